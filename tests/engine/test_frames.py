"""Results as objects: what a run, a tuning, an identification and a sweep say of themselves, and as frames."""

import dataclasses
import json
import math
import re
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io
import zarr
from commands import run as command
from mutants import killed_by

import diffabs as d
from diffabs import objectives
from diffabs.core.summary import Summary, format_cell, round_for_table
from diffabs.host import interactive
from diffabs.loop.convert import signal_columns, write_csv
from diffabs.loop.matlab import write_mat
from diffabs.output.plot.style import sheet
from diffabs.parts.controllers import HoldingInput, StateFeedback
from diffabs.parts.plants import BrakeStart, MirroredRig
from diffabs.parts.references import FixedSlip
from diffabs.parts.stops import SpeedReached
from diffabs.scenario.defaults import braking
from diffabs.scenario.measurements import read_measurements
from diffabs.tune import build_problem, grid, tune
from diffabs.tune.identify import Traces, identify
from diffabs.uncertainty.sweep import Results, Space, Study, Uniform, sweep
from diffabs.uncertainty.sweep.trajectories import write_trajectories

SOLVER = d.FixedStep(2e-3, 2.0)


def rig():
    return braking(
        plant=MirroredRig(),
        initial=BrakeStart(speed=6.0),
        reference=FixedSlip(slip=0.2),
        controller=StateFeedback(gain=(-3000.0, -48.0)),
        feedforward=HoldingInput(),
        stop=SpeedReached(speed=2.0),
    )


@pytest.fixture(scope="module")
def run():
    return d.rollout(rig(), SOLVER, objectives.BRAKING)


@killed_by("core.summary", "ZERO_TOLERANCE = 1e-14", "ZERO_TOLERANCE = 0.0")
@pytest.mark.parametrize(
    ("value", "text"),
    [
        (8e-17, "0"),
        (-8e-17, "0"),
        (1.25e-9, "1.25e-09"),
        (math.nan, "nan"),
        (math.inf, "inf"),
        (-3.14159265, "-3.14159"),
    ],
)
def test_rounding_is_no_number(value, text):
    assert round_for_table(value) == text


def test_a_cell_of_a_list_is_its_beginning():
    assert format_cell(np.arange(6.0)) == "[0, 1, 2, 3, ...]"
    assert format_cell(np.array([1.5, -1e-17])) == "[1.5, 0]"
    assert format_cell(None) == ""
    assert format_cell(True) == "True"


@killed_by("core.summary", "<strong>{html.escape(self.title)}</strong>", "<strong>{self.title}</strong>")
def test_a_summary_is_text_and_html():
    found = Summary("a <title>", ("name", "value"), (("x", 1 / 3), ("longer", 8e-17)), "note")
    assert str(found).splitlines() == [
        "a <title>", "name    value", "----------------", "x       0.333333", "longer  0", "note",
    ]  # fmt: skip
    html = found._repr_html_()
    assert "a &lt;title&gt;" in html
    assert html.count("<tr>") == 3
    assert "<td>0</td>" in html


@killed_by("loop.convert", '"reached its stop {end}" if run.stopped', '"reached its stop {end}" if True')
def test_a_run_says_what_it_is(run):
    lines = repr(run).splitlines()
    end = float(run.ending.sample.t)
    assert lines[0].startswith(f"Run that reached its stop at t = {end:.6g} s; a trajectory of")
    assert any(line.split() == ["iae", f"{float(run.metrics['iae']):.6g}"] for line in lines)
    assert len(repr(run)) < 1000
    assert "<table>" in run._repr_html_()
    late = d.measure(rig(), dataclasses.replace(SOLVER, duration=0.1), objectives.BRAKING)
    assert repr(late).startswith("Run that ended at t = 0.1 s")
    wild = dataclasses.replace(rig(), controller=StateFeedback(gain=(-3e9, 48e5)))
    lost = d.measure(wild, SOLVER, objectives.BRAKING)
    assert repr(lost).startswith("Run that diverged")


@pytest.mark.slow
def test_many_runs_are_counted_and_a_traced_one_can_be_shown():
    said = []

    def one(mass):
        found = d.measure(d.replace(rig(), {"plant.mass": mass}), SOLVER, {"iae": objectives.BRAKING["iae"]})
        said.append(repr(found))
        return found

    many = jax.vmap(one)(jnp.linspace(5.0, 6.0, 3))
    assert said[0] == "Run being traced, of 1 metrics"
    lines = repr(many).splitlines()
    assert lines[0] == "3 runs: 3 reached their stop, 0 diverged"
    row = next(line.split() for line in lines if line.startswith("iae"))
    values = np.asarray(many.metrics["iae"])
    assert [*map(float, row[1:])] == pytest.approx([values.mean(), values.min(), values.max()], rel=1e-5)
    frame = many.pandas()
    np.testing.assert_array_equal(frame["iae"], values)
    assert frame["stopped"].tolist() == [True] * 3


