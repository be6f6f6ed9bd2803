"""A sweep's table against runs one by one; what does not change it; how it is opened, replayed, and refused."""

import dataclasses
import json
import math
import os
import re
import shutil
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest
from commands import assert_one_error_line, left_in, run
from marks import cases, readable_id
from mutants import killed_by
from seams import replace_seam
from small_scenarios import SWEEP as SMALL
from sweeping import described, manifest

import diffabs as d
from diffabs import roads
from diffabs.loop.run import measure, rollout
from diffabs.parts.objectives import Effort
from diffabs.scenario.defaults import balancing
from diffabs.uncertainty.sweep import (
    Categorical,
    Local,
    Normal,
    Results,
    Space,
    Study,
    SweepError,
    Uniform,
    runner,
    sweep,
)
from diffabs.uncertainty.sweep.checking import check_accuracy
from diffabs.uncertainty.sweep.seal import tables_digest
from diffabs.uncertainty.sweep.store import Store
from diffabs.uncertainty.sweep.trajectories import write_trajectories

pytestmark = pytest.mark.usefixtures("any_step_is_stable", "without_load")

ROAD = 'road = ["rig", { type = "scaled", road = "rig-unrounded", scale = 0.9 }]\n[sweep.failures]'
ROADS = SMALL.replace("[sweep.failures]", ROAD)
SINGLE = SMALL.replace("1e308", "3e38")  # diverges in float32
TOLERANCE = {"rtol": 1e-9, "atol": 1e-12}  # the same operations, compiled apart: rounding, of runs of 125 steps


@pytest.fixture(scope="module")
def study():
    return described(SMALL)


@pytest.fixture(scope="module")
def swept(study, tmp_path_factory):
    return sweep(study, tmp_path_factory.mktemp("small") / "out")


@pytest.fixture(scope="module")
def with_roads():
    return described(ROADS)


@pytest.fixture(scope="module")
def over_roads(with_roads, tmp_path_factory):
    return sweep(with_roads, tmp_path_factory.mktemp("roads") / "out")


@pytest.fixture(params=cases(["numbers", "roads"], "roads"))
def posed(request):
    """A study of numbers, or of alternatives of a part as well, which are programs of their own."""
    return request.getfixturevalue({"numbers": "study", "roads": "with_roads"}[request.param])


@pytest.fixture
def made(request, posed):
    return request.getfixturevalue("over_roads" if posed.parts else "swept")


def metrics(found):
    """Every column that is computed, by name."""
    return {name: found.column(name) for name in (*found.metrics, "stopped", "diverged")}


def one_by_one(study, samples):
    """Every column that is computed, of these samples, each run by itself."""
    runs = []
    with jax.enable_x64(study.dtype == "float64"):
        for i in samples:
            loop, key = study.lane(i)
            loop = jax.tree.map(lambda x: jnp.asarray(x, study.dtype), loop)
            done = measure(loop, study.solver, study.objectives, key=key)
            runs.append(jax.device_get(done.metrics | {"stopped": done.stopped, "diverged": done.diverged}))
    return {name: np.array([one[name] for one in runs]) for name in runs[0]}


def same(found, expected, **tolerance):
    assert found.keys() == expected.keys()
    for name, column in found.items():
        np.testing.assert_allclose(column, expected[name], err_msg=name, **tolerance)


# What is in the table


@pytest.mark.slow
@killed_by("uncertainty.sweep.runner", "noise_key(seed, sample)", "noise_key(seed, 0)")
def test_each_row_is_its_lane_run_by_itself(posed, made):
    assert made.column("sample").tolist() == list(range(150))
    some = np.arange(0, 150, 4)
    assert "plant.road" not in made.variables or len(set(made.column("plant.road")[some])) == 2
    assert 0 < made.column("diverged")[some].sum() < len(some)
    table = {name: column[some] for name, column in metrics(made).items()}
    same(table, one_by_one(posed, some), **TOLERANCE)


def test_parameters_are_the_drawn_ones(posed, made):
    drawn = posed.draw(0, 150)
    assert made.variables == list(drawn)
    assert {name for name in made.variables if not made.is_number(name)} == {"plant.road"} & {*drawn}
    for path, column in drawn.items():
        assert np.array_equal(made.column(path), column)


