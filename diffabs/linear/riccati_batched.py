"""Solvers for many Riccati equations at once.

`solve_care` and `solve_dare` have the batch as their first axis; the steps work on stacks of shape (rows, columns,
batch). Nested `vmap` calls join their axes into one batch. `riccati` states the equations and the method; this file
contains its steps.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from operator import add

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from diffabs.core.shapes import Float
from diffabs.core.types import Any, Array, Numbers, PyTree
from diffabs.linear.lyapunov import (
    cholesky,
    eye,
    frobenius_norm,
    gauss_jordan_solve,
    relative_residual,
    solve_stein,
    times,
    transpose,
)

# Equations that iterate together: their matrices fit the cache, and a slow equation delays only its own chunk.
CHUNK_MATRICES = 128
BALANCING_SWEEPS, MAX_DOUBLINGS, MAX_SIGN_ITERATIONS, MAX_KLEINMAN_STEPS = 12, 40, 40, 16
MAX_RELATIVE_ERROR = 1e-7  # largest admitted estimate of the relative error of P in balanced coordinates
PIVOT_ROUNDING = 1e-12  # pivots of R below this count as 0, relative to the diagonal
MAX_RELATIVE_RESIDUAL = 1e-9  # largest admitted relative residual in the given coordinates


@partial(jax.jit, static_argnums=0)
def solve_one(solver: Callable, data: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
    """Return (P, residual) of one equation (A, B, Q, R, S), shapes (n, n) and ()."""
    P, residual = solver(*(x[None] for x in data))
    return P[0], residual[0]


def _batch_over_matrices(solver: Callable) -> Callable:
    """Return `solver` for arrays (batch, rows, columns), in chunks of CHUNK_MATRICES; vmap enlarges the batch."""

    @custom_vmap
    def many(*data: jax.Array) -> tuple[Array, Array]:
        lanes = len(data[0])
        width = min(CHUNK_MATRICES, max(lanes, 1))
        # The padding repeats the last equation. Zeros have no solution, and would start the fallback for the chunk.
        padding = -lanes % width
        chunks = [jnp.pad(x, ((0, padding), (0, 0), (0, 0)), mode="edge") for x in data]
        chunks = [x.reshape(-1, width, *x.shape[1:]) for x in chunks]
        P, residual = lax.map(lambda chunk: solver(*(jnp.moveaxis(x, 0, -1) for x in chunk)), chunks)
        P = jnp.moveaxis(P, -1, 1)
        return P.reshape(-1, *P.shape[2:])[:lanes], residual.ravel()[:lanes]

    @many.def_vmap
    def rule(
        axis_size: int, batched: Sequence[bool], *data: jax.Array
    ) -> tuple[tuple[Array, Array], tuple[bool, bool]]:
        full = [x if b else jnp.broadcast_to(x, (axis_size, *x.shape)) for x, b in zip(data, batched, strict=True)]
        P, residual = many(*(x.reshape(-1, *x.shape[2:]) for x in full))
        lanes = full[0].shape[:2]
        return (P.reshape(*lanes, *P.shape[1:]), residual.reshape(lanes)), (True, True)

    return many


@_batch_over_matrices
def solve_care(
    A: Float[Array, "n n batch"],
    B: Float[Array, "n m batch"],
    Q: Float[Array, "n n batch"],
    R: Float[Array, "m m batch"],
    S: Float[Array, "n m batch"],
) -> tuple[Float[Array, "n n batch"], Float[Array, " batch"]]:
    """Return (P, residual) of continuous equations, shapes (batch, n, n) and (batch,); P is NaN where it is not proven.

    R is symmetric positive definite.
    """
    B, S, a, b, q, d = _reduce_and_balance(A, B, Q, R, S)
    G = times(b, transpose(b))
    # The scale is the geometric mean of the moduli of the Hamiltonian's eigenvalues.
    hamiltonian = _blocks(a, -G, -q, -transpose(a))
    scale = jnp.exp(gauss_jordan_solve(hamiltonian, hamiltonian[:, :0])[1] / len(hamiltonian))
    P, solved = _solve_by_doubling(*_cayley(a, G, q, scale))
    P = _fill_unsolved(solved, P, lambda: _solution_from_sign(_sign(hamiltonian)))
    return _unscale_with_residual(
        _refine_and_prove(partial(_kleinman, a, b, q, scale), P), d, partial(_terms, A, B, Q, S)
    )


@_batch_over_matrices
def solve_dare(
    A: Float[Array, "n n batch"],
    B: Float[Array, "n m batch"],
    Q: Float[Array, "n n batch"],
    R: Float[Array, "m m batch"],
    S: Float[Array, "n m batch"],
) -> tuple[Float[Array, "n n batch"], Float[Array, " batch"]]:
    """Return (P, residual) of discrete equations, shapes (batch, n, n) and (batch,); P is NaN where it is not proven.

    R is symmetric positive semidefinite, and singular only if R + B' P B > 0.
    """
    pivots, diagonal = (jnp.sum(x * eye(len(R), R), 1) for x in (cholesky(R), R))
    definite = jnp.all(pivots**2 > PIVOT_ROUNDING * diagonal, 0)
    # `lax.cond` skips the shift if every R in the chunk is definite, which is the usual case.
    regular, unshifted = jnp.all(definite), (Q, R, S, jnp.zeros_like(A))
    Q, R, S, shift = lax.cond(regular, lambda: unshifted, lambda: _shift_weights(A, B, Q, R, S, definite))
    B, S, a, b, q, d = _reduce_and_balance(A, B, Q, R, S)
    I, G = eye(len(a), a), times(b, transpose(b))

    def by_sign() -> jax.Array:
        """Return P from the matrix sign. A Cayley transformation maps the unit circle to the imaginary axis."""
        minus = _blocks(a - I, -G, -q, I - transpose(a))
        return _solution_from_sign(_sign(gauss_jordan_solve(minus, _blocks(a + I, G, -q, I + transpose(a)))[0]))

    P, solved = _solve_by_doubling(a, G, q)
    P = _fill_unsolved(solved, P, by_sign)
    P = _refine_and_prove(partial(_hewer, a, b, q), P, shift * d * d[:, None])
    P, residual = _unscale_with_residual(P, d, partial(_discrete_terms, A, B, Q, S))

    def keep_minimum() -> jax.Array:
        """Return P of the unshifted equation, NaN where R is singular and R + B' P B is not positive definite."""
        minimum = jnp.isfinite(frobenius_norm(cholesky(eye(B.shape[1], B) + times(transpose(B), P, B))))
        return jnp.where(definite | minimum, P + shift, jnp.nan)

    return lax.cond(regular, lambda: P, keep_minimum), residual


