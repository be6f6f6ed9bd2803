"""Sampling: quantile functions and designs against SciPy's, chunks against the whole, dependence against theory."""

import itertools
import json
import math
import tomllib

import jax
import numpy as np
import pytest
from marks import readable_id
from mutants import killed_by
from scipy import stats
from scipy.special import ndtri
from scipy.stats import qmc
from seams import replace_seam

from diffabs.core.pytree import ParameterSpec
from diffabs.host.values import as_plain
from diffabs.scenario.toml import write_toml
from diffabs.uncertainty.sweep import distributions, sampling
from diffabs.uncertainty.sweep import variables as space
from diffabs.uncertainty.sweep.distributions import (
    Categorical,
    Empirical,
    LogNormal,
    Normal,
    Triangular,
    Uniform,
    describe_out_of_range,
)
from diffabs.uncertainty.sweep.sampling import Corners, Grid, LatinHypercube, Random, Saltelli, Sobol
from diffabs.uncertainty.sweep.variables import Correlation, Rows, Space

MASS = ParameterSpec("kg", 0, open_low=True)
NUMBERS = "numbers of type float, or texts, are needed"
HINT = "; truncate it with low and high"
SAMPLE = (3.0, -1.0, 2.0, 2.0, 7.5)
CONTINUOUS = {
    "uniform": (Uniform(-2.0, 3.0), stats.uniform(-2, 5)),
    "normal": (Normal(5.75, 0.3), stats.norm(5.75, 0.3)),
    "truncated": (Normal(1.0, 2.0, -1.0, 4.0), stats.truncnorm(-1, 1.5, 1, 2)),
    "one-sided": (Normal(1.0, 2.0, low=0.0), stats.truncnorm(-0.5, np.inf, 1, 2)),
    "log-normal": (LogNormal(1.5, 0.2), stats.lognorm(0.2, scale=1.5)),
    "triangular": (Triangular(1.0, 1.5, 4.0), stats.triang(1 / 6, 1, 3)),
    "left corner": (Triangular(1.0, 1.0, 4.0), stats.triang(0, 1, 3)),
    "right corner": (Triangular(1.0, 4.0, 4.0), stats.triang(1, 1, 3)),
}
FIVE = {
    "a": Uniform(0.0, 1.0),
    "b": Normal(5.75, 0.3, 5.0, 6.5),
    "c": LogNormal(1.0, 0.2, 0.5, 2.0),
    "d": Triangular(0.0, 1.0, 3.0),
    "e": Categorical(("dry", "wet", "snow"), (1.0, 1.0, 2.0)),
}
PAIR = Correlation(("c", "a"), ((1.0, 0.6), (0.6, 1.0)))
DESIGNS = {
    "random": (Random(), 1000),
    "sobol": (Sobol(), 1000),
    "replicates": (Sobol(4), 1000),
    "latin": (LatinHypercube(), 1000),
    "grid": (Grid(5), 5**4 * 3),
    "saltelli": (Saltelli(), 7 * 143),
}


# Mirrored at 0, for the upper tail: SciPy's own quantiles lose digits there, except these of the normal distributions.
MIRRORED = {
    "uniform": stats.uniform(-3, 5),
    "truncated": stats.truncnorm(-1.5, 1, -1, 2),
    "one-sided": stats.truncnorm(-np.inf, 0.5, -1, 2),
    "triangular": stats.triang(5 / 6, -4, 3),
    "left corner": stats.triang(1, -4, 3),
    "right corner": stats.triang(0, -4, 3),
}


def quantile(case, p, q):
    """SciPy's at p = 1 - q, by the smaller."""
    theirs = CONTINUOUS[case][1]
    above = -MIRRORED[case].ppf(q) if case in MIRRORED else theirs.isf(q)
    return np.where(p < q, theirs.ppf(p), above)


@killed_by(
    "uncertainty.sweep.distributions",
    "p * width * rise), self.high - np.sqrt(q * width * fall)",
    "p * width * fall), self.high - np.sqrt(q * width * rise)",
)
@pytest.mark.parametrize("case", CONTINUOUS)
def test_quantiles_are_scipys(case):
    """To rounding: of quantities of size 1 next to where a quantile crosses zero."""
    u = np.concatenate([np.logspace(-15, -1, 57), np.linspace(0.1, 0.9, 41), 1 - np.logspace(-1, -7, 25)])
    found = CONTINUOUS[case][0].value(u.reshape(3, 41))
    assert found.shape == (3, 41)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found.ravel(), quantile(case, u, 1 - u), rtol=1e-12, atol=1e-15)


@killed_by(
    "uncertainty.sweep.distributions", "return self._at(ndtr(z), ndtr(-np.asarray(z)))", "return self.value(ndtr(z))"
)
@pytest.mark.parametrize("case", CONTINUOUS)
def test_both_tails_of_normal_coordinates_keep_their_digits(case):
    """Twelve digits of Phi(7) are nines, those of Phi(-7) are all there."""
    z = np.array([-9.0, -8.0, -7.0, -6.0, -2.0, -0.3, 0.3, 2.0, 6.0, 7.0, 8.0, 9.0])
    expected = quantile(case, stats.norm.cdf(z), stats.norm.sf(z))
    np.testing.assert_allclose(CONTINUOUS[case][0].from_normal(z), expected, rtol=1e-12, atol=1e-15)


