"""Blocks in series, for sensors and actuators, and the identity block."""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import TypeVar

import jax
import jax.numpy as jnp

from diffabs.core.arrays import steps_in_period
from diffabs.core.cubic import HermiteStep
from diffabs.core.protocols import Block, Clock, Memory, no_flow, no_memory
from diffabs.core.pytree import part, pytree
from diffabs.core.types import Int, Part, PyTree, Scalar

T = TypeVar("T")


@pytree
class Direct:
    """A perfect sensor, or an actuator without limits: the output is the signal itself."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: T) -> T:
        """Return the signal."""
        del t, memory
        return signal


@pytree
class Series:
    """Blocks in series, the first one nearest to the input."""

    blocks: tuple[Block, ...] = part(default=(Direct(),))

    def start(self, signal: object) -> Memory:
        """Return the memories, each started on the output of the blocks before it."""
        memories = []
        for block in self.blocks:
            memories.append(block.start(signal))
            signal = block.output(0.0, memories[-1], signal)
        return _join_memories(memories)

    def flow(self, t: Scalar, memory: Memory, signal: object) -> tuple[PyTree, ...]:
        """Return the rates of the blocks."""
        rates = []
        for block, m in self._pairs(memory):
            rates.append(block.flow(t, m, signal))
            signal = block.output(t, m, signal)
        return tuple(rates)

    def output(self, t: Scalar, memory: Memory, signal: T) -> T:
        """Return the output of the last block."""
        for block, m in self._pairs(memory):
            signal = block.output(t, m, signal)
        return signal

    def offers(self, hook: str) -> bool:
        """Return whether one of the blocks has this hook."""
        return any(offers(block, hook) for block in self.blocks)

    def tick(self, clock: Clock, memory: Memory, signal: object) -> Memory:
        """Return the memories after the ticks of the blocks, in order; each block draws from its own random stream."""
        # `before` follows the signal before this instant: each block's old output is the next block's old input.
        memories, before = [], signal if clock.before is None else clock.before
        for i, (block, m) in enumerate(self._pairs(memory)):
            key = None if clock.key is None else jax.random.fold_in(clock.key, i)
            after = block.tick(clock._replace(key=key, before=before), m, signal) if offers(block, "tick") else m
            signal, before = block.output(clock.t, after, signal), block.output(clock.t, m, before)
            memories.append(after)
        return _join_memories(memories)

    def margins(self, t: Scalar, memory: Memory, signal: object, rate: Callable[[], PyTree]) -> tuple[PyTree, ...]:
        """Return the margins of all blocks, in order."""
        margins: tuple[PyTree, ...] = ()
        for block, m in self._pairs(memory):
            if offers(block, "margins"):
                margins += block.margins(t, m, signal, rate)
            signal, rate = block.output(t, m, signal), partial(_output_rate, block, t, m, signal, rate)
        return margins

    def event(self, t: Scalar, memory: Memory, signal: object, fired: tuple[PyTree, ...]) -> Memory:
        """Return the memories after the events of the blocks, in order."""
        memories = []
        for block, m in self._pairs(memory):
            after = m
            if offers(block, "margins"):
                count = len(block.margins(t, m, signal, lambda signal=signal: signal))
                after, fired = block.event(t, m, signal, fired[:count]), fired[count:]
            memories.append(after)
            signal = block.output(t, m, signal)
        return _join_memories(memories)

    def recorded_signals(self, t: Scalar, memory: Memory, signal: object) -> tuple[PyTree, ...]:
        """Return the inputs of the recording blocks, in order, for the input `signal` at time `t` with `memory`."""
        inputs: tuple[PyTree, ...] = ()
        for block, m in self._pairs(memory):
            inputs += (record_signal(block, t, m, signal),) if offers(block, "record") else ()
            signal = block.output(t, m, signal)
        return inputs

    def record(self, memory: Memory, step: HermiteStep) -> Memory:
        """Return the memories after each recording block has recorded its input."""
        (starts, ends), (rates, last) = step.values, step.rates
        each = zip(starts, ends, rates, last, strict=True)
        memories = []
        for block, m in self._pairs(memory):
            if offers(block, "record"):
                a, b, da, db = next(each)
                m = block.record(m, step._replace(values=(a, b), rates=(da, db)))
            memories.append(m)
        return _join_memories(memories)

    def _pairs(self, memory: Memory) -> list[tuple[PyTree, PyTree]]:
        return [(b, Memory(f, h)) for b, f, h in zip(self.blocks, memory.flow, memory.held, strict=True)]


def offers(block: object, *hooks: str) -> bool:
    """Return whether a block has at least one of these optional methods.

    A block with a method `offers(hook)`, such as `Series`, answers for the blocks in it.
    """
    nested_offers = getattr(block, "offers", None)
    return any(nested_offers(hook) if nested_offers else hasattr(block, hook) for hook in hooks)


def next_tick(block: Part, k: Int, h: Scalar) -> Scalar:
    """Return the number of the first grid instant after the k-th at which a block ticks, on a grid of step h [s].

    A block without a period ticks at every grid instant. For blocks in series, the first tick of any of them counts.
    """
    ticking = [inner for inner in getattr(block, "blocks", (block,)) if offers(inner, "tick")]
    lengths = [steps_in_period(inner.period, h) if hasattr(inner, "period") else 1 for inner in ticking]
    return reduce(jnp.minimum, ((k // n + 1) * n for n in lengths))


def record_signal(block: Part, t: Scalar, memory: Memory, signal: PyTree) -> Scalar:
    """Return the signal that a block records: its input; for blocks in series the inputs of those that record."""
    inner = getattr(block, "recorded_signals", None)
    return inner(t, memory, signal) if inner else signal


def _join_memories(memories: Sequence[Memory]) -> Memory:
    return Memory(tuple(m.flow for m in memories), tuple(m.held for m in memories))


def _output_rate(block: Block, t: Scalar, memory: Memory, signal: object, rate: Callable[[], PyTree]) -> Scalar:
    """Return d(output)/dt of a block for the rate of its input."""
    t, moving = jnp.asarray(t), rate()
    moves = (jnp.ones_like(t), block.flow(t, memory, signal), moving)
    return jax.jvp(lambda t, z, s: block.output(t, memory._replace(flow=z), s), (t, memory.flow, signal), moves)[1]


@pytree
class NoFeedforward:
    """A feed-forward input of zero."""

    def input(self, plant: object, output: object, target: Scalar) -> Scalar:
        """Return zero, with the shape and type of `target`."""
        del plant, output
        return 0.0 * target  # zero with the shape and type of the target
