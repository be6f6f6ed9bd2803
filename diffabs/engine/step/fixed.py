"""Fixed steps: which step of a run under `FixedStep` is taken.

A step goes to the next instant of the grid. If an event lies within it, shorter steps are attempted until one ends on
the event (`event_location`). The next step goes on to the grid.

Steps keep to a mode if switching surfaces are located. A search on a switching surface may fail, or its mode may lead
to invalid numbers. Then the step is unrestricted: it goes to the grid, and each stage evaluates its comparisons. It is
accurate to the order of the kink. Later steps are unrestricted, too, until no comparison changes in one of them. With
`WatchedModes` a failed search ends the run, and so does the unrestricted step: SLID, or DIVERGED if its numbers are
invalid, too.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.types import Array, Bool, Int, Key, PyTree, Scalar
from diffabs.engine.hybrid import HybridState, HybridSystem
from diffabs.engine.step.advance import Carry, Decision, Judged, advance, cast_floats, start_carry
from diffabs.engine.step.attempt import Attempt, Point, StepRequest
from diffabs.engine.step.event_location import RunStatus
from diffabs.engine.step.modes import SlidingSurface, SurfaceCrossing
from diffabs.engine.step.outlook import look_ahead
from diffabs.engine.step.runge_kutta import RK4
from diffabs.engine.step.slides import along_of, begin_slide, ended_slide, no_surface
from diffabs.engine.step.switching import FREE_MODES, KEPT_MODES, UNSWITCHED, Checks, ModeGuard, Strain, Unswitched
from diffabs.engine.step.system import UNCONSTRAINED, Evaluation, Objectives, ObservedSystem

EVENT_ATTEMPTS_PER_STEP, SPARE_ATTEMPTS = 4, 64  # attempts to locate events: for each step of the grid, and in addition
CROSSING_ATTEMPTS_PER_STEP = 1  # attempts on switching surfaces per step of the grid; beyond, steps are unrestricted
FOLLOWED_ATTEMPTS_PER_STEP = 4  # the same in a run that follows surfaces, and is lost where its steps are unrestricted
MAX_ATTEMPTS_PER_STEP = 32  # attempts within one step of the grid, as a multiple of these
CALM_STEP_FRACTION = 0.02  # of a step of the grid: after a longer step without a landing, a run does not slide
# Greatest change of a state in a step: a multiple of the rates at both ends, plus a fraction of the state.
MAX_RATE_RATIO, MAX_STATE_FRACTION = 4, 1e-3
MAX_END_RATE_RATIO = 3  # Greatest rate at the end of a step: a multiple of the rate at its start plus the mean rate


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
        grazes: True if a margin crosses zero twice within the step, or only touches it, in a run that is watched.
    """

    surface: SurfaceCrossing | None
    grazes: Bool


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["h", "steps"],
    meta_fields=["switches", "second_order"],
)
@dataclasses.dataclass(frozen=True)
class FixedStepping:
    """Steps of a `FixedStep` solver.

    Attributes:
        h: Length of a step [s].
        steps: Number of steps.
        switches: What they do about switches. None is not chosen yet: modes are kept for derivatives, and for values
            if a rate jumps at a surface.
        second_order: True if the times of events have second derivatives.
    """

    h: Array
    steps: Int
    switches: Any = None
    second_order: bool = False
    tableau = RK4

    @property
    def has_margin_rates(self) -> bool:
        """True if the rates of all margins are evaluated."""
        return self.switches.watches

    @property
    def shows_comparisons(self) -> bool:
        """True if the comparisons of the flow are visible."""
        return self.switches.keeps_mode

    @property
    def crossing_attempts(self) -> int:
        """Attempts on switching surfaces per step of the grid; beyond, steps are unrestricted."""
        return FOLLOWED_ATTEMPTS_PER_STEP if self.switches.follows else CROSSING_ATTEMPTS_PER_STEP

    def _for_values(self, hybrid: HybridSystem) -> "FixedStepping":
        """Return the method for the values of `hybrid`."""
        return self._resolve(KEPT_MODES if hybrid.jumps else FREE_MODES)

    def _resolve(self, switches: Unswitched) -> "FixedStepping":
        return self if self.switches else dataclasses.replace(self, switches=switches)

    def start(self, hybrid: HybridSystem, objectives: Objectives, key: Key) -> Carry:
        """Return the carry of a run at t = 0, from `hybrid`, `objectives` and random `key`."""
        method = self._for_values(hybrid)
        foresee = partial(method._look_ahead, jnp.asarray(True), no_surface(), ())
        carry = start_carry(method, hybrid, objectives, key, foresee)
        return cast_floats(carry._replace(control=FixedStepControl(carry.k, carry.k)), self.h.dtype)

    def step(
        self, hybrid: HybridSystem, objectives: Objectives, key: Key | None, carry: Carry, until: Int | None = None
    ) -> Carry:
        """Return the `carry` after one attempt, as `advance` says."""
        return advance(self._for_values(hybrid), hybrid, objectives, key, carry, until)

    def keep_steps(self, carry: Carry) -> Carry:
        """Return the `carry` unchanged: steps end on the instants of the grid."""
        return carry

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
        """Return the method for derivatives of both orders."""
        return dataclasses.replace(self._resolve(KEPT_MODES), second_order=True)

    def without_switches(self) -> "FixedStepping":
        """Return the method for a field without comparisons and events."""
        return PlainFixedStepping(self.h, self.steps, UNSWITCHED)

    def capacity(self, hybrid: HybridSystem, steps: int) -> int:
        """Return the capacity of a scan for this number of `steps`: the greatest usual number of attempts.

        An event takes at least four attempts. One of them is REFINING, which `FixedStepControl.extra` does not count.
        """
        crossings = self.crossing_attempts if self.switches.keeps_mode else 0
        about = (crossings + (EVENT_ATTEMPTS_PER_STEP if hybrid.eventful else 0)) * steps + SPARE_ATTEMPTS
        return steps + SPARE_ATTEMPTS + about + about // 3

    def is_calm(self, carry: Carry) -> Bool:
        """Return True if the attempt of `carry` is longer than a short rest of a step."""
        return carry.length > CALM_STEP_FRACTION * self.h

    def propose(self, system: ObservedSystem, carry: Carry) -> StepRequest:
        """Return the next step to attempt, by the run of `carry` in `system`."""
        return self.switches.propose(system, carry, self.h, carry.k + 1)

    def forecast(self, carry: Carry, dynamics: Evaluation) -> PyTree:
        """Return the `Outlook` of a method that watches all margins, and else nothing."""
        fresh = carry.status == RunStatus.REFRESHING
        return self._look_ahead(fresh, ended_slide(carry), along_of(carry), dynamics)

    def report(
        self, system: ObservedSystem, carry: Carry, h: Scalar, dynamics: Evaluation, state: HybridState, error: object
    ) -> FixedStepReport:
        """Return the comparisons that an attempt contradicts at its end, and whether a margin grazes zero."""
        del state, error
        surface, grazes = self.switches.find_surface(carry, h, dynamics), False
        if self.has_margin_rates:
            turns = self.switches.find_turns(system, carry, h, dynamics)
            grazes = turns.grazes | (turns.time_since > 0)
        return FixedStepReport(surface, jnp.asarray(grazes))

    def decide(
        self, system: ObservedSystem, carry: Carry, request: StepRequest, attempt: Attempt, active: Bool
    ) -> Decision:
        """Return the decision: the numbers must be finite and, within a mode, plausible."""
        numbers = jax.tree.leaves(self._list_numbers(attempt.point))
        valid = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in numbers]))
        if self.switches.keeps_mode:  # a run that slides is moved onto its surface, which no rate predicts
            valid &= carry.unrestricted | request.mode.slides | _is_plausible(carry, attempt)
        last = request.strikes & (request.strike >= self.steps)
        return self.switches.decide(system, carry, attempt, Checks(active, valid, valid, last))

    def plan_next(
        self, system: ObservedSystem, carry: Carry, attempt: Attempt, decision: Decision, after: Carry
    ) -> Carry:
        """Return `after` with length and status of the next attempt, which goes to the grid or continues the search."""
        control, on_grid = carry.control, decision.accepted & carry.strikes
        extra = control.extra + jnp.where(on_grid | (carry.status == RunStatus.REFINING), 0, 1)
        in_step = jnp.where(on_grid, 0, control.in_step + extra - control.extra)
        status, unrestricted, lost = after.status, carry.unrestricted, ~decision.valid
        if self.switches.keeps_mode:
            after, guard = self._guard_mode(Judged(system, carry, attempt, decision), after, calm=on_grid)
            status = jnp.where(guard.abandons, RunStatus.RUNNING, status)
            unrestricted, lost = guard.unrestricted, lost & carry.unrestricted
            if self.switches.watches:
                grazes = attempt.report.grazes & (decision.accepted | decision.searches)
                status = self.switches.judge(status, guard.slides, grazes, after)
                lost |= grazes & (carry.status == RunStatus.RUNNING) & _outruns_step(carry, attempt)
        max_extra = (EVENT_ATTEMPTS_PER_STEP + self.crossing_attempts) * self.steps + SPARE_ATTEMPTS
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

    def _guard_mode(self, judged: Judged, after: Carry, *, calm: Bool) -> tuple[Carry, ModeGuard]:
        """Return the carry `after` an attempt with the slide that it has lost, and what becomes of its mode."""
        _, carry, _, decision = judged
        control = carry.control
        crowded = control.in_step >= self.crossing_attempts * MAX_ATTEMPTS_PER_STEP
        strain = Strain(
            crowded=crowded | (control.extra > self.crossing_attempts * carry.k + SPARE_ATTEMPTS),
            # Without its mode the numbers are valid: a surface is in the way that could not be located.
            leaves=decision.valid & carry.unrestricted if self.switches.watches else False,
            calm=calm,
            stuck=jnp.logical_not(decision.valid),
        )
        guard = self.switches.guard(judged, after, strain)
        if watch := after.slides:
            # So many landings within one step that there is no room for another return.
            begins = guard.fails & crowded & (watch.returns > 0)
            slide = begin_slide(watch.lost, begins, after.search.number, after.point.t)
            after = after._replace(slides=watch._replace(lost=slide))
        return after, guard

    def _list_numbers(self, end: Point) -> PyTree:
        """Return the numbers at the end of an attempt that must be finite."""
        return end.state.flow()

    def _look_ahead(
        self, fresh: Bool, ended: SlidingSurface, along: tuple[SlidingSurface, ...], dynamics: Evaluation
    ) -> PyTree:
        return look_ahead(fresh, ended, along, dynamics) if self.has_margin_rates else ()


