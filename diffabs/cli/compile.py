"""The command `compile`: the program of a kernel after each pass of the compiler."""

import pathlib
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.table import Table

from diffabs.cli import console, show, tables, targets
from diffabs.compiler.listing import count_by_level
from diffabs.compiler.lower.rules import Unsupported
from diffabs.compiler.passes import PASSES, LaneCall, find_lane_calls, list_pass
from diffabs.compiler.runtime.jax_primitive import MAX_TANGENTS_PER_LAUNCH
from diffabs.compiler.runtime.toolchain import NoCompiler
from diffabs.core.pytree import get, parameters
from diffabs.core.types import Array, JsonObject
from diffabs.engine.drive.engine import EngineError
from diffabs.host import documents
from diffabs.host.values import ScenarioError, unknown_name_error
from diffabs.loop.batch import Batch
from diffabs.loop.ensemble import run_batch
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
            values, derivative = console.run_with_progress(lambda: _trace(setup, paths), f"tracing {setup.name}")
            if name:
                # With --by every pass shows the program with tangents; without it only jvp, which values do not have.
                call = derivative if by or name == "jvp" else values
                text = console.run_with_progress(lambda: list_pass(call, name), f"pass {name}")
                file.write_text(text, encoding="utf-8") if file else typer.echo(text, nl=False)
                return
            result = console.run_with_progress(lambda: _count(setup, paths, values, derivative), "counting")
        show.as_json(result) if as_json else _show(result, setup)


def _differentiated_paths(scenario: Scenario, by: list[str]) -> list[str]:
    """Return the parameters to differentiate by: `by`, else the plant's first tunable number. Raises ScenarioError."""
    tunable = {
        path: spec
        for path, spec, value in parameters(scenario.loop)
        if spec.tunable and np.ndim(np.asarray(value)) == 0
    }
    if by:
        for path in by:
            if path not in tunable:
                raise unknown_name_error(f"--by {path} is no tunable number of this loop", path, tunable)
        if len(set(by)) != len(by):
            raise ScenarioError(f"--by {', '.join(by)}: a parameter is given twice")
        if len(by) > MAX_TANGENTS_PER_LAUNCH:
            raise ScenarioError(f"--by is given {len(by)} times, outside [1, {MAX_TANGENTS_PER_LAUNCH}]")
        return by
    first = [path for path in tunable if path.startswith("plant.")] or list(tunable)
    if not first:
        raise ScenarioError(f"{scenario.name} has no tunable number, by which a kernel could be differentiated")
    return first[:1]


def _trace(scenario: Scenario, paths: list[str]) -> tuple[LaneCall, LaneCall]:
    """Return the kernel calls of one run: of its metrics, and of their derivatives by `paths`. Raises ScenarioError."""

    def run(x: Array) -> dict[str, Array]:
        values = {path: x[i][None] for i, path in enumerate(paths)}
        lanes, options = Batch(values, jnp.zeros(1, int)), (scenario.solver, scenario.objectives)
        return run_batch(scenario.loop, lanes, *options, together=False, engine="kernel").metrics

    x = jnp.asarray([float(get(scenario.loop, path)) for path in paths])
    try:
        jaxprs = [jax.make_jaxpr(function)(x) for function in (run, jax.jacfwd(run))]
        values, derivative = (next(find_lane_calls(jaxpr)) for jaxpr in jaxprs)
    except (EngineError, NoCompiler, Unsupported) as error:
        raise ScenarioError(f"{scenario.name} has no kernel: {error}") from None
    return values, derivative


def _count(scenario: Scenario, paths: list[str], values: LaneCall, derivative: LaneCall) -> JsonObject:
    """Return the numbers of operations by pass and level, for --json; `paths` are those of the tangents."""
    programs = {
        "lower": values.lanes.derivative(None).program,
        "eliminate": values.program(),
        "lower, for derivatives": derivative.lanes.derivative(None).program,
        "jvp": derivative.lanes.derivative(derivative.seeds).program,
        "eliminate, with tangents": derivative.program(),
    }
    operations = {name: count_by_level(program) for name, program in programs.items()}
    return documents.stamp("compile", {**console.describe_source(scenario), "by": paths, "operations": operations})


def _show(result: JsonObject, scenario: Scenario) -> None:
    """Print the numbers of operations as a table."""
    table = Table("after pass", "once a launch", "once a run", "in each step")
    for name, counts in result["operations"].items():
        table.add_row(name, *(str(counts[level]) for level in ("uniform", "lane", "step")))
    by = ", ".join(result["by"])
    tables.show_titled_table(f"{scenario.title or scenario.name}: operations of its kernel; tangents by {by}", table)
