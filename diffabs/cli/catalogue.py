"""The commands `list` and `show`: all parts with their parameters, the packaged scenarios, a scenario as TOML."""

import pathlib
from typing import Annotated

import typer

from diffabs.cli import console, show, targets
from diffabs.host import documents, values
from diffabs.scenario.catalogue import LISTED_FAMILIES, PLURALS, describe_family
from diffabs.scenario.scenario import dump


def families_like(incomplete: str) -> list[str]:
    """Return completions of a family's name."""
    return [name for name in LISTED_FAMILIES if name.startswith(incomplete)]


def list_parts(
    family: Annotated[
        str | None,
        typer.Argument(
            metavar="[FAMILY]", help=f"Family to list: {', '.join(PLURALS)} or scenarios.", autocompletion=families_like
        ),
    ] = None,
    as_json: console.Json = False,
) -> None:
    """List all parts and packaged scenarios.

    A part is listed with its parameters, their defaults, units, ranges and meanings."""
    with console.end_on_errors():
        if family is not None and family not in LISTED_FAMILIES:
            raise values.unknown_name_error(
                f"there is no family {values.format_given(family)}", family, LISTED_FAMILIES
            )
        result = {name: describe_family(name) for name in LISTED_FAMILIES if family in (None, name)}
        if as_json:
            return show.as_json(documents.stamp("list", result))
        for name, members in result.items():
            show.show_family(name, members)
    return None


def show_scenario(
    scenario: console.ScenarioName,
    changes: console.Changes = None,
    out: Annotated[
        pathlib.Path | None, typer.Option(metavar="FILE.toml", help="File to write; default: stdout.")
    ] = None,
) -> None:
    """Print a scenario as TOML with every field.

    Edit the output to make a scenario of your own."""
    with console.end_on_errors():
        targets.check_scenario_file(out)
        text = dump(console.load_scenario(scenario, changes, integrated=False))
        with targets.new_target_file(out, "--out") as file:
            file.write_text(text, encoding="utf-8") if file else typer.echo(text, nl=False)
