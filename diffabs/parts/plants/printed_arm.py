"""The two-wheeler by the paper's printed linear equations, only to reproduce its Fig. 3.

    (a + p2 + p3 + 2 c2 + 2 c3) theta'' + (p2 + c2) psi'' + (p3 + c3) phi''
                         = g (b1 theta + b2 (theta - psi) + b3 (theta - phi))
    (p2 + c2) theta'' + p2 psi'' = tau + g b2 (theta - psi)
    (p3 + c3) theta'' + p3 phi'' = -K phi - d phi' + g b3 (theta - phi)

The gravity matrix d(right sides)/dq is not symmetric. These forces have no potential, so no machine has them. In these
equations the arm falls to the side that lifts the frame.

Source: Fumita, eqs. (8)-(10), for small angles.
"""

from diffabs.core.numerics import quotient
from diffabs.core.protocols import BalanceOutput
from diffabs.core.pytree import part, pytree
from diffabs.core.types import Scalar
from diffabs.parts.plants.arm_balance import ArmBalance, ArmState, BalanceStart, usual_objectives, usual_parts


@pytree
class PrintedArm:
    """The paper's linear equations with the parameters of a machine. They reproduce a misprint and are not valid
    mechanics.
    """

    machine: ArmBalance = part(default=ArmBalance)

    shows = BalanceOutput
    control_unit = "V"

    usual_parts, usual_objectives = usual_parts, usual_objectives

    def start(self, initial: BalanceStart) -> ArmState:
        """Return the state with the angles and rates of `initial`."""
        return self.machine.start(initial)

    def derivative(self, t: Scalar, state: ArmState, control: Scalar) -> ArmState:
        """Return dx/dt under the motor voltage `control` [V]."""
        del t
        m, (a, p2, p3, c2, c3, b1, b2, b3) = self.machine, self.machine.lumps()
        theta, psi, phi, *_ = state
        rates = (state.theta_rate, state.psi_rate, state.phi_rate)
        arm, rider = m.gravity * b2 * (theta - psi), m.gravity * b3 * (theta - phi)
        r1 = m.gravity * b1 * theta + arm + rider
        r2 = m.torque(state.psi_rate, control) + arm
        r3 = -m.stiffness * phi - m.damping * state.phi_rate + rider
        m12, m13, m22 = p2 + c2, p3 + c3, p2 + m.gear**2 * m.rotor_inertia
        by2, by3 = m12 / m22, m13 / p3
        first = quotient(r1 - by2 * r2 - by3 * r3, a + m12 + m13 + c2 + c3 - by2 * m12 - by3 * m13)
        return ArmState(*rates, first, r2 / m22 - by2 * first, r3 / p3 - by3 * first)

    def project(self, state: ArmState) -> ArmState:
        """Return the state itself, because every state is admissible."""
        return state

    def output(self, state: ArmState) -> BalanceOutput:
        """Return angles, rates, and the parameters from which the motor's torque follows."""
        return self.machine.output(state)

    def holding(self, output: BalanceOutput, target: Scalar) -> Scalar:
        """Return 0 V, the voltage of the upright position."""
        return self.machine.holding(output, target)
