"""Proofs over all frequencies and a box, from the loop to the file: prove and save; `proofs.verify` checks the file.

proof = prove_frequency(loop, {"plant.mass": (5.3, 6.2)}, [FrequencyClaim(1.7)])
proof.save("sensitivity.proof")
"""

import dataclasses
import math
import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from diffabs.core.pytree import get, replace
from diffabs.core.types import JsonObject
from diffabs.engine.solvers import FixedStep
from diffabs.host import documents, files
from diffabs.loop.closed_loop import Loop
from diffabs.parts.objectives import default_objectives
from diffabs.robust.frequency.certificate import frequency_document, read_frequency_file, verify_frequency
from diffabs.robust.frequency.opened import derive_opened
from diffabs.robust.frequency.sensitivity import (
    FrequencyClaim,
    Place,
    SensitivityProof,
    check_frequency_claim,
    prove_claim,
)
from diffabs.robust.reach.cover import check_box
from diffabs.robust.reach.verification import FileVerdict
from diffabs.scenario.parameter_paths import parameters_of
from diffabs.scenario.robustness import ScenarioMargins
from diffabs.scenario.scenario import Scenario, dump, loads


@dataclasses.dataclass(frozen=True, eq=False)
class FrequencyProof:
    """What is proved of claims about a loop over a box.

    Attributes:
        loop: Loop.
        over: Range (low, high) of each parameter, by path, in SI units.
        target: Setpoint; None for the loop's own.
        proofs: Proof of each claim.
    """

    loop: Loop
    over: Mapping[str, tuple[float, float]]
    target: float | None
    proofs: tuple[SensitivityProof, ...]

    @property
    def verdict(self) -> str:
        """The verdict: refuted if a claim is, proved if all are, else undecided."""
        verdicts = {proof.verdict for proof in self.proofs}
        return "refuted" if "refuted" in verdicts else "proved" if verdicts == {"proved"} else "undecided"

    @property
    def reason(self) -> str:
        """Why a claim is not proved; empty if all are."""
        return "; ".join(f"{proof.claim}: {proof.reason}" for proof in self.proofs if proof.reason)

    def record(self) -> JsonObject:
        """Return verdicts and figures as JSON values, in SI."""
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "over": {path: list(ends) for path, ends in self.over.items()},
            "target": self.target,
            "claims": [
                {
                    "claim": str(proof.claim),
                    "verdict": proof.verdict,
                    "reason": proof.reason,
                    "worst": self._describe_place(proof.worst),
                    "witness": self._describe_place(proof.witness),
                    "cells": proof.cells,
                    "tried": proof.tried,
                    "seconds": proof.seconds,
                }
                for proof in self.proofs
            ],
        }

    def _describe_place(self, place: Place | None) -> JsonObject | None:
        if place is None:
            return None
        values = dict(zip(self.over, place.params, strict=True))
        return {"sensitivity": place.sensitivity, "frequency": place.frequency, "added_delay": place.added, **values}

    def save(self, path: str | os.PathLike[str], scenario: Scenario | None = None) -> None:
        """Write the file from which `verify` proves the claims again, complete or not at all.

        Args:
            path: File to write.
            scenario: Scenario of the loop, for its name and its other sections; by default one of the loop alone.
        """
        if scenario is None:
            solver, measured = FixedStep(), default_objectives(self.loop.plant)
            scenario = Scenario("loop", loop=self.loop, solver=solver, objectives=measured)
        document = frequency_document(self.proofs, dump(scenario), self.over, self.target)
        files.write_file(pathlib.Path(path), f"{documents.format_document(document, None)}\n".encode())


def prove_frequency(
    loop: Loop,
    over: Mapping[str, tuple[float, float]],
    claims: Sequence[FrequencyClaim],
    *,
    target: float | None = None,
    budget: float = 60.0,
    progress: Callable[[str], None] = lambda line: None,
) -> FrequencyProof:
    """Return what can be proved of claims about a loop over a box and all frequencies.

    Args:
        loop: Loop; a sampled one has one control.
        over: Range (low, high) of each parameter of the box, by path, in SI units.
        claims: Statements to decide.
        target: Setpoint; None for the loop's own.
        budget: Computing time for each claim [s].
        progress: Called with a line about how far a proof is.

    Raises:
        ValueError: A number is out of its range, or the loop has no linear model at the middle of the box.
        NoRule: A part, an operation or a parameter of the loop has no sound rule.

    See also:
        `robust.frequency.prove_sensitivity`: One proof, with the method and an example.
    """
    for claim in claims:
        check_frequency_claim(claim)
    check_box(over)
    equations = derive_opened(loop, dict(over), target)
    proofs = [prove_claim(equations, over, claim, budget=budget, progress=progress) for claim in claims]
    return FrequencyProof(loop, over, target, tuple(proofs))


