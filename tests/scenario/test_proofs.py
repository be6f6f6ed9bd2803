"""A proof over a box from the loop to the file and back."""

import json
import pathlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs.host.documents import DocumentError
from diffabs.robust.design import Polytope, certify
from diffabs.robust.reach import RunClaim
from diffabs.robust.reach.extremes import ExtremeRuns
from diffabs.scenario.proofs import Proof, prove_box, read_proof_document, verify
from diffabs.scenario.scenario import load, loads

pytestmark = pytest.mark.usefixtures("native_prover")
LIMITED = ["controller.low=0", "controller.high=9.03", "solver.duration=3"]
OVER = {"plant.mass": (5.3, 5.301), "initial.speed": (2.8, 2.8001)}


@pytest.fixture(scope="module")
def proof(native_prover: None) -> Proof:
    del native_prover
    scenario = load("slip-lmi", LIMITED)
    return prove_box(scenario.loop, scenario.solver, OVER, [RunClaim("greatest slip", 0.999)], budget=100.0)


def test_a_proof_lies_beside_the_extreme_runs(proof: Proof) -> None:
    assert proof.verdict == "proved"
    for name, (least, greatest) in proof.extremes.ranges.items():
        low, high = proof.bounds[name]
        assert low <= least <= greatest <= high
    assert proof.bounds["greatest slip"][1] <= 0.999


