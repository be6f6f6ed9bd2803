"""Slip from the positions of two encoders, as a computer measures it.

    V = (position - position one period ago)/period, 0 below the dead zone,   slip = (V2 - V1)/(V2 + floor)

V1 is the speed of the wheel's rim, V2 that of the vehicle. Each is the mean over the last period. The shown values lag
by half a period at a sample, and by one and a half just before the next one.

Source: the driver of INTECO's laboratory anti-lock brake system, class `cabs`: 10 ms, 0.05 m/s, 0.01 m/s.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.protocols import BrakeOutput, Clock, Memory
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import period_on_grid
from diffabs.core.types import Scalar


class EncoderMemory(NamedTuple):
    """Positions at the latest sample, and the speeds over the period before it.

    Attributes:
        wheel: Path of the wheel's rim [m].
        vehicle: Path of the vehicle [m].
        wheel_speed: Mean speed of the rim over the last period, before the dead zone [m/s].
        speed: Mean speed of the vehicle over the last period, before the dead zone [m/s].
    """

    wheel: Scalar
    vehicle: Scalar
    wheel_speed: Scalar
    speed: Scalar


@pytree
class EncoderSlip:
    """Slip and speeds from differences of positions every `period`, held in between.

    The deceleration and the distance are the true ones.
    """

    period: Scalar = param(default=0.01, unit="s", above=0.0, tunable=False)
    """Period of the samples, a whole multiple of the integration step."""
    dead_zone: Scalar = param(default=0.05, unit="m/s", low=0.0, tunable=False)
    """A speed below it counts as 0."""
    floor: Scalar = param(default=0.01, unit="m/s", above=0.0)
    """Least speed in the slip's denominator, which is added there."""

    grid_rules = period_on_grid

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with the rim's path 0, the true distance, and the true speeds for the period before."""
        zero = 0.0 * signal.speed
        return Memory(zero, EncoderMemory(zero, signal.distance, signal.wheel_speed, signal.speed))

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Return the true speed of the wheel's rim [m/s]: the rate of its path."""
        del t, memory
        return signal.wheel_speed

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> BrakeOutput:
        """Return the signal with the speeds of the latest sample, and the slip computed from them."""
        del t
        w, v = (jnp.where(x < self.dead_zone, 0.0, x) for x in (memory.held.wheel_speed, memory.held.speed))
        return signal._replace(slip=(v - w) / (v + self.floor), speed=v, wheel_speed=w)

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """Return the memory with new positions and speeds if a period begins, else the old memory.

        The first sample has no earlier position: it keeps the speeds of the start.
        """
        m: EncoderMemory = memory.held
        now, number = clock.ticks(self.period)
        moved = (memory.flow - m.wheel) / self.period, (signal.distance - m.vehicle) / self.period
        new = EncoderMemory(memory.flow, signal.distance, *moved)
        now = now & (number > 0)
        return Memory(memory.flow, jax.tree.map(lambda a, b: jnp.where(now, a, b), new, m))
