"""Point estimates against NumPy, SciPy and closed forms; intervals against SciPy, and by how often they cover what is
known. A coverage of 95 % among 1,000 repetitions has a standard error of 0.7 points, among 200 one of 1.5 points."""

import json
import math

import numpy as np
import pytest
from mutants import killed_by
from scipy import optimize, stats
from seams import replace_seam

from diffabs.uncertainty.sweep.statistics import estimates, paired, sensitivity
from diffabs.uncertainty.sweep.statistics.estimates import Count, Moments, Tail
from diffabs.uncertainty.sweep.statistics.replicated import Replicates

REPETITIONS = 1000


def coverage(interval, draw, truth, repetitions=REPETITIONS):
    """In points, of interval(draw()) over the repetitions."""
    found = (interval(draw()) for _ in range(repetitions))
    return 100 * np.mean([one.low <= truth <= one.high for one in found])


def ends(estimate):
    return [estimate.low, estimate.high]


class TestColumn:
    @pytest.mark.parametrize(
        "function",
        [
            Moments.of,
            lambda x: Replicates(np.arange(6) % 2, 2).mean(x),
            estimates.summarise_column,
            lambda x: estimates.quantile(x, 0.5),
            lambda x: estimates.cvar(x, 0.5),
            lambda x: Tail.of(x, np.arange(len(x)), 2),
            lambda x: sensitivity.correlations(x[:, None], np.arange(6.0)),
            lambda x: sensitivity.correlations(np.ones((6, 1)), x),
            lambda x: sensitivity.sobol_indices(np.ones(6), np.ones(6), x[None]),
            lambda x: paired.compare_pairs(np.ones(6), x),
        ],
    )
    def test_what_is_not_finite_is_counted(self, function):
        with pytest.raises(ValueError, match="2 of 6 values are NaN or infinite"):
            function(np.array([1.0, np.nan, 2.0, 3.0, np.inf, 4.0]))

    def test_shapes_and_numbers_that_do_not_fit_are_refused(self):
        with pytest.raises(ValueError, match=r"shape \(2, 3\)"):
            Moments.of(np.ones((2, 3)))
        with pytest.raises(ValueError, match="1 samples, at least 2"):
            Moments.of([1.0]).mean()
        with pytest.raises(ValueError, match="3 failures among 2"):
            Count(3, 2).probability()
        with pytest.raises(ValueError, match="confidence = 1 is outside"):
            Count(1, 2).probability(confidence=1.0)
        with pytest.raises(ValueError, match=r"level = 1 is outside \(0, 1\)"):
            estimates.quantile([1.0, 2.0], 1.0)
        with pytest.raises(ValueError, match=r"level = 1 is outside \[0, 1\)"):
            estimates.cvar([1.0, 2.0], 1.0)
        with pytest.raises(ValueError, match=r"99 replicates are too few for confidence = 0\.99"):
            estimates.cvar(np.arange(99.0), 0.5, confidence=0.99, replicates=99)
        with pytest.raises(ValueError, match="99 replicates are too few"):
            sensitivity.sobol_indices(np.ones(6), np.ones(6), np.ones((2, 6)), confidence=0.99, replicates=99)
        with pytest.raises(ValueError, match="are not pairs"):
            paired.compare_pairs(np.ones(5), np.ones(6))
        with pytest.raises(ValueError, match=r"\(5, 2\) do not fit 6 outputs"):
            sensitivity.correlations(np.ones((5, 2)), np.ones(6))
        with pytest.raises(ValueError, match="do not fit"):
            sensitivity.sobol_indices(np.ones(6), np.ones(6), np.ones((2, 5)))


class TestMoments:
    X = np.random.default_rng(1).gamma(3.0, size=1000) + 100.0

    def test_are_those_of_numpy(self):
        one, d = Moments.of(self.X), self.X - np.mean(self.X)
        found = [one.count, one.centre, one.second]
        np.testing.assert_allclose(found, [1000, self.X.mean(), np.sum(d**2)], rtol=1e-12, atol=0)
        np.testing.assert_allclose(one.deviation().value, np.std(self.X, ddof=1), rtol=1e-12, atol=0)

    def test_the_mean_of_a_symmetric_sample_has_the_interval_of_the_t_test(self):
        x = np.concatenate([self.X, -self.X])
        theirs = stats.ttest_1samp(x, 0.0).confidence_interval(0.9)
        np.testing.assert_allclose(ends(Moments.of(x).mean(confidence=0.9)), theirs, rtol=1e-9, atol=0)

    @killed_by("uncertainty.sweep.statistics.estimates", "skewness / (6 * n)", "skewness / (3 * n)")
    @pytest.mark.parametrize("sign", [1, -1])
    @pytest.mark.parametrize("n", [2, 3, 10, 1000])
    def test_the_mean_has_the_wider_ends_of_the_t_test_and_of_hall(self, n, sign):
        """Hall's ends are where his polynomial of (x - mu)/s, solved here by Brent's method, is Student's quantile."""
        x = sign * np.random.default_rng(2).lognormal(size=n)
        scale, skewness = x.std(ddof=1), stats.skew(x)
        quantile = stats.t.ppf(0.95, n - 1) / math.sqrt(n)

        def end(side):
            def distance(t):
                return t + skewness * t**2 / 3 + skewness**2 * t**3 / 27 + skewness / (6 * n) - side * quantile

            return x.mean() - scale * optimize.brentq(distance, -100, 100, xtol=1e-14)

        student = stats.ttest_1samp(x, 0.0).confidence_interval(0.9)
        theirs = [min(student.low, end(1)), max(student.high, end(-1))]
        np.testing.assert_allclose(ends(Moments.of(x).mean(confidence=0.9)), theirs, rtol=1e-9, atol=1e-12)