@killed_by("loop.convert", 'pandas = import_optional("pandas")', "import pandas", case="pandas")
@killed_by("loop.convert", 'xarray = import_optional("xarray")', "import xarray", case="xarray")
@pytest.mark.parametrize("package", ["pandas", "xarray"])
def test_a_package_that_is_missing_is_named(run, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    with pytest.raises(ModuleNotFoundError, match=f"^{package} is not installed: pip install {package}$"):
        getattr(run, package)(rig().plant)


@killed_by("loop.convert", "np.asarray(values)[:rows])", "np.asarray(values))")
@killed_by("loop.convert", "control_units(plant) if plant is not None else {}", "{}")
def test_frames_have_units_and_end_where_the_run_does(run):
    count = int(np.sum(run.trajectory.running)) + 1
    frame, plant = run.pandas(rig().plant), rig().plant
    assert frame.index.name == "t"
    assert len(frame) == count < len(run.trajectory.running)
    assert frame.index[-1] == pytest.approx(float(run.ending.sample.t))
    np.testing.assert_array_equal(frame["slip"], np.asarray(run.trajectory.sample.output.slip)[:count])
    np.testing.assert_array_equal(frame["command"], np.asarray(run.trajectory.sample.command)[:count])
    assert frame.attrs["units"] | {} == {
        **plant.shows.units, "t": "s", "target": "1", "setpoint": "1", "feedforward": "N m", "command": "N m",
        "control": "N m",
    }  # fmt: skip
    assert frame.attrs["iae"] == float(run.metrics["iae"])
    data = run.xarray(plant)
    assert data["speed"].attrs["units"] == "m/s"
    assert data["t"].attrs["units"] == "s"
    assert run.xarray()["control"].attrs["units"] == "control"
    np.testing.assert_array_equal(data["speed"], frame["speed"])
    assert float(data["slip"].sel(t=0.0)) == frame["slip"].iloc[0]
    with pytest.raises(ValueError, match="no trajectory"):
        run._replace(trajectory=None).xarray()
    with pytest.raises(ValueError, match="many runs"):
        jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 2), run).pandas()


@killed_by("loop.convert", 'if name in ("target", "setpoint") else control', 'if name == "target" else control')
@killed_by("loop.closed_loop", 'if name not in ("t", "output"))', 'if name not in ("t", "output", "setpoint"))')
def test_every_table_and_file_has_the_same_columns(run, tmp_path):
    """Units and values of CSV, MAT, zarr and xarray are those of pandas."""
    plant = rig().plant
    frame = run.pandas(plant)
    units = frame.attrs["units"]
    values = {name: np.asarray(column) for name, column in frame.reset_index().items()}
    assert [*units] == [*values] == [
        *("t", *plant.shows._fields), *("target", "setpoint", "feedforward", "command", "control"),
    ]  # fmt: skip
    assert units | {"setpoint": "1", "feedforward": "N m"} == units
    assert np.all(values["feedforward"] > 2)
    data = run.xarray(plant)
    write_csv(tmp_path / "run.csv", run, plant)
    write_mat(tmp_path / "run.mat", run, plant)
    header, *rows = (tmp_path / "run.csv").read_text().splitlines()
    mat = scipy.io.loadmat(tmp_path / "run.mat", simplify_cells=True)
    study = Study(loop=rig(), solver=SOLVER, objectives={}, space=Space({"plant.mass": Uniform(5.29, 5.3)}), samples=2)
    group = zarr.open_group(write_trajectories(study, tmp_path, [1]), mode="r")
    loop, _ = study.lane(1)
    kept = signal_columns(d.rollout(loop, SOLVER, objectives.BRAKING).trajectory.sample, plant)  # the program of `run`
    numbers = np.array([row.split(",") for row in rows], float)
    assert header.split(",") == [f"{name} [{unit}]" for name, unit in units.items()]
    assert {*data.variables} == {*units}
    assert mat["units"] == units
    assert {*group.array_keys()} - {"sample"} == {"time" if name == "t" else name for name in units}
    for i, (name, unit) in enumerate(units.items()):
        array = group["time" if name == "t" else name]
        assert data[name].attrs["units"] == array.attrs["units"] == unit
        np.testing.assert_array_equal(data[name], values[name])
        np.testing.assert_array_equal(mat[name], values[name])
        np.testing.assert_allclose(numbers[:, i], values[name], rtol=1e-11, atol=1e-15)
        np.testing.assert_allclose(array[0], kept[name][1], rtol=1e-9, atol=1e-12, err_msg=name)
    read = read_measurements(tmp_path / "run.csv", plant.shows.units)
    assert {*read.columns, *read.infinite} == {*plant.shows._fields}
    np.testing.assert_allclose(read.columns["slip"], values["slip"], rtol=1e-11, atol=1e-15)


