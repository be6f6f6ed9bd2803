"""The command `export`: a scenario's controller as C or Structured Text, or its plant as an FMU."""

import dataclasses
import enum
import pathlib
from typing import Annotated

import numpy as np
import typer

from diffabs import __version__
from diffabs.cli import console, targets
from diffabs.core.units import control_units
from diffabs.engine.solvers import FixedStep
from diffabs.host.values import ScenarioError
from diffabs.scenario.scenario import Scenario


class Form(enum.StrEnum):
    """A format of the output."""

    C = "c"
    ST = "st"
    FMU = "fmu"


class Given(enum.StrEnum):
    """A signal that the code can receive as an input."""

    TARGET = "target"


def export(
    scenario: console.ScenarioName,
    to: Annotated[
        Form,
        typer.Option(help="Controller as C99 or Structured Text (IEC 61131-3), or the plant as an FMU."),
    ] = Form.C,
    changes: console.Changes = None,
    out: Annotated[
        pathlib.Path | None, typer.Option("--out", "-o", metavar="FILE", help="File to write; default: stdout.")
    ] = None,
    single: Annotated[bool, typer.Option("--float32", help="Write numbers in single precision.")] = False,
    extra_input: Annotated[
        Given | None, typer.Option("--given", help="Signal that the code takes as a further input.")
    ] = None,
    period: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Sample the scenario's continuous controller with this period."),
    ] = None,
) -> None:
    """Write the sampled controller as code, or the plant as FMU.

    The code has the controller's filter, limits, anti-windup, schedule and target."""
    with console.end_on_errors():
        from diffabs.output.export import NotExported

        if to is Form.FMU and out is None:
            console.fail("--to fmu needs a file: -o plant.fmu")
        if to is Form.FMU and (single or extra_input):
            console.fail("--float32 and --given are for --to c and --to st")
        if to is Form.FMU and period is not None:
            console.fail("--period is for a controller; --to fmu writes the plant")
        with targets.new_target_file(out, "--out") as file:
            setup = console.load_scenario(scenario, changes, integrated=to is Form.FMU)
            setup = setup if period is None else _sample_controller(setup, period)
            try:
                if to is Form.FMU and file and out:
                    _write_fmu(setup, file, out)
                    return
                text = console.run_with_progress(
                    lambda: _write_source(setup, out, to, single, extra_input), f"tracing {setup.name}"
                )
            except NotExported as error:
                # The message names arguments of Python; here they are options of the command.
                line = str(error).replace("give the target from outside", "say --given target")
                line = line.replace("give the period at which", "say --period SECONDS, at which")
                console.fail(f"{setup.name}: {line}")
            file.write_text(text, encoding="utf-8") if file else typer.echo(text, nl=False)
        if out and to is Form.ST:
            console.say(f"st: {out}; call FUNCTION_BLOCK {_function_prefix(setup, out)} once a period")
        elif out:
            console.say(f"c: {out}; try it with: cc -std=c99 -D{_function_prefix(setup, out).upper()}_MAIN {out} -lm")


def _sample_controller(scenario: Scenario, period: float) -> Scenario:
    from diffabs.output.export import sample_controller

    try:
        return dataclasses.replace(scenario, loop=sample_controller(scenario.loop, period))
    except ValueError as error:
        raise ScenarioError(f"--period: {error}") from None


def _function_prefix(scenario: Scenario, out: pathlib.Path | None) -> str:
    """Return the prefix of the functions' names, from the name of the file or of the scenario."""
    from diffabs.output.export import make_identifier

    return make_identifier(out.stem if out else scenario.name)


def _write_source(scenario: Scenario, out: pathlib.Path | None, to: Form, single: bool, extra_input: object) -> str:
    from diffabs.output.export import c_source, computer_program, structured_text

    step = getattr(scenario.solver, "step", None)
    dtype = np.float32 if single else np.float64
    program = computer_program(scenario.loop, step=step, dtype=dtype, given_target=extra_input is Given.TARGET)
    title = f"Scenario {scenario.name}{f': {scenario.title}' if scenario.title else ''}."
    written = structured_text if to is Form.ST else c_source
    return written(program, _function_prefix(scenario, out), [title, f"Written by diffabs {__version__}."])


def _write_fmu(scenario: Scenario, file: pathlib.Path, out: pathlib.Path) -> None:
    """Write the plant with the scenario's fixed steps. Raises ScenarioError, NotExported."""
    from diffabs.output.export import build_fmu

    solver = scenario.solver
    if not isinstance(solver, FixedStep):
        raise ScenarioError("solver.type = adaptive: an FMU takes fixed steps, as in --set solver.type=fixed")
    name, about = _function_prefix(scenario, out), scenario.title or scenario.name
    times = {"step": float(solver.step), "duration": float(solver.duration)}
    data = console.run_with_progress(
        lambda: build_fmu(scenario.loop, name, **times, about=about), f"compiling the plant of {scenario.name}"
    )
    file.write_bytes(data)
    inputs = ", ".join(f"{name} [{unit}]" for name, unit in control_units(scenario.loop.plant).items())
    console.say(f"fmu: {out}; FMI 2.0 for co-simulation, input {inputs}")
