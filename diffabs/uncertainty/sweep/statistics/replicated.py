"""Estimates from replicates, which are independently scrambled sequences of samples, each with an interval.

    mean           m -+ t e(x)
    probability    m -+ (t e(x) + 1/n)                                     x is 1 for a failure, else 0
    quantile q     x_(r), x_(s):  r <= n (p - t e(x < q)),  s - 1 >= n (p + t e(x <= q))       Woodruff (1952)
    CVaR           m -+ t e(y),  y = q + max(x - q, 0)/(1 - p)

m is the mean of all n values. t is a quantile of Student's law with R - 1 degrees of freedom for R replicates. The
standard error of m comes from the sums over each replicate:

    e(x)^2 = sum_r (sum_(i in r) (x_i - m)/n)^2 / (1 - sum_r (n_r/n)^2)       n_r samples in replicate r

Each estimate is one of all samples together. A mean of the quantiles of replicates would be biased. The quantile of few
samples is nearer to the median, and stratified replicates have nearly equal ones.

The coverage of 95 % intervals was measured for 600 seeds of scrambled Sobol' sequences (200 for 4,096 samples), three
laws, and sums of 1, 2 and 5 variables. The lowest and highest of 15 to 30 cases, in %, each with a standard error of
1 to 1.5:

    samples, replicates    quantiles 0.05, 0.5, 0.95    probabilities 0.002 to 0.5    mean         CVaR 0.95
    256, 8                 96 to 100                    96 to 100                     90 to 100    88 to 95
    1,024, 16              96 to 100                    95 to 100                     91 to 100    92 to 96
    1,024, 32              96 to 100                    96 to 100                     93 to 98     91 to 97
    4,096, 16              94 to 100                    92 to 100                     93 to 100    93 to 98

Means and CVaR of up to 1,024 samples have the lowest for the exponential law.

Source: R. S. Woodruff, Confidence intervals for medians and other position measures, J. Am. Stat. Assoc. 47 (1952).
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy import stats

from diffabs.uncertainty.sweep.statistics.estimates import (
    MIN_TAIL_SAMPLES,
    Count,
    IntervalEstimate,
    as_column,
    quantile_between,
    upper_level,
)


@dataclasses.dataclass(frozen=True, eq=False)
class Replicates:
    """The replicates of n samples. Each estimate is that of all samples together.

    Ends of intervals are infinite if a replicate has no sample, for example because its runs have diverged. Those of a
    probability are then of independent samples.

    Attributes:
        places: Replicate of each sample, counted from 0, shape (n,).
        count: Number of replicates, at least 2.
        confidence: Confidence of the intervals, in (0, 1).
    """

    places: np.ndarray
    count: int
    confidence: float = 0.95

    def mean(self, values: object) -> IntervalEstimate:
        """Return the mean of `values` (n,) with a t interval."""
        x = as_column(values)
        centre, half = float(x.mean()), self._half_width(x)
        return IntervalEstimate(centre, centre - half, centre + half, self.confidence, len(x))

    def probability(self, failed: object) -> IntervalEstimate:
        """Return the share of `failed` samples, a mask of shape (n,).

        The interval is that of Clopper and Pearson in three cases: fewer than 10 failures or successes, equal shares in
        all replicates, an empty replicate.
        """
        x = as_column(failed)
        n, failures, half = len(x), int(np.count_nonzero(x)), self._half_width(x)
        sizes, counts = (np.bincount(self.places, w, self.count) for w in (None, x))
        equal = (counts * n == failures * sizes).all()
        if equal or half == math.inf or not MIN_TAIL_SAMPLES <= failures <= n - MIN_TAIL_SAMPLES:
            return Count(failures, n).probability(confidence=self.confidence)
        share, half = failures / n, half + 1 / n
        return IntervalEstimate(share, max(share - half, 0.0), min(share + half, 1.0), self.confidence, n)

    def quantile(self, values: object, level: float) -> IntervalEstimate:
        """Return a quantile of `values` (n,) by linear interpolation, with an interval between two order statistics.

        An end is infinite where no order statistic reaches the confidence. The value is clipped to the interval.
        """
        x = as_column(values)
        ordered = np.sort(x)
        if not 0 < level < 1:
            raise ValueError(f"level = {level:g} is outside (0, 1)")
        n, value = len(x), np.quantile(ordered, level)
        # Of equal values, the lower end needs the share below them, the upper end the share up to them.
        below, above = (self._half_width(mask.astype(float)) for mask in (x < value, x <= value))
        low, high = max(n * (level - below), 0.0), min(n * (level + above), float(n))
        return quantile_between(ordered, level, math.floor(low), math.ceil(high) + 1, self.confidence)

    def cvar(self, values: object, level: float) -> IntervalEstimate:
        """Return the mean of the largest fraction 1 - level of the samples; the sample at the edge counts in part.

        Ends are infinite with fewer than 10 samples in the tail.
        """
        x = as_column(values)
        if not 0 <= level < 1:
            raise ValueError(f"level = {level:g} is outside [0, 1)")
        share = round(len(x) * (1 - level), 9)
        edge = np.sort(x)[max(math.ceil(len(x) * level) - 1, 0)]
        estimate = self.mean(edge + np.maximum(x - edge, 0.0) / (1 - level))
        return estimate if share >= MIN_TAIL_SAMPLES else estimate._replace(low=-math.inf, high=math.inf)

    def summarise_column(self, values: object, levels: Sequence[float], tail: float) -> dict[str, IntervalEstimate]:
        """Return each estimate by its name: `mean`, `quantile 0.05` and so on, and `cvar 0.95`."""
        estimates = {"mean": self.mean(values)}
        estimates |= {f"quantile {level:g}": self.quantile(values, level) for level in levels}
        return estimates | {f"cvar {tail:g}": self.cvar(values, tail)}

    def _half_width(self, x: np.ndarray) -> float:
        """Return t e(x), or infinity if a replicate has no sample."""
        if np.bincount(self.places, minlength=self.count).min() == 0:
            return math.inf
        sums = np.bincount(self.places, x - x.mean(), self.count) / len(x)
        shares = np.bincount(self.places, minlength=self.count) / len(x)
        error = math.sqrt(np.square(sums).sum() / (1 - np.square(shares).sum()))
        return float(stats.t.ppf(upper_level(self.confidence), self.count - 1)) * error
