"""JAX's operations on arrays as operations on single numbers: a rule for each primitive.

An array has a known shape, so it is an array of nodes, and whatever only moves its entries costs nothing. A rule names
the parameters that it knows. A primitive without a rule, or with another parameter (a later JAX may have one), is an
objection, never a guess."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.extend.core as jex
import numpy as np

from diffabs.kernel.graph import Array, Graph, Node, real

LONGEST = 64  # a scan of so many steps is written out; an array of so many entries may be written to, anywhere


class Unsupported(Exception):
    """What cannot be translated: the primitive, and why."""

    def __init__(self, primitive: str, reason: str):
        """`reason` goes on where the primitive's name stands."""
        super().__init__(f"{primitive}: {reason}")
        self.primitive, self.reason = primitive, reason


class Rule(NamedTuple):
    """apply(graph, eqn, inputs) -> outputs, and the names of the parameters that it knows."""

    apply: Callable[[Graph, Any, list[Array]], Sequence[Array]]
    known: frozenset[str]


RULES: dict[str, Rule] = {}


def rule(names: str, known: str = "") -> Callable[[Any], Any]:
    """Register a function of (graph, eqn, inputs) for these primitives, with these parameters."""

    def decorate(apply: Any) -> Any:
        RULES.update({name: Rule(apply, frozenset(known.split())) for name in names.split()})
        return apply

    return decorate


