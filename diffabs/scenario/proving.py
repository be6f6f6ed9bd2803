"""Proofs about a scenario's gain over the ranges of [design.over], as values of a JSON document.

Everything here needs the extra `design`, whose modules are imported only when a function runs.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diffabs.core.channels import need_single_control
from diffabs.core.pytree import parameters
from diffabs.core.types import JsonObject
from diffabs.host.separated import read_decimal
from diffabs.host.values import ScenarioError, format_given
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.robust.design import Certificate
    from diffabs.robust.design.findings import FurtherFindings
    from diffabs.robust.design.loop_task import ProofTask

# Keys of the JSON document; without a certificate most are null.
FROM_PROOF = ("quadratically_stable", "stable", "verified_exactly", "decay_rate", "damping", "trace_cost",
              "guaranteed_cost", "worst_vertex", "margins", "claims")  # fmt: skip
FROM_DESIGN = ("lower_bound", "gap", "residual")
BOUND_ROUNDING = 1e-9  # relative; rounding of a decay rate that is proved as a factor per period is smaller


class Proved(NamedTuple):
    """The outcome of an attempt to prove something about a scenario's loop.

    Attributes:
        document: JSON values of the certificate. Without a certificate they are null, and "reason" tells why.
        sentence: Result, or the reason for no certificate.
        task: Linear systems of the proof; None without a certificate.
        certified: True if there is a certificate, even one without a proved property.
    """

    document: JsonObject
    sentence: str
    task: "ProofTask | None" = None
    certified: bool = False


def build_proof_task(
    scenario: Scenario,
    read_gain: Callable[[Sequence[str]], np.ndarray] | None = None,
    *,
    weighed: bool = False,
) -> "ProofTask":
    """Return the linear systems of a scenario over [design.over], with the gain to certify.

    Args:
        read_gain: Function that returns the gain for the names of the states; by default the controller's gain.
        weighed: Also require the weights of a cost.

    Raises:
        ScenarioError: [design] has no weights, or does not fit the states.
        ValueError: The loop has no linear model.
        ModuleNotFoundError: No SDP solver is installed.
    """
    need_single_control(scenario.loop.plant, "design" if weighed else "certify")
    if weighed and scenario.design.Q is None:
        raise ScenarioError("design.Q and design.R are missing: a design minimises the cost that they weigh")
    from diffabs.robust.design import Spec
    from diffabs.robust.design.loop_task import build_loop_task
    from diffabs.robust.design.sdp import solver
    from diffabs.robust.design.state_feedback import reduce_loop

    reduced, design = reduce_loop(scenario.loop), scenario.design
    states = reduced.model.states
    gain = None if read_gain is None else read_gain(states)  # refused before anything is computed
    spec = Spec(Q=design.Q, R=design.R, decay=design.decay, damping=design.damping)
    try:
        spec = spec.check(len(states), 1, reduced.model.period)
    except ValueError as error:
        raise ScenarioError(f"design.{error}; the states are {', '.join(states)}") from None
    solver.solvers()  # fails early if no SDP solver is installed
    return build_loop_task(scenario.loop, design.box(scenario.loop), spec, gain, reduced)


def read_gain(text: str, states: Sequence[str], where: str = "--gain") -> np.ndarray:
    """Return the gain of a text `k1,k2,...`, with a number for each of the states."""
    words = text.strip().removeprefix("[").removesuffix("]").split(",")
    try:
        values = np.array([read_decimal(word) for word in words])
    except ValueError:
        raise ScenarioError(f"{where} {format_given(text)}: numbers are needed, as in {where}=-11753,-48") from None
    if not np.isfinite(values).all():
        raise ScenarioError(f"{where} {format_given(text)} is outside (-inf, inf): a gain is finite")
    if len(values) != len(states):
        raise ScenarioError(
            f"{where} {format_given(text)} has {len(values)} of {len(states)} numbers, one for each of"
            f" {', '.join(states)}"
        )
    return values


def certify_result(scenario: Scenario) -> Proved:
    """Return the outcome of a proof for a tuned loop over the ranges of [design].

    The certificate has the fastest decay rate that is found. If [tune] requires a faster one, it has that one if it can
    be proved. Without a certificate the outcome gives the reason; no error is raised.
    """
    from diffabs.robust.design import findings

    decay = scenario.tune.decay
    try:
        task = build_proof_task(scenario)
        proof = task.certify()
        if (proof.decay_rate or 0.0) < decay:  # the search for the fastest decay ends slightly below the optimum
            faster_proof = task.certify(dataclasses.replace(task.spec, decay=decay * (1 + BOUND_ROUNDING)))
            proof = faster_proof if (faster_proof.decay_rate or 0.0) >= decay else proof
    except (ModuleNotFoundError, ValueError, np.linalg.LinAlgError) as error:
        return without_certificate(" ".join(str(error).split()))
    further = findings.find_further(task, proof)
    reason = findings.describe_unproved(proof, task.spec, further) or None
    document = describe_proof(task, proof, reason=reason, further=further)
    rate = document["decay_rate"]
    over = ", ".join(f"{path} {low:.6g} to {high:.6g}" for path, (low, high) in task.over.items())
    sentence = reason or f"quadratically stable over {over}, decay rate {rate:.4g} 1/s"
    return Proved(document, f"certificate: {sentence}", task, certified=True)


def without_certificate(why: str) -> Proved:
    """Return the outcome of a proof that gave no certificate."""
    return Proved({**dict.fromkeys(FROM_PROOF), "reason": why}, f"no certificate: {why}")


def describe_proof(
    task: "ProofTask",
    proof: "Certificate | None" = None,
    reason: str | None = None,
    further: "FurtherFindings | None" = None,
    **numbers: float | None,
) -> JsonObject:
    """Return the JSON values of a proof, whose parameters have the names of the linear model and SI units.

    Args:
        proof: Certificate; None if nothing was found.
        reason: Why the gain or a property is missing.
        further: Results without a common Lyapunov matrix.
        **numbers: Further values by key: "lower_bound", "gap", "residual" and "trace_cost" of a design.
    """
    from diffabs.robust.design.findings import slowest_vertex

    summary: JsonObject = proof.summary() if proof else {}
    if proof:
        summary["worst_vertex"] = summary["worst_vertex"] or slowest_vertex(proof)
    coverage = task.polytope.coverage
    return {
        "gain": np.ravel(proof.gain).tolist() if proof else None,  # one input: the row is the gain
        "states": list(task.states),
        **{name: summary.get(name) for name in FROM_PROOF},
        **dict.fromkeys(FROM_DESIGN),
        **numbers,
        "reason": reason,
        "besides": further.document() if further else None,
        "period": task.polytope.period,
        "over": {path: list(ends) for path, ends in task.over.items()},
        "units": {path: spec.unit for path, spec, _ in parameters(task.model) if path in task.over},
        "vertices": task.polytope.vertices,
        "corners": [dict(corner) for corner in task.polytope.corners],
        "poles": list(proof.frozen) if proof else None,
        "coverage": dataclasses.asdict(coverage) if coverage else None,
        "exact": task.reduced.exact,
        "neglected": list(task.reduced.neglected),
    }
