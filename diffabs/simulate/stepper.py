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

from diffabs.core.log import lend, settle, tables
from diffabs.core.loop import Loop, Margins
from diffabs.core.protocols import Clock
from diffabs.simulate.advance import Arrival, Kink, Point, Try, arrive, begin, depart
from diffabs.simulate.checkpoint import anyone, apart
from diffabs.simulate.condition import Condition, after_step, goes_on
from diffabs.simulate.dynamics import Objectives, dynamics
from diffabs.simulate.landing import (
    BEYOND,
    TRIES,
    Crossed,
    Crossings,
    Search,
    aimed,
    earliest,
    falls_through,
    init_search,
    land,
    refine,
    seek,
    select,
)

EXTRA, SPARE = 4, 64  # tries beyond a step of the grid for each of them, about an event; and besides
KINKS = 1  # tries for each step of the grid, up to now, that comparisons may take; then steps are blunt
MOST = 32  # tries within one step of the grid, likewise
FASTER, PART = 4, 1e-3  # times the rates at both ends of a step, and part of the state: the most that it may change


class Carry(NamedTuple):
    """A run on its way."""

    point: Point
    k: Any  # number of the last instant of the grid
    length: Any  # of the step to try [s]
    search: Search
    extra: Any  # tries that did not end on the grid
    here: Any  # those since its last instant
    blunt: Any  # whether steps are
    condition: Any

    running = property(goes_on)


class Verdict(NamedTuple):
    """What is made of a try: whether its numbers are finite, whether it is taken, whether it then ends on the grid;
    which events happen at its end, and whether the run is over there."""

    fine: Any
    taken: Any
    on_grid: Any
    fired: Margins
    over: Any


def room(loop: Loop, steps: int, *, kinks: bool = False) -> int:
    """Return how many tries a run of so many steps of the grid may take: what a scan must have room for. Of three tries
    about an event, at least, one is made twice: REFINING."""
    about = ((KINKS if kinks else 0) + (EXTRA if loop.eventful else 0)) * steps + SPARE
    return steps + SPARE + about + about // 3


def init_carry(loop: Loop, objectives: Objectives, h: Any, key: Any, *, kinks: bool = False) -> Carry:
    """Return the carry at t = 0."""
    zero = jnp.asarray(0)
    point = begin(loop, objectives, Clock(0.0 * h, h, zero, key), kinks=kinks)
    condition = jnp.where(point.margins["stop"][0] > 0, zero + Condition.RUNNING, zero + Condition.DIVERGED)
    return typed(Carry(point, zero, h, init_search(h), zero, zero, jnp.asarray(False), condition), h.dtype)


def step(
    loop: Loop,
    objectives: Objectives,
    h: Any,
    key: Any,
    steps: Any,
    carry: Carry,
    until: Any = None,
    *,
    kinks: bool = False,
    refines: bool = False,
) -> Carry:
    """Return the carry after one try of a step; the same if the run is over, or has come to instant `until`.

    kinks: whether comparisons are located, as derivatives need it
    refines: whether the moment of an event has second derivatives; its value is the same"""
    active = carry.running if until is None else carry.running & (carry.k < until)
    logs = tables(carry.point.state)
    carry = carry._replace(point=carry.point._replace(state=lend(carry.point.state, None)))
    to_grid, landing, anew = (
        carry.condition == one for one in (Condition.RUNNING, Condition.LANDING, Condition.REFRESHING)
    )
    system = dynamics(loop, objectives, carry.point.t, carry.point.state, carry.point.tally, kinks=kinks)
    count, which = system.kinks, carry.search.which
    end = jnp.where(to_grid, (carry.k + 1) * h, carry.point.t + carry.length)
    one = Try(carry.length, end, h, carry.blunt, anew, which, landing & (which < count))
    here = apart(active, lambda: arrive(system, carry.point, one, active))
    verdict = apart(active, lambda: _judge(carry, here, count, active, steps))
    k = carry.k + jnp.where(verdict.on_grid, 1, 0)
    leave = partial(depart, system, Clock(end, h, k, key, verdict.on_grid), here, verdict.fired, one, logs)
    point = apart(active, leave) if loop.changes else leave()
    point = select(verdict.over, _last(here, point), point)

    trying, plan = active & ~verdict.taken, (carry.search, carry.length, carry.blunt, carry.condition)

    def looked() -> Any:
        return select(trying, _look(carry, here, verdict.fine, count, h, refines), plan)

    search, *tried = jax.lax.cond(anyone(trying), looked, lambda: plan)
    length, blunt, condition = select(
        verdict.taken, _ahead(loop, carry, here, verdict, h, (k + 1) * h - end), tuple(tried)
    )
    counts = active & ~verdict.on_grid & (carry.condition != Condition.REFINING)
    extra = carry.extra + jnp.where(counts, 1, 0)
    since = jnp.where(verdict.on_grid, 0, carry.here + extra - carry.extra)
    lost = active & ((~verdict.fine & (carry.blunt if count else True)) | (extra > (EXTRA + KINKS) * steps + SPARE))
    condition = jnp.where(lost, Condition.DIVERGED, condition).astype(carry.condition.dtype)
    point = select(verdict.taken, point, carry.point)
    point = point._replace(state=settle(point.state, logs))
    return Carry(point, k, length, search, extra, since, blunt, condition)


