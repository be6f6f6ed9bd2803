"""The inequalities of a design, for V = x'X^-1 x and F = K X: each matrix must be positive semidefinite.

Every function is affine in X, F, Z, g and takes stacks of them. `flow` is A X + B F, `drift` dX/dt along a schedule. In
discrete time x+ = A x + B u, and a Schur complement with X takes the place of the derivative.

Sources: Maeda and Sugiura, eqs. (30), (32); M. Chilali and P. Gahinet, H-infinity design with pole placement
constraints (1996); S. Boyd et al., Linear Matrix Inequalities in System and Control Theory (1994).
"""

from typing import Any

import numpy as np

from diffabs.design.proof.exact import he
from diffabs.design.sdp.solver import symmetric_from_blocks

Matrix = Any  # (r, c), or a stack of them


def cost_lmi(
    x: Matrix, flow: Matrix, drift: Matrix, q_root: np.ndarray, f: Matrix, even: np.ndarray, *, discrete: bool
) -> np.ndarray:
    """Return the matrix of dV/dt + x'Qx + u'u <= 0, for R = I.

    A congruence by `even` scales the first rows and columns.

    Args:
        x: X, shape (..., n, n).
        flow: A X + B F, shape (..., n, n).
        drift: dX/dt, shape (..., n, n); not used in discrete time.
        q_root: Root of the weight, Q = q_root' q_root.
        f: F, shape (..., m, n).
        even: Congruence, shape (n, n).
        discrete: Whether the system is in discrete time.

    Source: Maeda and Sugiura, eq. (30).
    """
    n, m = x.shape[-1], f.shape[-2]
    if discrete:
        rows = [[even.T @ x @ even], [flow @ even, x], [q_root @ x @ even, None, np.eye(n)]]
        return symmetric_from_blocks([*rows, [f @ even, None, None, np.eye(m)]])
    return symmetric_from_blocks(
        [[even.T @ (drift - he(flow)) @ even], [q_root @ x @ even, np.eye(n)], [f @ even, None, np.eye(m)]]
    )


def trace_lmi(x: Matrix, z: Matrix) -> np.ndarray:
    """Return the matrix of Z >= X^-1.

    Args:
        x: X, shape (..., n, n).
        z: Z, shape (..., n, n).

    Source: Maeda and Sugiura, eq. (32).
    """
    return symmetric_from_blocks([[z], [np.eye(x.shape[-1]), x]])


def decay_lmi(x: Matrix, flow: Matrix, drift: Matrix, rate: float, *, discrete: bool) -> np.ndarray:
    """Return the matrix of dV/dt + 2 rate V <= 0, or in discrete time of V+ <= exp(-2 rate) V.

    Args:
        x: X, shape (..., n, n).
        flow: A X + B F, shape (..., n, n).
        drift: dX/dt, shape (..., n, n); not used in discrete time.
        rate: Decay rate per unit of time; in discrete time per step.
        discrete: Whether the system is in discrete time.
    """
    if discrete:
        return symmetric_from_blocks([[np.exp(-2 * rate) * x], [flow, x]])
    # With X = P^-1 the inequality is that of P, multiplied by X from both sides; d(X^-1)/dt gives drift its sign.
    return drift - he(flow) - 2 * rate * x


def damping_lmi(flow: Matrix, cot: float) -> np.ndarray:
    """Return the matrix of the pole region |Im s| <= -Re s/cot, which has the damping cot/sqrt(1 + cot^2).

    Args:
        flow: A X + B F, shape (..., n, n).
        cot: Cotangent of the half-angle of the cone about the negative real axis.
    """
    skew = cot * (flow - np.swapaxes(flow, -1, -2))
    return -symmetric_from_blocks([[he(flow)], [-skew, he(flow)]])


def l2_gain_lmi(
    x: Matrix, flow: Matrix, drift: Matrix, z: Matrix, e: np.ndarray, g: Matrix, s: Matrix, *, discrete: bool
) -> np.ndarray:
    """Return the matrix of s dV/dt + |z|^2 - g |w|^2 <= 0, where z = (C X + D F) X^-1 x.

    It is affine in (X, F, s) for a fixed g, and in (X, F, g) for s = 1. The multiplier s lets V serve the cost and the
    gain at once, although their natural sizes differ.

    Args:
        x: X, shape (..., n, n).
        flow: A X + B F, shape (..., n, n).
        drift: dX/dt, shape (..., n, n); not used in discrete time.
        z: C X + D F, shape (..., z, n).
        e: Input matrix E of w, shape (n, w).
        g: Squared gain.
        s: Multiplier of V.
        discrete: Whether the system is in discrete time.
    """
    # Divided by s and with w in units of s, the inequality is linear in s: its blocks are s E, s g I and s I.
    limit, one = s * g * np.eye(e.shape[1]), s * np.eye(z.shape[-2])
    if discrete:
        return symmetric_from_blocks([[x], [None, limit], [flow, s * e, x], [z, None, None, one]])
    return symmetric_from_blocks([[drift - he(flow)], [-s * e.T, limit], [z, None, one]])


def start_lmi(x: Matrix, point: np.ndarray, level: float) -> np.ndarray:
    """Return the matrix of V(point) <= level.

    Args:
        x: X, shape (..., n, n).
        point: Start, shape (n,).
        level: Level of V.
    """
    return symmetric_from_blocks([[np.array([[level]])], [point[:, None], x]])


def input_limit_lmi(x: Matrix, row: Matrix, limit: float, level: float) -> np.ndarray:
    """Return the matrix of |u_j| <= limit while V <= level, with u_j = row X^-1 x.

    Args:
        x: X, shape (..., n, n).
        row: Row of F for the input, shape (..., 1, n).
        limit: Limit of the input.
        level: Level of V.
    """
    return symmetric_from_blocks([[np.array([[limit**2 / level]])], [np.swapaxes(row, -1, -2), x]])
