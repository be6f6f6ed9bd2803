"""Any controller as a computer runs it: sampled, computed for a while, held.

    u(t) = u_k for t_k + delay <= t < t_(k+1) + delay,   t_k = k period,   I_(k+1) = I_k + period I'(t_k)

The continuous memory of the inner controller is advanced by forward Euler at the sampling period, as such code is
usually written. When the output changes inside an integration step, the step uses its mean: the impulse is exact, and
the run is differentiable in the delay."""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.controllers.pid import PID
from diffabs.core.numerics import axpy, clamp
from diffabs.core.protocols import Block, Clock, Jump, Memory, Tracking, no_flow
from diffabs.core.pytree import Scalar, param, part, pytree
from diffabs.core.rules import Rule, array
from diffabs.core.timing import steps, whole_steps


class SampledMemory(NamedTuple):
    """Inner memory; output before and after the pending change, time of that change [s]; mean over the present step."""

    inner: Memory
    before: Scalar
    after: Scalar
    change: Scalar
    applied: Scalar


@pytree
class Sampled:
    """`controller` evaluated every `period`, its output applied `delay` later. The period is a multiple of the step."""

    controller: Block = part(default=PID)
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    delay: Scalar = param(default=0.0, unit="s", low=0.0)

    flow = no_flow

    def start(self, signal: Tracking) -> Memory:
        """Output zero until the first sample has been computed."""
        zero = 0.0 * signal.target
        return Memory(held=SampledMemory(self.controller.start(signal), zero, zero, zero, zero))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """The held output, averaged over the present step."""
        del t, signal
        return memory.held.applied

    def jump(self, clock: Clock, memory: Memory, signal: Tracking) -> Jump:
        """At a sampling instant: compute; in every step: hold."""
        m: SampledMemory = memory.held
        due = clock.k % steps(self.period, clock.h) == 0
        inner = self.controller.jump(clock, m.inner, signal).memory
        output = self.controller.output(clock.t, inner, signal)
        flow = axpy(self.period, self.controller.flow(clock.t, inner, signal), inner.flow)
        new = SampledMemory(Memory(flow, inner.held), m.after, output, clock.t + self.delay, m.applied)
        m = jax.tree.map(lambda a, b: jnp.where(due, a, b), new, m)
        waiting = clamp((m.change - clock.t) / clock.h, 0.0, 1.0)
        return Jump(Memory(held=m._replace(applied=waiting * m.before + (1 - waiting) * m.after)))

    def rules(self) -> Iterator[Rule]:
        """A computation takes no longer than the period."""
        yield Rule(
            array(self.delay) <= array(self.period),
            "delay exceeds the period",
            lambda: f"delay = {self.delay:g} s exceeds the period of {self.period:g} s",
        )

    def grid_rules(self, step: float) -> Iterator[Rule]:
        """The period is on the integration grid."""
        yield whole_steps("period", self.period, step)
