"""Sensor errors: noise, bias, quantisation. Each has one parameter per measured channel."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from diffabs.core.numerics import axpy
from diffabs.core.protocols import BrakeOutput, Clock, Memory, no_flow, no_memory
from diffabs.core.pytree import Scalar, Vector, param, pytree
from diffabs.core.rules import Rule
from diffabs.core.timing import whole_steps


@pytree
class Noise:
    """Gaussian noise of these standard deviations, drawn every `period` and held. Needs a key: `rollout(..., key=)`.

    The k-th draw is a function of (key, k), so a run is deterministic and differentiable in the deviations. A channel
    whose deviation is 0 draws nothing, which would take most of the time.
    """

    slip: Scalar = param(default=0.0, unit="1", low=0.0)
    speed: Scalar = param(default=0.0, unit="m/s", low=0.0)
    wheel_speed: Scalar = param(default=0.0, unit="m/s", low=0.0)
    deceleration: Scalar = param(default=0.0, unit="m/s^2", low=0.0)
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)

    flow = no_flow

    def start(self, signal: BrakeOutput) -> Memory:
        """No noise before the first draw."""
        return Memory(held=jax.tree.map(lambda x: 0.0 * x, signal))

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Signal plus noise."""
        del t
        return axpy(1.0, memory.held, signal)

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """Draw at the instants of the period. Raises ValueError without a key."""
        if clock.key is None:
            raise ValueError("a noisy sensor needs a random key: rollout(..., key=jax.random.key(seed))")
        now, draw = clock.ticks(self.period)
        deviations = (self.slip, self.speed, self.wheel_speed, self.deceleration)
        noise = [drawn(jnp.asarray(d), clock.key, len(deviations) * draw + i) for i, d in enumerate(deviations)]
        held = BrakeOutput(noise[0], noise[1], noise[2], noise[3], 0.0 * signal.distance)
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(now, a, b), held, memory.held))

    def grid_rules(self, step: float) -> Iterator[Rule]:
        """The period is on the integration grid."""
        yield whole_steps("period", self.period, step)


@pytree
class WheelNoise:
    """Gaussian noise of the wheel's speed in proportion to the vehicle's, w_seen = w - v n, drawn every `period` and
    held, so that the measured slip has the noise n of this standard deviation at any speed. Needs a key.

    That is what teeth of unequal width do; whoever estimates the vehicle's speed from the wheel's sees it, too."""

    slip: Scalar = param(default=0.0, unit="1", low=0.0)
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)

    flow = no_flow
    grid_rules = Noise.grid_rules

    def start(self, signal: BrakeOutput) -> Memory:
        """No noise before the first draw."""
        return Memory(held=0.0 * signal.slip)

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Wheel speed and slip with noise."""
        del t
        noise = memory.held
        return signal._replace(slip=signal.slip + noise, wheel_speed=signal.wheel_speed - signal.speed * noise)

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """Draw at the instants of the period. Raises ValueError without a key."""
        del signal
        if clock.key is None:
            raise ValueError("a noisy sensor needs a random key: rollout(..., key=jax.random.key(seed))")
        now, draw = clock.ticks(self.period)
        return Memory(held=jnp.where(now, drawn(jnp.asarray(self.slip), clock.key, draw), memory.held))


@pytree
class PlayedWheelNoise:
    """A given error of the wheel's speed in proportion to the vehicle's, w_seen = w - v n: an entry of `noise` (n,) for
    each period, held, and again from the first after the last.

    What `WheelNoise` draws, as parameters: a recorded sequence, or one that is looked for. One that repeats is what
    the teeth of a wheel do."""

    noise: Vector = param(default=(0.0,), unit="1", free=True)
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)

    flow = no_flow
    grid_rules, start, output = Noise.grid_rules, WheelNoise.start, WheelNoise.output

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """The next entry at the instants of the period."""
        del signal
        now, played = clock.ticks(self.period)
        noise = jnp.asarray(self.noise)
        entry = jax.lax.dynamic_index_in_dim(noise, played % noise.size, keepdims=False)
        return Memory(held=jnp.where(now, entry, memory.held))

    def problems(self) -> Iterator[str]:
        """No noise."""
        if np.ndim(self.noise) != 1 or np.size(self.noise) < 1:
            yield f"noise has shape {np.shape(self.noise)}; it needs (n,), n at least 1"


@jax.custom_jvp
def drawn(deviation: Any, key: Any, number: Any) -> Any:
    """deviation z: z is drawn only where it counts, or where it is the derivative."""
    return jax.lax.cond(deviation != 0, lambda: deviation * _normal(deviation, key, number), lambda: 0.0 * deviation)


def _rule(primals: Any, tangents: Any) -> tuple[Any, Any]:
    value, moving = drawn(*primals), type(tangents[0]) is not SymbolicZero
    return value, tangents[0] * _normal(*primals) if moving else jnp.zeros_like(value)


drawn.defjvp(_rule, symbolic_zeros=True)


def _normal(like: Any, key: Any, number: Any) -> Any:
    return jax.random.normal(jax.random.fold_in(key, number), (), like.dtype)


@pytree
class Bias:
    """measured = true + bias."""

    slip: Scalar = param(default=0.0, unit="1")
    speed: Scalar = param(default=0.0, unit="m/s")
    wheel_speed: Scalar = param(default=0.0, unit="m/s")
    deceleration: Scalar = param(default=0.0, unit="m/s^2")

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Signal plus bias."""
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
    """measured = q round(true/q) for each channel; q = 0 leaves the channel alone.

    The derivative in the signal is that of a staircase, 0: it says nothing of the jumps. A run does not depend smoothly
    on q: differentiating it by q raises a ValueError.
    """

    slip: Scalar = param(default=0.0, unit="1", low=0.0, tunable=False)
    speed: Scalar = param(default=0.0, unit="m/s", low=0.0, tunable=False)
    wheel_speed: Scalar = param(default=0.0, unit="m/s", low=0.0, tunable=False)
    deceleration: Scalar = param(default=0.0, unit="m/s^2", low=0.0, tunable=False)

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """The nearest multiples."""
        del t, memory
        return BrakeOutput(
            _rounded(signal.slip, self.slip),
            _rounded(signal.speed, self.speed),
            _rounded(signal.wheel_speed, self.wheel_speed),
            _rounded(signal.deceleration, self.deceleration),
            signal.distance,
        )


def _rounded(x: Scalar, q: Scalar) -> Any:
    fine = jnp.greater(q, 0)
    q = jnp.where(fine, q, 1.0)
    return jnp.where(fine, q * jnp.round(x / q), x)
