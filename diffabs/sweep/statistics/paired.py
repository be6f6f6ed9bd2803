"""Two variants on the same samples: what the difference is, and what it gained to share the samples.

    mean(a - b)    t interval                median(a - b)    order statistics
    P(a < b)       Clopper-Pearson           reduction        (var a + var b)/var(a - b)

Common random numbers: the reduction is the factor by which independent samples would have to be more for an equally
sharp mean difference. P. Glasserman and D. D. Yao, Some guidelines and guarantees for common random numbers, Manage.
Sci. 38 (1992)."""

import math
from typing import Any, NamedTuple

import numpy as np

from diffabs.sweep.statistics.estimates import Count, IntervalEstimate, Moments, as_column, quantile
from diffabs.sweep.statistics.sensitivity import pearson


class PairedComparison(NamedTuple):
    """Of a - b: mean, median; share of samples where a < b, and how many are equal; correlation of a with b;
    (var a + var b)/var(a - b), infinite for a constant difference, NaN if both are constant."""

    mean: IntervalEstimate
    median: IntervalEstimate
    less: IntervalEstimate
    ties: int
    correlation: IntervalEstimate
    reduction: float


def compare_pairs(a: Any, b: Any, *, confidence: float = 0.95) -> PairedComparison:
    """From outputs (n,) of two variants, sample by sample.

    Raises ValueError for fewer than four samples, for lengths that differ, and for values not finite.
    """
    one, other = as_column(a, least=4), as_column(b)
    if one.shape != other.shape:
        raise ValueError(f"{len(one)} and {len(other)} values are not pairs: leave a lane out of both")
    difference = one - other
    apart, together = float(np.var(one) + np.var(other)), float(np.var(difference))
    less = Count(int(np.count_nonzero(one < other)), len(one))
    return PairedComparison(
        mean=Moments.of(difference).mean(confidence=confidence),
        median=quantile(difference, 0.5, confidence=confidence),
        less=less.probability(confidence=confidence),
        ties=int(np.count_nonzero(one == other)),
        correlation=pearson(one, other, confidence=confidence),
        reduction=apart / together if together > 0 else math.inf if apart > 0 else math.nan,
    )