class TestCount:
    @killed_by(
        "uncertainty.sweep.statistics.estimates", "stats.beta.ppf(top, k + 1, n - k)", "stats.beta.ppf(top, k, n - k)"
    )
    @pytest.mark.parametrize(("k", "n"), [(0, 10), (10, 10), (3, 10), (1, 1000), (420, 1000)])
    def test_is_clopper_and_pearsons(self, k, n):
        theirs = stats.binomtest(k, n).proportion_ci(0.99)
        np.testing.assert_allclose(ends(Count(k, n).probability(confidence=0.99)), theirs, rtol=0, atol=1e-8)
        assert Count(k, n).probability().value == k / n

    def test_rare_failures_solve_the_binomial_equations(self):
        low, high = ends(Count(3, 10**7).probability())
        np.testing.assert_allclose(stats.binom.sf(2, 10**7, low), 0.025, rtol=1e-7, atol=0)
        np.testing.assert_allclose(stats.binom.cdf(3, 10**7, high), 0.025, rtol=1e-7, atol=0)


class TestQuantile:
    @killed_by(
        "uncertainty.sweep.statistics.estimates",
        "stats.binom.isf(1 - top, n, level)) + 1",
        "stats.binom.isf(1 - top, n, level))",
    )
    @pytest.mark.parametrize("level", [0.001, 0.05, 0.3, 0.5, 0.9, 0.99])
    @pytest.mark.parametrize("n", [1, 5, 40, 300])
    def test_is_between_the_right_order_statistics(self, level, n):
        """Values are their own ranks; below[k] = P(B <= k)."""
        x, below = np.arange(1.0, n + 1), np.cumsum(stats.binom.pmf(np.arange(n + 1), n, level))
        low = max((r for r in range(1, n + 1) if below[r - 1] <= 0.05), default=-math.inf)
        high = min((s for s in range(1, n + 1) if below[s - 1] >= 0.95), default=math.inf)
        found = estimates.quantile(np.random.default_rng(2).permutation(x), level, confidence=0.9)
        assert ends(found) == [low, high]
        assert found.value == np.clip(np.quantile(x, level), low, high)

    def test_an_end_that_cannot_be_had_is_infinite(self):
        x = np.random.default_rng(3).random(100)
        assert estimates.quantile(x, 0.999).high == math.inf
        assert estimates.quantile(x, 0.999).low > x.mean()
        assert estimates.quantile(x, 0.001).low == -math.inf


def brute_cvar(x, level):
    """min over q of q + mean(max(x - q, 0))/(1 - level), Rockafellar and Uryasev; the standard error of that mean."""
    y = x[:, None] + np.maximum(x[None] - x[:, None], 0.0) / (1 - level)
    best = np.argmin(y.mean(axis=1))
    return y[best].mean(), y[best].std() / math.sqrt(len(x))


