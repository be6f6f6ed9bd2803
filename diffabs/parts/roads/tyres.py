"""Tyres: the force of an axle or a wheel on the road, from its slip and its load.

A `RoadTyre` has the force Fz mu(slip) of a friction curve. A `PacejkaTyre` is the Magic Formula of a whole tyre; its
force is not odd in the slip, and its friction depends a little on the load:

    F = -Fz D sin(C arctan(B x - E (B x - arctan B x)) + Fz Vx),   x = Hx - slip,   B = K/(C D)

Sources: H. B. Pacejka, Tire and Vehicle Dynamics, 3rd ed., sec. 4.3; M. Althoff and G. Wuersching, CommonRoad: Vehicle
Models, 2020, Table 7, for the coefficients. That model has the vertical shift Fz Vx inside the sine, where Pacejka's
formula adds it outside; here it is inside, too.
"""

from typing import ClassVar

import jax.numpy as jnp

from diffabs.core.protocols import Road
from diffabs.core.pytree import param, part, pytree
from diffabs.core.types import Scalar
from diffabs.parts.roads.burckhardt import DRY_ASPHALT


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


@pytree
class PacejkaTyre:
    """The Magic Formula for pure longitudinal slip; the defaults are the tyre of CommonRoad's vehicle models.

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

    proportional: ClassVar[bool] = False

    def braking_force(self, slip: Scalar, load: Scalar, speed: Scalar = 0.0, distance: Scalar = 0.0) -> Scalar:
        """Return the force [N]; `speed` and `distance` have no effect."""
        del speed, distance
        greatest = self.grip * self.p_dx1
        x = self.p_kx1 / (self.p_cx1 * greatest) * (self.p_hx1 - slip)
        angle = self.p_cx1 * jnp.arctan(x - self.p_ex1 * (x - jnp.arctan(x)))
        return -load * greatest * jnp.sin(angle + load * self.p_vx1)
