"""Length of an adaptive step: limits by its error, by stability, by switching surfaces and by clocks.

`modes` says when the run crosses the next switching surface.
"""

from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from diffabs.core.numerics import clamp
from diffabs.core.types import Array, Int, PyTree, Scalar
from diffabs.engine.hybrid import HybridSample, HybridState, HybridSystem

INITIAL_STEP_S = 1e-4  # s, the first step
SAFETY, MIN_ERROR = 0.85, 1e-6  # fraction of the optimal length; offset that keeps the length finite for an error of 0
MIN_STEP_RATIO, MAX_STEP_RATIO = 0.25, 2.5  # least and greatest ratio of a step to the last one
# Fraction of the duration, at least 4 times its rounding: within a shorter step nothing is located.
MIN_LOCATION_FRACTION = 1e-9
MIN_STEP_EPS = 4  # multiples of the rounding of the time: the shortest step
TWO_STEP_RATIO = 1.2  # ratio to the present length: a nearer switching surface is reached in two equal steps
CLOCK_REACH_FRACTION = 0.99  # fraction of the time to a clock's instant: a longer step ends on the instant
STABILITY_RADIUS = 3.0  # the longest step is this number divided by the spectral radius
POWER_ITERATIONS, MIN_NORM = 12, 1e-20
MAX_UNROLLED_STATES = 12  # numbers of a flow: the Jacobian of a larger one is not written out
MIN_CROSSING_STEP_FRACTION = 4e-3  # fraction of the length that the error allows: the shortest step to a crossing


def error_scales(state: HybridState, sample: HybridSample) -> PyTree:
    """Return the scales of the error: the sizes of the `error_controlled_signals` and of every state."""
    return sample.signal_scales(), jax.tree.map(jnp.abs, state.flow())


def first_error_scales(hybrid: HybridSystem, state: HybridState, sample: HybridSample) -> PyTree:
    """Return the scales at the start of a run, at least those of the system."""
    signals, states = error_scales(state, sample)
    least_scales = hybrid.least_scales(state)
    return signals, states if least_scales is None else jax.tree.map(jnp.maximum, states, least_scales)


def error_norm(
    hybrid: HybridSystem, state: HybridState, state_errors: PyTree, scale: PyTree, sample: HybridSample
) -> Array:
    """Return the greatest error of all states and of the `error_controlled_signals`, as a fraction of their scales.

    A scale of 0 counts as 1; there is no other absolute tolerance.

    The errors of the states lie in the middle of the step. The signals are evaluated with them at the end of the
    step, as an approximation.
    """
    moved = state.with_flow(jax.tree.map(lambda x, d: x - d, state.flow(), state_errors))
    signal_errors = jax.tree.map(
        jnp.subtract, hybrid.error_controlled_signals(moved), sample.error_controlled_signals()
    )
    pairs = zip(jax.tree.leaves((signal_errors, state_errors)), jax.tree.leaves(scale), strict=True)
    shares = [jnp.max(jnp.abs(d) / jnp.where(c > 0, c, 1.0)) for d, c in pairs if jnp.size(c)]
    return jnp.max(jnp.stack(shares or [jnp.asarray(0.0)]))


def propose_length(length: Scalar, error: Scalar) -> Scalar:
    """Return the length that an error allows [s]: 0.85/error^(1/4) times the present length, within limits."""
    return length * clamp(SAFETY / jnp.sqrt(jnp.sqrt(error + MIN_ERROR)), MIN_STEP_RATIO, MAX_STEP_RATIO)


def plan_step(length: Scalar, ahead: Scalar, to_strike: Scalar) -> tuple[PyTree, PyTree]:
    """Return the length of the next step [s], and True if the step ends where a clock strikes.

    `length` is what error and stability allow, `ahead` the time to the next switching surface [s], `to_strike` to the
    clock.
    """
    # Two steps of 0.6 lengths instead of one full step and a very short one.
    near = jnp.where(ahead < TWO_STEP_RATIO * length, 0.5 * TWO_STEP_RATIO * length, length)
    length = jnp.where(ahead < length, jnp.maximum(ahead, MIN_CROSSING_STEP_FRACTION * length), near)
    # A step just short of the clock's instant would leave a remainder near rounding. Else, two halves share the rest.
    ends = length > CLOCK_REACH_FRACTION * to_strike
    return jnp.where(ends, to_strike, jnp.where(2 * length > to_strike, 0.5 * to_strike, length)), ends


def shortest_step(t: Array) -> Scalar:
    """Return the shortest step [s] that changes the time `t` [s] by more than its rounding."""
    number = jnp.finfo(t.dtype)
    # At t = 0 numbers are far closer than steps need to be. This one keeps quotients by a step finite.
    return jnp.maximum(MIN_STEP_EPS * number.eps * jnp.abs(t), number.tiny / number.eps)


def spectral_step_limit(hybrid: HybridSystem, t: Array, state: HybridState, scale: PyTree) -> Scalar:
    """Return the stability limit of a step, 3/rho [s], with an estimate rho of the spectral radius of the flow's
    Jacobian.

    A power iteration estimates rho: the growth of a vector per multiplication by the Jacobian. The components of the
    vector are relative to the largest values of the states so far, `scale` (`error_scales`).
    """
    flow, unflatten = ravel_pytree(state.flow())
    size = ravel_pytree(scale[1])[0]
    size = jnp.where(size > 0, size, 1.0)

    def rates(flow: PyTree) -> Array:
        at = state.with_flow(unflatten(flow))
        return ravel_pytree(hybrid.flow(t, at, hybrid.signals(t, at)))[0]

    written_out, rows = size.size <= MAX_UNROLLED_STATES, []
    if written_out:
        moves = jnp.eye(size.size, dtype=size.dtype) * size
        columns = jax.vmap(lambda move: jax.jvp(rates, (flow,), (move,))[1])(moves) / size
        # Scalars instead of a matrix product: for such small sums XLA on a CPU calls a library, at ten times the cost.
        rows = [[columns[j, i] for j in range(size.size)] for i in range(size.size)]

    def longest(vector: list[PyTree]) -> Array:
        return reduce(jnp.maximum, (jnp.max(jnp.abs(x)) if x.ndim else jnp.abs(x) for x in vector)) + MIN_NORM

    def multiply(at: tuple[list[PyTree], PyTree], counts: Int) -> tuple[tuple[list[PyTree], PyTree], None]:
        vector, log = at
        norm = longest(vector)
        vector = [x / norm for x in vector]
        if written_out:
            vector = [sum(a * x for a, x in zip(row, vector, strict=True)) for row in rows]
        else:
            vector = [jax.jvp(rates, (flow,), (vector[0] * size,))[1] / size]
        return (vector, log + counts * jnp.log(norm)), None

    # A scan instead of an unrolled loop: XLA would compute the matrix again in each round.
    half = POWER_ITERATIONS // 2
    # The growth is averaged over the second half of the iterations, after the first half has aligned the vector.
    later = jnp.asarray(np.arange(POWER_ITERATIONS) > half, t.dtype)
    begin = list(jnp.ones_like(size)) if written_out else [jnp.ones_like(size)]
    # Logarithms: a product of the norms of a stiff loop would overflow single precision.
    vector, log = jax.lax.scan(multiply, (begin, 0.0 * t), later)[0]
    return STABILITY_RADIUS * jnp.exp(-(log + jnp.log(longest(vector))) / half)
