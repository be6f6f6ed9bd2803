"""Length of an adaptive step: limits by its error, by stability, by switching surfaces and by clocks.

Near a point of the run the margin x - y of a comparison moves along a line. It is zero at a time |x - y|/|d(x - y)/dt|
ahead or in the past. A step that ends there has its kink at its end, where the kink costs no accuracy.
"""

from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from diffabs.core.loop import Loop, LoopState
from diffabs.core.numerics import clamp
from diffabs.core.protocols import Sample
from diffabs.core.types import Array, Int, PyTree, Scalar
from diffabs.simulate.step.modes import WORD_BITS, ModeBits
from diffabs.simulate.step.system import SwitchingFunction

INITIAL_STEP_S = 1e-4  # s, the first step
SAFETY, MIN_ERROR = 0.85, 1e-6  # fraction of the optimal length; offset that keeps the length finite for an error of 0
MIN_STEP_RATIO, MAX_STEP_RATIO = 0.25, 2.5  # least and greatest ratio of a step to the last one
MIN_STEP_FRACTION = 1e-9  # fraction of the duration: the shortest step, or 4 times the rounding of the duration
TWO_STEP_RATIO = 1.2  # ratio to the present length: a nearer switching surface is reached in two equal steps
CLOCK_REACH_FRACTION = 0.99  # fraction of the time to a clock's instant: a longer step ends on the instant
STABILITY_RADIUS = 3.0  # the longest step is this number divided by the spectral radius
POWER_ITERATIONS, MIN_NORM = 12, 1e-20
NEVER_S = 1e9  # s; time to the next crossing if no crossing is predicted


# Tolerances of steps that end on switching surfaces. The first two are fractions of the length that the error allows: a
# crossing nearer than the first has happened, and the second is the shortest step that ends on a crossing. The last two
# are fractions of a step: a crossing outside of this range lies at one end of the step.
IMMEDIATE_FRACTION, MIN_CROSSING_STEP_FRACTION, STEP_START_FRACTION, STEP_END_FRACTION = 2e-4, 4e-3, 0.02, 0.95


def error_scales(state: LoopState, sample: Sample) -> PyTree:
    """Return the scales of the error: the size of the first signal or of its setpoint, and the size of every state.

    Args:
        state: State of the loop.
        sample: Sample of the signals.
    """
    first = jnp.maximum(jnp.abs(sample.output[0]), jnp.abs(sample.setpoint))
    return first, jax.tree.map(jnp.abs, state.flow())


def error_norm(loop: Loop, state: LoopState, off: Scalar, scale: Scalar, sample: Sample) -> PyTree:
    """Return the greatest error of all states and of the first signal, as a fraction of their scales.

    The errors of the states lie in the middle of the step. The first signal is evaluated with them at the end of the
    step, as an approximation.

    Args:
        loop: Closed loop.
        state: State at the end of the step.
        off: Errors of the states in the middle of the step.
        scale: Scales of the error: the largest values so far.
        sample: Sample at the end of the step.
    """
    moved = state.with_flow(jax.tree.map(lambda x, d: x - d, state.flow(), off))
    all_off = (loop.plant.output(moved.plant)[0] - sample.output[0], *jax.tree.leaves(off))
    pairs = zip(all_off, jax.tree.leaves(scale), strict=True)
    return jnp.max(jnp.stack([jnp.max(jnp.abs(d) / jnp.where(c > 0, c, 1.0)) for d, c in pairs if jnp.size(c)]))


def propose_length(length: Scalar, error: Scalar) -> Scalar:
    """Return the length that an error allows [s]: 0.85/error^(1/4) times the present length, within limits.

    Args:
        length: Present length [s].
        error: Error as a multiple of the allowed error.
    """
    return length * clamp(SAFETY / jnp.sqrt(jnp.sqrt(error + MIN_ERROR)), MIN_STEP_RATIO, MAX_STEP_RATIO)


def plan_step(length: Scalar, ahead: Scalar, left: Scalar, least: Scalar) -> tuple[PyTree, PyTree]:
    """Return the length of the next step [s], and True if the step ends where a clock strikes.

    Args:
        length: Length that the error and stability allow [s].
        ahead: Time to the next switching surface [s].
        left: Time to the next instant of a clock [s].
        least: Shortest length of any step [s].
    """
    # Two steps of 0.6 lengths instead of one full step and a very short one.
    near = jnp.where(ahead < TWO_STEP_RATIO * length, 0.5 * TWO_STEP_RATIO * length, length)
    length = jnp.where(
        ahead < length, jnp.maximum(ahead, jnp.maximum(MIN_CROSSING_STEP_FRACTION * length, least)), near
    )
    # A step just short of the clock's instant would leave a remainder near rounding. Else, two halves share the rest.
    ends = length > CLOCK_REACH_FRACTION * left
    return jnp.where(ends, left, jnp.where(2 * length > left, 0.5 * left, length)), ends


