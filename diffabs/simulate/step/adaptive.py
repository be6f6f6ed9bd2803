"""Adaptive step-size control of a single run: the attempts of a run under `Adaptive`.

    length     0.85 r^(-1/4) times the last length, r = |error|/rtol. The error is that of the cubic in the middle of
               the step, which represents every signal within a step. The length is at most 3/rho, rho the spectral
               radius of the loop's Jacobian
    surfaces   a step ends where a comparison of the flow is predicted to change (`foresight`). If another comparison
               changes within the step, the step is attempted again up to that change
    events     if a margin falls through zero within a step, the step is attempted again until it ends on the zero
               (`landing`)
    clocks     a step ends where the clock of a block strikes

Clocks strike on the grid of `Adaptive.step`, and a trajectory keeps instants of this grid. A step need not end on it.
"""

from typing import Any

import jax
import jax.numpy as jnp

from diffabs.core.blocks import Passage
from diffabs.core.log import borrow, log_rows, write_last_rows
from diffabs.core.loop import Loop, LoopState, Margins
from diffabs.core.protocols import Clock, Memory, Segment, Shown
from diffabs.core.types import Matrix, PyTree, Scalar
from diffabs.simulate.drive.checkpoint import any_lane, jit_barrier
from diffabs.simulate.step.attempt import SurfaceCrossing, mode_after_changes, mode_at_end, start_state
from diffabs.simulate.step.event_location import (
    MAX_LOCATION_ATTEMPTS,
    OVERSHOOT_EXPONENT,
    EventSearch,
    accept_location,
    bracket_event,
    falls_through,
    find_event_crossings,
    init_search,
    locate_event,
    select,
)
from diffabs.simulate.step.fixed import cast_floats, find_crossings
from diffabs.simulate.step.foresight import forecast_crossings, valid_end_rates
from diffabs.simulate.step.modes import ComparisonAnswers, Mode, find_contradicted
from diffabs.simulate.step.span import HermiteStep
from diffabs.simulate.step.status import RunStatus, status_after_step
from diffabs.simulate.step.step_size import (
    INITIAL_STEP_S,
    MIN_STEP_RATIO,
    StepSizeControl,
    error_norm,
    error_scales,
    plan_step,
    propose_length,
    spectral_step_limit,
)
from diffabs.simulate.step.system import (
    UNCONSTRAINED,
    Accumulators,
    Dynamics,
    LoopEvaluationWithRates,
    Objectives,
    build_dynamics,
    split_flow_and_held,
)
from diffabs.simulate.step.tries import AdaptiveAttempt, AdaptiveCarry, AdaptiveDecision, AdaptivePoint
from diffabs.simulate.step.tsit5 import midpoint_error, tsit5_step_with_error

# A run with more attempts in all, or per instant of its grid, makes no progress and has diverged.
MAX_ATTEMPTS, ATTEMPTS_PER_INSTANT = 100_000, 16
# Fraction of the length that the error allows. A step longer than this one that ends on no switching surface resets the
# count of consecutive crossings.
RESET_STEP_FRACTION = 0.1
# For derivatives: the first step after an event or a switching surface, as a fraction of the longest stable step, and
# the growth of this fraction per step. An event excites the fastest modes of the derivative far more than the run's.
INITIAL_STABILITY_FRACTION, STABILITY_FRACTION_GROWTH = 1 / 16, 1.6
MAX_CONSECUTIVE_CROSSINGS = 16  # steps in a row that end on switching surfaces; then steps are unrestricted
# A step that keeps its mode goes 1.5 times as far as the predicted crossing, so that the crossing lies within the step.
CROSSING_OVERREACH = 1.5
FIELDS_AFTER_END = ("tries", "status")  # fields of the carry that must stay valid when a run is over


