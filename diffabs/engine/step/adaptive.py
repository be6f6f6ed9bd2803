"""Adaptive steps: which step of a run under `Adaptive` is taken.

    length     0.85 r^(-1/4) times the last length, r = |error|/rtol. The error is the difference between two solutions
               in the middle of the step: the cubic, which represents every signal within the step, and the method's
               own. The length is at most 3/rho, rho the spectral radius of the loop's Jacobian. A run whose shortest
               step has r > 1 has diverged; this step is near the spacing of numbers at its time
    surfaces   a step ends near the predicted change of a comparison. A change between 2 % and 95 % of a step repeats
               the step up to there. Each stage evaluates its comparisons
    events     if a margin falls through zero within a step, the step is attempted again until it ends on the zero
               (`event_location`). A margin that crosses zero twice within a step cuts the step there (`outlook`)
    clocks     a step ends where the clock of a block strikes

Clocks strike on the grid of `Adaptive.step`, and a trajectory keeps instants of this grid. A step need not end on it.

A run that is logged for derivatives keeps to one mode in a step, and locates switching surfaces as events.

A run that slides along a surface and does not follow it is over (`SLID`). With `WatchedModes` so is one whose margin
only touches zero (`GRAZED`).
"""

import dataclasses
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.cubic import HermiteStep
from diffabs.core.lanes import any_lane, select
from diffabs.core.log import borrow
from diffabs.core.types import Any, AnyArray, Array, Bool, Int, Key, PyTree, Scalar
from diffabs.engine.hybrid import HybridState, HybridSystem
from diffabs.engine.step.advance import Carry, Decision, Judged, advance, cast_floats, start_carry
from diffabs.engine.step.attempt import Attempt, Point, StepRequest
from diffabs.engine.step.event_location import RunStatus
from diffabs.engine.step.modes import SurfaceCrossing
from diffabs.engine.step.runge_kutta import TSIT5, midpoint_error
from diffabs.engine.step.slides import along_of, begin_slide, ended_slide, no_surface
from diffabs.engine.step.step_size import (
    INITIAL_STEP_S,
    MIN_LOCATION_FRACTION,
    MIN_STEP_EPS,
    MIN_STEP_RATIO,
    error_norm,
    error_scales,
    first_error_scales,
    plan_step,
    propose_length,
    shortest_step,
    spectral_step_limit,
)
from diffabs.engine.step.switching import (
    FREE_MODES,
    KEPT_MODES,
    UNSWITCHED,
    Checks,
    Horizon,
    ModeGuard,
    NextAttempt,
    Strain,
    Trial,
)
from diffabs.engine.step.system import Evaluation, Objectives, ObservedSystem

MIN_RTOL_EPS = 32  # multiples of machine epsilon: the smallest error that a step can reach
DERIVATIVE_RTOL_FRACTION = 0.03  # fraction of the allowed error of a step, for derivatives
ATTEMPTS_PER_RENEWAL = 16  # attempts between two updates of the stability limit
# A run with more attempts than the first number plus the second for each instant of its grid is EXHAUSTED.
MAX_ATTEMPTS, ATTEMPTS_PER_INSTANT = 100_000, 16
# Fraction of the length that the error allows. A longer regular step resets the count of consecutive crossings.
RESET_STEP_FRACTION = 0.1
# For derivatives: the first step after an event or a switching surface, as a fraction of the longest stable step, and
# the growth of this fraction per step. An event excites the fastest modes of the derivative far more than the run's.
INITIAL_STABILITY_FRACTION, STABILITY_FRACTION_GROWTH = 1 / 16, 1.6
MAX_CONSECUTIVE_CROSSINGS = 16  # steps in a row that end on switching surfaces; later ones keep to no mode
# Fractions of the duration. A step longer than the first ends the watch for a slide: its landings are no returns. Of a
# run that is watched or follows surfaces, one longer than the second resets the count of consecutive crossings.
CALM_FRACTION, SLIDE_INTERVAL_FRACTION = 1e-3, 1e-6
# A step without a mode that crosses a surface and moves back at its end adds `RETURN_SCORE`, any other one takes 1
# away. With `MAX_RETURN_SCORE` the run slides.
RETURN_SCORE, MAX_RETURN_SCORE = 16, 1024
# The first step after a landing, of a run that is watched: greatest ratio to the step that has landed, and least
# ratio to the length that the error allows.
LANDED_STEP_RATIO, LEAST_LANDED_RATIO = 4.0, 1e-3
# The second attempt to reach a surface at which a rate jumps, as a fraction of the length of the first.
SHORT_OF_SURFACE_FRACTION = 0.995


