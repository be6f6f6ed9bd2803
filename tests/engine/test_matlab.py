"""MAT files of runs, read by SciPy's reader."""

import numpy as np
import pytest
from commands import assert_one_error_line, left_in
from commands import run as command
from mutants import killed_by

import diffabs as d
from diffabs.loop.matlab import write_mat

io = pytest.importorskip("scipy.io")

SHORT = ("--set", "initial.speed_kmh=20", "--set", "controller.high=inf")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mat")
    command("simulate", "slip-lmi", *SHORT, "--csv", folder / "run.csv", "--mat", folder / "run.mat", "--json")
    return folder


@pytest.mark.slow
def test_a_mat_file_has_what_the_csv_has(folder):
    found = io.loadmat(folder / "run.mat", simplify_cells=True)
    header, *rows = (folder / "run.csv").read_text().splitlines()
    numbers = np.array([row.split(",") for row in rows], float)
    for k, column in enumerate(header.split(",")):
        name, unit = column.removesuffix("]").split(" [")
        assert found["units"][name] == unit
        assert found[name].shape == (len(rows),)
        np.testing.assert_allclose(found[name], numbers[:, k], rtol=1e-11, atol=1e-15)
    assert len(rows) > 50
    assert found["scenario"] == "slip-lmi"


@killed_by("loop.matlab", ', oned_as="column"', "")
def test_a_mat_file_has_metrics_and_parameters(folder):
    found = io.loadmat(folder / "run.mat", simplify_cells=True)
    assert found["parameters"]["plant_mass"] == 5.3
    assert found["parameters"]["controller_high"] == np.inf
    np.testing.assert_array_equal(found["parameters"]["controller_gain"], [-11753.0, -48.0])
    assert found["metrics"]["stop_time"] == pytest.approx(found["t"][-1], abs=1e-3)
    raw = io.loadmat(folder / "run.mat")
    assert raw["slip"].shape[1] == 1  # MATLAB's columns
    assert (folder / "run.mat").read_bytes()[:19] == b"MATLAB 5.0 MAT-file"


@killed_by("loop.matlab", "while new in renamed:", "while False:")
@killed_by("loop.matlab", "if valid in KEYWORDS", "if False")
@killed_by("loop.matlab", "[:MAX_NAME]", "[:99]")
def test_every_name_becomes_one_of_matlab(tmp_path):
    loop, values = d.braking(), {"a.b": 1.0, "a-b": 2.0, "90pct": 3.0, "_c": 4.0, 70 * "d": 5.0}
    values |= {"end": 6.0, "a_": 7.0, "double": 8.0, "a": 9.0, "a_table": 10.0}
    write_mat(tmp_path / "run.mat", d.rollout(loop, d.FixedStep(1e-2, 0.02), {}), loop.plant, parameters=values)
    found = io.loadmat(tmp_path / "run.mat", simplify_cells=True)["parameters"]
    names = ["a_b", "a_b_2", "x90pct", "x_c", 60 * "d", "end_", "a_", "double", "a", "a_table"]
    assert found == dict(zip(names, values.values(), strict=True))


@killed_by("cli.targets", "if places[first] == places[second]:", "if False:")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--mat", "run.txt"), "the name must end in .mat"),
        (("--mat", "none/run.mat"), "No such file or directory"),
        (("--mat", "a.mat", "--csv", "./a.mat"), "--csv and --mat are the same file"),
    ],
)
def test_what_cannot_be_written_is_said_first(tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    result = command("simulate", "slip-lmi", *words, status=2)
    assert said in result.stderr
    assert_one_error_line(result)
    assert left_in(tmp_path) == set()
