"""Blocks in series, for sensors and actuators; blocks side by side, one for each channel; and the identity block."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial, reduce
from typing import TypeVar

import jax
import jax.numpy as jnp

from diffabs.core.arrays import steps_in_period
from diffabs.core.channels import zero_controls
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


class Chain:
    """Base of blocks in series."""

    blocks: tuple[Block, ...]

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
        each = _split_step(step)
        return _join_memories(
            [block.record(m, next(each)) if offers(block, "record") else m for block, m in self._pairs(memory)]
        )

    def _pairs(self, memory: Memory) -> list[tuple[PyTree, PyTree]]:
        return [(b, Memory(f, h)) for b, f, h in zip(self.blocks, memory.flow, memory.held, strict=True)]


@pytree
class Series(Chain):
    """Blocks in series, the first one nearest to the input."""

    blocks: tuple[Block, ...] = part(default=(Direct(),))


class Parallel:
    """Base of a block that is made of blocks side by side: one for each channel, or several for the same signal.

    A subclass is a part (`core.pytree.pytree`) that says which blocks there are, what each reads, and how their outputs
    are joined. Two controllers with a rule that chooses between them:

        @pytree
        class Arbitrated(Parallel):
            slip: Block = part(default=PID)
            speed: Block = part(default=PID)

            def by_channel(self):
                return {"slip": self.slip, "speed": self.speed}

            def join(self, signal, outputs):
                return jax.tree.map(jnp.minimum, outputs["slip"], outputs["speed"])
    """

    def by_channel(self) -> Mapping[str, Block]:
        """Return the block of each channel by name."""
        raise NotImplementedError

    def select(self, name: str, signal: PyTree) -> PyTree:
        """Return what a block reads: some of the numbers of `signal`, by default all. It also selects from rates."""
        del name
        return signal

    def join(self, signal: PyTree, outputs: dict[str, PyTree]) -> PyTree:
        """Return the output for a signal, of the outputs of the blocks by name."""
        raise NotImplementedError

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Return the blocks in order."""
        return tuple(self.by_channel().values())

    def start(self, signal: PyTree) -> Memory:
        """Return the memories of the blocks by name."""
        return _join_named({name: block.start(self.select(name, signal)) for name, block in self.by_channel().items()})

    def flow(self, t: Scalar, memory: Memory, signal: PyTree) -> dict[str, PyTree]:
        """Return the rates of the blocks by name."""
        return {name: block.flow(t, m, self.select(name, signal)) for name, block, m in self._each(memory)}

    def output(self, t: Scalar, memory: Memory, signal: PyTree) -> PyTree:
        """Return the outputs of the blocks, joined."""
        return self.join(
            signal, {name: block.output(t, m, self.select(name, signal)) for name, block, m in self._each(memory)}
        )

    def offers(self, hook: str) -> bool:
        """Return whether one of the blocks has this hook."""
        return any(offers(block, hook) for block in self.blocks)

    def tick(self, clock: Clock, memory: Memory, signal: PyTree) -> Memory:
        """Return the memories after the ticks of the blocks; each draws from its own random stream."""
        memories = {}
        for i, (name, block, m) in enumerate(self._each(memory)):
            memories[name] = m
            if offers(block, "tick"):
                key = None if clock.key is None else jax.random.fold_in(clock.key, i)
                before = None if clock.before is None else self.select(name, clock.before)
                memories[name] = block.tick(clock._replace(key=key, before=before), m, self.select(name, signal))
        return _join_named(memories)

    def margins(self, t: Scalar, memory: Memory, signal: PyTree, rate: Callable[[], PyTree]) -> tuple[PyTree, ...]:
        """Return the margins of all blocks, in order."""
        margins: tuple[PyTree, ...] = ()
        for name, block, m in self._each(memory):
            if offers(block, "margins"):
                margins += block.margins(t, m, self.select(name, signal), lambda name=name: self.select(name, rate()))
        return margins

    def event(self, t: Scalar, memory: Memory, signal: PyTree, fired: tuple[PyTree, ...]) -> Memory:
        """Return the memories after the events of the blocks."""
        memories = {}
        for name, block, m in self._each(memory):
            memories[name] = m
            if offers(block, "margins"):
                read = self.select(name, signal)
                count = len(block.margins(t, m, read, lambda read=read: read))
                memories[name], fired = block.event(t, m, read, fired[:count]), fired[count:]
        return _join_named(memories)

    def recorded_signals(self, t: Scalar, memory: Memory, signal: PyTree) -> tuple[PyTree, ...]:
        """Return the inputs of the recording blocks, in order."""
        recording = [(name, block, m) for name, block, m in self._each(memory) if offers(block, "record")]
        return tuple(record_signal(block, t, m, self.select(name, signal)) for name, block, m in recording)

    def record(self, memory: Memory, step: HermiteStep) -> Memory:
        """Return the memories after each recording block has recorded its input."""
        each = _split_step(step)
        return _join_named(
            {
                name: block.record(m, next(each)) if offers(block, "record") else m
                for name, block, m in self._each(memory)
            }
        )

    def _each(self, memory: Memory) -> Iterator[tuple[str, PyTree, Memory]]:
        for name, block in self.by_channel().items():
            yield name, block, Memory(memory.flow[name], memory.held[name])


