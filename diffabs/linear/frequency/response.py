"""Frequency responses of open and closed loops as JAX functions of their matrices, with exact delays.

    L(jw) = (C (jw - A)^-1 B + D) e^(-jw delay)            sampled: e^(jw period) in place of jw
    S = (I + L)^-1,   T = I - S

S is computed from the matrix of the closed loop, so an integrator of L does no harm at w = 0:

    S = F - F e C (jw - A + B F e C)^-1 B F,   F = (I + e D)^-1,   e = e^(-jw delay)

The matrices may be tracers; `Transfer` is only their container here.
"""

import jax
import jax.numpy as jnp

from diffabs.core.types import Array, Scalar, Vector
from diffabs.linear.lyapunov import eye, gauss_jordan_solve
from diffabs.linear.transfer import Transfer


def respond(system: Transfer, w: Vector) -> Array:
    """Return the response (k, p, m) at frequencies w (k,) [rad/s]; not finite at a pole."""
    return (system.C @ _inverse(_shifted(system, w)) @ system.B + system.D) * _delay_factors(system, w)


def respond_sensitivity(system: Transfer, w: Vector) -> Array:
    """Return S (k, m, m) of an open loop that is closed by negative feedback."""
    turn = _delay_factors(system, w)
    direct = jnp.linalg.inv(jnp.eye(system.D.shape[0]) + turn * system.D)
    # b and c are input and output of the closed loop, whose matrix is A - B F e C.
    b, c = system.B @ direct, turn * (direct @ system.C)
    return direct - c @ _inverse(_shifted(system, w) + system.B @ c) @ b


def loop_from(sensitivity: Array) -> Array:
    """Return L = S^-1 - I from S (k, m, m)."""
    m = sensitivity.shape[-1]
    return (1 / sensitivity if m == 1 else _inverse(sensitivity)) - jnp.eye(m)


def closed_poles_without_delay(system: Transfer) -> Array:
    """Return the poles (n,) of the closed loop if its delay were zero: in s, or in z if it is sampled."""
    direct = jnp.eye(system.D.shape[0]) + system.D
    return jnp.linalg.eigvals(system.A - system.B @ jnp.linalg.solve(direct, system.C))


def _shifted(system: Transfer, w: Vector) -> Array:
    """Return jw - A, or z - A, (k, n, n)."""
    identity = jnp.eye(system.A.shape[0])
    if system.period is None:
        return 1j * w[:, None, None] * identity - system.A
    # z - A = (z - 1) - (A - 1) keeps the digits of slow modes, whose z is near 1.
    return _exp_minus_one(w * system.period)[:, None, None] * identity - (system.A - identity)


def _exp_minus_one(angle: Array) -> Array:
    """Return e^(j angle) - 1 without cancellation at small angles."""
    return -2 * jnp.sin(angle / 2) ** 2 + 1j * jnp.sin(angle)


def _delay_factors(system: Transfer, w: Vector) -> Array:
    return jnp.exp(-1j * w * jnp.asarray(system.delay))[:, None, None]


@jax.custom_jvp
def _inverse(matrices: Array) -> Array:
    """Return the inverses of matrices (k, n, n). The derivatives are products, which compile faster than solutions."""
    stack = jnp.moveaxis(matrices, 0, -1)
    return jnp.moveaxis(gauss_jordan_solve(stack, eye(len(stack), stack))[0], -1, 0)


@_inverse.defjvp
def _inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    inverse = _inverse(*primals)
    return inverse, -inverse @ tangents[0] @ inverse


def half_sampling_rate(system: Transfer) -> Scalar:
    """Return the highest frequency of a sampled system [rad/s]; infinity in continuous time."""
    return jnp.inf if system.period is None else jnp.pi / system.period


def as_arrays(system: Transfer) -> Transfer:
    """Return a system with JAX arrays."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), system)
