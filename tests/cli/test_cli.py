"""The command line as a script sees it: exit status, stdout, stderr, and the files it leaves."""

import collections
import csv
import io
import json
import math
import os
import pathlib
import re
import shlex
import signal
import subprocess
import sys
import tomllib
import types

import numpy as np
import pytest
import typer
from commands import assert_one_error_line, left_in, run, umask
from mutants import killed_by
from project import ROOT
from seams import replace_seam
from typer.testing import CliRunner

import diffabs
from diffabs.cli import main
from diffabs.core.protocols import Sample
from diffabs.core.pytree import parameters
from diffabs.loop.convert import write_csv
from diffabs.loop.stability import stable_step
from diffabs.parts.objectives import BRAKING
from diffabs.scenario import model, registry, scenario, simulation

SHORT = ("--set", "solver.duration=0.02", "--set", "solver.step=1e-3", "--set", "solver.every=1")


class Figure:
    """Stands for a figure: what it writes shows what was drawn, and in what format."""

    def __init__(self, text: str):
        self.text = text

    def savefig(self, path: pathlib.Path):
        pathlib.Path(path).write_text(f"{self.text} {pathlib.Path(path).suffix}")


pytestmark = pytest.mark.usefixtures("any_step_is_stable")  # it has tests of its own


@pytest.fixture(scope="module")
def runs():
    """The runs of `whole`, for tests that need any run."""
    return []


@pytest.fixture(scope="module")
def whole(tmp_path_factory, runs):
    """One whole run of slip-lmi with everything written."""
    folder = tmp_path_factory.mktemp("whole")
    simulated = simulation._run
    with pytest.MonkeyPatch.context() as patch:
        replace_seam(patch, "main_run", lambda *args, **more: runs.append(simulated(*args, **more)) or runs[-1])

        def draw(run, *, title="", unit=""):
            return Figure(f"{title}: {bool(run.stopped)}")

        plot = types.SimpleNamespace(draw_run=draw)
        patch.setitem(sys.modules, "diffabs.output.plot", plot)
        result = run("simulate", "slip-lmi", "--json", "--csv", folder / "a.csv", "--plot", folder / "a.png")
    return folder, json.loads(result.stdout)


# simulate


def test_json_has_what_scripts_rely_on(whole):
    folder, document = whole
    old = {"scenario", "metrics", "stopped", "diverged", "solver", "versions", "files"}
    assert set(document) == old | {"format", "fault", "title", "parts", "parameters", "at_limit", "warnings"}
    assert document["scenario"] == "slip-lmi"
    assert list(document["metrics"]) == list(BRAKING)
    assert document["stopped"] is True
    assert document["diverged"] is False
    assert document["solver"] == {"step": 1e-4, "duration": 2.5, "seed": 0}
    assert set(document["versions"]) == {"diffabs", "jax", "python"}
    assert document["versions"]["diffabs"] == diffabs.__version__
    assert document["files"] == {"csv": str(folder / "a.csv"), "plot": str(folder / "a.png")}


def test_metrics_are_the_reference_numbers(whole):
    """An independent, converged integration gave these (unlimited torque); float64 or they would not come out."""
    metrics = whole[1]["metrics"]
    assert metrics["max_slip"] == pytest.approx(0.308331266209, abs=2e-8)
    assert metrics["settling_time"] == pytest.approx(0.122693, abs=1e-6)
    assert metrics["stop_time"] == pytest.approx(1.611940500246, abs=1e-9)
    assert metrics["stop_distance"] == pytest.approx(12.326404879818, abs=1e-8)
    assert metrics["iae"] == pytest.approx(0.005443262785, abs=2e-8)
    assert metrics["overshoot"] == pytest.approx(0.308331266209 / 0.2 - 1, abs=1e-7)
    assert metrics["locked_time"] == 0.0


@killed_by("loop.convert", 'csv.writer(file, lineterminator="\\n").writerow(columns)', 'file.write(",".join(columns))')
def test_a_unit_with_a_comma_is_one_column(tmp_path):
    unit, numbers = 'deg, of the "wheel"', np.arange(2.0)
    plant, shows = types.SimpleNamespace(control_unit="V"), collections.namedtuple("Output", ["angle"])
    shows.units = {"angle": unit}
    sample = Sample(numbers, shows(numbers), *[numbers] * 5)
    trajectory = types.SimpleNamespace(sample=sample, running=np.array([True, False]))
    run = types.SimpleNamespace(trajectory=trajectory, stopped=True)
    write_csv(tmp_path / "a.csv", run, plant)
    with (tmp_path / "a.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header == [
        *("t [s]", f"angle [{unit}]", f"target [{unit}]", f"setpoint [{unit}]"),
        *("feedforward [V]", "command [V]", "control [V]"),
    ]
    assert rows == [["0"] * 7, ["1"] * 7]


