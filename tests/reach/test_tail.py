"""Proofs that end in settled states, against a brake with a closed form.

The slip is s' = k (1/5 - s), the speed v' = -(8 + b s), until v = 1; the box has b and the speed at the start."""

import copy
import dataclasses
import json
from collections.abc import Callable

import numpy as np
import pytest
from marks import cases
from mutants import killed_by
from seams import replace_seam

import diffabs as d
from diffabs.core.types import JsonObject
from diffabs.robust.reach.certificate import FORMAT, tail_document
from diffabs.robust.reach.cover import RunClaim, cover_box
from diffabs.robust.reach.engine import CellBounds, Prover
from diffabs.robust.reach.equations import Equations, RealOperation
from diffabs.robust.reach.search_tail import find_tail
from diffabs.robust.reach.tail import RunTail, stop_speed
from diffabs.robust.reach.verification import FileVerdict, verify_box

pytestmark = pytest.mark.usefixtures("native_prover", "any_step_is_stable")
RATE, TARGET, HORIZON = 40.0, 0.2, 5.0
BOX = {"b": (2.0, 3.0), "initial.speed": (4.0, 6.0)}
LOOP = d.braking()  # stands for the loop of the scenario; `brake` takes its place


def brake(period: float | None = None, *, start: float = 0.0) -> Equations:
    """Equations of slip, speed, distance and time; with a period, a tick that changes nothing."""
    operations: list[RealOperation] = []

    def make(name: str, *args: int, value: float | None = None) -> int:
        operations.append(RealOperation(name, args, value))
        return len(operations) - 1

    b, speed = make("param", value=0), make("param", value=1)
    s, v, x, t = (make("state", value=i) for i in range(4))
    zero, one, first = make("const", value=0.0), make("const", value=1.0), make("const", value=start)
    slip_rate = make("mul", make("const", value=RATE), make("sub", make("const", value=TARGET), s))
    fall = make("neg", make("add", make("const", value=8.0), make("mul", b, s)))
    return Equations(
        tuple(operations) + (RealOperation("sub", (v, one)),), tuple(BOX),
        ("plant.slip", "plant.speed", "plant.distance", "time"),
        (first, speed, zero, zero), (slip_rate, fall, v, one), () if period is None else (s, v, x, t), period,
        {"slip": s, "speed": v}, len(operations), (0,), 2, 1, 3, False, fall,
    )  # fmt: skip


