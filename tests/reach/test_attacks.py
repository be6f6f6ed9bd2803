"""Files that somebody edited: no false statement is verified.

The equation is x' = -p x with x(0) = q until x = 1/4."""

import copy
import itertools
import json
import math
import time
from collections.abc import Callable

import pytest
from mutants import killed_by
from seams import replace_seam

import diffabs as d
from diffabs.core.types import JsonObject
from diffabs.robust.reach.certificate import FORMAT
from diffabs.robust.reach.equations import Equations, RealOperation
from diffabs.robust.reach.verification import FileVerdict, verify_box

pytest.importorskip("flint")
LOOP = d.braking()  # stands for the loop of the scenario; `equations` takes its place
HORIZON = 50.0  # the checker takes 500 steps up to there
BOX = {"p": (1.0, 1.25), "q": (0.75, 1.0)}
LONGEST, SHORTEST = math.log(4.0), math.log(3.0) / 1.25  # stop times [s]
WORST = (1.0, 1.0)  # p and q of the longest run


def decay() -> Equations:
    """Equations of x, its integral and the time; p and q are the parameters."""
    operations = [
        RealOperation("param", (), 0), RealOperation("param", (), 1), RealOperation("state", (), 0),
        RealOperation("state", (), 2), RealOperation("const", (), 0.0), RealOperation("const", (), 1.0),
        RealOperation("const", (), 0.25), RealOperation("mul", (0, 2)), RealOperation("neg", (7,)),
        RealOperation("sub", (2, 6)), RealOperation("const", (), 2.0), RealOperation("sub", (10, 2)),
    ]  # fmt: skip
    return Equations(
        tuple(operations), ("p", "q"), ("x", "s", "t"), (1, 4, 4), (8, 2, 5), (), None, {"x": 2, "t": 3, "y": 11},
        9, (), 1, -1, 2, False,
    )  # fmt: skip


def cells() -> list[list[list[float]]]:
    """The 16 cells of two halvings of each side."""
    p, q = ([[low + k / 16, low + (k + 1) / 16] for k in range(4)] for low, _ in BOX.values())
    return [[x, y] for x in p for y in q]


HONEST: JsonObject = {
    "format": FORMAT,
    "verdict": "proved",
    "scenario": "",
    "over": {path: list(ends) for path, ends in BOX.items()},
    "claims": [{"quantity": "stop_time", "bound": 1.5}, {"quantity": "least x", "bound": 0.15}],
    "horizon": HORIZON,
    "bounds": {
        "greatest x": [None, 1.0001],
        "least x": [0.16, None],
        "least y": [0.9999, None],
        "stop_time": [SHORTEST * 0.97, LONGEST * 1.03],
        "stop_distance": [0.4 * 0.97, 0.75 * 1.03],
    },
    "cells": cells(),
}


@pytest.fixture(autouse=True)
def equations(monkeypatch: pytest.MonkeyPatch) -> None:
    replace_seam(monkeypatch, "verified_equations", lambda loop, over: decay())


def judge(document: JsonObject, share: float = 1.0, **more) -> FileVerdict:
    """Return the verdict on a document as its reader sees it, after it was text."""
    return verify_box(LOOP, HORIZON, json.loads(json.dumps(document)), share, **more)


def objection(document: JsonObject) -> str:
    """Return why a document is not verified, empty if it is."""
    try:
        return judge(document).reason
    except ValueError as error:
        return str(error)


@killed_by(
    "robust.reach.verification", "return (order * CELL_HALVINGS)[:CELL_HALVINGS]", "return order[:1] * CELL_HALVINGS"
)
def test_the_honest_file_is_verified() -> None:
    found = judge(HONEST)
    assert found.reason == ""
    assert found.checked == found.cells == 16
    assert found.statements[:3] == ("stop_time <= 1.5", "least x >= 0.15", "greatest x <= 1.0001")
    assert len(found.statements) == 2 + 7


