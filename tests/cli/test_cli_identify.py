"""`diffabs identify`: measured runs as files, what is found in them, and how it fails."""

import json
import sys
import types

import numpy as np
import pytest
from commands import assert_one_error_line, left_in, run
from marks import readable_id
from mutants import killed_by
from seams import replace_seam
from small_scenarios import IDENTIFY as SMALL

import diffabs.tune.identify.identification as library
from diffabs.cli import identify_options
from diffabs.core.protocols import BrakeOutput
from diffabs.scenario.measurements import read_measurements
from diffabs.scenario.scenario import ScenarioError, load
from diffabs.tune import Reason
from diffabs.tune.identify.fit import Identified
from diffabs.tune.identify.uncertainty import uncertainty

KEYS = [
    *(
        "format",
        "scenario",
        "model",
        "made",
        "data",
        "values",
        "correlations",
        "notes",
        "undetermined",
        "residuals",
        "chi2",
        "degrees",
        "scale",
        "reason",
    ),
    *("evaluations", "parameters", "versions", "files", "interrupted"),
]
UNITS = BrakeOutput.units
HEADER = "t [s],wheel_speed [m/s],slip [1],command [N m]"
ROWS = ["0,13.8,0.0,1", "0.1,12.9,0.05,1", "0.3,11.0,0.1,2"]


pytestmark = pytest.mark.usefixtures("any_step_is_stable")  # it has tests of its own


@pytest.fixture
def csv(tmp_path):
    """Write a table."""

    def write(*lines: str):
        (tmp_path / "run.csv").write_text("\n".join(lines) + "\n")
        return tmp_path / "run.csv"

    return write


@pytest.fixture
def small(file):
    return file(SMALL, "small.toml")


# Readings


@killed_by("scenario.measurements", "    for i in used:", "    for i in range(len(row)):")
def test_readings_are_what_is_in_the_file(csv):
    """The column of commands is not read, whatever it holds."""
    rows = (row[:-1] + cell for row, cell in zip(ROWS, ("nan", "", "-inf"), strict=True))
    t, columns, *_ = read_measurements(csv("\ufeff" + HEADER, *rows, ""), UNITS)
    assert t.tolist() == [0, 0.1, 0.3]
    assert list(columns) == ["wheel_speed", "slip"]
    assert columns["wheel_speed"].tolist() == [13.8, 12.9, 11.0]
    assert columns["slip"].tolist() == [0, 0.05, 0.1]


@pytest.mark.slow
def test_readings_are_what_simulate_writes(small, tmp_path):
    run("simulate", small, "--csv", tmp_path / "run.csv", "--set", "solver.duration=0.02")
    t, columns, *_ = read_measurements(tmp_path / "run.csv", UNITS)
    np.testing.assert_allclose(t, 1e-3 * np.arange(21), rtol=1e-11, atol=1e-15)
    assert list(columns) == ["slip", "speed", "wheel_speed", "deceleration", "distance"]
    np.testing.assert_allclose(columns["slip"], 1 - columns["wheel_speed"] / columns["speed"], rtol=0, atol=1e-10)


BAD_FILES = [
    ((), "is empty; there is t [s], slip [1], speed [m/s]"),
    (("1,2,3",), "line 1 has no column t [s]"),
    (("slip [1]", "0"), "line 1 has no column t [s]"),
    ((HEADER,), "has a header and no numbers"),
    (("t [s]", "0"), "has no column of a measured signal; there is slip [1]"),
    (("t [s],wheel_spede [m/s]", "0,1"), 'column "wheel_spede [m/s]" is unknown; did you mean wheel_speed [m/s]?'),
    (("t [s],speed [km/h]", "0,1"), 'column "speed [km/h]" is unknown; did you mean speed [m/s]?'),
    (("t [s],slip [1],slip [1]", "0,1,1"), 'column "slip [1]" occurs twice'),
    ((HEADER, ROWS[0], "0.1,fast,0,0"), 'line 3: wheel_speed [m/s] = "fast" is text; a number is needed'),
    ((HEADER, ROWS[0], "", "0.1,,0,0"), 'line 4: wheel_speed [m/s] = "" is text; a number is needed'),
    ((HEADER, "0,nan,0,0"), "line 2: wheel_speed [m/s] = nan is outside (-inf, inf)"),
    ((HEADER, ROWS[0], "0.1,2"), "line 3: has 2 cells; the header has 4"),
    ((HEADER, ROWS[0], ROWS[2], ROWS[1]), "line 4: t = 0.1 s does not come after 0.3 s"),
    ((HEADER, ROWS[0], ROWS[0]), "line 3: t = 0 s does not come after 0 s"),
    ((HEADER, "-1,1,1,1"), "line 2: t = -1 s does not come after 0 s"),
]


