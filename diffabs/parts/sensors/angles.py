"""The balance sensor of a real vehicle: it measures theta (frame) and psi (arm), but not phi (rider)."""

import jax
import jax.numpy as jnp

from diffabs.core.protocols import BalanceOutput, Clock, Memory, no_flow
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import period_on_grid
from diffabs.core.types import Scalar
from diffabs.parts.sensors.noise import draw_noise


@pytree
class AngleSensor:
    """theta and psi with Gaussian noise, drawn every `period` and held; all other channels read 0.

    A run needs a random key (`rollout(..., key=)`), also with both deviations 0.
    """

    theta: Scalar = param(default=0.0, unit="rad", low=0.0)
    """Standard deviation of theta's noise."""
    psi: Scalar = param(default=0.0, unit="rad", low=0.0)
    """Standard deviation of psi's noise."""
    period: Scalar = param(default=0.01, unit="s", above=0.0, tunable=False)
    """Period of the draws, a whole multiple of the integration step."""

    flow = no_flow
    grid_rules = period_on_grid

    def start(self, signal: BalanceOutput) -> Memory:
        """Return the memory with zero noise for both angles."""
        zero = 0.0 * signal.theta
        return Memory(held=(zero, zero))

    def output(self, t: Scalar, memory: Memory, signal: BalanceOutput) -> BalanceOutput:
        """Return both angles with noise; all other channels are 0."""
        del t
        nothing = jax.tree.map(lambda x: 0.0 * x, signal)
        return nothing._replace(theta=signal.theta + memory.held[0], psi=signal.psi + memory.held[1])

    def tick(self, clock: Clock, memory: Memory, signal: BalanceOutput) -> Memory:
        """Return the memory with new noise if a period begins, else the old memory.

        Raises:
            ValueError: The run has no random key.
        """
        del signal
        now, number = clock.ticks(self.period)
        held = tuple(
            draw_noise(jnp.asarray(deviation), clock.key, 2 * number + i)
            for i, deviation in enumerate((self.theta, self.psi))
        )
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(now, a, b), held, memory.held))