def translate(graph: Graph, jaxpr: Any, constants: Sequence[Array], inputs: Sequence[Array]) -> list[Array]:
    """Return the outputs of a jaxpr as arrays of nodes. Raises Unsupported."""
    at = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *inputs], strict=True))

    def read(atom: Any) -> Array:
        return known(graph, np.asarray(atom.val, atom.aval.dtype)) if isinstance(atom, jex.Literal) else at[atom]

    for eqn in jaxpr.eqns:
        at.update(zip(eqn.outvars, _applied(graph, eqn, [read(atom) for atom in eqn.invars]), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _applied(graph: Graph, eqn: Any, inputs: list[Array]) -> Sequence[Array]:
    name = eqn.primitive.name
    if name not in RULES:
        raise Unsupported(name, "there is no rule for it")
    one = RULES[name]
    if new := sorted(set(eqn.params) - one.known):
        raise Unsupported(name, f"its parameter {new[0]} is not known")
    return one.apply(graph, eqn, inputs)


def known(graph: Graph, x: Any) -> Array:
    """Return an array of known numbers."""
    x = np.asarray(x)
    return each(lambda i: graph.const(x.reshape(-1)[i]), np.arange(x.size).reshape(x.shape))


def single(node: Node) -> Array:
    """Return a node as an array of no dimension."""
    out = np.empty((), object)
    out[()] = node
    return out


def each(function: Callable[..., Node], *arrays: Any) -> Array:
    """Return a function of numbers, entry by entry."""
    arrays = np.broadcast_arrays(*arrays) if len(arrays) > 1 else arrays
    out = np.empty(arrays[0].shape, object)
    for i in np.ndindex(out.shape):
        out[i] = function(*(array[i] for array in arrays))
    return out


def called(graph: Graph, program: Any, inputs: Sequence[Array]) -> list[Array]:
    """Return the outputs of a program within one."""
    jaxpr, constants = (program.jaxpr, program.consts) if hasattr(program, "consts") else (program, ())
    return translate(graph, jaxpr, [known(graph, x) for x in constants], inputs)


# number by number -----------------------------------------------------------------------------------------------------


@rule("and or xor not neg sqrt exp log log1p expm1 sin cos tan tanh atan asin acos sinh cosh atan2", "accuracy")
@rule("div sub is_finite floor ceil eq ne lt le gt ge pow", "accuracy")
@rule("add mul", "out_dtype")
def _same(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    name = eqn.primitive.name
    if eqn.params.get("accuracy") is not None:
        raise Unsupported(name, f"an accuracy is asked of it: {eqn.params['accuracy']}")
    if eqn.params.get("out_dtype") not in (None, eqn.outvars[0].aval.dtype):
        raise Unsupported(name, f"its result is to be {eqn.params['out_dtype']}")
    if name == "div" and not real(eqn.outvars[0].aval.dtype):
        return [each(lambda x, y: _quotient(graph, x, y), *ins)]
    return [each(lambda *x: graph.op(name, *x), *ins)]


def _quotient(graph: Graph, x: Node, y: Node) -> Node:
    """Of whole numbers, towards zero; as XLA has it by 0, where a processor ends the process, -1, and all bits."""
    zero, one = graph.const(0, y.dtype), graph.const(1, y.dtype)
    nothing, turned = graph.op("eq", y, zero), graph.const(False)
    if y.dtype.kind == "i":
        turned = graph.op("eq", y, graph.const(-1, y.dtype))  # of the least number that, too, ends the process
    found = graph.op("quotient", x, graph.select(graph.op("or", nothing, turned), y, one))
    found = graph.select(turned, found, graph.op("neg", x) if y.dtype.kind == "i" else x)
    return graph.select(nothing, found, graph.op("not", zero))


@rule("add_any")
def _sum_of_tangents(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return [each(lambda x, y: graph.op("add", x, y), *ins)]


@rule("stop_gradient copy copy_p optimization_barrier pvary")
def _unchanged(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return ins


@rule("max min")
def _extreme(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    """NaN if either is."""
    return [each(lambda x, y: extreme(graph, eqn.primitive.name, x, y), *ins)]


def extreme(graph: Graph, name: str, x: Node, y: Node) -> Node:
    """Return the larger or smaller of two numbers; NaN if either is."""
    if x is y:
        return x
    if x.dtype == bool:
        return graph.op("or" if name == "max" else "and", x, y)
    return graph.op(name, x, y)


@rule("abs")
def _abs(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return [each(lambda x: graph.op("abs", x), *ins)]


@rule("sign")
def _sign(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    """NaN and zeros are their own sign."""

    def sign(x: Node) -> Node:
        zero, one, less = (graph.const(value, x.dtype) for value in (0, 1, -1 if x.dtype.kind != "u" else 0))
        low = graph.select(graph.op("lt", x, zero), x, less)
        return graph.select(graph.op("gt", x, zero), low, one)

    return [each(sign, *ins)]


@rule("square")
def _square(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return [each(lambda x: graph.op("mul", x, x), *ins)]


@rule("integer_pow", "y")
def _integer_pow(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    def power(x: Node) -> Node:
        n, result = abs(eqn.params["y"]), None
        while n:
            if n & 1:
                result = x if result is None else graph.op("mul", result, x)
            n >>= 1
            x = graph.op("mul", x, x) if n else x
        one = graph.const(1, x.dtype)
        return (result or one) if eqn.params["y"] >= 0 else graph.op("div", one, result or one)

    return [each(power, *ins)]


@rule("rsqrt logistic", "accuracy")
def _inverse(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    if eqn.params["accuracy"] is not None:
        raise Unsupported(eqn.primitive.name, f"an accuracy is asked of it: {eqn.params['accuracy']}")

    def inverse(x: Node) -> Node:
        one = graph.const(1, x.dtype)
        if eqn.primitive.name == "rsqrt":
            return graph.op("div", one, graph.op("sqrt", x))
        return graph.op("div", one, graph.op("add", one, graph.op("exp", graph.op("neg", x))))

    return [each(inverse, *ins)]


@rule("rem")
def _rem(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    if ins[1].size and not real(ins[1].flat[0].dtype) and any(x.op != "const" or x.attr == 0 for x in ins[1].flat):
        return [each(lambda x, y: _whole_rest(graph, x, y), *ins)]
    return [each(lambda x, y: graph.op("rem", x, y), *ins)]


def _whole_rest(graph: Graph, x: Node, y: Node) -> Node:
    """By 0 the rest is the number itself, and not the end of the process."""
    zero = graph.op("eq", y, graph.const(0, y.dtype))
    return graph.select(zero, graph.op("rem", x, graph.select(zero, y, graph.const(1, y.dtype))), x)


@rule("round", "rounding_method")
def _round(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    if eqn.params["rounding_method"].name == "TO_NEAREST_EVEN":
        return [each(lambda x: graph.op("rint", x), *ins)]

    def away(x: Node) -> Node:
        """A half goes away from zero. What the size lacks to its whole part is exact, and its half plus 1/2 is not."""
        size = graph.op("abs", x)
        down = graph.op("floor", size)
        up = graph.op("ge", graph.op("sub", size, down), graph.const(0.5, x.dtype))
        size = graph.select(up, down, graph.op("add", down, graph.const(1, x.dtype)))
        return graph.select(graph.op("lt", x, graph.const(0, x.dtype)), size, graph.op("neg", size))

    return [each(away, *ins)]


@rule("select_n")
def _select(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    which, *cases = ins
    if len(cases) != 2 or eqn.invars[0].aval.dtype != bool:
        raise Unsupported("select_n", f"between {len(cases)} cases")
    return [each(graph.select, which, *cases)]


@rule("clamp")
def _clamp(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    low, x, high = ins
    return [each(lambda a, b, c: extreme(graph, "min", extreme(graph, "max", a, b), c), low, x, high)]


@rule("convert_element_type", "new_dtype weak_type sharding")
def _convert(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return [each(lambda x: graph.convert(x, eqn.params["new_dtype"]), *ins)]


@rule("bitcast_convert_type", "new_dtype")
def _bits(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    if eqn.invars[0].aval.dtype.itemsize != np.dtype(eqn.params["new_dtype"]).itemsize:
        raise Unsupported("bitcast_convert_type", "between types of different sizes")
    return [each(lambda x: graph.bits(x, eqn.params["new_dtype"]), *ins)]


@rule("shift_left shift_right_logical")
def _shift(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    """By as many places as there are, or more, nothing is left."""
    name = eqn.primitive.name

    def shift(x: Node, by: Node) -> Node:
        if name == "shift_right_logical" and x.dtype.kind == "i":
            raise Unsupported(name, "of a number with a sign")
        count, zero = 8 * x.dtype.itemsize, graph.const(0, x.dtype)
        if by.op == "const":
            return graph.op(name, x, by) if 0 <= by.attr < count else zero
        inside = graph.op("lt", by, graph.const(count, by.dtype))
        if by.dtype.kind == "i":
            inside = graph.op("and", inside, graph.op("ge", by, graph.const(0, by.dtype)))
        return graph.select(inside, zero, graph.op(name, x, graph.select(inside, graph.const(0, by.dtype), by)))

    return [each(shift, *ins)]


# shapes ---------------------------------------------------------------------------------------------------------------


@rule("broadcast_in_dim", "shape broadcast_dimensions sharding")
def _broadcast(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    shape = eqn.params["shape"]
    wide = [1] * len(shape)
    for i, dimension in enumerate(eqn.params["broadcast_dimensions"]):
        wide[dimension] = ins[0].shape[i]
    return [np.broadcast_to(ins[0].reshape(wide), shape)]


@rule("reshape", "new_sizes dimensions sharding")
@rule("squeeze", "dimensions")
@rule("expand_dims", "dimensions")
def _reshape(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    if eqn.primitive.name == "reshape" and eqn.params["dimensions"] is not None:
        raise Unsupported("reshape", "in another order of dimensions")
    return [ins[0].reshape(eqn.outvars[0].aval.shape)]


@rule("slice", "start_indices limit_indices strides")
def _slice(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    p = eqn.params
    strides = p["strides"] or [1] * ins[0].ndim
    return [ins[0][tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]]


@rule("concatenate", "dimension")
def _concatenate(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return [np.concatenate(ins, eqn.params["dimension"])]


@rule("transpose", "permutation")
def _transpose(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return [ins[0].transpose(eqn.params["permutation"])]


@rule("rev", "dimensions")
def _rev(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return [np.flip(ins[0], eqn.params["dimensions"])]


@rule("stack", "axis")
def _stack(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return [np.stack(ins, eqn.params["axis"])]


@rule("unstack", "axis")
def _unstack(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return [entry(x) for x in np.moveaxis(ins[0], eqn.params["axis"], 0)]


@rule("split", "axis sizes")
def _split(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return list(np.split(ins[0], np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"]))


@rule("iota", "dtype shape dimension sharding")
def _iota(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    shape, dimension = eqn.params["shape"], eqn.params["dimension"]
    along = np.arange(shape[dimension], dtype=eqn.params["dtype"])
    along = along.reshape([-1 if i == dimension else 1 for i in range(len(shape))])
    return [known(graph, np.broadcast_to(along, shape))]


def entry(x: Any) -> Array:
    """Return what indexing an array of nodes gives, as an array."""
    return x if isinstance(x, np.ndarray) else single(x)


# several entries ------------------------------------------------------------------------------------------------------


@rule("reduce_sum", "axes out_sharding")
@rule("reduce_prod", "axes out_sharding")
@rule("reduce_max", "axes out_sharding")
@rule("reduce_min", "axes out_sharding")
@rule("reduce_and reduce_or", "axes")
def _reduce(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    """In pairs: a short chain."""
    name = eqn.primitive.name.removeprefix("reduce_")
    name, x = {"sum": "add", "prod": "mul"}.get(name, name), ins[0]

    def join(a: Node, b: Node) -> Node:
        return extreme(graph, name, a, b) if name in ("max", "min") else graph.op(name, a, b)

    for axis in sorted(eqn.params["axes"], reverse=True):
        rows = list(np.moveaxis(x, axis, 0)) or [_of_nothing(graph, eqn, np.delete(x.shape, axis))]
        while len(rows) > 1:
            pairs = [each(join, *rows[i : i + 2]) for i in range(0, len(rows) - 1, 2)]
            rows = pairs + rows[2 * len(pairs) :]
        x = entry(rows[0])
    return [x]


def _of_nothing(graph: Graph, eqn: Any, shape: Any) -> Array:
    whole = {"reduce_sum": 0, "reduce_prod": 1, "reduce_and": True, "reduce_or": False}
    if eqn.primitive.name not in whole:
        raise Unsupported(eqn.primitive.name, "of nothing")
    return known(graph, np.full(shape, whole[eqn.primitive.name], eqn.outvars[0].aval.dtype))


@rule("cumsum", "axis reverse")
def _cumsum(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    order = slice(None, None, -1 if eqn.params["reverse"] else 1)
    rows = list(np.moveaxis(ins[0], eqn.params["axis"], 0)[order])
    for i in range(1, len(rows)):
        rows[i] = each(lambda a, b: graph.op("add", a, b), rows[i - 1], rows[i])
    return [np.moveaxis(np.stack(rows)[order], 0, eqn.params["axis"])]


@rule("argmin argmax", "axes index_dtype")
def _first_extreme(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    """The first of equal ones, or the first NaN."""
    if len(eqn.params["axes"]) != 1:
        raise Unsupported(eqn.primitive.name, "over several axes")
    beyond = "lt" if eqn.primitive.name == "argmin" else "gt"
    rows = np.moveaxis(ins[0], eqn.params["axes"][0], 0)
    dtype = eqn.params["index_dtype"]

    def first(*column: Node) -> Node:
        place, best = graph.const(0, dtype), column[0]
        for i, x in enumerate(column[1:], 1):
            nan = graph.op("and", graph.op("ne", x, x), graph.op("eq", best, best))
            better = graph.op("or", graph.op(beyond, x, best), nan)
            place = graph.select(better, place, graph.const(i, dtype))
            best = graph.select(better, best, x)
        return place

    return [each(first, *(entry(row) for row in rows))]


@rule("dot_general", "dimension_numbers precision preferred_element_type out_sharding")
def _dot(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    (left, right), batch = eqn.params["dimension_numbers"]
    if any(batch):
        raise Unsupported("dot_general", "of stacked arrays")
    count = math.prod(ins[0].shape[i] for i in left)
    a = np.moveaxis(ins[0], left, range(len(left))).reshape(count, -1)
    b = np.moveaxis(ins[1], right, range(len(right))).reshape(count, -1)
    out = np.empty((a.shape[1], b.shape[1]), object)
    for i, j in np.ndindex(out.shape):
        terms = [graph.op("mul", x, y) for x, y in zip(a[:, i], b[:, j], strict=True)]
        out[i, j] = terms[0]
        for term in terms[1:]:
            out[i, j] = graph.op("add", out[i, j], term)
    return [out.reshape(eqn.outvars[0].aval.shape)]


# entries at places that a lane decides --------------------------------------------------------------------------------


def _inside(graph: Graph, index: Node, most: int) -> Node:
    low = extreme(graph, "max", index, graph.const(0, index.dtype))
    return extreme(graph, "min", low, graph.const(most, index.dtype))


@rule("dynamic_slice", "slice_sizes")
def _dynamic_slice(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    x, places = ins[0], [place.item() for place in ins[1:]]
    for axis, (size, place) in enumerate(zip(eqn.params["slice_sizes"], places, strict=True)):
        x = _part(graph, x, axis, place, size)
    return [x]


def _part(graph: Graph, x: Array, axis: int, place: Node, size: int) -> Array:
    """So many entries along an axis, from a place, which is moved so that they lie within."""
    most = x.shape[axis] - size
    if most == 0:
        return x
    rows = np.moveaxis(x, axis, 0)
    if place.op == "const":
        start = int(np.clip(place.attr, 0, most))
        return np.moveaxis(rows[start : start + size], 0, axis)
    place = _inside(graph, place, most)
    taken = [each(lambda *column: _entry(graph, place, column), *rows[i : i + most + 1]) for i in range(size)]
    return np.moveaxis(np.stack(taken), 0, axis)


def _entry(graph: Graph, index: Node, column: tuple[Node, ...]) -> Node:
    if len(column) > 2 and all(x.level < x.level.LANE for x in column):
        return graph.table(index, column)
    if len(column) > LONGEST:
        raise Unsupported("dynamic_slice", f"of {len(column)} entries that differ between lanes")
    found = column[-1]
    for i in range(len(column) - 2, -1, -1):
        found = graph.select(graph.op("eq", index, graph.const(i, index.dtype)), found, column[i])
    return found


@rule("gather", "dimension_numbers slice_sizes indices_are_sorted unique_indices mode fill_value")
def _gather(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    """x[i] along the first axis, for each of some i."""
    x, places = ins
    n, p = eqn.params["dimension_numbers"], eqn.params
    simple = (
        n.start_index_map == (0,)
        and n.collapsed_slice_dims == (0,)
        and not n.operand_batching_dims
        and n.offset_dims == tuple(range(places.ndim - 1, places.ndim - 2 + x.ndim))
        and p["slice_sizes"] == (1, *x.shape[1:])
    )
    mode = str(p["mode"]).rsplit(".", 1)[-1]
    if not simple or mode not in ("PROMISE_IN_BOUNDS", "CLIP"):
        raise Unsupported("gather", f"with {n}, {mode}")
    out = np.empty((*places.shape[:-1], *x.shape[1:]), object)
    for at in np.ndindex(places.shape[:-1]):
        out[(*at, ...)] = _part(graph, x, 0, places[(*at, 0)], 1)[0]
    return [out]


@rule("dynamic_update_slice")
def _dynamic_update(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    x, new, places = ins[0], ins[1], [place.item() for place in ins[2:]]
    for axis, place in enumerate(places):
        _writable(eqn, x.shape[axis] if new.shape[axis] != x.shape[axis] and place.op != "const" else 0)
    starts = [_inside(graph, place, most) for place, most in zip(places, np.subtract(x.shape, new.shape), strict=True)]
    out = x.copy()
    for i in np.ndindex(x.shape):
        for k in np.ndindex(new.shape):
            offsets = np.subtract(i, k)
            if all(0 <= o <= m for o, m in zip(offsets, np.subtract(x.shape, new.shape), strict=True)):
                hits = [graph.op("eq", s, graph.const(o, s.dtype)) for s, o in zip(starts, offsets, strict=True)]
                out[i] = graph.select(_all(graph, hits), out[i], new[k])
    return [out]


@rule("scatter", "dimension_numbers indices_are_sorted mode unique_indices update_consts update_jaxpr")
def _scatter(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    """x.at[i].set(value) of one i along the first axis; nothing where that is outside."""
    x, places, new = ins
    n = eqn.params["dimension_numbers"]
    whole = n.update_window_dims == tuple(range(x.ndim - 1)) and n.inserted_window_dims == (0,)
    if not whole or n.scatter_dims_to_operand_dims != (0,) or n.operand_batching_dims or places.size != 1:
        raise Unsupported("scatter", f"with {n}")
    mode = str(eqn.params["mode"]).rsplit(".", 1)[-1]
    if mode not in ("FILL_OR_DROP", "PROMISE_IN_BOUNDS", "CLIP"):
        raise Unsupported("scatter", f"with the mode {mode}")
    _writable(eqn, len(x))
    index, out = places.ravel()[0], np.empty(x.shape, object)
    index = _inside(graph, index, len(x) - 1) if mode == "CLIP" else index
    for i in range(len(x)):
        hit = graph.op("eq", index, graph.const(i, index.dtype))
        out[i, ...] = each(lambda a, b, hit=hit: graph.select(hit, a, b), entry(x[i]), new.reshape(x.shape[1:]))
    return [out]


def _all(graph: Graph, truths: list[Node]) -> Node:
    found = graph.const(True)
    for one in truths:
        found = graph.op("and", found, one)
    return found


def _writable(eqn: Any, count: int) -> None:
    if count > LONGEST:
        raise Unsupported(eqn.primitive.name, f"into {count} entries; {LONGEST} are the most")


# programs within ------------------------------------------------------------------------------------------------------


@rule(
    "jit pjit closed_call core_call remat remat2 checkpoint",
    "jaxpr call_jaxpr name inline in_shardings out_shardings in_layouts out_layouts donated_invars ctx_mesh keep_unused"
    " compiler_options_kvs prevent_cse differentiated policy",
)
@rule("custom_jvp_call", "call_jaxpr jvp_jaxpr_fun num_consts symbolic_zeros")
@rule("custom_vjp_call", "call_jaxpr fwd_jaxpr_thunk bwd num_consts out_trees symbolic_zeros")
def _call(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    return called(graph, eqn.params["call_jaxpr" if "call_jaxpr" in eqn.params else "jaxpr"], ins)


@rule("custom_vmap_call", "call rule in_tree out_tree")
def _of_a_batch(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    """A rule of its own for batches may be anything; it is known if it says of truths whether any is."""
    call = eqn.params["call"].jaxpr
    truth = len(ins) == 1 and eqn.invars[0].aval.dtype == bool and ins[0].ndim == 0
    if not truth or call.eqns or call.invars != call.outvars or not _says_any(eqn):
        raise Unsupported("custom_vmap_call", "its rule for batches is not `any`")
    return [single(graph.any(ins[0].item()))]


def _says_any(eqn: Any) -> bool:
    told = jex.DebugInfo("kernel", "any", None, None)
    body = jex.Jaxpr((), list(eqn.invars), list(eqn.outvars), [eqn], eqn.effects, told)
    found = jax.vmap(lambda x: jex.jaxpr_as_fun(jex.ClosedJaxpr(body, ()))(x)[0])
    with jax.ensure_compile_time_eval():
        return all(bool(found(np.array(x)).all()) == any(x) for x in ([False, False], [False, True], [True, True]))


@rule("cond", "branches")
def _cond(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    which, rest, branches = ins[0].item(), ins[1:], eqn.params["branches"]
    if which.op == "const":
        return called(graph, branches[int(np.clip(which.attr, 0, len(branches) - 1))], rest)
    taken = called(graph, branches[0], rest)
    for i, branch in enumerate(branches[1:], 1):
        asked = graph.convert(which, bool)
        if len(branches) > 2:
            asked = graph.op("ge", which, graph.const(i, which.dtype))
        other = called(graph, branch, rest)
        flat = [[node for array in arrays for node in array.flat] for arrays in (taken, other)]
        gated = iter(graph.gate(asked, *flat))
        taken = [each(lambda _: next(gated), array) for array in taken]  # noqa: B023  used at once
    return taken


@rule("scan", "length reverse jaxpr num_consts num_carry linear unroll _split_transpose")
def _scan(graph: Graph, eqn: Any, ins: list[Array]) -> list[Array]:
    p = eqn.params
    if p["length"] > LONGEST:
        raise Unsupported("scan", f"of {p['length']} steps within a step; {LONGEST} are the most")
    constants, many = p["num_consts"], p["num_carry"]
    fixed, carry, rows = ins[:constants], ins[constants : constants + many], ins[constants + many :]
    order = range(p["length"])[:: -1 if p["reverse"] else 1]
    seen: dict[int, list[Array]] = {}
    for i in order:
        outs = called(graph, p["jaxpr"], [*fixed, *carry, *(entry(row[i]) for row in rows)])
        carry, seen[i] = outs[:many], outs[many:]
    return [*carry, *(np.stack(column) for column in zip(*(seen[i] for i in sorted(seen)), strict=True))]
