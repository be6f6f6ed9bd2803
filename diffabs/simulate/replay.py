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
from diffabs.core.log import borrow, log_rows, write_last_rows
from diffabs.core.loop import Loop, LoopState, Margins
from diffabs.core.modes import Mode, ModeBits
from diffabs.core.numerics import axpy
from diffabs.core.protocols import Clock, Memory, Segment, Shown
from diffabs.simulate.adaptive import build_passages
from diffabs.simulate.advance import start_state
from diffabs.simulate.checkpoint import any_lane, rematerialise
from diffabs.simulate.condition import RunStatus, is_running
from diffabs.simulate.drivers import STEPS_PER_BLOCK
from diffabs.simulate.dynamics import (
    Accumulators,
    Dynamics,
    LoopEvaluationWithRates,
    Objectives,
    build_dynamics,
    split_flow_and_held,
)
from diffabs.simulate.landing import select
from diffabs.simulate.methods import AdaptiveStepping
from diffabs.simulate.result import observe
from diffabs.simulate.solution import ADAPTIVE_ERROR_ORDER, Adaptive, Trajectory
from diffabs.simulate.span import HermiteStep
from diffabs.simulate.stepper import cast_floats
from diffabs.simulate.tries import AdaptiveCarry
from diffabs.simulate.tsit5 import tsit5_step_from

BASE_LOG_CAPACITY, LOG_CAPACITY_PER_TICK = (
    4096,
    2,
)  # tries that can be noted at an error of 1e-5, and for each instant of a grid with clocks
MAX_SHIFT_FRACTION = (
    1e-3  # of the try in which it was seen: no event or comparison at the end of a step is so far from its zero
)


class StepLog(NamedTuple):
    """Of every try, in blocks (blocks, BLOCK, ...): whether it led on; the time at its end and its length; the length
    of the first try from there; the number of the instant of the grid at which a clock has struck last; a bit for each
    event at its end; its regime, and whether that did not count; the number of the comparison that changes at its end,
    or -1."""

    moved: Any
    t: Any
    length: Any
    base: Any
    k: Any
    triggered: Any
    words: ModeBits
    unrestricted: Any
    lands: Any


class ReplayState(NamedTuple):
    """A run on its way: time, how much later that is than its noted one, state, accumulators, and the number of the
    clock's last instant."""

    t: Any
    late: Any
    state: LoopState
    accumulators: Accumulators
    k: Any


class RecordedSignals(NamedTuple):
    """What blocks record at an instant, and its rates."""

    t: Any
    recorded: tuple[dict[str, Any], dict[str, Any]]


class ReplayedRun(NamedTuple):
    """A run that is over, as a judge sees it."""

    point: ReplayState
    status: Any

    running = property(is_running)  # never


def log_capacity(loop: Loop, solver: Adaptive) -> int:
    """Return for how many tries there is room in the notes of a run."""
    return math.ceil(BASE_LOG_CAPACITY * max(1.0, 1e-5 / solver.rtol) ** (1 / ADAPTIVE_ERROR_ORDER)) + (
        LOG_CAPACITY_PER_TICK * solver.steps if loop.ticks else 0
    )


def log_attempt(old: AdaptiveCarry, new: AdaptiveCarry) -> StepLog:
    """Return the notes of one try, between these carries."""
    moved = (new.point.t > old.point.t) | (new.triggered != 0)
    landed = (old.status == RunStatus.LANDING) & (new.triggered == 0)
    lands = jnp.where(landed, old.search.which, -1)
    return StepLog(
        moved, new.point.t, old.length, old.base, new.k, new.triggered, old.point.words, old.unrestricted, lands
    )


