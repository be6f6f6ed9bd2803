"""Lowering rules for entries at computed indices: slices, gather and scatter.

A graph of single numbers has no memory, so an index is compared with every possible index. A read of entries that are
the same for all lanes becomes a table instead.
"""

import numpy as np
from jax.extend.core import JaxprEqn

from diffabs.compiler.ir import Graph, Node, NodeArray, UpdateLevel
from diffabs.compiler.lower.elementwise import max_or_min
from diffabs.compiler.lower.rules import Unsupported, as_node_array, lowering_rule, map_entries
from diffabs.core.types import PyTree

MAX_COMPARED_ENTRIES = 64  # possible indices of one read or write by comparison


def _clamp_index(graph: Graph, index: Node, last: int) -> Node:
    """Return an index clamped to [0, last]."""
    low = max_or_min(graph, "max", index, graph.const(0, index.dtype))
    return max_or_min(graph, "min", low, graph.const(last, index.dtype))


@lowering_rule("dynamic_slice", "slice_sizes")
def _dynamic_slice(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    x, places = ins[0], [place.item() for place in ins[1:]]
    for axis, (size, place) in enumerate(zip(eqn.params["slice_sizes"], places, strict=True)):
        x = _part(graph, x, axis, place, size)
    return [x]


def _part(graph: Graph, x: NodeArray, axis: int, place: Node, size: int) -> NodeArray:
    """Return `size` entries along an axis from index `place`, which is clamped so that they lie inside."""
    last = x.shape[axis] - size
    if last == 0:
        return x
    rows = np.moveaxis(x, axis, 0)
    if place.op == "const":
        start = int(np.clip(place.attr, 0, last))
        return np.moveaxis(rows[start : start + size], 0, axis)
    place = _clamp_index(graph, place, last)
    entries: PyTree = [map_entries(lambda *x: _entry(graph, place, x), *rows[i : i + last + 1]) for i in range(size)]
    return np.moveaxis(np.stack(entries), 0, axis)


def _entry(graph: Graph, index: Node, column: tuple[Node, ...]) -> Node:
    """Return the entry of a column at an index; too many entries that differ between lanes are refused."""
    if len(column) > MAX_COMPARED_ENTRIES and any(x.level >= UpdateLevel.LANE for x in column):
        raise Unsupported("dynamic_slice", f"of {len(column)} entries that differ between lanes")
    return graph.table(index, column)


@lowering_rule("gather", "dimension_numbers slice_sizes indices_are_sorted unique_indices mode fill_value")
def _gather(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    """Return x[i] along the first axis for each index i."""
    x, places = ins
    n, p = eqn.params["dimension_numbers"], eqn.params
    simple = (
        n.start_index_map == (0,)
        and n.collapsed_slice_dims == (0,)
        and not n.operand_batching_dims
        and n.offset_dims == tuple(range(places.ndim - 1, places.ndim - 2 + x.ndim))
        and p["slice_sizes"] == (1, *x.shape[1:])
    )
    # Both modes allow `_part` to clamp the index. FILL_OR_DROP would need a fill value for an index outside.
    mode, last = str(p["mode"]).rsplit(".", 1)[-1], len(x) - 1
    inside = all(i.op == "const" and 0 <= i.attr <= last for i in places.flat)
    if not simple or not (inside or mode in ("PROMISE_IN_BOUNDS", "CLIP")):
        raise Unsupported("gather", f"with {n}, {mode}")
    out = np.empty((*places.shape[:-1], *x.shape[1:]), object)
    for at in np.ndindex(places.shape[:-1]):
        out[(*at, ...)] = _part(graph, x, 0, places[(*at, 0)], 1)[0]
    return [out]


@lowering_rule("dynamic_update_slice")
def _dynamic_update(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    x, new, places = ins[0], ins[1], [place.item() for place in ins[2:]]
    for axis, place in enumerate(places):
        _check_writable(eqn, x.shape[axis] if new.shape[axis] != x.shape[axis] and place.op != "const" else 0)
    room = [a - b for a, b in zip(x.shape, new.shape, strict=True)]
    starts = [_clamp_index(graph, place, last) for place, last in zip(places, room, strict=True)]
    out = x.copy()
    # One pass for each possible position: the block is written where all clamped indices match.
    for start in np.ndindex(*(last + 1 for last in room)):
        hits = [graph.op("eq", s, graph.const(o, s.dtype)) for s, o in zip(starts, start, strict=True)]
        hit = graph.const(True)
        for axis_hit in hits:
            hit = graph.op("and", hit, axis_hit)
        inside = tuple(slice(o, o + size) for o, size in zip(start, new.shape, strict=True))
        out[inside] = map_entries(lambda a, b, hit=hit: graph.select(hit, a, b), out[inside], new)
    return [out]


@lowering_rule(
    "scatter scatter-add", "dimension_numbers indices_are_sorted mode unique_indices update_consts update_jaxpr"
)
def _scatter(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    """Return x.at[i].set(value) or x.at[i].add(value) for one index i along the first axis.

    An index outside of the array changes nothing, or is clamped in the mode CLIP.
    """
    x, places, new = ins
    n = eqn.params["dimension_numbers"]
    whole = n.update_window_dims == tuple(range(x.ndim - 1)) and n.inserted_window_dims == (0,)
    if not whole or n.scatter_dims_to_operand_dims != (0,) or n.operand_batching_dims or places.size != 1:
        raise Unsupported(eqn.primitive.name, f"with {n}")
    mode = str(eqn.params["mode"]).rsplit(".", 1)[-1]
    if mode not in ("FILL_OR_DROP", "PROMISE_IN_BOUNDS", "CLIP"):
        raise Unsupported(eqn.primitive.name, f"with the mode {mode}")
    _check_writable(eqn, len(x))
    index, out = places.ravel()[0], np.empty(x.shape, object)
    # Without the clamp, an index outside matches no entry, so the array stays, as FILL_OR_DROP demands.
    index = _clamp_index(graph, index, len(x) - 1) if mode == "CLIP" else index
    adds = eqn.primitive.name == "scatter-add"
    for i in range(len(x)):
        hit = graph.op("eq", index, graph.const(i, index.dtype))

        def write(old: Node, new: Node, hit: Node = hit) -> Node:
            return graph.select(hit, old, graph.op("add", old, new) if adds else new)

        out[i, ...] = map_entries(write, as_node_array(x[i]), new.reshape(x.shape[1:]))
    return [out]


def _check_writable(eqn: JaxprEqn, count: int) -> None:
    """Raise Unsupported for a write that compares an index with more than MAX_COMPARED_ENTRIES possible ones."""
    if count > MAX_COMPARED_ENTRIES:
        raise Unsupported(eqn.primitive.name, f"into {count} entries; {MAX_COMPARED_ENTRIES} are the most")
