"""The linear model of any loop at rest on its setpoint, by automatic differentiation.

    x' = A x + B u,   u = K x      x: what the plant and the blocks integrate, u: the controller's command

At rest the plant stands still and shows the setpoint: f(x, u) = 0, y1(x) = setpoint, found by Newton's method from the
loop's start. The command is differentiated there too, so that A + B K is the loop's own linearisation, for whatever
controller is smooth there. The target is held at the setpoint: its motion is a disturbance. What neither the plant nor
the command depends on is left out, such as the integral of a controller without an integral gain."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from diffabs.core.blocks import Direct, NoFeedforward
from diffabs.core.loop import Loop
from diffabs.core.protocols import Block, Feedforward, Memory, Plant, Reference, Tracking
from diffabs.core.pytree import canonical_dtypes, part, pytree, static
from diffabs.linear.linearization import StateSpace
from diffabs.stops import NoStop

ROOT_ITERATIONS = 10  # iterations for the rest; one is enough where the loop is linear
MAX_REST_RESIDUE = 1e-6  # relative to the state: what is further off than this is no rest


class LinearLoop(NamedTuple):
    """A (n, n), B (n, 1), gain K (n,) of the loop's controller; and how far from rest they were taken."""

    A: Any
    B: Any
    K: Any
    residue: Any


@pytree
class OperatingPoint:
    """The parts of a loop, and which of its states are `kept`. Make it with `operating_point`."""

    plant: Plant = part()
    initial: Any = part()
    sensor: Block = part(default=Direct)
    reference: Reference = part()
    feedforward: Feedforward = part(default=NoFeedforward)
    controller: Block = part()
    actuator: Block = part(default=Direct)
    kept: tuple[int, ...] = static(default=())

    period = None  # it is in continuous time

    @property
    def loop(self) -> Loop:
        """The loop, without its stop."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "kept"}  # pyright: ignore[reportArgumentType]
        return Loop(**fields, stop=NoStop())

    @property
    def states(self) -> tuple[str, ...]:
        """What the states are: those of the plant by their names, those of a block with its name before."""
        names = _names(self.loop)
        return tuple(names[i] for i in self.kept)

    def matrices(self) -> StateSpace:
        """A (n, n) and B (n, 1), differentiable in every parameter; compiled once for each kind of loop."""
        found, kept = _linearize_at_rest(self), np.array(self.kept, int)
        return StateSpace(found.A[kept][:, kept], found.B[kept])

    def gain(self) -> Any:
        """K (n,) of the loop's own controller."""
        return _linearize_at_rest(self).K[np.array(self.kept, int)]


def operating_point(loop: Loop) -> OperatingPoint:
    """Return the linear model of a loop at rest on its setpoint.

    Raises:
        ValueError: a block that acts at instants (sampled, delayed, a relay), a plant that does not come to rest at the
            setpoint, a control that is at a limit there.
    """
    start = loop.start()
    for name in ("sensor", "controller", "actuator"):
        if jax.tree.leaves(getattr(start, name).held):
            kind = type(getattr(loop, name)).__name__
            raise ValueError(f"{name} {kind} acts at instants: it has no linear model in continuous time")
    model = _drop_stop(loop)
    found = jax.device_get(_linearize_at_rest(model))
    if not found.residue < MAX_REST_RESIDUE:
        raise ValueError(f"plant {type(loop.plant).__name__} does not come to rest at the setpoint: no linear model")
    if not np.any(found.B) or not np.any(found.K):
        raise ValueError("the control is at a limit at the setpoint, or does not act there: no linear model")
    plant = np.arange(len(found.A)) < len(ravel_pytree(start.plant)[0])
    return dataclasses.replace(model, kept=_needed_states(found, plant))  # pyright: ignore[reportArgumentType]


def loop_gain(loop: Loop, states: tuple[str, ...]) -> Any:
    """Return K (n,) of a loop's controller on the states of an `OperatingPoint`, by their names. Differentiable in the
    loop's parameters."""
    names = _names(loop)
    return _linearize_at_rest(_drop_stop(loop)).K[np.array([names.index(name) for name in states])]


def _drop_stop(loop: Loop) -> OperatingPoint:
    """The parts of a loop but its stop."""
    fields = {f.name: getattr(loop, f.name) for f in dataclasses.fields(loop) if f.name != "stop"}  # pyright: ignore[reportArgumentType]
    return OperatingPoint(**fields)


