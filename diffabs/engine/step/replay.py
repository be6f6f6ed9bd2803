"""Derivatives of a run with adaptive steps. The run is made once for its values and logged, and then its steps are
replayed.

    log        for each attempt: whether it was accepted, the time at its end, its mode and the next one, and the
               comparison, events and clock instant at its end
    replay     the same attempts within the same modes, which are smooth. If a comparison changes or an event happens at
               the end of a step, the step ends at the zero of its margin g. Newton's step -g/(dg/dt) from the logged
               end has the derivative of the event's time, by the implicit function theorem

The derivative treats the logged lengths as constants. Only ends on events and switching surfaces move.

Under XLA, both modes log the whole run and then replay it. Forward mode in a kernel replays each attempt at once
(`LaggedReplayStepping`). It keeps only the present state, so the memory of many runs does not grow with their steps.
"""

import dataclasses
import math
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.lanes import any_lane, select
from diffabs.core.types import Array, Bool, Int, Key, PyTree, Scalar
from diffabs.engine.hybrid import HybridState, HybridSystem
from diffabs.engine.solvers import ADAPTIVE_ERROR_ORDER, Adaptive
from diffabs.engine.step.adaptive import AdaptiveStepping, StateSpan, clip_rtol, next_span
from diffabs.engine.step.advance import Carry, Decision, advance, cast_floats, start_carry
from diffabs.engine.step.attempt import Attempt, StepRequest
from diffabs.engine.step.event_location import RunStatus
from diffabs.engine.step.modes import ModeBits, SlidingSurface, mode_in_step, pick_number
from diffabs.engine.step.runge_kutta import TSIT5
from diffabs.engine.step.slides import along_of, is_return
from diffabs.engine.step.switching import Replayed
from diffabs.engine.step.system import Evaluation, Objectives, ObservedSystem

T = TypeVar("T")


# Capacity of the log: attempts at an rtol of 1e-5, and attempts for each instant of a grid with clocks.
BASE_LOG_CAPACITY, LOG_CAPACITY_PER_TICK = 4096, 3
# Fraction of `base`. A longer Newton step to an event is ignored, because its margin hardly falls.
MAX_SHIFT_FRACTION = 1e-3


class StepLog(NamedTuple):
    """Log of the attempts of a run, one entry for each.

    Attributes:
        accepted: True if the attempt was accepted.
        t: Time at its end [s].
        length: Length [s].
        base: Length of the first attempt from the same point [s].
        k: Number of the grid instant at which a clock struck last.
        triggered: Bit mask of the events at its end.
        words: Mode of the step.
        next_words: Mode of the next step.
        along: Comparisons along whose surfaces the step slides (`Mode.along`).
        next_along: Those of the next step.
        unrestricted: True if the step has no mode.
        lands: Number of the comparison that changes at its end, or -1.
        begins_at_zero: True if it lands on a margin that is zero at its beginning, with a slope near zero or because
            the run has just landed on the same surface.
        refresh: True for a step of length 0 that evaluates the rates.
        over: True if the run ends there.
    """

    accepted: Bool
    t: Array
    length: Scalar
    base: Array
    k: Int
    triggered: Int
    words: ModeBits
    next_words: ModeBits
    along: tuple[SlidingSurface, ...]
    next_along: tuple[SlidingSurface, ...]
    unrestricted: Bool
    lands: Int
    begins_at_zero: Bool
    refresh: Bool
    over: Bool


class ReplayControl(NamedTuple):
    """Numbers of `ReplayStepping` in a carry.

    Attributes:
        delay: Time of the replay minus the logged time [s].
        last_step: Last step, a `StateSpan`; () without a trajectory.
    """

    delay: Scalar
    last_step: StateSpan | tuple[()]


