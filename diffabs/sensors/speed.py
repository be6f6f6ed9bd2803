"""How slip is really measured: from the wheel's speed, and from a vehicle speed that nobody measures directly."""

import jax.numpy as jnp

from diffabs.core.protocols import BrakeOutput, Memory, no_flow, no_memory
from diffabs.core.pytree import Scalar, param, pytree


@pytree
class WheelSpeed:
    """A wheel-speed sensor with a first-order filter, w' = (true - w)/T; the slip is computed from it as (v - w)/v."""

    time_constant: Scalar = param(default=0.002, unit="s", above=0.0)
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)

    def start(self, signal: BrakeOutput) -> Memory:
        """The filter at the true speed."""
        return Memory(flow=signal.wheel_speed)

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """w'."""
        del t
        return (signal.wheel_speed - memory.flow) / self.time_constant

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Filtered wheel speed, and the slip computed with it."""
        del t
        slip = (signal.speed - memory.flow) / jnp.maximum(signal.speed, self.floor)
        return signal._replace(slip=slip, wheel_speed=memory.flow)


@pytree
class IntegratedAccelerometer:
    """Vehicle speed as the integral of an accelerometer, v' = -deceleration + bias, and the slip computed with it.

    Aoki and Nakamura, sec. 4: "obtained by integrating the acceleration sensors". The bias is that of the signed
    forward acceleration: a positive one makes the vehicle seem too fast, the slip too large, and releases the brake.
    The `floor` on the speed in the slip's denominator limits what this does near standstill."""

    bias: Scalar = param(default=0.0, unit="m/s^2")
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)

    def start(self, signal: BrakeOutput) -> Memory:
        """The speed at which braking starts is known: the wheel still rolls."""
        return Memory(flow=signal.speed)

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """v'."""
        del t, memory
        return self.bias - signal.deceleration

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Estimated speed, biased deceleration, slip."""
        del t
        v = memory.flow
        slip = (v - signal.wheel_speed) / jnp.maximum(v, self.floor)
        return signal._replace(slip=slip, speed=v, deceleration=signal.deceleration - self.bias)


@pytree
class SpeedScale:
    """A vehicle speed that is off by a factor, v = factor * true, and the slip computed with it, (v - w)/v.

    What a wrong rolling radius does to a speed that is estimated from another wheel. A speed seen low hides slip: held
    at a slip s as measured, the wheel slips by 1 - factor (1 - s)."""

    factor: Scalar = param(default=1.0, unit="1", above=0.0)
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Scaled speed, and the slip computed with it and the true wheel's speed."""
        del t, memory
        v = self.factor * signal.speed
        return signal._replace(slip=(v - signal.wheel_speed) / jnp.maximum(v, self.floor), speed=v)


@pytree
class DriftingSpeed:
    """A vehicle speed whose relative error drifts, and the slip computed with it and the wheel's speed as it is seen.

        v_seen = (1 + e) v,   e = last + (first - last) exp(-t/T),   slip = (v_seen - w)/v_seen

    Held at the slip s as measured, the wheel slips by s - e (1 - s): a speed that is seen low (e < 0) hides slip."""

    first: Scalar = param(default=0.0, unit="1", above=-1.0)
    last: Scalar = param(default=0.0, unit="1", above=-1.0)
    time_constant: Scalar = param(default=0.5, unit="s", above=0.0)
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """The speed that is off, and the slip computed with it."""
        del memory
        error = self.last + (self.first - self.last) * jnp.exp(-t / self.time_constant)
        v = (1 + error) * signal.speed
        return signal._replace(slip=(v - signal.wheel_speed) / jnp.maximum(v, self.floor), speed=v)
