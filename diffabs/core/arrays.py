"""Conversion of numbers: to arrays without a compiled program for each number, and to whole steps."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from diffabs.core.types import AnyArray, Array, Scalar


def as_array(x: object, dtype: DTypeLike) -> jax.Array:
    """Return `jnp.asarray(x, dtype)`, but convert untraced values by NumPy, since JAX would compile a program for each.

    The array of a Python float is cached, because its creation takes longer than many computations with it.
    """
    if isinstance(x, jax.Array):
        return jnp.asarray(x, dtype)
    if isinstance(x, float):
        around = jax.config.jax_enable_x64, jax.config.jax_default_device  # pyright: ignore
        return _number(float(x), math.copysign(1.0, x), np.dtype(dtype), around)
    return jax.device_put(np.asarray(x, dtype))


@functools.lru_cache(maxsize=4096)
def _number(x: float, sign: float, dtype: np.dtype, around: tuple[bool, object]) -> jax.Array:
    """Return the array of a Python float, from a cache.

    `sign` distinguishes the keys 0.0 and -0.0, which compare equal. `around` holds the settings that decide precision
    and device.
    """
    del sign, around
    return jax.device_put(np.asarray(x, dtype))


def as_rule_array(x: object) -> AnyArray:
    """Return x as an array: JAX arrays and tracers in their own type, other numbers as NumPy float64."""
    if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(x)):
        return jnp.asarray(x)
    return np.asarray(x, float)


def steps_in_period(period: Scalar, h: Scalar) -> Array:
    """Return the number of steps h [s] in a period [s], an integer of at least 1, without a derivative."""
    return jnp.maximum(jnp.round(jax.lax.stop_gradient(period / h)), 1).astype(int)
