"""JAX's operations on arrays as operations on single numbers: a rule for each primitive.

An array has a known shape, so it is an array of nodes, and whatever only moves its entries costs nothing. A rule names
the parameters that it knows. A primitive without a rule, or with another parameter (a later JAX may have one), is an
objection, never a guess."""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.extend.core as jex
import numpy as np

from diffabs.kernel.graph import Array, Graph, Node

JAX = pathlib.Path(jax.__file__).parent
INTERNAL_FOLDERS = [pathlib.Path(__file__).parents[1] / name for name in ("core", "kernel", "simulate")]


class Unsupported(Exception):
    """What cannot be translated: the primitive, why, and, where it can be told, the method of the part that asks."""

    def __init__(self, primitive: str, reason: str):
        """`reason` goes on where the primitive's name stands."""
        super().__init__(primitive, reason)
        self.primitive, self.reason, self.method = primitive, reason, ""

    def __str__(self) -> str:
        """One line."""
        return f"{self.primitive}: {self.reason}" + (f" (in {self.method})" if self.method else "")


class LoweringRule(NamedTuple):
    """apply(graph, eqn, inputs) -> outputs, and the names of the parameters that it knows."""

    apply: Callable[[Graph, Any, list[Array]], Sequence[Array]]
    known: frozenset[str]


LOWERING_RULES: dict[str, LoweringRule] = {}


def lowering_rule(names: str, known: str = "") -> Callable[[Any], Any]:
    """Register a function of (graph, eqn, inputs) for these primitives, with these parameters."""

    def decorate(apply: Any) -> Any:
        LOWERING_RULES.update({name: LoweringRule(apply, frozenset(known.split())) for name in names.split()})
        return apply

    return decorate


def lower_jaxpr(graph: Graph, jaxpr: Any, constants: Sequence[Array], inputs: Sequence[Array]) -> list[Array]:
    """Return the outputs of a jaxpr as arrays of nodes. Raises Unsupported."""
    at = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *inputs], strict=True))

    def read(atom: Any) -> Array:
        return constant_array(graph, atom.val, _dtype(atom)) if isinstance(atom, jex.Literal) else at[atom]

    for eqn in jaxpr.eqns:
        graph.begins(eqn)
        at.update(zip(eqn.outvars, _apply_rule(graph, eqn, [read(atom) for atom in eqn.invars]), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _dtype(atom: Any) -> Any:
    return atom.aval.dtype


def _apply_rule(graph: Graph, eqn: Any, inputs: list[Array]) -> Sequence[Array]:
    name = eqn.primitive.name
    try:
        if name not in LOWERING_RULES:
            raise Unsupported(name, "there is no rule for it")
        if new := sorted(set(eqn.params) - LOWERING_RULES[name].known):
            raise Unsupported(name, f"its parameter {new[0]} is not known")
        return LOWERING_RULES[name].apply(graph, eqn, inputs)
    except Unsupported as error:
        error.method = error.method or _calling_method(eqn)
        raise


def _calling_method(eqn: Any) -> str:
    """The innermost method from which this comes, of a class that is not JAX's nor of what carries parts; or none."""
    traceback = getattr(getattr(eqn, "source_info", None), "traceback", None)
    for frame in getattr(traceback, "frames", ()):
        place = pathlib.Path(frame.file_name)
        method = frame.function_name.partition(".<locals>")[0]
        if "." in method and not (JAX in place.parents or any(folder in place.parents for folder in INTERNAL_FOLDERS)):
            return method
    return ""


def constant_array(graph: Graph, x: Any, dtype: Any = None) -> Array:
    """Return an array of known numbers."""
    x = np.asarray(x, dtype)
    return map_entries(lambda i: graph.const(x.reshape(-1)[i]), np.arange(x.size).reshape(x.shape))


def scalar_array(node: Node) -> Array:
    """Return a node as an array of no dimension."""
    out = np.empty((), object)
    out[()] = node
    return out


def map_entries(function: Callable[..., Node], *arrays: Any) -> Array:
    """Return a function of numbers, entry by entry."""
    arrays = np.broadcast_arrays(*arrays) if len(arrays) > 1 else arrays
    out = np.empty(arrays[0].shape, object)
    for i in np.ndindex(out.shape):
        out[i] = function(*(array[i] for array in arrays))
    return out


def inline_program(graph: Graph, program: Any, inputs: Sequence[Array]) -> list[Array]:
    """Return the outputs of a program within one."""
    jaxpr, constants = (program.jaxpr, program.consts) if hasattr(program, "consts") else (program, ())
    return lower_jaxpr(graph, jaxpr, [constant_array(graph, x) for x in constants], inputs)


def as_node_array(x: Any) -> Array:
    """Return what indexing an array of nodes gives, as an array."""
    return x if isinstance(x, np.ndarray) else scalar_array(x)
