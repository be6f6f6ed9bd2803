"""Shared code of the commands that prove: the task of a scenario, its document, and errors as one line.

Everything here needs the extra `design`. Modules that need the extra are imported only when a command runs.
"""

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from diffabs.cli import console
from diffabs.config.values import ScenarioError, format_given
from diffabs.core.pytree import parameters
from diffabs.core.types import JsonObject
from diffabs.runtime import provenance
from diffabs.runtime.separated import read_decimal
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.design import Certificate
    from diffabs.design.findings import FurtherFindings
    from diffabs.design.loop_task import ProofTask

# Keys of the JSON document; without a certificate most are null.
FROM_PROOF = ("quadratically_stable", "stable", "verified_exactly", "decay_rate", "damping", "trace_cost",
              "guaranteed_cost", "worst_vertex", "margins", "claims")  # fmt: skip
FROM_DESIGN = ("lower_bound", "gap", "residual")


def build_proof_task(scenario: Scenario, gain: str | None = None, *, weighed: bool = False) -> "ProofTask":
    """Return the linear systems of a scenario over [design.over], with the gain to certify.

    Args:
        gain: `k1,k2,...`; by default the gain of the controller.
    """
    if weighed and scenario.design.Q is None:
        raise ScenarioError("design.Q and design.R are missing: a design minimises the cost that they weigh")
    from diffabs.design import Spec
    from diffabs.design.loop_task import build_loop_task
    from diffabs.design.sdp import solver
    from diffabs.design.state_feedback import reduce_loop

    reduced, design = reduce_loop(scenario.loop), scenario.design
    states = reduced.model.states
    typed = None if gain is None else _read_gain(gain, states)  # refused before anything is computed
    spec = Spec(Q=design.Q, R=design.R, decay=design.decay, damping=design.damping)
    try:
        spec = spec.check(len(states), 1, reduced.model.period)
    except ValueError as error:
        raise ScenarioError(f"design.{error}; the states are {', '.join(states)}") from None
    solver.solvers()  # fails early if no SDP solver is installed
    return build_loop_task(scenario.loop, design.box(scenario.loop), spec, typed, reduced)


def _read_gain(text: str, states: Sequence[str]) -> np.ndarray:
    words = text.strip().removeprefix("[").removesuffix("]").split(",")
    try:
        values = np.array([read_decimal(word) for word in words])
    except ValueError:
        raise ScenarioError(f"--gain {format_given(text)}: numbers are needed, as in --gain=-11753,-48") from None
    if not np.isfinite(values).all():
        raise ScenarioError(f"--gain {format_given(text)} is outside (-inf, inf): a gain is finite")
    if len(values) != len(states):
        raise ScenarioError(
            f"--gain {format_given(text)} has {len(values)} of {len(states)} numbers, one for each of"
            f" {', '.join(states)}"
        )
    return values


def proof_document(
    scenario: Scenario,
    task: "ProofTask",
    proof: "Certificate | None" = None,
    out: pathlib.Path | None = None,
    reason: str | None = None,
    further: "FurtherFindings | None" = None,
    **numbers: float | None,
) -> JsonObject:
    """Return the JSON document of a proof, whose parameters have the names of the linear model and SI units.

    Args:
        **numbers: Further values by key: "lower_bound", "gap", "residual" and "trace_cost" of a design.
    """
    from diffabs.design.findings import slowest_vertex

    summary: JsonObject = proof.summary() if proof else {}
    if proof:
        summary["worst_vertex"] = summary["worst_vertex"] or slowest_vertex(proof)
    coverage = task.polytope.coverage
    return {
        **console.describe_source(scenario),
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
        "versions": provenance.versions("cvxpy", "clarabel", "scipy"),
        "files": {"out": str(out)} if out and proof else {},
    }


@contextlib.contextmanager
def report_design_errors() -> Iterator[None]:
    """Turn errors of `diffabs.design` into one line."""
    try:
        yield
    except ModuleNotFoundError as error:
        console.fail(" ".join(str(error).split()))
    except np.linalg.LinAlgError as error:
        console.fail(f"the linear algebra failed: {error}", console.FAILED)
    except ValueError as error:
        raise ScenarioError(str(error)) from None