class TestCVaR:
    X = np.random.default_rng(4).exponential(size=237)

    @pytest.mark.parametrize("level", [0.0, 0.3, 0.9, 0.95, 0.999])
    def test_is_rockafellar_and_uryasevs(self, level):
        np.testing.assert_allclose(
            estimates.cvar(self.X, level).value, brute_cvar(self.X, level)[0], rtol=1e-12, atol=0
        )

    @killed_by(
        "uncertainty.sweep.statistics.estimates",
        "tail_weights = np.clip(share - (reached - weights), 0.0, weights)",
        "tail_weights = np.clip(np.round(share) - (reached - weights), 0.0, weights)",
    )
    def test_the_sample_at_the_edge_counts_in_part(self):
        assert estimates.cvar([1.0, 5.0, 2.0, 3.0], 0.625).value == pytest.approx((5 + 0.5 * 3) / 1.5, rel=1e-12)

    @killed_by(
        "uncertainty.sweep.statistics.estimates",
        "totals = random.binomial(n, total / n, size=replicates)",
        "totals = np.full(replicates, total)",
    )
    def test_the_interval_is_that_of_a_plain_studentised_bootstrap(self):
        """Both with 2,000 resamples of their own: an end has a standard error of 0.02 half-widths."""
        random, (value, error) = np.random.default_rng(5), brute_cvar(self.X, 0.8)
        resampled = [brute_cvar(random.choice(self.X, len(self.X)), 0.8) for _ in range(2000)]
        ratios = np.quantile([(v - value) / e for v, e in resampled], [0.95, 0.05])
        found = estimates.cvar(self.X, 0.8, confidence=0.9, replicates=2000)
        np.testing.assert_allclose(ends(found), value - ratios * error, rtol=0, atol=0.1 * 1.65 * error)

    def test_a_seed_is_an_interval_and_units_do_not_matter(self):
        one = estimates.cvar(self.X, 0.9, seed=7)
        assert estimates.cvar(self.X[::-1], 0.9, seed=7) == one
        assert estimates.cvar(self.X, 0.9, seed=8).low != one.low
        np.testing.assert_allclose(
            ends(estimates.cvar(1e3 * self.X - 40, 0.9, seed=7)), 1e3 * np.array(ends(one)) - 40, rtol=1e-10, atol=0
        )

    def test_a_long_tail_of_few_atoms_has_the_same_interval(self, monkeypatch):
        """Tails of 4,000 samples in 64 or in 1,024 atoms, against none merged: ends as far apart as other seeds'."""
        x = np.random.default_rng(6).exponential(size=20_000)
        found = {}
        for atoms in (64, 1024, 10**6):
            replace_seam(monkeypatch, "max_tail_atoms", atoms)
            found[atoms] = estimates.cvar(x, 0.8, replicates=799)
        half = 1.96 * np.std(np.maximum(x - np.quantile(x, 0.8), 0.0)) / 0.2 / math.sqrt(len(x))
        for atoms in (64, 1024):
            assert found[atoms].value == found[10**6].value
            np.testing.assert_allclose(ends(found[atoms]), ends(found[10**6]), rtol=0, atol=0.15 * half)

    def test_zeros_and_ones_have_an_interval(self):
        """45 ones of 1,000 against a tail of 50: CVaR is the share of ones times 20, and 1 from 50 ones on. A resample
        of 50 ones has no spread, so that the lower end is the percentile, to one step of 0.02."""
        found = estimates.cvar(np.arange(1000) < 45, 0.95, replicates=3999)
        assert found.value == pytest.approx(0.9, rel=1e-12)
        assert found.low == pytest.approx(stats.binom.ppf(0.025, 1000, 0.045) / 50, abs=0.021)
        assert 1.0 < found.high < 1.3

    def test_a_tail_with_too_few_samples_has_no_interval(self):
        assert ends(estimates.cvar(self.X, 0.96)) == [-math.inf, math.inf]
        assert math.isfinite(estimates.cvar(self.X, 0.95).high)
        np.testing.assert_allclose(estimates.cvar(np.minimum(self.X, 1.1), 0.9)[:3], 1.1, rtol=1e-12, atol=0)


class TestTail:
    @pytest.mark.parametrize("seed", range(20))
    def test_keeps_the_greatest_and_of_equal_ones_the_first(self, seed):
        random = np.random.default_rng(seed)
        x, k = random.integers(0, 30, 200).astype(float), int(random.integers(1, 250))
        theirs = sorted(range(200), key=lambda i: (-x[i], i))[:k]
        index = random.permutation(200)
        one = Tail.of(x[index], index, k)
        assert one.indices.tolist() == theirs
        assert one.values.tolist() == x[theirs].tolist()


class TestSummary:
    def test_is_what_the_functions_say_as_plain_values(self):
        x = np.random.default_rng(10).exponential(size=500)
        found = estimates.summarise_column(x, 0.9, levels=(0.25, 0.5), tail=0.8)
        assert found == {
            "mean": Moments.of(np.sort(x)).mean(confidence=0.9),
            "deviation": Moments.of(np.sort(x)).deviation(confidence=0.9),
            "quantile 0.25": estimates.quantile(x, 0.25, confidence=0.9),
            "quantile 0.5": estimates.quantile(x, 0.5, confidence=0.9),
            "cvar 0.8": estimates.cvar(x, 0.8, confidence=0.9),
        }
        table = found["mean"].table()
        assert json.loads(json.dumps(table)) == table
        assert set(table) == {"value", "low", "high", "confidence", "samples"}


def in_replicates(n, count):
    """Samples of an exponential law and their replicates, shuffled: as a table from which rows are left out."""
    random = np.random.default_rng(41)
    return random.exponential(size=n), random.permutation(np.arange(n) % count)


