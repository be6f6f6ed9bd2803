"""Subset simulation for small probabilities, followed by importance sampling if the failures predict a benefit.

    P[F] = P[F_1] P[F_2|F_1] ... P[F_m|F_m-1],   F_j = {z: g(z) >= b_j},   z ~ N(0, I),   b_m = threshold

The method is that of S.-K. Au and J. L. Beck, Probabilistic Engineering Mechanics 16 (2001). A fraction `share` of the
samples reaches b_j. These samples are the seeds of Markov chains that fill the next level by adaptive conditional
sampling (I. Papaioannou et al., ibid. 41 (2015)):

    z' = sqrt(1 - s^2) z + s xi,  accepted if g(z') >= b_j,   log s += (acceptance - 0.44)/sqrt(step)

All chains make each step together and share the adapted s. The shares are counted, not presumed, so scores may tie. The
estimate is consistent; its bias is O(1/samples) (positive, a few per cent by default).

A level's relative variance is (1 - p)/(p n) (1 + correlation along chains). The levels depend on each other, too. The
total variance comes from the failures' ancestors among the first samples, sum_a (share of a)^2 (A. Lee and N. Whiteley,
Biometrika 105 (2018)). It is kept between the values for independent and for fully dependent levels (the bounds of Au
and Beck). The interval is log-normal, with quantiles of Student's t and one degree of freedom for each effective
ancestor.

This interval assumes that the chains entered every failure region. A region that gains on the others only at late
levels is often missed, and no sample shows that. The first level alone needs no assumption: it is plain Monte Carlo,
with the exact interval of Clopper and Pearson. It is the estimate if there is one level, or if no sample fails at last.

Importance sampling follows if the failures predict that it at least halves the coefficient of variation
(`importance_sampling`). Its estimate replaces that of subset simulation unless it proves more uncertain or far lower. A
far lower estimate would follow from missed failures. A few normal distributions do not cover some failure sets, for
example the surface of a sphere in ten dimensions. Subset simulation then gives the result. The choice between two
consistent estimates adds a small bias.
"""

import dataclasses
import enum
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from diffabs.core.jax_flags import default_flags
from diffabs.core.kinds import find_value_objection, format_value
from diffabs.core.shapes import Bool, Float, Int
from diffabs.uncertainty.reliability.importance_sampling import (
    CountedScore,
    Gradient,
    ImportanceEstimate,
    ProbabilityEstimate,
    Score,
    is_better_estimate,
    lognormal_estimate,
    try_importance_sampling,
)
from diffabs.uncertainty.sweep.statistics.estimates import Count

TARGET_ACCEPTANCE, FIRST_SPREAD = 0.44, 0.6  # acceptance aimed at, and s of the first step: Papaioannou et al.
MAX_FAILING_POINTS = 100  # greatest number of failures in a result
MAX_LEVEL_NUMBERS = 50_000_000  # coordinates of all samples of a level; a few arrays of this size are in memory
Rng = np.random.Generator


class SubsetReason(enum.Enum):
    """The reason why no further level follows: the threshold was reached, no progress, or no levels left."""

    REACHED = "the threshold was reached"
    PLATEAU = "no progress: no sample is above the score that they share"
    LEVELS = "the levels were exhausted"


class SubsetProgress(NamedTuple):
    """The progress after a level.

    Attributes:
        level: Number of the level, from 1.
        threshold: Threshold of the level.
        share: Fraction of the level's samples that reached the threshold [1].
        evaluations: Number of runs over all levels so far.
        strict: Whether only a score above the threshold reaches it, as in `SubsetLevel`.
    """

    level: int
    threshold: float
    share: float
    evaluations: int
    strict: bool = False


def describe_levels(levels: Sequence[SubsetProgress]) -> str:
    """Return the threshold that is reached so far, with its probability and the number of runs, in words."""
    probability, last = math.prod(level.share for level in levels), levels[-1]
    reached = f"{'>' if last.strict else '>='} {last.threshold:.4g} has a probability of about {probability:.2g}"
    return f"{reached}, by {last.evaluations:,} runs"