def test_a_lane_has_the_drawn_parameters(with_roads):
    drawn = with_roads.draw(0, 150)
    assert set(drawn["plant.road"]) == {"rig", "1"}
    for i in (0, 149):
        loop, _ = with_roads.lane(i)
        assert loop.plant.mass == drawn["plant.mass"][i]
        assert loop.controller.gain.tolist() == [drawn["controller.gain.0"][i], drawn["controller.gain.1"][i]]
        assert isinstance(loop.plant.road, roads.Scaled) == (drawn["plant.road"][i] == "1")


def test_diverged_runs_are_counted_and_keep_their_row(study, swept):
    bad = swept.column("controller.gain.1") > 0
    assert 5 < bad.sum() < 40
    assert np.array_equal(swept.column("diverged"), bad)
    rows = swept.diverged_rows()
    assert rows.column("sample").to_numpy().tolist() == np.flatnonzero(bad).tolist()
    assert np.array_equal(rows.column("plant.mass").to_numpy(), study.draw(0, 150)["plant.mass"][bad])
    assert np.isnan(rows.column("iae").to_numpy()).all()
    assert np.isfinite(swept.column("iae")[~bad]).all()


@killed_by("uncertainty.sweep.study", "unit_at(spec.unit, place, np.size(value))", "spec.unit")
def test_entries_of_lists_have_their_own_units(study, swept):
    """A gain of slip for its integral and itself; of angles and their rates for a balancing robot."""
    known = {"controller.gain.0": "N m/s", "controller.gain.1": "N m", "plant.mass": "kg"}
    for units in (study.units(), swept.units):
        assert {path: units[path] for path in known} == known
    entries = {f"controller.gain.{i}": Uniform(-1.0, 1.0) for i in range(6)}
    robot = Study(loop=balancing(), space=Space(entries), samples=8, solver=d.FixedStep(1e-3, 0.1))
    assert [robot.units()[path] for path in entries] == 3 * ["V/rad"] + 3 * ["V s/rad"]


@pytest.mark.slow
def test_failures_are_counted_while_it_runs(study, swept, tmp_path):
    told = []
    sweep(study, tmp_path / "out", progress=told.append)
    diverged, stopped = swept.column("diverged"), swept.column("stopped")
    failed = diverged | ~stopped | (swept.column("overshoot") > 0.3) | (swept.column("locked_time") > 0)
    assert diverged.sum() < failed.sum() < 150
    assert [(at.samples, at.here) for at in told] == [(0, 0), (64, 64), (128, 128), (150, 150)]
    assert (told[-1].total, told[-1].failed, told[-1].diverged) == (150, failed.sum(), diverged.sum())


def test_worst(swept):
    values = np.nan_to_num(swept.column("overshoot"), nan=-np.inf)
    rows = swept.worst("overshoot", 7)
    assert rows.column("sample").to_numpy().tolist() == np.argsort(values)[::-1][:7].tolist()
    assert rows.column("overshoot").to_numpy().tolist() == np.sort(values)[::-1][:7].tolist()


@killed_by("uncertainty.sweep.results", "if name not in available", "if False")
@pytest.mark.parametrize(
    ("read", "line"),
    [
        (lambda found: found.table(["iae", "iea", "a", "b", "c"]), r"iea is no column of \S+; did you mean iae\?"),
        (lambda found: found.column("iea"), r"iea is no column of \S+; did you mean iae\?"),
        (lambda found: found.worst("refused"), "refused holds texts; a column of numbers is needed"),
    ],
    ids=["table", "column", "worst"],
)
def test_a_column_that_is_not_there(swept, read, line):
    with pytest.raises(ValueError, match=line):
        read(swept)


def test_a_lane_does_not_depend_on_jaxs_precision(study):
    loop, key = study.lane(5)
    with jax.enable_x64(False):
        other, same_key = study.lane(5)
    assert np.array_equal(jax.random.key_data(key), jax.random.key_data(same_key))
    for a, b in zip(jax.tree.leaves(loop), jax.tree.leaves(other), strict=True):
        assert np.array_equal(np.asarray(a, float), np.asarray(b, float))


# What does not change it


@pytest.mark.slow
def test_the_length_of_a_chunk_changes_rounding_only(study, swept, tmp_path):
    found = sweep(dataclasses.replace(study, chunk=37), tmp_path / "out")
    assert len(found.files) == 5
    same(metrics(found), metrics(swept), **TOLERANCE)
    for path in swept.variables:
        assert np.array_equal(found.column(path), swept.column(path))


