"""A two-wheeler seen from behind: a frame on the ground contact line, an arm that a motor turns, and a rider.

    theta1 = theta        frame, from the vertical       theta2 = psi, theta3 = phi     arm and rider, from the frame

    M q'' + h + G = (0, tau, -K phi - d phi'),   q = (theta, psi, phi)
    M = [[a + p2 + p3 + 2 c2 cos psi + 2 c3 cos phi, p2 + c2 cos psi, p3 + c3 cos phi], [., p2 + N^2 Jr, 0], [., 0, p3]]
    h = [-c2 sin psi (2 theta' psi' + psi'^2) - c3 sin phi (2 theta' phi' + phi'^2), c2 sin psi theta'^2,
         c3 sin phi theta'^2]
    G = -g [b1 sin theta + b2 sin(theta + psi) + b3 sin(theta + phi), b2 sin(theta + psi), b3 sin(theta + phi)]
    tau = (Kt/Rm) u - (Kt Kb/Rm + fm) psi'    while the current (u - Kb psi')/Rm is within its limit

    a = I1 + m1 lg^2 + (m2 + m3) l^2   p2 = I2 + m2 Lg^2   p3 = I3 + m3 hg^2   c2 = m2 l Lg   c3 = m3 l hg
    b1 = m1 lg + (m2 + m3) l           b2 = m2 Lg          b3 = m3 hg

The kinetic energy is that of Fumita, section 2, eqs. (1), (3), (5). All equations here follow from one Lagrangian.

The paper's potential energy uses theta1 - theta2 and theta1 - theta3, but its kinetic energy uses the sums: two
conventions in one Lagrangian. Eqs. (4) and (6) also lack g in their first terms, and eq. (8) lacks l in the term with
theta2'^2. The centrifugal terms of (9), (10) have the opposite sign. `PrintedArm` is the paper's own linear model.

Without a rider (mass, stiffness and damping 0) this is the Acrobot of Spong. The paper has no gear. Here a gear of
ratio N and a rotor of inertia Jr act as N Kt, N Kb and N^2 Jr about the arm's joint. The model neglects the reaction of
the spinning rotor on the frame.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from diffabs.core.numerics import clamp, quotient
from diffabs.core.protocols import BalanceOutput
from diffabs.core.pytree import param, pytree
from diffabs.core.types import AnyArray, PyTree, Scalar
from diffabs.parts.actuators import VoltageLimit
from diffabs.parts.controllers import BalanceFeedback
from diffabs.parts.objectives import BALANCE
from diffabs.parts.plants.audit import BalanceAudit
from diffabs.parts.references import Upright
from diffabs.parts.stops import Fallen


class ArmState(NamedTuple):
    """Angles of frame, arm and rider [rad], and their rates [rad/s]."""

    theta: Scalar
    psi: Scalar
    phi: Scalar
    theta_rate: Scalar
    psi_rate: Scalar
    phi_rate: Scalar


class Lumps(NamedTuple):
    """Coefficients of masses and lengths in the equations: a, p2, p3, c2, c3 [kg m^2], b1, b2, b3 [kg m]."""

    a: Scalar
    p2: Scalar
    p3: Scalar
    c2: Scalar
    c3: Scalar
    b1: Scalar
    b2: Scalar
    b3: Scalar


@pytree
class BalanceStart:
    """Angles [rad] and rates [rad/s] of frame (theta), arm (psi) and rider (phi) at t = 0."""

    theta: Scalar = param(default=0.0, unit="rad")
    """Angle of the frame at t = 0, from the vertical."""
    psi: Scalar = param(default=0.0, unit="rad")
    """Angle of the arm at t = 0, from the frame."""
    phi: Scalar = param(default=0.0, unit="rad")
    """Angle of the rider at t = 0, from the frame."""
    theta_rate: Scalar = param(default=0.0, unit="rad/s")
    """Rate of theta at t = 0."""
    psi_rate: Scalar = param(default=0.0, unit="rad/s")
    """Rate of psi at t = 0."""
    phi_rate: Scalar = param(default=0.0, unit="rad/s")
    """Rate of phi at t = 0."""


def usual_parts(self: object) -> dict[str, PyTree]:
    """Return the default parts of a loop by field: feedback that holds the vehicle upright until it falls."""
    del self
    around = {"reference": Upright(), "controller": BalanceFeedback(), "actuator": VoltageLimit(), "stop": Fallen()}
    return {"initial": BalanceStart(), **around}


def usual_objectives(self: object) -> dict[str, PyTree]:
    """Return the default objectives of a two-wheeler, by name."""
    del self
    return dict(BALANCE)


@pytree
class ArmBalance:
    """Frame, arm and rider under the voltage of the arm's motor. A negative `arm_length` is a hanging arm."""

    body_mass: Scalar = param(default=30.0, unit="kg", above=0.0)
    """Mass m1 of the frame."""
    arm_mass: Scalar = param(default=20.0, unit="kg", above=0.0)
    """Mass m2 of the arm."""
    rider_mass: Scalar = param(default=50.0, unit="kg", low=0.0)
    """Mass m3 of the rider."""
    body_height: Scalar = param(default=0.6, unit="m", above=0.0)
    """Height lg of the frame's centre of mass."""
    mount_height: Scalar = param(default=0.7, unit="m", above=0.0)
    """Height l at which arm and rider turn."""
    arm_length: Scalar = param(default=0.5, unit="m")
    """Distance Lg from there to the arm's centre of mass; negative for a hanging arm."""
    rider_height: Scalar = param(default=0.6, unit="m")
    """Distance hg from there to the rider's centre of mass."""
    body_inertia: Scalar = param(default=3.6, unit="kg m^2", low=0.0)
    """Inertia I1 of the frame."""
    arm_inertia: Scalar = param(default=1.7, unit="kg m^2", above=0.0)
    """Inertia I2 of the arm."""
    rider_inertia: Scalar = param(default=6.0, unit="kg m^2", above=0.0)
    """Inertia I3 of the rider."""
    stiffness: Scalar = param(default=1000.0, unit="N m/rad", low=0.0)
    """Stiffness K of the rider's hip."""
    damping: Scalar = param(default=100.0, unit="N m s/rad", low=0.0)
    """Damping d of the rider's hip."""
    resistance: Scalar = param(default=3.0, unit="ohm", above=0.0)
    """Resistance Rm of the motor."""
    torque_constant: Scalar = param(default=30.0, unit="N m/A", above=0.0)
    """Torque Kt of the motor per ampere."""
    back_emf: Scalar = param(default=30.0, unit="V s/rad", low=0.0)
    """Induced voltage Kb of the motor per speed."""
    friction: Scalar = param(default=0.02, unit="N m s/rad", low=0.0)
    """Viscous friction fm of the motor."""
    gear: Scalar = param(default=1.0, unit="1", above=0.0)
    """Gear ratio N of the motor."""
    current_max: Scalar = param(default=np.inf, unit="A", above=0.0, infinite=True)
    """Greatest current of the motor."""
    rotor_inertia: Scalar = param(default=0.0, unit="kg m^2", low=0.0)
    """Inertia Jr of the motor's rotor."""
    gravity: Scalar = param(default=9.81, unit="m/s^2", above=0.0)
    """Acceleration g of gravity."""

    shows = BalanceOutput
    control_unit = "V"

    usual_parts, usual_objectives = usual_parts, usual_objectives

    def lumps(self) -> Lumps:
        """Return the coefficients of masses and lengths in the equations."""
        upper = self.arm_mass + self.rider_mass
        return Lumps(
            a=self.body_inertia + self.body_mass * self.body_height**2 + upper * self.mount_height**2,
            p2=self.arm_inertia + self.arm_mass * self.arm_length**2,
            p3=self.rider_inertia + self.rider_mass * self.rider_height**2,
            c2=self.arm_mass * self.mount_height * self.arm_length,
            c3=self.rider_mass * self.mount_height * self.rider_height,
            b1=self.body_mass * self.body_height + upper * self.mount_height,
            b2=self.arm_mass * self.arm_length,
            b3=self.rider_mass * self.rider_height,
        )

    def torque(self, psi_rate: Scalar, control: Scalar) -> Scalar:
        """Return tau [N m], eq. (11): N Kt i - fm psi', with i = (u - N Kb psi')/Rm clamped to its limit.

        Args:
            psi_rate: Rate of the arm psi' [rad/s].
            control: Motor voltage u [V].
        """
        current = quotient(control - self.gear * self.back_emf * psi_rate, self.resistance)
        current = clamp(current, -self.current_max, self.current_max)
        return self.gear * self.torque_constant * current - self.friction * psi_rate

    def start(self, initial: BalanceStart) -> ArmState:
        """Return the state with the angles and rates of `initial`."""
        return ArmState(*(getattr(initial, name) for name in ArmState._fields))

    def derivative(self, t: Scalar, state: ArmState, control: Scalar) -> ArmState:
        """Return dx/dt under the motor voltage `control` [V]."""
        del t
        rates = (state.theta_rate, state.psi_rate, state.phi_rate)
        return ArmState(*rates, *self.accelerations(state, self.torque(state.psi_rate, control)))

    def accelerations(self, state: ArmState, torque: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        """Return theta'', psi'', phi'' [rad/s^2], by the Schur complement of M: its lower block is diagonal.

        Args:
            state: Angles [rad] and rates [rad/s].
            torque: Torque between frame and arm [N m].
        """
        theta, psi, phi, v1, v2, v3 = state
        _, _, _, c2, c3, b1, b2, b3 = lumps = self.lumps()
        (sin1, cos1), (sin2, cos2), (sin3, cos3) = ((jnp.sin(x), jnp.cos(x)) for x in (theta, psi, phi))
        arm = self.gravity * b2 * (sin1 * cos2 + cos1 * sin2)
        rider = self.gravity * b3 * (sin1 * cos3 + cos1 * sin3)
        r1 = c2 * sin2 * v2 * (2 * v1 + v2) + c3 * sin3 * v3 * (2 * v1 + v3)
        r1 = r1 + self.gravity * b1 * sin1 + arm + rider
        r2 = torque - c2 * sin2 * v1**2 + arm
        r3 = -self.stiffness * phi - self.damping * v3 - c3 * sin3 * v1**2 + rider
        m11, m12, m13, m22, m33 = _mass(lumps, cos2, cos3, self.gear**2 * self.rotor_inertia)
        # psi'' and phi'' are eliminated first: m23 = 0, so the lower block of M is diagonal.
        by2, by3 = m12 / m22, m13 / m33
        first = quotient(r1 - by2 * r2 - by3 * r3, m11 - by2 * m12 - by3 * m13)
        return first, r2 / m22 - by2 * first, r3 / m33 - by3 * first

    def project(self, state: ArmState) -> ArmState:
        """Return the state itself, because every state is admissible; the stop detects a fall."""
        return state

    def output(self, state: ArmState) -> BalanceOutput:
        """Return angles, rates, and the parameters from which the motor's torque follows."""
        like = 0.0 * state.theta
        motor = (self.gear * self.torque_constant, self.gear * self.back_emf * state.psi_rate, self.resistance)
        return BalanceOutput(*state, *(x + like for x in (*motor, self.current_max)))

    def holding(self, output: BalanceOutput, target: Scalar) -> Scalar:
        """Return 0 V: only the upright position is an equilibrium without motion, and it needs no voltage."""
        del target
        return 0.0 * output.theta

    def kinetic_energy(self, state: ArmState) -> Scalar:
        """Return the kinetic energy q' M q'/2 of a `state` [J]."""
        _, psi, phi, v1, v2, v3 = state
        m11, m12, m13, m22, m33 = _mass(self.lumps(), jnp.cos(psi), jnp.cos(phi), self.gear**2 * self.rotor_inertia)
        return 0.5 * (m11 * v1**2 + m22 * v2**2 + m33 * v3**2) + (m12 * v2 + m13 * v3) * v1

    def potential_energy(self, state: ArmState) -> Scalar:
        """Return the potential energy of a `state` [J]: gravity, 0 for masses at the height of the ground, and the
        rider's spring.
        """
        lumps = self.lumps()
        heights = (
            lumps.b1 * jnp.cos(state.theta)
            + lumps.b2 * jnp.cos(state.theta + state.psi)
            + lumps.b3 * jnp.cos(state.theta + state.phi)
        )
        return self.gravity * heights + 0.5 * self.stiffness * state.phi**2

    def energy(self, state: ArmState) -> Scalar:
        """Return the kinetic and potential energy of a `state` [J]; energy' = tau psi' - d phi'^2."""
        return self.kinetic_energy(state) + self.potential_energy(state)

    def audit(self, initial: BalanceStart) -> BalanceAudit:
        """Return the audit of runs from `initial`: a gain of energy beyond the motor's work reveals an unstable
        integration.
        """
        lumps, start = self.lumps(), self.start(initial)
        fall = self.gravity * (lumps.b1 + abs(lumps.b2) + abs(lumps.b3))
        scale = fall + self.kinetic_energy(start) + 0.5 * self.stiffness * start.phi**2
        return BalanceAudit(plant=self, first=self.energy(start), scale=scale)

    def limits(self, gain: AnyArray) -> np.ndarray:
        """Return the row, shape (..., 1, 6), for which the motor's current is within its limit where |row x| <= 1.

        The state x is (theta, psi, phi) and their rates, in the order of `ArmState`.

        Args:
            gain: K of the feedback u = K x, shape (..., 6) [V/rad, V s/rad]. The plant's parameters may be NumPy arrays
                of shape (...).
        """
        current = np.array(gain, float) / np.asarray(self.resistance)[..., None]
        current[..., 4] -= self.gear * self.back_emf / self.resistance
        return (current / np.asarray(self.current_max)[..., None])[..., None, :]

    def remainder(self, linear: object, extent: Callable[[PyTree], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return D (..., 6, 3) and the bound Y (..., 3) of the nonlinear remainder D y, |y| <= Y.

        The equations are x' = linear x + D y. The bound holds wherever |row x| <= extent(row) for all rows. If all
        extents shrink by a factor, Y shrinks by at least the same factor.

            y = -(M(q) - M(0)) q'' - h - (G - G'(0) q)      D = (0, M(0)^-1)

        Y follows from 1 - cos z <= z^2/2, |sin z - z| <= |z|^3/6, and |q''| <= |linear x| + |M(0)^-1| |y|. It is
        infinite where the last inequality gives no bound.

        Args:
            linear: State matrix of the linearised closed loop, shape (..., 6, 6). The plant's parameters may be NumPy
                arrays of shape (...).
            extent: Function of a row (6,) that returns a bound of |row x|, shape (...).
        """
        _, _, _, c2, c3, b1, b2, b3 = (np.abs(x) for x in self.lumps())
        unit = np.eye(6)
        theta, psi, phi, v1, v2, v3 = (extent(row) for row in unit)
        arm = self.gravity * b2 * extent(unit[0] + unit[1]) ** 3 / 6
        rider = self.gravity * b3 * extent(unit[0] + unit[2]) ** 3 / 6
        turning = c2 * psi * v2 * extent(2 * unit[3] + unit[4]) + c3 * phi * v3 * extent(2 * unit[3] + unit[5])
        forces = _columns(
            turning + self.gravity * b1 * theta**3 / 6 + arm + rider, c2 * psi * v1**2 + arm, c3 * phi * v1**2 + rider
        )
        zero, by2, by3 = 0.0 * theta, c2 * psi**2 / 2, c3 * phi**2 / 2
        changes = np.stack(
            [_columns(2 * by2 + 2 * by3, by2, by3), _columns(by2, zero, zero), _columns(by3, zero, zero)], axis=-2
        )
        inverse = np.linalg.inv(_at_rest(self.lumps(), self.gear**2 * self.rotor_inertia))
        inverse = np.broadcast_to(inverse, changes.shape)
        loop = np.abs(inverse) @ changes
        accelerations = _columns(*(extent(np.asarray(linear)[..., 3 + i, :]) for i in range(3)))
        accelerations = accelerations + (np.abs(inverse) @ forces[..., None])[..., 0]
        # |q''| <= accelerations + loop |q''|. If the infinity norm of `loop` is below 1, I - loop has a nonnegative
        # inverse, and the inequality can be solved for |q''|.
        held = loop.sum(axis=-1).max(axis=-1) < 1
        safe = np.where(held[..., None, None], loop, 0.0)
        bound = np.linalg.solve(np.eye(3) - safe, accelerations[..., None])[..., 0]
        amounts = forces + (changes @ bound[..., None])[..., 0]
        return np.concatenate([np.zeros_like(inverse), inverse], axis=-2), np.where(held[..., None], amounts, np.inf)

    def cautions(self) -> Iterator[str]:
        """Yield a message if the spring cannot hold the rider on an upright frame."""
        needed = self.rider_mass * self.gravity * self.rider_height
        if self.rider_mass > 0 and not self.stiffness > needed:
            yield (
                f"stiffness = {self.stiffness:g} N m/rad does not hold the rider: even on an upright frame that needs "
                f"more than m3 g hg = {needed:g} N m/rad"
            )


def _mass(lumps: Lumps, cos2: Scalar, cos3: Scalar, rotor: Scalar) -> tuple[PyTree, ...]:
    """Return m11, m12, m13, m22, m33 of the mass matrix [kg m^2]; m23 is 0."""
    m12, m13 = lumps.p2 + lumps.c2 * cos2, lumps.p3 + lumps.c3 * cos3
    m11 = lumps.a + m12 + m13 + lumps.c2 * cos2 + lumps.c3 * cos3
    return m11, m12, m13, lumps.p2 + rotor, lumps.p3


def _at_rest(lumps: Lumps, rotor: Scalar) -> np.ndarray:
    """Return the mass matrix of the upright position, shape (..., 3, 3) [kg m^2]."""
    m11, m12, m13, m22, m33 = _mass(lumps, 1.0, 1.0, rotor)
    zero = 0.0 * m11
    return np.stack([_columns(m11, m12, m13), _columns(m12, m22, zero), _columns(m13, zero, m33)], axis=-2)


def _columns(*columns: ArrayLike) -> np.ndarray:
    return np.stack(np.broadcast_arrays(*columns), axis=-1)


ACROBOT = ArmBalance(
    body_mass=1.0,
    arm_mass=1.0,
    rider_mass=0.0,
    body_height=0.5,
    mount_height=1.0,
    arm_length=1.0,
    body_inertia=0.083,
    arm_inertia=0.33,
    stiffness=0.0,
    damping=0.0,
    resistance=1.0,
    torque_constant=1.0,
    back_emf=0.0,
    friction=0.0,
    gravity=9.8,
)
"""Spong's Acrobot, driven by a torque [N m]. The massless rider keeps its own inertia and moves without coupling to the
rest."""
