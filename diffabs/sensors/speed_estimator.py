"""The vehicle's speed from what a car has: the wheel's speed, noisy, and an accelerometer, noisy and biased.

A scalar Kalman filter with a gate. Every period h, from the deceleration a and the wheel's speed w as measured,

    p = v - h a,                 P- = P + h q^2           prediction, and its variance
    s = (p - w)/p                                         the slip that it means
    gate = 1 for s <= 0, 1 - s/slip_gate, 0 beyond it     a wheel that slips says nothing of the vehicle
    L = gate P-/(P- + R),        R = (noise p)^2          gain; the wheel's noise goes with the speed
    v = p + L (w - p),           P = (1 - L) P-

from v = w and P = R. While the wheel still rolls the first samples are averaged (L = 1/2, 1/3, ...); once it is braked
or locked the accelerometer alone is believed, and P grows, so that a wheel that rolls again is believed the sooner. A
wheel faster than the estimate is always believed: a braked wheel is not faster than the car. A bias of the
accelerometer is no state of the filter: in the first milliseconds of braking nothing tells it from the noise.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import clamp
from diffabs.core.protocols import BrakeOutput, Clock, Memory, no_flow
from diffabs.core.pytree import Scalar, param, pytree
from diffabs.sensors.noise import Noise


class EstimatorMemory(NamedTuple):
    """Speed [m/s], its variance [m^2/s^2], and 1 once there was a sample."""

    speed: Scalar
    variance: Scalar
    begun: Scalar


@pytree
class SpeedEstimator:
    """Gated Kalman filter: `noise` of the wheel's speed, relative; `growth` q of the uncertainty, by noise and bias of
    the accelerometer; `gate`, the slip from which on the wheel is not believed."""

    noise: Scalar = param(default=0.005, unit="1", above=0.0)
    growth: Scalar = param(default=0.05, unit="m/s/s^0.5", above=0.0)
    gate: Scalar = param(default=0.03, unit="1", above=0.0, below=1.0)
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)

    flow = no_flow
    grid_rules = Noise.grid_rules

    def start(self, signal: BrakeOutput) -> Memory:
        """At the wheel's speed."""
        w = jnp.maximum(signal.wheel_speed, self.floor)
        return Memory(held=EstimatorMemory(w, (self.noise * w) ** 2, 0.0 * w))

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Estimated speed, and the slip computed with it."""
        del t
        v = memory.held.speed
        return signal._replace(slip=(v - signal.wheel_speed) / v, speed=v)

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """A step of the filter at the instants of the period; the first sample is where it starts."""
        now, _ = clock.ticks(self.period)
        m: EstimatorMemory = memory.held
        first = self.start(signal).held
        predicted = jnp.maximum(m.speed - self.period * signal.deceleration, self.floor)
        variance = m.variance + self.period * self.growth**2
        slip = (predicted - signal.wheel_speed) / predicted
        open_ = clamp(1 - slip / self.gate, 0.0, 1.0)
        gain = open_ * variance / (variance + (self.noise * predicted) ** 2)
        v = jnp.maximum(predicted + gain * (signal.wheel_speed - predicted), self.floor)
        later = EstimatorMemory(v, (1 - gain) * variance, jnp.ones_like(v))
        new = jax.tree.map(lambda a, b: jnp.where(m.begun > 0.5, a, b), later, first._replace(begun=1.0 + 0.0 * v))
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(now, a, b), new, m))
