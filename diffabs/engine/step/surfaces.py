"""Switching surfaces: where the margin of a comparison is zero, and when a run crosses it.

Near a point of the run the margin x - y of a comparison moves along a line. It is zero at a time |x - y|/|d(x - y)/dt|
ahead or in the past. A step that ends there has its kink at its end, where the kink costs no accuracy.
"""

from typing import NamedTuple

import jax.numpy as jnp

from diffabs.core.types import AnyArray, Array, Bool, Int, Scalar
from diffabs.engine.step.modes import ModeBits, split_number

NEVER_S = 1e9  # s; time to the next crossing if no crossing is predicted
# A crossing nearer than this fraction of the length that the error allows counts as past.
IMMEDIATE_FRACTION = 2e-4
# A crossing outside of these fractions of a step lies at one end of the step.
STEP_START_FRACTION, STEP_END_FRACTION = 0.02, 0.95


class SwitchingFunctions(NamedTuple):
    """Margins of comparisons, and their rates.

    Attributes:
        numbers: Numbers of the comparisons' bits, shape (n,).
        values: Margins x - y, shape (n,); within a mode, negative where the numbers contradict the answer.
        rates: Rates of the margins [1/s], shape (n,); None if they were not evaluated.
    """

    numbers: AnyArray
    values: Array
    rates: Array | None = None

    def times_since_crossing(self) -> Array:
        """Return the times since the margins were zero, shape (n,) [s]; negative for a crossing ahead.

        A rate of 0 gives an infinite time or NaN, which cuts no step.
        """
        assert self.rates is not None
        return self.values / self.rates

    def take_none(self) -> "SwitchingFunctions":
        """Return no functions, of the same types."""
        return SwitchingFunctions(self.numbers[:0], self.values[:0], None if self.rates is None else self.rates[:0])


def forecast_crossing(surfaces: SwitchingFunctions, natural: Scalar, shortest: Scalar) -> Scalar:
    """Return the time [s] to the first predicted crossing of a switching surface; `NEVER_S` without one.

    A crossing nearer than `shortest`, the shortest step [s], or than `IMMEDIATE_FRACTION` of `natural`, the length that
    the error allows [s], counts as past.
    """
    nearest, since = jnp.maximum(IMMEDIATE_FRACTION * natural, shortest), surfaces.times_since_crossing()
    return jnp.min(jnp.where(since < -nearest, -since, NEVER_S), initial=NEVER_S).astype(jnp.result_type(natural))


def time_since_crossing(surfaces: SwitchingFunctions, changed: ModeBits, length: Scalar) -> Scalar:
    """Return the time [s] between the first crossing inside a step and the end of the step; 0 without one.

    A crossing counts as inside between `STEP_START_FRACTION` and `STEP_END_FRACTION` of the step. `surfaces` are those
    at its end, and `changed` the bits of the comparisons whose answers differ from those at its beginning.
    """
    _, later, since = _find_changes(surfaces, changed, length)
    # Crossings outside of these fractions of the step lie at its ends.
    inside = later & (since > (1 - STEP_END_FRACTION) * length)
    return jnp.max(jnp.where(inside, since, 0.0), initial=0.0)


class Imminent(NamedTuple):
    """The comparison that a run is about to change.

    Attributes:
        number: Number of the comparison; -1 without one.
        time: Predicted time to the change [s].
    """

    number: Int
    time: Scalar


def find_imminent(surfaces: SwitchingFunctions, natural: Scalar) -> Imminent:
    """Return the comparison with the first predicted change, however near; later than `NEVER_S` counts as none."""
    ahead = -surfaces.times_since_crossing()
    ahead = jnp.where(ahead >= 0, ahead, NEVER_S)
    time = jnp.min(ahead, initial=NEVER_S).astype(jnp.result_type(natural))
    number = jnp.max(jnp.where((ahead == time) & (time < NEVER_S), jnp.asarray(surfaces.numbers), -1), initial=-1)
    return Imminent(number, time)


def find_return(imminent: Imminent, surfaces: SwitchingFunctions, changed: ModeBits, length: Scalar) -> Array:
    """Return the number of a comparison that a step crosses and that moves back in it or at its end; -1 without one."""
    assert surfaces.rates is not None
    numbers = jnp.asarray(surfaces.numbers)
    back = read_bits(changed, numbers) & (surfaces.values * surfaces.rates < 0)
    early = (imminent.time < STEP_START_FRACTION * length) & ~read_bits(changed, imminent.number)
    number = jnp.where(early, imminent.number, -1)
    return jnp.maximum(number, jnp.max(jnp.where(back, numbers, -1), initial=-1))


def valid_end_rates(surfaces: SwitchingFunctions, changed: ModeBits, length: Scalar) -> tuple[Bool, Bool]:
    """Return two flags, for the start and the end of a step: True if the rate there is also the rate inside the step.

    The start's flag is False if a comparison changes at the start. The end's flag is False if one changes later.
    """
    at_start, later, _ = _find_changes(surfaces, changed, length)
    return ~jnp.any(at_start), ~jnp.any(later)


def _find_changes(surfaces: SwitchingFunctions, changed: ModeBits, length: Scalar) -> tuple[AnyArray, AnyArray, Array]:
    """Return for each comparison: whether it changed at the start of a step, whether later, and the time since then.

    A change without a time, at a rate of 0, counts as later.
    """
    on, since = read_bits(changed, surfaces.numbers), surfaces.times_since_crossing()
    early = since >= (1 - STEP_START_FRACTION) * length
    return on & early, on & ~early, since


def is_surface_moving(surfaces: SwitchingFunctions, changed: ModeBits) -> Bool:
    """Return True if the margin of a comparison that changes in a step is not at rest at its end."""
    return jnp.any(read_bits(changed, surfaces.numbers) & (surfaces.rates != 0))  # pyright: ignore[reportOptionalOperand]


def read_bits(words: ModeBits, numbers: object) -> Bool:
    """Return the bits with these numbers, bool."""
    index, place = split_number(jnp.asarray(numbers))
    word = sum(jnp.where(index == i, bits, jnp.uint32(0)) for i, bits in enumerate(words))
    return word & (jnp.uint32(1) << place) != 0