@pytest.mark.slow
def test_float32(tmp_path):
    """Against runs in float32: noise is drawn from other bits than in float64."""
    single = dataclasses.replace(described(SINGLE), dtype="float32", samples=70)
    found = sweep(single, tmp_path / "out")
    assert found.column("iae").dtype == np.float32
    assert found.column("plant.mass").dtype == np.float64
    # rounding of 125 steps, 1e-7 each, of slips and times of order 1
    same(metrics(found), one_by_one(single, range(70)), rtol=1e-4, atol=2e-5)


@pytest.mark.slow
def test_objectives_of_another_precision_do_not_lower_it(study, swept, tmp_path):
    with jax.enable_x64(False):
        effort = Effort()
        low = {"iae": study.objectives["iae"], "effort": jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), effort)}
    found = sweep(dataclasses.replace(study, objectives=low, failures={}), tmp_path / "out")
    np.testing.assert_allclose(found.column("iae"), swept.column("iae"), **TOLERANCE)


def test_stopped_and_continued_is_the_same_to_the_bit(study, swept, tmp_path):
    part = sweep(study, tmp_path / "out", on=Local(jax.local_devices()), stopping=lambda: True)
    assert (len(part.files), part.complete) == (1, False)
    told = []
    whole = sweep(study, tmp_path / "out", resume=True, progress=told.append)
    assert (told[0].samples, told[-1].here) == (64, 86)
    assert whole.complete
    assert whole.digest == swept.digest


@killed_by("uncertainty.sweep.checking", 'np.searchsorted(results.column("sample"), samples)', "samples")
@pytest.mark.slow
def test_a_half_step_of_a_sweep_with_a_gap(study, swept, tmp_path):
    """Its samples are those of the other chunks, and each change is that of the sample's own row."""
    shutil.copytree(swept.folder, tmp_path / "out")
    (tmp_path / "out" / swept.files[0].relative_to(swept.folder)).unlink()
    found = check_accuracy(study, Results(tmp_path / "out"), 40)
    assert len(found["samples"]) == 40 - found["ended otherwise"] - found["not comparable"]
    assert min(found["samples"]) >= 64
    assert max(found["samples"]) > 86  # the number of rows
    assert found["metrics"]["iae"]["largest"] < 1e-3


@killed_by("uncertainty.sweep.checking", "refine_solver(study.solver, 2)", "study.solver")
def test_half_steps_are_made_by_the_sweeps_own_engine_and_program(study, swept, monkeypatch):
    """XLA's program of a run compiles for a minute where the sweep's kernel is there already."""
    asked = []

    class Recording:
        def __init__(self, study):
            asked.append(study)

        def run_samples(self, samples):
            columns = {name: 1.25 * swept.column(name)[samples] for name in swept.metrics}
            return columns | {name: swept.column(name)[samples] for name in ("stopped", "diverged")}

    replace_seam(monkeypatch, "checking_runner", Recording)
    study = dataclasses.replace(study, engine="kernel")
    found = check_accuracy(study, swept, 6)
    assert [(one.engine, one.chunk, one.solver.step) for one in asked] == [
        ("kernel", study.chunk, study.solver.step / 2)
    ]
    assert found["metrics"]["iae"]["largest"] == pytest.approx(0.25, rel=1e-12)  # 1.25 and 0.25 are exact


@killed_by(
    "uncertainty.sweep.checking",
    "for name, numbers in turned.items() if numbers",
    "for name, numbers in turned.items() if not numbers",
)
@pytest.mark.slow
def test_a_half_step_that_turns_never_into_a_number(study, swept):
    """The table says "never" of two of the repeated runs, which have a number with the half step."""
    study = dataclasses.replace(study, objectives={"overshoot": study.objectives["overshoot"]})
    columns = {name: swept.column(name) for name in ("sample", "stopped", "diverged", "refused", "overshoot")}
    table: Any = SimpleNamespace(metrics=["overshoot"], column=columns.__getitem__)
    repeated = check_accuracy(study, table, 3)["samples"]
    columns["overshoot"] = np.where(np.isin(columns["sample"], repeated[:2]), np.inf, columns["overshoot"])
    found = check_accuracy(study, table, 3)
    assert found["turned"] == {"overshoot": {"count": 2, "samples": repeated[:2]}}
    assert found["metrics"]["overshoot"]["sample"] == repeated[2]


