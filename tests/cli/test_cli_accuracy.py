"""`simulate --check`, and what a sweep says of its accuracy without being asked."""

import dataclasses
import json
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import assert_one_error_line, run
from mutants import killed_by
from sweeping import SCENARIO

import diffabs as d
from diffabs.core.protocols import Memory
from diffabs.engine.solvers import Adaptive
from diffabs.loop.checking import check_run_accuracy, describe_check, describe_loose_metrics
from diffabs.scenario import section_sweep
from diffabs.scenario.scenario import load, loads
from diffabs.uncertainty.sweep import Results, sweep
from diffabs.uncertainty.sweep.checking import _choose_samples, accuracy_warnings, check_accuracy

RELAY = """
plant = "mirrored-rig"
initial.speed_kmh = 30.0
stop = {type = "speed-reached", speed_kmh = 25.0}
controller = {type = "relay", high = 12.0}
actuator = {type = "rate-limit", rate = 500.0}
solver = {step = 2e-3, duration = 1.0}
sweep = {samples = 40, chunk = 40, seed = 5, check = 6, over = {"plant.mass" ={low=5.3,high=6.2}}}
"""

TURNS = ["never at all", "half", "quarter", "always"]
PAIRS = {
    "to never": (0.3, np.inf, ["settling_time from 0.3 to never"]),
    "from never": (np.inf, 0.3, ["settling_time from never to 0.3"]),
    "to NaN": (0.3, np.nan, ["settling_time from 0.3 to none"]),
    "never": (np.inf, np.inf, []),
    "both NaN": (np.nan, np.nan, []),
    "near": (0.3, 0.3002, []),
    "far": (0.3, 0.33, ["settling_time by 9.1 %"]),
}

pytestmark = pytest.mark.usefixtures("any_step_is_stable", "without_load")


@pytest.mark.slow
def test_simulate_check_says_how_accurate_each_metric_is(file):
    path = file(RELAY)
    result = json.loads(run("simulate", path, "--check", "--json").stdout)
    found, chosen = result["accuracy"], load(path)
    assert [one["step"] for one in found["solvers"]] == [2e-3, 1e-3, 5e-4]
    assert found["comparable"]
    assert list(found["metrics"]) == list(chosen.objectives)
    half = d.measure(chosen.loop, d.FixedStep(1e-3, 1.0), chosen.objectives).metrics
    for name, row in found["metrics"].items():
        assert row["value"] == result["metrics"][name]
        assert row["value"] + row["difference"] == pytest.approx(float(half[name]), rel=1e-9, abs=1e-12), name
        assert abs(row["float32 difference"]) < 1e-2 * abs(row["value"]) + 1e-4, name
        assert row["error"] >= abs(row["difference"])
    shown = run("simulate", path, "--check")
    assert "half step" in shown.stdout
    assert max(map(len, shown.stdout.splitlines())) <= 100


@pytest.mark.slow
def test_check_without_a_metric_to_compare_gives_no_number(file):
    result = run(
        "simulate",
        file(RELAY.replace('"mirrored-rig"', '"mirrored-rig"\nreference = "peak-literal"')),
        "--check",
        "--json",
    )
    found = json.loads(result.stdout)["accuracy"]
    assert not found["comparable"]
    assert all(row["difference"] is None and row["error"] is None for row in found["metrics"].values())
    assert "warning: accuracy unknown: reference computes once in every step" in result.stderr


@pytest.mark.slow
def test_a_step_that_cannot_be_shortened(file):
    long = RELAY.replace("duration = 1.0", "duration = 6e4")
    assert_one_error_line(failed := run("simulate", file(long), "--check", status=2))
    assert "a quarter of it takes too many steps for --check" in failed.stderr


