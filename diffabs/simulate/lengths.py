"""How long an adaptive step may be: by its error, by stability, by the kinks and clocks ahead."""

import dataclasses
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from diffabs.core.loop import Loop, LoopState
from diffabs.core.numerics import clamp
from diffabs.core.protocols import Sample
from diffabs.simulate.foresight import MIN_CROSSING_STEP_FRACTION

INITIAL_STEP_S = 1e-4  # s, the first step
SAFETY, MIN_ERROR = 0.85, 1e-6  # of the length that the error asks for; an error below which none counts
MIN_STEP_RATIO, MAX_STEP_RATIO = 0.25, 2.5  # times the last step, at least and at most
MIN_STEP_FRACTION = 1e-9  # of the duration: the shortest step; or 4 times its rounding
TWO_STEP_RATIO = 1.2  # times the present length: a kink so near is reached in two steps
CLOCK_REACH_FRACTION = 0.99  # of the way to a clock's instant: a step so long goes there
STABILITY_RADIUS = 3.0  # times the inverse of the spectral radius: the longest step
POWER_ITERATIONS, MIN_NORM = 12, 1e-20


@partial(jax.tree_util.register_dataclass, data_fields=["h", "steps", "rtol"], meta_fields=["keeps", "notes"])
@dataclasses.dataclass(frozen=True)
class StepSizeControl:
    """What `Adaptive` asks for: step of the grid [s], the number of its last instant, and the error of a step; whether
    what is between two instants of a run is to be seen, and whether what is needed to repeat it is noted."""

    h: Any
    steps: Any
    rtol: Any
    keeps: bool = False
    notes: bool = False

    @property
    def least(self) -> Any:
        """The shortest step [s]."""
        return self.h * self.steps * jnp.maximum(MIN_STEP_FRACTION, 4 * jnp.finfo(self.h.dtype).eps)

    def next_strike(self, loop: Loop, k: Any) -> Any:
        """The number of the first instant after the k-th at which a clock strikes, or the run ends."""
        return jnp.minimum(loop.next_tick(k, self.h), self.steps) if loop.ticks else self.steps


def error_scales(state: LoopState, sample: Sample) -> Any:
    """Return how large the first signal is, or where it shall go, and every state."""
    first = jnp.maximum(jnp.abs(sample.output[0]), jnp.abs(sample.setpoint))
    return first, jax.tree.map(jnp.abs, state.flow())


def error_norm(loop: Loop, state: LoopState, off: Any, scale: Any, sample: Sample) -> Any:
    """Return how far states are off, as a fraction of the largest values so far: the greatest of every one, and of the
    first signal, which they move at the end of the step as they would in its middle."""
    moved = state.with_flow(jax.tree.map(lambda x, d: x - d, state.flow(), off))
    all_off = (loop.plant.output(moved.plant)[0] - sample.output[0], *jax.tree.leaves(off))
    pairs = zip(all_off, jax.tree.leaves(scale), strict=True)
    return jnp.max(jnp.stack([jnp.max(jnp.abs(d) / jnp.where(c > 0, c, 1.0)) for d, c in pairs if jnp.size(c)]))


def propose_length(length: Any, error: Any) -> Any:
    """Return the length that an error allows, which is 1 in a step as long as it may be: 0.85/error^(1/4) times the
    present one."""
    return length * clamp(SAFETY / jnp.sqrt(jnp.sqrt(error + MIN_ERROR)), MIN_STEP_RATIO, MAX_STEP_RATIO)


def plan_step(length: Any, ahead: Any, left: Any, control: StepSizeControl) -> tuple[Any, Any]:
    """Return the length of the next step [s], and whether it ends where a clock strikes.

    length: that the error and stability allow; ahead, left: seconds to the next kink, and to the clock's instant"""
    near = jnp.where(ahead < TWO_STEP_RATIO * length, 0.5 * TWO_STEP_RATIO * length, length)
    length = jnp.where(
        ahead < length, jnp.maximum(ahead, jnp.maximum(MIN_CROSSING_STEP_FRACTION * length, control.least)), near
    )
    ends = length > CLOCK_REACH_FRACTION * left
    return jnp.where(ends, left, jnp.where(2 * length > left, 0.5 * left, length)), ends


def spectral_step_limit(loop: Loop, t: Any, state: LoopState, scale: Any) -> Any:
    """Return 3/rho [s], rho about the spectral radius of the flow's Jacobian: how much longer a vector becomes each
    time that it is multiplied by that, measured in the largest values so far."""
    flow, unflatten = ravel_pytree(state.flow())
    size = ravel_pytree(scale[1])[0]
    size = jnp.where(size > 0, size, 1.0)

    def rates(flow: Any) -> Any:
        at = state.with_flow(unflatten(flow))
        return ravel_pytree(loop.flow(t, at, loop.signals(t, at)))[0]

    moves = jnp.eye(size.size, dtype=size.dtype) * size
    columns = jax.vmap(lambda one: jax.jvp(rates, (flow,), (one,))[1])(moves) / size
    # Number by number: for sums over so few XLA on a CPU calls a library, which takes ten times as long.
    rows = [[columns[j, i] for j in range(size.size)] for i in range(size.size)]

    def longest(vector: list[Any]) -> Any:
        return reduce(jnp.maximum, map(jnp.abs, vector)) + MIN_NORM

    def multiplied(at: tuple[list[Any], Any], counts: Any) -> tuple[tuple[list[Any], Any], None]:
        vector, log = at
        norm = longest(vector)
        vector = [x / norm for x in vector]
        vector = [sum(a * x for a, x in zip(row, vector, strict=True)) for row in rows]
        return (vector, log + counts * jnp.log(norm)), None

    # A loop, and not its rounds one by one: XLA would work the matrix out anew in each of them.
    half = POWER_ITERATIONS // 2
    later = jnp.asarray(np.arange(POWER_ITERATIONS) > half, t.dtype)  # of the norms before, and the last one, below
    vector, log = jax.lax.scan(multiplied, (list(jnp.ones_like(size)), 0.0 * t), later)[0]
    return STABILITY_RADIUS * jnp.exp(-(log + jnp.log(longest(vector))) / half)
