"""A field with its events as a hybrid system.

    dy/dt = field(t, y, args),  y(t0) = y0
    where condition(t, y, args) falls through zero:  y <- reset(t, y, args), or the solution ends

The engine makes the run of a `FieldSystem` in the time s = (t - t0)/(t1 - t0) from 0 to 1:

    dy/ds = (t1 - t0) field(t0 + (t1 - t0) s, y, args)

So one program serves every span, t0 and t1 have derivatives, and time may run backwards.

Where an event happens its condition is zero, and rounding decides its sign. If the condition rises after the event, as
at a bounce, the next fall is an event again. If it falls on, and no reset has set it, it must rise through zero first.
A condition that a reset sets to zero counts as positive, as at the start. A small constant, the lift, is added to the
condition up to its next event and makes its sign agree.
"""

import dataclasses
import enum
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.cubic import Cubic
from diffabs.core.lanes import any_lane, select
from diffabs.core.protocols import Clock, Ending, Memory, Objective, Segment
from diffabs.core.pytree import param, part, pytree, static
from diffabs.core.types import Array, Bool, Int, PyTree, Scalar
from diffabs.engine.hybrid import Fired, Margins
from diffabs.engine.step.attempt import Point

# Fractions of the span. A landing is at most `LANDING_FRACTION` from the zero of its condition. A run is `CROWDED`
# after `MAX_QUICK_EVENTS` instants of events, each within that time of the one before. A save at most
# `COINCIDENCE_FRACTION` before an event has the state after it.
LANDING_FRACTION, MAX_QUICK_EVENTS, COINCIDENCE_FRACTION = 1e-7, 8, 1e-10
# The lift: time in which the condition moves as far, as a fraction of the span, and multiples of the rounding.
LIFT_FRACTION, LIFT_EPS = 1e-12, 32
SAME_RATE_FRACTION = 1e-6  # a reset that changes the rate of a condition by less leaves the condition as it is
Field = Callable[..., PyTree]  # of (t, y, args)


class SolutionStatus(enum.IntEnum):
    """How a solution ended; up to `TERMINATED`, its numbers are valid.

    Attributes:
        FINISHED: It reached t1.
        TERMINATED: A terminal event ended it.
        DIVERGED: A number is not finite, no step meets its tolerance, or the steps would be too many; with fixed steps
            also if a rate runs away within a step.
        SLID: It slides along a switching surface of the field, or crosses surfaces ever faster; with fixed steps also
            if a step is too long for the field beyond a surface.
        CROWDED: Events follow each other without end, as the bounces of a ball that comes to rest, or where a reset
            sets its own condition to zero and it falls.
        GRAZED: A switching surface or the zero of a condition is only touched, or a condition jumps.
    """

    FINISHED, TERMINATED, DIVERGED, SLID, CROWDED, GRAZED = range(6)


@dataclasses.dataclass(frozen=True)
class Event:
    """An event where a condition falls through zero.

    Attributes:
        condition: Function of (t, y, args): a continuous number. It falls along the run, so backwards in time if
            t1 < t0. A zero at the start, or set by a reset, counts as positive.
        reset: Function of (t, y, args) that returns the state after the event; None leaves the state.
        terminal: True if the event ends the solution, without a reset. It happens, too, where the reset of another
            event makes its condition negative.
    """

    condition: Field
    reset: Field | None = None
    terminal: bool = False


class EventMemory(NamedTuple):
    """Held memory of the events that do not end a solution.

    Attributes:
        counts: Number of events of each kind, shape (events,), as floats.
        times: Times of the first ones in units of the span, shape (events, kept).
        lifts: Numbers that are added to the conditions, shape (events,).
        last: Time of the last event in units of the span.
        quick: Number of successive instants of events, each at once after the one before.
        fault: `SolutionStatus` that ends the run, as a float; 0 for none.
        ends: Number of the terminal event that a reset has made happen, from 1, as a float; 0 for none.
    """

    counts: Array
    times: Array
    lifts: Array
    last: Scalar
    quick: Scalar
    fault: Scalar
    ends: Scalar


