"""How often does a 95 % interval of a mean cover it, for skewed laws and few samples?

The package reports the hull of Hall's and Student's intervals (`sweep.statistics.estimates`). Each number is in
percent of 10,000 samples, with a standard error of at most 0.5. "warned" counts the samples that `diffabs sweep` calls
skewed, by `MAX_SKEWNESS`. "length" is the median length over that of Student's interval.

    python experiments/mean_intervals/run.py
"""

import dataclasses
from typing import Any

import numpy as np
from scipy import stats

from diffabs.papers import record
from diffabs.uncertainty.sweep.statistics import summary
from diffabs.uncertainty.sweep.statistics.estimates import Moments
from experiments._shared.numbers import store_numbers

LAWS = {
    "log-normal, sigma 1.5": stats.lognorm(1.5),
    "log-normal, sigma 1": stats.lognorm(1.0),
    "exponential": stats.expon(),
    "log-normal, sigma 0.5": stats.lognorm(0.5),
    "gamma, shape 4": stats.gamma(4.0),
    "normal": stats.norm(),
    "uniform": stats.uniform(),
    "Student, 5 degrees": stats.t(5.0),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    counts: tuple[int, ...] = (10, 30, 100, 1000)
    repetitions: int = 10_000
    confidence: float = 0.95
    thresholds: tuple[float, ...] = (0.1, 0.2, 0.3)  # of |skewness|/sqrt(n)
    seed: int = 0
    out: str = "out/experiments/mean_intervals"


def measure_law(config: Config, name: str, n: int) -> dict[str, Any]:
    """Return the coverage of three intervals of n samples of a law, and the share of samples that are warned of."""
    law, random = LAWS[name], np.random.default_rng((config.seed, n))
    samples = law.rvs(size=(config.repetitions, n), random_state=random)
    ends = np.array([Moments.of(x).mean(confidence=config.confidence)[1:3] for x in samples]).T
    half = stats.t.ppf(0.5 + config.confidence / 2, n - 1) * stats.sem(samples, axis=1)
    centre, truth, skewness = samples.mean(axis=1), law.mean(), stats.skew(samples, axis=1)
    # Hall's polynomial of (mean - truth)/deviation is within Student's quantile
    t = (centre - truth) / samples.std(axis=1, ddof=1)
    polynomial = t + skewness * t**2 / 3 + skewness**2 * t**3 / 27 + skewness / (6 * n)
    hall = np.abs(polynomial) <= half / samples.std(axis=1, ddof=1)
    return {
        "law": name,
        "samples": n,
        "Student [%]": 100 * np.mean(np.abs(centre - truth) <= half),
        "Hall [%]": 100 * np.mean(hall),
        "ours [%]": 100 * np.mean((ends[0] <= truth) & (truth <= ends[1])),
        "length": float(np.median((ends[1] - ends[0]) / (2 * half))),
        **{f"warned above {t:g} [%]": 100 * np.mean(np.abs(skewness) / np.sqrt(n) > t) for t in config.thresholds},
    }


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    assert summary.MAX_SKEWNESS in config.thresholds
    rows = [measure_law(config, name, n) for name in LAWS for n in config.counts]
    record.print_rows("Coverage of 95 % intervals of a mean", rows)
    return record.experiment(config, {"rows": rows}, {})


if __name__ == "__main__":
    store_numbers(__file__, main(), tolerance=1e-3)
