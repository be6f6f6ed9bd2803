"""Open loop: a recorded sequence of commands, such as that of an experiment, drives the plant."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.protocols import Clock, Memory, Tracking, no_flow
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import period_on_grid
from diffabs.core.types import Scalar, Vector


@pytree
class PlayedCommand:
    """From time k period on, the output is entry k of `commands`; the last one stays. Signals have no effect."""

    commands: Vector = param(default=(0.0,), unit="control", free=True)
    """Recorded commands, shape (length,)."""
    period: Scalar = param(default=0.01, unit="s", above=0.0, tunable=False)
    """Period of the entries, a whole multiple of the integration step."""

    flow = no_flow
    grid_rules = period_on_grid

    def start(self, signal: Tracking) -> Memory:
        """Return the memory with the first entry."""
        return Memory(held=jnp.asarray(self.commands)[0] + 0.0 * signal.target)

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the present entry [control]."""
        del t, signal
        return memory.held

    def tick(self, clock: Clock, memory: Memory, signal: Tracking) -> Memory:
        """Return the memory with the entry of the period that begins, or the old memory between two periods."""
        del signal
        now, played = clock.ticks(self.period)
        commands = jnp.asarray(self.commands)
        entry = jax.lax.dynamic_index_in_dim(commands, jnp.minimum(played, commands.size - 1), keepdims=False)
        return Memory(held=jnp.where(now, entry, memory.held))

    def problems(self) -> Iterator[str]:
        """Yield a message if `commands` is not a vector of at least one entry."""
        if np.ndim(self.commands) != 1 or np.size(self.commands) < 1:
            yield f"commands has shape {np.shape(self.commands)}; it needs (n,), n at least 1"
