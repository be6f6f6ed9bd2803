"""Quarter car with one braked wheel.

    m v' = -mu(slip) m g,   J omega' = r mu(slip) m g - u,   x' = v,   slip = (v - r omega)/v

Aoki and Nakamura, eqs. (1) and (7)-(12); the same equations are eqs. (6)-(11) of Maeda and Sugiura. Aoki and Nakamura's
brake torque is negative; here u >= 0 brakes. Their eq. (9) drops the brake from a stopped wheel, so that the wheel
starts to turn again at once. Here a stopped wheel stays stopped while the brake torque exceeds the road's torque. The
model neglects rolling and air resistance.
"""

from typing import NamedTuple

from diffabs.core.numerics import quotient
from diffabs.core.protocols import BrakeOutput, Road
from diffabs.core.pytree import param, part, pytree
from diffabs.core.types import Scalar
from diffabs.parts.plants.audit import BrakeAudit
from diffabs.parts.plants.wheel import GRAVITY, BrakedWheel, BrakeStart, forward_speed, halt_at_zero
from diffabs.parts.roads import SPLINE_B


class QuarterCarState(NamedTuple):
    """Vehicle speed [m/s], wheel's angular speed [rad/s], distance [m]."""

    speed: Scalar
    spin: Scalar
    distance: Scalar


@pytree
class QuarterCar(BrakedWheel):
    """m v' = -mu m g, J omega' = r mu m g - u. The inertia was identified together with the spline road."""

    mass: Scalar = param(default=15.0, unit="kg", above=0.0)
    """Mass m of the vehicle on the wheel."""
    radius: Scalar = param(default=0.2, unit="m", above=0.0)
    """Radius r of the wheel."""
    inertia: Scalar = param(default=1.04456, unit="kg m^2", above=0.0)
    """Inertia J of the wheel."""
    crawl_speed: Scalar = param(default=0.01, unit="m/s", above=0.0)
    """Least denominator of the slip."""
    road: Road = part(default=SPLINE_B)

    def start(self, initial: BrakeStart) -> QuarterCarState:
        """Return the state for a speed and a slip."""
        spin = (1 - initial.slip) * initial.speed / self.radius
        return QuarterCarState(initial.speed, spin, 0.0 * initial.speed)

    def derivative(self, t: Scalar, state: QuarterCarState, control: Scalar) -> QuarterCarState:
        """Return dx/dt under the brake torque `control` [N m]."""
        del t
        mu = self.output(state).deceleration / GRAVITY
        spin = quotient(self.radius * mu * self.mass * GRAVITY - control, self.inertia)
        return QuarterCarState(halt_at_zero(state.speed, -mu * GRAVITY), halt_at_zero(state.spin, spin), state.speed)

    def project(self, state: QuarterCarState) -> QuarterCarState:
        """Return the state with neither car nor wheel moving backwards."""
        return QuarterCarState(forward_speed(state.speed), forward_speed(state.spin), state.distance)

    def output(self, state: QuarterCarState) -> BrakeOutput:
        """Return slip [1], speeds of car and wheel rim [m/s], deceleration mu g [m/s^2], and distance [m]."""
        v, w = state.speed, self.radius * state.spin
        slip, mu = self.slip_and_friction(v, w, state.distance)
        return BrakeOutput(slip, v, w, mu * GRAVITY, state.distance)

    def holding(self, output: BrakeOutput, target: Scalar) -> Scalar:
        """Return tau* = mu (m g r + (1 - slip) J g/r) [N m], which brakes car and wheel together at a constant slip."""
        mu = self.road.friction(target, output.speed, output.distance)
        return mu * GRAVITY * (self.mass * self.radius + (1 - target) * self.inertia / self.radius)

    def audit(self, initial: BrakeStart) -> BrakeAudit:
        """Return the audit of runs from `initial`; only a negative torque, which drives the wheel, explains a gain of
        energy.
        """
        wheel, scale = self.inertia / self.radius**2, self.energy(self.start(initial))
        return BrakeAudit(car=self.mass, wheel=wheel, radius=self.radius, scale=scale)

    def energy(self, state: QuarterCarState) -> Scalar:
        """Return the kinetic energy of car and wheel in a `state` [J]."""
        return 0.5 * (self.mass * state.speed**2 + self.inertia * state.spin**2)
