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

A method that `watches` reports runs that it cannot resolve. A run that slides along a surface is over (`SLID`), and so
is one with a margin that only touches zero (`GRAZED`). It looks for turns of the comparisons' margins, too.
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
from diffabs.engine.step.attempt import Attempt, Point, StepRequest
from diffabs.engine.step.event_location import (
    MAX_LOCATION_ATTEMPTS,
    SurfaceCrossing,
    find_surface_crossing,
)
from diffabs.engine.step.outlook import look_ahead, margin_error, watch_margins
from diffabs.engine.step.runge_kutta import TSIT5, midpoint_error
from diffabs.engine.step.slides import begin_slide, ended_slide, has_slid, slide_of
from diffabs.engine.step.status import RunStatus
from diffabs.engine.step.step_size import (
    INITIAL_STEP_S,
    MIN_LOCATION_FRACTION,
    MIN_STEP_EPS,
    MIN_STEP_RATIO,
    error_norm,
    error_scales,
    plan_step,
    propose_length,
    shortest_step,
    spectral_step_limit,
)
from diffabs.engine.step.surfaces import (
    find_imminent,
    find_return,
    forecast_crossing,
    is_surface_moving,
    time_since_crossing,
)
from diffabs.engine.step.system import Evaluation, Objectives, ObservedSystem

MIN_RTOL_EPS = 32  # multiples of machine epsilon: the smallest error that a step can reach
DERIVATIVE_RTOL_FRACTION = 0.03  # fraction of the allowed error of a step, for derivatives
ATTEMPTS_PER_RENEWAL = 16  # attempts between two updates of the stability limit
# A run with more attempts in all, or per instant of its grid, makes no progress and has diverged.
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
# away. With `MAX_RETURN_SCORE` the run slides. A return with a smaller error, as a multiple of the allowed one, is
# rounding.
RETURN_SCORE, MAX_RETURN_SCORE, MIN_RETURN_ERROR = 16, 1024, 1e-3
# The first step after a landing, of a method that `watches`: greatest ratio to the step that has landed, and least
# ratio to the length that the error allows.
LANDED_STEP_RATIO, LEAST_LANDED_RATIO = 4.0, 1e-3
# The second attempt to reach a surface at which a rate jumps, as a fraction of the length of the first.
SHORT_OF_SURFACE_FRACTION = 0.995
# A step that keeps its mode goes 1.5 times as far as the predicted crossing, so that the crossing lies within the step.
CROSSING_OVERREACH = 1.5


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


