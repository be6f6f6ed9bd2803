"""The kinds of values that can be a number of a run.

JAX converts far more values: it parses text, drops imaginary parts and turns truth values into 1. A single 16-bit leaf
makes a whole run 16-bit.
"""

import functools
import math
import numbers
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike

from diffabs.core.types import Any

FEWEST_BITS = 32  # of a float: with 16 bits, the time stops advancing by small steps after a second
MAX_SHOWN_LENGTH = 60  # characters of a value in a message


def find_value_objection(value: object) -> str:
    """Return why a value cannot be a number of a run or an array of numbers, such as `is text`; empty if it can.

    For an array only the type counts, so it may be traced. A Python integer beyond the range of a float is refused.
    """
    if type(value) is float:
        return ""
    if isinstance(value, list | tuple | range):
        return next(filter(None, map(find_value_objection, value)), "")
    if (dtype := getattr(value, "dtype", None)) is not None:
        return _of_type(dtype)
    if isinstance(value, str | bytes):
        return "is text"
    if isinstance(value, bool):
        return "is a truth value"
    if isinstance(value, numbers.Real):
        return "is too large" if _overflows(value) else ""
    return "is complex" if isinstance(value, complex) else f"is of type {type(value).__name__}"


def _overflows(value: Any) -> bool:
    return sys.float_info.max < abs(value) < math.inf


@functools.cache
def _of_type(dtype: DTypeLike) -> str:
    """Return the objection to an array of this type, or an empty text."""
    if jnp.issubdtype(dtype, jax.dtypes.extended) or np.dtype(dtype).kind in "mM":  # keys, dates
        return f"is of type {dtype}"
    if jnp.issubdtype(dtype, np.floating):
        few = np.dtype(dtype).itemsize * 8 < FEWEST_BITS
        return f"is of type {dtype}, a float of fewer than {FEWEST_BITS} bits" if few else ""
    kinds = {np.integer: "", np.complexfloating: "is complex", np.bool_: "is a truth value", np.character: "is text"}
    return next((line for kind, line in kinds.items() if jnp.issubdtype(dtype, kind)), f"is of type {dtype}")


def value_shape(value: ArrayLike) -> tuple[int, ...]:
    """Return the shape of an array, also traced, a number, or a nested list, whose first item stands for all."""
    if isinstance(value, list | tuple | range):
        return (len(value), *(value_shape(value[0]) if value else ()))
    return np.shape(value)


def format_value(value: object) -> str:
    """Return a value or an array for a message: on one line, of at most 60 characters."""
    try:
        text = " ".join(str(value).split()) if hasattr(value, "dtype") else repr(value).replace("\n", " ")
    except ValueError:  # a whole number of thousands of digits
        text = "..."
    return text if len(text) <= MAX_SHOWN_LENGTH else f"{text[: MAX_SHOWN_LENGTH - 3]}..."
