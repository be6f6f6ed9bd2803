"""The commands `design` and `certify`: a robust gain for a scenario, and what can be proved about one.

Both need the extra `diffabs[design]`, so what needs it is imported when a command runs."""

import contextlib
import dataclasses
import math
import pathlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import typer

from diffabs import console, show
from diffabs.catalogue import ScenarioError, shown
from diffabs.pytree import parameters
from diffabs.scenario import Scenario, load

if TYPE_CHECKING:
    from diffabs.design import Certificate, Polytope, Spec
    from diffabs.design.reduction import Reduced

# Of the JSON document. Without a certificate most are null.
FROM_PROOF = ("quadratically_stable", "stable", "verified_exactly", "decay_rate", "damping", "trace_cost",
              "guaranteed_cost", "worst_vertex", "margins", "claims")  # fmt: skip
FROM_DESIGN = ("lower_bound", "gap", "residual")
CHECK = "check it with: python experiments/check_certificate.py"
VERDICTS = {True: "proved", False: "disproved", None: "undecided"}

Out = Annotated[pathlib.Path | None, typer.Option(metavar="FILE.json", help="Write the certificate to this file.")]


class _Task(NamedTuple):
    """A scenario brought to linear systems: the gain in question, the set it is about, the specification."""

    chosen: Scenario
    reduced: "Reduced"
    gain: np.ndarray
    over: dict[str, tuple[float, float]]
    polytope: "Polytope"
    spec: "Spec"


def design(
    scenario: console.ScenarioName,
    changes: console.Changes = None,
    as_json: console.Json = False,
    out: Out = None,
) -> None:
    """Find the state feedback with the least guaranteed cost over the ranges of [design], and prove it."""
    with console.guarded(), _reported():
        with _file(out) as file:
            task = console.waited(lambda: _task(scenario, changes or (), weighed=True), "computing the polytope")
            from diffabs.design import synthesis

            try:
                found = console.waited(
                    lambda: synthesis.design(task.polytope, task.spec), f"designing for {task.chosen.name}"
                )
            except synthesis.DesignError as error:
                if as_json:
                    show.as_json(_result(task, reason=str(error)))
                console.fail(f"{task.chosen.name}: {error}", console.FAILED)
            if file:
                found.certificate.save(file)
        numbers = {name: getattr(found, name) for name in (*FROM_DESIGN, "trace_cost")}
        _show(_result(task, found.certificate, out, **numbers), task, as_json)


def certify(
    scenario: console.ScenarioName,
    gain: Annotated[
        str | None, typer.Option(metavar="K1,K2,...", help="The gain of u = K x; else the scenario's controller's own.")
    ] = None,
    changes: console.Changes = None,
    as_json: console.Json = False,
    out: Out = None,
) -> None:
    """Prove, or disprove, that a gain is stable over the ranges of [design], however fast the parameters vary."""
    with console.guarded(), _reported():
        with _file(out) as file:
            task = console.waited(lambda: _task(scenario, changes or (), gain), "computing the polytope")
            from diffabs.design import analysis

            proof = console.waited(
                lambda: analysis.certify(task.gain, task.polytope, task.spec, fastest=True),
                f"certifying {task.chosen.name}",
            )
            if file:
                proof.save(file)
        reason = _unproved(proof, task.spec)
        _show(_result(task, proof, out, reason=reason or None), task, as_json)
        if reason:
            console.fail(f"{task.chosen.name}: {reason}", console.FAILED)


@contextlib.contextmanager
def _reported() -> Iterator[None]:
    """What `diffabs.design` raises, in one line: what is missing or does not fit is bad input."""
    try:
        yield
    except ModuleNotFoundError as error:
        console.fail(" ".join(str(error).split()))
    except np.linalg.LinAlgError as error:
        console.fail(f"the linear algebra failed: {error}", console.FAILED)
    except ValueError as error:
        raise ScenarioError(str(error)) from None


def _file(out: pathlib.Path | None) -> contextlib.AbstractContextManager[pathlib.Path | None]:
    return console.new_file(out, "--out") if out else contextlib.nullcontext()


def _task(scenario: str, changes: Sequence[str], gain: str | None = None, *, weighed: bool = False) -> _Task:
    """Raises ScenarioError; ValueError for a loop that has no linear model; ModuleNotFoundError without the extra."""
    chosen = load(scenario, changes, integrated=False)
    if weighed and chosen.design.Q is None:
        raise ScenarioError("design.Q and design.R are missing: a design minimises the cost that they weigh")
    from diffabs.design import Spec, lmi
    from diffabs.design.box import polytope
    from diffabs.design.reduction import state_feedback

    reduced, wanted = state_feedback(chosen.loop), chosen.design
    states = reduced.model.states
    values = reduced.gain if gain is None else _gain(gain, states)
    spec = Spec(Q=wanted.Q, R=wanted.R, decay=wanted.decay, damping=wanted.damping)
    try:
        spec = spec.checked(len(states), 1)
    except ValueError as error:
        raise ScenarioError(f"design.{error}; the states are {', '.join(states)}") from None
    lmi.solvers()  # says what is missing before anything is computed
    over = wanted.box(chosen.loop)
    return _Task(chosen, reduced, values, over, polytope(reduced.model, over), spec)


