"""A sampled controller without events, for statistics over many runs.

    u(t) = u_k for t_k + delay <= t < t_(k+1) + delay,   t_k = k period

These are the times of `Sampled`. If u changes inside a step [t, t + h], at t + theta h, the step uses the mean `theta
u_(k-1) + (1 - theta) u_k`. The impulse of the control is exact. Behind a lag T > h the torque error at the end of such
a step is at most h^2/(8 T^2) of the change of u. No step is cut; a run with an event in every period takes four to five
times as long.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import clamp
from diffabs.core.protocols import Block, Clock, Memory, Tracking, no_flow
from diffabs.core.pytree import param, part, pytree
from diffabs.core.rules import Rule, whole_steps
from diffabs.core.types import PyTree, Scalar
from diffabs.parts.controllers.pid import PID
from diffabs.parts.controllers.sampled import PERIOD_EPS, Sampled, replace_nan, sampling_rules


class GridMemory(NamedTuple):
    """Memory of a sampled controller on the grid.

    Attributes:
        inner: Memory of the inner controller.
        next: Output of the latest sample [control].
        last: Output of the sample before it [control].
        until: Time until which `last` is applied [s].
        applied: Mean output in the present step [control].
    """

    inner: Memory
    next: PyTree
    last: PyTree
    until: Scalar
    applied: PyTree


@pytree
class SampledOnGrid:
    """`controller` evaluated every `sampling_period`, with its output applied `delay` later. In the step of the change
    it applies the mean over the step.
    """

    controller: Block = part(default=PID)
    """Controller that the computer runs."""
    # The name is not `period`: for a block with a `period`, steps end only at its multiples, but this block must tick
    # at every grid instant.
    sampling_period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    """Period of the samples, a whole multiple of the integration step."""
    delay: Scalar = param(default=0.0, unit="s", low=0.0)
    """Computing time, at most the sampling period."""

    flow = no_flow
    compute_sample = Sampled.compute_sample
    compute_guarded = Sampled.compute_guarded
    _update_memory = Sampled._update_memory

    def start(self, signal: Tracking) -> Memory:
        """Return the memory with output 0, which applies until the first sample's output replaces it."""
        signal = replace_nan(signal)
        command = jax.tree.map(lambda x: 0.0 * x, signal.feedforward)
        zero = jax.tree.leaves(command)[0]
        return Memory(held=GridMemory(self.controller.start(signal), command, command, zero, command))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the mean output over the present step [control]."""
        del t, signal
        return memory.held.applied

    def tick(self, clock: Clock, memory: Memory, signal: Tracking) -> Memory:
        """Return the memory for the step that begins now, with a new output at a sampling instant.

        At every grid instant it sets the mean output over the coming step. Between grid instants the memory stays the
        same.
        """
        m: GridMemory = memory.held
        now, number = clock.ticks(self.sampling_period)
        inner, output, _ = self.compute_guarded(
            clock._replace(h=self.sampling_period, k=number), m.inner, m.next, signal
        )
        close = PERIOD_EPS * jnp.finfo(jnp.result_type(clock.t, clock.h)).eps * (clock.t + self.sampling_period)
        over = jax.lax.stop_gradient(jnp.maximum(self.delay - (self.sampling_period - 2 * close), 0.0))
        new = GridMemory(inner, output, m.next, clock.t + self.delay - over, m.applied)
        m = jax.tree.map(lambda a, b: jnp.where(now, a, b), new, m)
        remaining = m.until - clock.t
        # A change exactly on the grid belongs to the step after it, so that only one step carries its derivative.
        within = (remaining >= -close) & (remaining < clock.h - close)
        # `waits` is the step's share of the previous output. Only a change inside the step gives it a derivative.
        fixed = jax.lax.stop_gradient(remaining)
        waits = clamp(fixed / clock.h, 0.0, 1.0) + jnp.where(within, (remaining - fixed) / clock.h, 0.0)
        is_tick = clock.ticks()[0]

        def mean(last: Scalar, latest: Scalar, applied: Scalar) -> Scalar:
            return jnp.where(is_tick, waits * last + (1 - waits) * latest, applied)

        return Memory(held=m._replace(applied=jax.tree.map(mean, m.last, m.next, m.applied)))

    def rules(self) -> Iterator[Rule]:
        """Yield the rules that delay and controller fit the period."""
        yield from sampling_rules(self.controller, self.delay, self.sampling_period)

    def grid_rules(self, step: float) -> Iterator[Rule]:
        """Yield the rule that the sampling period is a multiple of the integration step."""
        yield whole_steps("sampling_period", self.sampling_period, step)
