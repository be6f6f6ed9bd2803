"""How well data determine parameters: covariance, and the combinations that they leave open.

    A = diag(1/sigma) dr/dp,   P = d(prior)/dp,   C = (A'A/s^2 + P'P)^-1,   s^2 = |r/sigma|^2/(n - p)

with s = 1 where sigma is known absolutely. Linearised at the parameters found: it says nothing of other minima, and
nothing of what the model itself gets wrong (which s^2 only averages).

The directions are the right singular vectors of A diag(size)/s, data alone: along the k-th one standard deviation of
the data is a relative change by 1/(singular value). `size` of a parameter is |p|, or dp/dz of its unbounded coordinate
(its distance from the end of a half-open range, at most a quarter of a finite one) where that is greater, so that a
parameter that happens to be zero has a size, too."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

MAX_RELATIVE_SPREAD = (
    1.0  # relative spread beyond which a direction counts as not determined: as wide as the parameters are large
)


class Direction(NamedTuple):
    """A unit vector of relative changes, by name, its largest one positive; the singular value, and the spread
    1/(singular value), infinite where that is zero to rounding."""

    spread: float
    singular: float
    components: dict[str, float]

    def shown(self, least: float = 0.1) -> str:
        """The components that matter: `0.83 plant.mass + 0.55 plant.inertia`."""
        terms = sorted(self.components.items(), key=lambda item: -abs(item[1]))
        text = " ".join(f"{'-' if x < 0 else '+'} {abs(x):.2f} {name}" for name, x in terms if abs(x) >= least)
        return text.removeprefix("+ ")


@dataclasses.dataclass(frozen=True, eq=False)
class Uncertainty:
    """What is known about the parameters, one row for each of `names`.

    covariance, correlation (p, p): with the prior; a direction that nothing determines gets a huge, finite variance
    deviations: standard deviations, by name
    scale: s; degrees: n - p
    directions: p of them, the best determined first; from the data alone
    """

    names: Sequence[str]
    covariance: np.ndarray
    deviations: dict[str, float]
    correlation: np.ndarray
    scale: float
    degrees: int
    directions: list[Direction]

    def undetermined(self, beyond: float = MAX_RELATIVE_SPREAD) -> list[Direction]:
        """The directions that the data leave open: those with a relative spread beyond a threshold."""
        return [one for one in self.directions if not one.spread <= beyond]

    @property
    def singular(self) -> np.ndarray:
        """Singular values (p,), descending."""
        return np.array([one.singular for one in self.directions])


def uncertainty(names: Sequence[str], size: np.ndarray, data: Any, prior: Any, scale: float) -> Uncertainty:
    """From sizes (p,), A (n, p), P (k, p) and s."""
    degrees, known = len(data) - len(names), data * size / scale
    _, values, vectors = _padded_svd(np.concatenate([known, prior * size]))
    spread = vectors.T / np.maximum(values, _zero_threshold(values, len(data)))  # a root of the relative covariance
    covariance = size[:, None] * (spread @ spread.T) * size
    deviations = np.sqrt(np.diag(covariance))
    return Uncertainty(
        names=names,
        covariance=covariance,
        deviations=dict(zip(names, deviations.tolist(), strict=True)),
        correlation=covariance / np.outer(deviations, deviations),
        scale=scale,
        degrees=degrees,
        directions=_directions(names, known),
    )


def _directions(names: Sequence[str], known: np.ndarray) -> list[Direction]:
    _, values, vectors = _padded_svd(known)
    zero, found = _zero_threshold(values, len(known)), []
    for value, vector in zip(values, vectors, strict=True):
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        spread = 1 / float(value) if value > zero else float("inf")
        found.append(Direction(spread, float(value), dict(zip(names, vector.tolist(), strict=True))))
    return found


def _padded_svd(matrix: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
    """Singular values and right vectors, p of each: zeros for directions beyond the number of rows."""
    missing = max(0, matrix.shape[1] - matrix.shape[0])
    return np.linalg.svd(np.concatenate([matrix, np.zeros((missing, matrix.shape[1]))]), full_matrices=False)


def _zero_threshold(values: np.ndarray, rows: int) -> float:
    """What counts as zero among singular values; positive even where all are zero."""
    return max(float(values[0]) * max(rows, len(values)) * np.finfo(float).eps, float(np.finfo(float).tiny))
