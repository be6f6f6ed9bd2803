"""Derivatives of a run with adaptive steps: the run is made once for its values and logged, and then its steps are
replayed.

    log        for each step: the time at its end, its mode, and the comparison, events and clock instant at its end
    replay     the same steps within the same modes, which are smooth. If a comparison changes or an event happens at
    the
               end of a step, the step ends at the zero of its margin g. Newton's step -g/(dg/dt) from the logged end
               has the derivative of the event's time, by the implicit function theorem

So the derivative is that of a run whose steps end at the logged times, or on its switching surfaces and events. The
lengths of all other steps are constants.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.blocks import Passage
from diffabs.core.log import borrow, log_rows, write_last_rows
from diffabs.core.loop import Loop, LoopState, Margins
from diffabs.core.numerics import axpy
from diffabs.core.protocols import Clock, Memory, Segment, Shown
from diffabs.core.types import Matrix, PyTree, Scalar
from diffabs.simulate.drive.checkpoint import any_lane, rematerialise
from diffabs.simulate.drive.loops import STEPS_PER_BLOCK
from diffabs.simulate.result import observe
from diffabs.simulate.step.adaptive import build_passages
from diffabs.simulate.step.attempt import start_state
from diffabs.simulate.step.event_location import select
from diffabs.simulate.step.fixed import cast_floats
from diffabs.simulate.step.methods import AdaptiveStepping
from diffabs.simulate.step.modes import Mode, ModeBits
from diffabs.simulate.step.span import HermiteStep
from diffabs.simulate.step.status import RunStatus, is_running
from diffabs.simulate.step.system import (
    Accumulators,
    Dynamics,
    LoopEvaluationWithRates,
    Objectives,
    build_dynamics,
    split_flow_and_held,
)
from diffabs.simulate.step.tries import AdaptiveCarry
from diffabs.simulate.step.tsit5 import tsit5_step_from
from diffabs.simulate.types import ADAPTIVE_ERROR_ORDER, Adaptive, Trajectory

# Capacity of the log: attempts at an rtol of 1e-5, and attempts for each instant of a grid with clocks.
BASE_LOG_CAPACITY, LOG_CAPACITY_PER_TICK = 4096, 3
# Fraction of the attempt with the first sign of an event. No event or crossing at the end of a step is farther from its
# zero than this: a larger Newton step would come from a margin that hardly falls.
MAX_SHIFT_FRACTION = 1e-3


class StepLog(NamedTuple):
    """Log of the attempts of a run, in blocks of shape (blocks, `STEPS_PER_BLOCK`, ...).

    Attributes:
        moved: True if the attempt was accepted.
        t: Time at its end [s].
        length: Length [s].
        base: Length of the first attempt from the same point [s].
        k: Number of the grid instant at which a clock struck last.
        triggered: Bit mask of the events at its end.
        words: Mode of the step.
        unrestricted: True if the step has no mode.
        lands: Number of the comparison that changes at its end, or -1.
    """

    moved: Any
    t: Scalar
    length: Scalar
    base: Scalar
    k: Scalar
    triggered: PyTree
    words: ModeBits
    unrestricted: Scalar
    lands: Scalar


class ReplayState(NamedTuple):
    """A replay in progress.

    Attributes:
        t: Time [s].
        late: Difference between this time and the logged time [s].
        state: State of the loop.
        accumulators: Accumulators of the objectives.
        k: Number of the grid instant at which a clock struck last.
    """

    t: Scalar
    late: Scalar
    state: LoopState
    accumulators: Accumulators
    k: Scalar


class RecordedSignals(NamedTuple):
    """Signals that blocks record at an instant, and their rates.

    Attributes:
        t: Time [s].
        recorded: Signals and their rates, each by block.
    """

    t: Scalar
    recorded: tuple[dict[str, PyTree], dict[str, PyTree]]


class ReplayedRun(NamedTuple):
    """A replayed run that is over, as `finish_run` expects it.

    Attributes:
        point: State at the end.
        status: Status of the run.
    """

    point: ReplayState
    status: Scalar

    running = property(is_running)  # always False


def log_capacity(loop: Loop, solver: Adaptive) -> int:
    """Return the capacity of the log of a run, in attempts.

    Args:
        loop: Closed loop.
        solver: Solver of the run.
    """
    return math.ceil(BASE_LOG_CAPACITY * max(1.0, 1e-5 / solver.rtol) ** (1 / ADAPTIVE_ERROR_ORDER)) + (
        LOG_CAPACITY_PER_TICK * solver.steps if loop.ticks else 0
    )


def log_attempt(old: AdaptiveCarry, new: AdaptiveCarry) -> StepLog:
    """Return the log entry of one attempt.

    Args:
        old: Carry before the attempt.
        new: Carry after the attempt.
    """
    moved = (new.point.t > old.point.t) | (new.triggered != 0)
    landed = (old.status == RunStatus.LANDING) & (new.triggered == 0)
    lands = jnp.where(landed, old.search.which, -1)
    return StepLog(
        moved, new.point.t, old.length, old.base, new.k, new.triggered, old.point.words, old.unrestricted, lands
    )


def log_steps(
    loop: Loop, objectives: Objectives, stepping: AdaptiveStepping, key: PyTree, tries: int
) -> tuple[StepLog, PyTree]:
    """Return the log of a run and its status at the end; a run with more attempts than the capacity has diverged.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by the names of their metrics.
        stepping: Stepping method of the logged run.
        key: Random key, or None.
        tries: Capacity of the log in attempts.
    """

    def one(carry: AdaptiveCarry, _: Any) -> tuple[AdaptiveCarry, StepLog]:
        new = stepping.step(loop, objectives, key, carry)
        return new, log_attempt(carry, new)

    def some(carry: AdaptiveCarry) -> tuple[AdaptiveCarry, StepLog]:
        return jax.lax.scan(one, stepping.renew(loop, carry), length=STEPS_PER_BLOCK)

    carry = stepping.start(loop, objectives, key)
    carry, notes = _scan_active(some, lambda carry, _: carry.running, carry, None, -(-tries // STEPS_PER_BLOCK))

    notes = jax.tree.map(jax.lax.stop_gradient, notes)
    return notes, jnp.where(carry.running, RunStatus.DIVERGED, carry.status)


def _scan_active(
    work: Any, on: Scalar, carry: PyTree, xs: PyTree, length: int | None = None, reverse: bool = False
) -> PyTree:
    """Return the result of a scan of work(carry) or, with xs, work(carry, x), with the steps skipped if no run is
    on(carry, x).

    A skipped step returns zeros.
    """

    def body(carry: PyTree, x: Scalar) -> tuple[PyTree, PyTree]:
        def run() -> tuple[PyTree, PyTree]:
            return work(carry) if x is None else work(carry, x)

        def skip() -> tuple[PyTree, PyTree]:
            return carry, jax.tree.map(lambda y: jnp.zeros(y.shape, y.dtype), jax.eval_shape(run)[1])

        return jax.lax.cond(any_lane(on(carry, x)), run, skip)

    return jax.lax.scan(body, carry, xs, length=length, reverse=reverse)


def replay_run(
    loop: Loop, objectives: Objectives, stepping: AdaptiveStepping, key: PyTree, notes: StepLog, status: Scalar
) -> ReplayedRun:
    """Return the replayed run, differentiable with respect to every leaf of loop and objectives.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by the names of their metrics.
        stepping: Stepping method of the logged run.
        key: Random key, or None.
        notes: Log of the run.
        status: Status of the logged run at its end.
    """
    return ReplayedRun(_replay_steps(loop, objectives, stepping, key, notes)[0], status)


def replay_with_trajectory(
    loop: Loop,
    objectives: Objectives,
    stepping: AdaptiveStepping,
    key: PyTree,
    notes: StepLog,
    status: Scalar,
    instants: PyTree,
) -> tuple[ReplayedRun, Trajectory, Trajectory]:
    """Return the replayed run, the sample at its beginning, and the samples at these instants of the grid.

    The cubics of the steps give the samples.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by the names of their metrics.
        stepping: Stepping method of the logged run.
        key: Random key, or None.
        notes: Log of the run.
        status: Status of the logged run at its end.
        instants: Numbers of the grid's instants, shape (n,).
    """
    last, spans = _replay_steps(loop, objectives, stepping, key, notes)
    # Skipped blocks are zero and come after the end: infinity keeps the start times sorted for the search.
    starts = jnp.where(jnp.any(notes.moved, axis=1)[:, None], jax.lax.stop_gradient(spans.t), jnp.inf)
    spans = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), spans)

    def observe_at(instant: Scalar) -> Trajectory:
        t = instant * stepping.h
        place = jnp.searchsorted(starts.ravel(), t, side="right") - 1
        span = jax.tree.map(lambda x: x[place], spans)
        return observe(loop, t, span.at(t), t < jax.lax.stop_gradient(last.t))

    first = observe(loop, 0.0 * stepping.h, jax.tree.map(lambda x: x[0], spans.state), jnp.asarray(True))
    return ReplayedRun(last, status), first, jax.vmap(observe_at)(instants)


def _replay_steps(
    loop: Loop, objectives: Objectives, stepping: AdaptiveStepping, key: PyTree, notes: StepLog
) -> tuple[ReplayState, PyTree]:
    """Return the state at the end of the run and, with a trajectory, the `HermiteStep` of each attempt."""
    begun = start_replay(loop, objectives, stepping, key)

    def step(place: ReplayState, one: StepLog) -> tuple[ReplayState, PyTree]:
        return replay_attempt(loop, objectives, stepping, key, place, one)

    # Checkpoints on both levels: memory for the states of the blocks plus those of one block.
    @rematerialise
    def block(place: ReplayState, some: StepLog) -> tuple[ReplayState, PyTree]:
        return jax.lax.scan(rematerialise(step), place, some)

    return _scan_active(block, lambda _, some: jnp.any(some.moved), begun, notes)


def start_replay(loop: Loop, objectives: Objectives, stepping: AdaptiveStepping, key: PyTree) -> ReplayState:
    """Return the state of a replay at t = 0.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by the names of their metrics.
        stepping: Stepping method of the logged run.
        key: Random key, or None.
    """
    zero = 0.0 * stepping.h
    state, accumulators = start_state(loop, objectives, Clock(zero, stepping.h, 0, key))
    return cast_floats(
        ReplayState(zero, zero, borrow(state, log_rows(state)), accumulators, jnp.asarray(0)), stepping.h.dtype
    )


def replay_attempt(
    loop: Loop, objectives: Objectives, stepping: AdaptiveStepping, key: PyTree, place: ReplayState, one: StepLog
) -> tuple[ReplayState, PyTree]:
    """Return the state after a logged attempt, unchanged if the attempt was not accepted, and with a trajectory its
    `HermiteStep`.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by the names of their metrics.
        stepping: Stepping method of the logged run.
        key: Random key, or None.
        place: State before the attempt.
        one: Log entry of the attempt.
    """
    logs, place = write_last_rows(place.state), place._replace(state=borrow(place.state, None))
    new, span = _step(loop, objectives, stepping, key, place, one, logs)
    place = select(one.moved, new, place)
    return place._replace(state=borrow(place.state, logs)), span


def _step(
    loop: Loop,
    objectives: Objectives,
    stepping: AdaptiveStepping,
    key: PyTree,
    place: ReplayState,
    one: StepLog,
    logs: list[PyTree],
) -> tuple[ReplayState, PyTree]:
    """Return the state after one step within its mode, with the changes at its end, and with a trajectory its
    `HermiteStep`.

    The state is without the rows of the blocks' logs, `logs`.
    """
    system = build_dynamics(loop, objectives, place.t, place.state, place.accumulators, kinks=True)
    within, h = Mode(one.words, one.unrestricted), one.length - place.late
    begin = system.ahead(place.t, place.state, place.accumulators, within)
    z, held = split_flow_and_held(place.state, place.accumulators)

    def flow(t: Scalar, z: Matrix, given: tuple[PyTree, Mode]) -> Any:
        return system.rates(t, z, *given)

    # `h` is the logged length less the shift of the step's beginning: the step still ends at the logged time.
    z = tsit5_step_from(flow, place.t, z, begin.seen[:2], h, (held, within))
    noted_end = system.ahead(one.t, *_with_flow(place, z), within)
    strikes = (one.k != place.k) & (one.k < stepping.steps)
    shift = _shift(noted_end, one, one.k != place.k)
    t = one.t + shift
    z = axpy(shift, noted_end.seen[:2], z)
    state, accumulators = _with_flow(place, z)
    end = system.ahead(t, state, accumulators, within)  # second evaluation: the rates must be those of the shifted end
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


def _with_flow(place: ReplayState, z: Matrix) -> tuple[LoopState, Accumulators]:
    """Return state and accumulators with other integrated values, without projection: a projection may end on a
    switching surface.
    """
    return place.state.with_flow(z[0]), {
        name: memory._replace(flow=z[1][name]) for name, memory in place.accumulators.items()
    }


def _shift(end: LoopEvaluationWithRates, one: StepLog, strikes: Scalar) -> Scalar:
    """Return the time [s] from the logged end of a step to its event or to the zero of its comparison.

    The time is 0 without an event or comparison, or if a clock determines the end.
    """
    shift, most = jnp.zeros_like(one.length), MAX_SHIFT_FRACTION * one.base
    for comparison in end.comparisons:
        on = comparison.numbers == one.lands
        each = (jnp.ravel(jnp.asarray(x)) for x in (on, comparison.value, comparison.rate))
        for which, margin, rate in zip(*each, strict=True):
            close, later = _time_to_zero(which, margin, rate, most)
            shift = jnp.where(close, later, shift)
    # A clock fixes the time of a crossing, but events come last: an event decides even at a clock's instant.
    shift = jnp.where(strikes, 0.0, shift)
    events = zip(jax.tree.leaves(end.seen.margins), jax.tree.leaves(end.falls), strict=True)
    for i, (margin, fall) in reversed(list(enumerate(events))):
        close, later = _time_to_zero(one.triggered & (1 << i) != 0, margin, fall, most)
        shift = jnp.where(close, later, shift)
    return shift


def _time_to_zero(on: Scalar, margin: Scalar, fall: Scalar, most: Scalar) -> tuple[PyTree, PyTree]:
    """Return True if a margin is zero within `most` seconds, and the time to its zero [s]."""
    close = on & (jnp.abs(margin) < jnp.abs(jax.lax.stop_gradient(most) * fall))
    # The fall may be frozen: its derivative is multiplied by the margin, which is 0 except for rounding.
    return close, -margin / jax.lax.stop_gradient(jnp.where(close, fall, 1.0))


def _commit_changes(
    system: Dynamics, clock: Clock, state: LoopState, margins: Margins, fired: Any, step: dict[str, Passage]
) -> LoopState:
    """Return the state after the events and ticks at the end of a step."""
    signals = system.loop.signals(clock.t, state)
    leaves, tree = jax.tree.flatten(margins)
    happens = tree.unflatten([fired & (1 << i) != 0 for i in range(len(leaves))])
    return system.loop.change(clock, state, signals, margins, happens, step)
