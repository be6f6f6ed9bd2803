"""Periods on the integration grid."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from diffabs.pytree import Scalar


def steps(period: Scalar, h: Scalar) -> Any:
    """How many steps of length h make a period. An integer, so without a derivative."""
    return jnp.maximum(jnp.round(jax.lax.stop_gradient(period / h)), 1).astype(int)


def period_problems(name: str, period: Scalar, step: float) -> Iterator[str]:
    """Objects to a period that is no whole multiple of the step."""
    count = float(period) / step
    if count < 0.5 or abs(count - round(count)) > 1e-6 * count:
        yield f"{name} = {float(period):g} s is not a multiple of solver.step = {step:g} s"