@pytest.mark.slow
def test_a_sweep_says_how_accurate_it_is_without_being_asked(file, tmp_path):
    path, out = file(RELAY), tmp_path / "out"
    result = run("sweep", path, "--out", out, "--json")
    found = json.loads(result.stdout)["accuracy"]
    assert json.loads((out / "summary.json").read_text())["accuracy"] == found
    study, table = section_sweep.build_study(load(path)), Results(out)
    assert len(found["samples"]) == 6
    row = found["metrics"]["overshoot"]
    loop, key = study.lane(row["sample"])
    half = d.measure(loop, d.FixedStep(1e-3, 1.0), study.objectives, key=key).metrics["overshoot"]
    assert row["difference"] == pytest.approx(abs(float(half) - table.column("overshoot")[row["sample"]]), rel=1e-6)
    assert 0 <= row["median"] <= row["largest"]
    loose = {name for name, one in found["metrics"].items() if one["largest"] > 0.01}
    assert loose  # a relay behind a rate limit, at 2 ms
    assert all(f"{name} by up to " in result.stderr for name in loose)
    again = check_accuracy(study, table, 6)
    assert again["samples"] == found["samples"]
    assert check_accuracy(study, table, 0) == {**again, "samples": [], "metrics": {}}


@pytest.mark.slow
def test_a_sweep_is_not_checked_where_that_is_turned_off(file, tmp_path):
    path = file(RELAY.replace("check = 6", "check = 0"))
    assert json.loads(run("sweep", path, "--out", tmp_path / "out", "--json").stdout)["accuracy"] is None


@pytest.mark.slow
def test_noise_is_the_same_in_a_sweeps_half_steps(tmp_path):
    """Of the noisy sweep of the tests: the half step changes a hundredth of what other noise does."""
    study = section_sweep.build_study(
        loads(SCENARIO.replace("samples = 3200", "samples = 64").encode(), "small", "small.toml")
    )
    study = dataclasses.replace(study, objectives={"iae": study.objectives["iae"]})
    found = check_accuracy(study, sweep(study, tmp_path), 16)
    assert found["not comparable"] == 0
    assert found["metrics"]["iae"]["largest"] < 1e-3
    loop, _ = study.lane(0)
    two = [d.measure(loop, study.solver, study.objectives, key=jax.random.key(i)).metrics["iae"] for i in (1, 2)]
    assert abs(two[0] / two[1] - 1) > 1e-2


def test_lanes_that_are_no_result_are_not_drawn():
    columns = {"sample": np.arange(8), "diverged": np.arange(8) < 3, "refused": np.array([""] * 6 + ["bad"] * 2)}
    study = SimpleNamespace(seed=1)
    table: Any = SimpleNamespace(column=columns.__getitem__)
    assert _choose_samples(study, table, 100).tolist() == [3, 4, 5]
    assert len(_choose_samples(study, table, 2)) == 2


@killed_by("loop.checking", 'max(MIN_CHANGE * abs(row["value"]), ROUNDING)', 'MIN_CHANGE * abs(row["value"])')
def test_no_order_of_rounding_is_not_said():
    row = {"value": 8.9e-16, "converges": False, "error": 1.7e-14}
    found = {"reasons": [], "comparable": True, "ended alike": True, "turned": [], "metrics": {"final_slip_error": row}}
    assert describe_check(found) == []
    row["error"] = 1e-9
    assert describe_check(found) == ["shorter steps do not converge for final_slip_error: the error is a guess"]


