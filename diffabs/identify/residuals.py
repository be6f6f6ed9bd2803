"""What a least-squares fit evaluates: residuals, prior and their Jacobians, compiled once, at one z after the other."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from diffabs.core.bijectors import FreeSpace
from diffabs.core.pytree import get

Residuals = Callable[..., Any]  # (part, *data) -> (n,)
Prior = Callable[[Any], Any]  # part -> (k,), in standard deviations


@dataclasses.dataclass(frozen=True)
class _GaussianPrior:
    """Independent normal distributions of these parameters."""

    paths: tuple[str, ...]

    def __call__(self, means: Any, deviations: Any, part: Any) -> Any:
        """(p - mean)/deviation, concatenated."""
        known = zip(self.paths, means, deviations, strict=True)
        return jnp.concatenate([jnp.ravel((get(part, path) - m) / s) for path, m, s in known])


def gaussian(known: Mapping[str, tuple[Any, Any]]) -> Prior:
    """Return the prior in which the parameters `known` are {path: (mean, standard deviation)}; other numbers do not
    compile again. Raises ValueError for a deviation that is not positive."""
    for path, (_, deviation) in known.items():
        if not (np.asarray(deviation, float) > 0).all():
            raise ValueError(f"{path}: the prior's standard deviation is {np.min(deviation):g}; it must be positive")
    means, deviations = zip(*known.values(), strict=True)
    return Partial(
        _GaussianPrior(tuple(known)), *(list(map(jnp.asarray, map(np.float64, x))) for x in (means, deviations))
    )


def as_partial(prior: Prior | None) -> Prior:
    """As a pytree that can be called: a `Partial`, whose arguments are traced, stays one."""
    return prior if isinstance(prior, Partial) else Partial(prior or _empty_prior)


def _empty_prior(part: Any) -> Any:
    del part
    return jnp.zeros(0)


class ResidualEvaluation(NamedTuple):
    """At one z: residuals (n,), prior (k,), and their derivatives in z (n, p) and (k, p)."""

    residuals: Any
    prior: Any
    slopes: tuple[Any, Any]

    def finite(self) -> bool:
        """Whether every number is."""
        return all(bool(np.isfinite(x).all()) for x in jax.tree.leaves(self))


@partial(jax.jit, static_argnames=("free", "residuals"))
def _evaluate_residuals(
    free: FreeSpace, residuals: Residuals, prior: Prior, part: Any, data: Any, z: Any
) -> ResidualEvaluation:
    """Compiled once for equal functions, spaces and structures."""

    def both(z: Any) -> tuple[Any, Any]:
        at = free.at(part, z)
        values = jnp.ravel(residuals(at, *data)), prior(at)
        return values, values

    slopes, values = jax.jacfwd(both, has_aux=True)(z)
    return ResidualEvaluation(values[0], values[1], slopes)


@dataclasses.dataclass(eq=False)
class FitProblem:
    """Remembers the last point, since SciPy asks for value and Jacobian one after the other."""

    space: FreeSpace
    part: Any
    residuals: Residuals
    data: tuple[Any, ...]
    prior: Prior  # a pytree: see `traced`
    norm: float
    usable: Callable[[Any], bool] | None
    evaluations: int = 0
    last: tuple[np.ndarray, ResidualEvaluation | None] | None = None

    def shapes(self) -> tuple[int, int]:
        """n and k, without a run."""
        r = jax.eval_shape(lambda part, data: self.residuals(part, *data), self.part, self.data)
        k = jax.eval_shape(lambda part: self.prior(part), self.part).size
        return r.size, k

    def at(self, z: np.ndarray) -> ResidualEvaluation | None:
        """None where a number is not finite, or the part not usable."""
        if self.last is None or not np.array_equal(self.last[0], z):
            self.last = z.copy(), self._evaluate_at(z)
            self.evaluations += 1
        return self.last[1]

    def _evaluate_at(self, z: np.ndarray) -> ResidualEvaluation | None:
        if self.usable and not self.usable(self.space.at(self.part, jnp.asarray(z))):
            return None
        seen = _evaluate_residuals(self.space, self.residuals, self.prior, self.part, self.data, jnp.asarray(z))
        seen = jax.tree.map(lambda x: np.asarray(x, float), jax.device_get(seen))
        return seen if seen.finite() else None

    def vector(self, seen: ResidualEvaluation, sigma: np.ndarray) -> np.ndarray:
        """sgn(r) |r/sigma|^(norm/2), and the prior: the sum of squares is the cost. (n + k,)."""
        x = seen.residuals / sigma
        return np.concatenate([np.sign(x) * np.abs(x) ** (self.norm / 2), seen.prior])

    def jacobian(self, seen: ResidualEvaluation, sigma: np.ndarray) -> np.ndarray:
        """Derivative of the vector in z (n + k, p)."""
        x = (self.norm / 2) * np.abs(seen.residuals / sigma) ** (self.norm / 2 - 1) / sigma
        return np.concatenate([x[:, None] * seen.slopes[0], seen.slopes[1]])