def _blocks(*blocks: jax.Array) -> jax.Array:
    return jnp.concatenate([jnp.concatenate(blocks[:2], 1), jnp.concatenate(blocks[2:], 1)], 0)


# Steps 1 and 2


def _reduce_and_balance(A: Array, B: Array, Q: Array, R: Array, S: Array) -> tuple[Array, ...]:
    """Return B L^-T and S L^-T, the balanced equation with R = I and S = 0, and scales d of the state.

    L is the Cholesky factor, L L' = R. The balanced matrices are those of A - B R^-1 S', B L^-T and Q - S R^-1 S'.
    """
    inverse = transpose(gauss_jordan_solve(cholesky(R), eye(len(R), R))[0])
    B, S = times(B, inverse), times(S, inverse)
    a, q = A - times(B, transpose(S)), Q - times(S, transpose(S))
    d = _balance(a, times(B, transpose(B)), q)
    return B, S, a * d / d[:, None], B / d[:, None], q * d * d[:, None], d


def _shift_weights(A: Array, B: Array, Q: Array, R: Array, S: Array, definite: jax.Array) -> tuple[Array, ...]:
    """Return Q, R, S of the discrete equation for P - shift, and the diagonal matrix `shift`.

    The shift is 0 where R is definite, and NaN where R is not semidefinite. In balanced coordinates it is as large as
    Q. The weight of the inputs becomes R + B' shift B. This is definite if R + B' P B is definite for any P.
    """
    weight, identity = frobenius_norm(R), eye(len(R), R)
    semidefinite = jnp.isfinite(
        frobenius_norm(cholesky(R + jnp.where(weight > 0, PIVOT_ROUNDING * weight, 1.0) * identity))
    )
    d = _balance(A, times(B, transpose(B)), Q)
    level = frobenius_norm(Q * d * d[:, None])
    p = jnp.where(semidefinite, jnp.where(level > 0, level, 1.0) / (d * d), jnp.nan)
    shift = jnp.where(definite, 0.0, p)[:, None] * eye(len(A), A)
    moved = times(transpose(A), shift)
    return Q + times(moved, A) - shift, R + times(transpose(B), shift, B), S + times(moved, B), shift


