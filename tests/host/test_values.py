"""Values that somebody wrote become dataclasses, or one line; parts become values; files are whole."""

import dataclasses
import importlib
import os
import subprocess
from typing import Any

import numpy as np
import pytest
from marks import readable_id
from mutants import killed_by
from project import ROOT

from diffabs.core.pytree import ParameterSpec
from diffabs.host import files, provenance, values
from diffabs.host.exports import lazy_getattr
from diffabs.host.values import (
    ScenarioError,
    as_plain,
    choice_reader,
    range_reader,
    read_number_in_range,
    table_field,
    table_reader,
    whole_reader,
)
from diffabs.parts.roads import Burckhardt
from diffabs.scenario.scenario import dump, load, loads
from diffabs.uncertainty.sweep.distributions import Normal, Uniform
from diffabs.uncertainty.sweep.sampling import Sobol


@dataclasses.dataclass(frozen=True)
class Cup:
    volume: float = table_field(range_reader(ParameterSpec("l", low=0.0, open_low=True)))
    handles: int = table_field(whole_reader(0, 2), 1)
    glaze: str = table_field(choice_reader("matt", "shiny"), "matt")
    marks: Any = table_field(table_reader(values.read_text, "texts"), dict)


def test_a_table_becomes_a_dataclass():
    given = {"volume": 1, "glaze": "shiny", "marks": {"maker": "x"}}
    assert values.read_table(Cup, given, "cup") == Cup(1.0, 1, "shiny", {"maker": "x"})
    assert values.read_one({"cup": Cup}, {"type": "cup", **given}, "x") == Cup(1.0, 1, "shiny", {"maker": "x"})


@killed_by(
    "host.values",
    '            raise unknown_name_error(f"{dotted_path(path, key)} is not a field',
    '            continue\n            raise unknown_name_error(f"{dotted_path(path, key)} is not a field',
)
@pytest.mark.parametrize(
    ("given", "line"),
    [
        (3, "cup = 3 is a number; a table of volume, handles, glaze, marks is needed"),
        ({}, "cup.volume is missing: cup needs it"),
        ({"volume": 0}, "cup.volume = 0 is outside (0, inf) l"),
        ({"volume": "full"}, 'cup.volume = "full" is text; a number in (0, inf) l is needed'),
        ({"volume": None}, "cup.volume = None is nothing; a number in (0, inf) l is needed"),
        ({"volume": np.arange(2)}, "cup.volume = array([0, 1]) is of type ndarray; a number in (0, inf) l is needed"),
        ({"volume": 1, "handles": 3}, "cup.handles = 3 is outside [0, 2]"),
        (
            {"volume": 1, "handle": 1},
            "cup.handle is not a field of cup; did you mean handles? There is volume",
        ),
        ({"volume": 1, "glaze": "shinny"}, 'cup.glaze = "shinny" is unknown; did you mean shiny? There is matt, shiny'),
        ({"volume": 1, "glaze": 1}, "cup.glaze = 1 is a number; one of matt, shiny is needed"),
        ({"volume": 1, "marks": {"a\nb": 1}}, r'cup.marks."a\nb" = 1 is a number; text is needed'),
        ({"volume": 1, "marks": []}, "cup.marks = [] is a list; a table of texts is needed"),
    ],
    ids=readable_id,
)
def test_what_is_wrong_is_one_line(given, line):
    with pytest.raises(ScenarioError) as caught:
        values.read_table(Cup, given, "cup")
    assert str(caught.value).startswith(line)
    assert "\n" not in str(caught.value)


def test_a_type_that_is_not_there():
    with pytest.raises(ScenarioError, match=r"x\.type is missing; there is cup"):
        values.read_one({"cup": Cup}, {}, "x")
    with pytest.raises(ScenarioError, match=r'x\.type = "cap" is unknown; did you mean cup'):
        values.read_one({"cup": Cup}, "cap", "x")


PATHS = ["plant.mass", "controller.period", "controller.delay", "controller.controller.gain", "initial.speed"]


@killed_by("host.values", "if len(words) > 1 and all(", "if False and all(")
@killed_by("host.values", "if len(words) == 1 or is_similar(path)", "if True")
@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("controller.gain", "controller.controller.gain"),  # of a part inside
        ("plant.mas", "plant.mass"),
        ("plnt.mass", "plant.mass"),
        ("controller.delai", "controller.delay"),
        ("controller.kp", None),  # like controller.delay in its first word only
        ("controller.time_constant", None),
    ],
)
def test_the_name_that_is_meant(name, meant):
    line = str(values.unknown_name_error("x", name, PATHS))
    assert line.startswith("x; there is plant.mass" if meant is None else f"x; did you mean {meant}? There is ")


def test_nan_is_in_no_range():
    with pytest.raises(ScenarioError, match=r"x = nan is outside \[0, 1\]"):
        read_number_in_range(float("nan"), ParameterSpec("1", 0.0, 1.0), "x")


