"""Frequency responses of open and closed loops as JAX functions of their matrices, with exact delays.

    L(jw) = (C (jw - A)^-1 B + D) e^(-jw delay)            sampled: e^(jw period) in place of jw
    S = (I + L)^-1,   T = I - S

S is computed from the matrix of the closed loop, so an integrator of L does no harm at w = 0:

    S = F - F e C (jw - A + B F e C)^-1 B F,   F = (I + e D)^-1,   e = e^(-jw delay)

A `TracedSystem` is a `Transfer` whose numbers may be tracers.
"""

import functools
import operator
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once
from diffabs.core.types import Array, Scalar
from diffabs.linear.lyapunov import eye, gauss_jordan_solve
from diffabs.linear.transfer import Transfer


class TracedSystem(NamedTuple):
    """A linear system with a pure delay whose numbers are JAX arrays or tracers; the fields are those of `Transfer`."""

    A: Array
    B: Array
    C: Array
    D: Array
    period: Scalar | None
    delay: Array


Result = TypeVar("Result")


def compile_for_systems(function: Callable[..., Result]) -> Callable[[Transfer | TracedSystem], Result]:
    """Return a function of a system that checks its shapes and compiles once for each kind of system."""
    compiled = compile_once(options=SAME_RESULT_OPTIONS)(function)

    @functools.wraps(function)
    def call(loop: Transfer | TracedSystem) -> Result:
        return compiled(as_arrays(loop))

    return call


def respond(system: TracedSystem, w: Array) -> Array:
    """Return the response (k, p, m) at frequencies w (k,) [rad/s]; not finite at a pole."""
    if not len(system.A):
        return system.D * _delay_factors(system, w)
    return (system.C @ _inverse(_subtract_matrix(system, w)) @ system.B + system.D) * _delay_factors(system, w)


def respond_sensitivity(system: TracedSystem, w: Array) -> Array:
    """Return S (k, m, m) of an open loop that is closed by negative feedback."""
    turn = _delay_factors(system, w)
    direct = jnp.linalg.inv(jnp.eye(system.D.shape[0]) + turn * system.D)
    # b and c are input and output of the closed loop, whose matrix is A - B F e C.
    b, c = system.B @ direct, turn * (direct @ system.C)
    return direct - c @ _inverse(_subtract_matrix(system, w) + system.B @ c) @ b


def search_sensitivity(system: TracedSystem, poles: Array, closed: Array) -> Callable[[Array], Array]:
    """Return S (k, m, m) as a function of frequencies for a search, which needs no exact value.

    With one channel, and `poles` and `closed` those of the open and of the closed loop without its delay, it is

        1/S = 1 + (Q - 1) e^(-jw delay),   Q = (1 + D) product of (jw - closed)/(jw - poles)

    This compiles and runs several times faster than inverses of matrices.
    """
    if system.D.shape[0] > 1:
        return lambda w: respond_sensitivity(system, w)

    def respond_single(w: Array) -> Array:
        points = (1j * w if system.period is None else jnp.exp(1j * w * system.period))[:, None]
        # A chain of products: complex logarithms are slow, and the derivative of `jnp.prod` is long.
        factors = (points - closed) / (points - poles)
        quotient = functools.reduce(operator.mul, factors.T, 1 + system.D[0, 0])
        return (1 / (1 + (quotient - 1) * _delay_factors(system, w)[:, 0, 0]))[:, None, None]

    return respond_single


def loop_from(sensitivity: Array) -> Array:
    """Return L = S^-1 - I from S (k, m, m)."""
    m = sensitivity.shape[-1]
    return (1 / sensitivity if m == 1 else _inverse(sensitivity)) - jnp.eye(m)


def closed_poles_without_delay(system: TracedSystem) -> Array:
    """Return the poles (n,) of the closed loop if its delay were zero: in s, or in z if it is sampled."""
    direct = jnp.eye(system.D.shape[0]) + system.D
    return jnp.linalg.eigvals(system.A - system.B @ jnp.linalg.solve(direct, system.C))


def _subtract_matrix(system: TracedSystem, w: Array) -> Array:
    """Return jw - A, or z - A, (k, n, n)."""
    identity = jnp.eye(system.A.shape[0])
    if system.period is None:
        return 1j * w[:, None, None] * identity - system.A
    # z - A = (z - 1) - (A - 1) keeps the digits of slow modes, whose z is near 1.
    return _exp_minus_one(w * system.period)[:, None, None] * identity - (system.A - identity)


