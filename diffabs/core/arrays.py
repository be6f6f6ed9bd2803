"""Conversion of numbers to JAX arrays without a compiled program for each number."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from diffabs.core.types import Scalar


def as_array(x: Scalar, dtype: DTypeLike) -> jax.Array:
    """Return `jnp.asarray(x, dtype)`, but convert untraced values by NumPy, since JAX would compile a program for each.

    The array of a Python float is cached, because its creation takes longer than many computations with it.

    Args:
        x: Number, array, or list of numbers.
        dtype: Type of the array.
    """
    if isinstance(x, jax.Array):
        return jnp.asarray(x, dtype)
    if isinstance(x, float):
        around = jax.config.jax_enable_x64, jax.config.jax_default_device  # pyright: ignore
        return _number(float(x), math.copysign(1.0, x), np.dtype(dtype), around)
    return jax.device_put(np.asarray(x, dtype))


@functools.lru_cache(maxsize=4096)
def _number(x: float, sign: float, dtype: np.dtype, around: Any) -> jax.Array:
    """Return the array of a Python float, from a cache.

    `sign` distinguishes the keys 0.0 and -0.0, which compare equal. `around` holds the settings that decide precision
    and device.
    """
    del sign, around
    return jax.device_put(np.asarray(x, dtype))
