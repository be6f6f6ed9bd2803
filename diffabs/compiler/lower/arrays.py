"""Lowering rules for primitives that move entries of an array (reshape, pad) or reduce them (sum, dot), and iota."""

import math
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn

from diffabs.compiler.ir import Graph, Node, NodeArray
from diffabs.compiler.lower.elementwise import max_or_min
from diffabs.compiler.lower.rules import Unsupported, as_node_array, constant_array, lowering_rule, map_entries
from diffabs.core.types import Equation


@lowering_rule("broadcast_in_dim", "shape broadcast_dimensions sharding")
def _broadcast(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    shape = eqn.params["shape"]
    wide = [1] * len(shape)
    for i, dimension in enumerate(eqn.params["broadcast_dimensions"]):
        wide[dimension] = ins[0].shape[i]
    return [np.broadcast_to(ins[0].reshape(wide), shape)]


@lowering_rule("reshape", "new_sizes dimensions sharding")
@lowering_rule("squeeze", "dimensions")
@lowering_rule("expand_dims", "dimensions")
def _reshape(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    if eqn.primitive.name == "reshape" and eqn.params["dimensions"] is not None:
        raise Unsupported("reshape", "in another order of dimensions")
    return [ins[0].reshape(eqn.outvars[0].aval.shape)]


@lowering_rule("slice", "start_indices limit_indices strides")
def _slice(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    p = eqn.params
    strides = p["strides"] or [1] * ins[0].ndim
    return [ins[0][tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]]


@lowering_rule("concatenate", "dimension")
def _concatenate(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    return [np.concatenate(ins, eqn.params["dimension"])]


@lowering_rule("pad", "padding_config")
def _pad(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    """Pad before, after and between the entries of each axis; a negative width crops."""
    x, value = ins[0], ins[1].item()
    # Order as in XLA: interior padding first, then a negative edge width crops the dilated array.
    for axis, (low, high, between) in enumerate(eqn.params["padding_config"]):
        rows = np.moveaxis(x, axis, 0)
        wide = np.full((max(0, len(rows) + between * (len(rows) - 1)), *rows.shape[1:]), value, object)
        wide[:: between + 1] = rows
        ends = [np.full((max(0, n), *rows.shape[1:]), value, object) for n in (low, high)]
        padded = np.concatenate([ends[0], wide, ends[1]])
        first, last = max(0, -low), len(padded) - max(0, -high)
        x = np.moveaxis(padded[first : max(first, last)], 0, axis)
    return [x]


@lowering_rule("transpose", "permutation")
def _transpose(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    return [ins[0].transpose(eqn.params["permutation"])]


@lowering_rule("rev", "dimensions")
def _rev(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    return [np.flip(ins[0], eqn.params["dimensions"])]


@lowering_rule("stack", "axis")
def _stack(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    return [np.stack(ins, eqn.params["axis"])]


@lowering_rule("unstack", "axis")
def _unstack(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    return [as_node_array(x) for x in np.moveaxis(ins[0], eqn.params["axis"], 0)]


@lowering_rule("split", "axis sizes")
def _split(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    return list(np.split(ins[0], np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"]))


@lowering_rule("iota", "dtype shape dimension sharding")
def _iota(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    shape, dimension = eqn.params["shape"], eqn.params["dimension"]
    along = np.arange(shape[dimension], dtype=eqn.params["dtype"])
    along = along.reshape([-1 if i == dimension else 1 for i in range(len(shape))])
    return [constant_array(graph, np.broadcast_to(along, shape))]


REDUCTION_OPERATIONS: dict[str, str] = {"sum": "add", "prod": "mul"}
NEUTRAL_ELEMENTS: dict[str, int] = {"sum": 0, "prod": 1, "and": True, "or": False}


def _neutral_element(kind: str, dtype: np.dtype) -> Any:
    """Return the result of a reduction of nothing."""
    if kind not in ("max", "min"):
        return NEUTRAL_ELEMENTS[kind]
    if np.issubdtype(dtype, np.floating):
        return np.inf if kind == "min" else -np.inf
    return np.iinfo(dtype).max if kind == "min" else np.iinfo(dtype).min


@lowering_rule("reduce_sum", "axes out_sharding")
@lowering_rule("reduce_prod", "axes out_sharding")
@lowering_rule("reduce_max", "axes out_sharding")
@lowering_rule("reduce_min", "axes out_sharding")
@lowering_rule("reduce_and reduce_or", "axes")
def _reduce(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    """Reduce by pairs: the longest dependency chain of n entries has about log2(n) operations."""
    kind, x = eqn.primitive.name.removeprefix("reduce_"), ins[0]
    name: Any = REDUCTION_OPERATIONS.get(kind, kind)

    def join(a: Node, b: Node) -> Node:
        return max_or_min(graph, name, a, b) if name in ("max", "min") else graph.op(name, a, b)

    for axis in sorted(eqn.params["axes"], reverse=True):
        rows = list(np.moveaxis(x, axis, 0))
        if not rows:
            dtype = eqn.outvars[0].aval.dtype
            nothing = np.full(np.delete(x.shape, axis), _neutral_element(kind, dtype), dtype)
            rows = [constant_array(graph, nothing)]
        while len(rows) > 1:
            pairs = [map_entries(join, *rows[i : i + 2]) for i in range(0, len(rows) - 1, 2)]
            rows = pairs + rows[2 * len(pairs) :]
        x = as_node_array(rows[0])
    return [x]


@lowering_rule("cumsum", "axis reverse")
def _cumsum(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    order = slice(None, None, -1 if eqn.params["reverse"] else 1)
    # A reversed sum runs over the flipped rows, and the result is flipped back.
    if not ins[0].size:
        return ins
    rows = list(np.moveaxis(ins[0], eqn.params["axis"], 0)[order])
    for i in range(1, len(rows)):
        rows[i] = map_entries(lambda a, b: graph.op("add", a, b), rows[i - 1], rows[i])
    return [np.moveaxis(np.stack(rows)[order], 0, eqn.params["axis"])]


@lowering_rule("argmin argmax", "axes index_dtype")
def _first_extreme(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    """Return the index of the first extreme entry, or of the first NaN if there is one, as JAX does."""
    if len(eqn.params["axes"]) != 1:
        raise Unsupported(eqn.primitive.name, "over several axes")
    beyond = "lt" if eqn.primitive.name == "argmin" else "gt"
    rows = np.moveaxis(ins[0], eqn.params["axes"][0], 0)
    dtype = eqn.params["index_dtype"]

    def first(*column: Node) -> Node:
        # x != x detects NaN. A NaN replaces the best entry once, because no later comparison with it is true.
        place, best = graph.const(0, dtype), column[0]
        for i, x in enumerate(column[1:], 1):
            nan = graph.op("and", graph.op("ne", x, x), graph.op("eq", best, best))
            better = graph.op("or", graph.op(beyond, x, best), nan)
            place = graph.select(better, place, graph.const(i, dtype))
            best = graph.select(better, best, x)
        return place

    return [map_entries(first, *(as_node_array(row) for row in rows))]


@lowering_rule("dot_general", "dimension_numbers precision preferred_element_type out_sharding")
def _dot(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    (left_axes, right_axes), batch = eqn.params["dimension_numbers"]
    if any(batch):
        raise Unsupported("dot_general", "of stacked arrays")
    if len({x.aval.dtype for x in (*eqn.invars, *eqn.outvars)}) > 1 or not ins[0].size:
        raise Unsupported("dot_general", "of nothing, or of two types")
    count = math.prod(ins[0].shape[i] for i in left_axes)
    a = np.moveaxis(ins[0], left_axes, range(len(left_axes))).reshape(count, -1)
    b = np.moveaxis(ins[1], right_axes, range(len(right_axes))).reshape(count, -1)
    out: Any = np.empty((a.shape[1], b.shape[1]), object)
    # Sequential sum: every product can fuse with its addition (FMA). A sum by pairs allows that at its leaves only.
    for i, j in np.ndindex(out.shape):
        terms = [graph.op("mul", a[k, i], b[k, j]) for k in range(count)]
        out[i, j] = terms[0]
        for term in terms[1:]:
            out[i, j] = graph.op("add", out[i, j], term)
    return [out.reshape(eqn.outvars[0].aval.shape)]


@lowering_rule("empty empty2", "dtype memory_space shape out_sharding")
def _empty(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    """Return zeros for an array without values, which a branch of a conditional leaves to the other one."""
    kind = eqn.outvars[0].aval
    return [constant_array(graph, np.zeros(kind.shape, kind.dtype))]
