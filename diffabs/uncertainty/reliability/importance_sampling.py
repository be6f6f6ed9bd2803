"""Importance sampling from mixtures of normal distributions, centred on known failures or on design points.

    P = E_q[w 1_F],   q(z) = sum_k a_k N(z; c_k, u_k u_k' + s_k^2 (I - u_k u_k')),   u = c/|c|,   w = phi/q

    E_q[w^2 1_F]/P^2 = E[w|F]/P

The last equation predicts the variance of importance sampling from failures alone, before any run. The variance is
finite for all centres since s^2 > 1/2. One number s serves all directions across u. It follows the curvature of the
limit surface, and stays near one in the many directions without influence.

The centres are either the maximum-likelihood fit of the failures or design points. Expectation maximisation computes
the fit (cross-entropy method, R. Y. Rubinstein and D. P. Kroese, The Cross-Entropy Method, 2004). Design points are the
points of F nearest to the origin. The improved HL-RF method finds them.

Source: Y. Zhang and A. Der Kiureghian, Two improved algorithms for reliability analysis, in Reliability and
Optimization of Structural Systems, 1995.
"""

import math
import statistics
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from diffabs.core.shapes import Bool, Float, Int

COMPONENT_COUNTS = (1, 2, 4, 8, 16)  # numbers of centres that are tried
EM_STEPS = 15  # steps of expectation maximisation
DEFENSIVE_SHARE = 0.1  # of the draws, shared equally by all centres: the known failures may miss parts of F
SCALE_RANGE = 0.8, 2.0  # least and greatest s: the weights' variance is finite above sqrt(1/2)
MAX_DESIGN_POINT_STEPS = 30  # steps, and so gradients, of a search for a design point
MIN_POINT_DISTANCE = 0.5  # distance below which two design points are one
STEP_TOLERANCE = 0.05  # length of a step that ends a search; a centre needs no more accuracy
MIN_STEP_SHARE = 1e-3  # least t of a step, below which a search stops
CONFIDENCE = 0.95
DESIGN_POINT_STARTS = 8  # number of searches for design points
MAX_COV_RATIO = 0.5  # greatest predicted coefficient of variation over that of subset simulation
MAX_DEVIATIONS_APART = 4.0  # standard deviations below subset simulation at which the two estimates contradict

Score = Callable[[np.ndarray], np.ndarray]
Gradient = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
Fit = Callable[[np.ndarray], "Mixture"]


class DivergenceError(ValueError):
    """Too many runs diverged to estimate a probability; the message is one line."""


class ProbabilityEstimate(NamedTuple):
    """An estimate of a probability.

    Attributes:
        probability: Probability.
        cov: Coefficient of variation: standard deviation of the estimate over the probability [1].
        interval: Ends of the 95 % interval.
    """

    probability: float
    cov: float
    interval: tuple[float, float]


class ImportanceEstimate(NamedTuple):
    """The result of importance sampling.

    Attributes:
        estimate: Probability, coefficient of variation and interval.
        effective_samples: Effective sample size (sum w)^2/sum w^2.
        predicted_cov: Coefficient of variation predicted from the failures before any run.
        centres: Centres of the mixture, shape (k, d).
    """

    estimate: ProbabilityEstimate
    effective_samples: float
    predicted_cov: float
    centres: Float[np.ndarray, "k d"]