class SubsetLevel(NamedTuple):
    """Level j of subset simulation: samples of F_(j-1), of which a fraction lies in F_j.

    Attributes:
        threshold: Threshold b_j of the score.
        share: Fraction of the samples with a score of at least b_j, or above b_j if `strict` [1].
        cov: Coefficient of variation of the share, with the correlation along chains.
        acceptance: Accepted fraction of the proposals [1]; 1 for the first level, whose samples are independent.
        spread: Standard deviation s of a proposal, after the last step.
        diverged: Number of the level's runs that diverged.
        strict: Whether only a score above b_j reaches it, as where b_j is the bound of `failure_probability`.
    """

    threshold: float
    share: float
    cov: float
    acceptance: float
    spread: float
    diverged: int
    strict: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class RareEvent:
    """An estimate of P[g(z) >= threshold] or, from `failure_probability`, of P[metric > bound].

    Attributes:
        probability: Probability of the better estimate; NaN, undecided, if no sample failed.
        cov: Coefficient of variation of the better estimate; infinite if no sample failed. It is 0 if all samples
            failed: then only the interval shows the uncertainty.
        interval: 95 % interval of the better estimate. That of several levels assumes that the chains entered every
            failure region.
        reason: Reason why no further level was made.
        levels: The levels of subset simulation.
        subset: Estimate of subset simulation.
        plain: Estimate of the first level alone, plain Monte Carlo, with the interval of Clopper and Pearson. It needs
            no assumption on the failure regions. Runs that diverge count as not failing.
        importance: Result of importance sampling, or None if nothing was drawn for it.
        note: Name of the better estimate, the reason for the choice, and what the interval assumes.
        failing: Different failures (k, d) of subset simulation, distributed as phi on F, the most likely first; at most
            100.
        evaluations: Number of runs of both methods, without the gradients.
        gradients: Number of gradients, one for each point.
        diverged: Number of runs and gradients with a NaN score. They count as not failing; a score of +inf counts as
            failing.
        price: Cost of a gradient in runs.
        engine: Engine of the runs, with compiler and flags if it is a kernel; empty if the score is another function.
    """

    probability: float
    cov: float
    interval: tuple[float, float]
    reason: SubsetReason
    levels: list[SubsetLevel]
    subset: ProbabilityEstimate
    plain: ProbabilityEstimate
    importance: ImportanceEstimate | None
    note: str
    failing: np.ndarray
    evaluations: int
    gradients: int
    diverged: int
    price: float
    engine: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def cost(self) -> float:
        """Total cost in runs, each gradient counted as `price` runs."""
        return self.evaluations + self.price * self.gradients


