"""What braked wheels have in common: slip, standstill, and the start of a run."""

from typing import Any

import jax
import jax.numpy as jnp

from diffabs.controllers import PID
from diffabs.core.numerics import larger, quotient
from diffabs.core.pytree import Scalar, param, pytree
from diffabs.objectives import BRAKING
from diffabs.references import FixedSlip
from diffabs.stops import Standstill

PROBED_SPEEDS = 6  # between start and stop, in geometric progression: the ends decide
PROBED_OFFSETS = (0.0, 1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1)  # slip below and above the setpoint
PROBED_SLIPS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # where a run may pass

FROZEN_OUTPUTS = ("speed", "distance")  # outputs that a linear model of the slip holds
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


def halt_at_zero(speed: Scalar, rate: Scalar) -> Any:
    """The rate of a speed that cannot become negative: at standstill only what speeds up acts. Brake friction balances
    the rest, as dry friction does."""
    return jnp.where(jnp.greater(speed, 0), rate, larger(rate, 0.0))


def forward_speed(speed: Scalar) -> Any:
    """The speed, or 0 where a step went past standstill."""
    return jnp.where(jnp.greater(speed, 0), speed, 0.0)


def usual_parts(self: Any) -> dict[str, Any]:
    """Return what surrounds a brake where nothing is said: a PID of 0 to 90 N m that holds a fixed slip until
    standstill."""
    del self
    return {
        "initial": BrakeStart(),
        "reference": FixedSlip(),
        "controller": PID(low=0.0, high=90.0),
        "stop": Standstill(),
    }


def usual_objectives(self: Any) -> dict[str, Any]:
    """Return what every run of a brake is measured by."""
    del self
    return dict(BRAKING)


def probes(self: Any, initial: BrakeStart, setpoint: Scalar, stop: Any) -> BrakeStart:
    """Return where the loop may be stiffest, (k,) starts: at speeds down to the stop, at slips close to the setpoint,
    where the controller is not at a limit, and all over the friction curve, which is steepest near 0."""
    del self
    near = jnp.concatenate([setpoint - jnp.array(PROBED_OFFSETS), setpoint + jnp.array(PROBED_OFFSETS)])
    slips = jnp.concatenate([jnp.clip(near, 1e-4, 1.0), jnp.array(PROBED_SLIPS)])
    speeds = jnp.geomspace(initial.speed, stop.speed, PROBED_SPEEDS)
    speed, slip = jnp.meshgrid(speeds, slips, indexing="ij")
    return jax.tree.map(jnp.ravel, BrakeStart(speed=speed, slip=slip))
