"""Rare events against known probabilities. Statistics are over written seeds, and each says what it expects."""

import numpy as np
import pytest
from marks import cases
from mutants import killed_by
from scipy.integrate import quad
from scipy.stats import binomtest, chi2, norm
from scipy.stats import t as student_t

from diffabs.uncertainty.reliability.importance_sampling import (
    CountedScore,
    ImportanceEstimate,
    Mixture,
    ProbabilityEstimate,
    design_points,
    fit_proposal,
    is_better_estimate,
    student_quantile,
)
from diffabs.uncertainty.reliability.subset_simulation import (
    SubsetReason,
    _advance_chains,
    _level_cov,
    _make_plan,
    _Population,
    _product_estimate,
    subset_simulation,
)

B6 = norm.isf(1e-6)


def linear(d):
    """P[score >= b] is that of one normal variable, in whatever direction; here one along no axis."""
    a = np.arange(1.0, d + 1)
    a /= np.linalg.norm(a)
    return lambda z: z @ a


def parabola(curvature):
    def score(z):
        return z[:, 0] + curvature * np.sum(z[:, 1:] ** 2, axis=1)

    def gradient(z):
        return score(z), np.concatenate([np.ones((len(z), 1)), 2 * curvature * z[:, 1:]], axis=1)

    return score, gradient


def parabola_probability(curvature, d, b):
    """One normal variable given the chi-square of the others."""
    return quad(lambda q: chi2.pdf(q, d - 1) * norm.sf(b - curvature * q), 0, 300, points=[1, 5, 20, 60], limit=500)[0]


def both_sides(z):
    return np.abs(z[:, 0])


def four_branches(z):
    """A series system: two curved branches across one diagonal, two straight ones across the other."""
    u, v = (z[:, 0] + z[:, 1]) / np.sqrt(2), (z[:, 0] - z[:, 1]) / np.sqrt(2)
    return np.max([np.abs(u) - 0.2 * v**2, np.abs(v) * np.sqrt(2) - 7 / np.sqrt(2) + 3], axis=0)


def four_branches_probability(b):
    edge = (b - 3) / np.sqrt(2) + 3.5  # beyond which |v| fails on its own
    curved = quad(lambda v: norm.pdf(v) * 2 * norm.sf(b + 0.2 * v**2), -edge, edge, points=[0.0])[0]
    return 2 * norm.sf(edge) + curved


def sphere(z):
    return np.sum(z**2, axis=1)


def steps(z):
    """Saturates at 5, and is 0 for half of all z and a multiple of a quarter for the others."""
    return np.floor(4 * np.clip(linear(z.shape[1])(z), 0.0, 5.0)) / 4


def runs(score, d, threshold, count, **options):
    return [subset_simulation(score, d, threshold, seed=seed, **options) for seed in range(count)]


def ratios(found, truth):
    return np.array([each.probability for each in found]) / truth


