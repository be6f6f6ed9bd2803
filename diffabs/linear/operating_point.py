"""The linear model of a control loop at rest on its setpoint, by automatic differentiation.

    x' = A x + B u,   u = K x      x: states of the plant and the blocks, u: the controller's commands

At rest the plant stands still and its tracked signals are the setpoints: f(x, u) = 0, y(x) = setpoint. Newton's method
finds this point from the loop's start. The command is differentiated there too, so A + B K is the loop's own
linearisation for any controller that is smooth there. The target is held at the setpoint; its motion is a disturbance.
States on which neither the plant nor the command depends are left out. An example is the integral state of a
controller without an integral gain.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from diffabs.core.channels import control_names, outputs_like, zero_controls
from diffabs.core.jax_flags import default_flags
from diffabs.core.protocols import Memory, Tracking
from diffabs.core.pytree import canonical_dtypes, pytree, static
from diffabs.core.types import AnyArray, Array, Bool, Matrix, Part, PyTree, Scalar
from diffabs.linear.linearization import StateSpace, check_kink, is_kinked, nan_at_kink
from diffabs.loop.closed_loop import Loop, LoopParts, LoopState
from diffabs.parts.stops import NoStop

ROOT_ITERATIONS = 10  # Gauss-Newton iterations to the point of rest; one is enough where the loop is linear
MAX_REST_RESIDUE = 1e-6  # largest residue of a point of rest, relative to the state


class LinearLoop(NamedTuple):
    """A linear model of a loop, with its controller.

    Attributes:
        A: State matrix, shape (n, n).
        B: Input matrix, shape (n, m).
        K: Gain of the loop's controller, shape (m, n).
        residue: Largest rate or error at the operating point, over 1 plus the largest state or command.
        kinked: Whether a slope jumps at the operating point; A, B and K are then NaN.
    """

    A: AnyArray
    B: AnyArray
    K: AnyArray
    residue: Scalar
    kinked: Bool


@pytree
class OperatingPoint(LoopParts):
    """A loop at rest, as a linear model in continuous time. `operating_point` makes it."""

    indices: tuple[int, ...] = static(default=())
    """Indices of the loop's states that the model contains."""

    period = None  # it is in continuous time

    @property
    def loop(self) -> Loop:
        """The loop, without its stop."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "indices"}  # pyright: ignore[reportArgumentType]
        return Loop(**fields, stop=NoStop())

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states; those of a part begin with it, as in `controller.integral`."""
        names = _names(self.loop)
        return tuple(names[i] for i in self.indices)

    def matrices(self) -> StateSpace:
        """Return A (n, n) and B (n, m), differentiable in every parameter; they compile once for each kind of loop.

        At a kink, where a slope jumps, this raises ValueError. Inside jit A and B are NaN there.
        """
        model, indices = _smooth_model(self), np.array(self.indices, int)
        return StateSpace(model.A[indices][:, indices], model.B[indices])

    def gain(self) -> AnyArray:
        """Return K of the loop's own controller, (m, n), or (n,) for a plant with a single control.

        At a kink this raises ValueError; inside jit K is NaN there.
        """
        return _gain_on(_smooth_model(self), self, np.array(self.indices, int))


@default_flags()
def operating_point(loop: Loop) -> OperatingPoint:
    """Return the linear model of a loop at rest on its setpoint, in continuous time.

    Raises:
        ValueError: A block acts at instants (sampled, delayed, a relay); or the plant does not come to rest at the
            setpoint; or there a slope jumps, or the control is at a limit or has no effect. In single precision a
            jump is not noticed.
    """
    start = loop.start()
    for name in ("sensor", "controller", "actuator"):
        if jax.tree.leaves(getattr(start, name).held):
            kind = type(getattr(loop, name)).__name__
            raise ValueError(f"{name} {kind} acts at instants: it has no linear model in continuous time")
    model = _drop_stop(loop)
    linear = jax.device_get(_linearize_at_rest(model))
    if not linear.residue < MAX_REST_RESIDUE:
        raise ValueError(f"plant {type(loop.plant).__name__} does not come to rest at the setpoint: no linear model")
    check_kink("the loop at its setpoint", linear.kinked)
    if not np.any(linear.B) or not np.any(linear.K):
        raise ValueError("the control is at a limit at the setpoint, or does not act there: no linear model")
    # The plant's states come first in the vector of states.
    plant = np.arange(len(linear.A)) < len(ravel_pytree(start.plant)[0])
    # The model contains these, those on which the command depends, and all that influence one of them.
    contained = plant | (linear.K != 0).any(axis=0)
    for _ in contained:
        contained = contained | (linear.A[contained] != 0).any(axis=0)
    return dataclasses.replace(model, indices=tuple(np.flatnonzero(contained).tolist()))  # pyright: ignore[reportArgumentType]


def loop_gain(loop: Loop, states: tuple[str, ...]) -> AnyArray:
    """Return K of a loop's controller on the named states, differentiable in the loop's parameters.

    It has the shape (m, n), or (n,) for a plant with a single control.

    At a kink this raises ValueError; inside jit K is NaN there.
    """
    names, model = _names(loop), _drop_stop(loop)
    return _gain_on(_smooth_model(model), model, np.array([names.index(name) for name in states]))


def _gain_on(linear: LinearLoop, model: OperatingPoint, indices: np.ndarray) -> AnyArray:
    return linear.K[:, indices] if control_names(model.plant) else linear.K[0, indices]


