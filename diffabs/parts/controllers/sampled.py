"""A sampled controller: a computer runs any controller with a period, a computing delay and a hold.

    u(t) = u_k for t_k + delay <= t < t_(k+1) + delay,   t_k = k period,   I_(k+1) = I_k + period I'(t_k)

Forward Euler advances the inner controller's continuous memory at the sampling period, as is usual in such code. The
output changes in an event at the end of the delay.

The controller skips a sample if a number that it reads is NaN, or if its memory or output would not be finite. Memory
and output then keep the values of the previous sample.
"""

import dataclasses
from collections.abc import Iterator
from functools import reduce
from typing import NamedTuple, NoReturn, TypeVar

import jax
import jax.numpy as jnp

from diffabs.core.arrays import as_rule_array
from diffabs.core.blocks import offers
from diffabs.core.numerics import axpy
from diffabs.core.protocols import Block, Clock, Memory, Tracking, no_flow
from diffabs.core.pytree import children, param, part, pytree, replace
from diffabs.core.rules import Rule, period_on_grid, whole_steps
from diffabs.core.tracing import leaf_dependence
from diffabs.core.types import Bool, Part, PyTree, Scalar
from diffabs.parts.controllers.antiwindup import BackCalculation, Clamping
from diffabs.parts.controllers.cascade import Cascade
from diffabs.parts.controllers.per_channel import PerChannel
from diffabs.parts.controllers.pid import PID
from diffabs.parts.controllers.torque_logic import BandLogic

T = TypeVar("T")


PERIOD_EPS = 16.0  # in machine epsilons of the time: closer instants count as equal


class SampledMemory(NamedTuple):
    """Memory of a sampled controller.

    Attributes:
        inner: Memory of the inner controller.
        applied: Output applied now [control].
        next: Output of the latest sample [control]; it is applied at the end of the delay.
        until: Time at which `next` is applied [s].
        waits: 1 until `next` is applied, else 0.
    """

    inner: Memory
    applied: PyTree
    next: PyTree
    until: Scalar
    waits: Scalar


