"""Simulate, differentiate, tune and certify controllers for braking wheels."""

from diffabs import interrupt as _interrupt

_interrupt.early()  # before JAX, whose import takes seconds

from diffabs.loop import Loop as Loop
from diffabs.plants import BrakeStart as BrakeStart
from diffabs.pytree import replace as replace
from diffabs.refusals import check as check
from diffabs.rollout import FixedStep as FixedStep
from diffabs.rollout import Run as Run
from diffabs.rollout import measure as measure
from diffabs.rollout import rollout as rollout

__version__ = "0.1.0"