@pytest.mark.slow
def test_a_run_draws_the_figure_of_its_plant(run, tmp_path):
    figure = run.plot(rig().plant, title="a rig")
    assert figure.get_axes()[0].get_ylabel() == "slip [1]"
    assert figure.get_suptitle() == "a rig"
    balance = d.rollout(d.balancing(), d.FixedStep(1e-2, 0.1), {})
    assert balance.plot().get_axes()[0].get_ylabel() == "angle [rad]"
    figure.savefig(tmp_path / "run.png")


def cells(html):
    return [re.findall(r"<td>(.*?)</td>", row) for row in re.findall(r"<tr>(<td>.*?)</tr>", html)]


@killed_by("loop.closed_loop", "spec.interval()) for", '"") for')
def test_a_loop_and_a_batch_have_tables_in_a_notebook():
    html = rig()._repr_html_()
    assert "plant MirroredRig" in html
    rows = {name: rest for name, *rest in cells(html)}
    assert rows["plant.mass"] == ["5.3", "(0, inf) kg"]
    assert rows["controller.gain"][0] == "[-3000, -48]"
    batch = d.Batch({"plant.mass": [5.3, 5.5, 6.2], "controller.gain": np.full((3, 2), -7.0)}, keys=np.arange(3))
    html = batch._repr_html_()
    assert "Batch of 3 runs" in html
    assert cells(html) == [
        ["plant.mass", "5.3", "6.2", "(3,)"], ["controller.gain", "-7", "-7", "(3, 2)"], ["keys", "0", "2", "(3,)"],
    ]  # fmt: skip
    named = d.Batch({"plant.mass": [5.3]}, keys=jax.random.split(jax.random.key(0), 1))
    assert cells(named._repr_html_())[1] == ["keys", "", "", "(1,)"]


@killed_by("output.plot.style", 'format="png", dpi', 'format="pdf", dpi')
def test_a_figure_shows_itself_in_a_notebook():
    """As IPython asks for it, without `%matplotlib inline`."""
    figure, _ = sheet(title="a rig")
    assert figure._repr_png_().startswith(b"\x89PNG")


@killed_by("host.interactive", "self.handle.update(Line(self.text))", "pass")
def test_progress_is_one_line_in_a_notebook_and_in_a_session_and_none_in_a_script(monkeypatch, capsys):
    shown, now = [], iter(range(100))
    monkeypatch.setattr(interactive.time, "monotonic", lambda: next(now))
    words = interactive.report_to(interactive.ProgressLine(), None, str)
    assert words is None
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    with interactive.ProgressLine() as line:
        tell = interactive.report_to(line, None, "{} of {}".format)
        tell(1, 3)
        tell(2, 3)
    assert capsys.readouterr().err.replace("\r\x1b[K", "|") == "|1 of 3|2 of 3|2 of 3\n"
    user = shown.append
    assert interactive.report_to(line, user, str) is user

    def display(text, display_id):
        assert display_id
        shown.append(repr(text))
        return SimpleNamespace(update=lambda text: shown.append(repr(text)))

    shell = SimpleNamespace(kernel=1)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=display))
    with interactive.ProgressLine() as line:
        line.write("a")
        line.write("b")
    assert shown == ["a", "b", "b"]
    assert capsys.readouterr().err == ""


