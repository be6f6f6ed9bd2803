"""Stepping methods of a run behind one interface: the numbers of a solver as a pytree, for compiled programs."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from diffabs.core.arrays import as_array
from diffabs.core.compiling import is_traced
from diffabs.core.log import borrow
from diffabs.core.loop import Loop
from diffabs.core.types import Int, Key, PyTree, Scalar
from diffabs.simulate.drive.checkpoint import any_lane
from diffabs.simulate.result import observe
from diffabs.simulate.step import adaptive
from diffabs.simulate.step import fixed as stepper
from diffabs.simulate.step.event_location import select
from diffabs.simulate.step.step_size import StepSizeControl, spectral_step_limit
from diffabs.simulate.step.system import Objectives
from diffabs.simulate.step.tries import AdaptiveCarry
from diffabs.simulate.types import Adaptive, Solver, Trajectory

MIN_RTOL_EPS = 32  # multiples of machine epsilon: the smallest error that a step can reach
DERIVATIVE_RTOL_FRACTION = 0.03  # fraction of the allowed error of a step, for derivatives
ATTEMPTS_PER_RENEWAL = 16  # attempts between two updates of the stability limit


@partial(jax.tree_util.register_dataclass, data_fields=["h", "steps"], meta_fields=["kinks", "refines"])
@dataclasses.dataclass(frozen=True)
class FixedStepping:
    """Steps of a `FixedStep` solver.

    Attributes:
        h: Length of a step [s].
        steps: Number of steps.
        kinks: True if switching surfaces are located. None locates them for derivatives, and if a rate jumps there.
        refines: True if the times of events have second derivatives.
    """

    h: Scalar
    steps: Int
    kinks: bool | None = None
    refines: bool = False

    def start(self, loop: Loop, objectives: Objectives, key: Key) -> stepper.FixedStepCarry:
        """Return the carry of a run at t = 0, from `loop`, `objectives` and random `key`."""
        return stepper.init_carry(loop, objectives, self.h, key, kinks=self._locates(loop))

    def step(
        self, loop: Loop, objectives: Objectives, key: Key, carry: stepper.FixedStepCarry, until: Scalar = None
    ) -> stepper.FixedStepCarry:
        """Return the `carry` after one attempt of a step, unchanged if the run is over or has reached the instant
        `until`.

        `loop`, `objectives` and `key` are those of `start`.
        """
        how = {"kinks": self._locates(loop), "refines": self.refines}
        return stepper.step(loop, objectives, self.h, key, self.steps, carry, until, **how)

    def renew(self, loop: Loop, carry: stepper.FixedStepCarry) -> stepper.FixedStepCarry:
        """Return the `carry` unchanged: fixed steps of a `loop` need no update between blocks."""
        del loop
        return carry

    def before(self, carry: stepper.FixedStepCarry, instant: Scalar) -> PyTree:
        """Return True if the run with this `carry` goes on and has not reached this `instant`."""
        return carry.running & (carry.k < instant)

    def observe_at(self, loop: Loop, carry: stepper.FixedStepCarry, instant: Scalar) -> Trajectory:
        """Return the signals of the `loop` at this `instant` of the grid, which the `carry` has reached."""
        del instant
        return observe(loop, carry.point.t, carry.point.state, carry.running)

    def with_trajectory(self) -> "FixedStepping":
        """Return the method for a run with a trajectory."""
        return self

    def for_derivatives(self) -> "FixedStepping":
        """Return the method for derivatives."""
        return dataclasses.replace(self, kinks=self.kinks is not False, refines=True)

    def room(self, loop: Loop, steps: int) -> int:
        """Return the capacity of attempts for a number of `steps` of this `loop`."""
        return stepper.attempt_capacity(loop, steps, kinks=self.kinks is not False)

    def _locates(self, loop: Loop) -> bool:
        return loop.jumps if self.kinks is None else self.kinks


@partial(jax.tree_util.register_dataclass, data_fields=["h", "steps", "rtol"], meta_fields=["keeps", "notes"])
@dataclasses.dataclass(frozen=True)
class AdaptiveStepping(StepSizeControl):
    """Steps of an `Adaptive` solver."""

    def start(self, loop: Loop, objectives: Objectives, key: Key) -> AdaptiveCarry:
        """Return the carry of a run at t = 0, from `loop`, `objectives` and random `key`."""
        return adaptive.init_carry(loop, objectives, self, key)

    def step(
        self, loop: Loop, objectives: Objectives, key: Key, carry: AdaptiveCarry, until: Scalar = None
    ) -> AdaptiveCarry:
        """Return the `carry` after one attempt of a step, unchanged if the run is over or has reached the instant
        `until`.

        `loop`, `objectives` and `key` are those of `start`.
        """
        return adaptive.step(loop, objectives, self, key, carry, until)

    def renew(self, loop: Loop, carry: AdaptiveCarry) -> AdaptiveCarry:
        """Return the `carry` with a new stability limit of the `loop`, once in `ATTEMPTS_PER_RENEWAL` attempts."""
        due, at = carry.running & (carry.tries - carry.tries_at_renewal >= ATTEMPTS_PER_RENEWAL), carry.point
        # One condition for the whole batch: `cond` with one for each run would execute both branches.
        limit = jax.lax.cond(
            any_lane(due), lambda: spectral_step_limit(loop, at.t, at.state, carry.scale), lambda: carry.limit
        )
        return carry._replace(limit=limit, tries_at_renewal=jnp.where(due, carry.tries, carry.tries_at_renewal))

    def before(self, carry: AdaptiveCarry, instant: Scalar) -> PyTree:
        """Return True if the run with this `carry` goes on and has not reached this `instant`."""
        return adaptive.is_before(self, carry, instant)

    def observe_at(self, loop: Loop, carry: AdaptiveCarry, instant: Scalar) -> Trajectory:
        """Return the signals of the `loop` at this `instant` of the grid, which lies within the last step of the
        `carry`.
        """
        now, t = carry.point, instant * self.h
        # The last step is a cubic, so the instant may lie anywhere in it. A run that is over shows its last point.
        inside = (t < now.t) & (carry.last_step.until > carry.last_step.t)
        t, state = select(inside, (t, carry.last_step.at(t)), (now.t, borrow(now.state, None)))
        return observe(loop, t, state, carry.running | inside)

    def with_trajectory(self) -> "AdaptiveStepping":
        """Return the method for a run with a trajectory."""
        return dataclasses.replace(self, keeps=True)

    def without_trajectory(self) -> "AdaptiveStepping":
        """Return the method for a run without a trajectory."""
        return dataclasses.replace(self, keeps=False)

    def for_replay(self) -> "AdaptiveStepping":
        """Return the method for a run that is logged and then replayed with derivatives.

        The derivative changes faster than the run. The allowed error of a step is therefore only
        `DERIVATIVE_RTOL_FRACTION` of that for values.
        """
        return dataclasses.replace(self, notes=True, rtol=_clip_rtol(DERIVATIVE_RTOL_FRACTION * self.rtol))


def build_stepping(solver: Solver, dtype: DTypeLike) -> FixedStepping | AdaptiveStepping:
    """Return the stepping method of a solver, with numbers of one data type.

    Args:
        solver: Solver of the run.
        dtype: Floating-point type.
    """
    number = jnp.asarray if is_traced() else as_array
    # `device_put` instead of `jnp.asarray`, which would compile a program.
    h, steps = number(float(solver.step), dtype), jax.device_put(solver.steps)
    if isinstance(solver, Adaptive):
        return AdaptiveStepping(h, steps, number(float(_clip_rtol(np.asarray(solver.rtol, dtype))), dtype))
    return FixedStepping(h, steps, solver.kinks)


def _clip_rtol(rtol: Scalar) -> Scalar:
    """Return rtol, but at least the multiple `MIN_RTOL_EPS` of the machine epsilon of its type."""
    most = np if isinstance(rtol, np.ndarray) else jnp
    return most.maximum(rtol, MIN_RTOL_EPS * jnp.finfo(rtol.dtype).eps)
