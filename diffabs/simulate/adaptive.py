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
from diffabs.core.log import lend, tables, written
from diffabs.core.loop import Loop, LoopState, Margins
from diffabs.core.protocols import Clock, Memory, Segment, Shown
from diffabs.core.regime import Answers, Regime, crossing
from diffabs.simulate.advance import Kink, after_changes, at_end, start
from diffabs.simulate.checkpoint import anyone, apart
from diffabs.simulate.condition import Condition, after_step
from diffabs.simulate.dynamics import FREE, Ahead, Dynamics, Objectives, Tally, dynamics, parted
from diffabs.simulate.foresight import kinks, within_step
from diffabs.simulate.landing import (
    BEYOND,
    TRIES,
    Search,
    aimed,
    earliest,
    falls_through,
    init_search,
    land,
    seek,
    select,
)
from diffabs.simulate.lengths import FIRST, SHRINK, Pace, allowed, error, longest_stable, planned, sizes
from diffabs.simulate.span import Span
from diffabs.simulate.stepper import crossings, typed
from diffabs.simulate.tries import Arrival, Carry, Point, Verdict
from diffabs.simulate.tsit5 import off_in_the_middle, tsit5_pair

MOST, EACH = 100_000, 16  # tries of a run, and for each instant of its grid: more of them lead nowhere
CALM = 0.1  # of the length that the error allows: a step so long that ends on no comparison is none in such a row
# For derivatives: the first step after an event or a comparison that changes, as a part of the longest stable one, and
# how much longer each of the next may be. An event excites the fastest modes of the derivative far more than the run's.
EASED, EASIER = 1 / 16, 1.6
TURNS = 16  # steps in a row that end on comparisons; then steps are blunt
OVER = 1.5  # times the way to where a comparison is predicted to change: a step that keeps to its regime
COUNTED = ("tries", "condition")  # what is still looked at when a run is over


def init_carry(loop: Loop, objectives: Objectives, pace: Pace, key: Any) -> Carry:
    """Return the carry at t = 0."""
    zero, none = jnp.asarray(0), 0.0 * pace.h
    state, tally = start(loop, objectives, Clock(none, pace.h, zero, key))
    state, logs = lend(state, None), tables(state)
    natural = jnp.minimum(FIRST, pace.h * pace.steps) + none
    system = dynamics(loop, objectives, none, state, tally, kinks=True)
    point = _point(system, pace, none, state, tally, natural, FREE)
    scale = sizes(state, point.sample)
    condition = jnp.where(point.margins["stop"][0] > 0, zero + Condition.RUNNING, zero + Condition.DIVERGED)
    limit = longest_stable(loop, none, state, scale)
    left = pace.strike(loop, zero) * pace.h
    length, ends = planned(jnp.minimum(natural, limit), point.ahead, left, pace)
    search = init_search(pace.h)
    past = Span(point.t, state, point.rate[0], point.t, state.flow(), point.rate[0]) if pace.keeps else ()
    lengths = (natural, length, ends, limit, scale, length)
    point = point._replace(state=lend(state, logs))
    return typed(
        Carry(
            point, zero, none, *lengths, search, zero, zero, past, zero, 1.0 + none, jnp.asarray(False), zero, condition
        ),
        pace.h.dtype,
    )