def _gain(text: str, states: Sequence[str]) -> np.ndarray:
    words = text.strip().removeprefix("[").removesuffix("]").split(",")
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise ScenarioError(f"--gain {shown(text)}: numbers are needed, as in --gain=-11753,-48") from None
    if not np.isfinite(values).all():
        raise ScenarioError(f"--gain {shown(text)} is outside (-inf, inf): a gain is finite")
    if len(values) != len(states):
        raise ScenarioError(f"--gain {shown(text)} has {len(values)} of {len(states)} numbers: {', '.join(states)}")
    return values


def _result(
    task: _Task,
    proof: "Certificate | None" = None,
    out: pathlib.Path | None = None,
    reason: str | None = None,
    **numbers: float | None,
) -> dict[str, Any]:
    """The JSON document. Parameters have the names of the linear model, in SI."""
    summary: dict[str, Any] = proof.summary() if proof else {}
    if proof:
        summary["worst_vertex"] = summary["worst_vertex"] or _slowest(proof)
    coverage = task.polytope.coverage
    return {
        "scenario": task.chosen.name,
        "gain": np.ravel(proof.gain).tolist() if proof else None,  # one input: the row is the gain
        "states": list(task.reduced.model.states),
        **{name: summary.get(name) for name in FROM_PROOF},
        **dict.fromkeys(FROM_DESIGN),
        **numbers,
        "reason": reason,
        "period": task.polytope.period,
        "over": {path: list(ends) for path, ends in task.over.items()},
        "vertices": task.polytope.vertices,
        "corners": [dict(corner) for corner in task.polytope.corners],
        "poles": list(proof.frozen) if proof else None,
        "coverage": dataclasses.asdict(coverage) if coverage else None,
        "exact": task.reduced.exact,
        "neglected": list(task.reduced.neglected),
        "versions": show.versions("cvxpy", "clarabel", "scipy"),
        "files": {"out": str(out)} if out and proof else {},
    }


def _slowest(proof: "Certificate") -> dict[str, Any]:
    """For a proof that is about all vertices together: the vertex with the slowest pole, as `worst_vertex`."""
    index = int(np.argmax(proof.frozen))
    margin = (0.0 if proof.period is None else 1.0) - proof.frozen[index]
    corners = proof.cells[0].corners
    corner = dict(corners[index]) if corners else None
    return {"index": index, "cell": 0, "corner": corner, "claim": "poles", "margin": margin}


def _unproved(proof: "Certificate", spec: "Spec") -> str:
    """What was asked for and is not proved, in words; empty if all is."""
    stable, refuted = proof.quadratically_stable, any(proof.proved("infeasible"))
    asked = {
        "decay": (spec.decay > 0, f"decay = {spec.decay:g} 1/s", not refuted),
        "cost": (spec.Q is not None, "a guaranteed cost", True),
        "damping": (spec.damping > 0, f"damping = {spec.damping:g}", True),
    }
    found = [] if stable else [f"quadratic stability is {VERDICTS[stable]}"]
    if stable is False:
        found[0] += f": no common Lyapunov matrix exists for the {proof.cells[0].vertices} vertices"
    else:
        for kind, (wanted, words, still_open) in asked.items():
            if wanted and not any(proof.proved(kind)):
                found.append(f"{words} is {VERDICTS[None if still_open else False]}")
    if not found:
        return ""
    worst = _slowest(proof)
    where = ", ".join(f"{name} {value:.6g}" for name, value in (worst["corner"] or {}).items())
    kind = "is unstable even if it is fixed" if worst["margin"] <= 0 else "has the slowest pole"
    return f"{', '.join(found)}; vertex {worst['index']}{f' ({where})' if where else ''} {kind}"


def _show(result: dict[str, Any], task: _Task, as_json: bool) -> None:
    if as_json:
        show.as_json(result)
    else:
        units = {path: spec.unit for path, spec, _ in parameters(task.reduced.model)}
        show.proof(result, f"{task.chosen.name}: u = K x", units, VERDICTS[result["quadratically_stable"]])
    for line in task.reduced.neglected:
        console.say(f"neglected: {line}")
    if not task.reduced.exact:
        console.say("note: the linear model is not the loop's own linearisation; a proof is about the model")
    spread = task.polytope.coverage.spread if task.polytope.coverage else 1.0
    if spread == math.inf:
        console.say("note: the corners do not cover the ranges; the vertices are those of a box around the systems")
    elif not math.isclose(spread, 1.0):
        console.say(f"note: the corners do not cover the ranges; the vertices are spread by {spread:.4g}")
    for path in result["files"].values():
        console.say(f"certificate: {path}; {CHECK} {path}")
