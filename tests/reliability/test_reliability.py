"""Rare failures of a study: against a count where they are not rare, and against a closed form where they are."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from scipy.stats import binomtest, norm
from seams import replace_seam

import diffabs as d
from diffabs import controllers, objectives, plants, stops
from diffabs.scenario.defaults import braking
from diffabs.uncertainty.reliability.failure import _make_gradient, _run_scores, describe_failures, failure_probability
from diffabs.uncertainty.reliability.importance_sampling import design_points
from diffabs.uncertainty.sweep import Normal, Space, Study, Triangular, Uniform
from diffabs.uncertainty.sweep.variables import Correlation

RIG = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=30 / 3.6),
    stop=stops.SpeedReached(speed=27 / 3.6),
    controller=controllers.StateFeedback(),
    feedforward=controllers.HoldingInput(),
)
SPACE = Space({"plant.road.w4": Normal(0.4, 0.01, low=0.3), "plant.mass": Uniform(5.3, 6.2)})
STUDY = Study(
    loop=RIG,
    space=SPACE,
    samples=1,
    solver=d.FixedStep(2e-3, 1.0),
    objectives={"max_slip": objectives.MaxSlip(), "stop_distance": objectives.StopDistance()},
)


@pytest.mark.slow
def test_scores_are_runs():
    z = np.array([[0.0, 0.0], [-2.0, 1.0], [3.0, -1.0]])
    found = _run_scores(STUDY, "stop_distance", z)
    for i, value in enumerate(found):
        values = {path: column[i] for path, column in SPACE.normal(z).items()}
        distance = {"stop_distance": STUDY.objectives["stop_distance"]}
        alone = d.measure(d.replace(RIG, values), STUDY.solver, distance).metrics["stop_distance"]
        assert value == pytest.approx(float(alone), rel=1e-12)


@killed_by(
    "uncertainty.reliability.failure", "(above - below) / (2 * DIFFERENCE_STEP)", "(above - below) / (above - below)"
)
@pytest.mark.slow
@pytest.mark.parametrize("metric", ["stop_distance", pytest.param("max_slip", marks=pytest.mark.slow)])
def test_slopes_are_differences_of_runs(metric):
    """Of a normal variable, a uniform one and a triangular one, two of which depend on each other."""
    space = Space(
        {**SPACE.variables, "controller.gain.0": Triangular(-13e3, -12e3, -11e3)},
        Correlation(("plant.road.w4", "plant.mass"), [[1.0, 0.6], [0.6, 1.0]]),
    )
    study = dataclasses.replace(STUDY, space=space, solver=dataclasses.replace(STUDY.solver, kinks=True))
    z = np.array([[0.0, 0.0, 0.3], [-2.0, 1.0, -1.0], [1.0, -1.0, 2.0]])
    score, slope = _make_gradient(study, metric)(z)
    np.testing.assert_allclose(score, _run_scores(study, metric, z), rtol=1e-10)
    for j, offset in enumerate(1e-4 * np.eye(3)):
        ends = _run_scores(study, metric, z + offset), _run_scores(study, metric, z - offset)
        difference = (ends[0] - ends[1]) / 2e-4
        # 1e-8 of the curvature, and the rounding of the metric in 1e-4
        np.testing.assert_allclose(slope[:, j], difference, rtol=1e-5, atol=1e-9, err_msg=f"z_{j}")


@killed_by("uncertainty.reliability.failure", "if gradients else None", "if False else None")
@pytest.mark.slow
def test_gradients_lead_to_the_design_point_of_a_slippery_road():
    """Where the distance reaches the bound nearest to the mean: at w4 = 0.4 - 0.01 * 4, whatever the mass."""
    bound = float(_run_scores(STUDY, "stop_distance", np.array([[-4.0, 0.0]]))[0])
    found = failure_probability(STUDY, "stop_distance", bound, samples=400, draws=400, gradients=True)
    assert found.interval[0] < norm.cdf(-4.0) < found.interval[1]
    assert found.gradients > 0
    assert found.cost == found.evaluations + 3 * found.gradients
    points = design_points(_make_gradient(STUDY, "stop_distance"), found.failing[:8], bound)
    np.testing.assert_allclose(points[0], [-4.0, 0.0], atol=0.05)


@pytest.mark.slow
def test_the_probability_of_a_slippery_road():
    """Stopping distance falls with w4, so that it exceeds its value at w4 = 0.4 - 0.01 b with probability Phi(-b)."""
    bound = float(_run_scores(STUDY, "stop_distance", np.array([[-4.0, 0.0]]))[0])
    spread = np.ptp(_run_scores(STUDY, "stop_distance", np.array([[-4.0, -2.0], [-4.0, 2.0]])))
    steep = np.ptp(_run_scores(STUDY, "stop_distance", np.array([[-4.1, 0.0], [-3.9, 0.0]])))
    assert spread < 0.03 * steep  # of 0.2 deviations: the mass moves the exponent by a per cent
    found = failure_probability(STUDY, "stop_distance", bound, samples=400, draws=400)
    assert found.interval[0] < norm.cdf(-4.0) < found.interval[1]
    assert found.probability == pytest.approx(norm.cdf(-4.0), rel=0.5)


@killed_by("uncertainty.reliability.failure", "np.nextafter(np.asarray(bound, study.dtype), np.inf)", "bound")
@killed_by("uncertainty.reliability.failure", "np.asarray(bound, study.dtype)", "bound", case="0.1-float32")
@killed_by(
    "uncertainty.reliability.failure",
    "np.nextafter(np.asarray(bound, study.dtype), np.inf)",
    "np.asarray(bound * (1 + 2e-7), study.dtype)",
    case="0.0-float64",
)
@killed_by(
    "uncertainty.reliability.failure",
    "np.nextafter(np.asarray(bound, study.dtype), np.inf)",
    "np.asarray(bound * (1 + 2e-7), study.dtype)",
    case="-0.1-float64",
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("bound", [0.1, 0.0, -0.1])
def test_a_metric_at_its_bound_has_not_failed(bound, dtype, monkeypatch):
    """A tenth of the masses is above 6.11 kg and exceeds the bound; all others are at the bound."""

    def measure(study, metric, at):
        return np.where(at["plant.mass"] > 6.11, 1.0, bound).astype(study.dtype)

    replace_seam(monkeypatch, "measure_metric", measure)
    found = failure_probability(dataclasses.replace(STUDY, dtype=dtype), "max_slip", bound, samples=400)
    low, high = binomtest(40, 400).proportion_ci(0.999)
    assert low < found.probability < high
    assert [level.threshold for level in found.levels] == [bound]


@killed_by(
    "uncertainty.reliability.failure", "strict=True) if level.threshold == beyond", ") if level.threshold == beyond"
)
@killed_by("uncertainty.reliability.failure", "if level.threshold == beyond", "if level.threshold >= bound")
@killed_by("uncertainty.reliability.failure", "progress(state_bound(level))", "progress(level)")
@killed_by("uncertainty.reliability.failure", "event.failing[:MAX_LISTED_FAILURES]", "event.failing")
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_level_states_whether_its_bound_is_exceeded(dtype, monkeypatch):
    """Three tenths of the masses are at the bound or above it, and a hundredth above it: a level each."""

    def measure(study, metric, at):
        score = np.where(at["plant.mass"] > 6.191, 1.0, np.where(at["plant.mass"] > 5.93, 0.1, 0.0))
        return score.astype(study.dtype)

    replace_seam(monkeypatch, "measure_metric", measure)
    told = []
    found = failure_probability(
        dataclasses.replace(STUDY, dtype=dtype), "max_slip", 0.1, samples=400, draws=0, progress=told.append
    )
    first, last = found.levels
    assert (first.strict, last.strict, last.threshold) == (False, True, 0.1)
    assert first.threshold == np.asarray(0.1, dtype)
    assert first.share == pytest.approx(0.3, abs=4 * (0.3 * 0.7 / 400) ** 0.5)
    assert found.probability == pytest.approx(0.01, rel=0.8)
    assert [(one.threshold, one.share, one.strict) for one in told] == [
        (one.threshold, one.share, one.strict) for one in found.levels
    ]
    record = json.loads(json.dumps(describe_failures(found, STUDY, "max_slip", 0.1)))
    assert (record["metric"], record["unit"], record["probability"]) == ("max_slip", "1", found.probability)
    assert [row["threshold"] for row in record["levels"]] == [first.threshold, 0.1]
    assert min(record["failures"]["plant.mass"]) > 6.191  # in kg, and at most five of them
    assert len(record["failures"]["plant.mass"]) <= 5


@killed_by("uncertainty.reliability.failure", "np.where(accepted, score[: len(z)], -np.inf)", "score[: len(z)]")
@pytest.mark.slow
def test_a_refused_trial_shortens_the_search(monkeypatch):
    """The tangent of tanh leads from a failure far below the speed at which a run stops: no metric means a thing."""
    bound = float(np.tanh(4 * 0.5))  # at 3.5 standard deviations

    def measure(study, metric, at):
        speed = at["initial.speed"]
        return jnp.where(speed > RIG.stop.speed, jnp.tanh(4 * ((speed - 10.0) / 0.5 - 3)), bound)

    replace_seam(monkeypatch, "measure_metric", measure)
    study = dataclasses.replace(STUDY, space=Space({"initial.speed": Normal(10.0, 0.5, low=1.0, high=19.0)}))
    found = failure_probability(study, "max_slip", bound, samples=400, draws=400, gradients=True)
    assert found.interval[0] < norm.sf(3.5) < found.interval[1]
    assert found.diverged == 0
    points = design_points(_make_gradient(study, "max_slip"), np.array([[4.5]]), bound)
    np.testing.assert_allclose(points, [[3.5]], atol=0.1)


@killed_by("uncertainty.reliability.failure", "if not np.isfinite(beyond):", "if False:")
def test_what_is_not_there_is_said():
    with pytest.raises(ValueError, match="overshoot is not measured; there is max_slip, stop_distance"):
        failure_probability(STUDY, "overshoot", 0.5)
    with pytest.raises(ValueError, match=r"bound = '0.9' is text; a number in \(-inf, inf\) m is needed"):
        failure_probability(STUDY, "stop_distance", "0.9")
    with pytest.raises(ValueError, match=r"bound = nan is outside \(-inf, inf\) m"):
        failure_probability(STUDY, "stop_distance", np.nan)
    with pytest.raises(ValueError, match=r"^bound = 1e\+39 is too great for float32$"):
        failure_probability(dataclasses.replace(STUDY, dtype="float32"), "stop_distance", 1e39)
