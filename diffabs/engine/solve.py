"""Solutions of any field, with events; undeclared switches of the field are located, as in every run.

    dy/dt = field(t, y, args),  y(t0) = y0
    where condition(t, y, args) falls through zero:  y <- reset(t, y, args), or the solution ends

The engine makes the run of a `FieldSystem` in the time s = (t - t0)/(t1 - t0) from 0 to 1:

    dy/ds = (t1 - t0) field(t0 + (t1 - t0) s, y, args)

So one program serves every span, t0 and t1 have derivatives, and time may run backwards.

Where an event happens its condition is zero, and rounding decides its sign. If the condition rises after the event, as
at a bounce, the next fall is an event again. If it falls on, and no reset has set it, it must rise through zero first.
A condition that a reset sets to zero counts as positive, as at the start. A small constant, the lift, is added to the
condition up to its next event and makes its sign agree.

Some runs have no right answer, or none that could be computed: `SolutionStatus` names them, and every number of such a
solution is NaN.
"""

import dataclasses
import enum
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jax._src.source_info_util import summarize  # JAX has no public function that names the line of an operation
from jax.core import Tracer
from jax.sharding import AbstractMesh, Mesh
from jax.typing import DTypeLike

from diffabs.core import kinds
from diffabs.core.compiling import is_traced
from diffabs.core.cubic import Cubic
from diffabs.core.jax_flags import default_flags
from diffabs.core.lanes import any_lane, select
from diffabs.core.numerics import invalidate
from diffabs.core.protocols import Clock, Ending, Memory, Objective, Segment
from diffabs.core.pytree import canonical_dtypes, param, part, pytree, static
from diffabs.core.types import AnyArray, Array, Bool, Int, Numbers, PyTree, Scalar
from diffabs.engine.drive.deferred import run_deferred
from diffabs.engine.drive.engine import resolve_request
from diffabs.engine.drive.loops import log_run, round_up_capacity
from diffabs.engine.drive.runs import RunCapacity, build_stepping, run_differentiable
from diffabs.engine.hybrid import Margins
from diffabs.engine.solvers import Adaptive, FixedStep, Solver, find_solver_faults
from diffabs.engine.step.adaptive import AdaptiveStepping
from diffabs.engine.step.attempt import Point
from diffabs.engine.step.comparisons import SwitchedProgram
from diffabs.engine.step.fixed import FixedStepping
from diffabs.engine.step.inner_functions import HOST_CALLS, SEARCHSORTED
from diffabs.engine.step.replay import log_attempt, log_capacity
from diffabs.engine.step.status import RunStatus, end_unfinished
from diffabs.engine.step.system import UNCONSTRAINED, build_system

MAX_TIME_LOSS = 1e-4  # rounding of t0 and t1, as a fraction of the span
MAX_EVENTS = 24  # kinds of events of a solution: the log of a run has one bit for each
# Fractions of the span. A landing is at most `LANDING_FRACTION` from the zero of its condition. Events that follow
# each other within it have no end, after `MAX_QUICK_EVENTS` of them. A save belongs to the step after an event that
# is not `COINCIDENCE_FRACTION` later.
LANDING_FRACTION, MAX_QUICK_EVENTS, COINCIDENCE_FRACTION = 1e-7, 8, 1e-10
# The lift: time in which the condition moves as far, as a fraction of the span, and multiples of the rounding.
LIFT_FRACTION, LIFT_EPS = 1e-12, 32
SAME_RATE_FRACTION = 1e-6  # a reset that changes the rate of a condition by less leaves the condition as it is

SWITCH_SOLVER = Adaptive(1e-6)
# By the function that hides a comparison: what to write instead.
REFUSAL_ADVICE = (
    (("scan",), "Write the loop as a loop of Python, or compare before it"),
    (("while",), "Write a fixed number of turns as a loop of Python, or compare before it"),
    (("custom_jvp_call", "custom_vjp_call"), "Compare outside of the function, or leave out its derivative rule"),
    (HOST_CALLS, "Write the function in JAX"),
    ((), "Compare outside of the function"),
)

Field = Callable[..., PyTree]  # of (t, y, args)


