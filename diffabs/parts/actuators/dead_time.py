"""Dead times of a switching command, different for a rise and a fall.

    control(t) = value of the latest switch whose due time has passed,   due = instant of the switch + rise or fall

A valve, a clutch or the slack of a brake cable answers a rise of the command later, or earlier, than a fall. A switch
that would be due before an earlier one cancels it. So a pulse shorter than rise - fall never reaches the plant, nor a
gap shorter than fall - rise.

`Delay` is for a command that changes smoothly; its rise and fall are delayed equally.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.protocols import Clock, Memory, no_flow
from diffabs.core.pytree import param, pytree, static
from diffabs.core.types import Array, PyTree, Scalar
from diffabs.parts.actuators.delay import find_wrong_capacity


class DeadTimeMemory(NamedTuple):
    """The control, the latest command, and the switches on their way.

    Attributes:
        applied: Control now [control].
        newest: Command at the latest instant [control].
        due: Instants at which switches arrive [s], shape (capacity,), increasing; infinite for a free place.
        values: Commands after these switches [control], shape (capacity,).
    """

    applied: Scalar
    newest: Scalar
    due: Array
    values: Any


@pytree
class DeadTime:
    """A command that switches between values arrives `rise` after an increase and `fall` after a decrease.

    The command is read at every instant of the grid and at every event, where `tick` runs, and is held in between. At
    most `capacity` switches may be on their way. With one more the control becomes NaN, and so the plant's state: the
    run has diverged.
    """

    rise: Scalar = param(default=0.02, unit="s", above=0.0)
    """Dead time of an increase."""
    fall: Scalar = param(default=0.01, unit="s", above=0.0)
    """Dead time of a decrease."""
    capacity: int = static(default=8)
    """Greatest number of switches on their way; an integer >= 1."""

    flow = no_flow

    def start(self, signal: Scalar) -> Memory:
        """Return the memory for the control 0, with no switch on its way."""
        zero = 0.0 * jnp.asarray(signal)
        none = jnp.broadcast_to(zero, (self.capacity,))
        return Memory(held=DeadTimeMemory(zero, zero, none + jnp.inf, none))

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return the value of the latest switch that has arrived [control]."""
        del t, signal
        return memory.held.applied

    def tick(self, clock: Clock, memory: Memory, signal: Scalar) -> Memory:
        """Return the memory with a change of the command since the previous instant sent on its way."""
        m: DeadTimeMemory = memory.held
        rises = signal > m.newest
        due = clock.t + jnp.where(rises, self.rise, self.fall)
        before = m.due < due  # the switches that arrive earlier stay, the others are cancelled
        place = jnp.sum(jnp.where(before, 1, 0))
        at_place = jnp.arange(self.capacity) == place
        times = jnp.where(at_place, due, jnp.where(before, m.due, jnp.inf))
        values = jnp.where(at_place, signal, m.values)
        applied = jnp.where(place < self.capacity, m.applied, jnp.nan)
        sent = DeadTimeMemory(applied, signal, times, values)
        changed = signal != m.newest
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(changed, a, b), sent, m))

    def margins(self, t: Scalar, memory: Memory, signal: Scalar, rate: object) -> tuple[PyTree]:
        """Return the time until the next switch arrives [s], or 1 s if no switch is on its way."""
        del signal, rate
        due = memory.held.due[0]
        on_its_way = due < jnp.inf
        return (jnp.where(on_its_way, jnp.where(on_its_way, due, 0.0) - t, 1.0),)

    def event(self, t: Scalar, memory: Memory, signal: Scalar, fired: tuple[PyTree]) -> Memory:
        """Return the memory with the first switch applied if its event has fired, else the old memory."""
        del t, signal
        m: DeadTimeMemory = memory.held
        due = jnp.concatenate([m.due[1:], jnp.full_like(m.due[:1], jnp.inf)])
        values = jnp.concatenate([m.values[1:], m.values[-1:]])
        arrived = DeadTimeMemory(m.values[0], m.newest, due, values)
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(fired[0], a, b), arrived, m))

    def problems(self) -> Iterator[str]:
        """Yield a message if the capacity is no integer, or smaller than 1 switch."""
        yield from find_wrong_capacity(self.capacity, 1, "switches")
