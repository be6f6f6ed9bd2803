"""Pure delay: control(t) = command(t - time), and 0 until the first command arrives.

The delay stores one `Piece` for each past step, of any length. A piece has the times of both ends and a cubic Hermite
polynomial of the command. The polynomial interpolates value and rate at both ends, so a smooth command keeps the order
of the method.

The command breaks where value or rate at the end of one piece differ from those at the start of the next. A step of the
integration ends where the break leaves the delay. The time of this event carries the tangents of the break's entry time
and of `time`. If the delay equals one step, the exit time of a break is a grid instant, and no event is needed. For
derivatives with respect to `time`, the next step then starts with an event (`_InEvents`).

Inside the Runge-Kutta stages of a step the delayed command must be smooth, also beyond the next break. A step therefore
reads only the pieces between two breaks. They come from a window of the pieces that leave next; a tick moves the window
after each step.
"""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.arrays import as_rule_array
from diffabs.core.cubic import Cubic, HermiteStep
from diffabs.core.kinds import format_value
from diffabs.core.log import Log
from diffabs.core.protocols import Clock, Memory, no_flow
from diffabs.core.pytree import param, pytree, static
from diffabs.core.rules import Rule
from diffabs.core.types import Any, Array, Int, Matrix, PyTree, Scalar, Vector

TIME_ROUNDING = 1e-6  # relative rounding of single precision
WINDOW_PIECES = 6  # pieces; a step that spans more is cut
TIME_EPS = 16.0  # in machine epsilons of t: closer instants count as equal
SMOOTH_CHANGE_SHARE = 0.5  # exponent of the machine epsilon: a smaller relative difference is no jump
LEAST_CAPACITY = 3  # steps: the delay has at least one step, and at most capacity - 2
SPARE, CUTS = 16, 4  # room for cut steps: SPARE pieces and one more for every CUTS steps


class Piece(NamedTuple):
    """A past step of the integration, with the command as a cubic.

    Attributes:
        start: Time of the step's start [s].
        end: Time of the step's end [s].
        command: Cubic of the command between both times.
        breaks: 1 where the command does not continue smoothly from the previous piece, else 0.
    """

    start: Scalar
    end: Scalar
    command: Cubic
    breaks: Scalar

    @classmethod
    def of(cls, row: PyTree) -> "Piece":
        """Return the piece stored in `row`, a row of the ring or of the window."""
        start, end, *command, breaks = row
        return cls(start, end, Cubic(*command), breaks)

    @property
    def rate(self) -> Scalar:
        """Rate of the command at the end of the piece [control/s]."""
        return self.command.end_slope / (self.end - self.start)


class DelayMemory(NamedTuple):
    """The ring of past steps and the window of pieces that leave next. Integers have the floating type of the signal.

    Attributes:
        ring: Past steps, one row for each `Piece`.
        window: Rows of the pieces that leave next, shape (WINDOW_PIECES, columns).
        valid: Number of valid pieces in the window.
        place: Index in the window of the first piece that the present step may read.
        last: Index in the window of the last piece that the present step may read.
        until: Command time up to which the present step may read [s]; the delay reaches it at `until` + time.
        first: Index in the ring of the window's first piece.
        count: Number of pieces in the ring from `first` on.
        newest: Row of the newest piece.
    """

    ring: Log
    window: Matrix
    valid: Array
    place: Array
    last: Array
    until: Scalar
    first: Array
    count: Array  # pyright: ignore[reportIncompatibleMethodOverride]  # not that of a tuple
    newest: Int


