"""The probability that a metric of a study exceeds a bound, where it is too small to be counted.

Standard normal coordinates z are mapped to the parameters v by `Space.normal`, and the metric m of the run is the score
of `rare.subset_simulation`. All runs share one sequence of sensor noise: the probability is that over the parameters,
given this noise. It is of the whole space: where `simulate` would refuse a point there is no answer, since no run says
on which side of the bound it lies. If asked for, design points are found by

    dm/dz_j = sum_i dm/dv_i dv_i/dz_j

with dm/dv through the run in reverse mode, or forward by a kernel, and dv/dz, which costs no run, by central
differences."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.reliability.importance_sampling import DESIGN_POINT_STARTS, Gradient
from diffabs.reliability.subset_simulation import RareEvent, subset_simulation
from diffabs.simulate.admissible import batch_admissibility
from diffabs.simulate.batch import Batch, run_batch
from diffabs.sweep.study import Study, noise_key, precision

DIFFERENCE_STEP = 1e-4  # of the differences in z: errors of 1e-9 and 1e-12 of the values


def failure_probability(
    study: Study, metric: str, bound: float, *, gradients: bool = False, **options: Any
) -> RareEvent:
    """Return an estimate of P[metric >= bound] over the space of a study, whose design and samples do not matter. Runs
    are made by the study's engine.

    metric: a name of what the study measures
    gradients: also draw around design points, found by gradients through the run
    options: those of `subset_simulation`; runs that diverge do not count as failures and are reported

    >>> import diffabs as d
    >>> from diffabs import controllers, reliability, stops, sweep
    >>> parts = {"initial": d.BrakeStart(speed=10.0, slip=1.0), "stop": stops.SpeedReached(speed=5.0)}
    >>> loop = d.braking(controller=controllers.ConstantTorque(torque=500.0), **parts)  # a locked wheel
    >>> space = sweep.Space({"initial.speed": sweep.Normal(10.0, 0.5, low=6.0, high=14.0)})
    >>> study = sweep.Study(loop, space, samples=1, solver=d.FixedStep(5e-3, 6.0))
    >>> found = reliability.failure_probability(study, "stop_time", 0.878)
    >>> print(f"{found.probability:.0e}")  # 1.1e-3 in closed form
    1e-03

    Raises ValueError for a metric that is not measured, for a study that draws parts, for a bound that is not finite,
    for a point that is drawn and cannot be run, and (`importance_sampling.Diverged`) where too many runs diverge.
    """
    study.check()
    if metric not in study.objectives:
        raise ValueError(f"{metric} is not measured; there is {', '.join(study.objectives)}")
    if study.parts:
        raise ValueError(f"{', '.join(study.parts)}: alternatives of parts have no normal coordinates")

    def score(z: np.ndarray) -> np.ndarray:
        return _run_scores(study, metric, z)

    gradient = _make_gradient(study, metric) if gradients else None
    return subset_simulation(score, study.space.dimension, bound, gradient=gradient, **options)


def find_metric_objection(study: Study, metric: str) -> str | None:
    """Return why a kernel cannot make these runs, or None. None is made, but what makes them is compiled.

    Raises ValueError for what cannot be run at all."""
    from diffabs.simulate import native

    values = study.space.normal(np.zeros((1, study.space.dimension)))
    with precision(study.dtype):
        return native.kernel_objection(*_cast_arguments(study, metric, values))


def _cast_arguments(study: Study, metric: str, values: Mapping[str, Any]) -> Any:
    """Loop, values, solver and objectives, of the study's type."""
    given = study.loop, {metric: study.objectives[metric]}
    loop, objective = jax.tree.map(lambda x: np.asarray(x, study.dtype), given)
    return loop, values, study.solver, objective