class TestKnown:
    """Within a factor of 1.5: of the seeds 0 to 199 all but one in d = 2 and 10, where importance sampling follows, and
    91 % where subset simulation stays alone, as in d = 100, so at least 6 of 10 with a probability of 0.999."""

    @pytest.mark.slow
    @killed_by("uncertainty.reliability.subset_simulation", "math.sqrt(1 - s**2) * z + s", "z + s")
    @killed_by("uncertainty.reliability.subset_simulation", "accepted = new >= value", "accepted = new >= -np.inf")
    @pytest.mark.parametrize("beta", [3.0, 4.75342, 5.19934])
    @pytest.mark.parametrize(("d", "least"), [(2, 10), (10, 10), (100, 6)])
    def test_a_half_space(self, d, least, beta):
        found = runs(linear(d), d, beta, 10)
        assert np.sum(np.abs(np.log(ratios(found, norm.sf(beta)))) <= np.log(1.5)) >= least
        levels = {3.0: 3, 4.75342: 6, 5.19934: 8}[beta]
        assert max(each.evaluations for each in found) <= 2800 + 2520 * (levels - 1) + 2000  # 17400 for 1e-6
        assert all(each.reason is SubsetReason.REACHED for each in found)

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("score", "d", "threshold", "truth"),
        [
            (sphere, 2, chi2.isf(1e-6, 2), 1e-6),
            (sphere, 10, chi2.isf(1e-6, 10), 1e-6),
            (parabola(0.05)[0], 10, B6, parabola_probability(0.05, 10, B6)),
            (parabola(-0.2)[0], 10, 3.0, parabola_probability(-0.2, 10, 3.0)),
            (both_sides, 10, norm.isf(5e-7), 1e-6),
            (four_branches, 2, 4.5, four_branches_probability(4.5)),
            (steps, 10, 4.75, norm.sf(4.75)),
        ],
        ids=["circle", "sphere", "parabola", "concave", "both sides", "four branches", "steps"],
    )
    def test_other_limits(self, score, d, threshold, truth):
        found = runs(score, d, threshold, 10)
        assert np.sum(np.abs(np.log(ratios(found, truth))) <= np.log(1.5)) >= 7
        assert sum(each.interval[0] <= truth <= each.interval[1] for each in found) >= 8

    def test_a_probability_that_one_level_counts(self):
        found = subset_simulation(linear(3), 3, 1.0, samples=10000)
        assert len(found.levels) == 1
        p = found.probability
        np.testing.assert_allclose(p, norm.sf(1.0), atol=4 * np.sqrt(0.16 * 0.84 / 1e4))
        np.testing.assert_allclose(found.cov, np.sqrt((1 - p) / (p * 10000)), rtol=1e-9)
        assert found.importance is None


