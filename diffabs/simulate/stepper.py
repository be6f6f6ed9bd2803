"""Which steps a run takes: those of the grid, cut where an event lies between.

A step within which a margin falls through zero (the stop's, a block's) is tried again, shorter, until one ends on the
zero (`landing`). So the run is a discretisation of the exact solution on both sides of the event, and nothing is
corrected afterwards. The next step goes on to the grid.

    RUNNING  --a margin falls through zero-->  SEEKING  -->  PROBING  -->  LANDING  -->  RUNNING, or STOPPED"""

import enum
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.loop import Loop, Margins
from diffabs.core.protocols import Clock
from diffabs.simulate.advance import Arrival, Objectives, Point, arrive, begin, depart
from diffabs.simulate.checkpoint import anyone
from diffabs.simulate.landing import Search, falls_through, init_search, land, seek, select

EXTRA, SPARE = 4, 64  # tries beyond a step of the grid for each of them, about an event; and besides
MISSED = 0.1  # of the change of the stop's margin in the step: the most that may be left of it


class Condition(enum.IntEnum):
    """How a run is: it goes on along the grid, or looks for an event, or for how its margin falls, or is to land on
    it; or it is over."""

    RUNNING, SEEKING, PROBING, LANDING, STOPPED, TIMED_OUT, DIVERGED = range(7)


class Carry(NamedTuple):
    """A run on its way."""

    point: Point
    k: Any  # number of the last instant of the grid
    length: Any  # of the step to try [s]
    search: Search
    extra: Any  # tries that did not end on the grid
    condition: Any

    @property
    def running(self) -> Any:
        """Whether another step is to be made or tried."""
        return self.condition <= Condition.LANDING

    @property
    def stopped(self) -> Any:
        """Whether the stop was reached."""
        return self.condition == Condition.STOPPED


class Verdict(NamedTuple):
    """What is made of a try: whether its numbers are finite, whether it is taken, whether it then ends on the grid;
    which events happen at its end, and whether the run is over there."""

    fine: Any
    taken: Any
    on_grid: Any
    fired: Margins
    over: Any


def room(loop: Loop, steps: int) -> int:
    """Return how many tries a run of so many steps of the grid may take: what a scan must have room for."""
    return ((1 + EXTRA) * steps if loop.eventful else steps) + SPARE


def init_carry(loop: Loop, objectives: Objectives, h: Any, key: Any) -> Carry:
    """Return the carry at t = 0."""
    zero = jnp.asarray(0)
    point = begin(loop, objectives, Clock(0.0 * h, h, zero, key))
    condition = jnp.where(point.margins["stop"][0] > 0, zero + Condition.RUNNING, zero + Condition.DIVERGED)
    return _typed(Carry(point, zero, h, init_search(h), zero, condition), h.dtype)


def step(loop: Loop, objectives: Objectives, h: Any, key: Any, steps: Any, carry: Carry, until: Any = None) -> Carry:
    """Return the carry after one try of a step; the same if the run is over, or has come to instant `until`."""
    active = carry.running if until is None else carry.running & (carry.k < until)
    to_grid = carry.condition == Condition.RUNNING
    end = jnp.where(to_grid, (carry.k + 1) * h, carry.point.t + carry.length)
    here = _apart(active, lambda: arrive(loop, objectives, carry.point, carry.length, end, h))
    verdict = _apart(active, lambda: _judge(carry, here, active, steps))
    k = carry.k + jnp.where(verdict.on_grid, 1, 0)
    leave = partial(depart, loop, objectives, Clock(end, h, k, key, verdict.on_grid), here, verdict.fired)
    point = _apart(active, leave) if loop.changes else leave()
    point = select(verdict.over, _last(here, point), point)

    trying, plan = active & ~verdict.taken, (carry.search, carry.length, carry.condition)
    found = jax.lax.cond(anyone(trying), lambda: _look(carry, here, h), lambda: plan)
    ahead = (carry.search, jnp.where(verdict.on_grid, h, (k + 1) * h - end), _ended(carry, here, verdict))
    search, length, condition = select(active, select(trying, found, ahead), plan)
    extra = carry.extra + jnp.where(active & ~verdict.on_grid, 1, 0)
    lost = active & ~(verdict.fine & (extra <= EXTRA * steps + SPARE))
    condition = jnp.where(lost, Condition.DIVERGED, condition).astype(carry.condition.dtype)
    return Carry(select(verdict.taken, point, carry.point), k, length, search, extra, condition)


def _apart(active: Any, work: Callable[[], Any]) -> Any:
    """work(), compiled by itself and not once more into everything that is made of it; zeros where no lane runs."""
    work = jax.jit(work)  # traced once for its shape and for its program
    shape = jax.eval_shape(work)
    return jax.lax.cond(anyone(active), work, lambda: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape))


def _judge(carry: Carry, here: Arrival, active: Any, steps: Any) -> Verdict:
    to_grid, landing = carry.condition == Condition.RUNNING, carry.condition == Condition.LANDING
    fine = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(here.state.flow())]))
    crossed = falls_through(*_margins(carry, here))
    taken = active & fine & (landing | (to_grid & ~jnp.any(jnp.stack(crossed))))
    on_grid = taken & to_grid
    fired = [landing & ((carry.search.which == i) | one) for i, one in enumerate(crossed)]
    fired = jax.tree.unflatten(jax.tree.structure(here.margins), fired)
    over = fired["stop"][0] | (on_grid & (carry.k + 1 >= steps))
    return Verdict(fine, taken, on_grid, fired, over)


def _look(carry: Carry, here: Arrival, h: Any) -> tuple[Search, Any, Any]:
    """What a try that is not taken tells: the search, the next length, and how that is tried."""
    margins, new = _margins(carry, here), carry.condition == Condition.RUNNING
    search, length, enough = seek(carry.search, carry.length, new, *margins, h)
    seeking = search, length, jnp.where(enough, Condition.PROBING, Condition.SEEKING)
    landing = carry.search, land(carry.search, carry.length, *margins), jnp.asarray(Condition.LANDING)
    search, length, condition = select(carry.condition == Condition.PROBING, landing, seeking)
    return search, length, condition.astype(carry.condition.dtype)


def _margins(carry: Carry, here: Arrival) -> tuple[list[Any], list[Any]]:
    """At the beginning and at the end of the try."""
    return jax.tree.leaves(carry.point.margins), jax.tree.leaves(here.margins)


def _ended(carry: Carry, here: Arrival, verdict: Verdict) -> Any:
    """The condition after a step that is taken. A landing that does not come to rest on the stop is none."""
    left, scale = jnp.abs(here.margins["stop"][0]), carry.point.margins["stop"][0] + jnp.abs(carry.search.at_full)
    landed = jnp.where(left <= MISSED * scale, Condition.STOPPED, Condition.DIVERGED)
    return jnp.where(verdict.fired["stop"][0], landed, jnp.where(verdict.over, Condition.TIMED_OUT, Condition.RUNNING))


def _last(here: Arrival, point: Point) -> Point:
    """The end of a run, where nothing changes any more."""
    return point._replace(state=here.state, tally=here.tally, sample=here.signals.sample)


def _typed(tree: Any, dtype: Any) -> Any:
    """Strong types throughout: a scan refuses a carry whose type weakens or strengthens."""

    def typed(x: Any) -> Any:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(x.dtype)

    return jax.tree.map(typed, tree)