def step(loop: Loop, objectives: Objectives, pace: Pace, key: Any, carry: Carry, until: Any = None) -> Carry:
    """Return the carry after one try of a step; the same if the run is over, or has come to instant `until`."""
    active = carry.running if until is None else before(pace, carry, until)
    logs = written(carry.point.state)
    carry = carry._replace(point=carry.point._replace(state=lend(carry.point.state, None)))
    system = dynamics(loop, objectives, carry.point.t, carry.point.state, carry.point.tally, kinks=True)
    strike = pace.strike(loop, carry.k)
    end = jnp.where(carry.ends, strike * pace.h, carry.point.t + carry.length)
    anew = carry.condition == Condition.REFRESHING
    count, which = (system.kinks if pace.notes else 0), carry.search.which
    lands = (carry.condition == Condition.LANDING) & (which < count)
    here = apart(active, lambda: arrive(system, carry, end, anew, lands, pace))
    verdict = apart(active, lambda: _judge(carry, here, count, active, strike >= pace.steps, pace))
    strikes = verdict.taken & carry.ends
    k = jnp.where(strikes, strike, carry.k)
    clock = Clock(end, pace.h, k, key, strikes)
    regime = after_changes(system, here.point.words, which, lands) if count else FREE
    point = depart(system, pace, clock, carry.point, here, verdict.fired, carry.natural, logs, regime)
    point = select(verdict.over, here.point, point)

    since = jnp.where(strikes, 0.0, jnp.where(verdict.taken, carry.since + carry.length, carry.since))
    carry = carry._replace(k=k, since=since)
    after = _after(loop, pace, carry, here, verdict, select(verdict.taken, point, carry.point), count)
    if until is None:  # of a run that is over, the rest does not matter
        kept = {name: jnp.where(active, getattr(after, name), getattr(carry, name)) for name in COUNTED}
        after = after._replace(**kept)
    else:
        after = select(active, after, carry)
    return after._replace(point=after.point._replace(state=lend(after.point.state, logs)))


def _after(loop: Loop, pace: Pace, carry: Carry, here: Arrival, verdict: Verdict, point: Point, count: int) -> Carry:
    """The carry after a try, which has led to this point, or is to be tried again from there."""
    trying, new = ~verdict.taken, carry.condition == Condition.RUNNING
    natural = _natural(carry, here, verdict, pace)
    left = (pace.strike(loop, carry.k) - carry.k) * pace.h - carry.since
    eased = carry.eased
    if pace.notes:
        quiet = carry.condition == Condition.RUNNING
        eased = jnp.where(verdict.taken, jnp.where(quiet, jnp.minimum(EASIER * eased, 1.0), EASED), eased)
    longest = jnp.minimum(natural, eased * carry.limit)
    length, ends = planned(longest, point.ahead, left, pace)
    late = trying & (here.late > 0) & verdict.fine
    length = jnp.where(late, jnp.maximum(carry.length - here.late, pace.least), length)
    condition = jnp.where(verdict.taken, after_step(loop, carry, here.point.margins, verdict), carry.condition)
    refreshes = condition == Condition.REFRESHING
    length = jnp.where(refreshes, 0.0, length)
    looking = trying & verdict.seeks
    plan = (carry.search, length, condition)
    found = jax.lax.cond(anyone(looking), lambda: _look(carry, here, count), lambda: plan)
    search, length, condition = select(looking, found, plan)
    turns, blunt = carry.turns, carry.blunt
    if count:
        on_comparison = (carry.condition == Condition.LANDING) & (carry.search.which < count)
        calm = verdict.taken & new & (carry.length > CALM * carry.natural)
        turns = jnp.where(verdict.taken & on_comparison, turns + 1, jnp.where(calm, 0, turns))
        tired = looking & (search.tries >= TRIES) & (search.which < count)
        same = jnp.all(jnp.stack([a == b for a, b in zip(here.point.words, carry.point.words, strict=True)]))
        begins = (tired | (verdict.taken & (turns > TURNS))) & ~blunt
        blunt = (blunt | begins) & ~(calm & same)
        looking &= ~(begins & tired)
        length = jnp.where(begins & tired, longest, length)
        condition = jnp.where(begins & tired, Condition.RUNNING, condition).astype(condition.dtype)
    lost = (~verdict.fine & (carry.length <= pace.least)) | (carry.tries > MOST + EACH * pace.steps)
    last = Span(*(carry.point.t, carry.point.state, carry.point.rate[0]), *_end(here.point))
    return carry._replace(
        point=point,
        natural=natural,
        length=length,
        ends=ends & ~looking & ~late & ~refreshes,
        scale=select(verdict.taken, here.scale, carry.scale),
        base=jnp.where(looking & new, carry.length, carry.base),
        search=search,
        tries=carry.tries + 1,
        past=select(verdict.taken, last, carry.past) if pace.keeps else (),
        turns=turns,
        eased=eased,
        blunt=blunt,
        fired=packed(verdict.fired),
        condition=jnp.where(lost, Condition.DIVERGED, condition).astype(carry.condition.dtype),
    )