def run(b: float, v0: float, t: np.ndarray, s0: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slip, speed and distance at instants, in closed form."""
    e, mean = np.exp(-RATE * t), 8.0 + b * TARGET
    off = b * (s0 - TARGET) / RATE
    return (
        TARGET + (s0 - TARGET) * e,
        v0 - mean * t - off * (1 - e),
        v0 * t - mean * t**2 / 2 - off * (t - (1 - e) / RATE),
    )


def stop_of(b: float, v0: float, s0: float = 0.0) -> float:
    """Stop time, by bisection of the closed form."""
    low, high = 0.0, 2.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if run(b, v0, np.array(middle), s0)[1] > 1.0 else (low, middle)
    return high


def prover_of(equations: Equations) -> Prover:
    prover = Prover(equations, ("slip", "speed"), HORIZON)
    prover.choose_weights(np.array([2.5, 6.0]))
    return prover


PERIODS = pytest.mark.parametrize("period", cases([None, 0.01], 0.01), ids=["continuous", "sampled"])


def tail_of(prover: Prover) -> RunTail:
    tail = find_tail(prover, BOX, 1e-3, 0.25)
    assert tail is not None
    return tail


@killed_by(
    "robust.reach.search_tail", "return tail if len(tail.pieces) > 1 else None", "return None", case="continuous"
)
@PERIODS
def test_runs_from_a_piece_stay_in_its_ranges(period: float | None) -> None:
    tail, random = tail_of(prover_of(brake(period))), np.random.default_rng(1)
    assert tail.states == ("plant.slip",)
    assert stop_speed(brake(period)) == 1.0
    assert tail.pieces[-1].high > 4.0  # before the slip has settled there is no piece
    for piece in tail.pieces:
        b, v0, place = random.uniform(2, 3, 50), random.uniform(piece.low, piece.high, 50), random.uniform(-1, 1, 50)
        centre = piece.centre[0] + piece.by_speed[0] * (v0 - piece.middle) + (b - tail.middle[0]) * piece.by_param[0][0]
        for i, s0 in enumerate(centre + place * piece.width[0]):
            slip, speed, _ = run(b[i], v0[i], np.linspace(0, stop_of(b[i], v0[i], s0), 200), s0)
            for name, values in (("slip", slip), ("speed", speed)):
                low, high = piece.later_signals[name]
                assert low <= values.min()
                assert values.max() <= high


def bounds(period: float | None, cells: np.ndarray, *, settled: bool) -> CellBounds:
    prover = prover_of(brake(period))
    prover.use_tail(tail_of(prover) if settled else None)
    return prover.prove(cells)


@killed_by(
    "robust/reach/native/prove.cpp",
    "return now_.c + integral + symmetric(w);",
    "return now_.c + integral;",
    case="continuous",
)
@killed_by(
    "robust/reach/native/prove.cpp", "in &= off.mag() + spread <=", "in &= 0.0 * off.mag() <=", case="continuous"
)
@PERIODS
def test_a_cell_that_ends_in_the_tail_bounds_its_runs(period: float | None) -> None:
    """The tail makes the bounds of the stop at most 0.3 % wider."""
    random = np.random.default_rng(2)
    corners = np.stack([random.uniform(2, 2.98, 12), random.uniform(4, 5.9, 12)], 1)
    cells = np.stack([corners, corners + (0.02, 0.1)], 2)
    direct, ended = (bounds(period, cells, settled=settled) for settled in (False, True))
    assert (direct.status == 1).all()
    assert (ended.status == 1).all()
    for i, cell in enumerate(cells):
        for b, v0 in random.uniform(cell[:, 0], cell[:, 1], (20, 2)):
            stop = stop_of(b, v0)
            slip, _, way = run(b, v0, np.array([stop]))
            assert ended.time[i, 0] <= stop <= ended.time[i, 1]
            assert ended.distance[i, 0] <= way[0] <= ended.distance[i, 1]
            assert slip[0] <= ended.upper[i, 0]
        for mine, other in ((ended.time[i], direct.time[i]), (ended.distance[i], direct.distance[i])):
            assert mine[0] >= other[0] * 0.997
            assert mine[1] <= other[1] * 1.003
    assert not np.array_equal(ended.time, direct.time)  # the tail was used


@pytest.mark.parametrize("bound", cases([0.21, 0.2001], 0.21))
def test_the_claims_hold_in_the_tail(monkeypatch: pytest.MonkeyPatch, bound: float) -> None:
    replace_seam(monkeypatch, "cells_before_tail", 0)
    replace_seam(monkeypatch, "proved_equations", lambda loop, over: brake())
    found = cover_box(LOOP, BOX, [RunClaim("greatest slip", bound)], signals=("slip",), horizon=HORIZON, budget=60)
    assert found.verdict == "proved"
    assert found.tail is not None
    assert 0.2 < found.tail.pieces[-1].later_signals["slip"][1] <= bound


@pytest.mark.parametrize("equations", [
    dataclasses.replace(brake(), margin=4, speed=-1),  # stops at a distance
    dataclasses.replace(brake(), nonnegative=()),
], ids=["no speed", "no slip"])  # fmt: skip
def test_a_loop_without_such_a_stop_has_no_tail(equations: Equations) -> None:
    assert find_tail(prover_of(equations), BOX, 1e-3, 0.25) is None


# The file.


@pytest.fixture(scope="module")
def honest(native_prover: None) -> JsonObject:
    """The document of a proof with a tail of three pieces."""
    del native_prover
    prover = prover_of(brake())
    whole = tail_of(prover)
    tail = whole._replace(pieces=whole.pieces[:3])
    prover.use_tail(tail)
    middle = 0.5 * (BOX["b"][0] + BOX["b"][1])
    cells = [[[low, high], [4.0, 4.0]] for low, high in ((2.0, middle), (middle, 3.0))]
    found = prover.prove(np.array(cells))
    assert (found.status == 1).all()
    document = {
        "format": FORMAT,
        "verdict": "proved",
        "scenario": "",
        "over": {"b": [2.0, 3.0], "initial.speed": [4.0, 4.0]},
        "claims": [],
        "horizon": HORIZON,
        "bounds": {
            "greatest slip": [None, float(found.upper[:, 0].max()) * 1.001],
            "stop_time": [float(found.time[:, 0].min()) * 0.999, float(found.time[:, 1].max()) * 1.001],
        },
        "cells": cells,
        "tail": tail_document(_over_one_speed(tail)),
    }
    return json.loads(json.dumps(document))


def _over_one_speed(tail: RunTail) -> RunTail:
    """The tail for a box with one speed at the start, which no run reads after its start."""
    pieces = (p._replace(cells=tuple((c[0], (4.0, 4.0), c[2]) for c in p.cells)) for p in tail.pieces)
    return tail._replace(pieces=tuple(pieces))


def judge(
    monkeypatch: pytest.MonkeyPatch, document: JsonObject, known: dict[str, tuple[float, float]] | None = None
) -> FileVerdict:
    pytest.importorskip("flint")
    replace_seam(monkeypatch, "verified_equations", lambda loop, over: brake())
    return verify_box(LOOP, HORIZON, json.loads(json.dumps(document)), 1.0, extremes=known)


def objection(monkeypatch: pytest.MonkeyPatch, document: JsonObject) -> str:
    """Return why a document is not verified, empty if it is."""
    try:
        return judge(monkeypatch, document).reason
    except ValueError as error:
        return str(error) if "tail" in str(error) else ""


def test_the_tail_of_a_file_is_verified(monkeypatch: pytest.MonkeyPatch, honest: JsonObject) -> None:
    found = judge(monkeypatch, honest)
    assert found.reason == ""
    assert found.checked == found.cells == 2 + sum(len(piece["cells"]) for piece in honest["tail"]["pieces"])


def scale(name: str, piece: int, factor: float) -> Callable[[JsonObject], None]:
    """Return an edit that multiplies the numbers of a piece."""

    def edit(document: JsonObject) -> None:
        numbers = document["tail"]["pieces"][piece][name]
        document["tail"]["pieces"][piece][name] = [factor * x for x in numbers]

    return edit


def narrow(name: str) -> Callable[[JsonObject], None]:
    """Return an edit that narrows a range of all pieces, so that they still contain one another."""

    def edit(document: JsonObject) -> None:
        for piece in document["tail"]["pieces"]:
            piece[name] = {key: [TARGET - 5e-5, TARGET + 5e-5] for key in piece[name] if "slip" in key}

    return edit


EDITS: dict[str, Callable[[JsonObject], object]] = {
    "a wider piece": scale("width", 1, 20.0),
    "a piece elsewhere": scale("centre", 0, 1.1),
    "a piece that turns with the speed": lambda f: f["tail"]["pieces"][2].update(by_speed=[0.5]),
    "narrow states": narrow("later_states"),
    "narrow signals": narrow("later_signals"),
    "a slower piece is wider": lambda f: f["tail"]["pieces"][1]["later_states"].update({"plant.slip": [0.19, 0.21]}),
    "no range of a state": lambda f: [piece["later_states"].clear() for piece in f["tail"]["pieces"]],
    "no range of a signal": lambda f: [piece["later_signals"].pop("slip") for piece in f["tail"]["pieces"]],
    "a cell is missing": lambda f: f["tail"]["pieces"][1]["cells"].pop(),
    "a faster piece": lambda f: f["tail"]["pieces"][1].update(high=9.0),
    "the speed as a settled state": lambda f: (f["tail"].update(states=["plant.slip", "plant.speed"]), [
        piece.update({name: [*piece[name], 0.0] for name in ("centre", "by_speed")}, width=[*piece["width"], 9.0],
                     by_param=[*piece["by_param"], [0.0, 0.0]]) for piece in f["tail"]["pieces"]]),
    "no settled state": lambda f: (f["tail"].update(states=[]), [
        piece.update(centre=[], by_speed=[], width=[], by_param=[]) for piece in f["tail"]["pieces"]]),
    "an unknown state": lambda f: f["tail"].update(states=["slop"]),
    "an infinite width": lambda f: f["tail"]["pieces"][0].update(width=[float("inf")]),
    "another middle": lambda f: f["tail"].update(middle=[2.5]),
    "text": lambda f: f.update(tail="settled"),
    "a list for a table": lambda f: f["tail"]["pieces"][0].update(later_states=[]),
    "an unknown signal": lambda f: [p["later_signals"].update(slop=[0.0, 1.0]) for p in f["tail"]["pieces"]],
    "an unknown later state": lambda f: [p["later_states"].update(slop=[0.0, 1.0]) for p in f["tail"]["pieces"]],
    "the range of another state": lambda f: [
        p["later_states"].update({"plant.distance": [0.0, 1.0]}) for p in f["tail"]["pieces"]],
}  # fmt: skip


@killed_by(
    "robust.reach.verification", "    return _find_gap(file)\n", '    return ""\n', case="a slower piece is wider"
)
@pytest.mark.parametrize("name", EDITS)
def test_an_edited_tail_is_noticed(monkeypatch: pytest.MonkeyPatch, honest: JsonObject, name: str) -> None:
    document = copy.deepcopy(honest)
    EDITS[name](document)
    assert objection(monkeypatch, document)


@killed_by("robust.reach.verification", "or name_contradiction(bounds, extremes or {})", "")
def test_a_bound_that_a_run_violates_is_not_verified(monkeypatch: pytest.MonkeyPatch, honest: JsonObject) -> None:
    """A false piece could make it false in all cells."""
    longest = honest["bounds"]["stop_time"][1]
    for run, is_beyond in ((0.999 * longest, False), (1.002 * longest, True)):
        known = {"stop_time": (0.999 * longest, run)}
        assert bool(judge(monkeypatch, honest, known).reason) == is_beyond


@killed_by("robust.reach.verification", "if reason and tail is not None and latest is None:", "if False:")
def test_bounds_of_cells_from_before_the_tail_are_verified(monkeypatch: pytest.MonkeyPatch, honest: JsonObject) -> None:
    """The tail says less about the stop than the runs do that are followed to it."""
    document = copy.deepcopy(honest)
    for piece in document["tail"]["pieces"]:
        piece["later_states"] = {"plant.slip": [0.1, 0.3]}
    assert judge(monkeypatch, document).reason == ""


@killed_by("robust.reach.checker", "or e.speed in settled", "")
def test_the_speed_is_no_settled_state(monkeypatch: pytest.MonkeyPatch, honest: JsonObject) -> None:
    document = copy.deepcopy(honest)
    EDITS["the speed as a settled state"](document)
    assert "without its speed" in judge(monkeypatch, document).reason


@killed_by("robust.reach.checker", "<= arb(piece.width[i]):", "<= arb(1):")
@killed_by(
    "robust.reach.checker",
    "y = q.centre + integral + balls.symmetric(q.uncertainty)",
    "y = q.centre + balls.symmetric(q.uncertainty)",
)
@pytest.mark.parametrize("speed", cases([1.1, 5.5], 1.1), ids=["too slow to settle", "settles"])
def test_the_checker_bounds_runs_that_end_in_the_tail(speed: float) -> None:
    checker = pytest.importorskip("diffabs.robust.reach.checker")
    tail, steps = tail_of(prover_of(brake())), [2e-3]
    cell = [(2.5, 2.55), (speed, speed + 0.02)]
    found = checker.check_cell(brake(), ["slip"], cell, steps, HORIZON, tail=tail)
    direct = checker.check_cell(brake(), ["slip"], cell, steps, HORIZON)
    assert (found == direct) == (speed == 1.1)
    for b, v0 in np.random.default_rng(3).uniform(*np.transpose(cell), (30, 2)):
        stop = stop_of(b, v0)
        assert found.stop_time[0] <= stop <= found.stop_time[1]
        assert found.distance[0] <= run(b, v0, np.array(stop))[2] <= found.distance[1]
