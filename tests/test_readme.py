"""The README's code runs and says what the README says of it; its commands exist."""

import importlib.resources
import pathlib
import re
import tempfile
import textwrap

import numpy as np
import pytest
from typer.testing import CliRunner

from diffabs.cli.main import app
from diffabs.scenario.scenario import load

TEXT = (pathlib.Path(__file__).parent.parent / "README.md").read_text()
SWEEPS = (pathlib.Path(__file__).parent.parent / "docs" / "sweeps.md").read_text()
CODE, DESIGN, TUNE = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def test_the_twelve_lines_run():
    code = CODE.replace("64)", "3)")  # 9 lanes instead of 4,096: the same call
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    assert names["many"]["overshoot"].shape == (9,)
    assert np.all(np.isfinite(names["slope"]))
    assert np.all(names["slope"] != 0)
    assert len([line for line in CODE.splitlines() if line.strip()]) <= 16


def test_4096_masses_and_roads_in_one_call():
    code = CODE.replace("FixedStep(1e-3, 4.0)", "FixedStep(1e-3, 0.05)").rsplit("slope", 1)[0]
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    overshoot = np.asarray(names["many"]["overshoot"])
    assert overshoot.shape == (4096,)
    assert len(np.unique(overshoot)) > 4000
    one = names["brake"]({"plant.mass": names["masses"][1234], "plant.road.w4": names["grips"][1234]})
    np.testing.assert_allclose(overshoot[1234], one["overshoot"], rtol=1e-10)


def test_the_robust_design_runs():
    names = {}
    exec(compile(DESIGN, "README.md", "exec"), names)
    assert names["found"].certificate.verified_exactly
    assert names["found"].certificate.decay_rate >= 20.0
    assert names["published"].quadratically_stable is False


@pytest.mark.slow
def test_the_tuning_runs():
    names = {}
    exec(compile(CODE.rsplit("masses, grips", 1)[0], "README.md", "exec"), names)
    exec(compile(TUNE, "README.md", "exec"), names)
    found = names["found"]
    assert found.objective[1] < 0.6 * found.objective[0]
    assert np.max(found.metrics[1]["overshoot"]) < 0.02


def test_the_sweep_of_the_page_on_sweeps_runs(tmp_path, monkeypatch):
    code, _ = re.findall(r"```python\n(.*?)```", SWEEPS, re.DOTALL)  # the other: test_sweep_processes.py
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(code.replace("256", "64").replace("128", "32"), "sweeps.md", "exec"), names)
    frame = names["frame"]
    assert len(frame) == 64
    assert frame["plant.mass"].between(5.3, 6.2).all()
    assert (frame["stop_distance"].corr(frame["plant.road.w4"])) < -0.9
    assert len(list((tmp_path / "out" / "sweep" / "chunks").iterdir())) == 2


@pytest.mark.parametrize("command", re.findall(r"^    diffabs ((?:list|certify) .*)$", TEXT, re.MULTILINE))
def test_commands_exist(command):
    assert CliRunner().invoke(app, command.split()).exit_code == 0


def test_the_promised_message():
    result = CliRunner().invoke(app, ["simulate", "slip-lmi", "--set", "plant.mass=-1"])
    assert result.exit_code == 2
    assert re.search(r"^    (error: .*)$", TEXT, re.MULTILINE)[1] in result.stderr


def test_the_section_for_tuning_is_one():
    block = re.search(r"^    \[tune\]\n(?:    .*\n)+", TEXT, re.MULTILINE)
    packaged = importlib.resources.files("diffabs") / "scenarios" / "slip-cured.toml"
    head = packaged.read_text().partition("[tune]")[0]
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "mine.toml"
        path.write_text(head + textwrap.dedent(block[0]))
        goal = load(path, integrated=False).tune.check(load("slip-cured", integrated=False).loop)
    assert set(goal.free) == {"controller.controller.gain", "reference.time_constant"}
    assert goal.batch(0).size == 9