@default_flags()
def subset_simulation(
    score: Score,
    dimension: int,
    threshold: float,
    *,
    samples: int = 2800,
    share: float = 0.1,
    seed: int = 0,
    levels: int = 20,
    draws: int = 2000,
    gradient: Gradient | None = None,
    price: float = 3.0,
    tolerated: float = 0.05,
    progress: Callable[[SubsetProgress], None] | None = None,
) -> RareEvent:
    """Return an estimate of P[score(z) >= threshold] for z ~ N(0, I) in R^dimension.

    The levels may end before a sample fails. The probability is then NaN, undecided, and `reason` tells why the levels
    ended. The interval is then that of the first level alone.

    With several levels the interval assumes that the chains entered every failure region. With a late second region it
    may cover the truth in far fewer than 95 % of the seeds (first two rows):

        score                                    threshold  P        covered  deviation of P  claimed
        max(z0 - 0.5, 3 (z1 - 3))                3.5        4.7e-5   55 %     17 %            5 %
        max(z0, 20 (z1 - 3.2))                   4          3.7e-4   79 %     49 %            7 %
        max(tanh z0, 2 if z1 > 4.5 else 0)       1.5        3.4e-6   100 %    undecided

    These are figures of 100 seeds (10 for the last score), with importance sampling. The last interval is that of
    the first level, since no sample fails. The interval of `RareEvent.plain` covers the truth in at least 99 % of
    the seeds in all three cases.

    >>> from diffabs.uncertainty.reliability import subset_simulation
    >>> event = subset_simulation(lambda z: (z[:, 0] + z[:, 1]) / 2**0.5, 2, 4.5)  # exactly 3.4e-6
    >>> print(f"{event.probability:.1e}")
    3.3e-06

    Args:
        score: Function (n, dimension) -> (n,); n is `samples` once, then samples * share, and `draws` at the end.
        dimension: Number of coordinates z.
        threshold: Threshold of the score.
        samples: Number of samples of each level.
        share: Share of the samples that start the next level; samples * share is an integer >= 2 that divides samples.
            P = share^m costs samples (1 + (m - 1)(1 - share)) runs: 15400 for 1e-6.
        seed: Seed of all draws.
        levels: Greatest number of levels.
        draws: Number of draws of importance sampling, >= 2; 0 for no importance sampling.
        gradient: Function (n, dimension) -> score (n,), its derivative (n, dimension), n at most 8; or None. It locates
            design points, which serve importance sampling as centres. In many dimensions (from about 20) the failures
            alone do not locate them.
        price: Cost of a gradient in runs, for `RareEvent.cost`.
        tolerated: Greatest share of diverged runs in a level, and among the draws.
        progress: Called after every level.

    Raises:
        ValueError: The dimension, the threshold, the share or a number of samples, levels or draws is invalid, or the
            score or its derivative has the wrong shape.
        importance_sampling.DivergenceError: Too many runs diverge.
    """
    plan = _make_plan(dimension, threshold, samples, share, levels, draws)
    runs = CountedScore(score, gradient, tolerated)
    # Separate streams: importance sampling does not change the draws of subset simulation.
    first, second = (np.random.default_rng(each) for each in np.random.SeedSequence(seed).spawn(2))
    level_results, last, hits, reason, failed = _run_levels(runs, dimension, plan, first, progress)
    plain = _plain_estimate(failed, plan.samples)
    subset = _product_estimate(level_results, last.family[hits]) if len(level_results) > 1 and hits.any() else plain
    tried, note = None, _describe_subset(plan, len(level_results), bool(hits.any()))
    if hits.any() and plan.draws > 0 and len(level_results) > 1:
        chain = np.flatnonzero(hits) % plan.chains
        tried, note = try_importance_sampling(
            runs, last.z[hits], chain, subset, threshold=plan.threshold, draws=plan.draws, rng=second
        )
    # A chain that rejects a proposal repeats its sample: each failure counts once.
    failing = np.unique(last.z[hits], axis=0)
    return RareEvent(
        *(tried.estimate if tried and is_better_estimate(tried, subset) else subset),
        reason=reason,
        levels=level_results,
        subset=subset,
        plain=plain,
        importance=tried,
        note=note if subset is plain else f"{note}; {_describe_assumption(plain)}",
        failing=failing[np.argsort(np.sum(failing**2, axis=1), kind="stable")][:MAX_FAILING_POINTS],
        evaluations=runs.evaluations,
        gradients=runs.gradients,
        diverged=runs.diverged,
        price=price,
    )


class _Plan(NamedTuple):
    threshold: float
    samples: int
    chains: int
    levels: int
    draws: int


def _make_plan(dimension: int, threshold: float, samples: int, share: float, levels: int, draws: int) -> _Plan:
    for name, value, minimum in (("dimension", dimension, 1), ("samples", samples, 4), ("levels", levels, 1)):
        _check_integer(name, value, minimum)
    _check_integer("draws", draws, 0)
    limit = MAX_LEVEL_NUMBERS // dimension
    for name, value in (("samples", samples), ("draws", draws)):
        if value > limit:
            raise ValueError(f"{name} = {value} need too much memory: at most {limit} with {dimension} coordinates")
    check_number("threshold", threshold)
    check_number("share", share)
    chains = round(samples * share)
    if chains < 2 or abs(chains - samples * share) > 1e-9 * samples or samples % chains or samples == chains:
        raise ValueError(
            f"samples * share must be an integer of at least 2 that divides samples, not {samples}*{share}"
        )
    if draws == 1:
        raise ValueError("draws = 1 is outside [2, inf), and not 0")
    return _Plan(float(threshold), samples, chains, levels, draws)


