"""Find out by tracing, without computing anything, what depends on what."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from diffabs.core.first_order import first_order
from diffabs.core.pytree import parameters


def differentiated_paths(tangents: Any) -> frozenset[str]:
    """Return the paths of a part's parameters by which it is differentiated, from its tangents in a rule with
    `symbolic_zeros`."""
    return frozenset(path for path, _, move in parameters(tangents) if type(move) is not SymbolicZero)


def jvp_nonzero(function: Callable[..., Any], primals: Any, tangents: Any, once: str = "") -> tuple[Any, Any]:
    """Return function(*primals) and its derivative along tangents, of a rule with `symbolic_zeros`. Only what has a
    tangent is differentiated: zeros worked out would cost as much as any other.

    once: why a function has no second derivatives; whoever asks for them gets a ValueError with this line"""
    values, tree = jax.tree.flatten(primals)
    moves = tree.flatten_up_to(tangents)
    live = [type(move) is not SymbolicZero for move in moves]

    def run(moving: list[Any]) -> Any:
        left = iter(moving)
        return function(*tree.unflatten([next(left) if on else x for x, on in zip(values, live, strict=True)]))

    moving, rates = ([x for x, on in zip(xs, live, strict=True) if on] for xs in (values, moves))
    if not once:
        return jax.jvp(run, (moving,), (rates,))
    found, rate = jax.jvp(run, (moving,), (first_order(rates, once),))
    return found, first_order(rate, once)


def split_batched(make: Callable[[Any], Any], batch: Any) -> tuple[Any, Callable[[Any], Any]]:
    """`make` over a batch, with what does not depend on the batch worked out once: the leaves (n, ...) that do, and a
    function from those of one member to the whole. In a loop over lanes constants then stay numbers, which a processor
    keeps in registers, instead of becoming columns."""
    one = jax.tree.map(lambda x: x[0], batch)
    program, shape = jax.make_jaxpr(make, return_shape=True)(one)
    depends = set(program.jaxpr.invars)
    for step in program.jaxpr.eqns:
        if any(not hasattr(v, "val") and v in depends for v in step.invars):
            depends.update(step.outvars)
    moves = [not hasattr(v, "val") and v in depends for v in program.jaxpr.outvars]
    fixed, tree = jax.tree.leaves(make(one)), jax.tree.structure(shape)

    def moving(member: Any) -> list[Any]:
        return [x for x, on in zip(jax.tree.leaves(make(member)), moves, strict=True) if on]

    def whole(leaves: list[Any]) -> Any:
        rest = iter(leaves)
        return tree.unflatten([next(rest) if on else x for x, on in zip(fixed, moves, strict=True)])

    return jax.vmap(moving)(batch) if any(moves) else [], whole


def depends_on_signal(function: Callable[[Any], Any], signal: Any) -> bool:
    """Return whether what a function of a signal returns depends on it, as its program has it; a product with a zero
    that stands there does not."""
    return any(leaf_dependence(function, signal))


def leaf_dependence(function: Callable[[Any], Any], signal: Any) -> list[bool]:
    """Return for each leaf of a signal whether what a function of it returns depends on the leaf, as in `follows`."""
    program = jax.make_jaxpr(function)(signal).jaxpr
    needed = {atom for atom in program.outvars if not hasattr(atom, "val")}
    for step in reversed(program.eqns):
        if not _zero(step) and not needed.isdisjoint(step.outvars):
            needed.update(atom for atom in step.invars if not hasattr(atom, "val"))
    return [atom in needed for atom in program.invars]


def moving_leaves(function: Callable[[Any, Any], Any], fixed: Any, batch: Any) -> Any:
    """Return by which leaves of `batch` (n, ...) function(fixed, batch), of one member, has derivatives: truths, as
    `batch`. What only decides has none."""
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), (fixed, batch))
    program = jax.make_jaxpr(function)(*one).jaxpr

    def moves(atom: Any) -> bool:
        return not hasattr(atom, "val") and jnp.issubdtype(atom.aval.dtype, jnp.inexact)

    needed = {atom for atom in program.outvars if moves(atom)}
    for step in reversed(program.eqns):
        if not needed.isdisjoint(step.outvars):
            needed.update(atom for atom in step.invars if moves(atom))
    leaves, tree = jax.tree.flatten(batch)
    return tree.unflatten([atom in needed for atom in program.invars[-len(leaves) :]])


def _zero(step: Any) -> bool:
    """Whether a step of a program multiplies by zero."""
    return step.primitive.name == "mul" and any(np.all(v.val == 0) for v in step.invars if hasattr(v, "val"))