class TestSubset:
    @pytest.mark.slow
    def test_the_estimate_is_unbiased_and_its_intervals_cover(self):
        # a bias of 1 to 2 % is expected at 2800 samples; the interval covers 95 % (measured: 94 to 96 %)
        truth = parabola_probability(0.05, 10, B6)
        found = runs(parabola(0.05)[0], 10, B6, 100, draws=0)
        ratio = ratios(found, truth)
        assert abs(np.mean(ratio) - 1) <= 0.02 + 2 * np.std(ratio) / 10
        assert sum(each.interval[0] <= truth <= each.interval[1] for each in found) >= 90
        foretold = np.sqrt(np.mean([each.cov**2 for each in found]))
        np.testing.assert_allclose(foretold, np.std(ratio), rtol=0.2)  # 100 seeds: 7 %; 3 levels fewer would be 40 %

    def test_the_probability_is_the_product_of_the_shares_counted(self):
        found = subset_simulation(lambda z: np.floor(linear(2)(z)), 2, 4.0, draws=0)
        shares = [level.share for level in found.levels]
        assert found.probability == pytest.approx(np.prod(shares), rel=1e-12)
        truth = [norm.sf(level.threshold) for level in found.levels]
        expected = np.array(truth) / np.array([1.0, *truth[:-1]])
        assert max(abs(share - 0.1) for share in expected) > 0.05  # the steps are nowhere near a tenth
        np.testing.assert_allclose(shares, expected, rtol=0.25)

    def test_more_than_half_at_one_score_is_no_obstacle(self):
        score = linear(2)
        found = runs(lambda z: np.maximum(score(z) - 1.8, 0.0), 2, B6 - 1.8, 10)
        assert np.sum(np.abs(np.log(ratios(found, 1e-6))) <= np.log(1.5)) == 10
        assert found[0].levels[0].share == pytest.approx(norm.sf(1.8), rel=0.3)
        assert found[0].levels[0].threshold > 0

    def test_all_or_nothing_is_counted(self):
        found = subset_simulation(lambda z: (linear(2)(z) >= 2.5).astype(float), 2, 1.0, samples=10000)
        assert [level.threshold for level in found.levels] == [1.0]
        assert found.probability == pytest.approx(norm.sf(2.5), rel=0.4)  # 62 of 10000: three standard deviations

    @killed_by(
        "uncertainty.reliability.subset_simulation",
        "if len(level_results) > 1 and hits.any() else plain",
        "if hits.any() else plain",
    )
    @pytest.mark.parametrize("truth", cases([0.9999, 0.9995, 0.999, 0.9, 0.3], 0.9995, 0.999, 0.3))
    def test_the_interval_of_one_level_is_that_of_a_count(self, truth):
        """At 0.9999 the log-normal interval covers the truth in 21 % of these seeds, at 0.9995 in 70 %."""
        found = runs(linear(2), 2, norm.isf(truth), 100)
        for each in found[:3]:
            count = round(each.probability * 2800)
            low, high = binomtest(count, 2800).proportion_ci(0.95, "exact")
            np.testing.assert_allclose(each.interval, (low, high), rtol=1e-9)
            assert each.interval == each.plain.interval
        assert sum(each.interval[0] <= truth <= each.interval[1] for each in found) >= 89  # of 100: 0.6 % for less

    @killed_by(
        "uncertainty.reliability.subset_simulation",
        "_product_estimate(level_results, last.family[hits]) if len(level_results) > 1 and hits.any() else plain",
        "_product_estimate(level_results, last.family) if len(level_results) > 1 else plain",
    )
    def test_without_a_failure_only_the_first_level_is_known(self):
        """Of 2800 plain samples none fails: P <= 1 - 0.025^(1/2800), whatever the later levels did not find."""
        flat, cut = (subset_simulation(lambda z, x=x: np.minimum(linear(2)(z), x), 2, 4.0) for x in (-9.0, 3.0))
        for found, levels in [(flat, 1), (cut, 4)]:
            assert found.reason is SubsetReason.PLATEAU
            assert len(found.levels) == levels
            assert np.isnan(found.probability)
            assert found.cov == np.inf
            np.testing.assert_allclose(found.interval, (0.0, 1 - 0.025 ** (1 / 2800)), rtol=1e-9)
            assert found.note.startswith("undecided: no sample failed")
            assert len(found.failing) == 0

    def test_a_region_that_no_level_leads_to_is_not_ruled_out(self):
        """No level of tanh z0 < 1 leads to z1 > 4.5, and the score 2 there is above the threshold."""
        found = runs(lambda z: np.maximum(np.tanh(z[:, 0]), 2.0 * (z[:, 1] > 4.5)), 2, 1.5, 5)
        for each in found:
            assert each.reason is SubsetReason.LEVELS
            assert np.isnan(each.probability)
            assert each.interval[0] <= norm.sf(4.5) <= each.interval[1]

    @killed_by(
        "uncertainty.reliability.subset_simulation",
        "note if subset is plain else f",
        "note if subset is not None else f",
    )
    @pytest.mark.slow
    def test_a_late_second_region_is_an_assumption_that_the_note_states(self):
        """The second region has a third of the failures but enters at a late level: the page on sweeps has figures."""
        truth = 1 - norm.cdf(4.0) * norm.cdf(3 + 3.5 / 3)
        found = runs(lambda z: np.maximum(z[:, 0] - 0.5, 3 * (z[:, 1] - 3.0)), 2, 3.5, 20)
        covered = sum(each.interval[0] <= truth <= each.interval[1] for each in found)
        assert covered < 16  # 11 are expected: should it ever cover, the statement is out of date
        for each in found:
            count = round(2800 * np.nan_to_num(each.plain.probability))  # 0.13 are expected
            low, high = binomtest(count, 2800).proportion_ci(0.95, "exact")
            np.testing.assert_allclose(each.plain.interval, (low, high), rtol=1e-9)
            assert low <= truth <= high
            assert "the interval assumes that the chains entered every failure region" in each.note
            assert f"without this assumption it is {low:.3g} to {high:.3g}" in each.note

    def test_exhausted_levels_end_undecided_or_with_a_count(self):
        none = subset_simulation(linear(2), 2, B6, levels=3)
        assert none.reason is SubsetReason.LEVELS
        assert len(none.levels) == 3
        assert np.isnan(none.probability)
        assert none.interval == none.plain.interval
        few = subset_simulation(linear(2), 2, norm.isf(4e-4), levels=3, draws=0)
        assert few.reason is SubsetReason.LEVELS
        assert few.interval[0] < 4e-4 < few.interval[1]

    def test_chains_accept_as_often_as_they_should(self):
        for d in (2, 100):
            found = subset_simulation(linear(d), d, B6, draws=0)
            np.testing.assert_allclose([level.acceptance for level in found.levels[2:]], 0.44, atol=0.08)
            assert found.levels[0].acceptance == 1.0
            spreads = [level.spread for level in found.levels[1:]]
            assert spreads == sorted(spreads, reverse=True)

    def test_diverged_runs_are_counted_and_do_not_fail(self):
        lost = []

        def score(z):
            values = linear(2)(z)
            values[values > 3.7] = np.nan
            lost.append(np.sum(np.isnan(values)))
            return values

        found = subset_simulation(score, 2, 3.5, draws=0, tolerated=0.5)
        assert found.diverged == sum(lost) > 0
        assert found.diverged == sum(level.diverged for level in found.levels)
        truth = norm.sf(3.5) - norm.sf(3.7)
        assert found.interval[0] < truth < found.interval[1]
        assert np.all(linear(2)(found.failing) <= 3.7)
        with pytest.raises(ValueError, match=r"\d+ of 2520 runs diverged: .*\+inf"):
            subset_simulation(score, 2, 3.65, draws=0, tolerated=0.02)
        infinite = runs(lambda z: np.nan_to_num(score(z), nan=np.inf), 2, 3.5, 3)
        assert all(each.interval[0] < norm.sf(3.5) < each.interval[1] for each in infinite)

    def test_same_seed_same_numbers_and_few_large_calls(self):
        sizes, seen = [], []

        def score(z):
            sizes.append(len(z))
            return linear(10)(z)

        found = subset_simulation(score, 10, B6, seed=3, progress=seen.append)
        again = subset_simulation(linear(10), 10, B6, seed=3)
        assert (found.probability, found.interval, found.levels) == (again.probability, again.interval, again.levels)
        assert found.probability != subset_simulation(linear(10), 10, B6, seed=4).probability
        steps_made = 9 * (len(found.levels) - 1)
        assert sizes == [2800] + steps_made * [280] + [2000]
        assert found.evaluations == sum(sizes) == found.cost
        assert [each.level for each in seen] == list(range(1, len(found.levels) + 1))
        assert [each.threshold for each in seen] == [level.threshold for level in found.levels]
        assert seen[-1].threshold == B6
        assert seen[0].evaluations == 2800

    def test_failures_can_be_replayed(self):
        found = subset_simulation(linear(10), 10, B6)
        assert found.failing.shape == (100, 10)
        assert np.all(linear(10)(found.failing) >= B6)
        assert len(np.unique(found.failing, axis=0)) == 100
        assert np.all(np.diff(np.sum(found.failing**2, axis=1)) >= 0)

    @killed_by("uncertainty.reliability.subset_simulation", "(1 + max(0.0, excess))", "1.0")
    def test_covariance_of_chains(self):
        rng = np.random.default_rng(0)
        frozen = np.tile(rng.random(400) < 0.2, (10, 1))
        p = np.mean(frozen)
        np.testing.assert_allclose(_level_cov(frozen), np.sqrt((1 - p) / (p * 400)), rtol=1e-9)
        free = rng.random((10, 4000)) < 0.2
        np.testing.assert_allclose(_level_cov(free), np.sqrt(0.8 / (0.2 * 40000)), rtol=0.05)
        assert _level_cov(np.ones((3, 4), bool)) == 0.0

    def test_chains_that_accept_nothing(self):
        """Ten copies of each seed: the variance is that of the seeds alone, and each copy knows its ancestor."""
        first = []

        def score(z):
            first.append(len(z))
            return linear(2)(z) if len(first) == 1 else np.full(len(z), -9.0)

        found = subset_simulation(score, 2, 2.0, draws=0)
        p = found.levels[1].share
        np.testing.assert_allclose(found.levels[1].cov, np.sqrt((1 - p) / (p * 280)), rtol=1e-9)
        z = np.random.default_rng(0).standard_normal((100, 2))
        old = _Population(z, z[:, 0], np.arange(100), 1, 1.0, 0.6, 0)
        runs = CountedScore(lambda z: np.full(len(z), -9.0), None, 0.1)
        new = _advance_chains(runs, old, z[:, 0] > 1, 1.0, _make_plan(2, 3.0, 100, 0.1, 9, 0), np.random.default_rng(1))
        np.testing.assert_array_equal(new.z, z[new.family])
        assert len(new.z) == 100
        assert len(np.unique(new.family)) == 10

    def test_the_variance_lies_between_its_two_bounds(self):
        level = subset_simulation(linear(2), 2, 1.0, draws=0).levels[0]
        levels = [level._replace(cov=0.1, share=0.1), level._replace(cov=0.2, share=0.1)]
        for count, cov in [(1, 0.3), (16, 0.25), (1000, np.sqrt(0.05))]:
            found = _product_estimate(levels, np.repeat(np.arange(count), 5))
            np.testing.assert_allclose((found.probability, found.cov), (0.01, cov), rtol=1e-6)
        middle = np.sqrt(found.interval[0] * found.interval[1])
        np.testing.assert_allclose(middle, 0.01 * np.sqrt(1.05), rtol=1e-9)
        reach = student_t.ppf(0.975, 20) * np.sqrt(np.log(1.05))
        np.testing.assert_allclose(np.log(found.interval[1] / middle), reach, rtol=1e-3)


