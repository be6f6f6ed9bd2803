"""Any controller as a computer runs it, without events: for many runs, where only their statistics count.

    u(t) = u_k for t_k + delay <= t < t_(k+1) + delay,   t_k = k period,   as `Sampled`,

but a step of the integration [t, t + h] in which u changes, at t + theta h, gets its mean theta u_(k-1) + (1 - theta)
u_k. The impulse is right; behind a lag T > h the torque at the end of such a step is off by h^2/(8 T^2) of the change
at most. No step has to be cut: a run with an event in every period takes four to five times as long.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.controllers.pid import PID
from diffabs.controllers.sampled import PERIOD_EPS, Sampled, replace_nan, within_period
from diffabs.core.numerics import clamp
from diffabs.core.protocols import Block, Clock, Memory, Tracking, no_flow
from diffabs.core.pytree import Scalar, param, part, pytree
from diffabs.core.rules import Rule
from diffabs.core.timing import whole_steps


class GridMemory(NamedTuple):
    """Inner memory; the last output and the one before it; until when [s] that one is applied; what is applied now."""

    inner: Memory
    next: Scalar
    last: Scalar
    until: Scalar
    applied: Scalar


@pytree
class SampledOnGrid:
    """`controller` evaluated every `sampling_period`, its output applied `delay` later; in the step in which that is,
    the mean over the step."""

    controller: Block = part(default=PID)
    # not `period`, at whose instants alone steps would end: it ticks at every instant of the grid
    sampling_period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    delay: Scalar = param(default=0.0, unit="s", low=0.0)

    flow = no_flow
    computed, guarded, _sampled = Sampled.computed, Sampled.guarded, Sampled._sampled

    def start(self, signal: Tracking) -> Memory:
        """Output zero until the first sample has been computed."""
        signal = replace_nan(signal)
        zero = 0.0 * signal.target
        return Memory(held=GridMemory(self.controller.start(signal), zero, zero, zero, zero))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """The mean over the present step."""
        del t, signal
        return memory.held.applied

    def tick(self, clock: Clock, memory: Memory, signal: Tracking) -> Memory:
        """At a sampling instant: compute. At every instant of the grid: what is applied until the next."""
        m: GridMemory = memory.held
        now, number = clock.ticks(self.sampling_period)
        inner, output, _ = self.guarded(clock._replace(h=self.sampling_period, k=number), m.inner, m.next, signal)
        close = PERIOD_EPS * jnp.finfo(jnp.result_type(clock.t, clock.h)).eps * (clock.t + self.sampling_period)
        over = jax.lax.stop_gradient(jnp.maximum(self.delay - (self.sampling_period - 2 * close), 0.0))
        new = GridMemory(inner, output, m.next, clock.t + self.delay - over, m.applied)
        m = jax.tree.map(lambda a, b: jnp.where(now, a, b), new, m)
        left = m.until - clock.t
        # An output that changes on the grid belongs to the step after it, so that one step alone has the derivative.
        within = (left >= -close) & (left < clock.h - close)
        fixed = jax.lax.stop_gradient(left)
        waits = clamp(fixed / clock.h, 0.0, 1.0) + jnp.where(within, (left - fixed) / clock.h, 0.0)
        applied = waits * m.last + (1 - waits) * m.next
        return Memory(held=m._replace(applied=jnp.where(clock.ticks()[0], applied, m.applied)))

    def rules(self) -> Iterator[Rule]:
        """A computation takes no longer than the period; a filter follows its samples."""
        yield from within_period(self.controller, self.delay, self.sampling_period)

    def grid_rules(self, step: float) -> Iterator[Rule]:
        """The period is on the integration grid."""
        yield whole_steps("sampling_period", self.sampling_period, step)
