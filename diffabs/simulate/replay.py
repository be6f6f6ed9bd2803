"""Derivatives of a run with adaptive steps: the run is made once for its values and noted, and its steps are repeated.

    noted      of each step: when it ends, its regime, the comparison, the events and the instant of a clock at its end
    repeated   the same steps within the same regimes, which are smooth; a step at whose end a comparison changes, or an
               event happens, ends where the margin g of that is zero, by Newton's step -g/(dg/dt) from the noted end,
               whose derivative is that of the moment by the implicit function theorem

So the derivative is that of the run whose steps end at these times, and on its kinks and events; the lengths of the
others do not depend on anything."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.blocks import Passage
from diffabs.core.log import lend, tables, written
from diffabs.core.loop import Loop, LoopState, Margins
from diffabs.core.numerics import axpy
from diffabs.core.protocols import Clock, Memory, Segment, Shown
from diffabs.core.regime import Regime, Words
from diffabs.simulate.adaptive import passed
from diffabs.simulate.advance import start
from diffabs.simulate.checkpoint import anyone, forgetful
from diffabs.simulate.condition import Condition, goes_on
from diffabs.simulate.drivers import BLOCK
from diffabs.simulate.dynamics import Ahead, Dynamics, Objectives, Tally, dynamics, parted
from diffabs.simulate.landing import select
from diffabs.simulate.methods import AtPace
from diffabs.simulate.outcome import observe
from diffabs.simulate.solution import ORDER, Adaptive, Trajectory
from diffabs.simulate.span import Span
from diffabs.simulate.stepper import typed
from diffabs.simulate.tries import Carry
from diffabs.simulate.tsit5 import tsit5_step_from

MOST, TICKED = 4096, 2  # tries that can be noted at an error of 1e-5, and for each instant of a grid with clocks
NEAR = 1e-3  # of the try in which it was seen: no event or comparison at the end of a step is so far from its zero


class Notes(NamedTuple):
    """Of every try, in blocks (blocks, BLOCK, ...): whether it led on; the time at its end and its length; the length
    of the first try from there; the number of the instant of the grid at which a clock has struck last; a bit for each
    event at its end; its regime, and whether that did not count; the number of the comparison that changes at its end,
    or -1."""

    moved: Any
    t: Any
    length: Any
    base: Any
    k: Any
    fired: Any
    words: Words
    blunt: Any
    lands: Any


class Place(NamedTuple):
    """A run on its way: time, how much later that is than its noted one, state, accumulators, and the number of the
    clock's last instant."""

    t: Any
    late: Any
    state: LoopState
    tally: Tally
    k: Any


class Recorded(NamedTuple):
    """What blocks record at an instant, and its rates."""

    t: Any
    recorded: tuple[dict[str, Any], dict[str, Any]]


class Repeated(NamedTuple):
    """A run that is over, as a judge sees it."""

    point: Place
    condition: Any

    running = property(goes_on)  # never


def room(loop: Loop, solver: Adaptive) -> int:
    """Return for how many tries there is room in the notes of a run."""
    return math.ceil(MOST * max(1.0, 1e-5 / solver.rtol) ** (1 / ORDER)) + (TICKED * solver.steps if loop.ticks else 0)


def noted(old: Carry, new: Carry) -> Notes:
    """Return the notes of one try, between these carries."""
    moved = (new.point.t > old.point.t) | (new.fired != 0)
    landed = (old.condition == Condition.LANDING) & (new.fired == 0)
    lands = jnp.where(landed, old.search.which, -1)
    return Notes(moved, new.point.t, old.length, old.base, new.k, new.fired, old.point.words, old.blunt, lands)


