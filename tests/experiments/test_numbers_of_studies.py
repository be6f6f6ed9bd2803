"""The numbers beside the pages of the studies are those that the studies print."""

import dataclasses
import importlib
import json

import pytest
from project import ROOT

from experiments._shared import numbers

STUDIES = ROOT / "experiments"
QUICK = ("lab_rig", "mean_intervals")  # take one to three minutes each; the others up to hours


def test_a_number_beyond_the_tolerance_is_named(tmp_path):
    results = {"rows": [{"law": "normal", "length": 1.25, "even": True, "last": None}], "versions": {"jax": "1"}}
    path = numbers.store_numbers(str(tmp_path / "run.py"), results)
    assert numbers.find_differences(path, results | {"versions": {"jax": "2"}}) == []
    rows = [{"law": "normal", "length": 1.25 * (1 + 1e-7), "even": True, "last": None}]
    assert numbers.find_differences(path, {"rows": rows}) == []
    rows[0] |= {"length": 1.2501, "even": False}
    lines = ["rows.0.length: 1.25 in the file, 1.2501 here", "rows.0.even: True in the file, False here"]
    assert numbers.find_differences(path, {"rows": rows}) == lines
    assert len(numbers.find_differences(path, {"rows": []})) == 1
    assert json.loads(path.read_text())["tolerance"] == numbers.TOLERANCE


@pytest.mark.parametrize("name", [folder.parent.name for folder in sorted(STUDIES.glob(f"*/{numbers.FILE}"))])
def test_numbers_have_tables_and_a_tolerance(name):
    stored = json.loads((STUDIES / name / numbers.FILE).read_text())
    assert stored["format"] == "diffabs numbers 1"
    assert 0 < stored["tolerance"] <= 0.01
    assert stored["tables"]


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_a_study_prints_the_numbers_of_its_file(name, tmp_path):
    pytest.importorskip("matplotlib")
    study = importlib.import_module(f"experiments.{name}.run")
    results = study.main(dataclasses.replace(study.Config(), out=str(tmp_path)))
    assert numbers.find_differences(STUDIES / name / numbers.FILE, results) == []
