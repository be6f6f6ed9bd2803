"""Aggregates: maps from one number for each run of a batch to the one number that a search minimises."""

import math
from typing import Protocol

import jax
import jax.numpy as jnp

from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar, Vector


class Aggregate(Protocol):
    """A function from one number for each run to one number."""

    def __call__(self, values: Vector) -> Scalar:
        """Return a scalar from `values` (runs,)."""
        ...


@pytree
class Mean:
    """The mean over the runs."""

    def __call__(self, values: Vector) -> Scalar:
        """Return the mean of `values`."""
        return jnp.mean(values)


@pytree
class SmoothWorst:
    """A smooth maximum over the runs, w ln(mean exp(x/w)), with w = `softness` times the mean of |x|.

    It lies between the mean (w -> infinity) and the greatest value (w -> 0).
    """

    softness: Scalar = param(default=0.02, unit="1", above=0.0)
    """Width w over the mean of |x|."""

    def __call__(self, values: Vector) -> Scalar:
        """Return the smooth maximum of `values`."""
        size = jnp.mean(jnp.abs(values))
        w = self.softness * jnp.where(size > 0, size, 1.0)  # any width serves if every value is zero
        return w * (jax.nn.logsumexp(values / w) - math.log(len(values)))


@pytree
class CVaR:
    """The conditional value at risk: the mean over the worst fraction 1 - level of the runs.

    The run at the edge of that fraction counts in part. Level 0 is the mean.

    Source: R. T. Rockafellar and S. Uryasev, Optimization of conditional value-at-risk, J. Risk 2 (2000).
    """

    level: Scalar = param(default=0.9, unit="1", low=0.0, below=1.0)
    """Share of the runs outside the tail."""

    def __call__(self, values: Vector) -> Scalar:
        """Return the mean of the tail of `values`."""
        n = len(values)
        share = n * (1 - self.level)
        # 1 for each whole run of the tail, the remaining fraction for the run at its edge, 0 for the others.
        weights = jnp.clip(share - jnp.arange(n), 0.0, 1.0)
        return jnp.sum(weights * -jnp.sort(-values)) / share


@pytree
class Quantile:
    """The value that a fraction `level` of the runs does not exceed, interpolated linearly."""

    level: Scalar = param(default=0.9, unit="1", low=0.0, high=1.0)
    """Share of the runs at or below the quantile."""

    def __call__(self, values: Vector) -> Scalar:
        """Return the quantile of `values`."""
        return jnp.quantile(values, self.level)


AGGREGATE_TYPES: dict[str, type] = {"mean": Mean, "smooth-worst": SmoothWorst, "cvar": CVaR, "quantile": Quantile}