class StateSpan(NamedTuple):
    """The state over a step, for instants between its ends.

    Attributes:
        state: State after the changes at the beginning.
        flow: Its integrated part over the step.
    """

    state: HybridState
    flow: HermiteStep

    def at(self, t: Scalar) -> HybridState:
        """Return the state at a time `t` [s] within the step."""
        return self.state.with_flow(self.flow.at(t))


class AdaptiveControl(NamedTuple):
    """Numbers of `AdaptiveStepping` in a carry.

    Attributes:
        error_limited: Length that the error allows [s].
        limit: Longest stable step [s].
        scale: Largest values so far of what limits the error, as `error_scales` returns them.
        tries: Number of attempts so far.
        tries_at_renewal: Number of attempts at the last update of the stability limit.
        last_step: Last step, a `StateSpan`; () without a trajectory.
        consecutive_crossings: Number of steps that ended on switching surfaces since the last long regular step
            (`RESET_STEP_FRACTION`). If steps keep to no mode, the score of returns (`RETURN_SCORE`).
        stability_fraction: Fraction of the longest stable step that a step may have after an event.
        accepted: True if the last attempt was accepted.
        triggered: Bit mask of the events at its end.
    """

    error_limited: Scalar
    limit: Scalar
    scale: PyTree
    tries: Int
    tries_at_renewal: Int
    last_step: StateSpan | tuple[()]
    consecutive_crossings: Int
    stability_fraction: Scalar
    accepted: Bool
    triggered: Int


class CrossingCount(NamedTuple):
    """What an attempt with `AdaptiveStepping` says about crossings of surfaces.

    Attributes:
        crossings: The next `AdaptiveControl.consecutive_crossings`.
        stability_fraction: The next one.
        falls_short: True if the next attempt ends just before a surface at which a rate jumps.
    """

    crossings: Int
    stability_fraction: Scalar
    falls_short: Bool


