"""Sensor errors: noise, bias and quantisation, mostly with one parameter per measured channel."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from diffabs.core.numerics import axpy
from diffabs.core.protocols import BrakeOutput, Clock, Memory, no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import period_on_grid
from diffabs.core.types import Array, Key, PyTree, Scalar, Vector


@pytree
class Noise:
    """Independent Gaussian noise of each channel, drawn every `period` and held; the distance has none.

    The slip has noise of its own: it is not computed again from the noisy speeds. A run needs a random key
    (`rollout(..., key=)`), also with all deviations 0. The k-th draw is a function of (key, k), so a run is
    deterministic and differentiable in the deviations. A channel with deviation 0 draws nothing, because drawing would
    take most of the run's time.
    """

    slip: Scalar = param(default=0.0, unit="1", low=0.0)
    """Standard deviation of the slip's noise."""
    speed: Scalar = param(default=0.0, unit="m/s", low=0.0)
    """Standard deviation of the vehicle speed's noise."""
    wheel_speed: Scalar = param(default=0.0, unit="m/s", low=0.0)
    """Standard deviation of the wheel speed's noise."""
    deceleration: Scalar = param(default=0.0, unit="m/s^2", low=0.0)
    """Standard deviation of the deceleration's noise."""
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    """Period of the draws, a whole multiple of the integration step."""

    flow = no_flow
    grid_rules = period_on_grid

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with zero noise in every channel."""
        return Memory(held=jax.tree.map(lambda x: 0.0 * x, signal))

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Return the signal plus the held noise."""
        del t
        return axpy(1.0, memory.held, signal)

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """Return the memory with new noise if a period begins, else the old memory.

        Raises:
            ValueError: The run has no random key.
        """
        now, draw = clock.ticks(self.period)
        deviations = (self.slip, self.speed, self.wheel_speed, self.deceleration)
        # Every channel has its own draw number, so channels are independent.
        noise = [draw_noise(jnp.asarray(d), clock.key, len(deviations) * draw + i) for i, d in enumerate(deviations)]
        held = BrakeOutput(noise[0], noise[1], noise[2], noise[3], 0.0 * signal.distance)
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(now, a, b), held, memory.held))


@pytree
class WheelNoise:
    """Gaussian noise of the wheel speed, proportional to the vehicle speed: w_seen = w - v n, with n drawn every
    `period` and held.

    The slip shown is slip + n at any speed. A run needs a random key, also with deviation 0. Teeth of unequal width
    cause such noise. It also enters an estimate of the vehicle speed from the wheel speed.
    """

    slip: Scalar = param(default=0.0, unit="1", low=0.0)
    """Standard deviation of the slip's noise n."""
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    """Period of the draws, a whole multiple of the integration step."""

    flow = no_flow
    grid_rules = period_on_grid

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with zero noise."""
        return Memory(held=0.0 * signal.slip)

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Return the signal with noise in wheel speed and slip."""
        del t
        noise = memory.held
        return signal._replace(slip=signal.slip + noise, wheel_speed=signal.wheel_speed - signal.speed * noise)

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """Return the memory with new noise if a period begins, else the old memory.

        Raises:
            ValueError: The run has no random key.
        """
        del signal
        now, draw = clock.ticks(self.period)
        return Memory(held=jnp.where(now, draw_noise(jnp.asarray(self.slip), clock.key, draw), memory.held))


@pytree
class PlayedWheelNoise:
    """A given error of the wheel speed, proportional to the vehicle speed: w_seen = w - v n.

    Each period holds one entry of `noise` (length,), cyclically. The slip shown is slip + n. No random key is
    necessary. The entries of `noise` are parameters in place of the draws of `WheelNoise`: a recorded sequence, or the
    result of a search. A repeating sequence models the teeth of a wheel.
    """

    noise: Vector = param(default=(0.0,), unit="1", free=True)
    """Values of n, shape (length,)."""
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    """Period of the entries, a whole multiple of the integration step."""

    flow = no_flow
    grid_rules, start, output = period_on_grid, WheelNoise.start, WheelNoise.output

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """Return the memory with the next entry if a period begins, else the old memory."""
        del signal
        now, played = clock.ticks(self.period)
        noise = jnp.asarray(self.noise)
        entry = jax.lax.dynamic_index_in_dim(noise, played % noise.size, keepdims=False)
        return Memory(held=jnp.where(now, entry, memory.held))

    def problems(self) -> Iterator[str]:
        """Yield a message if `noise` is not a vector of at least one entry."""
        if np.ndim(self.noise) != 1 or np.size(self.noise) < 1:
            yield f"noise has shape {np.shape(self.noise)}; it needs (n,), n at least 1"


