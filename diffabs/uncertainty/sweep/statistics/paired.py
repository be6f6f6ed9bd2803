"""Comparison of two variants on the same samples: their difference, and the gain from common samples.

    mean(a - b)    hull of Hall and Student  median(a - b)    order statistics
    P(a < b)       Clopper-Pearson           reduction        (var a + var b)/var(a - b)

The reduction is the gain from common random numbers. Independent samples would need this factor more for an equally
sharp mean difference.

Source: P. Glasserman and D. D. Yao, Some guidelines and guarantees for common random numbers, Manage. Sci. 38 (1992).
"""

import math
from typing import NamedTuple

import numpy as np

from diffabs.core.types import Scalar
from diffabs.uncertainty.sweep.statistics.estimates import Count, IntervalEstimate, Moments, as_column, quantile


class PairedComparison(NamedTuple):
    """Statistics of the difference a - b.

    Attributes:
        mean: Mean of a - b.
        median: Median of a - b.
        less: Probability that a < b; a tie counts as not less.
        ties: Number of samples with a = b.
        reduction: (var a + var b)/var(a - b); infinite for a constant difference, NaN if both are constant.
    """

    mean: IntervalEstimate
    median: IntervalEstimate
    less: IntervalEstimate
    ties: int
    reduction: float


def compare_pairs(a: Scalar, b: Scalar, *, confidence: float = 0.95) -> PairedComparison:
    """Return the comparison of two variants by their outputs a and b, each of shape (n,)."""
    first, second = as_column(a, minimum=4), as_column(b)
    if first.shape != second.shape:
        raise ValueError(f"{len(first)} and {len(second)} values are not pairs: leave a lane out of both")
    difference = first - second
    apart, together = float(np.var(first) + np.var(second)), float(np.var(difference))
    less = Count(int(np.count_nonzero(first < second)), len(first))
    return PairedComparison(
        mean=Moments.of(difference).mean(confidence=confidence),
        median=quantile(difference, 0.5, confidence=confidence),
        less=less.probability(confidence=confidence),
        ties=int(np.count_nonzero(first == second)),
        reduction=apart / together if together > 0 else math.inf if apart > 0 else math.nan,
    )
