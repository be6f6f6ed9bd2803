"""The laboratory anti-lock brake rig of INTECO, as modelled in its manual.

    Fn = (Mg + s1 (M1 + M10) + d1 omega1)/(L (sin phi - mu cos phi))
    J1 omega1' = Fn r1 mu - d1 omega1 - s1 (M1 + M10)
    J2 omega2' = -(Fn r2 mu + d2 omega2 + s2 M20)
    M1' = c31 (b(u) - M1),   b(u) = max(b1 u + b2, 0) for u >= u0, else 0

The braked upper wheel hangs on a lever of length L and presses on the lower wheel, the "road", at the angle phi. Its
brake torque adds to the normal force. mu is odd in the slip and so contains the manual's sign s of the slip. This is
eq. (1) of Maeda and Sugiura with tau_b + tau_1 = Mg + M1 + M10 + d1 omega1.

The defaults are the numbers of the manual (INTECO, ABS, user's manual, 2014); "mask" is the maker's Simulink model:

    r1, r2, L, phi    Table 2, p. 31 (mask: the same; the driver's perimeters give 0.0956 and 0.0985 m)
    J1, J2            Table 3, p. 33 (mask 7.5281e-3, 25.603e-3)
    d1, d2, M20       Table 4, means, p. 33 (mask 1.2e-4, 2.25e-4, 0.093); M10 that of the mask (Table 4: 0.0032)
    Mg                p. 32, with the digits of the mask
    c31               pp. 31 and 36 (p. 35 prints 10.37; mask 1/0.048 = 20.83)
    b1, b2, u0        pp. 31 and 36 (mask u0 = 6.21/15.24 = 0.4075, where b is 0; p. 36 has b = 0.12 below u0)
    road              p. 36, rounded as in Maeda and Sugiura

`papers/measured_rig.py` has the mask's rig. The rig that was measured is in another state: `lab-rig-measured`.

A stopped wheel sticks while the road's torque T is below M1 + M10; the brake then carries exactly T. Where r1 mu
exceeds L (sin phi - mu cos phi), no torque holds the wheel.

    T = r1 mu Mg/(L (sin phi - mu cos phi) - r1 mu)

At mu = tan phi the lever locks itself: no finite normal force balances it. `rules` refuses such a road. A run that
meets such friction later has diverged.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from diffabs.core.arrays import as_rule_array
from diffabs.core.numerics import clamp, larger, quotient, smaller
from diffabs.core.protocols import BrakeOutput, Road
from diffabs.core.pytree import param, part, pytree
from diffabs.core.rules import Rule
from diffabs.core.types import Numbers, PyTree, Scalar
from diffabs.parts.plants.audit import BrakeAudit
from diffabs.parts.plants.wheel import BrakedWheel, BrakeStart, forward_speed, halt_at_zero, slip_ratio
from diffabs.parts.roads import RIG
from diffabs.parts.roads.sign import stays_below


class LabRigState(NamedTuple):
    """State of the rig.

    Attributes:
        wheel: Angular speed of the braked wheel [rad/s].
        drum: Angular speed of the road wheel [rad/s].
        brake: Brake torque [N m].
        distance: r2 * angle of the road wheel [m].
    """

    wheel: Scalar
    drum: Scalar
    brake: Scalar
    distance: Scalar


@pytree
class LabRig(BrakedWheel):
    """Two wheels, a lever, bearing friction, and a brake with a 49 ms lag. The control u in [0, 1] is the brake
    command.
    """

    wheel_radius: Scalar = param(default=0.0995, unit="m", above=0.0)
    """Radius r1 of the braked wheel."""
    drum_radius: Scalar = param(default=0.099, unit="m", above=0.0)
    """Radius r2 of the road wheel."""
    wheel_inertia: Scalar = param(default=7.53e-3, unit="kg m^2", above=0.0)
    """Inertia J1 of the braked wheel."""
    drum_inertia: Scalar = param(default=25.6e-3, unit="kg m^2", above=0.0)
    """Inertia J2 of the road wheel."""
    wheel_friction: Scalar = param(default=1.1874e-4, unit="N m s", low=0.0)
    """Viscous friction d1 of the braked wheel."""
    drum_friction: Scalar = param(default=2.1468e-4, unit="N m s", low=0.0)
    """Viscous friction d2 of the road wheel."""
    wheel_stiction: Scalar = param(default=0.003, unit="N m", low=0.0)
    """Dry friction M10 of the braked wheel."""
    drum_stiction: Scalar = param(default=0.0925, unit="N m", low=0.0)
    """Dry friction M20 of the road wheel."""
    lever: Scalar = param(default=0.37, unit="m", above=0.0)
    """Length L of the lever."""
    lever_angle: Scalar = param(default=math.radians(65.61), unit="rad", above=0.0, below=math.pi / 2)
    """Angle phi of the lever."""
    weight_torque: Scalar = param(default=19.6181, unit="N m", above=0.0)
    """Torque Mg of the lever's weight."""
    brake_rate: Scalar = param(default=20.37, unit="1/s", above=0.0)
    """Rate c31 of the brake."""
    brake_gain: Scalar = param(default=15.24, unit="N m", above=0.0)
    """Torque b1 of the brake at command 1, without the offset."""
    brake_offset: Scalar = param(default=-6.21, unit="N m")
    """Offset b2 of the brake's torque."""
    brake_threshold: Scalar = param(default=0.415, unit="1", low=0.0, high=1.0, tunable=False)
    """Command u0 below which the brake is released."""
    crawl_speed: Scalar = param(default=0.01, unit="m/s", above=0.0)
    """Least denominator of the slip."""
    road: Road = part(default=RIG)

    control_unit = "1"  # a command; the other braked plants take a torque in N m

    def start(self, initial: BrakeStart) -> LabRigState:
        """Return the state for a speed and a slip, with the brake released."""
        zero = 0.0 * initial.speed
        wheel = (1 - initial.slip) * initial.speed / self.wheel_radius
        return LabRigState(wheel, initial.speed / self.drum_radius, zero, zero)

    def derivative(self, t: Scalar, state: LabRigState, control: Scalar) -> LabRigState:
        """Return dx/dt under the brake command `control` [1], clamped to [0, 1]."""
        del t
        mu, normal, torque = self.contact(state)
        wheel = quotient(normal * self.wheel_radius * mu - torque, self.wheel_inertia)
        rests = (state.wheel <= 0) & (torque < state.brake + self.wheel_stiction)
        wheel = jnp.where(rests, 0.0, wheel)  # exactly 0: from rounding a stuck wheel would turn
        drum = -quotient(self._drum_torque(state.drum, normal * mu), self.drum_inertia)
        u = clamp(control, 0.0, 1.0)
        brake = larger(0.0, self.brake_gain * u + self.brake_offset)  # a brake does not drive
        target = jnp.where(u < self.brake_threshold, 0.0, brake)  # NaN for a command of NaN
        return LabRigState(
            halt_at_zero(state.wheel, wheel),
            halt_at_zero(state.drum, drum),
            self.brake_rate * (target - state.brake),
            self.drum_radius * state.drum,
        )

    def contact(self, state: LabRigState) -> tuple[PyTree, PyTree, PyTree]:
        """Return the friction coefficient [1], the normal force [N], and the braking torque on the wheel [N m].

        The torque is the brake's plus the bearing's friction. On a stopped wheel it is at most the torque that holds
        the wheel. The normal force is infinite where the lever locks itself.

        Args:
            state: State of the rig.
        """
        slip = slip_ratio(self.drum_radius * state.drum, self.wheel_radius * state.wheel, self.crawl_speed)
        mu = self.road.friction(slip, self.drum_radius * state.drum, state.distance)
        arm = self.lever * (jnp.sin(self.lever_angle) - mu * jnp.cos(self.lever_angle))
        capacity = state.brake + self.wheel_stiction
        # Denominators are replaced where they are not positive: a NaN in the branch that `where` does not take would
        # reach the derivatives.
        held = arm > self.wheel_radius * mu
        spare = jnp.where(held, arm - self.wheel_radius * mu, 1.0)
        needed = quotient(self.wheel_radius * mu * self.weight_torque, spare)
        stuck = jnp.where(held, smaller(needed, capacity), capacity)
        torque = jnp.where(state.wheel > 0, capacity + self.wheel_friction * state.wheel, stuck)
        free = arm > 0
        normal = jnp.where(free, quotient(self.weight_torque + torque, jnp.where(free, arm, 1.0)), jnp.inf)
        return mu, normal, torque

    def project(self, state: LabRigState) -> LabRigState:
        """Return the state with neither wheel turning backwards."""
        return LabRigState(forward_speed(state.wheel), forward_speed(state.drum), state.brake, state.distance)

    def output(self, state: LabRigState) -> BrakeOutput:
        """Return slip, rim speeds, deceleration of the road wheel's rim, and distance."""
        v, w = self.drum_radius * state.drum, self.wheel_radius * state.wheel
        mu, normal, _ = self.contact(state)
        deceleration = self.drum_radius * quotient(self._drum_torque(state.drum, normal * mu), self.drum_inertia)
        return BrakeOutput(slip_ratio(v, w, self.crawl_speed), v, w, deceleration, state.distance)

    def holding(self, output: BrakeOutput, target: Scalar) -> Scalar:
        """Return the brake command [1] whose steady torque keeps the slip at `target` while both wheels slow down.

        The condition is omega1' = (1 - slip) (r2/r1) omega2'. The command is not clamped to [0, 1] and ignores the
        threshold. It is infinite where no torque holds the slip, because the friction grows as fast as the torque.
        """
        drum = output.speed / self.drum_radius
        spin = (1 - target) * output.speed / self.wheel_radius
        mu = self.road.friction(target, output.speed, output.distance)
        arm = self.lever * (jnp.sin(self.lever_angle) - mu * jnp.cos(self.lever_angle))
        k = self.wheel_inertia * (1 - target) * self.drum_radius / (self.wheel_radius * self.drum_inertia)
        grip = mu * (self.wheel_radius + k * self.drum_radius)
        drag = k * (self.drum_friction * drum + self.drum_stiction)
        spare = larger(arm - grip, 0.0)
        torque = quotient(grip * self.weight_torque + drag * arm, spare)
        brake = torque - self.wheel_stiction - self.wheel_friction * spin
        return (brake - self.brake_offset) / self.brake_gain

    def audit(self, initial: BrakeStart) -> BrakeAudit:
        """Return the audit of runs from `initial`: this brake never drives, so any gain of energy is a numerical
        instability.
        """
        car, wheel = self.drum_inertia / self.drum_radius**2, self.wheel_inertia / self.wheel_radius**2
        scale = self.energy(self.start(initial))
        return BrakeAudit(car=car, wheel=wheel, radius=self.wheel_radius, scale=scale, commanded=True)

    def energy(self, state: LabRigState) -> Scalar:
        """Return the kinetic energy of both wheels in a `state` [J]."""
        return 0.5 * (self.wheel_inertia * state.wheel**2 + self.drum_inertia * state.drum**2)

    def rules(self) -> Iterator[Rule]:
        """Yield the rule that the lever does not lock itself at the start of a run: mu < tan(phi)."""
        friction = Partial(type(self.road).friction, self.road, speed=0.0, distance=0.0)
        angle = as_rule_array(self.lever_angle)
        limit = jnp.tan(angle) if isinstance(angle, jax.Array) else np.tan(angle)
        yield stays_below(friction, limit, "tan(lever_angle)", "the lever locks itself").under("road.")

    def _drum_torque(self, drum: Scalar, push: Scalar) -> Numbers:
        return push * self.drum_radius + self.drum_friction * drum + jnp.where(drum > 0, self.drum_stiction, 0.0)