@killed_by("engine.solvers", "fields if solver.kinks is None else", "fields if True else")
def test_steps_on_kinks_are_another_sweep(study, tmp_path):
    """Without a choice the table stays that of older versions, whose sweeps can be continued."""
    entries = {}
    for kinks in (None, True, False):
        solver = d.FixedStep(2e-3, 0.25, kinks=kinks)
        entries[kinks] = dataclasses.replace(study, solver=solver).table()["solver"]
    assert entries[None] == {"step": 2e-3, "duration": 0.25}
    Store(tmp_path).begin(manifest(2, 1, solver=entries[True]), resume=False)
    Store(tmp_path).begin(manifest(2, 1, solver=entries[True]), resume=True)
    for kinks, said in ((False, "false"), (None, "null")):
        with pytest.raises(SweepError, match=f"study.solver.kinks is true there, {said} here"):
            Store(tmp_path).begin(manifest(2, 1, solver=entries[kinks]), resume=True)


@killed_by("cli.sweep", "report.check_target(out / report.DEFAULT_NAME)", "pass")
def test_a_report_of_somebody_else_is_left_alone(file, swept, tmp_path):
    folder = shutil.copytree(swept.folder, tmp_path / "out")
    (folder / "report.html").write_text("mine")
    result = run("sweep", file(SMALL), "--out", folder, "--resume", "--figures", status=2)
    assert_one_error_line(result)
    assert "report.html: exists and is not an earlier report" in result.stderr
    assert (folder / "report.html").read_text() == "mine"


@killed_by("cli.show_samples", "    if scenario.seed:", "    if False:")
@pytest.mark.slow
def test_the_seed_of_a_single_run_has_no_effect_and_that_is_said(file, tmp_path):
    changes = ("--set", "solver.seed=5", "--set", "sweep.samples=2", "--set", "sweep.check=0")
    result = run("sweep", file(SMALL), "--out", tmp_path / "out", *changes)
    assert "note: solver.seed = 5 has no effect: sweep.seed decides the noise of a sweep\n" in result.stderr


def test_a_finished_sweep_is_not_computed_again(study, swept):
    class Nobody:
        def run(self, *_):
            raise AssertionError

    assert sweep(study, swept.folder, resume=True, on=Nobody()).digest == swept.digest


@pytest.mark.slow
def test_two_devices_change_no_bit(over_roads, file, tmp_path):
    """The command in a process of its own, as the number of devices is fixed when JAX starts."""
    command = ["sweep", file(ROADS), "--out", tmp_path / "out", "--devices", "2", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "diffabs", *map(str, command)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir},
    )
    assert json.loads(done.stdout)["digest"] == over_roads.digest


@killed_by("uncertainty.sweep.engines", 'study.engine == "kernel" or', "True or")
@killed_by("uncertainty.sweep.engines", 'alone = study.engine == "kernel" or', "alone =")
def test_xla_computes_a_chunk_on_each_core(study, swept, tmp_path, monkeypatch):
    """A kernel uses all cores for one chunk. No bit depends on the number of cores."""
    replace_seam(monkeypatch, "chunk_cores", lambda: 3)
    devices = jax.local_devices()
    assert Local().places(dataclasses.replace(study, engine="kernel")) == devices
    assert Local().places(study) == 3 * devices
    assert sweep(study, tmp_path / "out").digest == swept.digest


@killed_by("uncertainty.sweep.runner", "np.arange(self.size) < len(block.lanes)", "True")
@pytest.mark.parametrize("chunk", cases([2, 4096], 4096))
def test_copies_that_fill_a_block_do_not_run(study, monkeypatch, chunk):
    """Three samples are three runs, whatever the size of a chunk."""
    runs = []

    def measure(*given):
        runs.append(np.asarray(given[5]))
        return {"iae": np.zeros(chunk), "stopped": np.zeros(chunk, bool), "diverged": np.zeros(chunk, bool)}

    monkeypatch.setattr(runner, "_measure_block", measure)
    few = dataclasses.replace(study, samples=3, chunk=chunk)
    runner.Runner(few).run(range(few.chunks))
    assert {len(one) for one in runs} == {chunk}
    assert np.sum(runs) == 3


def test_every_device_is_used(study, monkeypatch):

    asked = []

    class Runner:
        def __init__(self, study, devices):
            asked.append(devices)

        def run(self, chunks):
            asked.append(chunks)
            none = {"diverged": np.zeros(2, bool), "refused": np.full(2, "", object)}
            return [none | {"stopped": np.ones(2, bool), "iae": np.ones(2)} for _ in chunks]

    replace_seam(monkeypatch, "runner", Runner)
    few = dataclasses.replace(study, objectives={"iae": study.objectives["iae"]}, failures={})
    found = [one.chunk for one in Local(["a", "b"]).run(few, [0, 3, 4, 6, 7], lambda: False)]
    assert asked == [["a", "b"], [0, 3], [4, 6], [7]]
    assert found == [0, 3, 4, 6, 7]


