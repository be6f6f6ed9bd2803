"""Dependences between the inputs and outputs of functions, found by tracing without a computation."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import JaxprEqn, Literal
from jax.interpreters.partial_eval import dce_jaxpr

from diffabs.core.first_order import first_order
from diffabs.core.pytree import parameters
from diffabs.core.types import Params, PyTree


def differentiated_paths(tangents: object) -> frozenset[str]:
    """Return the paths of the parameters by which a part is differentiated, from tangents with symbolic zeros."""
    return frozenset(path for path, _, move in parameters(tangents) if type(move) is not SymbolicZero)


def jvp_nonzero(
    function: Callable[..., PyTree], primals: object, tangents: object, once: str = ""
) -> tuple[PyTree, PyTree]:
    """Return function(*primals) and its derivative along the tangents, for a rule with `symbolic_zeros`.

    Only leaves with a tangent are differentiated, since zero tangents cost as much as others. `once` is the message of
    the ValueError that a second derivative raises, or "" if the function has second derivatives.
    """
    values, tree = jax.tree.flatten(primals)
    moves = tree.flatten_up_to(tangents)
    live = [type(move) is not SymbolicZero for move in moves]

    def run(moving: list[PyTree]) -> Any:
        live_leaves = iter(moving)
        return function(*tree.unflatten([next(live_leaves) if on else x for x, on in zip(values, live, strict=True)]))

    moving, rates = ([x for x, on in zip(xs, live, strict=True) if on] for xs in (values, moves))
    if not once:
        return jax.jvp(run, (moving,), (rates,))
    outputs, rate = jax.jvp(run, (moving,), (first_order(rates, once),))
    return outputs, first_order(rate, once)


def split_batched(make: Callable[[PyTree], PyTree], batch: object) -> tuple[PyTree, Callable[[PyTree], PyTree]]:
    """Return (leaves, whole): the result of `make` for each member of a batch (n, ...), with constants kept apart.

    `leaves` are those leaves of the result that depend on the member, each (n, ...). `whole` takes these leaves for one
    member and returns its result. The other leaves are computed once. In a loop over runs they stay numbers, which a
    processor keeps in registers, instead of columns.
    """
    first = jax.tree.map(lambda x: x[0], batch)
    program, shape = jax.make_jaxpr(make, return_shape=True)(first)
    # Forward pass: each equation with a dependent input has dependent outputs. Literals have `val` and do not depend.
    depends = set(program.jaxpr.invars)
    for step in program.jaxpr.eqns:
        if any(not hasattr(v, "val") and v in depends for v in step.invars):
            depends.update(step.outvars)
    moves = [not hasattr(v, "val") and v in depends for v in program.jaxpr.outvars]
    fixed, tree = jax.tree.leaves(make(first)), jax.tree.structure(shape)

    def moving_outputs(member: object) -> list[PyTree]:
        return [x for x, on in zip(jax.tree.leaves(make(member)), moves, strict=True) if on]

    def whole(leaves: list[PyTree]) -> Any:
        moving = iter(leaves)
        return tree.unflatten([next(moving) if on else x for x, on in zip(fixed, moves, strict=True)])

    return jax.vmap(moving_outputs)(batch) if any(moves) else [], whole


def depends_on_signal(function: Callable[[PyTree], PyTree], signal: object) -> bool:
    """Return whether a function's traced result depends on its signal; a product with a literal zero does not count."""
    return any(leaf_dependence(function, signal))


def leaf_dependence(function: Callable[[PyTree], PyTree], signal: object) -> list[bool]:
    """Return for each leaf of a signal, in order, whether a function depends on it (`depends_on_signal`)."""
    return used_inputs(jax.make_jaxpr(function)(signal).jaxpr, lambda step: not _zero(step))


def used_inputs(program: Any, passes: Callable[[Any], bool] = lambda step: True) -> list[bool]:
    """Return for each input of a jaxpr whether a result depends on it, by the equations that `passes` accepts."""
    steps = [step for step in program.eqns if passes(step)]
    return dce_jaxpr(program.replace(eqns=steps), [True] * len(program.outvars))[1]


def read_leaves(
    function: Callable[[PyTree, PyTree], PyTree], fixed: object, batch: object, *, differentiably: bool = False
) -> PyTree:
    """Return a pytree of bools: whether function(fixed, batch) of one member depends on each leaf of `batch`.

    Both arguments have leaves (n, ...). With `differentiably` only leaves count by which the function has a derivative.
    Leaves that only enter decisions have none.
    """
    member = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), (fixed, batch))
    program = jax.make_jaxpr(function)(*member).jaxpr

    def counts(atom: PyTree) -> bool:
        # Integer and boolean values carry no derivative: a comparison ends the dependence.
        return not differentiably or jnp.issubdtype(atom.aval.dtype, jnp.inexact)

    program = program.replace(outvars=[atom for atom in program.outvars if counts(atom)])
    used = used_inputs(program, lambda step: any(map(counts, step.outvars)))
    leaves, tree = jax.tree.flatten(batch)
    inputs = zip(program.invars, used, strict=True)
    return tree.unflatten([is_used and counts(atom) for atom, is_used in inputs][-len(leaves) :])


def scan_input_counts(params: Params, inputs: int) -> tuple[int, int]:
    """Return how many inputs of a scan are constants and how many are carried, from the primitive's parameters.

    Until JAX 0.10 these are numbers. Later versions store a structure with three groups of inputs, in their order.
    """
    if "num_carry" in params:
        return params["num_consts"], params["num_carry"]
    try:
        groups = [list(group) for group in params["ft_in"].update(range(inputs)).unpack()]
    except (AssertionError, AttributeError, KeyError, TypeError, ValueError):
        groups = []
    if len(groups) != 3 or [i for group in groups for i in group] != [*range(inputs)]:
        raise ValueError("its parameter ft_in is not known")
    return len(groups[0]), len(groups[1])


def _zero(step: JaxprEqn) -> bool:
    """Return whether an equation of a jaxpr multiplies by a literal zero."""
    return step.primitive.name == "mul" and any(np.all(v.val == 0) for v in step.invars if isinstance(v, Literal))
