"""The inequalities of a design, for V = x'X^-1 x and F = K X: each matrix must be positive semidefinite.

Every function is affine in X, F, Z, g and takes stacks of them. `flow` is A X + B F, `drift` dX/dt along a schedule.
In discrete time x+ = A x + B u, and a Schur complement with X takes the place of the derivative.

Sources: Maeda and Sugiura, eqs. (30), (32); M. Chilali and P. Gahinet, H-infinity design with pole placement
constraints (1996); S. Boyd et al., Linear Matrix Inequalities in System and Control Theory (1994).
"""

from typing import Any

import numpy as np

from diffabs.design.sdp.solver import he, symmetric_from_blocks

Matrix = Any  # (r, c), or a stack of them


def cost_lmi(
    x: Matrix, flow: Matrix, drift: Matrix, q_root: np.ndarray, f: Matrix, even: np.ndarray, *, discrete: bool
) -> np.ndarray:
    """dV/dt + x'Qx + u'u <= 0, eq. (30), for R = I; Q = q_root' q_root. The first rows are multiplied by `even`."""
    n, m = x.shape[-1], f.shape[-2]
    if discrete:
        rows = [[even.T @ x @ even], [flow @ even, x], [q_root @ x @ even, None, np.eye(n)]]
        return symmetric_from_blocks([*rows, [f @ even, None, None, np.eye(m)]])
    return symmetric_from_blocks(
        [[even.T @ (drift - he(flow)) @ even], [q_root @ x @ even, np.eye(n)], [f @ even, None, np.eye(m)]]
    )


def trace_lmi(x: Matrix, z: Matrix) -> np.ndarray:
    """Z >= X^-1, eq. (32)."""
    return symmetric_from_blocks([[z], [np.eye(x.shape[-1]), x]])


def decay_lmi(x: Matrix, flow: Matrix, drift: Matrix, rate: float, *, discrete: bool) -> np.ndarray:
    """dV/dt + 2 rate V <= 0; in discrete time V+ <= exp(-2 rate) V, with the rate per step."""
    if discrete:
        return symmetric_from_blocks([[np.exp(-2 * rate) * x], [flow, x]])
    return drift - he(flow) - 2 * rate * x


def damping_lmi(flow: Matrix, cot: float) -> np.ndarray:
    """Poles where |Im s| <= -Re s/cot: damping cot/sqrt(1 + cot^2)."""
    skew = cot * (flow - np.swapaxes(flow, -1, -2))
    return -symmetric_from_blocks([[he(flow)], [-skew, he(flow)]])


def l2_gain_lmi(
    x: Matrix, flow: Matrix, drift: Matrix, z: Matrix, e: np.ndarray, g: Matrix, s: Matrix, *, discrete: bool
) -> np.ndarray:
    """s dV/dt + |z|^2 - g |w|^2 <= 0, with z = (C X + D F) X^-1 x and E the input of w; affine in (X, F, s) for a given
    g, and in (X, F, g) for s = 1. The multiplier s keeps the gain's V from having the size of the cost's."""
    limit, one = s * g * np.eye(e.shape[1]), s * np.eye(z.shape[-2])
    if discrete:
        return symmetric_from_blocks([[x], [None, limit], [flow, s * e, x], [z, None, None, one]])
    return symmetric_from_blocks([[drift - he(flow)], [-s * e.T, limit], [z, None, one]])


def start_lmi(x: Matrix, point: np.ndarray, level: float) -> np.ndarray:
    """V(point) <= level."""
    return symmetric_from_blocks([[np.array([[level]])], [point[:, None], x]])


def input_limit_lmi(x: Matrix, row: Matrix, limit: float, level: float) -> np.ndarray:
    """|u_j| <= limit while V <= level, u_j = row X^-1 x."""
    return symmetric_from_blocks([[np.array([[limit**2 / level]])], [np.swapaxes(row, -1, -2), x]])
