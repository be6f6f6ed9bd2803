"""Frequencies between which a loop changes little, a fixed number of them, and the stability of the closed loop.

The number of frequencies depends on the order alone, so a search over them works under `vmap`. They are placed in
passes: first even on the logarithmic axis and close around every pole, then even in how far L and 1 + L move.

**Stability** with an exact delay is Mikhailov's criterion. Let f(jw) = det(jw - A + B e^(-jw delay) C), of order n. The
closed loop is stable if and only if the argument of f grows by n pi/2 from w = 0 to infinity, and for a sampled loop by
n pi up to half the sampling rate (A. V. Mikhailov, 1938; with delays: L. S. Pontryagin, 1942).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.types import Array, Bool, Scalar
from diffabs.linear.responses.response import (
    TracedSystem,
    closed_poles_without_delay,
    half_sampling_rate,
    loop_from,
    search_sensitivity,
)

GRID_DECADES = 3.0  # of the grid beyond the slowest and the fastest pole
LOG_POINTS = 160  # of the first pass
SPREADS, EVEN_POINTS = 2, 96  # passes that follow, and points of each
AROUND_POLE = (-5.0, -2.0, -1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0, 2.0, 5.0)  # places around a pole, times its decay rate
PAIR_OFFSET = 0.07  # of these places for the second of a conjugate pair
LEAST_GAP = 1e-6  # between two frequencies, relative
MAX_MOVE = 2.0  # largest relative move of L between two points that attracts points
LOG_SHARE = 1e-3  # of the logarithmic axis in the coordinate of the second pass, for each point
SMALL_LOOP = 1e-3  # |L| below which its own motion attracts no points
# Of the argument of f: largest increment between two points that is resolved, and distance of the total from whole
# quarters of a turn, in quarters.
MAX_TURN, MAX_QUARTER_ERROR = 2.6, 0.3
MAX_PERIOD_ERROR = 1e-6  # of a delay that counts as whole periods, in periods; it leaves room for single precision


class FrequencyGrid(NamedTuple):
    """Frequencies of a loop.

    Attributes:
        w: Frequencies (k,), increasing from well below to well above the poles [rad/s].
        sensitivity: S there, (k, m, m), but for errors that a search may have.
        respond: S as a function of other frequencies, with the same errors.
        stable: Whether the closed loop is stable.
        resolved: Whether the grid resolves the argument of the characteristic function. If it does not, `stable` says
            nothing.
    """

    w: Array
    sensitivity: Array
    respond: Callable[[Array], Array]
    stable: Bool
    resolved: Bool

    @property
    def decided(self) -> Bool:
        """Whether the closed loop is known to be stable."""
        return jnp.asarray(self.stable) & self.resolved


def place_frequencies(system: TracedSystem) -> FrequencyGrid:
    """Return the frequencies of an open loop and the stability of its closed loop. They have no derivative."""
    system = jax.lax.stop_gradient(system)
    poles, closed = jnp.linalg.eigvals(system.A), closed_poles_without_delay(system)
    respond = search_sensitivity(system, poles, closed)
    w = first_frequencies(system, jnp.append(poles, closed))
    sensitivity = respond(w)
    for _ in range(SPREADS):
        w = spread_evenly(w, relative_moves(sensitivity, 0.0), relative_moves(loop_from(sensitivity), SMALL_LOOP))
        sensitivity = respond(w)
    stable, resolved = _is_stable(system.period, poles, w, sensitivity)
    return FrequencyGrid(w, sensitivity, respond, stable, resolved & _has_fit_delay(system))


def _has_fit_delay(system: TracedSystem) -> Bool:
    """Return whether the delay is one that the criterion covers: no direct path behind it; whole periods if sampled."""
    if system.period is None:
        return (system.delay == 0) | ((system.delay > 0) & jnp.all(system.D == 0))
    periods = system.delay / system.period
    return (periods >= 0) & (jnp.abs(periods - jnp.round(periods)) <= MAX_PERIOD_ERROR * jnp.maximum(1.0, periods))


def first_frequencies(system: TracedSystem, poles: Array) -> Array:
    """Return frequencies that are even on the logarithmic axis, and close around each of some poles (k,)."""
    half = half_sampling_rate(system)
    if system.period is not None:
        alive = jnp.abs(poles) > 1e-9
        poles = jnp.where(alive, jnp.log(jnp.where(alive, poles, 1.0)), jnp.pi) / system.period
    sizes = jnp.abs(poles)
    largest = jnp.max(sizes, initial=0.0)
    counts = sizes > 1e-9 * largest
    low = jnp.min(jnp.where(counts, sizes, jnp.inf), initial=jnp.inf)
    low, high = (jnp.where(largest > 0, x, 1.0) for x in (low, largest))
    # A delay turns L at frequencies of its own.
    high = jnp.maximum(high, jnp.where(system.delay > 0, 10.0 / jnp.maximum(system.delay, 1e-30), 0.0))
    high = jnp.minimum(high * 10.0**GRID_DECADES, half)
    low = jnp.minimum(low, high) * 10.0**-GRID_DECADES
    even = jnp.geomspace(low, high, LOG_POINTS)
    offsets = jnp.array(AROUND_POLE) + jnp.where(poles.imag < 0, PAIR_OFFSET, 0.0)[:, None]
    around = (jnp.abs(poles.imag)[:, None] + jnp.abs(poles.real)[:, None] * offsets).ravel()
    elsewhere = low * (high / low) ** ((jnp.arange(len(around)) + 0.5) / len(around))
    w = jnp.sort(jnp.concatenate([even, jnp.where((around > low) & (around < high), around, elsewhere)]))
    # Two equal frequencies, as near equal poles, would hide a maximum beside them: no bracket holds it.
    return w * (1 - LEAST_GAP * jnp.arange(len(w))[::-1])


def spread_evenly(w: Array, *moves: Array) -> Array:
    """Return the frequencies with others between them where something moves most; `moves` has an entry less than w."""
    even = LOG_SHARE * len(w) * jnp.diff(jnp.log(w)) / jnp.log(w[-1] / w[0])
    length = jnp.concatenate([jnp.zeros(1), jnp.cumsum(sum(moves, even))])
    places = jnp.linspace(0.0, 1.0, EVEN_POINTS + 2)[1:-1] * length[-1]
    return jnp.sort(jnp.concatenate([w, jnp.exp(jnp.interp(places, length, jnp.log(w)))]))


def relative_moves(values: Array, smallest: float) -> Array:
    """Return how far matrices (k, m, m) move between neighbours, relative to the smaller one, at most `MAX_MOVE`."""
    sizes = jnp.sqrt(jnp.sum(jnp.abs(values) ** 2, axis=(1, 2)))
    change = jnp.sqrt(jnp.sum(jnp.abs(jnp.diff(values, axis=0)) ** 2, axis=(1, 2)))
    base = jnp.maximum(jnp.minimum(sizes[1:], sizes[:-1]), max(smallest, 1e-30))
    return jnp.nan_to_num(jnp.minimum(change / base, MAX_MOVE), nan=MAX_MOVE)


def _is_stable(period: Scalar | None, poles: Array, w: Array, sensitivity: Array) -> tuple[Bool, Bool]:
    """Return whether the closed loop is stable by Mikhailov's criterion, and whether the frequencies resolve that.

    `poles` (n,) are those of the open loop: f is the product of jw - pole, over det S.
    """
    if period is None:
        distances, quarters = 1j * w[:, None] - poles, 1
    else:
        distances, quarters = jnp.exp(1j * w[:, None] * period) - poles, 2
    directions = jnp.concatenate([distances, 1 / jnp.linalg.det(sensitivity)[:, None]], axis=1)
    values = jnp.prod(directions / jnp.abs(directions), axis=1)
    turns = jnp.angle(values[1:] * jnp.conj(values[:-1]))
    total = jnp.sum(turns) / (jnp.pi / 2)
    resolved = jnp.all(jnp.isfinite(turns)) & (jnp.max(jnp.abs(turns), initial=0.0) < MAX_TURN)
    near = jnp.abs(total - jnp.round(total)) < MAX_QUARTER_ERROR
    return jnp.round(total) == quarters * len(poles), resolved & near