class ProvedMargins(NamedTuple):
    """Bounds of a loop's margins that a file proves for a box.

    Attributes:
        sensitivity: Bound of |S| over all frequencies; infinity without one.
        delay: Added delay that keeps the loop stable [s]; 0 without one.
        over: Range (low, high) of each parameter of the box, by path, in SI units.
    """

    sensitivity: float
    delay: float
    over: Mapping[str, tuple[float, float]]

    def bounds(self) -> dict[str, float]:
        """Return the bounds by the name of the margin, without those that the file does not state."""
        peak = (
            {} if math.isinf(self.sensitivity) else {"modulus": 1 / self.sensitivity, "sensitivity": self.sensitivity}
        )
        return peak | ({"delay": self.delay} if self.delay else {})


def read_proved_margins(
    path: str | os.PathLike[str], margins: ScenarioMargins, loop: Loop, progress: Callable[[str], None]
) -> ProvedMargins:
    """Return what a file proves about examined loops; its proof is checked in full before.

    Args:
        path: File of `FrequencyProof.save`.
        margins: Margins of the loop at its values, and over ranges.
        loop: The loop at these values.
        progress: Called with a line about how far the check is.

    Raises:
        ValueError: The file is none, is not proved, or is about another loop or another box.
        ModuleNotFoundError: python-flint is not installed.
    """
    from diffabs.scenario.proofs import FREQUENCY_PROOF, read_proof_document

    document = read_proof_document(path, (FREQUENCY_PROOF,))
    if document is None:
        raise ValueError("no proof over all frequencies, as certify --sensitivity --out writes it")
    file = read_frequency_file(document)
    verdict, scenario, _ = verify_frequency_document(document, pathlib.Path(path).stem, 1.0, progress)
    if verdict.reason:
        raise ValueError(f"not proved: {verdict.reason}")
    if file.target != margins.target or not _equal_outside(loop, scenario.loop, file.over):
        raise ValueError("it is about another loop; certify this one")
    for name, (low, high) in file.over.items():
        value = float(np.asarray(get(loop, name)))
        lowest, highest = (pick([value, *margins.over.get(name, ())]) for pick in (min, max))
        if not low <= lowest <= highest <= high:
            unit = parameters_of(loop)[name][0].unit
            unit = "" if unit == "1" else f" {unit}"
            where = f"{name} in [{low:g}, {high:g}]{unit}"
            raise ValueError(f"it is about {where}, and the margins are of {lowest:g} to {highest:g}{unit}")
    if outside := sorted(set(margins.over) - set(file.over)):
        raise ValueError(f"it is about one value of {', '.join(outside)}, and the margins are of a range")
    claims = [claim for claim, _ in file.claims]
    return ProvedMargins(min(claim.bound for claim in claims), max(claim.added for claim in claims), file.over)


def _equal_outside(loop: Loop, other: Loop, over: Mapping[str, tuple[float, float]]) -> bool:
    """Return whether two loops are equal but for some parameters."""
    try:
        values = {path: np.full(np.shape(get(loop, path)), low) for path, (low, _) in over.items()}
        loops = [jax.tree.flatten(replace(part, values)) for part in (loop, other)]
    except ValueError:  # a parameter that the loop does not have
        return False
    (leaves, structure), (others, other_structure) = loops
    return structure == other_structure and all(
        np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=1e-12, atol=0.0, equal_nan=True)
        for a, b in zip(leaves, others, strict=True)
    )


def verify_frequency_document(
    document: JsonObject, name: str, share: float, progress: Callable[[str], None]
) -> tuple[FileVerdict, Scenario, str]:
    """Return the findings about a file's document, its scenario and the text of that."""
    text = document.get("scenario")
    if not isinstance(text, str):
        raise ValueError("scenario is missing or no text; the TOML text of a scenario is needed")
    scenario = loads(text.encode(), name, "scenario", integrated=False)
    return verify_frequency(scenario.loop, document, share, progress), scenario, text