def test_the_last_digits_next_to_an_end_at_zero():
    """With its end at 0, a value is its distance from the end, and rounding hides nothing."""
    z = np.array([6.0, 7.0, 8.0, 20.0])
    tail = stats.norm.sf(z)
    np.testing.assert_allclose(Uniform(-1.0, 0.0).from_normal(z), -tail, rtol=1e-12)
    np.testing.assert_allclose(Uniform(0.0, 1.0).from_normal(-z), tail, rtol=1e-12)
    np.testing.assert_allclose(Triangular(-1.0, -0.5, 0.0).from_normal(z), -np.sqrt(tail / 2), rtol=1e-12)
    np.testing.assert_allclose(Triangular(0.0, 0.5, 1.0).from_normal(-z), np.sqrt(tail / 2), rtol=1e-12)
    assert Normal(0.0, 2.0).from_normal(40.0) == 80.0
    np.testing.assert_allclose(LogNormal(2.0, 0.5).from_normal(40.0), 2 * math.exp(20.0), rtol=1e-12)


@pytest.mark.parametrize("end", [8.0, 20.0, 36.0])
def test_what_a_limit_leaves_of_a_far_tail(end):
    """Beyond `end` deviations: z with sf(z) = (1 - u) sf(end), by SciPy's inverse survival function."""
    u = np.array([1e-9, 0.1, 0.5, 0.9, 1 - 2.0**-40])
    right = stats.norm.isf((1 - u) * stats.norm.sf(end))
    np.testing.assert_allclose(Normal(0.0, 1.0, low=end).value(u), right, rtol=1e-13)
    np.testing.assert_allclose(Normal(0.0, 1.0, high=-end).value(1 - u), -right, rtol=1e-13)
    np.testing.assert_allclose(LogNormal(1.0, 0.1, low=math.exp(end / 10)).value(u), np.exp(right / 10), rtol=1e-12)
    left = LogNormal(1.0, 0.1, high=math.exp(-end / 10)).value(1 - u)
    np.testing.assert_allclose(left, np.exp(-right / 10), rtol=1e-12)


@pytest.mark.parametrize("case", CONTINUOUS)
def test_u_of_0_and_1_are_the_ends_of_the_support(case):
    ours, theirs = CONTINUOUS[case]
    np.testing.assert_allclose(ours.value([0.0, 1.0]), ours.support(), rtol=1e-15)
    np.testing.assert_allclose(ours.support(), theirs.support(), rtol=1e-15)


@pytest.mark.parametrize("low", [0.1, -0.3, 1e6 / 3])
def test_rounding_does_not_leave_the_support(low):
    u = np.nextafter(1.0, 0) - np.linspace(0, 1, 1001) ** 8
    high = low + 1e-9 * abs(low)
    for ours in (Uniform(low, high), Normal(low, 1.0, low, high), Triangular(low, high, high)):
        values = ours.value(np.clip(u, 0, 1))
        assert ((values >= low) & (values <= high)).all()


@killed_by("uncertainty.sweep.discrete", "np.ones(self.size) if self.weights is None", "np.ones(self.size) if True")
def test_choices_come_by_weight():
    """u below F(k), so the edges belong to the next choice; the last includes u = 1."""
    ours = Categorical(("dry", "wet", "snow"), (1.0, 1.0, 2.0))
    u = [0.0, 0.2499, 0.25, 0.4999, 0.5, 0.99, 1.0]
    assert ours.index(u).tolist() == [0, 0, 1, 1, 2, 2, 2]
    assert ours.value(u).tolist() == ["dry", "dry", "wet", "wet", "snow", "snow", "snow"]
    assert ours.from_normal([-3.0, 0.1, 3.0]).tolist() == ["dry", "snow", "snow"]
    numbers = Categorical((5, 6.5))
    assert numbers.value(np.array([[0.0, 0.49], [0.5, 1.0]])).tolist() == [[5.0, 5.0], [6.5, 6.5]]
    assert numbers.value(0.3).dtype == np.float64
    assert numbers.support() == (5.0, 6.5)
    assert ours.support() == (0.0, 2.0)
    assert ours.index(ours.middles()).tolist() == [0, 1, 2]


def test_a_sample_is_drawn_again():
    """The k-th smallest of n for u in ((k - 1)/n, k/n]; interpolated, SciPy's order statistics in between."""
    u = np.linspace(0.001, 0.999, 998)
    again = np.sort(SAMPLE)[np.ceil(u * 5).astype(int) - 1]
    np.testing.assert_array_equal(Empirical(SAMPLE).value(u), again)
    np.testing.assert_array_equal(Empirical(SAMPLE).from_normal(ndtri(u)), again)
    between = np.interp(u, np.linspace(0, 1, 5), np.sort(SAMPLE))
    np.testing.assert_allclose(Empirical(SAMPLE, True).value(u), between, rtol=1e-13)
    assert Empirical(SAMPLE).support() == (-1.0, 7.5)
    assert Empirical(SAMPLE).value([0.0, 1.0]).tolist() == [-1.0, 7.5]


@pytest.mark.parametrize("design", [Random(), Sobol(), LatinHypercube()], ids=readable_id)
def test_draws_are_distributed_as_scipy_says(design):
    """Kolmogorov-Smirnov at 1 in 1000, mean and deviation within 4.5 standard errors; the seed is fixed."""
    n = 2**14
    drawn = Space({name: ours for name, (ours, _) in CONTINUOUS.items()}, None, design).draw(3, 0, n, n)
    for name, (_, theirs) in CONTINUOUS.items():
        values = drawn[name]
        assert stats.kstest(values, theirs.cdf).pvalue > 1e-3, name
        deviation = theirs.std()
        assert abs(values.mean() - theirs.mean()) < 4.5 * deviation / math.sqrt(n), name
        fourth = float(theirs.stats("k")) + 3
        assert abs(values.var() / deviation**2 - 1) < 4.5 * math.sqrt((fourth - 1) / n), name
    independent = np.corrcoef([drawn[name] for name in CONTINUOUS]) - np.eye(len(CONTINUOUS))
    assert np.abs(independent).max() < 4.5 / math.sqrt(n)


