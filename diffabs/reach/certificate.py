"""The file of a proof over a box: cells, bounds, claims and the scenario, from which a checker proves it again."""

import math
from collections.abc import Mapping, Sequence

from diffabs.core.types import JsonObject
from diffabs.reach.cover import BoxProof, RunClaim
from diffabs.runtime import provenance

FORMAT = "diffabs box proof 1"


def certificate_document(
    proof: BoxProof, scenario: str, over: Mapping[str, tuple[float, float]], claims: Sequence[RunClaim]
) -> JsonObject:
    """Return the JSON document of a proof's file.

    Args:
        proof: Proof over the box.
        scenario: TOML text of the scenario.
        over: Range of each parameter of the box, by path.
        claims: Claims of the proof.
    """
    return {
        "format": FORMAT,
        "verdict": proof.verdict,
        "scenario": scenario,
        "over": {path: list(ends) for path, ends in over.items()},
        "claims": [claim._asdict() for claim in claims],
        "signals": list(proof.prover.signals),
        "horizon": proof.prover.horizon,
        "bounds": {name: [x if math.isfinite(x) else None for x in ends] for name, ends in proof.bounds.items()},
        "cells": proof.cells.tolist(),
        "versions": provenance.versions("numpy"),
    }
