"""The JSON document of a tuning: what was free, metrics and constraints before and after, the certificate."""

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from diffabs.cli import certificates, console
from diffabs.core import provenance
from diffabs.core.pytree import get, parameters
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.tune import Batch, Tuned

WHEN = ("before", "after")


class Work(NamedTuple):
    """What is tuned: the scenario, its lanes, its constraints by name, and the linear systems a decay is asked of."""

    chosen: Scenario
    batch: "Batch"
    constraints: dict[str, Any]
    task: certificates.ProofTask | None


class Proved(NamedTuple):
    """The JSON of a certificate, whose numbers are null where there is none, and why not in a sentence."""

    document: dict[str, Any]
    sentence: str
    task: certificates.ProofTask | None = None
    certified: bool = False


def tuning_document(work: Work, found: "Tuned", proved: Proved) -> dict[str, Any]:
    """The whole document, without the files that were written."""
    chosen, goal = work.chosen, work.chosen.tune
    return {
        **console.describe_source(chosen),
        "lanes": work.batch.size,
        "free": {path: _free(chosen, found, path) for path in goal.free},
        "objective": dict(zip(WHEN, map(float, found.objective), strict=True)),
        "metrics": {when: _over_lanes(m, chosen) for when, m in zip(WHEN, found.metrics, strict=True)},
        "constraints": (rows := _constraints(work, found, proved)),
        "met": all(row["met"] for row in rows),
        "reason": found.reason.value,
        "gradient_norm": float(found.gradient),
        "evaluations": found.evaluations,
        "mode": found.mode.value,
        "engine": found.engine,
        "history": [point._asdict() for point in found.history],
        "starts": [
            {"objective": float(s.objective), "violation": float(s.violation), "reason": s.reason.value}
            for s in found.starts
        ],
        "parameters": {path: _plain(value) for path, _, value in parameters(found.loop)},
        "certificate": proved.document,
        "versions": provenance.versions("optax", "scipy", *(("cvxpy", "clarabel") if proved.certified else ())),
        "files": {},
    }


def _free(chosen: Scenario, found: "Tuned", path: str) -> dict[str, Any]:
    spec = next(spec for name, spec, _ in parameters(chosen.loop) if name == path)
    low, high = chosen.tune.free[path] or (spec.low, spec.high)
    before, after = (_plain(get(loop, path)) for loop in (chosen.loop, found.loop))
    return {"before": before, "after": after, "low": _plain(low), "high": _plain(high), "unit": spec.unit}


def _over_lanes(metrics: dict[str, Any], chosen: Scenario) -> dict[str, dict[str, float]]:
    """NaN where a lane diverged: a mean over the others would hide it."""
    each = {name: np.asarray(metrics[name], float) for name in chosen.objectives}
    return {
        "mean": {name: float(values.mean()) for name, values in each.items()},
        "worst": {name: float(values.max()) for name, values in each.items()},
    }


def _constraints(work: Work, found: "Tuned", proved: Proved) -> list[dict[str, Any]]:
    """What was asked for, its worst value before and after, and whether it is met."""
    goal, rows = work.chosen.tune, []
    for name, bound in goal.limits.items():
        before, after = (float(np.max(metrics[name])) for metrics in found.metrics)
        rows.append(_constraint_row(name, bound, before, after, at_most=True))
    if work.task and goal.decay:
        before, after = certificates.certify_gain(work.task).decay_rate, proved.document["decay_rate"]
        rows.append(_constraint_row("certified decay", goal.decay, before, after, at_most=False))
    if work.task and goal.damping:
        before = _least_damping(work.task, work.chosen.loop)
        after = _least_damping(proved.task or work.task, found.loop)
        rows.append(_constraint_row("damping", goal.damping, before, after, at_most=False))
    return rows


def _constraint_row(
    name: str, bound: float, before: float | None, after: float | None, *, at_most: bool
) -> dict[str, Any]:
    """A line of the constraints. Met is met, without a tolerance; else `missed` is by how much it is not, or null where
    no number is known."""
    reached = math.nan if after is None else after
    beyond = reached - bound if at_most else bound - reached
    missed = None if math.isnan(beyond) else max(beyond, 0.0)
    row = {"name": name, "bound": bound, "before": before, "after": after}
    return {**row, "met": beyond <= 0, "missed": missed}


def _least_damping(task: certificates.ProofTask, loop: Any) -> float:
    """The least of the poles at the vertices."""
    from diffabs.tune import Poles

    return float(Poles(task.polytope).least_damping(loop))


def _plain(value: Any) -> Any:
    return np.asarray(value, float).tolist()
