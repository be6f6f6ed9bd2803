"""Residuals, prior and Jacobians of a least-squares fit, compiled once and evaluated at one z after the other."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from diffabs.core.bijectors import FreeSpace
from diffabs.core.kinds import find_value_objection, format_value
from diffabs.core.pytree import get
from diffabs.core.renamed import refuse_old_names
from diffabs.core.types import AnyArray, Part, PyTree, Scalar, Vector

Residuals = Callable[..., Any]  # (part, *data) -> (n,)
Prior = Callable[[Any], Any]  # part -> (k,), in standard deviations


@dataclasses.dataclass(frozen=True)
class _GaussianPrior:
    """Independent normal distributions of the parameters at `paths`."""

    paths: tuple[str, ...]

    def __call__(self, means: Vector, deviations: Vector, part: object) -> Scalar:
        """Return (p - mean)/deviation, concatenated over the parameters."""
        terms = zip(self.paths, means, deviations, strict=True)
        return jnp.concatenate([jnp.ravel((get(part, path) - m) / s) for path, m, s in terms])


@refuse_old_names
def gaussian(distributions: Mapping[str, tuple[PyTree, PyTree]]) -> Prior:
    """Return a prior of independent normal distributions.

    Other means and deviations do not compile again.

    Args:
        distributions: Parameters as {path: (mean, standard deviation)}.

    Raises:
        ValueError: No parameter is given, a mean is not finite, or a standard deviation is not positive.
    """
    if not distributions:
        raise ValueError("the prior has no parameter; leave the prior out")
    for path, (mean, deviation) in distributions.items():
        for name, value in (("mean", mean), ("standard deviation", deviation)):
            if line := find_value_objection(value):
                raise ValueError(f"{path}: the prior's {name} = {format_value(value)} {line}; it must be a number")
        if not np.isfinite(np.asarray(mean, float)).all():
            raise ValueError(f"{path}: the prior's mean is {format_value(mean)}; it must be finite")
        if not (np.asarray(deviation, float) > 0).all():
            raise ValueError(f"{path}: the prior's standard deviation is {np.min(deviation):g}; it must be positive")
    # np.float64 gives every number one strong type: an int or a weak Python float would compile again.
    means, deviations = zip(*distributions.values(), strict=True)
    return Partial(
        _GaussianPrior(tuple(distributions)), *(list(map(jnp.asarray, map(np.float64, x))) for x in (means, deviations))
    )


def check_prior(prior: Prior | None, free: Collection[str]) -> None:
    """Check that the parameters of a prior of `gaussian` are free: it has no effect on others."""
    function = prior.func if isinstance(prior, Partial) else None
    paths = function.paths if isinstance(function, _GaussianPrior) else ()
    # An element of a free list, `gain.0`, is free.
    if held := [path for path in paths if not any(f"{path}.".startswith(f"{free_path}.") for free_path in free)]:
        raise ValueError(f"{', '.join(held)}: a prior, but not free; free are {', '.join(free)}")


def as_partial(prior: Prior | None) -> Prior:
    """Return a prior, or the empty one for None, as a callable pytree; the arguments of a `Partial` are traced."""
    return prior if isinstance(prior, Partial) else Partial(prior or _empty_prior)


def _empty_prior(part: object) -> Vector:
    del part
    return jnp.zeros(0)


class ResidualEvaluation(NamedTuple):
    """Residuals and prior at one z.

    Attributes:
        residuals: Residuals, shape (n,).
        prior: Deviations from prior knowledge, shape (k,).
        slopes: Derivatives of both in z, shapes (n, p) and (k, p).
    """

    residuals: np.ndarray
    prior: Vector
    slopes: tuple[PyTree, PyTree]

    def finite(self) -> bool:
        """Return whether every number is finite."""
        return all(bool(np.isfinite(x).all()) for x in jax.tree.leaves(self))


@partial(jax.jit, static_argnames=("free", "residuals"))
def _evaluate_residuals(
    free: FreeSpace, residuals: Residuals, prior: Prior, part: Part, data: tuple[PyTree, ...], z: AnyArray
) -> ResidualEvaluation:
    """Return residuals, prior and derivatives at z; compiled once for equal functions, spaces and structures."""

    def both(z: AnyArray) -> tuple[PyTree, PyTree]:
        at = free.at(part, z)
        values = jnp.ravel(residuals(at, *data)), prior(at)
        return values, values

    # has_aux returns the values of the same pass; a second call would run the simulation twice.
    slopes, values = jax.jacfwd(both, has_aux=True)(z)
    return ResidualEvaluation(values[0], values[1], slopes)


@dataclasses.dataclass(eq=False)
class FitProblem:
    """A least-squares problem that caches its last point.

    SciPy calls for the value and the Jacobian one after the other, so the cache saves half of the evaluations.
    """

    space: FreeSpace
    part: Part
    residuals: Residuals
    data: tuple[PyTree, ...]
    prior: Prior  # a pytree: see `as_partial`
    norm: float
    usable: Callable[[PyTree], bool] | None
    evaluations: int = 0
    last: tuple[np.ndarray, ResidualEvaluation | None] | None = None

    def shapes(self) -> tuple[int, int]:
        """Return the number of residuals n and of prior terms k, without a run."""
        r = jax.eval_shape(lambda part, data: self.residuals(part, *data), self.part, self.data)
        k = jax.eval_shape(lambda part: self.prior(part), self.part).size
        return r.size, k

    def at(self, z: np.ndarray) -> ResidualEvaluation | None:
        """Return the evaluation at `z`, or None if a number is not finite or the part is not usable."""
        if self.last is None or not np.array_equal(self.last[0], z):
            self.last = z.copy(), self._evaluate_at(z)
            self.evaluations += 1
        return self.last[1]

    def _evaluate_at(self, z: np.ndarray) -> ResidualEvaluation | None:
        if self.usable and not self.usable(self.space.at(self.part, jnp.asarray(z))):
            return None
        evaluation = _evaluate_residuals(self.space, self.residuals, self.prior, self.part, self.data, jnp.asarray(z))
        evaluation = jax.tree.map(lambda x: np.asarray(x, float), jax.device_get(evaluation))
        return evaluation if evaluation.finite() else None

    def vector(self, evaluation: ResidualEvaluation, sigma: np.ndarray) -> np.ndarray:
        """Return sgn(r) |r/sigma|^(norm/2) followed by the prior, shape (n + k,); its sum of squares is the cost."""
        x = evaluation.residuals / sigma
        return np.concatenate([np.sign(x) * np.abs(x) ** (self.norm / 2), evaluation.prior])

    def jacobian(self, evaluation: ResidualEvaluation, sigma: np.ndarray) -> np.ndarray:
        """Return the derivative of `vector` in z, shape (n + k, p)."""
        x = (self.norm / 2) * np.abs(evaluation.residuals / sigma) ** (self.norm / 2 - 1) / sigma
        return np.concatenate([x[:, None] * evaluation.slopes[0], evaluation.slopes[1]])
