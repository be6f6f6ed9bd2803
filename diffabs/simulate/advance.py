"""What happens in one step of the grid, or in a part of one; `adaptive` says the same of steps that it chooses.

integrate to t + h, within one regime;  the plant's projection;  the objectives' update over the step;  at t + h the
blocks' events and ticks;  the rates from there, with which the next step begins"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.blocks import Passage
from diffabs.core.log import borrow
from diffabs.core.loop import Loop, LoopState, Margins, Signals
from diffabs.core.modes import Mode, ModeBits, find_contradicted, single_bit
from diffabs.core.protocols import Clock, Memory, Sample, Segment, Shown
from diffabs.simulate.checkpoint import jit_barrier
from diffabs.simulate.dynamics import Accumulators, Dynamics, Objectives, build_dynamics, split_flow_and_held
from diffabs.simulate.rk4 import rk4_step_from


class FixedStepPoint(NamedTuple):
    """A run at an instant, after what changes there: the loop's state and the objectives' accumulators, what is seen,
    the rates of both (of what is integrated), the margins of the stop and of the blocks' events, and the regime: the
    answers to the comparisons in these rates."""

    t: Any
    state: LoopState
    accumulators: Accumulators
    sample: Sample
    rate: tuple[Any, Any]
    margins: Margins
    mode: ModeBits


class SurfaceCrossing(NamedTuple):
    """Of the comparisons at the end of a step: one other than that which is looked for, and which says something else
    than in the step, or -1; whether that which is looked for does; the one of these to look for; and its margin."""

    other: Any
    contradicted: Any
    chosen: Any
    margin: Any


class FixedStepAttempt(NamedTuple):
    """The end of a step, before what changes there: time, state, accumulators, signals, rates, margins, comparisons,
    the regime from there, and the step itself for the blocks that record it."""

    t: Any
    state: LoopState
    accumulators: Accumulators
    signals: Signals
    rate: tuple[Any, Any]
    margins: Margins
    kink: SurfaceCrossing
    mode: ModeBits
    passed: dict[str, Passage]


class StepRequest(NamedTuple):
    """A step to be made: length [s], the time at its end, the step of the grid [s]; whether it is a blunt one, over
    whatever lies within; whether it is none, but works out anew what an event has changed; the comparison
    that is looked for, and whether the step ends where that changes."""

    h: Any
    end: Any
    step: Any
    unrestricted: Any
    refresh: Any
    which: Any
    lands: Any


def start_state(loop: Loop, objectives: Objectives, clock: Clock) -> tuple[LoopState, Accumulators]:
    """Return state and accumulators at t = 0, after the first ticks; a block whose margin is negative has its event."""
    state = loop.start()
    signals = loop.signals(clock.t, state)
    accumulators = {name: objective.start(signals.sample) for name, objective in objectives.items()}
    if loop.changes:
        margins = loop.margins(clock.t, state, signals, lambda: loop.flow(clock.t, state, signals))
        state = loop.change(clock, state, signals, margins, jax.tree.map(lambda margin: margin < 0, margins))
    return state, accumulators


def initial_point(loop: Loop, objectives: Objectives, clock: Clock, *, kinks: bool = False) -> FixedStepPoint:
    """Return the point at t = 0."""
    state, accumulators = start_state(loop, objectives, clock)
    system = build_dynamics(loop, objectives, clock.t, state, accumulators, kinks=kinks)
    return _evaluate_point(system, clock.t, state, accumulators, Mode(None))


def attempt_step(system: Dynamics, point: FixedStepPoint, one: StepRequest, active: Any) -> FixedStepAttempt:
    """Return what this step leads to, by one Runge-Kutta step."""
    loop, (z, held) = system.loop, split_flow_and_held(point.state, point.accumulators)

    def flow(t: Any, z: Any, given: tuple[Any, Mode]) -> Any:
        return system.rates(t, z, *given)

    z = rk4_step_from(flow, point.t, z, point.rate, one.h, (held, Mode(point.mode, one.unrestricted)))
    state = point.state.with_flow(z[0])
    accumulated = {name: memory._replace(flow=z[1][name]) for name, memory in point.accumulators.items()}
    rests = state._replace(plant=loop.plant.project(state.plant))
    state = jax.tree.map(partial(jnp.where, one.unrestricted), rests, state) if system.kinks else rests

    def look() -> Any:
        seen, answers = system.look(
            one.end,
            state,
            accumulated,
            mode_at_end(system, point.mode, one.which, one.lands, one.unrestricted | one.refresh),
        )
        return seen, SurfaceCrossing(*find_contradicted(answers, one.which, one.h)), answers.words

    seen, kink, words = jit_barrier(active, look) if system.kinks else look()
    end = (one.end, state, accumulated, seen.rate)
    segment = _build_segment(system, point, end, seen.signals.sample, one)
    new = {name: Memory(z[1][name], o.update(accumulated[name], segment)) for name, o in system.objectives.items()}
    accumulated = (
        jax.tree.map(partial(jnp.where, one.refresh), point.accumulators, new)
        if loop.changes and not loop.ticks
        else new
    )
    passed = _build_passages(system, point, end, one)
    return FixedStepAttempt(one.end, rests, accumulated, seen.signals, seen[:2], seen.margins, kink, words, passed)


def commit_step(
    system: Dynamics, clock: Clock, here: FixedStepAttempt, fired: Margins, one: StepRequest, logs: list[Any]
) -> FixedStepPoint:
    """Return the point from which a run goes on, after the events that have `fired` and the ticks of the clock. In a
    loop without ticks, what follows from an event is left to a step that does it `anew`: there are few of them.

    logs: the rows of the blocks' logs, which the state is without (`core.log`)"""
    t, state, accumulators, signals, rate, margins, _, mode, passed = here
    if system.loop.changes:
        state = borrow(system.loop.change(clock, borrow(state, logs), signals, margins, fired, passed), None)
    if not system.loop.ticks:
        return FixedStepPoint(t, state, accumulators, signals.sample, rate, margins, mode)
    return _evaluate_point(system, t, state, accumulators, mode_after_changes(system, mode, one.which, one.lands))