@pytree
class Sampled:
    """`controller` evaluated every `period`, with its output applied `delay` later and held.

    The period must be a whole multiple of the integration step.
    """

    controller: Block = part(default=PID)
    """Controller that the computer runs."""
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    """Period of the samples."""
    delay: Scalar = param(default=0.0, unit="s", low=0.0)
    """Computing time, at most the sampling period."""

    flow = no_flow
    grid_rules = period_on_grid

    def start(self, signal: Tracking) -> Memory:
        """Return the memory with output 0, which applies until the first sample's output replaces it."""
        signal = replace_nan(signal)
        command = jax.tree.map(lambda x: 0.0 * x, signal.feedforward)
        zero = jax.tree.leaves(command)[0]
        return Memory(held=SampledMemory(self.controller.start(signal), command, command, zero, zero))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the held output [control]."""
        del t, signal
        return memory.held.applied

    def tick(self, clock: Clock, memory: Memory, signal: Tracking) -> Memory:
        """Return the memory after a sampling instant, where the controller computes a new output.

        With delay 0 the new output applies at once. Otherwise it waits for an event, and an output that still waits is
        applied now. At all other instants the memory stays the same.
        """
        m: SampledMemory = memory.held
        now, number = clock.ticks(self.period)
        inner, output, _ = self.compute_guarded(clock._replace(h=self.period, k=number), m.inner, m.next, signal)
        waits = self._waits()
        applied = jax.tree.map(
            lambda next, applied, output: jnp.where(waits, jnp.where(m.waits > 0.5, next, applied), output),
            m.next, m.applied, output,
        )  # fmt: skip
        new = SampledMemory(inner, applied, output, self._until(clock.t), jnp.where(waits, 1.0, 0.0))
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(now, a, b), new, m))

    def compute_sample(self, clock: Clock, memory: Memory, signal: Tracking) -> tuple[Memory, Scalar]:
        """Return the inner controller's memory for the next sample, and its output at this one.

        The output comes before the Euler step of length `clock.h`, but after the inner controller's events and tick.

        Args:
            clock: Clock of the sampling period: its h is the period [s], its k the number of the sample.
            memory: Inner controller's memory before the sample.
            signal: The sample: target, measured output and feed-forward.
        """
        inner = self._update_memory(clock, memory, signal)
        output = self.controller.output(clock.t, inner, signal)
        flow = axpy(clock.h, _at_period(self.controller, clock.h).flow(clock.t, inner, signal), inner.flow)
        return Memory(flow, inner.held), output

    def compute_guarded(
        self, clock: Clock, memory: Memory, last: Scalar, signal: Tracking, lost: Bool = False
    ) -> tuple[Memory, Scalar, PyTree]:
        """Return inner memory, output, and whether the sample is skipped.

        A sample is skipped if it is lost, if a number that the controller reads is NaN, or if a result is not finite.
        Memory and output are then the given ones, `memory` and `last`.

        Args:
            clock: Clock of the sampling period: its h is the period [s], its k the number of the sample.
            memory: Inner controller's memory before the sample.
            last: Output of the previous sample [control].
            signal: The sample: target, measured output and feed-forward.
            lost: True skips the sample in any case.
        """
        # Compute with finite inputs even for a skipped sample. Otherwise NaN would reach the derivatives through the
        # branch of `jnp.where` that is not taken.
        before = None if clock.before is None else replace_nan(clock.before)
        new = self.compute_sample(clock._replace(before=before), memory, replace_nan(signal))
        read = leaf_dependence(lambda signal: self.compute_sample(clock, memory, signal), signal)
        # A NaN counts only in a number that the controller reads: an unused channel may be NaN.
        numbers = [x for x, on in zip(jax.tree.leaves(signal), read, strict=True) if on]
        results = [x for x in jax.tree.leaves(new) if jnp.issubdtype(jnp.result_type(x), jnp.floating)]
        missing = [jnp.any(jnp.isnan(x)) for x in numbers]
        infinite = [~jnp.all(jnp.isfinite(x)) for x in results]
        held = reduce(jnp.logical_or, [*missing, *infinite], lost)
        inner, output = jax.tree.map(lambda old, new: jnp.where(held, old, new), (memory, last), new)
        return inner, output, held

    def _waits(self) -> Scalar:
        """Return whether an output waits for the end of a delay, so that an event applies it."""
        return jnp.greater(self.delay, 0)

    def enable_derivatives(self, names: set[str]) -> "Sampled":
        """Return the controller for derivatives with respect to the parameters in `names`.

        This is the controller itself unless `names` contains "delay". For this name, an event applies every output.
        """
        if "delay" not in names:
            return self
        return _AlwaysWaits(controller=self.controller, period=self.period, delay=self.delay)

    def _until(self, t: Scalar) -> Scalar:
        """Return the time at which the output sampled at time t is applied [s].

        The time is a rounding early. An event exactly on a grid instant would not end a step. The maximum of a run at
        this instant would then have the derivative for a fixed time.
        """
        rounding = PERIOD_EPS * jnp.finfo(jnp.result_type(t, self.period)).eps * (t + self.period)
        early = jnp.maximum(jnp.minimum(rounding, self.delay), self.delay - (self.period - rounding))
        return t + self.delay - jax.lax.stop_gradient(early)

    def margins(self, t: Scalar, memory: Memory, signal: Tracking, rate: object) -> tuple[PyTree]:
        """Return the time until the waiting output applies [s], or 1 if no output waits."""
        del signal, rate
        return (jnp.where(memory.held.waits > 0.5, memory.held.until - t, 1.0),)

    def event(self, t: Scalar, memory: Memory, signal: Tracking, fired: tuple[PyTree]) -> Memory:
        """Return the memory after the waiting output has become the applied one."""
        del t, signal
        m: SampledMemory = memory.held
        applied = jax.tree.map(lambda next, applied: jnp.where(fired[0], next, applied), m.next, m.applied)
        waits = jnp.where(fired[0], 0.0, m.waits)
        return Memory(held=m._replace(applied=applied, waits=waits))

    def _update_memory(self, clock: Clock, memory: Memory, signal: Tracking) -> Memory:
        """Return the inner controller's memory after its tick and the events that it detects only at a sample."""
        inner: Part = self.controller
        if offers(inner, "margins"):
            late = tuple(margin < 0 for margin in inner.margins(clock.t, memory, signal, _refuse_rate))
            memory = inner.event(clock.t, memory, signal, late)
        return inner.tick(clock, memory, signal) if offers(inner, "tick") else memory

    def rules(self) -> Iterator[Rule]:
        """Yield the rules that delay and controller fit the period."""
        yield from sampling_rules(self.controller, self.delay, self.period)


