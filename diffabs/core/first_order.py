"""Errors in place of wrong derivatives: by a parameter that has none, and the second one of a rule that freezes values.

A derivative rule that freezes values that depend on the parameters has correct first derivatives and wrong second ones.
Such a rule wraps both its input tangents and its output tangents in `first_order`. A second pass in forward mode meets
the wrapper of the output, a second pass in reverse mode that of the input.
"""

from functools import partial
from typing import NoReturn

import jax
import jax.extend.core as jex
from jax.interpreters import ad, batching, mlir

from diffabs.core.types import PyTree, Scalar

_operation = jex.Primitive("first_order")


def first_order(tangents: object, why: str) -> PyTree:
    """Return tangents unchanged; their differentiation raises a ValueError with the message `why`."""

    def each(x: Scalar) -> Scalar:
        return x if getattr(x, "dtype", None) == jax.dtypes.float0 else _operation.bind(x, why=why)

    return jax.tree.map(each, tangents)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def without_derivative(path: str, x: Scalar) -> Scalar:
    """Return x, the value of a parameter; its differentiation raises a ValueError that names the parameter."""
    del path
    return x


@without_derivative.defjvp
def _raise_for_parameter(path: str, at: object, moves: object) -> tuple[PyTree, PyTree]:
    # JAX calls this rule only if x has a tangent that is not a symbolic zero.
    del at, moves
    raise ValueError(
        f"{path} has no derivative: a run does not depend smoothly on it. Differentiate by other parameters, or hold"
        " this one with jax.lax.stop_gradient"
    )


def _raise_for_second_derivative(at: object, moves: object, *, why: str) -> NoReturn:
    del at, moves
    raise ValueError(why)


def _batch_refusal(at: PyTree, axes: PyTree, *, why: str) -> PyTree:
    return _operation.bind(*at, why=why), axes[0]


_operation.def_impl(lambda x, *, why: x)
_operation.def_abstract_eval(lambda x, *, why: x)
ad.primitive_jvps[_operation] = _raise_for_second_derivative
ad.primitive_transposes[_operation] = lambda cotangent, x, *, why: [first_order(cotangent, why)]
batching.primitive_batchers[_operation] = _batch_refusal
mlir.register_lowering(_operation, lambda ctx, x, *, why: [x])
