"""Linear models of a plant, by automatic differentiation.

    linearize           x' = f(x, u) at any point:  A = df/dx, B = df/du
    tracking_dynamics   dynamics of a tracked output while other outputs are frozen

A frozen output, such as the speed of a brake, is a parameter of the model and not a state.

At a kink the slopes of both sides differ, and rounding would choose one of them: there is no linear model.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree

from diffabs.core.jax_flags import default_flags
from diffabs.core.protocols import Plant
from diffabs.core.pytree import canonical_dtypes
from diffabs.core.shapes import Float
from diffabs.core.types import AnyArray, Array, Bool, PyTree, Scalar
from diffabs.parts.plants.wheel import FROZEN_OUTPUTS

T = TypeVar("T")


# Newton iterations that bring the remaining states to rest; one is enough where their equation is linear.
REMAINING_STATE_ITERATIONS = 10
# An offset smaller by this factor makes the second difference smaller by its square where the function is smooth, by
# the factor itself at a kink. It leaves the slope of a smooth function as it is, and makes that of a jump larger.
NARROWER = 8.0
KINK_POWER = 1.1  # a second difference that falls by a smaller power of the factor is a kink's; that of |x|^1.5 is 1.5
MAX_SLOPE_GROWTH = 1.5  # of a smooth function's slope with the smaller offset
MAX_ROUNDINGS = 8.0  # of a component's value that make no jump
MAX_SLOPE_JUMP = 1e-3  # largest jump of a slope that counts as none, relative to the largest slope of the component


class StateSpace(NamedTuple):
    """A linear system x' = A x + B u, or x+ = A x + B u: A (n, n), B (n, m)."""

    A: Float[AnyArray, "n n"]
    B: Float[AnyArray, "n m"]


@default_flags()
def linearize(plant: Plant, state: object, control: PyTree) -> StateSpace:
    """Return df/dx (n, n) and df/du (n, m) of a plant x' = f(x, u), at a state and a control.

    >>> from diffabs import BrakeStart, plants, roads
    >>> from diffabs.linear import linearize
    >>> car = plants.QuarterCar(inertia=0.8, road=roads.DRY_ASPHALT)
    >>> linearize(car, car.start(BrakeStart(speed=20.0, slip=0.1)), 90.0).B.shape  # speed, spin, distance
    (3, 1)

    Args:
        plant: Plant whose `derivative` is f.
        state: State of the plant; it need not be an equilibrium. The components of x are the leaves of the state.
        control: Control at this point: a number, or the `controls` of a plant with several.

    Raises:
        ValueError: A slope of f jumps here, at a kink. Inside jit A and B are then NaN. In single precision a kink is
            not noticed.
    """
    flow, x, u = as_vectors(plant, state, control)
    kinked = is_kinked(flow, jnp.diag(1 + jnp.abs(x)), x, u)
    check_kink(type(plant).__name__, kinked)
    return nan_at_kink(StateSpace(*jax.jacfwd(flow, (0, 1))(x, u)), kinked)


def tracking_dynamics(
    plant: Plant,
    state: object,
    control: Scalar,
    tracked: Sequence[str] = ("slip",),
    frozen: Sequence[str] = FROZEN_OUTPUTS,
) -> StateSpace:
    """Return the linear dynamics of the tracked outputs and the remaining states, with the frozen outputs held.

        xi = F(x) = (h(x), remaining, w(x)),  xi' = DF(x) f(x, u) =: G(x, u),  A = (dG/dx) DF^-1,  B = dG/du

    h are the tracked outputs and w the frozen ones. A and B contain the rows and columns of (h, remaining). The
    remaining states are the components of the state on which neither h nor w depends. The result is exact at any point,
    which need not be an equilibrium: where f is not zero, dG/dx contains the second derivative of F times f.

    Raises:
        ValueError: F is not a change of coordinates: its components are more or fewer than the states, or dependent. Or
            a slope of G jumps here, at a kink. Inside jit only a wrong number of components raises an error; in the
            other cases A and B are not finite. In single precision a kink is not noticed.
    """
    model, kinked = track_outputs(plant, state, control, tracked, frozen)
    check_kink(", ".join(tracked), kinked)
    return nan_at_kink(model, kinked)


def track_outputs(
    plant: Plant,
    state: object,
    control: Scalar,
    tracked: Sequence[str] = ("slip",),
    frozen: Sequence[str] = FROZEN_OUTPUTS,
) -> tuple[StateSpace, Bool]:
    """Return the model of `tracking_dynamics`, and whether it is at a kink; there it is the model of one side."""
    plant, state, control = canonical_dtypes((plant, state, control))
    flow, x, u = as_vectors(plant, state, control)
    unravel = ravel_pytree(state)[1]
    remaining = independent_components(plant, state, (*tracked, *frozen))

    def chart(x: Array) -> Array:
        y = plant.output(unravel(x))
        h, w = ([jnp.ravel(getattr(y, name)) for name in names] for names in (tracked, frozen))
        return jnp.concatenate([*h, x[remaining], *w])

    by_x = jax.jacfwd(chart)(x)
    _check_chart(by_x, (*tracked, *frozen))

    # The tangent of the chart along f(x, u) is G(x, u); its Jacobian includes the second derivative of the chart.
    def moves(x: Array, u: Array) -> AnyArray:
        return jax.jvp(chart, (x,), (flow(x, u),))[1]

    a, b = jax.jacfwd(moves, (0, 1))(x, u)
    n = len(x) - sum(np.size(getattr(jax.eval_shape(plant.output, state), name)) for name in frozen)
    kinked = is_kinked(lambda x, u: moves(x, u)[:n], coordinate_moves(by_x, chart(x))[:n], x, u)
    return StateSpace(jnp.linalg.solve(by_x.T, a.T).T[:n, :n], b[:n]), kinked


