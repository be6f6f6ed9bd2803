"""Hybrid systems in time: Runge-Kutta steps, events and switching surfaces, derivatives, and what makes the runs.

`hybrid` says what a system is, `step` takes one step, `drive` repeats it by XLA or by a kernel, and `solve` is the
interface for fields. The ring knows no loop and no plant. It imports `core`, `host` and `compiler`.

Read first: `hybrid.py`, `step/advance.py`, `drive/runs.py`.
"""

from typing import TYPE_CHECKING

from diffabs.host.exports import lazy_getattr

if TYPE_CHECKING:
    from diffabs.engine.solve import solve as solve

__getattr__ = lazy_getattr(__name__)
