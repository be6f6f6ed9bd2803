"""The commands `design` and `certify`: a robust gain for a scenario, and proofs about a gain.

They need the extra `design`. Modules that need it are imported only when a command runs.
"""

import functools
import math
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from diffabs.cli import certificates, console, show, show_proofs, targets
from diffabs.cli.options import read_sides
from diffabs.core.pytree import parameters
from diffabs.core.types import JsonObject
from diffabs.host.values import ScenarioError, read_time
from diffabs.scenario import proving
from diffabs.scenario.model import result_document
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.robust.design.loop_task import ProofTask

CHECK = "check it with: diffabs verify"

Out = Annotated[pathlib.Path | None, typer.Option(metavar="FILE.json", help="Write the certificate to this file.")]


def design(
    scenario: console.ScenarioName,
    changes: console.Changes = None,
    as_json: console.Json = False,
    out: Out = None,
) -> None:
    """Find the gain with the least cost that one common P proves together with all specifications.

    The gain is a state feedback for all systems within the ranges of [design.over].
    Its certificate proves the cost with a P of its own, so the guaranteed cost may be lower."""
    with console.end_on_errors(), certificates.report_design_errors():
        with targets.new_target_file(out, "--out") as file:
            setup, task = _prepare(scenario, changes or (), weighed=True)
            from diffabs.robust.design import synthesis

            try:
                solution = console.run_with_progress(
                    lambda: synthesis.design(task.polytope, task.spec), f"designing for {setup.name}"
                )
            except synthesis.DesignError as error:
                if as_json:
                    show.as_json(certificates.proof_document(setup, task, reason=str(error)))
                console.fail(f"{setup.name}: {error}", console.FAILED)
            numbers = {name: getattr(solution, name) for name in (*proving.FROM_DESIGN, "trace_cost")}
            document = functools.partial(certificates.proof_document, setup, task, solution.certificate, **numbers)
            if file:
                with console.show_before_errors(lambda: _show(document(), task, as_json)):
                    solution.certificate.save(file)
        _show(document(out), task, as_json)


def certify(
    scenario: console.ScenarioName,
    gain: Annotated[
        str | None,
        typer.Option(metavar="K1,K2,...", help="Gain of u = K x; default: that of the scenario's controller."),
    ] = None,
    sensitivity: Annotated[
        float | None,
        typer.Option(help="Prove |1/(1 + L)| <= this at every frequency, for every parameter of --over."),
    ] = None,
    delay_margin: Annotated[
        str | None,
        typer.Option(metavar="TIME", help='Prove that so much more delay is stable, as "5 ms" or 0.005 (s).'),
    ] = None,
    over: Annotated[
        list[str] | None,
        typer.Option("--over", metavar="PATH=LOW:HIGH", help="Range of a parameter; default: [design.over]."),
    ] = None,
    budget: Annotated[float, typer.Option(help="Computing time of each proof of --sensitivity [s].")] = 60.0,
    changes: console.Changes = None,
    as_json: console.Json = False,
    out: Out = None,
) -> None:
    """Prove that a gain is stable over the ranges of [design.over].

    The result, proved or disproved, holds for parameters that vary arbitrarily fast. With --sensitivity or
    --delay-margin: prove a margin of the loop at every constant parameter, with exact delays and sampling."""
    with console.end_on_errors():
        if sensitivity is not None or delay_margin is not None:
            if gain is not None:
                console.fail("--gain does not go with --sensitivity: give the gain by --set controller.gain=...")
            _certify_margins(scenario, sensitivity, delay_margin, over or (), budget, changes or (), as_json, out)
            return
        if over:
            console.fail("--over goes with --sensitivity or --delay-margin; other ranges are those of [design.over]")
    from diffabs.robust.design import findings

    with console.end_on_errors(), certificates.report_design_errors():
        with targets.new_target_file(out, "--out") as file:
            setup, task = _prepare(scenario, changes or (), gain)
            proof = console.run_with_progress(task.certify, f"certifying {setup.name}")
            document = functools.partial(certificates.proof_document, setup, task, proof)
            if file:
                with console.show_before_errors(lambda: _show(document(), task, as_json)):
                    proof.save(file)
        further = console.run_with_progress(
            lambda: findings.find_further(task, proof), "analysing the loops at fixed parameters"
        )
        reason = findings.describe_unproved(proof, task.spec, further)
        _show(document(out, reason=reason or None, further=further), task, as_json)
        if reason:
            console.conclude(f"{setup.name}: {reason}")


def _certify_margins(
    scenario: str, sensitivity: float | None, delay_margin: str | None, over: Sequence[str], budget: float,
    changes: Sequence[str], as_json: bool, out: pathlib.Path | None,
) -> None:  # fmt: skip
    """Prove margins over a box, and show what is proved."""
    if not 0 < budget < math.inf:
        console.fail(f"--budget = {budget:g} is outside (0, inf) s")
    from diffabs.robust.frequency import FrequencyClaim
    from diffabs.scenario.frequency_proofs import prove_frequency

    setup = console.load_scenario(scenario, changes, integrated=False)
    claims = [] if sensitivity is None else [FrequencyClaim(sensitivity)]
    claims += [] if delay_margin is None else [FrequencyClaim(math.inf, read_time(delay_margin, "--delay-margin"))]
    box = {side.path: side.ends for side in read_sides(over, setup)} if over else setup.design.ranges(setup.loop)
    if not box:
        console.fail("--over is missing, and the scenario has no [design.over]")
    with targets.new_target_file(out, "--out") as file:
        try:
            proof = console.run_with_lines(
                lambda tell: prove_frequency(setup.loop, box, claims, budget=budget, progress=tell),
                f"certifying {setup.name}",
            )
        except ScenarioError:
            raise
        except ValueError as error:  # also NoRule
            raise ScenarioError(f"{setup.name}: {error}") from None
        result = result_document("frequency", setup, proof.record(), "numpy")
        show_result = functools.partial(show.show_result, as_json, show_proofs.show_frequency_proof, result, setup)
        if file:
            with console.show_before_errors(show_result):
                proof.save(file, setup)
    result["files"] = {"certificate": str(out)} if out else {}
    show_result()
    if proof.verdict != "proved":
        console.conclude(f"{setup.name}: {proof.verdict}: {proof.reason}")
    if out:
        console.say(f"certificate: {out}; {CHECK} {out}")


def _prepare(
    scenario: str, changes: Sequence[str], gain: str | None = None, *, weighed: bool = False
) -> tuple[Scenario, "ProofTask"]:
    setup = console.load_scenario(scenario, changes, integrated=False)
    read = None if gain is None else functools.partial(proving.read_gain, gain)
    return setup, console.run_with_progress(
        lambda: proving.build_proof_task(setup, read, weighed=weighed), "computing the polytope"
    )


def _show(result: JsonObject, task: "ProofTask", as_json: bool) -> None:
    if as_json:
        show.as_json(result)
    else:
        from diffabs.robust.design.findings import VERDICT_WORDS

        units = {path: spec.unit for path, spec, _ in parameters(task.model)}
        verdict = VERDICT_WORDS[result["quadratically_stable"]]
        show.show_proof(result, f"{result['scenario']}: u = K x", units, verdict)
    for line in task.notes():
        console.say(line)
    for path in result["files"].values():
        console.say(f"certificate: {path}; {CHECK} {path}")
