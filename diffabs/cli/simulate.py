"""The command `simulate`: one run of a scenario."""

import contextlib
import functools
import pathlib
from typing import Annotated

import typer

from diffabs.cli import console, show, targets
from diffabs.core.pytree import parameters
from diffabs.core.types import JsonObject
from diffabs.host import documents, provenance
from diffabs.loop.checking import describe_check
from diffabs.loop.convert import write_csv
from diffabs.loop.matlab import write_mat
from diffabs.loop.result import Run
from diffabs.scenario.samples import load_sample
from diffabs.scenario.scenario import Scenario
from diffabs.scenario.simulation import simulate as run_scenario

MAX_CSV_ROWS = 20_000  # of a trajectory


def simulate(
    scenario: Annotated[
        str | None,
        typer.Argument(
            autocompletion=console.scenarios_like,
            help="TOML file, or name of a packaged scenario.",
            show_default=False,
        ),
    ] = None,
    changes: console.Changes = None,
    as_json: console.Json = False,
    csv: Annotated[pathlib.Path | None, typer.Option(help="Write the trajectory to this file.")] = None,
    mat: Annotated[pathlib.Path | None, typer.Option(help="Write trajectory, units and metrics for MATLAB.")] = None,
    plot: Annotated[pathlib.Path | None, typer.Option(help="Draw the run to this file (.png, .pdf, .svg).")] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the noise of sensors; the same as --set solver.seed=N.")
    ] = None,
    from_sweep: Annotated[
        pathlib.Path | None, typer.Option(metavar="DIR", help="Folder of a sweep; run one of its samples again.")
    ] = None,
    sample: Annotated[int | None, typer.Option(help="Number of the sample, with --from-sweep.")] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Also run half and quarter steps, and show the accuracy of each metric.")
    ] = False,
) -> None:
    """Run a scenario once and show its metrics."""
    with console.end_on_errors():
        if (scenario is None) == (from_sweep is None):
            console.fail("either SCENARIO or --from-sweep DIR --sample N is needed")
        if (from_sweep is None) != (sample is None):
            console.fail("--from-sweep DIR and --sample N need each other")
        if from_sweep and (changes or seed is not None):
            console.fail("--from-sweep runs a sample unchanged: --set and --seed do not apply")
        targets.check_picture(plot)
        targets.check_mat(mat)
        max_rows = MAX_CSV_ROWS if csv or mat or plot else 0
        with contextlib.ExitStack() as files:
            csv_file = files.enter_context(targets.new_target_file(csv, "--csv"))
            mat_file = files.enter_context(targets.new_target_file(mat, "--mat"))
            picture = files.enter_context(targets.new_target_file(plot, "--plot"))
            if from_sweep and sample is not None:
                console.need_extra("sweep")
                setup, key = console.run_with_progress(
                    lambda: load_sample(from_sweep, sample, "--sample"), "reading the sweep"
                )
            else:
                overrides = console.add_option_overrides(changes, "solver", seed=seed)
                setup = console.load_scenario(scenario or "", overrides)
                key = setup.key()
            simulation = console.run_with_progress(
                lambda: run_scenario(setup, key, max_rows=max_rows), f"simulating {setup.name}"
            )
            accuracy = console.run_with_progress(simulation.accuracy, "shortening the step") if check else None
            lines = describe_check(accuracy) if accuracy else simulation.loose_metrics()
            result = documents.stamp("simulate", simulation.record())
            result |= {"versions": provenance.versions(), "files": {}}
            if from_sweep:  # the sweep's seed and the number of the sample decide the noise
                result["solver"]["seed"] = None
                result["sample"] = {"sweep": str(from_sweep), "seed": setup.sweep.seed, "number": sample}
            if accuracy:
                result["accuracy"] = accuracy
            show_result = functools.partial(show.show_result, as_json, show.show_run, result, setup)
            with console.show_before_errors(show_result):
                if csv_file:
                    write_csv(csv_file, simulation.run, setup.loop.plant)
                if mat_file:
                    values = {path: value for path, _, value in parameters(setup.loop)}
                    write_mat(mat_file, simulation.run, setup.loop.plant, parameters=values, scenario=setup.name)
                if picture:
                    console.run_with_progress(lambda: _draw(setup, simulation.run, picture), "drawing")
        result["files"] |= {name: str(path) for name, path in (("csv", csv), ("mat", mat), ("plot", plot)) if path}
        show_result()
        for line in lines:
            console.say(f"warning: {line}")
        _judge(setup, result, simulation.slide())


def _judge(scenario: Scenario, result: JsonObject, slides: str) -> None:
    """Write the warnings, also that the run `slides`. Raises typer.Exit for a diverged run, which has no metrics."""
    if result["diverged"]:
        why = f"{result['fault']}; there are no metrics"
        console.fail(f"{scenario.name}: {slides}" if slides else f"{scenario.name} diverged: {why}", 1)
    if slides:
        console.say(f"warning: {slides}")
    for warning in result["warnings"]:
        console.say(f"warning: {warning}")


def _draw(scenario: Scenario, run: Run, picture: pathlib.Path) -> None:
    from diffabs.output.plot import draw_run

    unit = getattr(scenario.loop.plant, "control_unit", "")
    draw_run(run, title=scenario.title or scenario.name, unit=unit).savefig(picture)
