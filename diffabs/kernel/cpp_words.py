"""The words of C++ for single numbers in vectors of lanes: types, operators, functions (of `native/functions.h`),
literals."""

import numpy as np

from diffabs.kernel.graph import Node, is_real

CPP_TYPES = {
    "float32": "f32", "float64": "f64", "int32": "i32", "int64": "i64", "uint32": "u32", "uint64": "u64",
}  # fmt: skip
CPP_INFIX = {
    "add": "+", "sub": "-", "mul": "*", "div": "/", "quotient": "/", "and": "&", "or": "|", "xor": "^",
    "shift_left": "<<", "shift_right_logical": ">>",
}  # fmt: skip
PREFIX = {"neg": "-", "not": "~"}
CPP_FUNCTIONS = {
    "lt": "lt", "le": "le", "eq": "eq", "ne": "ne", "max": "most", "min": "least", "lower": "lower",
    "higher": "higher", "abs": "size", "sqrt": "root",
    "rint": "whole", "floor": "down", "ceil": "up", "rem": "rest", "is_finite": "finite",
    **{name: f"k_{name}" for name in (
        "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "atan", "asin", "acos", "sinh", "cosh", "atan2",
        "pow")},
}  # fmt: skip


def is_boolean(dtype: np.dtype) -> bool:
    """Return whether numbers of this type are truths."""
    return dtype.kind == "b"


def scalar_type(dtype: np.dtype) -> str:
    """Return the type of one number."""
    return "u8" if is_boolean(dtype) else CPP_TYPES[dtype.name]


def vector_type(dtype: np.dtype) -> str:
    """Return the type of a vector of them."""
    return "mask" if is_boolean(dtype) else "v" + CPP_TYPES[dtype.name]


def literal(node: Node) -> str:
    """Return a known number in every lane."""
    x = node.attr
    if is_boolean(node.dtype):
        return f"all({'true' if x else 'false'})"
    name = CPP_TYPES[node.dtype.name]
    if not is_real(node.dtype):
        ends = {"i32": "", "u32": "u", "i64": "ll", "u64": "ull"}[name]
        number = (
            f"INT{x.itemsize * 8}_MIN" if node.dtype.kind == "i" and x == np.iinfo(x.dtype).min else f"{int(x)}{ends}"
        )
        return f"all(({name}){number})"
    if np.isnan(x):
        return f"all(({name})NAN)"
    if np.isinf(x):
        return f"all(({name}){'-' if x < 0 else ''}INFINITY)"
    return f"all(({name}){float(x).hex()})"
