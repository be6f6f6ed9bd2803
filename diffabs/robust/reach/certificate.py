"""The file of a proof over a box: cells, bounds, claims and the scenario, from which a checker proves it again."""

import math
from collections.abc import Mapping, Sequence

from diffabs.core.types import JsonObject
from diffabs.host import provenance
from diffabs.robust.reach.cover import BoxProof, RunClaim
from diffabs.robust.reach.tail import RunTail

FORMAT = "diffabs box proof 1"
SLACK = 1e-3  # of a bound, which the file adds: the checker has other steps, and bounds that are slightly wider


def proved_ends(quantity: str) -> tuple[bool, bool]:
    """Return whether a file states a low and a high end of a quantity: the ends that the checker can prove.

    The quantities are `greatest NAME` and `least NAME` of a signal, `stop_time` and `stop_distance`.
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
        "bounds": {name: _stated_ends(name, ends, claims) for name, ends in proof.bounds.items()},
        "cells": proof.cells.tolist(),
        "tail": None if proof.tail is None else tail_document(proof.tail),
        "versions": provenance.versions("numpy"),
    }


def tail_document(tail: RunTail) -> JsonObject:
    """Return the JSON object of a tail, the settled states in which cells may end."""
    return {**tail._asdict(), "pieces": [piece._asdict() for piece in tail.pieces]}


def _stated_ends(name: str, ends: tuple[float, float], claims: Sequence[RunClaim]) -> list[float | None]:
    """Return the ends of a bound that a file states: wider by SLACK, but not beyond a claim that holds."""
    low, high = ends
    low, high = low - SLACK * abs(low), high + SLACK * abs(high)
    for claim in claims:
        if claim.quantity == name and name.startswith("least"):
            low = max(low, min(claim.bound, ends[0]))
        elif claim.quantity == name:
            high = min(high, max(claim.bound, ends[1]))
    stated = zip((low, high), proved_ends(name), strict=True)
    return [x if provable and math.isfinite(x) else None for x, provable in stated]
