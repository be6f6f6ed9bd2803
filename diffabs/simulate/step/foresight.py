"""Predicted and past crossings of switching surfaces, from the margins of comparisons and their rates.

Near a point of the run the margin x - y of a comparison moves along a line. It is zero at a time |x - y|/|d(x - y)/dt|
ahead or in the past. A step that ends there has its kink at its end, where the kink costs no accuracy.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp

from diffabs.core.types import PyTree, Scalar
from diffabs.simulate.step.modes import WORD_BITS, ModeBits

NEVER_S = 1e9  # s; time to the next crossing if no crossing is predicted


# Tolerances of steps that end on switching surfaces. The first two are fractions of the length that the error allows: a
# crossing nearer than the first has happened, and the second is the shortest step that ends on a crossing. The last two
# are fractions of a step: a crossing outside of this range lies at one end of the step.
IMMEDIATE_FRACTION, MIN_CROSSING_STEP_FRACTION, STEP_START_FRACTION, STEP_END_FRACTION = 2e-4, 4e-3, 0.02, 0.95


class SwitchingFunction(NamedTuple):
    """Margins of comparisons with their rates.

    Attributes:
        numbers: Numbers of the comparisons' bits.
        value: Margins x - y.
        rate: Rates of the margins [1/s].
    """

    numbers: PyTree
    value: Scalar
    rate: PyTree


class CrossingForecast(NamedTuple):
    """Times to the next crossing and since the first crossing.

    Attributes:
        ahead: Time to the first predicted crossing [s]; a large number without one.
        late: Time [s] between the first crossing inside the step and the end of the step. 0 if all crossings lie at its
            ends.
    """

    ahead: Scalar
    late: Scalar


def forecast_crossings(
    margins: Sequence[SwitchingFunction], natural: Scalar, shortest: Scalar, changed: ModeBits, length: Scalar
) -> CrossingForecast:
    """Return the time to the next crossing and the time since the first crossing inside the step, for the end of a
    step.

    Args:
        margins: Margins of the comparisons and their rates, at the end of the step.
        natural: Length that the error allows [s].
        shortest: Shortest length of any step [s].
        changed: Bits of the comparisons whose answers differ from those at the beginning of the step.
        length: Length of the step [s].
    """
    least, low, high = (
        jnp.maximum(IMMEDIATE_FRACTION * natural, shortest),
        (1 - STEP_END_FRACTION) * length,
        (1 - STEP_START_FRACTION) * length,
    )
    next, first = jnp.full_like(length, -NEVER_S), low
    # value/rate is the time since the crossing, negative for a crossing ahead. A rate of 0 gives an infinite time or
    # NaN: neither `where` below selects it.
    for one in margins:
        was = read_bits(changed, one.numbers)
        for on, since in zip(*(jnp.ravel(jnp.asarray(x)) for x in (was, one.value / one.rate)), strict=True):
            next = jnp.where((since < -least) & (since > next), since, next)
            first = jnp.where(on & (since < high) & (since > first), since, first)
    return CrossingForecast(-next, jnp.where(first > low, first, 0.0))


def valid_end_rates(margins: Sequence[SwitchingFunction], changed: ModeBits, length: Scalar) -> tuple[PyTree, PyTree]:
    """Return two flags, for the start and the end of a step: True if the rate there is also the rate inside the step.

    The start's flag is False if a comparison changes at the start. The end's flag is False if one changes later.

    Args:
        margins: Margins of the comparisons at the end of the step, and their rates.
        changed: Bits of the comparisons whose answers differ from those at the beginning of the step.
        length: Length of the step [s].
    """
    start = end = jnp.asarray(True)
    for one in margins:
        was = read_bits(changed, one.numbers)
        for on, since in zip(*(jnp.ravel(jnp.asarray(x)) for x in (was, one.value / one.rate)), strict=True):
            early = since >= (1 - STEP_START_FRACTION) * length
            start, end = start & ~(on & early), end & ~(on & ~early)
    return start, end


def read_bits(words: ModeBits, numbers: PyTree) -> Scalar:
    """Return the bits with these numbers, bool.

    Args:
        words: Packed bits.
        numbers: Numbers of the bits.
    """
    numbers = jnp.asarray(numbers)
    word = sum(jnp.where(numbers // WORD_BITS == i, one, jnp.uint32(0)) for i, one in enumerate(words))
    return word & (jnp.uint32(1) << (numbers % WORD_BITS).astype(jnp.uint32)) != 0