def _exp_minus_one(angle: Array) -> Array:
    """Return e^(j angle) - 1 without cancellation at small angles."""
    return -2 * jnp.sin(angle / 2) ** 2 + 1j * jnp.sin(angle)


def _delay_factors(system: TracedSystem, w: Array) -> Array:
    return jnp.exp(-1j * w * system.delay)[:, None, None]


def largest_singular_values(matrices: Array) -> Array:
    """Return the largest singular value of each matrix (k, p, m); its derivative at a zero matrix is 0."""
    if 1 in matrices.shape[1:]:
        squares = jnp.sum(matrices.real**2 + matrices.imag**2, axis=(1, 2))
    else:
        p, m = matrices.shape[1:]
        squares = _top_eigenpairs(_adjoint(matrices) @ matrices if m <= p else matrices @ _adjoint(matrices))[0]
    # The square root has no derivative at 0, where a response may be.
    zero = squares <= 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squares)))


@jax.custom_jvp
def _top_eigenpairs(hermitian: Array) -> tuple[Array, Array, Array]:
    """Return the largest eigenvalue (k,), its eigenvector (k, n) and the pseudo-inverse of their residual (k, n, n).

    The derivatives need a gap to the second eigenvalue only, and without one they are large, not infinite. Those of a
    full decomposition are NaN as soon as any two eigenvalues are equal, as the zeros of a matrix of low rank are.
    """
    values, vectors = jnp.linalg.eigh(hermitian)
    top, others = values[:, -1], vectors[:, :, :-1]
    gaps = jnp.maximum(top[:, None] - values[:, :-1], jnp.finfo(top.dtype).eps * jnp.where(top > 0, top, 1.0)[:, None])
    return top, vectors[:, :, -1], (others / gaps[:, None, :]) @ _adjoint(others)


@_top_eigenpairs.defjvp
def _top_eigenpairs_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
    top, vector, reduced = _top_eigenpairs(*primals)
    forced = (tangents[0] @ vector[:, :, None])[:, :, 0]
    slope = jnp.sum(jnp.conj(vector) * forced, axis=1).real
    turned = (reduced @ forced[:, :, None])[:, :, 0]
    # G. H. Golub, V. Pereyra (1973): the derivative of a pseudo-inverse of constant rank.
    bent = (reduced @ turned[:, :, None]) * jnp.conj(vector)[:, None, :]
    moved = reduced @ tangents[0] @ reduced - slope[:, None, None] * (reduced @ reduced) - bent - _adjoint(bent)
    return (top, vector, reduced), (slope, turned, moved)


def _adjoint(matrices: Array) -> Array:
    return jnp.conj(jnp.swapaxes(matrices, 1, 2))


@jax.custom_jvp
def _inverse(matrices: Array) -> Array:
    """Return the inverses of matrices (k, n, n). The derivatives are products, which compile faster than solutions."""
    stack = jnp.moveaxis(matrices, 0, -1)
    return jnp.moveaxis(gauss_jordan_solve(stack, eye(len(stack), stack))[0], -1, 0)


@_inverse.defjvp
def _inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    inverse = _inverse(*primals)
    return inverse, -inverse @ tangents[0] @ inverse


def half_sampling_rate(system: TracedSystem) -> Scalar:
    """Return the highest frequency of a sampled system [rad/s]; infinity in continuous time."""
    return jnp.inf if system.period is None else jnp.pi / jnp.asarray(system.period)


def as_arrays(system: Transfer | TracedSystem, least_order: int = 1) -> TracedSystem:
    """Return a system with JAX arrays. Raises ValueError if it is no system, or its matrices do not fit each other."""
    if not isinstance(system, Transfer | TracedSystem):
        raise ValueError(f"{type(system).__name__} is no Transfer: linear.from_control makes one of python-control's")
    n, (p, m) = (np.shape(system.A) or (0,))[0], np.shape(system.D) if np.ndim(system.D) == 2 else (0, 0)
    for name, shape in {"D": (p, m), "A": (n, n), "B": (n, m), "C": (p, n)}.items():
        if np.shape(getattr(system, name)) != shape or not (p and m and n >= least_order):
            sizes = "n, m and p at least 1" if least_order else "m and p at least 1"
            needed = f"A (n, n), B (n, m), C (p, n) and D (p, m) are needed, {sizes}"
            raise ValueError(f"{name} has the shape {np.shape(getattr(system, name))}: {needed}")
    dtype = jnp.result_type(float)
    a, b, c, d = (jnp.asarray(matrix, dtype) for matrix in system[:4])
    return TracedSystem(a, b, c, d, system.period, jnp.asarray(system.delay, dtype))
