"""Linear models of a plant, by automatic differentiation.

    linearize    x' = f(x, u) at any point:  A = df/dx, B = df/du
    tracking     the dynamics of a tracked output while other outputs are frozen

What is frozen (a brake's speed) is a parameter of the model: its fall is a change of the model, not of its state.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree

from diffabs.core.protocols import Plant
from diffabs.core.pytree import canonical_dtypes
from diffabs.plants.wheel import FROZEN_OUTPUTS

REMAINING_STATE_ITERATIONS = (
    10  # iterations for the rest of the remaining states; one is enough where their equation is linear
)


class StateSpace(NamedTuple):
    """x' = A x + B u, or x+ = A x + B u: A (n, n), B (n, m)."""

    A: Any
    B: Any


def linearize(plant: Plant, state: Any, control: Any) -> StateSpace:
    """Return df/dx (n, n) and df/du (n, m) of a plant, x' = f(x, u), at a state and a control.

    plant: its `derivative` is f
    state, control: the point, which need not be an equilibrium; the components of x are the leaves of the state

    >>> from diffabs import BrakeStart, plants, roads
    >>> from diffabs.linear import linearize
    >>> car = plants.QuarterCar(inertia=0.8, road=roads.DRY_ASPHALT)
    >>> linearize(car, car.start(BrakeStart(speed=20.0, slip=0.1)), 90.0).B.shape  # speed, spin, distance
    (3, 1)
    """
    flow, x, u = as_vectors(plant, state, control)
    return StateSpace(*jax.jacfwd(flow, (0, 1))(x, u))


def tracking_dynamics(
    plant: Plant, state: Any, control: Any, tracked: Sequence[str] = ("slip",), frozen: Sequence[str] = FROZEN_OUTPUTS
) -> StateSpace:
    """The linear dynamics of outputs `tracked` and of the remaining states, with the outputs `frozen` held.

        xi = F(x) = (h(x), remaining, w(x)),  xi' = DF(x) f(x, u) =: G(x, u),  A = (dG/dx) DF^-1,  B = dG/du

    and of these the rows and columns of (h, remaining). Remaining are the state's components on which neither h nor w
    depends. Exact at any point: where f is not zero, dG/dx contains the second derivative of F times f.

    Raises:
        ValueError: the outputs and the remaining states are no coordinates: too many, too few, or dependent (this last
            only outside of jit; inside, the matrices are not finite).
    """
    plant, state, control = canonical_dtypes((plant, state, control))
    flow, x, u = as_vectors(plant, state, control)
    unravel = ravel_pytree(state)[1]
    kept = independent_components(plant, state, (*tracked, *frozen))

    def chart(x: Any) -> Any:
        y = plant.output(unravel(x))
        h, w = ([jnp.ravel(getattr(y, name)) for name in names] for names in (tracked, frozen))
        return jnp.concatenate([*h, x[kept], *w])

    by_x = jax.jacfwd(chart)(x)
    _check_chart(by_x, (*tracked, *frozen))
    a, b = jax.jacfwd(lambda x, u: jax.jvp(chart, (x,), (flow(x, u),))[1], (0, 1))(x, u)
    n = len(x) - sum(np.size(getattr(jax.eval_shape(plant.output, state), name)) for name in frozen)
    return StateSpace(jnp.linalg.solve(by_x.T, a.T).T[:n, :n], b[:n])


def as_vectors(plant: Plant, state: Any, control: Any) -> Any:
    """Return f(x, u) on vectors, and the vectors x and u."""
    plant, state, control = canonical_dtypes((plant, state, control))
    (x, unravel), (u, unravel_control) = ravel_pytree(state), ravel_pytree(control)

    def flow(x: Any, u: Any) -> Any:
        return ravel_pytree(plant.derivative(0.0, unravel(x), unravel_control(u)))[0]

    return flow, x, u


def _check_chart(by_x: Any, outputs: Sequence[str]) -> None:
    """Outputs and remaining states must be as many as the states, and independent."""
    rows, columns = by_x.shape
    named = ", ".join(outputs)
    if rows != columns:
        raise ValueError(f"{named} and the states they do not depend on are {rows} coordinates of {columns} states")
    if not isinstance(by_x, Tracer):
        unit = by_x / np.maximum(np.linalg.norm(by_x, axis=1, keepdims=True), 1e-300)
        if np.linalg.matrix_rank(unit) < rows:
            raise ValueError(f"{named} are no coordinates here: they depend on each other (singular Jacobian)")


def independent_components(plant: Plant, state: Any, outputs: Sequence[str]) -> np.ndarray:
    """Return the places in the raveled state of the components that none of the outputs depends on."""
    used = used_leaves(plant, state, outputs)
    sizes = [np.size(leaf) for leaf in jax.tree.leaves(state)]
    return np.flatnonzero(np.repeat([not u for u in used], sizes))


def used_leaves(plant: Plant, state: Any, outputs: Sequence[str]) -> list[bool]:
    """Return of each leaf of the state whether some output is computed from it. From the traced program, not from
    values: it must be known while the parameters are tracers."""
    leaves, tree = jax.tree.flatten(state)

    def select(*leaves: Any) -> Any:
        y = plant.output(jax.tree.unflatten(tree, leaves))
        return [getattr(y, name) for name in outputs]

    program = jax.make_jaxpr(select)(*leaves).jaxpr
    needed = {id(v) for v in program.outvars}
    for equation in reversed(program.eqns):
        if needed & {id(v) for v in equation.outvars}:
            needed |= {id(v) for v in equation.invars}
    return [id(v) in needed for v in program.invars]
