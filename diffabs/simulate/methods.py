"""What chooses the steps of a run, by one interface: a solver's numbers as a pytree, for compiled programs."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.arrays import as_array
from diffabs.core.compiling import is_traced
from diffabs.core.log import borrow
from diffabs.core.loop import Loop
from diffabs.simulate import adaptive, stepper
from diffabs.simulate.checkpoint import any_lane
from diffabs.simulate.dynamics import Objectives
from diffabs.simulate.landing import select
from diffabs.simulate.lengths import StepSizeControl, spectral_step_limit
from diffabs.simulate.result import observe
from diffabs.simulate.solution import Adaptive, Solver, Trajectory
from diffabs.simulate.tries import AdaptiveCarry

MIN_RTOL_EPS = 32  # times the precision of a number: the least error that is asked of a step
DERIVATIVE_RTOL_FRACTION = 0.03  # of the error that a step may have, where a derivative is asked for
ATTEMPTS_PER_RENEWAL = 16  # tries between two looks at what is stable


@partial(jax.tree_util.register_dataclass, data_fields=["h", "steps"], meta_fields=["kinks", "refines"])
@dataclasses.dataclass(frozen=True)
class FixedStepping:
    """The steps of a `FixedStep`: their length [s], how many there are, whether comparisons are located (None for
    derivatives, and where a rate jumps), and whether the moments of events have second derivatives."""

    h: Any
    steps: Any
    kinks: bool | None = None
    refines: bool = False

    def start(self, loop: Loop, objectives: Objectives, key: Any) -> stepper.FixedStepCarry:
        """Return the carry at t = 0."""
        return stepper.init_carry(loop, objectives, self.h, key, kinks=self._locates(loop))

    def step(
        self, loop: Loop, objectives: Objectives, key: Any, carry: stepper.FixedStepCarry, until: Any = None
    ) -> stepper.FixedStepCarry:
        """Return the carry after one try of a step; the same if the run is over, or has come to instant `until`."""
        how = {"kinks": self._locates(loop), "refines": self.refines}
        return stepper.step(loop, objectives, self.h, key, self.steps, carry, until, **how)

    def renew(self, loop: Loop, carry: stepper.FixedStepCarry) -> stepper.FixedStepCarry:
        """Return the carry: nothing has to be looked at but in the steps."""
        del loop
        return carry

    def before(self, carry: stepper.FixedStepCarry, instant: Any) -> Any:
        """Return whether the run goes on, and has not come to this instant."""
        return carry.running & (carry.k < instant)

    def seen(self, loop: Loop, carry: stepper.FixedStepCarry, instant: Any) -> Trajectory:
        """Return what is seen at this instant of the grid, to which the run has come."""
        del instant
        return observe(loop, carry.point.t, carry.point.state, carry.running)

    def with_trajectory(self) -> "FixedStepping":
        """Return the method for a run that is seen on its way."""
        return self

    def for_derivatives(self) -> "FixedStepping":
        """Return the method for derivatives."""
        return dataclasses.replace(self, kinks=self.kinks is not False, refines=True)

    def room(self, loop: Loop, steps: int) -> int:
        """Return how many tries so many steps may take."""
        return stepper.attempt_capacity(loop, steps, kinks=self.kinks is not False)

    def _locates(self, loop: Loop) -> bool:
        return loop.jumps if self.kinks is None else self.kinks


@partial(jax.tree_util.register_dataclass, data_fields=["h", "steps", "rtol"], meta_fields=["keeps", "notes"])
@dataclasses.dataclass(frozen=True)
class AdaptiveStepping(StepSizeControl):
    """The steps of `Adaptive`."""

    def start(self, loop: Loop, objectives: Objectives, key: Any) -> AdaptiveCarry:
        """Return the carry at t = 0."""
        return adaptive.init_carry(loop, objectives, self, key)

    def step(
        self, loop: Loop, objectives: Objectives, key: Any, carry: AdaptiveCarry, until: Any = None
    ) -> AdaptiveCarry:
        """Return the carry after one try of a step; the same if the run is over, or has come to instant `until`."""
        return adaptive.step(loop, objectives, self, key, carry, until)

    def renew(self, loop: Loop, carry: AdaptiveCarry) -> AdaptiveCarry:
        """Return the carry with the longest stable step, if that was not looked at for ROUND tries."""
        due, at = carry.running & (carry.tries - carry.tries_at_renewal >= ATTEMPTS_PER_RENEWAL), carry.point
        limit = jax.lax.cond(
            any_lane(due), lambda: spectral_step_limit(loop, at.t, at.state, carry.scale), lambda: carry.limit
        )
        return carry._replace(limit=limit, tries_at_renewal=jnp.where(due, carry.tries, carry.tries_at_renewal))

    def before(self, carry: AdaptiveCarry, instant: Any) -> Any:
        """Return whether the run goes on, and has not come to this instant."""
        return adaptive.is_before(self, carry, instant)

    def seen(self, loop: Loop, carry: AdaptiveCarry, instant: Any) -> Trajectory:
        """Return what is seen at this instant of the grid, which lies within the last step."""
        now, t = carry.point, instant * self.h
        inside = (t < now.t) & (carry.last_step.until > carry.last_step.t)
        t, state = select(inside, (t, carry.last_step.at(t)), (now.t, borrow(now.state, None)))
        return observe(loop, t, state, carry.running | inside)

    def with_trajectory(self) -> "AdaptiveStepping":
        """Return the method for a run that is seen on its way."""
        return dataclasses.replace(self, keeps=True)

    def without_trajectory(self) -> "AdaptiveStepping":
        """Return the method for a run that is not."""
        return dataclasses.replace(self, keeps=False)

    def for_replay(self) -> "AdaptiveStepping":
        """Return the method for a run that is to be repeated. Its derivative changes faster than the run, so the error
        of a step is a part of what it is for values."""
        return dataclasses.replace(self, notes=True, rtol=_clip_rtol(DERIVATIVE_RTOL_FRACTION * self.rtol))


def build_stepping(solver: Solver, dtype: Any) -> FixedStepping | AdaptiveStepping:
    """Return what chooses the steps of a solver, its numbers of this type."""
    number = jnp.asarray if is_traced() else as_array
    h, steps = number(float(solver.step), dtype), jax.device_put(solver.steps)  # `asarray` would compile a program
    if isinstance(solver, Adaptive):
        return AdaptiveStepping(h, steps, number(float(_clip_rtol(np.asarray(solver.rtol, dtype))), dtype))
    return FixedStepping(h, steps, solver.kinks)


def _clip_rtol(rtol: Any) -> Any:
    """No less than the precision of its type allows."""
    most = np if isinstance(rtol, np.ndarray) else jnp
    return most.maximum(rtol, MIN_RTOL_EPS * jnp.finfo(rtol.dtype).eps)
