"""Sensors of several outputs, and the noise of one."""

from collections.abc import Iterator

import jax.numpy as jnp

from diffabs.core.blocks import Parallel, find_unnamed
from diffabs.core.channels import select_output
from diffabs.core.protocols import Block, Clock, Memory, no_flow, no_memory
from diffabs.core.pytree import param, part, pytree
from diffabs.core.rules import period_on_grid
from diffabs.core.types import PyTree, Scalar
from diffabs.core.units import Units
from diffabs.parts.sensors.noise import draw_noise


@pytree
class PerOutput(Parallel):
    """A sensor for each of several outputs, by the output's name; other outputs pass unchanged.

    A sensor of one output maps a number to a number, as do `OutputError`, `OutputNoise` and the actuators `Lag`,
    `Delay`, `DeadTime` and `Limits`. If the plant's output type has a method `channel`, the sensor of a tracked output
    instead sees the outputs of its channel: the slip and the speeds of a wheel.

    >>> from diffabs.parts.actuators import Lag
    >>> from diffabs.parts.sensors import OutputNoise, PerOutput
    >>> levels = PerOutput(sensor={"level_1": Lag(time_constant=2.0), "level_2": OutputNoise(deviation=1e-3)})
    """

    sensor: dict[str, Block] = part(default=dict, named=True)
    """Sensor of each output."""

    def by_channel(self) -> dict[str, Block]:
        """Return the sensor of each output, in alphabetical order: JAX rebuilds a dictionary with sorted keys."""
        return dict(sorted(self.sensor.items()))

    def select(self, name: str, signal: PyTree) -> PyTree:
        """Return the output, or the outputs of its channel."""
        output = select_output(signal, name)
        return output if _has_channel(signal, name) else output[0]

    def join(self, signal: PyTree, outputs: dict[str, PyTree]) -> PyTree:
        """Return all measured outputs."""
        for name, output in outputs.items():
            signal = (
                signal.with_channel(name, output) if _has_channel(signal, name) else signal._replace(**{name: output})
            )
        return signal

    def units_inside(self, name: str, units: Units) -> Units:
        """Return the units of an output's sensor, from those of the loop."""
        return units.of_channel("", name)

    def problems(self) -> Iterator[str]:
        """Yield a line if there is no sensor, or one without a name."""
        yield from find_unnamed("sensor", self.sensor, '{"level_1": OutputNoise()}')


def _has_channel(signal: PyTree, name: str) -> bool:
    """Return whether an output is that of a channel with outputs of its own."""
    return hasattr(signal, "channel") and name in type(signal).tracked


@pytree
class OutputError:
    """factor * signal + offset: an error of one measured output, of a wheel's radius or an accelerometer's zero."""

    factor: Scalar = param(default=1.0, unit="1", above=0.0)
    """Ratio of the shown output to the true one."""
    offset: Scalar = param(default=0.0, unit="signal")
    """Number added to the output."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return the output with its errors."""
        del t, memory
        return self.factor * signal + self.offset


@pytree
class OutputNoise:
    """Gaussian noise of one output, drawn every `period` and held. A run needs a random key."""

    deviation: Scalar = param(default=0.0, unit="signal", low=0.0)
    """Standard deviation."""
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    """Period of the draws, a whole multiple of the integration step."""

    flow = no_flow
    grid_rules = period_on_grid

    def start(self, signal: Scalar) -> Memory:
        """Return the memory with zero noise."""
        return Memory(held=0.0 * signal)

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return the signal plus the held noise."""
        del t
        return signal + memory.held

    def tick(self, clock: Clock, memory: Memory, signal: Scalar) -> Memory:
        """Return the memory with new noise if a period begins, else the old memory."""
        del signal
        now, draw = clock.ticks(self.period)
        return Memory(held=jnp.where(now, draw_noise(jnp.asarray(self.deviation), clock.key, draw), memory.held))