def log_steps(
    loop: Loop, objectives: Objectives, stepping: AdaptiveStepping, key: Any, tries: int
) -> tuple[StepLog, Any]:
    """Return the notes of a run, with room for so many tries, and how it ended: it has diverged if it took more."""

    def one(carry: AdaptiveCarry, _: Any) -> tuple[AdaptiveCarry, StepLog]:
        new = stepping.step(loop, objectives, key, carry)
        return new, log_attempt(carry, new)

    def some(carry: AdaptiveCarry) -> tuple[AdaptiveCarry, StepLog]:
        return jax.lax.scan(one, stepping.renew(loop, carry), length=STEPS_PER_BLOCK)

    carry = stepping.start(loop, objectives, key)
    carry, notes = _scan_active(some, lambda carry, _: carry.running, carry, None, -(-tries // STEPS_PER_BLOCK))

    notes = jax.tree.map(jax.lax.stop_gradient, notes)
    return notes, jnp.where(carry.running, RunStatus.DIVERGED, carry.status)


def _scan_active(work: Any, on: Any, carry: Any, xs: Any, length: int | None = None, reverse: bool = False) -> Any:
    """A scan of work(carry) or, with xs, work(carry, x), which is skipped where no lane of a batch is on(carry, x):
    it leaves zeros there."""

    def body(carry: Any, x: Any) -> tuple[Any, Any]:
        def run() -> tuple[Any, Any]:
            return work(carry) if x is None else work(carry, x)

        def skip() -> tuple[Any, Any]:
            return carry, jax.tree.map(lambda y: jnp.zeros(y.shape, y.dtype), jax.eval_shape(run)[1])

        return jax.lax.cond(any_lane(on(carry, x)), run, skip)

    return jax.lax.scan(body, carry, xs, length=length, reverse=reverse)


def replay_run(
    loop: Loop, objectives: Objectives, stepping: AdaptiveStepping, key: Any, notes: StepLog, status: Any
) -> ReplayedRun:
    """Return the run of these notes once more, which can be differentiated in every leaf of loop and objectives."""
    return ReplayedRun(_replay_steps(loop, objectives, stepping, key, notes)[0], status)


def replay_with_trajectory(
    loop: Loop, objectives: Objectives, stepping: AdaptiveStepping, key: Any, notes: StepLog, status: Any, instants: Any
) -> tuple[ReplayedRun, Trajectory, Trajectory]:
    """Return the same run, what is seen at its beginning, and what at these instants (n,) of the grid: by the cubics of
    its steps."""
    last, spans = _replay_steps(loop, objectives, stepping, key, notes)
    # What was skipped is zero, and comes after the end.
    starts = jnp.where(jnp.any(notes.moved, axis=1)[:, None], jax.lax.stop_gradient(spans.t), jnp.inf)
    spans = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), spans)

    def seen(instant: Any) -> Trajectory:
        t = instant * stepping.h
        place = jnp.searchsorted(starts.ravel(), t, side="right") - 1
        span = jax.tree.map(lambda x: x[place], spans)
        return observe(loop, t, span.at(t), t < jax.lax.stop_gradient(last.t))

    first = observe(loop, 0.0 * stepping.h, jax.tree.map(lambda x: x[0], spans.state), jnp.asarray(True))
    return ReplayedRun(last, status), first, jax.vmap(seen)(instants)


def _replay_steps(
    loop: Loop, objectives: Objectives, stepping: AdaptiveStepping, key: Any, notes: StepLog
) -> tuple[ReplayState, Any]:
    """The end of the run, and the `HermiteStep` of every try, where they are kept."""
    begun = start_replay(loop, objectives, stepping, key)

    def step(place: ReplayState, one: StepLog) -> tuple[ReplayState, Any]:
        return replay_attempt(loop, objectives, stepping, key, place, one)

    @rematerialise
    def block(place: ReplayState, some: StepLog) -> tuple[ReplayState, Any]:
        return jax.lax.scan(rematerialise(step), place, some)

    return _scan_active(block, lambda _, some: jnp.any(some.moved), begun, notes)


def start_replay(loop: Loop, objectives: Objectives, stepping: AdaptiveStepping, key: Any) -> ReplayState:
    """Return where a run begins."""
    zero = 0.0 * stepping.h
    state, accumulators = start_state(loop, objectives, Clock(zero, stepping.h, 0, key))
    return cast_floats(
        ReplayState(zero, zero, borrow(state, log_rows(state)), accumulators, jnp.asarray(0)), stepping.h.dtype
    )


def replay_attempt(
    loop: Loop, objectives: Objectives, stepping: AdaptiveStepping, key: Any, place: ReplayState, one: StepLog
) -> tuple[ReplayState, Any]:
    """Return where a try leads, if it led on; its `HermiteStep`, where they are kept."""
    logs, place = write_last_rows(place.state), place._replace(state=borrow(place.state, None))
    new, span = _step(loop, objectives, stepping, key, place, one, logs)
    place = select(one.moved, new, place)
    return place._replace(state=borrow(place.state, logs)), span


