"""Comparisons inside functions of a program: the functions that `comparisons` opens, and those that hide comparisons.

A call is opened by its own program. A conditional that compares becomes a selection among all its branches, and the
greatest number of an array a tournament. The function atan2, which jumps behind its origin, becomes two halves. The
rules of JAX's own functions with a derivative rule are known.

Loops, other functions with a derivative rule, and calls of the host stay closed. A comparison in them that depends on
time or state is hidden: no step can end where its answer changes.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.extend.core as jex
import jax.numpy as jnp

from diffabs.core.tracing import scan_input_counts
from diffabs.core.types import Array, Equation, PyTree, Source
from diffabs.engine.step.modes import WORD_BITS

# What compares real numbers, as `comparisons` answers it.
COMPARING_OPERATIONS = ("gt", "ge", "lt", "le", "max", "min", "abs", "sign", "clamp")
SEARCHSORTED = "searchsorted"  # of `jax.numpy` or `core.numerics`, in at most `WORD_BITS` knots
INLINED_CALLS = ("jit", "pjit", "remat", "remat2", "checkpoint", "closed_call", "core_call")
JUMPING_OPERATIONS = ("floor", "ceil", "round", "rem", "argmax", "argmin", "bitcast_convert_type", "lt_to", "le_to")
SORTING_OPERATIONS = ("sort", "top_k", "approx_top_k", "cummax", "cummin", "reduce_window_max", "reduce_window_min")
REDUCING_OPERATIONS = {"reduce_max": jnp.maximum, "reduce_min": jnp.minimum}
CUSTOM_CALLS = ("custom_jvp_call", "custom_vjp_call")
HOST_CALLS = ("pure_callback", "io_callback", "ffi_call")
# Functions of JAX with a derivative rule. The first ones bend where they compare, and their rule is the derivative of
# what they compute. The others are smooth, although they compare.
BENT_RULES = ("relu", "relu6")
SMOOTH_RULES = ("logaddexp", "logaddexp2", "_softmax", "log1mexp", "_i0", "_wofz", "_erfcx", "_dawsn", "logit")
SMOOTH_RULES += ("xlogy", "xlog1py", "_xlogx", "zeta", "log_ndtr", "expi", "sici", "expn", "poch", "hyp1f1", "hyp2f1")
SMOOTH_RULES += ("_owens_t_impl", "_sinc_maclaurin", "_det", "_slogdet_small", "_slogdet_lu", "_slogdet_qr")


class Hidden(NamedTuple):
    """A comparison that a closed function hides.

    Attributes:
        name: What JAX calls the comparison.
        function: What JAX calls the function.
        source: JAX's record of the line that wrote the comparison.
    """

    name: str
    function: str
    source: Source


def open_equation(eqn: Equation, moves: Sequence[bool], bends: bool) -> jex.ClosedJaxpr | None:
    """Return the program that replaces an equation; None for an equation that stays.

    `moves` says which inputs depend on time or state, and `bends` whether derivatives of the result are asked for.
    """
    name, params = eqn.primitive.name, eqn.params
    if name in INLINED_CALLS and not is_knot_search(eqn):
        return _close(params.get("jaxpr") or params.get("call_jaxpr"))
    if name in CUSTOM_CALLS and _origin(eqn) in BENT_RULES:
        return _close(params["call_jaxpr"])
    if name == "cond" and find_hidden(eqn, moves):
        return _trace(eqn, lambda index, *xs: _select_branch(params["branches"], index, xs))
    if name == "atan2" and any(moves) and all(map(_is_real, eqn.invars)):
        return _trace(eqn, _turn_angle)
    if name in REDUCING_OPERATIONS and bends and moves[0] and _is_real(eqn.invars[0]):
        return _trace(eqn, lambda x: [_hold_tournament(REDUCING_OPERATIONS[name], x, params["axes"])])
    return None


def find_hidden(eqn: Equation, moves: Sequence[bool]) -> Hidden | None:
    """Return a comparison that depends on inputs that move, in the inner functions of an equation, or None."""
    name = eqn.primitive.name
    if not any(moves) or is_knot_search(eqn) or (name in CUSTOM_CALLS and _origin(eqn) in SMOOTH_RULES):
        return None
    if name in HOST_CALLS:
        return Hidden(name, name, eqn.source_info)
    for body, inner_moves in _list_bodies(eqn, list(moves)):
        if hidden := _search_body(body, inner_moves)[0]:
            return Hidden(hidden.name, name, hidden.source)
    return None


def jumps(eqn: Equation) -> bool:
    """Return whether the result of an equation jumps or bends where no comparison changes, as a rounded number."""
    name = eqn.primitive.name
    if not eqn.invars or not _is_real(eqn.invars[0]):
        return False
    if name in JUMPING_OPERATIONS or name in SORTING_OPERATIONS:
        return True
    return name == "convert_element_type" and not jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.inexact)


def is_knot_search(eqn: Equation) -> bool:
    """Return whether an equation searches one number in at most `WORD_BITS` knots."""
    shapes = [atom.aval.shape for atom in eqn.invars]
    named = eqn.primitive.name in INLINED_CALLS and eqn.params.get("name") == SEARCHSORTED
    return named and len(shapes) == 2 and shapes[1] == () and len(shapes[0]) == 1 and shapes[0][0] <= WORD_BITS


def find_bent(jaxpr: jex.Jaxpr) -> set[jex.Var]:
    """Return the variables of a jaxpr whose derivatives reach its results: not those behind a `stop_gradient`."""
    bent = {variable for variable in jaxpr.outvars if not isinstance(variable, jex.Literal)}
    for eqn in reversed(jaxpr.eqns):
        if eqn.primitive.name != "stop_gradient" and not bent.isdisjoint(eqn.outvars):
            bent.update(variable for variable in eqn.invars if not isinstance(variable, jex.Literal))
    return bent


def _search_body(jaxpr: jex.Jaxpr, moves: Sequence[bool]) -> tuple[Hidden | None, list[bool]]:
    """Return the first comparison of a jaxpr that depends on inputs that move, and which of its results move."""
    on = dict(zip(jaxpr.invars, moves, strict=True))

    def read(atom: jex.Var | jex.Literal) -> bool:
        return not isinstance(atom, jex.Literal) and on.get(atom, False)

    hidden = None
    for eqn in jaxpr.eqns:
        ins, name = [read(atom) for atom in eqn.invars], eqn.primitive.name
        outs = [any(ins)] * len(eqn.outvars)
        if any(ins) and hidden is None:
            compares = name in COMPARING_OPERATIONS and all(map(_is_real, eqn.invars))
            compares |= name in (*REDUCING_OPERATIONS, "atan2") and _is_real(eqn.invars[0])
            if compares or jumps(eqn) or is_knot_search(eqn):
                hidden = Hidden(SEARCHSORTED if is_knot_search(eqn) else name, name, eqn.source_info)
            else:
                hidden = find_hidden(eqn, ins)
        if name in INLINED_CALLS:
            outs = _search_body(_close(eqn.params.get("jaxpr") or eqn.params["call_jaxpr"]).jaxpr, ins)[1]
        on.update(zip(eqn.outvars, outs, strict=True))
    return hidden, [read(atom) for atom in jaxpr.outvars]


def _list_bodies(eqn: Equation, moves: list[bool]) -> Iterator[tuple[jex.Jaxpr, list[bool]]]:
    """Yield the inner jaxprs of an equation, each with those of its inputs that depend on time or state."""
    name, params = eqn.primitive.name, eqn.params
    if name == "cond":
        yield from ((_close(branch).jaxpr, moves[1:]) for branch in params["branches"])
    elif name == "scan":
        body, (fixed, many) = _close(params["jaxpr"]).jaxpr, scan_input_counts(params, len(moves))
        end = fixed + many
        yield body, [*moves[:fixed], *_follow_carry(body, moves[:fixed], moves[fixed:end], moves[end:]), *moves[end:]]
    elif name == "while":
        ask, body = (_close(params[key]).jaxpr for key in ("cond_jaxpr", "body_jaxpr"))
        first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        carry = _follow_carry(body, moves[first:second], moves[second:], [])
        yield body, [*moves[first:second], *carry]
        yield ask, [*moves[:first], *carry]
    elif name in INLINED_CALLS or name in CUSTOM_CALLS:
        yield _close(params.get("jaxpr") or params["call_jaxpr"]).jaxpr, moves
    else:
        inner = jax.tree.leaves(list(params.values()), is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr"))
        bodies = [_close(x).jaxpr for x in inner if hasattr(x, "eqns") or hasattr(x, "jaxpr")]
        yield from ((body, [True] * len(body.invars)) for body in bodies)


def _follow_carry(body: jex.Jaxpr, fixed: list[bool], carry: list[bool], scanned: list[bool]) -> list[bool]:
    """Return which numbers of a loop's carry depend on time or state, in any of its turns."""
    while True:
        after = _search_body(body, [*fixed, *carry, *scanned])[1][: len(carry)]
        more = [a or b for a, b in zip(carry, after, strict=True)]
        if more == carry:
            return carry
        carry = more