class AdaptiveReport(NamedTuple):
    """What `AdaptiveStepping` needs to know of an attempt.

    Attributes:
        error: Error as a multiple of the allowed error.
        scale: Largest values so far of what limits the error, as `error_scales` returns them.
        past_crossing: Time from the first change of a comparison inside the step, or the first turn of a margin beyond
            zero, to the end of the step [s]; 0 without one.
        grazes: True if a margin only touches zero, or crosses it twice in a step that is too short to be cut.
        returns: Number of a comparison that has changed and moves back at the end; -1 without one, or within a mode.
        surface: Contradicted comparisons; None if steps keep to no mode.
    """

    error: Scalar
    scale: PyTree
    past_crossing: Scalar
    grazes: Any
    returns: Array
    surface: SurfaceCrossing | None


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["h", "steps", "rtol"],
    meta_fields=["keeps_last_step", "keeps_mode", "watches", "smooth", "stable", "follows"],
)
@dataclasses.dataclass(frozen=True)
class AdaptiveStepping:
    """Steps of an `Adaptive` solver.

    Attributes:
        h: Step of the grid [s].
        steps: Number of the last instant of the grid.
        rtol: Allowed relative error of a step.
        keeps_last_step: True if the carry keeps the last step, for samples between its ends.
        keeps_mode: True if steps keep to a mode, as in a run that is logged for a replay with derivatives.
        watches: True if the run ends where it slides or grazes, and a step where the margin of a comparison turns. Its
            steps keep to a mode.
        smooth: True if nothing switches and no event can happen.
        stable: True if stability limits a step, too. The error of a run at rest shows no derivative that grows.
        follows: True if a run follows the surface along which it slides. Its steps keep to a mode.
    """

    h: Array
    steps: Int
    rtol: AnyArray
    keeps_last_step: bool = False
    keeps_mode: bool = False
    watches: bool = False
    smooth: bool = False
    stable: bool = True
    follows: bool = False
    tableau, has_margin_rates, second_order = TSIT5, True, False
    step = advance

    @property
    def searches(self) -> bool:
        """True if the method locates events."""
        return not self.smooth

    @property
    def closest(self) -> Scalar:
        """Length of a step [s] within which no crossing is located and no margin's error counts."""
        rounding = MIN_STEP_EPS * jnp.finfo(self.h.dtype).eps
        return self.h * self.steps * jnp.maximum(MIN_LOCATION_FRACTION, rounding)

    def start(self, hybrid: HybridSystem, objectives: Objectives, key: Key) -> Carry:
        """Return the carry of a run at t = 0, from `hybrid`, `objectives` and random `key`."""
        error_limited = jnp.minimum(INITIAL_STEP_S, self.h * self.steps) + 0.0 * self.h
        foresee = partial(self._look_ahead, error_limited, jnp.asarray(False), jnp.asarray(True), -1)
        carry = start_carry(self, hybrid, objectives, key, foresee)
        point, zero, no = carry.point, carry.k, carry.unrestricted
        state = borrow(point.state, None)
        scale = error_scales(state, point.sample)
        limit = self.h * self.steps  # until the first `renew`, before the first attempt
        to_strike = self._next_strike(hybrid, zero) * self.h
        length, strikes = plan_step(error_limited, self._ahead(point), to_strike)
        last = span_step(point, point) if self.keeps_last_step else ()
        due = zero - ATTEMPTS_PER_RENEWAL
        control = AdaptiveControl(error_limited, limit, scale, zero, due, last, zero, 1.0 + 0.0 * self.h, no, zero)
        return cast_floats(carry._replace(length=length, base=length, strikes=strikes, control=control), self.h.dtype)

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

        The derivative changes faster than the run, so a step may have `DERIVATIVE_RTOL_FRACTION` of the error. The
        steps of a run that is `smooth` need no mode.
        """
        rtol = clip_rtol(DERIVATIVE_RTOL_FRACTION * self.rtol)
        return dataclasses.replace(self, keeps_mode=not self.smooth, stable=True, rtol=rtol)

    def is_switched(self, hybrid: HybridSystem) -> bool:
        """Return True: the comparisons of the `hybrid`'s flow are always visible."""
        del hybrid
        return True

    def is_calm(self, carry: Carry) -> Bool:
        """Return True if the attempt of `carry` is not far shorter than the error allows, or than the whole run."""
        apart = CALM_FRACTION * self.h * self.steps  # without an error a step may be as long as the run
        return carry.length > jnp.minimum(RESET_STEP_FRACTION * carry.control.error_limited, apart)

    def propose(self, system: ObservedSystem, carry: Carry) -> StepRequest:
        """Return the next step to attempt, by the run of `carry` in `system`."""
        return propose_step(self, system, carry, self._next_strike(system.hybrid, carry.k), frozen=self.keeps_mode)

    def forecast(self, carry: Carry, dynamics: Evaluation) -> PyTree:
        """Return the predicted time [s] to the first change of an answer, and an `Outlook`.

        A step that keeps its mode gets `CROSSING_OVERREACH` times this time, so that the change lies within it.
        """
        fresh = (carry.status == RunStatus.REFRESHING) | carry.unrestricted
        return self._look_ahead(carry.control.error_limited, carry.unrestricted, fresh, ended_slide(carry), dynamics)

    def report(
        self, system: ObservedSystem, carry: Carry, h: Scalar, dynamics: Evaluation, state: HybridState, error: PyTree
    ) -> AdaptiveReport:
        """Return the error of an attempt, and the comparisons that change in it."""
        sample, point = dynamics.signals.sample, carry.point
        changed = tuple(a ^ b for a, b in zip(dynamics.words, point.words, strict=True))
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
        if self.smooth:
            return AdaptiveReport(relative, scale, jnp.zeros_like(h), jnp.asarray(False), jnp.asarray(-1), None)
        surface = find_surface_crossing(dynamics, carry.search.number, h) if self.keeps_mode else None
        turns = watch_margins(carry, h, self._select_watched(dynamics), system.bit_count)
        past_crossing = jnp.maximum(time_since_crossing(dynamics.surfaces, changed, h), turns.time_since)
        if self.watches:
            relative = jnp.maximum(relative, jnp.where(resolved, margin_error(system, carry, h, dynamics, state), 0.0))
        grazes = turns.grazes | (~resolved & (turns.time_since > 0))
        grazes |= carry.unrestricted & is_surface_moving(dynamics.surfaces, changed)
        returns = jnp.asarray(-1)
        if not self.keeps_mode:
            number = find_return(point.forecast[2], dynamics.surfaces, changed, h)
            returns = jnp.where(relative > MIN_RETURN_ERROR, number, -1)
        return AdaptiveReport(relative, scale, jnp.where(resolved, past_crossing, 0.0), grazes, returns, surface)

    def decide(
        self, system: ObservedSystem, carry: Carry, request: StepRequest, attempt: Attempt, active: Bool
    ) -> Decision:
        """Return the decision: the error must be small, and no comparison may change within the attempt."""
        error, past_crossing = attempt.report.error, attempt.report.past_crossing
        valid = jnp.isfinite(error)  # the maximum over all states: one NaN makes it NaN
        exact = (error <= 1) & (past_crossing <= 0)
        last = request.strikes & (request.strike >= self.steps)
        return decide_attempt(self, system, carry, attempt, active, valid, exact, last=last, frozen=self.keeps_mode)

    def plan_next(
        self, system: ObservedSystem, carry: Carry, attempt: Attempt, decision: Decision, after: Carry
    ) -> Carry:
        """Return the carry `after` an `attempt` with length and status of the next attempt."""
        control, report, accepted = carry.control, attempt.report, decision.accepted
        new = carry.status == RunStatus.RUNNING
        error_limited = self._error_limited_length(carry, attempt, decision)
        fraction = control.stability_fraction
        if self.keeps_mode:
            grown = jnp.minimum(STABILITY_FRACTION_GROWTH * fraction, 1.0)
            fraction = jnp.where(accepted, jnp.where(new, grown, INITIAL_STABILITY_FRACTION), fraction)
        longest = jnp.maximum(jnp.minimum(error_limited, fraction * control.limit), shortest_step(after.point.t))
        to_strike = (self._next_strike(system.hybrid, after.k) - after.k) * self.h - after.since
        length, strikes = plan_step(longest, self._ahead(after.point), to_strike)
        # A comparison changed inside the step: the next attempt ends there.
        ends_on_crossing = ~accepted & (report.past_crossing > 0) & decision.valid
        length = jnp.where(ends_on_crossing, jnp.maximum(carry.length - report.past_crossing, self.closest), length)
        falls_short = self._jumps_at_end(carry, report, decision)
        length = jnp.where(falls_short, SHORT_OF_SURFACE_FRACTION * carry.length, length)
        searches, status, unrestricted = decision.searches, after.status, carry.unrestricted
        crossings, slides = control.consecutive_crossings, jnp.asarray(False)
        watch = after.slides
        if self.keeps_mode:
            calm = accepted & new & (carry.length > RESET_STEP_FRACTION * control.error_limited)
            if self.watches or self.follows:
                # Steps without an error are as long as the run, so that no step counts as long beside them.
                apart = carry.length > SLIDE_INTERVAL_FRACTION * self.h * self.steps
                calm, crossings = calm | (accepted & new & apart), jnp.where(apart, 0, crossings)
            crosses = (
                decision.crosses_surface | (accepted & carry.unrestricted) if self.watches else decision.crosses_surface
            )
            crossings = jnp.where(crosses, crossings + 1, jnp.where(calm, 0, crossings))
            gave_up = searches & (after.search.tries >= MAX_LOCATION_ATTEMPTS)
            gave_up &= after.search.number < system.bit_count
            becomes_unrestricted = (gave_up | (accepted & (crossings > MAX_CONSECUTIVE_CROSSINGS))) & ~unrestricted
            unrestricted = (unrestricted | becomes_unrestricted) & ~(calm & have_same_answers(carry, attempt))
            if self.watches:
                # Just before a surface that the run comes to with rate 0, each step may be too long for its mode: the
                # square root of a level. One step without a mode goes there. If the level stays, so does the run.
                slides = gave_up | (accepted & (crossings > MAX_CONSECUTIVE_CROSSINGS))
                unrestricted = new & ~decision.valid & (carry.length <= self.closest) & ~carry.unrestricted
                length = jnp.where(unrestricted, carry.length, length)
            searches &= ~(becomes_unrestricted & gave_up)
            length = jnp.where(becomes_unrestricted & gave_up, longest, length)
            status = jnp.where(becomes_unrestricted & gave_up, RunStatus.RUNNING, status)
        elif watch:
            score = jnp.maximum(crossings + jnp.where(report.returns >= 0, RETURN_SCORE, -1), 0)
            crossings = jnp.where(accepted, score, crossings)
            slide = begin_slide(watch.lost, crossings >= MAX_RETURN_SCORE, report.returns, after.point.t)
            after = after._replace(slides=watch._replace(lost=slide))
        # A landing with invalid numbers is no landing: the step is attempted again, and its event located again.
        status = jnp.where(~accepted & ~searches & (status == RunStatus.LANDING), RunStatus.RUNNING, status)
        refreshes = status == RunStatus.REFRESHING
        length = jnp.where(searches, after.length, jnp.where(refreshes, 0.0, length))
        last_step = control.last_step
        if self.keeps_last_step:
            last_step = select(accepted, span_step(carry.point, attempt.point), last_step)
        # An error that is NaN is not small. An attempt within a search need not be accurate.
        fails = jnp.where(new, ~(report.error <= 1), ~decision.valid)
        lost = fails & (carry.length <= shortest_step(carry.point.t))
        exhausted = control.tries > MAX_ATTEMPTS + ATTEMPTS_PER_INSTANT * self.steps
        judged = jnp.where(exhausted, RunStatus.EXHAUSTED, self._judge(report, after, slides, status))
        return after._replace(
            length=length,
            base=jnp.where(status == RunStatus.RUNNING, length, carry.base),
            strikes=strikes & ~searches & ~ends_on_crossing & ~falls_short & ~refreshes & ~unrestricted,
            unrestricted=unrestricted,
            control=control._replace(
                error_limited=error_limited,
                scale=select(accepted, report.scale, control.scale),
                tries=control.tries + 1,
                last_step=last_step,
                consecutive_crossings=crossings,
                stability_fraction=fraction,
                accepted=accepted,
                triggered=_pack_events(decision.triggered),
            ),
            status=jnp.where(lost, RunStatus.DIVERGED, judged),
        )

    def _judge(self, report: AdaptiveReport, after: Carry, slides: Bool, status: Scalar) -> Scalar:
        """Return the `status`, or that of a run which is over because it slides or grazes."""
        if not self.watches:
            return jnp.where(has_slid(slide_of(after)), RunStatus.SLID, status)
        status = jnp.where(report.grazes, RunStatus.GRAZED, status)
        return jnp.where(slides, RunStatus.SLID, status)

    def _find_stability_limit(self, hybrid: HybridSystem, t: Array, state: HybridState, scale: Array) -> Scalar:
        """Return the longest stable step [s]; the whole span without a flow, or if its Jacobian is not finite."""
        if not jax.tree.leaves(state.flow()):
            return self.h * self.steps
        limit = spectral_step_limit(hybrid, t, state, scale)
        return jnp.where(limit > 0, limit, self.h * self.steps)  # False also for NaN

    def _ahead(self, point: Point) -> Scalar:
        """Return the predicted time [s] to the first change of an answer."""
        return jnp.full_like(self.h, jnp.inf) if self.smooth else point.forecast[0]

    def _look_ahead(
        self, error_limited: Scalar, unrestricted: Bool, fresh: Bool, ended: PyTree, dynamics: Evaluation
    ) -> PyTree:
        """Return the forecast, nothing if `smooth`; `fresh` is True if the answers are new."""
        if self.smooth:
            return ()
        outlook = look_ahead(fresh, ended, self._select_watched(dynamics))
        ahead = self._forecast_crossing(error_limited, unrestricted, dynamics), outlook
        return ahead if self.keeps_mode else (*ahead, find_imminent(dynamics.surfaces, error_limited))

    def _select_watched(self, dynamics: Evaluation) -> Evaluation:
        """Return the dynamics with those margins only whose turns are looked for: of events, or all if it `watches`."""
        return dynamics if self.watches else dynamics._replace(surfaces=dynamics.surfaces.take_none())

    def _next_strike(self, hybrid: HybridSystem, k: Int) -> Int:
        """Return the number of the first grid instant after the `k`-th at which a clock strikes or the run ends."""
        return jnp.minimum(hybrid.next_tick(k, self.h), self.steps) if hybrid.ticks else self.steps

    def _forecast_crossing(self, error_limited: Scalar, unrestricted: Bool, dynamics: Evaluation) -> Scalar:
        ahead = forecast_crossing(dynamics.surfaces, error_limited, self.closest)
        return jnp.where(unrestricted, 1.0, CROSSING_OVERREACH) * ahead if self.keeps_mode else ahead

    def _jumps_at_end(self, carry: Carry, report: AdaptiveReport, decision: Decision) -> Bool:
        """Return True if an attempt aimed at a surface and has more than the allowed error: a rate jumps at the
        surface.

        A stage beyond the surface has the rate of the other side. The weights of the stages are not all positive, so
        the step may even go away from the surface.
        """
        if self.keeps_mode or self.smooth:  # all stages keep to one mode, or there is none
            return jnp.asarray(False)
        aimed = (carry.status == RunStatus.RUNNING) & (carry.length == self._ahead(carry.point))
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
        if self.watches:
            # After a landing the next one may be near. A step much longer than the way there would pass over it.
            landed = decision.accepted & (carry.status == RunStatus.LANDING)
            longest = jnp.maximum(LANDED_STEP_RATIO * carry.length, LEAST_LANDED_RATIO * new)
            new = jnp.where(landed, jnp.minimum(new, longest), new)
        return jnp.maximum(new, shortest_step(attempt.point.t))


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
