"""Estimates from one column of a sweep, each with a confidence interval.

    mean            m - s g(t/sqrt(n)), m - s g(-t/sqrt(n)), not inside m -+ t s/sqrt(n)    Hall (1992), Student
    deviation       no interval, see below                                             Bahadur and Savage (1956)
    probability     Beta quantiles of k failures among n                               Clopper and Pearson (1934)
    quantile        x_(r), x_(s):  P(B < r) <= a/2,  P(B >= s) <= a/2,  B ~ Bin(n, p)  order statistics, any law
    CVaR            c - t*_(1-a/2) e,  c - t*_(a/2) e                                  studentised bootstrap

The confidence is 1 - a. An end that the data cannot give is infinite. Columns are finite: diverged runs are counted and
left out first.

The mean of a skewed sample has Hall's interval, which removes the skewness k from the t statistic:

    g(y) = 3 ((1 + k (y - k/(6 n)))^(1/3) - 1)/k

Each end is the outer one of Hall's and Student's. So heavy symmetric tails do not lower the coverage. 95 % intervals of
10, 30, 100 and 1,000 samples cover, in % (`experiments/mean_intervals/run.py`; the brackets have Student's intervals):

- Log-normal law with deviation 1 of the logarithm: 91, 94, 95 and 96 (84, 88, 92 and 94).
- Exponential law: 94, 96, 96 and 96 (90, 93, 94 and 95).
- Log-normal law with deviation 0.5 of the logarithm, gamma law of shape 4, normal law, uniform law, and Student's law
  with five degrees of freedom: 95 to 97 (93 to 95).

For the first law and 10 samples the median length is 1.4 of Student's, for the exponential law 1.2, for the normal law
1.06. A law with a longer tail has less: a log-normal law with deviation 1.5 has 86, 90, 93 and 95. Where the samples
are clearly skewed, the summary says so.

A standard deviation has no interval. Its error depends on the fourth moment of the law. A sample of a law with heavy
tails does not show it. The coverage of 95 % intervals of 50, 1,000 and 10,000 samples was measured:

- Bonett's method (2006), log-normal law with deviation 1 of the logarithm: 71, 85 and 91 %.
- Bonett's method (2006), Student's law with four degrees of freedom: 87, 91 and 92 %.
- Studentised bootstrap of 50 and 1,000 samples, the same laws: 83 and 89 %, and 91 and 92 %.

The quantiles have intervals that hold for every law.

Sources: P. Hall, On the removal of skewness by transformation, J. R. Stat. Soc. B 54 (1992). R. R. Bahadur and L. J.
Savage, The nonexistence of certain statistical procedures in nonparametric problems, Ann. Math. Stat. 27 (1956). R. T.
Rockafellar and S. Uryasev, Optimization of conditional value-at-risk, J. Risk 2 (2000).
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

BOOTSTRAP_REPLICATES = 999
# Rounding: differences are multiples of 2^-ROUNDING_BITS of their largest, and not larger than this, relative to the
# largest value, or to 1. Final errors near 0 are differences of numbers near 1.
ROUNDING_BITS, LARGEST_ROUNDING = 12, 2.0**-30
MIN_SKEWNESS = 1e-6  # below it Hall's correction is less than 1e-6 of the interval
MIN_TAIL_SAMPLES = 10  # samples in the tail from which CVaR's interval covers 92 to 95 %
# Atoms of a resampled tail: the largest half are single samples, the others are means of neighbours.
MAX_TAIL_ATOMS = 1024
REPLICATES_PER_BLOCK = 128  # replicates in memory at a time


class IntervalEstimate(NamedTuple):
    """An estimate with a confidence interval.

    Attributes:
        value: Estimate.
        low: Lower end of the interval.
        high: Upper end of the interval.
        confidence: Confidence of the interval, in (0, 1).
        samples: Number of samples.
    """

    value: float
    low: float
    high: float
    confidence: float
    samples: int

    def table(self) -> dict[str, float]:
        """Return the fields as plain values."""
        return self._asdict()


def as_column(values: object, minimum: int = 1) -> np.ndarray:
    """Return finite values as float64, shape (n,); raise ValueError for another shape, or too few values."""
    x = np.asarray(values, dtype=np.float64)
    if x.ndim != 1:
        raise ValueError(f"a column has one axis, this has shape {x.shape}")
    if (bad := x.size - np.count_nonzero(np.isfinite(x))) > 0:
        raise ValueError(f"{bad} of {x.size} values are NaN or infinite: leave diverged lanes out first")
    if x.size < minimum:
        raise ValueError(f"{x.size} values, at least {minimum} are needed")
    return x


def varies(values: np.ndarray) -> bool:
    """Return whether values differ by more than rounding.

    Differences that are rounding are few multiples of one small power of two, the spacing of the numbers that were
    subtracted. No other column looks like that: its values have all digits, or its multiples are of a larger number.
    """
    span = float(np.ptp(values)) if values.size else 0.0
    if not span > 0:
        return False
    unit = 2.0 ** (math.floor(math.log2(span)) - ROUNDING_BITS)
    multiples = (values - values.min()) / unit
    small = unit <= LARGEST_ROUNDING * max(1.0, float(np.abs(values).max()))
    return not (small and np.array_equal(multiples, np.round(multiples)))


def upper_level(confidence: float) -> float:
    """Return 1 - a/2 for the confidence 1 - a."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence = {confidence:g} is outside (0, 1)")
    return 0.5 + confidence / 2


