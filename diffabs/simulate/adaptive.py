"""Steps as long as an error allows, of one lane each: how a run under `Adaptive` goes on.

    length     0.85 r^(-1/4) times the last, r = |error|/rtol: the error is that of the cubic in the step's middle,
               through which everything in a step is seen; at most 3/rho, rho the spectral radius of the loop's
               Jacobian
    kinks      a step ends where a comparison in the flow is predicted to change (`foresight`); one within which
               another did is tried again, up to there
    events     a step within which a margin falls through zero is tried again until one ends on it (`landing`)
    clocks     a step ends where a block's clock strikes

The grid of `Adaptive.step` is only where clocks strike and what a trajectory keeps: no step has to end on it."""

from typing import Any

import jax
import jax.numpy as jnp

from diffabs.core.blocks import Passage
from diffabs.core.log import borrow, log_rows, write_last_rows
from diffabs.core.loop import Loop, LoopState, Margins
from diffabs.core.modes import ComparisonAnswers, Mode, find_contradicted
from diffabs.core.protocols import Clock, Memory, Segment, Shown
from diffabs.simulate.advance import SurfaceCrossing, mode_after_changes, mode_at_end, start_state
from diffabs.simulate.checkpoint import any_lane, jit_barrier
from diffabs.simulate.condition import RunStatus, status_after_step
from diffabs.simulate.dynamics import (
    UNCONSTRAINED,
    Accumulators,
    Dynamics,
    LoopEvaluationWithRates,
    Objectives,
    build_dynamics,
    split_flow_and_held,
)
from diffabs.simulate.foresight import forecast_crossings, valid_end_rates
from diffabs.simulate.landing import (
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
from diffabs.simulate.lengths import (
    INITIAL_STEP_S,
    MIN_STEP_RATIO,
    StepSizeControl,
    error_norm,
    error_scales,
    plan_step,
    propose_length,
    spectral_step_limit,
)
from diffabs.simulate.span import HermiteStep
from diffabs.simulate.stepper import cast_floats, find_crossings
from diffabs.simulate.tries import AdaptiveAttempt, AdaptiveCarry, AdaptiveDecision, AdaptivePoint
from diffabs.simulate.tsit5 import midpoint_error, tsit5_step_with_error

MAX_ATTEMPTS, ATTEMPTS_PER_INSTANT = (
    100_000,
    16,
)  # tries of a run, and for each instant of its grid: more of them lead nowhere
RESET_STEP_FRACTION = (
    0.1  # of the length that the error allows: a step so long that ends on no comparison is none in such a row
)
# For derivatives: the first step after an event or a comparison that changes, as a part of the longest stable one, and
# how much longer each of the next may be. An event excites the fastest modes of the derivative far more than the run's.
INITIAL_STABILITY_FRACTION, STABILITY_FRACTION_GROWTH = 1 / 16, 1.6
MAX_CONSECUTIVE_CROSSINGS = 16  # steps in a row that end on comparisons; then steps are blunt
CROSSING_OVERREACH = 1.5  # times the way to where a comparison is predicted to change: a step that keeps to its regime
FIELDS_AFTER_END = ("tries", "status")  # what is still looked at when a run is over


def init_carry(loop: Loop, objectives: Objectives, control: StepSizeControl, key: Any) -> AdaptiveCarry:
    """Return the carry at t = 0."""
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
    loop: Loop, objectives: Objectives, control: StepSizeControl, key: Any, carry: AdaptiveCarry, until: Any = None
) -> AdaptiveCarry:
    """Return the carry after one try of a step; the same if the run is over, or has come to instant `until`."""
    active = carry.running if until is None else is_before(control, carry, until)
    logs = write_last_rows(carry.point.state)
    carry = carry._replace(point=carry.point._replace(state=borrow(carry.point.state, None)))
    system = build_dynamics(loop, objectives, carry.point.t, carry.point.state, carry.point.accumulators, kinks=True)
    strike = control.next_strike(loop, carry.k)
    end = jnp.where(carry.ends, strike * control.h, carry.point.t + carry.length)
    refreshing = carry.status == RunStatus.REFRESHING
    count, which = (system.kinks if control.notes else 0), carry.search.which
    lands = (carry.status == RunStatus.LANDING) & (which < count)
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
    if until is None:  # of a run that is over, the rest does not matter
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
    """The carry after a try, which has led to this point, or is to be tried again from there."""
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
    system: Dynamics, carry: AdaptiveCarry, end: Any, refreshing: Any, lands: Any, control: StepSizeControl
) -> AdaptiveAttempt:
    """Return what a try leads to. For derivatives it keeps to its regime, unless it is blunt.

    lands: whether it ends where the comparison changes that is looked for"""
    loop, point, h = system.loop, carry.point, carry.length
    z, held = split_flow_and_held(point.state, point.accumulators)
    within, at = UNCONSTRAINED, UNCONSTRAINED
    if control.notes:
        within = Mode(point.words, carry.unrestricted)
        at = mode_at_end(system, point.words, carry.search.which, lands, carry.unrestricted | refreshing)

    def flow(t: Any, z: Any) -> Any:
        return system.rates(t, z, held, within)

    z, so_far = tsit5_step_with_error(flow, point.t, z, point.rate, h)
    state = point.state.with_flow(z[0])
    rests = state._replace(plant=loop.plant.project(state.plant))
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
        accumulators = select(refreshing, point.accumulators, accumulators)
    ahead, late = forecast_crossings(comparisons, carry.error_limited, control.least, changed, h)
    ahead = jnp.where(carry.unrestricted, 1.0, CROSSING_OVERREACH) * ahead if control.notes else ahead
    new = AdaptivePoint(end, rests, accumulators, sample, moving, recorded, seen[:2], seen.margins, words, ahead)
    scale = jax.tree.map(jnp.maximum, carry.scale, error_scales(state, sample))
    off = midpoint_error(so_far[0], seen.rate, h)
    off = error_norm(loop, state, off, scale, sample) / control.rtol
    kink = _surface_crossing(found, carry.search.which, h) if control.notes else ()
    return AdaptiveAttempt(new, seen.signals, off, scale, late, kink)