class AdaptiveReport(NamedTuple):
    """What `AdaptiveStepping` needs to know of an attempt.

    Attributes:
        scale: Largest values so far of what limits the error, as `error_scales` returns them.

    The others are those of `Findings`.
    """

    scale: PyTree
    error: Scalar
    past_crossing: Scalar
    grazes: Any
    returns: Array
    surface: SurfaceCrossing | None


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["h", "steps", "rtol"],
    meta_fields=["switches", "stable"],
)
@dataclasses.dataclass(frozen=True)
class AdaptiveStepping:
    """Steps of an `Adaptive` solver.

    Attributes:
        h: Step of the grid [s].
        steps: Number of the last instant of the grid.
        rtol: Allowed relative error of a step.
        switches: What they do about switches. A run that is logged for a replay with derivatives keeps modes.
        stable: True if stability limits a step, too. A run at rest has no error, but its derivative may grow.
    """

    h: Array
    steps: Int
    rtol: AnyArray
    switches: Any = FREE_MODES
    stable: bool = True
    tableau, has_margin_rates, second_order = TSIT5, True, False
    shows_comparisons = True
    step = advance

    @property
    def closest(self) -> Scalar:
        """Length of a step [s] within which no crossing is located and no margin's error counts."""
        rounding = MIN_STEP_EPS * jnp.finfo(self.h.dtype).eps
        return self.h * self.steps * jnp.maximum(MIN_LOCATION_FRACTION, rounding)

    def start(self, hybrid: HybridSystem, objectives: Objectives, key: Key) -> Carry:
        """Return the carry of a run at t = 0, from `hybrid`, `objectives` and random `key`."""
        error_limited = jnp.minimum(INITIAL_STEP_S, self.h * self.steps) + 0.0 * self.h
        horizon = Horizon(error_limited, self.closest, jnp.asarray(False), jnp.asarray(True), no_surface(), ())
        foresee = partial(self.switches.forecast, horizon)
        carry = start_carry(self, hybrid, objectives, key, foresee)
        point, zero, no = carry.point, carry.k, carry.unrestricted
        state = borrow(point.state, None)
        scale = first_error_scales(hybrid, state, point.sample)
        limit = self.h * self.steps  # until the first `renew`, before the first attempt
        to_strike = self._next_strike(hybrid, zero) * self.h
        length, strikes = plan_step(error_limited, self._time_ahead(point), to_strike)
        due = zero - ATTEMPTS_PER_RENEWAL
        control = AdaptiveControl(error_limited, limit, scale, zero, due, (), zero, 1.0 + 0.0 * self.h, no, zero)
        return cast_floats(carry._replace(length=length, base=length, strikes=strikes, control=control), self.h.dtype)

    def keep_steps(self, carry: Carry) -> Carry:
        """Return the `carry` of a run that keeps its last step from now on, for samples between its ends."""
        return keep_steps(carry)

    def renew(self, hybrid: HybridSystem, carry: Carry) -> Carry:
        """Return the `carry` with a new stability limit of the `hybrid`, once in `ATTEMPTS_PER_RENEWAL` attempts."""
        if not self.stable:
            return carry
        control, at = carry.control, carry.point
        due = carry.running & (control.tries - control.tries_at_renewal >= ATTEMPTS_PER_RENEWAL)

        def renew_due() -> Scalar:
            new = self._find_stability_limit(hybrid, at.t, at.state, control.scale)
            return jnp.where(due, new, control.limit)

        # One condition for the whole batch: `cond` with one for each run would execute both branches.
        limit = jax.lax.cond(any_lane(due), renew_due, lambda: control.limit)
        renewed = jnp.where(due, control.tries, control.tries_at_renewal)
        # The first attempt was planned without a limit; `plan_next` limits all others.
        too_long = due & (control.tries == 0) & (carry.length > limit)
        length, base = (jnp.where(too_long, limit, x) for x in (carry.length, carry.base))
        control = control._replace(limit=limit, tries_at_renewal=renewed)
        return carry._replace(length=length, base=base, strikes=carry.strikes & ~too_long, control=control)

    def is_active(self, carry: Carry, until: Int | None) -> Bool:
        """Return True if the run of `carry` goes on and has not reached the instant `until` of the grid."""
        return carry.running if until is None else carry.running & (carry.point.t < until * self.h)

    def state_at(self, carry: Carry, instant: Scalar) -> tuple[Any, HybridState, Bool]:
        """Return time, state, and whether the run goes on, at an `instant` of the grid within the last step."""
        now, t, last = carry.point, instant * self.h, carry.control.last_step
        # The last step is a cubic, so the instant may lie anywhere in it. A run that is over shows its last point.
        inside = (t < now.t) & (last.flow.end > last.flow.start)
        t, state = select(inside, (t, last.at(t)), (now.t, borrow(now.state, None)))
        return t, state, carry.running | inside

    def for_replay(self) -> "AdaptiveStepping":
        """Return the method for a run that is logged and then replayed with derivatives.

        The derivative changes faster than the run, so a step may have `DERIVATIVE_RTOL_FRACTION` of the error.
        """
        rtol = clip_rtol(DERIVATIVE_RTOL_FRACTION * self.rtol)
        switches = KEPT_MODES if self.switches == FREE_MODES else self.switches
        return dataclasses.replace(self, switches=switches, stable=True, rtol=rtol)

    def without_switches(self) -> "AdaptiveStepping":
        """Return the method for the values of a field without comparisons and events."""
        return dataclasses.replace(self, switches=UNSWITCHED, stable=False)

    def is_calm(self, carry: Carry) -> Bool:
        """Return True if the attempt of `carry` is not far shorter than the error allows, or than the whole run."""
        apart = CALM_FRACTION * self.h * self.steps  # without an error a step may be as long as the run
        return carry.length > jnp.minimum(RESET_STEP_FRACTION * carry.control.error_limited, apart)

    def propose(self, system: ObservedSystem, carry: Carry) -> StepRequest:
        """Return the next step to attempt, by the run of `carry` in `system`."""
        return self.switches.propose(system, carry, self.h, self._next_strike(system.hybrid, carry.k))

    def forecast(self, carry: Carry, dynamics: Evaluation) -> PyTree:
        """Return the forecast of its rule for switches."""
        fresh = (carry.status == RunStatus.REFRESHING) | carry.unrestricted
        natural = carry.control.error_limited
        horizon = Horizon(natural, self.closest, carry.unrestricted, fresh, ended_slide(carry), along_of(carry))
        return self.switches.forecast(horizon, dynamics)

    def report(
        self, system: ObservedSystem, carry: Carry, h: Scalar, dynamics: Evaluation, state: HybridState, error: PyTree
    ) -> AdaptiveReport:
        """Return the error of an attempt, and the comparisons that change in it."""
        sample = dynamics.signals.sample
        changed = tuple(a ^ b for a, b in zip(dynamics.words, carry.point.words, strict=True))
        scale = jax.tree.map(jnp.maximum, carry.control.scale, error_scales(state, sample))
        resolved = carry.length > self.closest
        # A state that is zero until a comparison changes has no scale, and its error in the step with the change is a
        # large share of it, however short the step. The shortest step that locates a change bounds this error.
        starts = ~resolved & reduce(jnp.logical_or, [word != 0 for word in changed], jnp.asarray(False))
        scales = jax.tree.map(
            lambda before, now: jnp.where(starts & (before == 0), jnp.inf, now), carry.control.scale, scale
        )
        state_errors = midpoint_error(self.tableau, error[0], dynamics.rates[0], h)
        relative = error_norm(system.hybrid, state, state_errors, scales, sample) / self.rtol
        trial = Trial(h, dynamics, state, changed, relative, resolved)
        return AdaptiveReport(scale, *self.switches.find(system, carry, trial))

    def decide(
        self, system: ObservedSystem, carry: Carry, request: StepRequest, attempt: Attempt, active: Bool
    ) -> Decision:
        """Return the decision: the error must be small, and no comparison may change within the attempt."""
        error, past_crossing = attempt.report.error, attempt.report.past_crossing
        valid = jnp.isfinite(error)  # the maximum over all states: one NaN makes it NaN
        exact = (error <= 1) & (past_crossing <= 0)
        last = request.strikes & (request.strike >= self.steps)
        return self.switches.decide(system, carry, attempt, Checks(active, valid, exact, last))

    def plan_next(
        self, system: ObservedSystem, carry: Carry, attempt: Attempt, decision: Decision, after: Carry
    ) -> Carry:
        """Return the carry `after` an `attempt` with length and status of the next attempt."""
        control, report, accepted = carry.control, attempt.report, decision.accepted
        new = carry.status == RunStatus.RUNNING
        error_limited = self._error_limited_length(carry, attempt, decision)
        after, count, guard = self._guard_mode(Judged(system, carry, attempt, decision), after)
        limit = jnp.minimum(error_limited, count.stability_fraction * control.limit)
        longest = jnp.maximum(limit, shortest_step(after.point.t))
        to_strike = (self._next_strike(system.hybrid, after.k) - after.k) * self.h - after.since
        length, strikes = plan_step(longest, self._time_ahead(after.point), to_strike)
        # A comparison changed inside the step: the next attempt ends there.
        ends_on_crossing = ~accepted & (report.past_crossing > 0) & decision.valid
        length = jnp.where(ends_on_crossing, jnp.maximum(carry.length - report.past_crossing, self.closest), length)
        length = jnp.where(count.falls_short, SHORT_OF_SURFACE_FRACTION * carry.length, length)
        plan = NextAttempt(decision.searches, length, after.status)
        searches, length, status = self.switches.resume(plan, longest, carry, guard)
        # A landing with invalid numbers is no landing: the step is attempted again, and its event located again.
        status = jnp.where(~accepted & ~searches & (status == RunStatus.LANDING), RunStatus.RUNNING, status)
        refreshes = status == RunStatus.REFRESHING
        length = jnp.where(searches, after.length, jnp.where(refreshes, 0.0, length))
        # An error that is NaN is not small. An attempt within a search need not be accurate.
        fails = jnp.where(new, ~(report.error <= 1), ~decision.valid)
        lost = fails & (carry.length <= shortest_step(carry.point.t))
        exhausted = control.tries > MAX_ATTEMPTS + ATTEMPTS_PER_INSTANT * self.steps
        judged = self.switches.judge(status, guard.slides, report.grazes, after)
        judged = jnp.where(exhausted, RunStatus.EXHAUSTED, judged)
        repeats = searches | ends_on_crossing | refreshes | guard.unrestricted | count.falls_short
        return after._replace(
            length=length,
            base=jnp.where(status == RunStatus.RUNNING, length, carry.base),
            strikes=strikes & ~repeats,
            unrestricted=guard.unrestricted,
            control=control._replace(
                error_limited=error_limited,
                scale=select(accepted, report.scale, control.scale),
                tries=control.tries + 1,
                last_step=next_span(control.last_step, carry, attempt, decision),
                consecutive_crossings=count.crossings,
                stability_fraction=count.stability_fraction,
                accepted=accepted,
                triggered=_pack_events(decision.triggered),
            ),
            status=jnp.where(lost, RunStatus.DIVERGED, judged),
        )

    def _guard_mode(self, judged: Judged, after: Carry) -> tuple[Carry, CrossingCount, ModeGuard]:
        """Return the carry `after` an attempt with its lost slide, its crossings, and what becomes of its mode."""
        system, carry, attempt, decision = judged
        control, report, accepted = carry.control, attempt.report, decision.accepted
        count = CrossingCount(control.consecutive_crossings, control.stability_fraction, False)
        if self.switches.keeps_mode:
            count, strain = self._count_crossings(carry, decision)
            return after, count, self.switches.guard(judged, after, strain)
        if self.switches != UNSWITCHED:
            count = count._replace(falls_short=self._jumps_at_end(carry, report, decision))
        if watch := after.slides:
            score = jnp.maximum(count.crossings + jnp.where(report.returns >= 0, RETURN_SCORE, -1), 0)
            if system.hybrid.ticks:  # each tick may move a sampled signal across a surface, to which the flow returns
                score = jnp.where(after.since > 0, score, 0)
            count = count._replace(crossings=jnp.where(accepted, score, count.crossings))
            slide = begin_slide(watch.lost, count.crossings >= MAX_RETURN_SCORE, report.returns, after.point.t)
            after = after._replace(slides=watch._replace(lost=slide))
        return after, count, ModeGuard(False, carry.unrestricted, False, False)

    def _count_crossings(self, carry: Carry, decision: Decision) -> tuple[CrossingCount, Strain]:
        """Return the crossings after an attempt that keeps to its mode, and the strain on modes."""
        control, accepted, new = carry.control, decision.accepted, carry.status == RunStatus.RUNNING
        crossings, crosses, stuck = control.consecutive_crossings, decision.crosses_surface, False
        grown = jnp.minimum(STABILITY_FRACTION_GROWTH * control.stability_fraction, 1.0)
        fraction = jnp.where(new, grown, INITIAL_STABILITY_FRACTION)
        fraction = jnp.where(accepted, fraction, control.stability_fraction)
        calm = accepted & new & (carry.length > RESET_STEP_FRACTION * control.error_limited)
        if self.switches.watches or self.switches.follows:
            # Steps without an error are as long as the run, so that no step counts as long beside them.
            apart = carry.length > SLIDE_INTERVAL_FRACTION * self.h * self.steps
            calm, crossings = calm | (accepted & new & apart), jnp.where(apart, 0, crossings)
        if self.switches.watches:
            crosses |= accepted & carry.unrestricted
            stuck = jnp.logical_and(new, ~decision.valid) & (carry.length <= self.closest)
        crossings = jnp.where(crosses, crossings + 1, jnp.where(calm, 0, crossings))
        leaves = accepted & (crossings > MAX_CONSECUTIVE_CROSSINGS)
        return CrossingCount(crossings, fraction, False), Strain(crowded=False, leaves=leaves, calm=calm, stuck=stuck)

    def _find_stability_limit(self, hybrid: HybridSystem, t: Array, state: HybridState, scale: Array) -> Scalar:
        """Return the longest stable step [s]; the whole span without a flow, or if its Jacobian is not finite."""
        if not jax.tree.leaves(state.flow()):
            return self.h * self.steps
        limit = spectral_step_limit(hybrid, t, state, scale)
        return jnp.where(limit > 0, limit, self.h * self.steps)  # False also for NaN

    def _time_ahead(self, point: Point) -> Scalar:
        """Return the predicted time [s] to the first change of an answer."""
        return self.switches.time_ahead(point.forecast, self.h)

    def _next_strike(self, hybrid: HybridSystem, k: Int) -> Int:
        """Return the number of the first grid instant after the `k`-th at which a clock strikes or the run ends."""
        return jnp.minimum(hybrid.next_tick(k, self.h), self.steps) if hybrid.ticks else self.steps

    def _jumps_at_end(self, carry: Carry, report: AdaptiveReport, decision: Decision) -> Bool:
        """Return True if an attempt aimed at a surface and has more than the allowed error: a rate jumps at the
        surface.

        A stage beyond the surface has the rate of the other side. The weights of the stages are not all positive, so
        the step may even go away from the surface.
        """
        aimed = (carry.status == RunStatus.RUNNING) & (carry.length == self._time_ahead(carry.point))
        return aimed & decision.valid & ~decision.accepted & (report.error > 1) & (report.past_crossing <= 0)

    def _error_limited_length(self, carry: Carry, attempt: Attempt, decision: Decision) -> Scalar:
        """Return the step length that the error allows [s].

        An accepted step that was cut short may only raise it. A rejected step with a surface inside leaves it
        unchanged.
        """
        old, report = carry.control.error_limited, attempt.report
        new = jnp.where(decision.valid, propose_length(carry.length, report.error), MIN_STEP_RATIO * carry.length)
        # A step cut short by a clock or an event has a small error, so it may raise the allowed length only.
        cut = decision.accepted & (carry.length < old)
        wrong = ~decision.valid | ((report.error > 1) & (report.past_crossing <= 0))
        judged = (carry.status == RunStatus.RUNNING) & (decision.accepted | wrong)
        new = jnp.where(judged, jnp.where(cut, jnp.maximum(new, old), new), old)
        if self.switches.watches:
            # After a landing the next one may be near. A step much longer than the way there would pass over it.
            landed = decision.accepted & (carry.status == RunStatus.LANDING)
            longest = jnp.maximum(LANDED_STEP_RATIO * carry.length, LEAST_LANDED_RATIO * new)
            new = jnp.where(landed, jnp.minimum(new, longest), new)
        return jnp.maximum(new, shortest_step(attempt.point.t))