class CountedScore:
    """A score z (n, d) -> (n,), and its gradient, that count evaluations, gradients and diverged runs.

    A NaN score counts as diverged and becomes -inf, so it fails at no threshold.
    """

    def __init__(self, score: Score, gradient: Gradient | None, tolerated: float):
        """Set the score, its gradient (None: no gradient) and the share of runs that may diverge."""
        self.score = score
        self.slope = gradient
        self.tolerated = tolerated
        self.evaluations: int = 0
        self.gradients: int = 0
        self.diverged: int = 0

    def __call__(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        self.evaluations += len(z)
        return self._clean(self.score(z), z)

    def gradient(self, z: Float[np.ndarray, "n d"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n d"]]:
        """Return the score (n,) and its derivative (n, d) at `z` (n, d)."""
        assert self.slope is not None
        self.gradients += len(z)
        score, slope = self.slope(z)
        slope = np.array(slope, float)
        if slope.shape != z.shape:
            raise ValueError(f"the derivative of the score of {z.shape} must be {z.shape}, not {slope.shape}")
        return self._clean(score, z), slope

    def _clean(self, score: np.ndarray, z: np.ndarray) -> np.ndarray:
        score = np.array(score, float)
        if score.shape != (len(z),):
            raise ValueError(f"the score of {z.shape} must be ({len(z)},), not {score.shape}")
        lost = np.isnan(score)
        self.diverged += int(np.sum(lost))
        return np.where(lost, -np.inf, score)

    def since(self, evaluations: int, diverged: int) -> int:
        """Return how many runs diverged since the counters had these values; raise DivergenceError for too many."""
        lost, of = self.diverged - diverged, self.evaluations - evaluations
        if lost > self.tolerated * of:
            raise DivergenceError(
                f"{lost} of {of} runs diverged: make the score +inf or -inf there, or `tolerated` greater"
            )
        return lost


class Mixture(NamedTuple):
    """A mixture of normal distributions c + u u'x + s (x - u u'x), x ~ N(0, I).

    The variance is one along the direction u of each centre, in which the density falls, and s^2 across it.

    Attributes:
        centres: Centres c, shape (k, d).
        weights: Weights, shape (k,).
        scales: Standard deviations s across the centre's direction, shape (k,).
    """

    centres: Float[np.ndarray, "k d"]
    weights: Float[np.ndarray, " k"]
    scales: Float[np.ndarray, " k"]

    @property
    def directions(self) -> Float[np.ndarray, "k d"]:
        """Unit vectors u from the origin to the centres, shape (k, d); the first axis for a centre at the origin."""
        size = np.linalg.norm(self.centres, axis=1, keepdims=True)
        return np.where(size > 0, self.centres / np.where(size > 0, size, 1.0), np.eye(1, self.centres.shape[1]))

    def draw(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "{count} d"]:
        """Return `count` points (count, d) drawn with `rng`."""
        components = rng.choice(len(self.weights), size=count, p=self.weights)
        x, u, s = (
            rng.standard_normal((count, self.centres.shape[1])),
            self.directions[components],
            self.scales[components],
        )
        return self.centres[components] + s[:, None] * x + ((1 - s) * np.sum(u * x, axis=1))[:, None] * u

    def log_weight(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Return log(phi/q) at `z` (n, d), shape (n,)."""
        return -np.logaddexp.reduce(self._terms(z)[0], axis=1)

    def parts(self, z: Float[np.ndarray, "n d"]) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
        """Return each centre's share of the density at `z` (n, d), and the squared distance from its line, each (n, k).

        The share is the probability that z was drawn around that centre. The line passes through the origin and the
        centre.
        """
        terms, across = self._terms(z)
        odds = np.exp(terms - np.max(terms, axis=1, keepdims=True))
        return odds / np.sum(odds, axis=1, keepdims=True), across

    def _terms(self, z: Float[np.ndarray, "n d"]) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
        """Return log(weight * density/phi) of each centre, and squared distances from its line, each (n, k)."""
        along, square = z @ self.directions.T, np.sum(z**2, axis=1)[:, None]
        across, size = np.maximum(square - along**2, 0.0), np.linalg.norm(self.centres, axis=1)
        # (along - size)^2 is the squared distance along u; d - 1 directions across have standard deviation s.
        log_q = -0.5 * ((along - size) ** 2 + across / self.scales**2) - (z.shape[1] - 1) * np.log(self.scales)
        return np.log(self.weights) + log_q + 0.5 * square, across


def fit_proposal(
    failures: Float[np.ndarray, "n d"],
    group: Int[np.ndarray, " n"],
    probability: float,
    centres: Float[np.ndarray, "k d"] | None = None,
) -> tuple[Mixture, float]:
    """Return the fitted mixture with the least predicted moment E_q[w^2 1_F]/P^2, and the logarithm of the moment.

    The fits have 1, 2, 4, 8 and 16 centres from the failures; one more takes the given `centres`. The logarithm is
    infinite if all failures are in odd groups, or all in even groups.

    Args:
        failures: Points (n, d), distributed as phi on F.
        group: Integers (n,); failures with the same integer depend on each other. Fits to odd groups predict the moment
            on even groups, and vice versa.
        centres: Centres (k, d) as an alternative to the fitted centres; only their weights and scales are fitted. None
            gives no alternative.
    """
    # k=k binds the value of the loop; a plain k would be the last count in every lambda.
    fits: list[Fit] = [
        lambda z, k=k: _fit_mixture(z, choose_spread_points(z, k), moving=True) for k in COMPONENT_COUNTS
    ]
    if centres is not None:
        fits.append(lambda z: _fit_mixture(z, centres, moving=False))
    odd = group % 2 == 1
    moments = [_second_moment(fit, failures, odd) - np.log(probability) for fit in fits]
    best = int(np.argmin(moments))
    return fits[best](failures), float(moments[best])


def _second_moment(fit: Fit, failures: Float[np.ndarray, "n d"], odd: Bool[np.ndarray, " n"]) -> float:
    """Return log E[w|F], with each half of the failures evaluated under the mixture fitted to the other half."""
    halves = failures[odd], failures[~odd]
    if min(map(len, halves)) == 0:
        return np.inf
    logs = [fit(fitted).log_weight(tested) for fitted, tested in (halves, halves[::-1])]
    return np.logaddexp.reduce(np.concatenate(logs)) - np.log(len(failures))


def _fit_mixture(z: Float[np.ndarray, "n d"], centres: Float[np.ndarray, "k d"], *, moving: bool) -> Mixture:
    """Return the mixture with weights and scales of maximum likelihood, and fitted centres if `moving`."""
    count, d = len(centres), z.shape[1]
    mixture = Mixture(centres, np.full(count, 1 / count), np.ones(count))
    for _ in range(EM_STEPS):
        parts, across = mixture.parts(z)
        total = np.maximum(parts.sum(axis=0), np.finfo(float).tiny)
        # Each centre has d - 1 directions across, all with the same variance.
        square = np.sum(parts * across, axis=0) / total / max(d - 1, 1)
        mixture = Mixture(
            parts.T @ z / total[:, None] if moving else centres,
            (1 - DEFENSIVE_SHARE) * parts.mean(axis=0) + DEFENSIVE_SHARE / count,
            np.clip(np.sqrt(square), *SCALE_RANGE),
        )
    return mixture


def choose_spread_points(z: Float[np.ndarray, "n d"], count: int) -> Float[np.ndarray, "k d"]:
    """Return up to `count` of the points, far apart in direction; the first is the point nearest to the origin.

    Each further point has the direction farthest from the directions chosen so far.
    """
    size = np.linalg.norm(z, axis=1)
    directions = z / np.maximum(size, np.finfo(float).tiny)[:, None]
    indices = [int(np.argmin(size))]
    cosine = directions @ directions[indices[0]]
    while len(indices) < min(count, len(z)):
        indices.append(int(np.argmin(cosine)))
        cosine = np.maximum(cosine, directions @ directions[indices[-1]])
    return z[indices]


def design_points(gradient: Gradient, starts: Float[np.ndarray, "n d"], threshold: float) -> Float[np.ndarray, "k d"]:
    """Return local minima (k, d) of |z| on g(z) = threshold, the nearest to the origin first.

        z' = (a'z + threshold - g) a/|a|^2,   a = dg/dz

    A search moves to z + t (z' - z) if the merit |z|^2/2 + 2 (|z| + 1)/|a| |threshold - g| falls. Otherwise t is
    halved. All searches advance together. Of ends closer than 0.5 to each other, the nearest to the origin is returned.

    A trial whose run diverges or is refused halves t. A search stops at a kink, on a plateau (a = 0), or when t falls
    below 1e-3. Its point is then a poor centre, but the estimate stays unbiased for any centre.
    """
    z = starts.copy()
    score, slope = gradient(z)
    t = np.ones(len(z))
    for _ in range(MAX_DESIGN_POINT_STEPS):
        # A plateau (slope 0) or a diverged run (score -inf) gives infinite or NaN moves: `go` drops these searches.
        with np.errstate(all="ignore"):
            squared = np.sum(slope**2, axis=1)
            move = ((np.sum(slope * z, axis=1) + threshold - score) / squared)[:, None] * slope - z
            penalty = 2 * (np.linalg.norm(z, axis=1) + 1) / np.sqrt(squared)
            length = np.linalg.norm(move, axis=1)
            go = np.flatnonzero(np.isfinite(length) & (length > STEP_TOLERANCE) & (t > MIN_STEP_SHARE))
        if len(go) == 0:
            break
        trial = z[go] + t[go, None] * move[go]
        value, steep = gradient(trial)
        merit = 0.5 * np.sum(trial**2, axis=1) + penalty[go] * np.abs(threshold - value)
        better = merit < 0.5 * np.sum(z[go] ** 2, axis=1) + penalty[go] * np.abs(threshold - score[go])
        moved = go[better]
        z[moved], score[moved], slope[moved] = trial[better], value[better], steep[better]
        t[go] = np.where(better, 1.0, 0.5 * t[go])
    # Of searches that end at one design point, the result nearest to the origin is kept.
    distinct: list[np.ndarray] = []
    for point in z[np.argsort(np.linalg.norm(z, axis=1), kind="stable")]:
        if all(np.linalg.norm(point - neighbour) > MIN_POINT_DISTANCE for neighbour in distinct):
            distinct.append(point)
    return np.array(distinct)


def try_importance_sampling(
    runs: CountedScore,
    failures: Float[np.ndarray, "n d"],
    group: Int[np.ndarray, " n"],
    subset: ProbabilityEstimate,
    *,
    threshold: float,
    draws: int,
    rng: np.random.Generator,
) -> tuple[ImportanceEstimate | None, str]:
    """Return the estimate of importance sampling, and a note that names the better estimate and the reason.

    The failures must predict at most half the coefficient of variation of subset simulation. Otherwise the estimate is
    None and nothing is drawn. With a gradient, design points are further candidates for centres.
    """
    centres = None
    if runs.slope:
        centres = design_points(runs.gradient, choose_spread_points(failures, DESIGN_POINT_STARTS), threshold)
    mixture, moment = fit_proposal(failures, group, subset.probability, centres)
    # cov^2 = (E_q[w^2 1_F]/P^2 - 1)/draws; the limits keep the root real and expm1 from an overflow.
    predicted_cov = math.sqrt(math.expm1(min(max(moment, 0.0), 700.0)) / draws)
    if predicted_cov > MAX_COV_RATIO * subset.cov:
        return None, f"subset simulation: {predicted_cov:.2g} is the coefficient of variation to be had otherwise"
    before = runs.evaluations, runs.diverged
    importance = importance_sampling(runs, threshold, mixture, draws, predicted_cov, rng)
    runs.since(*before)
    if is_better_estimate(importance, subset):
        return importance, "importance sampling: less uncertain than subset simulation, and not in contradiction"
    return importance, "subset simulation: importance sampling is far below, or more uncertain"


def is_better_estimate(importance: ImportanceEstimate, subset: ProbabilityEstimate) -> bool:
    """Return whether importance sampling is no more uncertain than subset simulation, and not far below it.

    The uncertainty is the coefficient of variation. Far below means more than four standard deviations in log P: such
    an estimate misses failures.
    """
    cov = importance.estimate.cov
    if cov > subset.cov:
        return False
    below = math.log(subset.probability / importance.estimate.probability)
    return below <= MAX_DEVIATIONS_APART * math.sqrt(math.log1p(cov**2) + math.log1p(subset.cov**2))


def importance_sampling(
    score: Score, threshold: float, mixture: Mixture, draws: int, predicted_cov: float, rng: np.random.Generator
) -> ImportanceEstimate:
    """Return the estimate of importance sampling, which is unbiased for any mixture.

    The coefficient of variation is the greater of the observed and the predicted one, since both are low if heavy
    weights are rare. The interval is an interval of log P, from Student's t with (effective size - 1) degrees of
    freedom. If no draw fails, the probability is 0, the coefficient of variation inf and the interval (0, 1).
    """
    z = mixture.draw(draws, rng)
    weights = np.where(score(z) >= threshold, np.exp(mixture.log_weight(z)), 0.0)
    probability = float(np.mean(weights))
    if probability == 0:
        return ImportanceEstimate(ProbabilityEstimate(0.0, np.inf, (0.0, 1.0)), 0.0, predicted_cov, mixture.centres)
    cov = max(float(np.std(weights, ddof=1)) / math.sqrt(draws) / probability, predicted_cov)
    effective = float(np.sum(weights) ** 2 / np.sum(weights**2))
    return ImportanceEstimate(
        lognormal_estimate(probability, cov, cov, effective - 1), effective, predicted_cov, mixture.centres
    )


def lognormal_estimate(probability: float, cov: float, deviation: float, degrees: float) -> ProbabilityEstimate:
    """Return the estimate with the 95 % interval P exp(+- t deviation) up to 1, where `deviation` is that of log P."""
    reach = math.exp(min(student_quantile(degrees) * deviation, 700.0))
    return ProbabilityEstimate(probability, cov, (probability / reach, min(1.0, probability * reach)))


def student_quantile(degrees: float) -> float:
    """Return the upper quantile of Student's t for a two-sided 95 % interval.

    The formula is the expansion of Cornish and Fisher about the normal distribution. Its error is at most 2 % from 4
    degrees of freedom. Less than 2 degrees count as 2.
    """
    z, n = statistics.NormalDist().inv_cdf(0.5 + CONFIDENCE / 2), max(degrees, 2.0)
    return z + (z**3 + z) / (4 * n) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