@dataclasses.dataclass(frozen=True)
class ReplayStepping:
    """Steps that repeat one logged attempt.

    Attributes:
        live: Stepping method of the logged run.
        entry: Log entry of the attempt, a `StepLog`; None at the start.
    """

    live: AdaptiveStepping
    entry: Any = None
    switches = Replayed()
    tableau, has_margin_rates, second_order = TSIT5, True, False
    shows_comparisons = True

    @property
    def h(self) -> Array:
        """Step of the grid [s]."""
        return self.live.h

    def start(self, hybrid: HybridSystem, objectives: Objectives, key: Key) -> Carry:
        """Return the carry of a replay at t = 0, from `hybrid`, `objectives` and random `key`."""
        carry = start_carry(self, hybrid, objectives, key)
        control = ReplayControl(jnp.zeros_like(self.h), ())
        # A run whose start is over has no logged attempt.
        running = jnp.asarray(RunStatus.RUNNING.value)
        return cast_floats(carry._replace(control=control, search=(), status=running), self.h.dtype)

    def step(self, hybrid: HybridSystem, objectives: Objectives, key: Key, carry: Carry, entry: StepLog) -> Carry:
        """Return the `carry` after the logged attempt `entry`, unchanged if the attempt was not accepted."""
        return advance(dataclasses.replace(self, entry=entry), hybrid, objectives, key, carry)

    def is_active(self, carry: Carry, until: Int | None) -> Bool:
        """Return True if the logged attempt was accepted; `carry` and `until` have no influence."""
        del carry, until
        return self.entry.accepted

    def is_calm(self, carry: Carry) -> Bool:
        """Return True: a replay of `carry` looks for no slide."""
        del carry
        return jnp.asarray(True)

    def propose(self, system: ObservedSystem, carry: Carry) -> StepRequest:
        """Return the logged attempt.

        If the last step ended late, this one is shorter: it aims at the logged time, and `shift_end` may move its end.
        An attempt that was not accepted becomes a step of length 0. It may have invalid numbers, which reverse mode in
        a batch would multiply by 0.
        """
        entry, k = self.entry, carry.k
        h = jnp.where(entry.refresh | ~entry.accepted, 0.0, entry.length - carry.control.delay)
        end = jnp.where(entry.refresh, carry.point.t, entry.t)
        step, next = (entry.words, entry.along), (entry.next_words, entry.next_along)
        words, along = select(entry.refresh, next, step)
        mode = mode_in_step(words, entry.unrestricted)._replace(along=along)
        strikes = entry.k != k

        def shift_end(end: Evaluation) -> Scalar:
            # The zero of such a margin moves with the beginning of the step. A quotient by its slope would magnify the
            # rounding of its derivative.
            with_start = entry.begins_at_zero & ~strikes
            return jnp.where(with_start, carry.control.delay, _time_to_event(entry, strikes, end))

        return StepRequest(h, end, self.h, mode, entry.refresh, strikes, entry.k, shift_end)

    def forecast(self, carry: Carry, dynamics: Evaluation) -> PyTree:
        """Return nothing: the log says where steps end."""
        del carry, dynamics
        return ()

    def report(
        self, system: ObservedSystem, carry: Carry, h: Scalar, dynamics: Evaluation, state: HybridState, error: object
    ) -> PyTree:
        """Return nothing: the log has the decisions."""
        del system, carry, h, dynamics, state, error
        return ()

    def decide(
        self, system: ObservedSystem, carry: Carry, request: StepRequest, attempt: Attempt, active: Bool
    ) -> Decision:
        """Return the logged decision on the `attempt`, with the mode that was logged."""
        entry, no = self.entry, jnp.asarray(False)
        margins, tree = jax.tree.flatten(attempt.point.margins)
        triggered = tree.unflatten([entry.triggered & (1 << i) != 0 for i in range(len(margins))])
        mode = mode_in_step(entry.next_words, no)._replace(along=entry.next_along)
        return Decision(active, active, no, entry.lands >= 0, triggered, mode, entry.over)

    def plan_next(
        self, system: ObservedSystem, carry: Carry, attempt: Attempt, decision: Decision, after: Carry
    ) -> Carry:
        """Return the carry `after` an `attempt` with the new delay behind the log."""
        delay, last = carry.control
        delay = jnp.where(decision.accepted & ~self.entry.refresh, attempt.shift, delay)
        return after._replace(control=ReplayControl(delay, next_span(last, carry, attempt, decision)))


