"""Slip sensors with realistic errors: slip from a wheel-speed sensor, and from a vehicle speed that is estimated."""

import jax.numpy as jnp

from diffabs.core.protocols import BrakeOutput, Memory, no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar


@pytree
class WheelSpeed:
    """A wheel-speed sensor with a first-order filter, w' = (true - w)/T, and the slip (v - w)/max(v, floor)."""

    time_constant: Scalar = param(default=0.002, unit="s", above=0.0)
    """Time constant T of the low-pass filter."""
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)
    """Least speed in the slip's denominator."""

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with the filter at the true wheel speed."""
        return Memory(flow=signal.wheel_speed)

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Return w' [m/s^2]."""
        del t
        return (signal.wheel_speed - memory.flow) / self.time_constant

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Return the signal with the filtered wheel speed, and the slip computed from it."""
        del t
        slip = (signal.speed - memory.flow) / jnp.maximum(signal.speed, self.floor)
        return signal._replace(slip=slip, wheel_speed=memory.flow)


@pytree
class IntegratedAccelerometer:
    """Vehicle speed as the integral of an accelerometer, v' = -deceleration + bias, and the slip computed with it.

    The bias is that of the signed forward acceleration. A positive bias makes the estimated speed too high and the slip
    too large, which releases the brake. The `floor` limits this effect near standstill.

    Source: Aoki and Nakamura, sec. 4: "obtained by integrating the acceleration sensors".
    """

    bias: Scalar = param(default=0.0, unit="m/s^2")
    """Bias of the forward acceleration."""
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)
    """Least speed in the slip's denominator."""

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with the true speed: it is known at the start of braking, because the wheel still rolls."""
        return Memory(flow=signal.speed)

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Return v' = bias - deceleration [m/s^2]."""
        del t, memory
        return self.bias - signal.deceleration

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Return the signal with estimated speed v, deceleration - bias, and slip (v - w)/max(v, floor)."""
        del t
        v = memory.flow
        slip = (v - signal.wheel_speed) / jnp.maximum(v, self.floor)
        return signal._replace(slip=slip, speed=v, deceleration=signal.deceleration - self.bias)


@pytree
class SpeedScale:
    """A vehicle speed with a relative error, v = factor * true, and the slip (v - w)/max(v, floor).

    A wrong rolling radius has this effect on a speed that is estimated from another wheel. A factor below 1 hides slip:
    at a measured slip s, the wheel slips by 1 - factor (1 - s).
    """

    factor: Scalar = param(default=1.0, unit="1", above=0.0)
    """Ratio of the shown speed to the true one."""
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)
    """Least speed in the slip's denominator."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Return the signal with the scaled speed, and the slip computed with it and the measured wheel speed."""
        del t, memory
        v = self.factor * signal.speed
        return signal._replace(slip=(v - signal.wheel_speed) / jnp.maximum(v, self.floor), speed=v)


@pytree
class DriftingSpeed:
    """A vehicle speed with a relative error e that drifts, and the slip computed with it and the given wheel speed w.

        v_seen = (1 + e) v,   e = last + (first - last) exp(-t/T),   slip = (v_seen - w)/max(v_seen, floor)

    At a measured slip s, the wheel slips by s - e (1 - s). An error e < 0 hides slip.
    """

    first: Scalar = param(default=0.0, unit="1", above=-1.0)
    """Relative error at t = 0."""
    last: Scalar = param(default=0.0, unit="1", above=-1.0)
    """Relative error for large t."""
    time_constant: Scalar = param(default=0.5, unit="s", above=0.0)
    """Time constant T of the drift."""
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)
    """Least speed in the slip's denominator."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Return the signal with v_seen as speed, and the slip computed with it."""
        del memory
        error = self.last + (self.first - self.last) * jnp.exp(-t / self.time_constant)
        v = (1 + error) * signal.speed
        return signal._replace(slip=(v - signal.wheel_speed) / jnp.maximum(v, self.floor), speed=v)
