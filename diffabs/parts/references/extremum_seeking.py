"""Extremum seeking: a reference that climbs along the slope of the deceleration to the slip of greatest deceleration.

    target = s (1 + d sin(w t))                                         a dither around the estimate s of the best slip
    T m' = slip - m,   T b' = a - b                                     means of the measured slip and deceleration
    T c' = (slip - m)(a - b) - c,   T q' = (slip - m)^2 - q             covariance and variance about them
    e = m c/((q + r^2) max(b, b0))                                      estimate of d ln a/d ln slip
    (ln s)' = k e g,   g = clamp(|ln(s/end)|/ln(1 + band), 0, 1)        end: the greatest slip if e > 0, or the least

Krstic and Wang multiply by the dither itself. Here the deceleration is correlated with the measured slip. There are no
dynamics between them, a = mu(slip) g. The slope is therefore correct for any phase lag of the loop behind the dither.
Any movement of the slip contributes to the estimate. Slope and step are relative, so one gain fits ice and asphalt. If
the deceleration is a linear function of the slip, c = (da/ds) q. Noise of the deceleration adds nothing to c on
average, and a constant bias cancels in a - b.

Source: M. Krstic and H.-H. Wang, Stability of extremum seeking feedback for general nonlinear dynamic systems,
Automatica 36 (2000).
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp

from diffabs.core.numerics import clamp, larger
from diffabs.core.protocols import BrakeOutput, Memory
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import Rule, order_rule
from diffabs.core.types import Scalar


class SeekingMemory(NamedTuple):
    """Continuous memory of the extremum seeking; all means are exponential means over the time constant.

    Attributes:
        logarithm: ln s, with the estimate s of the best slip.
        slip: Mean of the slip, m [1].
        deceleration: Mean of the deceleration, b [m/s^2].
        covariance: Covariance of slip and deceleration, c [m/s^2].
        variance: Variance of the slip, q [1].
    """

    logarithm: Scalar
    slip: Scalar
    deceleration: Scalar
    covariance: Scalar
    variance: Scalar


@pytree
class ExtremumSeeking:
    """target = s (1 + dither sin(frequency t)), where s climbs the slope of the deceleration between two limits."""

    slip: Scalar = param(default=0.12, unit="1", above=0.0, high=1.0)
    """Target s at the start."""
    gain: Scalar = param(default=3.0, unit="1/s", low=0.0)
    """Rate k of ln s for an elasticity of 1."""
    dither: Scalar = param(default=0.1, unit="1", low=0.0, below=1.0)
    """Relative amplitude d of the dither."""
    frequency: Scalar = param(default=30.0, unit="rad/s", above=0.0)
    """Frequency w of the dither."""
    time_constant: Scalar = param(default=0.1, unit="s", above=0.0)
    """Time constant T of the means."""
    resolution: Scalar = param(default=2e-3, unit="1", above=0.0)
    """Slip deviation r below which the estimated slope fades to 0."""
    deceleration_floor: Scalar = param(default=0.5, unit="m/s^2", above=0.0)
    """Least deceleration b0 in the denominator of the elasticity."""
    slip_low: Scalar = param(default=0.02, unit="1", above=0.0, below=1.0)
    """Lower limit of the target."""
    slip_high: Scalar = param(default=0.5, unit="1", above=0.0, high=1.0)
    """Upper limit of the target."""
    band: Scalar = param(default=0.1, unit="1", above=0.0, tunable=False)
    """Relative distance from a limit within which the gain fades to 0."""

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with s = slip, means at the measured signals, and covariance and variance 0."""
        zero = 0.0 * signal.slip
        return Memory(flow=SeekingMemory(jnp.log(self.slip) + zero, signal.slip, signal.deceleration, zero, zero))

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> SeekingMemory:
        """Return the time derivatives of the five numbers in the memory, per second."""
        del t
        m: SeekingMemory = memory.flow
        slip, deceleration = signal.slip - m.slip, signal.deceleration - m.deceleration
        products = slip * deceleration - m.covariance, slip * slip - m.variance
        means, moments = (tuple(x / self.time_constant for x in pair) for pair in ((slip, deceleration), products))
        e = self.elasticity(memory)
        # The gain fades to 0 at a limit, so s never leaves the limits and no clamp kinks the rate there.
        room = jnp.where(e > 0, jnp.log(self.slip_high) - m.logarithm, m.logarithm - jnp.log(self.slip_low))
        climb = self.gain * e * clamp(room / jnp.log1p(self.band), 0.0, 1.0)
        return SeekingMemory(climb, *means, *moments)

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Return the target slip with the dither [1]."""
        del signal
        return self.setpoint(memory) * (1 + self.dither * jnp.sin(self.frequency * t))

    def setpoint(self, memory: Memory) -> Scalar:
        """Return s, the present estimate of the best slip without the dither [1]."""
        return jnp.exp(memory.flow.logarithm)

    def elasticity(self, memory: Memory) -> Scalar:
        """Return the estimate e of d ln(deceleration)/d ln(slip) from `memory` [1].

        It is positive below the peak and negative beyond it.
        """
        m: SeekingMemory = memory.flow
        return (
            m.slip
            * m.covariance
            / ((m.variance + self.resolution**2) * larger(m.deceleration, self.deceleration_floor))
        )

    def rules(self) -> Iterator[Rule]:
        """Yield the rules slip_low <= slip <= slip_high."""
        yield order_rule(("slip_low", self.slip_low), ("slip", self.slip), "1")
        yield order_rule(("slip", self.slip), ("slip_high", self.slip_high), "1")
