"""The commands on a loop with two inputs, and docs/plant-with-two-inputs.md."""

import json
import re

import numpy as np
import pytest
from commands import assert_one_error_line, run
from mutants import killed_by
from project import ROOT
from seams import replace_seam

from diffabs.loop.batch import Batch
from diffabs.loop.ensemble import run_batch
from diffabs.robust.design.polytopes import Coverage
from diffabs.robust.frequency import PeakBounds
from diffabs.scenario.scenario import dump, load, loads

HERE = ROOT / "examples" / "two-inputs"
SHORT = ("--set", "solver.duration=30")


@killed_by("loop.convert", '{f"{name}_{key}": (', '{f"{key}_{name}": (')
def test_a_run_has_columns_of_each_channel(tmp_path):
    out = tmp_path / "run.csv"
    result = run("simulate", "quadruple-tank", *SHORT, "--csv", out, "--plot", tmp_path / "run.svg", "--json")
    assert {"iae_1", "iae_2"} < json.loads(result.stdout)["metrics"].keys()
    header = out.read_text().partition("\n")[0].split(",")
    assert {"control_pump_1 [V]", "target_level_2 [m]", "feedforward_pump_2 [V]"} < {*header}
    free = ("--set", "plant.share_1=0.75", "--free", "plant.share_1=0.5:0.9")
    identified = run("identify", "quadruple-tank", *SHORT, "--data", out, *free, "--json", "-q")
    np.testing.assert_allclose(json.loads(identified.stdout)["values"]["plant.share_1"]["value"], 0.7, rtol=1e-6)


def test_a_scenario_is_written_and_read_again():
    text = dump(load("quadruple-tank", ["controller.pump_1.kp=100", "reference.level_2.value=0.14"]))
    again = loads(text.encode(), "again", "again")
    assert dump(again) == text
    assert again.loop.controller.controller["pump_1"].kp == 100.0


@killed_by("scenario.registry", "{**default, **static}", "static")
def test_an_override_changes_one_channel():
    loop = load("quadruple-tank", ["controller.channels.pump_1=level_2", "controller.pump_2=pid"]).loop
    assert dict(loop.controller.channels) == {"pump_1": "level_2", "pump_2": "level_2"}
    assert loop.controller.controller["pump_2"].kp == 3893.0


@pytest.mark.slow
def test_tune_and_sweep(tmp_path):
    tuned = tmp_path / "tuned.toml"
    fast = ("--set", "solver.duration=60", "--set", "tune.iterations=2", "--set", "sweep.samples=16")
    result = json.loads(run("tune", HERE / "tank.toml", *fast, "--out", tuned, "--json").stdout)
    assert result["objective"]["after"] < 0.9 * result["objective"]["before"]
    summary = json.loads(run("sweep", tuned, "--out", tmp_path / "swept", "--json").stdout)
    assert summary["complete"]
    assert {"overshoot_1", "iae"} < summary["metrics"].keys()


@pytest.mark.slow
def test_a_rare_failure_of_one_channel():
    """About one pair of valve settings in 180, as the runs of a grid of pairs show it."""
    words = ("overshoot_1=0.33", "--samples", 400, "--seed", 3, "--json")
    result = json.loads(run("rare", HERE / "tank.toml", *words).stdout)
    assert len(result["levels"]) > 1
    chosen, n = load(HERE / "tank.toml"), 60
    places = 0.1 * (np.arange(n) + 0.5) / n
    shares = [x.ravel() for x in np.meshgrid(0.65 + places, 0.55 + places)]
    batch = Batch(dict(zip(("plant.share_1", "plant.share_2"), shares, strict=True)))
    runs = run_batch(chosen.loop, batch, chosen.solver, {"overshoot": chosen.objectives["overshoot_1"]})
    share = float(np.mean(np.asarray(runs.metrics["overshoot"]) > 0.33))
    low, high = result["interval"]
    assert low < share < high < 4 * share