def percentile_index(replicates: int, confidence: float) -> int:
    """Return the index i of an interval's ends among sorted replicates.

    The ends are the elements i and -1 - i, at the levels a/2 and 1 - a/2.
    """
    place = math.floor((replicates + 1) * (1 - upper_level(confidence)) + 1e-9) - 1
    if place < 0:
        raise ValueError(f"{replicates} replicates are too few for confidence = {confidence:g}")
    return place


@dataclasses.dataclass(frozen=True)
class Moments:
    """Count, mean, and sums of powers of deviations from the mean.

    Attributes:
        count: Number of samples.
        centre: Mean.
        second: Sum of squares of deviations from the mean.
        third: Sum of cubes of deviations from the mean.
    """

    count: int
    centre: float
    second: float
    third: float

    @classmethod
    def of(cls, values: object) -> "Moments":
        """Return the moments of `values` (n,), in two passes."""
        x = as_column(values, minimum=0)
        if not x.size:
            return cls(0, 0.0, 0.0, 0.0)
        d = x - x.mean()
        return cls(x.size, float(x.mean()), float(np.square(d).sum()), float((d * d * d).sum()))

    def mean(self, *, confidence: float = 0.95) -> IntervalEstimate:
        """Return the mean with the hull of Hall's and Student's intervals at this `confidence`."""
        n = self._check_count(2)
        scale, y = math.sqrt(self.second / (n - 1)), float(stats.t.ppf(upper_level(confidence), n - 1)) / math.sqrt(n)
        skewness = self.third / n / (self.second / n) ** 1.5 if self.second > 0 else 0.0
        low, high = max(y, _invert_hall(y, skewness, n)), min(-y, _invert_hall(-y, skewness, n))
        return IntervalEstimate(self.centre, self.centre - scale * low, self.centre - scale * high, confidence, n)

    def deviation(self, *, confidence: float = 0.95) -> IntervalEstimate:
        """Return the standard deviation with n - 1 in the denominator, between infinite ends at every `confidence`.

        No interval of finite length holds for every law.
        """
        n = self._check_count(2)
        return IntervalEstimate(math.sqrt(self.second / (n - 1)), -math.inf, math.inf, confidence, n)

    def _check_count(self, minimum: int) -> int:
        if self.count < minimum:
            raise ValueError(f"{self.count} samples, at least {minimum} are needed")
        return self.count


class Count(NamedTuple):
    """A number of failures among samples."""

    failures: int
    samples: int

    def probability(self, *, confidence: float = 0.95) -> IntervalEstimate:
        """Return the share of failures with the Clopper-Pearson interval, which has at least the given `confidence`."""
        k, n, top = self.failures, self.samples, upper_level(confidence)
        if not (0 <= k <= n and n > 0):
            raise ValueError(f"{k} failures among {n} samples")
        low = float(stats.beta.ppf(1 - top, k, n - k + 1)) if k > 0 else 0.0
        high = float(stats.beta.ppf(top, k + 1, n - k)) if k < n else 1.0
        return IntervalEstimate(k / n, low, high, confidence, n)