def _check_integer(name: str, value: object, minimum: int) -> None:
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise ValueError(f"{name} = {format_value(value)} is no integer; an integer in [{minimum}, inf) is needed")
    if value < minimum:
        raise ValueError(f"{name} = {value} is outside [{minimum}, inf)")


def check_number(name: str, value: Any, unit: str = "1") -> None:
    """Check that a setting is one finite number."""
    allowed = f"(-inf, inf) {'' if unit == '1' else unit}".rstrip()
    if line := find_value_objection(value) or ("is no single number" if np.ndim(value) else ""):
        raise ValueError(f"{name} = {format_value(value)} {line}; a number in {allowed} is needed")
    if not math.isfinite(value):
        raise ValueError(f"{name} = {value} is outside {allowed}")


class _Population(NamedTuple):
    """Samples (n, d) of a level, step by step: chain c holds rows c, c + chains, ...

    `family` is the index of the first-level sample from which each sample descends.
    """

    z: Float[np.ndarray, "n d"]
    scores: Float[np.ndarray, " n"]
    family: Int[np.ndarray, " n"]
    length: int
    acceptance: float
    spread: float
    diverged: int


class _LevelSequence(NamedTuple):
    """All levels; the samples of the last one and the mask (n,) of its failures. Then the reason for the end, and the
    number of failures among the samples of the first level.
    """

    levels: list[SubsetLevel]
    last: _Population
    hits: Bool[np.ndarray, " n"]
    reason: SubsetReason
    failed: int


def _run_levels(
    runs: CountedScore, dimension: int, plan: _Plan, rng: Rng, progress: Callable[[SubsetProgress], None] | None
) -> _LevelSequence:
    z = rng.standard_normal((plan.samples, dimension))
    scores = runs(z)
    failed = int(np.sum(scores >= plan.threshold))
    now = _Population(z, scores, np.arange(plan.samples), 1, 1.0, FIRST_SPREAD, runs.since(0, 0))
    levels: list[SubsetLevel] = []
    while True:
        aim = _next_threshold(now.scores, plan)
        ends = aim is None or aim >= plan.threshold or len(levels) + 1 == plan.levels
        value = plan.threshold if ends or aim is None else aim
        hits = now.scores >= value
        part, cov = float(np.mean(hits)), _level_cov(hits.reshape(now.length, -1))
        levels.append(SubsetLevel(value, part, cov, now.acceptance, now.spread, now.diverged))
        if progress:
            progress(SubsetProgress(len(levels), value, part, runs.evaluations))
        if ends:
            reached = SubsetReason.REACHED if aim == plan.threshold else SubsetReason.LEVELS
            return _LevelSequence(levels, now, hits, SubsetReason.PLATEAU if aim is None else reached, failed)
        now = _advance_chains(runs, now, hits, value, plan, rng)


def _next_threshold(scores: Float[np.ndarray, " n"], plan: _Plan) -> float | None:
    """Return the next threshold b_j, or None if all samples share one score.

    It is the final threshold if at least half as many samples as there are chains fail. Another level would cost more
    than it contributes. Otherwise it is the score that `chains` samples reach. If ties let more than half of all
    samples reach it, the next greater score is taken. That score must leave at least a tenth of the chains, unless all
    samples reach the tied score.
    """
    if np.sum(scores >= plan.threshold) >= plan.chains / 2:
        return plan.threshold
    reached = np.sort(scores)[-plan.chains]
    share, above = np.mean(scores >= reached), scores[scores > reached]
    if share > 0.5 and (len(above) >= plan.chains / 10 or (share == 1 and len(above) > 0)):
        return min(float(np.min(above)), plan.threshold)
    return float(reached) if share < 1 else None