def _balance(A: jax.Array, G: jax.Array, Q: jax.Array) -> jax.Array:
    """Return scales d (n, batch), powers of two. With x = d z, row i and column i of the Hamiltonian have similar sums.

    The sums leave out the diagonal.
    """
    A, G, Q = jnp.abs(A) * (1 - eye(len(A), A)), jnp.abs(G), jnp.abs(Q)

    # An exponent of 1/2 would equalise one row and column. All change at once, so 1/4 damps the sweep.
    def sweep(_: object, d: jax.Array) -> jax.Array:
        row = (jnp.sum(A * d, 1) + jnp.sum(G / d, 1)) / d
        column = (jnp.sum(A / d[:, None], 0) + jnp.sum(Q * d, 1)) * d
        coupled = (row > 0) & (column > 0)
        return d * jnp.where(coupled, row / jnp.where(coupled, column, 1.0), 1.0) ** 0.25

    # Powers of two scale without rounding.
    d = lax.fori_loop(0, BALANCING_SWEEPS, sweep, jnp.ones_like(A[0]))
    return jnp.ldexp(jnp.ones_like(d), jnp.round(jnp.log2(d)).astype(int))


def _cayley(A: jax.Array, G: jax.Array, Q: jax.Array, scale: jax.Array) -> tuple[jax.Array, ...]:
    """Return (A, G, Q) of a discrete equation with the same P.

        (A, -G; Q, A') <- I + 2 g (A - g, G; -Q, A' - g)^-1

    These are eqs. (2.8) of Chu, Fan and Lin (2005) in one inverse. In ordinary examples g is not an eigenvalue of A.
    """
    n, g = len(A), 1.09 * scale
    shifted = A - g * eye(n, A)
    whole = _blocks(shifted, G, -Q, transpose(shifted))
    whole = eye(2 * n, A) + 2 * g * gauss_jordan_solve(whole, eye(2 * n, A))[0]
    return whole[:n, :n], -whole[:n, n:], whole[n:, :n]


