"""The slip error under a feedback proportional to the speed, in coordinates in which the loop hardly varies.

A torque proportional to v moves the slip equally fast at every speed v. With every torque of a sampled model in units
of v/v0,

    x = S z,  u = (v/v0) w,  S = diag(1, 1, ..., v/v0, ...),      x+ = A(v) x + B(v) u
    z+ = S(v+)^-1 (A S z + B (v/v0) w) = D [S^-1 A S z + S^-1 B (v/v0) w],  D = diag(1, 1, ..., v/v+, ...)

so w = K z is `ProportionalFeedback`.

The ratio v/v+ = 1 + fall gives the fall of the speed in a period. With a range of `fall` in the polytope, a certificate
holds for every course of the speed whose fall per period is in that range.
"""

from functools import partial

import jax
import jax.numpy as jnp

from diffabs.core.pytree import canonical_dtypes, param, part, pytree
from diffabs.core.types import Scalar
from diffabs.linear.linearization import StateSpace
from diffabs.linear.slip_model import Sampling, SlipModel

TORQUES = ("actuator torque", "torque of the last sample")


@pytree
class SpeedScaled:
    """A sampled `SlipModel` with its torques in units of speed/reference_speed; `fall` is v/v+ - 1 over a period."""

    model: SlipModel = part(default=SlipModel)
    reference_speed: Scalar = param(default=50 / 3.6, unit="m/s", above=0.0)
    """Speed v0 at which gains and rates have their stated values."""
    fall: Scalar = param(default=0.0, unit="1", above=-1.0)
    """Greatest relative fall of the speed over a period, v/v+ - 1."""

    @property
    def period(self) -> float | None:
        """Sampling period [s]."""
        return self.model.period

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states."""
        return self.model.states

    def matrices(self) -> StateSpace:
        """Return A (n, n) and B (n, 1), differentiable in every parameter.

        Raises:
            ValueError: A model in continuous time, where the fall of the speed would be a rate.
        """
        if not isinstance(self.model.sampling, Sampling):
            raise ValueError("a speed-scaled model is a sampled one: model.sampling is continuous")
        return _matrices(self, tuple(name in TORQUES for name in self.states))


def greatest_speed_fall(deceleration: float, speed: float, period: float) -> float:
    """Return v/v+ - 1 [1] at a constant deceleration [m/s^2] over a period [s], for the lowest speed v [m/s]."""
    if not deceleration * period < speed:
        needed = f"a speed above {deceleration * period:g} m/s is needed"
        raise ValueError(f"speed = {speed:g} m/s ends in a period of {period:g} s at {deceleration:g} m/s^2: {needed}")
    return deceleration * period / (speed - deceleration * period)


@partial(jax.jit, static_argnames="torques")
def _matrices(scaled: SpeedScaled, torques: tuple[bool, ...]) -> StateSpace:
    scaled = canonical_dtypes(scaled)
    a, b = scaled.model.matrices()
    torque = jnp.array(torques)
    size = scaled.model.speed / scaled.reference_speed
    s = jnp.where(torque, size, 1.0)
    # gain = D S^-1 as a vector: only the torques are scaled.
    gain = jnp.where(torque, 1 + scaled.fall, 1.0) / s
    return StateSpace(gain[:, None] * a * s, gain[:, None] * b * size)
