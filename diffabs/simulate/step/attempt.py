"""One fixed step, or a part of one: integration, objectives, events and ticks. `adaptive` has the same for adaptive
steps.

A step integrates to t + h within one mode. Then the plant projects its state, and the objectives are updated over the
step. At t + h the events and ticks of the blocks happen. The rates after these changes begin the next step.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.blocks import Passage
from diffabs.core.log import borrow
from diffabs.core.loop import Loop, LoopState, Margins, Signals
from diffabs.core.protocols import Clock, Memory, Sample, Segment, Shown
from diffabs.core.types import Matrix, PyTree, Scalar
from diffabs.simulate.drive.checkpoint import jit_barrier
from diffabs.simulate.step.modes import Mode, ModeBits, find_contradicted, single_bit
from diffabs.simulate.step.rk4 import rk4_step_from
from diffabs.simulate.step.system import Accumulators, Dynamics, Objectives, build_dynamics, split_flow_and_held


class FixedStepPoint(NamedTuple):
    """A run at an instant, after the changes there.

    Attributes:
        t: Time [s].
        state: State of the loop.
        accumulators: Accumulators of the objectives.
        sample: Sample of the signals.
        rate: Rates of the loop's flow and of the objectives' integrals.
        margins: Margins of the stop and of the blocks' events.
        mode: Answers to the comparisons in these rates.
    """

    t: Scalar
    state: LoopState
    accumulators: Accumulators
    sample: Sample
    rate: tuple[PyTree, PyTree]
    margins: Margins
    mode: ModeBits


class SurfaceCrossing(NamedTuple):
    """Contradicted comparisons at the end of a step: their answers differ from the mode of the step.

    Attributes:
        other: A contradicted comparison other than the sought one, or -1.
        contradicted: True if the sought comparison is contradicted.
        chosen: Number of the comparison to search for: the sought one if it is contradicted, else `other`.
        margin: Margin of the chosen comparison.
    """

    other: Any
    contradicted: Any
    chosen: Any
    margin: Scalar


class FixedStepAttempt(NamedTuple):
    """The end of an attempted step, before the changes there.

    Attributes:
        t: Time [s].
        state: State of the loop, projected.
        accumulators: Accumulators of the objectives.
        signals: Signals of the loop.
        rate: Rates of the loop's flow and of the objectives' integrals.
        margins: Margins of the stop and of the blocks' events.
        kink: Contradicted comparisons.
        mode: Mode after the step.
        passed: The step as a `Passage` for each block that records its signal.
    """

    t: Scalar
    state: LoopState
    accumulators: Accumulators
    signals: Signals
    rate: tuple[PyTree, PyTree]
    margins: Margins
    kink: SurfaceCrossing
    mode: ModeBits
    passed: dict[str, Passage]


class StepRequest(NamedTuple):
    """A step to attempt.

    Attributes:
        h: Length [s].
        end: Time at the end [s].
        step: Step of the grid [s].
        unrestricted: True for a step without a mode: each stage evaluates its comparisons, across switching surfaces.
        refresh: True for a step of length 0 that evaluates the rates after an event.
        which: Number of the sought comparison.
        lands: True if the step ends on the switching surface of that comparison.
    """

    h: Scalar
    end: PyTree
    step: Scalar
    unrestricted: Scalar
    refresh: Any
    which: Scalar
    lands: Scalar


def start_state(loop: Loop, objectives: Objectives, clock: Clock) -> tuple[LoopState, Accumulators]:
    """Return state and accumulators at t = 0, after the first ticks and the events of blocks with a negative margin.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by the names of their metrics.
        clock: Instant t = 0.
    """
    state = loop.start()
    signals = loop.signals(clock.t, state)
    accumulators = {name: objective.start(signals.sample) for name, objective in objectives.items()}
    if loop.changes:
        margins = loop.margins(clock.t, state, signals, lambda: loop.flow(clock.t, state, signals))
        state = loop.change(clock, state, signals, margins, jax.tree.map(lambda margin: margin < 0, margins))
    return state, accumulators


def initial_point(loop: Loop, objectives: Objectives, clock: Clock, *, kinks: bool = False) -> FixedStepPoint:
    """Return the point at t = 0.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by the names of their metrics.
        clock: Instant t = 0.
        kinks: True if switching surfaces are located.
    """
    state, accumulators = start_state(loop, objectives, clock)
    system = build_dynamics(loop, objectives, clock.t, state, accumulators, kinks=kinks)
    return _evaluate_point(system, clock.t, state, accumulators, Mode(None))


def attempt_step(system: Dynamics, point: FixedStepPoint, one: StepRequest, active: Scalar) -> FixedStepAttempt:
    """Return the end of one Runge-Kutta step from a point.

    Args:
        system: Dynamics of the loop and its objectives.
        point: Point at the beginning.
        one: Step to attempt.
        active: False for a run that is over. Its result has no meaning.
    """
    loop, (z, held) = system.loop, split_flow_and_held(point.state, point.accumulators)

    def flow(t: Scalar, z: Matrix, given: tuple[PyTree, Mode]) -> Any:
        return system.rates(t, z, *given)

    z = rk4_step_from(flow, point.t, z, point.rate, one.h, (held, Mode(point.mode, one.unrestricted)))
    state = point.state.with_flow(z[0])
    accumulated = {name: memory._replace(flow=z[1][name]) for name, memory in point.accumulators.items()}
    rests = state._replace(plant=loop.plant.project(state.plant))
    # A projection may move the state onto a switching surface, so the end of a frozen mode is evaluated without it.
    state = jax.tree.map(partial(jnp.where, one.unrestricted), rests, state) if system.kinks else rests

    def look() -> Any:
        seen, answers = system.look(
            one.end,
            state,
            accumulated,
            mode_at_end(system, point.mode, one.which, one.lands, one.unrestricted | one.refresh),
        )
        return seen, SurfaceCrossing(*find_contradicted(answers, one.which, one.h)), answers.words

    # The evaluation has many consumers (objectives, margins, rates). XLA would fuse a copy of it into each of them.
    seen, kink, words = jit_barrier(active, look) if system.kinks else look()
    end = (one.end, state, accumulated, seen.rate)
    segment = _build_segment(system, point, end, seen.signals.sample, one)
    new = {name: Memory(z[1][name], o.update(accumulated[name], segment)) for name, o in system.objectives.items()}
    # A step of length 0 must not count twice in the objectives.
    accumulated = (
        jax.tree.map(partial(jnp.where, one.refresh), point.accumulators, new)
        if loop.changes and not loop.ticks
        else new
    )
    passed = _build_passages(system, point, end, one)
    return FixedStepAttempt(one.end, rests, accumulated, seen.signals, seen[:2], seen.margins, kink, words, passed)


def commit_step(
    system: Dynamics, clock: Clock, here: FixedStepAttempt, fired: Margins, one: StepRequest, logs: list[PyTree]
) -> FixedStepPoint:
    """Return the point at which the run continues, after the triggered events and the ticks of the clock.

    In a loop without ticks a later step of length 0 (`StepRequest.refresh`) evaluates the rates after an event. Events
    are rare, so this is cheaper than an evaluation after every step.

    Args:
        system: Dynamics of the loop and its objectives.
        clock: Instant at the end of the step.
        here: Result of the attempt.
        fired: True for each event that happens at the end of the step.
        one: Step that led there.
        logs: Rows of the blocks' logs, which the state is without (`core.log`).
    """
    t, state, accumulators, signals, rate, margins, _, mode, passed = here
    if system.loop.changes:
        state = borrow(system.loop.change(clock, borrow(state, logs), signals, margins, fired, passed), None)
    if not system.loop.ticks:
        return FixedStepPoint(t, state, accumulators, signals.sample, rate, margins, mode)
    return _evaluate_point(system, t, state, accumulators, mode_after_changes(system, mode, one.which, one.lands))


def _evaluate_point(
    system: Dynamics, t: Scalar, state: LoopState, accumulators: Accumulators, mode: Mode
) -> FixedStepPoint:
    seen, answers = system.look(t, state, accumulators, mode)
    return FixedStepPoint(t, state, accumulators, seen.signals.sample, seen[:2], seen.margins, answers.words)


def mode_at_end(system: Dynamics, words: ModeBits, which: Scalar, lands: Scalar, free: PyTree) -> Mode:
    """Return the mode for the end of a step made in the mode `words`.

    It is the same mode, or the comparisons are evaluated where it is `free`. A step that lands on a switching surface
    flips the answer of that comparison, and the other comparisons may give way.

    Args:
        system: Dynamics of the loop and its objectives.
        words: Answers to the comparisons in the step.
        which: Number of the sought comparison.
        lands: True if the step ends on its switching surface.
        free: True if all comparisons are evaluated.
    """
    one_bit = single_bit(which, system.words)
    none, all = jnp.uint32(0), ~jnp.uint32(0)
    # `loose` are the answers that the numbers may override. The landed comparison is not among them: at its zero,
    # rounding could turn it back.
    flipped = tuple(word ^ jnp.where(lands, bit, none) for word, bit in zip(words, one_bit, strict=True))
    loose = tuple(jnp.where(free, all, jnp.where(lands, ~bit, none)) for bit in one_bit)
    return Mode(flipped, free, loose)


def mode_after_changes(system: Dynamics, words: ModeBits, which: Scalar, lands: Scalar) -> Mode:
    """Return the mode after the ticks and events at the end of a step.

    All comparisons are evaluated, except for the comparison on whose switching surface the step lands: it keeps its
    answer.

    Args:
        system: Dynamics of the loop and its objectives.
        words: Answers to the comparisons at the end of the step.
        which: Number of the sought comparison.
        lands: True if the step ends on its switching surface.
    """
    kept = (jnp.where(lands, bit, jnp.uint32(0)) for bit in single_bit(which, system.words))
    return Mode(words, ~lands, tuple(~bit for bit in kept))


def _build_segment(system: Dynamics, point: FixedStepPoint, end: PyTree, sample: Sample, one: StepRequest) -> Segment:
    within = Mode(point.mode, one.unrestricted)
    ends = ((point.t, point.state, point.accumulators, point.rate[0]), end)

    # Rates are computed on demand, once for all objectives that ask for them.
    def each(of: Any) -> Any:
        return cache(lambda: tuple(system.rate_of(of, end, within) for end in ends))

    # A step that ends on every switching surface reaches no limit inside.
    smooth = ~one.unrestricted if system.kinks else False
    rates = each(Shown.of), each(lambda sample: sample)
    return Segment(point.sample, sample, one.h, one.step, *rates, smooth, (True, True))


def _build_passages(system: Dynamics, point: FixedStepPoint, end: PyTree, one: StepRequest) -> dict[str, Passage]:
    """Return the recorded signals of each block at both ends of a step, and their rates within its mode."""
    loop, within = system.loop, Mode(point.mode, one.unrestricted)

    def recorded_rates(t: Scalar, state: LoopState, accumulators: Accumulators, rate: PyTree) -> Any:
        (flow, still), held = split_flow_and_held(state, accumulators)

        def read_recorded(t: Scalar, flow: PyTree) -> Any:
            if system.program is None:
                return loop.signals(t, state.with_flow(flow)).recorded
            fixed = (held, loop, system.objectives)
            return system.program(lambda recorded: recorded.signals.recorded, (t, flow, still), fixed, within)

        return jax.jvp(read_recorded, (t, flow), (jnp.ones_like(t), rate))

    if not loop.recorders:
        return {}
    (starts, rates), (ends, last) = (
        recorded_rates(point.t, point.state, point.accumulators, point.rate[0]),
        recorded_rates(*end),
    )
    return {name: Passage(point.t, one.end, (starts[name], ends[name]), (rates[name], last[name])) for name in starts}
