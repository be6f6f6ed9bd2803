"""What happens in one step of the grid, or in a part of one; `adaptive` says the same of steps that it chooses.

integrate to t + h, within one regime;  the plant's projection;  the objectives' update over the step;  at t + h the
blocks' events and ticks;  the rates from there, with which the next step begins"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.blocks import Passage
from diffabs.core.log import lend
from diffabs.core.loop import Loop, LoopState, Margins, Signals
from diffabs.core.protocols import Clock, Memory, Sample, Segment, Shown
from diffabs.core.regime import Regime, Words, crossing, only
from diffabs.simulate.checkpoint import apart
from diffabs.simulate.dynamics import Dynamics, Objectives, Tally, dynamics, parted
from diffabs.simulate.rk4 import rk4_step_from


class Point(NamedTuple):
    """A run at an instant, after what changes there: the loop's state and the objectives' accumulators, what is seen,
    the rates of both (of what is integrated), the margins of the stop and of the blocks' events, and the regime: the
    answers to the comparisons in these rates."""

    t: Any
    state: LoopState
    tally: Tally
    sample: Sample
    rate: tuple[Any, Any]
    margins: Margins
    regime: Words


class Kink(NamedTuple):
    """Of the comparisons at the end of a step: one other than that which is looked for, and which says something else
    than in the step, or -1; whether that which is looked for does; the one of these to look for; and its margin."""

    other: Any
    crossed: Any
    chosen: Any
    margin: Any


class Arrival(NamedTuple):
    """The end of a step, before what changes there: time, state, accumulators, signals, rates, margins, comparisons,
    the regime from there, and the step itself for the blocks that record it."""

    t: Any
    state: LoopState
    tally: Tally
    signals: Signals
    rate: tuple[Any, Any]
    margins: Margins
    kink: Kink
    regime: Words
    passed: dict[str, Passage]


class Try(NamedTuple):
    """A step to be made: length [s], the time at its end, the step of the grid [s]; whether it is a blunt one, over
    whatever lies within; whether it is none, but works out anew what an event has changed; the comparison
    that is looked for, and whether the step ends where that changes."""

    h: Any
    end: Any
    step: Any
    blunt: Any
    anew: Any
    which: Any
    lands: Any


def start(loop: Loop, objectives: Objectives, clock: Clock) -> tuple[LoopState, Tally]:
    """Return state and accumulators at t = 0, after the first ticks; a block whose margin is negative has its event."""
    state = loop.start()
    signals = loop.signals(clock.t, state)
    tally = {name: objective.start(signals.sample) for name, objective in objectives.items()}
    if loop.changes:
        margins = loop.margins(clock.t, state, signals, lambda: loop.flow(clock.t, state, signals))
        state = loop.change(clock, state, signals, margins, jax.tree.map(lambda margin: margin < 0, margins))
    return state, tally


def begin(loop: Loop, objectives: Objectives, clock: Clock, *, kinks: bool = False) -> Point:
    """Return the point at t = 0."""
    state, tally = start(loop, objectives, clock)
    system = dynamics(loop, objectives, clock.t, state, tally, kinks=kinks)
    return _leave(system, clock.t, state, tally, Regime(None))


def arrive(system: Dynamics, point: Point, one: Try, active: Any) -> Arrival:
    """Return what this step leads to, by one Runge-Kutta step."""
    loop, (z, held) = system.loop, parted(point.state, point.tally)

    def flow(t: Any, z: Any, given: tuple[Any, Regime]) -> Any:
        return system.rates(t, z, *given)

    z = rk4_step_from(flow, point.t, z, point.rate, one.h, (held, Regime(point.regime, one.blunt)))
    state = point.state.with_flow(z[0])
    tallied = {name: memory._replace(flow=z[1][name]) for name, memory in point.tally.items()}
    rests = state._replace(plant=loop.plant.project(state.plant))
    state = jax.tree.map(partial(jnp.where, one.blunt), rests, state) if system.kinks else rests

    def look() -> Any:
        seen, answers = system.look(
            one.end, state, tallied, at_end(system, point.regime, one.which, one.lands, one.blunt | one.anew)
        )
        return seen, Kink(*crossing(answers, one.which, one.h)), answers.words

    seen, kink, words = apart(active, look) if system.kinks else look()
    end = (one.end, state, tallied, seen.rate)
    segment = _segment(system, point, end, seen.signals.sample, one)
    new = {name: Memory(z[1][name], o.update(tallied[name], segment)) for name, o in system.objectives.items()}
    tallied = jax.tree.map(partial(jnp.where, one.anew), point.tally, new) if loop.changes and not loop.ticks else new
    passed = _passed(system, point, end, one)
    return Arrival(one.end, rests, tallied, seen.signals, seen[:2], seen.margins, kink, words, passed)


def depart(system: Dynamics, clock: Clock, here: Arrival, fired: Margins, one: Try, logs: list[Any]) -> Point:
    """Return the point from which a run goes on, after the events that have `fired` and the ticks of the clock. In a
    loop without ticks, what follows from an event is left to a step that does it `anew`: there are few of them.

    logs: the rows of the blocks' logs, which the state is without (`core.log`)"""
    t, state, tally, signals, rate, margins, _, regime, passed = here
    if system.loop.changes:
        state = lend(system.loop.change(clock, lend(state, logs), signals, margins, fired, passed), None)
    if not system.loop.ticks:
        return Point(t, state, tally, signals.sample, rate, margins, regime)
    return _leave(system, t, state, tally, after_changes(system, regime, one.which, one.lands))