def _evaluate_point(
    system: Dynamics, t: Any, state: LoopState, accumulators: Accumulators, mode: Mode
) -> FixedStepPoint:
    seen, answers = system.look(t, state, accumulators, mode)
    return FixedStepPoint(t, state, accumulators, seen.signals.sample, seen[:2], seen.margins, answers.words)


def mode_at_end(system: Dynamics, words: ModeBits, which: Any, lands: Any, free: Any) -> Mode:
    """Return the regime for the end of a step made in the regime `words`: the same, or as the numbers say where it is
    `free`. A step that `lands` on the comparison `which` changes its answer, and others may follow."""
    one_bit = single_bit(which, system.words)
    none, all = jnp.uint32(0), ~jnp.uint32(0)
    flipped = tuple(word ^ jnp.where(lands, bit, none) for word, bit in zip(words, one_bit, strict=True))
    loose = tuple(jnp.where(free, all, jnp.where(lands, ~bit, none)) for bit in one_bit)
    return Mode(flipped, free, loose)


def mode_after_changes(system: Dynamics, words: ModeBits, which: Any, lands: Any) -> Mode:
    """Return the regime after the ticks and events at the end of a step: as the numbers say, but for the comparison on
    which the step `lands`."""
    kept = (jnp.where(lands, bit, jnp.uint32(0)) for bit in single_bit(which, system.words))
    return Mode(words, ~lands, tuple(~bit for bit in kept))


def _build_segment(system: Dynamics, point: FixedStepPoint, end: Any, sample: Sample, one: StepRequest) -> Segment:
    within = Mode(point.mode, one.unrestricted)
    ends = ((point.t, point.state, point.accumulators, point.rate[0]), end)

    def each(of: Any) -> Any:
        return cache(lambda: tuple(system.moving(of, end, within) for end in ends))

    smooth = (
        ~one.unrestricted if system.kinks else False
    )  # a step that ends on every comparison reaches no limit within
    rates = each(Shown.of), each(lambda sample: sample)
    return Segment(point.sample, sample, one.h, one.step, *rates, smooth, (True, True))


def _build_passages(system: Dynamics, point: FixedStepPoint, end: Any, one: StepRequest) -> dict[str, Passage]:
    """What blocks record of a step: their signals at both ends, and the rates, within its regime."""
    loop, within = system.loop, Mode(point.mode, one.unrestricted)

    def moving(t: Any, state: LoopState, accumulators: Accumulators, rate: Any) -> Any:
        (flow, still), held = split_flow_and_held(state, accumulators)

        def seen(t: Any, flow: Any) -> Any:
            if system.program is None:
                return loop.signals(t, state.with_flow(flow)).recorded
            fixed = (held, loop, system.objectives)
            return system.program(lambda seen: seen.signals.recorded, (t, flow, still), fixed, within)

        return jax.jvp(seen, (t, flow), (jnp.ones_like(t), rate))

    if not loop.recorders:
        return {}
    (starts, rates), (ends, last) = moving(point.t, point.state, point.accumulators, point.rate[0]), moving(*end)
    return {name: Passage(point.t, one.end, (starts[name], ends[name]), (rates[name], last[name])) for name in starts}