def _select_branch(branches: Sequence[jex.ClosedJaxpr], index: Array, xs: Sequence[PyTree]) -> list[PyTree]:
    """Return the results of the branch `index`; all are computed, and the others have no derivatives."""
    each = []
    for i, branch in enumerate(branches):
        # Otherwise an infinite derivative in a branch that is not taken would become NaN.
        inputs = [jax.lax.select_n(index == i, jax.lax.stop_gradient(x), x) if _is_real(x) else x for x in xs]
        each.append(jex.jaxpr_as_fun(_close(branch))(*inputs))
    return [
        jax.lax.select_n(index.astype(bool) if len(outs) == 2 else index, *outs) for outs in zip(*each, strict=True)
    ]


def _turn_angle(y: Array, x: Array) -> list[Array]:
    """Return atan2(y, x), which jumps at y = 0 > x, from two functions that are smooth there, and a comparison."""
    away = jnp.sqrt(x * x + y * y)
    above = 0.5 * jnp.pi - 2.0 * jnp.arctan(x / jnp.where(away + y == 0, 1.0, away + y))
    below = -0.5 * jnp.pi + 2.0 * jnp.arctan(x / jnp.where(away - y == 0, 1.0, away - y))
    return [jnp.where(away == 0, 0.0, jnp.where(y >= 0, above, below)).astype(x.dtype)]


