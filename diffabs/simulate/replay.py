"""Derivatives of a run with adaptive steps: the run is made once for its values and noted, and its steps are repeated.

    noted      of each step: when it ends, the regime in its middle, the events and the instant of a clock at its end
    repeated   Runge-Kutta steps to the same ends within the same regimes, which are smooth; a step at whose end the
               regime changes, or an event happens, ends where the margin g of that is zero, by Newton's step
               -g/(dg/dt) from the noted end, whose derivative is that of the moment by the implicit function theorem

So the derivative is that of the run whose steps end at these times, and on its kinks and events; the lengths of the
others do not depend on anything."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.loop import Loop, LoopState, Margins
from diffabs.core.numerics import axpy
from diffabs.core.protocols import Clock, Memory, Segment
from diffabs.core.regime import Regime, Words
from diffabs.simulate.adaptive import Carry, Pace
from diffabs.simulate.checkpoint import anyone, repeated
from diffabs.simulate.condition import Condition
from diffabs.simulate.drivers import BLOCK
from diffabs.simulate.dynamics import Ahead, Dynamics, Objectives, Tally, dynamics, parted
from diffabs.simulate.foresight import bit
from diffabs.simulate.landing import select
from diffabs.simulate.rk4 import rk4_step_from
from diffabs.simulate.solution import ORDER, Adaptive
from diffabs.simulate.stepper import typed

MOST, TICKED = 2048, 2  # tries that can be noted at an error of 1e-5, and for each instant of a grid with clocks
FAR = 0.5  # of a step: no comparison that changes at its end is so far from changing there
NEAR = 1e-3  # of the length that the error allows: nor is an event, or a comparison that changes with one


class Notes(NamedTuple):
    """Of every try (tries, ...): whether it led on; the time at its end, the length that the error allowed, and the
    number of the instant of the grid at which a clock has struck last; a bit for each event at its end; the regime in
    its middle, and in that of the next that led on."""

    moved: Any
    t: Any
    natural: Any
    k: Any
    fired: Any
    words: Words
    next: Words


class Place(NamedTuple):
    """A run on its way: time, state, accumulators, and the number of the clock's last instant."""

    t: Any
    state: LoopState
    tally: Tally
    k: Any


class Repeated(NamedTuple):
    """A run that is over, as a judge sees it."""

    point: Place
    condition: Any

    @property
    def running(self) -> Any:
        """Whether another step is to be made: never."""
        return self.condition < 0

    @property
    def stopped(self) -> Any:
        """Whether the stop was reached."""
        return self.condition == Condition.STOPPED


def room(loop: Loop, solver: Adaptive) -> int:
    """Return for how many tries there is room in the notes of a run."""
    return math.ceil(MOST * max(1.0, 1e-5 / solver.rtol) ** (1 / ORDER)) + (TICKED * solver.steps if loop.ticks else 0)


