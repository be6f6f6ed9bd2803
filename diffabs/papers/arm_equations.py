"""Fumita's potential energies (2), (4), (6) and equations of motion (8)-(10) as printed, and what is wrong in them.

Each is a function of angles q, rates v and accelerations a, shape (3,). Every misprint is thus a difference of two
functions.
"""

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.types import AnyArray, JsonObject, Scalar, Vector
from diffabs.papers import record
from diffabs.parts.plants import ArmBalance

# Half the length of a uniform rod with the inertia of each body.
RODS = {"body": "body_height", "arm": "arm_length", "rider": "rider_height"}


def potentials(p: ArmBalance, q: Vector) -> Scalar:
    """Return eqs. (2), (4), (6) as printed, shape (3,) [J].

    In (4) and (6) a term lacks the factor g, so that they add kg m to J.

    Args:
        q: Angles (3,) [rad].
    """
    t1, t2, t3 = q
    u1 = p.body_mass * p.body_height * p.gravity * jnp.cos(t1)
    u2 = p.arm_mass * p.mount_height * jnp.cos(t1) + p.arm_mass * p.arm_length * p.gravity * jnp.cos(t1 - t2)
    u3 = p.rider_mass * p.mount_height * jnp.cos(t1) + p.rider_mass * p.rider_height * p.gravity * jnp.cos(t1 - t3)
    return jnp.stack([u1, u2, u3])


def printed_equations(p: ArmBalance, q: Vector, v: AnyArray, a: Vector) -> Scalar:
    """Return the left sides of eqs. (8), (9), (10), shape (3,).

    Args:
        q: Angles (3,) [rad].
        v: Rates (3,) [rad/s].
        a: Accelerations (3,) [rad/s^2].
    """
    (t1, t2, t3), (v1, v2, v3) = q, v
    sin2, sin3 = jnp.sin(t2), jnp.sin(t3)
    l, lg, hg, m2, m3, g = p.mount_height, p.arm_length, p.rider_height, p.arm_mass, p.rider_mass, p.gravity
    arm, rider = p.arm_inertia + m2 * lg**2, p.rider_inertia + m3 * hg**2
    by2, by3 = arm + m2 * l * lg * jnp.cos(t2), rider + m3 * l * hg * jnp.cos(t3)
    frame = p.body_inertia + p.body_mass * p.body_height**2 + m2 * l**2 + m3 * l**2 + arm + rider
    frame = frame + 2 * m2 * l * lg * jnp.cos(t2) + 2 * m3 * l * hg * jnp.cos(t3)
    gravity2, gravity3 = m2 * lg * g * jnp.sin(t1 - t2), m3 * hg * g * jnp.sin(t1 - t3)
    eighth = frame * a[0] + by2 * a[1] + by3 * a[2]
    eighth = eighth - 2 * m2 * l * lg * sin2 * v1 * v2 - 2 * m3 * l * hg * sin3 * v1 * v3
    eighth = eighth - m2 * lg * sin2 * v2**2 - m3 * l * hg * sin3 * v3**2
    eighth = eighth - (p.body_mass * p.body_height + (m2 + m3) * l) * g * jnp.sin(t1) - gravity2 - gravity3
    ninth = by2 * a[0] + arm * a[1] - m2 * l * lg * sin2 * v1**2 - gravity2
    tenth = by3 * a[0] + rider * a[2] - m3 * l * hg * sin3 * v1**2 - gravity3
    return jnp.stack([eighth, ninth, tenth])


def gravity_stiffness(p: ArmBalance) -> np.ndarray:
    """Return the Jacobian of the left sides of (8)-(10) by the angles, upright and at rest, shape (3, 3) [N m/rad].

    A gravity that comes from a potential has a symmetric Jacobian.
    """
    zero = jnp.zeros(3)
    return np.asarray(jax.jacfwd(lambda q: printed_equations(p, q, zero, zero))(zero))


def judge_equations(p: ArmBalance) -> list[JsonObject]:
    """Return the rows that judge the printed equations, one for each number."""
    upright = np.asarray(potentials(p, jnp.zeros(3)))
    height = p.arm_mass * p.gravity * (p.mount_height + p.arm_length)
    rows = [record.computed_row("eq. (4), everything upright", "potential energy", "J", upright[1], reference=height)]
    stiffness = gravity_stiffness(p)
    for i, name in ((1, "arm"), (2, "rider")):
        of_frame = f"gravity of eq. ({8 + i}) by the frame less that of (8) by the {name}"
        rows.append(
            record.computed_row(of_frame, "asymmetry", "N m/rad", stiffness[i, 0] - stiffness[0, i], reference=0.0)
        )
    for name, half in RODS.items():
        mass, inertia = getattr(p, f"{name}_mass"), getattr(p, f"{name}_inertia")
        rod = mass * (2 * getattr(p, half)) ** 2 / 12
        rows.append(record.computed_row(f"a uniform rod as the {name}", "inertia", "kg m^2", rod, published=inertia))
    rows.append(record.computed_row("motor, stalled at 48 V", "torque", "N m", p.torque_constant * 48.0 / p.resistance))
    rows.append(record.computed_row("motor, most at 48 V", "mechanical power", "W", 48.0**2 / (4 * p.resistance)))
    return rows