@killed_by("uncertainty.sweep.sampling", "numbers = start + jax", "numbers = 0 * start + jax", case="random")
@killed_by(
    "uncertainty.sweep.sampling",
    "_hypercube_points(seed, samples, dimension)[start:stop]",
    "_hypercube_points(seed, stop - start, dimension)",
    case="latin",
)
@pytest.mark.parametrize("case", DESIGNS)
def test_chunks_make_the_whole_bit_for_bit(case):
    """Also correlated ones; a chunk of one; chunks across replicates and rows of the design."""
    design, samples = DESIGNS[case]
    copula = None if isinstance(design, Grid | Saltelli) else PAIR
    ours = Space(FIVE, copula, design)
    whole = ours.draw(7, 0, samples, samples)
    edges = [0, 1, 8, 249, 250, 377, 378, 751, samples, samples]
    parts = [ours.draw(7, start, stop, samples) for start, stop in itertools.pairwise(edges)]
    for path, column in whole.items():
        assert len(column) == samples
        np.testing.assert_array_equal(np.concatenate([part[path] for part in parts]), column)


@killed_by(
    "uncertainty.sweep.sampling",
    "_random_words(_check_seed(seed)",
    "_random_words(_check_seed(0 * seed)",
    case="random",
)
@pytest.mark.parametrize("case", DESIGNS)
def test_the_seed_decides(case):
    design, samples = DESIGNS[case]
    first, again, other = (Space(FIVE, None, design).draw(seed, 5, 25, samples)["a"] for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert (first == other).all() == (case == "grid")


def test_random_samples_are_keys_folded_with_their_number():
    """Two words of 32 bits make 52, of which the value is the middle; the number of the sample is all it takes."""
    keys = [jax.random.fold_in(jax.random.key(5), i) for i in (70, 71)]
    words = [np.asarray(jax.random.bits(key, (3, 2), np.uint32)) for key in keys]
    expected = [[((int(w) << 20 | int(v) >> 12) + 0.5) / 2**52 for w, v in row] for row in words]
    np.testing.assert_array_equal(Random().unit(5, 70, 72, 3, 10**6), expected)
    np.testing.assert_array_equal(Random().unit(5, 70, 72, 3, 72), expected)


@pytest.mark.parametrize("word", [0, 2**32 - 1])
def test_random_numbers_stay_inside_the_open_interval(monkeypatch, word):
    """The extreme words, which nobody lives to see drawn."""
    replace_seam(monkeypatch, "random_words", lambda *_: np.full((1, 2, 2), word, np.uint32))
    u = Random().unit(0, 0, 1, 2, 1)
    assert ((u > 0) & (u < 1)).all()
    np.testing.assert_array_equal(np.minimum(u, 1 - u), 2.0**-53)


def test_draws_do_not_depend_on_precision_and_compile_once():
    large = 2**32 - 1
    expected = Random().unit(large, 4_000_000_000, 4_000_000_017, 2, large)
    with jax.enable_x64(False):
        np.testing.assert_array_equal(Random().unit(large, 4_000_000_000, 4_000_000_017, 2, large), expected)
    compiled = sampling._random_words._cache_size()
    Random().unit(3, 17, 34, 2, 100)
    Random().unit(4, 34, 51, 2, 200)
    assert sampling._random_words._cache_size() == compiled


@killed_by("uncertainty.sweep.sampling", "spawn_key=(stream,)", "spawn_key=(0 * stream,)")
def test_sobol_replicates_are_scipys():
    """Generated at once, each with a stream of its own; odd multiples of 2^-33, so never 0."""
    found = Sobol(4).unit(9, 0, 1024, 3, 1024)
    for r, block in enumerate(np.split(found, 4)):
        stream = np.random.default_rng(np.random.SeedSequence(9, spawn_key=(r,)))
        np.testing.assert_array_equal(block - 2.0**-33, qmc.Sobol(3, bits=32, rng=stream).random_base2(8))
    assert (found * 2.0**33 % 2 == 1).all()
    # Balanced: each replicate has one point in each of 256 strata of each variable.
    for block in np.split(found, 4):
        np.testing.assert_array_equal(np.sort(np.floor(block * 256), axis=0), np.tile(np.arange(256.0)[:, None], 3))


def test_sobol_is_far_closer_than_random():
    """Mean of exp(u1 + u2), (e - 1)^2: the error of 2^12 points is below 1e-3 of the standard error of random ones."""
    exact = (math.e - 1) ** 2
    errors = [
        abs(np.exp(design.unit(1, 0, 2**12, 2, 2**12).sum(1)).mean() / exact - 1) for design in (Sobol(), Random())
    ]
    assert errors[0] < 1e-4 < errors[1]


def test_sobol_starts_anywhere():
    """Nearly ten millions in: any 256 points that begin at a multiple of 256 have one in each of 256 strata, and no
    others would."""
    start = 39_000 * 256
    found = Sobol().unit(2, start, start + 256, 5, 10_000_000)
    np.testing.assert_array_equal(np.sort(np.floor(found * 256), axis=0), np.tile(np.arange(256.0)[:, None], 5))


def test_a_latin_hypercube_has_one_sample_in_each_stratum():
    n = 500
    found = LatinHypercube().unit(4, 0, n, 3, n)
    np.testing.assert_array_equal(np.sort(np.floor(found * n), axis=0), np.tile(np.arange(n)[:, None], 3))
    assert abs(np.corrcoef(found.T) - np.eye(3)).max() < 4.5 / math.sqrt(n)
    assert not np.array_equal(found, LatinHypercube().unit(5, 0, n, 3, n))


def test_a_hypercube_stays_inside_the_open_interval(monkeypatch):
    monkeypatch.setattr(qmc.LatinHypercube, "random", lambda self, n: np.tile([[0.0], [1.0]], (n // 2, self.d)))
    u = LatinHypercube().unit(123456, 0, 4, 2, 4)
    assert ((u > 0) & (u < 1)).all()


def test_a_grid_is_complete():
    """Every combination once, the last variable fastest; each choice and row once, however unlikely."""
    rows = Rows({"x": [1.0, 2.0], "y": [3.0, 4.0]}, [1.0, 9.0])
    ours = Space(
        {
            "m": Uniform(5.0, 6.0),
            "road": Categorical(("dry", "wet", "snow"), (1.0, 1.0, 98.0)),
            "rows": rows,
            "t": Uniform(0, 1),
        },
        design=Grid({"m": 3, "t": (0.25, 0.5)}),
    )
    assert ours.check() == ours.check(36) == 36
    found = ours.draw(0, 0, 36, 36)
    assert ours.paths == tuple(found) == ("m", "road", "x", "y", "t")
    assert list(zip(*(found[path] for path in ours.paths), strict=True)) == [
        (m, road, x, y, t)
        for m in (5.0, 5.5, 6.0)
        for road in ("dry", "wet", "snow")
        for x, y in ((1.0, 3.0), (2.0, 4.0))
        for t in (0.25, 0.5)
    ]
    assert Grid(3).unit(0, 2, 4, 2, 9).tolist() == [[0.0, 1.0], [0.5, 0.0]]


@killed_by("uncertainty.sweep.sampling", "places * (1 / (levels - 1))", "places / levels")
def test_a_grid_needs_no_memory_for_its_levels():
    """Those of NumPy, to the bit; and the last of a number that no list could have."""
    for n in (2, 3, 50, 12_345):
        np.testing.assert_array_equal(Grid(n).unit(0, 0, n, 1, n)[:, 0], np.linspace(0, 1, n))
    n = 2**32 - 1
    ours = Space({"a": Uniform(0.0, 1.0)}, design=Grid(n))
    assert ours.check() == n
    assert ours.draw(0, n - 2, n, n)["a"].tolist() == [(n - 2) / (n - 1), 1.0]


def test_corners_are_complete():
    variables = {"a": Uniform(1, 2), "b": Normal(0, 1, -3.0, 3.0), "c": Empirical(SAMPLE), "d": Categorical((4.0, 8.0))}
    ours = Space(variables, design=Corners())
    assert ours.check() == 16
    found = list(zip(*ours.draw(0, 0, 16, 16).values(), strict=True))
    assert found == list(itertools.product((1.0, 2.0), (-3.0, 3.0), (-1.0, 7.5), (4.0, 8.0)))


@killed_by("uncertainty.sweep.sampling", "np.where(from_b, b, a)", "np.where(from_b, a, b)")
def test_saltelli_rows_are_a_b_and_mixtures():
    rows, d = 64, 3
    found = Saltelli().unit(6, 0, rows * (d + 2), d, rows * (d + 2)).reshape(rows, d + 2, d)
    stream = np.random.default_rng(np.random.SeedSequence(6, spawn_key=(0,)))
    base = qmc.Sobol(2 * d, bits=32, rng=stream).random(rows) + 2.0**-33
    np.testing.assert_array_equal(found[:, 0], base[:, :d])
    np.testing.assert_array_equal(found[:, 1], base[:, d:])
    for j in range(d):
        expected = base[:, :d].copy()
        expected[:, j] = base[:, d + j]
        np.testing.assert_array_equal(found[:, 2 + j], expected)


def test_saltelli_gives_the_sensitivity_indices_of_ishigami():
    """S1 = 0.3139, S2 = 0.4424, S3 = 0 (a = 7, b = 0.1), by the estimator of Saltelli 2010, table 2 (b)."""
    rows = 2**12
    n = 5 * rows
    x = Space({name: Uniform(-np.pi, np.pi) for name in "abc"}, design=Saltelli()).draw(1, 0, n, n)
    y = np.sin(x["a"]) + 7 * np.sin(x["b"]) ** 2 + 0.1 * x["c"] ** 4 * np.sin(x["a"])
    a, b, *mixed = y.reshape(rows, 5).T
    found = [np.mean(b * (m - a)) / np.var([a, b]) for m in mixed]
    np.testing.assert_allclose(found, [0.3139, 0.4424, 0.0], atol=0.01)


@killed_by(
    "uncertainty.sweep.variables",
    "np.linalg.cholesky(np.asarray(self.matrix, float))",
    "np.asarray(self.matrix, float)",
)
def test_correlations_are_recovered():
    """Pearson's of normals is rho, Spearman's of any two 6/pi asin(rho/2); the marginals stay what they are."""
    variables = {
        "n1": Normal(5.0, 2.0),
        "l": LogNormal(1.0, 0.8),
        "free": Uniform(0, 1),
        "n2": Normal(0, 1),
        "u": Uniform(2, 3),
    }
    paths = ("u", "n1", "l", "n2")
    rho = np.array([[1, 0.8, -0.3, 0.1], [0.8, 1, -0.5, 0.3], [-0.3, -0.5, 1, 0.2], [0.1, 0.3, 0.2, 1]])
    n = 2**15
    ours = Space(variables, Correlation(paths, rho), Sobol())
    assert ours.check(n) == n
    x = ours.draw(11, 0, n, n)
    spearman = stats.spearmanr(np.stack([x[path] for path in paths], 1)).statistic
    np.testing.assert_allclose(spearman, 6 / np.pi * np.arcsin(rho / 2), atol=0.005)
    assert abs(np.corrcoef(x["n1"], x["n2"])[0, 1] - 0.3) < 0.005
    assert max(abs(stats.spearmanr(x["free"], x[path]).statistic) for path in paths) < 0.005
    for path, theirs in {"u": stats.uniform(2, 1), "n1": stats.norm(5, 2), "l": stats.lognorm(0.8)}.items():
        assert stats.kstest(x[path], theirs.cdf).pvalue > 1e-3


def test_normal_marginals_have_the_given_covariance():
    """x = mean + chol(C) z, exactly; the correlations of a covariance are those of its Cholesky factor."""
    covariance = np.array([[0.09, 0.05], [0.05, 0.25]])
    variables = {"b": Normal(1.0, 0.5), "a": Normal(5.0, 0.3)}
    ours = Space(variables, Correlation(("a", "b"), ((1.0, 0.05 / 0.15), (0.05 / 0.15, 1.0))))
    z = np.array([[0.3, -1.0], [7.0, 8.0], [-8.0, 0.1]])
    found = ours.normal(z)
    expected = np.array([5.0, 1.0]) + z[:, ::-1] @ np.linalg.cholesky(covariance).T
    np.testing.assert_allclose(np.stack([found["a"], found["b"]], 1), expected, rtol=1e-13)
    assert ours.dimension == 2
    assert list(found) == ["b", "a"]


def test_normal_coordinates_and_draws_are_the_same_map():
    ours = Space(FIVE | {"rows": Rows({"x": [1.0, 2.0, 3.0]})}, PAIR, Sobol())
    u = Sobol().unit(1, 0, 64, 6, 64)
    drawn, mapped = ours.draw(1, 0, 64, 64), ours.normal(ndtri(u))
    assert ours.dimension == 6
    for path in ours.paths:
        if path == "e":
            assert drawn[path].tolist() == mapped[path].tolist()
        else:
            np.testing.assert_allclose(drawn[path], mapped[path], rtol=1e-13)


def test_rows_stay_together_and_come_by_weight():
    table = {"x": np.arange(4.0), "y": np.arange(4.0) ** 2, "road": np.array(["a", "b", "c", "d"])}
    ours = Space({"rows": Rows(table, [1.0, 0.0, 2.0, 1.0]), "z": Uniform(0, 1)}, None, Sobol())
    assert ours.check(1024) == 1024
    assert (ours.dimension, ours.paths) == (2, ("x", "y", "road", "z"))
    found = ours.draw(0, 0, 1024, 1024)
    np.testing.assert_array_equal(found["y"], found["x"] ** 2)
    assert ["abcd"[int(x)] for x in found["x"]] == found["road"].tolist()
    assert [int((found["x"] == x).sum()) for x in range(4)] == [256, 0, 512, 256]
    assert Rows(table, [1.0, 1.0, 0.0, 0.0]).value(1.0)["x"] == 1.0


TABLES = [
    Uniform(1.0, 2.5),
    Normal(5.75, 0.3),
    Normal(5.75, 0.3, low=5.0),
    LogNormal(1.0, 0.2, high=3.0),
    Triangular(0.0, 1.0, 2.0),
    Categorical(("dry", "snow"), (1.0, 3.0)),
    Categorical((1.0, 2.0)),
    Empirical(SAMPLE, interpolated=True),
]


@pytest.mark.parametrize("ours", TABLES, ids=readable_id)
def test_tables_of_distributions_are_read_back(ours):
    table = as_plain(ours, brief=True)
    assert distributions.read_distribution(json.loads(json.dumps(table)), "x") == ours
    assert distributions.read_distribution(tomllib.loads(write_toml({"x": table}, {}))["x"], "x") == ours


@pytest.mark.parametrize(
    "ours",
    [Random(), Sobol(), Sobol(8), LatinHypercube(), Grid(3), Grid({"a": 3, "b": (0.1, 1.0)}), Corners(), Saltelli()],
    ids=readable_id,
)
def test_tables_of_designs_are_read_back(ours):
    table = as_plain(ours, brief=True)
    assert sampling.read_sampling_design(json.loads(json.dumps(table)), "x") == ours
    assert tomllib.loads(write_toml({"x": table}, {}))["x"] == table


def test_the_table_of_a_space_is_read_back():
    ours = Space(FIVE | {"rows": Rows({"x": np.array([1.0, 2.0])}, np.array([1.0, 3.0]))}, PAIR, Sobol(2))
    again = space.read_space(json.loads(json.dumps(ours.table())), "sweep")
    assert again.table() == ours.table()
    for path, column in ours.draw(1, 0, 32, 32).items():
        np.testing.assert_array_equal(again.draw(1, 0, 32, 32)[path], column)
    assert space.read_space({"variables": {}}, "sweep").design == Random()


@killed_by("uncertainty.sweep.discrete", "not all(isinstance(value, str) for value in column)", "False")
@pytest.mark.parametrize(
    ("ours", "lines"),
    [
        (Uniform(6.0, 5.3), ["m: low = 6 is not below high = 5.3"]),
        (Uniform(math.nan, math.inf), ["m: low = nan is outside (-inf, inf)", "m: high = inf is outside (-inf, inf)"]),
        (Normal(0.0, 0.0), ["m: deviation = 0 is outside (0, inf)"]),
        (Normal(0.0, 1.0, math.nan), ["m: low = nan is outside (-inf, inf)"]),
        (Normal(0.0, 1.0, 2.0, 2.0), ["m: low = 2 is not below high = 2"]),
        (Normal(0.0, 1.0, 40.0), ["m: normal(0, 1, low = 40) has nothing between its limits"]),
        (LogNormal(-1.0, 1.0), ["m: median = -1 is outside (0, inf)"]),
        (LogNormal(1.0, 1.0, low=-1.0), ["m: low = -1 is outside [0, inf)"]),
        (LogNormal(1.0, 0.1, high=0.01), ["m: log-normal(1, 0.1, high = 0.01) has nothing between its limits"]),
        (Triangular(0.0, 3.0, 2.0), ["m: mode = 3 is outside [0, 2]"]),
        (Categorical(()), ["m: choices are empty"]),
        (Categorical((1.0, "a")), ["m: choices = [1.0, 'a'] mix numbers and texts"]),
        (Categorical((1.0, math.inf)), ["m: choices = [1.0, inf] are not all in (-inf, inf)"]),
        (Categorical((1.0, 2.0), (1.0,)), ["m: weights are 1; there are 2 to weigh"]),
        (Categorical((1.0, 2.0), (1.0, 0.0)), ["m: weights = [1.0, 0.0] are not all in (0, inf)"]),
        (Empirical(()), ["m: values are empty"]),
        (Empirical((1.0, math.nan)), ["m: values = [1.0, nan] are not all in (-inf, inf)"]),
        (Rows({}), ["m: columns need one shape (n,); there is none"]),
        (Rows({"x": [1.0], "y": [1.0, 2.0]}), ["m: columns need one shape (n,); there is x (1,), y (2,)"]),
        (Rows({"x": [[1.0]]}), ["m: columns need one shape (n,); there is x (1, 1)"]),
        (Rows({"x": [1.0, math.nan]}), ["m: column x is not finite in row 1"]),
        (Rows({"x": np.array([1.0, 2.0], object)}), [f"m: column x is of type object; {NUMBERS}"]),
        (Rows({"x": np.array([True, False])}), [f"m: column x is of type bool; {NUMBERS}"]),
        (Uniform("a", 3), ["m: low = 'a' is no number; one in (-inf, inf) is needed"]),
        (Rows({"x": [1.0, 2.0]}, [0.0, 0.0]), ["m: weights have sum 0"]),
        (Rows({"x": [1.0, 2.0]}, [-1.0, 2.0]), ["m: weights = [-1.0, 2.0] are not all in [0, inf)"]),
    ],
    ids=readable_id,
)
def test_what_is_wrong_with_a_variable_is_said(ours, lines):
    assert list(ours.problems("m")) == lines


@pytest.mark.parametrize(
    ("given", "line"),
    [
        (5, "x = 5 is a number; a table, or the name of a type (uniform, normal, "),
        ({}, "x.type is missing; there is uniform, normal, log-normal, triangular, categorical, empirical"),
        (
            {"type": "unifrom"},
            'x.type = "unifrom" is unknown; did you mean uniform? There is uniform, normal, log-normal',
        ),
        ({"type": ["normal"]}, "x.type = ['normal'] is a list; one of uniform, normal, "),
        ({"type": "normal", "mean": 1.0}, "x.deviation is missing: normal needs it"),
        (
            {"type": "normal", "mean": 1.0, "sd": 1.0},
            "x.sd is not a field of normal; there is mean, deviation, low, high",
        ),
        ({"type": "normal", "mean": "1", "deviation": 1.0}, 'x.mean = "1" is text; a number in (-inf, inf) is needed'),
        ({"type": "normal", "mean": True, "deviation": 1.0}, "x.mean = true is a boolean; a number"),
        ({"type": "normal", "mean": 10**400, "deviation": 1.0}, "is too large for a number in (-inf, inf)"),
        ({"type": "normal", "mean": math.nan, "deviation": 1.0}, "x.mean = nan is outside (-inf, inf)"),
        ({"type": "uniform", "low": 2, "high": 1}, "x: low = 2 is not below high = 1"),
        ({"type": "categorical", "choices": 3}, "x.choices = 3 is a number; a list is needed"),
        ({"type": "categorical", "choices": [True]}, "x.choices.0 = true is a boolean; a number"),
        ({"type": "empirical", "values": [1.0], "interpolated": 1}, "x.interpolated = 1 is a number; true or false"),
    ],
    ids=readable_id,
)
def test_what_is_wrong_with_a_table_is_said(given, line):
    with pytest.raises(ValueError, match="x") as caught:
        distributions.read_distribution(given, "x")
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("given", "line"),
    [
        (
            "sobl",
            'x.type = "sobl" is unknown; did you mean sobol? There is random, sobol, latin-hypercube, grid, corners',
        ),
        ({"type": "sobol", "replicates": 2.5}, "x.replicates = 2.5 is a number; a whole number in [1, 4294967295]"),
        ({"type": "sobol", "replicates": 0}, "x.replicates = 0 is outside [1, 4294967295]"),
        ({"type": "grid"}, "x.levels is missing: grid needs it"),
        ({"type": "grid", "levels": 1}, "x.levels = 1 is outside [2, 4294967295]"),
        ({"type": "grid", "levels": {"a": 1.5}}, "x.levels.a = 1.5 is a number; a whole number in [2, 4294967295]"),
        ({"type": "grid", "levels": {"a": [0.5, 1.5]}}, "x: a = [0.5, 1.5] are not quantile levels in [0, 1]"),
    ],
    ids=readable_id,
)
def test_what_is_wrong_with_the_table_of_a_design_is_said(given, line):
    with pytest.raises(ValueError, match="x") as caught:
        sampling.read_sampling_design(given, "x")
    assert line in str(caught.value)


UNIT = {"type": "uniform", "low": 0, "high": 1}


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ([], "x = [] is a list; a table of variables, correlation, design is needed"),
        ({"variables": {}, "designs": "random"}, "x.designs is not a field of x; did you mean design?"),
        ({"variables": {"m": {"type": "uniform", "low": 0}}}, "x.variables.m.high is missing: uniform needs it"),
        (
            {"variables": {"r": {"type": "rows", "columns": [1]}}},
            "x.variables.r.columns = [1] is a list; a table",
        ),
        ({"variables": {"m": UNIT}, "correlation": [1]}, "x.correlation = [1] is a list; a table of paths, matrix"),
        (
            {"variables": {"m": UNIT}, "correlation": {"paths": [1], "matrix": [[1]]}},
            "x.correlation.paths.0 = 1 is a number; text is needed",
        ),
        (
            {"variables": {"m": UNIT}, "correlation": {"paths": ["m"], "matrix": [[2]]}},
            "x.correlation: matrix has [2.0] on",
        ),
        (
            {"variables": {"m": UNIT}, "design": {"type": "sobol", "replicates": 0}},
            "x.design.replicates = 0 is outside [1, ",
        ),
    ],
    ids=range(8),
)
def test_what_is_wrong_with_the_table_of_a_space_is_said(given, line):
    with pytest.raises(ValueError, match="x") as caught:
        space.read_space(given, "x")
    assert line in str(caught.value)


def test_levels_of_other_variables_are_refused():
    with pytest.raises(ValueError, match="levels are given for 1 variables, not 2"):
        Grid({"a": 3}).unit(0, 0, 1, 2, 9)


@pytest.mark.parametrize(
    ("design", "samples", "line"),
    [
        (Random(), None, "samples is missing: how many there shall be"),
        (Random(), 0, "samples = 0 is outside [1, 4294967295]"),
        (Sobol(3), 1000, "samples = 1000 is not a multiple of 3, the number of replicates; 999 or 1002 would be"),
        (LatinHypercube(), 10**6 + 1, "samples = 1000001 are more than a latin-hypercube can have, 1000000; use sobol"),
        (Grid(4), 10, "samples = 10 is not 16, the number of points of the grid 4 x 4"),
        (Grid(10**5), None, "samples = 10000000000 is outside [1, 4294967295]"),
        (Corners(), 5, "samples = 5 is not 4, the number of points of the corners"),
        (Saltelli(), 2, "samples = 2 is not a multiple of 4, the number of variables plus 2; 4 would be"),
    ],
    ids=readable_id,
)
def test_a_design_that_cannot_have_so_many_samples_says_so(design, samples, line):
    with pytest.raises(ValueError, match="samples") as caught:
        Space({"a": Uniform(0, 1), "b": Uniform(0, 1)}, None, design).check(samples)
    assert str(caught.value) == line


@pytest.mark.parametrize(
    ("ours", "line"),
    [
        (Space({}), "variables are empty: nothing varies"),
        (Space({"a": Uniform(2, 1)}), "a: low = 2 is not below high = 1"),
        (Space({"a": Uniform(0, 1), "r": Rows({"a": [1.0], "b": [1.0]})}), "a is given 2 times"),
        (
            Space({"a": Uniform(0, 1)}, Correlation(("b",), [[1.0]])),
            "correlation: b is not a variable with a distribution",
        ),
        (
            Space({"r": Rows({"a": [1.0]})}, Correlation(("r",), [[1.0]])),
            "correlation: r is not a variable with a distr",
        ),
        (Space(FIVE, Correlation(("a", "a"), np.eye(2))), "correlation: a is named 2 times"),
        (
            Space(FIVE, Correlation(("a", "b"), [[1.0]])),
            "correlation: matrix needs 2 rows of 2 numbers, as many as paths",
        ),
        (Space(FIVE, Correlation(("a", "b"), [[1.0], [0.5, 1.0]])), "correlation: matrix needs 2 rows of 2 numbers"),
        (Space(FIVE, Correlation(("a", "b"), "abc")), "correlation: matrix needs 2 rows of 2 numbers"),
        (Space(FIVE, Correlation(("a", "b"), [[1.0, 0.5], [0.4, 1.0]])), "correlation: matrix is not symmetric"),
        (Space(FIVE, Correlation(("a", "b"), [[1.0, math.nan], [0.4, 1.0]])), "correlation: matrix is not finite"),
        (
            Space(FIVE, Correlation(("a", "b"), [[2.0, 0.5], [0.5, 1.0]])),
            "matrix has [2.0, 1.0] on its diagonal, not ones",
        ),
        (Space(FIVE, Correlation(("a", "b"), [[1.0, 1.2], [1.2, 1.0]])), "its least eigenvalue is -0.2, below 1e-10"),
        (Space(FIVE, PAIR, Saltelli()), "correlation: a saltelli design needs independent variables"),
        (Space(FIVE, PAIR, Grid(3)), "correlation: a grid design needs independent variables"),
        (
            Space({"a": Normal(5.75, 0.3)}, None, Grid(3)),
            "design: a = normal(5.75, 0.3) reaches (-inf, inf); grid needs a",
        ),
        (
            Space({"a": LogNormal(1, 1, high=2)}, None, Grid(3)),
            "design: a = log-normal(1, 1, high = 2) reaches (0, 2]; grid",
        ),
        (
            Space({"a": Normal(5.75, 0.3, 0)}, None, Corners()),
            "reaches [0, inf); corners needs a finite, closed support",
        ),
        (Space(FIVE, None, Corners()), "design: e is one of 3; corners need two ends; use grid"),
        (
            Space({"a": Uniform(0, 1)}, None, Grid({"b": 3})),
            "design: levels of a are missing; design: b is not a variable",
        ),
        (Space({"a": Uniform(0, 1)}, None, Sobol(0)), "design: replicates = 0 is outside [1, 4294967295]"),
        (Space({"a": Uniform(0, 1)}, None, Sobol(2.0)), "design: replicates = 2 is a number; a whole number in [1, "),
        (Space({"a": Uniform(0, 1)}, None, Grid(2.5)), "design: levels = 2.5 is a number; a whole number in [2, "),
    ],
    ids=range(23),
)
def test_what_is_wrong_with_a_space_is_said(ours, line):
    with pytest.raises(ValueError, match=r"\w") as caught:
        ours.check(100)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


@killed_by("host.values", "isinstance(value, numbers.Real)", "isinstance(value, int | float)")
def test_unbounded_variables_may_have_levels_inside():
    ours = Space({"a": Normal(0.0, 1.0)}, None, Grid({"a": (0.25, 0.5, np.float32(0.75))}))
    assert ours.check() == 3
    np.testing.assert_allclose(ours.draw(0, 0, 3, 3)["a"], stats.norm.ppf([0.25, 0.5, 0.75]), atol=1e-15)


@pytest.mark.parametrize(("start", "stop"), [(-1, 3), (3, 2), (8, 11)])
def test_samples_that_are_not_there_are_refused(start, stop):
    with pytest.raises(ValueError, match=r"samples \[-?\d+, \d+\) are outside \[0, 10\)"):
        Space(FIVE).draw(0, start, stop, 10)


@pytest.mark.parametrize("design", [Random(), Sobol(), LatinHypercube()], ids=readable_id)
@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_has_32_bits(design, seed):
    with pytest.raises(ValueError, match=rf"seed = {seed} is outside \[0, 4294967295\]"):
        design.unit(seed, 0, 4, 1, 4)


@killed_by(
    "uncertainty.sweep.distributions", "support.high == spec.high and spec.open_high", "False and spec.open_high"
)
@pytest.mark.parametrize(
    ("ours", "spec", "line"),
    [
        (Normal(5.75, 0.3), MASS, f"normal(5.75, 0.3) reaches (-inf, inf), outside (0, inf) kg{HINT}"),
        (Normal(5.75, 0.3), ParameterSpec("kg"), None),
        (Normal(5.75, 0.3, low=0), ParameterSpec("kg", 0), None),
        (Normal(5.75, 0.3, low=0), MASS, f"normal(5.75, 0.3, low = 0) reaches [0, inf), outside (0, inf) kg{HINT}"),
        (LogNormal(1, 0.3), MASS, None),
        (LogNormal(1, 0.3), ParameterSpec("1", 0, 9), f"log-normal(1, 0.3) reaches (0, inf), outside [0, 9]{HINT}"),
        (Uniform(0, 5), ParameterSpec("s", 0, 5), None),
        (Uniform(0, 5), ParameterSpec("s", 0, 5, open_high=True), "uniform(0, 5) reaches [0, 5], outside [0, 5) s"),
        (Uniform(0, 5), ParameterSpec("s", 1, 6), "uniform(0, 5) reaches [0, 5], outside [1, 6] s"),
        (Categorical((1.0, 7.0)), ParameterSpec("1", 0, 6), "categorical([1.0, 7.0]) reaches [1, 7], outside [0, 6]"),
        (
            Categorical(("a", "b")),
            ParameterSpec("1"),
            "categorical(['a', 'b']) is text; a number in (-inf, inf) is needed",
        ),
        (Empirical(SAMPLE), ParameterSpec("1", -1, 7.5), None),
    ],
    ids=range(12),
)
def test_what_leaves_the_range_of_a_parameter_is_said(ours, spec, line):
    assert describe_out_of_range(ours, spec, "sweep.over.m") == (line and f"sweep.over.m = {line}")
    assert list(Space({"m": ours}).describe_out_of_range({"m": spec}, "sweep.over.")) == (
        [f"sweep.over.m = {line}"] if line else []
    )


def test_rows_that_leave_the_range_of_a_parameter_are_said():
    ours = Space({"r": Rows({"m": [1.0, 7.0], "n": [5.0, 5.0], "o": np.array(["a", "b"])})})
    found = list(ours.describe_out_of_range(dict.fromkeys("mno", ParameterSpec("kg", 0, 6)), "over."))
    text = "over.r: column o is text; a number in [0, 6] kg is needed"
    assert found == ["over.r: column m = 1 ... 7 leaves [0, 6] kg", text]
