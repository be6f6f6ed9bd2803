"""The probability that a metric of a study exceeds a bound, where it is too small to be counted.

Standard normal coordinates z are mapped to the parameters by `Space.normal`, and the metric of the run is the score of
`rare.subset_simulation`. All runs share one sequence of sensor noise: the probability is that over the parameters,
given this noise."""

from typing import Any

import jax
import numpy as np

from diffabs.conveyor import measure_lanes
from diffabs.sweep.rare import RareEvent, subset_simulation
from diffabs.sweep.study import Study, noise_key, precision


def failure_probability(study: Study, metric: str, bound: float, **options: Any) -> RareEvent:
    """P[metric > bound] over the space of a study, whose design and number of samples do not matter.

    options: those of `subset_simulation`; runs that diverge do not count as failures and are reported

    Raises ValueError for a metric that is not measured, for a study that draws parts, and for a bound that is not
    finite.
    """
    study.check()
    if metric not in study.objectives:
        raise ValueError(f"{metric} is not measured; there is {', '.join(study.objectives)}")
    if study.parts:
        raise ValueError(f"{', '.join(study.parts)}: alternatives of parts have no normal coordinates")

    def score(z: np.ndarray) -> np.ndarray:
        return _scores(study, metric, z)

    return subset_simulation(score, study.space.dimension, bound, **options)


def _scores(study: Study, metric: str, z: np.ndarray) -> np.ndarray:
    """The metric at z (n, dimension), NaN where the run diverges. n is filled up to a power of two: few programs."""
    size = 1 << (len(z) - 1).bit_length()
    values = study.space.normal(np.concatenate([z, np.repeat(z[-1:], size - len(z), axis=0)]))
    with precision(study.dtype):
        keys = jax.vmap(lambda _: noise_key(study.seed, 0))(np.arange(size))
        loop, objective = jax.tree.map(
            lambda x: np.asarray(x, study.dtype), (study.loop, {metric: study.objectives[metric]})
        )
        done = jax.device_get(measure_lanes(loop, values, study.solver, objective, keys=keys))
    return np.asarray(done.metrics[metric], float)[: len(z)]