def _hold_tournament(pick: Callable[[Array, Array], Array], x: Array, axes: Sequence[int]) -> Array:
    """Return the greatest or least numbers along axes by comparisons of two."""
    remaining_shape = [size for axis, size in enumerate(x.shape) if axis not in axes]
    x = jnp.moveaxis(x, axes, range(len(axes))).reshape(-1, *remaining_shape)
    while len(x) > 1:
        half = len(x) // 2
        x = jnp.concatenate([pick(x[:half], x[half : 2 * half]), x[2 * half :]])
    return x[0]


def _trace(eqn: Equation, function: Callable[..., Sequence[PyTree]]) -> jex.ClosedJaxpr:
    return jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in eqn.invars))


def _close(jaxpr: jex.Jaxpr | jex.ClosedJaxpr) -> jex.ClosedJaxpr:
    return jaxpr if isinstance(jaxpr, jex.ClosedJaxpr) else jex.ClosedJaxpr(jaxpr, ())


def _origin(eqn: Equation) -> str:
    """Return the name of the function of JAX that a call with a derivative rule calls; "" if it is not of JAX."""
    source = getattr(_close(eqn.params["call_jaxpr"]).jaxpr.debug_info, "func_src_info", None) or ""
    name, _, place = source.partition(" at ")
    return name if "/jax/_src/" in place.replace("\\", "/") else ""


def _is_real(x: PyTree) -> bool:
    return jnp.issubdtype(getattr(x, "aval", x).dtype, jnp.floating)
