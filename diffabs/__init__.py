"""Simulate, differentiate, tune and certify controllers for braking wheels and two-wheelers."""

from typing import TYPE_CHECKING

from diffabs.host import interrupt as _interrupt

_interrupt.end_early_on_interrupt()  # before JAX, whose import takes seconds

from diffabs.core.pytree import arrays as arrays
from diffabs.core.pytree import replace as replace
from diffabs.engine.field import Event as Event
from diffabs.engine.solve import Solution as Solution
from diffabs.engine.solve import solve as solve
from diffabs.engine.solve import switches as switches
from diffabs.engine.solvers import Adaptive as Adaptive
from diffabs.engine.solvers import FixedStep as FixedStep
from diffabs.host.exports import lazy_getattr as _lazy_getattr
from diffabs.loop.admissible import check as check
from diffabs.loop.batch import Batch as Batch
from diffabs.loop.closed_loop import Loop as Loop
from diffabs.loop.ensemble import run_batch as run_batch
from diffabs.loop.result import Run as Run
from diffabs.loop.run import measure as measure
from diffabs.loop.run import rollout as rollout
from diffabs.parts.plants import BrakeStart as BrakeStart
from diffabs.scenario.defaults import balancing as balancing
from diffabs.scenario.defaults import braking as braking

if TYPE_CHECKING:
    from diffabs import linear as linear
    from diffabs import tune as tune
    from diffabs.parts import actuators as actuators
    from diffabs.parts import controllers as controllers
    from diffabs.parts import objectives as objectives
    from diffabs.parts import plants as plants
    from diffabs.parts import references as references
    from diffabs.parts import roads as roads
    from diffabs.parts import sensors as sensors
    from diffabs.parts import stops as stops
    from diffabs.robust import design as design
    from diffabs.robust import reach as reach
    from diffabs.scenario.proofs import prove_box as prove_box
    from diffabs.scenario.proofs import verify as verify
    from diffabs.scenario.registry import register_parts as register_parts
    from diffabs.scenario.scenario import load as load
    from diffabs.uncertainty import sweep as sweep

_export = _lazy_getattr(__name__)


def __getattr__(name: str) -> object:
    if name == "simulate":
        raise AttributeError(
            "diffabs has no simulate: a run is d.rollout(loop, solver), its metrics d.measure(loop, solver, objectives)"
        )
    return _export(name)


__version__ = "0.1.0"
