"""Tracing of functions of one lane, (lane, carry) to carry, to jaxprs.

Values that the functions close over are inputs, the same for all lanes. So new values need no new compilation.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.extend.core as jex

from diffabs.compiler.ir import UpdateLevel
from diffabs.core.types import PyTree, Scalar


class TracedFunction(NamedTuple):
    """A function of one lane as a jaxpr of the arrays of lane and carry.

    Attributes:
        jaxpr: Jaxpr; its constvars are the arrays of `closed`, then those of `constants`.
        closed: Indices in `TracedFunctions.uniform` of the arrays that the function closes over.
        constants: Values that become constants of the program. Only a derivative has them.
    """

    jaxpr: jex.Jaxpr
    closed: tuple[int, ...]
    constants: tuple[PyTree, ...] = ()


class TracedFunctions(NamedTuple):
    """Traced functions of one lane with the arrays they share.

    Attributes:
        each: Functions by name.
        types: Shapes and types of one lane's arrays: UNIFORM closed over, LANE lane's constants, STEP carry.
        uniform: The uniform arrays, which may be tracers.
        names: Paths of the arrays of lane and carry in their pytrees, for listings; empty for uniform arrays.
    """

    each: dict[str, TracedFunction]
    types: dict[UpdateLevel, list[PyTree]]
    uniform: list[PyTree]
    names: dict[UpdateLevel, list[str]]


def trace_functions(
    functions: dict[str, Callable[[PyTree, PyTree], PyTree]], lane: object, carry: object
) -> TracedFunctions:
    """Return functions of (lane, carry) as jaxprs, with the arrays that they close over.

    `lane` and `carry` have the shapes and types of one lane's arrays, without the axis of lanes.
    """
    uniform: list[PyTree] = []
    numbers: dict[int, int] = {}
    each: dict[str, TracedFunction] = {}
    for name, function in functions.items():
        closed = jax.make_jaxpr(function)(lane, carry)
        for x in closed.consts:
            # Functions that close over the same array share one input. Equal values in two arrays stay two inputs.
            if id(x) not in numbers:
                numbers[id(x)] = len(uniform)
                uniform.append(x)
        each[name] = TracedFunction(closed.jaxpr, tuple(numbers[id(x)] for x in closed.consts))
    types = {
        UpdateLevel.UNIFORM: uniform,
        UpdateLevel.LANE: jax.tree.leaves(lane),
        UpdateLevel.STEP: jax.tree.leaves(carry),
    }
    names = {
        UpdateLevel.UNIFORM: [""] * len(uniform),
        UpdateLevel.LANE: _leaf_names(lane),
        UpdateLevel.STEP: _leaf_names(carry),
    }
    return TracedFunctions(each, {level: [_type(x) for x in xs] for level, xs in types.items()}, uniform, names)


def _leaf_names(tree: object) -> list[str]:
    """Return the path of each leaf, such as point.state.plant.speed."""
    return [
        ".".join(str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path)
        for path, _ in jax.tree_util.tree_leaves_with_path(tree)
    ]


def _type(x: Scalar) -> jax.ShapeDtypeStruct:
    """Return shape and type of an array without its sharding, because the program is for one lane."""
    aval = x if isinstance(x, jax.ShapeDtypeStruct) else jax.typeof(x)
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=getattr(aval, "weak_type", False))