@dataclasses.dataclass(frozen=True, eq=False)
class Tail:
    """The k largest values, descending, and the indices of their samples; of equal values the lower index is first.

    Attributes:
        k: Largest number of values.
        values: Values, shape (k,), or shorter if there are fewer samples.
        indices: Indices of their samples, the same shape.
    """

    k: int
    values: np.ndarray
    indices: np.ndarray

    @classmethod
    def of(cls, values: object, indices: object, k: int) -> "Tail":
        """Return the k largest of `values` (n,), with `indices` (n,) of the samples."""
        x, index = as_column(values, minimum=0), np.asarray(indices)
        if x.shape != index.shape or k < 1:
            raise ValueError(f"k = {k} of {x.size} values with indices of shape {index.shape}")
        if k < x.size:
            in_tail = x >= np.partition(x, x.size - k)[x.size - k]
            x, index = x[in_tail], index[in_tail]
        order = np.lexsort((index, -x))[:k]
        return cls(k, x[order], index[order])


def quantile(values: object, level: float, *, confidence: float = 0.95) -> IntervalEstimate:
    """Return a quantile by linear interpolation (`numpy.quantile`), with an interval between two order statistics.

    The interval covers the quantile of any law at least with this confidence. For a continuous law the probability is
    exactly P(r <= B < s). Here r and s are the ranks of its ends, and B is binomial. An end is infinite where no order
    statistic reaches the confidence. The value is clipped to the interval.
    """
    ordered, top = np.sort(as_column(values)), upper_level(confidence)
    if not 0 < level < 1:
        raise ValueError(f"level = {level:g} is outside (0, 1)")
    n = len(ordered)
    r, s = int(stats.binom.ppf(1 - top, n, level)), int(stats.binom.isf(1 - top, n, level)) + 1
    return quantile_between(ordered, level, r, s, confidence)


def quantile_between(ordered: np.ndarray, level: float, low: int, high: int, confidence: float) -> IntervalEstimate:
    """Return a quantile by linear interpolation, between the order statistics of two ranks.

    Args:
        low: Rank of the lower end, counted from 1; with 0 the end is infinite.
        high: Rank of the upper end; with n + 1 the end is infinite.
    """
    n = len(ordered)
    bottom = float(ordered[low - 1]) if low > 0 else -math.inf
    top = float(ordered[high - 1]) if high <= n else math.inf
    # Interpolation can leave the interval for extreme levels and few samples.
    value = min(max(float(np.quantile(ordered, level)), bottom), top)
    return IntervalEstimate(value, bottom, top, confidence, n)


def cvar(
    values: object, level: float, *, confidence: float = 0.95, replicates: int = BOOTSTRAP_REPLICATES, seed: int = 0
) -> IntervalEstimate:
    """Return the mean of the largest fraction 1 - level of the samples; the sample at the edge counts in part.

    The interval is a studentised bootstrap. Its ends are -inf and inf with fewer than 10 samples in the tail. A tail
    without spread has percentile ends instead. Coverage of 95 % intervals was measured for n = 500 to 2000, levels 0.9
    and 0.95, six laws. The percentile bootstrap covers 89 to 95 %, BCa 90 to 95 %, and the studentised bootstrap 92 to
    96 %.
    """
    ordered = np.sort(as_column(values))
    if not 0 <= level < 1:
        raise ValueError(f"level = {level:g} is outside [0, 1)")
    n, place = len(ordered), percentile_index(replicates, confidence)
    share = round(n * (1 - level), 9)  # 100 (1 - 0.9) is 10
    # Samples that a resample's tail can reach: 8 standard deviations of a count above its mean.
    reach = min(n, math.ceil(share + 8 * math.sqrt(share)) + MIN_TAIL_SAMPLES)
    tail = ordered[n - reach :][::-1]
    ((value, _),) = _tail_means(tail, np.ones((1, reach)), share, n)
    if share < MIN_TAIL_SAMPLES:
        return IntervalEstimate(float(value), -math.inf, math.inf, confidence, n)
    atoms, sizes = _merge_into_atoms(tail)
    ((centre, error),) = _tail_means(atoms, sizes[None].astype(float), share, n)
    resampled = np.concatenate([_tail_means(atoms, w, share, n) for w in _resample_atoms(sizes, n, replicates, seed)])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = (resampled[:, 0] - centre) / resampled[:, 1]
        sides = np.sort(np.where(np.isnan(ratios), 0.0, ratios))[[-1 - place, place]]
        ends = value - sides * error
    # Percentiles replace an end if this tail, or a resample's tail, has no spread.
    plain = np.sort(resampled[:, 0])[[place, -1 - place]]
    low, high = np.where(np.isfinite(ends) & (error > 0), ends, plain)
    return IntervalEstimate(float(value), float(low), float(high), confidence, n)


