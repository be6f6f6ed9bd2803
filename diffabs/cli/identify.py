"""The command `identify`: parameters of a scenario from a measured run.

It needs the extra `tune`. Modules that need it are imported only when the command runs.
"""

import functools
import pathlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated

import typer

from diffabs.cli import certificates, console, identify_options, progress, show, targets
from diffabs.scenario import section_tune
from diffabs.scenario.measurements import Readings, read_separator
from diffabs.scenario.model import result_document
from diffabs.scenario.scenario import Scenario, dump

if TYPE_CHECKING:
    from diffabs.tune.identify.fit import Identified


def identify(
    scenario: console.ScenarioName,
    data: Annotated[
        pathlib.Path,
        typer.Option(metavar="FILE.csv", help="Measured run, as simulate --csv writes it, or a logger."),
    ],
    free: Annotated[
        list[str],
        typer.Option(metavar="PATH[=LOW:HIGH]", help="Parameter to identify, and its range; may be repeated."),
    ],
    sigma: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN=NUMBER",
            help="Standard deviation of a column's noise; default: estimated from the residuals.",
        ),
    ] = None,
    column: Annotated[
        list[str] | None, typer.Option(metavar="COLUMN", help="Compare only this column; may be repeated.")
    ] = None,
    rename: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN=NAME", help="Signal, or t, that a column of the file holds, in SI; may be repeated."
        ),
    ] = None,
    separator: Annotated[
        str | None, typer.Option(metavar="CHARACTER", help="Between the cells, or `tab`; default: guessed.")
    ] = None,
    changes: console.Changes = None,
    as_json: console.Json = False,
    out: Annotated[
        pathlib.Path | None, typer.Option(metavar="FILE.toml", help="Write the scenario with the identified values.")
    ] = None,
) -> None:
    """Find parameters of a scenario from a measured run.

    Each value has a standard deviation. Parameters that the run does not determine are named."""
    with console.end_on_errors(), certificates.report_design_errors():
        console.need_extra("tune")
        from diffabs.tune.identify.noise import describe_residuals

        targets.check_scenario_file(out)
        with targets.new_target_file(out, "--out") as file:
            setup = console.load_scenario(scenario, changes)
            units = setup.loop.plant.shows.units
            file_form = identify_options.read_renames(rename or ()), read_separator(separator, "--separator")
            readings = identify_options.read_columns(data, column, setup.loop.plant, *file_form)
            noise = identify_options.read_noise(sigma or (), readings, units)
            ranges = identify_options.read_ranges(free, setup)
            fit, noise, interrupted = _fit_with_progress(setup, readings, ranges, noise)
            residuals = describe_residuals(fit, noise, units)
            values = {"data": readings.record(), **fit.record(setup.loop, ranges), "residuals": residuals}
            result = {**result_document("identify", setup, values, "optax", "scipy"), "interrupted": interrupted}
            show_result = functools.partial(show.show_result, as_json, show.show_identification, result)
            if interrupted:
                show_result()
                console.say("interrupted: these are the values so far, not the best ones; no file is written")
                raise typer.Exit(console.INTERRUPTED)
            if result["undetermined"]:  # inside `with`: the exception discards the file
                show_result()
                missing = "; ".join(row["direction"] for row in result["undetermined"])
                console.fail(f"{setup.name}: not identifiable from these data: {missing}", console.FAILED)
            if file:
                with console.show_before_errors(show_result):
                    file.write_text(dump(setup.with_loop(fit.part, "identified")), encoding="utf-8")
        result["files"] |= {"out": str(out)} if out else {}
        show_result()


def _fit_with_progress(
    scenario: Scenario,
    readings: Readings,
    ranges: Mapping[str, section_tune.Ends | None],
    fixed_noise: Mapping[str, float],
) -> tuple["Identified", dict[str, float], bool]:
    """Return the fit, its standard deviations by column, and True if Ctrl-C ended it."""
    from diffabs.tune.identify.noise import identify_with_noise

    far: list[str] = []

    def report_progress(evaluations: int, cost: float) -> None:
        far.append(f"{evaluations} evaluation{'s' if evaluations != 1 else ''}, cost {cost:.6g}")

    ending = console.InterruptibleEnd("the evaluation in hand", nothing=lambda: not far)
    fit, noise = console.run_with_progress(
        lambda: identify_with_noise(
            scenario.loop, readings.t, readings.columns, ranges,
            solver=scenario.solver, sigma=fixed_noise, progress=report_progress, stopping=ending,
        ),
        f"identifying {scenario.name}",
        lambda: far[-1] if far else progress.COMPILING,
        ending,
    )  # fmt: skip
    return fit, noise, ending.is_requested