@killed_by(
    "host.values",
    "return value if type(value) in PLAIN_TYPES else",
    "return value if isinstance(value, PLAIN_TYPES) else",
)
def test_parts_are_written_whole_and_the_rest_in_short():
    assert as_plain(Burckhardt(c1=np.float32(0.5), c2=30, c3=0.25)) == {
        "type": "burckhardt", **{"c1": 0.5, "c2": 30.0, "c3": 0.25, "c4": Burckhardt().c4}
    }  # fmt: skip
    assert as_plain({"m": (Normal(1.0, 2.0, low=0.0), np.float64(3.0))}, brief=True) == {
        "m": [{"type": "normal", "mean": 1.0, "deviation": 2.0, "low": 0.0}, 3.0]
    }
    assert type(as_plain(np.float64(3.0))) is float  # the text of a NumPy number is no TOML


W4 = "{type='normal', mean=0.4, deviation=0.01, low=0.3, high=0.5}"
DRAWN = f"sweep.over={{'initial.speed_kmh'={{low=36,high=72}}, 'road.w4'={W4}, 'plant.mass'={{low=5,high=6}}}}"


@killed_by(
    "scenario.section_sweep", "distributions.convert_distribution_to_si(distribution, item.scale)", "distribution"
)
@killed_by("scenario.section_sweep", "return {item.path: item.value for", "return {item.where: item.value for")
def test_a_sweep_is_read_once_into_si_by_path_of_the_loop():
    chosen = load("slip-lmi", [DRAWN, "sweep.design=sobol", "sweep.correlation={paths=['road.w4'], matrix=[[1]]}"])
    assert list(chosen.sweep.over.items()) == [
        ("initial.speed", Uniform(10.0, 20.0)),
        ("plant.road.w4", Normal(0.4, 0.01, 0.3, 0.5)),
        ("plant.mass", Uniform(5.0, 6.0)),
    ]
    assert chosen.sweep.design == Sobol()
    assert chosen.sweep.correlation.paths == ("plant.road.w4",)
    again = loads(dump(chosen).encode(), "again", "again").sweep
    assert list(again.over.items()) == list(chosen.sweep.over.items())  # their order is that of a design's columns
    assert again.table() == chosen.sweep.table()


def test_an_impossible_distribution_is_refused_on_reading():
    with pytest.raises(ScenarioError, match=r"sweep.over.initial.speed_kmh = uniform\(36, 900\) reaches \[36, 900\]"):
        load("slip-lmi", ["sweep.over.initial.speed_kmh=36:900"])


@killed_by("host.exports", ", *homes()})", "})")
@killed_by("host.exports", 'if name == "__all__"', "if not name")
def test_packages_export_what_they_say_and_no_more(tmp_path, monkeypatch):
    export = lazy_getattr("diffabs.parts.roads")
    assert export("Burckhardt") is Burckhardt
    with pytest.raises(AttributeError, match="has no attribute 'Burkhardt'"):
        export("Burkhardt")
    text = "import diffabs.host.exports as e\nif not e:\n    from math import tau as tau\n"
    (tmp_path / "exporting.py").write_text(f"{text}__getattr__ = e.lazy_getattr(__name__)\n")
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("exporting")
    assert ("tau" in dir(module), "tau" in vars(module), module.__all__) == (True, False, ["tau"])


@killed_by(
    "host.files",
    "        yield temporary\n        if temporary.exists():\n            temporary.replace(target)",
    "        try:\n            yield temporary\n        finally:\n            temporary.replace(target)",
)
def test_a_file_is_the_old_one_or_the_whole_new_one(tmp_path):
    path = tmp_path / "a.txt"
    mask = os.umask(0o027)
    try:
        files.write_file(path, b"old")
    finally:
        os.umask(mask)
    assert path.stat().st_mode & 0o777 == 0o640
    with pytest.raises(KeyError), files.new_file(path) as half:  # noqa: PT012
        assert half.suffix == ".txt"
        half.write_text("ne")
        raise KeyError
    with files.new_file(path) as unwanted:
        unwanted.unlink()
    assert path.read_text() == "old"
    assert files.write_durably(path, b"new").read_bytes() == b"new"
    assert [each.name for each in tmp_path.iterdir()] == ["a.txt"]


@killed_by(
    "host.files",
    "        new.mkdir()\n        yield new\n",
    "        new.mkdir()\n        with contextlib.suppress(KeyError):\n            yield new\n",
)
def test_a_folder_is_the_old_one_or_the_whole_new_one(tmp_path):
    path = tmp_path / "deep" / "f"
    for content in ("old", "new"):
        with files.new_folder(path) as new:
            (new / content).touch()
    with pytest.raises(KeyError), files.new_folder(path) as new:  # noqa: PT012
        (new / "half").touch()
        raise KeyError
    assert [each.name for each in path.iterdir()] == ["new"]
    assert [each.name for each in path.parent.iterdir()] == ["f"]


def test_a_working_copy_knows_its_commit():
    root = ROOT
    if not (root / ".git").exists():
        pytest.skip("not a working copy")
    command = ["git", "-C", str(root), "rev-parse", "--short=12", "HEAD"]
    head = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    assert provenance.source_commit()["commit"].removesuffix("-dirty") == head