@killed_by("scenario.measurements", "np.flatnonzero(np.diff(t) <= 0)", "np.flatnonzero(np.diff(t) < -1e9)")
@pytest.mark.parametrize(("lines", "needed"), BAD_FILES, ids=[readable_id(needed) for _, needed in BAD_FILES])
def test_a_bad_file_is_one_line(csv, lines, needed):
    path = csv(*lines) if lines else csv("")
    path.write_text(path.read_text() if lines else "")
    with pytest.raises(ScenarioError) as caught:
        read_measurements(path, UNITS)
    assert needed in str(caught.value)
    assert str(caught.value).startswith(f"--data {path}")
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_text(tmp_path):
    (tmp_path / "run.csv").write_bytes(b"t [s],slip [1]\n\xff\xfe\n")
    with pytest.raises(ScenarioError, match="is not a CSV file of UTF-8 text"):
        read_measurements(tmp_path / "run.csv", UNITS)


def test_a_file_that_is_not_there(small, tmp_path):
    result = run("identify", small, "--data", tmp_path / "none.csv", "--free", "plant.mass", status=2)
    assert_one_error_line(result)
    assert "none.csv: cannot be read, No such file or directory" in result.stderr


# What is asked, and shown


@pytest.fixture
def invented(monkeypatch):
    """A fit that has found something, at once; returns what it was asked."""
    asked = []

    def identify(loop, data, free, **what):
        asked.append({"data": data, "free": free, **what})
        n = np.size(data.t) * len(data.columns)
        residuals = np.repeat([0.2, 0.001], (n + 1) // 2)[:n]
        slopes = 1e3 * np.array([[1.0, 1.0], [1.0, 1.1], [1.0, 0.9], *[[1.0, 1.0]] * (n - 3)])
        known = uncertainty(list(free), np.array([6.0, 0.4]), slopes, np.zeros((0, 2)), 1.0)
        found = {"plant.mass": np.array(6.0), "plant.road.w4": np.array(0.4)}
        part = library.replace(loop, found)
        one = np.ones(n)
        return Identified(part, found, residuals, one, 5.0, 5.0, known, [9.0, 5.0], 4, Reason.CHANGE, {})

    replace_seam(monkeypatch, "identify", identify)
    return asked


FREE = ("--free", "plant.mass=4:8", "--free", "road.w4")


def test_the_arguments_reach_the_fit(small, csv, invented):
    path = csv(HEADER, *ROWS)
    run("identify", small, "--data", path, *FREE, "--sigma", "wheel_speed=0.05", "--sigma", "slip=1e-3")
    (asked,) = invented
    assert asked["free"] == {"plant.mass": (4.0, 8.0), "plant.road.w4": None}
    assert asked["absolute"] is True
    assert asked["data"].sigma == {"wheel_speed": 0.05, "slip": 1e-3}
    assert asked["data"].t.tolist() == [0, 0.1, 0.3]
    assert asked["solver"].duration == pytest.approx(0.302)


@killed_by("tune.identify.noise", "max(residual_noise[name], noise_floors[name])", "spread[name]")
def test_noise_that_is_not_known_is_taken_from_the_residuals(small, csv, invented):
    document = json.loads(run("identify", small, "--data", csv(HEADER, *ROWS), *FREE, "--json").stdout)
    first, *others = (asked["data"].sigma for asked in invented)
    assert first == {"wheel_speed": np.std([13.8, 12.9, 11.0]), "slip": np.std([0, 0.05, 0.1])}
    assert len(others) == 2
    for sigma in others:
        assert sigma == {"wheel_speed": pytest.approx(0.2), "slip": pytest.approx(1e-3)}
    assert not any(asked["absolute"] for asked in invented)
    assert document["evaluations"] == 12
    assert {name: row["sigma"] for name, row in document["residuals"].items()} == others[-1]


def test_columns_that_follow_from_each_other_are_said_to(small, csv, invented):
    path = csv("t [s],wheel_speed [m/s],slip [1],speed [m/s]", *ROWS)
    assert identify_options.REDUNDANT in run("identify", small, "--data", path, *FREE).stderr
    assert identify_options.REDUNDANT not in run("identify", small, "--data", path, *FREE, "--column", "slip").stderr


def test_one_column_only(small, csv, invented):
    run("identify", small, "--data", csv(HEADER, *ROWS), *FREE, "--column", "slip")
    assert list(invented[0]["data"].columns) == ["slip"]


def test_json_has_what_scripts_rely_on(small, csv, invented, tmp_path):
    out = tmp_path / "found.toml"
    result = run("identify", small, "--data", csv(HEADER, *ROWS), *FREE, "--json", "--out", out)
    document = json.loads(result.stdout)
    assert sorted(document) == sorted(KEYS)
    assert document["data"] == {"samples": 3, "columns": ["wheel_speed", "slip"], "until": 0.3}
    mass = document["values"]["plant.mass"]
    assert (mass["before"], mass["value"], mass["low"], mass["high"], mass["unit"]) == (5.3, 6.0, 4.0, 8.0, "kg")
    assert mass["deviation"] > 0
    (pair,) = document["correlations"]
    assert set(pair["between"]) == {"plant.mass", "plant.road.w4"}
    assert pair["correlation"] < -0.95
    assert document["residuals"]["slip"]["rms"] == pytest.approx(1e-3)
    assert document["files"] == {"out": str(out)}
    assert load(out).loop.plant.mass == 6.0
    assert load(out).loop.plant.road.w4 == 0.4


def test_table_for_people(small, csv, invented):
    result = run("identify", small, "--data", csv(HEADER, *ROWS), *FREE)
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in result.stdout.splitlines() if "│" in line]
    found = {row[0]: row[1:] for row in rows}
    assert found["plant.mass"][:2] == ["5.3", "6"]
    assert found["slip"][:2] == ["0.001", "0.001"]
    assert "plant.road.w4 and plant.mass are correlated by -0.9" in result.stderr


