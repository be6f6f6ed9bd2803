"""Controllers without memory of the plant: constant torque, relay with hysteresis, sliding mode."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp

from diffabs.core.numerics import clamp, ratio
from diffabs.core.protocols import Clock, Jump, Memory, Tracking, no_flow, no_jump, no_memory
from diffabs.core.pytree import Scalar, param, pytree
from diffabs.core.rules import Rule, ordered


@pytree
class ConstantTorque:
    """u = torque: a driver who stands on the brake, no anti-lock control."""

    torque: Scalar = param(default=90.0, unit="control")

    start = no_memory
    flow = no_flow
    jump = no_jump

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Torque [N m]."""
        del t, memory, signal
        return self.torque


class RelayMemory(NamedTuple):
    """1 while the brake is applied, else 0; excess of the slip over the target at the last instant."""

    applied: Scalar
    excess: Scalar


@pytree
class Relay:
    """torque_max until slip > target + band, then torque_min until slip < target - band.

    Switches at the instants of the integration grid; the moment of the crossing inside the step is that of the parabola
    through the excess at both ends with its rate at the later one, so that a run does not depend on the grid and is
    differentiable.
    """

    band: Scalar = param(default=0.02, unit="signal", above=0.0, below=1.0)
    torque_min: Scalar = param(default=0.0, unit="control")
    torque_max: Scalar = param(default=90.0, unit="control")

    flow = no_flow

    def start(self, signal: Tracking) -> Memory:
        """Applied if the slip is below the target."""
        excess = signal.measured[0] - signal.target
        return Memory(held=RelayMemory(jnp.where(excess < 0, 1.0, 0.0) + 0.0 * excess, excess))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Torque [N m]."""
        del t, signal
        applied = memory.held.applied
        return self.torque_min + applied * (self.torque_max - self.torque_min)

    def jump(self, clock: Clock, memory: Memory, signal: Tracking) -> Jump:
        """Switch at the far side of the band."""
        applied, before = memory.held
        excess = signal.measured[0] - signal.target
        release = (applied > 0.5) & (excess > self.band)
        apply = (applied < 0.5) & (excess < -self.band)
        side = jnp.where(release, 1.0, -1.0)
        slope = excess - before
        if clock.rate is not None:
            rate = clock.rate()
            slope = clock.h * (rate.measured[0] - rate.target)
        late = _crossed(side * (before - side * self.band), side * (excess - side * self.band), side * slope)
        elapsed = jnp.where(release | apply, late * clock.h, 0.0)
        now = jnp.where(release, 0.0, jnp.where(apply, 1.0, applied))
        return Jump(Memory(held=RelayMemory(now, excess)), elapsed)

    def rules(self) -> Iterator[Rule]:
        """A release torque below the applied one."""
        yield ordered(("torque_min", self.torque_min), ("torque_max", self.torque_max), "{control}", equal=False)


def _crossed(before: Scalar, after: Scalar, slope: Scalar) -> Any:
    """How long ago, in steps, a value became positive that was `before` <= 0, is `after` > 0, and now rises by `slope`
    a step: the latest zero of the parabola after - slope r + bend r^2, in a form that does not cancel."""
    bend = before - after + slope
    square = slope**2 - 4.0 * bend * after
    root = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    return clamp(ratio(2.0 * after, slope + root), 0.0, 1.0)


@pytree
class SlidingMode:
    """u = clamp(ff + gain sat((target - slip)/boundary), torque_min, torque_max), sat(z) = clamp(z, -1, 1).

    First-order sliding mode with a boundary layer. Slotine and Li, Applied Nonlinear Control, sec. 7.2.
    """

    gain: Scalar = param(default=90.0, unit="control", low=0.0)
    boundary: Scalar = param(default=0.02, unit="signal", above=0.0)
    torque_min: Scalar = param(default=0.0, unit="control")
    torque_max: Scalar = param(default=90.0, unit="control")

    start = no_memory
    flow = no_flow
    jump = no_jump

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Torque [N m]."""
        del t, memory
        inside = clamp((signal.target - signal.measured[0]) / self.boundary, -1.0, 1.0)
        return clamp(signal.feedforward + self.gain * inside, self.torque_min, self.torque_max)

    def rules(self) -> Iterator[Rule]:
        """Limits that do not exclude each other."""
        yield ordered(("torque_min", self.torque_min), ("torque_max", self.torque_max), "{control}", equal=False)
