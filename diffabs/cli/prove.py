"""The command `prove`: bounds of all runs of a box of parameters, of the nonlinear loop with its limits."""

import functools
import math
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import typer

from diffabs.cli import console, show_proofs, targets
from diffabs.cli import show as views
from diffabs.core.types import JsonObject
from diffabs.host.separated import read_decimal
from diffabs.host.values import ScenarioError, format_given, unknown_name_error
from diffabs.scenario.parameter_paths import parameters_of, read_entries
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.output.plot.proofs import ProofMap
    from diffabs.robust.reach import RunClaim
    from diffabs.robust.reach.equations import Equations
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
        from diffabs.robust.reach.equations import derive_equations
        from diffabs.scenario.proofs import prove_box

        setup = console.load_scenario(scenario, changes or (), integrated=False)
        sides = _read_sides(over, setup)
        box = {side.path: side.ends for side in sides}
        if plot:
            _choose_axes(sides)  # refuses other boxes before anything is proved
        if "slip" not in setup.loop.plant.shows._fields and not claim:
            raise ScenarioError(
                f"--claim is needed: the plant has no slip; it has {', '.join(setup.loop.plant.shows._fields)}"
            )
        far = [""]
        with targets.new_target_file(plot, "--plot") as picture:
            with targets.new_target_file(out, "--out") as file:
                try:
                    equations = derive_equations(setup.loop, box)  # refuses before anything is simulated
                    claims = [_read_claim(text, setup, equations) for text in claim or ()]
                    proof = console.run_with_progress(
                        lambda: prove_box(
                            setup.loop, setup.solver, box, claims, budget,
                            progress=lambda line: far.__setitem__(0, line),
                        ),
                        f"proving {setup.name}",
                        lambda: far[0],
                    )  # fmt: skip
                except (NoRule, NoCompiler) as error:
                    raise ScenarioError(str(error)) from None
                result = _document(proof, setup)
                show_result = functools.partial(_show, result, setup, as_json)
                if file:
                    with console.show_before_errors(show_result):
                        proof.save(file, setup)
            result["files"] = {"certificate": str(out)} if out else {}
            if picture:
                from diffabs.output.plot.proofs import draw_proof

                with console.show_before_errors(show_result):
                    shown = _map_of_proof(proof, setup, sides)
                    console.run_with_progress(lambda: draw_proof(shown).savefig(picture), "drawing")
                result["files"] |= {"plot": str(plot)}
        show_result()
        if proof.verdict != "proved":
            console.conclude(f"{setup.name}: {proof.verdict}: {result['reason']}")


def _show(result: JsonObject, scenario: Scenario, as_json: bool) -> None:
    views.as_json(result) if as_json else show_proofs.show_box_proof(result, scenario)


def _describe_claim(claim: "RunClaim") -> str:
    """Return a claim in words."""
    return f"{claim.quantity} {'>=' if claim.quantity.startswith('least') else '<='} {claim.bound!r}"


class _Side(NamedTuple):
    """One parameter of the box: its range in SI, and how the user names it.

    `label` has the unit in which the user gave the range, and `scale` is the factor from SI to that unit.
    """

    path: str
    ends: tuple[float, float]
    label: str
    scale: float


def _read_sides(options: Sequence[str], scenario: Scenario) -> list[_Side]:
    """Return the range of each parameter, widened by a rounding so that it holds the decimal numbers given."""
    table: JsonObject = {}
    for text in options:
        path, equals, ends = text.partition("=")
        low, colon, high = ends.partition(":")
        try:
            pair = [read_decimal(low), read_decimal(high)]
        except ValueError:
            pair = []
        if not (equals and colon and pair):
            raise ScenarioError(f"--over {format_given(text)} is not of the form path=low:high")
        if path.strip() in table:
            raise ScenarioError(f"--over {path.strip()} is given twice")
        table[path.strip()] = pair
    sides = []
    for entry in read_entries(table, "--over", parameters_of(scenario.loop), "not a parameter of this loop"):
        if entry.shape:
            raise ScenarioError(f"{entry.where} is a list; a proof varies single numbers")
        low, high = entry.range()
        if not (math.isfinite(low) and math.isfinite(high)):
            raise ScenarioError(f"{entry.where} = {format_given(entry.value)}: both ends must be finite")
        # Zero is exact, and a slip must not be less.
        ends = (low and math.nextafter(low, -math.inf), high and math.nextafter(high, math.inf))
        sides.append(_Side(entry.path, ends, f"{entry.path} [{entry.spec.unit or 1}]", entry.scale))
    return sides


def _choose_axes(sides: Sequence[_Side]) -> list[int]:
    """Return the indices of the parameters with more than one value. Raises ScenarioError unless there are 1 or 2."""
    from diffabs.robust.reach.extremes import is_wide

    wide = [i for i, side in enumerate(sides) if is_wide(side.ends)]
    if len(wide) not in (1, 2):
        raise ScenarioError(f"--plot draws one or two parameters; {len(wide)} of --over have more than one value")
    return wide