def init_carry(loop: Loop, objectives: Objectives, control: StepSizeControl, key: PyTree) -> AdaptiveCarry:
    """Return the carry at t = 0.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by the names of their metrics.
        control: Step-size control.
        key: Random key, or None.
    """
    zero, none = jnp.asarray(0), 0.0 * control.h
    state, accumulators = start_state(loop, objectives, Clock(none, control.h, zero, key))
    state, logs = borrow(state, None), log_rows(state)
    error_limited = jnp.minimum(INITIAL_STEP_S, control.h * control.steps) + none
    system = build_dynamics(loop, objectives, none, state, accumulators, kinks=True)
    point = _evaluate_point(system, control, none, state, accumulators, error_limited, UNCONSTRAINED)
    scale = error_scales(state, point.sample)
    status = jnp.where(point.margins["stop"][0] > 0, zero + RunStatus.RUNNING, zero + RunStatus.DIVERGED)
    limit = spectral_step_limit(loop, none, state, scale)
    left = control.next_strike(loop, zero) * control.h
    length, ends = plan_step(jnp.minimum(error_limited, limit), point.ahead, left, control)
    search = init_search(control.h)
    past = HermiteStep(point.t, state, point.rate[0], point.t, state.flow(), point.rate[0]) if control.keeps else ()
    lengths = (error_limited, length, ends, limit, scale, length)
    point = point._replace(state=borrow(state, logs))
    return cast_floats(
        AdaptiveCarry(
            point, zero, none, *lengths, search, zero, zero, past, zero, 1.0 + none, jnp.asarray(False), zero, status
        ),
        control.h.dtype,
    )


def step(
    loop: Loop,
    objectives: Objectives,
    control: StepSizeControl,
    key: PyTree,
    carry: AdaptiveCarry,
    until: Scalar = None,
) -> AdaptiveCarry:
    """Return the carry after one attempt of a step, unchanged if the run is over or has reached the instant `until`.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by the names of their metrics.
        control: Step-size control.
        key: Random key, or None.
        carry: Carry before the attempt.
        until: Number of the grid instant at which to pause; None to go on to the end of the run.
    """
    active = carry.running if until is None else is_before(control, carry, until)
    # The blocks' logs leave the carry: `select` below would otherwise copy whole tables in every step.
    logs = write_last_rows(carry.point.state)
    carry = carry._replace(point=carry.point._replace(state=borrow(carry.point.state, None)))
    system = build_dynamics(loop, objectives, carry.point.t, carry.point.state, carry.point.accumulators, kinks=True)
    strike = control.next_strike(loop, carry.k)
    end = jnp.where(carry.ends, strike * control.h, carry.point.t + carry.length)
    refreshing = carry.status == RunStatus.REFRESHING
    count, which = (system.kinks if control.notes else 0), carry.search.which
    lands = (carry.status == RunStatus.LANDING) & (which < count)
    # Without the barrier, XLA would compile the attempt again into each expression that uses it.
    here = jit_barrier(active, lambda: attempt_step(system, carry, end, refreshing, lands, control))
    verdict = jit_barrier(active, lambda: _decide(carry, here, count, active, strike >= control.steps, control))
    strikes = verdict.taken & carry.ends
    k = jnp.where(strikes, strike, carry.k)
    clock = Clock(end, control.h, k, key, strikes)
    mode = mode_after_changes(system, here.point.words, which, lands) if count else UNCONSTRAINED
    point = commit_step(system, control, clock, carry.point, here, verdict.triggered, carry.error_limited, logs, mode)
    point = select(verdict.over, here.point, point)

    since = jnp.where(strikes, 0.0, jnp.where(verdict.taken, carry.since + carry.length, carry.since))
    carry = carry._replace(k=k, since=since)
    after = _next_carry(loop, control, carry, here, verdict, select(verdict.taken, point, carry.point), count)
    if until is None:  # the other fields of a run that is over have no effect: no select for them
        kept = {name: jnp.where(active, getattr(after, name), getattr(carry, name)) for name in FIELDS_AFTER_END}
        after = after._replace(**kept)
    else:
        after = select(active, after, carry)
    return after._replace(point=after.point._replace(state=borrow(after.point.state, logs)))


