"""The command `export`: the computer's part of a scenario as C, or as difference equations."""

import enum
import pathlib
import re
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from diffabs import __version__
from diffabs.cli import console, show
from diffabs.core.provenance import versions
from diffabs.scenario.scenario import Scenario


class Form(enum.StrEnum):
    """What can be written."""

    C = "c"
    TABLE = "table"


class Given(enum.StrEnum):
    """What can come from outside."""

    TARGET = "target"


def export(
    scenario: console.ScenarioName,
    to: Annotated[Form, typer.Option(help="One file of C99, or a table of difference equations.")] = Form.C,
    changes: console.Changes = None,
    out: Annotated[
        pathlib.Path | None, typer.Option("--out", "-o", metavar="FILE", help="Write to this file; default: stdout.")
    ] = None,
    single: Annotated[bool, typer.Option("--float32", help="Numbers of C in single precision.")] = False,
    given: Annotated[Given | None, typer.Option(help="What the C is given from outside, beside measurements.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="With --to table: one JSON document on stdout.")] = False,
) -> None:
    """The sampled controller, with filter, limits, anti-windup, schedule and target, as code for a computer."""
    with console.guarded():
        from diffabs.export import NotExported

        if to is Form.C and as_json:
            console.fail("--json is for --to table; C is text")
        if to is Form.TABLE and (single or given):
            console.fail("--float32 and --given are for --to c")
        with console.new_file(out, "--out") as file:
            chosen = console.loaded(scenario, changes, integrated=False)
            try:
                if to is Form.TABLE:
                    _table(chosen, file, as_json)
                    return
                text = console.waited(lambda: _source(chosen, out, single, given), f"tracing {chosen.name}")
            except NotExported as error:
                console.fail(f"{chosen.name}: {_hinted(str(error))}")
            file.write_text(text, encoding="utf-8") if file else typer.echo(text, nl=False)
        if out:
            console.say(f"c: {out}; try it with: cc -std=c99 -D{_name(chosen, out).upper()}_MAIN {out} -lm")


def _hinted(line: str) -> str:
    """With what the command line can do about it."""
    return line.replace("give the target from outside", "say --given target")


def _name(chosen: Scenario, out: pathlib.Path | None) -> str:
    """What functions begin with: the file's name, or the scenario's."""
    name = re.sub(r"\W", "_", out.stem if out else chosen.name)
    return name if name[:1].isalpha() else f"controller_{name}"


def _source(chosen: Scenario, out: pathlib.Path | None, single: bool, given: Any) -> str:
    from diffabs.export import c_source, device

    step = getattr(chosen.solver, "step", None)
    dtype = np.float32 if single else np.float64
    found = device(chosen.loop, step=step, dtype=dtype, given_target=given is Given.TARGET)
    title = f"Scenario {chosen.name}{f': {chosen.title}' if chosen.title else ''}."
    return c_source(found, _name(chosen, out), [title, f"Written by diffabs {__version__}."])


def _table(chosen: Scenario, file: pathlib.Path | None, as_json: bool) -> None:
    from diffabs.export import equations

    found = console.waited(lambda: equations(chosen.loop), f"linearising {chosen.name}")
    states = [f"x{i + 1}" for i in range(len(found["F"]))]
    columns = [*states, *(f"d {name}" for name in found["inputs"])]
    rows = {f"{x}(k+1)": [*f, *g] for x, f, g in zip(states, found["F"], found["G"], strict=True)}
    rows["d command(k)"] = [*found["H"], *found["J"]]
    if file:
        lines = [",".join(["", *columns]), *(",".join([name, *map(repr, row)]) for name, row in rows.items())]
        file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    elif as_json:
        show.as_json({"scenario": chosen.name, **found, "versions": versions()})
    else:
        _shown(chosen, found["period"], columns, rows)


def _shown(chosen: Scenario, period: float, columns: list[str], rows: dict[str, list[float]]) -> None:
    table = Table("next", *columns)
    for name, row in rows.items():
        table.add_row(name, *(f"{value:.8g}" for value in row))
    show.titled(f"{chosen.title or chosen.name}: every {1e3 * period:g} ms, at k", table)
    console.say("note: d is the difference from rest on the setpoint, x that of what is remembered; limits do not act")
