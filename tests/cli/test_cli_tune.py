"""`diffabs tune`: what scripts read, what is written, and how it fails."""

import dataclasses
import json
import math
import pathlib
import re
import sys
import threading
import time
import types
import warnings

import jax
import numpy as np
import pytest
from commands import assert_one_error_line, left_in, run, umask
from invented import HISTORY
from invented import tuned as invention
from marks import cases
from mutants import killed_by
from seams import replace_seam
from small_scenarios import TUNE as SMALL

import diffabs.tune as library
from diffabs.cli import console, progress
from diffabs.cli import tune as commands_tune
from diffabs.core.pytree import parameters, replace
from diffabs.loop.run import measure
from diffabs.robust.design.sdp import solver
from diffabs.scenario import proving, tuning
from diffabs.scenario.proving import Proved
from diffabs.scenario.scenario import load
from diffabs.tune import DerivativeMode, Reason, StartError, Tuned

KEYS = [
    *("format", "scenario", "model", "made", "lanes", "free", "objective", "metrics", "constraints", "met", "reason"),
    "gradient_norm",
    *("evaluations", "mode", "engine", "history", "starts", "parameters", "certificate", "versions", "files"),
    "interrupted",
]


class Figure:
    """Stands for a figure: what it writes shows what was drawn."""

    def __init__(self, text: str):
        self.text = text

    def savefig(self, path: pathlib.Path):
        pathlib.Path(path).write_text(self.text)


def drawn(history, runs, *, title, lane, unit, bounds, boxes):
    return Figure(f"{title}: {len(history)} points, {', '.join(runs)}, {lane} [{unit}]")


pytestmark = pytest.mark.usefixtures("any_step_is_stable")  # it has tests of its own


