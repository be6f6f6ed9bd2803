"""Many random runs: Monte-Carlo sweeps with statistics, and probabilities of rare failures. Needs the extra `sweep`.

The ring imports `loop` and what is below it; it knows no scenario.

Read first: `sweep/run.py`, `sweep/sampling.py`, `reliability/failure.py`.
"""

from typing import TYPE_CHECKING

from diffabs.host.exports import lazy_getattr

if TYPE_CHECKING:
    from diffabs.uncertainty import reliability as reliability
    from diffabs.uncertainty import sweep as sweep

__getattr__ = lazy_getattr(__name__)