def note(loop: Loop, objectives: Objectives, pace: AtPace, key: Any, tries: int) -> tuple[Notes, Any]:
    """Return the notes of a run, with room for so many tries, and how it ended: it has diverged if it took more."""

    def one(carry: Carry, _: Any) -> tuple[Carry, Notes]:
        new = pace.step(loop, objectives, key, carry)
        return new, noted(carry, new)

    def some(carry: Carry) -> tuple[Carry, Notes]:
        return jax.lax.scan(one, pace.renew(loop, carry), length=BLOCK)

    carry = pace.start(loop, objectives, key)
    carry, notes = _skipping(some, lambda carry, _: carry.running, carry, None, -(-tries // BLOCK))

    notes = jax.tree.map(jax.lax.stop_gradient, notes)
    return notes, jnp.where(carry.running, Condition.DIVERGED, carry.condition)


def _skipping(work: Any, on: Any, carry: Any, xs: Any, length: int | None = None, reverse: bool = False) -> Any:
    """A scan of work(carry) or, with xs, work(carry, x), which is skipped where no lane of a batch is on(carry, x):
    it leaves zeros there."""

    def body(carry: Any, x: Any) -> tuple[Any, Any]:
        def run() -> tuple[Any, Any]:
            return work(carry) if x is None else work(carry, x)

        def skip() -> tuple[Any, Any]:
            return carry, jax.tree.map(lambda y: jnp.zeros(y.shape, y.dtype), jax.eval_shape(run)[1])

        return jax.lax.cond(anyone(on(carry, x)), run, skip)

    return jax.lax.scan(body, carry, xs, length=length, reverse=reverse)


def repeat(loop: Loop, objectives: Objectives, pace: AtPace, key: Any, notes: Notes, condition: Any) -> Repeated:
    """Return the run of these notes once more, which can be differentiated in every leaf of loop and objectives."""
    return Repeated(_repeated(loop, objectives, pace, key, notes)[0], condition)


def repeat_and_watch(
    loop: Loop, objectives: Objectives, pace: AtPace, key: Any, notes: Notes, condition: Any, instants: Any
) -> tuple[Repeated, Trajectory, Trajectory]:
    """Return the same run, what is seen at its beginning, and what at these instants (n,) of the grid: by the cubics of
    its steps."""
    last, spans = _repeated(loop, objectives, pace, key, notes)
    # What was skipped is zero, and comes after the end.
    starts = jnp.where(jnp.any(notes.moved, axis=1)[:, None], jax.lax.stop_gradient(spans.t), jnp.inf)
    spans = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), spans)

    def seen(instant: Any) -> Trajectory:
        t = instant * pace.h
        place = jnp.searchsorted(starts.ravel(), t, side="right") - 1
        span = jax.tree.map(lambda x: x[place], spans)
        return observe(loop, t, span.at(t), t < jax.lax.stop_gradient(last.t))

    first = observe(loop, 0.0 * pace.h, jax.tree.map(lambda x: x[0], spans.state), jnp.asarray(True))
    return Repeated(last, condition), first, jax.vmap(seen)(instants)


def _repeated(loop: Loop, objectives: Objectives, pace: AtPace, key: Any, notes: Notes) -> tuple[Place, Any]:
    """The end of the run, and the `Span` of every try, where they are kept."""
    begun = place_at_start(loop, objectives, pace, key)

    def step(place: Place, one: Notes) -> tuple[Place, Any]:
        return repeat_try(loop, objectives, pace, key, place, one)

    @forgetful
    def block(place: Place, some: Notes) -> tuple[Place, Any]:
        return jax.lax.scan(forgetful(step), place, some)

    return _skipping(block, lambda _, some: jnp.any(some.moved), begun, notes)


def place_at_start(loop: Loop, objectives: Objectives, pace: AtPace, key: Any) -> Place:
    """Return where a run begins."""
    zero = 0.0 * pace.h
    state, tally = start(loop, objectives, Clock(zero, pace.h, 0, key))
    return typed(Place(zero, zero, lend(state, tables(state)), tally, jnp.asarray(0)), pace.h.dtype)


def repeat_try(
    loop: Loop, objectives: Objectives, pace: AtPace, key: Any, place: Place, one: Notes
) -> tuple[Place, Any]:
    """Return where a try leads, if it led on; its `Span`, where they are kept."""
    logs, place = written(place.state), place._replace(state=lend(place.state, None))
    new, span = _step(loop, objectives, pace, key, place, one, logs)
    place = select(one.moved, new, place)
    return place._replace(state=lend(place.state, logs)), span