def arrive(system: Dynamics, carry: Carry, end: Any, anew: Any, lands: Any, pace: Pace) -> Arrival:
    """Return what a try leads to. For derivatives it keeps to its regime, unless it is blunt.

    lands: whether it ends where the comparison changes that is looked for"""
    loop, point, h = system.loop, carry.point, carry.length
    z, held = parted(point.state, point.tally)
    within, at = FREE, FREE
    if pace.notes:
        within = Regime(point.words, carry.blunt)
        at = at_end(system, point.words, carry.search.which, lands, carry.blunt | anew)

    def flow(t: Any, z: Any) -> Any:
        return system.rates(t, z, held, within)

    z, so_far = tsit5_pair(flow, point.t, z, point.rate, h)
    state = point.state.with_flow(z[0])
    rests = state._replace(plant=loop.plant.project(state.plant))
    state = select(carry.blunt, rests, state) if pace.notes else rests
    tallied = {name: memory._replace(flow=z[1][name]) for name, memory in point.tally.items()}
    found = system.ahead(end, state, tallied, at)
    seen, moving, recording, _, words, _, comparisons = found
    sample, recorded = seen.signals.sample, (seen.signals.recorded, recording)
    changed = tuple(a ^ b for a, b in zip(words, point.words, strict=True))
    segment = Segment(
        point.sample,
        sample,
        h,
        pace.h,
        lambda: (Shown.of(point.moving), Shown.of(moving)),
        lambda: (point.moving, moving),
        smooth=True,
        within=within_step(comparisons, changed, h),
    )
    tally = {name: Memory(z[1][name], o.update(tallied[name], segment)) for name, o in system.objectives.items()}
    if loop.changes and not loop.ticks:
        tally = select(anew, point.tally, tally)
    ahead, late = kinks(comparisons, carry.natural, pace.least, changed, h)
    ahead = jnp.where(carry.blunt, 1.0, OVER) * ahead if pace.notes else ahead
    new = Point(end, rests, tally, sample, moving, recorded, seen[:2], seen.margins, words, ahead)
    scale = jax.tree.map(jnp.maximum, carry.scale, sizes(state, sample))
    off = off_in_the_middle(so_far[0], seen.rate, h)
    off = error(loop, state, off, scale, sample) / pace.rtol
    kink = _kink(found, carry.search.which, h) if pace.notes else ()
    return Arrival(new, seen.signals, off, scale, late, kink)


def _kink(found: Ahead, which: Any, h: Any) -> Kink:
    """The comparisons that say something else at the end of a step than in it."""
    margins = [(one.numbers, one.value) for one in found.comparisons]
    return Kink(*crossing(Answers(found.words, found.crossed, margins), which, h))


def depart(
    system: Dynamics,
    pace: Pace,
    clock: Clock,
    begun: Point,
    here: Arrival,
    fired: Margins,
    natural: Any,
    logs: list[Any],
    regime: Regime,
) -> Point:
    """Return the point from which a run goes on, after the events that have `fired` and the ticks of the clock. In a
    loop without ticks, what follows from an event is left to a step of no length: there are few of them.

    logs: the rows of the blocks' logs, which the state is without (`core.log`); regime: that after the ticks"""
    loop, point = system.loop, here.point
    if not loop.changes:
        return point
    lent, step = lend(point.state, logs), passed(begun, point)
    state = lend(loop.change(clock, lent, here.signals, point.margins, fired, step), None)
    if not loop.ticks:
        return point._replace(state=state)
    return _point(system, pace, point.t, state, point.tally, natural, regime)


def passed(start: Any, end: Any) -> dict[str, Passage]:
    """Return the step between two points for the blocks that record it."""
    (values, rates), (last, falls) = start.recorded, end.recorded
    return {n: Passage(start.t, end.t, (values[n], last[n]), (rates[n], falls[n])) for n in values}


def before(pace: Pace, carry: Carry, instant: Any) -> Any:
    """Return whether a run goes on, and has not come to this instant of the grid."""
    return carry.running & (carry.point.t < instant * pace.h)