@partial(jax.tree_util.register_dataclass, data_fields=["h", "steps"], meta_fields=["switches", "second_order"])
@dataclasses.dataclass(frozen=True)
class PlainFixedStepping(FixedStepping):
    """Steps of a field without comparisons and events: each attempt is a step to the next instant of the grid."""

    def capacity(self, hybrid: HybridSystem, steps: int) -> int:
        """Return the number of `steps`."""
        del hybrid
        return steps

    def propose(self, system: ObservedSystem, carry: Carry) -> StepRequest:
        """Return the step to the next instant, whose length is a constant."""
        del system
        strike, no, yes = carry.k + 1, jnp.asarray(False), jnp.asarray(True)
        return StepRequest(self.h, strike * self.h, self.h, UNCONSTRAINED, no, yes, strike)

    def plan_next(
        self, system: ObservedSystem, carry: Carry, attempt: Attempt, decision: Decision, after: Carry
    ) -> Carry:
        """Return `after`, diverged if the numbers are invalid."""
        del system, carry, attempt
        return after._replace(status=jnp.where(decision.valid, after.status, RunStatus.DIVERGED))

    def _list_numbers(self, end: Point) -> PyTree:
        # The rates at the end are used nowhere else but in samples of the last step.
        return end.state.flow(), end.rates[0]


