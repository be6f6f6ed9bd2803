"""Figures of tunings: what is drawn are the numbers handed in."""

import numpy as np
import pytest
from mutants import killed_by

from diffabs.core.protocols import BrakeOutput, Sample
from diffabs.linear import OpenLoop, Transfer
from diffabs.loop.result import Trajectory
from diffabs.output.plot import tuning as plots
from diffabs.tune import DescentPoint, FrequencyBounds

HISTORY = [DescentPoint(i, 10.0 ** (1 - i), 1.0, 10.0**-i, max(0.0, 0.2 - 0.1 * i), 2 * i + 1) for i in range(5)]


def trajectory(rate: float) -> Trajectory:
    """Slip that settles exponentially into 0.2."""
    t = np.linspace(0.0, 2.0, 201)
    slip, speed = 0.2 * (1 - np.exp(-rate * t)), 20.0 - 8.0 * t
    output = BrakeOutput(slip, speed, speed * (1 - slip), 8.0 + 0 * t, 20.0 * t - 4 * t**2)
    setpoint = np.full(len(t), 0.2)
    return Trajectory(Sample(t, output, setpoint, setpoint, 0 * t, rate * t, rate * t), output, None, t < 2)


SLOW, FAST = trajectory(10.0), trajectory(40.0)
RUNS = {"before": SLOW, "after": FAST}


def lines(ax):
    return {line.get_label(): np.array(line.get_data(), float) for line in ax.get_lines()}


@pytest.mark.slow
def test_history_is_over_the_gradients_computed(tmp_path):
    figure = plots.draw_tuning(HISTORY, RUNS)
    objective, gradient, _, _, violation = figure.axes
    np.testing.assert_array_equal(objective.get_lines()[0].get_data(), [[1, 3, 5, 7, 9], [10, 1, 0.1, 0.01, 0.001]])
    np.testing.assert_allclose(gradient.get_lines()[0].get_data()[1], 10.0 ** -np.arange(5.0), rtol=1e-15)
    np.testing.assert_allclose(violation.get_lines()[0].get_data()[1], [0.2, 0.1, 0, 0, 0], rtol=0, atol=1e-15)
    assert (objective.get_yscale(), gradient.get_yscale()) == ("log", "log")
    figure.savefig(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_an_objective_of_either_sign_has_a_linear_axis():
    little = [point._replace(objective=40 + point.gradient, violation=0.0) for point in HISTORY]
    negative = [point._replace(objective=point.objective - 1) for point in HISTORY]
    drawn = [plots.draw_tuning(points, RUNS).axes for points in (little, negative)]
    assert [axes[0].get_yscale() for axes in drawn] == ["linear"] * 2
    assert len(drawn[0]) == 4  # without an axis for the violation


def test_tuning_has_history_and_both_runs():
    axes = plots.draw_tuning(HISTORY, RUNS, title="T", lane="plant.mass = 6").axes
    slip, torque = axes[2], axes[3]
    np.testing.assert_array_equal(lines(slip)["after"], [FAST.sample.t, FAST.sample.output.slip])
    np.testing.assert_array_equal(lines(torque)["before"], [SLOW.sample.t, SLOW.sample.control])
    assert slip.get_title() == "worst lane: plant.mass = 6"


def test_runs_are_shown_until_they_have_settled():
    """To 2 % after ln(50)/10 s."""
    for ax in plots.draw_tuning(HISTORY, RUNS).axes[2:4]:
        assert ax.get_xlim()[1] == pytest.approx(1.5 * np.log(50) / 10, abs=0.02)


@killed_by("output.plot.tuning", "        if y[i] < lowest:", "        if True:")
def test_a_front_has_the_points_that_no_other_beats():
    x, y = np.random.default_rng(2).random((2, 60)).round(2)
    x[5] = np.nan
    beaten = [
        any((x[j] <= x[i]) & (y[j] <= y[i]) & ((x[j] < x[i]) | (y[j] < y[i])) for j in range(60)) for i in range(60)
    ]
    expected = {(x[i], y[i]) for i in range(60) if not beaten[i] and np.isfinite(x[i])}
    found = plots.pareto_front(x, y)
    assert {(x[i], y[i]) for i in found} == expected
    assert (np.diff(x[found]) > 0).all()
    assert plots.pareto_front([np.nan], [1.0]).size == 0


def test_pareto_joins_the_front_and_shows_the_rest():
    ax = plots.draw_pareto(
        {"gain": ([1.0, 2.0, 3.0, 2.5], [5.0, 3.0, 2.0, 4.0])}, marks={"published": (2.0, 4.0)}
    ).axes[0]
    np.testing.assert_array_equal(lines(ax)["gain"], [[1, 2, 3], [5, 3, 2]])
    np.testing.assert_array_equal(lines(ax)["published"], [[2], [4]])
    assert "stopping distance" in ax.get_ylabel()
    assert "effort" in ax.get_xlabel()


@killed_by("output.plot.frequency", "ax.plot(w, values.max(axis=0)", "ax.plot(w, values.min(axis=0)")
def test_sensitivities_over_a_box_are_drawn_with_their_bounds():
    """Of L = k/(s (s + 1)), |S| = |s (s + 1)/(s^2 + s + k)| and |T| = |k/(s^2 + s + k)|."""

    def loop(k):
        integrator = Transfer(np.zeros((1, 1)), np.eye(1), np.eye(1), np.zeros((1, 1)))
        lag = Transfer(-np.eye(1), np.eye(1), np.array([[-k]]), np.zeros((1, 1)))
        return OpenLoop(integrator, lag, 0.0)

    bounds = FrequencyBounds(sensitivity=1.6, shape=((0.1, 0.2), (10.0, 2.0)))
    boxes = {"before": [loop(1.0), loop(4.0)], "after": [loop(0.5)]}
    *_, sensitivity, complementary = plots.draw_tuning(HISTORY[:1], RUNS, bounds=bounds, boxes=boxes).axes[:6]
    w = lines(sensitivity)["before"][0]
    s = 1j * w
    for name, gains in {"before": (1.0, 4.0), "after": (0.5,)}.items():
        expected = np.array([[abs(s * (s + 1)), np.full(len(w), k)] / abs(s**2 + s + k) for k in gains]).max(axis=0)
        np.testing.assert_allclose([lines(ax)[name][1] for ax in (sensitivity, complementary)], expected, rtol=1e-9)
    np.testing.assert_array_equal(lines(sensitivity)["bound 1.6"][1], 1.6)
    np.testing.assert_allclose(lines(sensitivity)["shape"][1], np.clip(0.2 * (w / 0.1) ** 0.5, 0.2, 2.0), rtol=1e-9)
    assert "bound" not in " ".join(lines(complementary))