def is_kinked(function: Callable[..., AnyArray], moves: AnyArray, x: AnyArray, u: AnyArray) -> Bool:
    """Return whether a function or its slope jumps at a point, along some moves of x or along a component of u.

    In single precision the result is False: differences are too inexact. Each move of x, shape (m, len(x)), is as large
    as what it moves.
    """
    point, unravel = ravel_pytree((x, u))
    by_u = (1 + jnp.abs(u))[:, None] * jnp.eye(len(u), dtype=point.dtype)
    moves = jnp.concatenate([jnp.pad(moves, ((0, 0), (0, len(u)))), jnp.pad(by_u, ((0, 0), (len(x), 0)))])
    if point.dtype != jnp.float64:
        return jnp.array(False)
    offset = float(jnp.finfo(point.dtype).eps) ** (1 / 3)  # wider than the rounding of a point of rest
    steps = jnp.array([0.0, offset, -offset, offset / NARROWER, -offset / NARROWER], point.dtype)
    # Values instead of slopes: a further derivative of the function would compile twice as long.
    ends = (point + steps[:, None, None] * moves).reshape(-1, len(point))
    middle, up, down, near_up, near_down = jax.vmap(lambda z: function(*unravel(z)))(ends).reshape(5, len(moves), -1)
    wide, narrow = jnp.abs(up - 2 * middle + down), jnp.abs(near_up - 2 * middle + near_down)
    slope, near_slope = jnp.abs(up - down) / (2 * offset), jnp.abs(near_up - near_down) * NARROWER / (2 * offset)
    rounding = jnp.abs(middle) * jnp.finfo(point.dtype).eps * NARROWER / offset
    counts = MAX_SLOPE_JUMP * jnp.max(slope, 0) + MAX_ROUNDINGS * rounding
    bent = (narrow * NARROWER**KINK_POWER > wide) & (narrow * NARROWER / offset > counts)
    # A jump such as that of sign(x) at 0 has no second difference.
    return jnp.any(bent | ((near_slope > MAX_SLOPE_GROWTH * slope) & (near_slope > counts)))


def check_kink(subject: str, kinked: Bool) -> None:
    """Raise ValueError if a flag of a kink is true; accept a traced flag."""
    if not isinstance(kinked, Tracer) and kinked:
        raise ValueError(f"{subject}: a slope jumps here, at a kink: no linear model")


def nan_at_kink(model: T, kinked: Bool) -> T:
    """Return a model, or NaN in its place at a kink."""
    return jax.tree.map(lambda x: jnp.where(kinked, jnp.nan, x), model)


def coordinate_moves(by_x: AnyArray, at: AnyArray) -> AnyArray:
    """Return the moves of x, one a row, that change one coordinate by 1 plus its size and no other."""
    return (jnp.linalg.inv(by_x) * (1 + jnp.abs(at))).T


def as_vectors(plant: Plant, state: object, control: PyTree) -> tuple[Callable[[Array, Array], Array], Array, Array]:
    """Return (flow, x, u): f(x, u) as a function of two vectors, the state as vector x, and the control as vector u."""
    plant, state, control = canonical_dtypes((plant, state, control))
    (x, unravel), (u, unravel_control) = ravel_pytree(state), ravel_pytree(control)

    def flow(x: Array, u: Array) -> Array:
        return ravel_pytree(plant.derivative(0.0, unravel(x), unravel_control(u)))[0]

    return flow, x, u


def _check_chart(by_x: Array, outputs: Sequence[str]) -> None:
    """Raise ValueError unless outputs and remaining states are as many as the states, and independent."""
    rows, columns = by_x.shape
    named = ", ".join(outputs)
    if rows != columns:
        raise ValueError(f"{named} and the states they do not depend on are {rows} coordinates of {columns} states")
    if not isinstance(by_x, Tracer):
        # Rows in their own units: scaled to length 1, so that the rank does not depend on the units.
        unit = by_x / np.maximum(np.linalg.norm(by_x, axis=1, keepdims=True), 1e-300)
        if np.linalg.matrix_rank(unit) < rows:
            raise ValueError(f"{named} are no coordinates here: they depend on each other (singular Jacobian)")


def independent_components(plant: Plant, state: object, outputs: Sequence[str]) -> np.ndarray:
    """Return the indices in the flattened state of the components on which none of the outputs depends."""
    used = used_leaves(plant, state, outputs)
    sizes = [np.size(leaf) for leaf in jax.tree.leaves(state)]
    return np.flatnonzero(np.repeat([not u for u in used], sizes))


def used_leaves(plant: Plant, state: object, outputs: Sequence[str]) -> list[bool]:
    """Return for each leaf of the state whether at least one of the outputs depends on it.

    Dependence is read from the traced computation, not from values. A leaf counts even if its coefficient is zero, and
    the parameters may be tracers.
    """
    leaves, tree = jax.tree.flatten(state)

    def select(*leaves: Array) -> list[Scalar]:
        y = plant.output(jax.tree.unflatten(tree, leaves))
        return [getattr(y, name) for name in outputs]

    # Walk the program backwards and mark every variable that an output needs.
    program = jax.make_jaxpr(select)(*leaves).jaxpr
    needed = {id(v) for v in program.outvars}
    for equation in reversed(program.eqns):
        if needed & {id(v) for v in equation.outvars}:
            needed |= {id(v) for v in equation.invars}
    return [id(v) in needed for v in program.invars]