def summarise_column(
    values: object, confidence: float = 0.95, levels: Sequence[float] = (0.05, 0.5, 0.95), tail: float = 0.95
) -> dict[str, IntervalEstimate]:
    """Return each estimate by its name: `mean`, `deviation`, `quantile 0.05` and so on, and `cvar 0.95`."""
    ordered = np.sort(as_column(values, minimum=4))
    moments = Moments.of(ordered)
    estimates = {"mean": moments.mean(confidence=confidence), "deviation": moments.deviation(confidence=confidence)}
    estimates |= {f"quantile {level:g}": quantile(ordered, level, confidence=confidence) for level in levels}
    estimates[f"cvar {tail:g}"] = cvar(ordered, tail, confidence=confidence)
    return estimates


def _invert_hall(y: float, skewness: float, n: int) -> float:
    """Return the t statistic over sqrt(n) at which Hall's polynomial of it is y."""
    if abs(skewness) < MIN_SKEWNESS:
        return y
    return 3 * (math.cbrt(1 + skewness * (y - skewness / (6 * n))) - 1) / skewness


def _tail_means(tail: np.ndarray, weights: np.ndarray, share: float, n: int) -> np.ndarray:
    """Return CVaR and its standard error, (replicates, 2), from descending values (k,) and weights (replicates, k).

    CVaR is the mean of y = q + max(x - q, 0) n/share, with the quantile q. Its standard error is e = std(y)/sqrt(n).
    """
    reached = np.cumsum(weights, axis=1)
    tail_weights = np.clip(share - (reached - weights), 0.0, weights)
    edge = np.minimum(np.count_nonzero(reached < share, axis=1), len(tail) - 1)
    excess = np.maximum(tail - tail[edge][:, None], 0.0)
    first, second = (np.einsum("rk,rk->r", weights, power) / n for power in (excess, excess**2))
    return np.stack([tail_weights @ tail / share, np.sqrt(np.maximum(second - first**2, 0.0) * n) / share], axis=1)


def _merge_into_atoms(tail: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the descending tail with at most MAX_TAIL_ATOMS values, and the number of samples of each.

    The bootstrap loses the variation within an atom, a share of about 1/MAX_TAIL_ATOMS^2 of the variance.
    """
    single = MAX_TAIL_ATOMS // 2
    if len(tail) <= MAX_TAIL_ATOMS:
        return tail, np.ones(len(tail), dtype=int)
    edges = np.concatenate([np.arange(single), np.linspace(single, len(tail), MAX_TAIL_ATOMS - single + 1).astype(int)])
    sizes = np.diff(edges)
    return np.add.reduceat(tail, edges[:-1]) / sizes, sizes


def _resample_atoms(sizes: np.ndarray, n: int, replicates: int, seed: int) -> Iterator[np.ndarray]:
    """Yield the counts of each atom when n samples are drawn of n, in blocks (replicates, atoms).

    The other samples are below the tail.
    """
    random, total = np.random.default_rng(seed), int(sizes.sum())
    totals = random.binomial(n, total / n, size=replicates)
    for start in range(0, replicates, REPLICATES_PER_BLOCK):
        yield random.multinomial(totals[start : start + REPLICATES_PER_BLOCK], sizes / total).astype(float)
