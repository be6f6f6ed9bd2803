"""Clauses as constraints of a tuning: excesses in closed form, what is undecided, slopes, and a tuning of gains."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import assert_one_error_line, run
from mutants import killed_by

import diffabs as d
from diffabs.assess import Clause, ClauseBounds, Figures, StopProgram, assess
from diffabs.assess.bounds import find_excess
from diffabs.core.pytree import replace
from diffabs.scenario import ScenarioError, dump, load, loads
from diffabs.scenario.tuning import build_clause_bounds, describe_clause

SLUGGISH = """
plant = "half-car"
[controller.front_brake]
kp = 1e3
ki = 1e4
antiwindup = "no-anti-windup"
[controller.rear_brake]
kp = 1e3
ki = 1e4
antiwindup = "no-anti-windup"
[assess]
load = 300.0
[tune]
clauses = "all"
[tune.free]
"controller.front_brake.ki" = { low = 5e3, high = 3e5 }
"controller.rear_brake.ki" = { low = 5e3, high = 3e5 }
[tune.objective]
peak = 1.0
[objective.peak]
type = "peak-output"
output = "deceleration"
[solver]
type = "adaptive"
rtol = 1e-6
duration = 10.0
"""


def figures(values, limit, at_least):
    return Figures("5.2.1", "a rule", jnp.asarray([values]), limit, "1", at_least, tuple(range(len(values))))


@killed_by("assess.bounds", "row.limit - row.values if row.at_least", "row.values - row.limit if row.at_least")
@killed_by("assess.bounds", "jnp.nan, beyond / scale", "-1.0, beyond / scale")
def test_an_excess_is_relative_to_its_limit_and_unknown_without_an_end():
    ended = jnp.array([[False, False, False]])
    np.testing.assert_allclose(find_excess(figures([0.6, 0.75, 0.9], 0.75, True), ended), [0.2, 0.0, -0.2], atol=1e-15)
    np.testing.assert_allclose(find_excess(figures([0.3, 0.1, 0.0], 0.1, False), ended), [2.0, 0.0, -1.0], atol=1e-15)
    np.testing.assert_allclose(find_excess(figures([0.3, 0.1, 0.0], 0.0, False), ended), [0.3, 0.1, 0.0])
    lost = find_excess(figures([0.6, 0.9, 0.9], 0.75, True), jnp.array([[False, True, False]]))
    np.testing.assert_array_equal(np.isnan(lost), [False, True, False])


def clause(figure, met, diverged=0):
    return Clause("5.2.1", "adhesion", figure, 0.75, "1", True, "low, 55 km/h", True, np.array([met]), diverged)


@killed_by("scenario.tuning", 'clause.verdict == "undecided"', 'clause.verdict == "never"')
def test_an_undecided_clause_does_not_count_as_met():
    """The worst figure of the other stops is above the limit: the clause is undecided, and nothing is known of it."""
    row = describe_clause(clause(0.6, met=False), clause(0.9, met=False, diverged=1))
    assert (row["name"], row["before"], row["met"], row["missed"]) == ("5.2.1 adhesion (at least)", 0.6, False, None)
    assert np.isnan(row["after"])
    assert describe_clause(clause(0.6, met=False), clause(0.8, met=True))["met"]
    assert describe_clause(clause(0.8, met=True), clause(0.6, met=False))["missed"] == pytest.approx(0.15)


@pytest.mark.parametrize(
    ("judged", "line"),
    [
        (clause(0.9, met=False, diverged=2), "5.2.1 has no derivative at the start: 2 runs diverge or do not reach 15"),
        (
            clause(np.inf, met=False),
            "5.2.1 has no derivative at the start: the adhesion is not finite, in low, 55 km/h",
        ),
    ],
)
def test_a_start_must_decide_every_clause(monkeypatch, judged, line):
    monkeypatch.setattr(ClauseBounds, "judge", lambda self, loop: (judged,))
    with pytest.raises(ScenarioError, match=r"tune\.clauses: ") as error:
        build_clause_bounds(loads(SLUGGISH.encode(), "sluggish", "sluggish"))
    assert line in str(error.value)


def test_all_clauses_are_those_of_the_plant():
    half = loads(SLUGGISH.encode(), "sluggish", "sluggish")
    assert half.tune.clauses == ("5.2.1", "5.3.1", "5.3.2", "5.3.3")
    assert loads(dump(half).encode(), "sluggish", "again").tune.clauses == half.tune.clauses
    assert load("car-straight", ["tune.clauses=all"]).tune.clauses == (*half.tune.clauses, "5.3.4", "5.3.7")
    assert load("half-car", ["tune.clauses=['5.3.2']"]).tune.clauses == ("5.3.2",)
    assert load("half-car").tune.clauses == ()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["half-car", "--set", "tune.clauses=every"],
            'tune.clauses = "every" is text; "all" or a list of 5.2.1, 5.3.1',
        ),
        (["half-car", "--set", "tune.clauses=['5.3.4']"], 'tune.clauses.0 = "5.3.4" is unknown; '),
        (["half-car", "--set", "tune.clauses=3"], 'tune.clauses = 3 is a number; "all" or a list of 5.2.1'),
        (["half-car", "--set", "tune.clauses=false"], 'tune.clauses = false is a boolean; "all" or a list of 5.2.1'),
        (["lab-rig", "--set", "tune.clauses=all"], "tune.clauses: LabRig has no tyres with roads; the plants half-car"),
    ],
)
def test_clauses_that_do_not_exist_are_refused_in_a_line(words, line):
    result = run("tune", *words, status=2)
    assert_one_error_line(result)
    assert line in result.stderr


@pytest.mark.slow
def test_excesses_have_the_slopes_of_differences():
    """Adhesion used and time locked under a constant torque that locks the wheels, by torque and height of the car."""
    loop = load("half-car", [f"controller.{axle}_brake=constant-torque" for axle in ("front", "rear")]).loop
    bounds = ClauseBounds(("5.2.1", "5.3.1", "5.3.2"), d.Adaptive(1e-9, 60.0), StopProgram(load=200.0))
    paths = ("controller.front_brake.torque", "plant.height")
    loop = replace(loop, {"controller.rear_brake.torque": 900.0})

    def excesses(values):
        return bounds.excess(replace(loop, dict(zip(paths, values, strict=True))), {})

    x = np.array([4000.0, 0.55])
    slopes, values = np.asarray(jax.jit(jax.jacfwd(excesses))(jnp.asarray(x))), jax.jit(excesses)
    assert np.asarray(values(jnp.asarray(x))).max() > 1.0  # wheels are locked
    for width in (1e-3, 3e-4, 1e-4):
        for i, step in enumerate(np.diag(width * x)):
            far, near, close, distant = (np.asarray(values(jnp.asarray(x + n * step))) for n in (-2, -1, 1, 2))
            difference = (8 * (close - near) - (distant - far)) / (12 * step[i])
            np.testing.assert_allclose(slopes[:, i], difference, rtol=1e-4, atol=1e-5 * np.abs(difference).max())


@pytest.mark.slow
def test_sluggish_gains_are_tuned_until_all_clauses_hold(tmp_path):
    """The least peak of the deceleration that the clauses allow: two of them end at their limits, and all hold."""
    source, target = tmp_path / "sluggish.toml", tmp_path / "tuned.toml"
    source.write_text(SLUGGISH)
    before = assess(load(source).loop, load(source).solver, StopProgram(load=300.0))
    assert before.passed == 0
    result = json.loads(run("tune", source, "--json", "--out", target).stdout)
    assert result["met"] is True
    rows = {row["name"].partition(" ")[0]: row for row in result["constraints"]}
    assert rows["5.2.1"]["before"] == pytest.approx(before.clauses[0].figure, rel=1e-6)
    assert rows["5.2.1"]["after"] == pytest.approx(0.75, rel=0.01)
    assert rows["5.3.3"]["after"] == pytest.approx(1.0, rel=0.01)
    tuned = load(target)
    assert tuned.assess.load == 300.0
    assert assess(tuned.loop, tuned.solver, tuned.assess).passed == 1
