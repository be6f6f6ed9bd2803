"""Judgement of Maeda and Sugiura's minor statements: the scaled mass, the cost for any mass, and the origin of the
published gain.

The paper models a car of a tonne by 5 kg.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_continuous_are, solve_continuous_lyapunov

from diffabs.core.numerics import spectral_bound
from diffabs.core.types import AnyArray, JsonObject
from diffabs.papers import record
from diffabs.papers.lmi_design import DESIGN_BOX, K1, PUBLISHED_GAIN
from diffabs.parts.plants import GRAVITY, LabRig
from diffabs.robust.design import Polytope

CAR, PERSON, RIG = 1000.0, 60.0, 5.0  # kg


def scaled_mass(people: int) -> float:
    """Return the rig's mass with passengers [kg], where 5 kg stand for a car of 1000 kg."""
    return RIG + people * PERSON * RIG / CAR


def rig_masses() -> tuple[float, float]:
    """Return two masses of the laboratory rig [kg].

    Returns:
        The mass of the lower wheel by eq. (3), 2 J2/r2^2, and the mass whose weight presses the wheels together at
        rest.
    """
    rig = LabRig()
    by_inertia = 2 * float(rig.drum_inertia) / float(rig.drum_radius) ** 2
    return by_inertia, float(rig.weight_torque) / (float(rig.lever) * np.sin(float(rig.lever_angle)) * GRAVITY)


def corner(system: Polytope, mass: float, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Return A, shape (2, 2), and B, shape (2, 1), of the polytope's vertex that is nearest to this mass and speed.

    Args:
        mass: Mass of the vertex [kg].
        speed: Speed of the vertex [m/s].
    """
    away = [abs(c["plant.mass"] / mass - 1) + abs(c["speed"] / speed - 1) for c in system.corners]
    i = int(np.argmin(away))
    return np.asarray(system.A[i]), np.asarray(system.B[i])


def cost(A: np.ndarray, B: np.ndarray, gain: Sequence[float] | AnyArray, weights: tuple[float, float]) -> float:
    """Return the trace of the cost matrix P, eq. (24), with R = 1; infinity if the gain does not stabilise.

    Args:
        gain: K of u = K x, 2 numbers.
        weights: Diagonal of Q.
    """
    K, Q = np.reshape(gain, (1, 2)), np.diag(weights)
    closed = A + B @ K
    if spectral_bound(closed) >= 0:
        return np.inf
    return float(np.trace(solve_continuous_lyapunov(closed.T, -(Q + K.T @ K))))


def optimum(A: np.ndarray, B: np.ndarray, weights: tuple[float, float]) -> tuple[np.ndarray, float]:
    """Return the LQ gain K of u = K x with R = 1, eq. (27), shape (2,), and its cost: trace P.

    Args:
        weights: Diagonal of Q.
    """
    P = solve_continuous_are(A, B, np.diag(weights), np.eye(1))
    return -(B.T @ P)[0], float(np.trace(P))


def holding_mass(system: Polytope, gain: AnyArray) -> float:
    """Return the greatest mass [kg] at which a gain is stable at the top speed.

    alpha, eq. (17), is affine in the mass, and the closed loop is stable while alpha < beta |k2|.

    Args:
        gain: K of u = K x, 2 numbers.
    """
    low, high = DESIGN_BOX["plant.mass"]
    speed = DESIGN_BOX["speed"][1]
    (a, b), (c, _) = (corner(system, mass, speed) for mass in (low, high))
    slope = (c[1, 1] - a[1, 1]) / (high - low)
    return float(low + (-gain[1] * b[1, 0] - a[1, 1]) / slope)


def nearest_speed(system: Polytope) -> float:
    """Return the speed [m/s] at which the LQ gain for Q = diag(k1^2, 0) and R = 1 is the published gain.

    It uses that alpha/beta does not depend on the speed, and that omega_2/beta is proportional to it.
    """
    low = DESIGN_BOX["speed"][0]
    A, B = corner(system, DESIGN_BOX["plant.mass"][0], low)
    ratio = A[1, 1] / B[1, 0]
    k = -PUBLISHED_GAIN[1]
    return float(low * ((k - ratio) ** 2 - ratio**2) * B[1, 0] / (2 * K1))


def judge_lmi_claims(system: Polytope, gains: dict[tuple[float, float], np.ndarray]) -> list[JsonObject]:
    """Return the rows that judge the statements, one for each number."""
    (light, heavy), (slow, fast) = DESIGN_BOX["plant.mass"], DESIGN_BOX["speed"]
    rows = [record.computed_row(f"a car with {n} of 60 kg", "mass of the rig", "kg", scaled_mass(n)) for n in (1, 4)]
    names = ("the rig's lower wheel, 2 J2/r2^2", "weight on the rig's wheels at rest")
    rows += [record.computed_row(name, "mass", "kg", mass) for name, mass in zip(names, rig_masses(), strict=True)]
    for weights, gain in gains.items():
        name = f"LMI, Q = diag({weights[0]:.6g}, {weights[1]:g})"
        costs = [cost(*corner(system, mass, fast), gain, weights) for mass in (light, heavy)]
        rows.append(
            record.computed_row(name, "cost at 6.2 kg over that at 5.3 kg, less 1", "1", costs[1] / costs[0] - 1)
        )
        rows.append(record.computed_row(name, "stable up to a mass of", "kg", holding_mass(system, gain)))
    weights = (K1**2, 1.0)
    alone = optimum(*corner(system, light, slow), (K1**2, 0.0))[0]
    rows.append(
        record.computed_row(
            "LQ at 5 km/h alone, Q = diag(11753^2, 0)", "k2", "N m", alone[1], published=PUBLISHED_GAIN[1]
        )
    )
    speed = 3.6 * nearest_speed(system)
    rows.append(record.computed_row("speed whose LQ gain is the published one", "speed", "km/h", speed))
    for name, at in (("5 km/h", slow), ("50 km/h", fast)):
        A, B = corner(system, light, at)
        excess = cost(A, B, PUBLISHED_GAIN, weights) / optimum(A, B, weights)[1] - 1
        rows.append(
            record.computed_row(f"published gain at {name}, Q = diag(11753^2, 1)", "cost above the least", "1", excess)
        )
    return rows
