"""A reference that climbs to the slip of greatest deceleration by its slope: extremum seeking.

    target = s (1 + d sin(w t))                                         a dither around the slip s that is believed best
    T m' = slip - m,   T b' = a - b                                     means of the measured slip and deceleration
    T c' = (slip - m)(a - b) - c,   T q' = (slip - m)^2 - q             covariance and variance about them
    e = m c/((q + r^2) max(b, b0))                                      estimate of d ln a/d ln slip
    (ln s)' = k e g,   g = clamp(|ln(s/end)|/ln(1 + band), 0, 1)        end: the greatest slip if e > 0, or the least

M. Krstic and H.-H. Wang, Stability of extremum seeking feedback for general nonlinear dynamic systems, Automatica 36
(2000), multiply by the dither itself. Here the deceleration is correlated with the slip as measured: between them there
is no dynamics (a = mu(slip) g), so the slope is right however much later than the dither the loop moves the slip, and
whatever moves it counts. Slope and step are relative, so that one gain fits ice and asphalt. On a straight line through
any point c = (da/ds) q; noise of the deceleration has no mean in c, a constant bias none in a - b.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp

from diffabs.core.numerics import clamp, larger
from diffabs.core.protocols import BrakeOutput, Memory
from diffabs.core.pytree import Scalar, param, pytree
from diffabs.core.rules import Rule, order_rule


class SeekingMemory(NamedTuple):
    """Logarithm of the slip believed best; means of slip [1] and deceleration [m/s^2], their covariance [m/s^2] and the
    slip's variance [1]."""

    logarithm: Scalar
    slip: Scalar
    deceleration: Scalar
    covariance: Scalar
    variance: Scalar


@pytree
class ExtremumSeeking:
    """target = s (1 + dither sin(frequency t)); s climbs the slope of the deceleration, between two limits."""

    slip: Scalar = param(default=0.12, unit="1", above=0.0, high=1.0)
    gain: Scalar = param(default=3.0, unit="1/s", low=0.0)
    dither: Scalar = param(default=0.1, unit="1", low=0.0, below=1.0)
    frequency: Scalar = param(default=30.0, unit="rad/s", above=0.0)
    time_constant: Scalar = param(default=0.1, unit="s", above=0.0)
    resolution: Scalar = param(default=2e-3, unit="1", above=0.0)
    least_deceleration: Scalar = param(default=0.5, unit="m/s^2", above=0.0)
    least_slip: Scalar = param(default=0.02, unit="1", above=0.0, below=1.0)
    greatest_slip: Scalar = param(default=0.5, unit="1", above=0.0, high=1.0)
    band: Scalar = param(default=0.1, unit="1", above=0.0, tunable=False)

    def start(self, signal: BrakeOutput) -> Memory:
        """The first slip; means at the first sample, no covariance."""
        zero = 0.0 * signal.slip
        return Memory(flow=SeekingMemory(jnp.log(self.slip) + zero, signal.slip, signal.deceleration, zero, zero))

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> SeekingMemory:
        """The rates of all five."""
        del t
        m: SeekingMemory = memory.flow
        slip, deceleration = signal.slip - m.slip, signal.deceleration - m.deceleration
        products = slip * deceleration - m.covariance, slip * slip - m.variance
        means, moments = (tuple(x / self.time_constant for x in pair) for pair in ((slip, deceleration), products))
        return SeekingMemory(self._climb(m), *means, *moments)

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Target slip [1]."""
        del signal
        return self.setpoint(memory) * (1 + self.dither * jnp.sin(self.frequency * t))

    def setpoint(self, memory: Memory) -> Any:
        """The slip believed best."""
        return jnp.exp(memory.flow.logarithm)

    def elasticity(self, memory: Memory) -> Any:
        """The estimate of d ln(deceleration)/d ln(slip) [1]: positive below the peak, negative beyond it."""
        m: SeekingMemory = memory.flow
        return (
            m.slip
            * m.covariance
            / ((m.variance + self.resolution**2) * larger(m.deceleration, self.least_deceleration))
        )

    def rules(self) -> Iterator[Rule]:
        """A first slip within limits that do not exclude each other."""
        yield order_rule(("least_slip", self.least_slip), ("slip", self.slip), "1")
        yield order_rule(("slip", self.slip), ("greatest_slip", self.greatest_slip), "1")

    def _climb(self, m: SeekingMemory) -> Any:
        e = self.elasticity(Memory(flow=m))
        room = jnp.where(e > 0, jnp.log(self.greatest_slip) - m.logarithm, m.logarithm - jnp.log(self.least_slip))
        return self.gain * e * clamp(room / jnp.log1p(self.band), 0.0, 1.0)