class LaggedReplay(NamedTuple):
    """A run for values, with a replay that follows it step by step.

    Attributes:
        ahead: Carry of the run for values.
        behind: Carry of the replay.
        entry: Log entry of the last attempt.
    """

    ahead: Carry
    behind: Carry
    entry: StepLog

    running = property(lambda self: self.ahead.running, doc="True if the run for values needs another attempt.")
    slides = property(lambda self: self.ahead.slides, doc="Watch for slides of the run for values.")
    status = property(lambda self: self.ahead.status, doc="Status of the run for values.")
    point = property(lambda self: self.behind.point, doc="Point of the replay.")


@partial(jax.tree_util.register_dataclass, data_fields=["live"], meta_fields=[])
@dataclasses.dataclass(frozen=True)
class LaggedReplayStepping:
    """Steps of `Adaptive` with forward derivatives: each attempt is made for its values and replayed at once.

    Reverse mode needs the steps in the opposite order, and therefore a log.

    Attributes:
        live: Stepping method of the logged run.
    """

    live: AdaptiveStepping

    def start(self, hybrid: HybridSystem, objectives: Objectives, key: Key) -> LaggedReplay:
        """Return the carry of a run at t = 0, from `hybrid`, `objectives` and random `key`."""
        ahead = self.live.start(_stop_gradients(hybrid), _stop_gradients(objectives), key)
        return LaggedReplay(ahead, ReplayStepping(self.live).start(hybrid, objectives, key), log_attempt(ahead, ahead))

    def step(self, hybrid: HybridSystem, objectives: Objectives, key: Key, carry: LaggedReplay) -> LaggedReplay:
        """Return the `carry` after one attempt of the run for values, and its replay if the attempt was accepted."""
        # The run ahead only chooses the steps. All derivatives pass through the replay.
        old = _stop_gradients(carry.ahead)
        new = _stop_gradients(self.live.step(_stop_gradients(hybrid), _stop_gradients(objectives), key, old))
        after = LaggedReplay(new, carry.behind, log_attempt(old, new))

        def repeat() -> Carry:
            return self.repeat(hybrid, objectives, key, after).behind

        return after._replace(behind=jax.lax.cond(any_lane(after.entry.accepted), repeat, lambda: after.behind))

    def repeat(self, hybrid: HybridSystem, objectives: Objectives, key: Key, carry: LaggedReplay) -> LaggedReplay:
        """Return the `carry` after the replay of its last attempt. Only this part of a step has derivatives."""
        return carry._replace(behind=ReplayStepping(self.live).step(hybrid, objectives, key, carry.behind, carry.entry))

    def renew(self, hybrid: HybridSystem, carry: LaggedReplay) -> LaggedReplay:
        """Return the `carry` with a new stability limit of the `hybrid` if the last one is too old."""
        return carry._replace(
            ahead=_stop_gradients(self.live.renew(_stop_gradients(hybrid), _stop_gradients(carry.ahead)))
        )


def log_capacity(hybrid: HybridSystem, solver: Adaptive) -> int:
    """Return the capacity of the log of a run, in attempts."""
    rtol = float(clip_rtol(np.asarray(solver.rtol, float)))
    return math.ceil(BASE_LOG_CAPACITY * max(1.0, 1e-5 / rtol) ** (1 / ADAPTIVE_ERROR_ORDER)) + (
        LOG_CAPACITY_PER_TICK * solver.steps if hybrid.ticks else 0
    )


