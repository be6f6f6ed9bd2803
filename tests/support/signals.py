"""What sensors and controllers are given in tests: outputs of a plant, and blocks that read or follow them."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.protocols import BrakeOutput, Memory
from diffabs.core.pytree import pytree, static

H = 1e-3


def seen(slip=0.0, speed=20.0, deceleration=0.0, wheel_speed=None):
    return BrakeOutput(slip, speed, (1 - slip) * speed if wheel_speed is None else wheel_speed, deceleration, 0.0)


@pytree
class Script:
    """A plant that shows read(t), whatever it is told."""

    read: Callable = static()

    shows = BrakeOutput
    control_unit = "N m"

    def start(self, initial):
        return 0.0 * initial

    def derivative(self, t, state, control):
        return 1.0 + 0.0 * control * state

    def project(self, state):
        return state

    def output(self, state):
        return jax.tree.map(lambda x: x + 0.0 * state, self.read(state))

    def holding(self, output, target):
        return 0.0 * target


@pytree
class Mean:
    """Mean of the target and of the control over a run: where they are two levels, the moment of the change."""

    unit = "1"

    def start(self, sample):
        return Memory(flow=(0.0 * sample.t, 0.0 * sample.t))

    def flow(self, memory, sample):
        return sample.target, sample.control

    def update(self, memory, segment):
        return memory.held

    def value(self, memory, ending):
        return jnp.stack(memory.flow) / ending.sample.t


def close(actual, desired, rtol=1e-12, atol=1e-14):
    np.testing.assert_allclose(actual, desired, rtol=rtol, atol=atol)