def _advance_chains(
    runs: CountedScore, old: _Population, hits: np.ndarray, value: float, plan: _Plan, rng: Rng
) -> _Population:
    """Return the population of chains that start from the samples of a level, some from the same sample."""
    before = runs.evaluations, runs.diverged
    # np.resize repeats the permuted indices if fewer samples than chains reached the level.
    seeds = np.resize(rng.permutation(np.flatnonzero(hits)), plan.chains)
    z, scores, s, length = old.z[seeds], old.scores[seeds], old.spread, plan.samples // plan.chains
    points, values, acceptances = [z], [scores], []
    for step in range(1, length):
        proposed = math.sqrt(1 - s**2) * z + s * rng.standard_normal(z.shape)
        new = runs(proposed)
        accepted = new >= value
        z, scores = np.where(accepted[:, None], proposed, z), np.where(accepted, new, scores)
        points.append(z)
        values.append(scores)
        acceptances.append(float(np.mean(accepted)))
        s = min(1.0, s * math.exp((acceptances[-1] - TARGET_ACCEPTANCE) / math.sqrt(step)))
    family = np.tile(old.family[seeds], length)
    lost = runs.since(*before)
    return _Population(
        np.concatenate(points), np.concatenate(values), family, length, float(np.mean(acceptances)), s, lost
    )


def _level_cov(hits: Bool[np.ndarray, "steps chains"]) -> float:
    """Return the coefficient of variation of a level's share from hits (length, chains).

        sqrt((1 - p)/(p n) (1 + 2 sum_k (1 - k/length) correlation_k))

    Source: Au and Beck.
    """
    p, length = float(np.mean(hits)), len(hits)
    if p in (0.0, 1.0):
        return np.inf if p == 0 else 0.0
    lags = [np.mean(hits[:-k] & hits[k:]) - p**2 for k in range(1, length)]
    # An estimated correlation may be negative by chance; max(0, ...) keeps the variance on the safe side.
    excess = 2 * sum((1 - k / length) * lag for k, lag in enumerate(lags, 1)) / (p * (1 - p))
    return math.sqrt((1 - p) / (p * hits.size) * (1 + max(0.0, excess)))


def _plain_estimate(failed: int, samples: int) -> ProbabilityEstimate:
    """Return the share of `failed` among independent samples, with its 95 % interval; NaN if none failed."""
    share, low, high, *_ = Count(failed, samples).probability()
    if failed == 0:
        return ProbabilityEstimate(math.nan, np.inf, (low, high))
    return ProbabilityEstimate(share, math.sqrt((1 - share) / failed), (low, high))


def _product_estimate(levels: list[SubsetLevel], family: Int[np.ndarray, " n"]) -> ProbabilityEstimate:
    """Return the product of the shares, with the variance estimated from the families of the failures."""
    covs = np.array([level.cov for level in levels])
    parts = np.bincount(family) / len(family)
    cov = float(np.clip(np.sqrt(np.sum(parts**2)), np.sqrt(np.sum(covs**2)), np.sum(covs)))
    probability, spread = math.prod(level.share for level in levels), math.log1p(cov**2)
    middle = lognormal_estimate(probability * math.exp(spread / 2), cov, math.sqrt(spread), 1 / max(cov**2, 1e-9))
    return ProbabilityEstimate(probability, cov, middle.interval)


def _describe_subset(plan: _Plan, levels: int, failed: bool) -> str:
    """Return the name of the estimate without importance sampling, and why there is none."""
    if not failed:
        return "undecided: no sample failed; the interval is that of the first level, plain Monte Carlo"
    if levels == 1:
        return "plain Monte Carlo: one level shows the failures"
    return f"subset simulation: no importance sampling with {plan.draws} draws"


def _describe_assumption(plain: ProbabilityEstimate) -> str:
    low, high = plain.interval
    without = f"without this assumption it is {low:.3g} to {high:.3g}"
    return f"the interval assumes that the chains entered every failure region; {without}"