def _surface_crossing(found: LoopEvaluationWithRates, which: Any, h: Any) -> SurfaceCrossing:
    """The comparisons that say something else at the end of a step than in it."""
    margins = [(one.numbers, one.value) for one in found.comparisons]
    return SurfaceCrossing(*find_contradicted(ComparisonAnswers(found.words, found.contradicted, margins), which, h))


def commit_step(
    system: Dynamics,
    control: StepSizeControl,
    clock: Clock,
    begun: AdaptivePoint,
    here: AdaptiveAttempt,
    fired: Margins,
    error_limited: Any,
    logs: list[Any],
    mode: Mode,
) -> AdaptivePoint:
    """Return the point from which a run goes on, after the events that have `fired` and the ticks of the clock. In a
    loop without ticks, what follows from an event is left to a step of no length: there are few of them.

    logs: the rows of the blocks' logs, which the state is without (`core.log`); regime: that after the ticks"""
    loop, point = system.loop, here.point
    if not loop.changes:
        return point
    lent, step = borrow(point.state, logs), build_passages(begun, point)
    state = borrow(loop.change(clock, lent, here.signals, point.margins, fired, step), None)
    if not loop.ticks:
        return point._replace(state=state)
    return _evaluate_point(system, control, point.t, state, point.accumulators, error_limited, mode)


def build_passages(start: Any, end: Any) -> dict[str, Passage]:
    """Return the step between two points for the blocks that record it."""
    (values, rates), (last, falls) = start.recorded, end.recorded
    return {n: Passage(start.t, end.t, (values[n], last[n]), (rates[n], falls[n])) for n in values}


def is_before(control: StepSizeControl, carry: AdaptiveCarry, instant: Any) -> Any:
    """Return whether a run goes on, and has not come to this instant of the grid."""
    return carry.running & (carry.point.t < instant * control.h)


def _end(point: AdaptivePoint) -> Any:
    """Of a span, before what changes there."""
    return point.t, point.state.flow(), point.rate[0]


def _evaluate_point(
    system: Dynamics,
    control: StepSizeControl,
    t: Any,
    state: LoopState,
    accumulators: Accumulators,
    length: Any,
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
    carry: AdaptiveCarry, here: AdaptiveAttempt, count: int, active: Any, last: Any, control: StepSizeControl
) -> AdaptiveDecision:
    running, landing = carry.status == RunStatus.RUNNING, carry.status == RunStatus.LANDING
    refreshing = carry.status == RunStatus.REFRESHING
    fine = jnp.isfinite(here.error)  # the greatest of those of all states
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


def pack_events(fired: Margins) -> Any:
    """Return a bit for each event."""
    return sum((jnp.where(one, 1 << i, 0) for i, one in enumerate(jax.tree.leaves(fired))), jnp.asarray(0))


def _error_limited_length(
    carry: AdaptiveCarry, here: AdaptiveAttempt, verdict: AdaptiveDecision, control: StepSizeControl
) -> Any:
    """The length that the error allows. A step that was cut short says nothing against it, nor does one with a kink."""
    longer = jnp.where(verdict.fine, propose_length(carry.length, here.error), MIN_STEP_RATIO * carry.length)
    cut = verdict.taken & (carry.length < carry.error_limited)
    wrong = ~verdict.fine | ((here.error > 1) & (here.late <= 0))
    judged = (carry.status == RunStatus.RUNNING) & (verdict.taken | wrong)
    error_limited = jnp.where(
        judged, jnp.where(cut, jnp.maximum(longer, carry.error_limited), longer), carry.error_limited
    )
    return jnp.maximum(error_limited, control.least)


def _continue_search(carry: AdaptiveCarry, here: AdaptiveAttempt, count: int) -> tuple[EventSearch, Any, Any]:
    """What a try that is not taken tells about an event, or a comparison: the search, the next length, and how that is
    tried."""
    new = carry.status == RunStatus.RUNNING
    base = jnp.where(new, carry.length, carry.base)
    which, ends = carry.search.which, _margins(carry, here)
    tells = find_crossings(which, count, here.kink, *ends) if count else find_event_crossings(which, 0, *ends)
    beyond = jnp.where(which < count, base * jnp.finfo(base.dtype).eps ** OVERSHOOT_EXPONENT, 0.0)
    search, length, enough = bracket_event(carry.search, carry.length, new, tells, base)
    seeking = search, length, jnp.where(enough, RunStatus.PROBING, RunStatus.SEEKING)
    found, end = locate_event(carry.search, carry.length, tells, beyond)
    end, again = accept_location(found, carry.length, end)
    landing = found, end, jnp.where(again, RunStatus.SEEKING, RunStatus.LANDING)
    search, length, status = select(carry.status == RunStatus.PROBING, landing, seeking)
    return search, length, status.astype(carry.status.dtype)


def _margins(carry: AdaptiveCarry, here: AdaptiveAttempt) -> tuple[list[Any], list[Any]]:
    """At the beginning and at the end of the try."""
    return jax.tree.leaves(carry.point.margins), jax.tree.leaves(here.point.margins)