def spectral_step_limit(loop: Loop, t: Scalar, state: LoopState, scale: Scalar) -> Scalar:
    """Return the stability limit of a step, 3/rho [s], with an estimate rho of the spectral radius of the flow's
    Jacobian.

    A power iteration estimates rho: the growth of a vector per multiplication by the Jacobian. The components of
    the vector are relative to the largest values of the states so far.

    Args:
        loop: Closed loop.
        t: Time [s].
        state: State of the loop.
        scale: Largest values so far, as `error_scales` returns them.
    """
    flow, unflatten = ravel_pytree(state.flow())
    size = ravel_pytree(scale[1])[0]
    size = jnp.where(size > 0, size, 1.0)

    def rates(flow: PyTree) -> Any:
        at = state.with_flow(unflatten(flow))
        return ravel_pytree(loop.flow(t, at, loop.signals(t, at)))[0]

    moves = jnp.eye(size.size, dtype=size.dtype) * size
    columns = jax.vmap(lambda one: jax.jvp(rates, (flow,), (one,))[1])(moves) / size
    # Scalars instead of a matrix product: for such small sums XLA on a CPU calls a library, at ten times the cost.
    rows = [[columns[j, i] for j in range(size.size)] for i in range(size.size)]

    def longest(vector: list[PyTree]) -> Any:
        return reduce(jnp.maximum, map(jnp.abs, vector)) + MIN_NORM

    def multiply(at: tuple[list[PyTree], PyTree], counts: Int) -> tuple[tuple[list[PyTree], PyTree], None]:
        vector, log = at
        norm = longest(vector)
        vector = [x / norm for x in vector]
        vector = [sum(a * x for a, x in zip(row, vector, strict=True)) for row in rows]
        return (vector, log + counts * jnp.log(norm)), None

    # A scan instead of an unrolled loop: XLA would compute the matrix again in each round.
    half = POWER_ITERATIONS // 2
    # The growth is averaged over the second half of the iterations, after the first half has aligned the vector.
    later = jnp.asarray(np.arange(POWER_ITERATIONS) > half, t.dtype)
    # Logarithms: a product of the norms of a stiff loop would overflow single precision.
    vector, log = jax.lax.scan(multiply, (list(jnp.ones_like(size)), 0.0 * t), later)[0]
    return STABILITY_RADIUS * jnp.exp(-(log + jnp.log(longest(vector))) / half)


def forecast_crossing(surfaces: Sequence[SwitchingFunction], natural: Scalar, shortest: Scalar) -> Scalar:
    """Return the time [s] to the first predicted crossing of a switching surface; `NEVER_S` without one.

    A crossing nearer than `shortest`, or than `IMMEDIATE_FRACTION` of `natural`, is not counted.

    Args:
        surfaces: Margins of the comparisons and their rates, at an instant.
        natural: Length that the error allows [s].
        shortest: Shortest length of any step [s].
    """
    # A crossing nearer than this has happened.
    least, next = jnp.maximum(IMMEDIATE_FRACTION * natural, shortest), jnp.full_like(natural, -NEVER_S)
    for one in surfaces:
        for since in _times_since_crossing(one):
            next = jnp.where((since < -least) & (since > next), since, next)
    return -next


def time_since_crossing(surfaces: Sequence[SwitchingFunction], changed: ModeBits, length: Scalar) -> Scalar:
    """Return the time [s] between the first crossing inside a step and the end of the step; 0 without one.

    A crossing counts as inside between `STEP_START_FRACTION` and `STEP_END_FRACTION` of the step.

    Args:
        surfaces: Margins of the comparisons and their rates, at the end of the step.
        changed: Bits of the comparisons whose answers differ from those at the beginning of the step.
        length: Length of the step [s].
    """
    # Crossings outside of these fractions of the step lie at its ends.
    low, high = (1 - STEP_END_FRACTION) * length, (1 - STEP_START_FRACTION) * length
    first = low
    for one in surfaces:
        for on, since in zip(jnp.ravel(read_bits(changed, one.numbers)), _times_since_crossing(one), strict=True):
            first = jnp.where(on & (since < high) & (since > first), since, first)
    return jnp.where(first > low, first, 0.0)


def _times_since_crossing(surface: SwitchingFunction) -> Array:
    """Return the times since the crossings of these surfaces, shape (n,) [s]; negative for a crossing ahead.

    A rate of 0 gives an infinite time or NaN: no comparison with such a time is true.
    """
    return jnp.ravel(jnp.asarray(surface.value / surface.rate))


def valid_end_rates(surfaces: Sequence[SwitchingFunction], changed: ModeBits, length: Scalar) -> tuple[PyTree, PyTree]:
    """Return two flags, for the start and the end of a step: True if the rate there is also the rate inside the step.

    The start's flag is False if a comparison changes at the start. The end's flag is False if one changes later.

    Args:
        surfaces: Margins of the comparisons at the end of the step, and their rates.
        changed: Bits of the comparisons whose answers differ from those at the beginning of the step.
        length: Length of the step [s].
    """
    start = end = jnp.asarray(True)
    for one in surfaces:
        for on, since in zip(jnp.ravel(read_bits(changed, one.numbers)), _times_since_crossing(one), strict=True):
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