def _next_carry(
    loop: Loop,
    control: StepSizeControl,
    carry: AdaptiveCarry,
    here: AdaptiveAttempt,
    verdict: AdaptiveDecision,
    point: AdaptivePoint,
    count: int,
) -> AdaptiveCarry:
    """Return the carry after an attempt: at `point`, with the plan for the next attempt from there."""
    trying, new = ~verdict.taken, carry.status == RunStatus.RUNNING
    error_limited = _error_limited_length(carry, here, verdict, control)
    left = (control.next_strike(loop, carry.k) - carry.k) * control.h - carry.since
    stability_fraction = carry.stability_fraction
    if control.notes:
        quiet = carry.status == RunStatus.RUNNING
        stability_fraction = jnp.where(
            verdict.taken,
            jnp.where(
                quiet, jnp.minimum(STABILITY_FRACTION_GROWTH * stability_fraction, 1.0), INITIAL_STABILITY_FRACTION
            ),
            stability_fraction,
        )
    longest = jnp.minimum(error_limited, stability_fraction * carry.limit)
    length, ends = plan_step(longest, point.ahead, left, control)
    late = trying & (here.late > 0) & verdict.fine
    # A comparison changed `late` seconds before the end: the next attempt ends there.
    length = jnp.where(late, jnp.maximum(carry.length - here.late, control.least), length)
    status = jnp.where(verdict.taken, status_after_step(loop, carry, here.point.margins, verdict), carry.status)
    refreshes = status == RunStatus.REFRESHING
    length = jnp.where(refreshes, 0.0, length)
    looking = trying & verdict.searches_event
    plan = (carry.search, length, status)
    found = jax.lax.cond(any_lane(looking), lambda: _continue_search(carry, here, count), lambda: plan)
    search, length, status = select(looking, found, plan)
    crossing_steps, unrestricted = carry.turns, carry.unrestricted
    if count:
        on_comparison = (carry.status == RunStatus.LANDING) & (carry.search.which < count)
        calm = verdict.taken & new & (carry.length > RESET_STEP_FRACTION * carry.error_limited)
        crossing_steps = jnp.where(
            verdict.taken & on_comparison, crossing_steps + 1, jnp.where(calm, 0, crossing_steps)
        )
        tired = looking & (search.tries >= MAX_LOCATION_ATTEMPTS) & (search.which < count)
        same = jnp.all(jnp.stack([a == b for a, b in zip(here.point.words, carry.point.words, strict=True)]))
        begins = (tired | (verdict.taken & (crossing_steps > MAX_CONSECUTIVE_CROSSINGS))) & ~unrestricted
        unrestricted = (unrestricted | begins) & ~(calm & same)
        looking &= ~(begins & tired)
        length = jnp.where(begins & tired, longest, length)
        status = jnp.where(begins & tired, RunStatus.RUNNING, status).astype(status.dtype)
    lost = (~verdict.fine & (carry.length <= control.least)) | (
        carry.tries > MAX_ATTEMPTS + ATTEMPTS_PER_INSTANT * control.steps
    )
    last = HermiteStep(*(carry.point.t, carry.point.state, carry.point.rate[0]), *_end(here.point))
    return carry._replace(
        point=point,
        error_limited=error_limited,
        length=length,
        ends=ends & ~looking & ~late & ~refreshes,
        scale=select(verdict.taken, here.scale, carry.scale),
        base=jnp.where(looking & new, carry.length, carry.base),
        search=search,
        tries=carry.tries + 1,
        last_step=select(verdict.taken, last, carry.last_step) if control.keeps else (),
        turns=crossing_steps,
        stability_fraction=stability_fraction,
        unrestricted=unrestricted,
        triggered=pack_events(verdict.triggered),
        status=jnp.where(lost, RunStatus.DIVERGED, status).astype(carry.status.dtype),
    )


def attempt_step(
    system: Dynamics, carry: AdaptiveCarry, end: PyTree, refreshing: Scalar, lands: Scalar, control: StepSizeControl
) -> AdaptiveAttempt:
    """Return the result of one attempt.

    For derivatives (`control.notes`) the step keeps the mode of its beginning, unless steps are unrestricted.

    Args:
        system: Dynamics of the loop and its objectives.
        carry: Carry before the attempt.
        end: Time at the end of the step [s].
        refreshing: True for a step of length 0 that evaluates the rates after an event.
        lands: True if the step ends on the switching surface that the search looks for.
        control: Step-size control.
    """
    loop, point, h = system.loop, carry.point, carry.length
    z, held = split_flow_and_held(point.state, point.accumulators)
    within, at = UNCONSTRAINED, UNCONSTRAINED
    if control.notes:
        within = Mode(point.words, carry.unrestricted)
        at = mode_at_end(system, point.words, carry.search.which, lands, carry.unrestricted | refreshing)

    def flow(t: Scalar, z: Matrix) -> Any:
        return system.rates(t, z, held, within)

    # The error estimate waits for the rate at the end, which `ahead` computes together with everything else there.
    z, so_far = tsit5_step_with_error(flow, point.t, z, point.rate, h)
    state = point.state.with_flow(z[0])
    rests = state._replace(plant=loop.plant.project(state.plant))
    # A projection may move the state onto a switching surface, so the end of a frozen mode is evaluated without it.
    state = select(carry.unrestricted, rests, state) if control.notes else rests
    accumulated = {name: memory._replace(flow=z[1][name]) for name, memory in point.accumulators.items()}
    found = system.ahead(end, state, accumulated, at)
    seen, moving, recording, _, words, _, comparisons = found
    sample, recorded = seen.signals.sample, (seen.signals.recorded, recording)
    changed = tuple(a ^ b for a, b in zip(words, point.words, strict=True))
    segment = Segment(
        point.sample,
        sample,
        h,
        control.h,
        lambda: (Shown.of(point.moving), Shown.of(moving)),
        lambda: (point.moving, moving),
        smooth=True,
        within=valid_end_rates(comparisons, changed, h),
    )
    accumulators = {
        name: Memory(z[1][name], o.update(accumulated[name], segment)) for name, o in system.objectives.items()
    }
    if loop.changes and not loop.ticks:
        # A step of length 0 must not count twice in the objectives.
        accumulators = select(refreshing, point.accumulators, accumulators)
    ahead, late = forecast_crossings(comparisons, carry.error_limited, control.least, changed, h)
    ahead = jnp.where(carry.unrestricted, 1.0, CROSSING_OVERREACH) * ahead if control.notes else ahead
    new = AdaptivePoint(end, rests, accumulators, sample, moving, recorded, seen[:2], seen.margins, words, ahead)
    scale = jax.tree.map(jnp.maximum, carry.scale, error_scales(state, sample))
    off = midpoint_error(so_far[0], seen.rate, h)
    off = error_norm(loop, state, off, scale, sample) / control.rtol
    kink = _surface_crossing(found, carry.search.which, h) if control.notes else ()
    return AdaptiveAttempt(new, seen.signals, off, scale, late, kink)