def _is_plausible(carry: Carry, attempt: Attempt) -> Bool:
    """Return True if the state has changed roughly as the rates at both ends predict."""
    ends = [jax.tree.leaves(point.state.flow()) for point in (carry.point, attempt.point)]
    rates = [jax.tree.leaves(point.rates[0]) for point in (carry.point, attempt.point)]
    # A flow within a mode need not be bounded beyond its kinks, unlike the system's own flow. A step too long for
    # stability goes there.
    sane = []
    for a, b, p, q in zip(*ends, *rates, strict=True):
        from_rates = MAX_RATE_RATIO * jnp.abs(carry.length) * jnp.maximum(jnp.abs(p), jnp.abs(q))
        sane.append(jnp.all(jnp.abs(b - a) <= from_rates + MAX_STATE_FRACTION * (jnp.abs(a) + jnp.abs(b))))
    return jnp.all(jnp.array(sane))


def _outruns_step(carry: Carry, attempt: Attempt) -> Bool:
    """Return True if the rates at the end are far beyond those that the start and the step explain.

    The trapezoidal rule allows twice the change of the state plus the rate at the start.
    """
    ends = [jax.tree.leaves(point.state.flow()) for point in (carry.point, attempt.point)]
    rates = [jax.tree.leaves(point.rates[0]) for point in (carry.point, attempt.point)]
    outruns = [
        jnp.any(jnp.abs(carry.length * q) > MAX_END_RATE_RATIO * (jnp.abs(b - a) + jnp.abs(carry.length * p)))
        for a, b, p, q in zip(*ends, *rates, strict=True)
    ]
    return jnp.any(jnp.array(outruns))