def log_attempt(old: Carry, new: Carry) -> StepLog:
    """Return the log entry of the attempt between two carries."""
    accepted, triggered = new.control.accepted, new.control.triggered
    landing = old.status == RunStatus.LANDING
    lands = jnp.where(landing & accepted & (triggered == 0), old.search.number, -1)
    return StepLog(
        accepted=accepted,
        t=new.point.t,
        length=old.length,
        base=old.base,
        k=new.k,
        triggered=triggered,
        words=old.point.words,
        next_words=new.point.words,
        along=along_of(old),
        next_along=along_of(new),
        unrestricted=old.unrestricted,
        lands=lands,
        begins_at_zero=landing & old.search.at_once & ((old.search.fall == 0) | is_return(old, lands)),
        refresh=old.status == RunStatus.REFRESHING,
        over=~new.running,
    )


def states_between(spans: StateSpan, accepted: Bool, instants: Array) -> HybridState:
    """Return the states at the times `instants` (n,) [s], leaves (n, ...), from the steps of a replayed run.

    The spans have leaves (blocks, attempts, ...). That of an attempt that was not `accepted` (blocks, attempts) is that
    of the last accepted one, or zero in a block without one.
    """
    begins = jax.lax.stop_gradient(spans.flow.start)
    begins = jnp.where(jnp.any(accepted, axis=1)[:, None], begins, jnp.inf).ravel()
    spans = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), spans)
    # A block without an accepted attempt may lie between others: sorting moves all of them to the end.
    order = jnp.argsort(begins)
    place = order[jnp.searchsorted(begins[order], instants, side="right") - 1]
    return jax.vmap(StateSpan.at)(jax.tree.map(lambda x: x[place], spans), instants)


def _time_to_event(entry: StepLog, strikes: Bool, end: Evaluation) -> Scalar:
    """Return the time [s] from the logged end of a step to its event or to the zero of its comparison; 0 without.

    It is also 0 for a comparison if a clock determines the end; an event there keeps its time.
    """
    shift, longest = jnp.zeros_like(entry.length), MAX_SHIFT_FRACTION * entry.base
    surfaces = end.surfaces
    assert surfaces.rates is not None
    margin, rate = (pick_number(surfaces.numbers, entry.lands, x) for x in (surfaces.values, surfaces.rates))
    close, later = _time_to_zero(entry.lands >= 0, margin, rate, longest)
    shift = jnp.where(close, later, shift)
    # A clock fixes the time of a crossing, but events come last: an event decides even at a clock's instant.
    shift = jnp.where(strikes, 0.0, shift)
    events = zip(jax.tree.leaves(end.margins), jax.tree.leaves(end.margin_rates), strict=True)
    for i, (margin, fall) in reversed(list(enumerate(events))):
        close, later = _time_to_zero(entry.triggered & (1 << i) != 0, margin, fall, longest)
        shift = jnp.where(close, later, shift)
    return shift


def _time_to_zero(on: Bool, margin: Scalar, fall: Scalar, longest: Scalar) -> tuple[Bool, Scalar]:
    """Return True if the margin is sought (`on`) and zero within `longest` seconds, and the time to its zero [s]."""
    close = on & (jnp.abs(margin) < jnp.abs(jax.lax.stop_gradient(longest) * fall))
    # The fall may be frozen: its derivative is multiplied by the margin, which is 0 except for rounding.
    return close, -margin / jax.lax.stop_gradient(jnp.where(close, fall, 1.0))


def _stop_gradients(tree: T) -> T:
    return jax.tree.map(jax.lax.stop_gradient, tree)


def refuse_derivative(hybrid: HybridSystem, objectives: Objectives, method: object) -> None:
    """Raise a ValueError if an objective of a run would have a wrong derivative.

    It is that of an objective that `counts_kinks`, behind a pure delay with adaptive steps.
    """
    if isinstance(method, AdaptiveStepping) and hybrid.recorders:
        # Rounding moves the kinks of the delayed command between the logged run and its replay.
        counting = {name: part for name, part in objectives.items() if getattr(part, "counts_kinks", False)}
        if counting:
            kinds_of_parts = ", ".join(sorted({type(part).__name__ for part in counting.values()}))
            raise ValueError(
                f"{', '.join(counting)}: {kinds_of_parts} has no derivative behind a pure delay with adaptive steps."
                " Leave it out, or use d.FixedStep"
            )