# Whole ones


@pytest.mark.slow
def test_what_simulate_wrote_is_found_again(small, tmp_path):
    """The steps of a fit end on kinks, so those of the run do."""
    truth = ("--set", "plant.mass=6.0", "--set", "road.w4=0.38", "--set", "solver.kinks=true")
    run("simulate", small, "--csv", tmp_path / "run.csv", *truth)
    t, columns, *_ = read_measurements(tmp_path / "run.csv", UNITS)
    noisy = columns["wheel_speed"] + np.random.default_rng(5).normal(0.0, 0.02, len(t))
    lines = (f"{x},{w}" for x, w in zip(t, noisy, strict=True))
    (tmp_path / "noisy.csv").write_text("\n".join(["t [s],wheel_speed [m/s]", *lines]))
    out = tmp_path / "found.toml"
    exact = json.loads(run("identify", small, "--data", tmp_path / "run.csv", *FREE, "--json", "--out", out).stdout)
    assert exact["values"]["plant.mass"]["value"] == pytest.approx(6.0, rel=1e-8)
    assert exact["values"]["plant.road.w4"]["value"] == pytest.approx(0.38, rel=1e-8)
    assert load(out).loop.plant.mass == exact["values"]["plant.mass"]["value"]
    # Without noise, the deviation is that of the least noise, and not of the errors that the search leaves.
    assert exact["scale"] == 1.0
    assert abs(exact["values"]["plant.mass"]["value"] - 6.0) < exact["values"]["plant.mass"]["deviation"]
    noisy = json.loads(run("identify", small, "--data", tmp_path / "noisy.csv", *FREE, "--json").stdout)
    for name, value in (("plant.mass", 6.0), ("plant.road.w4", 0.38)):
        row = noisy["values"][name]
        assert 1e-6 < row["deviation"] < 0.5
        assert abs(row["value"] - value) < 4 * row["deviation"]  # 1 in 16,000 would be further off by chance
    assert noisy["residuals"]["wheel_speed"]["sigma"] == pytest.approx(0.02, rel=0.25)  # 60 instants: 9 %


