"""A proof's file, and its verification by the checker; a file with one changed number is not verified."""

import copy
import json
import math
import os
import pathlib
import re
from collections.abc import Callable

import pytest
from commands import assert_one_error_line, run
from mutants import killed_by

from diffabs.core.types import JsonObject
from diffabs.robust.reach.certificate import FORMAT
from diffabs.robust.reach.verification import (
    CELL_HALVINGS,
    FileVerdict,
    _choose_sides,
    _map_cells,
    read_proof,
    verify_box,
)
from diffabs.scenario.scenario import loads

pytest.importorskip("flint")
pytestmark = pytest.mark.usefixtures("native_prover", "any_step_is_stable")
BOX = ["--over", "plant.mass=5.3:5.302", "--over", "initial.speed_kmh=10:10.004", "--claim", "no_lock"]
LIMITS = ["--set", "controller.low=0", "--set", "controller.high=9.03"]


@pytest.fixture(scope="module")
def proof(native_prover: None, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """The file of a proof."""
    del native_prover
    file = tmp_path_factory.mktemp("proof") / "p.json"
    run("prove", "slip-lmi", *LIMITS, *BOX, "--budget", "100", "--out", file, "--json")
    return file


def judge(document: JsonObject) -> FileVerdict:
    """Return the verdict on a file of the loop and the duration of its own scenario."""
    chosen = loads(document["scenario"].encode(), "p", "p")
    return verify_box(chosen.loop, chosen.solver.duration, document, share=1e-6)


@pytest.mark.slow
def test_a_file_is_verified(proof: pathlib.Path) -> None:
    found = json.loads(run("verify", proof, "--share", "1e-6", "--json").stdout)
    assert found["proved"]
    assert {"greatest slip", "stop_time"} <= {claim["kind"].rpartition(" ")[0][:-3] for claim in found["claims"]}
    document = json.loads(proof.read_text())
    assert document["verdict"] == "proved"
    assert len(document["cells"]) >= 1


def lower_bound(document: JsonObject) -> None:
    document["bounds"]["greatest slip"][1] *= 0.995


def shorter_stop(document: JsonObject) -> None:
    document["bounds"]["stop_time"][1] *= 0.995


def smaller_torque(document: JsonObject) -> None:
    """The greatest slip becomes 0.2816, and the file says 0.2804."""
    assert "high = 9.03" in document["scenario"]
    document["scenario"] = document["scenario"].replace("high = 9.03", "high = 8.9")


def shorter_duration(document: JsonObject) -> None:
    document["horizon"] *= 0.5


def false_claim(document: JsonObject) -> None:
    document["claims"] = [{"quantity": "greatest slip", "bound": 0.2}]


CHEAP = [shorter_duration, false_claim]  # noticed before a cell is proved again; `test_attacks.py` has more
CHANGES = [*CHEAP, *(pytest.param(x, marks=pytest.mark.slow) for x in (lower_bound, shorter_stop, smaller_torque))]


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_a_changed_number_is_noticed(proof: pathlib.Path, change: Callable[[JsonObject], None]) -> None:
    document = copy.deepcopy(json.loads(proof.read_text()))
    change(document)
    assert judge(document).reason


def test_a_file_that_is_no_proof_is_refused(tmp_path: pathlib.Path, proof: pathlib.Path) -> None:
    document = json.loads(proof.read_text())
    for key in ("cells", "over", "bounds", "scenario"):
        broken = tmp_path / f"{key}.json"
        broken.write_text(json.dumps({name: value for name, value in document.items() if name != key}))
        run("verify", broken, status=2)


@killed_by("robust.reach.verification", "if not isinstance(member, kind):", "if False:")
@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ({"over": [1, 2]}, "over = [1, 2] is not a table"),
        ({"over": None}, "over is missing"),
        ({"over": {"plant.mass": [5, 6, 7]}}, "over.plant.mass = [5, 6, 7]; a pair [low, high] of finite numbers is"),
        ({"cells": [[[5, 6]], [[5, "a"]]]}, "cells.1 = [[5, 'a']]; a list, each entry a pair [low, high] of finite"),
        ({"claims": [{"quantity": "slip"}]}, "claims.0 = {'quantity': 'slip'}; {\"quantity\": name, \"bound\""),
        ({"bounds": {"greatest slip": [None, math.nan]}}, "bounds.greatest slip = [None, nan]; a pair [low, high] of"),
        ({"horizon": "long"}, 'horizon = "long"; a finite number [s] is needed'),
    ],
)
def test_a_wrong_member_of_a_file_is_named(changed: JsonObject, line: str) -> None:
    document = {"format": FORMAT, "verdict": "proved", "over": {"plant.mass": [5, 6]}, "cells": [], "claims": []}
    with pytest.raises(ValueError, match=re.escape(line)):
        read_proof({**document, "bounds": {}, "horizon": 1.0, **changed})


