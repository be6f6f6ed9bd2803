"""When comparisons will change, and when they did: from their margins and the rates of these.

A margin x - y of a comparison moves, near a point of the run, as a line: it is zero |x - y|/|d(x - y)/dt| later, or
earlier. A step that ends there has its kink at its end, where it does no harm."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from diffabs.core.regime import WORD, Words

AT_ONCE = 2e-4  # of the present length of a step: a comparison changes now, and not ahead
FAR = 1e9  # s, as good as never
SINCE = 0.02, 0.95  # of a step: outside of these it changed at one of the ends


class Margin(NamedTuple):
    """Of comparisons: the numbers of their bits, x - y, and its rate."""

    numbers: Any
    value: Any
    rate: Any


def until_next(margins: Sequence[Margin], length: Any) -> Any:
    """Return in how many seconds the first of the comparisons will change; a great number if none does.

    length: of the present step [s]"""
    least, soonest = AT_ONCE * length, jnp.full_like(length, FAR)
    for one in margins:
        for value, rate in zip(*(jnp.ravel(jnp.asarray(x)) for x in one[1:]), strict=True):
            ahead = -value / rate
            soonest = jnp.minimum(soonest, jnp.where(ahead > least, ahead, FAR))
    return soonest


def since_first(changed: Words, margins: Sequence[Margin], length: Any) -> Any:
    """Return how many seconds before the end of a step the first of those comparisons changed whose answers have; 0 if
    none did, but at the ends.

    margins: at the end. length: of the step [s]"""
    low, high = ((1 - share) * length for share in reversed(SINCE))
    longest = jnp.zeros_like(length)
    for one in margins:
        was = _bit(changed, one.numbers)
        for bit, value, rate in zip(*(jnp.ravel(jnp.asarray(x)) for x in (was, *one[1:])), strict=True):
            back = value / rate
            longest = jnp.maximum(longest, jnp.where(bit & (back > low) & (back < high), back, 0.0))
    return longest


def _bit(words: Words, numbers: Any) -> Any:
    numbers = jnp.asarray(numbers)
    word = sum(jnp.where(numbers // WORD == i, one, jnp.uint32(0)) for i, one in enumerate(words))
    return (word >> (numbers % WORD).astype(jnp.uint32)) & 1 != 0