def _step(
    loop: Loop,
    objectives: Objectives,
    stepping: AdaptiveStepping,
    key: Any,
    place: ReplayState,
    one: StepLog,
    logs: list[Any],
) -> tuple[ReplayState, Any]:
    """Return where one step leads, within its mode and with what happens at its end; and its `HermiteStep`, where these
    are kept. `logs` are the rows of the logs, which the state is without."""
    system = build_dynamics(loop, objectives, place.t, place.state, place.accumulators, kinks=True)
    within, h = Mode(one.words, one.unrestricted), one.length - place.late
    begin = system.ahead(place.t, place.state, place.accumulators, within)
    z, held = split_flow_and_held(place.state, place.accumulators)

    def flow(t: Any, z: Any, given: tuple[Any, Mode]) -> Any:
        return system.rates(t, z, *given)

    z = tsit5_step_from(flow, place.t, z, begin.seen[:2], h, (held, within))
    noted_end = system.ahead(one.t, *_with_flow(place, z), within)
    strikes = (one.k != place.k) & (one.k < stepping.steps)
    shift = _shift(noted_end, one, one.k != place.k)
    t = one.t + shift
    z = axpy(shift, noted_end.seen[:2], z)
    state, accumulators = _with_flow(place, z)
    end = system.ahead(t, state, accumulators, within)  # rates, too, are those of the shifted end
    state = state._replace(plant=loop.plant.project(state.plant))
    sample = end.seen.signals.sample
    segment = Segment(
        begin.seen.signals.sample,
        sample,
        h + shift,
        stepping.h,
        lambda: (Shown.of(begin.moving), Shown.of(end.moving)),
        lambda: (begin.moving, end.moving),
        smooth=True,
        within=(True, ~one.unrestricted),
    )
    accumulators = {
        name: Memory(accumulators[name].flow, o.update(accumulators[name], segment)) for name, o in objectives.items()
    }
    ends = (t, state.flow(), end.seen.rate) if stepping.keeps else ()
    span = HermiteStep(place.t, place.state, begin.seen.rate, *ends) if stepping.keeps else ()
    if loop.changes:
        ends = (begin.seen.signals.recorded, begin.recorded), (end.seen.signals.recorded, end.recorded)
        step = build_passages(*(RecordedSignals(*both) for both in zip((place.t, t), ends, strict=True)))
        clock, state = Clock(t, stepping.h, one.k, key, strikes), borrow(state, logs)
        state = borrow(_commit_changes(system, clock, state, end.seen.margins, one.triggered, step), None)
    return ReplayState(t, shift, state, accumulators, one.k), span


def _with_flow(place: ReplayState, z: Any) -> tuple[LoopState, Accumulators]:
    """State and accumulators with other continuous memories, not projected: a projection may end at a comparison."""
    return place.state.with_flow(z[0]), {
        name: memory._replace(flow=z[1][name]) for name, memory in place.accumulators.items()
    }


def _shift(end: LoopEvaluationWithRates, one: StepLog, strikes: Any) -> Any:
    """How much later [s] than its noted end a step has come to its event, or to the comparison that changes there; 0
    where there is none, or a clock decides."""
    shift, most = jnp.zeros_like(one.length), MAX_SHIFT_FRACTION * one.base
    for comparison in end.comparisons:
        on = comparison.numbers == one.lands
        each = (jnp.ravel(jnp.asarray(x)) for x in (on, comparison.value, comparison.rate))
        for which, margin, rate in zip(*each, strict=True):
            close, later = _time_to_zero(which, margin, rate, most)
            shift = jnp.where(close, later, shift)
    shift = jnp.where(strikes, 0.0, shift)
    events = zip(jax.tree.leaves(end.seen.margins), jax.tree.leaves(end.falls), strict=True)
    for i, (margin, fall) in reversed(list(enumerate(events))):
        close, later = _time_to_zero(one.triggered & (1 << i) != 0, margin, fall, most)
        shift = jnp.where(close, later, shift)
    return shift


def _time_to_zero(on: Any, margin: Any, fall: Any, most: Any) -> tuple[Any, Any]:
    """Whether a margin is zero within so many seconds, and in how many."""
    close = on & (jnp.abs(margin) < jnp.abs(jax.lax.stop_gradient(most) * fall))
    return close, -margin / jax.lax.stop_gradient(jnp.where(close, fall, 1.0))  # the margin is 0, but for rounding


def _commit_changes(
    system: Dynamics, clock: Clock, state: LoopState, margins: Margins, fired: Any, step: dict[str, Passage]
) -> LoopState:
    """The state after the events and the ticks at the end of a step."""
    signals = system.loop.signals(clock.t, state)
    leaves, tree = jax.tree.flatten(margins)
    happens = tree.unflatten([fired & (1 << i) != 0 for i in range(len(leaves))])
    return system.loop.change(clock, state, signals, margins, happens, step)
