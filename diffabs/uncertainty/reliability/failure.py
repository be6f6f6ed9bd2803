"""The probability that a metric of a study exceeds a bound, if it is too small for a count of runs.

`Space.normal` maps standard normal coordinates z to the parameters v. The metric m of the run is the score of
`subset_simulation`. A failure is m > bound, as in a sweep.

The probability is taken over the parameters, given one sequence of sensor noise that all runs share. It covers the
whole space: a point that `simulate` refuses raises an error, since its side of the bound is unknown. On request, the
search for design points uses

    dm/dz_j = sum_i dm/dv_i dv_i/dz_j

The derivative dm/dv passes through the run. The derivative dv/dz costs no run and comes from central differences. A
trial point that `simulate` refuses only shortens a step of the search.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.jax_flags import default_flags
from diffabs.core.types import JsonObject, Params, PyTree, Scalar, Table
from diffabs.core.units import resolve_unit, units_of
from diffabs.engine.drive.batches import describe_placement
from diffabs.engine.drive.engine import describe_engine, log_kernel, log_xla_reason, resolve_request
from diffabs.loop.admissible import batch_admissibility
from diffabs.loop.batch import Batch
from diffabs.loop.ensemble import kernel_objection, run_batch
from diffabs.uncertainty.reliability.importance_sampling import DESIGN_POINT_STARTS, Gradient
from diffabs.uncertainty.reliability.subset_simulation import (
    RareEvent,
    SubsetLevel,
    SubsetProgress,
    check_number,
    subset_simulation,
)
from diffabs.uncertainty.sweep.study import Study, noise_key, precision

DIFFERENCE_STEP = 1e-4  # step in z: relative errors of 1e-9 (truncation) and 1e-12 (rounding)
MAX_LISTED_FAILURES = 5
MAX_BATCH = 1 << 17  # runs; their states and programs' temporaries are in memory at a time

_Level = TypeVar("_Level", SubsetLevel, SubsetProgress)


@default_flags()
def failure_probability(
    study: Study,
    metric: str,
    bound: float,
    *,
    gradients: bool = False,
    progress: Callable[[SubsetProgress], None] | None = None,
    **options: Any,
) -> RareEvent:
    """Return an estimate of P[metric > bound] over the space of a study, with runs on the study's engine.

    The engine "auto" becomes a kernel where one can make the runs. The log says once why XLA makes them, if it does.
    The study's design and its number of samples have no influence; its seed determines the sensor noise only. Runs that
    diverge do not count as failures; the result reports their number.

    Args:
        study: Loop, space, solver and objectives.
        metric: Name of a metric that the study measures.
        bound: Bound on the metric, in its unit.
        gradients: Whether to offer importance sampling design points as centres, found by gradients through the run.
        progress: Called after every level.
        options: Keyword arguments of `subset_simulation`, such as `samples` and the `seed` of the draws.

    Raises:
        ValueError: The metric is not measured, the study draws parts, the bound is no finite number of the study's
            type, or a drawn point cannot be run.
        importance_sampling.DivergenceError: Too many runs diverge.

    See also:
        `reliability.subset_simulation`: The same for any function of standard normal numbers.
        `sweep.sweep`: Frequent failures, by counting.
        `tune.worst_case`: The worst run of a box, without probabilities.

    Notes:
        The estimate is a product of conditional probabilities along levels b_1 < ... < b_m = bound

            P[F] = P[F_1] P[F_2|F_1] ... P[F_m|F_m-1],   F_j = {z: metric(z) >= b_j},   z ~ N(0, I)

        each of which is large enough for a count. Importance sampling then follows if the failures predict that it
        halves the deviation. Sources: S.-K. Au and J. L. Beck, Estimation of small failure probabilities in high
        dimensions by subset simulation, Probab. Eng. Mech. 16 (2001); I. Papaioannou, W. Betz, K. Zwirglmaier and D.
        Straub, MCMC algorithms for subset simulation, ibid. 41 (2015).

    Examples:
        >>> import diffabs as d
        >>> from diffabs import controllers, stops, sweep
        >>> from diffabs.uncertainty import reliability
        >>> parts = {"initial": d.BrakeStart(speed=10.0, slip=1.0), "stop": stops.SpeedReached(speed=5.0)}
        >>> loop = d.braking(controller=controllers.ConstantTorque(torque=500.0), **parts)  # a locked wheel
        >>> space = sweep.Space({"initial.speed": sweep.Normal(10.0, 0.5, low=6.0, high=14.0)})
        >>> study = sweep.Study(loop, space, samples=1, solver=d.FixedStep(5e-3, 6.0))
        >>> event = reliability.failure_probability(study, "stop_time", 0.878)
        >>> print(f"{event.probability:.0e}")  # 1.1e-3 in closed form
        1e-03
    """
    study.check()
    if metric not in study.objectives:
        raise ValueError(f"{metric} is not measured; there is {', '.join(study.objectives)}")
    check_number(
        "bound", bound, resolve_unit(getattr(study.objectives[metric], "unit", ""), units_of(study.loop.plant))
    )
    # `subset_simulation` counts a score at its threshold as a failure, so the threshold is the next number.
    with np.errstate(over="ignore"):
        beyond = float(np.nextafter(np.asarray(bound, study.dtype), np.inf))
    if not np.isfinite(beyond):
        raise ValueError(f"bound = {bound:g} is too great for {study.dtype}")
    if study.parts:
        raise ValueError(f"{', '.join(study.parts)}: alternatives of parts have no normal coordinates")

    is_auto = resolve_request(study.engine) == "auto"
    study, why = choose_metric_engine(study, metric)
    if is_auto:
        log_xla_reason(why) if why else log_kernel()

    def score(z: np.ndarray) -> np.ndarray:
        return _run_scores(study, metric, z)

    gradient = _make_gradient(study, metric) if gradients else None

    def state_bound(level: _Level) -> _Level:
        return level._replace(threshold=float(bound), strict=True) if level.threshold == beyond else level

    def report(level: SubsetProgress) -> None:
        if progress:
            progress(state_bound(level))

    event = subset_simulation(score, study.space.dimension, beyond, gradient=gradient, progress=report, **options)
    return dataclasses.replace(
        event, levels=[state_bound(level) for level in event.levels], engine=describe_engine(study.engine)
    )


def describe_failures(event: RareEvent, study: Study, metric: str, bound: float) -> JsonObject:
    """Return an estimate as JSON values, with the likeliest failures by path in SI, the likeliest first."""
    rows = study.space.normal(event.failing[:MAX_LISTED_FAILURES]) if len(event.failing) else {}
    return {
        "metric": metric,
        "bound": bound,
        "unit": resolve_unit(getattr(study.objectives[metric], "unit", ""), units_of(study.loop.plant)),
        "probability": event.probability,
        "cov": event.cov,
        "interval": list(event.interval),
        "note": event.note,
        "reason": event.reason.value,
        "levels": [level._asdict() for level in event.levels],
        "first level alone": event.plain._asdict(),
        "subset simulation": event.subset._asdict(),
        "importance sampling": event.importance.estimate._asdict() if event.importance else None,
        "failures": {path: column.tolist() for path, column in rows.items()},
        "runs": event.evaluations,
        "gradients": event.gradients,
        "diverged": event.diverged,
        "seed": study.seed,
        "engine": dict(event.engine),
    }


def choose_metric_engine(study: Study, metric: str) -> tuple[Study, str]:
    """Return the study with engine "xla" or "kernel" for runs of one metric, and why "auto" became "xla", or ""."""
    engine, why = resolve_request(study.engine), ""
    if engine == "auto":
        why = describe_placement(()) or find_metric_objection(study, metric) or ""
        engine = "xla" if why else "kernel"
    return dataclasses.replace(study, engine=engine), why


def find_metric_objection(study: Study, metric: str) -> str | None:
    """Return why a kernel cannot make the runs of a study that measures only this metric, or None; it makes no run."""
    values = study.space.normal(np.zeros((1, study.space.dimension)))
    with precision(study.dtype):
        return kernel_objection(*_cast_arguments(study, metric, values))


def _cast_arguments(study: Study, metric: str, values: Params) -> PyTree:
    """Return loop, values, solver and objectives; loop and objectives have the study's number type."""
    numbers = study.loop, {metric: study.objectives[metric]}
    loop, objective = jax.tree.map(lambda x: np.asarray(x, study.dtype), numbers)
    return loop, values, study.solver, objective