def _needed_states(found: LinearLoop, plant: np.ndarray) -> tuple[int, ...]:
    """The states of the plant, those that the command depends on, and those that any of these depends on."""
    kept = plant | (found.K != 0)
    for _ in kept:
        kept = kept | (found.A[kept] != 0).any(axis=0)
    return tuple(np.flatnonzero(kept).tolist())


class _IntegratedStates(NamedTuple):
    """What is integrated, but for the reference."""

    plant: Any
    sensor: Any
    controller: Any
    actuator: Any


def _start(loop: Loop) -> _IntegratedStates:
    state = loop.start()
    return _IntegratedStates(state.plant, state.sensor.flow, state.controller.flow, state.actuator.flow)


def _names(loop: Loop) -> list[str]:
    names = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(jax.eval_shape(_start, canonical_dtypes(loop))):
        block, *inner = (str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path)
        name = ".".join(inner if block == "plant" and inner else [block, *inner])
        names += [".".join([name, *map(str, at)]) for at in np.ndindex(leaf.shape)] if leaf.shape else [name]
    return names


class _VectorLoop(NamedTuple):
    """A loop on a setpoint, whose integrated states are one vector z; the actuator is given a command v."""

    loop: Loop
    setpoint: Any
    unravel: Any

    def tracking(self, z: Any) -> tuple[Any, Tracking]:
        """What the plant shows, and what the controller sees."""
        loop, x = self.loop, self.unravel(z)
        y = loop.plant.output(x.plant)
        measured = loop.sensor.output(0.0, Memory(x.sensor), y)
        return y, Tracking(self.setpoint, measured, loop.feedforward.input(loop.plant, measured, self.setpoint))

    def command(self, z: Any) -> Any:
        """The controller's."""
        return self.loop.controller.output(0.0, Memory(self.unravel(z).controller), self.tracking(z)[1])

    def flow(self, z: Any, v: Any) -> Any:
        """dz/dt."""
        loop, x = self.loop, self.unravel(z)
        y, seen = self.tracking(z)
        rates = _IntegratedStates(
            loop.plant.derivative(0.0, x.plant, loop.actuator.output(0.0, Memory(x.actuator), v)),
            loop.sensor.flow(0.0, Memory(x.sensor), y),
            loop.controller.flow(0.0, Memory(x.controller), seen),
            loop.actuator.flow(0.0, Memory(x.actuator), v),
        )
        return ravel_pytree(rates)[0]


@jax.jit
def _linearize_at_rest(model: OperatingPoint) -> LinearLoop:
    loop = canonical_dtypes(model).loop
    setpoint = loop.reference.setpoint(loop.start().reference)
    z, unravel = ravel_pytree(_start(loop))
    one = _VectorLoop(loop, setpoint, unravel)
    at = _IntegratedStates(*(np.size(ravel_pytree(part)[0]) for part in _start(loop)))
    inside = np.repeat(np.arange(4) == _IntegratedStates._fields.index("controller"), at)

    def still(free: Any) -> Any:
        """Zero where everything but the controller is at rest, the first signal on the setpoint."""
        moved = z.at[~inside].set(free[:-1])
        return jnp.append(one.flow(moved, free[-1])[~inside], one.tracking(moved)[0][0] - setpoint)

    free = find_root(still, jnp.append(z[~inside], 0.0))
    z = z.at[~inside].set(free[:-1])

    def holding(memory: Any, z: Any = z) -> Any:
        """Zero where the controller is at rest and commands what holds the plant."""
        moved = z.at[inside].set(memory)
        return jnp.append(one.flow(moved, free[-1])[inside], one.command(moved) - free[-1])

    z = z.at[inside].set(find_root(holding, z[inside]))
    a, b = jax.jacfwd(one.flow, (0, 1))(z, free[-1])
    residue = jnp.max(jnp.abs(still(free))) / (1 + jnp.max(jnp.abs(free)))
    return LinearLoop(a, b[:, None], jax.jacfwd(one.command)(z), residue)


def find_root(function: Any, x: Any) -> Any:
    """Return where a function is zero, or least in squares, by Gauss and Newton. First and second derivatives are those
    of the last two steps: each doubles their order."""

    def step(x: Any, function: Any = function) -> Any:
        return x - jax.lax.stop_gradient(jnp.linalg.pinv(jax.jacfwd(function)(x))) @ function(x)

    if not x.size:
        return x
    fixed = jax.lax.fori_loop(0, ROOT_ITERATIONS, lambda _, x: jax.lax.stop_gradient(step(x)), jax.lax.stop_gradient(x))
    return step(step(jax.lax.stop_gradient(fixed)))
