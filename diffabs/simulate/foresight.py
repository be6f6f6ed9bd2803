"""When comparisons will change, and when they did: from their margins and the rates of these.

A margin x - y of a comparison moves, near a point of the run, as a line: it is zero |x - y|/|d(x - y)/dt| later, or
earlier. A step that ends there has its kink at its end, where it does no harm."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from diffabs.core.modes import WORD_BITS, ModeBits

NEVER_S = 1e9  # s, as good as never


# How exactly steps end on comparisons. As fractions of the length that the error allows: what changes so soon changes
# now; the shortest step that ends there. And of a step: outside of these two a comparison changed at one end.
IMMEDIATE_FRACTION, MIN_CROSSING_STEP_FRACTION, STEP_START_FRACTION, STEP_END_FRACTION = 2e-4, 4e-3, 0.02, 0.95


class SwitchingFunction(NamedTuple):
    """Of comparisons: the numbers of their bits, x - y, and its rate."""

    numbers: Any
    value: Any
    rate: Any


class CrossingForecast(NamedTuple):
    """In how many seconds the first of the comparisons will change, a great number if none does; and how many seconds
    before the end of a step the first of those changed whose answers have, 0 if none did but at its ends."""

    ahead: Any
    late: Any


def forecast_crossings(
    margins: Sequence[SwitchingFunction], natural: Any, shortest: Any, changed: ModeBits, length: Any
) -> CrossingForecast:
    """Return what the margins at the end of a step say.

    natural: the length that the error allows [s]; shortest: that of any step [s]
    changed: bits of the comparisons whose answers are others than at the beginning of the step
    length: of the step [s]"""
    least, low, high = (
        jnp.maximum(IMMEDIATE_FRACTION * natural, shortest),
        (1 - STEP_END_FRACTION) * length,
        (1 - STEP_START_FRACTION) * length,
    )
    next, first = jnp.full_like(length, -NEVER_S), low
    for one in margins:
        was = read_bits(changed, one.numbers)
        for on, since in zip(*(jnp.ravel(jnp.asarray(x)) for x in (was, one.value / one.rate)), strict=True):
            next = jnp.where((since < -least) & (since > next), since, next)
            first = jnp.where(on & (since < high) & (since > first), since, first)
    return CrossingForecast(-next, jnp.where(first > low, first, 0.0))


def valid_end_rates(margins: Sequence[SwitchingFunction], changed: ModeBits, length: Any) -> tuple[Any, Any]:
    """Return whether the rates at the start of a step, and those at its end, are those within it: no comparison has
    changed there."""
    start = end = jnp.asarray(True)
    for one in margins:
        was = read_bits(changed, one.numbers)
        for on, since in zip(*(jnp.ravel(jnp.asarray(x)) for x in (was, one.value / one.rate)), strict=True):
            early = since >= (1 - STEP_START_FRACTION) * length
            start, end = start & ~(on & early), end & ~(on & ~early)
    return start, end


def read_bits(words: ModeBits, numbers: Any) -> Any:
    """Return the bits of these numbers."""
    numbers = jnp.asarray(numbers)
    word = sum(jnp.where(numbers // WORD_BITS == i, one, jnp.uint32(0)) for i, one in enumerate(words))
    return word & (jnp.uint32(1) << (numbers % WORD_BITS).astype(jnp.uint32)) != 0
