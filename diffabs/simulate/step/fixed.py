"""Fixed steps of a single run: the attempts of a run under `FixedStep`, and the search for events between grid
instants.

A margin of the stop, of a block, or of a comparison in the flow may fall through zero within a step. Then shorter steps
are attempted until one ends on the zero (`landing`). So the run discretises the exact solution on both sides of the
event, without a later correction. The next step goes on to the grid.

    RUNNING  --a margin falls through zero-->  SEEKING  -->  PROBING  -->  LANDING  -->  RUNNING, or STOPPED

For derivatives REFINING lies between PROBING and LANDING: an attempt of the same length. It gives the length the second
derivatives of the event's time.

REFRESHING is a step of length 0 that evaluates the rates after an event has changed a block. It is needed only if no
clock is evaluated after each step anyway.

A search on a switching surface may fail, or its mode may lead to invalid numbers. Then one unrestricted step goes to
the grid, in which each stage evaluates its comparisons: it is accurate to the order of the kink. Later steps are
unrestricted, too, until no comparison changes in one of them.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.log import borrow, commit, log_rows
from diffabs.core.loop import Loop, Margins
from diffabs.core.protocols import Clock
from diffabs.core.types import PyTree, Scalar
from diffabs.simulate.drive.checkpoint import any_lane, jit_barrier
from diffabs.simulate.step.attempt import (
    FixedStepAttempt,
    FixedStepPoint,
    StepRequest,
    SurfaceCrossing,
    attempt_step,
    commit_step,
    initial_point,
)
from diffabs.simulate.step.event_location import (
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
from diffabs.simulate.step.status import RunStatus, is_running, status_after_step
from diffabs.simulate.step.system import Objectives, build_dynamics

EVENT_ATTEMPTS_PER_STEP, SPARE_ATTEMPTS = 4, 64  # attempts to locate events: for each step of the grid, and in addition
CROSSING_ATTEMPTS_PER_STEP = 1  # attempts on switching surfaces per step of the grid; beyond, steps are unrestricted
MAX_ATTEMPTS_PER_STEP = 32  # attempts within one step of the grid; beyond, steps are unrestricted
# Greatest change of a state in a step: a multiple of the rates at both ends, plus a fraction of the state.
MAX_RATE_RATIO, MAX_STATE_FRACTION = 4, 1e-3


class FixedStepCarry(NamedTuple):
    """State of a run between two attempts.

    Attributes:
        point: Point of the run that the last accepted attempt reached.
        k: Number of the last instant of the grid.
        length: Length of the next attempt [s].
        search: Search for an event.
        extra_attempts: Number of attempts so far that did not end on the grid.
        here: Number of such attempts since the last instant of the grid.
        unrestricted: True if steps are unrestricted.
        status: Status of the run, a `RunStatus`.
    """

    point: FixedStepPoint
    k: Scalar  # number of the last instant of the grid
    length: Scalar  # length of the next attempt [s]
    search: EventSearch
    extra_attempts: Any  # attempts that did not end on the grid
    here: Any  # such attempts since the last instant of the grid
    unrestricted: Scalar  # True if steps are unrestricted
    status: Scalar

    running = property(is_running)


class FixedStepDecision(NamedTuple):
    """Decision on an attempt.

    Attributes:
        fine: True if its numbers are finite and plausible.
        taken: True if the attempt is accepted.
        on_grid: True if an accepted attempt ends on the grid.
        triggered: True for each event at its end.
        over: True if the run ends there.
    """

    fine: Scalar
    taken: PyTree
    on_grid: Scalar
    triggered: Margins
    over: Any


def attempt_capacity(loop: Loop, steps: int, *, kinks: bool = False) -> int:
    """Return the greatest number of attempts in a run: the capacity of a scan.

    At least three attempts belong to an event, and REFINING repeats one of them.

    Args:
        loop: Closed loop.
        steps: Number of steps of the grid.
        kinks: True if switching surfaces are located.
    """
    about = (
        (CROSSING_ATTEMPTS_PER_STEP if kinks else 0) + (EVENT_ATTEMPTS_PER_STEP if loop.eventful else 0)
    ) * steps + SPARE_ATTEMPTS
    return steps + SPARE_ATTEMPTS + about + about // 3


def init_carry(loop: Loop, objectives: Objectives, h: Scalar, key: PyTree, *, kinks: bool = False) -> FixedStepCarry:
    """Return the carry at t = 0.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by the names of their metrics.
        h: Step of the grid [s].
        key: Random key, or None.
        kinks: True if switching surfaces are located.
    """
    zero = jnp.asarray(0)
    point = initial_point(loop, objectives, Clock(0.0 * h, h, zero, key), kinks=kinks)
    status = jnp.where(point.margins["stop"][0] > 0, zero + RunStatus.RUNNING, zero + RunStatus.DIVERGED)
    return cast_floats(FixedStepCarry(point, zero, h, init_search(h), zero, zero, jnp.asarray(False), status), h.dtype)


def step(
    loop: Loop,
    objectives: Objectives,
    h: Scalar,
    key: PyTree,
    steps: Scalar,
    carry: FixedStepCarry,
    until: Scalar = None,
    *,
    kinks: bool = False,
    refines: bool = False,
) -> FixedStepCarry:
    """Return the carry after one attempt of a step, unchanged if the run is over or has reached the instant `until`.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by the names of their metrics.
        h: Step of the grid [s].
        key: Random key, or None.
        steps: Number of steps of the run.
        carry: Carry before the attempt.
        until: Number of the grid instant at which to pause; None to go on to the end of the run.
        kinks: True if switching surfaces are located, as derivatives need it.
        refines: True if the time of an event has second derivatives. Its value is the same.
    """
    active = carry.running if until is None else carry.running & (carry.k < until)
    # The blocks' logs leave the carry: `select` below would otherwise copy whole tables in every step.
    logs = log_rows(carry.point.state)
    carry = carry._replace(point=carry.point._replace(state=borrow(carry.point.state, None)))
    to_grid, landing, refreshing = (
        carry.status == one for one in (RunStatus.RUNNING, RunStatus.LANDING, RunStatus.REFRESHING)
    )
    system = build_dynamics(loop, objectives, carry.point.t, carry.point.state, carry.point.accumulators, kinks=kinks)
    count, which = system.kinks, carry.search.which
    end = jnp.where(to_grid, (carry.k + 1) * h, carry.point.t + carry.length)
    one = StepRequest(carry.length, end, h, carry.unrestricted, refreshing, which, landing & (which < count))
    # Without the barrier, XLA would compile the attempt again into each expression that uses it.
    here = jit_barrier(active, lambda: attempt_step(system, carry.point, one, active))
    verdict = jit_barrier(active, lambda: _decide(carry, here, count, active, steps))
    k = carry.k + jnp.where(verdict.on_grid, 1, 0)
    leave = partial(commit_step, system, Clock(end, h, k, key, verdict.on_grid), here, verdict.triggered, one, logs)
    point = jit_barrier(active, leave) if loop.changes else leave()
    point = select(verdict.over, _last(here, point), point)

    trying, plan = active & ~verdict.taken, (carry.search, carry.length, carry.unrestricted, carry.status)

    def look() -> Any:
        return select(trying, _continue_search(carry, here, verdict.fine, count, h, refines), plan)

    # Few attempts search, so a batch skips the search unless one of its runs needs it.
    search, *tried = jax.lax.cond(any_lane(trying), look, lambda: plan)
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
    loop: Loop, carry: FixedStepCarry, here: FixedStepAttempt, verdict: FixedStepDecision, h: Scalar, left: Scalar
) -> tuple[PyTree, ...]:
    """Return next length, unrestricted flag and status after an accepted attempt that ended `left` seconds before the
    grid.
    """
    ended = status_after_step(loop, carry, here.margins, verdict)
    left = jnp.where(ended == RunStatus.REFRESHING, 0.0, jnp.where(verdict.on_grid, h, left))
    same = [a == b for a, b in zip(here.mode, carry.point.mode, strict=True)]
    calm = verdict.on_grid & jnp.all(jnp.array(same))
    return left, carry.unrestricted & ~calm, ended


def _decide(
    carry: FixedStepCarry, here: FixedStepAttempt, kinks: int, active: Scalar, steps: Scalar
) -> FixedStepDecision:
    """Return the decision on an attempt: accept it, search within it, or end the run."""
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


def _is_plausible(carry: FixedStepCarry, here: FixedStepAttempt) -> Scalar:
    """Return True if the state has changed roughly as the rates at both ends predict."""
    ends = [jax.tree.leaves(point.state.flow()) for point in (carry.point, here)]
    rates = [jax.tree.leaves(point.rate[0]) for point in (carry.point, here)]
    # A flow within a mode need not be bounded beyond its kinks, unlike the loop's own flow. A step too long for
    # stability goes there.
    sane = []
    for a, b, p, q in zip(*ends, *rates, strict=True):
        most = MAX_RATE_RATIO * jnp.abs(carry.length) * jnp.maximum(jnp.abs(p), jnp.abs(q))
        sane.append(jnp.all(jnp.abs(b - a) <= most + MAX_STATE_FRACTION * (jnp.abs(a) + jnp.abs(b))))
    return jnp.all(jnp.array(sane))


def _continue_search(
    carry: FixedStepCarry, here: FixedStepAttempt, fine: Scalar, kinks: int, h: Scalar, refines: bool
) -> tuple[EventSearch, PyTree, PyTree, PyTree]:
    """Return search, next length, unrestricted flag and status after an attempt that is not accepted."""
    tells = find_crossings(carry.search.which, kinks, here.kink, *_margins(carry, here))
    new = carry.status == RunStatus.RUNNING
    search, length, enough = bracket_event(carry.search, carry.length, new, tells, h)
    seeking = search, length, jnp.where(enough, RunStatus.PROBING, RunStatus.SEEKING)
    # A step ends sqrt(eps) steps beyond a switching surface, so that the comparison has surely changed there.
    beyond = jnp.where(carry.search.which < kinks, h * jnp.finfo(h.dtype).eps ** OVERSHOOT_EXPONENT, 0.0)
    landing = _land(carry, *locate_event(carry.search, carry.length, tells, beyond), refines)
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


def _land(
    carry: FixedStepCarry, search: EventSearch, length: Scalar, refines: bool
) -> tuple[EventSearch, PyTree, PyTree]:
    """Return the search, the next length and the status after a probe: a step that lands, or a further search."""
    length, again = accept_location(search, carry.length, length)
    return search, length, jnp.where(again, RunStatus.SEEKING, RunStatus.REFINING if refines else RunStatus.LANDING)


def find_crossings(
    which: Scalar, kinks: int, kink: SurfaceCrossing, before: list[PyTree], after: list[PyTree]
) -> AttemptCrossings:
    """Return the crossings of switching surfaces and events within an attempt; comparisons come first.

    Args:
        which: Number of the sought margin.
        kinks: Number of comparisons.
        kink: Contradicted comparisons at the end of the attempt.
        before: Margins of events at the beginning.
        after: Margins of events at the end.
    """
    events = find_event_crossings(which, kinks, before, after)
    unknown, bends = jnp.full_like(kink.margin, jnp.inf), kink.other >= 0
    at = [jnp.where(kink.chosen == one, kink.margin, jnp.inf) for one in (which, kink.other)]
    sought = select(which < kinks, EventCrossing(which, at[0], unknown), events.sought)
    other = select(bends, EventCrossing(kink.other, at[1], unknown), events.other)
    return AttemptCrossings(sought, kink.contradicted | events.falls, other, bends | events.another)


def _margins(carry: FixedStepCarry, here: FixedStepAttempt) -> tuple[list[PyTree], list[PyTree]]:
    """Return the margins at the beginning and at the end of the attempt."""
    return jax.tree.leaves(carry.point.margins), jax.tree.leaves(here.margins)


def _last(here: FixedStepAttempt, point: FixedStepPoint) -> FixedStepPoint:
    """Return the point at the end of a run, where no block changes any more."""
    return point._replace(state=here.state, accumulators=here.accumulators, sample=here.signals.sample)


def cast_floats(tree: PyTree, dtype: Any) -> PyTree:
    """Return the tree with strong types throughout, and its floating-point leaves cast to one type.

    Args:
        tree: Pytree to cast.
        dtype: Floating-point type.
    """

    # A scan rejects a carry whose type weakens or strengthens.
    def cast(x: Scalar) -> Any:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(x.dtype)

    return jax.tree.map(cast, tree)
