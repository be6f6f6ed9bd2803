"""Simulate, differentiate, tune and certify controllers for braking wheels and two-wheelers."""

from typing import TYPE_CHECKING

from diffabs.runtime import interrupt as _interrupt

_interrupt.end_early_on_interrupt()  # before JAX, whose import takes seconds

from diffabs.core.loop import Loop as Loop
from diffabs.core.pytree import arrays as arrays
from diffabs.core.pytree import replace as replace
from diffabs.plants import BrakeStart as BrakeStart
from diffabs.runtime.exports import lazy_getattr as _lazy_getattr
from diffabs.scenario.defaults import balancing as balancing
from diffabs.scenario.defaults import braking as braking
from diffabs.simulate.admissible import check as check
from diffabs.simulate.batch import Batch as Batch
from diffabs.simulate.ensemble import run_batch as run_batch
from diffabs.simulate.run import measure as measure
from diffabs.simulate.run import rollout as rollout
from diffabs.simulate.solve import Event as Event
from diffabs.simulate.solve import Solution as Solution
from diffabs.simulate.solve import solve as solve
from diffabs.simulate.solve import switches as switches
from diffabs.simulate.types import Adaptive as Adaptive
from diffabs.simulate.types import FixedStep as FixedStep
from diffabs.simulate.types import Run as Run

if TYPE_CHECKING:
    from diffabs import linear as linear
    from diffabs import sweep as sweep
    from diffabs import tune as tune
    from diffabs.scenario.registry import register_parts as register_parts
    from diffabs.scenario.scenario import load as load

__getattr__ = _lazy_getattr(__name__)
__version__ = "0.1.0"