def _run_scores(study: Study, metric: str, z: np.ndarray) -> np.ndarray:
    """Return the metric at z (n, dimension), NaN where the run diverges; MAX_BATCH runs are made at a time."""
    if len(z) > MAX_BATCH:
        parts = np.split(z, range(MAX_BATCH, len(z), MAX_BATCH))
        return np.concatenate([_run_scores(study, metric, part) for part in parts])
    # Padding to a power of two keeps the number of batch shapes, and so of compilations, small.
    values = study.space.normal(_pad_with_last(z, 1 << (len(z) - 1).bit_length()))
    _check_runnable(study, values, len(z))
    with precision(study.dtype):
        return np.asarray(_measure_metric(study, metric, values), float)[: len(z)]


def _measure_metric(study: Study, metric: str, values: Params) -> Scalar:
    """Return the metric of runs (n,) that share one sequence of noise."""
    loop, _, solver, objective = _cast_arguments(study, metric, values)
    # The same key for every run, so that the score is a deterministic function of z.
    keys = jax.vmap(lambda _: noise_key(study.seed, 0))(np.arange(Batch(values).size))
    lanes = Batch(values, keys)
    return run_batch(loop, lanes, solver, objective, accepted=True, engine=study.engine).metrics[metric]


def _check_runnable(study: Study, values: Mapping[str, np.ndarray], count: int) -> None:
    """Raise a ValueError of one line if any of the first `count` points cannot be run."""
    refused = batch_admissibility(study.loop, values, study.solver)
    bad = np.flatnonzero(refused.codes[:count])
    if len(bad):
        at = ", ".join(f"{path} = {column[bad[0]]:.6g}" for path, column in values.items())
        why = f"{refused.texts[bad[0]]} (at {at})"
        raise ValueError(f"no probability: {len(bad)} of {count} points cannot be run: {why}; narrow the ranges")


