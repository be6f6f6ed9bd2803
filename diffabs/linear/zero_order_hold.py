"""Discretisation of a linear system whose input is held over a period, with a computing delay."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.types import AnyArray, Array, Scalar
from diffabs.linear.linearization import StateSpace

TERMS, EXPONENTIAL_SQUARINGS = 14, 16  # terms of the Taylor series and largest number of squarings of e^a


def discretise_held_input(system: StateSpace, period: Scalar, delay: Scalar) -> StateSpace:
    """Return the discrete system over one period, for the state (x, u_old): A (n + m, n + m), B (n + m, m).

    The previous input u_old acts until `delay` d [s], then the new one until the period T ends, 0 <= d <= T.

        x(T) = e^(A T) x + e^(A (T - d)) G(d) u_old + G(T - d) u,  G(s) = integral of e^(A r) B over r in [0, s]
    """
    (a, b), n, m = system, *system.B.shape
    with_input = jnp.zeros((n + m, n + m), a.dtype).at[:n, :n].set(a).at[:n, n:].set(b)
    before, after = (_exponential(with_input * s) for s in (delay, period - delay))
    both = jnp.zeros_like(with_input).at[:n].set(after[:n, :n] @ before[:n])
    return StateSpace(both, jnp.concatenate([after[:n, n:], jnp.eye(m, dtype=a.dtype)]))


def hold_input(a: np.ndarray, b: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return e^(A t) (k, n, n) and the response of the state to a held input, G(t) (k, n, m), in NumPy and float64.

    G(t) = integral of e^(A r) B over r in [0, t], t >= 0
    """
    (n, m), times = np.shape(b), np.asarray(times, float)
    rates = np.zeros((n + m, n + m))
    rates[:n, :n], rates[:n, n:] = a, b
    norm = float(np.max(np.sum(np.abs(rates), axis=1), initial=0.0)) * float(np.max(times, initial=0.0))
    halvings = max(0, math.ceil(math.log2(max(norm, 0.25))) + 1)
    scaled, identity = rates * (times[:, None, None] * 2.0**-halvings), np.eye(n + m)
    exponential = np.broadcast_to(identity, scaled.shape)
    for i in range(TERMS):
        exponential = identity + scaled @ exponential / (TERMS - i)
    for _ in range(halvings):
        exponential = exponential @ exponential
    return exponential[:, :n, :n], exponential[:, :n, n:]


def _exponential(a: Array) -> AnyArray:
    """Return e^a by scaling and squaring of its Taylor series.

    It is exact to about rounding for norms up to 2^(EXPONENTIAL_SQUARINGS - 1). `jax.scipy.linalg.expm` hangs for
    20,000 models of the lab rig at once (JAX 0.10.2, two cores). JAX has no known issue of exactly this;
    github.com/jax-ml/jax/issues/20428 is similar.
    """
    # The number of halvings is piecewise constant, so its gradient is cut. A fixed number of squarings, masked by
    # `where`, has a reverse-mode derivative and works under vmap.
    norm = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(a), axis=1)))
    halvings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(norm, 0.25))) + 1, 0, EXPONENTIAL_SQUARINGS)
    scaled, identity = a * 2.0**-halvings, jnp.eye(len(a), dtype=a.dtype)
    series = jax.lax.fori_loop(0, TERMS, lambda i, e: identity + scaled @ e / (TERMS - i), identity)
    return jax.lax.fori_loop(0, EXPONENTIAL_SQUARINGS, lambda i, e: jnp.where(i < halvings, e @ e, e), series)
