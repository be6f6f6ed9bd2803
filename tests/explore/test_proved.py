"""A proof's file in the explorer: whether it covers the values on the page."""

import json
import pathlib
from typing import Any

import pytest
from commands import assert_one_error_line, run
from mutants import killed_by
from test_explore import SHORT, turn

from diffabs.host.values import ScenarioError
from diffabs.output.explore.proved import ProvedBox, judge_values, load_proved_box
from diffabs.output.explore.session import CERTIFIED, NOT_PROVED, Session
from diffabs.robust.reach.certificate import FORMAT
from diffabs.scenario import dump, load

pytestmark = pytest.mark.usefixtures("any_step_is_stable")
BOX = [[5.3, 6.2], [20 / 3.6, 30 / 3.6]]


@pytest.fixture
def session(file) -> Session:
    """Of a short run."""
    return Session(str(file(SHORT)))


@pytest.fixture
def document(file) -> dict[str, Any]:
    """A file about that run, which claims a bound without any proof."""
    return {
        "format": FORMAT,
        "verdict": "proved",
        "scenario": dump(load(str(file(SHORT)))),
        "over": dict(zip(("plant.mass", "initial.speed"), BOX, strict=True)),
        "claims": [{"quantity": "greatest slip", "bound": 0.4}],
        "bounds": {"greatest slip": [None, 0.35], "stop_time": [0.1, None]},
        "horizon": 1.0,
        "cells": [BOX],
    }


@pytest.fixture
def proved(document: dict[str, Any]) -> ProvedBox:
    return load_proved_box(pathlib.Path("p.json"), document)


@killed_by(
    "output.explore.proved",
    "now = friction.without_factor(session.scenario(), session.original)",
    "now = session.original",
)
def test_values_in_the_box_are_covered(session: Session, proved: ProvedBox) -> None:
    assert judge_values(proved, session) == (
        CERTIFIED,
        "greatest slip <= 0.4, greatest slip <= 0.35, stop_time >= 0.1 for plant.mass 5.3 to 6.2 kg,"
        " initial.speed 20 to 30 km/h, by p.json; verify with diffabs verify p.json",
    )
    turn(session, "plant.mass", "6.2")
    turn(session, "initial.speed", "20")
    assert judge_values(proved, session).word == CERTIFIED
    turn(session, "plant.mass", "6.21")
    assert judge_values(proved, session) == (
        NOT_PROVED,
        "outside of the proved box: plant.mass = 6.21 kg is not in 5.3 to 6.2 kg, by p.json",
    )


@killed_by("output.explore.proved", '{knob.words(value)}" if', '{knob.text(value)} {knob.spec.unit}" if')
@killed_by("output.explore.proved", "to {knob.words(high)}", "to {knob.text(high)} {knob.spec.unit}")
def test_a_plain_number_is_named_without_a_unit(session: Session, document: dict[str, Any]) -> None:
    box = [*BOX, [0.15, 0.19]]
    over = document["over"] | {"reference.slip": box[-1]}
    proved = load_proved_box(pathlib.Path("p.json"), document | {"over": over, "cells": [box]})
    said = "outside of the proved box: reference.slip = 0.2 is not in 0.15 to 0.19, by p.json"
    assert judge_values(proved, session) == (NOT_PROVED, said)


@killed_by("output.explore.proved", "if path not in over and not np.array_equal", "if False and not np.array_equal")
@pytest.mark.parametrize(
    ("key", "given", "said"),
    [
        ("controller.gain.1", "-50", "controller.gain = -11753, -48 N m/s, N m, here it is -11753, -50 N m/s, N m"),
        ("plant.road.road.w4", "0.4", "plant.road.w4 = 0.407, here it is 0.4"),
        ("plant.road.scale", "0.9", "another loop"),
        ("stop.speed", "11", "stop.speed = 2.77778 m/s, here it is 3.05556 m/s"),
    ],
)
def test_another_value_is_not_covered(session: Session, proved: ProvedBox, key: str, given: str, said: str) -> None:
    turn(session, key, given)
    assert judge_values(proved, session) == (NOT_PROVED, f"p.json is about {said}")
    session.reset()
    assert judge_values(proved, session).word == CERTIFIED


@killed_by("output.explore.proved", " or _compare_durations(now, proved.scenario)", "")
def test_another_loop_or_duration_is_not_covered(proved: ProvedBox, file) -> None:
    longer = Session(str(file(SHORT.replace("duration = 1.0", "duration = 2.0"))))
    assert judge_values(proved, longer) == (NOT_PROVED, "p.json is about runs of 1 s, here they last 2 s")
    for name in ("slip-cured", "arm-hanging"):
        assert judge_values(proved, Session(name)) == (NOT_PROVED, "p.json is about another loop")


def test_a_file_that_is_no_proof_is_refused(document: dict[str, Any], tmp_path: pathlib.Path) -> None:
    for changed in (
        {"verdict": "refuted"},
        {"bounds": {"greatest slip": [None, float("nan")]}},
        {"scenario": "[plant"},
    ):
        with pytest.raises((ValueError, ScenarioError)):
            load_proved_box(tmp_path / "p.json", document | changed)
    (tmp_path / "p.json").write_text(json.dumps(document | {"verdict": "undecided"}))
    (tmp_path / "q.json").write_text("{}")
    for name, said in (("p.json", "nothing to verify"), ("q.json", "is no certificate"), ("r.json", "no such file")):
        found = run("explore", "slip-cured", "--proof", tmp_path / name, "--no-browser", status=2)
        assert_one_error_line(found)
        assert said in found.stderr