def test_what_is_said():
    nothing = {"metrics": {}, "turned": {}, "ended otherwise": 0, "not comparable": 0}
    assert accuracy_warnings(nothing) == []
    loose = {
        **nothing,
        "metrics": {
            "iae": {"largest": 0.03, "difference": 1e-4, "sample": 7},
            "stop_time": {"largest": 0.009, "difference": 0.02, "sample": 8},
            "final_slip_error": {"largest": 0.5, "difference": 1e-10, "sample": 9},
        },
    }
    line = "a half step changes iae by up to 3 % (sample 7): "
    assert accuracy_warnings(loose) == [f"{line}shorten solver.step"]
    assert accuracy_warnings({**loose, "solver": {"rtol": 1e-5}}) == [f"{line}lower solver.rtol"]
    assert accuracy_warnings({**loose, "solver": {"rtol": 1e-3}}) == []
    assert "2 of the lanes" in accuracy_warnings({**nothing, "ended otherwise": 2})[0]
    assert "accuracy unknown" in accuracy_warnings({**nothing, "not comparable": 1})[0]
    never = {**nothing, "samples": [3, 5, 8], "turned": {"settling_time": {"count": 2, "samples": [5, 8]}}}
    (line,) = accuracy_warnings(never)
    where = "in 2 of 3 runs, the first sample 5"
    assert line.startswith(f"settling_time is finite with one step and never with the other {where}: ")
    assert accuracy_warnings({key: value for key, value in never.items() if key != "turned"}) == []  # an older result


@dataclasses.dataclass(frozen=True)
class EndlessSteps:
    """The number of steps of a run, and "never" above a limit."""

    most: int
    unit = "1"
    unreached = np.inf

    def start(self, sample):
        del sample
        return Memory((), jnp.zeros(()))

    def flow(self, memory, sample):
        del memory, sample
        return ()

    def update(self, memory, segment):
        del segment
        return memory.held + 1

    def value(self, memory, ending):
        del ending
        return jnp.where(memory.held > self.most, jnp.inf, memory.held)


jax.tree_util.register_dataclass(EndlessSteps, [], ["most"])


@pytest.mark.slow
@killed_by("loop.accuracy", "jnp.stack([coarse, half, quarter])", "jnp.stack([coarse, half])", case="quarter")
@killed_by("loop.accuracy", "jnp.any(finite) & ~jnp.all(finite)", "jnp.any(finite)")
@pytest.mark.parametrize(("most", "turned"), [(9, []), (10, ["steps"]), (20, ["steps"]), (40, [])], ids=TURNS)
def test_a_shorter_step_that_turns_a_number_into_never(file, most, turned):
    """Ten steps become twenty, and forty."""
    chosen = load(file(RELAY.replace("step = 2e-3, duration = 1.0", "step = 2e-3, duration = 0.02")))
    chosen = dataclasses.replace(chosen, objectives={"steps": EndlessSteps(most)})
    found = check_run_accuracy(chosen.loop, chosen.solver, chosen.objectives, chosen.key())
    assert found["metrics"]["steps"]["value"] == (10 if most >= 10 else np.inf)
    assert found["turned"] == turned
    lines = describe_check(found)
    said = "steps is finite with one step and never with another: its value cannot be trusted"
    assert [said in lines] == [bool(turned)]


@killed_by("loop.checking", "if differs_in_kind(value, finer_value):", "if False:")
@killed_by("loop.result", "~(np.isnan(first) & np.isnan(second))", "True", case="both NaN")
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("one", "other", "words"), PAIRS.values(), ids=PAIRS)
def test_a_change_to_never_is_the_largest_of_rtol(one, other, words):
    solver = Adaptive(rtol=1e-5)
    run: Any = SimpleNamespace(diverged=False, metrics={"settling_time": np.float64(other)})
    lines = describe_loose_metrics({"settling_time": np.float64(one)}, solver, lambda finer: run)
    assert [line.partition("changes ")[2].partition(":")[0] for line in lines] == words


@killed_by("loop.checking", "    if finer.diverged:", "    if False:")
def test_a_closer_run_that_diverges_is_said():
    run: Any = SimpleNamespace(diverged=np.bool_(True), metrics={"iae": np.float64(np.nan)})
    lines = describe_loose_metrics({"iae": np.float64(0.3)}, Adaptive(rtol=1.6e-4), lambda finer: run)
    assert lines == ["the run diverges with solver.rtol = 1e-05: its metrics cannot be trusted"]
