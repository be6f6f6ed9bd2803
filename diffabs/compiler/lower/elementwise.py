"""Lowering rules for elementwise primitives: arithmetic, functions, comparisons, conversions and bit operations."""

import numpy as np
from jax.extend.core import JaxprEqn

from diffabs.compiler.ir import Graph, Node, NodeArray, is_real
from diffabs.compiler.lower.rules import Unsupported, lowering_rule, map_entries
from diffabs.core.types import Equation


@lowering_rule(
    "and or xor not neg abs sqrt exp log log1p expm1 sin cos tan tanh atan asin acos sinh cosh atan2", "accuracy"
)
@lowering_rule("div sub is_finite floor ceil eq ne lt le gt ge pow", "accuracy")
@lowering_rule("add add_any mul", "out_dtype")
def _elementwise(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    name = eqn.primitive.name.removesuffix("_any")
    if eqn.params.get("accuracy") is not None:
        raise Unsupported(name, f"an accuracy is asked of it: {eqn.params['accuracy']}")
    if eqn.params.get("out_dtype") not in (None, eqn.outvars[0].aval.dtype):
        raise Unsupported(name, f"its result is to be {eqn.params['out_dtype']}")
    if name == "div" and not is_real(eqn.outvars[0].aval.dtype):
        return [map_entries(lambda x, y: _integer_quotient(graph, x, y), *ins)]
    if name == "pow" and not is_real(eqn.invars[1].aval.dtype):
        ins = [ins[0], map_entries(lambda y: graph.convert(y, eqn.invars[0].aval.dtype), ins[1])]
    return [map_entries(lambda *x: graph.op(name, *x), *ins)]


@lowering_rule("lt_to le_to")
def _total_order(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    """Compare in the total order of sorting and searching: -NaN < -inf < ... < -0 < 0 < ... < inf < NaN."""
    integer = np.dtype(f"i{eqn.invars[0].aval.dtype.itemsize}")

    def key(x: Node) -> Node:
        if not is_real(x.dtype):
            return x
        # The bits of a real number, read as an integer, have its order; those of a negative one have the reverse order.
        bits = graph.bits(x, integer)
        reverse = graph.op("xor", bits, graph.const(np.iinfo(integer).max, integer))
        return graph.select(graph.op("lt", bits, graph.const(0, integer)), bits, reverse)

    return [map_entries(lambda x, y: graph.op(eqn.primitive.name[:2], key(x), key(y)), *ins)]


def _integer_quotient(graph: Graph, x: Node, y: Node) -> Node:
    """Return an integer quotient rounded towards zero, with a value where the processor would stop the process.

    As in XLA, x/0 has all bits set, and the least integer divided by -1 is itself.
    """
    zero, unit = graph.const(0, y.dtype), graph.const(1, y.dtype)
    by_zero, by_minus_one = graph.op("eq", y, zero), graph.const(False)
    if y.dtype.kind == "i":
        # The least integer divided by -1 overflows, which stops the process on x86. A negation wraps instead.
        by_minus_one = graph.op("eq", y, graph.const(-1, y.dtype))
    # The divisor is made valid first: both sides of a selection are computed in every lane.
    quotient = graph.op("quotient", x, graph.select(graph.op("or", by_zero, by_minus_one), y, unit))
    quotient = graph.select(by_minus_one, quotient, graph.op("neg", x) if y.dtype.kind == "i" else x)
    return graph.select(by_zero, quotient, graph.op("not", zero))


@lowering_rule("stop_gradient copy copy_p optimization_barrier pvary")
@lowering_rule("name", "name")
@lowering_rule("reshard", "dst_sharding concrete_mesh")
def _identity(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    return ins


@lowering_rule("max min")
def _max_min(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    """Return the larger or smaller of two arrays, entry by entry; NaN if either is NaN."""
    return [map_entries(lambda x, y: max_or_min(graph, eqn.primitive.name, x, y), *ins)]


def max_or_min(graph: Graph, name: str, x: Node, y: Node) -> Node:
    """Return the larger or smaller of two numbers, NaN if either is NaN; of booleans, the larger is their "or"."""
    if x is y:
        return x
    if x.dtype == bool:
        return graph.op("or" if name == "max" else "and", x, y)
    return graph.op(name, x, y)


@lowering_rule("sign")
def _sign(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    """Return the sign; NaN, 0 and -0 stay themselves."""

    def sign(x: Node) -> Node:
        zero, unit, less = (graph.const(value, x.dtype) for value in (0, 1, -1 if x.dtype.kind != "u" else 0))
        low = graph.select(graph.op("lt", x, zero), x, less)
        # Both comparisons are false for NaN, 0 and -0, so x remains.
        return graph.select(graph.op("gt", x, zero), low, unit)

    return [map_entries(sign, *ins)]


@lowering_rule("square")
def _square(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    return [map_entries(lambda x: graph.op("mul", x, x), *ins)]


@lowering_rule("integer_pow", "y")
def _integer_pow(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    def power(x: Node) -> Node:
        # Binary powers as in XLA. A negative exponent inverts the final product.
        n, result = abs(eqn.params["y"]), None
        while n:
            if n & 1:
                result = x if result is None else graph.op("mul", result, x)
            n >>= 1
            x = graph.op("mul", x, x) if n else x
        unit = graph.const(1, x.dtype)
        return (result or unit) if eqn.params["y"] >= 0 else graph.op("div", unit, result or unit)

    return [map_entries(power, *ins)]


@lowering_rule("rsqrt logistic", "accuracy")
def _rsqrt_or_logistic(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    if eqn.params["accuracy"] is not None:
        raise Unsupported(eqn.primitive.name, f"an accuracy is asked of it: {eqn.params['accuracy']}")

    def inverse(x: Node) -> Node:
        unit = graph.const(1, x.dtype)
        if eqn.primitive.name == "rsqrt":
            return graph.op("div", unit, graph.op("sqrt", x))
        return graph.op("div", unit, graph.op("add", unit, graph.op("exp", graph.op("neg", x))))

    return [map_entries(inverse, *ins)]


@lowering_rule("rem")
def _rem(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    # A constant divisor other than 0 and -1 needs no guard.
    divisors = ins[1].flat
    if ins[1].size and not is_real(divisors[0].dtype) and any(x.op != "const" or x.attr in (0, -1) for x in divisors):
        return [map_entries(lambda x, y: _integer_remainder(graph, x, y), *ins)]
    return [map_entries(lambda x, y: graph.op("rem", x, y), *ins)]


def _integer_remainder(graph: Graph, x: Node, y: Node) -> Node:
    """Return an integer remainder with the sign of x, with a value where the processor would stop the process.

    The remainder is x for y = 0 as in XLA, and 0 for y = -1.
    """
    zero, unit = graph.op("eq", y, graph.const(0, y.dtype)), graph.const(False)
    if y.dtype.kind == "i":
        # The least integer divided by -1 overflows, which stops the process on x86. The remainder by 1 is the same.
        unit = graph.op("eq", y, graph.const(-1, y.dtype))
    safe = graph.select(graph.op("or", zero, unit), y, graph.const(1, y.dtype))
    return graph.select(zero, graph.op("rem", x, safe), x)


@lowering_rule("round", "rounding_method")
def _round(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    if eqn.params["rounding_method"].name == "TO_NEAREST_EVEN":
        return [map_entries(lambda x: graph.op("rint", x), *ins)]

    def away(x: Node) -> Node:
        """Round to the nearest integer, half away from zero."""
        # size - floor(size) is exact. floor(size + 1/2) is not: for the number just below 1/2 the sum rounds to 1.
        size = graph.op("abs", x)
        down = graph.op("floor", size)
        up = graph.op("ge", graph.op("sub", size, down), graph.const(0.5, x.dtype))
        size = graph.select(up, down, graph.op("add", down, graph.const(1, x.dtype)))
        return graph.select(graph.op("lt", x, graph.const(0, x.dtype)), size, graph.op("neg", size))

    return [map_entries(away, *ins)]


@lowering_rule("select_n")
def _select(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    condition, *cases = ins
    if len(cases) != 2 or eqn.invars[0].aval.dtype != bool:
        raise Unsupported("select_n", f"between {len(cases)} cases")
    return [map_entries(graph.select, condition, *cases)]


@lowering_rule("clamp")
def _clamp(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    low, x, high = ins
    return [map_entries(lambda a, b, c: max_or_min(graph, "min", max_or_min(graph, "max", a, b), c), low, x, high)]


@lowering_rule("convert_element_type", "new_dtype weak_type sharding")
def _convert(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    return [map_entries(lambda x: graph.convert(x, eqn.params["new_dtype"]), *ins)]


@lowering_rule("bitcast_convert_type", "new_dtype")
def _bits(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    if eqn.invars[0].aval.dtype.itemsize != np.dtype(eqn.params["new_dtype"]).itemsize:
        raise Unsupported("bitcast_convert_type", "between types of different sizes")
    return [map_entries(lambda x: graph.bits(x, eqn.params["new_dtype"]), *ins)]


@lowering_rule("shift_left shift_right_logical")
def _shift(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    """Shift by a number of bits; a shift by the width or more gives 0, where C leaves it undefined."""
    name = eqn.primitive.name

    def shift(x: Node, by: Node) -> Node:
        if name == "shift_right_logical" and x.dtype.kind == "i":
            raise Unsupported(name, "of a number with a sign")
        # The shift distance is made valid first: both sides of a selection are computed.
        count, zero = 8 * x.dtype.itemsize, graph.const(0, x.dtype)
        if by.op == "const":
            return graph.op(name, x, by) if 0 <= by.attr < count else zero
        inside = graph.op("lt", by, graph.const(count, by.dtype))
        if by.dtype.kind == "i":
            inside = graph.op("and", inside, graph.op("ge", by, graph.const(0, by.dtype)))
        return graph.select(inside, zero, graph.op(name, x, graph.select(inside, graph.const(0, by.dtype), by)))

    return [map_entries(shift, *ins)]


@lowering_rule("population_count")
def _population_count(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    """Count the bits that are set: sums of pairs, of fours and of eights, then a product that adds the four bytes."""

    def count(x: Node) -> Node:
        if x.dtype != np.uint32:
            raise Unsupported("population_count", f"of {x.dtype}")

        def part(y: Node, places: int, mask: int) -> Node:
            """Return `y`, shifted right by `places` bits, and `mask`."""
            moved = graph.op("shift_right_logical", y, graph.const(places, y.dtype))
            return graph.op("and", moved if places else y, graph.const(mask, y.dtype))

        x = graph.op("sub", x, part(x, 1, 0x55555555))
        x = graph.op("add", part(x, 0, 0x33333333), part(x, 2, 0x33333333))
        fours = graph.op("add", x, graph.op("shift_right_logical", x, graph.const(4, x.dtype)))
        bytes_ = graph.op("mul", part(fours, 0, 0x0F0F0F0F), graph.const(0x01010101, x.dtype))
        return graph.op("shift_right_logical", bytes_, graph.const(24, x.dtype))

    return [map_entries(count, *ins)]
