"""Peaks and roots of functions of frequency, with right derivatives in the parameters of the function.

A search has no derivative. At its end stands one Newton step whose frequency depends on the parameters:

    peak    d/dw f(w, p) = 0    the value f(w(p), p) has the derivative df/dp (envelope theorem)
    root    f(w, p) = 0         dw/dp = -(df/dp)/(df/dw) (implicit function theorem)

Two equal peaks have a derivative on each side only; `FrequencyPeak.runner_up` shows them.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.types import Array, Bool, Scalar

MAX_PEAKS = 4  # highest local maxima of the grid that are refined
CLIMBS = 40  # Newton steps or bisections to a maximum
ROOT_HALVINGS = 60
SAME_PEAK = 1e-6  # relative distance in frequency below which two places are one maximum

FrequencyFunction = Callable[[Array], Array]  # maps w (k,) to real values (k,)


class FrequencyPeak(NamedTuple):
    """The greatest value of a function of frequency.

    Attributes:
        value: Value.
        at: Frequency [rad/s]; infinity for the limit of a system in continuous time.
        runner_up: Value of the next local maximum, -inf without one. If it equals `value`, the derivative of `value` is
            that of one of the two, so it is one-sided.
    """

    value: Scalar
    at: Scalar
    runner_up: Scalar


class Roots(NamedTuple):
    """Frequencies at which a function changes its sign.

    Attributes:
        w: Frequencies (k,) [rad/s]; those that are not valid are any number.
        valid: Which entries are roots (k,).
        complete: Whether there are no more roots on the grid than entries.
    """

    w: Array
    valid: Array
    complete: Bool


def find_peaks(function: FrequencyFunction, near: FrequencyFunction, w: Array, values: Array) -> tuple[Array, Array]:
    """Return the values of the `MAX_PEAKS` highest local maxima between the ends of a grid and their frequencies.

    `near` is the function but for small errors, for the search; `values` are those on the grid. Missing maxima are
    -inf. The values of maxima are differentiable, also twice.
    """
    values = jax.lax.stop_gradient(jnp.where(jnp.isfinite(values), values, -jnp.inf))
    middle = values[1:-1]
    heights, places = jax.lax.top_k(
        jnp.where((middle >= values[:-2]) & (middle > values[2:]), middle, -jnp.inf), MAX_PEAKS
    )
    at = _climb(near, w[places], w[places + 1], w[places + 2])
    value, slope, bend = _expand(function, at)
    # f - f'^2/(2 f'') is the value at the top of the parabola. It has the first and second derivatives of the maximum.
    bend = jax.lax.stop_gradient(bend)
    curved = bend < 0
    correction = jnp.where(curved, slope, 0.0) ** 2 / jnp.where(curved, -2 * bend, 1.0)
    # A flat function has no bend but rounding.
    still = (jnp.abs(slope) * at <= SAME_PEAK * jnp.abs(value)) | (jnp.abs(slope) <= SAME_PEAK * at * jnp.abs(bend))
    tops = jnp.where(jnp.isfinite(heights) & still, value + correction, -jnp.inf)
    # Two brackets may end on one maximum.
    same = jnp.abs(at[:, None] - at[None, :]) <= SAME_PEAK * jnp.abs(at[:, None])
    return jnp.where(jnp.any(jnp.tril(same, -1), axis=1), -jnp.inf, tops), at


def highest(values: Array, at: Array) -> FrequencyPeak:
    """Return the highest of some values as a peak."""
    top, places = jax.lax.top_k(values, 2)
    return FrequencyPeak(top[0], at[places[0]], top[1])


def _climb(function: FrequencyFunction, low: Array, at: Array, high: Array) -> Array:
    """Return maxima between two places each, by Newton steps on the slope; bisection where they leave the bracket."""

    def climb(_: object, places: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, at, high = places
        _, slope, bend = _expand(function, at)
        low, high = jnp.where(slope > 0, at, low), jnp.where(slope > 0, high, at)
        newton = at - slope / bend
        # Near the top the sign of the slope is rounding, and the bracket may exclude the top.
        near = jnp.abs(newton - at) <= SAME_PEAK * at
        inside = (bend < 0) & (near | ((newton > low) & (newton < high)))
        return low, jnp.where(inside, newton, 0.5 * (low + high)), high

    return jax.lax.stop_gradient(jax.lax.fori_loop(0, CLIMBS, climb, (low, at, high))[1])


def _expand(function: FrequencyFunction, at: Array) -> tuple[Array, Array, Array]:
    """Return value, slope and second derivative of a function at some frequencies."""

    def value_and_slope(w: Array) -> tuple[Array, Array]:
        return jax.jvp(function, (w,), (jnp.ones_like(w),))

    (value, slope), (_, bend) = jax.jvp(value_and_slope, (at,), (jnp.ones_like(at),))
    return value, slope, bend


def find_roots(
    function: FrequencyFunction, near: FrequencyFunction, w: Array, values: Array, ranks: Array, count: int
) -> Roots:
    """Return `count` frequencies at which a function changes its sign on a grid; differentiable.

    `near` and `values` are those of `find_peaks`. Of more sign changes those with the greatest of the `ranks` (k,) are
    taken. A rank of -inf excludes a frequency.
    """
    values, ranks = jax.lax.stop_gradient((values, ranks))
    negative = values <= 0
    crosses = (negative[1:] != negative[:-1]) & jnp.isfinite(values[1:]) & jnp.isfinite(values[:-1])
    ranks = jnp.where(crosses, jnp.maximum(ranks[1:], ranks[:-1]), -jnp.inf)
    highest_ranks, places = jax.lax.top_k(ranks, count)

    def halve(_: object, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        before = (near(middle) <= 0) == negative[places]
        return jnp.where(before, middle, low), jnp.where(before, high, middle)

    low, high = jax.lax.stop_gradient(jax.lax.fori_loop(0, ROOT_HALVINGS, halve, (w[places], w[places + 1])))
    at = 0.5 * (low + high)
    value, slope = jax.jvp(function, (at,), (jnp.ones_like(at),))
    slope = jax.lax.stop_gradient(slope)
    usable = jnp.isfinite(slope) & (slope != 0) & jnp.isfinite(value)
    step = jnp.where(usable, value, 0.0) / jnp.where(usable, slope, 1.0)
    return Roots(at - step, highest_ranks > -jnp.inf, jnp.sum(ranks > -jnp.inf) <= count)
