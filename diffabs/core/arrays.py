"""Numbers as arrays, without a program of JAX for each."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def as_array(x: Any, dtype: Any) -> jax.Array:
    """Return `jnp.asarray(x, dtype)`, where nothing is traced, by NumPy: JAX would compile a program for it. That of
    a Python number is made once: that takes longer than what many calls do with it."""
    if isinstance(x, jax.Array):
        return jnp.asarray(x, dtype)
    if isinstance(x, float):
        around = jax.config.jax_enable_x64, jax.config.jax_default_device  # pyright: ignore
        return _number(float(x), math.copysign(1.0, x), np.dtype(dtype), around)
    return jax.device_put(np.asarray(x, dtype))


@functools.lru_cache(maxsize=4096)
def _number(x: float, sign: float, dtype: np.dtype, around: Any) -> jax.Array:
    """Of a sign, since 0 equals -0; `around`: what decides precision and device besides."""
    del sign, around
    return jax.device_put(np.asarray(x, dtype))
