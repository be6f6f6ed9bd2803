"""Many runs of a closed loop: batches, their runs by the fastest engine, and estimates of the error.

The ring imports `engine` and what is below it.

Read first: `batch.py`, `ensemble.py`, `accuracy.py`.
"""

from typing import TYPE_CHECKING

from diffabs.host.exports import lazy_getattr

if TYPE_CHECKING:
    from diffabs.loop.batch import Batch as Batch
    from diffabs.loop.ensemble import run_batch as run_batch

__getattr__ = lazy_getattr(__name__)