def _surface_crossing(found: LoopEvaluationWithRates, which: Scalar, h: Scalar) -> SurfaceCrossing:
    """Return the comparisons whose answers at the end of a step contradict the mode of the step."""
    margins = [(one.numbers, one.value) for one in found.comparisons]
    return SurfaceCrossing(*find_contradicted(ComparisonAnswers(found.words, found.contradicted, margins), which, h))


def commit_step(
    system: Dynamics,
    control: StepSizeControl,
    clock: Clock,
    begun: AdaptivePoint,
    here: AdaptiveAttempt,
    fired: Margins,
    error_limited: Scalar,
    logs: list[PyTree],
    mode: Mode,
) -> AdaptivePoint:
    """Return the point at which the run continues, after the triggered events and the ticks of the clock.

    In a loop without ticks a later step of length 0 evaluates the rates after an event. Events are rare, so this is
    cheaper than an evaluation after every step.

    Args:
        system: Dynamics of the loop and its objectives.
        control: Step-size control.
        clock: Instant at the end of the step.
        begun: Point at the beginning of the step.
        here: Result of the attempt.
        fired: True for each event that happens at the end of the step.
        error_limited: Step length that the error allows [s].
        logs: Rows of the blocks' logs, which the state is without (`core.log`).
        mode: Mode after the ticks and events.
    """
    loop, point = system.loop, here.point
    if not loop.changes:
        return point
    lent, step = borrow(point.state, logs), build_passages(begun, point)
    state = borrow(loop.change(clock, lent, here.signals, point.margins, fired, step), None)
    if not loop.ticks:
        return point._replace(state=state)
    return _evaluate_point(system, control, point.t, state, point.accumulators, error_limited, mode)


def build_passages(start: PyTree, end: PyTree) -> dict[str, Passage]:
    """Return the step between two points as a `Passage` for each block that records its signal, by the block's name.

    Args:
        start: Point at the beginning, with the time and the recorded signals.
        end: Point at the end, before the changes there.
    """
    (values, rates), (last, falls) = start.recorded, end.recorded
    return {n: Passage(start.t, end.t, (values[n], last[n]), (rates[n], falls[n])) for n in values}


def is_before(control: StepSizeControl, carry: AdaptiveCarry, instant: Scalar) -> Scalar:
    """Return True if the run goes on and has not reached this instant of the grid.

    Args:
        control: Step-size control.
        carry: Carry of the run.
        instant: Number of the instant on the grid.
    """
    return carry.running & (carry.point.t < instant * control.h)


def _end(point: AdaptivePoint) -> PyTree:
    """Return time, flow state and rate of a point: the end of a `HermiteStep`, before the changes there."""
    return point.t, point.state.flow(), point.rate[0]


def _evaluate_point(
    system: Dynamics,
    control: StepSizeControl,
    t: Scalar,
    state: LoopState,
    accumulators: Accumulators,
    length: Scalar,
    mode: Mode,
) -> AdaptivePoint:
    seen, moving, recording, _, words, _, comparisons = system.ahead(t, state, accumulators, mode)
    recorded = (seen.signals.recorded, recording)
    ahead, _ = forecast_crossings(comparisons, length, control.least, words, 0.0 * length)
    ahead = CROSSING_OVERREACH * ahead if control.notes else ahead
    return AdaptivePoint(
        t, state, accumulators, seen.signals.sample, moving, recorded, seen[:2], seen.margins, words, ahead
    )


