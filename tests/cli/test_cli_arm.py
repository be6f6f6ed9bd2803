"""The two-wheeler on the command line: its scenarios, what is said of a fall, and of parts that do not fit."""

import csv
import json
import math

import numpy as np
import pytest
from commands import assert_one_error_line, run
from mutants import killed_by

from diffabs import FixedStep, stops
from diffabs.parts.objectives import BALANCE
from diffabs.scenario import section_sweep
from diffabs.scenario.scenario import load
from diffabs.tune import worst_case
from diffabs.tune.tuning import build_problem
from diffabs.uncertainty.sweep import Space, Study, Uniform
from diffabs.uncertainty.sweep.study import has_wrong_end

METRICS = {"settling_time", "peak_lean", "peak_arm_angle", "peak_voltage", "peak_torque", "final_norm", "fell"}
SHORT = ("--set", "solver.duration=0.02")


pytestmark = pytest.mark.usefixtures("any_step_is_stable")  # it has tests of its own


@pytest.fixture(scope="module")
def falling(tmp_path_factory):
    path = tmp_path_factory.mktemp("falling") / "a.csv"
    result = run("simulate", "arm-balance", "--json", "--csv", path)
    return result, json.loads(result.stdout), path


@pytest.mark.slow
def test_the_papers_start_falls_and_that_is_said(falling):
    """A result, and not a failure of the program: status 0."""
    result, document, _ = falling
    assert list(document["metrics"]) == list(BALANCE)
    assert set(document["metrics"]) == METRICS
    assert (document["metrics"]["fell"], document["stopped"], document["diverged"]) == (1.0, True, False)
    assert document["metrics"]["peak_lean"] == pytest.approx(math.pi / 2, abs=1e-9)
    assert document["metrics"]["peak_voltage"] == 48.0
    assert document["metrics"]["peak_torque"] <= 30 * (48 + 30 * 10) / 3
    assert [line for line in result.stderr.splitlines() if line.startswith("warning: ")] == [
        "warning: FELL: the frame reached the stop's angle",
        "warning: settling_time is infinite: the run ends before the event that it measures",
        "warning: the control is at a limit (-48 to 48 V) for 100 % of the run: gains hardly matter there",
    ]


@pytest.mark.slow
def test_every_column_has_its_unit(falling):
    """And the last row is the fall."""
    header, *rows = csv.reader(falling[2].read_text().splitlines())
    angles = [f"{name} [rad]" for name in ("theta", "psi", "phi")]
    rates = [f"{name}_rate [rad/s]" for name in ("theta", "psi", "phi")]
    assert header[:7] == ["t [s]", *angles, *rates]
    assert header[-5:] == ["target [rad]", "setpoint [rad]", "feedforward [V]", "command [V]", "control [V]"]
    first, last = (dict(zip(header, map(float, row), strict=True)) for row in (rows[0], rows[-1]))
    assert (first["theta [rad]"], first["phi [rad]"], first["psi [rad]"]) == (0.5, 0.2, 0.0)
    assert last["theta [rad]"] == pytest.approx(math.pi / 2, abs=1e-9)
    assert (last["t [s]"]) == pytest.approx(0.649256, abs=1e-5)
    assert falling[1]["metrics"]["settling_time"] is None  # never


@pytest.mark.slow
def test_the_hanging_arm_stays_up():
    """Peaks of an independent solution, to the digits that it gives; nothing is said of a stop that is not wanted."""
    result = run("simulate", "arm-hanging", "--json")
    document = json.loads(result.stdout)
    assert document["metrics"]["peak_lean"] == pytest.approx(0.03987, abs=6e-6)
    assert document["metrics"]["peak_arm_angle"] == pytest.approx(0.58744, abs=6e-6)
    assert document["metrics"]["final_norm"] < 1e-6
    assert (document["metrics"]["fell"], document["stopped"]) == (0.0, False)
    assert "warning" not in result.stderr
    assert "STOPPED" not in result.stderr


@pytest.mark.slow
def test_a_rider_whom_the_spring_cannot_hold_is_a_warning():
    result = run("simulate", "arm-hanging", *SHORT, "--set", "plant.stiffness=294")
    assert "warning: plant.stiffness = 294 N m/rad does not hold the rider" in result.stderr
    assert "m3 g hg = 294.3 N m/rad" in result.stderr
    assert "plant.stiffness" not in run("simulate", "arm-hanging", *SHORT, "--set", "plant.stiffness=295").stderr


def test_a_gain_of_the_wrong_length_is_one_line():
    """The ranges of [tune] do not fit it either, but that is not what is wrong."""
    result = run("simulate", "arm-hanging", "--set", "controller.gain=1,2", status=2)
    assert_one_error_line(result)
    assert "controller.gain has shape (2,); it needs (6,)" in result.stderr


def test_an_arms_controller_on_a_wheel_is_one_line():
    result = run("simulate", "slip-lmi", "--set", "controller=balance-feedback", status=2)
    assert_one_error_line(result)
    assert "balance-feedback needs theta" in result.stderr


