"""Rare failures of a study: against a count where they are not rare, and against a closed form where they are."""

import numpy as np
import pytest
from scipy.stats import norm

import diffabs as d
from diffabs import controllers, objectives, plants, stops
from diffabs.sweep import Normal, Space, Study, Uniform
from diffabs.sweep.reliability import _scores, failure_probability

RIG = d.Loop(
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


def test_scores_are_runs():
    z = np.array([[0.0, 0.0], [-2.0, 1.0], [3.0, -1.0]])
    found = _scores(STUDY, "stop_distance", z)
    for i, value in enumerate(found):
        values = {path: column[i] for path, column in SPACE.normal(z).items()}
        alone = d.measure(d.replace(RIG, values), STUDY.solver, STUDY.objectives).metrics["stop_distance"]
        assert value == pytest.approx(float(alone), rel=1e-12)


@pytest.mark.slow
def test_the_probability_of_a_slippery_road():
    """Stopping distance falls with w4, so that it exceeds its value at w4 = 0.4 - 0.01 b with probability Phi(-b)."""
    bound = float(_scores(STUDY, "stop_distance", np.array([[-4.0, 0.0]]))[0])
    spread = np.ptp(_scores(STUDY, "stop_distance", np.array([[-4.0, -2.0], [-4.0, 2.0]])))
    steep = np.ptp(_scores(STUDY, "stop_distance", np.array([[-4.1, 0.0], [-3.9, 0.0]])))
    assert spread < 0.03 * steep  # of 0.2 deviations: the mass moves the exponent by a per cent
    found = failure_probability(STUDY, "stop_distance", bound, samples=400, draws=400)
    assert found.interval[0] < norm.cdf(-4.0) < found.interval[1]
    assert found.probability == pytest.approx(norm.cdf(-4.0), rel=0.5)


def test_what_is_not_there_is_said():
    with pytest.raises(ValueError, match="overshoot is not measured; there is max_slip, stop_distance"):
        failure_probability(STUDY, "overshoot", 0.5)