def _decide(
    carry: AdaptiveCarry, here: AdaptiveAttempt, count: int, active: Scalar, last: PyTree, control: StepSizeControl
) -> AdaptiveDecision:
    """Return the decision on an attempt: accept it, search within it, or end the run."""
    running, landing = carry.status == RunStatus.RUNNING, carry.status == RunStatus.LANDING
    refreshing = carry.status == RunStatus.REFRESHING
    fine = jnp.isfinite(here.error)  # the maximum over all states: one NaN makes it NaN
    short = carry.length <= control.least
    exact = fine & (((here.error <= 1) & (here.late <= 0)) | short)
    crossed = falls_through(*_margins(carry, here))
    crosses = jnp.any(jnp.stack(crossed + ([here.kink.contradicted, here.kink.other >= 0] if count else [])))
    taken = active & fine & (landing | refreshing | (running & exact & ~crosses))
    seeks = ~landing & ~refreshing & (~running | (exact & crosses))
    fired = [taken & landing & ((carry.search.which == count + i) | one) for i, one in enumerate(crossed)]
    fired = jax.tree.unflatten(jax.tree.structure(here.point.margins), fired)
    over = fired["stop"][0] | (taken & carry.ends & last)
    return AdaptiveDecision(fine, taken, seeks, fired, over)


def pack_events(fired: Margins) -> Scalar:
    """Return the triggered events as a bit mask, one bit for each event.

    Args:
        fired: True for each event that happens.
    """
    return sum((jnp.where(one, 1 << i, 0) for i, one in enumerate(jax.tree.leaves(fired))), jnp.asarray(0))


def _error_limited_length(
    carry: AdaptiveCarry, here: AdaptiveAttempt, verdict: AdaptiveDecision, control: StepSizeControl
) -> Scalar:
    """Return the step length that the error allows [s].

    A step that was cut short cannot reduce this length, nor can a step with a switching surface inside.
    """
    longer = jnp.where(verdict.fine, propose_length(carry.length, here.error), MIN_STEP_RATIO * carry.length)
    # A step cut short by a clock or an event has a small error, so it may raise the allowed length but not lower it.
    cut = verdict.taken & (carry.length < carry.error_limited)
    wrong = ~verdict.fine | ((here.error > 1) & (here.late <= 0))
    judged = (carry.status == RunStatus.RUNNING) & (verdict.taken | wrong)
    error_limited = jnp.where(
        judged, jnp.where(cut, jnp.maximum(longer, carry.error_limited), longer), carry.error_limited
    )
    return jnp.maximum(error_limited, control.least)


def _continue_search(carry: AdaptiveCarry, here: AdaptiveAttempt, count: int) -> tuple[EventSearch, PyTree, PyTree]:
    """Return the search, the next length and the next status after an attempt with an event or a switching surface
    inside.
    """
    new = carry.status == RunStatus.RUNNING
    base = jnp.where(new, carry.length, carry.base)
    which, ends = carry.search.which, _margins(carry, here)
    tells = find_crossings(which, count, here.kink, *ends) if count else find_event_crossings(which, 0, *ends)
    # A step ends sqrt(eps) steps beyond a switching surface, so that the comparison has surely changed there.
    beyond = jnp.where(which < count, base * jnp.finfo(base.dtype).eps ** OVERSHOOT_EXPONENT, 0.0)
    search, length, enough = bracket_event(carry.search, carry.length, new, tells, base)
    seeking = search, length, jnp.where(enough, RunStatus.PROBING, RunStatus.SEEKING)
    found, end = locate_event(carry.search, carry.length, tells, beyond)
    end, again = accept_location(found, carry.length, end)
    landing = found, end, jnp.where(again, RunStatus.SEEKING, RunStatus.LANDING)
    search, length, status = select(carry.status == RunStatus.PROBING, landing, seeking)
    return search, length, status.astype(carry.status.dtype)


def _margins(carry: AdaptiveCarry, here: AdaptiveAttempt) -> tuple[list[PyTree], list[PyTree]]:
    """Return the margins at the beginning and at the end of the attempt."""
    return jax.tree.leaves(carry.point.margins), jax.tree.leaves(here.point.margins)
