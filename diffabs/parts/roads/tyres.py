"""Tyres: the force of an axle or a wheel on the road, from its slip and its load.

A `RoadTyre` has the force Fz mu(slip) of a friction curve. A `PacejkaTyre` is the Magic Formula of a whole tyre; its
force is not odd in the slip, and its friction depends a little on the load:

    F = -Fz D sin(C arctan(B x - E (B x - arctan B x)) + Fz Vx),   x = Hx - slip,   B = K/(C D)

In combined slip the force of a `RoadTyre` is that of the resultant slip, against the velocity of the contact:

    s = (slip cos A, sin A),   (F, -Fy) = Fz mu(|s|) s/|s|          for a braking wheel with the slip angle A

A `PacejkaTyre` has the weighting functions of the Magic Formula without camber.

A tyre's tread bends before it slides. A `RelaxedTyre` therefore follows slip and slip angle over a rolled distance:

    sigma slip_c' = v (slip - slip_c),   sigma_y A_c' = v (A - A_c),   F = F(slip_c, A_c)

After a step of the slip, 63.2 % of it is reached sigma metres further, at any speed.

Sources: U. Kiencke and L. Nielsen, Automotive Control Systems, 2nd ed., sec. 8.3, for the resultant slip; H. B.
Pacejka, Tire and Vehicle Dynamics, 3rd ed., sec. 4.3, and 7.2 for the relaxation; M. Althoff and G. Wuersching,
CommonRoad: Vehicle Models, 2020, Table 7, for the coefficients. That model has the vertical shift Fz Vx inside the
sine, where Pacejka's formula adds it outside; here it is inside, too.
"""

from collections.abc import Iterator
from typing import ClassVar

import jax.numpy as jnp

from diffabs.core.numerics import larger, quotient
from diffabs.core.protocols import Contact, Road, Tyre, TyreForces
from diffabs.core.pytree import param, part, pytree
from diffabs.core.types import Scalar
from diffabs.parts.roads.burckhardt import DRY_ASPHALT

LEAST_SLIP = 1e-8  # resultant slip below which the friction is linear


@pytree
class RoadTyre:
    """F = Fz mu(slip): a tyre whose friction is that of its road at every load.

    >>> from diffabs.parts.roads import SNOW, RoadTyre
    >>> print(f"{RoadTyre(road=SNOW).braking_force(0.1, load=4000.0, speed=10.0, distance=0.0):.0f}")
    730
    """

    road: Road = part(default=DRY_ASPHALT)
    """Friction curve of the surface below the tyre."""

    proportional: ClassVar[bool] = True

    def braking_force(self, slip: Scalar, load: Scalar, speed: Scalar, distance: Scalar) -> Scalar:
        """Return Fz mu(slip) [N]."""
        return load * self.road.friction(slip, speed, distance)

    def forces(self, slip: Scalar, slip_angle: Scalar, load: Scalar, speed: Scalar, distance: Scalar) -> TyreForces:
        """Return braking and lateral force [N] at the resultant slip."""
        along, across = slip * jnp.cos(slip_angle), jnp.sin(slip_angle)
        resultant = jnp.sqrt(larger(along**2 + across**2, LEAST_SLIP**2))
        force = load * self.road.friction(resultant, speed, distance) / resultant
        return TyreForces(force * along, -force * across)


