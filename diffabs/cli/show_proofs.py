"""The view of a proof over a box."""

from collections.abc import Mapping, Sequence

from rich.table import Table

from diffabs.cli.console import say
from diffabs.cli.tables import show_titled_table
from diffabs.core.types import JsonObject
from diffabs.scenario.parameter_paths import parameters_of
from diffabs.scenario.scenario import Scenario


def show_box_proof(result: JsonObject, scenario: Scenario) -> None:
    """Show the verdict and the proved bounds of a box."""
    box = describe_box(result["over"], scenario)
    table = Table("quantity", "proved from", "to", "unit", "worst run found", "looseness")
    for name, row in result["bounds"].items():
        ends = ("" if row[key] is None else f"{row[key]:z.6g}" for key in ("low", "high"))
        worst = f"{row['worst_run']:z.6g}" if "worst_run" in row else ""
        loose = f"{100 * row['looseness']:.2g} %" if row.get("looseness") is not None else ""
        table.add_row(name, *ends, row["unit"], worst, loose)
    if result["verdict"] == "proved":
        show_titled_table(f"{scenario.title or scenario.name}: proved for every {box}", table)
    for claim in result["claims"]:
        relation = ">=" if claim["quantity"].startswith("least") else "<="
        say(f"{result['verdict']}: {claim['quantity']} {relation} {claim['bound']:.6g}")
    say(f"{result['cells']:,} cells proved, {result['tried']:,} tried, {result['seconds']:.1f} s")


def show_frequency_proof(result: JsonObject, scenario: Scenario) -> None:
    """Show what is proved of each claim, beside the greatest sensitivity that was met."""
    table = Table("claim", "verdict", "greatest |S| found", "at", "cells", "seconds")
    for row in result["claims"]:
        worst = row["worst"] or {}
        place = ", ".join(f"{name} {worst[name]:.5g}" for name in worst if name not in ("sensitivity", "frequency"))
        where = f"{worst['frequency']:.5g} rad/s, {place}" if worst else ""
        size = f"{worst['sensitivity']:.6g}" if worst else ""
        table.add_row(row["claim"], row["verdict"], size, where, f"{row['cells']:,}", f"{row['seconds']:.1f}")
    show_titled_table(f"{scenario.title or scenario.name}: for every {describe_box(result['over'], scenario)}", table)


def describe_box(box: Mapping[str, Sequence[float]], scenario: Scenario, digits: int = 6) -> str:
    """Return a box in words, in SI units."""
    specs = parameters_of(scenario.loop)
    units = {path: "" if specs[path][0].unit == "1" else f" {specs[path][0].unit}" for path in box}
    return ", ".join(f"{path} {low:.{digits}g} to {high:.{digits}g}{units[path]}" for path, (low, high) in box.items())
