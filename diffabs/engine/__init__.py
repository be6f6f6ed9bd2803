"""A run in time: Runge-Kutta steps, events and switching surfaces, derivatives, and the engines that make the runs.

`step` takes one step, `drive` repeats it by XLA or by a kernel, and `run` and `solve` are the interface. The ring
imports `core`, `host` and `compiler`.

Read first: `run.py`, `step/advance.py`, `drive/loops.py`.
"""

from typing import TYPE_CHECKING

from diffabs.host.exports import lazy_getattr

if TYPE_CHECKING:
    from diffabs.engine.run import measure as measure
    from diffabs.engine.run import rollout as rollout
    from diffabs.engine.solve import solve as solve

__getattr__ = lazy_getattr(__name__)
