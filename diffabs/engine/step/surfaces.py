"""Switching surfaces: where the margin of a comparison is zero, and when a run crosses it.

Near a point of the run the margin x - y of a comparison moves along a line. It is zero at a time |x - y|/|d(x - y)/dt|
ahead or in the past. A step that ends there has its kink at its end, where the kink costs no accuracy.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp

from diffabs.core.types import Array, Bool, Int, PyTree, Scalar
from diffabs.engine.step.modes import WORD_BITS, ModeBits

NEVER_S = 1e9  # s; time to the next crossing if no crossing is predicted
# A crossing nearer than this fraction of the length that the error allows counts as past.
IMMEDIATE_FRACTION = 2e-4
# A crossing outside of these fractions of a step lies at one end of the step.
STEP_START_FRACTION, STEP_END_FRACTION = 0.02, 0.95


class SwitchingFunction(NamedTuple):
    """Margins of comparisons, and their rates.

    Attributes:
        numbers: Numbers of the comparisons' bits.
        value: Margins x - y; within a mode, negative where the numbers contradict the answer.
        rate: Rates of the margins [1/s]; None if they were not evaluated.
    """

    numbers: PyTree
    value: Scalar
    rate: Scalar | None = None


def forecast_crossing(surfaces: Sequence[SwitchingFunction], natural: Scalar, shortest: Scalar) -> Scalar:
    """Return the time [s] to the first predicted crossing of a switching surface; `NEVER_S` without one.

    A crossing nearer than `shortest`, the shortest step [s], or than `IMMEDIATE_FRACTION` of `natural`, the length that
    the error allows [s], counts as past.
    """
    nearest, next = jnp.maximum(IMMEDIATE_FRACTION * natural, shortest), jnp.full_like(natural, -NEVER_S)
    for surface in surfaces:
        for since in _times_since_crossing(surface):
            next = jnp.where((since < -nearest) & (since > next), since, next)
    return -next


def time_since_crossing(surfaces: Sequence[SwitchingFunction], changed: ModeBits, length: Scalar) -> Scalar:
    """Return the time [s] between the first crossing inside a step and the end of the step; 0 without one.

    A crossing counts as inside between `STEP_START_FRACTION` and `STEP_END_FRACTION` of the step. `surfaces` are those
    at its end, and `changed` the bits of the comparisons whose answers differ from those at its beginning.
    """
    # Crossings outside of these fractions of the step lie at its ends.
    first = low = (1 - STEP_END_FRACTION) * length
    for _, later, since in _list_changes(surfaces, changed, length):
        first = jnp.where(later & (since > first), since, first)
    return jnp.where(first > low, first, 0.0)


class Imminent(NamedTuple):
    """The comparison that a run is about to change.

    Attributes:
        number: Number of the comparison; -1 without one.
        time: Predicted time to the change [s].
    """

    number: Int
    time: Scalar


def find_imminent(surfaces: Sequence[SwitchingFunction], natural: Scalar) -> Imminent:
    """Return the comparison with the first predicted change, however near; later than `NEVER_S` counts as none."""
    number, time = jnp.asarray(-1), jnp.full_like(natural, NEVER_S)
    for surface in surfaces:
        ahead = -_times_since_crossing(surface)
        for bit, each in zip(jnp.ravel(jnp.asarray(surface.numbers)), ahead, strict=True):
            nearer = (each >= 0) & (each < time)
            number, time = jnp.where(nearer, bit, number), jnp.where(nearer, each, time)
    return Imminent(number, time)


def find_return(imminent: Imminent, surfaces: Sequence[SwitchingFunction], changed: ModeBits, length: Scalar) -> Array:
    """Return the number of a comparison that a step crosses and that moves back in it or at its end; -1 without one."""
    back = (imminent.time < STEP_START_FRACTION * length) & ~read_bits(changed, imminent.number)
    number = jnp.where(back, imminent.number, -1)
    for surface in surfaces:
        back = read_bits(changed, surface.numbers) & (surface.value * surface.rate < 0)  # pyright: ignore[reportOptionalOperand, reportOperatorIssue]
        number = jnp.maximum(number, jnp.max(jnp.where(back, jnp.asarray(surface.numbers), -1)))
    return number


def _times_since_crossing(surface: SwitchingFunction) -> Array:
    """Return the times since the crossings of these surfaces, shape (n,) [s]; negative for a crossing ahead.

    A rate of 0 gives an infinite time or NaN, which cuts no step.
    """
    return jnp.ravel(jnp.asarray(surface.value / surface.rate))  # pyright: ignore[reportOptionalOperand, reportOperatorIssue]


def valid_end_rates(surfaces: Sequence[SwitchingFunction], changed: ModeBits, length: Scalar) -> tuple[PyTree, PyTree]:
    """Return two flags, for the start and the end of a step: True if the rate there is also the rate inside the step.

    The start's flag is False if a comparison changes at the start. The end's flag is False if one changes later.
    """
    at_start = later = jnp.asarray(False)
    for one_at_start, one_later, _ in _list_changes(surfaces, changed, length):
        at_start, later = at_start | one_at_start, later | one_later
    return ~at_start, ~later


def _list_changes(
    surfaces: Sequence[SwitchingFunction], changed: ModeBits, length: Scalar
) -> Iterator[tuple[Bool, Bool, Scalar]]:
    """Yield for each comparison: whether it changed at the start of a step, whether later, and the time since then [s].

    A change without a time, at a rate of 0, counts as later.
    """
    for surface in surfaces:
        flips = jnp.ravel(read_bits(changed, surface.numbers))
        for on, since in zip(flips, _times_since_crossing(surface), strict=True):
            early = since >= (1 - STEP_START_FRACTION) * length
            yield on & early, on & ~early, since


def is_surface_moving(surfaces: Sequence[SwitchingFunction], changed: ModeBits) -> Bool:
    """Return True if the margin of a comparison that changes in a step is not at rest at its end."""
    moving = [jnp.any(read_bits(changed, surface.numbers) & (surface.rate != 0)) for surface in surfaces]
    return jnp.any(jnp.array(moving, bool))


def read_bits(words: ModeBits, numbers: object) -> Bool:
    """Return the bits with these numbers, bool."""
    numbers = jnp.asarray(numbers)
    word = sum(jnp.where(numbers // WORD_BITS == i, bits, jnp.uint32(0)) for i, bits in enumerate(words))
    return word & (jnp.uint32(1) << (numbers % WORD_BITS).astype(jnp.uint32)) != 0