def _map_of_proof(proof: "Proof", scenario: Scenario, sides: Sequence[_Side]) -> "ProofMap":
    """Return the map of the first claim's quantity, else of the greatest slip, in the units of the given ranges."""
    from diffabs.output.plot.proofs import ProofMap

    axes, claims, extremes, cover = _choose_axes(sides), proof.claims, proof.extremes, proof.cover
    scales = np.array([sides[i].scale for i in axes])
    quantity = claims[0].quantity if claims else "greatest slip"
    word, _, signal = quantity.rpartition(" ")
    bounds = np.empty(0)
    if cover.rows is not None:
        times = {"stop_time": cover.rows.time, "stop_distance": cover.rows.distance}
        columns = cover.rows.lower if word == "least" else cover.rows.upper
        bounds = columns[:, cover.prover.signals.index(signal)] if word else times[quantity][:, 1]
    kind = "lower" if word == "least" else "upper"
    statement = f": {_describe_claim(claims[0])}" if claims else ""

    def shown_cells(cells: np.ndarray) -> np.ndarray:
        return cells[..., axes, :] * scales[:, None]

    worst = extremes.worst.get(quantity)
    return ProofMap(
        labels=[sides[i].label for i in axes],
        box=shown_cells(np.array([side.ends for side in sides])),
        cells=shown_cells(cover.cells),
        bounds=bounds,
        undecided=shown_cells(cover.undecided),
        refuting=None if cover.refuting is None else shown_cells(cover.refuting),
        worst=None if worst is None else np.array(worst)[axes] * scales,
        worst_value=extremes.ranges[quantity][1] if quantity in extremes.ranges else None,
        quantity=f"proved {kind} bound of {signal.replace('_', ' ')} [{_unit_of(quantity, scenario)}]",
        claimed=claims[0].bound if claims else None,
        title=f"{scenario.title or scenario.name}\n{proof.verdict}{statement}",
    )


def _read_claim(text: str, scenario: Scenario, equations: "Equations") -> "RunClaim":
    """Return a claim about a signal, the stop time or the stop distance. Raises ScenarioError."""
    from diffabs.robust.reach import claims

    name, equals, number = text.partition("=")
    names = claims.claimable_names(scenario.loop.plant.shows._fields)
    if name not in names:
        raise unknown_name_error(f"--claim {name} is not a quantity of this loop", name, names)
    if name == claims.NO_LOCK:
        if equals:
            raise ScenarioError("--claim no_lock has no bound: it says that the slip stays below 1")
        return claims.no_lock_claim()
    try:
        bound = read_decimal(number)
    except ValueError:
        bound = math.nan
    if not math.isfinite(bound):
        raise ScenarioError(f"--claim {text} needs a finite number: {name}=BOUND")
    try:
        return claims.named_claim(name, bound, equations)
    except ValueError as error:
        instead = ": --claim max_slip=BOUND" if bound >= 0 else ""
        raise ScenarioError(f"--claim {error}{instead}") from None


def _unit_of(quantity: str, scenario: Scenario) -> str:
    """Return the unit of a quantity of a proof, empty if the plant declares none."""
    units = {"stop_time": "s", "stop_distance": "m", **scenario.loop.plant.shows.units}
    return units.get(quantity.split()[-1], "")


def _document(proof: "Proof", scenario: Scenario) -> JsonObject:
    """Return the JSON document; a bound that is not proved is null."""
    cover, box, extremes = proof.cover, proof.over, proof.extremes.ranges
    bounds = {}
    for name, (low, high) in proof.bounds.items():
        row = {"low": low, "high": high, "unit": _unit_of(name, scenario)}
        bounds[name] = {key: x if isinstance(x, str) or math.isfinite(x) else None for key, x in row.items()}
        if name in extremes:
            bounds[name]["least_run"], worst = extremes[name]
            bounds[name]["worst_run"] = worst
            bounds[name]["looseness"] = (high - worst) / worst if worst and math.isfinite(high) else None
    widths = np.array([high - low for low, high in box.values()])
    shares = ((cover.undecided[:, :, 1] - cover.undecided[:, :, 0]) / np.where(widths > 0, widths, 1)).prod(1)
    refuting = None if cover.refuting is None else dict(zip(box, cover.refuting.tolist(), strict=True))
    if proof.verdict == "refuted":
        reason = "every run violates the claim where " + ", ".join(
            f"{path} = {ends[0]:.6g}" if ends[0] == ends[1] else f"{path} in [{ends[0]:.6g}, {ends[1]:.6g}]"
            for path, ends in (refuting or {}).items()
        )
    elif proof.verdict == "undecided":
        cells = "one cell" if len(cover.undecided) == 1 else f"{len(cover.undecided):,} cells"
        reason = f"{100 * shares.sum():.3g} % of the box is left in {cells}"
        reason += f" ({cover.failure})" if cover.failure else ""
        reason += "; a greater --budget goes on" if len(cover.cells) else ""
        reason = reason if len(cover.undecided) else cover.failure
    else:
        reason = ""
    values = {
        "verdict": proof.verdict,
        "reason": reason,
        "over": {path: list(ends) for path, ends in box.items()},
        "claims": [claim._asdict() for claim in proof.claims],
        "bounds": bounds,
        "refuted_by": refuting,
        "cells": len(cover.cells),
        "left": len(cover.undecided),
        "share_left": float(shares.sum()),
        "tried": cover.tried,
        "seconds": cover.seconds,
    }
    return console.document("prove", scenario, values, "numpy")
