"""From one number per lane to one number: what of a batch is made small."""

import math
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from diffabs.core.pytree import Scalar, Vector, param, pytree


class Aggregate(Protocol):
    """A function of one number per lane."""

    def __call__(self, values: Vector) -> Scalar:
        """values (n,) -> scalar."""
        ...


@pytree
class Mean:
    """The mean over the lanes."""

    def __call__(self, values: Vector) -> Any:
        """Mean."""
        return jnp.mean(values)


@pytree
class SmoothWorst:
    """w ln(mean exp(x/w)), w = `softness` times the mean of |x|: between the mean (w -> infinity) and the greatest
    value (w -> 0), from below."""

    softness: Scalar = param(default=0.02, unit="1", above=0.0)

    def __call__(self, values: Vector) -> Any:
        """Smooth maximum."""
        w = self.softness * jnp.maximum(jnp.mean(jnp.abs(values)), 1e-300)
        return w * (jax.nn.logsumexp(values / w) - math.log(len(values)))


@pytree
class CVaR:
    """Conditional value at risk: the mean of the worst fraction 1 - level of the lanes, the one at its edge in part.

    R. T. Rockafellar and S. Uryasev, Optimization of conditional value-at-risk, J. Risk 2 (2000). Level 0 is the mean.
    """

    level: Scalar = param(default=0.9, unit="1", low=0.0, below=1.0)

    def __call__(self, values: Vector) -> Any:
        """Mean of the tail."""
        n = len(values)
        share = n * (1 - self.level)
        weights = jnp.clip(share - jnp.arange(n), 0.0, 1.0)
        return jnp.sum(weights * -jnp.sort(-values)) / share


@pytree
class Quantile:
    """The value that a fraction `level` of the lanes does not exceed, interpolated linearly."""

    level: Scalar = param(default=0.9, unit="1", low=0.0, high=1.0)

    def __call__(self, values: Vector) -> Any:
        """Quantile."""
        return jnp.quantile(values, self.level)


AGGREGATE_TYPES: dict[str, type] = {"mean": Mean, "smooth-worst": SmoothWorst, "cvar": CVaR, "quantile": Quantile}
