"""The translation of JAX primitives on arrays into operations on single numbers, by one lowering rule for each
primitive.

Shapes are known, so an array becomes a NumPy array of nodes, and moving its entries costs nothing. A rule lists the
parameters it handles. A primitive without a rule, or with an unknown parameter (as in a later JAX), raises Unsupported.
"""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.extend.core as jex
import numpy as np
from jax.extend.core import JaxprEqn
from jax.typing import DTypeLike

from diffabs.compiler.ir import Graph, Node, NodeArray
from diffabs.core.types import PyTree, Scalar

JAX = pathlib.Path(jax.__file__).parent
INTERNAL_FOLDERS = [pathlib.Path(__file__).parents[2] / name for name in ("core", "compiler", "engine", "loop")]


class Unsupported(Exception):
    """An error: a JAX primitive cannot be lowered, or an operation cannot be translated to a language.

    Attributes:
        primitive: Name of the primitive or operation; "carry", "step" or "log" for a limit of kernels.
        reason: The reason, as it continues after the primitive's name.
        method: Method of the part that uses the primitive, empty if unknown.
    """

    def __init__(self, primitive: str, reason: str):
        """Store `primitive` and `reason`; `reason` is text that continues a line after the primitive's name."""
        super().__init__(primitive, reason)
        self.primitive = primitive
        self.reason = reason
        self.method: str = ""

    def __str__(self) -> str:
        """Return the message, one line."""
        return f"{self.primitive}: {self.reason}" + (f" (in {self.method})" if self.method else "")


class LoweringRule(NamedTuple):
    """A rule for a primitive.

    Attributes:
        apply: Function (graph, eqn, inputs) -> outputs.
        parameters: Names of the parameters that the primitive may have; another one is refused.
    """

    apply: Callable[[Graph, PyTree, list[NodeArray]], Sequence[NodeArray]]
    parameters: frozenset[str]


LOWERING_RULES: dict[str, LoweringRule] = {}


def lowering_rule(names: str, parameters: str = "") -> Callable[[PyTree], PyTree]:
    """Return a decorator that registers a function (graph, eqn, inputs) -> outputs as the rule of some primitives.

    `names` lists the primitives, `parameters` all that they may have, separated by blanks.
    """

    def decorate(apply: Any) -> Any:
        LOWERING_RULES.update({name: LoweringRule(apply, frozenset(parameters.split())) for name in names.split()})
        return apply

    return decorate


def lower_jaxpr(
    graph: Graph, jaxpr: Any, constants: Sequence[NodeArray], inputs: Sequence[NodeArray]
) -> list[NodeArray]:
    """Lower a jaxpr to a graph and return its outputs as arrays of nodes."""
    arrays = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *inputs], strict=True))

    def read(atom: object) -> NodeArray:
        if isinstance(atom, jex.Literal):
            return constant_array(graph, atom.val, atom.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
        return arrays[atom]

    for eqn in jaxpr.eqns:
        graph.begin_equation(eqn)
        name, ins = eqn.primitive.name, [read(atom) for atom in eqn.invars]
        try:
            if name not in LOWERING_RULES:
                raise Unsupported(name, "there is no rule for it")
            # An unknown parameter may change the meaning of the primitive.
            if new := sorted(set(eqn.params) - LOWERING_RULES[name].parameters):
                raise Unsupported(name, f"its parameter {new[0]} is not known")
            outs = LOWERING_RULES[name].apply(graph, eqn, ins)
        except Unsupported as error:
            # The innermost equation names the method first. Outer calls keep that name.
            error.method = error.method or _calling_method(eqn)
            raise
        arrays.update(zip(eqn.outvars, outs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _calling_method(eqn: JaxprEqn) -> str:
    """Return the innermost method that made the equation, outside JAX and this package's core; else ""."""
    traceback = getattr(getattr(eqn, "source_info", None), "traceback", None)
    for frame in getattr(traceback, "frames", ()):
        place = pathlib.Path(frame.file_name)
        method = frame.function_name.partition(".<locals>")[0]
        if "." in method and not (JAX in place.parents or any(folder in place.parents for folder in INTERNAL_FOLDERS)):
            return method
    return ""


def constant_array(graph: Graph, x: Scalar, dtype: DTypeLike | None = None) -> NodeArray:
    """Return an array of constant nodes."""
    x = np.asarray(x, dtype)
    return map_entries(lambda i: graph.const(x.reshape(-1)[i]), np.arange(x.size).reshape(x.shape))


def scalar_array(node: Node) -> NodeArray:
    """Return a node as an array of shape ()."""
    out = np.empty((), object)
    out[()] = node
    return out


def map_entries(function: Callable[..., Node], *arrays: PyTree) -> NodeArray:
    """Apply a function entry by entry, with broadcasting, and return the array of its results."""
    arrays = np.broadcast_arrays(*arrays) if len(arrays) > 1 else arrays
    out = np.empty(arrays[0].shape, object)
    for i in np.ndindex(out.shape):
        out[i] = function(*(array[i] for array in arrays))
    return out


def inline_program(graph: Graph, program: jex.ClosedJaxpr, inputs: Sequence[NodeArray]) -> list[NodeArray]:
    """Lower a program (jaxpr, closed or not) that another one calls, and return its outputs as arrays of nodes."""
    jaxpr, constants = (program.jaxpr, program.consts) if hasattr(program, "consts") else (program, ())
    return lower_jaxpr(graph, jaxpr, [constant_array(graph, x) for x in constants], inputs)


def as_node_array(x: Node | NodeArray) -> NodeArray:
    """Return `x` itself if it is an array, or a single node as an array of shape ()."""
    return x if isinstance(x, np.ndarray) else scalar_array(x)
