"""C++ types and literals for numbers in vectors of lanes."""

import numpy as np

from diffabs.compiler.ir import Node, is_real

CPP_TYPES = {
    "float32": "f32", "float64": "f64", "int32": "i32", "int64": "i64", "uint32": "u32", "uint64": "u64",
}  # fmt: skip


def scalar_type(dtype: np.dtype) -> str:
    """Return the C++ type of one number, such as f64; a boolean is a byte, u8."""
    return "u8" if dtype.kind == "b" else CPP_TYPES[dtype.name]


def vector_type(dtype: np.dtype) -> str:
    """Return the C++ type of a vector with one number for each lane, such as vf64; for booleans, mask."""
    return "mask" if dtype.kind == "b" else "v" + CPP_TYPES[dtype.name]


def literal(node: Node) -> str:
    """Return the C++ expression of a vector with a constant in every lane."""
    x = node.attr
    if node.dtype == bool:
        return f"all({'true' if x else 'false'})"
    name = CPP_TYPES[node.dtype.name]
    if not is_real(node.dtype):
        # C++ parses -2147483648 as the negative of a number out of range, so a macro stands for the least integer.
        ends = {"i32": "", "u32": "u", "i64": "ll", "u64": "ull"}[name]
        number = (
            f"INT{x.itemsize * 8}_MIN" if node.dtype.kind == "i" and x == np.iinfo(x.dtype).min else f"{int(x)}{ends}"
        )
        return f"all(({name}){number})"
    if np.isnan(x):
        return f"all(({name})NAN)"
    if np.isinf(x):
        return f"all(({name}){'-' if x < 0 else ''}INFINITY)"
    # A hexadecimal literal is exact: the compiler does not round a decimal number.
    return f"all(({name}){float(x).hex()})"
