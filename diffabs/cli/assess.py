"""The command `assess`: the clauses of a regulation about anti-lock brakes."""

from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from diffabs.cli import console, show, tables
from diffabs.core.types import JsonObject
from diffabs.host.values import ScenarioError, plain_fields
from diffabs.scenario.model import result_document
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.assess import Assessment

MOST_CARS = 1_000_000
UNCONFIRMED = "Rules without a clause number are not from the regulation; the exit status does not depend on them."
ONE_TRACK = "5.3.4 and 5.3.7, the split road, need the plant car: a half-car has one track."


def assess_brakes(
    scenario: console.ScenarioName,
    high: Annotated[float | None, typer.Option(help="Coefficient of adhesion of the good road: 0.8.")] = None,
    low: Annotated[float | None, typer.Option(help="Coefficient of adhesion of the slippery road: 0.3.")] = None,
    load: Annotated[float | None, typer.Option(help="Mass that a laden car carries [kg]: 400.")] = None,
    fast: Annotated[float | None, typer.Option(help="The high speed [km/h]: 120.")] = None,
    steering_ratio: Annotated[
        float | None, typer.Option(help="Angle of the steering wheel per steer angle: 16.")
    ] = None,
    brief: Annotated[float | None, typer.Option(help="Longest time for which a wheel may lock [s]: 0.1.")] = None,
    adhesion: Annotated[
        str | None, typer.Option(help="k of the utilised adhesion: road, or axles for one measured with one axle.")
    ] = None,
    cars: Annotated[
        int,
        typer.Option(
            min=0, max=MOST_CARS, help="Assess this number of cars, drawn from [sweep.over]; 0: the scenario's own."
        ),
    ] = 0,
    changes: console.Changes = None,
    as_json: console.Json = False,
) -> None:
    """Assess the brakes of a car by the clauses of Regulation (EU) 2015/68, Annex XI.

    Options replace fields of the section [assess]: --high 0.7 is --set assess.high=0.7.
    With --cars it estimates the probability that a car of the distribution in [sweep.over] meets all clauses.
    Exit status: 0 all clauses are met, 1 one is not, or undecided, 2 wrong input."""
    with console.end_on_errors():
        from diffabs.assess import StopProgram, assess
        from diffabs.assess.runs import tyre_fields
        from diffabs.scenario.section_sweep import build_study

        options = {"high": high, "low": low, "load": load, "fast": fast, "brief": brief, "adhesion": adhesion}
        changes = console.add_option_overrides(changes, "assess", **options, steering_ratio=steering_ratio)
        setup = console.load_scenario(scenario, changes)
        try:
            tyre_fields(setup.loop.plant)
            study = build_study(setup) if cars else None
            population = study.space.draw(study.seed, 0, cars, cars) if study else {}
            program = setup.assess or StopProgram()
            assessment = console.run_with_progress(
                lambda: assess(setup.loop, setup.solver, program, population),
                f"assessing {setup.name}",
            )
        except ValueError as error:
            raise ScenarioError(str(error)) from None
        result = result_document("assess", setup, {"program": plain_fields(program), **assessment.record()})
        show.show_result(as_json, partial(_show_assessment, assessment=assessment, scenario=setup), result)
        unmet = [f"{row.number} {row.verdict}" for row in assessment.clauses if row.confirmed and row.verdict != "met"]
        if unmet:
            console.conclude(f"{setup.name}: {', '.join(unmet)}")


def _show_assessment(result: JsonObject, assessment: "Assessment", scenario: Scenario) -> None:
    """Show the clauses, their figures and verdicts, and the probability that a car meets all."""
    several = assessment.cars > 1
    table = Table("clause", "rule", "figure", "limit", "verdict", *(["cars"] if several else []), "worst stop")
    for row in assessment.clauses:
        limit = f"{'>=' if row.at_least else '<='} {row.limit:.3g} {row.unit.replace('1', '')}".rstrip()
        met = [f"{row.met.mean():.2%}"] if several else []
        table.add_row(row.number, row.rule, f"{row.figure:.3g}", limit, row.verdict, *met, row.stop)
    tables.show_titled_table(f"{scenario.title or scenario.name}: {assessment.stops} stops", table)
    if any(not row.confirmed for row in assessment.clauses):
        console.say(UNCONFIRMED)
    else:
        console.say(ONE_TRACK)
    for row in assessment.clauses:
        if row.note:
            console.say(f"note: {row.number} {row.rule}: {row.note}")
    if assessment.unfinished:
        console.say(
            f"warning: {assessment.unfinished:,} runs diverged or did not reach 15 km/h; their cars do not pass"
        )
    if several:
        share = assessment.probability()
        console.say(
            f"{assessment.passed:,} of {assessment.cars:,} cars meet all clauses:"
            f" {share.value:.4g}, 95 % interval {share.low:.4g} to {share.high:.4g}"
        )