def keep_steps(carry: Carry) -> Carry:
    """Return a carry that keeps the last step from now on."""
    last = span_step(carry.point, carry.point)
    return carry._replace(control=carry.control._replace(last_step=last))


def next_span(last: StateSpan | tuple[()], carry: Carry, attempt: Attempt, decision: Decision) -> StateSpan | tuple[()]:
    """Return the last step after an attempt, if the run keeps it."""
    return select(decision.accepted, span_step(carry.point, attempt.point), last) if last else ()


def clip_rtol(rtol: AnyArray) -> AnyArray:
    """Return rtol, but at least the multiple `MIN_RTOL_EPS` of the machine epsilon of its type."""
    numpy_like = np if isinstance(rtol, np.ndarray) else jnp  # NumPy compiles nothing
    return numpy_like.maximum(rtol, MIN_RTOL_EPS * jnp.finfo(rtol.dtype).eps)


def _pack_events(triggered: object) -> Int:
    """Return the triggered events as a bit mask, one bit for each event."""
    return sum((jnp.where(happens, 1 << i, 0) for i, happens in enumerate(jax.tree.leaves(triggered))), jnp.asarray(0))


def span_step(start: Point, end: Point) -> StateSpan:
    """Return the state over a step, from its start after the changes there to its end before the changes there."""
    state = borrow(start.state, None)
    rates = start.rates[0], end.rates[0]
    return StateSpan(state, HermiteStep(start.t, end.t, (state.flow(), end.state.flow()), rates))
