"""Which steps a run under `FixedStep` takes: those of the grid, cut where an event lies between.

A step within which a margin falls through zero (the stop's, a block's, that of a comparison in the flow) is tried
again, shorter, until one ends on the zero (`landing`). So the run is a discretisation of the exact solution on both
sides of the event, and nothing is corrected afterwards. The next step goes on to the grid.

    RUNNING  --a margin falls through zero-->  SEEKING  -->  PROBING  -->  LANDING  -->  RUNNING, or STOPPED

For derivatives REFINING lies between PROBING and LANDING: a try of the same length, from which the length has the
second derivatives of the event's moment.

Where a block has changed in an event, and no clock is looked at after each step anyway, the rates are worked out by a
step of no length, REFRESHING.

Where a comparison does not let itself be landed on, or its regime leads out of what can be computed, the way to the
grid is one blunt step, in which comparisons say at each stage what the numbers say: right to the order of the kink. So
are the steps after it, until in one of them no comparison changes."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.log import borrow, commit, log_rows
from diffabs.core.loop import Loop, Margins
from diffabs.core.protocols import Clock
from diffabs.simulate.advance import (
    FixedStepAttempt,
    FixedStepPoint,
    StepRequest,
    SurfaceCrossing,
    attempt_step,
    commit_step,
    initial_point,
)
from diffabs.simulate.checkpoint import any_lane, jit_barrier
from diffabs.simulate.condition import RunStatus, is_running, status_after_step
from diffabs.simulate.dynamics import Objectives, build_dynamics
from diffabs.simulate.landing import (
    MAX_LOCATION_ATTEMPTS,
    OVERSHOOT_EXPONENT,
    AttemptCrossings,
    EventCrossing,
    EventSearch,
    accept_location,
    bracket_event,
    falls_through,
    find_event_crossings,
    init_search,
    locate_event,
    refine,
    select,
)

EVENT_ATTEMPTS_PER_STEP, SPARE_ATTEMPTS = (
    4,
    64,
)  # tries beyond a step of the grid for each of them, about an event; and besides
CROSSING_ATTEMPTS_PER_STEP = (
    1  # tries for each step of the grid, up to now, that comparisons may take; then steps are blunt
)
MAX_ATTEMPTS_PER_STEP = 32  # tries within one step of the grid, likewise
MAX_RATE_RATIO, MAX_STATE_FRACTION = (
    4,
    1e-3,
)  # times the rates at both ends of a step, and part of the state: the most that it may change


class FixedStepCarry(NamedTuple):
    """A run on its way."""

    point: FixedStepPoint
    k: Any  # number of the last instant of the grid
    length: Any  # of the step to try [s]
    search: EventSearch
    extra_attempts: Any  # tries that did not end on the grid
    here: Any  # those since its last instant
    unrestricted: Any  # whether steps are
    status: Any

    running = property(is_running)


class FixedStepDecision(NamedTuple):
    """What is made of a try: whether its numbers are finite, whether it is taken, whether it then ends on the grid;
    which events happen at its end, and whether the run is over there."""

    fine: Any
    taken: Any
    on_grid: Any
    triggered: Margins
    over: Any


def attempt_capacity(loop: Loop, steps: int, *, kinks: bool = False) -> int:
    """Return how many tries a run of so many steps of the grid may take: what a scan must have room for. Of three tries
    about an event, at least, one is made twice: REFINING."""
    about = (
        (CROSSING_ATTEMPTS_PER_STEP if kinks else 0) + (EVENT_ATTEMPTS_PER_STEP if loop.eventful else 0)
    ) * steps + SPARE_ATTEMPTS
    return steps + SPARE_ATTEMPTS + about + about // 3


def init_carry(loop: Loop, objectives: Objectives, h: Any, key: Any, *, kinks: bool = False) -> FixedStepCarry:
    """Return the carry at t = 0."""
    zero = jnp.asarray(0)
    point = initial_point(loop, objectives, Clock(0.0 * h, h, zero, key), kinks=kinks)
    status = jnp.where(point.margins["stop"][0] > 0, zero + RunStatus.RUNNING, zero + RunStatus.DIVERGED)
    return cast_floats(FixedStepCarry(point, zero, h, init_search(h), zero, zero, jnp.asarray(False), status), h.dtype)


def step(
    loop: Loop,
    objectives: Objectives,
    h: Any,
    key: Any,
    steps: Any,
    carry: FixedStepCarry,
    until: Any = None,
    *,
    kinks: bool = False,
    refines: bool = False,
) -> FixedStepCarry:
    """Return the carry after one try of a step; the same if the run is over, or has come to instant `until`.

    kinks: whether comparisons are located, as derivatives need it
    refines: whether the moment of an event has second derivatives; its value is the same"""
    active = carry.running if until is None else carry.running & (carry.k < until)
    logs = log_rows(carry.point.state)
    carry = carry._replace(point=carry.point._replace(state=borrow(carry.point.state, None)))
    to_grid, landing, refreshing = (
        carry.status == one for one in (RunStatus.RUNNING, RunStatus.LANDING, RunStatus.REFRESHING)
    )
    system = build_dynamics(loop, objectives, carry.point.t, carry.point.state, carry.point.accumulators, kinks=kinks)
    count, which = system.kinks, carry.search.which
    end = jnp.where(to_grid, (carry.k + 1) * h, carry.point.t + carry.length)
    one = StepRequest(carry.length, end, h, carry.unrestricted, refreshing, which, landing & (which < count))
    here = jit_barrier(active, lambda: attempt_step(system, carry.point, one, active))
    verdict = jit_barrier(active, lambda: _decide(carry, here, count, active, steps))
    k = carry.k + jnp.where(verdict.on_grid, 1, 0)
    leave = partial(commit_step, system, Clock(end, h, k, key, verdict.on_grid), here, verdict.triggered, one, logs)
    point = jit_barrier(active, leave) if loop.changes else leave()
    point = select(verdict.over, _last(here, point), point)

    trying, plan = active & ~verdict.taken, (carry.search, carry.length, carry.unrestricted, carry.status)

    def looked() -> Any:
        return select(trying, _continue_search(carry, here, verdict.fine, count, h, refines), plan)

    search, *tried = jax.lax.cond(any_lane(trying), looked, lambda: plan)
    length, unrestricted, status = select(
        verdict.taken, _plan_next_step(loop, carry, here, verdict, h, (k + 1) * h - end), tuple(tried)
    )
    counts = active & ~verdict.on_grid & (carry.status != RunStatus.REFINING)
    extra = carry.extra_attempts + jnp.where(counts, 1, 0)
    since = jnp.where(verdict.on_grid, 0, carry.here + extra - carry.extra_attempts)
    lost = active & (
        (~verdict.fine & (carry.unrestricted if count else True))
        | (extra > (EVENT_ATTEMPTS_PER_STEP + CROSSING_ATTEMPTS_PER_STEP) * steps + SPARE_ATTEMPTS)
    )
    status = jnp.where(lost, RunStatus.DIVERGED, status).astype(carry.status.dtype)
    point = select(verdict.taken, point, carry.point)
    point = point._replace(state=commit(point.state, logs))
    return FixedStepCarry(point, k, length, search, extra, since, unrestricted, status)


def _plan_next_step(
    loop: Loop, carry: FixedStepCarry, here: FixedStepAttempt, verdict: FixedStepDecision, h: Any, left: Any
) -> tuple[Any, ...]:
    """What a try that is taken leaves: next length, whether steps are blunt, and the condition; `left` to the grid."""
    ended = status_after_step(loop, carry, here.margins, verdict)
    left = jnp.where(ended == RunStatus.REFRESHING, 0.0, jnp.where(verdict.on_grid, h, left))
    same = [a == b for a, b in zip(here.mode, carry.point.mode, strict=True)]
    calm = verdict.on_grid & jnp.all(jnp.array(same))
    return left, carry.unrestricted & ~calm, ended


def _decide(carry: FixedStepCarry, here: FixedStepAttempt, kinks: int, active: Any, steps: Any) -> FixedStepDecision:
    to_grid, landing = carry.status == RunStatus.RUNNING, carry.status == RunStatus.LANDING
    fine = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(here.state.flow())]))
    crossed = falls_through(*_margins(carry, here))
    fine &= carry.unrestricted | _is_plausible(carry, here) if kinks else True
    changes = jnp.any(jnp.stack([*crossed, here.kink.contradicted, here.kink.other >= 0]))
    taken = active & fine & (landing | (carry.status == RunStatus.REFRESHING) | (to_grid & ~changes))
    on_grid = taken & to_grid
    fired = [landing & ((carry.search.which == kinks + i) | one) for i, one in enumerate(crossed)]
    fired = jax.tree.unflatten(jax.tree.structure(here.margins), fired)
    over = fired["stop"][0] | (on_grid & (carry.k + 1 >= steps))
    return FixedStepDecision(fine, taken, on_grid, fired, over)


def _is_plausible(carry: FixedStepCarry, here: FixedStepAttempt) -> Any:
    """Whether the state has changed as the rates at both ends say, roughly. Within a regime, beyond its kinks, a flow
    need not be bounded as that of the loop is, and where a step is too long for stability that is where it leads."""
    ends = [jax.tree.leaves(point.state.flow()) for point in (carry.point, here)]
    rates = [jax.tree.leaves(point.rate[0]) for point in (carry.point, here)]
    sane = []
    for a, b, p, q in zip(*ends, *rates, strict=True):
        most = MAX_RATE_RATIO * jnp.abs(carry.length) * jnp.maximum(jnp.abs(p), jnp.abs(q))
        sane.append(jnp.all(jnp.abs(b - a) <= most + MAX_STATE_FRACTION * (jnp.abs(a) + jnp.abs(b))))
    return jnp.all(jnp.array(sane))


def _continue_search(
    carry: FixedStepCarry, here: FixedStepAttempt, fine: Any, kinks: int, h: Any, refines: bool
) -> tuple[EventSearch, Any, Any, Any]:
    """What a try that is not taken tells: the search, the next length, and how that is tried."""
    tells = find_crossings(carry.search.which, kinks, here.kink, *_margins(carry, here))
    new = carry.status == RunStatus.RUNNING
    search, length, enough = bracket_event(carry.search, carry.length, new, tells, h)
    seeking = search, length, jnp.where(enough, RunStatus.PROBING, RunStatus.SEEKING)
    beyond = jnp.where(carry.search.which < kinks, h * jnp.finfo(h.dtype).eps ** OVERSHOOT_EXPONENT, 0.0)
    landing = _landing(carry, *locate_event(carry.search, carry.length, tells, beyond), refines)
    search, length, status = select(carry.status == RunStatus.PROBING, landing, seeking)
    if refines:
        refined = carry.search, refine(carry.search, carry.length, tells), status * 0 + RunStatus.LANDING
        search, length, status = select(carry.status == RunStatus.REFINING, refined, (search, length, status))
    tired = (
        (search.tries >= MAX_LOCATION_ATTEMPTS)
        | (carry.here >= MAX_ATTEMPTS_PER_STEP)
        | (carry.extra_attempts > CROSSING_ATTEMPTS_PER_STEP * carry.k + SPARE_ATTEMPTS)
    )
    unrestricted = carry.unrestricted | ~fine | (tired & (search.which < kinks))
    begins = unrestricted & ~carry.unrestricted
    length = jnp.where(begins, (carry.k + 1) * h - carry.point.t, length)
    status = jnp.where(begins, RunStatus.RUNNING, status)
    return search, length, unrestricted, status.astype(carry.status.dtype)


def _landing(carry: FixedStepCarry, search: EventSearch, length: Any, refines: bool) -> tuple[EventSearch, Any, Any]:
    """A step of this length, or a search that goes on: the condition last."""
    length, again = accept_location(search, carry.length, length)
    return search, length, jnp.where(again, RunStatus.SEEKING, RunStatus.REFINING if refines else RunStatus.LANDING)


def find_crossings(
    which: Any, kinks: int, kink: SurfaceCrossing, before: list[Any], after: list[Any]
) -> AttemptCrossings:
    """Return what a try tells of the comparisons, first, and of the margins of the events at its ends."""
    events = find_event_crossings(which, kinks, before, after)
    unknown, bends = jnp.full_like(kink.margin, jnp.inf), kink.other >= 0
    at = [jnp.where(kink.chosen == one, kink.margin, jnp.inf) for one in (which, kink.other)]
    sought = select(which < kinks, EventCrossing(which, at[0], unknown), events.sought)
    other = select(bends, EventCrossing(kink.other, at[1], unknown), events.other)
    return AttemptCrossings(sought, kink.contradicted | events.falls, other, bends | events.another)


def _margins(carry: FixedStepCarry, here: FixedStepAttempt) -> tuple[list[Any], list[Any]]:
    """At the beginning and at the end of the try."""
    return jax.tree.leaves(carry.point.margins), jax.tree.leaves(here.margins)


def _last(here: FixedStepAttempt, point: FixedStepPoint) -> FixedStepPoint:
    """The end of a run, where nothing changes any more."""
    return point._replace(state=here.state, accumulators=here.accumulators, sample=here.signals.sample)


def cast_floats(tree: Any, dtype: Any) -> Any:
    """Strong types throughout: a scan refuses a carry whose type weakens or strengthens."""

    def typed(x: Any) -> Any:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(x.dtype)

    return jax.tree.map(typed, tree)
