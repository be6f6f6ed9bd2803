"""Estimator of the vehicle speed from a noisy wheel speed and a noisy, biased accelerometer: a scalar Kalman filter
with a gate.

Every period h, from the measured deceleration a and wheel speed w:

    p = v - h a,                 P- = P + h q^2           prediction, and its variance
    s = (p - w)/p                                         the slip of this prediction
    open = 1 for s <= 0, 1 - s/gate, 0 beyond it          a wheel that slips does not measure the vehicle speed
    L = open P-/(P- + R),        R = (noise p)^2          gain; the wheel's noise is proportional to the speed
    v = p + L (w - p),           P = (1 - L) P-
    f = max(a, f exp(-h/hold))                            recent deceleration: rises at once, decays slowly

With several wheels, each one has its s, open and L, and corrects v and P in turn; the filter starts, and starts again,
from the fastest one.

The filter starts from v = w, P = R and f = g. It restarts where s >= gate and f < rest. While the wheel still rolls, it
averages the first samples (L = 1/2, 1/3, ...). Once the wheel is braked or locked, the filter uses the accelerometer
alone and P grows. The larger P is, the sooner the filter trusts a rolling wheel again. The filter always trusts a wheel
that is faster than the estimate, because a braked wheel is not faster than the car. The accelerometer's bias is no
state of the filter: in the first milliseconds of braking it cannot be distinguished from noise.

**False slip of a rolling wheel.** If the measured deceleration has a bias b < 0, v_seen - v grows by |b| t. A
controller that holds the estimated slip at s* sets the wheel speed to w = (1 - s*) v_seen. Once v_seen is v/(1 - s*),
this is w = v. The wheel rolls, its estimated slip is s*, and the controller releases the brake. Then nothing slows the
car, the estimated slip does not end, and the gate never opens. Real slip causes a force, which tells the two cases
apart. A wheel slower than the car, locked or not, decelerates it by mu(s) g (twice this on the mirrored rig). The
accelerometer shows exactly this, also on a slope:

    f >= a >= min of mu(s') g over s' >= s      so, with m(s) for that minimum,      f < m(s_0)  proves  s < s_0.

m rises from m(0) = 0 to its value for a locked wheel, or for the least friction beyond the peak. `rest` must lie above
bias and noise and below this value. Then f < rest proves that the wheel's slip is at most m^-1(rest), for any estimated
s, and the filter restarts from the wheel speed. A wheel that is locked on the road has f >= rest and is never trusted.
On the rig m is at least 6.8 m/s^2 from a slip of 0.1 on, and m^-1(1 m/s^2) is a slip of 0.8 %.

The assumption is a road that gives `rest`: with mu < rest/g the filter would trust a locked wheel. Because f rises at
once, there is no restart between two actuations of the brake. It decays from g to rest in hold ln(g/rest), 46 ms. For
as long there is no restart after the start either, when the brake is about to act.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import clamp, larger
from diffabs.core.protocols import Clock, Memory, no_flow
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import period_on_grid
from diffabs.core.types import PyTree, Scalar
from diffabs.parts.sensors.reference_speed import fastest_rim, rim_speeds, show_speed

BRAKED = 9.81  # m/s^2, recent deceleration f that the filter assumes at its start


class EstimatorMemory(NamedTuple):
    """Memory of the speed estimator.

    Attributes:
        speed: Estimate v [m/s].
        variance: Its variance P [m^2/s^2].
        braked: Recent deceleration f [m/s^2].
        begun: 1 once the filter has taken its first sample, else 0.
    """

    speed: Scalar
    variance: Scalar
    braked: Scalar
    begun: Scalar


@pytree
class SpeedEstimator:
    """A gated Kalman filter of the vehicle speed from accelerometer and wheels that may slip, one or several."""

    noise: Scalar = param(default=0.005, unit="1", above=0.0)
    """Relative noise of the wheel speed."""
    growth: Scalar = param(default=0.05, unit="m/s/s^0.5", above=0.0)
    """Growth q of the uncertainty, from noise and bias of the accelerometer."""
    gate: Scalar = param(default=0.03, unit="1", above=0.0, below=1.0)
    """Slip from which on the wheel is not trusted, unless the recent deceleration is below `rest`."""
    rest: Scalar = param(default=1.0, unit="m/s^2", above=0.0)
    """Recent deceleration below which the filter restarts from the wheel speed."""
    hold: Scalar = param(default=0.02, unit="s", above=0.0)
    """Time constant with which the recent deceleration decays."""
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    """Period of the samples h."""
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)
    """Least speed that is estimated."""

    flow = no_flow
    grid_rules = period_on_grid

    def start(self, signal: PyTree) -> Memory:
        """Return the memory with v = w, at least `floor`, P = (noise v)^2 and f = 9.81 m/s^2."""
        w = jnp.maximum(fastest_rim(signal), self.floor)
        return Memory(held=EstimatorMemory(w, (self.noise * w) ** 2, BRAKED + 0.0 * w, 0.0 * w))

    def output(self, t: Scalar, memory: Memory, signal: PyTree) -> PyTree:
        """Return the signal with the estimated speed v, and the slips (v - w)/v computed with it."""
        del t
        return show_speed(signal, memory.held.speed)

    def tick(self, clock: Clock, memory: Memory, signal: PyTree) -> Memory:
        """Return the memory after one filter step if a period begins, else the old memory.

        At the first sample, and where the least slip >= gate with f < rest, the filter starts again.
        """
        now, _ = clock.ticks(self.period)
        m: EstimatorMemory = memory.held
        first = self.start(signal).held
        predicted = jnp.maximum(m.speed - self.period * signal.deceleration, self.floor)
        variance = m.variance + self.period * self.growth**2
        braked = larger(signal.deceleration, m.braked * jnp.exp(-self.period / self.hold))
        v = predicted
        for w in rim_speeds(signal):
            slip = (predicted - w) / predicted
            open_ = clamp(1 - slip / self.gate, 0.0, 1.0)
            gain = open_ * variance / (variance + (self.noise * predicted) ** 2)
            v, variance = v + gain * (w - v), (1 - gain) * variance
        later = EstimatorMemory(jnp.maximum(v, self.floor), variance, braked, jnp.ones_like(v))
        slip = (predicted - fastest_rim(signal)) / predicted
        goes_on = (m.begun > 0.5) & ((slip < self.gate) | (braked >= self.rest))
        new = jax.tree.map(lambda a, b: jnp.where(goes_on, a, b), later, first._replace(begun=1.0 + 0.0 * v))
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(now, a, b), new, m))
