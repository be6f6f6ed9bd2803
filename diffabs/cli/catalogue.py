"""The commands `list` and `show`: all parts with their parameters, the packaged scenarios, a scenario as TOML."""

import pathlib
from typing import Annotated

import typer

from diffabs.cli import console, show, targets
from diffabs.core.types import JsonObject
from diffabs.host import values
from diffabs.scenario import registry
from diffabs.scenario.scenario import dump, names, read_header

PLURALS = {f"{name}s": name for name in ("plant", "road", "controller", "reference", "actuator", "sensor")}
PLURALS |= {"feedforward": "feedforward", "antiwindup": "antiwindup", "initial": "initial"}
PLURALS |= {"stops": "stop", "objectives": "objective"}
LISTED_FAMILIES = (*PLURALS, "scenarios")


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
        result = {name: _describe_family(name) for name in LISTED_FAMILIES if family in (None, name)}
        if as_json:
            return show.as_json(result)
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


def _describe_family(plural: str) -> JsonObject:
    """Return the members of a family as plain values."""
    if plural == "scenarios":
        return {name: read_header(name) for name in names()}
    family = PLURALS[plural]
    return {
        name: {
            "summary": registry.part_summary(part),
            **({"unit": registry.unit_of(part)} if family == "objective" else {}),
            "parameters": registry.describe_part(family, part),
        }
        for name, part in registry.family_types(family).items()
    }