def note(loop: Loop, objectives: Objectives, pace: Pace, key: Any, tries: int) -> tuple[Notes, Any]:
    """Return the notes of a run, with room for so many tries, and how it ended: it has diverged if it took more."""

    def entry(old: Carry, new: Carry) -> Notes:
        fired, words = new.note
        moved = (new.point.t > old.point.t) | (fired != 0)
        return Notes(moved, new.point.t, old.natural, new.k, fired, words, words)

    def block(at: tuple[Any, Carry, Notes]) -> tuple[Any, Carry, Notes]:
        first, carry, notes = at

        def one(i: Any, at: tuple[Carry, Notes]) -> tuple[Carry, Notes]:
            new = pace.step(loop, objectives, key, at[0])
            said = entry(at[0], new)
            return new, jax.tree.map(lambda all, x: all.at[first + i].set(x), at[1], said)

        return first + BLOCK, *jax.lax.fori_loop(0, BLOCK, one, (pace.renew(loop, carry), notes))

    carry = pace.start(loop, objectives, key)
    shapes = jax.eval_shape(entry, carry, carry)
    room = -(-tries // BLOCK) * BLOCK
    notes = jax.tree.map(lambda x: jnp.zeros((room, *x.shape), x.dtype), shapes)
    _, carry, notes = jax.lax.while_loop(lambda at: (at[0] < room) & anyone(at[1].running), block, (0, carry, notes))

    def back(words: Words, at: tuple[Any, Words]) -> tuple[Words, Words]:
        return select(at[0], at[1], words), words

    last = jax.tree.map(lambda x: x[-1], notes.words)
    following = jax.lax.scan(back, last, (notes.moved, notes.words), reverse=True)[1]
    return notes._replace(next=following), jnp.where(carry.running, Condition.DIVERGED, carry.condition)


def repeat(loop: Loop, objectives: Objectives, pace: Pace, key: Any, notes: Notes, condition: Any) -> Repeated:
    """Return the run of these notes once more, which can be differentiated in every leaf of loop and objectives."""
    room, zero = len(notes.t), 0.0 * pace.h
    state = loop.start()
    signals = loop.signals(zero, state)
    tally = {name: objective.start(signals.sample) for name, objective in objectives.items()}
    if loop.changes:
        margins = loop.margins(zero, state, signals, lambda: loop.flow(zero, state, signals))
        fired = jax.tree.map(lambda margin: margin < 0, margins)
        state = loop.change(Clock(zero, pace.h, 0, key), state, signals, margins, fired)
    last = jnp.max(jnp.where(notes.moved, jnp.arange(1, room + 1), 0))

    def step(at: tuple[Any, Place]) -> tuple[Any, Place]:
        i, place = at
        one = jax.tree.map(lambda x: x[jnp.minimum(i, room - 1)], notes)
        new = _step(loop, objectives, pace, key, place, one)
        return i + 1, select(one.moved & (i < room), new, place)

    begun = typed(Place(zero, state, tally, jnp.asarray(0)), pace.h.dtype)
    place = repeated(step, (0, begun), room, lambda at: anyone(at[0] < last))[1]
    return Repeated(place, condition)


def _step(loop: Loop, objectives: Objectives, pace: Pace, key: Any, place: Place, one: Notes) -> Place:
    """One step within its regime, and what happens at its end."""
    system = dynamics(loop, objectives, place.t, place.state, place.tally, kinks=True)
    within, h = Regime(one.words), one.t - place.t
    start = system.ahead(place.t, place.state, place.tally, within)
    z, held = parted(place.state, place.tally)

    def flow(t: Any, z: Any, given: tuple[Any, Regime]) -> Any:
        return system.rates(t, z, *given)

    z = rk4_step_from(flow, place.t, z, start.seen[:2], h, (held, within))
    state, tally = _whole(loop, place, z)
    end = system.ahead(one.t, state, tally, within)
    changed = tuple(a ^ b for a, b in zip(one.words, one.next, strict=True))
    strikes = (one.k != place.k) & (one.k < pace.steps)
    shift = _shift(end, changed, one, h, one.k != place.k)
    t = one.t + shift
    z = axpy(shift, end.seen[:2], z)
    state, tally = _whole(loop, place, z)
    sample = axpy(shift, end.moving, end.seen.signals.sample)
    sample = sample._replace(t=t)
    segment = Segment(
        start.seen.signals.sample,
        sample,
        h + shift,
        pace.h,
        lambda: (start.moving.output, end.moving.output),
        lambda: (start.moving, end.moving),
    )
    tally = {name: Memory(tally[name].flow, o.update(tally[name], segment)) for name, o in objectives.items()}
    if loop.changes:
        state = _changed(system, Clock(t, pace.h, one.k, key, strikes), state, end.seen.margins, one.fired)
    return Place(t, state, tally, one.k)


def _whole(loop: Loop, place: Place, z: Any) -> tuple[LoopState, Tally]:
    state = place.state.with_flow(z[0])
    state = state._replace(plant=loop.plant.project(state.plant))
    return state, {name: memory._replace(flow=z[1][name]) for name, memory in place.tally.items()}


def _shift(end: Ahead, changed: Words, one: Notes, h: Any, strikes: Any) -> Any:
    """How much later [s] than its noted end a step has come to its event, or to the comparison that changes there, with
    which an event may come whose margin jumps; 0 where there is none, or a clock decides."""
    happens = one.fired != 0
    shift, nearest = jnp.zeros_like(h), jnp.where(happens, NEAR * one.natural, FAR * h)
    for comparison in end.comparisons:
        was = bit(changed, comparison.numbers)
        for on, *line in zip(*(jnp.ravel(jnp.asarray(x)) for x in (was, *comparison[1:])), strict=True):
            close, later = _until(on, *line, nearest)
            shift, nearest = jnp.where(close, later, shift), jnp.where(close, jnp.abs(later), nearest)
    shift = jnp.where(strikes & ~happens, 0.0, shift)
    for i, line in reversed(list(enumerate(zip(*map(jax.tree.leaves, (end.seen.margins, end.falls)), strict=True)))):
        close, later = _until((one.fired >> i) & 1 != 0, *line, NEAR * one.natural)
        shift = jnp.where(close, later, shift)
    return shift


def _until(on: Any, margin: Any, fall: Any, most: Any) -> tuple[Any, Any]:
    """Whether a margin is zero within so many seconds, and in how many."""
    close = on & (jnp.abs(margin) < jnp.abs(jax.lax.stop_gradient(most) * fall))
    return close, -margin / jnp.where(close, fall, 1.0)


def _changed(system: Dynamics, clock: Clock, state: LoopState, margins: Margins, fired: Any) -> LoopState:
    """The state after the events and the ticks at the end of a step."""
    signals = system.loop.signals(clock.t, state)
    leaves, tree = jax.tree.flatten(margins)
    happens = tree.unflatten([(fired >> i) & 1 != 0 for i in range(len(leaves))])
    return system.loop.change(clock, state, signals, margins, happens)