@killed_by("scenario.proofs", "if not isinstance(text, str):", "if False:")
@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ({}, "scenario is missing or no text; the TOML text of a scenario is needed"),
        ({"scenario": 3}, "scenario is missing or no text"),
        ({"scenario": "hello"}, '"scenario" is not TOML: '),
    ],
)
def test_a_file_without_a_scenario_is_refused_by_name(changed: JsonObject, line: str, tmp_path: pathlib.Path) -> None:
    file = tmp_path / "p.json"
    file.write_text(json.dumps({"format": FORMAT, "verdict": "proved", **changed}))
    assert_one_error_line(result := run("verify", file, status=2))
    assert line in result.stderr


@killed_by("scenario.proofs", "if not verdict.reason and not whole", "if not whole")
def test_a_refuted_file_has_no_hint_to_check_more(proof: pathlib.Path, tmp_path: pathlib.Path) -> None:
    document = json.loads(proof.read_text())
    shorter_duration(document)
    file = tmp_path / "p.json"
    file.write_text(json.dumps(document))
    result = run("verify", file, "--share", "1", status=1)
    assert "NOT PROVED" in result.stdout
    assert result.stderr.splitlines()[-1].startswith(f"verdict: {file}: not proved: ")
    assert "proves all" not in result.stdout


@killed_by("robust.reach.verification", "why = readers[i % count].recv()", "why = ''")
@pytest.mark.slow
def test_several_processes_check_every_cell(proof: pathlib.Path) -> None:
    document = json.loads(proof.read_text())
    (mass, (low, high)), *_ = document["cells"]
    middle = 0.5 * (low + high)
    document["cells"] = [[mass, [low, middle]], [mass, [middle, high]]]
    chosen = loads(document["scenario"].encode(), "p", "p")

    def verdict() -> FileVerdict:
        return verify_box(chosen.loop, chosen.solver.duration, document, share=1.0, processes=2)

    found = verdict()
    assert found.checked == found.cells == 2
    assert not found.reason
    lower_bound(document)
    assert verdict().reason


@killed_by("robust.reach.verification", 'why = "the process that checked it has ended"', 'why = ""')
@pytest.mark.slow
def test_a_cell_whose_process_ends_is_not_proved() -> None:
    assert all(why for _, why in _map_cells(os._exit, [3, 3], 2))


@killed_by("robust.reach.verification", "key=lambda i: shares[i]", "key=lambda i: -shares[i]")
def test_the_side_that_the_prover_halved_most_is_halved_first() -> None:
    """A side that is a point is not halved."""
    over = {"plant.mass": (5.0, 6.0), "initial.speed": (8.0, 16.0), "plant.inertia": (1.0, 1.0)}
    assert _choose_sides(over, ((5.5, 5.75), (8.0, 8.5), (1.0, 1.0))) == ([1, 0] * CELL_HALVINGS)[:CELL_HALVINGS]