class FieldState(NamedTuple):
    """The state of a `FieldSystem`.

    Attributes:
        y: State of the field.
        events: Memory of its events, an `EventMemory`.
    """

    y: PyTree
    events: Any

    def flow(self) -> PyTree:
        """Return the state of the field."""
        return self.y

    def memories(self) -> Any:
        """Return the memory of the events."""
        return self.events

    def with_flow(self, flow: PyTree) -> "FieldState":
        """Return the state with another state of the field."""
        return self._replace(y=flow)


class FieldSample(NamedTuple):
    """Time, in units of the span, and state of a field."""

    t: Scalar
    y: PyTree

    def show(self) -> "FieldSample":
        """Return all of it."""
        return self

    def error_controlled_signals(self) -> tuple[()]:
        """Return nothing: the states' errors alone limit a step."""
        return ()

    signal_scales = error_controlled_signals


class FieldSignals(NamedTuple):
    """The signals of a field; nothing is recorded."""

    sample: FieldSample
    recorded: dict[str, PyTree]


@dataclasses.dataclass(frozen=True)
class Function:
    """A function of the user, of (t, y, args): equal to another one that computes the same.

    Attributes:
        key: Operations and constants of the function, as they are at this call of `solve`.
        call: The function, of (t, y, args), or of (t, y, args, constants) with the constants of its closure.
        place: Place of its constants in the list of all; None if it closes over nothing that is traced.
    """

    key: Any
    call: Callable = dataclasses.field(compare=False)
    place: int | None = None

    def __call__(self, t: Array, y: object, args: object, constants: list[PyTree]) -> PyTree:
        """Return the result at (`t`, `y`, `args`), with the type of `t`, and the `constants` of all functions."""
        values = self.call(t, y, args) if self.place is None else self.call(t, y, args, constants[self.place])
        return jax.tree.map(lambda x: jnp.asarray(x, t.dtype), values)


class FieldCode(NamedTuple):
    """The functions of a solution.

    Attributes:
        field: The field.
        events: The events, whose functions are `Function`s, too.
    """

    field: "Function"
    events: tuple[Event, ...]

    @property
    def inner(self) -> list[Event]:
        """The events that do not end the solution."""
        return [event for event in self.events if not event.terminal]

    @property
    def terminal(self) -> list[Event]:
        """The events that end the solution."""
        return [event for event in self.events if event.terminal]