@pytree
class PacejkaTyre:
    """The Magic Formula with combined slip; the defaults are the tyre of CommonRoad's vehicle models.

    >>> from diffabs.parts.roads import PacejkaTyre
    >>> print(f"{PacejkaTyre().braking_force(0.1413, load=5000.0, speed=10.0, distance=0.0):.0f}")
    5869
    """

    grip: Scalar = param(default=1.0, unit="1", above=0.0, high=10.0)
    """Factor of the greatest friction: 1 on the road on which the tyre was measured."""
    p_cx1: Scalar = param(default=1.6411, unit="1", above=0.0)
    """Shape factor C."""
    p_dx1: Scalar = param(default=1.1739, unit="1", above=0.0)
    """Greatest friction D, at a grip of 1."""
    p_ex1: Scalar = param(default=0.46403, unit="1", high=1.0)
    """Curvature factor E."""
    p_kx1: Scalar = param(default=22.303, unit="1", above=0.0)
    """Slip stiffness per load K: the slope at the origin, whatever the grip."""
    p_hx1: Scalar = param(default=0.0012297, unit="1")
    """Horizontal shift Hx."""
    p_vx1: Scalar = param(default=-8.8098e-06, unit="1/N")
    """Vertical shift per load Vx."""

    p_cy1: Scalar = param(default=1.3507, unit="1", above=0.0)
    """Lateral shape factor."""
    p_dy1: Scalar = param(default=1.0489, unit="1", above=0.0)
    """Greatest lateral friction, at a grip of 1."""
    p_ey1: Scalar = param(default=-0.0074722, unit="1", high=1.0)
    """Lateral curvature factor."""
    p_ky1: Scalar = param(default=-21.92, unit="1", below=0.0)
    """Cornering stiffness per load."""
    r_bx1: Scalar = param(default=13.276, unit="1")
    """Longitudinal weighting: stiffness factor."""
    r_bx2: Scalar = param(default=-13.778, unit="1")
    """Longitudinal weighting: change of the stiffness factor with the slip."""
    r_cx1: Scalar = param(default=1.2568, unit="1")
    """Longitudinal weighting: shape factor."""
    r_ex1: Scalar = param(default=0.65225, unit="1")
    """Longitudinal weighting: curvature factor."""
    r_hx1: Scalar = param(default=0.0050722, unit="rad")
    """Longitudinal weighting: shift of the slip angle."""
    r_by1: Scalar = param(default=7.1433, unit="1")
    """Lateral weighting: stiffness factor."""
    r_by2: Scalar = param(default=9.1916, unit="1")
    """Lateral weighting: change of the stiffness factor with the slip angle."""
    r_by3: Scalar = param(default=-0.027856, unit="rad")
    """Lateral weighting: slip angle of the greatest stiffness factor."""
    r_cy1: Scalar = param(default=1.0719, unit="1")
    """Lateral weighting: shape factor."""
    r_ey1: Scalar = param(default=-0.27572, unit="1")
    """Lateral weighting: curvature factor."""
    r_hy1: Scalar = param(default=5.7448e-06, unit="1")
    """Lateral weighting: shift of the slip."""
    r_vy1: Scalar = param(default=-0.027825, unit="1")
    """Lateral force by longitudinal slip: its size per load and lateral friction."""
    r_vy4: Scalar = param(default=12.12, unit="1")
    """Lateral force by longitudinal slip: its fall with the slip angle."""
    r_vy5: Scalar = param(default=1.9, unit="1")
    """Lateral force by longitudinal slip: shape factor."""
    r_vy6: Scalar = param(default=-10.704, unit="1")
    """Lateral force by longitudinal slip: stiffness factor."""

    proportional: ClassVar[bool] = False

    def braking_force(self, slip: Scalar, load: Scalar, speed: Scalar = 0.0, distance: Scalar = 0.0) -> Scalar:
        """Return the force [N]; `speed` and `distance` have no effect."""
        del speed, distance
        greatest = self.grip * self.p_dx1
        x = self.p_kx1 / (self.p_cx1 * greatest) * (self.p_hx1 - slip)
        return -load * greatest * jnp.sin(self.p_cx1 * _bend(x, self.p_ex1) + load * self.p_vx1)

    def forces(
        self, slip: Scalar, slip_angle: Scalar, load: Scalar, speed: Scalar = 0.0, distance: Scalar = 0.0
    ) -> TyreForces:
        """Return braking and lateral force [N] of combined slip."""
        greatest = self.grip * self.p_dy1
        stiffness = self.p_ky1 / (self.p_cy1 * greatest)
        lateral = load * greatest * jnp.sin(self.p_cy1 * _bend(stiffness * slip_angle, self.p_ey1))

        along = self.r_bx1 * jnp.cos(jnp.arctan(self.r_bx2 * slip))
        across = self.r_by1 * jnp.cos(jnp.arctan(self.r_by2 * (slip_angle - self.r_by3)))
        height = load * greatest * self.r_vy1 * jnp.cos(jnp.arctan(self.r_vy4 * slip_angle))
        by_slip = height * jnp.sin(self.r_vy5 * jnp.arctan(self.r_vy6 * slip))
        return TyreForces(
            self.braking_force(slip, load, speed, distance)
            * _weight(along, slip_angle, self.r_hx1, self.r_cx1, self.r_ex1),
            lateral * _weight(across, slip, self.r_hy1, self.r_cy1, self.r_ey1) + by_slip,
        )


