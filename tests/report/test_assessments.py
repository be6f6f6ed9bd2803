"""The page that compares assessments of cars: every clause of every car, with its figure, limit, verdict and stop."""

import json

import numpy as np
import pytest
from commands import run
from reports import Page

pytest.importorskip("jinja2")

from mutants import killed_by

from diffabs.assess import Assessment, Clause, StopProgram
from diffabs.host.documents import format_document
from diffabs.host.values import plain_fields
from diffabs.output.report import ReportError, build_report, find_documents
from diffabs.scenario import load
from diffabs.scenario.model import result_document

FIGURES = {"good": (0.9123, 0.0), "bad": (0.4321, np.inf)}
LIMITS = {"good": 0.1, "bad": 0.05}


def clauses_of(name):
    used, locked = FIGURES[name]
    yield Clause("5.2.1", "adhesion", used, 0.75, "1", True, "low, 55 km/h", True, np.array([used > 0.75]), 0, "again")
    met = np.array([locked <= LIMITS[name]])
    yield Clause("5.3.1", "time locked", locked, LIMITS[name], "s", False, "high, 40 km/h", True, met, 0)
    yield Clause("", "own figure", 3.25, 2.0, "m", False, "high | low", False, np.array([False]), 0)


@pytest.fixture
def folder(tmp_path):
    """A folder with the documents of two cars."""
    for name in FIGURES:
        assessment = Assessment(tuple(clauses_of(name)), 1, 20, int(name == "good"), 0)
        values = {"program": plain_fields(StopProgram(brief=LIMITS[name])), **assessment.record()}
        document = result_document("assess", load("half-car", [f"title={name} car"]), values)
        (tmp_path / f"{name}.json").write_text(format_document(document))
    return tmp_path


@killed_by("output.report.assessments", 'row["verdict"] == "met"', 'row["verdict"] != "not met" or True')
@killed_by("output.report.assessments", "'at least' if row", "'at most' if row")
def test_several_cars_are_compared_clause_by_clause(folder):
    page = Page(build_report(find_documents(folder)))
    assert page.headings.index("2 cars on the same clauses") < page.headings.index("Clauses of bad car")
    assert "1 of 2 meet all: good car." in page.text
    assert {"0.9123", "0.4321", "3.25"} <= set(page.numbers)
    for cells in (
        "good car met met not met",  # the verdicts, those of own rules last
        "bad car not met not met not met",
        "bad car 0.4321 at least 0.75 not met low, 55 km/h",
        "bad car not finite at most 0.05 s not met high, 40 km/h",
        "good car 0 at most 0.1 s met high, 40 km/h",
        "good car: 5.2.1 adhesion: again",
        "own rule own figure",
    ):
        assert cells in page.text, cells
    assert "The programs of the stops differ" in page.text
    assert page.foreign == []


def test_the_page_of_one_car_compares_nothing(folder):
    text = Page(build_report(find_documents(folder / "good.json"))).text
    assert "met 5.2.1 adhesion: 0.912, at least 0.75; worst stop: low, 55 km/h" in text
    assert "meet all" not in text
    assert "1 car, 20 stops each; 0 runs diverged" in text


def test_the_command_takes_several_files(folder):
    files = [folder / f"{name}.json" for name in FIGURES]
    assert "--out FILE.html is needed for several sources" in run("report", *files, status=2).stderr
    run("report", *files, "--out", folder / "both.html")
    assert "1 of 2 meet all" in Page((folder / "both.html").read_text()).text
    nowhere = run("report", *files, "--out", folder / "no" / "x.html", status=2)
    assert f"x.html: there is no folder {folder / 'no'}" in nowhere.stderr
    missing = run("report", files[0], folder / "none.json", "--out", folder / "x.html", status=2)
    assert "none.json: there is no such folder or file" in missing.stderr
    assert not (folder / "x.html").exists()
    content = json.loads(files[1].read_text())
    del content["clauses"][0]["stop"]
    files[1].write_text(json.dumps(content))
    broken = run("report", *files, "--out", folder / "x.html", status=2)
    assert "bad.json: cannot be read as a document of assess: KeyError 'stop'" in broken.stderr


def test_a_comparison_that_cannot_be_made_names_the_files(folder):
    content = json.loads((folder / "good.json").read_text())
    content["model"]["title"] = 7
    (folder / "good.json").write_text(json.dumps(content))
    with pytest.raises(ReportError, match=r"bad\.json, .*good\.json: cannot be read as a document of assess: a value"):
        build_report(find_documents(folder))


def test_an_assessment_without_clauses_meets_none(folder):
    content = json.loads((folder / "bad.json").read_text())
    content["clauses"] = []
    (folder / "bad.json").write_text(json.dumps(content))
    assert "1 of 2 meet all: good car." in Page(build_report(find_documents(folder))).text