@pytree
class FieldSystem:
    """A field with its events as a hybrid system (`hybrid.HybridSystem`), in the time s."""

    inputs: dict[str, PyTree] = part()
    """Pytree of y0, t0, t1, args, and the constants of the functions."""
    code: FieldCode = static()
    """The functions."""
    times_per_event: int = static()
    """Number of times that are kept of each event."""

    @property
    def ticks(self) -> bool:
        """Whether there is a clock: no."""
        return False

    @property
    def jumps(self) -> bool:
        """Whether a rate may jump where a comparison changes: yes."""
        return True

    @property
    def recorders(self) -> tuple[str, ...]:
        """Names of the recorded signals: none."""
        return ()

    @property
    def span(self) -> Scalar:
        """t1 - t0."""
        return self.inputs["t1"] - self.inputs["t0"]

    def time(self, s: Scalar) -> Scalar:
        """Return the time at `s`, exactly t0 and t1 at 0 and 1."""
        return self.inputs["t0"] * (1.0 - s) + self.inputs["t1"] * s

    @property
    def changes(self) -> bool:
        """Whether there are events that do not end the solution."""
        return bool(self.code.inner)

    @property
    def eventful(self) -> bool:
        """Whether there are events."""
        return bool(self.code.events)

    def start(self) -> FieldState:
        """Return the state at t0."""
        y0, zero = self.inputs["y0"], jnp.zeros_like(self.inputs["t0"])
        count = len(self.code.inner)
        none = jnp.zeros(count, zero.dtype)
        times = jnp.full((count, self.times_per_event), jnp.nan, zero.dtype)
        return FieldState(y0, EventMemory(none, times, none, zero - 1.0, zero, zero, zero))

    def prepare_run(self) -> tuple["FieldSystem", dict[str, Objective]]:
        """Return the system itself: nothing is computed before a run, and nothing else measured."""
        return self, {}

    def join_state(self, flow: PyTree, held: EventMemory) -> FieldState:
        """Return the state of these two parts."""
        return FieldState(flow, held)

    def project(self, state: FieldState) -> FieldState:
        """Return the state: all are admissible."""
        return state

    def error_controlled_signals(self, state: FieldState) -> tuple[()]:
        """Return nothing: the states' errors alone limit a step."""
        del state
        return ()

    def least_scales(self, state: FieldState) -> None:
        """Return None: errors are relative."""
        del state

    def next_tick(self, k: Int, h: Scalar) -> Int:
        """Raise a TypeError: a field has no clock."""
        raise TypeError(f"a field has no clock; asked for the tick after {k} on a grid of {h}")

    def signals(self, t: Scalar, state: FieldState) -> FieldSignals:
        """Return the signals at the time `t` in units of the span: time and state of the field."""
        return FieldSignals(FieldSample(t, state.y), {})

    def flow(self, t: Scalar, state: FieldState, signals: FieldSignals) -> PyTree:
        """Return d(state.flow())/ds; NaN after a fault, which ends the run."""
        del signals
        rate = self._rate(t, state.y)
        if self.changes:
            rate = select(state.events.fault > 0, jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), rate), rate)
        return rate

    def margins(self, t: Scalar, state: FieldState, signals: FieldSignals, flow: Callable[[], PyTree]) -> Margins:
        """Return the conditions; those of terminal events belong to the stop."""
        del signals, flow
        stops = (
            jnp.ones_like(jnp.asarray(t)),
            *(self._call(event.condition, t, state.y) for event in self.code.terminal),
        )
        if not self.changes:
            return {"stop": stops}
        lifts = state.events.lifts
        pairs = zip(self.code.inner, lifts, strict=True)
        conditions = (self._call(event.condition, t, state.y) + lift for event, lift in pairs)
        return {"events": tuple(conditions), "stop": stops}

    def change(
        self,
        clock: Clock,
        state: FieldState,
        before: FieldSignals,
        margins: Margins,
        fired: Fired,
        passed: dict[str, PyTree] | None = None,
    ) -> FieldState:
        """Return the state after the events that have `fired`; a reset may make a later event of the list happen."""
        del before
        if passed is None:  # the start, where no condition has fallen
            return state
        happens = fired["events"]
        return jax.lax.cond(
            any_lane(jnp.any(jnp.stack(happens))),
            lambda: self._change(clock.t, state, margins, happens),
            lambda: state,
        )

    def _change(self, t: Any, state: FieldState, margins: Margins, fired: Sequence[Bool]) -> FieldState:
        was, stops = margins["events"], margins["stop"][1:]
        held = state.events

        def apply_resets(t: Array, y: object) -> tuple[tuple[PyTree, list[Scalar]], list[Bool]]:
            """Return the state after the resets with all conditions there, and which events have happened."""
            moved, happened = False, []
            for i, (event, happens) in enumerate(zip(self.code.inner, fired, strict=True)):
                if moved:
                    condition = self._call(event.condition, t, y) + held.lifts[i]
                    happens |= (was[i] >= 0) & (condition < -self._rounding_error(event.condition, t, y))
                happened.append(happens)
                if event.reset is not None:
                    y, moved = select(happens, self._call(event.reset, t, y), y), True
            return (y, [self._call(event.condition, t, y) for event in self.code.inner]), happened

        follow = jnp.ones_like(t), self._rate(t, state.y)
        (y, after), (_, moves), happened = jax.jvp(apply_resets, (t, state.y), follow, has_aux=True)
        each = zip(self.code.inner, happened, fired, was, held.lifts, after, moves, strict=True)
        lifts, faults = zip(*(self._rearm(t, state.y, y, *some) for some in each), strict=True)
        events = jnp.stack(happened)
        now = jnp.arange(self.times_per_event) == held.counts[:, None]
        quick = jnp.where(t - held.last < LANDING_FRACTION, held.quick + 1.0, 0.0)
        quick, last = select(jnp.any(events), (quick, t), (held.quick, held.last))
        fault = jnp.max(jnp.stack([held.fault, *faults]))
        fault = jnp.where((fault == 0) & (quick >= MAX_QUICK_EVENTS), float(SolutionStatus.CROWDED), fault)
        ends = held.ends
        for i, event in reversed(list(enumerate(self.code.terminal))):
            condition, rise = self._follow(event.condition, *jax.lax.stop_gradient((t, y)))
            rounding = self._rounding_error(event.condition, t, y)
            falls = (jnp.abs(condition) <= rounding) & (rise < 0)
            ends = jnp.where(falls | ((stops[i] >= 0) & (condition < -rounding)), i + 1.0, ends)
        fault = jnp.where((fault == 0) & (ends > 0), float(SolutionStatus.TERMINATED), fault)
        held = EventMemory(
            held.counts + events,
            jnp.where(now & events[:, None], t, held.times),
            jnp.stack(lifts),
            *(last, quick, fault, ends),
        )
        return FieldState(y, jax.tree.map(lambda x: jnp.asarray(x, t.dtype), held))

    def _rearm(
        self,
        t: Array,
        before: object,
        y: object,
        event: Event,
        happens: Bool,
        fired: Bool,
        was: Scalar,
        lift: Scalar,
        after: Scalar,
        move: Scalar,
    ) -> tuple[Scalar, Scalar]:
        """Return the lift of an event's condition after an instant, and the fault that ends the run, or 0.

        The resets may leave the condition as it is. Or they set it, perhaps to zero: then it counts as positive, as at
        a start. `after` is the condition after them, and `move` its rate along the flow before them.
        """
        t, before, y, after, move = jax.lax.stop_gradient((t, before, y, after, move))
        condition, fall = self._follow(event.condition, t, before)
        # The second derivative, too: it says when a condition that rises is back at zero.
        moves = (jnp.ones_like(t), self._rate(t, y))
        rise, bend = jax.jvp(lambda t, y: self._follow(event.condition, t, y)[1], (t, y), moves)
        rounding = self._rounding_error(event.condition, t, y)
        unmoved = (jnp.abs(after - condition) <= rounding) & (
            jnp.abs(move - fall) <= SAME_RATE_FRACTION * jnp.abs(fall)
        )
        # A landing ends near the zero: `exact` is the condition after a landing on it.
        exact = after - jnp.where(fired & (fall < 0), move * condition / jnp.where(fall < 0, fall, -1.0), 0.0)
        zero = unmoved | (jnp.abs(exact) <= rounding)
        small = LIFT_FRACTION * jnp.abs(rise) + rounding
        new = jnp.where(unmoved & ~(rise > 0), -small - after, small - after)
        returns = happens & zero & (rise > 0) & (2.0 * rise < -bend * LANDING_FRACTION)
        # At rest on its zero a condition has no next sign. One that did not fall before its event has jumped.
        unclear = happens & unmoved & (LANDING_FRACTION * jnp.abs(rise) <= rounding)
        jumps = fired & ~(fall < 0)
        # An earlier event of the list that a later reset makes happen at this instant: there is no order for it.
        again = ~happens & (was >= 0) & ~zero & (after + lift < -rounding)
        fault = jnp.where(again | returns, float(SolutionStatus.CROWDED), 0.0)
        fault = jnp.where(unclear | jumps, float(SolutionStatus.GRAZED), fault)
        old_lift = jnp.where(happens, 0.0, lift)
        return jax.lax.stop_gradient(jnp.where(zero & (happens | ~unmoved), new, old_lift)), fault

    def _rounding_error(self, condition: Callable, t: Array, y: PyTree) -> Any:
        """Return how far rounding may move a condition in the state `y` at `t`."""
        t, y = jax.lax.stop_gradient((t, y))
        slopes = jax.grad(lambda t, y: self._call(condition, t, y), argnums=(0, 1))(t, y)
        terms = zip(jax.tree.leaves(slopes), jax.tree.leaves((t, y)), strict=True)
        return LIFT_EPS * jnp.finfo(t.dtype).eps * sum(jnp.sum(jnp.abs(a * b)) for a, b in terms)

    def _call(self, function: Callable, t: Scalar, y: object) -> PyTree:
        """Return the result of a function at the time `t` in units of the span."""
        return function(self.time(t), y, self.inputs["args"], self.inputs["constants"])

    def _rate(self, t: Scalar, y: object) -> PyTree:
        return jax.tree.map(lambda x: self.span * x, self.field(t, y))

    def field(self, t: Scalar, y: object) -> PyTree:
        """Return dy/dt at the time `t` in units of the span."""
        return self._call(self.code.field, t, y)

    def distance(self, condition: Callable, point: Point) -> Scalar:
        """Return the time from the end of a run to the zero of an event's condition, zero within rounding."""
        t, y = jax.lax.stop_gradient((point.t, point.state.flow()))
        margin, rate = self._follow(condition, t, y)
        away = jnp.where(rate < 0, jnp.abs(margin) / jnp.where(rate < 0, -rate, 1.0), jnp.inf)
        return jnp.where(away <= COINCIDENCE_FRACTION, 0.0, away)

    def _follow(self, condition: Callable, t: Scalar, y: object) -> tuple[Scalar, Scalar]:
        """Return a condition and its rate along the field, from the state `y` at `t` on."""
        moves = (jnp.ones_like(t), self._rate(t, y))
        return jax.jvp(lambda t, y: self._call(condition, t, y), (t, y), moves)


