"""An error where a derivative would be wrong: by a parameter that has none, and second ones of a frozen rule.

A rule for derivatives that freezes what depends on the parameters has right first derivatives and wrong second ones.
Such a rule wraps both the tangents that it gets and the tangents that it returns in `first_order`. A second pass in
forward mode meets the wrapper of the result, a pass in reverse mode that of the argument."""

from functools import partial
from typing import Any

import jax
import jax.extend.core as jex
from jax.interpreters import ad, batching, mlir

_operation = jex.Primitive("first_order")


def first_order(tangents: Any, why: str) -> Any:
    """Return tangents (a pytree) as they are. Whoever differentiates them gets a ValueError that says `why`."""

    def each(x: Any) -> Any:
        return x if getattr(x, "dtype", None) == jax.dtypes.float0 else _operation.bind(x, why=why)

    return jax.tree.map(each, tangents)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def without_derivative(path: str, x: Any) -> Any:
    """Return x, the value of the parameter at this path. Whoever differentiates it gets a ValueError that names it."""
    del path
    return x


@without_derivative.defjvp
def _raise_for_parameter(path: str, at: Any, moves: Any) -> tuple[Any, Any]:
    # JAX asks for this rule only where x has a tangent: one that is known to be zero does not come here.
    del at, moves
    raise ValueError(
        f"{path} has no derivative: a run does not depend smoothly on it. Differentiate by other parameters, or hold"
        " this one with jax.lax.stop_gradient"
    )


def _raise_for_second_derivative(at: Any, moves: Any, *, why: str) -> Any:
    del at, moves
    raise ValueError(why)


def _batch_refusal(at: Any, axes: Any, *, why: str) -> Any:
    return _operation.bind(*at, why=why), axes[0]


_operation.def_impl(lambda x, *, why: x)
_operation.def_abstract_eval(lambda x, *, why: x)
ad.primitive_jvps[_operation] = _raise_for_second_derivative
ad.primitive_transposes[_operation] = lambda cotangent, x, *, why: [first_order(cotangent, why)]
batching.primitive_batchers[_operation] = _batch_refusal
mlir.register_lowering(_operation, lambda ctx, x, *, why: [x])