def _controllers_in(controller: Cascade | PerChannel) -> list[tuple[str, PyTree]]:
    """Return name and controller of each part of a cascade, or of each channel."""
    return [(name, inner) for name, _, inner in children(controller, "")]


def _at_period(controller: Part, period: Scalar) -> Part:
    """Return the controller with an anti-windup that fits Euler steps of `period` [s]."""
    if isinstance(controller, Cascade | PerChannel):
        return replace(controller, {name: _at_period(inner, period) for name, inner in _controllers_in(controller)})
    antiwindup = getattr(controller, "antiwindup", None)
    if not isinstance(antiwindup, Clamping):
        return controller
    return dataclasses.replace(controller, antiwindup=antiwindup.at_period(period))


def _refuse_rate() -> NoReturn:
    raise ValueError("the signal of a sampled controller has no rate: its `margins` cannot call rate()")


def replace_nan(signal: T) -> T:
    """Return a signal with 0 in place of NaN, so that a memory that starts from it is finite."""
    return jax.tree.map(lambda x: jnp.where(jnp.isnan(x), 0.0, x), signal)


@pytree
class _AlwaysWaits(Sampled):
    """A sampled controller whose output is applied in an event after any delay, including 0.

    With delay 0, the derivative with respect to the delay is the derivative from the right. The stored sample at such
    an instant is the previous output. A run that needs only values uses `Sampled`, because one event in every period
    makes a run several times slower.
    """

    def _waits(self) -> Scalar:
        return jnp.asarray(True)


def inner_controller(controller: object) -> PyTree:
    """Return the controller inside a `Sampled`; any other controller, also `SampledOnGrid`, is returned unchanged."""
    return controller.controller if isinstance(controller, Sampled) else controller


def sampling_rules(controller: Part, delay: Scalar, period: Scalar, name: str = "controller") -> Iterator[Rule]:
    """Yield the rules that delay, the controller's own clock and its Euler steps fit the period."""
    if isinstance(controller, Cascade | PerChannel):
        for part, inner in _controllers_in(controller):
            yield from sampling_rules(inner, delay, period, f"{name}.{part}")
        return
    yield Rule(
        as_rule_array(delay) <= as_rule_array(period),
        "delay exceeds the period",
        lambda: f"delay = {delay:g} s exceeds the period of {period:g} s",
    )
    if offers(controller, "tick") and hasattr(controller, "period"):
        yield whole_steps(f"{name}.period", controller.period, as_rule_array(period), "the sampling period")
    if isinstance(controller, PID):
        # d_(k+1) = d_k + period cutoff (e - d_k)
        cutoff = controller.cutoff
        yield Rule(
            as_rule_array(cutoff) * as_rule_array(period) < 2,
            f"{name}.cutoff is too fast for the period",
            lambda: (
                f"{name}.cutoff = {cutoff:g} rad/s is outside (0, {2 / period:g}) rad/s: sampled every"
                f" {period:g} s, a faster filter is not stable"
            ),
        )
    if isinstance(antiwindup := getattr(controller, "antiwindup", None), BackCalculation):
        # At a limit, one sample multiplies the excess over the limit by 1 - period / tracking_time.
        tracking_time = antiwindup.tracking_time
        yield Rule(
            as_rule_array(period) < 2 * as_rule_array(tracking_time),
            f"{name}.antiwindup.tracking_time is too short for the period",
            lambda: (
                f"{name}.antiwindup.tracking_time = {tracking_time:g} s is outside ({period / 2:g}, inf) s: sampled"
                f" every {period:g} s, a faster back-calculation is not stable"
            ),
        )
    if isinstance(controller, BandLogic):
        # One sample multiplies the torque by 1 - period decay. A negative torque would stay negative.
        decay = controller.decay
        yield Rule(
            as_rule_array(decay) * as_rule_array(period) < 1,
            f"{name}.decay is too fast for the period",
            lambda: (
                f"{name}.decay = {decay:g} 1/s is outside (0, {1 / period:g}) 1/s: sampled every {period:g} s,"
                " a faster decay ends below zero"
            ),
        )