class TestImportance:
    @pytest.mark.parametrize("d", [1, 2, 7])
    def test_weights_are_a_density_ratio(self, d):
        rng = np.random.default_rng(1)
        mixture = Mixture(rng.standard_normal((3, d)), np.array([0.2, 0.3, 0.5]), np.array([0.8, 1.0, 1.5]))
        z = mixture.draw(200000, rng)
        weight = np.exp(mixture.log_weight(z))
        assert abs(np.mean(weight) - 1) <= 4 * np.std(weight) / np.sqrt(len(z))
        second = np.mean(weight[:, None] * z**2, axis=0)  # of a standard normal
        error = np.std(weight[:, None] * z**2, axis=0) / np.sqrt(len(z))
        assert np.all(np.abs(second - 1) <= 4 * error)

    @killed_by("uncertainty.reliability.importance_sampling", "np.exp(mixture.log_weight(z)), 0.0)", "1e-6, 0.0)")
    def test_failures_foretell_the_variance(self):
        found = runs(linear(10), 10, B6, 20)
        foretold = np.array([each.importance.predicted_cov for each in found])
        actual = np.array([each.importance.estimate.cov for each in found])
        assert np.median(np.abs(np.log(actual / foretold))) < 0.2
        np.testing.assert_allclose(np.std(ratios(found, 1e-6)), np.median(actual), rtol=0.5)
        assert all(each.importance.effective_samples > 100 for each in found)
        assert np.all(actual >= foretold)
        assert all(each.note.startswith("importance") and each.probability != each.subset.probability for each in found)

    def test_a_mixture_that_misses_failures_foretells_that(self):
        rng = np.random.default_rng(2)
        z = rng.standard_normal((400, 5))
        z[:, 0] = np.where(np.arange(400) < 380, 4.5, -4.5) + 0.2 * z[:, 0]
        one = np.array([[4.5, 0, 0, 0, 0]])
        mixture, moment = fit_proposal(z, np.arange(400), 4e-6, one)
        assert len(mixture.centres) > 1
        assert moment < np.log(100)
        assert Mixture(one, np.ones(1), np.ones(1)).log_weight(z).max() > np.log(1e6)

    @killed_by(
        "uncertainty.reliability.importance_sampling",
        "return below <= MAX_DEVIATIONS_APART",
        "return True or below <= MAX_DEVIATIONS_APART",
    )
    def test_one_that_is_far_too_low_is_not_believed(self):
        subset = ProbabilityEstimate(1e-6, 0.2, (0.6e-6, 1.6e-6))
        for factor, believed in [(1.0, True), (0.7, True), (0.3, False), (3.0, True)]:
            made = ImportanceEstimate(ProbabilityEstimate(factor * 1e-6, 0.05, (0, 1)), 400.0, 0.05, np.zeros((1, 2)))
            assert is_better_estimate(made, subset) is believed
        assert not is_better_estimate(made._replace(estimate=ProbabilityEstimate(1e-6, 0.25, (0, 1))), subset)
        assert not is_better_estimate(made._replace(estimate=ProbabilityEstimate(0.0, np.inf, (0, 1))), subset)

    @pytest.mark.parametrize("degrees", [4, 10, 40, 1e9])
    def test_quantiles_are_those_of_scipy(self, degrees):
        np.testing.assert_allclose(
            student_quantile(degrees), student_t.ppf(0.975, degrees), rtol=0.02 if degrees < 9 else 2e-3
        )


