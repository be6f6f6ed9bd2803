"""A linear plant of a user with two or three controls, and logic over its channels."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.blocks import ChangedCommand, Parallel
from diffabs.core.protocols import Block, Memory
from diffabs.core.pytree import param, part, pytree
from diffabs.core.types import Matrix, Scalar, Vector


class State(NamedTuple):
    x: Any


class _Two(NamedTuple):
    a: Scalar
    b: Scalar


class _Three(NamedTuple):
    a: Scalar
    b: Scalar
    c: Scalar


class _TwoInputs(NamedTuple):
    left: Scalar
    right: Scalar


class _ThreeInputs(NamedTuple):
    left: Scalar
    right: Scalar
    middle: Scalar


class TwoOutputs(_Two):
    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType(dict.fromkeys(_Two._fields, "1"))
    tracked: ClassVar[tuple[str, ...]] = _Two._fields


class ThreeOutputs(_Three):
    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType(dict.fromkeys(_Three._fields, "1"))
    tracked: ClassVar[tuple[str, ...]] = _Three._fields


class TwoControls(_TwoInputs):
    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType(dict.fromkeys(_TwoInputs._fields, "1"))


class ThreeControls(_ThreeInputs):
    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType(dict.fromkeys(_ThreeInputs._fields, "1"))


@pytree
class Start:
    x: Vector = param(default=np.zeros(3), unit="1", free=True)


@pytree
class Filtered:
    """A target that comes to its value with a time constant."""

    value: Scalar = param(default=1.0, unit="signal")
    time_constant: Scalar = param(default=0.1, unit="s", above=0.0)

    def start(self, signal):
        del signal
        return Memory(flow=0.0 * self.value)

    def flow(self, t, memory, signal):
        del t, signal
        return (self.value - memory.flow) / self.time_constant

    def output(self, t, memory, signal):
        del t, signal
        return memory.flow

    def setpoint(self, memory):
        del memory
        return self.value


class Linear:
    """x' = A x + B u, whose first states are the outputs; `rest` u holds a target."""

    def start(self, initial):
        return State(jnp.asarray(initial.x))

    def derivative(self, t, state, control):
        del t
        return State(jnp.asarray(self.A) @ state.x + jnp.asarray(self.B) @ jnp.stack(control))

    def project(self, state):
        return state

    def output(self, state):
        return self.shows(*(state.x[i] for i in range(len(self.shows._fields))))

    def holding(self, output, target):
        del output
        return self.controls(*(self.rest[i] * value for i, value in enumerate(target)))


@pytree
class TwoByTwo(Linear):
    A: Matrix = param(default=-np.eye(3), unit="1/s", free=True)
    B: Matrix = param(default=np.eye(3, 2), unit="1/s", free=True)
    rest: Vector = param(default=np.ones(2), unit="1", free=True)

    shows, controls = TwoOutputs, TwoControls


@pytree
class ThreeByThree(Linear):
    A: Matrix = param(default=-np.eye(4), unit="1/s", free=True)
    B: Matrix = param(default=np.eye(4, 3), unit="1/s", free=True)
    rest: Vector = param(default=np.ones(3), unit="1", free=True)

    shows, controls = ThreeOutputs, ThreeControls


def draw_plant(rng, count):
    """Return a stable plant with this number of controls."""
    states = count + 1
    a = -np.diag(rng.uniform(0.8, 2.0, states)) + rng.uniform(-0.4, 0.4, (states, states))
    b = np.eye(states, count) * rng.uniform(0.8, 1.6, count) + rng.uniform(-0.2, 0.2, (states, count))
    return {2: TwoByTwo, 3: ThreeByThree}[count](A=a, B=b, rest=rng.uniform(0.3, 0.8, count))


@pytree
class LeastOf(Parallel):
    """Two controllers of all controls, of which the lower command counts."""

    first: Block = part()
    second: Block = part()

    def by_channel(self):
        return {"first": self.first, "second": self.second}

    def join(self, signal, outputs):
        del signal
        return jax.tree.map(jnp.minimum, outputs["first"], outputs["second"])


@pytree
class Difference(ChangedCommand):
    """A limit on the difference of two commands, as on a yaw moment."""

    controller: Block = part()
    limit: Scalar = param(default=0.1, unit="1", low=0.0)

    def change(self, t, command, signal):
        del t, signal
        return command._replace(left=jnp.minimum(command.left, command.right + self.limit))
