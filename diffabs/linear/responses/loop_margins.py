"""Margins of an open loop as JAX functions of its matrices, with derivatives, for one loop or for many under `vmap`.

    S = (I + L)^-1,   T = I - S,   L closed by negative feedback

A result is NaN if the closed loop is unstable, or if the fixed number of frequencies does not resolve the loop. A
margin that does not exist is infinite. A loop with several channels has the peaks of the largest singular value.

Derivatives are those of a smooth piece: of the peak, crossover or channel that is the worst. Where two are equally bad
the derivative is that of one of them, and on each side another. `FrequencyPeak.runner_up` and `Margin.runner_up` show
how near the next one is. A loop whose |L| touches 1 without crossing it has no crossover there.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from diffabs.core.types import Array, Bool, Scalar
from diffabs.linear.responses.grid import FrequencyGrid, place_frequencies
from diffabs.linear.responses.response import (
    TracedSystem,
    as_arrays,
    compile_for_systems,
    half_sampling_rate,
    largest_singular_values,
    loop_from,
    respond_sensitivity,
)
from diffabs.linear.responses.search import FrequencyPeak, Roots, find_peaks, find_roots, highest
from diffabs.linear.transfer import Transfer

PHASE_CROSSOVERS = 16  # crossings of the real axis that are looked at
FAR = 1e3  # times the highest frequency of the grid: infinity
ZERO_SENSITIVITY = 1e-9  # |S| below which L is infinite but for rounding

Change = Callable[[Array, Array], Array]  # maps S (k, m, m) and frequencies (k,) to matrices (k, p, q)


class Margin(NamedTuple):
    """A margin of a loop.

    Attributes:
        value: Value; infinity without a limit, NaN for an unstable closed loop.
        at: Frequency at which the limit is reached [rad/s]; NaN without one.
        runner_up: Value at the crossover that is next; infinity without one.
    """

    value: Scalar
    at: Scalar
    runner_up: Scalar


@compile_for_systems
def sensitivity_peak(loop: Transfer | TracedSystem) -> FrequencyPeak:
    """Return Ms, the greatest singular value of S over all frequencies; 1/Ms is the modulus margin.

    It is differentiable in the matrices and the delay, and works under `jit` and `vmap`.

    Args:
        loop: Open loop L with as many inputs as outputs, of order 1 or more. With a delay in continuous time and a
            direct path the result is NaN, and with a delay that is negative or no whole number of periods.

    Raises:
        ValueError: The loop is no `Transfer`, or its matrices do not fit each other.

    See also:
        `linear.margins`: All margins of one loop, in NumPy.
        `linear.multivariable_margins`: The same for a loop with several channels.

    Examples:
        >>> import jax
        >>> import numpy as np
        >>> from diffabs.linear import Transfer
        >>> from diffabs.linear.responses import sensitivity_peak
        >>> A = np.array([[-10.0, -10.0, -10.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        >>> def peak(gain):
        ...     return sensitivity_peak(Transfer(A, np.eye(3, 1), gain * np.eye(3)[2:], np.zeros((1, 1)))).value
        >>> value, slope = jax.value_and_grad(peak)(25.0)
        >>> print(f"{value:.6f}, {slope:.6f} for each unit of gain")
        2.486660, 0.078365 for each unit of gain
    """
    return _find_peak(loop, lambda s, _: s)


@compile_for_systems
def complementary_peak(loop: Transfer | TracedSystem) -> FrequencyPeak:
    """Return Mt, the greatest singular value of T over all frequencies. Arguments are those of `sensitivity_peak`."""
    return _find_peak(loop, lambda s, _: jnp.eye(s.shape[-1]) - s)


@compile_for_systems
def disk_margin(loop: Transfer | TracedSystem) -> Margin:
    """Return the disk margin a of a loop with one channel: 1/max |S - 1/2|.

    The closed loop stays stable if L is multiplied by (1 + d/2)/(1 - d/2) for any complex |d| < a. Arguments are those
    of `sensitivity_peak`.
    """
    peak = _find_peak(_single(loop), lambda s, _: s - 0.5)
    return Margin(1 / peak.value, peak.at, 1 / jnp.maximum(peak.runner_up, 0.0))


@compile_for_systems
def gain_margins(loop: Transfer | TracedSystem) -> tuple[Margin, Margin]:
    """Return the factors of the gain (below 1, above 1) at which a loop with one channel turns unstable.

    They are 0 and infinity without a limit. Arguments are those of `sensitivity_peak`.
    """
    loop = _single(loop)
    grid = place_frequencies(loop)
    values = _single_loop(grid.sensitivity)
    # With a delay L crosses the real axis for ever. The crossings with |L| near 1 are the limits.
    closeness = jnp.where(values.real < 0, -jnp.abs(jnp.log(jnp.abs(values))), -jnp.inf)
    roots = find_roots(
        lambda w: _respond_single(loop, w).imag,
        lambda w: _single_loop(grid.respond(w)).imag,
        grid.w,
        values.imag,
        closeness,
        PHASE_CROSSOVERS,
    )
    # At both ends of the axis L is real.
    ends = jnp.zeros(1) if loop.period is None else jnp.stack([jnp.zeros(()), half_sampling_rate(loop)])
    w = jnp.concatenate([roots.w, ends])
    s = respond_sensitivity(loop, w)[:, 0, 0]
    real = jnp.where(s == 0, -jnp.inf, (1 / jnp.where(s == 0, 1.0, s) - 1).real)
    valid = jnp.concatenate([roots.valid, jnp.ones(len(ends), bool)]) & (real < 0) & (real > -1 / ZERO_SENSITIVITY)
    factors = -1 / jnp.where(valid, real, -1.0)
    below = nearest_margin(-factors, w, valid & (factors < 1), grid.decided)
    above = nearest_margin(factors, w, valid & (factors > 1), grid.decided)
    lower = jnp.where(jnp.isinf(below.value), 0.0, -below.value)
    return Margin(lower, below.at, jnp.maximum(-below.runner_up, 0.0)), above


@compile_for_systems
def phase_margin(loop: Transfer | TracedSystem) -> Margin:
    """Return the smallest angle, lag or lead, that brings a loop with one channel to -1 [rad].

    Arguments are those of `sensitivity_peak`.
    """
    loop = _single(loop)
    return phase_margin_on(loop, place_frequencies(loop))


def phase_margin_on(loop: TracedSystem, grid: FrequencyGrid) -> Margin:
    """Return the phase margin of a loop of arrays whose frequencies are known."""
    roots, angles, decided = find_gain_crossovers(loop, grid)
    return nearest_margin(jnp.abs(angles), roots.w, roots.valid, decided)


@compile_for_systems
def delay_margin(loop: Transfer | TracedSystem) -> Margin:
    """Return the smallest added delay that makes a loop with one channel in continuous time unstable [s].

    It is 0 with a direct path of at least 1. Arguments are those of `sensitivity_peak`.

    Raises:
        ValueError: The loop is sampled. `sampled_delay_margin` samples it again with each delay.
    """
    loop = _single(loop)
    if loop.period is not None:
        raise ValueError("the loop is sampled: only whole periods of delay have a meaning for a Transfer")
    return delay_margin_on(loop, place_frequencies(loop))


def delay_margin_on(loop: TracedSystem, grid: FrequencyGrid) -> Margin:
    """Return the delay margin of a loop of arrays in continuous time whose frequencies are known."""
    roots, angles, decided = find_gain_crossovers(loop, grid)
    nearest = nearest_margin(jnp.mod(angles, 2 * jnp.pi) / roots.w, roots.w, roots.valid, decided)
    # A delay turns the limit D of L through all angles: with |D| >= 1 it reaches -1 at once.
    reaches = jnp.abs(loop.D[0, 0]) >= 1
    return nearest._replace(value=jnp.where(reaches & decided, 0.0, nearest.value))


def find_gain_crossovers(loop: TracedSystem, grid: FrequencyGrid) -> tuple[Roots, Array, Bool]:
    """Return the frequencies with |L| = 1, at most as many as states, the angle of -L there, and whether all is known.

    Angles lie in (-pi, pi].
    """

    def logarithm(sensitivity: Array) -> Array:
        return jnp.log(jnp.abs(_single_loop(sensitivity)))

    roots = find_roots(
        lambda w: logarithm(respond_sensitivity(loop, w)),
        lambda w: logarithm(grid.respond(w)),
        grid.w,
        logarithm(grid.sensitivity),
        -grid.w,
        loop.A.shape[0] + 1,
    )
    return roots, jnp.angle(-_respond_single(loop, roots.w)), grid.decided & roots.complete


def _respond_single(loop: TracedSystem, w: Array) -> Array:
    return _single_loop(respond_sensitivity(loop, w))


def _single_loop(sensitivity: Array) -> Array:
    return loop_from(sensitivity)[:, 0, 0]


def nearest_margin(values: Array, at: Array, valid: Array, decided: Bool) -> Margin:
    """Return the smallest of the valid values; infinity without one, NaN if nothing is decided."""
    values = jnp.where(valid, values, jnp.inf)
    first, second = jnp.argsort(values)[:2]
    value = jnp.where(decided, values[first], jnp.nan)
    return Margin(value, jnp.where(jnp.isfinite(value), at[first], jnp.nan), values[second])


def find_sensitivity_peaks(loop: TracedSystem, grid: FrequencyGrid, change: Change) -> tuple[Array, Array]:
    """Return the local maxima of the largest singular value of a function of S, and their frequencies.

    The maxima have no order; missing ones are -inf. Both ends of the frequency axis count, and the limit of a loop in
    continuous time, where the function gets a frequency far above the poles.
    """

    def measure(sensitivity: Array, w: Array) -> Array:
        return largest_singular_values(change(sensitivity, w))

    tops, at = find_peaks(
        lambda w: measure(respond_sensitivity(loop, w), w),
        lambda w: measure(grid.respond(w), w),
        grid.w,
        measure(grid.sensitivity, grid.w),
    )
    ends = jnp.zeros(1) if loop.period is None else jnp.stack([jnp.zeros(()), half_sampling_rate(loop)])
    tops, at = jnp.append(tops, measure(respond_sensitivity(loop, ends), ends)), jnp.append(at, ends)
    if loop.period is None:
        far = jnp.linalg.inv(jnp.eye(loop.D.shape[0]) + loop.D)
        tops, at = jnp.append(tops, measure(far[None], FAR * grid.w[-1:])), jnp.append(at, jnp.inf)
    return tops, at


def _find_peak(loop: Transfer | TracedSystem, change: Change) -> FrequencyPeak:
    loop = as_arrays(loop)
    grid = place_frequencies(loop)
    peak = highest(*find_sensitivity_peaks(loop, grid, change))
    return peak._replace(value=jnp.where(grid.decided, peak.value, jnp.nan))


def _single(loop: Transfer | TracedSystem) -> TracedSystem:
    """Return a loop with one channel as arrays. Raises ValueError for another one."""
    if np.shape(loop.D) != (1, 1):
        raise ValueError(f"L has the shape {np.shape(loop.D)}: this margin is of one channel")
    return as_arrays(loop)
