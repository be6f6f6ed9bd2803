"""Covariance of identified parameters, and the combinations of parameters that the data leave open.

    A = diag(1/sigma) dr/dp,   P = d(prior)/dp,   C = (A'A/s^2 + P'P)^-1,   s^2 = |r/sigma|^2/(n - p)

with s = 1 if sigma is known absolutely. The model is linearised at the identified parameters. The covariance therefore
does not cover other minima. It does not cover errors of the model either, which s^2 only averages.

A parameter held at an end of its range has no standard deviation: the data would move it past the end. Its numbers are
NaN, and those of the others are for this parameter fixed there.

The directions are the right singular vectors of A diag(size)/s, from the data alone. A relative change by 1/(singular
value) along a direction changes the residuals by one standard deviation.

The `size` of a parameter is |p|, or dp/dz of its unbounded coordinate if that is larger. So a parameter that happens
to be zero has a size, too. On a half-open range dp/dz is the distance from the end, on a finite range at most a quarter
of the width.
"""

import dataclasses
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from diffabs.core.types import PyTree

# A direction with a larger relative spread counts as not determined: it is as wide as the parameters are large.
MAX_RELATIVE_SPREAD = 1.0


class Direction(NamedTuple):
    """A unit vector of relative parameter changes, (change of p)/size.

    Attributes:
        spread: Relative standard deviation along the vector, 1/(singular value); infinite if that is zero to rounding.
        singular: Singular value.
        components: Components by parameter name; the largest one is positive.
    """

    spread: float
    singular: float
    components: dict[str, float]

    def describe(self, threshold: float = 0.1) -> str:
        """Return the components of magnitude `threshold` or more as text.

        Example: `0.83 plant.mass + 0.55 plant.inertia`.
        """
        terms = sorted(self.components.items(), key=lambda item: -abs(item[1]))
        text = " ".join(f"{'-' if x < 0 else '+'} {abs(x):.2f} {name}" for name, x in terms if abs(x) >= threshold)
        return text.removeprefix("+ ")


@dataclasses.dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance and directions of the identified parameters, with one row for each of `names`.

    Attributes:
        names: Names of the parameters, p of them.
        sizes: Sizes of the parameters, shape (p,), in their units.
        covariance: Covariance from data and prior, shape (p, p), in the parameters' units. A direction that neither
            determines has a huge, finite variance. The row and column of a held parameter are NaN.
        deviations: Standard deviations by name, in the parameters' units; NaN for a held parameter.
        correlation: Correlation from data and prior, shape (p, p); NaN for a held parameter.
        scale: Factor s of the residuals' standard deviations; 1 if these are known absolutely.
        degrees: Degrees of freedom n - p.
        directions: A direction from the data alone for each parameter that is not held, the best determined first.
    """

    names: Sequence[str]
    sizes: np.ndarray
    covariance: np.ndarray
    deviations: dict[str, float]
    correlation: np.ndarray
    scale: float
    degrees: int
    directions: list[Direction]

    def undetermined_directions(self, beyond: float = MAX_RELATIVE_SPREAD) -> list[Direction]:
        """Return the directions that the data leave open: their spread is larger than `beyond`, by default 100 %."""
        return [direction for direction in self.directions if not direction.spread <= beyond]

    def undetermined_parameters(self, beyond: float = MAX_RELATIVE_SPREAD) -> list[str]:
        """Return the names of the parameters that data and prior leave open.

        Their standard deviation is larger than `beyond` times their size. The number is then meaningless.
        """
        return [
            name for name, size in zip(self.names, self.sizes, strict=True) if self.deviations[name] > beyond * size
        ]

    @property
    def singular(self) -> np.ndarray:
        """Singular values of the directions, descending."""
        return np.array([direction.singular for direction in self.directions])


def uncertainty(
    names: Sequence[str],
    size: np.ndarray,
    data: np.ndarray,
    prior: np.ndarray,
    scale: float,
    held: Collection[str] = (),
) -> Uncertainty:
    """Return covariance, correlation and directions from scaled Jacobians.

    Args:
        size: Sizes of the parameters, shape (p,), in their units.
        data: Jacobian A of residual/sigma by the parameters, shape (n, p).
        prior: Jacobian P of the prior by the parameters, shape (k, p).
        held: Names of the parameters that an end of their range holds.
    """
    free = [i for i, name in enumerate(names) if name not in held]
    jacobian = (data * size / scale)[:, free]
    # An SVD of the Jacobian avoids the normal equations, whose condition number is squared.
    _, values, vectors = _padded_svd(np.concatenate([jacobian, (prior * size)[:, free]]))
    spread = vectors.T / np.maximum(values, _zero_threshold(values, len(data)))  # a root of the relative covariance
    covariance = np.full((len(names), len(names)), np.nan)
    covariance[np.ix_(free, free)] = size[free, None] * (spread @ spread.T) * size[free]
    deviations = np.sqrt(np.diag(covariance))
    return Uncertainty(
        names=names,
        sizes=size,
        covariance=covariance,
        deviations=dict(zip(names, deviations.tolist(), strict=True)),
        correlation=covariance / np.outer(deviations, deviations),
        scale=scale,
        degrees=len(data) - len(names),
        directions=_directions([names[i] for i in free], jacobian),
    )


def _directions(names: Sequence[str], jacobian: np.ndarray) -> list[Direction]:
    _, values, vectors = _padded_svd(jacobian)
    zero, directions = _zero_threshold(values, len(jacobian)), []
    for value, vector in zip(values, vectors, strict=True):
        # The SVD leaves the sign open.
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        spread = 1 / float(value) if value > zero else float("inf")
        directions.append(Direction(spread, float(value), dict(zip(names, vector.tolist(), strict=True))))
    return directions


def _padded_svd(matrix: np.ndarray) -> tuple[PyTree, np.ndarray, np.ndarray]:
    """Return p singular values and right singular vectors, with zeros for directions beyond the number of rows."""
    missing = max(0, matrix.shape[1] - matrix.shape[0])
    return np.linalg.svd(np.concatenate([matrix, np.zeros((missing, matrix.shape[1]))]), full_matrices=False)


def _zero_threshold(values: np.ndarray, rows: int) -> float:
    """Return the threshold below which a singular value counts as zero, positive even if all are zero."""
    return max(
        float(np.max(values, initial=0.0)) * max(rows, len(values)) * np.finfo(float).eps, float(np.finfo(float).tiny)
    )
