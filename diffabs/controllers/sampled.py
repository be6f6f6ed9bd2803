"""Any controller as a computer runs it: sampled, computed for a while, held.

    u(t) = u_k for t_k + delay <= t < t_(k+1) + delay,   t_k = k period,   I_(k+1) = I_k + period I'(t_k)

The continuous memory of the inner controller is advanced by forward Euler at the sampling period, as such code is
usually written. The change of the output after the delay is an event.

A sample is not used if a number that the controller reads is NaN, or if its memory or output would not be finite:
memory and output stay those of the sample before."""

from collections.abc import Iterator
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.controllers.pid import PID
from diffabs.core.blocks import offers
from diffabs.core.numerics import axpy
from diffabs.core.protocols import Block, Clock, Memory, Tracking, no_flow
from diffabs.core.pytree import Scalar, param, part, pytree
from diffabs.core.rules import Rule, as_rule_array
from diffabs.core.timing import whole_steps
from diffabs.core.tracing import leaf_dependence

PERIOD_EPS = 16.0  # precisions of the time: instants that are one


class SampledMemory(NamedTuple):
    """Inner memory; output that is applied; output that waits, until when [s], and 1 while it does."""

    inner: Memory
    applied: Scalar
    next: Scalar
    until: Scalar
    waits: Scalar


@pytree
class Sampled:
    """`controller` evaluated every `period`, its output applied `delay` later. The period is a multiple of the step."""

    controller: Block = part(default=PID)
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    delay: Scalar = param(default=0.0, unit="s", low=0.0)

    flow = no_flow

    def start(self, signal: Tracking) -> Memory:
        """Output zero until the first sample has been computed."""
        signal = replace_nan(signal)
        zero = 0.0 * signal.target
        return Memory(held=SampledMemory(self.controller.start(signal), zero, zero, zero, zero))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """The held output."""
        del t, signal
        return memory.held.applied

    def tick(self, clock: Clock, memory: Memory, signal: Tracking) -> Memory:
        """At a sampling instant: compute. What still waits is applied."""
        m: SampledMemory = memory.held
        now, number = clock.ticks(self.period)
        inner, output, _ = self.guarded(clock._replace(h=self.period, k=number), m.inner, m.next, signal)
        waits = self._waits()
        applied = jnp.where(waits, jnp.where(m.waits > 0.5, m.next, m.applied), output)
        new = SampledMemory(inner, applied, output, self._until(clock.t), jnp.where(waits, 1.0, 0.0))
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(now, a, b), new, m))

    def computed(self, clock: Clock, memory: Memory, signal: Tracking) -> tuple[Memory, Scalar]:
        """What the computer does with one sample: the inner controller's memory after it, and the output. `clock` is
        that of the period."""
        inner = self._sampled(clock, memory, signal)
        output = self.controller.output(clock.t, inner, signal)
        flow = axpy(clock.h, self.controller.flow(clock.t, inner, signal), inner.flow)
        return Memory(flow, inner.held), output

    def guarded(
        self, clock: Clock, memory: Memory, last: Scalar, signal: Tracking, lost: Any = False
    ) -> tuple[Memory, Scalar, Any]:
        """What `computed` returns, and False; or, where the sample is `lost` or cannot be used, the memory and the
        `last` output as they are, and True."""
        # on numbers, also where there are none: nothing that is not defined for NaN is computed or differentiated
        before = None if clock.before is None else replace_nan(clock.before)
        new = self.computed(clock._replace(before=before), memory, replace_nan(signal))
        read = leaf_dependence(lambda signal: self.computed(clock, memory, signal), signal)
        numbers = [x for x, on in zip(jax.tree.leaves(signal), read, strict=True) if on]
        results = [x for x in jax.tree.leaves(new) if jnp.issubdtype(jnp.result_type(x), jnp.floating)]
        missing = [jnp.any(jnp.isnan(x)) for x in numbers]
        infinite = [~jnp.all(jnp.isfinite(x)) for x in results]
        held = reduce(jnp.logical_or, [*missing, *infinite], lost)
        inner, output = jax.tree.map(lambda old, new: jnp.where(held, old, new), (memory, last), new)
        return inner, output, held

    def _waits(self) -> Any:
        """Whether an output is computed for a while, so that an event applies it."""
        return jnp.greater(self.delay, 0)

    def differentiated(self, names: set[str]) -> "Sampled":
        """Return the same controller for derivatives by these of its parameters."""
        if "delay" not in names:
            return self
        return _AlwaysWaits(controller=self.controller, period=self.period, delay=self.delay)

    def _until(self, t: Scalar) -> Any:
        """When what is sampled now is applied. A rounding early: an event exactly on an instant of the grid would end
        no step, and the greatest value of a run there would have the derivative of the instant, which does not move."""
        rounding = PERIOD_EPS * jnp.finfo(jnp.result_type(t, self.period)).eps * (t + self.period)
        early = jnp.maximum(jnp.minimum(rounding, self.delay), self.delay - (self.period - rounding))
        return t + self.delay - jax.lax.stop_gradient(early)

    def margins(self, t: Scalar, memory: Memory, signal: Tracking, rate: Any) -> tuple[Any]:
        """The time until the output changes."""
        del signal, rate
        return (jnp.where(memory.held.waits > 0.5, memory.held.until - t, 1.0),)

    def event(self, t: Scalar, memory: Memory, signal: Tracking, fired: tuple[Any]) -> Memory:
        """Apply what waits."""
        del t, signal
        m: SampledMemory = memory.held
        applied, waits = jnp.where(fired[0], m.next, m.applied), jnp.where(fired[0], 0.0, m.waits)
        return Memory(held=m._replace(applied=applied, waits=waits))

    def _sampled(self, clock: Clock, memory: Memory, signal: Tracking) -> Memory:
        """The inner controller's memory after its tick, or after an event that it can only notice now."""
        inner: Any = self.controller
        if offers(inner, "margins"):
            late = tuple(margin < 0 for margin in inner.margins(clock.t, memory, signal, None))
            memory = inner.event(clock.t, memory, signal, late)
        return inner.tick(clock, memory, signal) if offers(inner, "tick") else memory

    def rules(self) -> Iterator[Rule]:
        """A computation takes no longer than the period; a filter follows its samples."""
        yield from within_period(self.controller, self.delay, self.period)

    def grid_rules(self, step: float) -> Iterator[Rule]:
        """The period is on the integration grid."""
        yield whole_steps("period", self.period, step)