def test_csv_is_the_run(whole):
    folder, document = whole
    header, *rows = (folder / "a.csv").read_text().splitlines()
    assert header == (
        "t [s],slip [1],speed [m/s],wheel_speed [m/s],deceleration [m/s^2],distance [m],target [1],setpoint [1],"
        "feedforward [N m],command [N m],control [N m]"
    )
    numbers = np.array([row.split(",") for row in rows], float)
    t, slip, speed, wheel, _, distance, target, setpoint, feedforward, command, control = numbers.T
    np.testing.assert_allclose(t[:-1], 1e-3 * np.arange(len(t) - 1), rtol=1e-11, atol=0)
    assert t[-1] == pytest.approx(document["metrics"]["stop_time"], rel=1e-11)
    assert distance[-1] == pytest.approx(document["metrics"]["stop_distance"], rel=1e-11)
    assert t[-1] > t[-2]
    assert (speed[0], speed[-1]) == (pytest.approx(50 / 3.6, rel=1e-11), pytest.approx(5 / 3.6, rel=1e-11))
    np.testing.assert_allclose(slip, (speed - wheel) / speed, atol=1e-9)
    assert set(target) == set(setpoint) == {0.2}
    assert len(set(feedforward)) == 1
    np.testing.assert_array_equal(command, control)


def test_figure_and_nothing_else_is_left(whole):
    folder, _ = whole
    assert (folder / "a.png").read_text() == "State feedback on the mirrored rig, published gain: True .png"
    assert left_in(folder) == {"a.csv", "a.png"}
    assert (folder / "a.csv").stat().st_mode & 0o777 == 0o666 & ~umask()


@pytest.mark.slow
def test_a_long_trajectory_is_thinned(tmp_path, monkeypatch):
    replace_seam(monkeypatch, "max_csv_rows", 5)
    (tmp_path / "a.csv").write_text("old")
    os.link(tmp_path / "a.csv", tmp_path / "reader.csv")  # stands for someone who has the old file open
    run("simulate", "slip-lmi", *SHORT, "--csv", tmp_path / "a.csv")
    rows = (tmp_path / "a.csv").read_text().splitlines()[1:]
    assert [row.split(",")[0] for row in rows] == ["0", "0.004", "0.008", "0.012", "0.016", "0.02"]
    assert (tmp_path / "reader.csv").read_text() == "old"


@pytest.mark.slow
def test_not_stopped_is_done_but_said_loudly():
    result = run("simulate", "slip-lmi", *SHORT)
    assert "NOT STOPPED within solver.duration = 0.02 s" in result.stderr
    assert "with the last deceleration, at least 0.001 m/s^2" in result.stderr
    assert "stop_distance" in result.stdout
    document = json.loads(run("simulate", "slip-lmi", *SHORT, "--json").stdout)
    assert document["stopped"] is False


@pytest.mark.slow
def test_table_shows_units():
    lines = run("simulate", "slip-lmi", *SHORT).stdout.splitlines()
    units = {line.split("│")[1].strip(): line.split("│")[3].strip() for line in lines if line.startswith("│")}
    assert units == {name: registry.unit_of(part) for name, part in BRAKING.items()}


@pytest.mark.slow
def test_diverged_could_not_be_done():
    blow_up = ("--set", "controller=constant-torque", "--set", "controller.torque=-1e308")
    result = run("simulate", "slip-lmi", *SHORT, *blow_up, "--json", status=1)
    document = json.loads(result.stdout)
    assert document["diverged"] is True
    assert set(document["metrics"].values()) == {None}
    assert "error: slip-lmi diverged" in result.stderr


@pytest.mark.slow
def test_seed_decides_the_noise():
    def iae(*more: str) -> float:
        noise = ("--set", "sensor=noise", "--set", "sensor.slip=0.01")
        return json.loads(run("simulate", "slip-lmi", *SHORT, *noise, "--json", *more).stdout)["metrics"]["iae"]

    first = iae("--seed", "1")
    assert first == iae("--set", "solver.seed=1")
    assert first != iae("--seed", "2")


