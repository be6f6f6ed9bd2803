"""Lowering rules for random numbers: Threefry, with the same bits as in JAX, and erf_inv for normal variates.

For fold_in and bits, JAX's own functions of a key are traced and inlined. Only the hash is written out here.
"""

import math
from typing import Any

import jax
import jax.extend.random as jer
import jax.numpy as jnp
import numpy as np
from jax.extend.core import JaxprEqn

from diffabs.compiler.ir import Graph, Node, NodeArray
from diffabs.compiler.lower.rules import Unsupported, constant_array, inline_program, lowering_rule, map_entries

MAX_NUMBERS_PER_DRAW = 16  # bound on the size of a draw, because each hash is inlined with about 120 operations
PARITY = 0x1BD11BDA  # constant of Threefry's key schedule
THREEFRY_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))  # bits by which a round rotates, alternating every four rounds


def key_shape(aval: Any) -> tuple[tuple[int, ...], np.dtype]:
    """Return shape and type of an array; for a random key, shape and type of its words."""
    if not jnp.issubdtype(aval.dtype, jax.dtypes.prng_key):
        return aval.shape, np.dtype(aval.dtype)
    if str(aval.dtype) != "key<fry>":
        raise Unsupported("random_bits", f"of the generator {aval.dtype}")
    return (*aval.shape, 2), np.dtype(np.uint32)