class TestReplicates:
    X, PLACES = in_replicates(640, 8)
    BY = Replicates(PLACES, 8, 0.9)

    def blocks(self, values):
        """Means of the replicates."""
        return [values[r == self.PLACES].mean() for r in range(8)]

    @killed_by("uncertainty.sweep.statistics.replicated", " / (1 - np.square(shares).sum())", "")
    def test_the_mean_has_the_t_interval_of_the_replicates(self):
        theirs = stats.ttest_1samp(self.blocks(self.X), 0.0).confidence_interval(0.9)
        found = self.BY.mean(self.X)
        np.testing.assert_allclose([found.value, *ends(found)], [self.X.mean(), *theirs], rtol=1e-12, atol=0)

    @killed_by(
        "uncertainty.sweep.statistics.replicated", "x - x.mean(), self.count) / len(x)", "x, self.count) / len(x)"
    )
    def test_replicates_of_different_lengths_count_by_their_samples(self):
        """Linearised ratio of two sums, by the replicates left out in turn (jackknife)."""
        kept = np.random.default_rng(42).random(640) < np.linspace(1.0, 0.5, 8)[self.PLACES]
        x, places = self.X[kept], self.PLACES[kept]
        without = [x[places != r].mean() for r in range(8)]
        jackknife = math.sqrt(7 / 8 * np.sum((np.array(without) - np.mean(without)) ** 2))
        found = Replicates(places, 8, 0.9).mean(x)
        half = stats.t.ppf(0.95, 7) * jackknife
        np.testing.assert_allclose(ends(found), [x.mean() - half, x.mean() + half], rtol=0, atol=0.05 * half)

    @killed_by("uncertainty.sweep.statistics.replicated", "np.square(shares).sum()", "1 / self.count")
    def test_the_error_of_unequal_replicates_is_not_too_small(self):
        """Of independent samples, its square is 1/n on average."""
        random, by = np.random.default_rng(43), Replicates(np.arange(200) // 180, 2)
        found = [by.mean(x) for x in random.normal(size=(2000, 200))]
        errors = np.array([one.high - one.value for one in found]) / stats.t.ppf(0.975, 1)
        assert np.square(errors).mean() == pytest.approx(1 / 200, rel=0.15)

    @killed_by("uncertainty.sweep.statistics.replicated", "n * (level + above)", "n * level")
    @killed_by("uncertainty.sweep.statistics.replicated", "n * (level - below)", "n * level")
    @pytest.mark.parametrize("level", [0.05, 0.5, 0.9])
    def test_a_quantile_lies_where_the_shares_below_it_allow(self, level):
        x, ordered = self.X, np.sort(self.X)
        share = stats.ttest_1samp(self.blocks(x <= np.quantile(x, level)), level).confidence_interval(0.9)
        half = (share.high - share.low) / 2
        found = self.BY.quantile(x, level)
        expected = [ordered[math.floor(640 * (level - half)) - 1], ordered[math.ceil(640 * (level + half))]]
        np.testing.assert_allclose([found.value, *ends(found)], [np.quantile(x, level), *expected], rtol=1e-12, atol=0)

    def test_a_quantile_among_equal_values_is_certain(self):
        x = np.floor(3 * self.X)  # 0 with probability 0.28, 1 with 0.20
        assert self.BY.quantile(x, 0.15)[:3] == (0.0, 0.0, 0.0)
        assert ends(self.BY.quantile(x, stats.expon.cdf(1 / 3))) == [0.0, 1.0]

    @killed_by(
        "uncertainty.sweep.statistics.replicated",
        "np.maximum(x - edge, 0.0) / (1 - level)",
        "np.maximum(x - edge, 0.0)",
    )
    @pytest.mark.parametrize("level", [0.3, 0.9, 0.951])
    def test_cvar_is_rockafellar_and_uryasevs(self, level):
        x, edge = self.X, np.sort(self.X)[math.ceil(640 * level) - 1]
        theirs = stats.ttest_1samp(self.blocks(edge + np.maximum(x - edge, 0) / (1 - level)), 0).confidence_interval(
            0.9
        )
        found = self.BY.cvar(x, level)
        assert found.value == pytest.approx(brute_cvar(x, level)[0], rel=1e-12)
        np.testing.assert_allclose(ends(found), theirs, rtol=1e-12, atol=0)

    @killed_by("uncertainty.sweep.statistics.replicated", "MIN_TAIL_SAMPLES <= failures", "1 <= failures")
    @killed_by("uncertainty.sweep.statistics.replicated", "if equal or", "if half == 0 or", case="three each")
    @pytest.mark.parametrize(
        ("failed", "n"),
        [([], 1024), ([5], 1024), ([5, 6], 1024), (range(0, 1024, 64), 1024), (np.arange(1000) % 100 < 3, 1000)],
        ids=["none", "one", "two", "one each", "three each"],
    )
    def test_rare_failures_have_clopper_and_pearsons_interval(self, failed, n):
        """Also equal shares: they have no spread, and the share of the law is not certain."""
        mask = failed if isinstance(failed, np.ndarray) else np.isin(np.arange(n), failed)
        theirs = stats.binomtest(int(mask.sum()), n).proportion_ci()
        size = 64 if n == 1024 else 100
        found = Replicates(np.arange(n) // size, n // size).probability(mask)
        np.testing.assert_allclose(ends(found), theirs, rtol=0, atol=1e-8)

    @killed_by("uncertainty.sweep.statistics.replicated", "max(share - half, 0.0)", "share - half")
    def test_a_probability_lies_between_0_and_1(self):
        """All failures in one replicate: the t interval would begin below 0."""
        mask = np.arange(1024) < 40
        found = Replicates(np.arange(1024) // 64, 16).probability(mask)
        half = (
            stats.ttest_1samp(mask.reshape(16, 64).mean(axis=1), 0.0).confidence_interval().high - 40 / 1024
        ) + 1 / 1024
        np.testing.assert_allclose(found[:3], [40 / 1024, 0.0, 40 / 1024 + half], rtol=1e-12, atol=0)
        assert Replicates(np.arange(1024) // 64, 16).probability(~mask).high == 1.0

    @killed_by(
        "uncertainty.sweep.statistics.replicated", "minlength=self.count).min() == 0", "minlength=self.count).min() < 0"
    )
    def test_without_a_replicate_no_interval_is_known(self):
        x, by = self.X[self.PLACES < 7], Replicates(self.PLACES[self.PLACES < 7], 8)
        for found, value in (
            (by.mean(x), x.mean()),
            (by.quantile(x, 0.5), np.quantile(x, 0.5)),
            (by.cvar(x, 0.9), brute_cvar(x, 0.9)[0]),
        ):
            assert found.value == pytest.approx(value, rel=1e-12)
            assert ends(found) == [-math.inf, math.inf]
        assert by.probability(x > 1) == Count(np.count_nonzero(x > 1), len(x)).probability()

    def test_a_tail_with_too_few_samples_has_no_interval(self):
        assert ends(self.BY.cvar(self.X, 0.99)) == [-math.inf, math.inf]
        assert self.BY.quantile(self.X, 0.001).low == -math.inf
        assert self.BY.quantile(self.X, 0.999).high == math.inf


class TestCorrelations:
    X = np.random.default_rng(11).normal(size=(80, 3))
    Y = X[:, 0] + np.exp(X[:, 1]) + 0.1 * np.random.default_rng(12).normal(size=80)

    def test_pearsons_are_scipys(self):
        found = sensitivity.correlations(self.X, self.Y).pearson
        theirs = [stats.pearsonr(x, self.Y).statistic for x in self.X.T]
        np.testing.assert_allclose([one.value for one in found], theirs, rtol=1e-12, atol=0)

    @killed_by("uncertainty.sweep.statistics.sensitivity", "_influence(u, v, r) + rank_effect", "_influence(u, v, r)")
    @killed_by("uncertainty.sweep.statistics.sensitivity", "u * v - r * (u * u + v * v) / 2", "u * v")
    @pytest.mark.parametrize(
        ("kind", "theirs"),
        [pytest.param("pearson", stats.pearsonr, marks=pytest.mark.slow), ("spearman", stats.spearmanr)],
    )
    def test_the_intervals_are_those_of_samples_left_out(self, kind, theirs):
        """Jackknife of the inverse hyperbolic tangent, for three laws that are not binormal."""
        random = np.random.default_rng(40)
        x = random.normal(size=(400, 3))
        y = x[:, 0] + x[:, 0] ** 2 + np.exp(x[:, 1])
        for one, column in zip(getattr(sensitivity.correlations(x, y), kind), x.T, strict=True):
            keep = ~np.eye(400, dtype=bool)
            z = np.arctanh([theirs(column[mask], y[mask]).statistic for mask in keep])
            half = 1.96 * math.sqrt(399 / 400 * np.sum((z - z.mean()) ** 2))
            middle = np.arctanh(theirs(column, y).statistic)
            np.testing.assert_allclose(np.arctanh(ends(one)), [middle - half, middle + half], rtol=0, atol=0.06 * half)

    def test_spearmans_are_scipys_with_ties_too(self):
        x, y = np.round(self.X), np.round(2 * self.Y)
        found = sensitivity.correlations(x, y).spearman
        theirs = [stats.spearmanr(one, y).statistic for one in x.T]
        np.testing.assert_allclose([one.value for one in found], theirs, rtol=1e-12, atol=0)

    def test_constants_have_no_correlation_and_monotone_ones_one(self):
        x = np.stack([np.full(80, 0.1), self.Y**3, -self.Y], axis=1)
        found = sensitivity.correlations(x, self.Y)
        for one in (found.pearson[0], found.spearman[0]):
            assert math.isnan(one.value)
            assert ends(one) == [-1.0, 1.0]
        np.testing.assert_allclose([found.spearman[1].value, *ends(found.spearman[1])], 1.0, rtol=1e-6, atol=0)
        np.testing.assert_allclose([found.pearson[2].value, *ends(found.pearson[2])], -1.0, rtol=1e-6, atol=0)


def ishigami(x, a=7.0, b=0.1):
    x = np.pi * (2 * x - 1)
    return np.sin(x[..., 0]) + a * np.sin(x[..., 1]) ** 2 + b * x[..., 2] ** 4 * np.sin(x[..., 0])


def ishigami_indices(a=7.0, b=0.1):
    one, two, both = (1 + b * np.pi**4 / 5) ** 2 / 2, a**2 / 8, b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    return np.array([one, two, 0, one + both, two, both]) / (one + two + both)


G = np.array([0, 1, 4.5, 9, 99, 99])


def product(x):
    """Sobol's g-function."""
    return np.prod((np.abs(4 * x - 2) + G) / (1 + G), axis=-1)


def product_indices():
    v = 1 / (3 * (1 + G) ** 2)
    return np.concatenate([v, v * np.prod(1 + v) / (1 + v)]) / (np.prod(1 + v) - 1)


def outputs(function, d, n, random):
    """f(A), f(B), f(AB_j)."""
    a, b = random.random((2, n, d))
    mixed = np.where(np.eye(d, dtype=bool)[:, None], b, a)
    return function(a), function(b), function(mixed)


MODELS = pytest.mark.parametrize(
    ("function", "truth"), [(ishigami, ishigami_indices()), (product, product_indices())], ids=["ishigami", "product"]
)


class TestSobol:
    @MODELS
    def test_is_right_within_its_interval_and_that_is_narrow(self, function, truth):
        """n = 60,000, 18 intervals in all: of 99.9 %."""
        a, b, ab = outputs(function, len(truth) // 2, 60_000, np.random.default_rng(13))
        found = sensitivity.sobol_indices(a, b, ab, confidence=0.999, replicates=3999)
        for one, index in zip(found.first + found.total, truth, strict=True):
            assert one.low <= index <= one.high
            assert one.high - one.low < 0.07
            assert one.samples == 60_000

    @pytest.mark.slow
    @MODELS
    def test_intervals_cover(self, function, truth):
        random, hits = np.random.default_rng(14), np.zeros(len(truth))
        for k in range(200):
            rows = outputs(function, len(truth) // 2, 1000, random)
            found = sensitivity.sobol_indices(*rows, replicates=199, seed=k)
            each = zip(found.first + found.total, truth, strict=True)
            hits += [one.low <= index <= one.high for one, index in each]
        np.testing.assert_allclose(hits / 2, 95.0, rtol=0, atol=4.0)

    @killed_by("uncertainty.sweep.statistics.sensitivity", "mean = (a.mean() + b.mean()) / 2", "mean = b.mean()")
    def test_the_bootstrap_is_that_of_scipy_with_rows_together(self):
        """First and total index. 2,000 resamples on both sides: an end has a standard error of 0.06 deviations."""
        a, b, ab = outputs(ishigami, 3, 200, np.random.default_rng(15))

        def indices(a, b, mixed, axis):
            middle = np.mean([a, b], axis=(0, -1))[..., None]
            scale = np.var(np.concatenate([a, b], axis=axis), axis=axis)
            return np.array([((b - middle) * (mixed - a)).mean(axis), ((a - mixed) ** 2).mean(axis) / 2]) / scale

        theirs = stats.bootstrap(
            (a, b, ab[0]), indices, paired=True, method="percentile", n_resamples=2000, rng=np.random.default_rng(16)
        )
        found = sensitivity.sobol_indices(a, b, ab, replicates=2000)
        ours = np.array([ends(found.first[0]), ends(found.total[0])])
        value = [found.first[0].value, found.total[0].value]
        np.testing.assert_allclose(value, indices(a, b, ab[0], -1), rtol=1e-12, atol=0)
        error = theirs.standard_error[:, None]
        np.testing.assert_allclose(ours / error, np.transpose(theirs.confidence_interval) / error, rtol=0, atol=0.25)

    def test_groups_of_rows_change_no_index_and_no_width(self, monkeypatch):
        """Ends of 999 resamples of 500 groups: widths to 5 %; sorted rows must not lie in one group."""
        a, b, ab = outputs(ishigami, 3, 4000, np.random.default_rng(17))
        order = np.argsort(a)
        rows = sensitivity.sobol_indices(a, b, ab)
        replace_seam(monkeypatch, "max_row_groups", 500)
        groups = sensitivity.sobol_indices(a[order], b[order], ab[:, order])
        for one, other in zip(rows.first + rows.total, groups.first + groups.total, strict=True):
            np.testing.assert_allclose(other.value, one.value, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(other.high - other.low, one.high - one.low, rtol=0.2, atol=0)

    def test_a_seed_changes_the_interval_and_an_offset_nothing(self):
        a, b, ab = outputs(ishigami, 3, 100, np.random.default_rng(18))
        one = sensitivity.sobol_indices(a, b, ab, seed=3)
        assert sensitivity.sobol_indices(a, b, ab, seed=3) == one
        assert sensitivity.sobol_indices(a, b, ab, seed=4).first[0].low != one.first[0].low
        moved = sensitivity.sobol_indices(a + 1e6, b + 1e6, ab + 1e6, seed=3)
        np.testing.assert_allclose(moved.first + moved.total, one.first + one.total, rtol=0, atol=1e-8)
        found = sensitivity.sobol_indices(np.ones(9), np.ones(9), np.ones((2, 9)))
        for none in found.first + found.total:
            assert math.isnan(none.value)
            assert ends(none) == [-math.inf, math.inf]


class TestPaired:
    A = np.random.default_rng(19).gamma(4.0, size=150)
    NOISE = np.round(np.random.default_rng(20).normal(0.0, 0.5, size=75), 1)
    B = A + (0.3 + np.concatenate([NOISE, -NOISE]))  # differences without skewness: the interval is Student's

    @killed_by("uncertainty.sweep.statistics.paired", "difference = first - second", "difference = second - first")
    def test_is_scipys_each_by_each(self):
        found = paired.compare_pairs(self.A, self.B, confidence=0.9)
        theirs = stats.ttest_rel(self.A, self.B).confidence_interval(0.9)
        np.testing.assert_allclose(ends(found.mean), theirs, rtol=1e-10, atol=0)
        assert found.mean.value == pytest.approx(np.mean(self.A) - np.mean(self.B), rel=1e-12)
        assert found.median == estimates.quantile(self.A - self.B, 0.5, confidence=0.9)
        less, ties = sum(self.A < self.B), sum(self.A == self.B)
        theirs = stats.binomtest(less, 150).proportion_ci(0.9)
        np.testing.assert_allclose([found.less.value, *ends(found.less)], [less / 150, *theirs], rtol=0, atol=1e-8)
        assert found.ties == ties > 0

    def test_the_reduction_is_what_independent_samples_would_cost(self):
        """var a = 1, var b = 1.25, var(a - b) = 0.25: 9. Relative error of three variances: sqrt(2/n) each, at most."""
        random = np.random.default_rng(21)
        a = random.normal(size=100_000)
        b = a + 0.5 * random.normal(size=100_000)
        assert paired.compare_pairs(a, b).reduction == pytest.approx(9.0, rel=0.03)
        assert paired.compare_pairs(a, a + 0.0).reduction == math.inf
        assert math.isnan(paired.compare_pairs(np.ones(5), np.zeros(5)).reduction)


def binormal(random, n, rho):
    x, y = random.normal(size=(2, n))
    return x, rho * x + math.sqrt(1 - rho**2) * y


class TestCoverage:
    @pytest.mark.parametrize(
        ("law", "n", "least", "greatest"),
        [
            (stats.lognorm(1.0), 30, 92, 96),  # Student's interval: 88
            (stats.expon(), 10, 92.5, 96.5),  # 90
            (stats.gamma(4), 10, 93, 97.5),
            (stats.norm(), 30, 93, 97.5),
            (stats.t(5), 30, 93, 97.5),  # Hall's interval alone: 93.1
        ],
        ids=["log-normal", "exponential", "gamma", "normal", "t5"],
    )
    def test_mean(self, law, n, least, greatest):
        """Within three standard errors of what `experiments/mean_intervals/run.py` measures."""
        samples = law.rvs(size=(REPETITIONS, n), random_state=np.random.default_rng(30))
        found = coverage(lambda x: Moments.of(x).mean(), iter(samples).__next__, law.mean())
        assert least < found < greatest

    @pytest.mark.parametrize("n", [50, 1000])
    @pytest.mark.parametrize("law", [stats.lognorm(1.0), stats.t(4)], ids=["log-normal", "t4"])
    def test_deviation(self, law, n):
        """An interval that is stated covers at least 93 % whatever the law; one that is not stated covers all."""
        random = np.random.default_rng(31)
        found = coverage(lambda x: Moments.of(x).deviation(), lambda: law.rvs(size=n, random_state=random), law.std())
        assert found >= 93

    def test_quantile(self):
        n, level, random = 1000, 0.9, np.random.default_rng(32)
        r, s = ends(estimates.quantile(np.arange(1.0, n + 1), level))
        exact = 100 * (stats.binom.cdf(s - 1, n, level) - stats.binom.cdf(r - 1, n, level))
        assert 95 <= exact < 96
        found = coverage(
            lambda x: estimates.quantile(x, level), lambda: random.exponential(size=n), -math.log(1 - level)
        )
        assert abs(found - exact) < 2

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("n", "level", "law"),
        [
            pytest.param(1000, 0.95, stats.expon(), id="exponential"),
            pytest.param(500, 0.9, stats.norm(), id="normal", marks=pytest.mark.slow),
        ],
    )
    def test_cvar(self, n, level, law):
        """The truth by quadrature over the upper quantiles."""
        random, q = np.random.default_rng(33), level + (1 - level) * (np.arange(10**6) + 0.5) / 10**6
        found = coverage(
            lambda x: estimates.cvar(x, level, replicates=299),
            lambda: law.rvs(n, random_state=random),
            law.ppf(q).mean(),
        )
        assert abs(found - 95) < 2

    @pytest.mark.slow
    def test_cvar_of_zeros_and_ones_at_its_kink(self):
        """P(1) = 0.045 against a tail of 0.05: one sample in five has only ones in its tail, and none is sure of it."""
        random = np.random.default_rng(39)
        found = coverage(
            lambda x: estimates.cvar(x, 0.95, replicates=199),
            lambda: random.random(1000) < 0.045,
            0.9,
            repetitions=400,
        )
        assert 92 < found < 98.5

    def test_probability(self):
        n, p, random = 1000, 0.1, np.random.default_rng(34)
        every = [Count(k, n).probability() for k in range(n + 1)]
        exact = 100 * sum(stats.binom.pmf([k for k in range(n + 1) if every[k].low <= p <= every[k].high], n, p))
        assert 95 <= exact < 97
        found = coverage(lambda k: every[k], lambda: random.binomial(n, p), p)
        assert abs(found - exact) < 2

    @killed_by("uncertainty.sweep.statistics.sensitivity", " or n < MIN_CORRELATED_SAMPLES", "")
    @pytest.mark.parametrize("n", [4, 9, 10])
    def test_correlations_of_few_samples(self, n):
        """Pearson's of 10 cover 90 %; fewer have no interval."""
        random, rho = np.random.default_rng(44), 0.9
        pairs = [binormal(random, n, rho) for _ in range(300)]
        found = [sensitivity.correlations(x[:, None], y) for x, y in pairs]
        for kind, truth in (("pearson", rho), ("spearman", 6 / np.pi * math.asin(rho / 2))):
            ours = [getattr(one, kind)[0] for one in found]
            assert np.mean([one.low <= truth <= one.high for one in ours]) > 0.86
            assert {one.high - one.low == 2 for one in ours} == {n < 10}

    @pytest.mark.slow
    def test_correlations(self):
        random, rho = np.random.default_rng(35), 0.6
        pairs = [binormal(random, 300, rho) for _ in range(REPETITIONS)]
        found = [sensitivity.correlations(x[:, None], y) for x, y in pairs]
        for kind, truth in (("pearson", rho), ("spearman", 6 / np.pi * math.asin(rho / 2))):
            each = iter(getattr(one, kind)[0] for one in found)
            assert abs(coverage(lambda one: one, lambda each=each: next(each), truth) - 95) < 2

    @pytest.mark.slow
    def test_correlations_of_what_is_not_binormal(self):
        """y = (x - 1/4)^2 of uniform x. Spearman's by hand: the law of y is 2 sqrt(y), then 1/4 + sqrt(y)."""
        random = np.random.default_rng(36)
        samples = [random.random(300) for _ in range(REPETITIONS)]
        truths = (("pearson", 1 / 24 / math.sqrt(1 / 12 * 19 / 720)), ("spearman", 7 / 8))
        found = [sensitivity.correlations(x[:, None], (x - 0.25) ** 2) for x in samples]
        for kind, truth in truths:
            each = iter(getattr(one, kind)[0] for one in found)
            assert abs(coverage(lambda one: one, lambda each=each: next(each), truth) - 95) < 2

    @pytest.mark.slow
    def test_paired(self):
        """Differences of mean 0.2, median 0.2, and 34.5 % of them negative."""
        random = np.random.default_rng(37)

        def draw():
            b = random.exponential(size=400)
            return paired.compare_pairs(b + random.normal(0.2, 0.5, size=400), b)

        found = [draw() for _ in range(REPETITIONS)]
        for kind, truth in (("mean", 0.2), ("median", 0.2), ("less", stats.norm.cdf(-0.4))):
            each = iter(getattr(one, kind) for one in found)
            assert abs(coverage(lambda one: one, lambda each=each: next(each), truth) - 95) < 2

    def test_replicated(self):
        """Independent samples of one law in 8 replicates."""
        random, by = np.random.default_rng(38), Replicates(np.arange(160) % 8, 8)
        found = coverage(by.mean, lambda: random.normal(3.0, 2.0, size=160), 3.0)
        assert abs(found - 95) < 2

    @killed_by(
        "uncertainty.sweep.statistics.replicated",
        "value = len(x), np.quantile(ordered, level)",
        "value = len(x), ordered[-1]",
    )
    @pytest.mark.parametrize(
        "law",
        [
            pytest.param(stats.expon(), id="exponential"),
            pytest.param(stats.uniform(), id="uniform", marks=pytest.mark.slow),
            pytest.param(stats.norm(), id="normal", marks=pytest.mark.slow),
        ],
    )
    def test_replicates_of_stratified_samples(self, law):
        """Sobol' replicates in one dimension: one sample in each of 64 strata of equal probability. The mean of the
        quantiles of 16 replicates has intervals of 0 % coverage here."""
        random, by = np.random.default_rng(43), Replicates(np.repeat(np.arange(16), 64), 16)
        tail = law.ppf(0.95 + 0.05 * (np.arange(10**5) + 0.5) / 10**5).mean()

        def draw():
            return law.ppf((np.tile(np.arange(64), 16) + random.random(1024)) / 64)

        for level in (0.05, 0.5, 0.95):
            assert coverage(lambda x, level=level: by.quantile(x, level), draw, law.ppf(level), 200) >= 95
        assert coverage(lambda x: by.cvar(x, 0.95), draw, tail, 200) >= 88
        assert coverage(lambda x: by.probability(x > law.isf(0.05)), draw, 0.05, 200) >= 92


@killed_by("uncertainty.sweep.statistics.sensitivity", "if not varies(np.concatenate([fa, fb])):", "if False:")
@killed_by(
    "uncertainty.sweep.statistics.sensitivity", "outputs if varies(outputs) else np.zeros_like(outputs)", "outputs"
)
def test_rounding_has_no_sensitivities():
    """The error of a settled loop is a difference of numbers near 1: a few multiples of 2^-53."""
    random = np.random.default_rng(5)
    x, errors = random.normal(size=(200, 1)), (1 + 3e-16 * random.normal(size=(3, 200))) - 1
    assert 1 < len(np.unique(errors)) < 20
    indices = sensitivity.sobol_indices(errors[0], errors[1], errors[2:])
    found = sensitivity.correlations(x, errors[0])
    for estimate in (indices.first[0], indices.total[0], found.pearson[0], found.spearman[0]):
        assert math.isnan(estimate.value)
    # what is small but has all its digits, or counts something, varies
    for y in (1e-16 * x[:, 0], np.where(x[:, 0] > 0, 1.0, 0.0), 5e-7 * np.round(x[:, 0])):
        assert sensitivity.correlations(x, y).pearson[0].value > 0.7