@pytest.mark.slow
def test_design_proves_one_gain_for_all_riders():
    document = json.loads(run("design", "arm-hanging", "--json").stdout)
    assert document["quadratically_stable"] is True
    assert document["verified_exactly"] is True
    assert (document["vertices"], document["period"]) == (27, None)
    assert document["states"] == ["theta", "psi", "phi", "theta_rate", "psi_rate", "phi_rate"]
    assert any("between the points of the grid" in line for line in document["neglected"])
    assert any("voltage limit of 48 V" in line for line in document["neglected"])


def test_certify_disproves_the_gain_for_one_rider():
    result = run("certify", "arm-hanging", "--json", status=1)
    document = json.loads(result.stdout)
    assert document["quadratically_stable"] is False
    assert document["verified_exactly"] is True
    assert document["worst_vertex"]["corner"]["plant.rider_mass"] == 100.0
    assert "quadratic stability is disproved" in result.stderr


@killed_by("uncertainty.sweep.study", "return np.asarray(stopped) != success", "return ~np.asarray(stopped)")
def test_a_stop_that_is_a_fall_is_not_missed():
    stopped = np.array([True, False])
    np.testing.assert_array_equal(has_wrong_end(stopped, stops.Fallen.success), [True, False])
    np.testing.assert_array_equal(has_wrong_end(stopped, stops.Standstill.success), [False, True])
    study = section_sweep.build_study(load("arm-hanging", ("sweep.failures={peak_lean=0.3}",)))
    assert (study.failure_bounds, study.success) == ({"fell": 0.0, "peak_lean": 0.3}, False)


def test_without_objectives_an_arm_is_measured_as_one():
    """Those of braking have no `fell`, and ask an arm for its slip."""
    loop, solver = load("arm-hanging").loop, FixedStep(step=1e-3, duration=0.02)
    free = {"controller.gain": (-1e5, 1e5)}
    assert build_problem(loop, free=free, objective={"fell": 1.0}, solver=solver).measured == BALANCE
    space = Space({"plant.rider_mass": Uniform(40.0, 100.0)})
    assert Study(loop, space, samples=2, solver=solver).objectives == BALANCE
    with pytest.raises(ValueError, match=r"stop_distance is not measured; there is .*fell"):
        worst_case(loop, over={"initial.theta": (0.0, 0.01)}, metric="stop_distance", solver=solver)


@pytest.mark.slow
def test_a_sweep_counts_falls_and_nothing_else(tmp_path):
    """Lanes that are upright to the end have not reached their stop, and have not failed."""
    pandas = pytest.importorskip("pandas")
    out = tmp_path / "out"
    changes = ("--samples", "64", "--set", "solver.duration=3", "--json")
    document = json.loads(run("sweep", "arm-hanging", "--out", out, *changes).stdout)
    table = pandas.concat(pandas.read_parquet(path) for path in sorted((out / "chunks").glob("*.parquet")))
    fallen = int((table["fell"] == 1).sum())
    assert len(table) == 64
    assert 0 < fallen < 64
    assert set(table["fell"]) == {0.0, 1.0}
    np.testing.assert_array_equal(table["fell"] == 1, table["stopped"])
    counts = {name: row["count"] for name, row in document["failures"].items()}
    assert counts == {"diverged": 0, "stopped": fallen, "fell > 0": fallen, "any": fallen}


@pytest.mark.parametrize("name", ["arm-balance", "arm-hanging"])
def test_the_packaged_gain_is_the_designs(name):
    """LQR of the weights in its own [design], to the printed digits, by SciPy."""
    import scipy.linalg

    from diffabs.linear.balance_model import BalanceModel

    s = load(name)
    a, b = (np.asarray(x) for x in BalanceModel(plant=s.loop.plant).matrices())
    q, r = np.diag(s.design.Q), np.atleast_2d(s.design.R)
    gain = -np.linalg.solve(r, b.T @ scipy.linalg.solve_continuous_are(a, b, q, r))[0]
    np.testing.assert_allclose(s.loop.controller.gain, gain, rtol=1e-6, atol=0)


@pytest.mark.slow
def test_a_sweep_keeps_trajectories_of_whatever_its_plant_shows(tmp_path):
    """An arm has no slip, and its control is a voltage."""
    import zarr

    small = ("--samples", "4", "--set", "solver.step=0.01", "--set", "solver.duration=0.1")
    run("sweep", "arm-hanging", *small, "--keep", "3", "--out", tmp_path / "out")
    group = zarr.open_group(tmp_path / "out" / "trajectories.zarr", mode="r")
    units = {"theta": "rad", "phi_rate": "rad/s", "target": "rad", "command": "V", "control": "V", "time": "s"}
    assert {name: group[name].attrs["units"] for name in units} == units
    assert group["theta"].shape == (1, 11)
