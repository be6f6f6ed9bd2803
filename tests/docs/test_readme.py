"""The code of README and docs runs and says what they say of it; their commands exist."""

import importlib.resources
import pathlib
import re
import subprocess
import sys
import tempfile
import textwrap
import urllib.request

import jax.numpy as jnp
import jaxtyping
import matplotlib.image
import numpy as np
import pytest
from project import ROOT
from typer.testing import CliRunner

import diffabs as d
from diffabs import objectives
from diffabs.cli.main import app
from diffabs.scenario.scenario import load

TEXT, COMMANDS, LIBRARY, SWEEPS = (
    (ROOT / page).read_text() for page in ("README.md", "docs/commands.md", "docs/library.md", "docs/sweeps.md")
)
(START,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
CODE, DESIGN, TUNE = re.findall(r"```python\n(.*?)```", LIBRARY, re.DOTALL)

FIRST = re.findall(r"^    diffabs (.*?)(?: {2,}#.*)?$", TEXT, re.MULTILINE)
TABLE = re.findall(r"\| `([^`]+)` \|$", TEXT, re.MULTILINE)
ELSEWHERE = {  # commands of the table that other tests execute; a study with fewer runs
    "diffabs prove": "tests/cli/test_cli_prove.py::test_the_command_of_the_readme_proves_the_cured_loop",
    "python experiments/overshoot_cured/run.py": (
        "tests/experiments/test_experiments.py::test_the_cure_holds_at_its_corners_and_not_beyond"
    ),
    "python experiments/best_slip/run.py": (
        "tests/references/test_best_slip.py::test_no_rule_beats_the_bound_and_tuning_shortens"
    ),
    "diffabs simulate": "tests/plants/test_car.py::test_the_page_tells_how_far_a_car_turns_on_a_split_road",
    "python experiments/lq_weights/run.py": (
        "tests/experiments/test_experiments.py::test_gradients_need_fewer_rollouts_than_searches_without"
    ),
}
PAPERS = [command.split()[2] for command in TABLE if command.startswith("diffabs reproduce")]


def test_a_test_executes_every_command_of_the_readme():
    """`make demo` runs each week."""
    assert [command.split()[0] for command in FIRST] == ["simulate", "margins", "tune", "export", "explore"]
    studies = {" ".join(command.split()[:2]) for command in TABLE if "reproduce" not in command}
    assert studies == ELSEWHERE.keys()
    for place in ELSEWHERE.values():
        file, name = place.split("::")
        assert f"def {name}(" in (ROOT / file).read_text(encoding="utf-8")
    assert "demo" in (ROOT / ".github/workflows/weekly.yml").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_first_commands_end_in_a_picture_and_a_controller(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for command in FIRST[:-1]:
        assert CliRunner().invoke(app, command.split()).exit_code == 0, command
    for picture in ("run.png", "loop.png"):
        assert matplotlib.image.imread(tmp_path / picture).std() > 0.05  # not blank
    assert load(tmp_path / "tuned.toml", integrated=False).loop.reference.time_constant < 0.03
    assert "controller" in (tmp_path / "controller.c").read_text()


@pytest.mark.slow
def test_the_explorer_of_the_readme_opens(tmp_path):
    pytest.importorskip("nicegui", reason="needs the extra `explore`")
    command = [sys.executable, "-m", "diffabs", *FIRST[-1].split(), "--no-browser"]
    explorer = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        address = next(found[0] for line in explorer.stderr if (found := re.search(r"http://\S+", line)))
        browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())  # the token becomes a cookie
        assert "diffabs" in browser.open(address, timeout=60).read().decode()
    finally:
        explorer.kill()
        explorer.communicate()


@pytest.mark.slow
@pytest.mark.parametrize("paper", PAPERS)
def test_the_papers_of_the_readme_are_reproduced(paper, tmp_path):
    result = CliRunner().invoke(app, ["reproduce", paper, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert list(tmp_path.rglob("*.png"))


def test_the_readme_has_two_pages():
    """At 60 lines of 100 characters a page; a row of a table and a figure take more."""
    assert sum(-(-len(line) // 100) for line in TEXT.splitlines()) < 150


@pytest.mark.slow
def test_the_readme_prints_its_table(capsys):
    exec(compile(START.replace("4096", "3"), "README.md", "exec"), {})
    rows = capsys.readouterr().out.splitlines()
    numbers = {
        row.split()[0]: [float(x) for x in re.findall(r"[-\d.]+(?:e[-+]\d+)?", row.split(maxsplit=1)[1])]
        for row in rows
    }
    assert len(rows) == 8
    least, greatest, at, slope = numbers["stop_distance"]
    assert greatest / least == pytest.approx(2, rel=0.1)  # nearly in proportion to 1/grip
    assert (at, slope) == (0.4, pytest.approx(-12.33 / 0.4, rel=0.1))


@pytest.mark.slow
def test_the_twelve_lines_run():
    code = CODE.replace("64)", "3)")  # 9 lanes instead of 4,096: the same call
    names = {}
    exec(compile(code, "library.md", "exec"), names)
    assert names["many"]["overshoot"].shape == (9,)
    assert np.all(np.isfinite(names["slope"]))
    assert np.all(names["slope"] != 0)


@pytest.mark.slow
def test_4096_masses_and_roads_in_one_call():
    code = CODE.replace("FixedStep(1e-3, 4.0)", "FixedStep(1e-3, 0.05)").rsplit("slope", 1)[0]
    names = {}
    exec(compile(code, "library.md", "exec"), names)
    overshoot = np.asarray(names["many"]["overshoot"])
    assert overshoot.shape == (4096,)
    assert len(np.unique(overshoot)) > 4000
    one = names["brake"]({"plant.mass": names["masses"][1234], "plant.road.w4": names["grips"][1234]})
    np.testing.assert_allclose(overshoot[1234], one["overshoot"], rtol=1e-10)


@pytest.mark.slow
def test_values_have_the_shapes_of_the_table():
    """Names for sizes, such as `runs`, mean the same number in every row."""
    names = {name: getattr(jaxtyping, name) for name in ("Array", "Bool", "Float", "Int")}
    exec(compile(CODE.partition("masses, grips =")[0], "library.md", "exec"), names)
    loop, solver, metrics = names["rig"], d.FixedStep(1e-3, 0.02), {"iae": objectives.IAE()}
    gains = jnp.array([[-11753.0, -48.0]] * 3)
    batch = d.Batch({"plant.mass": jnp.array([5.3, 5.7, 6.2]), "controller.gain": gains})
    names |= {"loop": loop, "batch": batch, "run": d.rollout(loop, solver, metrics)}
    names["runs"] = d.run_batch(loop, batch, solver, metrics, trajectories=True)
    table = re.findall(r"^\| `(.+?)`, `(.+?)`.* \| `(.+?)` \| `(.+?)` \|$", LIBRARY, re.MULTILINE)
    assert len(table) == 7
    with jaxtyping.jaxtyped("context"):
        for one, many, type_of_one, type_of_many in table:
            for value, kind in ((one, type_of_one), (many, type_of_many)):
                assert isinstance(eval(value, names), eval(kind, names)), (value, kind)


def test_the_robust_design_runs():
    names = {}
    exec(compile(DESIGN, "library.md", "exec"), names)
    assert names["found"].certificate.verified_exactly
    assert names["found"].certificate.decay_rate >= 20.0
    assert names["published"].quadratically_stable is False


@pytest.mark.slow
def test_the_tuning_runs():
    names = {}
    exec(compile(CODE.partition("masses, grips =")[0], "library.md", "exec"), names)
    exec(compile(TUNE, "library.md", "exec"), names)
    found = names["found"]
    assert found.objective[1] < 0.6 * found.objective[0]
    assert np.max(found.metrics[1]["overshoot"]) < 0.02


@pytest.mark.slow
def test_the_sweep_of_the_page_on_sweeps_runs(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", SWEEPS, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(code.replace("256", "64").replace("128", "32"), "sweeps.md", "exec"), names)
    frame = names["frame"]
    assert len(frame) == 64
    assert frame["plant.mass"].between(5.3, 6.2).all()
    assert (frame["stop_distance"].corr(frame["plant.road.w4"])) < -0.9
    assert len(list((tmp_path / "out" / "sweep" / "chunks").iterdir())) == 2


@pytest.mark.parametrize("command", re.findall(r"^    diffabs ((?:list|certify) .*)$", COMMANDS, re.MULTILINE))
def test_commands_exist(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # one writes a proof
    assert CliRunner().invoke(app, command.split()).exit_code == 0


def test_the_promised_message():
    result = CliRunner().invoke(app, ["simulate", "slip-lmi", "--set", "plant.mass=-1"])
    assert result.exit_code == 2
    assert re.search(r"^    (error: .*)$", COMMANDS, re.MULTILINE)[1] in result.stderr


def test_the_section_for_tuning_is_one():
    block = re.search(r"^    \[tune\]\n(?:    .*\n)+", COMMANDS, re.MULTILINE)
    packaged = importlib.resources.files("diffabs.scenario") / "scenarios" / "slip-cured.toml"
    head = packaged.read_text().partition("[tune]")[0]
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "mine.toml"
        path.write_text(head + textwrap.dedent(block[0]))
        goal = load(path, integrated=False).tune.check(load("slip-cured", integrated=False).loop)
    assert set(goal.free) == {"controller.controller.gain", "reference.time_constant"}
    assert goal.batch(0).size == 9
