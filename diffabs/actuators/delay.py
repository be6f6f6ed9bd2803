"""Pure delay: control(t) = command(t - time), and 0 before the first command has come through.

Of each past step, whatever its length, the delay keeps the times of both ends and the cubic of the command between
them, from values and rates there. So a smooth command comes out to the order of the method. Where one step's end and
the next one's beginning are not the same, in value or in rate, the command has jumped or bent: a step of the run ends
where that comes out, and the moment of it carries the derivatives of the moment at which it went in, and of `time`.
To a delay of exactly one step the jump is known when it comes out. Where a derivative by `time` is asked for, the next
step begins with that event (`_InEvents`).

In Runge-Kutta stages the delayed command must be smooth, also beyond such an end. So a step uses the pieces between
two ends alone, from a window of those that come out next, which is moved on after every step."""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.blocks import Passage
from diffabs.core.cubic import Cubic
from diffabs.core.log import Log
from diffabs.core.protocols import Clock, Memory, no_flow
from diffabs.core.pytree import Scalar, param, pytree, static
from diffabs.core.rules import Rule, as_rule_array

TIME_ROUNDING = 1e-6  # relative, of single precision
WINDOW_PIECES = 6  # pieces: a step that spans more is cut
TIME_EPS = 16.0  # precisions of the time: instants that are one
SMOOTH_CHANGE_SHARE = 0.5  # power of the precision: a relative difference that is no jump
SPARE, CUTS = 16, 4  # pieces beyond the capacity, and one more for so many steps: for steps that are cut


class Piece(NamedTuple):
    """A past step: times of its ends [s], the cubic of the command between them, and 1 where the command does not go on
    smoothly from the piece before."""

    start: Scalar
    end: Scalar
    command: Cubic
    breaks: Scalar

    @classmethod
    def of(cls, row: Any) -> "Piece":
        """The piece of a row."""
        start, end, *command, breaks = row
        return cls(start, end, Cubic(*command), breaks)

    @property
    def rate(self) -> Any:
        """Of the command, at the end."""
        return self.command.end_slope / (self.end - self.start)


class DelayMemory(NamedTuple):
    """A ring of past steps, a row for each `Piece`. The window: rows of the pieces that come out next, how many of them
    there are; between `place` and `last`, those of which the present step may use; and until when [s] it may, less the
    delay. Where the window begins in the ring, and how many pieces there are from there on; the newest of them. Whole
    numbers are of the type of the signal."""

    ring: Log
    window: Any
    known: Any
    place: Any
    last: Any
    until: Any
    first: Any
    count: Any
    newest: Any