def of_linear(d):
    score = linear(d)
    a = score(np.eye(d))
    return lambda z: (score(z), np.tile(a, (len(z), 1)))


def of_both_sides(z):
    return both_sides(z), np.sign(z[:, :1]) * np.eye(1, z.shape[1])


class TestGradient:
    @killed_by(
        "uncertainty.reliability.importance_sampling",
        "np.sum(slope * z, axis=1) + threshold - score",
        "np.sum(slope * z, axis=1) - score",
    )
    def test_design_points_of_a_half_space_and_of_two(self):
        rng = np.random.default_rng(0)
        starts = 6 * rng.standard_normal((8, 100))
        found = design_points(of_linear(100), starts, 4.0)
        np.testing.assert_allclose(found, [4.0 * linear(100)(np.eye(100))], atol=0.05)
        two = design_points(of_both_sides, starts, 4.0)
        np.testing.assert_allclose(two[np.argsort(two[:, 0]), 0], [-4.0, 4.0], atol=0.05)
        np.testing.assert_allclose(two[:, 1:], 0.0, atol=0.05)

    def test_a_design_point_of_a_curved_limit(self):
        def gradient(z):
            x, y = z.T
            return x * y**3, np.stack([y**3, 3 * x * y**2], axis=1)

        found = design_points(gradient, np.array([[2.0, 4.0], [5.0, 2.0], [1.0, 6.0]]), 20.0)
        x = (20 / 3**1.5) ** 0.25  # |z| is least where y^2 = 3 x^2
        np.testing.assert_allclose(found, [[x, np.sqrt(3) * x]], atol=0.05)

    def test_plateaus_jumps_and_diverged_gradients_do_no_harm(self):
        def gradient(z):
            assert np.all(np.isfinite(z))
            score, slope = of_linear(20)(z)
            slope[score > 6.0] = 0.0
            slope[(score > 5.0) & (score < 5.5)] = np.nan
            score[(score > 5.5) & (score < 6.0)] = np.inf
            return np.where(score < B6, np.nan, score), slope

        starts = np.array([[5.2], [5.7], [6.2], [4.9]]) * linear(20)(np.eye(20))
        found = design_points(gradient, starts, B6)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1)[0], B6, atol=0.1)
        found = runs(linear(20), 20, B6, 5, gradient=gradient)
        assert np.all(np.abs(np.log(ratios(found, 1e-6))) < np.log(1.5))

    @pytest.mark.slow
    def test_it_pays_in_many_dimensions(self):
        """Variance times price, without a gradient to with one: 17 for seeds 0 to 199."""
        plain, informed = (runs(linear(100), 100, B6, 20, gradient=g) for g in (None, of_linear(100)))
        assert _price(plain) / _price(informed) > 6
        assert all(each.gradients > 0 and each.cost == each.evaluations + 3 * each.gradients for each in informed)
        assert all(each.subset.probability == other.probability for each, other in zip(informed, plain, strict=True))
        truth = [each.interval[0] <= 1e-6 <= each.interval[1] for each in informed]
        assert sum(truth) >= 17
        doubled = runs(linear(100), 100, B6, 1, gradient=of_linear(100), price=6.0)[0]
        assert doubled.cost == informed[0].cost + 3 * informed[0].gradients

    @pytest.mark.slow
    def test_it_pays_for_curved_limits_and_for_two_regions(self):
        """Against subset simulation alone: 10 and 20 for seeds 0 to 199."""
        score, gradient = parabola(0.05)
        for f, g, b, least in [(score, gradient, B6, 4), (both_sides, of_both_sides, norm.isf(5e-7), 6)]:
            plain, informed = runs(f, 10, b, 20, draws=0), runs(f, 10, b, 20, gradient=g)
            assert _price(plain) / _price(informed) > least

    def test_it_does_not_help_on_a_sphere_and_says_so(self):
        def gradient(z):
            return sphere(z), 2 * z

        threshold = chi2.isf(1e-6, 10)
        found = subset_simulation(sphere, 10, threshold, gradient=gradient)
        plain = subset_simulation(sphere, 10, threshold, draws=0)
        assert found.importance is None
        assert found.note.startswith("subset simulation: ")
        assert (found.probability, found.interval) == (plain.probability, plain.interval)