class SolutionStatus(enum.IntEnum):
    """How a solution ended; up to `TERMINATED`, its numbers are valid.

    Attributes:
        FINISHED: It reached t1.
        TERMINATED: A terminal event ended it.
        DIVERGED: A number is not finite, no step meets its tolerance, or the steps would be too many.
        SLID: It slides along a switching surface of the field, or crosses surfaces ever faster.
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


class Switch(NamedTuple):
    """A comparison in a field that depends on time or state.

    Attributes:
        source: File and line of the comparison.
        operation: What JAX calls it: `gt`, `max`, `abs`, `clamp`, `searchsorted`.
        margin: Difference of its two sides, an array for a comparison of arrays; zero where the answer changes. For a
            search in knots, the distance to the nearest one.
        flips: Times at which an answer changes in a run; () without a run.
    """

    source: str
    operation: str
    margin: Numbers
    flips: tuple[float, ...]


class SolutionEvents(NamedTuple):
    """The events of a solution, in the order of the argument `events`.

    Attributes:
        times: Times of the first events of each kind, shape (events, kept), differentiable; NaN where there is none.
        counts: Number of events of each kind, shape (events,), integers.
    """

    times: Array
    counts: Array


class Solution(NamedTuple):
    """The solution of a field.

    Attributes:
        t: Time at the end, or the times `save`. A terminal event ends a solution before t1.
        y: State there, with an axis for the times in front of each leaf if there is `save`. An event at a save time
            before t1 is over there. After a terminal event the last state is repeated. NaN unless the status is valid.
        events: Times and counts of the events.
        status: A `SolutionStatus`, as an integer.
    """

    t: Array
    y: PyTree
    events: SolutionEvents
    status: Array


class EventMemory(NamedTuple):
    """Held memory of the events that do not end a solution.

    Attributes:
        counts: Number of events of each kind, shape (events,), as floats.
        times: Times of the first ones in units of the span, shape (events, kept).
        lifts: Numbers that are added to the conditions, shape (events,).
        last: Time of the last event in units of the span.
        quick: Number of events that followed their predecessor at once.
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

    def error_signals(self) -> tuple[()]:
        """Return nothing: the states' errors alone limit a step."""
        return ()

    signal_scales = error_signals


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
    ticks, jumps, recorders = False, True, ()

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

    def error_signals(self, state: FieldState) -> tuple[()]:
        """Return nothing: the states' errors alone limit a step."""
        del state
        return ()

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
        fired: Margins,
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
        lifts, faults = zip(*(self._arm(t, state.y, y, *some) for some in each), strict=True)
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

    def _arm(
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
    """An objective that keeps the state at given times, from the cubic of each step."""

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


@default_flags()
def solve(
    field: Field,
    y0: object,
    t0: Array,
    t1: Scalar,
    args: object = None,
    *,
    solver: Solver,
    events: Sequence[Event] = (),
    save: AnyArray | None = None,
    engine: str = "auto",
    kept_events: int = 16,
) -> Solution:
    """Solve dy/dt = field(t, y, args) from t0 to t1, with events.

    Every comparison in the field that depends on t or y is a switch. Steps end where it changes, so that values keep
    the order of the method, and derivatives are right. `switches` lists them. The function works under `jax.jit`,
    `jax.vmap` and both modes of differentiation, by y0, t0, t1, args, `save` and all values that the functions close
    over. It is compiled again where a constant of a function has changed, so pass parameters by `args`.

    Args:
        field: Pure function of (t, y, args) that returns dy/dt, with the structure and shapes of y.
        y0: State at t0, any pytree of real numbers and arrays.
        t0: Start [unit of time of the field].
        t1: End; before t0, time runs backwards.
        args: Anything that the functions need, a pytree of arrays and numbers.
        solver: `FixedStep` or `Adaptive`. Only `step` or `rtol` is read: t0 and t1 replace the duration, and `save` the
            stride. Fixed steps are shortened to a whole number.
        events: Events; several at one instant happen in this order. One exactly at t1 does not happen. A terminal
            event at the instant of others may come before or after them; after it, none happens.
        save: Times between t0 and t1 at which the state is returned, shape (n,); None for the state at the end.
        engine: "xla", or "kernel": a program of this machine, with first derivatives in both modes. "auto" is that of
            $DIFFABS_ENGINE, or else a kernel inside JAX's transformations where one is possible, and XLA elsewhere.
        kept_events: Number of times that are kept of each event.

    Returns:
        The solution. Read its `status`: without a valid one its numbers are NaN.

    Raises:
        ValueError: An argument is invalid. A switch of the field cannot be located: it is no comparison, such as
            `jnp.floor`, or a loop hides it. A second derivative is asked of adaptive steps. A field with switches or
            events has float32 numbers.

    See also:
        `switches`: The comparisons of a field that the solution treats as switches.
        `Event`: A condition, and the state after it.
        `FixedStep`, `Adaptive`: The two methods.
        `rollout`: Runs of a loop made of parts.

    Notes:
        Between events the state follows y' = f(t, y, p). At an event, where a condition g falls through zero, it jumps
        to r(t, y, p). Derivatives pass the event by

            dt*/dp = -(g_y S + g_p)/(g_t + g_y f),   S+ = r_y S + r_p + (r_y f + r_t - f+) dt*/dp

        with S = dy/dp before and S+ after the jump, f before and f+ after it. Source: I. A. Hiskens and M. A. Pai,
        Trajectory sensitivity analysis of hybrid systems, IEEE Trans. Circuits Syst. I 47 (2000).

    Examples:
        >>> import jax
        >>> import diffabs as d
        >>> jax.config.update("jax_enable_x64", True)
        >>> solution = d.solve(lambda t, y, rate: -rate * y, 1.0, 0.0, 2.0, 0.5, solver=d.Adaptive(1e-8))
        >>> print(f"{solution.y:.6f}")
        0.367879

        The height of a ball after 1 s that falls from 1 m and bounces, and its derivative by gravity:

        >>> def height(g):
        ...     bounce = d.Event(lambda t, y, g: y[0], lambda t, y, g: (0.0, -0.8 * y[1]))
        ...     ball = lambda t, y, g: (y[1], -g)
        ...     return d.solve(ball, (1.0, 0.0), 0.0, 1.0, g, solver=d.Adaptive(1e-8), events=[bounce]).y[0]
        >>> print(f"{height(9.81):.4f} {jax.grad(height)(9.81):.4f}")  # in closed form 0.4680 and -0.0936
        0.4680 -0.0936
    """
    engine = resolve_request(engine)
    if not isinstance(events, list | tuple):
        raise ValueError(f"events = {kinds.format_value(events)} is no list of d.Event")
    events = tuple(events)
    if len(events) > MAX_EVENTS:
        raise ValueError(f"events has {len(events)} entries; at most {MAX_EVENTS} are possible")
    if isinstance(kept_events, bool) or not isinstance(kept_events, int | np.integer) or kept_events < 1:
        raise ValueError(f"kept_events = {kept_events!r} is no whole number of at least 1")
    system, save_objective = build_field(field, y0, t0, t1, args, events, save, int(kept_events))
    any_solver: Any = solver
    method, count = _read_solver(any_solver, t0, t1, system.inputs["t0"].dtype)
    program = _trace_program(system)
    switched = bool(program.bit_count or events)
    if switched and system.inputs["t0"].dtype != jnp.float64:
        raise ValueError(
            "float32 cannot locate the switches and events of a field; call"
            ' jax.config.update("jax_enable_x64", True), and give float64 numbers'
        )
    if not switched:
        adaptive = isinstance(method, AdaptiveStepping)
        lean = {"keeps_mode": False, "stable": False} if adaptive else {"kinks": False}
        method = dataclasses.replace(method, watches=False, smooth=True, **lean)
    saves = {} if save_objective is None else {"saves": save_objective}

    room = count if isinstance(method, FixedStepping) else log_capacity(system, any_solver)
    capacity = RunCapacity(_finish_solution, None, round_up_capacity(room))
    run = system, saves, method, None
    if engine == "kernel" or (engine == "auto" and is_traced(system, saves)):
        return run_deferred(run_differentiable, capacity, run, required=engine == "kernel")
    return run_differentiable(capacity, run)


@default_flags()
def switches(
    field: Field,
    t: Array,
    y: object,
    args: object = None,
    *,
    t1: Scalar | None = None,
    solver: Adaptive = SWITCH_SOLVER,
) -> list[Switch]:
    """Return the switches of a field: its comparisons that depend on time or state, and where they flip.

    Args:
        field: Function of (t, y, args) that returns dy/dt, as in `solve`.
        t: Time.
        y: State at that time.
        args: What the function needs.
        t1: End of a run from (t, y) whose flips are listed; None for no run.
        solver: Solver of that run.

    Examples:
        >>> import diffabs as d
        >>> comparisons = d.switches(lambda t, y, args: -abs(y), 0.0, 3.0)
        >>> print(comparisons[0].operation, comparisons[0].margin)
        abs 3.0

    Raises:
        ValueError: An argument is invalid or traced, or a switch of the field cannot be located.
    """
    if _is_traced(t, y, args, t1):
        raise ValueError("switches lists numbers of one run: call it outside of jit, vmap and grad")
    system, _ = build_field(field, y, t, float(t) + 1.0 if t1 is None else t1, args, (), None, 1)
    program, zero = _trace_program(system), jnp.zeros_like(system.inputs["t0"])
    observed = build_system(system, {}, zero, system.start(), {}, switched=True)
    surfaces = observed.evaluate(zero, system.start(), {}, UNCONSTRAINED).surfaces
    flips = [] if t1 is None else _list_flips(system, solver)
    comparisons = []
    for (first, shape), op in zip(program.places, program.origins, strict=True):
        bits = range(first, first + int(np.prod(shape)))
        margins = [surface.value for surface in surfaces if int(np.min(surface.numbers)) in bits]
        margin = margins[0] if len(margins) == 1 else min(margins, key=abs)
        turned = op.queries[0][1] and op.name != SEARCHSORTED  # the distance to a knot has no side
        times = tuple(time for time, bit in flips if bit in bits)
        comparisons.append(Switch(summarize(op.source), op.name, -margin if turned else margin, times))
    return comparisons


def _list_flips(system: FieldSystem, solver: Adaptive) -> list[tuple[float, int]]:
    """Return time and number of each comparison that changes in a run."""
    method, _ = _read_solver(solver, 0.0, 1.0, system.inputs["t0"].dtype)
    if not isinstance(method, AdaptiveStepping):
        raise ValueError(f"solver = {solver} has fixed steps; d.Adaptive is needed")

    @jax.jit
    def run(system: FieldSystem) -> PyTree:
        key: Any = None
        start = method.start(system, {}, key)
        step, renew = partial(method.step, system, {}, key), partial(method.renew, system)
        carry, log = log_run(step, renew, log_attempt, start, round_up_capacity(log_capacity(system, solver)))
        return _finish_solution(system, {}, end_unfinished(carry))[0].status, log

    status, log = run(system)
    if status != SolutionStatus.FINISHED:
        raise ValueError(f"t1: the run has no end, its status is {SolutionStatus(int(status)).name}")
    lands = np.ravel(log.lands)
    times = np.ravel(system.time(log.t))
    return [(float(times[i]), int(lands[i])) for i in np.flatnonzero(np.ravel(log.accepted) & (lands >= 0))]


def build_field(
    field: Field,
    y0: object,
    t0: Array,
    t1: Scalar,
    args: object,
    events: tuple[Event, ...],
    save: AnyArray | None,
    times_per_event: int,
) -> tuple[Any, Saves | None]:
    """Return the field as a `FieldSystem`, and the objective of the times `save`."""
    _read_times(t0, t1, save)
    _refuse_leaves("y0", y0)
    for path, leaf in jax.tree_util.tree_leaves_with_path(args):
        try:
            jax.typeof(leaf)
        except TypeError:
            place = jax.tree_util.keystr(path)
            raise ValueError(f"args{place} = {kinds.format_value(leaf)} is no number or array") from None
    save = jnp.asarray(save) if isinstance(save, list | tuple) else save
    y0, t0, t1, save = canonical_dtypes((y0, t0, t1, save))
    if not jax.tree.leaves(y0):
        raise ValueError("y0 has no number; a state of at least one is needed")
    if not _is_traced(t0, t1):
        start, end, eps = float(t0), float(t1), float(jnp.finfo(t0.dtype).eps)
        if eps * max(abs(start), abs(end)) > MAX_TIME_LOSS * abs(end - start):
            raise ValueError(
                f"t1 - t0 is lost in the rounding of t0 = {start:.10g} and t1 = {end:.10g} as {t0.dtype}: shift the"
                ' time, or call jax.config.update("jax_enable_x64", True)'
            )
    dynamics, event_functions, constants = _read_functions(field, events, t0, y0, args)
    inputs = {"y0": y0, "t0": t0, "t1": t1, "args": args, "constants": constants}
    system = FieldSystem(inputs=inputs, code=FieldCode(dynamics, event_functions), times_per_event=times_per_event)
    return system, None if save is None else _place_saves(save, t0, t1)


def _place_saves(save: AnyArray, t0: Scalar, t1: Scalar) -> Saves:
    """Return the objective of the times `save`; an empty span has only its end."""
    empty = t1 == t0
    at_end = jnp.where(save == t0, 1.0, jnp.nan)
    return Saves(places=jnp.where(empty, at_end, (save - t0) / jnp.where(empty, 1.0, t1 - t0)), times=jnp.asarray(save))


def _trace_program(system: FieldSystem) -> SwitchedProgram:
    """Return the program of the field, or raise a ValueError for a switch that no step can end on."""
    program = build_system(system, {}, jnp.zeros_like(system.inputs["t0"]), system.start(), {}, switched=True).program
    assert program is not None
    for worst in program.hidden:
        advice = next((text for names, text in REFUSAL_ADVICE if worst.function in names), REFUSAL_ADVICE[-1][1])
        raise ValueError(
            f"field has the comparison '{worst.name}' within '{worst.function}' at {summarize(worst.source)}: no step"
            f" can end where its answer changes. {advice}"
        )
    for worst in program.jumps:
        raise ValueError(
            f"field has the operation '{worst.name}' at {summarize(worst.source)}: its result jumps or bends where no"
            " comparison changes, so that no step can end there. Write it as comparisons, or as a state that an event"
            " resets"
        )
    return program


def _finish_solution(system: FieldSystem, objectives: dict[str, Saves], carry: PyTree) -> tuple[Solution, None]:
    point, held = carry.point, carry.point.state.events
    statuses = {
        RunStatus.TIMED_OUT: SolutionStatus.FINISHED,
        RunStatus.STOPPED: SolutionStatus.TERMINATED,
        RunStatus.SLID: SolutionStatus.SLID,
        RunStatus.GRAZED: SolutionStatus.GRAZED,
    }
    status: Scalar = jnp.asarray(SolutionStatus.DIVERGED.value)
    for run_status, meant in statuses.items():
        status = jnp.where(carry.status == run_status, meant.value, status)
    # A fault of an event ends the run by rates that are NaN. Fixed steps then leave their mode, as in a slide.
    lost: Scalar = ((status == SolutionStatus.DIVERGED) | (status == SolutionStatus.SLID)) & (held.fault > 0)
    status = jnp.where(lost, held.fault.astype(status.dtype), status)
    check = partial(invalidate, invalid=status > SolutionStatus.TERMINATED, inputs=system.inputs)
    # The sum of the steps of a grid may miss t1 by its rounding.
    t = jnp.where(status == SolutionStatus.FINISHED, system.inputs["t1"], system.time(point.t))
    y = point.state.y
    if objectives:
        t, places = objectives["saves"].times, objectives["saves"].places
        over = places > jax.lax.stop_gradient(point.t) - COINCIDENCE_FRACTION
        # At t1 the state moves with its own time. After a terminal event it is repeated.
        late = jnp.where(over & (status == SolutionStatus.FINISHED), t - system.time(point.t), 0.0)
        late -= jax.lax.stop_gradient(late)
        rates = system.field(point.t, y)
        outside = jnp.where(jnp.abs(places - 0.5) <= 0.5 + COINCIDENCE_FRACTION, 1.0, jnp.nan)

        def pick(y: Array, rate: Array, saved: Array) -> Array:
            shape = (-1, *(jnp.ndim(y) * [1]))
            moved = y + jnp.reshape(late, shape) * rate
            return jnp.reshape(outside, shape) * jnp.where(jnp.reshape(over, shape), moved, saved)

        y = jax.tree.map(pick, y, rates, point.accumulators["saves"].held)
    events = _count_events(system, carry, status == SolutionStatus.TERMINATED)
    times = check(system.time(events.times))
    return Solution(check(t), jax.tree.map(check, y), events._replace(times=times), status), None


def _count_events(system: FieldSystem, carry: PyTree, terminated: Bool) -> SolutionEvents:
    """Return times, in units of the span, and counts of all events in their order."""
    point, held = carry.point, carry.point.state.events
    distances = [system.distance(event.condition, point) for event in system.code.terminal]
    last = jnp.argmin(jnp.stack(distances)) if distances else 0
    last = jnp.where(held.ends > 0, held.ends - 1.0, last)
    never = jnp.full(system.times_per_event, jnp.nan, point.t.dtype)
    inner, ends, rows = iter(range(len(system.code.inner))), iter(range(len(distances))), []
    for event in system.code.events:
        if event.terminal:
            happens = jnp.asarray(terminated & (last == next(ends)))
            rows.append((jnp.where(happens, never.at[0].set(point.t), never), happens.astype(point.t.dtype)))
        else:
            i = next(inner)
            rows.append((held.times[i], held.counts[i]))
    times = jnp.stack([time for time, _ in rows]) if rows else jnp.zeros((0, system.times_per_event), point.t.dtype)
    counts = jnp.stack([count for _, count in rows]) if rows else jnp.zeros(0, point.t.dtype)
    return SolutionEvents(times, counts.astype(int))


def _read_times(t0: Scalar, t1: Scalar, save: AnyArray | None) -> None:
    """Raise a ValueError for an invalid time of a solution, as far as the times are concrete."""
    for name, x, rank in (("t0", t0, 0), ("t1", t1, 0), ("save", save, 1)):
        if x is None:
            continue
        if line := kinds.find_value_objection(x):
            raise ValueError(f"{name} = {kinds.format_value(x)} {line}; a time is needed")
        if len(kinds.value_shape(x)) != rank:
            needed = "a list of times" if rank else "one time"
            raise ValueError(f"{name} has shape {kinds.value_shape(x)}; {needed} is needed")
        if not _is_traced(x) and not np.all(np.isfinite(np.asarray(x, float))):
            raise ValueError(f"{name} = {kinds.format_value(x)} is not finite")
    if _is_traced(t0, t1):
        return
    if t0 == t1:
        raise ValueError(f"t1 = {t1} is equal to t0; another time is needed")
    if save is not None and not _is_traced(save):
        low, high = sorted((float(t0), float(t1)))
        outside = [x for x in np.asarray(save, float) if not low <= x <= high]
        if outside:
            raise ValueError(f"save has {outside[0]}; times in [{low:g}, {high:g}] are possible")


def _refuse_leaves(name: str, tree: object) -> None:
    """Raise a ValueError for a leaf that is no real number or array of numbers."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if line := kinds.find_value_objection(leaf):
            raise ValueError(
                f"{name}{jax.tree_util.keystr(path)} = {kinds.format_value(leaf)} {line}; a number is needed"
            )


def _read_solver(
    solver: object, t0: Scalar, t1: Scalar, dtype: DTypeLike
) -> tuple[FixedStepping | AdaptiveStepping, int]:
    """Return the stepping method in units of the span, and the number of its steps."""
    count = 1
    if isinstance(solver, Adaptive):
        solver = dataclasses.replace(solver, step=1.0, duration=1.0, every=1)
    elif not isinstance(solver, FixedStep):
        raise ValueError(f"solver = {kinds.format_value(solver)} is no solver; d.FixedStep or d.Adaptive is needed")
    elif _is_traced(t0, t1):
        raise ValueError("t0 or t1 is traced: d.FixedStep must know the number of its steps; d.Adaptive need not")
    elif solver.kinks is False:
        raise ValueError("solver.kinks = False: d.solve locates all switches; leave it out")
    else:
        solver = dataclasses.replace(solver, duration=abs(float(t1) - float(t0)), every=1)
    if lines := find_solver_faults(solver):
        raise ValueError("; ".join(lines).replace("solver.duration =", "t1 - t0 ="))
    if isinstance(solver, FixedStep):
        count = solver.steps
        solver = FixedStep(1.0 / count, 1.0, kinks=True)
    method = dataclasses.replace(build_stepping(solver, dtype), watches=True)
    return dataclasses.replace(method, keeps_mode=True) if isinstance(method, AdaptiveStepping) else method, count


def _read_functions(
    field: Field, events: Sequence[Event], t: Scalar, y: PyTree, args: PyTree
) -> tuple[Function, tuple[Event, ...], list[PyTree]]:
    """Return the field, the events, and the traced constants of their functions."""
    constants: list[PyTree] = []

    def read(function: Any, name: str, like: PyTree) -> Function:
        if not callable(function):
            raise ValueError(f"{name} = {kinds.format_value(function)} is no function of (t, y, args)")
        # What a function closes over may have changed. A new wrapper makes JAX trace it again.
        program, shapes = jax.make_jaxpr(lambda *inputs: function(*inputs), return_shape=True)(t, y, args)
        _check_result(name, shapes, like)
        traced = any(map(_is_traced, program.consts))
        hidden: list[Any] = []
        key = _describe_program(program, [jax.typeof(x) if traced else x for x in program.consts], hidden)
        if hidden:  # a derivative rule, which shows neither its operations nor its tracers
            key = key, object() if traced else _hashable(function)
        if not traced:
            return Function(key, function)

        # The compiled programs of the engine know no tracer from outside: the closure becomes an argument.
        def call(t: Scalar, y: PyTree, args: PyTree, closure: PyTree) -> PyTree:
            run = jex.jaxpr_as_fun(jex.ClosedJaxpr(program.jaxpr, closure))
            return jax.tree.unflatten(jax.tree.structure(shapes), run(*jax.tree.leaves((t, y, args))))

        constants.append(list(program.consts))
        return Function(key, call, len(constants) - 1)

    dynamics, event_functions = read(field, "field", y), []
    for i, event in enumerate(events):
        if not isinstance(event, Event):
            raise ValueError(f"events.{i} = {kinds.format_value(event)} is no d.Event")
        if event.terminal and event.reset is not None:
            raise ValueError(f"events.{i} is terminal and has a reset; a terminal event has none")
        condition = read(event.condition, f"events.{i}.condition", t)
        reset = None if event.reset is None else read(event.reset, f"events.{i}.reset", y)
        event_functions.append(Event(condition, reset, event.terminal))
    return dynamics, tuple(event_functions), constants


def _check_result(name: str, shapes: object, like: object) -> None:
    """Check that a function returns real numbers with structure and shapes of `like`."""
    if jax.tree.structure(shapes) != jax.tree.structure(like):
        structure, needed = jax.tree.structure(shapes), jax.tree.structure(like)
        raise ValueError(f"{name} returns the structure {structure}; {needed} is needed")
    paths = jax.tree_util.tree_leaves_with_path(shapes)
    for (path, a), b in zip(paths, jax.tree.leaves(like), strict=True):
        place = jax.tree_util.keystr(path)
        if a.shape != b.shape:
            raise ValueError(f"{name} returns shape {a.shape}{place and f' at {place}'}; {b.shape} is needed")
        if line := kinds.find_value_objection(a):
            raise ValueError(f"{name} returns a number that {line}{place and f' at {place}'}; a real one is needed")


def _describe_program(program: jex.ClosedJaxpr | jex.Jaxpr, constants: Sequence[Any], hidden: list[Any]) -> Any:
    """Return a description that is equal for programs of equal operations and constants; see `_describe`."""
    x, numbers = getattr(program, "jaxpr", program), dict[Any, int]()

    def read(atoms: Sequence[Any]) -> tuple:
        return tuple(
            (atom.aval, _describe(atom.val, hidden))
            if isinstance(atom, jex.Literal)
            else numbers.setdefault(atom, len(numbers))
            for atom in atoms
        )

    begins = [(variable.aval, *read([variable])) for variable in (*x.constvars, *x.invars)]
    rows = [(eqn.primitive, _describe(eqn.params, hidden), read(eqn.invars), read(eqn.outvars)) for eqn in x.eqns]
    return tuple(begins), tuple(rows), read(x.outvars), _describe(list(constants), hidden)


def _describe(x: object, hidden: list[Any]) -> Any:
    """Return a description that is equal for equal programs or parameters; `hidden` gets the parameters not read."""
    if isinstance(x, jex.ClosedJaxpr | jex.Jaxpr):
        return _describe_program(x, getattr(x, "consts", ()), hidden)
    if isinstance(x, dict):
        return tuple((name, _describe(entry, hidden)) for name, entry in sorted(x.items()))
    if isinstance(x, list | tuple):
        return type(x), tuple(_describe(element, hidden) for element in x)
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        x = jax.random.key_data(x)
    if isinstance(x, jax.Array | np.ndarray | np.generic | float):
        x = np.asarray(x)
        return x.dtype, x.shape, x.tobytes()
    unread = callable(x) or hasattr(x, "call_wrapped")  # JAX wraps a derivative rule anew each time
    if _hashable(x) is x and (not unread or isinstance(x, type | np.dtype | Mesh | AbstractMesh)):
        return x
    hidden.append(x)
    return type(x), str(getattr(x, "debug_info", None))


def _hashable(function: object) -> Any:
    try:
        hash(function)
    except TypeError:  # a callable with arrays in it: equal to itself only
        return id(function)
    return function


def _is_traced(*values: PyTree) -> bool:
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(values))