def _end(point: Point) -> Any:
    """Of a span, before what changes there."""
    return point.t, point.state.flow(), point.rate[0]


def _point(system: Dynamics, pace: Pace, t: Any, state: LoopState, tally: Tally, length: Any, regime: Regime) -> Point:
    seen, moving, recording, _, words, _, comparisons = system.ahead(t, state, tally, regime)
    recorded = (seen.signals.recorded, recording)
    ahead, _ = kinks(comparisons, length, pace.least, words, 0.0 * length)
    ahead = OVER * ahead if pace.notes else ahead
    return Point(t, state, tally, seen.signals.sample, moving, recorded, seen[:2], seen.margins, words, ahead)


def _judge(carry: Carry, here: Arrival, count: int, active: Any, last: Any, pace: Pace) -> Verdict:
    running, landing = carry.condition == Condition.RUNNING, carry.condition == Condition.LANDING
    anew = carry.condition == Condition.REFRESHING
    fine = jnp.isfinite(here.error)  # the greatest of those of all states
    short = carry.length <= pace.least
    exact = fine & (((here.error <= 1) & (here.late <= 0)) | short)
    crossed = falls_through(*_margins(carry, here))
    crosses = jnp.any(jnp.stack(crossed + ([here.kink.crossed, here.kink.other >= 0] if count else [])))
    taken = active & fine & (landing | anew | (running & exact & ~crosses))
    seeks = ~landing & ~anew & (~running | (exact & crosses))
    fired = [taken & landing & ((carry.search.which == count + i) | one) for i, one in enumerate(crossed)]
    fired = jax.tree.unflatten(jax.tree.structure(here.point.margins), fired)
    over = fired["stop"][0] | (taken & carry.ends & last)
    return Verdict(fine, taken, seeks, fired, over)


def packed(fired: Margins) -> Any:
    """Return a bit for each event."""
    return sum((jnp.where(one, 1 << i, 0) for i, one in enumerate(jax.tree.leaves(fired))), jnp.asarray(0))


def _natural(carry: Carry, here: Arrival, verdict: Verdict, pace: Pace) -> Any:
    """The length that the error allows. A step that was cut short says nothing against it, nor does one with a kink."""
    longer = jnp.where(verdict.fine, allowed(carry.length, here.error), SHRINK * carry.length)
    cut = verdict.taken & (carry.length < carry.natural)
    wrong = ~verdict.fine | ((here.error > 1) & (here.late <= 0))
    judged = (carry.condition == Condition.RUNNING) & (verdict.taken | wrong)
    natural = jnp.where(judged, jnp.where(cut, jnp.maximum(longer, carry.natural), longer), carry.natural)
    return jnp.maximum(natural, pace.least)


def _look(carry: Carry, here: Arrival, count: int) -> tuple[Search, Any, Any]:
    """What a try that is not taken tells about an event, or a comparison: the search, the next length, and how that is
    tried."""
    new = carry.condition == Condition.RUNNING
    base = jnp.where(new, carry.length, carry.base)
    which, ends = carry.search.which, _margins(carry, here)
    tells = crossings(which, count, here.kink, *ends) if count else earliest(which, 0, *ends)
    beyond = jnp.where(which < count, base * jnp.finfo(base.dtype).eps ** BEYOND, 0.0)
    search, length, enough = seek(carry.search, carry.length, new, tells, base)
    seeking = search, length, jnp.where(enough, Condition.PROBING, Condition.SEEKING)
    found, end = land(carry.search, carry.length, tells, beyond)
    end, again = aimed(found, carry.length, end)
    landing = found, end, jnp.where(again, Condition.SEEKING, Condition.LANDING)
    search, length, condition = select(carry.condition == Condition.PROBING, landing, seeking)
    return search, length, condition.astype(carry.condition.dtype)


def _margins(carry: Carry, here: Arrival) -> tuple[list[Any], list[Any]]:
    """At the beginning and at the end of the try."""
    return jax.tree.leaves(carry.point.margins), jax.tree.leaves(here.point.margins)
