"""The file of a proof over a box: cells, bounds, claims and the scenario, from which a checker proves it again."""

import math
from collections.abc import Mapping, Sequence

from diffabs.core.types import JsonObject
from diffabs.reach.cover import BoxProof, RunClaim
from diffabs.runtime import provenance

FORMAT = "diffabs box proof 1"


def proved_ends(quantity: str) -> tuple[bool, bool]:
    """Return whether a file states a low and a high end of a quantity: the ends that the checker can prove.

    Args:
        quantity: `greatest NAME` or `least NAME` of a signal, `stop_time` or `stop_distance`.

    Raises:
        ValueError: No proof bounds such a quantity.
    """
    word, _, name = quantity.partition(" ")
    if name and word in ("greatest", "least"):
        return word == "least", word == "greatest"
    if quantity in ("stop_time", "stop_distance"):
        return True, True
    raise ValueError(f"bounds: no proof bounds {quantity!r}")


def certificate_document(
    proof: BoxProof, scenario: str, over: Mapping[str, tuple[float, float]], claims: Sequence[RunClaim]
) -> JsonObject:
    """Return the JSON document of a proof's file; an end that nothing is proved of is null.

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
        "horizon": proof.prover.horizon,
        "bounds": {
            name: [x if known and math.isfinite(x) else None for x, known in zip(ends, proved_ends(name), strict=True)]
            for name, ends in proof.bounds.items()
        },
        "cells": proof.cells.tolist(),
        "versions": provenance.versions("numpy"),
    }