def find_unnamed(field: str, blocks: object, example: str) -> Iterator[str]:
    """Yield a line if a field of blocks by name has none, or a block without a name."""
    if not isinstance(blocks, Mapping):
        yield f"{field} = {type(blocks).__name__} has no name; a table by name is needed, such as {example}"
    elif not blocks:
        yield f"{field} = {{}} is empty; a table by name is needed, such as {example}"


class ChangedCommand(Chain):
    """Base of a controller that changes the commands of another one, its part `controller`.

    A subclass is a part (`core.pytree.pytree`) with a method `change`. A limit on the difference of two commands:

        @pytree
        class YawLimit(ChangedCommand):
            controller: Block = part(default=PerChannel)
            limit: Scalar = param(default=100.0, unit="N m", low=0.0)

            def change(self, t, command, signal):
                return command._replace(left=jnp.minimum(command.left, command.right + self.limit))
    """

    controller: Block

    def change(self, t: Scalar, command: PyTree, signal: PyTree) -> PyTree:
        """Return the commands, of those of the `controller` for its input `signal` at time `t` [s]."""
        raise NotImplementedError

    @property
    def blocks(self) -> tuple[Block, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]  # not a field here
        """Return the controller, alone."""
        return (self.controller,)

    def output(self, t: Scalar, memory: Memory, signal: PyTree) -> PyTree:
        """Return the changed commands."""
        return self.change(t, super().output(t, memory, signal), signal)


def offers(block: object, *hooks: str) -> bool:
    """Return whether a block has at least one of these optional methods.

    A block with a method `offers(hook)`, such as `Series`, answers for the blocks in it.
    """
    nested_offers = getattr(block, "offers", None)
    return any(nested_offers(hook) if nested_offers else hasattr(block, hook) for hook in hooks)


def next_tick(block: Part, k: Int, h: Scalar) -> Scalar:
    """Return the number of the first grid instant after the k-th at which a block ticks, on a grid of step h [s].

    A block without a period ticks at every grid instant. Of blocks in a block, the first tick of any of them counts.
    """
    ticking = [inner for inner in innermost_blocks(block) if offers(inner, "tick")]
    lengths = [steps_in_period(inner.period, h) if hasattr(inner, "period") else 1 for inner in ticking]
    return reduce(jnp.minimum, ((k // n + 1) * n for n in lengths))


def innermost_blocks(block: Part) -> list[Part]:
    """Return the block, or the blocks in series or side by side in it, at any depth."""
    inner = getattr(block, "blocks", None)
    return [block] if inner is None else [innermost for part in inner for innermost in innermost_blocks(part)]


def record_signal(block: Part, t: Scalar, memory: Memory, signal: PyTree) -> Scalar:
    """Return the signal that a block records: its input; for blocks in series the inputs of those that record."""
    inner = getattr(block, "recorded_signals", None)
    return inner(t, memory, signal) if inner else signal


def _join_memories(memories: Sequence[Memory]) -> Memory:
    return Memory(tuple(m.flow for m in memories), tuple(m.held for m in memories))


def _join_named(memories: dict[str, Memory]) -> Memory:
    return Memory({name: m.flow for name, m in memories.items()}, {name: m.held for name, m in memories.items()})


def _split_step(step: HermiteStep) -> Iterator[HermiteStep]:
    """Yield the step of each signal of a tuple of recorded signals."""
    for a, b, da, db in zip(*step.values, *step.rates, strict=True):
        yield step._replace(values=(a, b), rates=(da, db))


def _output_rate(block: Block, t: Scalar, memory: Memory, signal: object, rate: Callable[[], PyTree]) -> Scalar:
    """Return d(output)/dt of a block for the rate of its input."""
    t, moving = jnp.asarray(t), rate()
    moves = (jnp.ones_like(t), block.flow(t, memory, signal), moving)
    return jax.jvp(lambda t, z, s: block.output(t, memory._replace(flow=z), s), (t, memory.flow, signal), moves)[1]


@pytree
class NoFeedforward:
    """A feed-forward input of zero."""

    def input(self, plant: object, output: object, target: PyTree) -> PyTree:
        """Return zero for each control, with the shape and type of a target."""
        del output
        return zero_controls(plant, jax.tree.leaves(target)[0])