def _solve_by_doubling(A: jax.Array, G: jax.Array, Q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return P of a discrete equation by structured doubling, and whether it converged.

        W = (I + G Q)^-1 (A, G);   A <- A W_A,   G <- G + A W_G A',   Q <- Q + A' Q W_A

    It converges where P is stabilising and the dual equation has a solution too. An unstable mode without cost is an
    exception.
    """
    n = len(A)

    def goes_on(carry: PyTree) -> jax.Array:
        k, A, _, _ = carry
        return (k < MAX_DOUBLINGS) & jnp.any(frobenius_norm(A) > 1e-5)  # the error of Q is its square

    def double(carry: PyTree) -> tuple[Array, ...]:
        k, A, G, Q = carry
        W = gauss_jordan_solve(eye(n, A) + times(G, Q), jnp.concatenate([A, G], 1))[0]
        T = transpose(A)
        G, Q = G + times(A, W[:, n:], T), Q + times(T, Q, W[:, :n])
        return k + 1, times(A, W[:, :n]), (G + transpose(G)) / 2, (Q + transpose(Q)) / 2

    _, A, _, Q = lax.while_loop(goes_on, double, (0, A, G, Q))
    return Q, (frobenius_norm(A) <= 1e-5) & jnp.isfinite(frobenius_norm(Q))


def _fill_unsolved(solved: jax.Array, P: jax.Array, otherwise: Callable) -> jax.Array:
    """Return P with `otherwise()` where P is not found; `otherwise` runs only if a solution is missing."""
    return lax.cond(jnp.all(solved), lambda: P, lambda: jnp.where(solved, P, otherwise()))


def _sign(Z: jax.Array) -> jax.Array:
    """Return the matrix sign by Newton's iteration Z <- (c Z + (c Z)^-1)/2, c = abs(det Z)^(-1/size)."""

    def goes_on(carry: PyTree) -> jax.Array:
        k, _, moved = carry
        return (k < MAX_SIGN_ITERATIONS) & jnp.any(moved > 1e-5)  # converges quadratically

    def step(carry: PyTree) -> tuple[Array, ...]:
        k, Z, _ = carry
        inverse, log = gauss_jordan_solve(Z, eye(len(Z), Z))
        c = jnp.exp(-log / len(Z))
        new = (c * Z + inverse / c) / 2
        return k + 1, new, frobenius_norm(new - Z) / frobenius_norm(new)

    return lax.while_loop(goes_on, step, (0, Z, jnp.ones_like(Z[0, 0])))[1]


def _solution_from_sign(Z: jax.Array) -> jax.Array:
    """Return P of (Z + I) (I, P)' = 0, which are 2n equations, in the least-squares sense."""
    n = len(Z) // 2
    N, M = jnp.split(Z + eye(2 * n, Z), [n], 1)
    P = gauss_jordan_solve(times(transpose(M), M), -times(transpose(M), N))[0]
    return (P + transpose(P)) / 2


# Steps 3 and 4


def _refine_and_prove(newton: Callable, P: Float[Array, "n n batch"], shift: Numbers = 0.0) -> jax.Array:
    """Return P after Newton-Kleinman steps until it moves by less than 1e-7 of P + shift, or NaN without a proof."""

    def goes_on(carry: PyTree) -> jax.Array:
        return ~carry[0]

    def step(carry: PyTree) -> tuple[Array, ...]:
        _, k, P, moved, *_ = carry
        last = (k >= MAX_KLEINMAN_STEPS) | ~jnp.any(moved > 1e-7)
        # Only the last step needs X. A second copy of the step for it would take as long to compile.
        terms, D, X = newton(P, eye(len(P), P))
        return (
            last,
            k + 1,
            P + D,
            frobenius_norm(D) / frobenius_norm(P + D),
            terms,
            frobenius_norm(D),
            frobenius_norm(X),
        )

    none = jnp.zeros_like(P[0, 0])
    carry = lax.while_loop(goes_on, step, (jnp.array(False), 0, P, none + 1, none, none, none))
    _, _, P, _, terms, moved, proof = carry
    error, limit = jnp.finfo(P.dtype).eps * proof * terms, MAX_RELATIVE_ERROR * frobenius_norm(P + shift)
    return jnp.where((error <= limit) & (moved <= limit), P, jnp.nan)


def _unscale_with_residual(P: jax.Array, d: jax.Array, terms: Callable) -> tuple[jax.Array, jax.Array]:
    """Return P and its residual in the given coordinates, x = d z; P is NaN if the residual is too large."""
    P = (P + transpose(P)) / 2 / (d * d[:, None])
    parts = terms(P)
    residual = relative_residual(reduce(add, parts), *parts)
    return jnp.where(residual <= MAX_RELATIVE_RESIDUAL, P, jnp.nan), residual


def _terms(A: Array, B: Array, Q: Array, S: Array, P: Array) -> tuple[Array, ...]:
    """Return the terms of the continuous equation with R = I."""
    PA, T = times(P, A), times(P, B) + S
    return PA, transpose(PA), -times(T, transpose(T)), Q


def _discrete_terms(A: Array, B: Array, Q: Array, S: Array, P: Array) -> tuple[Array, ...]:
    """Return the terms of the discrete equation with R = I."""
    PA, PB = times(P, A), times(P, B)
    T = times(transpose(B), PA) + transpose(S)
    gain = gauss_jordan_solve(eye(B.shape[1], B) + times(transpose(B), PB), T)[0]
    return times(transpose(A), PA), -P, -times(transpose(T), gain), Q


def _kleinman(A: Array, B: Array, Q: Array, scale: Array, P: Array, *extra: Array) -> tuple[Any, ...]:
    """Return the size of the terms, the Newton step D, and one X for each E of `extra`.

        Ac' D + D Ac + (left side at P) = 0,     Ac' X + X Ac + E = 0

    The Cayley transformation C = (Ac + g)(Ac - g)^-1 turns each into a Stein equation:

        C' D C - D + 2 g M' (left side or E) M = 0,     M = (Ac - g)^-1
    """
    I, terms = eye(len(A), A), _terms(A, B, Q, jnp.zeros_like(B), P)
    M = gauss_jordan_solve(A - times(B, transpose(B), P) - scale * I, I)[0]
    right = (2 * scale * times(transpose(M), W, M) for W in (reduce(add, terms), *extra))
    return sum(map(frobenius_norm, terms)), *solve_stein(I + 2 * scale * M, *right)


def _hewer(A: Array, B: Array, Q: Array, P: Array, *extra: Array) -> tuple[Any, ...]:
    """Return the size of the terms, the Newton step D, and one X for each E of `extra`, in discrete time.

    Ac' D Ac - D + (left side at P) = 0,     Ac' X Ac - X + E = 0
    """
    terms, PB = _discrete_terms(A, B, Q, jnp.zeros_like(B), P), times(P, B)
    gain = gauss_jordan_solve(eye(B.shape[1], B) + times(transpose(B), PB), times(transpose(PB), A))[0]
    return sum(map(frobenius_norm, terms)), *solve_stein(A - times(B, gain), reduce(add, terms), *extra)
