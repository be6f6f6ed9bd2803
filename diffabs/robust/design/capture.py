"""Capture ellipsoids: x'Sx <= 1 from which a balance under u = clamp(K x) comes to rest, for the nonlinear equations.

    x' = A x + B u + D y(x),   S = P/c,   A'P + PA <= -2 g P  (A of the closed loop)

On x'Px <= c three conditions hold:

- The motor is linear: |K x| <= U, and its current is within the limit.
- The frame does not lie on the ground.
- The rest y of the nonlinear equations is small.

The plant bounds the rest, |y_k| <= Y_k(c), from the extent of each combination of angles and rates on the ellipsoid,
|row x| <= sqrt(c row P^-1 row'). Then, with V = x'Px,

    V' <= -2 V (g - sum_k sqrt((D'PD)_kk) Y_k(c)/sqrt(c))

Y_k falls at least as fast as sqrt(V). If the bracket is positive, V therefore falls to 0 from V <= c.

Of several P the module takes the ellipsoid with the largest volume, and 90 % of its c. That leaves a tenth of g for
rounding: the result is floating point with a margin, not a proof in integers. It holds for the differential equation; a
run integrates this equation numerically.

Source: H. K. Khalil, Nonlinear Systems, 3rd ed., sec. 8.2.
"""

from typing import NamedTuple

import jax
import numpy as np

from diffabs.core.blocks import Direct
from diffabs.core.numerics import spectral_bound
from diffabs.core.pytree import replace
from diffabs.core.types import Params, Part, PyTree
from diffabs.linear.balance_model import BalanceModel
from diffabs.loop.closed_loop import Loop
from diffabs.parts.actuators import VoltageLimit
from diffabs.parts.controllers import BalanceFeedback
from diffabs.parts.stops import Fallen

SAFE_LEVEL_FRACTION = 0.9  # part of the level c that the bound allows
LEVEL_BISECTIONS = 50
MIN_GROWTH_RATE = 1e-6  # 1/s, the smallest growth rate that counts as instability and not as rounding
# Shapes to try: shift as a part of the slowest decay; size of the diagonal that joins K'K/U^2 on the right side of P's
# Lyapunov equation; weight of the arm in that diagonal.
DECAY_FRACTIONS, RIGHT_SIDE_SIZES, ARM_WEIGHT_FRACTIONS = (0.5, 0.9), (1.0, 100.0), (1e-3, 1e-1)


class _ClosedLoops(NamedTuple):
    """Stacked closed loops: the plant, A (n, 6, 6), K/U (n, 1, 6), and rows (n, m, 6).

    The loop is linear where |row x| <= 1 for every row.
    """

    plant: Part
    closed: np.ndarray
    gain: np.ndarray
    limits: np.ndarray


class CaptureEllipsoids(NamedTuple):
    """Capture ellipsoids of n loops.

    Attributes:
        shapes: S, shape (n, 6, 6). Infinite where no ellipsoid is known, so that x'Sx <= 1 holds nowhere.
        unstable: Whether the loop is unstable about upright, shape (n,). Almost no start then comes to rest there.
    """

    shapes: np.ndarray
    unstable: np.ndarray


def capture_ellipsoids(loop: Loop, values: Params) -> CaptureEllipsoids:
    """Return the capture ellipsoids of loops of a balance that differ in `values` by path, each of shape (n, ...)."""
    systems = _build_closed_loops(loop, values)
    ellipsoids = CaptureEllipsoids(np.full_like(systems.closed, np.inf), np.zeros(len(systems.closed), bool))
    finite = np.flatnonzero(np.isfinite(systems.closed).all(axis=(1, 2)))
    if len(finite):
        slowest = -spectral_bound(systems.closed[finite])
        # A pole within rounding of the imaginary axis counts neither as stable nor as unstable.
        ellipsoids.unstable[finite] = slowest < -MIN_GROWTH_RATE
        ellipsoids.shapes[finite] = _largest_ellipsoids(jax.tree.map(lambda x: x[finite], systems), slowest)
    return ellipsoids


def _largest_ellipsoids(systems: _ClosedLoops, slowest: np.ndarray) -> np.ndarray:
    """Return the ellipsoid of largest volume among the tried shapes; inf where the slowest decay is not positive."""
    best = np.full_like(systems.closed, np.inf)
    volume = np.full(len(best), np.inf)
    for decay in DECAY_FRACTIONS:
        for size in RIGHT_SIDE_SIZES:
            for arm in ARM_WEIGHT_FRACTIONS:
                # K'K/U^2 on the right makes the ellipsoid narrow in the direction in which the voltage saturates.
                side = np.diag([1.0, arm, 1.0, 1.0, arm, 1.0]) * size + _square(systems.gain)
                scaled = _scale_to_largest_level(systems, _solve_lyapunov(systems.closed, decay * slowest, side))
                sure = (slowest > 0) & np.isfinite(scaled[:, 0, 0])
                # The volume is proportional to det(S)^(-1/2): the smallest log det S wins.
                log = np.linalg.slogdet(np.where(sure[:, None, None], scaled, np.eye(6)))[1]
                better = sure & (log < volume)
                best[better], volume[better] = scaled[better], log[better]
    return best