def _run_scores(study: Study, metric: str, z: np.ndarray) -> np.ndarray:
    """The metric at z (n, dimension), NaN where the run diverges. n is filled up to a power of two: few programs."""
    values = study.space.normal(_pad_with_last(z, 1 << (len(z) - 1).bit_length()))
    _check_runnable(study, values, len(z))
    with precision(study.dtype):
        return np.asarray(_measure_metric(study, metric, values), float)[: len(z)]


def _measure_metric(study: Study, metric: str, values: Mapping[str, Any]) -> Any:
    """The metric of lanes (n,) that share one sequence of noise."""
    loop, _, solver, objective = _cast_arguments(study, metric, values)
    keys = jax.vmap(lambda _: noise_key(study.seed, 0))(np.arange(Batch(values).size))
    lanes = Batch(values, keys)
    return run_batch(loop, lanes, solver, objective, accepted=True, engine=study.engine).metrics[metric]


def _check_runnable(study: Study, values: Mapping[str, np.ndarray], count: int) -> None:
    """Raises ValueError, in a line, for points of which the first `count` cannot all be run."""
    refused = batch_admissibility(study.loop, values, study.solver)
    bad = np.flatnonzero(refused.codes[:count])
    if len(bad):
        at = ", ".join(f"{path} = {column[bad[0]]:.6g}" for path, column in values.items())
        why = f"{refused.texts[bad[0]]} (at {at})"
        raise ValueError(f"no probability: {len(bad)} of {count} points cannot be run: {why}; narrow the ranges")


def _make_gradient(study: Study, metric: str) -> Gradient:
    """The metric (n,) and its derivative (n, dimension) at z (n, dimension), n at most STARTS."""
    slopes = _compile_derivatives(study, metric)

    def gradient(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = study.space.normal(_pad_with_last(z, DESIGN_POINT_STARTS))
        _check_runnable(study, values, len(z))
        values = {path: column.astype(study.dtype) for path, column in values.items()}
        with precision(study.dtype):
            score, by_value = jax.device_get(slopes(values))
        chain = [by_value[path][: len(z), None] * column for path, column in _parameter_slopes(study, z).items()]
        return np.array(score[: len(z)], float), np.sum(chain, axis=0)

    return gradient


def _compile_derivatives(study: Study, metric: str) -> Callable[[Mapping[str, Any]], Any]:
    """The metric of a batch of values, and its derivative in each: in reverse, by a kernel forward. Compiled once."""

    def forward(values: Mapping[str, Any]) -> Any:
        def along(way: Mapping[str, Any]) -> Any:
            return jax.jvp(lambda values: _measure_metric(study, metric, values), (values,), (way,))

        rows = dict(zip(values, np.eye(len(values)), strict=True))
        ways = {path: jnp.outer(rows[path], jnp.ones_like(column)) for path, column in values.items()}
        scores, rates = jax.vmap(along, out_axes=(None, 0))(ways)
        return scores, dict(zip(values, rates, strict=True))

    def slopes(values: Mapping[str, Any]) -> Any:
        scores, pull = jax.vjp(lambda values: _measure_metric(study, metric, values), values)
        return scores, *pull(jnp.ones_like(scores))

    return jax.jit(forward if study.engine == "kernel" else slopes)


def _parameter_slopes(study: Study, z: np.ndarray) -> dict[str, np.ndarray]:
    """dv/dz (n, dimension) of each parameter: zero for lists of values, but next to their edges."""
    n, d = z.shape
    offsets = DIFFERENCE_STEP * np.eye(d)
    points = np.stack([z[:, None] + offsets, z[:, None] - offsets]).reshape(-1, d)
    ends = {path: column.reshape(2, n, d) for path, column in study.space.normal(points).items()}
    return {path: (above - below) / (2 * DIFFERENCE_STEP) for path, (above, below) in ends.items()}


def _pad_with_last(z: np.ndarray, size: int) -> np.ndarray:
    """With copies of the last row."""
    return np.concatenate([z, np.repeat(z[-1:], size - len(z), axis=0)])
