"""The laboratory rig turned upside down: the upper wheel is the car's body, of mass m, and presses on the lower, braked
wheel.

    J1 omega1' = Fn r1 mu(slip) - tau1,   J2 omega2' = -Fn r2 mu(slip),   Fn = m g,   J2 = c m r2^2
    slip = (r2 omega2 - r1 omega1)/(r2 omega2)

Maeda and Sugiura, eqs. (2)-(5), (12). Their eq. (3) takes the body for a disk, c = 1/2. Eq. (9) then decelerates it at
2 mu g, twice their eq. (8) for a car; c = 1 is the inertia that gives the car's mu g. The default is 1/2, because their
numbers use it. Eq. (12) holds only for omega2 r2 >= omega1 r1; beyond this the slip is relative to the faster wheel.
"""

from typing import NamedTuple

from diffabs.core.numerics import quotient
from diffabs.core.protocols import BrakeOutput, Road
from diffabs.core.pytree import param, part, pytree
from diffabs.core.types import Scalar
from diffabs.parts.plants.audit import BrakeAudit
from diffabs.parts.plants.wheel import GRAVITY, BrakedWheel, BrakeStart, forward_speed, halt_at_zero
from diffabs.parts.roads import RIG


class RigState(NamedTuple):
    """Angular speeds of the braked wheel and of the body wheel [rad/s], distance r2 * angle [m]."""

    wheel: Scalar
    body: Scalar
    distance: Scalar


@pytree
class MirroredRig(BrakedWheel):
    """J1 omega1' = m g r1 mu - tau1, c m r2^2 omega2' = -m g r2 mu."""

    mass: Scalar = param(default=5.3, unit="kg", above=0.0)
    """Mass m of the vehicle on the wheel."""
    wheel_radius: Scalar = param(default=0.0995, unit="m", above=0.0)
    """Radius r1 of the braked wheel."""
    body_radius: Scalar = param(default=0.099, unit="m", above=0.0)
    """Radius r2 of the body wheel."""
    wheel_inertia: Scalar = param(default=7.53e-3, unit="kg m^2", above=0.0)
    """Inertia J1 of the braked wheel."""
    inertia_factor: Scalar = param(default=0.5, unit="1", above=0.0, high=1.0)
    """Inertia factor c of the body wheel, J2 = c m r2^2; 1/2 is a disk."""
    crawl_speed: Scalar = param(default=0.01, unit="m/s", above=0.0)
    """Least denominator of the slip."""
    road: Road = part(default=RIG)

    def start(self, initial: BrakeStart) -> RigState:
        """Return the state for a speed and a slip."""
        wheel = (1 - initial.slip) * initial.speed / self.wheel_radius
        return RigState(wheel, initial.speed / self.body_radius, 0.0 * initial.speed)

    def derivative(self, t: Scalar, state: RigState, control: Scalar) -> RigState:
        """Return dx/dt under the brake torque tau1 = `control` [N m]."""
        del t
        y = self.output(state)
        push = self.inertia_factor * self.mass * y.deceleration  # Fn mu [N]
        wheel = quotient(push * self.wheel_radius - control, self.wheel_inertia)
        body = -quotient(y.deceleration, self.body_radius)
        return RigState(halt_at_zero(state.wheel, wheel), halt_at_zero(state.body, body), y.speed)

    def project(self, state: RigState) -> RigState:
        """Return the state with neither wheel turning backwards."""
        return RigState(forward_speed(state.wheel), forward_speed(state.body), state.distance)

    def output(self, state: RigState) -> BrakeOutput:
        """Return slip, rim speeds, deceleration mu g/c of the body's rim, and distance."""
        v, w = self.body_radius * state.body, self.wheel_radius * state.wheel
        slip, mu = self.slip_and_friction(v, w, state.distance)
        return BrakeOutput(slip, v, w, quotient(mu * GRAVITY, self.inertia_factor), state.distance)

    def holding(self, output: BrakeOutput, target: Scalar) -> Scalar:
        """Return tau* = m g r1 mu + (1 - slip) J1 mu g/(c r1) [N m], the zero of eq. (14)."""
        mu = self.road.friction(target, output.speed, output.distance)
        wheel = (1 - target) * self.wheel_inertia / (self.inertia_factor * self.wheel_radius)
        return mu * GRAVITY * (self.mass * self.wheel_radius + wheel)

    def audit(self, initial: BrakeStart) -> BrakeAudit:
        """Return the audit of runs from `initial`; only a negative torque, which drives the wheel, explains a gain of
        energy.
        """
        car, wheel = self.inertia_factor * self.mass, self.wheel_inertia / self.wheel_radius**2
        return BrakeAudit(car=car, wheel=wheel, radius=self.wheel_radius, scale=self.energy(self.start(initial)))

    def energy(self, state: RigState) -> Scalar:
        """Return the kinetic energy of both wheels in a `state` [J]."""
        body = self.inertia_factor * self.mass * self.body_radius**2
        return 0.5 * (self.wheel_inertia * state.wheel**2 + body * state.body**2)
