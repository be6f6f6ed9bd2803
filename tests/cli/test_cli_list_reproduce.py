"""`diffabs list` and `diffabs reproduce`: what they show, and that no folder is half written or lost."""

import importlib
import json
import os
import pathlib
import re
import sys
import types

import pytest
from commands import assert_one_error_line, left_in, run, umask
from mutants import killed_by
from seams import replace_seam

import diffabs as d
from diffabs.compiler.runtime import toolchain
from diffabs.papers.digest import Digest
from diffabs.parts.objectives import BRAKING
from diffabs.scenario import catalogue, registry

# list


def test_list_knows_every_part():
    document = json.loads(run("list", "--json").stdout)
    assert set(document) == {*catalogue.PLURALS, "scenarios", "format"}
    for plural, family in catalogue.PLURALS.items():
        assert set(document[plural]) == set(registry.family_types(family))
    mass = document["plants"]["quarter-car"]["parameters"]["mass"]
    ends = {"range": "(0, inf) kg", "low": 0.0, "high": None}
    assert mass == {"meaning": "Mass m of the vehicle on the wheel.", "default": 15.0, "unit": "kg", **ends}
    assert document["plants"]["quarter-car"]["parameters"]["road"]["default"] == "spline-b"
    assert document["roads"]["patches"]["parameters"]["roads"]["default"] == ["dry-asphalt", "snow"]
    assert document["roads"]["snow"]["parameters"]["c1"]["default"] == 0.1946
    assert document["controllers"]["state-feedback"]["parameters"]["high"]["default"] is None
    assert document["actuators"]["delay"]["parameters"]["capacity"]["default"] == 1024
    assert document["objectives"]["variation"]["unit"] == "N m"
    assert document["scenarios"]["slip-lmi"]["title"]
    assert all(member["summary"] for family in catalogue.PLURALS for member in document[family].values())


def test_list_table_shows_units_and_ranges():
    text = run("list", "plants").stdout
    row = next(line for line in text.splitlines() if " mass " in line and " 5.3 " in line)
    *numbers, text_of_mass = (cell.strip() for cell in row.split("│")[2:-1])
    assert numbers == ["mass", "5.3", "kg", "(0, inf)"]
    assert text_of_mass.startswith("Mass m of the vehicle")  # the terminal may wrap it
    assert "[0, 1]" in text
    assert "snow" not in text
    assert "[dry-asphalt, snow]" in run("list", "roads").stdout


def test_list_shows_the_channels_of_a_plant():
    plants = json.loads(run("list", "plants", "--json").stdout)["plants"]
    channels = {"controls": {"pump_1": "V", "pump_2": "V"}, "targets": {"level_1": "m", "level_2": "m"}}
    assert plants["quadruple-tank"]["channels"] == channels
    assert "channels" not in plants["quarter-car"]
    assert re.search(r"controls *│ pump_1, pump_2 *│ V, V", run("list", "plants").stdout)


def test_list_of_an_unknown_family():
    result = run("list", "plant", status=2)
    assert_one_error_line(result)
    assert "did you mean plants?" in result.stderr


# reproduce


@pytest.fixture
def papers(monkeypatch):
    def good(folder: pathlib.Path, progress) -> dict:
        progress("drawing")
        (folder / "figure1.png").write_text("picture")
        (folder / "summary.json").write_text("{}")
        row = {
            "name": "proposed PI",
            "quantity": "T",
            "unit": "s",
            "ours": 2.9915,
            "published": 2.99,
            "difference": 0.0015,
        }
        more = {"name": "J", "unit": "kg m^2", "ours": 1.04, "published": None, "reference": 1.05}
        return {"title": "A paper", "rows": [row, more], "figures": ["figure1.png"], "notes": ["unknown road"]}

    def compact(summary: dict) -> Digest:
        agreement, verdicts = ["1 of 1 published numbers reproduced."], [("refuted", "a claim: 5")]
        return Digest(summary["title"], ("", "ours"), [("proposed PI", "2.99")], agreement, verdicts, 1)

    def interrupted(folder: pathlib.Path, progress) -> dict:
        good(folder, progress)
        raise KeyboardInterrupt

    importlib.import_module("diffabs.output.report")  # before its papers are replaced
    found = {"slip-lmi": good, "slip-estimator": good}
    replace_seam(
        monkeypatch,
        "write_report_file",
        lambda sources, target, title="": target.write_text(f"report of {len(sources)}"),
    )
    monkeypatch.setitem(
        sys.modules, "diffabs.papers", types.SimpleNamespace(PAPERS=found, REPRODUCTIONS=found, compact=compact)
    )
    return found, interrupted


@killed_by("cli.reproduce", 'if name == "all" else None', "if False else None")
def test_reproduce_everything(papers, tmp_path):
    result = run("reproduce", "--out", tmp_path / "new" / "out")
    out = tmp_path / "new" / "out"
    assert left_in(out) == {"slip-lmi", "slip-estimator", "report.html"}
    assert left_in(out / "slip-lmi") == {"figure1.png", "summary.json", "report.html"}
    assert (out / "report.html").read_text() == "report of 2"
    assert f"report of all papers: {out / 'report.html'}\n" in result.stderr
    lines = [line.split() for line in result.stdout.splitlines()]
    assert lines.count(["proposed", "PI", "2.99"]) == 2
    assert lines.count(["1", "of", "1", "published", "numbers", "reproduced."]) == 2
    assert lines.count(["refuted", "a", "claim:", "5"]) == 2
    assert result.stderr.count("drawing\n") == 2
    assert f"1 figures, summary.json and report.html: {out / 'slip-lmi'}\n" in result.stderr
    assert os.stat(out / "slip-lmi").st_mode & 0o777 == 0o777 & ~umask()


