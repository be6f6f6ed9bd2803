"""The command `prove`: the yardstick of the ARCH competition from a user's own plant, and roads and controllers."""

import json
import pathlib
import re
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import pytest
from commands import run
from marks import cases
from mutants import killed_by
from scipy.linalg import expm
from seams import replace_seam

from diffabs.cli.show import show_verification
from diffabs.cli.show_proofs import show_box_proof
from diffabs.robust.reach.claims import overshoot_claim
from diffabs.robust.reach.equations import derive_equations
from diffabs.robust.reach.extremes import ExtremeRuns
from diffabs.scenario.outside import lend_modules
from diffabs.scenario.parameter_paths import read_box
from diffabs.scenario.scenario import load

pytestmark = pytest.mark.usefixtures("native_prover", "any_step_is_stable")
EXAMPLES = pathlib.Path(__file__).parents[2] / "examples"
EXACT_POSITION = 0.0489094684039968  # [m] after 0.1 s; `exact_position` by mpmath in 30 digits


@pytest.fixture
def brake() -> Iterator[list[str | pathlib.Path]]:
    """The words of a proof about the electro-mechanical brake, a user's own plant."""
    with lend_modules(EXAMPLES, ["embrake"]):
        yield ["prove", EXAMPLES / "embrake.toml", "--over", "reference.value=0.05:0.05", "--json"]


def exact_position(samples: int) -> float:
    """The pads' position [m] after this many samples of 0.1 ms, by the matrix exponential of a held voltage."""
    inductance, resistance, constant, friction, gear, period = 1e-3, 0.5, 0.02, 0.1, 113.1167, 1e-4
    rates = [[0, constant / (gear * friction), 0],
             [0, -(resistance + constant**2 / friction) / inductance, 1 / inductance],
             [0, 0, 0]]  # fmt: skip
    held = expm(period * np.array(rates))
    position = current = total = 0.0
    for _ in range(samples):
        error = 0.05 - position
        position, current, _ = held @ (position, current, 10000.1 * error + 1000.0 * total)
        total += period * error
    return position


@pytest.mark.slow
def test_the_page_has_the_position_of_the_brake_after_its_whole_run() -> None:
    """The benchmark's first sample is at 0.1 ms, so its printed position after 0.1 s is that of 999 samples."""
    assert exact_position(999) == pytest.approx(0.048904787821800, rel=1e-12)  # printed there
    assert exact_position(1000) == pytest.approx(EXACT_POSITION, rel=1e-12)
    with lend_modules(EXAMPLES, ["embrake"]):
        found = json.loads(run("simulate", EXAMPLES / "embrake.toml", "--json").stdout)
    # RK4 with steps of 10 us: h^5/120 of a rate of 504 1/s over 1e4 steps
    assert 0.05 - found["metrics"]["final_error"] == pytest.approx(EXACT_POSITION, rel=1e-10)
    page = (EXAMPLES.parent / "docs" / "proofs.md").read_text(encoding="utf-8")
    assert f"position at most 0.04891 m in 0.1 s | {EXACT_POSITION:.7f} m |" in page


@pytest.mark.slow
def test_the_electro_mechanical_brake_stays_below_its_target(brake: list[str | pathlib.Path]) -> None:
    found = json.loads(run(*brake, "--claim", "max_position=0.05").stdout)
    assert found["verdict"] == "proved"
    greatest = found["bounds"]["greatest position"]
    assert greatest["low"] <= EXACT_POSITION <= greatest["high"] < EXACT_POSITION * 1.001


def test_a_false_claim_about_the_brake_is_refuted(brake: list[str | pathlib.Path]) -> None:
    result = run(*brake, "--claim", f"max_position={EXACT_POSITION * 0.999}", status=1)
    found = json.loads(result.stdout)
    assert found["verdict"] == "refuted"
    assert result.stderr.splitlines()[-1] == f"verdict: embrake: refuted: {found['reason']}"
    assert found["refuted_by"] is not None


@pytest.mark.slow
@killed_by("robust.reach.claims", "rounding = SLIP_ROUNDING *", "rounding = 0.0 *")
def test_a_bound_of_the_overshoot_is_never_rounded_up() -> None:
    """At a target of 0.2, some of these products are rounded up."""
    shares = [f"0.{i}" for i in range(83, 99)]
    claims = [word for share in shares for word in ("--claim", f"overshoot={share}")]
    limits = [word for change in ("low=0", "high=9.03") for word in ("--set", f"controller.{change}")]
    found = json.loads(run("prove", "slip-lmi", *limits, "--over", "plant.mass=5.5:5.5", *claims, "--json").stdout)
    assert found["verdict"] == "proved"
    for share, claim in zip(shares, found["claims"], strict=True):
        exact = (1 + Fraction(share)) * Fraction("0.2")
        assert exact * (1 - Fraction(1, 10**14)) < Fraction(claim["bound"]) <= exact


