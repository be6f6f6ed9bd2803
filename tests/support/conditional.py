"""The textbook's conditional integration, whose rate jumps: an anti-windup strategy that chatters along a limit."""

import jax.numpy as jnp

from diffabs.core.pytree import pytree


@pytree
class ConditionalIntegration:
    """I' = e, but 0 while the output is at a limit and gain * e would push it further out."""

    jumps = True

    def rate(self, error, gain, raw, limited):
        return jnp.where((raw - limited) * gain * error > 0, 0.0, error)
