"""The structured singular value mu of a complex matrix, bounded from both sides.

    1/mu = least s(Delta) with det(I - Delta M) = 0,   Delta = diag(Delta_1, ..., Delta_k) of given blocks

**Upper bound** (Fan, Tits and Doyle, IEEE Trans. Automat. Control 36 (1991)): with D = diag(d_i I), d_i > 0, and G
diagonal, real and zero in complex blocks,

    mu^2 <= least t with t D - M* D M - j (G M - M* G) >= 0

The matrix depends on D and G linearly, so for each t the analytic centre of all D and G is found by Newton's method.
Then t moves towards the largest eigenvalue there (method of centres: S. Boyd and L. El Ghaoui, Linear Algebra Appl. 188
(1993)). The inverse of the matrix at the last centre is the dual solution, which gives the derivative in M.

**Lower bound**, for complex blocks: the power iteration of A. Packard and J. Doyle, Automatica 29 (1993). It ends on a
Delta, whose spectral radius of Delta M is a bound in any case.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once
from diffabs.core.types import AnyArray, Array, Scalar

CENTRES, NEWTON_STEPS = 60, 6  # levels t, and Newton steps to the centre of each
FIRST_LEVEL = 1.5  # first t, over the largest eigenvalue without scalings
LEVEL_SHARE = 0.05  # of the way from the largest eigenvalue at the centre to the old t that the new t keeps
LEAST_SQUARE = 1e-12  # mu^2 that counts as zero, relative to the largest singular value squared
POWER_STEPS, POWER_STARTS = 200, 5


class Mu(NamedTuple):
    """Bounds of mu.

    Attributes:
        upper: Upper bound, differentiable in the matrix.
        lower: Lower bound, for complex blocks; NaN with a real block, which the iteration does not treat.
    """

    upper: Scalar
    lower: Scalar


class _Scalings(NamedTuple):
    """ln d of each block but the last, whose d is 1, and g of each real block."""

    logs: Array
    g: Array


def structured_singular_value(matrix: AnyArray, blocks: Sequence[int], real: Sequence[bool] = ()) -> Mu:
    """Return bounds of mu of a square matrix for a structure of full blocks on the diagonal.

    The upper bound is differentiable; both work under `jit` and `vmap`.

    Args:
        matrix: Matrix (n, n), real or complex.
        blocks: Size of each block; their sum is n.
        real: Whether each block is a real number instead of a complex matrix; empty for none. A real block has size 1.

    Raises:
        ValueError: The blocks do not fit the matrix, or a real block is larger than 1.

    Examples:
        Skogestad and Postlethwaite, Multivariable Feedback Control (2005), example 8.5, as a full block and diagonal:

        >>> import numpy as np
        >>> from diffabs.linear.responses import structured_singular_value
        >>> M = np.array([[2.0, 2.0], [-1.0, -1.0]])
        >>> [f"{structured_singular_value(M, blocks).upper:.4f}" for blocks in ([2], [1, 1])]
        ['3.1623', '3.0000']
    """
    sizes, is_real = np.array(blocks, int), np.array(real if len(real) else [False] * len(blocks), bool)
    if np.ndim(matrix) != 2 or np.shape(matrix) != (sizes.sum(),) * 2 or (sizes < 1).any():
        raise ValueError(f"blocks = {list(blocks)} do not fit a matrix of the shape {np.shape(matrix)}")
    if len(is_real) != len(sizes) or (is_real & (sizes > 1)).any():
        raise ValueError(f"real = {list(real)}: one truth value for each block is needed, and a real block has size 1")
    matrix = jnp.asarray(matrix, jnp.result_type(matrix, 1j))
    return _bound_both(matrix, blocks=tuple(sizes.tolist()), real=tuple(is_real.tolist()))


@compile_once(("blocks", "real"), SAME_RESULT_OPTIONS)
def _bound_both(matrix: Array, *, blocks: tuple[int, ...], real: tuple[bool, ...]) -> Mu:
    lower = jnp.nan if any(real) else _bound_below(matrix, np.array(blocks))
    return Mu(_bound_above(matrix, np.array(blocks), np.array(real)), lower)


def _bound_above(matrix: Array, sizes: np.ndarray, is_real: np.ndarray) -> Scalar:
    """Return the upper bound with its derivative from the dual solution."""
    block_of = np.repeat(np.arange(len(sizes)), sizes)
    real_places = np.flatnonzero(is_real[block_of])

    def scalings(x: _Scalings) -> tuple[Array, Array]:
        """Return the diagonals of D and G."""
        d = jnp.exp(jnp.append(x.logs, 0.0))[block_of]
        return d, jnp.zeros(len(matrix)).at[real_places].set(x.g)

    def shape(m: Array, x: _Scalings) -> Array:
        """Return M* D M + j (G M - M* G)."""
        d, g = scalings(x)
        product = g[:, None] * m
        return m.conj().T @ (d[:, None] * m) + 1j * (product - product.conj().T)

    def level(x: _Scalings) -> Array:
        """Return the least t for given scalings: the largest eigenvalue of D^-1/2 shape D^-1/2."""
        root = jnp.sqrt(scalings(x)[0])
        return jnp.linalg.eigvalsh(shape(frozen, x) / (root[:, None] * root))[-1]

    def barrier(x: _Scalings, t: Array) -> Array:
        d = scalings(x)[0]
        slack = jnp.diag(t * d) - shape(frozen, x)
        # The determinant relative to that of D does not depend on the scale of D.
        return -jnp.linalg.slogdet(slack)[1] + jnp.sum(jnp.log(d))

    def centre(x: _Scalings, t: Array) -> _Scalings:
        if not x.logs.size + x.g.size:  # a single complex block has no scalings
            return x

        def step(_: object, x: _Scalings) -> _Scalings:
            flat, unravel = ravel_pytree(x)

            def value(z: Array) -> Array:
                return barrier(unravel(z), t)

            gradient, hessian = jax.grad(value)(flat), jax.hessian(value)(flat)
            # The barrier is convex in D and G, not in ln d: the absolute eigenvalues keep the step a descent.
            curvatures, axes = jnp.linalg.eigh(hessian)
            move = -axes @ ((axes.T @ gradient) / jnp.maximum(jnp.abs(curvatures), 1e-9))
            move = move / jnp.maximum(1.0, jnp.linalg.norm(move))
            trials = flat + move * (0.5 ** jnp.arange(8.0))[:, None]
            levels, barriers = jax.vmap(lambda z: (level(unravel(z)), value(z)))(trials)
            worth = jnp.where(levels < t, barriers, jnp.inf)
            best = jnp.argmin(worth)
            return unravel(jnp.where(worth[best] < value(flat), trials[best], flat))

        return jax.lax.fori_loop(0, NEWTON_STEPS, step, x)

    frozen = jax.lax.stop_gradient(matrix)
    start = _Scalings(jnp.zeros(len(sizes) - 1), jnp.zeros(len(real_places)))

    def lower(_: object, state: tuple[_Scalings, Array]) -> tuple[_Scalings, Array]:
        x, t = state
        x = centre(x, t)
        bound = level(x)
        return x, bound + LEVEL_SHARE * (t - bound)

    first = jnp.maximum(level(start), 0.0)
    scale = jnp.maximum(jnp.linalg.norm(frozen, 2) ** 2, 1e-30)
    x, t = jax.lax.fori_loop(0, CENTRES, lower, (start, FIRST_LEVEL * first + 1e-3 * scale))
    x = jax.lax.stop_gradient(centre(x, t))
    d = scalings(x)[0]
    dual = jnp.linalg.inv(jnp.diag(t * d) - shape(frozen, x))
    weight = jax.lax.stop_gradient(dual / jnp.sum(jnp.diagonal(dual).real * d))
    # The value is the level at the scalings; its derivative is that of the dual form, whose own value cancels.
    form = jnp.sum(weight.T * shape(matrix, x)).real
    square = jax.lax.stop_gradient(level(x) - form) + form
    vanishes = square <= LEAST_SQUARE * scale
    return jnp.where(vanishes, 0.0, jnp.sqrt(jnp.where(vanishes, 1.0, square)))


def _bound_below(matrix: Array, sizes: np.ndarray) -> Scalar:
    """Return the largest spectral radius of Delta M at the ends of power iterations from several starts."""
    matrix = jax.lax.stop_gradient(matrix)
    block_of = np.repeat(np.arange(len(sizes)), sizes)

    def norms(v: Array) -> Array:
        """Return the norm of each block of a vector, at each of its entries."""
        return jnp.sqrt(jnp.zeros(len(sizes)).at[block_of].add(jnp.abs(v) ** 2) + 1e-300)[block_of]

    def iterate(_: object, state: tuple[Array, Array]) -> tuple[Array, Array]:
        b, w = state
        a = matrix @ b
        a = a / jnp.linalg.norm(a)
        z = norms(w) / norms(a) * a
        w = matrix.conj().T @ z
        w = w / jnp.linalg.norm(w)
        return norms(a) / norms(w) * w, w

    def bound(key: Array) -> Array:
        parts = jax.random.normal(key, (2, 2, len(matrix)))
        b, w = parts[0] + 1j * parts[1]
        b, w = jax.lax.fori_loop(0, POWER_STEPS, iterate, (b / jnp.linalg.norm(b), w / jnp.linalg.norm(w)))
        a = matrix @ b
        # Delta of norm 1 that maps each block of a to the direction of that of b.
        same = block_of[:, None] == block_of
        delta = jnp.where(same, (b / norms(b))[:, None] * (a / norms(a)).conj(), 0.0)
        return jnp.max(jnp.abs(jnp.linalg.eigvals(delta @ matrix)))

    starts = jax.vmap(bound)(jax.random.split(jax.random.key(0), POWER_STARTS))
    return jnp.max(jnp.where(jnp.isfinite(starts), starts, 0.0))