@pytree
class Delay:
    """control(t) = command(t - time). The delay is at least one step and at most capacity - 2 of them. There is room
    for events that cut every fourth of these steps; a run with more of them within one delay has diverged."""

    time: Scalar = param(default=0.01, unit="s", above=0.0)
    capacity: int = static(default=1024)

    flow = no_flow

    def start(self, signal: Scalar) -> Memory:
        """Nothing on the way yet: one piece that is 0, until t = 0."""
        zero = 0.0 * jnp.asarray(signal)
        row = _row(Piece(zero - self.time, zero, Cubic(zero, zero, zero, zero), zero))
        window = jnp.broadcast_to(row, (WINDOW_PIECES, *row.shape))
        rows = jnp.zeros((self.capacity + self.capacity // CUTS + SPARE, *row.shape), row.dtype)
        ring = Log(rows, zero, row).put(zero, row)
        return Memory((), self._aimed(DelayMemory(ring, window, zero + 1, zero, zero, zero, zero, zero + 1, row)))

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Any:
        """The delayed command; beyond a break that has not come out, straight on."""
        del signal
        m: DelayMemory = memory.held
        piece = _piece(m.window, self._place(t, m))
        x = (t - self.time - piece.start) / (piece.end - piece.start)
        within = _at_most_one(x)
        return piece.command(within) + (x - within) * piece.command.end_slope

    def margins(self, t: Scalar, memory: Memory, signal: Scalar, rate: Any) -> tuple[Any]:
        """The time until the command that comes out breaks, or until more must be known of it."""
        del signal, rate
        return (memory.held.until + self.time - t,)

    def event(self, t: Scalar, memory: Memory, signal: Scalar, fired: tuple[Any]) -> Memory:
        """The break has come out."""
        del t, signal
        m: DelayMemory = memory.held
        out = fired[0] & (m.last + 1 < m.known)
        return memory._replace(held=self._aimed(m._replace(place=jnp.where(out, m.last + 1, m.place))))

    def record(self, memory: Memory, passage: Passage) -> Memory:
        """Store the step that is over; one without a length is none."""
        m: DelayMemory = memory.held
        h, free = passage.end - passage.start, _ring_place(m.first + m.count, m.ring.size)
        before = Piece.of(jax.lax.stop_gradient(m.newest))
        cubic = Cubic(*passage.values, *(h * rate for rate in passage.rates))
        after = passage.values[0], self.time * passage.rates[0]
        breaks = jnp.where(_differ((before.command.end, before.rate * self.time), after), 1.0, 0.0).astype(h.dtype)
        row = _row(Piece(passage.start, passage.end, cubic, breaks))
        some = h > _rounding(passage.end)
        count = m.count + jnp.where(some, 1.0, 0.0)
        newest = jnp.where(some, row, m.newest)
        return memory._replace(held=m._replace(ring=m.ring.put(free, row), newest=newest, count=count))

    def tick(self, clock: Clock, memory: Memory, signal: Scalar) -> Memory:
        """The window from here. After a delay of one step, what breaks at this very instant has come out."""
        del signal
        m: DelayMemory = memory.held
        size, over = m.ring.size, self._place(clock.t, m)
        first, count = _ring_place(m.first + over, size), m.count - over
        rows = m.ring.read(_ring_place(first.astype(int) + jnp.arange(WINDOW_PIECES), size))
        window = jnp.where(count < size, rows, jnp.nan)  # else a piece that is still to come out is overwritten
        known, none = jnp.minimum(count, WINDOW_PIECES), jnp.zeros_like(count)
        new = self._aimed(DelayMemory(m.ring, window, known, none, none, none, first, count, m.newest))
        return memory._replace(held=self._at_once(new, clock.t))

    def _at_once(self, m: DelayMemory, t: Scalar) -> DelayMemory:
        """What breaks at time t or before has come out."""
        out = (m.last + 1 < m.known) & (m.until + self.time <= t)
        return self._aimed(m._replace(place=jnp.where(out, m.last + 1, m.place)))

    def differentiated(self, names: set[str]) -> "Delay":
        """Return the same delay for derivatives by these of its parameters."""
        return _InEvents(time=self.time, capacity=self.capacity) if "time" in names else self

    def _place(self, t: Scalar, m: DelayMemory) -> Any:
        """Which piece of the window comes out at time t, up to the next break."""
        return _count([m.window[i, 1] for i in range(WINDOW_PIECES)], t - self.time, m.place, m.last)

    def _aimed(self, m: DelayMemory) -> DelayMemory:
        """With the last piece before the next break, and the time of that."""
        last = m.known - 1
        for i in reversed(range(1, WINDOW_PIECES)):
            last = jnp.where((i > m.place) & (i < m.known) & (m.window[i, -1] > 0.5), i - 1.0, last)
        breaks = last + 1 < m.known
        until = jnp.where(breaks, _piece(m.window, last + 1).start, _piece(m.window, last).end)
        # Before what happens on the grid, or the moment would lose its derivatives; but no step is cut at its own end.
        newest = ~breaks & (m.known == m.count)
        return m._replace(last=last, until=until + jnp.where(newest, 1.0, -1.0) * _rounding(until + self.time))

    def refined(self, times: int) -> "Delay":
        """The same delay in so many more steps."""
        return dataclasses.replace(self, capacity=times * self.capacity)  # pyright: ignore[reportArgumentType]

    def grid_rules(self, step: float) -> Iterator[Rule]:
        """The ring holds the delay, to the rounding of single precision."""
        most, time = (self.capacity - 2) * step, as_rule_array(self.time)
        outside = f"outside [{step:g}, {most:g}] s, one step to capacity - 2 steps"
        yield Rule(
            (step <= time * (1 + TIME_ROUNDING)) & (time * (1 - TIME_ROUNDING) <= most),
            f"time is {outside}",
            lambda: f"time = {float(self.time):g} s is {outside}",
        )


@pytree
class _InEvents(Delay):
    """A delay whose command breaks in an event, also after a delay of one step: at the beginning of the next one. The
    moment then has a derivative, and the sample kept at that instant is the command before."""

    def _at_once(self, m: DelayMemory, t: Scalar) -> DelayMemory:
        # A break that is over has come out: a repeated run may see one that, to rounding, it did not see before.
        m = Delay._at_once(self, m, t - 4 * _rounding(t))
        late = jnp.where(m.last + 1 < m.known, t + _rounding(t) - (m.until + self.time), 0.0)
        return m._replace(until=m.until + jnp.maximum(jax.lax.stop_gradient(late), 0.0))


def _row(piece: Piece) -> Any:
    return jnp.stack([jnp.asarray(x) for x in jax.tree.leaves(piece)])


def _piece(window: Any, place: Any) -> Piece:
    """The piece at a place. By selections: a slice whose place is computed would take the stages of a step apart."""
    row, place = [window[0, j] for j in range(window.shape[1])], place.astype(int)  # whole numbers have no kinks
    for i in range(1, WINDOW_PIECES):
        row = [jnp.where(place >= i, window[i, j], x) for j, x in enumerate(row)]
    return Piece.of(row)


def _ring_place(place: Any, size: int) -> Any:
    """A place in a ring of this size, for one less than twice as far."""
    return jnp.where(place >= size, place - size, place)


def _differ(before: tuple[Any, Any], after: tuple[Any, Any]) -> Any:
    """Whether a command does not go on as a smooth one does: value, and change within the delay, at one instant."""
    size = jnp.abs(before[0]) + jnp.abs(before[1]) + jnp.abs(after[0]) + jnp.abs(after[1])
    jumps = [
        jnp.abs(x - y) > jnp.finfo(size.dtype).eps ** SMOOTH_CHANGE_SHARE * size
        for x, y in zip(before, after, strict=True)
    ]
    return jnp.any(jnp.stack(jumps))


def _rounding(t: Any) -> Any:
    """By how much two computations of the time t may differ."""
    return TIME_EPS * jnp.finfo(jnp.result_type(t)).eps * jax.lax.stop_gradient(t)


# Rules of their own, so that nobody looks for the places where these change: the command does not break there.


@jax.custom_jvp
def _count(ends: list[Any], t: Any, low: Any, high: Any) -> Any:
    """How many pieces are over at t, within these limits."""
    over = sum(jnp.where((i < high) & (t >= end), 1.0, 0.0) for i, end in enumerate(ends))
    return jnp.maximum(jnp.minimum(jnp.asarray(over, t.dtype), high), low)


@_count.defjvp
def _constant(at: Any, moves: Any) -> tuple[Any, Any]:
    del moves
    count = _count(*at)
    return count, jnp.zeros_like(count)


@jax.custom_jvp
def _at_most_one(x: Any) -> Any:
    return jnp.minimum(x, 1.0)


@_at_most_one.defjvp
def _slope(at: Any, moves: Any) -> tuple[Any, Any]:
    return _at_most_one(*at), jnp.where(at[0] <= 1.0, moves[0], 0.0)
