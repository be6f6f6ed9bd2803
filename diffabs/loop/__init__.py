"""The closed loop: a hybrid system of plant, controller and the blocks around them, its runs, batches and errors.

`closed_loop` is the system, `run` makes one run and `ensemble` many, `result` judges them. The ring imports `parts`,
`engine` and what is below them.

Read first: `closed_loop.py`, `run.py`, `ensemble.py`.
"""

from typing import TYPE_CHECKING

from diffabs.host.exports import lazy_getattr

if TYPE_CHECKING:
    from diffabs.loop.batch import Batch as Batch
    from diffabs.loop.ensemble import run_batch as run_batch
    from diffabs.loop.run import measure as measure
    from diffabs.loop.run import rollout as rollout

__getattr__ = lazy_getattr(__name__)