def replace_nan(signal: Any) -> Any:
    """Return a signal with 0 for NaN: a memory that begins on it is finite."""
    return jax.tree.map(lambda x: jnp.where(jnp.isnan(x), 0.0, x), signal)


@pytree
class _AlwaysWaits(Sampled):
    """A controller whose output is applied in an event after any delay. Without a delay, too, it then has a derivative
    in it, that from the right; the sample kept at such an instant is the output before. Values do without, because an
    event in every period makes a run some times as long."""

    def _waits(self) -> Any:
        return jnp.asarray(True)


def inner_controller(controller: Any) -> Any:
    """Return what a computer runs, or a controller that none runs itself."""
    return controller.controller if isinstance(controller, Sampled) else controller


def within_period(controller: Any, delay: Scalar, period: Scalar) -> Iterator[Rule]:
    """Yield what must hold between a period [s] and the controller that is computed in it, `delay` [s] long."""
    yield delay_within(delay, period)
    if hasattr(controller, "cutoff"):
        yield filter_within(controller.cutoff, period)


def delay_within(delay: Scalar, period: Scalar) -> Rule:
    """Return the rule that a delay [s] does not exceed the period [s]."""
    return Rule(
        as_rule_array(delay) <= as_rule_array(period),
        "delay exceeds the period",
        lambda: f"delay = {delay:g} s exceeds the period of {period:g} s",
    )


def filter_within(cutoff: Scalar, period: Scalar) -> Rule:
    """Return the rule that forward Euler, d_(k+1) = d_k + period cutoff (e - d_k), is stable: cutoff [rad/s] is below
    2 / period [s]."""
    return Rule(
        as_rule_array(cutoff) * as_rule_array(period) < 2,
        "controller.cutoff is too fast for the period",
        lambda: (
            f"controller.cutoff = {cutoff:g} rad/s is outside (0, {2 / period:g}) rad/s: sampled every {period:g} s, a"
            " faster filter is not stable"
        ),
    )
