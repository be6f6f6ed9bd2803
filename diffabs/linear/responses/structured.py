"""The structured singular value mu of a complex matrix, bounded from both sides.

    1/mu = least s(Delta) with det(I - Delta M) = 0,   Delta = diag(Delta_1, ..., Delta_k) of given blocks

**Upper bound** (Fan, Tits and Doyle, IEEE Trans. Automat. Control 36 (1991)): with D = diag(d_i I), d_i > 0, and G
diagonal, real and zero in complex blocks,

    mu^2 <= least t with t D - M* D M - j (G M - M* G) >= 0

The matrix depends on D and G linearly, so for each t the analytic centre of all D and G is found by Newton's method.
They are a cone; a term of their size makes the centre finite. Then t moves towards the largest eigenvalue there (method
of centres: S. Boyd and L. El Ghaoui, Linear Algebra Appl. 188 (1993)). The inverse of the matrix at the last centre is
the dual solution, which gives the derivative in M.

**Lower bound**: ascents over Delta, from several starts. Each step takes the Delta of norm 1 that makes the linearised
eigenvalue of Delta M greatest while it stays real, as the fixed points of the power iteration of P. Young and J. Doyle
(Proc. 29th IEEE Conf. Decision and Control, 1990) do. Any Delta with a real eigenvalue of Delta M proves a bound.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once
from diffabs.core.types import AnyArray, Array, Scalar

BALANCE_SWEEPS, LEAST_COUPLING = 20, 1e-20  # before both bounds; the square of a coupling, relative
CENTRES, NEWTON_STEPS = 60, 6  # levels t, and Newton steps to the centre of each
TRIED_LENGTHS = 3  # of each Newton step, each twice the one before
HESSIAN_SHIFT = 1e-13  # of a Hessian with a unit diagonal
SLACK_POWER = 0.7  # power of the machine precision: t over the largest eigenvalue in the end, relative
FIRST_LEVEL = 1.5  # first t, over the largest eigenvalue without scalings
LEVEL_SHARE = 0.2  # of the way from the largest eigenvalue at the centre to the old t that the new t keeps
LEAST_SQUARE = 1e-12  # mu^2 that counts as zero, relative to the largest singular value squared
ASCENT_STEPS, ASCENT_STARTS = 30, 10  # of the lower bound
ANGLE_HALVINGS, STEEPEST = 50, 1.5707  # of the angle whose tangent is the multiplier, and its end [rad]
OPEN_SIGN = 1e-6  # relative slope below which the multiplier leaves the sign of a real number open
MADE_REAL, REAL_STEPS = 3, 8  # Deltas of each ascent from which Newton steps go to a real eigenvalue: start and best
GREATEST_PENALTY = 3.0  # decades of the weight of an eigenvalue's distance from the real axis
REAL_ROUNDINGS = 1e4  # roundings by which the angle of a real eigenvalue may miss zero


class Mu(NamedTuple):
    """Bounds of mu.

    Attributes:
        upper: Upper bound, differentiable in the matrix.
        lower: Lower bound: the size of a perturbation that was found proves it, to rounding. 0 if none was found.
    """

    upper: Scalar
    lower: Scalar


class _Scalings(NamedTuple):
    """d of each block, and g of each real block."""

    d: Array
    g: Array


def structured_singular_value(matrix: AnyArray, blocks: Sequence[int], real: Sequence[bool] = ()) -> Mu:
    """Return bounds of mu of a square matrix for a structure of full blocks on the diagonal.

    The upper bound is differentiable; both work under `jit` and `vmap`. With real blocks mu may jump in the matrix, and
    both bounds may be far from it. The upper bound is mu for up to three complex blocks, or one of each kind.

    Args:
        matrix: Matrix (n, n), real or complex; with a NaN both bounds are NaN.
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

        Two real numbers with det(I - Delta M) = 1 - 2 d1 + d2; both are 1/3 with opposite signs:

        >>> mu = structured_singular_value(M, [1, 1], [True, True])
        >>> print(f"{mu.lower:.4f} <= mu <= {mu.upper:.4f}")
        3.0000 <= mu <= 3.0000
    """
    matrix = jnp.asarray(matrix)
    sizes, is_real = np.array(blocks, int), np.array(real if len(real) else [False] * len(blocks), bool)
    if np.ndim(matrix) != 2 or np.shape(matrix) != (sizes.sum(),) * 2 or (sizes < 1).any():
        raise ValueError(f"blocks = {list(blocks)} do not fit a matrix of the shape {np.shape(matrix)}")
    if len(is_real) != len(sizes) or (is_real & (sizes > 1)).any():
        raise ValueError(f"real = {list(real)}: one truth value for each block is needed, and a real block has size 1")
    matrix = matrix.astype(jnp.result_type(matrix, 1j))
    return _bound_both(matrix, blocks=tuple(sizes.tolist()), real=tuple(is_real.tolist()))


@compile_once(("blocks", "real"), SAME_RESULT_OPTIONS)
def _bound_both(matrix: Array, *, blocks: tuple[int, ...], real: tuple[bool, ...]) -> Mu:
    sizes, is_real = np.array(blocks), np.array(real)
    matrix = _balance(matrix, sizes)
    return Mu(_bound_above(matrix, sizes, is_real), _bound_below(matrix, sizes, is_real))


def _balance(matrix: Array, sizes: np.ndarray) -> Array:
    """Return D M D^-1, which has the same mu, with equal norms of the rows and columns of blocks (Osborne, 1960)."""
    block_of, count = np.repeat(np.arange(len(sizes)), sizes), len(sizes)
    sums = jax.ops.segment_sum(jnp.abs(jax.lax.stop_gradient(matrix)) ** 2, block_of, count)
    squares = jax.ops.segment_sum(sums.T, block_of, count).T * (1 - np.eye(count))
    squares = squares + LEAST_COUPLING * jnp.max(squares)  # else the scalings of a triangular matrix have no end

    def even_out(step: Scalar, logs: Array) -> Array:
        """Even out the row and the column of one block; `logs` are ln d."""
        i = step % count
        row = jnp.sum(squares[i] * jnp.exp(2 * (logs[i] - logs)))
        column = jnp.sum(squares[:, i] * jnp.exp(2 * (logs - logs[i])))
        even = (row > 0) & (column > 0)
        return logs.at[i].add(jnp.where(even, 0.25 * jnp.log(jnp.where(even, column / row, 1.0)), 0.0))

    logs = jax.lax.fori_loop(0, BALANCE_SWEEPS * count, even_out, jnp.zeros(count))[block_of]
    return matrix * jnp.exp(logs[:, None] - logs)


def _bound_above(matrix: Array, sizes: np.ndarray, is_real: np.ndarray) -> Scalar:
    """Return the upper bound with its derivative from the dual solution."""
    block_of = np.repeat(np.arange(len(sizes)), sizes)
    members = np.array([np.diag(block_of == i) for i in range(len(sizes))], float)
    reals = members[is_real]
    scale = jnp.maximum(jnp.linalg.norm(jax.lax.stop_gradient(matrix), 2), jnp.finfo(matrix.real.dtype).tiny)
    frozen = jax.lax.stop_gradient(matrix) / scale
    squares = frozen.conj().T @ members @ frozen
    turns = 1j * (reals @ frozen - frozen.conj().T @ reals)

    def shape(m: Array, x: _Scalings) -> Array:
        """Return M* D M + j (G M - M* G)."""
        product = (x.g @ reals.diagonal(axis1=1, axis2=2))[:, None] * m
        return m.conj().T @ (x.d[block_of][:, None] * m) + 1j * (product - product.conj().T)

    def level(x: _Scalings) -> Array:
        """Return the least t for given scalings: the largest eigenvalue of D^-1/2 shape D^-1/2."""
        root = jnp.sqrt(x.d[block_of])
        return jnp.linalg.eigvalsh(shape(frozen, x) / (root[:, None] * root))[-1]

    def slack(x: _Scalings, t: Array) -> Array:
        return t * jnp.diag(x.d[block_of]) - shape(frozen, x)

    def barrier(x: _Scalings, t: Array) -> Array:
        """Return -ln det slack - sum ln d + tr slack + sum d; infinite outside of the cone."""
        rest = slack(x, t)
        values = jnp.linalg.eigvalsh(rest)
        inside = (values[0] > 0) & (jnp.min(x.d) > 0)
        logs = jnp.sum(jnp.log(jnp.where(inside, values, 1.0))) + jnp.sum(jnp.log(jnp.where(inside, x.d, 1.0)))
        return jnp.where(inside, jnp.trace(rest).real + jnp.sum(x.d) - logs, jnp.inf)

    def centre(x: _Scalings, t: Array) -> _Scalings:
        def step(_: object, x: _Scalings) -> _Scalings:
            slopes = jnp.concatenate([x.d[:, None, None] * (t * members - squares), -turns])  # in ln d and g
            relative = jnp.linalg.inv(slack(x, t)) @ slopes
            traces = jnp.trace(slopes - relative, axis1=1, axis2=2).real
            gradient = traces + jnp.pad(x.d - 1.0, (0, len(x.g)))
            curvature = jnp.pad(jnp.ones(len(x.d)), (0, len(x.g)))  # of -ln d
            hessian = jnp.einsum("iab,jba->ij", relative, relative).real + jnp.diag(curvature)
            unit = jnp.diagonal(hessian) ** -0.5
            hessian = hessian * unit[:, None] * unit + HESSIAN_SHIFT * jnp.eye(len(unit))
            move = -unit * jnp.linalg.solve(hessian, unit * gradient)
            # A self-concordant barrier falls at 1/(1 + decrement), and stays inside.
            decrement = jnp.sqrt(jnp.maximum(-gradient @ move, 0.0))

            def step_by(length: Array) -> _Scalings:
                return _Scalings(x.d * (1 + length * move[: len(x.d)]), x.g + length * move[len(x.d) :])

            lengths = 2.0 ** jnp.arange(TRIED_LENGTHS) / (1 + decrement)
            worth = jax.vmap(lambda length: barrier(step_by(length), t))(lengths)
            best = jnp.argmin(jnp.where(jnp.isnan(worth), jnp.inf, worth))
            better = worth[best] < barrier(x, t)
            return jax.tree.map(lambda new, old: jnp.where(better, new, old), step_by(lengths[best]), x)

        return jax.lax.fori_loop(0, NEWTON_STEPS, step, x)

    def lower(_: object, state: tuple[_Scalings, Array]) -> tuple[_Scalings, Array]:
        x, t = state
        x = centre(x, t)
        bound = jnp.maximum(level(x), 0.1 * LEAST_SQUARE)
        # At t = bound the matrix is singular and has no dual solution.
        return x, bound + jnp.maximum(LEVEL_SHARE * (t - bound), jnp.finfo(t.dtype).eps ** SLACK_POWER * bound)

    start = _Scalings(jnp.ones(len(sizes)), jnp.zeros(len(reals)))
    x, t = jax.lax.fori_loop(0, CENTRES, lower, (start, FIRST_LEVEL * jnp.maximum(level(start), 0.0) + 1e-3))
    x = jax.lax.stop_gradient(centre(x, t))
    dual = jnp.linalg.inv(slack(x, t))
    weight = jax.lax.stop_gradient(dual / jnp.sum(jnp.diagonal(dual).real * x.d[block_of]))
    # The value is the level at the scalings; its derivative is that of the dual form, whose own value cancels.
    form = jnp.sum(weight.T * shape(matrix / scale, x)).real
    square = jax.lax.stop_gradient(level(x) - form) + form
    vanishes = square <= LEAST_SQUARE
    return jnp.where(vanishes, 0.0, scale * jnp.sqrt(jnp.where(vanishes, 1.0, square)))


class _Perturbation(NamedTuple):
    """A Delta of the structure with norm 1: q (n,) of the real blocks, unit vectors u and v (n,) of the complex ones.

    A complex block is u v*; entries of the other kind of block play no part.
    """

    q: Array
    u: Array
    v: Array


class _Eigenvalue(NamedTuple):
    """An eigenvalue e of Delta M with M x and the left eigenvector y of y x = 1, so that de = y dDelta M x."""

    value: Array
    image: Array
    row: Array


def _bound_below(matrix: Array, sizes: np.ndarray, is_real: np.ndarray) -> Scalar:
    """Return the greatest real eigenvalue of Delta M that ascents over Delta from several starts reach; 0 without one.

    If e is a real eigenvalue of Delta M, Delta/e makes I - Delta M/e singular: mu >= |e|/s(Delta), whatever found it.
    """
    matrix = jax.lax.stop_gradient(matrix)
    block_of = np.repeat(np.arange(len(sizes)), sizes)
    same, in_real = block_of[:, None] == block_of, is_real[block_of]
    first_of_complex = np.searchsorted(block_of, np.flatnonzero(~is_real))
    rounding = REAL_ROUNDINGS * jnp.finfo(matrix.real.dtype).eps

    def norms(v: Array) -> Array:
        """Return the norm of each block of a vector, at each of its entries."""
        return jnp.sqrt(jnp.zeros(len(sizes)).at[block_of].add(jnp.abs(v) ** 2) + 1e-300)[block_of]

    def product(delta: _Perturbation) -> Array:
        blocks = jnp.where(same & ~in_real, delta.u[:, None] * delta.v.conj(), jnp.diag(delta.q * in_real))
        return blocks @ matrix

    def rightmost(delta: _Perturbation, penalty: Array) -> _Eigenvalue:
        """Return an eigenvalue that is large and near the positive real axis."""
        values, vectors = jnp.linalg.eig(product(delta))
        i = jnp.argmax(values.real - penalty * jnp.abs(values.imag))
        return _Eigenvalue(values[i], matrix @ vectors[:, i], jnp.linalg.inv(vectors)[i])

    def ascend(penalty: Array, delta: _Perturbation, _: None) -> tuple[_Perturbation, tuple[_Perturbation, Array]]:
        """Return the Delta of norm 1 with the greatest linearised eigenvalue that is real; tan(a) is the multiplier."""
        at = rightmost(delta, penalty)
        slopes = jnp.where(in_real, at.row * at.image, 0.0)  # of the eigenvalue, in the entries of q
        row, image = norms(at.row), norms(at.image)
        complex_share = jnp.sum((row * image)[first_of_complex])

        def halve(_: object, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            # The dual function sum |Re s + tan(a) Im s| + share/cos(a) is convex in tan(a); this is its slope's sign.
            low, high = ends
            middle = 0.5 * (low + high)
            signs = jnp.sign(slopes.real + jnp.tan(middle) * slopes.imag)
            rises = jnp.sum(signs * slopes.imag) + complex_share * jnp.sin(middle) > 0
            return jnp.where(rises, low, middle), jnp.where(rises, middle, high)

        ends = (jnp.asarray(-STEEPEST), jnp.asarray(STEEPEST))
        low, high = jax.lax.fori_loop(0, ANGLE_HALVINGS, halve, ends)
        angle = 0.5 * (low + high)
        along = slopes.real + jnp.tan(angle) * slopes.imag
        q, turn = jnp.sign(along), jnp.exp(1j * angle)
        # A number whose sign the multiplier leaves open makes the eigenvalue real.
        doubts = jnp.where(in_real & (slopes.imag != 0), jnp.abs(along) / (jnp.abs(slopes) + 1e-300), jnp.inf)
        free = jnp.arange(len(q)) == jnp.argmin(doubts)
        rest = jnp.sum(jnp.where(free, 0.0, slopes * q)) + complex_share * turn
        open_value = jnp.clip(-rest.imag / jnp.where(free & (slopes.imag != 0), slopes.imag, 1.0), -1.0, 1.0)
        q = jnp.where(free & (doubts < OPEN_SIGN), open_value, q)
        better = _Perturbation(q, turn * at.row.conj() / row, at.image / image)
        better = jax.tree.map(lambda new, old: jnp.where(jnp.isfinite(new), new, old), better, delta)
        return better, (delta, at.value.real - penalty * jnp.abs(at.value.imag))

    def make_real(penalty: Array, delta: _Perturbation) -> _Perturbation:
        """Return Delta after a Newton step of least norm to a real eigenvalue."""
        at = rightmost(delta, penalty)
        slopes = jnp.where(in_real, (at.row * at.image).imag, 0.0)
        turning = (at.value - jnp.sum(jnp.where(in_real, at.row * at.image * delta.q, 0.0))).real
        square = jnp.sum(slopes**2) + turning**2
        # The slopes of an eigenvalue that is real may be rounding, and a step along them would be any number.
        moves = (jnp.abs(at.value.imag) > 0.01 * rounding * jnp.abs(at.value)) & (square > 0)
        step = jnp.where(moves, -at.value.imag / jnp.where(moves, square, 1.0), 0.0)
        return _Perturbation(delta.q + step * slopes, delta.u * jnp.exp(1j * step * turning), delta.v)

    def bound(key: Array) -> Array:
        keys = jax.random.split(key, 3)
        # Real blocks cannot turn an eigenvalue to the real axis: a large one far from it may hide a smaller one on it.
        penalty = 10.0 ** jax.random.uniform(keys[2], maxval=GREATEST_PENALTY if is_real.all() else 0.0)
        q = jax.random.uniform(keys[0], (len(matrix),), minval=-1.0, maxval=1.0)
        u, v = (parts[0] + 1j * parts[1] for parts in jax.random.normal(keys[1], (2, 2, len(matrix))))
        start = _Perturbation(q, u / norms(u), v / norms(v))
        _, (path, nearness) = jax.lax.scan(partial(ascend, penalty), start, None, length=ASCENT_STEPS)
        nearness = jnp.where(jnp.isfinite(nearness), nearness, -jnp.inf).at[0].set(jnp.inf)
        best = jax.lax.top_k(nearness, MADE_REAL)[1]
        return jnp.max(jax.vmap(lambda i: measure(penalty, jax.tree.map(lambda x: x[i], path)))(best))

    def measure(penalty: Array, delta: _Perturbation) -> Array:
        delta = jax.lax.fori_loop(0, REAL_STEPS, lambda _, x: make_real(penalty, x), delta)
        values = jnp.linalg.eigvals(product(delta))
        size = jnp.maximum(jnp.max(jnp.abs(delta.q) * in_real), 0.0 if is_real.all() else 1.0)
        is_bound = jnp.isfinite(values) & (jnp.abs(values.imag) <= rounding * jnp.abs(values))
        return jnp.max(jnp.where(is_bound, jnp.abs(values), 0.0)) / jnp.where(size > 0, size, 1.0)

    starts = jax.vmap(bound)(jax.random.split(jax.random.key(0), ASCENT_STARTS))
    greatest = jnp.max(starts)
    square = LEAST_SQUARE * jnp.linalg.norm(matrix, 2) ** 2
    return jnp.where(jnp.isnan(square), jnp.nan, jnp.where(greatest**2 > square, greatest, 0.0))
