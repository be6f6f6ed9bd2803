"""Fixed steps: which step of a run under `FixedStep` is taken.

A step goes to the next instant of the grid. If an event lies within it, shorter steps are attempted until one ends on
the event (`event_location`). The next step goes on to the grid.

Steps keep to a mode if switching surfaces are located. A search on a switching surface may fail, or its mode may lead
to invalid numbers. Then the step is unrestricted: it goes to the grid, and each stage evaluates its comparisons. It is
accurate to the order of the kink. Later steps are unrestricted, too, until no comparison changes in one of them.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.types import Array, Bool, Int, Key, PyTree, Scalar
from diffabs.engine.hybrid import HybridState, HybridSystem
from diffabs.engine.step.advance import (
    Carry,
    Decision,
    advance,
    cast_floats,
    decide_attempt,
    have_same_answers,
    propose_step,
    start_carry,
)
from diffabs.engine.step.attempt import Attempt, StepRequest
from diffabs.engine.step.event_location import MAX_LOCATION_ATTEMPTS, SurfaceCrossing, find_surface_crossing
from diffabs.engine.step.outlook import look_ahead, watch_margins
from diffabs.engine.step.runge_kutta import RK4
from diffabs.engine.step.slides import begin_slide, ended_slide
from diffabs.engine.step.status import RunStatus
from diffabs.engine.step.system import UNCONSTRAINED, Evaluation, Objectives, ObservedSystem

EVENT_ATTEMPTS_PER_STEP, SPARE_ATTEMPTS = 4, 64  # attempts to locate events: for each step of the grid, and in addition
CROSSING_ATTEMPTS_PER_STEP = 1  # attempts on switching surfaces per step of the grid; beyond, steps are unrestricted
FOLLOWED_ATTEMPTS_PER_STEP = 4  # the same in a run that follows surfaces, and is lost where its steps are unrestricted
MAX_ATTEMPTS_PER_STEP = 32  # attempts within one step of the grid, as a multiple of these
CALM_STEP_FRACTION = 0.02  # of a step of the grid: after a longer step without a landing, a run does not slide
# Greatest change of a state in a step: a multiple of the rates at both ends, plus a fraction of the state.
MAX_RATE_RATIO, MAX_STATE_FRACTION = 4, 1e-3


class FixedStepControl(NamedTuple):
    """Numbers of `FixedStepping` in a carry.

    Attributes:
        extra: Number of attempts so far, not counting accepted steps to the grid and attempts in REFINING.
        in_step: Number of such attempts since the last instant of the grid.
    """

    extra: Int
    in_step: Int


class FixedStepReport(NamedTuple):
    """What `FixedStepping` needs to know of an attempt.

    Attributes:
        surface: Contradicted comparisons; None if switching surfaces are not located.
        grazes: True if a margin crosses zero twice within the step, or only touches it; False unless the method
            `watches`.
    """

    surface: SurfaceCrossing | None
    grazes: Bool


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["h", "steps"],
    meta_fields=["kinks", "second_order", "watches", "smooth", "follows"],
)
@dataclasses.dataclass(frozen=True)
class FixedStepping:
    """Steps of a `FixedStep` solver.

    Attributes:
        h: Length of a step [s].
        steps: Number of steps.
        kinks: True if switching surfaces are located. None locates them for derivatives, and if a rate jumps there.
        second_order: True if the times of events have second derivatives.
        watches: True if the run ends where it slides or grazes. It must locate switching surfaces.
        smooth: True if nothing switches and no event can happen. Then each attempt is a step to the next instant.
        follows: True if a run follows the surface along which it slides.
    """

    h: Array
    steps: Int
    kinks: bool | None = None
    second_order: bool = False
    watches: bool = False
    smooth: bool = False
    follows: bool = False
    tableau = RK4
    step = advance

    @property
    def searches(self) -> bool:
        """True if the method locates events."""
        return not self.smooth

    @property
    def has_margin_rates(self) -> bool:
        """True if the rates of all margins are evaluated."""
        return self.watches

    @property
    def crossing_attempts(self) -> int:
        """Attempts on switching surfaces per step of the grid; beyond, steps are unrestricted."""
        return FOLLOWED_ATTEMPTS_PER_STEP if self.follows else CROSSING_ATTEMPTS_PER_STEP

    def start(self, hybrid: HybridSystem, objectives: Objectives, key: Key) -> Carry:
        """Return the carry of a run at t = 0, from `hybrid`, `objectives` and random `key`."""
        foresee = partial(look_ahead, jnp.asarray(True), -1) if self.watches else lambda dynamics: ()
        carry = start_carry(self, hybrid, objectives, key, foresee)
        return cast_floats(carry._replace(control=FixedStepControl(carry.k, carry.k)), self.h.dtype)

    def renew(self, hybrid: HybridSystem, carry: Carry) -> Carry:
        """Return the `carry` unchanged: fixed steps of a `hybrid` need no update between blocks."""
        del hybrid
        return carry

    def is_active(self, carry: Carry, until: Int | None) -> Bool:
        """Return True if the run of `carry` goes on and has not reached the instant `until` of the grid."""
        return carry.running if until is None else carry.running & (carry.k < until)

    def state_at(self, carry: Carry, instant: Scalar) -> tuple[Array, HybridState, Bool]:
        """Return time, state, and whether the run goes on, at an `instant` of the grid that the `carry` has reached."""
        del instant
        return carry.point.t, carry.point.state, carry.running

    def for_derivatives(self) -> "FixedStepping":
        """Return the method for derivatives of both orders: it locates switching surfaces unless `kinks` is False."""
        return dataclasses.replace(self, kinks=self.kinks is not False, second_order=True)

    def capacity(self, hybrid: HybridSystem, steps: int) -> int:
        """Return the capacity of a scan for this number of `steps`: the greatest usual number of attempts.

        An event takes at least four attempts. One of them is REFINING, which `FixedStepControl.extra` does not count.
        """
        if self.smooth:
            return steps
        crossings = self.crossing_attempts if self.kinks is not False else 0
        about = (crossings + (EVENT_ATTEMPTS_PER_STEP if hybrid.eventful else 0)) * steps + SPARE_ATTEMPTS
        return steps + SPARE_ATTEMPTS + about + about // 3

    def is_switched(self, hybrid: HybridSystem) -> bool:
        """Return True if the comparisons of the `hybrid`'s flow are visible."""
        return hybrid.jumps if self.kinks is None else self.kinks

    def is_calm(self, carry: Carry) -> Bool:
        """Return True if the attempt of `carry` is no short rest of a step."""
        return carry.length > CALM_STEP_FRACTION * self.h

    def propose(self, system: ObservedSystem, carry: Carry) -> StepRequest:
        """Return the next step to attempt, by the run of `carry` in `system`."""
        strike = carry.k + 1
        if self.smooth:
            no, yes = jnp.asarray(False), jnp.asarray(True)
            return StepRequest(self.h, strike * self.h, self.h, UNCONSTRAINED, no, yes, strike)
        return propose_step(self, system, carry, strike, frozen=system.program is not None)

    def forecast(self, carry: Carry, dynamics: Evaluation) -> PyTree:
        """Return the `Outlook` if the method `watches`, and else nothing."""
        if not self.watches:
            return ()
        return look_ahead(carry.status == RunStatus.REFRESHING, ended_slide(carry), dynamics)

    def report(
        self, system: ObservedSystem, carry: Carry, h: Scalar, dynamics: Evaluation, state: HybridState, error: object
    ) -> FixedStepReport:
        """Return the comparisons that an attempt contradicts at its end, and whether a margin grazes zero."""
        del state, error
        surface, grazes = find_surface_crossing(dynamics, carry.search.number, h) if system.program else None, False
        if self.watches:
            turns = watch_margins(carry, h, dynamics, system.bit_count)
            grazes = turns.grazes | (turns.time_since > 0)
        return FixedStepReport(surface, jnp.asarray(grazes))

    def decide(
        self, system: ObservedSystem, carry: Carry, request: StepRequest, attempt: Attempt, active: Bool
    ) -> Decision:
        """Return the decision: the numbers must be finite and, within a mode, plausible."""
        end = attempt.point
        # The rates at the end of a smooth run are used nowhere else but in samples of its last step.
        numbers = jax.tree.leaves((end.state.flow(), end.rates[0] if self.smooth else ()))
        valid = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in numbers]))
        # A run that slides is moved onto its surface, which no rate predicts.
        valid &= carry.unrestricted | request.mode.slides | _is_plausible(carry, attempt) if system.program else True
        last = request.strikes & (request.strike >= self.steps)
        frozen = system.program is not None
        return decide_attempt(self, system, carry, attempt, active, valid, valid, last=last, frozen=frozen)

    def plan_next(
        self, system: ObservedSystem, carry: Carry, attempt: Attempt, decision: Decision, after: Carry
    ) -> Carry:
        """Return `after` with length and status of the next attempt, which goes to the grid or continues the search."""
        if self.smooth:
            return after._replace(status=jnp.where(decision.valid, after.status, RunStatus.DIVERGED))
        control, on_grid = carry.control, decision.accepted & carry.strikes
        extra = control.extra + jnp.where(on_grid | (carry.status == RunStatus.REFINING), 0, 1)
        in_step = jnp.where(on_grid, 0, control.in_step + extra - control.extra)
        unrestricted, status = carry.unrestricted, after.status
        if system.program:
            crowded = control.in_step >= self.crossing_attempts * MAX_ATTEMPTS_PER_STEP
            gave_up = (
                crowded
                | (after.search.tries >= MAX_LOCATION_ATTEMPTS)
                | (control.extra > self.crossing_attempts * carry.k + SPARE_ATTEMPTS)
            )
            gave_up &= decision.searches & (after.search.number < system.bit_count)
            if watch := after.slides:
                # So many landings within one step that there is no room for another return.
                begins = gave_up & crowded & (watch.returns > 0)
                slide = begin_slide(watch.lost, begins, after.search.number, after.point.t)
                after = after._replace(slides=watch._replace(lost=slide))
            becomes_unrestricted = ~decision.accepted & ~unrestricted & (~decision.valid | gave_up)
            unrestricted = (unrestricted | becomes_unrestricted) & ~(on_grid & have_same_answers(carry, attempt))
            status = jnp.where(becomes_unrestricted, RunStatus.RUNNING, status)
        max_extra = (EVENT_ATTEMPTS_PER_STEP + self.crossing_attempts) * self.steps + SPARE_ATTEMPTS
        lost = ~decision.valid & (carry.unrestricted if system.program else True)
        if self.watches:
            grazes = attempt.report.grazes & (decision.accepted | decision.searches)
            status = jnp.where(unrestricted, RunStatus.SLID, jnp.where(grazes, RunStatus.GRAZED, status))
        status = jnp.where(extra > max_extra, RunStatus.EXHAUSTED, status)
        strikes = status == RunStatus.RUNNING
        length = jnp.where(strikes, self.h - after.since, jnp.where(status == RunStatus.REFRESHING, 0.0, after.length))
        return after._replace(
            length=length,
            strikes=strikes,
            unrestricted=unrestricted,
            control=FixedStepControl(extra, in_step),
            status=jnp.where(lost, RunStatus.DIVERGED, status),
        )


def _is_plausible(carry: Carry, attempt: Attempt) -> Bool:
    """Return True if the state has changed roughly as the rates at both ends predict."""
    ends = [jax.tree.leaves(point.state.flow()) for point in (carry.point, attempt.point)]
    rates = [jax.tree.leaves(point.rates[0]) for point in (carry.point, attempt.point)]
    # A flow within a mode need not be bounded beyond its kinks, unlike the loop's own flow. A step too long for
    # stability goes there.
    sane = []
    for a, b, p, q in zip(*ends, *rates, strict=True):
        from_rates = MAX_RATE_RATIO * jnp.abs(carry.length) * jnp.maximum(jnp.abs(p), jnp.abs(q))
        sane.append(jnp.all(jnp.abs(b - a) <= from_rates + MAX_STATE_FRACTION * (jnp.abs(a) + jnp.abs(b))))
    return jnp.all(jnp.array(sane))
