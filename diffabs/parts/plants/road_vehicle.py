"""Quarter car with its own wheel load, air drag, rolling resistance and bearing friction.

    m v' = -Fz mu(slip) - c v^2 - f m g,   J omega' = r Fz mu(slip) - B omega - u,   x' = v

The slip is (v - r omega)/v. `QuarterCar` is the case Fz = m g, c = f = B = 0. A published model may give the wheel a
load that is not the weight of its share of the car.

Source: J. Pedro, O. Nyandoro and S. John, Neural network based feedback linearisation slip control of an anti-lock
braking system, Proc. 7th Asian Control Conference (2009), pp. 1251-1257 (c and B); U. Kiencke and L. Nielsen,
Automotive Control Systems, 2nd ed., sec. 9.1 (f).
"""

import jax.numpy as jnp

from diffabs.core.numerics import quotient
from diffabs.core.protocols import BrakeOutput, Road
from diffabs.core.pytree import param, part, pytree
from diffabs.core.types import Scalar
from diffabs.parts.plants.quarter_car import QuarterCar, QuarterCarState
from diffabs.parts.plants.wheel import GRAVITY, BrakedWheel, halt_at_zero
from diffabs.parts.roads import DRY_ASPHALT


@pytree
class RoadVehicle(BrakedWheel):
    """m v' = -Fz mu - c v^2 - f m g, J omega' = r Fz mu - B omega - u."""

    mass: Scalar = param(default=440.0, unit="kg", above=0.0)
    """Mass m of the vehicle on the wheel."""
    radius: Scalar = param(default=0.3, unit="m", above=0.0)
    """Radius r of the wheel."""
    inertia: Scalar = param(default=1.6, unit="kg m^2", above=0.0)
    """Inertia J of the wheel."""
    wheel_load: Scalar = param(default=4316.4, unit="N", above=0.0)
    """Load Fz of the wheel on the road."""
    drag: Scalar = param(default=0.856, unit="kg/m", low=0.0)
    """Air drag c at 1 m/s, half of density, drag coefficient and area."""
    rolling: Scalar = param(default=0.01, unit="1", low=0.0)
    """Coefficient f of rolling resistance."""
    bearing: Scalar = param(default=0.08, unit="N m s", low=0.0)
    """Viscous friction B of the wheel."""
    crawl_speed: Scalar = param(default=0.01, unit="m/s", above=0.0)
    """Least denominator of the slip."""
    road: Road = part(default=DRY_ASPHALT)
    """Friction curve."""

    start, project, energy, audit = QuarterCar.start, QuarterCar.project, QuarterCar.energy, QuarterCar.audit

    def derivative(self, t: Scalar, state: QuarterCarState, control: Scalar) -> QuarterCarState:
        """Return dx/dt under the brake torque `control` [N m]."""
        del t
        y = self.output(state)
        grip = self.wheel_load * self.road.friction(y.slip, y.speed, y.distance)
        spin = quotient(self.radius * grip - self.bearing * state.spin - control, self.inertia)
        return QuarterCarState(halt_at_zero(state.speed, -y.deceleration), halt_at_zero(state.spin, spin), y.speed)

    def output(self, state: QuarterCarState) -> BrakeOutput:
        """Return slip [1], speeds of car and wheel rim [m/s], deceleration [m/s^2], and distance [m].

        The rolling resistance counts only while the car moves.
        """
        v, w = state.speed, self.radius * state.spin
        slip, mu = self.slip_and_friction(v, w, state.distance)
        resistance = self.drag * v * v + self.rolling * self.mass * GRAVITY * jnp.where(jnp.greater(v, 0), 1.0, 0.0)
        deceleration = quotient(self.wheel_load * mu + resistance, self.mass)
        return BrakeOutput(slip, v, w, deceleration, state.distance)

    def holding(self, output: BrakeOutput, target: Scalar) -> Scalar:
        """Return tau* = r Fz mu - B omega + (1 - slip) J a/r [N m] at the deceleration a, for a constant slip."""
        v = output.speed
        grip = self.wheel_load * self.road.friction(target, v, output.distance)
        a = quotient(grip + self.drag * v * v, self.mass) + self.rolling * GRAVITY
        return self.radius * grip + (1 - target) * (self.inertia * a - self.bearing * v) / self.radius