def _price(found):
    """Variance of log P, times runs."""
    return np.var([np.log(each.probability) for each in found]) * np.mean([each.cost for each in found])


class TestErrors:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"dimension": 0}, r"dimension = 0 is outside \[1, inf\)"),
            ({"dimension": True}, r"dimension = True is no integer; an integer in \[1, inf\) is needed"),
            ({"threshold": np.nan}, r"threshold = nan is outside \(-inf, inf\)"),
            ({"threshold": np.inf}, r"threshold = inf is outside \(-inf, inf\)"),
            ({"threshold": "0.9"}, r"threshold = '0.9' is text; a number in \(-inf, inf\) is needed"),
            ({"threshold": [1.0, 2.0]}, r"threshold = \[1.0, 2.0\] is no single number"),
            ({"samples": 2800.0}, r"samples = 2800.0 is no integer; an integer in \[4, inf\) is needed"),
            ({"samples": 10**9}, "samples = 1000000000 need too much memory: at most 25000000 with 2 coordinates"),
            ({"draws": 10**9}, "draws = 1000000000 need too much memory"),
            ({"share": np.nan}, r"share = nan is outside"),
            ({"samples": 10}, "at least 2 that divides samples, not 10\\*0.1"),
            ({"samples": 2805}, "integer of at least 2 that divides samples, not 2805\\*0.1"),
            ({"share": 0.3}, "integer of at least 2 that divides samples, not 2800\\*0.3"),
            ({"share": 0.1001}, "integer of at least 2 that divides samples, not 2800\\*0.1001"),
            ({"share": 1.0}, "divides samples, not 2800\\*1.0"),
            ({"levels": 0}, r"levels = 0 is outside \[1, inf\)"),
            ({"levels": 2.5}, "levels = 2.5 is no integer"),
            ({"draws": -5}, r"draws = -5 is outside \[0, inf\)"),
            ({"draws": 1}, r"draws = 1 is outside \[2, inf\), and not 0"),
            ({"score": lambda z: z}, r"the score of \(2800, 2\) must be \(2800,\), not \(2800, 2\)"),
            ({"gradient": lambda z: (z[:, 0], z[:, 0])}, r"the derivative of the score of \(8, 2\) must be \(8, 2\)"),
        ],
    )
    def test_in_one_line(self, change, message):
        arguments = {"score": linear(2), "dimension": 2, "threshold": 3.0} | change
        with pytest.raises(ValueError, match=message) as caught:
            subset_simulation(**arguments)
        assert "\n" not in str(caught.value)
