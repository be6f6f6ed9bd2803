"""Pure delay: control(t) = command(t - time), and 0 before the first command has come through.

Of each past step of the grid the ring keeps the command at both ends and its mean, which is integrated with the plant:
a parabola that is the command to third order; where the command jumped in an event within the step, its impulse.
The step that lies ahead needs it between t - time and t - time + h, where the end of a ring's step may lie and the
command may jump. Runge-Kutta stages would not see that, so the step uses the straight line that has the same mean and
the same first moment: of a smooth command that costs no order, and of a jump the impulse is exact. The line does not
leave the range of the commands that it stands for."""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import clamp
from diffabs.core.protocols import Clock, Memory
from diffabs.core.pytree import Scalar, param, pytree, static
from diffabs.core.rules import Rule, array

ROUNDING = 1e-6  # relative


class DelayMemory(NamedTuple):
    """Rings of the past steps: command at the start, at the end, and mean. Of the present step: the delayed command in
    its middle, its change over the step, that middle [s], and the step's length [s]."""

    start: Any
    end: Any
    mean: Any
    level: Scalar
    rise: Scalar
    middle: Scalar
    h: Scalar


@pytree
class Delay:
    """control(t) = command(t - time). `capacity` is how many steps the ring holds; the delay is at least one step and
    at most capacity - 2 of them."""

    time: Scalar = param(default=0.01, unit="s", above=0.0)
    capacity: int = static(default=1024)

    def start(self, signal: Scalar) -> Memory:
        """Nothing on the way yet."""
        zero = 0.0 * jnp.asarray(signal)
        ring = jnp.zeros(self.capacity, zero.dtype) + zero
        return Memory(zero, DelayMemory(ring, ring, ring, zero, zero, zero, zero + 1.0))

    def flow(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """The command: what is integrated over the present step is its mean."""
        del t, memory
        return signal

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """The line that stands for the delayed command."""
        del signal
        m: DelayMemory = memory.held
        return m.level + m.rise * (t - m.middle) / m.h

    def tick(self, clock: Clock, memory: Memory, signal: Scalar) -> Memory:
        """Store the step that is over, and find the line for the one that follows."""
        on_grid, number = clock.ticks()
        end = signal if clock.before is None else clock.before
        last, now = (number - 1) % self.capacity, number % self.capacity
        held: DelayMemory = memory.held
        rings = held._replace(
            start=held.start.at[now].set(signal),
            end=held.end.at[last].set(end),
            mean=held.mean.at[last].set(memory.flow / clock.h),
            middle=clock.t + 0.5 * clock.h,
            h=clock.h,
        )
        back = clamp(self.time / clock.h, 1.0, self.capacity - 2.0)
        whole = jnp.ceil(back)
        level, rise = self._line(rings, number - whole.astype(int), whole - back, number)
        new = Memory(0.0 * memory.flow, rings._replace(level=level, rise=rise))
        return jax.tree.map(lambda a, b: jnp.where(on_grid, a, b), new, memory)

    def _line(self, rings: DelayMemory, first: Any, part: Any, now: Any) -> tuple[Any, Any]:
        """The delayed command in the middle of a step that begins a `part` into step `first` of the ring, and its
        change. With a delay of one step, the second piece has no length, and is not known yet."""
        pieces = ((first, part, 1.0, -part), (jnp.minimum(first + 1, now - 1), 0.0, part, 1.0 - part))
        found = [_moments(rings, i % self.capacity, *place) for i, *place in pieces]
        found = [[jnp.where(i >= 0, x, 0.0) for x in one] for (i, *_), one in zip(pieces, found, strict=True)]
        mean, moment = (found[0][n] + found[1][n] for n in (0, 1))
        low = jnp.minimum(found[0][2], jnp.where(part > 0, found[1][2], jnp.inf))
        high = jnp.maximum(found[0][3], jnp.where(part > 0, found[1][3], -jnp.inf))
        most = 2.0 * jnp.maximum(jnp.minimum(mean - low, high - mean), 0.0)
        return mean, clamp(12.0 * (moment - 0.5 * mean), -most, most)

    def refined(self, times: int) -> "Delay":
        """The same delay in so many more steps."""
        return dataclasses.replace(self, capacity=times * self.capacity)  # pyright: ignore[reportArgumentType]

    def grid_rules(self, step: float) -> Iterator[Rule]:
        """The ring holds the delay, to the rounding of single precision."""
        most, time = (self.capacity - 2) * step, array(self.time)
        outside = f"outside [{step:g}, {most:g}] s, one step to capacity - 2 steps"
        yield Rule(
            (step <= time * (1 + ROUNDING)) & (time * (1 - ROUNDING) <= most),
            f"time is {outside}",
            lambda: f"time = {float(self.time):g} s is {outside}",
        )


def _moments(rings: DelayMemory, i: Any, left: Any, right: Any, shift: Any) -> tuple[Any, Any, Any, Any]:
    """Of the parabola of step i of a ring: integrals over [left, right] of the command, and of the command times the
    place + shift, in steps; the least and the greatest command that the whole of it stands for."""
    start, end, mean = rings.start[i], rings.end[i], rings.mean[i]
    bend = 3.0 * (start + end) - 6.0 * mean
    slope = end - start - bend

    def integral(power: int) -> Any:
        terms = ((start, power + 1), (slope, power + 2), (bend, power + 3))
        return sum(c * (right**n - left**n) / n for c, n in terms)

    # The line of a smooth command leaves the range of its ends on the side to which it bends, by this at most.
    low = jnp.minimum(start, end) - jnp.maximum(bend, 0.0) / 2.0
    high = jnp.maximum(start, end) - jnp.minimum(bend, 0.0) / 2.0
    return integral(0), integral(1) + shift * integral(0), low, high