def _build_closed_loops(loop: Loop, values: Params) -> _ClosedLoops:
    """Return the closed loops in float64, for a loop of any precision."""
    _check_supported(loop)
    # float64 on the CPU: an accelerator may have no float64.
    with jax.enable_x64(True), jax.default_device(jax.local_devices(backend="cpu")[0]):
        values = {path: np.asarray(column, float) for path, column in values.items()}
        exact = jax.tree.map(lambda x: np.asarray(x, float), loop)
        many = jax.vmap(lambda v: replace(exact, v))(values)
        a, b = jax.device_get(jax.vmap(lambda plant: BalanceModel(plant=plant).matrices())(many.plant))
        many = jax.tree.map(np.asarray, jax.device_get(many))
    gain = many.controller.gain
    limit = many.actuator.high if isinstance(loop.actuator, VoltageLimit) else np.full(len(a), np.inf)
    voltage = (gain / limit[:, None])[:, None]
    # Each limit is a row with |row x| <= 1: voltage, fall angle, and the plant's own limits of its motor.
    lean = (np.eye(6)[:1] / many.stop.angle[:, None])[:, None]
    return _ClosedLoops(
        many.plant, a + b @ gain[:, None], voltage, np.concatenate([voltage, lean, many.plant.limits(gain)], 1)
    )


def _check_supported(loop: Loop) -> None:
    supported = {"controller": BalanceFeedback, "sensor": Direct, "actuator": Direct | VoltageLimit, "stop": Fallen}
    for name, kind in supported.items():
        if not isinstance(getattr(loop, name), kind):
            raise ValueError(f"no ellipsoid is known for the {name} {type(getattr(loop, name)).__name__}")
    if not hasattr(loop.plant, "remainder"):
        raise ValueError(f"no ellipsoid is known for the plant {type(loop.plant).__name__}")


def _square(rows: np.ndarray) -> np.ndarray:
    return np.swapaxes(rows, -1, -2) @ rows


def _solve_lyapunov(a: np.ndarray, shift: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Return P of (A + shift I)'P + P (A + shift I) = -side, shape (n, 6, 6)."""
    eye = np.eye(6)
    moved = np.swapaxes(a + shift[:, None, None] * eye, -1, -2)
    # The Kronecker form of the Lyapunov equation: 36 unknowns for a state of 6, one batched solve.
    operator = np.einsum("nij,kl->nikjl", moved, eye) + np.einsum("ij,nkl->nikjl", eye, moved)
    p = np.linalg.solve(operator.reshape(-1, 36, 36), -side.reshape(-1, 36, 1)).reshape(a.shape)
    return (p + np.swapaxes(p, -1, -2)) / 2


def _scale_to_largest_level(systems: _ClosedLoops, p: np.ndarray) -> np.ndarray:
    """Return S = P/c with the largest c that the bound allows; infinite where P is no Lyapunov matrix."""
    usable = np.linalg.eigvalsh(p)[:, 0] > 0
    p = np.where(usable[:, None, None], p, np.eye(6))
    root = np.linalg.inv(np.linalg.cholesky(p))
    # In the coordinates of P = I the largest eigenvalue of A'P + PA is -2 g.
    falling = root @ (np.swapaxes(systems.closed, -1, -2) @ p + p @ systems.closed) @ np.swapaxes(root, -1, -2)
    decay = -np.linalg.eigvalsh(falling)[:, -1] / 2
    inverse = _square(root)
    reach = np.einsum("nmi,nij,nmj->nm", systems.limits, inverse, systems.limits)
    low, high = np.zeros(len(p)), 1 / reach.max(axis=1)
    # Bisection; the largest level that the linear limits admit is tried first, and low = high ends the search there.
    for tried in [high] + [None] * LEVEL_BISECTIONS:
        level = (low + high) / 2 if tried is None else tried
        admitted = _growth(systems, p, inverse, level) < decay
        low, high = np.where(admitted, level, low), np.where(admitted, high, level)
    usable &= (decay > 0) & (low > 0)
    return np.where(usable[:, None, None], p / np.where(usable, SAFE_LEVEL_FRACTION * low, 1.0)[:, None, None], np.inf)


def _growth(systems: _ClosedLoops, p: np.ndarray, inverse: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the sum over k in V' <= -2 V (g - sum), shape (n,)."""

    def extent(row: PyTree) -> np.ndarray:
        """Return the largest |row x| on the ellipsoid x'Px <= level."""
        row = np.broadcast_to(row, (len(p), 6))
        return np.sqrt(level * np.einsum("ni,nij,nj->n", row, inverse, row))

    directions, amounts = systems.plant.remainder(systems.closed, extent)
    weights = np.sqrt(np.einsum("nik,nij,njk->nk", directions, p, directions))
    return (weights * amounts).sum(axis=1) / np.sqrt(level)
