"""The command `prove`: bounds of all runs of a box of parameters, of the nonlinear loop with its limits."""

import functools
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from diffabs.cli import console, show, show_proofs, targets
from diffabs.cli.options import read_sides
from diffabs.host.values import ScenarioError
from diffabs.scenario.model import result_document
from diffabs.scenario.parameter_paths import BoxSide
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.scenario.proofs import Proof


def prove(
    scenario: console.ScenarioName,
    over: Annotated[
        list[str], typer.Option("--over", metavar="PATH=LOW:HIGH", help="Range of a parameter; may be repeated.")
    ],
    claim: Annotated[
        list[str] | None,
        typer.Option(
            "--claim",
            metavar="NAME[=BOUND]",
            help="max_SIGNAL, min_SIGNAL, overshoot, stop_time, stop_distance or no_lock; may be repeated.",
        ),
    ] = None,
    changes: console.Changes = None,
    budget: Annotated[float, typer.Option(help="Computing time of the proof [s].")] = 60.0,
    out: Annotated[pathlib.Path | None, typer.Option(help="Write the certificate to this file.")] = None,
    plot: Annotated[
        pathlib.Path | None,
        typer.Option(help="Draw the cells of a box of one or two parameters to this file (.png, .pdf, .svg)."),
    ] = None,
    as_json: console.Json = False,
) -> None:
    """Prove bounds of every run of a box of parameters, with torque limits, lag and sampling.

    Without a claim: the best bounds within the budget.
    Exit status: 0 proved, 1 refuted or undecided, 2 wrong input."""
    with console.end_on_errors():
        if not 0 < budget < math.inf:
            console.fail(f"--budget = {budget:g} is outside (0, inf) s")
        targets.check_picture(plot)
        from diffabs.compiler.runtime.toolchain import NoCompiler
        from diffabs.robust.reach import NoRule
        from diffabs.robust.reach.claims import read_claim
        from diffabs.robust.reach.equations import derive_equations
        from diffabs.scenario.proofs import prove_box

        setup = console.load_scenario(scenario, changes or (), integrated=False)
        console.refuse_several_controls(setup, "prove")
        sides = read_sides(over, setup)
        box = {side.path: side.ends for side in sides}
        if plot:
            _check_drawable(box)
        with targets.new_target_file(plot, "--plot") as picture:
            with targets.new_target_file(out, "--out") as file:
                try:
                    equations = derive_equations(setup.loop, box)  # refuses before anything is simulated
                    claims = [read_claim(text, setup.loop, equations, "--claim") for text in claim or ()]
                    proof = console.run_with_lines(
                        lambda tell: prove_box(setup.loop, setup.solver, box, claims, budget, progress=tell),
                        f"proving {setup.name}",
                    )
                except (NoRule, NoCompiler) as error:
                    raise ScenarioError(str(error)) from None
                result = result_document("prove", setup, proof.record(), "numpy")
                show_result = functools.partial(show.show_result, as_json, show_proofs.show_box_proof, result, setup)
                if file:
                    with console.show_before_errors(show_result):
                        proof.save(file, setup)
            result["files"] = {"certificate": str(out)} if out else {}
            if picture:
                with console.show_before_errors(show_result):
                    _draw(proof, setup, sides, picture)
                result["files"] |= {"plot": str(plot)}
        show_result()
        if proof.verdict != "proved":
            console.conclude(f"{setup.name}: {proof.verdict}: {result['reason']}")


def _check_drawable(box: Mapping[str, tuple[float, float]]) -> None:
    """Refuse a box with no map before anything is proved."""
    from diffabs.robust.reach.extremes import is_wide

    if (count := sum(map(is_wide, box.values()))) not in (1, 2):
        raise ScenarioError(f"--plot draws one or two parameters; {count} of --over have more than one value")


def _draw(proof: "Proof", scenario: Scenario, sides: Sequence[BoxSide], picture: pathlib.Path) -> None:
    from diffabs.output.plot import proofs

    shown = proofs.map_proof(proof, sides, scenario.title or scenario.name)
    console.run_with_progress(lambda: proofs.draw_proof(shown).savefig(picture), "drawing")