@pytest.fixture
def simulated(whole, runs, monkeypatch):
    """Every simulation gives the run of slip-lmi."""
    replace_seam(monkeypatch, "main_run", lambda chosen, key, keep: runs[0])


def test_lab_rig_commands_have_no_torque_unit(tmp_path, simulated):
    run("simulate", "lab-rig", "--csv", tmp_path / "a.csv")
    header = (tmp_path / "a.csv").read_text().splitlines()[0]
    assert header.endswith("command [1],control [1]")


def test_step_that_is_not_stable(monkeypatch):
    replace_seam(monkeypatch, "stable_step", stable_step)
    result = run("simulate", "slip-lmi", "--set", "solver.step=0.01", status=2)
    assert_one_error_line(result)
    assert "solver.step = 0.01 s is not stable" in result.stderr


@pytest.mark.parametrize(
    ("args", "needed"),
    [
        (("--csv", "none/a.csv"), "No such file or directory"),
        (("--csv", "."), "is not a regular file"),
        (("--csv", "/dev/null"), "/dev/null: is not a regular file"),
        (("--csv", "file/a.csv"), "Not a directory"),
        (("--plot", "none/a.png"), "No such file or directory"),
        (("--plot", "a.xyz"), ".png"),
        (("--csv", "a.png", "--plot", "./a.png"), "the same file"),
    ],
)
def test_target_that_cannot_be_written(tmp_path, monkeypatch, args, needed):
    monkeypatch.chdir(tmp_path)
    replace_seam(monkeypatch, "console_load", lambda *_: pytest.fail("looked at the scenario first"))
    (tmp_path / "file").write_text("")
    result = run("simulate", "slip-lmi", *args, status=2)
    assert_one_error_line(result)
    assert needed in result.stderr
    assert left_in(tmp_path) == {"file"}
    assert not pathlib.Path("/dev/null").is_file()


