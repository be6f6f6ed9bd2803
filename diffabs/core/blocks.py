"""Blocks in series, for sensors and actuators, and the block that does nothing."""

from typing import Any

import jax

from diffabs.core.protocols import Block, Clock, Jump, Memory, no_flow, no_jump, no_memory
from diffabs.core.pytree import Scalar, part, pytree


@pytree
class Direct:
    """The signal itself: a perfect sensor, an actuator without limits."""

    start = no_memory
    flow = no_flow
    jump = no_jump

    def output(self, t: Scalar, memory: Memory, signal: Any) -> Any:
        """The signal."""
        del t, memory
        return signal


@pytree
class Series:
    """Blocks one after the other, the first nearest to the input. Events inside a series are not localised."""

    blocks: tuple[Block, ...] = part(default=(Direct(),))

    def start(self, signal: Any) -> Memory:
        """The memories, each started on what the blocks before it put out."""
        memories = []
        for block in self.blocks:
            memories.append(block.start(signal))
            signal = block.output(0.0, memories[-1], signal)
        return Memory(tuple(m.flow for m in memories), tuple(m.held for m in memories))

    def flow(self, t: Scalar, memory: Memory, signal: Any) -> Any:
        """Their rates."""
        rates = []
        for block, m in self._pairs(memory):
            rates.append(block.flow(t, m, signal))
            signal = block.output(t, m, signal)
        return tuple(rates)

    def output(self, t: Scalar, memory: Memory, signal: Any) -> Any:
        """What the last one puts out."""
        for block, m in self._pairs(memory):
            signal = block.output(t, m, signal)
        return signal

    def jump(self, clock: Clock, memory: Memory, signal: Any) -> Jump:
        """Their jumps, in order; each draws from its own random stream."""
        memories, before = [], signal if clock.before is None else clock.before
        for i, (block, m) in enumerate(self._pairs(memory)):
            key = None if clock.key is None else jax.random.fold_in(clock.key, i)
            memories.append(block.jump(clock._replace(key=key, before=before, rate=None), m, signal).memory)
            signal, before = block.output(clock.t, memories[-1], signal), block.output(clock.t, m, before)
        return Jump(Memory(tuple(m.flow for m in memories), tuple(m.held for m in memories)))

    def _pairs(self, memory: Memory) -> Any:
        return [(b, Memory(f, h)) for b, f, h in zip(self.blocks, memory.flow, memory.held, strict=True)]


@pytree
class NoFeedforward:
    """No feed-forward: 0."""

    def input(self, plant: Any, output: Any, target: Scalar) -> Any:
        """Zero."""
        del plant, output
        return 0.0 * target