@pytree
class Saves:
    """A recorder in the form of an objective: it keeps the state at given times, from the cubic of each step."""

    places: Array = param(unit="1", free=True)
    """Times as shares of the span, shape (n,)."""
    times: Array = param(unit="1", free=True)
    """The same in the time of the field, shape (n,)."""

    def start(self, sample: FieldSample) -> Memory:
        """Return the first state for each time."""
        count = len(self.places)
        return Memory(held=jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x), (count, *jnp.shape(x))), sample.y))

    def flow(self, memory: Memory, sample: FieldSample) -> PyTree:
        """Return no rates."""
        del memory, sample
        return ()

    def update(self, memory: Memory, segment: Segment) -> PyTree:
        """Return the states, with those in the step."""
        (start, end), rates = (segment.start, segment.end), segment.shown_rates()
        first, last = (jax.tree.map(lambda rate: segment.h * rate, shown.y) for shown in rates)
        # Each time is overwritten from step to step up to the one in which it lies, so that an event on it is over.
        begun = jax.lax.stop_gradient(start.t) <= self.places + COINCIDENCE_FRACTION
        x = (self.places - start.t) / jnp.where(segment.h > 0, segment.h, 1.0)
        inside = begun & (jax.lax.stop_gradient(x) <= 2.0)
        x = jnp.where(inside, x, 0.0)  # far outside of a short step the cubic is infinite

        def keep(old: Array, a: Array, b: Array, da: Array, db: Array) -> Array:
            new = jax.vmap(Cubic(a, b, da, db))(x)
            return jnp.where(jnp.reshape(inside, (-1, *(jnp.ndim(a) * [1]))), new, old)

        return jax.tree.map(keep, memory.held, start.y, end.y, first, last)

    def value(self, memory: Memory, ending: Ending) -> PyTree:
        """Return the states."""
        del ending
        return memory.held
