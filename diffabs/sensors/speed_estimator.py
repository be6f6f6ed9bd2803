"""The vehicle's speed from what a car has: the wheel's speed, noisy, and an accelerometer, noisy and biased.

A scalar Kalman filter with a gate. Every period h, from the deceleration a and the wheel's speed w as measured,

    p = v - h a,                 P- = P + h q^2           prediction, and its variance
    s = (p - w)/p                                         the slip that it means
    open = 1 for s <= 0, 1 - s/gate, 0 beyond it          a wheel that slips says nothing of the vehicle
    L = open P-/(P- + R),        R = (noise p)^2          gain; the wheel's noise goes with the speed
    v = p + L (w - p),           P = (1 - L) P-
    f = max(a, f exp(-h/hold))                            the deceleration of late: at once up, slowly down

from v = w, P = R and f = g; and from there again where s >= gate and f < rest. While the wheel still rolls the first
samples are averaged (L = 1/2, 1/3, ...); once it is braked or locked the accelerometer alone is believed, and P grows,
so that a wheel that rolls again is believed the sooner. A wheel faster than the estimate is always believed: a braked
wheel is not faster than the car. A bias of the accelerometer is no state of the filter: in the first milliseconds of
braking nothing tells it from the noise.

**A wheel that seems to slip and does not push.** With an accelerometer whose bias b is negative, v_seen - v grows by
|b| t. A controller that holds the slip it sees at s* turns the wheel at w = (1 - s*) v_seen; where v_seen comes to
v/(1 - s*) that is w = v: the wheel rolls, seems to slip by s*, and the brake is let go. Now nothing slows the car, the
slip that is seen does not end, and the gate never opens. But a slip has a force. A wheel that is slower than the car,
locked or not, decelerates it by mu(s) g (twice that on the mirrored rig), and an accelerometer shows just that, on a
slope as well:

    f >= a >= min of mu(s') g over s' >= s      so, with m(s) for that minimum,      f < m(s_0)  proves  s < s_0.

m rises from m(0) = 0 to that of a wheel that locks, or of the least friction beyond the peak. With `rest` above bias
and noise and below that, f < rest says that the wheel rolls but for a slip of m^-1(rest), whatever s says, and the
filter begins anew with its speed; a wheel that locks on the road has f >= rest and stays unbelieved, however long. On
the rig m is at least 6.8 m/s^2 from a slip of 0.1 on, and m^-1(1 m/s^2) is a slip of 0.8 %. What is assumed is a road
that gives `rest`: on one with mu < rest/g a locked wheel would be believed. f rises at once, so nothing begins anew
between two bites of the brake, and falls from g to rest in hold ln(g/rest), 46 ms: for so long the start is left alone
as well, when a brake is about to bite.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import clamp, larger
from diffabs.core.protocols import BrakeOutput, Clock, Memory, no_flow
from diffabs.core.pytree import Scalar, param, pytree
from diffabs.sensors.noise import Noise

BRAKED = 9.81  # m/s^2, the deceleration before the first sample, as if there had been one


class EstimatorMemory(NamedTuple):
    """Speed [m/s], its variance [m^2/s^2], deceleration of late [m/s^2], and 1 once there was a sample."""

    speed: Scalar
    variance: Scalar
    braked: Scalar
    begun: Scalar


@pytree
class SpeedEstimator:
    """Gated Kalman filter: `noise` of the wheel's speed, relative; `growth` q of the uncertainty, by noise and bias of
    the accelerometer; `gate`, the slip from which on the wheel is not believed, unless the deceleration, forgotten with
    the time constant `hold`, has fallen below `rest`."""

    noise: Scalar = param(default=0.005, unit="1", above=0.0)
    growth: Scalar = param(default=0.05, unit="m/s/s^0.5", above=0.0)
    gate: Scalar = param(default=0.03, unit="1", above=0.0, below=1.0)
    rest: Scalar = param(default=1.0, unit="m/s^2", above=0.0)
    hold: Scalar = param(default=0.02, unit="s", above=0.0)
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)

    flow = no_flow
    grid_rules = Noise.grid_rules

    def start(self, signal: BrakeOutput) -> Memory:
        """At the wheel's speed."""
        w = jnp.maximum(signal.wheel_speed, self.floor)
        return Memory(held=EstimatorMemory(w, (self.noise * w) ** 2, BRAKED + 0.0 * w, 0.0 * w))

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Estimated speed, and the slip computed with it."""
        del t
        v = memory.held.speed
        return signal._replace(slip=(v - signal.wheel_speed) / v, speed=v)

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """A step of the filter at the instants of the period, or its first one."""
        now, _ = clock.ticks(self.period)
        m: EstimatorMemory = memory.held
        first = self.start(signal).held
        predicted = jnp.maximum(m.speed - self.period * signal.deceleration, self.floor)
        variance = m.variance + self.period * self.growth**2
        slip = (predicted - signal.wheel_speed) / predicted
        braked = larger(signal.deceleration, m.braked * jnp.exp(-self.period / self.hold))
        open_ = clamp(1 - slip / self.gate, 0.0, 1.0)
        gain = open_ * variance / (variance + (self.noise * predicted) ** 2)
        v = jnp.maximum(predicted + gain * (signal.wheel_speed - predicted), self.floor)
        later = EstimatorMemory(v, (1 - gain) * variance, braked, jnp.ones_like(v))
        goes_on = (m.begun > 0.5) & ((slip < self.gate) | (braked >= self.rest))
        new = jax.tree.map(lambda a, b: jnp.where(goes_on, a, b), later, first._replace(begun=1.0 + 0.0 * v))
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(now, a, b), new, m))