def test_plot_without_matplotlib(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result = run("simulate", "slip-lmi", "--plot", tmp_path / "a.png", status=2)
    assert_one_error_line(result)
    assert 'pip install ".[plot]" in a clone' in result.stderr


@pytest.mark.slow
def test_real_figure(tmp_path, simulated):
    pytest.importorskip("matplotlib")
    run("simulate", "slip-lmi", "--plot", tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert left_in(tmp_path) == {"a.png"}


def test_failure_at_the_end_leaves_old_files_as_they_were(tmp_path, monkeypatch, simulated):
    def full(run, **_):
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(sys.modules, "diffabs.output.plot", types.SimpleNamespace(draw_run=full))
    (tmp_path / "a.csv").write_text("old")
    files = ("--csv", tmp_path / "a.csv", "--plot", tmp_path / "a.png")
    result = run("simulate", "slip-lmi", *files, status=1)
    assert result.stderr.splitlines()[-1] == f"error: {tmp_path / 'a.png'}: No space left on device"
    assert (tmp_path / "a.csv").read_text() == "old"
    assert left_in(tmp_path) == {"a.csv"}


# What was run


def test_json_says_all_that_it_ran_with(whole):
    document = whole[1]
    loop = scenario.load("slip-lmi").loop
    assert {path for path, _, _ in parameters(loop)} <= set(document["parameters"])
    for path, spec, value in parameters(loop):
        row = document["parameters"][path]
        assert row["unit"] == spec.unit
        np.testing.assert_array_equal(np.asarray(row["value"], float), value)
    assert document["parameters"]["controller.low"] == {"value": "-inf", "unit": "N m"}
    assert document["parameters"]["objective.settling_time.band"] == {"value": 0.01, "unit": "1"}
    assert document["parts"]["controller"] == {"type": "state-feedback"}
    assert document["parts"]["plant.road"] == {"type": "rational-curve"}
    assert document["title"] == "State feedback on the mirrored rig, published gain"


@pytest.mark.slow
@pytest.mark.parametrize("name", scenario.names())
def test_parts_and_parameters_of_the_json_make_the_same_loop(name):
    chosen = scenario.load(name, integrated=False)
    parts = [f"{path}={{type='{row['type']}'}}" for path, row in model.describe_parts(chosen).items()]
    fixed = [f"{p}.{k}={v}" for p, row in model.describe_parts(chosen).items() for k, v in row.items() if k != "type"]
    numbers = model.describe_numbers(chosen)
    values = [f"{path}={json.dumps(row['value'])}".replace('"', "") for path, row in numbers.items()]
    again = scenario.loads(b"", name, name, [*parts, *fixed, *values], integrated=False)
    assert model.describe_numbers(again) == numbers


def test_a_figure_does_not_claim_what_was_changed(tmp_path, runs, monkeypatch):
    """Seen at least once: "published gain" over a run with another gain."""
    titles = []

    def draw(run, *, title="", unit=""):
        titles.append(title)
        return Figure(title)

    monkeypatch.setitem(sys.modules, "diffabs.output.plot", types.SimpleNamespace(draw_run=draw))
    replace_seam(monkeypatch, "main_run", lambda chosen, key, keep: runs[0])
    gain = ("--set", "controller.gain=-4000,-40")
    tables = [run("simulate", "slip-lmi", *more, "--plot", tmp_path / "a.png").stdout for more in ((), gain)]
    named = ("--set", "title=mine")
    run("simulate", "slip-lmi", *gain, *named, "--plot", tmp_path / "a.png")
    assert titles == [
        "State feedback on the mirrored rig, published gain",
        "slip-lmi with controller.gain=-4000,-40",
        "mine",
    ]
    assert [table.splitlines()[0] for table in tables] == titles[:2]


def test_a_long_title_stays_on_its_figure():
    pytest.importorskip("matplotlib")
    from diffabs.output.plot import sheet

    figure, _ = sheet(2, 2, title=f"slip-lmi with {', '.join(f'plant.mass={n}' for n in range(300))}")
    figure.draw_without_rendering()
    box = figure._suptitle.get_window_extent()
    assert 0 <= box.x0 < box.x1 <= figure.bbox.width
    assert box.height < figure.bbox.height / 4


# The program


COMMANDS = list(typer.main.get_command(main.app).commands)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_help_has_an_example_that_is_right(command, monkeypatch):
    """Its words are parsed; nothing is run."""
    example = re.search(r"Example:\n\n +diffabs (.*)\n", run(command, "-h").stdout)[1]
    group = typer.main.get_command(main.app)
    name, *args = shlex.split(example)
    assert name == command
    given = group.commands[name].make_context(name, list(args)).params
    if "changes" in given:
        scenario.load(given["scenario"], given["changes"] or (), integrated=False)


@pytest.mark.slow
def test_quiet_says_results_and_warnings_only(monkeypatch):
    noise = ("--set", "sensor=noise", "--set", "solver.seed=3")
    replace_seam(monkeypatch, "patience", 0.0)
    loud, quiet = (run("simulate", "slip-lmi", *SHORT, *noise, *more) for more in ((), ("-q",)))
    assert "checking the scenario" in loud.stderr
    assert {line.partition(":")[0] for line in quiet.stderr.splitlines()} == {"warning"}
    assert quiet.stdout == loud.stdout
    assert "checking the scenario" in run("simulate", "slip-lmi", *SHORT).stderr  # the next one is loud again


@pytest.mark.slow
def test_show_prints_a_scenario_to_start_from(tmp_path):
    """What is printed is the same scenario, so its run is the same to the last bit."""
    text = run("show", "slip-lmi", "--set", "plant.mass=6.2", *SHORT).stdout
    (tmp_path / "mine.toml").write_text(text)
    assert run("show", "slip-lmi", "--set", "plant.mass=6.2", *SHORT, "--out", tmp_path / "other.toml").stdout == ""
    assert (tmp_path / "other.toml").read_text() == text
    given, shown = (("slip-lmi", "--set", "plant.mass=6.2", *SHORT), (tmp_path / "mine.toml",))
    first, second = (json.loads(run("simulate", *words, "--json").stdout) for words in (given, shown))
    assert first["metrics"] == second["metrics"]
    assert first["parameters"] == second["parameters"]
    assert first["title"] == second["title"] == "slip-lmi with plant.mass=6.2, " + ", ".join(SHORT[1::2])


def test_a_removed_entry_is_a_note():
    changes = ("--set", "controller=relay")
    note = "note: controller=relay removes tune.free.controller.gain of the replaced part"
    assert note in run("show", "slip-lmi", *changes).stderr.splitlines()
    assert run("show", "slip-lmi", *changes, "-q").stderr == ""


@killed_by("cli.usage", "        console.escape_unencodable_output()\n", "")
def test_a_title_that_stdout_cannot_encode_is_escaped(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("title = 'ブレーキ'", encoding="utf-8")
    result = CliRunner(charset="latin-1").invoke(main.app, ["show", str(path)])
    assert result.exit_code == 0
    assert r'title = "\u30d6\u30ec\u30fc\u30ad"' in result.stdout


@killed_by(
    "cli.console", "(error.filename is None or error.errno in files.DISK_ERRORS) and _is_output_refused()", "False"
)
def test_help_on_a_full_disk_is_one_error_line(monkeypatch, capsys):
    class Full(io.StringIO):
        def write(self, text):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(sys, "stdout", Full())
    with pytest.raises(SystemExit) as left:
        main.app(["--help"])
    assert left.value.code == 1
    assert capsys.readouterr().err == "error: standard output: No space left on device\n"


@pytest.mark.slow
def test_completion_offers_commands_scenarios_and_fields():
    code = """
import contextlib, os, sys
from diffabs.cli.main import main
for words in ("diffabs id", "diffabs simulate slip-", "diffabs simulate slip-lmi --set plant.ma",
              "diffabs simulate --set plant.ma", "diffabs list ro"):
    os.environ |= {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    sys.argv = ["diffabs"]
    with contextlib.suppress(SystemExit):
        main()
    print("END", flush=True)
"""
    env = os.environ | {"_DIFFABS_COMPLETE": "complete_bash"}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    command, scenario, field, none, family = (said.split() for said in done.stdout.split("END")[:5])
    assert command == ["identify"]
    assert field == ["plant.mass="]
    assert none == []
    assert family == ["roads"]
    assert set(scenario) == {"slip-cured", "slip-estimator", "slip-lmi", "slip-real"}


def test_the_extra_all_is_all_of_them():
    root = ROOT
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (named,) = extras.pop("all")
    assert set(re.fullmatch(r"diffabs-control\[(.*)\]", named)[1].split(",")) == set(extras)


def test_version_and_usage():
    assert run("--version").stdout == f"diffabs {diffabs.__version__}\n"
    assert run("simulate", "--nonsense", status=2).stdout == ""
    assert run("simulate", status=2).stdout == ""
    assert run("simulat", status=2).stdout == ""


@pytest.mark.slow
def test_as_a_module_with_double_precision():
    done = subprocess.run(
        [sys.executable, "-m", "diffabs", "simulate", "slip-lmi", *SHORT, "--json"],
        capture_output=True,
        text=True,
        env={k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"},
        check=True,
    )
    value = json.loads(done.stdout)["metrics"]["iae"]
    assert math.isfinite(value)
    assert value != float(np.float32(value))


@pytest.mark.slow
def test_help_imports_no_matplotlib():
    code = "import sys, diffabs.cli.main; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
def test_control_c_ends_a_long_run_with_one_line(tmp_path):
    endless = ["controller={type='constant-torque',torque=0.0}", "solver.step=1e-5", "solver.duration=1000"]
    command = [sys.executable, "-m", "diffabs", "simulate", "slip-lmi", "--csv", str(tmp_path / "a.csv")]
    command += [word for change in endless for word in ("--set", change)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr
        for line in process.stderr:
            if line.startswith("simulating"):
                break
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=300)
    assert process.returncode == 130
    *before, last = err.splitlines()
    assert (out, last) == ("", "interrupted")
    assert all(line.startswith("simulating") for line in before)  # how far it was, where the machine is slow
    assert left_in(tmp_path) == set()


@pytest.mark.slow
@killed_by("output.export.c99", '.rstrip("_")', "")
def test_a_file_name_without_an_ascii_letter_gives_a_name_that_is_allowed(tmp_path):
    run("export", "slip-cured", "--to", "st", "-o", tmp_path / "\xe4.st")
    assert "FUNCTION_BLOCK controller\n" in (tmp_path / "\xe4.st").read_text()


@pytest.mark.slow
@killed_by("scenario.simulation", 'AT_LIMIT = "at a limit\\n"', 'AT_LIMIT = "at a limit"')
def test_an_objective_may_have_the_name_of_the_share_at_a_limit():
    limits = ("--set", "controller.low=0", "--set", "controller.high=0.1")  # far below the demand
    found = json.loads(
        run("simulate", "slip-lmi", *SHORT, *limits, "--set", "objective.at a limit=iae", "--json").stdout
    )
    assert found["at_limit"] == pytest.approx(1.0)
    assert found["metrics"]["at a limit"] == found["metrics"]["iae"] != 1.0