def _leave(system: Dynamics, t: Any, state: LoopState, tally: Tally, regime: Regime) -> Point:
    seen, answers = system.look(t, state, tally, regime)
    return Point(t, state, tally, seen.signals.sample, seen[:2], seen.margins, answers.words)


def at_end(system: Dynamics, words: Words, which: Any, lands: Any, free: Any) -> Regime:
    """Return the regime for the end of a step made in the regime `words`: the same, or as the numbers say where it is
    `free`. A step that `lands` on the comparison `which` changes its answer, and others may follow."""
    one_bit = only(which, system.words)
    none, all = jnp.uint32(0), ~jnp.uint32(0)
    flipped = tuple(word ^ jnp.where(lands, bit, none) for word, bit in zip(words, one_bit, strict=True))
    loose = tuple(jnp.where(free, all, jnp.where(lands, ~bit, none)) for bit in one_bit)
    return Regime(flipped, free, loose)


def after_changes(system: Dynamics, words: Words, which: Any, lands: Any) -> Regime:
    """Return the regime after the ticks and events at the end of a step: as the numbers say, but for the comparison on
    which the step `lands`."""
    kept = (jnp.where(lands, bit, jnp.uint32(0)) for bit in only(which, system.words))
    return Regime(words, ~lands, tuple(~bit for bit in kept))


def _segment(system: Dynamics, point: Point, end: Any, sample: Sample, one: Try) -> Segment:
    within = Regime(point.regime, one.blunt)
    ends = ((point.t, point.state, point.tally, point.rate[0]), end)

    def each(of: Any) -> Any:
        return cache(lambda: tuple(system.moving(of, end, within) for end in ends))

    smooth = ~one.blunt if system.kinks else False  # a step that ends on every comparison reaches no limit within
    rates = each(Shown.of), each(lambda sample: sample)
    return Segment(point.sample, sample, one.h, one.step, *rates, smooth, (True, True))


def _passed(system: Dynamics, point: Point, end: Any, one: Try) -> dict[str, Passage]:
    """What blocks record of a step: their signals at both ends, and the rates, within its regime."""
    loop, within = system.loop, Regime(point.regime, one.blunt)

    def moving(t: Any, state: LoopState, tally: Tally, rate: Any) -> Any:
        (flow, still), held = parted(state, tally)

        def seen(t: Any, flow: Any) -> Any:
            if system.program is None:
                return loop.signals(t, state.with_flow(flow)).recorded
            fixed = (held, loop, system.objectives)
            return system.program(lambda seen: seen.signals.recorded, (t, flow, still), fixed, within)

        return jax.jvp(seen, (t, flow), (jnp.ones_like(t), rate))

    if not loop.recorders:
        return {}
    (starts, rates), (ends, last) = moving(point.t, point.state, point.tally, point.rate[0]), moving(*end)
    return {name: Passage(point.t, one.end, (starts[name], ends[name]), (rates[name], last[name])) for name in starts}