def _make_gradient(study: Study, metric: str) -> Gradient:
    """Return a function z (n, dimension) -> (metric (n,), derivative (n, dimension)), n <= `DESIGN_POINT_STARTS`.

    The metric is -inf at a point that `simulate` refuses.
    """
    slopes = _compile_derivatives(study, metric)

    def gradient(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = study.space.normal(_pad_with_last(z, DESIGN_POINT_STARTS))
        accepted = batch_admissibility(study.loop, values, study.solver).accepted[: len(z)]
        values = {path: column.astype(study.dtype) for path, column in values.items()}
        with precision(study.dtype):
            score, by_value = jax.device_get(slopes(values))
        chain = [by_value[path][: len(z), None] * column for path, column in _parameter_slopes(study, z).items()]
        # Only a trial can be refused, because the starts are failures that were run. A score of -inf makes the search
        # halve its step.
        return np.where(accepted, score[: len(z)], -np.inf).astype(float), np.sum(chain, axis=0)

    return gradient


def _compile_derivatives(study: Study, metric: str) -> Callable[[Table], PyTree]:
    """Return a compiled function from values to the metric of each run and its derivatives by that run's values."""

    def slopes(values: Params) -> Any:
        # Runs are independent, so the gradient of their sum holds each run's own derivative.
        scores, pull = jax.vjp(lambda values: _measure_metric(study, metric, values), values)
        return scores, *pull(jnp.ones_like(scores))

    return jax.jit(slopes)


def _parameter_slopes(study: Study, z: np.ndarray) -> dict[str, np.ndarray]:
    """Return dv/dz (n, dimension) of each parameter; zero for one drawn from a list, except where its value changes."""
    n, d = z.shape
    offsets = DIFFERENCE_STEP * np.eye(d)
    points = np.stack([z[:, None] + offsets, z[:, None] - offsets]).reshape(-1, d)
    ends = {path: column.reshape(2, n, d) for path, column in study.space.normal(points).items()}
    return {path: (above - below) / (2 * DIFFERENCE_STEP) for path, (above, below) in ends.items()}


def _pad_with_last(z: np.ndarray, size: int) -> np.ndarray:
    """Return z with copies of its last row appended, `size` rows in all."""
    return np.concatenate([z, np.repeat(z[-1:], size - len(z), axis=0)])