REFUSED = {
    "a channel of no output": (
        ["simulate", "quadruple-tank", "--set", "controller.channels.pump_1=level_9"],
        "level_9",
    ),
    "a controller of one": (["simulate", "quadruple-tank", "--set", "controller=pid"], "per-channel"),
    "a controller without a channel": (
        ["simulate", "quadruple-tank", "--set", "controller.pump_3=pid"],
        "there are controllers of pump_1, pump_2, pump_3",
    ),
    "a misspelt channel": (
        ["simulate", "quadruple-tank", "--set", "controller.pump_9.kp=3"],
        "controller.pump_9 is no part of per-channel; did you mean pump_2? There is pump_1, pump_2, channels",
    ),
    "a number of a channel out of range": (
        ["simulate", "quadruple-tank", "--set", "controller.pump_1.cutoff=-3"],
        "controller.pump_1.cutoff = -3 is outside (0, inf) rad/s",
    ),
    "one of several targets": (
        ["margins", "quadruple-tank", "--at", "target=0.13"],
        "--at target = 0.13: there are several targets, level_1, level_2; set their references",
    ),
    "a proof": (["certify", "quadruple-tank"], "needs a loop with one control; plant QuadrupleTank has pump_1, pump_2"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_go_is_refused_in_a_line(name):
    words, line = REFUSED[name]
    result = run(*words, status=2)
    assert_one_error_line(result)
    assert line in result.stderr


@killed_by("cli.margins", "if path not in values}\n    if not box:", "}\n    if not box:")
def test_bounds_stand_beside_what_is_found(monkeypatch):
    """The box is that of --over without what --at fixes; a bound is rounded up, and one that does not exist is said."""
    boxes = []

    def bound(loop, over):
        boxes.append((loop.plant.share_2, over))
        values = dict.fromkeys(over, 0.65)
        times = {"ascents": 1.0, "hull": 2.0, "constant": 3.0, "varying": 4.0}
        whole = PeakBounds(1.23, values, 0.05, 1.234561, 0.06, np.inf, True, 9, 4, Coverage(100, 0.9, 1.0), times)
        return {"sensitivity": whole, "complementary": whole._replace(constant=np.nan)}

    replace_seam(monkeypatch, "bound_peaks", bound)
    words = ("margins", "quadruple-tank", "--bounds", "--at", "plant.share_2=0.61")
    ranges = ("--over", "plant.share_1=0.6:0.7", "--over", "plant.share_2=0.5:0.6")
    shown = run(*words, *ranges).output
    assert "1.23" in shown
    assert "at most 1.2346" in shown
    assert shown.count("no bound") == 2
    assert "undecided" in shown
    assert "proved that no common Lyapunov matrix exists" in shown
    assert "4 vertices that cover 100 checked systems; constant 6 s, varying 8 s" in shown
    document = json.loads(run(*words, *ranges, "--json").stdout)["bounds"]
    assert document["over"]["plant.share_1"] == pytest.approx([0.6, 0.7])
    assert document["sensitivity"]["varying"] == "inf"
    assert document["complementary"]["constant"] is None
    assert [(share, list(over)) for share, over in boxes] == [(0.61, ["plant.share_1"])] * 2


def test_the_page_is_the_example():
    blocks = re.findall(
        r"```\w+\n# ([\w.]+)\n(.*?)```", (ROOT / "docs/plant-with-two-inputs.md").read_text(), re.DOTALL
    )
    files = {}
    for name, text in blocks:
        files[name] = files.get(name, "") + text
    assert set(files) == {"two_rooms.py", "rooms.toml", "tank.toml"}
    for name, text in files.items():
        assert text.split() == (HERE / name).read_text().split()


@pytest.fixture
def rooms(monkeypatch):
    monkeypatch.syspath_prepend(str(HERE))
    replace_seam(monkeypatch, "outside_named", {})


def test_the_two_rooms_of_the_page(rooms):
    """Warm rooms agree with the rest of the linear equations, and a fuse for both heaters holds."""
    result = json.loads(run("simulate", HERE / "rooms.toml", "--parts", "two_rooms", "--json").stdout)
    assert 0 < result["metrics"]["iae_room_1"] < 1e4
    page = (ROOT / "docs/plant-with-two-inputs.md").read_text()
    scope: dict = {}
    exec(re.search(r"```python\n(import jax\n.*?)```", page, re.DOTALL)[1], scope)
    import two_rooms

    import diffabs as d

    plant = two_rooms.TwoRooms()
    usual = plant.usual_parts()
    fuse = scope["SharedFuse"](controller=usual["controller"], high=3500.0)
    run_of_rooms = d.rollout(d.Loop(plant=plant, **{**usual, "controller": fuse}), d.FixedStep(5.0, 7200.0), {})
    power = np.asarray(run_of_rooms.trajectory.sample.command)
    assert np.max(power.sum(axis=0)) <= 3500.0 * (1 + 1e-12)
    np.testing.assert_allclose(run_of_rooms.ending.sample.output, (21.0, 18.0), atol=0.05)
