"""The run between the ends of a step: the cubic through the states and the rates there."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.cubic import Cubic
from diffabs.core.loop import LoopState
from diffabs.core.numerics import clamp
from diffabs.core.types import PyTree, Scalar


class HermiteStep(NamedTuple):
    """A step of a run, for interpolation.

    Attributes:
        t: Time at the beginning [s].
        state: State after the changes at the beginning.
        rate: Rates after these changes.
        until: Time at the end [s].
        flow: Integrated values before the changes at the end.
        last_rate: Rates before these changes.
    """

    t: Scalar
    state: LoopState
    rate: PyTree
    until: Scalar
    flow: PyTree
    last_rate: Scalar

    def at(self, t: Scalar) -> LoopState:
        """Return the state at a time `t` [s] within the step."""
        h = self.until - self.t
        x = clamp((t - self.t) / jnp.where(h > 0, h, 1.0), 0.0, 1.0)
        ends = (self.state.flow(), self.flow, self.rate, self.last_rate)
        flow = jax.tree.map(lambda a, b, p, q: Cubic(a, b, h * p, h * q)(x), *ends)
        return self.state.with_flow(flow)