@killed_by("scenario.proofs", "extremes=extremes.ranges, suspects", "suspects")
def test_a_run_outside_of_its_bounds_is_no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only an error of the prover, here an invented run, leads there."""
    runs = ExtremeRuns({"greatest slip": (0.0, 0.3)}, {"greatest slip": [5.3, 2.8]})
    monkeypatch.setattr("diffabs.scenario.proofs.find_extreme_runs", lambda *_: runs)
    scenario = load("slip-lmi", LIMITED)
    proof = prove_box(scenario.loop, scenario.solver, OVER, [RunClaim("greatest slip", 0.999)], budget=100.0)
    assert proof.verdict == "undecided"
    assert "a simulated run has greatest slip = 0, beyond the bound" in proof.reason


@killed_by("scenario.proofs", "loop=self.loop, solver=self.solver", "solver=self.solver")
@killed_by("scenario.proofs", "loop=self.loop, solver=self.solver", "loop=self.loop")
def test_a_saved_proof_has_its_loop(proof: Proof, tmp_path: pathlib.Path) -> None:
    proof.save(tmp_path / "p.json")
    document = read_proof_document(tmp_path / "p.json")
    assert document is not None
    scenario = loads(document["scenario"].encode(), "p", "p")
    assert scenario.solver == proof.solver
    np.testing.assert_array_equal(scenario.loop.controller.high, 9.03)


@pytest.mark.slow
def test_a_saved_proof_is_verified(proof: Proof, tmp_path: pathlib.Path) -> None:
    pytest.importorskip("flint")
    proof.save(tmp_path / "p.json")
    verification = verify(tmp_path / "p.json", share=1e-6)
    assert verification.proved
    assert verification.over == {path: pytest.approx(ends) for path, ends in OVER.items()}
    assert "greatest slip <= 0.999" in [claim.kind for claim in verification.claims]


@killed_by("scenario.proofs", "    except documents.DocumentError:\n        raise\n", "")
def test_a_proof_of_a_later_release_is_named(tmp_path: pathlib.Path) -> None:
    (tmp_path / "p.json").write_text(json.dumps({"format": "diffabs box proof 2"}))
    with pytest.raises(DocumentError, match='"diffabs box proof 2" was written by a newer diffabs'):
        verify(tmp_path / "p.json")


@killed_by("scenario.proofs", 'if kind not in ("", *kinds):', "if False:")
@pytest.mark.parametrize("kind", ["box proofs", "tune"])
def test_a_document_of_another_kind_is_no_proof(kind: str, tmp_path: pathlib.Path) -> None:
    (tmp_path / "p.json").write_text(json.dumps({"format": f"diffabs {kind} 1", "verdict": "proved"}))
    needed = f'^format = "diffabs {kind} 1" is no proof; "diffabs box proof 1" or "diffabs certificate" is needed$'
    with pytest.raises(DocumentError, match=needed):
        verify(tmp_path / "p.json")


@killed_by("scenario.proofs", 'reason if verdicts else "the file has no claims"', "reason")
def test_a_certificate_is_verified_by_the_same_function(tmp_path: pathlib.Path) -> None:
    box = Polytope(A=[[[0.0, 1.0], [0.0, -1.0]]], B=[[[0.0], [1.0]]])
    certificate = certify((1.0, -1.0), box)
    certificate.save(tmp_path / "c.json")
    verification = verify(tmp_path / "c.json")
    assert (verification.proved, verification.complete, verification.scenario) == (True, True, None)
    assert [claim.kind for claim in verification.claims] == [claim.kind for claim in certificate.claims]
    empty = {**json.loads((tmp_path / "c.json").read_text()), "claims": []}
    (tmp_path / "c.json").write_text(json.dumps(empty))
    assert verify(tmp_path / "c.json").reason == "the file has no claims"


@killed_by("scenario.proofs", "    derive_equations(loop, over)  # may refuse", "    # may refuse")
def test_a_noisy_loop_is_refused_before_it_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffabs.scenario.proofs.find_extreme_runs", lambda *_: pytest.fail("simulated"))
    scenario = load("slip-lmi", ["sensor=noise"])
    with pytest.raises(ValueError, match="noisy sensor"):
        d.prove_box(scenario.loop, scenario.solver, OVER)


@killed_by("scenario.proofs", "if not (claims or signals):", "if False:")
def test_a_plant_without_slip_needs_a_claim(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffabs.scenario.proofs.find_extreme_runs", lambda *_: pytest.fail("simulated"))
    scenario = load("arm-hanging")
    with pytest.raises(ValueError, match="a claim is needed: the plant has no slip; it has theta"):
        d.prove_box(scenario.loop, scenario.solver, {"plant.body_mass": (30.0, 31.0)})


def invent_proof(**values: Any) -> Proof:
    """Return a proof whose cover has these values, over masses of 5 to 6 kg."""
    scenario, empty = load("slip-lmi", integrated=False), np.zeros((0, 1, 2))
    cover: Any = SimpleNamespace(
        **{"bounds": {}, "undecided": empty, "cells": empty, "refuting": None, "verdict": "proved"}
        | {"tried": 1, "seconds": 0.0, "failure": ""}
        | values
    )
    extremes = ExtremeRuns({"greatest slip": (0.0, values.get("worst", 0.0))}, {})
    return Proof(scenario.loop, scenario.solver, {"plant.mass": (5.0, 6.0)}, (), extremes, cover)


@killed_by("scenario.proofs", "if worst and math.isfinite(high)", "if math.isfinite(high)")
@killed_by("scenario.proofs", "(high - worst) / worst", "(high - worst) / high")
def test_a_bound_around_zero_has_no_relative_looseness() -> None:
    bounds = {"greatest slip": (0.0, 0.01), "stop_time": (1.0, np.inf)}
    rows = [invent_proof(bounds=bounds, worst=worst).record()["bounds"] for worst in (0.0, 0.008)]
    assert [row["greatest slip"]["looseness"] for row in rows] == [None, pytest.approx(0.25)]
    assert rows[0]["stop_time"] == {"low": 1.0, "high": None, "unit": "s"}


@killed_by("scenario.proofs", "if low == high else", "if True else")
@killed_by("scenario.proofs", 'f" ({cover.failure})" if cover.failure else ""', '""')
def test_a_proof_says_why_it_is_none() -> None:
    refuted = invent_proof(verdict="refuted", refuting=np.array([[5.5, 5.75]]))
    assert refuted.record()["reason"] == "every run violates the claim where plant.mass in [5.5, 5.75]"
    assert refuted.record()["refuted_by"] == {"plant.mass": [5.5, 5.75]}
    left = invent_proof(verdict="undecided", undecided=np.array([[[5.0, 5.25]]]), failure="no bound")
    assert left.reason == "25 % of the box is left in one cell (no bound)"
    assert (invent_proof().reason, invent_proof().share_left) == ("", 0.0)