# How it is opened


@pytest.mark.slow
def test_pandas_polars_and_xarray_in_one_call_each(made):
    mass = made.column("plant.mass")
    frame, table, data = made.pandas(), made.polars(), made.xarray()
    assert frame.index.name == "sample"
    assert np.array_equal(frame["plant.mass"], mass)
    assert np.array_equal(table["plant.mass"].to_numpy(), mass)
    assert dict(data.sizes) == {"sample": 150}
    fields = pq.read_schema(min((made.folder / "chunks").glob("*.parquet")))
    assert {name: fields.field(name).metadata for name in ("plant.mass", "iae", "sample")} == {
        "plant.mass": {b"unit": b"kg"},
        "iae": {b"unit": b"s"},
        "sample": None,
    }
    assert np.array_equal(data["plant.mass"], mass)
    assert float(data["iae"].sel(sample=149)) == made.column("iae")[149]
    if "plant.road" in made.variables:
        road = made.column("plant.road").tolist()
        assert frame["plant.road"].astype(str).tolist() == table["plant.road"].cast(str).to_list() == road


def test_the_folder_of_chunks_is_a_data_set(made):
    import duckdb
    import pandas
    import polars

    chunks = made.folder / "chunks"
    by = "plant.road" if "plant.road" in made.variables else "stopped"
    query = f"""select "{by}", count(*), avg("stop_time") from '{chunks}/*.parquet' where not diverged
                group by 1 order by 1"""
    rows = duckdb.sql(query).fetchall()
    good, groups = ~made.column("diverged"), made.column(by)
    for (name, count, mean), expected in zip(rows, sorted(set(groups[good])), strict=True):
        there = good & (groups == expected)
        assert (name, count) == (expected, there.sum())
        np.testing.assert_allclose(mean, made.column("stop_time")[there].mean(), rtol=1e-12)
    assert np.array_equal(pandas.read_parquet(chunks).sort_values("sample")["iae"], made.column("iae"), True)
    assert polars.scan_parquet(chunks / "*.parquet").select("sample").collect().height == 150


@pytest.mark.slow
def test_trajectories_are_those_of_rollout(study, tmp_path):
    import xarray

    data = xarray.open_zarr(write_trajectories(study, tmp_path, [7, 3]), consolidated=False)
    assert dict(data.sizes) == {"sample": 2, "instant": study.solver.steps + 1}
    assert data["sample"].values.tolist() == [7, 3]
    assert (data["time"].attrs["units"], data["speed"].attrs["units"]) == ("s", "m/s")
    loop, key = study.lane(3)
    seen = rollout(loop, study.solver, key=key).trajectory.sample
    expected = {"time": seen.t, "slip": seen.output.slip, "command": seen.command, "distance": seen.output.distance}
    for name, values in expected.items():
        np.testing.assert_allclose(data[name].sel(sample=3), values, err_msg=name, **TOLERANCE)
    assert left_in(tmp_path) == {"trajectories.zarr"}


def test_no_trajectories_are_refused(study, tmp_path):
    with pytest.raises(ValueError, match="give the number of at least one sample"):
        write_trajectories(study, tmp_path, [])
    assert not list(tmp_path.iterdir())


# From the command line