def _step(
    loop: Loop, objectives: Objectives, pace: AtPace, key: Any, place: Place, one: Notes, logs: list[Any]
) -> tuple[Place, Any]:
    """One step within its regime, and what happens at its end; its `Span`, where they are kept. The rows of the logs,
    which the state is without."""
    system = dynamics(loop, objectives, place.t, place.state, place.tally, kinks=True)
    within, h = Regime(one.words, one.blunt), one.length - place.late
    begin = system.ahead(place.t, place.state, place.tally, within)
    z, held = parted(place.state, place.tally)

    def flow(t: Any, z: Any, given: tuple[Any, Regime]) -> Any:
        return system.rates(t, z, *given)

    z = tsit5_step_from(flow, place.t, z, begin.seen[:2], h, (held, within))
    noted_end = system.ahead(one.t, *_with_flow(place, z), within)
    strikes = (one.k != place.k) & (one.k < pace.steps)
    shift = _shift(noted_end, one, one.k != place.k)
    t = one.t + shift
    z = axpy(shift, noted_end.seen[:2], z)
    state, tally = _with_flow(place, z)
    end = system.ahead(t, state, tally, within)  # rates, too, are those of the shifted end
    state = state._replace(plant=loop.plant.project(state.plant))
    sample = end.seen.signals.sample
    segment = Segment(
        begin.seen.signals.sample,
        sample,
        h + shift,
        pace.h,
        lambda: (Shown.of(begin.moving), Shown.of(end.moving)),
        lambda: (begin.moving, end.moving),
        smooth=True,
        within=(True, ~one.blunt),
    )
    tally = {name: Memory(tally[name].flow, o.update(tally[name], segment)) for name, o in objectives.items()}
    ends = (t, state.flow(), end.seen.rate) if pace.keeps else ()
    span = Span(place.t, place.state, begin.seen.rate, *ends) if pace.keeps else ()
    if loop.changes:
        ends = (begin.seen.signals.recorded, begin.recorded), (end.seen.signals.recorded, end.recorded)
        step = passed(*(Recorded(*both) for both in zip((place.t, t), ends, strict=True)))
        clock, state = Clock(t, pace.h, one.k, key, strikes), lend(state, logs)
        state = lend(_changed(system, clock, state, end.seen.margins, one.fired, step), None)
    return Place(t, shift, state, tally, one.k), span


def _with_flow(place: Place, z: Any) -> tuple[LoopState, Tally]:
    """State and accumulators with other continuous memories, not projected: a projection may end at a comparison."""
    return place.state.with_flow(z[0]), {name: memory._replace(flow=z[1][name]) for name, memory in place.tally.items()}


def _shift(end: Ahead, one: Notes, strikes: Any) -> Any:
    """How much later [s] than its noted end a step has come to its event, or to the comparison that changes there; 0
    where there is none, or a clock decides."""
    shift, most = jnp.zeros_like(one.length), NEAR * one.base
    for comparison in end.comparisons:
        on = comparison.numbers == one.lands
        each = (jnp.ravel(jnp.asarray(x)) for x in (on, comparison.value, comparison.rate))
        for which, margin, rate in zip(*each, strict=True):
            close, later = _until(which, margin, rate, most)
            shift = jnp.where(close, later, shift)
    shift = jnp.where(strikes, 0.0, shift)
    events = zip(jax.tree.leaves(end.seen.margins), jax.tree.leaves(end.falls), strict=True)
    for i, (margin, fall) in reversed(list(enumerate(events))):
        close, later = _until(one.fired & (1 << i) != 0, margin, fall, most)
        shift = jnp.where(close, later, shift)
    return shift


def _until(on: Any, margin: Any, fall: Any, most: Any) -> tuple[Any, Any]:
    """Whether a margin is zero within so many seconds, and in how many."""
    close = on & (jnp.abs(margin) < jnp.abs(jax.lax.stop_gradient(most) * fall))
    return close, -margin / jax.lax.stop_gradient(jnp.where(close, fall, 1.0))  # the margin is 0, but for rounding


def _changed(
    system: Dynamics, clock: Clock, state: LoopState, margins: Margins, fired: Any, step: dict[str, Passage]
) -> LoopState:
    """The state after the events and the ticks at the end of a step."""
    signals = system.loop.signals(clock.t, state)
    leaves, tree = jax.tree.flatten(margins)
    happens = tree.unflatten([fired & (1 << i) != 0 for i in range(len(leaves))])
    return system.loop.change(clock, state, signals, margins, happens, step)