@killed_by("tune.result", '("objective", *self.objective)', '("objective", *self.objective[::-1])')
@pytest.mark.slow
def test_a_tuning_has_a_table():
    free, over = {"controller.gain": ((-1e4, -300.0), (-200.0, -10.0))}, grid({"plant.mass": [5.3, 6.2]})
    found = tune(build_problem(rig(), free=free, objective={"iae": 1.0}, over=over, solver=SOLVER))
    table = found.table()
    rows = {row[0]: row[1:] for row in table.rows}
    np.testing.assert_array_equal(rows["controller.gain"][0], rig().controller.gain)
    np.testing.assert_array_equal(rows["controller.gain"][1], found.values["controller.gain"])
    assert rows["worst iae"] == (np.max(found.metrics[0]["iae"]), np.max(found.metrics[1]["iae"]))
    assert rows["mean iae"] == (np.mean(found.metrics[0]["iae"]), np.mean(found.metrics[1]["iae"]))
    assert rows["objective"] == found.objective
    assert repr(found) == str(table)
    assert repr(found).startswith("Tuned over 2 lanes: ")
    assert "<table>" in found._repr_html_()


@killed_by("tune.identify.fit", "else self.uncertainty.deviations[name]", "else 0.0")
@pytest.mark.slow
def test_an_identification_has_a_table(run):
    frame = run.pandas()
    data = Traces(t=frame.index.to_numpy(), columns={"speed": frame["speed"].to_numpy()}, sigma={"speed": 0.01})
    found = identify(d.replace(rig(), {"plant.mass": 5.0}), data, {"plant.mass": (4.0, 8.0)}, solver=SOLVER)
    (row,) = found.table().rows
    assert row == ("plant.mass", 5.0, found.values["plant.mass"], found.uncertainty.deviations["plant.mass"])
    assert repr(found) == str(found.table())
    assert f"Identified from {len(frame)} residuals" in repr(found)


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    space = Space({"plant.mass": Uniform(low=5.0, high=6.5)})
    study = Study(
        loop=rig(), solver=SOLVER, objectives={name: objectives.BRAKING[name] for name in ("iae", "stop_time")},
        space=space, samples=20, failures={"iae": 0.02},
    )  # fmt: skip
    return sweep(study, tmp_path_factory.mktemp("sweeps") / "study")


@killed_by("uncertainty.sweep.study", "if path in declared}", "if False}")
@pytest.mark.slow
def test_the_frame_of_a_sweep_has_units_and_says_what_failed(swept, monkeypatch):
    bound = float(np.median(swept.column("iae")))
    monkeypatch.setitem(
        swept.manifest["study"], "failures", {"iae": bound}
    )  # of those of the study none fails, or all do
    frame = swept.pandas()
    np.testing.assert_array_equal(frame["failed"], swept.column("iae") > bound)
    assert 0 < frame["failed"].sum() < 20
    assert frame.attrs["units"]["plant.mass"] == "kg"
    assert frame.attrs["units"]["stop_time"] == "s"
    assert swept.polars()["failed"].to_list() == frame["failed"].tolist()
    data = swept.xarray()
    assert data["plant.mass"].attrs["units"] == "kg"
    lines = repr(swept).splitlines()
    assert lines[0] == f"Sweep of 20 samples: {int(frame['failed'].sum())} failed, 0 diverged"
    assert any(line.split()[0] == "stop_time" and line.split()[-1] == "s" for line in lines)
    assert "over plant.mass" in lines[-1]
    assert "<table>" in swept._repr_html_()


@pytest.mark.slow
@killed_by("uncertainty.sweep.study", "{name: failed & run for", "{name: failed for")
def test_what_was_missed_or_refused_is_told_apart(swept, monkeypatch):
    stopped, refused = np.ones(20, bool), np.full(20, "")
    stopped[3], refused[5] = False, "a step that is too long"
    columns = {"stopped": stopped, "refused": refused, "diverged": refused != "", "iae": np.zeros(20)}
    monkeypatch.setattr(swept, "column", columns.__getitem__)
    monkeypatch.setitem(swept.manifest["study"], "failures", {"iae": 0.02})
    assert np.flatnonzero(swept.failed_samples()).tolist() == [3]
    assert np.flatnonzero(swept.failures()["not stopped"]).tolist() == [3]


@pytest.mark.slow
def test_a_sweep_of_before_has_no_units(swept):
    older = Results(swept.folder)
    older.manifest.pop("units")
    assert older.units == {}
    assert older.pandas().attrs["units"] == {}


@pytest.mark.slow
def test_no_table_of_the_command_line_has_rounding_for_a_number(monkeypatch):
    from diffabs.cli import show

    assert show.format_brief(8e-17) == "0"
    assert show.format_brief([1.0, 8e-17]) == "[1, 0]"
    result = json.loads(command("simulate", "slip-lmi", "--set", "solver.step=1e-3", "--json").stdout)
    assert set(result["metrics"]) >= {"iae"}
