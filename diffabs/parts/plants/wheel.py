"""Common functions of braked wheels: slip, standstill, the start of a run, and the default loop."""

from functools import reduce

import jax
import jax.numpy as jnp

from diffabs.core.numerics import larger, quotient, smaller
from diffabs.core.protocols import BrakeOutput, Contact, Road, Tyre
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Part, PyTree, Scalar
from diffabs.parts.controllers import PID
from diffabs.parts.objectives import BRAKING
from diffabs.parts.references import FixedSlip
from diffabs.parts.stops import Standstill

PROBED_SPEEDS = 6  # from start to end, in geometric progression; the stiffest speed is at one of the ends
PROBED_OFFSETS = (0.0, 1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1)  # distances in slip below and above the setpoint
PROBED_SLIPS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # slips that a run may pass

FROZEN_OUTPUTS = ("speed", "distance")  # outputs that a linear model of the slip keeps constant
GRAVITY = 9.81  # m/s^2, the value in all numbers of the papers
# A step that ends on standstill leaves a speed of its own rounding. Some plants treat a wheel that turns differently.
STANDSTILL_SPEED = 1e-9  # m/s or rad/s

LEAST_CONTACT = 0.01  # 1 or rad: slips and slip angles of contacts below it have absolute errors


@pytree
class BrakeStart:
    """A vehicle at `speed` [m/s] whose wheel has `slip` [1], at distance 0."""

    speed: Scalar = param(default=100 / 3.6, unit="m/s", above=0.0, high=200.0)
    """Speed of the vehicle at t = 0."""
    slip: Scalar = param(default=0.0, unit="1", low=0.0, high=1.0)
    """Slip at t = 0."""


def slip_ratio(speed: Scalar, wheel_speed: Scalar, crawl: Scalar) -> Scalar:
    """Return the slip (v - w)/max(v, w, crawl) [1], in [-1, 1]: positive in braking, negative in driving, 0 at rest.

    The slip is C1 at v = w. Below the crawl speed it goes to zero with v - w, so there is no division by zero.
    """
    return quotient(speed - wheel_speed, larger(larger(speed, wheel_speed), crawl))


def halt_at_zero(speed: Scalar, rate: Scalar) -> Scalar:
    """Return the rate of a speed that cannot become negative: at standstill a negative rate becomes 0.

    Brake friction balances a negative rate at standstill, as dry friction does.
    """
    return jnp.where(jnp.greater(speed, 0), rate, larger(rate, 0.0))


def forward_speed(speed: Scalar) -> Scalar:
    """Return the speed, or 0 where a step ended at standstill or beyond it."""
    return jnp.where(jnp.greater(speed, STANDSTILL_SPEED), speed, 0.0)


def settled_contact(tyre: Tyre, slip: Scalar) -> PyTree:
    """Return the contact of a tyre that follows a constant slip [1]; () for one whose force follows at once."""
    return Contact(slip, 0.0 * slip) if hasattr(tyre, "relax") else ()


def least_contact(tyre: Tyre) -> PyTree:
    """Return slip and slip angle of a contact below which errors are absolute, as both begin at 0; () without one."""
    return Contact(LEAST_CONTACT, LEAST_CONTACT) if hasattr(tyre, "relax") else ()


def contact_rate(tyre: Part, contact: PyTree, motion: Contact, speed: Scalar) -> PyTree:
    """Return d(contact)/dt at slip and slip angle of the wheel and the vehicle's speed [m/s]; () without a contact."""
    return tyre.relax(contact, *motion, speed) if contact else ()


class SlipProbes:
    """Base of plants whose stiffest state is a wheel; `crawl_speed` [m/s] is the least denominator of the slip."""

    crawl_speed: Scalar

    def probes(self, initial: BrakeStart, setpoint: PyTree, stop: Part) -> BrakeStart:
        """Return k starts at which the loop may be stiffest, as a `BrakeStart` of arrays (k,).

        They combine 6 speeds from the start's to the stop's with 23 slips. Some slips are close to the setpoint, where
        the controller is not at a limit; of several setpoints these are the least and the greatest. Other slips cover
        the friction curve, which is steepest near 0.

        Under a stop without a speed, such as `NoStop`, a run may last to standstill. The least speed is then the
        plant's crawl speed. The slip's denominator, and with it the stiffness, is the same at all lower speeds.
        """
        setpoints = jax.tree.leaves(setpoint)
        if len(setpoints) > 1:
            setpoints = [reduce(smaller, setpoints), reduce(larger, setpoints)]
        offsets = jnp.array(PROBED_OFFSETS)
        near = jnp.concatenate([end + sign * offsets for end in setpoints for sign in (-1.0, 1.0)])
        slips = jnp.concatenate([jnp.clip(near, 1e-4, 1.0), jnp.array(PROBED_SLIPS)])
        slowest = stop.speed if hasattr(stop, "speed") else self.crawl_speed
        speeds = jnp.geomspace(initial.speed, slowest, PROBED_SPEEDS)
        speed, slip = jnp.meshgrid(speeds, slips, indexing="ij")
        return jax.tree.map(jnp.ravel, BrakeStart(speed=speed, slip=slip))


class BrakedWheel(SlipProbes):
    """Base of plants with a braked wheel on a `road`."""

    road: Road

    shows = BrakeOutput
    control_unit = "N m"
    frozen = FROZEN_OUTPUTS

    def slip_and_friction(self, speed: Scalar, wheel_speed: Scalar, distance: Scalar) -> tuple[Scalar, Scalar]:
        """Return the slip (v - w)/v [1] of a wheel, and the friction mu(slip) [1] of the road below it.

        Args:
            speed: Speed v of the vehicle [m/s].
            wheel_speed: Speed w of the wheel's rim [m/s].
            distance: Place on the road [m].
        """
        slip = slip_ratio(speed, wheel_speed, self.crawl_speed)
        return slip, self.road.friction(slip, speed, distance)

    def usual_parts(self) -> dict[str, PyTree]:
        """Return the default parts of a loop around a brake: a PID that holds a fixed slip until standstill.

        The keys are `initial`, `reference`, `controller` and `stop`. The PID has limits of 0 and 90 in the plant's
        control unit.
        """
        return {
            "initial": BrakeStart(),
            "reference": FixedSlip(),
            "controller": PID(low=0.0, high=90.0),
            "stop": Standstill(),
        }

    def usual_objectives(self) -> dict[str, PyTree]:
        return dict(BRAKING)