@lowering_rule("random_wrap", "impl")
@lowering_rule("random_unwrap")
def _wrap_key(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    key_shape((eqn.outvars if eqn.primitive.name == "random_wrap" else eqn.invars)[0].aval)
    return ins


@lowering_rule("random_fold_in")
def _fold_in(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    if key_shape(eqn.invars[0].aval)[0] != (2,) or ins[1].ndim:
        raise Unsupported("random_fold_in", "of several keys")
    fold = jer.threefry_prng_impl.fold_in
    program = jax.make_jaxpr(fold)(*(jax.ShapeDtypeStruct(*spec) for spec in (((2,), np.uint32), ((), np.uint32))))
    return inline_program(graph, program, [ins[0], map_entries(lambda x: graph.convert(x, np.uint32), ins[1])])


@lowering_rule("random_bits", "bit_width shape")
def _bits(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    width, shape = eqn.params["bit_width"], eqn.params["shape"]
    if key_shape(eqn.invars[0].aval)[0] != (2,) or math.prod(shape) > MAX_NUMBERS_PER_DRAW:
        raise Unsupported("random_bits", f"of {math.prod(shape)} numbers at once, or of several keys")
    # Trace JAX's own function: the layout of the counters depends on width and shape, and stays JAX's.
    draw = jax.make_jaxpr(lambda key: jer.threefry_prng_impl.random_bits(key, width, shape))
    return inline_program(graph, draw(jax.ShapeDtypeStruct((2,), np.uint32)), ins)


@lowering_rule("iota_2x32_shape", "shape")
def _iota_words(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    """Return the index of each entry in the flattened array as two arrays of 32-bit words, high words first."""
    places = np.arange(math.prod(eqn.params["shape"]), dtype=np.uint32).reshape(eqn.params["shape"])
    return [constant_array(graph, 0 * places), constant_array(graph, places)]


@lowering_rule("threefry2x32")
def _threefry(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    """Return the two words of Threefry-2x32 with 20 rounds, entry by entry.

    Source: Salmon, Moraes, Dror and Shaw, Parallel random numbers: as easy as 1, 2, 3 (2011).
    """
    return [map_entries(lambda *words, i=i: threefry(graph, *words)[i], *ins) for i in range(2)]


def threefry(graph: Graph, k0: Node, k1: Node, x0: Node, x1: Node) -> tuple[Node, Node]:
    """Return the two words (uint32) of Threefry-2x32 with 20 rounds for the counter (x0, x1) and the key (k0, k1)."""

    def word(value: int) -> Node:
        return graph.const(value, np.uint32)

    keys = [k0, k1, graph.op("xor", graph.op("xor", k0, k1), word(PARITY))]
    x0, x1 = graph.op("add", x0, keys[0]), graph.op("add", x1, keys[1])
    # Five groups of four rounds. Each group ends with a key injection: two of the three key words and a counter.
    for i in range(5):
        for places in THREEFRY_ROTATIONS[i % 2]:
            x0 = graph.op("add", x0, x1)
            high, low = (
                graph.op("shift_left", x1, word(places)),
                graph.op("shift_right_logical", x1, word(32 - places)),
            )
            x1 = graph.op("xor", graph.op("or", high, low), x0)
        x0 = graph.op("add", x0, keys[(i + 1) % 3])
        x1 = graph.op("add", graph.op("add", x1, keys[(i + 2) % 3]), word(i + 1))
    return x0, x1


# M. Giles, Approximating the erfinv function (2012): polynomials in w = -log(1 - x^2), with XLA's coefficients. Each
# row has the upper end of a range of w, the variable of that range, and the coefficients, highest power first.
ERF_INV_SINGLE = (
    (5.0, lambda graph, w: graph.op("sub", w, graph.const(2.5, w.dtype)), (
        2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087, -0.00125372503, -0.00417768164,
        0.246640727, 1.50140941)),
    (math.inf, lambda graph, w: graph.op("sub", graph.op("sqrt", w), graph.const(3.0, w.dtype)), (
        -0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773, -0.0076224613, 0.00943887047,
        1.00167406, 2.83297682)),
)  # fmt: skip
ERF_INV_DOUBLE = (
    (6.25, lambda graph, w: graph.op("sub", w, graph.const(3.125, w.dtype)), (
        -3.6444120640178196996e-21, -1.685059138182016589e-19, 1.2858480715256400167e-18, 1.115787767802518096e-17,
        -1.333171662854620906e-16, 2.0972767875968561637e-17, 6.6376381343583238325e-15, -4.0545662729752068639e-14,
        -8.1519341976054721522e-14, 2.6335093153082322977e-12, -1.2975133253453532498e-11, -5.4154120542946279317e-11,
        1.051212273321532285e-09, -4.1126339803469836976e-09, -2.9070369957882005086e-08, 4.2347877827932403518e-07,
        -1.3654692000834678645e-06, -1.3882523362786468719e-05, 0.0001867342080340571352, -0.00074070253416626697512,
        -0.0060336708714301490533, 0.24015818242558961693, 1.6536545626831027356)),
    (16.0, lambda graph, w: graph.op("sub", graph.op("sqrt", w), graph.const(3.25, w.dtype)), (
        2.2137376921775787049e-09, 9.0756561938885390979e-08, -2.7517406297064545428e-07, 1.8239629214389227755e-08,
        1.5027403968909827627e-06, -4.013867526981545969e-06, 2.9234449089955446044e-06, 1.2475304481671778723e-05,
        -4.7318229009055733981e-05, 6.8284851459573175448e-05, 2.4031110387097893999e-05, -0.0003550375203628474796,
        0.00095328937973738049703, -0.0016882755560235047313, 0.0024914420961078508066, -0.0037512085075692412107,
        0.005370914553590063617, 1.0052589676941592334, 3.0838856104922207635)),
    (math.inf, lambda graph, w: graph.op("sub", graph.op("sqrt", w), graph.const(5.0, w.dtype)), (
        -2.7109920616438573243e-11, -2.5556418169965252055e-10, 1.5076572693500548083e-09, -3.7894654401267369937e-09,
        7.6157012080783393804e-09, -1.4960026627149240478e-08, 2.9147953450901080826e-08, -6.7711997758452339498e-08,
        2.2900482228026654717e-07, -9.9298272942317002539e-07, 4.5260625972231537039e-06, -1.9681778105531670567e-05,
        7.5995277030017761139e-05, -0.00021503011930044477347, -0.00013871931833623122026, 1.0103004648645343977,
        4.8499064014085844221)),
)  # fmt: skip


@lowering_rule("erf_inv", "accuracy")
def _erf_inv(graph: Graph, eqn: JaxprEqn, ins: list[NodeArray]) -> list[NodeArray]:
    return [map_entries(lambda x: erf_inv(graph, x), *ins)]


def erf_inv(graph: Graph, x: Node) -> Node:
    """Return y with erf(y) = x: infinite at x = 1 and x = -1, NaN outside [-1, 1]."""
    w = graph.op("neg", graph.op("log1p", graph.op("neg", graph.op("mul", x, x))))
    root: Node | None = None
    for upper, shifted, powers in reversed(ERF_INV_SINGLE if x.dtype == np.float32 else ERF_INV_DOUBLE):
        at, y = shifted(graph, w), graph.const(powers[0], x.dtype)
        for power in powers[1:]:
            y = graph.op("add", graph.op("mul", y, at), graph.const(power, x.dtype))
        root = y if root is None else graph.select(graph.op("lt", w, graph.const(upper, x.dtype)), root, y)
    assert root is not None
    # At x = 1 and x = -1, w is infinite and the leading coefficient, not x, would decide the sign of the result.
    ends = graph.op("eq", graph.op("abs", x), graph.const(1, x.dtype))
    return graph.select(ends, graph.op("mul", root, x), graph.op("mul", x, graph.const(np.inf, x.dtype)))