@pytree
class RelaxedTyre:
    """A tyre whose force follows slip and slip angle over a distance: the relaxation length.

    The defaults are of the size of a passenger car's tyre, of no particular one. The slip that a plant shows is that of
    the wheel; the force belongs to the slip of the contact, a state of the plant.

    >>> from diffabs.parts.plants import BrakeStart, HalfCar
    >>> from diffabs.parts.roads import RelaxedTyre
    >>> car = HalfCar(front_tyre=RelaxedTyre(length=0.3), rear_tyre=RelaxedTyre(length=0.3))
    >>> state = car.start(BrakeStart(speed=20.0))
    >>> locked = state._replace(front_spin=0.0)
    >>> print(car.output(locked).front_slip, car.output(locked).deceleration)
    1.0 0.0
    """

    tyre: Tyre = part(default=RoadTyre)
    """Tyre that has the force at a constant slip."""
    length: Scalar = param(default=0.3, unit="m", above=0.0)
    """Relaxation length sigma of the slip."""
    lateral_length: Scalar = param(default=0.5, unit="m", above=0.0)
    """Relaxation length of the slip angle."""

    def problems(self) -> Iterator[str]:
        """Yield a line for a relaxed tyre inside this one: a contact has one relaxation length."""
        if hasattr(self.tyre, "relax"):
            yield "tyre has a relaxation length of its own; a tyre without one is needed, such as RoadTyre"

    @property
    def proportional(self) -> bool:
        """Whether the friction of the enclosed tyre does not depend on the load."""
        return self.tyre.proportional

    def braking_force(self, slip: Scalar, load: Scalar, speed: Scalar, distance: Scalar) -> Scalar:
        """Return the force [N] at the slip of the contact."""
        return self.tyre.braking_force(slip, load, speed, distance)

    def forces(self, slip: Scalar, slip_angle: Scalar, load: Scalar, speed: Scalar, distance: Scalar) -> TyreForces:
        """Return both forces [N] at slip and slip angle of the contact."""
        return self.tyre.forces(slip, slip_angle, load, speed, distance)

    def relax(self, contact: Contact, slip: Scalar, slip_angle: Scalar, speed: Scalar) -> Contact:
        """Return d(contact)/dt of a wheel with slip [1] and slip angle [rad] at a vehicle speed [m/s]."""
        return Contact(
            speed * quotient(slip - contact.slip, self.length),
            speed * quotient(slip_angle - contact.slip_angle, self.lateral_length),
        )


def _bend(x: Scalar, curvature: Scalar) -> Scalar:
    """Return arctan(x - E (x - arctan x)), the argument of the Magic Formula's sine or cosine per shape factor."""
    return jnp.arctan(x - curvature * (x - jnp.arctan(x)))


def _weight(stiffness: Scalar, slip: Scalar, shift: Scalar, shape: Scalar, curvature: Scalar) -> Scalar:
    """Return the weighting function of combined slip, which is 1 at slip 0."""
    weight, at_zero = (jnp.cos(shape * _bend(stiffness * x, curvature)) for x in (slip + shift, shift))
    return weight / at_zero