@pytest.fixture
def without_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A proof without the runs of its box, whose program compiles for seconds."""
    replace_seam(monkeypatch, "find_extreme_runs", lambda *_: ExtremeRuns({}, {}))


LIMITED = [word for change in ("low=0", "high=9.03") for word in ("--set", f"controller.{change}")]


@killed_by("robust.reach.claims", 'if operation.name == "const"', "if operation.value is not None")
def test_an_overshoot_needs_one_target_for_all_runs() -> None:
    """With a target of 0.149 the slip of one run is 73 % above it, which is 72 % above 0.15."""
    over = ("--over", "reference.slip=0.149:0.15", "--claim", "overshoot=0.725")
    assert (
        "needs one start slip and one target for all runs" in run("prove", "slip-lmi", *LIMITED, *over, status=2).stderr
    )


# The first slip, the target, and the bound of the slip: 1 % of the step beyond the target, up or down.
STEPS = [
    (0.3, 0.2, "least slip", 0.199),
    (0.0, 0.004, "greatest slip", 0.00404),
    (0.05, 0.2, "greatest slip", 0.2015),
]


@killed_by("robust.reach.claims", "bound * step\n", "bound * setpoint\n")
@pytest.mark.parametrize(("first", "target", "quantity", "bound"), STEPS)
def test_an_overshoot_is_that_of_the_step(first, target, quantity, bound) -> None:
    loop = load("slip-lmi", [f"reference.slip={target}", f"initial.slip={first}"], integrated=False).loop
    claim = overshoot_claim(0.01, derive_equations(loop, {"plant.mass": (5.5, 5.5)}))
    assert (claim.quantity, claim.bound) == (quantity, pytest.approx(bound, rel=1e-12))


@pytest.mark.slow
@pytest.mark.parametrize(("first", "target", "quantity", "bound"), STEPS)
@pytest.mark.usefixtures("without_runs")
def test_a_proof_has_the_bound_of_an_overshoot(first, target, quantity, bound) -> None:
    changes = ("--set", f"reference.slip={target}", "--set", f"initial.slip={first}", "--budget", "1")
    words = (*changes, "--over", "plant.mass=5.5:5.5", "--claim", "overshoot=0.01", "--json")
    (claim,) = json.loads(run("prove", "slip-lmi", *LIMITED, *words, status=1).stdout)["claims"]
    assert (claim["quantity"], claim["bound"]) == (quantity, pytest.approx(bound, rel=1e-12))


def test_an_overshoot_without_a_step_cannot_be_claimed() -> None:
    words = ("--set", "initial.slip=0.2", "--over", "plant.mass=5.5:5.5", "--claim", "overshoot=0.01")
    assert "the runs start on their target" in run("prove", "slip-lmi", *LIMITED, *words, status=2).stderr


@pytest.mark.slow
@pytest.mark.parametrize("road", cases(["burckhardt", "magic-formula"], "magic-formula"))
def test_a_pid_quarter_car_on_other_roads(road: str, file) -> None:
    scenario = file(f'[plant]\ntype = "quarter-car"\n[road]\ntype = "{road}"\n[solver]\nduration = 6.0\nstep = 1e-4\n')
    words = ["prove", scenario, "--over", "plant.mass=15:15.1", "--claim", "no_lock", "--json"]
    found = json.loads(run(*words).stdout)
    assert found["verdict"] == "proved"
    assert found["bounds"]["greatest slip"]["high"] < 0.2
    for name in ("stop_time", "stop_distance"):
        low, high = (found["bounds"][name][end] for end in ("low", "high"))
        assert 0 < high - low < 2e-3 * high


@pytest.mark.slow
def test_the_command_of_the_readme_proves_the_cured_loop() -> None:
    readme = (EXAMPLES.parent / "README.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"`diffabs (prove [^`]*)`", readme)
    found = json.loads(run(*command.split(), "--json").stdout)
    assert found["verdict"] == "proved"
    assert found["bounds"]["greatest slip"]["high"] <= 0.2017


def test_the_table_of_a_proof_has_units_and_no_negative_zero(capsys: pytest.CaptureFixture[str]) -> None:
    proof = {
        "verdict": "proved",
        "over": {"initial.speed": [5.0, 10.0], "reference.slip": [0.1, 0.2]},
        "bounds": {"least slip": {"low": -0.0, "high": None, "unit": "1"}},
        "claims": [],
        "cells": 1,
        "tried": 1,
        "seconds": 0.0,
    }
    show_box_proof(proof, load("slip-lmi", integrated=False))
    shown = capsys.readouterr().out
    assert "proved for every initial.speed 5 to 10 m/s, reference.slip 0.1 to 0.2\n" in shown
    assert "-0" not in shown


@killed_by("scenario.parameter_paths", "low and math.nextafter", "math.nextafter")
def test_a_single_value_zero_is_not_widened() -> None:
    (side,) = read_box({"initial.slip": "0:0"}, "--over", load("slip-lmi", integrated=False).loop)
    assert side.ends == (0.0, 0.0)


@pytest.mark.slow
@pytest.mark.usefixtures("without_runs")
def test_a_proof_of_a_single_value_zero_says_zero() -> None:
    words = ("--over", "plant.mass=5.5:5.5", "--over", "initial.slip=0:0", "--budget", "1")
    found = json.loads(run("prove", "slip-lmi", *LIMITED, *words, "--claim", "no_lock", "--json", status=1).stdout)
    assert found["over"]["initial.slip"] == [0.0, 0.0]


@killed_by("cli.show", 'if result.get("complete", True) else', "if True else")
@pytest.mark.parametrize(
    ("proved", "complete", "word"),
    [(True, True, "proved  "), (True, False, "not refuted  "), (False, False, "NOT PROVED  ")],
)
def test_a_sample_of_the_cells_proves_nothing(
    proved: bool, complete: bool, word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    claim = {"kind": "greatest slip <= 0.3", "says": "1 of 2 cells proved again", "proved": proved}
    show_verification({"claims": [claim], "complete": complete}, json_wanted=False)
    assert capsys.readouterr().out.startswith(word)