NAN, INF = math.nan, math.inf
EDITS: dict[str, Callable[[JsonObject], object]] = {
    # Numbers that a comparison accepts, or that are none.
    "a bound that is not a number": lambda f: f["bounds"].update(stop_time=[None, NAN]),
    "a claim that is not a number": lambda f: f["claims"][0].update(bound=NAN),
    "a bound as text": lambda f: f["bounds"].update(stop_time=[None, "1.4"]),
    "a bound that is a truth": lambda f: f["bounds"].update(stop_distance=[None, True]),
    "a bound of 400 digits": lambda f: f["bounds"].update(stop_time=[None, 10**400]),
    "an inverted box": lambda f: f.update(
        over={"p": [1.0, 0.5], "q": [0.75, 0.75]}, cells=[[[1.0, 0.5], [0.75, 0.75]]]),
    "an infinite box": lambda f: f["over"].update(p=[1.0, INF]),
    "a cell without numbers": lambda f: f["cells"].__setitem__(0, [[NAN, NAN], [NAN, NAN]]),
    "no horizon": lambda f: f.update(horizon=NAN),
    # Bounds that are false.
    "a bound slightly too low": lambda f: f["bounds"].update({"greatest x": [None, 0.9995]}),
    "a bound slightly too high": lambda f: f["bounds"].update({"least y": [1.0005, None]}),
    "swapped ends": lambda f: f["bounds"]["stop_time"].reverse(),
    "a false stop distance": lambda f: f["bounds"].update(stop_distance=[0.42, None]),
    "a bound that no checker proves": lambda f: f["bounds"].update({"greatest x": [2.0, 1.0001]}),
    "a claim beyond its bound": lambda f: f["claims"][0].update(bound=LONGEST * 1.005),
    "a claim without its bound": lambda f: f["bounds"].update(stop_time=[0.5, None]),
    "a claim of another quantity": lambda f: f["claims"][0].update(quantity="greatest t"),
    "a bound of no signal": lambda f: f["bounds"].update({"greatest z": [None, 1.0]}),
    "a bound of a signal and more": lambda f: f["bounds"].update({"greatest x 1": [None, 1.0001]}),
    "a bound of a blank": lambda f: f["bounds"].update({"greatest  ": [None, 1.0]}),
    "a bound of no quantity": lambda f: f["bounds"].update({"rise_time": [None, 1.0]}),
    "a false bound, and the list of signals without it": lambda f: (
        f["bounds"].update({"greatest x": [None, 0.5]}), f.update(signals=[])),
    "all bounds and claims gone": lambda f: (f.update(claims=[]), f["bounds"].clear()),
    # Runs that are not followed, or others.
    "a shorter horizon": lambda f: (
        f.update(horizon=0.1, claims=[]), f.update(bounds={"least x": [0.6, None]})),
    "another order of the parameters": lambda f: f.update(over=dict(reversed(f["over"].items()))),
    # Cells.
    "a cell is missing": lambda f: f["cells"].pop(),
    "a cell twice": lambda f: f["cells"].append(f["cells"][0]),
    "a cell twice for another": lambda f: f["cells"].__setitem__(5, f["cells"][4]),
    "a cell that overlaps another": lambda f: f["cells"].__setitem__(5, [f["cells"][4][0], [0.75, 0.875]]),
    "a cell of no width": lambda f: f["cells"].__setitem__(5, [[1.0625, 1.0625], [0.75, 1.0]]),
    "a cell outside": lambda f: f["cells"][0][0].__setitem__(0, 0.9),
    "no cells": lambda f: f["cells"].clear(),
    "a cell with one range": lambda f: f["cells"][0].pop(),
    "a wider box": lambda f: f["over"].update(q=[0.75, 1.5]),
    # The head of the file.
    "no box": lambda f: f.update(over={}, cells=[[]]),
    "another format": lambda f: f.update(format="diffabs box proof 0"),
    "another verdict": lambda f: f.update(verdict="undecided"),
}  # fmt: skip


@killed_by("robust.reach.verification", " or not math.isfinite(number)", "", case="a claim that is not a number")
@killed_by("robust.reach.verification", "isinstance(number, bool) or ", "", case="a bound that is a truth")
@killed_by(
    "robust.reach.verification", 'name.partition(" ")[2]', "name.split()[1]", case="a bound of a signal and more"
)
@killed_by(
    "robust.reach.verification",
    "proved_high <= high",
    "proved_high <= high + 1e-3 * abs(high)",
    case="a bound slightly too low",
)
@killed_by(
    "robust.reach.verification", "proved_low >= low", "proved_low >= low * 0.999", case="a bound slightly too high"
)
@killed_by(
    "robust.reach.verification",
    "if end is not None and not proved:",
    "if False:",
    case="a bound that no checker proves",
)
@killed_by("robust.reach.verification", "if file.horizon != horizon:", "if False:", case="a shorter horizon")
@killed_by(
    "robust.reach.verification", "    if not file.statements:", "    if False:", case="all bounds and claims gone"
)
@killed_by("robust.reach.verification", "worst > claim.bound)", "False)", case="a claim beyond its bound")
@killed_by(
    "robust.reach.verification", "if worst is None or", "if worst is not None and", case="a claim without its bound"
)
@killed_by(
    "robust.reach.verification",
    "if not comes_from_halving(list(file.over.values()), file.cells):",
    "if False:",
    case="a cell is missing",
)
@pytest.mark.parametrize("name", EDITS)
def test_an_edited_file_is_noticed(name: str) -> None:
    document = copy.deepcopy(HONEST)
    EDITS[name](document)
    assert json.dumps(document) != json.dumps(HONEST)
    assert objection(document)


@killed_by("robust.reach.cover", "if not -LARGEST_INPUT < low <= high < LARGEST_INPUT:", "if False:")
def test_an_inverted_box_is_named() -> None:
    document = copy.deepcopy(HONEST)
    EDITS["an inverted box"](document)
    assert "over.p = [1, 0.5]; two numbers below 1e+150 are needed, the lower first" in objection(document)


@killed_by("robust.reach.cover", " and list(map(list, inside[0])) == part", "")
def test_a_hole_among_many_cells_is_noticed_at_once() -> None:
    """The halvings of 16^3 cells have 34,650 orders."""
    document = copy.deepcopy(HONEST)
    document["over"] = {path: [0.0, 1.0] for path in ("p", "q", "r")}
    sides = [[[k / 16, (k + 1) / 16] for k in row] for row in itertools.product(range(16), repeat=3)]
    document["cells"] = [*sides[:-1], [[0.9375, 1.0 - 1e-9], *sides[-1][1:]]]
    began = time.process_time()
    assert "halving" in judge(document).reason
    assert time.process_time() - began < 2.0


@pytest.mark.parametrize("share", [0.0, -0.5, 2.0, NAN])
def test_a_share_of_the_cells_is_in_its_range(share: float) -> None:
    with pytest.raises(ValueError, match=r"share = .* is outside \(0, 1\]"):
        judge(HONEST, share)


@killed_by("robust.reach.verification", "[*holding, *sample]", "sample")
def test_the_cell_of_a_suspect_is_always_checked() -> None:
    """A bound that is false in one of 16 cells is noticed, whatever cells the sample has."""
    document = copy.deepcopy(HONEST)
    document["bounds"]["stop_time"][1] = LONGEST * 0.9995
    document["claims"] = []
    for _ in range(4):
        assert "stop_time up to" in judge(document, 1e-9, suspects=[WORST]).reason
    assert judge(HONEST, 1e-9).checked == 1