@pytree
class Delay:
    """A pure delay, control(t) = command(t - time), and 0 for t < time.

    The delay lies between one step and capacity - 2 steps of the integration.
    The ring has spare rows for events that cut every fourth of these steps. A run with more events within one delay has
    diverged: its control becomes NaN.
    """

    time: Scalar = param(default=0.01, unit="s", above=0.0)
    """Delay."""
    capacity: int = static(default=1024)
    """Number of steps that the ring holds, without the spare rows; an integer >= 3."""

    flow = no_flow

    def start(self, signal: Scalar) -> Memory:
        """Return a memory with one piece: the command 0 until t = 0."""
        zero = 0.0 * jnp.asarray(signal)
        row = _row(Piece(zero - self.time, zero, Cubic(zero, zero, zero, zero), zero))
        window = jnp.broadcast_to(row, (WINDOW_PIECES, *row.shape))
        rows = jnp.zeros((self.capacity + self.capacity // CUTS + SPARE, *row.shape), row.dtype)
        ring = Log(rows, zero, row).put(zero, row)
        return Memory(
            (), self._aim_at_break(DelayMemory(ring, window, zero + 1, zero, zero, zero, zero, zero + 1, row))
        )

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return command(t - time) [control]; past the pieces that the step may read, a linear extrapolation."""
        del signal
        m: DelayMemory = memory.held
        piece = _piece(m.window, self._place(t, m))
        x = (t - self.time - piece.start) / (piece.end - piece.start)
        within = _at_most_one(x)
        return piece.command(within) + (x - within) * piece.command.end_slope

    def margins(self, t: Scalar, memory: Memory, signal: Scalar, rate: object) -> tuple[PyTree]:
        """Return the time [s] until the next break leaves the delay, or until the window runs out of pieces."""
        del signal, rate
        return (memory.held.until + self.time - t,)

    def event(self, t: Scalar, memory: Memory, signal: Scalar, fired: tuple[PyTree]) -> Memory:
        """Return the memory after a break has left the delay: the next pieces may be read."""
        del t, signal
        m: DelayMemory = memory.held
        out = fired[0] & (m.last + 1 < m.valid)
        return memory._replace(held=self._aim_at_break(m._replace(place=jnp.where(out, m.last + 1, m.place))))

    def record(self, memory: Memory, step: HermiteStep) -> Memory:
        """Return the memory with the finished `step` stored as a piece.

        A step of zero length is not stored.
        """
        m: DelayMemory = memory.held
        h, free = step.end - step.start, _ring_place(m.first + m.count, m.ring.size)
        before = Piece.of(jax.lax.stop_gradient(m.newest))
        cubic = Cubic(*step.values, *(h * rate for rate in step.rates))
        after = step.values[0], self.time * step.rates[0]
        breaks = jnp.where(_differ((before.command.end, before.rate * self.time), after), 1.0, 0.0).astype(h.dtype)
        row = _row(Piece(step.start, step.end, cubic, breaks))
        some = h > _time_tolerance(step.end)
        count = m.count + jnp.where(some, 1.0, 0.0)
        newest = jnp.where(some, row, m.newest)
        return memory._replace(held=m._replace(ring=m.ring.put(free, row), newest=newest, count=count))

    def tick(self, clock: Clock, memory: Memory, signal: Scalar) -> Memory:
        """Return the memory with the window moved to time t of the clock.

        If the delay is one step, a break at t itself has left the delay.
        """
        del signal
        m: DelayMemory = memory.held
        size, over = m.ring.size, self._place(clock.t, m)
        first, count = _ring_place(m.first + over, size), m.count - over
        rows = m.ring.read(_ring_place(first.astype(int) + jnp.arange(WINDOW_PIECES), size))
        window = jnp.where(count < size, rows, jnp.nan)  # else the ring has overwritten a piece that has not left yet
        valid, none = jnp.minimum(count, WINDOW_PIECES), jnp.zeros_like(count)
        new = self._aim_at_break(DelayMemory(m.ring, window, valid, none, none, none, first, count, m.newest))
        return memory._replace(held=self._at_once(new, clock.t))

    def _at_once(self, m: DelayMemory, t: Any) -> DelayMemory:
        """Return the memory after the breaks that leave the delay at time t or earlier."""
        out = (m.last + 1 < m.valid) & (m.until + self.time <= t)
        return self._aim_at_break(m._replace(place=jnp.where(out, m.last + 1, m.place)))

    def enable_derivatives(self, names: set[str]) -> "Delay":
        """Return the delay for derivatives with respect to the parameters in `names`.

        This is the delay itself unless `names` contains "time".
        """
        return _InEvents(time=self.time, capacity=self.capacity) if "time" in names else self

    def _place(self, t: Any, m: DelayMemory) -> Array:
        """Return the window index of the piece that leaves at time t, limited to the pieces before the next break."""
        return _count([m.window[i, 1] for i in range(WINDOW_PIECES)], t - self.time, m.place, m.last)

    def _aim_at_break(self, m: DelayMemory) -> DelayMemory:
        """Return the memory with `last` and `until` set for the present `place`."""
        last = m.valid - 1
        for i in reversed(range(1, WINDOW_PIECES)):
            last = jnp.where((i > m.place) & (i < m.valid) & (m.window[i, -1] > 0.5), i - 1.0, last)
        breaks = last + 1 < m.valid
        until = jnp.where(breaks, _piece(m.window, last + 1).start, _piece(m.window, last).end)
        # The event comes a rounding before the grid instant: on the grid its time would lose its derivatives. If the
        # newest piece limits the step, the event comes a rounding after its end, so that it does not cut the next step.
        newest = ~breaks & (m.valid == m.count)
        return m._replace(last=last, until=until + jnp.where(newest, 1.0, -1.0) * _time_tolerance(until + self.time))

    def refined(self, times: int) -> "Delay":
        """Return the same delay with `times` times the capacity, for a step that is `times` times shorter."""
        return dataclasses.replace(self, capacity=times * self.capacity)  # pyright: ignore[reportArgumentType]

    def problems(self) -> Iterator[str]:
        """Yield a message if the capacity is no integer, or smaller than 3 steps."""
        yield from find_wrong_capacity(self.capacity, LEAST_CAPACITY, "steps")

    def grid_rules(self, step: float) -> Iterator[Rule]:
        """Yield the rule step <= time <= (capacity - 2) * step, up to the rounding of single precision."""
        longest, time = (self.capacity - 2) * step, as_rule_array(self.time)
        outside = f"outside [{step:g}, {longest:g}] s, one step to capacity - 2 steps"
        yield Rule(
            (step <= time * (1 + TIME_ROUNDING)) & (time * (1 - TIME_ROUNDING) <= longest),
            f"time is {outside}",
            lambda: f"time = {float(self.time):g} s is {outside}",
        )


@pytree
class _InEvents(Delay):
    """A delay whose breaks always leave in an event; after a delay of one step, at the start of the next step.

    The event time then has a derivative. The sample stored at that instant is the command before the break.
    """

    def _at_once(self, m: DelayMemory, t: Any) -> DelayMemory:
        # Breaks more than a few roundings in the past have left already: when the solver repeats a step, rounding may
        # reveal a break that the first try did not see.
        m = Delay._at_once(self, m, t - 4 * _time_tolerance(t))
        late = jnp.where(m.last + 1 < m.valid, t + _time_tolerance(t) - (m.until + self.time), 0.0)
        return m._replace(until=m.until + jnp.maximum(jax.lax.stop_gradient(late), 0.0))


def find_wrong_capacity(capacity: Int, minimum: int, unit: str) -> Iterator[str]:
    """Yield a message if the capacity of an actuator's memory, in `unit` (plural), is no integer >= `minimum`."""
    if not isinstance(capacity, int | np.integer) or isinstance(capacity, bool):
        yield f"capacity = {format_value(capacity)} is no integer; one in [{minimum}, inf) {unit} is needed"
    elif capacity < minimum:
        yield f"capacity = {capacity} is outside [{minimum}, inf) {unit}"


def _row(piece: Piece) -> Vector:
    return jnp.stack([jnp.asarray(x) for x in jax.tree.leaves(piece)])


def _piece(window: Matrix, place: Array) -> Piece:
    """Return the piece at a place of the window, by selects.

    A gather at a computed index would prevent XLA from fusing the stages of a step.
    """
    # Comparisons of integers are no events.
    row, place = [window[0, j] for j in range(window.shape[1])], place.astype(int)
    for i in range(1, WINDOW_PIECES):
        row = [jnp.where(place >= i, window[i, j], x) for j, x in enumerate(row)]
    return Piece.of(row)


def _ring_place(place: Array, size: int) -> Array:
    """Return a place wrapped into a ring of `size` rows, for place < 2 size."""
    return jnp.where(place >= size, place - size, place)


def _differ(before: tuple[PyTree, PyTree], after: tuple[PyTree, PyTree]) -> Scalar:
    """Return whether value, or rate times delay, jumps between `before` and `after` by more than rounding."""
    size = jnp.abs(before[0]) + jnp.abs(before[1]) + jnp.abs(after[0]) + jnp.abs(after[1])
    jumps = [
        jnp.abs(x - y) > jnp.finfo(size.dtype).eps ** SMOOTH_CHANGE_SHARE * size
        for x, y in zip(before, after, strict=True)
    ]
    return jnp.any(jnp.stack(jumps))


def _time_tolerance(t: Array) -> Array:
    """Return the bound on the difference of two computations of the time t [s]."""
    return TIME_EPS * jnp.finfo(jnp.result_type(t)).eps * jax.lax.stop_gradient(t)


# Custom JVPs hide the comparisons in these functions from the event detection: the command does not break where they
# change. Their tangents are exact away from the thresholds.


@jax.custom_jvp
def _count(ends: list[PyTree], t: Array, low: Scalar, high: Scalar) -> Array:
    """Return the number of pieces that are over at time t, clamped to [low, high]."""
    over = sum(jnp.where((i < high) & (t >= end), 1.0, 0.0) for i, end in enumerate(ends))
    return jnp.maximum(jnp.minimum(jnp.asarray(over, t.dtype), high), low)


@_count.defjvp
def _constant(at: tuple[Scalar, ...], moves: tuple[Scalar, ...]) -> tuple[PyTree, PyTree]:
    del moves
    count = _count(*at)
    return count, jnp.zeros_like(count)


@jax.custom_jvp
def _at_most_one(x: Scalar) -> Scalar:
    return jnp.minimum(x, 1.0)


@_at_most_one.defjvp
def _slope(at: tuple[Scalar, ...], moves: tuple[Scalar, ...]) -> tuple[PyTree, PyTree]:
    return _at_most_one(*at), jnp.where(at[0] <= 1.0, moves[0], 0.0)
