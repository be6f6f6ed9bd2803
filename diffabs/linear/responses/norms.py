"""Norms of a stable linear system with derivatives."""

import jax
import jax.numpy as jnp

from diffabs.core.types import Array, Bool, Scalar
from diffabs.linear.lyapunov import discrete_lyapunov, lyapunov
from diffabs.linear.responses.grid import SPREADS, first_frequencies, relative_moves, spread_evenly
from diffabs.linear.responses.response import (
    TracedSystem,
    as_arrays,
    compile_for_systems,
    half_sampling_rate,
    largest_singular_values,
    respond,
)
from diffabs.linear.responses.search import FrequencyPeak, find_peaks, highest
from diffabs.linear.transfer import Transfer


@compile_for_systems
def hinf_norm(system: Transfer | TracedSystem) -> FrequencyPeak:
    """Return the H-infinity norm of a stable system: the greatest singular value of its response over all frequencies.

    The norm of an unstable system is NaN. A delay does not change it.

    Args:
        system: System of order 1 or more.

    Examples:
        A resonance with the damping ratio z has the peak 1/(2 z sqrt(1 - z^2)):

        >>> import numpy as np
        >>> from diffabs.linear import Transfer
        >>> from diffabs.linear.responses import hinf_norm
        >>> A, B = np.array([[0.0, 1.0], [-1.0, -0.2]]), np.array([[0.0], [1.0]])
        >>> print(f"{hinf_norm(Transfer(A, B, C=np.array([[1.0, 0.0]]), D=np.zeros((1, 1)))).value:.6f}")
        5.025189
    """
    system = as_arrays(system)
    peak = highest(*find_norm_peaks(system))
    return peak._replace(value=jnp.where(_is_stable(jax.lax.stop_gradient(system)), peak.value, jnp.nan))


def find_norm_peaks(system: TracedSystem) -> tuple[Array, Array]:
    """Return the local maxima of the largest singular value of a response, and their frequencies.

    The maxima have no order; missing ones are -inf. Both ends of the frequency axis count.
    """
    searched = jax.lax.stop_gradient(system)

    def measure(w: Array) -> Array:
        return largest_singular_values(respond(system, w))

    def search(w: Array) -> Array:
        return largest_singular_values(respond(searched, w))

    w = first_frequencies(searched, jnp.linalg.eigvals(searched.A))
    for _ in range(SPREADS):
        w = spread_evenly(w, relative_moves(respond(searched, w), 0.0))
    tops, at = find_peaks(measure, search, w, search(w))
    ends = jnp.zeros(1) if system.period is None else jnp.stack([jnp.zeros(()), half_sampling_rate(system)])
    tops, at = jnp.append(tops, measure(ends)), jnp.append(at, ends)
    if system.period is None:
        tops, at = jnp.append(tops, largest_singular_values(system.D[None])), jnp.append(at, jnp.inf)
    return tops, at


@compile_for_systems
def h2_norm(system: Transfer | TracedSystem) -> Scalar:
    """Return the H2 norm of a stable system, the root mean square of its output under unit white noise.

    It is NaN for an unstable system, and infinite for one in continuous time with a direct path. A delay does not
    change it.

    Examples:
        The norm of 1/(s + a) is 1/sqrt(2 a):

        >>> import numpy as np
        >>> from diffabs.linear import Transfer
        >>> from diffabs.linear.responses import h2_norm
        >>> print(h2_norm(Transfer(np.array([[-2.0]]), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)))))
        0.5
    """
    system = as_arrays(system)
    # The Gramian of the observer: A' X + X A + C'C = 0, or A' X A - X + C'C = 0.
    solve = lyapunov if system.period is None else discrete_lyapunov
    gramian = solve(system.A, system.C.T @ system.C).P
    square = jnp.sum(system.B * (gramian @ system.B)) + (0.0 if system.period is None else jnp.sum(system.D**2))
    norm = jnp.where(_is_stable(jax.lax.stop_gradient(system)), jnp.sqrt(square), jnp.nan)
    return norm if system.period is not None else jnp.where(jnp.any(system.D != 0), jnp.inf, norm)


def _is_stable(system: TracedSystem) -> Bool:
    poles = jnp.linalg.eigvals(system.A)
    return jnp.all(poles.real < 0) if system.period is None else jnp.all(jnp.abs(poles) < 1)