def _ahead(loop: Loop, carry: Carry, here: Arrival, verdict: Verdict, h: Any, left: Any) -> tuple[Any, ...]:
    """What a try that is taken leaves: next length, whether steps are blunt, and the condition; `left` to the grid."""
    ended = after_step(loop, carry, here.margins, verdict)
    left = jnp.where(ended == Condition.REFRESHING, 0.0, jnp.where(verdict.on_grid, h, left))
    same = [a == b for a, b in zip(here.regime, carry.point.regime, strict=True)]
    calm = verdict.on_grid & jnp.all(jnp.array(same))
    return left, carry.blunt & ~calm, ended


def _judge(carry: Carry, here: Arrival, kinks: int, active: Any, steps: Any) -> Verdict:
    to_grid, landing = carry.condition == Condition.RUNNING, carry.condition == Condition.LANDING
    fine = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(here.state.flow())]))
    crossed = falls_through(*_margins(carry, here))
    fine &= carry.blunt | _plausible(carry, here) if kinks else True
    changes = jnp.any(jnp.stack([*crossed, here.kink.crossed, here.kink.other >= 0]))
    taken = active & fine & (landing | (carry.condition == Condition.REFRESHING) | (to_grid & ~changes))
    on_grid = taken & to_grid
    fired = [landing & ((carry.search.which == kinks + i) | one) for i, one in enumerate(crossed)]
    fired = jax.tree.unflatten(jax.tree.structure(here.margins), fired)
    over = fired["stop"][0] | (on_grid & (carry.k + 1 >= steps))
    return Verdict(fine, taken, on_grid, fired, over)


def _plausible(carry: Carry, here: Arrival) -> Any:
    """Whether the state has changed as the rates at both ends say, roughly. Within a regime, beyond its kinks, a flow
    need not be bounded as that of the loop is, and where a step is too long for stability that is where it leads."""
    ends = [jax.tree.leaves(point.state.flow()) for point in (carry.point, here)]
    rates = [jax.tree.leaves(point.rate[0]) for point in (carry.point, here)]
    sane = []
    for a, b, p, q in zip(*ends, *rates, strict=True):
        most = FASTER * jnp.abs(carry.length) * jnp.maximum(jnp.abs(p), jnp.abs(q))
        sane.append(jnp.all(jnp.abs(b - a) <= most + PART * (jnp.abs(a) + jnp.abs(b))))
    return jnp.all(jnp.array(sane))


def _look(carry: Carry, here: Arrival, fine: Any, kinks: int, h: Any, refines: bool) -> tuple[Search, Any, Any, Any]:
    """What a try that is not taken tells: the search, the next length, and how that is tried."""
    tells = crossings(carry.search.which, kinks, here.kink, *_margins(carry, here))
    new = carry.condition == Condition.RUNNING
    search, length, enough = seek(carry.search, carry.length, new, tells, h)
    seeking = search, length, jnp.where(enough, Condition.PROBING, Condition.SEEKING)
    beyond = jnp.where(carry.search.which < kinks, h * jnp.finfo(h.dtype).eps ** BEYOND, 0.0)
    landing = _landing(carry, *land(carry.search, carry.length, tells, beyond), refines)
    search, length, condition = select(carry.condition == Condition.PROBING, landing, seeking)
    if refines:
        refined = carry.search, refine(carry.search, carry.length, tells), condition * 0 + Condition.LANDING
        search, length, condition = select(carry.condition == Condition.REFINING, refined, (search, length, condition))
    tired = (search.tries >= TRIES) | (carry.here >= MOST) | (carry.extra > KINKS * carry.k + SPARE)
    blunt = carry.blunt | ~fine | (tired & (search.which < kinks))
    begins = blunt & ~carry.blunt
    length = jnp.where(begins, (carry.k + 1) * h - carry.point.t, length)
    condition = jnp.where(begins, Condition.RUNNING, condition)
    return search, length, blunt, condition.astype(carry.condition.dtype)


def _landing(carry: Carry, search: Search, length: Any, refines: bool) -> tuple[Search, Any, Any]:
    """A step of this length, or a search that goes on: the condition last."""
    length, again = aimed(search, carry.length, length)
    return search, length, jnp.where(again, Condition.SEEKING, Condition.REFINING if refines else Condition.LANDING)


def crossings(which: Any, kinks: int, kink: Kink, before: list[Any], after: list[Any]) -> Crossings:
    """Return what a try tells of the comparisons, first, and of the margins of the events at its ends."""
    events = earliest(which, kinks, before, after)
    unknown, bends = jnp.full_like(kink.margin, jnp.inf), kink.other >= 0
    at = [jnp.where(kink.chosen == one, kink.margin, jnp.inf) for one in (which, kink.other)]
    sought = select(which < kinks, Crossed(which, at[0], unknown), events.sought)
    other = select(bends, Crossed(kink.other, at[1], unknown), events.other)
    return Crossings(sought, kink.crossed | events.falls, other, bends | events.another)


def _margins(carry: Carry, here: Arrival) -> tuple[list[Any], list[Any]]:
    """At the beginning and at the end of the try."""
    return jax.tree.leaves(carry.point.margins), jax.tree.leaves(here.margins)


def _last(here: Arrival, point: Point) -> Point:
    """The end of a run, where nothing changes any more."""
    return point._replace(state=here.state, tally=here.tally, sample=here.signals.sample)


def typed(tree: Any, dtype: Any) -> Any:
    """Strong types throughout: a scan refuses a carry whose type weakens or strengthens."""

    def typed(x: Any) -> Any:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(x.dtype)

    return jax.tree.map(typed, tree)
