"""The command `compile`: the program of a kernel after each pass of the compiler."""

import pathlib
from typing import Annotated

import typer
from rich.table import Table

from diffabs.cli import console, show, tables, targets
from diffabs.compiler.passes import PASSES
from diffabs.compiler.runtime.jax_primitive import MAX_TANGENTS_PER_LAUNCH
from diffabs.core.types import JsonObject
from diffabs.host import documents
from diffabs.host.values import ScenarioError, unknown_name_error
from diffabs.loop.kernel_programs import KernelPrograms, trace_kernel, tunable_numbers
from diffabs.scenario.model import describe_source
from diffabs.scenario.scenario import Scenario


def compile_scenario(
    scenario: console.ScenarioName,
    name: Annotated[
        str | None, typer.Option("--show", metavar="PASS", help=f"Print the program after a pass: {', '.join(PASSES)}.")
    ] = None,
    by: Annotated[
        list[str] | None,
        typer.Option("--by", metavar="PATH", help="Differentiate by this parameter; may be repeated."),
    ] = None,
    changes: console.Changes = None,
    out: Annotated[
        pathlib.Path | None, typer.Option("--out", "-o", metavar="FILE", help="File to write; default: stdout.")
    ] = None,
    as_json: console.Json = False,
) -> None:
    """Show the program of a kernel after each pass.

    Without --show it shows the number of operations after each pass, of values and of tangents. --show prints the
    program of values. With --by it prints the one with tangents. Only the pass jvp always has tangents. Without --by,
    the tangents are by the first tunable parameter of the plant."""
    with console.end_on_errors():
        if name is not None and name not in PASSES:
            raise unknown_name_error(f"--show {name} is unknown", name, PASSES)
        if name and as_json:
            console.fail("--json is for the numbers of operations; --show prints text")
        if out and not name:
            console.fail("--out is for the text of --show")
        with targets.new_target_file(out, "--out") as file:
            setup = console.load_scenario(scenario, changes)
            paths = _differentiated_paths(setup, by or [])
            programs = console.run_with_progress(lambda: _trace(setup, paths), f"tracing {setup.name}")
            if name:
                text = console.run_with_progress(lambda: programs.text(name, tangents=bool(by)), f"pass {name}")
                file.write_text(text, encoding="utf-8") if file else typer.echo(text, nl=False)
                return
            counts = console.run_with_progress(programs.counts, "counting")
        values = {**describe_source(setup), "by": paths, "operations": counts}
        result = documents.stamp("compile", values)
        show.show_result(as_json, _show, result, setup)


def _differentiated_paths(scenario: Scenario, by: list[str]) -> list[str]:
    """Return the parameters to differentiate by: `by`, else the plant's first tunable number. Raises ScenarioError."""
    tunable = tunable_numbers(scenario.loop)
    for path in by:
        if path not in tunable:
            raise unknown_name_error(f"--by {path} is no tunable number of this loop", path, tunable)
    if len(set(by)) != len(by):
        raise ScenarioError(f"--by {', '.join(by)}: a parameter is given twice")
    if len(by) > MAX_TANGENTS_PER_LAUNCH:
        raise ScenarioError(f"--by is given {len(by)} times, outside [1, {MAX_TANGENTS_PER_LAUNCH}]")
    paths = by or [path for path in tunable if path.startswith("plant.")][:1] or list(tunable)[:1]
    if not paths:
        raise ScenarioError(f"{scenario.name} has no tunable number, by which a kernel could be differentiated")
    return paths


def _trace(scenario: Scenario, paths: list[str]) -> KernelPrograms:
    try:
        return trace_kernel(scenario.loop, scenario.solver, scenario.objectives, paths)
    except ValueError as error:
        raise ScenarioError(f"{scenario.name} has no kernel: {error}") from None


def _show(result: JsonObject, scenario: Scenario) -> None:
    """Print the numbers of operations as a table."""
    table = Table("after pass", "once a launch", "once a run", "in each step")
    for name, counts in result["operations"].items():
        table.add_row(name, *(str(counts[level]) for level in ("uniform", "lane", "step")))
    by = ", ".join(result["by"])
    tables.show_titled_table(f"{scenario.title or scenario.name}: operations of its kernel; tangents by {by}", table)