@jax.custom_jvp
def draw_noise(deviation: Scalar, key: Key, number: Scalar) -> Array:
    """Return deviation * z as a scalar, with z standard normal; a draw happens only if necessary.

    A deviation of 0 without a tangent draws nothing and returns 0. The tangent is z times the deviation's tangent, also
    at deviation 0. The key of the run and the number of the draw, folded into it, determine z.
    """
    if key is None:
        raise ValueError("a noisy sensor needs a random key: rollout(..., key=jax.random.key(seed))")
    return jax.lax.cond(deviation != 0, lambda: deviation * _normal(deviation, key, number), lambda: 0.0 * deviation)


def _rule(primals: PyTree, tangents: PyTree) -> tuple[PyTree, PyTree]:
    value, moving = draw_noise(*primals), type(tangents[0]) is not SymbolicZero
    return value, tangents[0] * _normal(*primals) if moving else jnp.zeros_like(value)


# Symbolic zeros let the rule skip the draw for a deviation that is not differentiated.
draw_noise.defjvp(_rule, symbolic_zeros=True)


def _normal(like: PyTree, key: Key, number: Scalar) -> Array:
    return jax.random.normal(jax.random.fold_in(key, number), (), like.dtype)


@pytree
class Bias:
    """measured = true + bias, for each channel; the distance has no bias.

    The slip has a bias of its own: it is not computed again from the biased speeds.
    """

    slip: Scalar = param(default=0.0, unit="1")
    """Bias of the slip."""
    speed: Scalar = param(default=0.0, unit="m/s")
    """Bias of the vehicle speed."""
    wheel_speed: Scalar = param(default=0.0, unit="m/s")
    """Bias of the wheel speed."""
    deceleration: Scalar = param(default=0.0, unit="m/s^2")
    """Bias of the deceleration."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Return the signal plus bias."""
        del t, memory
        return BrakeOutput(
            signal.slip + self.slip,
            signal.speed + self.speed,
            signal.wheel_speed + self.wheel_speed,
            signal.deceleration + self.deceleration,
            signal.distance,
        )


@pytree
class Quantisation:
    """measured = q round(true/q) for each channel; q = 0 leaves the channel unchanged.

    The distance has no q. The derivative with respect to the signal is 0, as on the treads of a staircase; it does not
    contain the jumps. A run does not depend smoothly on q: a derivative with respect to q raises a ValueError.
    """

    slip: Scalar = param(default=0.0, unit="1", low=0.0, tunable=False)
    """Step q of the slip."""
    speed: Scalar = param(default=0.0, unit="m/s", low=0.0, tunable=False)
    """Step q of the vehicle speed."""
    wheel_speed: Scalar = param(default=0.0, unit="m/s", low=0.0, tunable=False)
    """Step q of the wheel speed."""
    deceleration: Scalar = param(default=0.0, unit="m/s^2", low=0.0, tunable=False)
    """Step q of the deceleration."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Return each channel rounded to the nearest multiple of its q."""
        del t, memory
        return BrakeOutput(
            _round_to(signal.slip, self.slip),
            _round_to(signal.speed, self.speed),
            _round_to(signal.wheel_speed, self.wheel_speed),
            _round_to(signal.deceleration, self.deceleration),
            signal.distance,
        )


def _round_to(x: Scalar, q: Scalar) -> Array:
    # For q = 0 the divisor is 1, so that the branch not taken holds no NaN.
    divisible = jnp.greater(q, 0)
    q = jnp.where(divisible, q, 1.0)
    return jnp.where(divisible, q * jnp.round(x / q), x)