@pytest.fixture(autouse=True, scope="module")
def quick():
    """No seconds for figures, which have tests of their own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("diffabs.output.plot.tuning.draw_tuning", drawn)
        yield


@pytest.mark.filterwarnings("default")
def test_a_warning_of_the_library_is_a_line(capsys):
    console.run_with_progress(lambda: warnings.warn("of two\nlines", stacklevel=1), "warning")
    assert capsys.readouterr().err == "warning: of two lines\n"


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_start_with_a_one_sided_derivative_is_said_in_a_line(file):
    """A relay that starts on its target: the run jumps there. It has no step, and so no overshoot."""
    relay = 'controller={type="relay",high=9.0}'
    changes = ("initial.slip=0.15", "reference.slip=0.15", relay, "tune.free={reference.slip=[0.1,0.2]}")
    words = [word for change in changes for word in ("--set", change)]
    found = run("tune", file(SMALL), *words, "--set", "tune.limits={max_slip=9.0}")
    (line,) = [line for line in found.stderr.splitlines() if "one side" in line]
    assert line.startswith(
        "warning: start: the relay starts on its target, where its first state jumps (in 2 of 2 runs)"
    )
    assert "the derivative by reference.slip is" in line
    assert ".py" not in found.stderr


@pytest.fixture
def unproved(monkeypatch):
    """Proofs have tests of their own, and take seconds."""

    def none(chosen):
        raise ValueError("no proof was asked for")

    replace_seam(monkeypatch, "build_proof_task", none)


@pytest.fixture
def invented(monkeypatch, unproved):
    """A tuning that has found something, at once; returns what it was asked."""
    asked = {}

    def tune(problem, **how):
        asked.update(how, problem=problem)
        return invention(problem, **how)

    replace_seam(monkeypatch, "tune_tune", tune)
    return asked


def values(loop):
    return [(path, value) for path, _, value in parameters(loop)]


@pytest.fixture
def small(file):
    return file(SMALL, "small.toml")


# A whole one


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tuned")
    (folder / "small.toml").write_text(SMALL)
    with pytest.MonkeyPatch.context() as patch:
        replace_seam(patch, "build_proof_task", lambda chosen: pytest.fail("asked for a proof too early"))
        replace_seam(patch, "certify_result", lambda after: Proved({"decay_rate": None}, "no proof"))
        out = ("--out", folder / "out.toml", "--plot", folder / "a.png")
        result = run("tune", folder / "small.toml", "--json", *out)
    return folder, json.loads(result.stdout), result.stderr


@pytest.mark.slow
def test_json_has_what_scripts_rely_on(tuned):
    folder, document, said = tuned
    assert list(document) == KEYS
    assert document["scenario"] == "small"
    assert document["lanes"] == 2
    free = document["free"]["controller.gain"]
    assert (free["before"], free["low"], free["high"]) == ([-4000, -40], [-1e4, -60], [-100, -20])
    assert all(low < after < high for low, after, high in zip(free["low"], free["after"], free["high"], strict=True))
    assert free["after"] != free["before"]
    assert document["objective"]["after"] < 0.95 * document["objective"]["before"]
    assert document["met"] is True
    assert document["mode"] == "forward"
    assert document["reason"] == Reason.LIMIT.value
    ends = [document["history"][i]["objective"] for i in (0, -1)]  # with a gradient, another program of the same steps
    assert ends == pytest.approx([document["objective"]["before"], document["objective"]["after"]], rel=1e-12)
    assert document["history"][-1]["iteration"] == 2
    assert document["evaluations"] == document["history"][-1]["evaluations"] >= 3
    assert document["gradient_norm"] == document["history"][-1]["gradient"]
    assert len(document["starts"]) == 1
    assert document["constraints"][0]["name"] == "overshoot"
    assert {"diffabs", "jax", "python", "optax", "scipy"} == set(document["versions"])
    assert document["files"] == {"out": str(folder / "out.toml"), "plot": str(folder / "a.png")}
    assert said == "no proof\n"


@pytest.mark.slow
@killed_by("cli.tune", 'after = work.scenario.with_loop(tuned.loop, "tuned")', "after = work.scenario")
def test_the_tuned_scenario_simulates_to_the_reported_numbers(tuned):
    folder, document, _ = tuned
    before, after = load(folder / "small.toml"), load(folder / "out.toml")
    for when, chosen in (("before", before), ("after", after)):
        lanes = [replace(chosen.loop, {"plant.mass": mass}) for mass in (5.3, 6.2)]
        solver = dataclasses.replace(chosen.solver, kinks=True)  # as of runs that are differentiated
        each = [jax.device_get(measure(loop, solver, chosen.objectives).metrics) for loop in lanes]
        for name in chosen.objectives:
            found = [float(metrics[name]) for metrics in each]
            # JSON has no infinity
            said = {how: document["metrics"][when][how][name] for how in ("mean", "worst")}
            said = {how: np.inf if value is None else value for how, value in said.items()}
            np.testing.assert_allclose(said["mean"], np.mean(found), rtol=1e-7, atol=1e-12)
            np.testing.assert_allclose(said["worst"], max(found), rtol=1e-7, atol=1e-12)
    assert after.tune == before.tune
    loaded = {path: np.asarray(value, float) for path, value in values(after.loop)}
    assert set(document["parameters"]) == set(loaded)
    for path, value in document["parameters"].items():
        assert value is None or np.array_equal(value, loaded[path])
    assert document["constraints"][0]["after"] == document["metrics"]["after"]["worst"]["overshoot"]


@pytest.mark.slow
def test_figure_and_file_and_nothing_else_are_left(tuned):
    folder, document, _ = tuned
    assert left_in(folder) == {"small.toml", "out.toml", "a.png"}
    points = len(document["history"])
    assert (folder / "a.png").read_text() == f"small: {points} points, before, after, plant.mass = 5.3 [N m]"
    assert (folder / "out.toml").stat().st_mode & 0o777 == 0o666 & ~umask()


# What is asked


@pytest.mark.slow
def test_the_section_reaches_the_tuning(small, invented):
    changes = ("tune.aggregate=cvar", "tune.aggregate.level=0.75", "tune.seed=7", "tune.limits.iae=0.5")
    sets = [word for change in changes for word in ("--set", change)]
    document = json.loads(run("tune", small, "--json", "--starts", "4", *sets).stdout)
    problem = invented["problem"]
    (entry,) = problem.space.entries
    assert (entry.path, entry.ranges) == ("controller.gain", ((-1e4, -100.0), (-60.0, -20.0)))
    assert problem.weights == {"iae": 1.0}
    assert problem.batch.values["plant.mass"].tolist() == [5.3, 6.2]
    assert tuple(problem.batch.keys) == (3, 3)
    assert isinstance(problem.aggregate, library.CVaR)
    assert problem.aggregate.level == 0.75
    assert [(c.metric, c.bound) for c in problem.constraints] == [("overshoot", 0.5), ("iae", 0.5)]
    assert (invented["method"].starts, invented["method"].seed) == (4, 7)
    assert invented["method"].stopping.iterations == 2
    assert document["history"] == [point._asdict() for point in HISTORY]


@pytest.mark.slow
def test_a_latin_hypercube_of_lanes(small, invented):
    run("tune", small, "--set", "tune.samples=9", "--set", "tune.over.initial.speed_kmh=49,50")
    lanes = invented["problem"].batch.values
    assert {len(column) for column in lanes.values()} == {9}
    assert 5.3 <= lanes["plant.mass"].min() < 5.5 < 6.0 < lanes["plant.mass"].max() <= 6.2
    assert 49 / 3.6 <= lanes["initial.speed"].min() <= lanes["initial.speed"].max() <= 50 / 3.6


def test_without_lanes_it_is_the_scenario_itself(small, invented):
    assert json.loads(run("tune", small, "--json", "--set", "tune.over={}").stdout)["lanes"] == 1


def test_table_for_people(small, invented):
    result = run("tune", small)
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in result.stdout.splitlines() if "│" in line]
    found = {row[0]: row[1:] for row in rows}
    assert found["controller.gain"][:2] == ["[-4000, -40]", "[-4400, -44]"]
    assert found["iae"] == ["0.3", "0.2", "0.3", "0.2", "s"]
    assert found["overshoot"] == ["0.5", "0.3", "0.2", "yes"]
    assert found["it ended because"] == [Reason.CHANGE.value]
    assert "over 2 runs" in result.stdout
    assert result.stderr == "no certificate: no proof was asked for\n"


def test_how_far_it_is():
    told = [library.TuningProgress(0, 2, point) for point in HISTORY]
    assert commands_tune._format_progress([]) == progress.WorkProgress("compiling")
    line = "loss 0.75, gradient 0.01, violation 0, 2 evaluations, 2 under way"
    assert commands_tune._format_progress(told) == progress.WorkProgress(
        line, HISTORY[-1].iteration, None, at_most=True
    )
    assert commands_tune._format_progress(told, 30).total == 30


def test_progress_is_told_again_when_it_changes(monkeypatch, capsys):
    replace_seam(monkeypatch, "patience", 0.0)
    replace_seam(monkeypatch, "second_interrupt_s", 0.0)
    replace_seam(monkeypatch, "progress_quiet", math.inf)  # no seconds, which depend on the machine's load
    steps = iter(["one", "one", "two", "two"])
    told = threading.Event()

    def detail():
        return next(steps, None) or (told.set(), "two")[1]

    console.run_with_progress(lambda: told.wait(60.0), "working", detail)
    assert capsys.readouterr().err == "working ... one\nworking ... two\n"


# What is proved


def test_without_the_design_extra_there_is_no_certificate(small, invented, monkeypatch):
    monkeypatch.undo()
    with pytest.MonkeyPatch.context() as patch:
        replace_seam(patch, "tune_tune", lambda problem, **how: fake(problem))
        patch.setitem(sys.modules, "cvxpy", None)
        solver.solvers.cache_clear()
        result = run("tune", small, "--json")
    document = json.loads(result.stdout)
    assert document["certificate"]["quadratically_stable"] is None
    assert 'pip install ".[design]" in a clone' in document["certificate"]["reason"]
    assert result.stderr == f"no certificate: {document['certificate']['reason']}\n"


def fake(problem):
    metrics = {name: np.zeros(problem.batch.size) for name in problem.measured}
    return Tuned(
        *(
            problem.subject,
            {},
            (1.0, 1.0),
            (0.0, 0.0),
            (metrics, metrics),
            True,
            Reason.GRADIENT,
            HISTORY,
            [],
            DerivativeMode.FORWARD,
        ),
        *((0, 0), {"name": "xla"}),
    )


@pytest.mark.slow
def test_a_loop_that_is_not_linear_has_no_certificate(small, monkeypatch):
    replace_seam(monkeypatch, "tune_tune", lambda problem, **how: fake(problem))
    changes = ("controller=relay", "tune.free.reference.slip=0.1,0.3")
    result = run("tune", small, *(word for change in changes for word in ("--set", change)))
    assert result.stderr.splitlines() == [
        "note: controller=relay removes tune.free.controller.gain of the replaced part",
        "no certificate: controller relay is not linear: it cannot be brought to state feedback",
    ]


@pytest.mark.slow
def test_a_decay_that_is_asked_for_is_certified(tmp_path):
    """The packaged scenario, shortened: constraints of all three kinds, and a proof of the result."""
    changes = ("tune.iterations=2", "solver.duration=0.2", "stop.speed_kmh=15", "tune.limits={}", "solver.step=5e-4",
               "tune.over={}", "tune.decay=20")  # fmt: skip
    sets = [word for change in changes for word in ("--set", change)]
    document = json.loads(run("tune", "slip-cured", "--json", "--out", tmp_path / "c.toml", *sets).stdout)
    rows = {row["name"]: row for row in document["constraints"]}
    assert set(rows) == {"certified decay", "damping"}
    assert rows["certified decay"]["after"] == document["certificate"]["decay_rate"] >= 20
    assert rows["damping"]["after"] >= 0.7
    assert document["certificate"]["verified_exactly"] is True
    assert set(document["versions"]) == {"diffabs", "jax", "python", "optax", "scipy", "cvxpy", "clarabel"}
    after = json.loads(run("certify", tmp_path / "c.toml", "--json").stdout)
    assert after["decay_rate"] == pytest.approx(document["certificate"]["decay_rate"], rel=1e-6)
    assert after["over"] == document["certificate"]["over"]


@pytest.mark.parametrize("name", cases(["slip-cured", "slip-lmi", "slip-estimator"], "slip-lmi", "slip-estimator"))
def test_packaged_scenarios_can_be_tuned(name, invented):
    """The library is asked something that fits: it has checked the problem that it built."""
    run("tune", name, "--set", "tune.decay=0", "--set", "tune.damping=0", "--set", "tune.limits={}")
    assert invented["problem"].space.size > 0


# What could not be done


@killed_by("scenario.tuning", '"met": beyond <= 0', '"met": True')
def test_a_constraint_that_is_not_met_could_not_be_done(small, invented, tmp_path):
    (tmp_path / "old.toml").write_text("old")
    out = ("--out", tmp_path / "old.toml", "--plot", tmp_path / "a.png")
    result = run("tune", small, "--json", "--set", "tune.limits.overshoot=0.199", *out, status=1)
    document = json.loads(result.stdout)
    assert document["met"] is False
    (row,) = document["constraints"]
    assert row.pop("missed") == pytest.approx(0.001)
    assert row == {"name": "overshoot", "bound": 0.199, "before": 0.3, "after": 0.2, "met": False}
    assert document["files"] == {}
    assert result.stderr.splitlines()[-1] == (
        f"error: small: not met: overshoot by 0.001 (0.5 %); {Reason.CHANGE.value}"
    )
    assert left_in(tmp_path) == {"small.toml", "old.toml"}
    assert (tmp_path / "old.toml").read_text() == "old"


@killed_by("scenario.tuning", '"met": beyond <= 0', '"met": beyond <= 1e-3 * abs(bound)')
@pytest.mark.parametrize(("bound", "met"), [("0.2", True), ("0.19999999999999998", False), ("0.1999001", False)])
def test_met_is_met_without_a_tolerance(small, invented, bound, met):
    """0.2 was reached. The float below it is not met, and the table says by how much."""
    limit = ("--set", f"tune.limits.overshoot={bound}")
    status = 0 if met else 1
    document = json.loads(run("tune", small, "--json", *limit, status=status).stdout)
    assert document["met"] is met
    assert document["constraints"][0]["missed"] == (0.0 if met else 0.2 - float(bound))
    line = next(line for line in run("tune", small, *limit, status=status).stdout.splitlines() if "NO" in line or met)
    assert met or f"NO, by {0.2 - float(bound):.3g}" in line


def test_a_limit_on_what_is_no_number_is_not_met():
    judged = tuning._constraint_row("overshoot", 0.2, 0.3, math.nan, at_most=True)
    assert (judged["met"], judged["missed"]) == (False, None)
    judged = tuning._constraint_row("certified decay", 5.0, None, None, at_most=False)
    assert (judged["met"], judged["missed"]) == (False, None)


# No lanes, a fifth of a second: 2,000 steps less than the packaged one, for the same controller, model and polytope.
SHORT = (
    *("tune.over={}", "solver.duration=0.2", "stop.speed_kmh=15", "solver.step=5e-4"),
    *("tune.limits={}", "tune.decay=0", "tune.damping=0.75"),
)


@pytest.mark.slow
@pytest.mark.parametrize("changes", [("reference.time_constant=0.03",), SHORT], ids=["whole", "damping"])
def test_what_the_packaged_cure_says_is_met_is_met(tmp_path, changes):
    """With a tolerance of 0.1 % these ended at an overshoot of 0.00800476 (0.008 allowed) and at dampings of 0.699484
    (0.7 asked) and 0.749981 (0.75 asked). The poles are NumPy's, of the certificate's own closed loops."""
    sets = [word for change in changes for word in ("--set", change)]
    document = json.loads(run("tune", "slip-cured", "--json", "--out", tmp_path / "c.toml", *sets).stdout)
    assert document["met"] is True
    for row in document["constraints"]:
        assert row["after"] <= row["bound"] if row["name"] == "overshoot" else row["after"] >= row["bound"]
        assert row["missed"] == 0.0
    after = load(tmp_path / "c.toml")
    asked = proving.build_proof_task(after)
    z = np.linalg.eigvals(asked.polytope.closed_loop(asked.gain)).astype(complex)
    poles = np.log(z[np.abs(z) > 1e-9]) / asked.polytope.period  # the rest decays at once
    assert (-poles.real / np.abs(poles)).min() >= after.tune.damping


@killed_by("cli.tune", "    except tune.StartError as error:", "    except KeyError as error:")
def test_no_start_that_can_be_used_could_not_be_done(small, monkeypatch):
    def none(*_, **__):
        raise StartError(f"{Reason.START.value}: 2 of 2 lanes diverge there")

    replace_seam(monkeypatch, "tune_tune", none)
    result = run("tune", small, "--json", status=1)
    assert_one_error_line(result)
    assert "small: no start can be used: the start diverged" in result.stderr


def test_what_does_not_fit_is_bad_input(small, monkeypatch):
    def none(*_, **__):
        raise ValueError("something\ndoes not fit")

    replace_seam(monkeypatch, "tune_tune", none)
    assert_one_error_line(run("tune", small, status=2))


def test_interrupted_it_leaves_nothing_half_written(small, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    replace_seam(monkeypatch, "tune_tune", interrupted)
    result = run("tune", small, "--out", tmp_path / "out.toml", "--plot", tmp_path / "a.png", status=130)
    assert result.stderr == "interrupted\n"
    assert left_in(tmp_path) == {"small.toml"}


@pytest.fixture
def endless(invented, monkeypatch):
    """A tuning that goes on until it is asked to end, and a person who presses Ctrl-C once it has begun."""
    told = []

    def tune(loop, *, progress, stopping, **what):
        progress(library.TuningProgress(0, 1, HISTORY[0]))
        told.append(True)
        end = time.monotonic() + 60
        while not stopping() and time.monotonic() < end:
            time.sleep(0.01)
        return dataclasses.replace(found(loop, **what), reason=Reason.INTERRUPTED)

    found = library.tune
    replace_seam(monkeypatch, "tune_tune", tune)
    replace_seam(monkeypatch, "take_interrupt", lambda: bool(told) and bool(told.pop()))


def test_interrupted_it_shows_and_writes_the_best_so_far(small, endless, tmp_path):
    out, picture = tmp_path / "out.toml", tmp_path / "a.png"
    result = run("tune", small, "--json", "--out", out, "--plot", picture, status=130)
    document = json.loads(result.stdout)
    assert document["interrupted"] is True
    assert document["reason"] == Reason.INTERRUPTED.value
    assert document["free"]["controller.gain"]["after"] == pytest.approx([-4400, -44])
    assert document["files"] == {"out": str(out), "plot": str(picture)}
    assert np.allclose(load(out).loop.controller.gain, [-4400, -44])
    assert result.stderr.splitlines() == [
        "interrupted: finishing the evaluation in hand (Ctrl-C again: at once)",
        "no certificate: no proof was asked for",
        "interrupted: this is the best so far, not a minimum",
    ]


def test_interrupted_where_a_limit_is_not_met_it_writes_nothing(small, endless, tmp_path):
    result = run("tune", small, "--set", "tune.limits.overshoot=0.1", "--out", tmp_path / "out.toml", status=130)
    assert "it was interrupted" in result.stdout
    last = result.stderr.splitlines()[-1]
    assert re.search(r"not met: overshoot by \S+ \(\S+ %\), so that no file is written$", last)
    assert left_in(tmp_path) == {"small.toml"}


def test_interrupted_while_it_certifies_it_shows_what_was_found(small, invented, tmp_path, monkeypatch):
    def interrupted(_):
        raise KeyboardInterrupt

    replace_seam(monkeypatch, "certify_result", interrupted)
    document = json.loads(run("tune", small, "--json", "--out", tmp_path / "out.toml", status=130).stdout)
    assert (document["interrupted"], document["met"]) == (True, True)
    assert document["certificate"]["reason"] == "interrupted"
    assert (tmp_path / "out.toml").exists()


@killed_by("scenario.tuning", '"met": False, "missed": None}', '"met": False}')
def test_interrupted_while_it_certifies_what_is_asked_for(small, invented, tmp_path, monkeypatch):
    def interrupted(_):
        raise KeyboardInterrupt

    replace_seam(monkeypatch, "build_proof_task", lambda chosen: types.SimpleNamespace(polytope=None))
    replace_seam(monkeypatch, "certify_result", interrupted)
    result = run("tune", small, "--set", "tune.decay=9", "--out", tmp_path / "out.toml", status=130)
    assert re.search(r"certified decay │ 9 +│ +│ +│ NO, not known │", result.stdout)
    assert result.stderr.endswith("not met: certified decay not known, so that no file is written\n")
    assert left_in(tmp_path) == {"small.toml"}


def test_interrupted_while_it_draws_there_is_no_picture(small, invented, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    replace_seam(monkeypatch, "tune_draw", interrupted)
    files = ("--out", tmp_path / "out.toml", "--plot", tmp_path / "a.png")
    document = json.loads(run("tune", small, "--json", *files, status=130).stdout)
    assert document["files"] == {"out": str(tmp_path / "out.toml")}
    assert left_in(tmp_path) == {"small.toml", "out.toml"}


# Bad input


@pytest.mark.parametrize("module", ["optax", "scipy"])
def test_without_the_extra(small, monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    result = run("tune", small, status=2)
    assert_one_error_line(result)
    assert f'{module} needed: pip install ".[tune]" in a clone' in result.stderr
