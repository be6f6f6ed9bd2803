"""Pure delay: control(t) = command(t - time), and 0 before the first command has come through.

The command is kept at the instants of the integration grid and joined by straight lines; each step uses the exact mean
of the delayed command over the step. That is second order in the step, exact in the impulse of the first command, and
differentiable in the delay."""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp

from diffabs.core.numerics import clamp
from diffabs.core.protocols import Clock, Jump, Memory, no_flow
from diffabs.core.pytree import Scalar, param, pytree, static
from diffabs.core.rules import Rule, array

ROUNDING = 1e-6  # relative


class DelayMemory(NamedTuple):
    """Ring of past commands; mean of the delayed command over the present step."""

    ring: Any
    applied: Scalar


@pytree
class Delay:
    """control(t) = command(t - time). `capacity` is how many steps the ring holds; the delay is at least one step and
    at most capacity - 2 of them."""

    time: Scalar = param(default=0.01, unit="s", above=0.0)
    capacity: int = static(default=1024)

    flow = no_flow

    def start(self, signal: Scalar) -> Memory:
        """Nothing on the way yet."""
        zero = 0.0 * jnp.asarray(signal)
        return Memory(held=DelayMemory(jnp.zeros(self.capacity, zero.dtype) + zero, zero))

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """The delayed command, averaged over the present step."""
        del t, signal
        return memory.held.applied

    def jump(self, clock: Clock, memory: Memory, signal: Scalar) -> Jump:
        """Store the present command, average the delayed one over the step that follows."""
        ring = memory.held.ring.at[clock.k % self.capacity].set(signal)
        back = clamp(self.time / clock.h, 1.0, self.capacity - 2.0)
        whole = jnp.ceil(back)
        first = clock.k - whole.astype(int)  # sample at or before t - time
        part = whole - back  # how far into that segment the step begins

        def line(i: Any, left: Any, right: Any) -> Any:
            """Integral of the command over [i + left, i + right] steps, 0 before the first command."""
            a, b = ring[i % self.capacity], ring[(i + 1) % self.capacity]
            mean = a + (b - a) * 0.5 * (left + right)
            return jnp.where(i >= 0, mean * (right - left), 0.0)

        second = jnp.minimum(first + 1, clock.k - 1)  # with a delay of one step, part is 0 and so is its share
        return Jump(Memory(held=DelayMemory(ring, line(first, part, 1.0) + line(second, 0.0, part))))

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
