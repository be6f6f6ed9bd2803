"""What chooses the steps of a run, by one interface: a solver's numbers as a pytree, for compiled programs."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.arrays import as_array
from diffabs.core.compiling import traced
from diffabs.core.log import lend
from diffabs.core.loop import Loop
from diffabs.simulate import adaptive, stepper
from diffabs.simulate.checkpoint import anyone
from diffabs.simulate.dynamics import Objectives
from diffabs.simulate.landing import select
from diffabs.simulate.lengths import Pace, longest_stable
from diffabs.simulate.outcome import observe
from diffabs.simulate.solution import Adaptive, Solver, Trajectory
from diffabs.simulate.tries import Carry

ROUNDING = 32  # times the precision of a number: the least error that is asked of a step
PART = 0.03  # of the error that a step may have, where a derivative is asked for
ROUND = 16  # tries between two looks at what is stable


@partial(jax.tree_util.register_dataclass, data_fields=["h", "steps"], meta_fields=["kinks", "refines"])
@dataclasses.dataclass(frozen=True)
class OnGrid:
    """The steps of a `FixedStep`: their length [s], how many there are, whether comparisons are located (None for
    derivatives, and where a rate jumps), and whether the moments of events have second derivatives."""

    h: Any
    steps: Any
    kinks: bool | None = None
    refines: bool = False

    def start(self, loop: Loop, objectives: Objectives, key: Any) -> stepper.Carry:
        """Return the carry at t = 0."""
        return stepper.init_carry(loop, objectives, self.h, key, kinks=self._locates(loop))

    def step(
        self, loop: Loop, objectives: Objectives, key: Any, carry: stepper.Carry, until: Any = None
    ) -> stepper.Carry:
        """Return the carry after one try of a step; the same if the run is over, or has come to instant `until`."""
        how = {"kinks": self._locates(loop), "refines": self.refines}
        return stepper.step(loop, objectives, self.h, key, self.steps, carry, until, **how)

    def renew(self, loop: Loop, carry: stepper.Carry) -> stepper.Carry:
        """Return the carry: nothing has to be looked at but in the steps."""
        del loop
        return carry

    def before(self, carry: stepper.Carry, instant: Any) -> Any:
        """Return whether the run goes on, and has not come to this instant."""
        return carry.running & (carry.k < instant)

    def seen(self, loop: Loop, carry: stepper.Carry, instant: Any) -> Trajectory:
        """Return what is seen at this instant of the grid, to which the run has come."""
        del instant
        return observe(loop, carry.point.t, carry.point.state, carry.running)

    def watched(self) -> "OnGrid":
        """Return the method for a run that is seen on its way."""
        return self

    def located(self) -> "OnGrid":
        """Return the method for derivatives."""
        return dataclasses.replace(self, kinks=self.kinks is not False, refines=True)

    def room(self, loop: Loop, steps: int) -> int:
        """Return how many tries so many steps may take."""
        return stepper.room(loop, steps, kinks=self.kinks is not False)

    def _locates(self, loop: Loop) -> bool:
        return loop.jumps if self.kinks is None else self.kinks


@partial(jax.tree_util.register_dataclass, data_fields=["h", "steps", "rtol"], meta_fields=["keeps", "notes"])
@dataclasses.dataclass(frozen=True)
class AtPace(Pace):
    """The steps of `Adaptive`."""

    def start(self, loop: Loop, objectives: Objectives, key: Any) -> Carry:
        """Return the carry at t = 0."""
        return adaptive.init_carry(loop, objectives, self, key)

    def step(self, loop: Loop, objectives: Objectives, key: Any, carry: Carry, until: Any = None) -> Carry:
        """Return the carry after one try of a step; the same if the run is over, or has come to instant `until`."""
        return adaptive.step(loop, objectives, self, key, carry, until)

    def renew(self, loop: Loop, carry: Carry) -> Carry:
        """Return the carry with the longest stable step, if that was not looked at for ROUND tries."""
        due, at = carry.running & (carry.tries - carry.renewed >= ROUND), carry.point
        limit = jax.lax.cond(
            anyone(due), lambda: longest_stable(loop, at.t, at.state, carry.scale), lambda: carry.limit
        )
        return carry._replace(limit=limit, renewed=jnp.where(due, carry.tries, carry.renewed))

    def before(self, carry: Carry, instant: Any) -> Any:
        """Return whether the run goes on, and has not come to this instant."""
        return adaptive.before(self, carry, instant)

    def seen(self, loop: Loop, carry: Carry, instant: Any) -> Trajectory:
        """Return what is seen at this instant of the grid, which lies within the last step."""
        now, t = carry.point, instant * self.h
        inside = (t < now.t) & (carry.past.until > carry.past.t)
        t, state = select(inside, (t, carry.past.at(t)), (now.t, lend(now.state, None)))
        return observe(loop, t, state, carry.running | inside)

    def watched(self) -> "AtPace":
        """Return the method for a run that is seen on its way."""
        return dataclasses.replace(self, keeps=True)

    def unwatched(self) -> "AtPace":
        """Return the method for a run that is not."""
        return dataclasses.replace(self, keeps=False)

    def noted(self) -> "AtPace":
        """Return the method for a run that is to be repeated. Its derivative changes faster than the run, so the error
        of a step is a part of what it is for values."""
        return dataclasses.replace(self, notes=True, rtol=_possible(PART * self.rtol))


def method_of(solver: Solver, dtype: Any) -> OnGrid | AtPace:
    """Return what chooses the steps of a solver, its numbers of this type."""
    number = jnp.asarray if traced() else as_array
    h, steps = number(float(solver.step), dtype), jax.device_put(solver.steps)  # `asarray` would compile a program
    if isinstance(solver, Adaptive):
        return AtPace(h, steps, number(float(_possible(np.asarray(solver.rtol, dtype))), dtype))
    return OnGrid(h, steps, solver.kinks)


def _possible(rtol: Any) -> Any:
    """No less than the precision of its type allows."""
    most = np if isinstance(rtol, np.ndarray) else jnp
    return most.maximum(rtol, ROUNDING * jnp.finfo(rtol.dtype).eps)