@pytest.fixture(scope="module", params=cases(["float64", "float32"], "float32"))
def by_command(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    (folder / "small.toml").write_text(SMALL if request.param == "float64" else SINGLE)
    changes = ("--set", f"sweep.dtype={request.param}", "--samples", "70", "--keep", "1,69", "--json")
    if request.param == "float64":  # test_accuracy_cli.py has its half steps
        changes += ("--set", "sweep.check=0")
    done = run("sweep", folder / "small.toml", "--out", folder / "out", *changes)
    return folder / "out", json.loads(done.stdout), done.stderr


@pytest.mark.slow
def test_the_command_computes_the_table(by_command, swept):
    folder, document, said = by_command
    assert (document["samples"], document["complete"], said) == (70, True, "")
    assert (document["accuracy"] is None) == (folder.parent.name.startswith("float64"))  # sweep.check is 0 there
    found = Results(folder)
    assert found.digest == document["digest"]
    assert left_in(folder) == {".lock", "manifest.json", "chunks", "summary.json", "trajectories.zarr"}
    if found.study["dtype"] == "float64":
        assert tables_digest([found.table().slice(0, 64)]) == tables_digest([swept.table().slice(0, 64)])


@killed_by("cli.simulate", '"seed": setup.sweep.seed', '"seed": setup.seed')
@pytest.mark.slow
def test_a_sample_that_is_simulated_again_is_its_row(by_command):
    folder, document, _ = by_command
    table = Results(folder).pandas()
    good, bad = document["worst"]["overshoot"][0]["sample"], document["diverged"]["samples"][0]
    tolerance = TOLERANCE if table["iae"].dtype == float else {"rtol": 1e-4, "atol": 2e-5}
    for number, status in ((good, 0), (bad, 1)):
        again = json.loads(run("simulate", "--from-sweep", folder, "--sample", number, "--json", status=status).stdout)
        assert (again["solver"]["seed"], again["sample"]) == (None, {"sweep": str(folder), "seed": 3, "number": number})
        assert (again["stopped"], again["diverged"]) == tuple(table.loc[number, ["stopped", "diverged"]])
        for name, value in again["metrics"].items():
            np.testing.assert_allclose(math.nan if value is None else value, table.loc[number, name], **tolerance)


# What cannot be


def test_nothing_varies(file, tmp_path):
    text = SMALL[: SMALL.index("[sweep.over]")]
    result = run("sweep", file(text), "--out", tmp_path / "out", status=2)
    assert_one_error_line(result)
    assert "sweep.over is empty" in result.stderr


def test_a_folder_that_cannot_be_written(file):
    scenario = file(SMALL)
    result = run("sweep", scenario, "--out", scenario / "out", status=2)
    assert_one_error_line(result)
    assert result.stderr == f"error: --out {scenario / 'out'}: cannot be written, Not a directory\n"


def test_a_folder_with_something_else_is_left_alone(file, tmp_path):
    scenario = file(SMALL)
    (tmp_path / "summary.json").write_text("mine")
    (tmp_path / "notes.tmp").write_text("mine")
    result = run("sweep", scenario, "--out", tmp_path, status=2)
    assert_one_error_line(result)
    assert f"{tmp_path} is no sweep, but holds mine.toml; choose a folder that is new or empty" in result.stderr
    assert left_in(tmp_path) == {"mine.toml", "summary.json", "notes.tmp"}


def test_a_sweep_is_not_begun_again_over_another(file, swept):
    before = {path.name: path.read_bytes() for path in swept.folder.iterdir() if path.is_file()}
    result = run("sweep", file(SMALL), "--out", swept.folder, status=2)
    assert_one_error_line(result)
    assert "already holds a sweep; --resume continues it" in result.stderr
    assert before == {path.name: path.read_bytes() for path in swept.folder.iterdir() if path.is_file()}
    early = run("sweep", "no-such-scenario", "--out", swept.folder, status=2)  # before the scenario is read
    assert "already holds a sweep; --resume continues it" in early.stderr


def test_a_manifest_of_something_else_is_left_alone(study, tmp_path):
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(SweepError, match="is no sweep that can be read"):
        sweep(study, tmp_path)
    assert (tmp_path / "manifest.json").read_text() == "{}"


def test_a_sweep_without_a_chunk_is_begun_anew(study, tmp_path):
    """Also with another configuration: there is nothing to lose."""

    class Absent:
        def run(self, *_):
            raise SweepError("nobody computes")

    with pytest.raises(SweepError, match="nobody computes"):
        sweep(dataclasses.replace(study, seed=study.seed + 1), tmp_path, on=Absent())
    assert sweep(study, tmp_path).manifest["study"]["seed"] == study.seed


ORDERED = {"a": 1, "b": 2.0, "c": math.nan}


@killed_by("uncertainty.sweep.store", "if not lines and list(existing) != list(expected):", "if False:")
@killed_by("uncertainty.sweep.store", "json.dumps(existing) != json.dumps(expected)", "existing != expected")
@pytest.mark.parametrize(
    ("other", "line"),
    [
        (ORDERED, ""),
        (dict(reversed(ORDERED.items())), "study.loop has the entries a, b, c there, c, b, a here"),
        (ORDERED | {"a": 1.0}, "study.loop.a is 1 there, 1.0 here"),
        (ORDERED | {"b": 2}, "study.loop.b is 2.0 there, 2 here"),
    ],
    ids=["the same", "order", "float", "int"],
)
def test_only_the_same_digest_is_the_same_sweep(tmp_path, other, line):
    """Before a chunk is computed, which belongs to the digest: the order counts, and NaN is NaN."""
    Store(tmp_path).begin(manifest(2, 1, loop=ORDERED), resume=False)
    wanted = manifest(2, 1, loop=other)
    if not line:
        Store(tmp_path).begin(wanted, resume=True)
        return
    with pytest.raises(SweepError, match=f"holds another sweep: {re.escape(line)}$"):
        Store(tmp_path).begin(wanted, resume=True)


@pytest.mark.parametrize(
    ("args", "needed"),
    [
        (("--from-sweep", "{}", "--sample", "150"), "--sample 150 is outside [0, 149]"),
        (("--from-sweep", "{}", "--sample", "0"), "was not swept from a scenario; Study.lane(0) is this sample"),
        (("--from-sweep", "{}/chunks", "--sample", "0"), "is no sweep: manifest.json: No such file or directory"),
    ],
)
def test_a_sample_that_is_not_there(swept, args, needed, monkeypatch):
    if "outside" in needed:
        source = {"scenario": SMALL, "name": "small"}
        there = {**json.loads((swept.folder / "manifest.json").read_text()), "source": source}
        replace_seam(monkeypatch, "read_manifest", lambda folder: there)
    result = run("simulate", *(arg.format(swept.folder) for arg in args), status=2)
    assert_one_error_line(result)
    assert needed in result.stderr


UNREADABLE = ["", "{", "[]", "{}", '{"format": 1}', '{"format": 2, "study": {}, "source": {}}', '{"format": 3}']


@pytest.mark.parametrize("text", UNREADABLE)
def test_a_manifest_that_cannot_be_read(tmp_path, text):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(SweepError, match=r"is no sweep that can be read: manifest.json: [^\n]+\Z"):
        Results(tmp_path)


@killed_by("uncertainty.sweep.manifest", "isinstance(stated, bool) or", "")
@pytest.mark.parametrize(
    ("stated", "words"),
    [
        (4, "format = 4 was written by a newer diffabs; version 3 is needed"),
        (2, "format = 2 was written by an older diffabs; version 3 is needed: read its chunks with pandas"),
        (True, "format = true is a boolean; 3 is needed"),
    ],
)
def test_a_manifest_of_another_release_is_named(tmp_path, stated, words):
    (tmp_path / "manifest.json").write_text(json.dumps({"format": stated}))
    with pytest.raises(SweepError, match=f"is no sweep that can be read: manifest.json: {words}"):
        Results(tmp_path)


WRONG = [
    ({"samples": 0}, "samples = 0 is outside [1, 4294967295]"),
    ({"samples": -3}, "samples = -3 is outside [1, 4294967295]"),
    ({"samples": 2.5}, "samples = 2.5 is a number; a whole number in [1, 4294967295] is needed"),
    ({"chunk": 0}, "chunk = 0 is outside [1, 1048576]"),
    ({"seed": True}, "seed = true is a boolean; a whole number in [0, 4294967295] is needed"),
    ({"seed": -1}, "seed = -1 is outside [0, 4294967295]"),
    ({"dtype": "float16"}, "dtype = float16 is neither float32 nor float64"),
    ({"solver": d.FixedStep}, "is no solver; d.FixedStep(step=..., duration=...) or d.Adaptive("),
    ({"solver": d.FixedStep(-1.0, 0.25)}, "solver.step = -1.0 is not positive and finite"),
    ({"solver": d.FixedStep(1e-3, math.nan)}, "solver.duration = nan is not positive and finite"),
    ({"failures": {"overshot": 1.0}}, "failures.overshot is not measured"),
    ({"failures": {"overshoot": math.nan}}, "failures.overshoot = nan is not a finite number"),
    ({"objectives": {"iae": SimpleNamespace(failure=math.inf)}}, "failures.iae = inf is not a finite number"),
    ({"objectives": {"stopped": Effort()}, "failures": {}}, "objectives.stopped: another column"),
    ({"space": Space({"plant.mas": Uniform(5.0, 6.0)})}, "plant.mas is not a parameter of this loop; did you mean"),
    ({"space": Space({"plant.mass": Normal(5.0, 1.0)})}, "plant.mass"),
    ({"space": Space({"plant.road": Categorical(("dry",))})}, "plant.road is not a parameter of this loop"),
    ({"space": Space({})}, "variables are empty: nothing varies"),
]


@killed_by("uncertainty.sweep.study", "isinstance(self.solver, Solver)", "dataclasses.is_dataclass(self.solver)")
@killed_by("uncertainty.sweep.study", "name, bound in self.failure_bounds", "name, bound in self.failures")
@pytest.mark.parametrize(("changes", "needed"), WRONG, ids=[readable_id(needed) for _, needed in WRONG])
def test_a_study_that_cannot_be(study, tmp_path, changes, needed):
    with pytest.raises(ValueError, match=re.escape(needed)) as error:
        sweep(dataclasses.replace(study, **changes), tmp_path / "out")
    assert str(error.value).count("\n") == 0
    assert str(error.value).count(needed) == 1
    assert left_in(tmp_path) == set()


@killed_by("uncertainty.sweep.run", "    if jax.process_count() > 1:", "    if False:")
def test_several_processes_of_jax_are_refused(study, tmp_path, monkeypatch):
    """Before anything is written."""
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    with pytest.raises(ValueError, match=re.escape("sweep runs in one process; several machines: on=Dask(...)")):
        sweep(study, tmp_path / "out")
    assert left_in(tmp_path) == set()


@killed_by("uncertainty.sweep.run", 'read_notes(source or {}, "source")', "dict(source or {})")
@pytest.mark.parametrize(
    ("note", "line"),
    [(1, "source.a = 1 is a number; text is needed"), (Effort, " is of type type; text is needed")],
    ids=["number", "class"],
)
def test_a_note_that_no_reader_would_take_is_refused_first(study, tmp_path, monkeypatch, note, line):
    """Before a kernel is compiled."""
    monkeypatch.setattr("diffabs.uncertainty.sweep.run.choose_study_engine", None)
    with pytest.raises(ValueError, match=re.escape(line)):
        sweep(study, tmp_path / "out", source={"a": note})
    assert left_in(tmp_path) == set()


@killed_by("uncertainty.sweep.study", "as_plain(getattr(self, name))", "getattr(self, name)")
@killed_by("uncertainty.sweep.study", "dataclasses.replace(self.solver, **plain_fields(self.solver))", "self.solver")
def test_a_study_has_a_table_of_plain_values(study):
    failures = {"overshoot": np.float32(0.5)}
    solver = d.FixedStep(jnp.asarray(2e-3), np.float32(0.25))
    whole = {"samples": np.uint32(50_000), "chunk": np.int16(20_000), "seed": np.int64(3)}
    made = dataclasses.replace(study, failures=failures, solver=solver, **whole).check()
    table = made.table()
    assert json.loads(json.dumps(table)) == table
    assert hash(made.solver)  # the programs of a sweep are known by it
    assert (type(made.seed), made.chunks, made.bounds(2)) == (int, 3, (40_000, 50_000))
    assert (table["failures"], table["success"]) == ({"locked_time": 0.0, "overshoot": 0.5}, True)


def refuse_later(store, *chunks):
    """Begin a sweep that is refused after these chunks."""
    with store.lock():
        store.begin({"format": 1}, resume=False)
        for name in chunks:
            (store.chunks / name).write_text("")
        raise RuntimeError("no device answers")


@killed_by("uncertainty.sweep.store", "        except Exception:\n", "        except ValueError:\n")
@killed_by("uncertainty.sweep.store", "                self._remove_new(before, created)", "                pass")
@killed_by("uncertainty.sweep.store", "self.chunks.rmdir()", "pass")
@pytest.mark.parametrize("there", [None, {}, {"notes.tmp": "mine"}])
def test_a_refused_sweep_leaves_a_folder_as_it_was(tmp_path, there):
    store = Store(tmp_path / "out" / "sweep")
    if there is not None:
        store.folder.mkdir(parents=True)
    for name, text in (there or {}).items():
        (store.folder / name).write_text(text)
    with pytest.raises((RuntimeError, SweepError)):
        refuse_later(store)
    assert left_in(tmp_path) == (set() if there is None else {"out"})
    assert there is None or left_in(store.folder) == set(there)


@killed_by("uncertainty.sweep.store", "if not self._has_chunks()", "if True")
def test_a_finished_chunk_stays_when_a_sweep_ends_with_an_error(tmp_path):
    store = Store(tmp_path / "out")
    store.chunks.mkdir(parents=True)  # by a process that was killed before it wrote the manifest
    with pytest.raises(RuntimeError):
        refuse_later(store, "part-0.parquet")
    assert left_in(store.folder) == {".lock", "manifest.json", "chunks"}