@pytest.mark.slow
@killed_by("tune.identify.noise", "[] if fit.ends else [fit.values]", "[fit.values]")
def test_a_value_at_an_end_of_its_range_has_no_deviation(small, tmp_path):
    run("simulate", small, "--csv", tmp_path / "run.csv", "--set", "plant.mass=5")
    args = ("--data", tmp_path / "run.csv", "--column", "slip", "--free", "plant.mass=5.2:8")
    document = json.loads(run("identify", small, *args, "--json").stdout)
    row = document["values"]["plant.mass"]
    assert row["value"] == pytest.approx(5.2, rel=1e-4)
    assert (row["deviation"], row["why"]) == (None, "end of range")
    assert document["notes"][0].startswith("plant.mass is at the end 5.2 of its range")
    assert "end of range" in run("identify", small, *args).stdout


@pytest.mark.slow
def test_what_the_data_do_not_show_is_said(small, tmp_path):
    run("simulate", small, "--csv", tmp_path / "run.csv")
    args = (
        "--data",
        tmp_path / "run.csv",
        "--column",
        "slip",
        "--free",
        "plant.mass=4:8",
        "--free",
        "plant.crawl_speed",
    )
    result = run("identify", small, *args, "--json", "--out", tmp_path / "found.toml", status=1)
    document = json.loads(result.stdout)
    (row,) = document["undetermined"]
    assert row["components"]["plant.crawl_speed"] == pytest.approx(1.0)
    assert document["files"] == {}
    assert result.stderr == "error: small: not identifiable from these data: 1.00 plant.crawl_speed\n"
    assert left_in(tmp_path) == {"small.toml", "run.csv"}


# What could not be done, and bad input


def test_interrupted_it_leaves_nothing_half_written(small, csv, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    replace_seam(monkeypatch, "identify", interrupted)
    args = ("--data", csv(HEADER, *ROWS), *FREE, "--out", tmp_path / "out.toml")
    assert run("identify", small, *args, status=130).stderr == "interrupted\n"
    assert left_in(tmp_path) == {"small.toml", "run.csv"}


@pytest.mark.slow
def test_too_few_data_are_bad_input(small, csv):
    result = run("identify", small, "--data", csv("t [s],slip [1]", "0.1,0.1"), *FREE, status=2)
    assert_one_error_line(result)
    assert "1 data do not determine 2 parameters" in result.stderr


def test_without_the_extra(small, csv, monkeypatch):
    monkeypatch.setitem(sys.modules, "optax", None)
    result = run("identify", small, "--data", csv(HEADER, *ROWS), *FREE, status=2)
    assert_one_error_line(result)
    assert 'pip install ".[tune]" in a clone' in result.stderr


@killed_by("scenario.measurements", "if i not in unlimited}", "}")
@killed_by("scenario.measurements", "        if used[j] not in unlimited:", "        if True:")
def test_a_limit_that_a_simulation_lacks_is_not_measured(csv):
    rows = ("t [s],psi [rad],current_max [A]", "0,0.1,inf", "0.1,0.2,inf")
    units = {"psi": "rad", "current_max": "A"}
    found = read_measurements(csv(*rows), units)
    assert (list(found.columns), found.infinite) == (["psi"], ("current_max",))
    for wrong in ((*rows[:2], "0.1,0.2,3"), (rows[0], "0,0.1,3", rows[2]), (*rows[:2], "0.1,inf,inf")):
        with pytest.raises(ScenarioError, match="= inf is outside"):
            read_measurements(csv(*wrong), units)
    with pytest.raises(ScenarioError, match="line 2: psi"):
        read_measurements(csv("t [s],psi [rad]", "0,inf"), units)


@killed_by("scenario.measurements", "            if name in self.infinite:", "            if False:")
@killed_by("cli.identify_options", "if readings.infinite and not names:", "if False:")
def test_a_column_that_is_left_out_is_named(csv, capsys):
    path, units = csv("t [s],psi [rad],current_max [A]", "0,0.1,inf", "0.1,0.2,inf"), {"psi": "rad", "current_max": "A"}
    plant = types.SimpleNamespace(shows=types.SimpleNamespace(units=units))
    found = identify_options.read_columns(path, None, plant)
    assert list(found.columns) == ["psi"]
    line = "note: current_max is infinite in every row of the data, and is not compared\n"
    assert capsys.readouterr().err == line
    identify_options.read_columns(path, ["psi"], plant)
    assert capsys.readouterr().err == ""
    with pytest.raises(ScenarioError, match="--column current_max is infinite in every row of the data"):
        identify_options.read_columns(path, ["current_max"], plant)