@killed_by("cli.reproduce", "            report.check_target(whole)\n", "            pass\n")
def test_a_foreign_report_is_found_before_any_paper(papers, tmp_path):
    (tmp_path / "report.html").write_text("a diary")
    assert_one_error_line(run("reproduce", "--out", tmp_path, status=2))
    assert left_in(tmp_path) == {"report.html"}


@killed_by("cli.console", "except (ScenarioError, EngineError) as error:", "except ScenarioError as error:")
def test_an_engine_that_cannot_make_the_runs_is_one_line(papers, tmp_path, monkeypatch):
    def needs_a_kernel(folder: pathlib.Path, progress) -> dict:
        lanes, solver = d.Batch({"plant.mass": [15.0]}), d.FixedStep(1e-3, 0.01)
        return {"rows": d.run_batch(d.braking(), lanes, solver, BRAKING, accepted=True).metrics}

    papers[0]["slip-lmi"] = needs_a_kernel
    monkeypatch.setenv("DIFFABS_ENGINE", "kernel")
    monkeypatch.setenv(toolchain.COMPILER, "")
    result = run("reproduce", "slip-lmi", "--out", tmp_path, status=2)
    assert "error: engine = 'kernel' is not possible: " in result.stderr
    assert left_in(tmp_path) == set()


def test_on_a_terminal_the_spinner_says_which_step(papers, tmp_path, monkeypatch):
    """And for how long: the arm's takes two minutes. No line is printed through the spinner."""
    shown = []

    def waited(work, message, detail):
        result = work()
        shown.append(f"{message} ... {detail()}")
        return result

    replace_seam(monkeypatch, "is_animated", lambda: True)
    replace_seam(monkeypatch, "run_with_progress", waited)
    result = run("reproduce", "slip-lmi", "--out", tmp_path)
    assert shown == ["reproducing slip-lmi ... drawing"]
    assert "drawing" not in result.stderr


def test_reproduce_as_json_replaces_an_older_result(papers, tmp_path):
    old = tmp_path / "slip-lmi"
    old.mkdir()
    (old / "summary.json").write_text("old")
    (old / "stale.png").write_text("old")
    document = json.loads(run("reproduce", "slip-lmi", "--out", tmp_path, "--json").stdout)
    assert set(document["papers"]) == {"slip-lmi"}
    assert document["papers"]["slip-lmi"]["rows"][0]["ours"] == 2.9915
    assert left_in(old) == {"figure1.png", "summary.json", "report.html"}
    assert left_in(tmp_path) == {"slip-lmi"}


def test_reproduce_keeps_the_old_result_when_interrupted(papers, tmp_path):
    run("reproduce", "slip-lmi", "--out", tmp_path)
    papers[0]["slip-lmi"] = papers[1]
    (tmp_path / "slip-lmi" / "summary.json").write_text("old")
    result = run("reproduce", "slip-lmi", "--out", tmp_path, status=130)
    assert result.stderr.splitlines()[-1] == "interrupted"
    assert (tmp_path / "slip-lmi" / "summary.json").read_text() == "old"
    run("reproduce", "slip-lmi", "--out", tmp_path / "new", status=130)
    assert left_in(tmp_path) == {"slip-lmi"}


def test_a_failed_rename_restores_the_old_result(papers, tmp_path, monkeypatch):
    run("reproduce", "slip-lmi", "--out", tmp_path)
    (tmp_path / "slip-lmi" / "summary.json").write_text("old")
    rename = pathlib.Path.rename

    def failing(self: pathlib.Path, target: pathlib.Path):
        if self.name == "new":
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(pathlib.Path, "rename", failing)
    monkeypatch.setattr(sys, "platform", "other")  # without an exchange of two folders in one step
    assert "Input/output error" in run("reproduce", "slip-lmi", "--out", tmp_path, status=1).stderr
    assert (tmp_path / "slip-lmi" / "summary.json").read_text() == "old"
    assert left_in(tmp_path) == {"slip-lmi"}


def test_reproduce_leaves_other_peoples_folders_alone(papers, tmp_path):
    (tmp_path / "slip-lmi").mkdir()
    (tmp_path / "slip-lmi" / "thesis.tex").write_text("years of work")
    assert_one_error_line(run("reproduce", "slip-lmi", "--out", tmp_path, status=2))
    assert left_in(tmp_path / "slip-lmi") == {"thesis.tex"}
    assert_one_error_line(run("reproduce", "slip-lmi", "--out", tmp_path / "slip-lmi" / "thesis.tex", status=2))


@killed_by("cli.targets", 'not entries & {"manifest.json", "chunks"}', "True")
@pytest.mark.parametrize("sweeps", ["manifest.json", "chunks"])
def test_reproduce_leaves_a_sweep_alone(papers, tmp_path, sweeps):
    (tmp_path / "slip-lmi" / sweeps).mkdir(parents=True)
    (tmp_path / "slip-lmi" / "summary.json").write_text("of a sweep")
    assert_one_error_line(run("reproduce", "slip-lmi", "--out", tmp_path, status=2))
    assert left_in(tmp_path / "slip-lmi") == {sweeps, "summary.json"}


def test_reproduce_an_unknown_paper(papers, tmp_path):
    result = run("reproduce", "slip-lim", "--out", tmp_path / "out", status=2)
    assert_one_error_line(result)
    assert "did you mean slip-lmi?" in result.stderr
    assert left_in(tmp_path) == set()
