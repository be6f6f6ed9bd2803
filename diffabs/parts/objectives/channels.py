"""Metrics of loops with several inputs: of one channel, and over all of them."""

import operator
from collections.abc import Iterator
from functools import reduce

from diffabs.core.channels import select_ending, select_sample, select_segment
from diffabs.core.protocols import Ending, Memory, Objective, Sample, Segment
from diffabs.core.pytree import param, part, pytree, static
from diffabs.core.types import PyTree, Scalar, Vector
from diffabs.core.units import Units, channel_unit
from diffabs.parts.objectives.tracking import IAE


@pytree
class InChannel:
    """The metric of one channel: an output with its target, a control with its command.

    The objective sees target, setpoint, command and control as numbers, and the output as the first one.

    >>> from diffabs.parts.objectives import IAE, Effort, InChannel
    >>> by_level = InChannel(objective=IAE(), output="level_1")
    >>> by_pump = InChannel(objective=Effort(), control="pump_1")
    """

    objective: Objective = part(default=IAE)
    """Objective for one control and one target."""
    output: str = static(default="")
    """Name of the output; empty for the first one with a target."""
    control: str = static(default="")
    """Name of the control; empty for the first one."""

    @property
    def unit(self) -> str:
        """Return the unit of the objective in this channel."""
        return channel_unit(self.objective.unit, self.control, self.output)

    def __getattr__(self, name: str) -> object:
        """Return what the objective says of its values: their range, and the value of a run without such a metric."""
        if name in ("physical", "unreached", "failure", "counts_kinks"):
            return getattr(self.objective, name)
        raise AttributeError(f"InChannel has no attribute {name}", name=name, obj=self)

    def units_inside(self, name: str, units: Units) -> Units:
        """Return the units of the channel."""
        del name
        return units.of_channel(self.control, self.output)

    def start(self, sample: Sample) -> Memory:
        """Return the accumulator of the objective."""
        return self.objective.start(select_sample(sample, self.control, self.output))

    def flow(self, memory: Memory, sample: Sample) -> PyTree:
        """Return its rate."""
        return self.objective.flow(memory, select_sample(sample, self.control, self.output))

    def update(self, memory: Memory, segment: Segment) -> PyTree:
        """Return its held memory after a step."""
        return self.objective.update(memory, select_segment(segment, self.control, self.output))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the metric."""
        return self.objective.value(memory, select_ending(ending, self.control, self.output))


@pytree
class OverChannels:
    """The weighted sum of a metric over channels, such as the sum of all integrals of the error.

    >>> from diffabs.parts.objectives import IAE, OverChannels
    >>> pairs = (("pump_1", "level_1"), ("pump_2", "level_2"))
    >>> both = OverChannels(objective=IAE(), channels=pairs, weights=(1.0, 2.0))
    """

    objective: Objective = part(default=IAE)
    """Objective for one control and one target."""
    channels: tuple[tuple[str, str], ...] = static(default=())
    """Pairs of a control and an output, one for each channel."""
    weights: Vector = param(default=(), unit="1", free=True)
    """Weight of each channel; none for weights of 1."""

    @property
    def unit(self) -> str:
        """Return the unit of the objective in the first channel; weights may convert the others."""
        return channel_unit(self.objective.unit, *(self.channels[0] if self.channels else ("", "")))

    def start(self, sample: Sample) -> Memory:
        """Return the accumulators of all channels."""
        memories = [self.objective.start(select_sample(sample, *channel)) for channel in self.channels]
        return Memory(tuple(m.flow for m in memories), tuple(m.held for m in memories))

    def flow(self, memory: Memory, sample: Sample) -> tuple[PyTree, ...]:
        """Return the rates of all channels."""
        return tuple(self.objective.flow(m, select_sample(sample, *channel)) for channel, m in self._each(memory))

    def update(self, memory: Memory, segment: Segment) -> tuple[PyTree, ...]:
        """Return the held memories of all channels after a step."""
        return tuple(self.objective.update(m, select_segment(segment, *channel)) for channel, m in self._each(memory))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the weighted sum."""
        values = [self.objective.value(m, select_ending(ending, *channel)) for channel, m in self._each(memory)]
        weights = self.weights if len(self.weights) else [1.0] * len(values)
        return reduce(operator.add, (weight * value for weight, value in zip(weights, values, strict=True)))

    def problems(self) -> Iterator[str]:
        """Yield a line if there is no channel, or another number of weights than channels."""
        if not self.channels:
            yield 'channels = () is empty; pairs are needed, such as (("pump_1", "level_1"),)'
        if len(self.weights) not in (0, len(self.channels)):
            yield f"weights has {len(self.weights)} numbers; there are {len(self.channels)} channels"

    def _each(self, memory: Memory) -> Iterator[tuple[tuple[str, str], Memory]]:
        for channel, flow, held in zip(self.channels, memory.flow, memory.held, strict=True):
            yield channel, Memory(flow, held)