def _drop_stop(loop: Loop) -> OperatingPoint:
    fields = {f.name: getattr(loop, f.name) for f in dataclasses.fields(loop) if f.name != "stop"}  # pyright: ignore[reportArgumentType]
    return OperatingPoint(**fields)


class _IntegratedStates(NamedTuple):
    """Integrated states of a loop, without those of the reference."""

    plant: Part
    sensor: Part
    controller: Part
    actuator: Part


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
    """A loop held at its setpoint, with all integrated states in one vector z and the commands v as the actuator's
    input.
    """

    loop: Loop
    setpoint: PyTree
    unravel: Callable[[Array], PyTree]
    as_control: Callable[[Array], PyTree]
    held: LoopState

    def track(self, z: Array) -> tuple[PyTree, Tracking]:
        loop, x = self.loop, self.unravel(z)
        y = loop.plant.output(x.plant)
        measured = loop.sensor.output(0.0, self.memory("sensor", x), y)
        return y, Tracking(self.setpoint, measured, loop.feedforward.input(loop.plant, measured, self.setpoint))

    def memory(self, name: str, x: "_IntegratedStates") -> Memory:
        return getattr(self.held, name)._replace(flow=getattr(x, name))

    def command(self, z: Array) -> Array:
        x = self.unravel(z)
        return ravel_pytree(self.loop.controller.output(0.0, self.memory("controller", x), self.track(z)[1]))[0]

    def tracking_errors(self, z: Array) -> Array:
        setpoint = self.setpoint
        return ravel_pytree(outputs_like(self.track(z)[0], setpoint))[0] - ravel_pytree(setpoint)[0]

    def flow(self, z: Array, v: Array) -> AnyArray:
        loop, x, command = self.loop, self.unravel(z), self.as_control(v)
        (y, signal), actuator = self.track(z), self.memory("actuator", x)
        rates = _IntegratedStates(
            loop.plant.derivative(0.0, x.plant, loop.actuator.output(0.0, actuator, command)),
            loop.sensor.flow(0.0, self.memory("sensor", x), y),
            loop.controller.flow(0.0, self.memory("controller", x), signal),
            loop.actuator.flow(0.0, actuator, command),
        )
        return ravel_pytree(rates)[0]


@jax.jit
def _linearize_at_rest(model: OperatingPoint) -> LinearLoop:
    loop = canonical_dtypes(model).loop
    start = loop.start()
    setpoint = loop.reference.setpoint(start.reference)
    z, unravel = ravel_pytree(_start(loop))
    no_control, as_control = ravel_pytree(zero_controls(loop.plant, jax.tree.leaves(setpoint)[0]))
    vectors = _VectorLoop(loop, setpoint, unravel, as_control, start)
    at = _IntegratedStates(*(np.size(ravel_pytree(part)[0]) for part in _start(loop)))
    inside = np.repeat(np.arange(4) == _IntegratedStates._fields.index("controller"), at)

    outside = int(np.sum(~inside))

    def still(free: PyTree) -> Matrix:
        """Return the rates of everything but the controller, and the errors of the tracked signals; zero at rest."""
        moved = z.at[~inside].set(free[:outside])
        return jnp.append(vectors.flow(moved, free[outside:])[~inside], vectors.tracking_errors(moved))

    # First the states outside the controller, together with the commands that hold the plant; then the controller.
    free = find_root(still, jnp.append(z[~inside], no_control))
    z, v = z.at[~inside].set(free[:outside]), free[outside:]

    def rest_residual(memory: object, z: Array = z) -> Matrix:
        """Return the rates of the controller's memory, and its commands minus those that hold the plant."""
        moved = z.at[inside].set(memory)
        return jnp.append(vectors.flow(moved, v)[inside], vectors.command(moved) - v)

    z = z.at[inside].set(find_root(rest_residual, z[inside]))
    a, b = jax.jacfwd(vectors.flow, (0, 1))(z, v)
    residue = jnp.max(jnp.abs(still(free))) / (1 + jnp.max(jnp.abs(free)))
    moves = jnp.diag(1 + jnp.abs(z))
    kinked = is_kinked(lambda z, v: jnp.append(vectors.flow(z, v), vectors.command(z)), moves, z, v)
    a, b, k = nan_at_kink((a, b, jax.jacfwd(vectors.command)(z)), kinked)
    return LinearLoop(a, b, k, residue, kinked)


def _smooth_model(model: OperatingPoint) -> LinearLoop:
    """Return the linear model, unless it is known to be at a kink."""
    linear = _linearize_at_rest(model)
    check_kink("the loop at its setpoint", linear.kinked)
    return linear


def find_root(function: Any, x: Array) -> Any:
    """Return a root (n,) of a vector function by the Gauss-Newton method, without one the least-squares minimiser.

    The result is differentiable twice in the parameters of the function.
    """

    def step(x: Scalar, function: Any = function) -> AnyArray:
        return x - jax.lax.stop_gradient(jnp.linalg.pinv(jax.jacfwd(function)(x))) @ function(x)

    if not x.size:
        return x
    # The iteration itself is not differentiated. Two last steps with a constant Jacobian are: the first makes the first
    # derivative exact, the second also the second derivative.
    fixed = jax.lax.fori_loop(0, ROOT_ITERATIONS, lambda _, x: jax.lax.stop_gradient(step(x)), jax.lax.stop_gradient(x))
    return step(step(jax.lax.stop_gradient(fixed)))
