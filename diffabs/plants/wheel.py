"""What braked wheels have in common: slip, standstill, and the start of a run."""

from typing import Any

import jax.numpy as jnp

from diffabs.core.numerics import larger, quotient
from diffabs.core.pytree import Scalar, param, pytree

GRAVITY = 9.81  # m/s^2, the value behind every number of the papers


@pytree
class BrakeStart:
    """A vehicle at `speed` whose wheel has `slip`, at distance 0."""

    speed: Scalar = param(default=100 / 3.6, unit="m/s", above=0.0, high=200.0)
    slip: Scalar = param(default=0.0, unit="1", low=0.0, high=1.0)


def slip_ratio(speed: Scalar, wheel_speed: Scalar, crawl: Scalar) -> Any:
    """(v - w)/max(v, w, crawl): (v - w)/v in braking, (v - w)/w in driving, so that it lies in [-1, 1].

    C1 at v = w. Below the crawl speed [m/s] the slip goes to zero with v - w instead of dividing by zero.
    """
    return quotient(speed - wheel_speed, larger(larger(speed, wheel_speed), crawl))


def halted(speed: Scalar, rate: Scalar) -> Any:
    """The rate of a speed that cannot become negative: at standstill only what speeds up acts. Brake friction balances
    the rest, as dry friction does."""
    return jnp.where(jnp.greater(speed, 0), rate, larger(rate, 0.0))


def forward(speed: Scalar) -> Any:
    """The speed, or 0 where a step went past standstill."""
    return jnp.where(jnp.greater(speed, 0), speed, 0.0)
