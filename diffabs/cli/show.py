"""Output of the commands: tables for a person, JSON for a script."""

import math
import pathlib
from collections.abc import Callable, Mapping

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table

from diffabs.cli.console import say
from diffabs.cli.tables import open_console, show_titled_table
from diffabs.core.summary import format_metric, round_for_table
from diffabs.core.types import JsonObject
from diffabs.host import documents
from diffabs.papers.digest import Digest
from diffabs.scenario.registry import unit_of
from diffabs.scenario.scenario import Scenario
from diffabs.scenario.tuning import format_shortfall, numbers_at_bounds

PROOF = {"decay_rate": "1/s", "damping": "1", "trace_cost": "", "guaranteed_cost": "", "lower_bound": "", "gap": "1"}
COSTS = {
    "trace_cost": "trace cost bounds the sum of the costs x'Px of runs from 1 in each single state.",
    "guaranteed_cost": "guaranteed cost bounds the same sum for this gain, proved in exact fractions.",
    "lower_bound": "lower bound: no common gain costs less.",
    "gap": (
        "The gain minimises the trace cost, for which one P proves all specifications. gap bounds the relative saving"
        " by another gain. The guaranteed cost has a P of its own and may be lower."
    ),
}


def as_json(value: object) -> None:
    """Print one JSON document to stdout; a number without a form in JSON becomes null."""
    typer.echo(documents.format_document(value))


def show_result(json_wanted: bool, view: Callable[..., None], result: JsonObject, *more: object) -> None:
    """Print the JSON document of a result, or show it by its view, which also gets `more`."""
    as_json(result) if json_wanted else view(result, *more)


def show_run(result: JsonObject, scenario: Scenario) -> None:
    """Show metrics with their units, the files written, and the accuracy if it was checked."""
    table = Table("metric", "value", "unit")
    for name, value in result["metrics"].items():
        table.add_row(name, format_metric(value), unit_of(scenario.objectives[name], scenario.loop.plant))
    show_titled_table(scenario.title or scenario.name, table)
    show_files(result)
    if "accuracy" in result:
        show_accuracy(result["accuracy"])


def show_accuracy(accuracy: JsonObject) -> None:
    """Show the changes of the metrics by shorter steps and by single precision."""
    table = Table("metric", "half step", "relative", "order", "error", "float32")
    for name, row in accuracy["metrics"].items():
        order = "none" if not row["converges"] else "" if math.isnan(row["order"]) else f"{row['order']:.1f}"
        numbers = (row["difference"], row["relative"], row["error"], row["float32 difference"])
        half, relative, error, single = ("" if x is None or math.isnan(x) else f"{x:.1e}" for x in numbers)
        table.add_row(name, half, relative, order, error, single)
    show_titled_table("change by a half step, order, error at this step, change in float32", table)


def show_family(name: str, members: JsonObject) -> None:
    """Show the members of a family, field by field; or the scenarios."""
    if name == "scenarios":
        table = Table("name", "title", "description")
        for member, header in members.items():
            table.add_row(member, header["title"], header["description"])
    else:
        table = Table("type", "field", "default", "unit", "range", "meaning")
        for member, about in members.items():
            member = f"{member} [{about['unit']}]" if about.get("unit") else member
            for role, channels in about.get("channels", {}).items():
                table.add_row(member, role, ", ".join(channels), ", ".join(channels.values()), "", "")
                member = ""
            fields = about["parameters"] or {"": {"default": "", "unit": "", "range": "", "meaning": ""}}
            for field, row in fields.items():
                range_ = row["range"].removesuffix(row["unit"])
                table.add_row(member, field, format_brief(row["default"]), row["unit"], range_, row["meaning"])
                member = ""
            table.add_section()
    show_titled_table(name, table)


def show_paper(digest: Digest, folder: pathlib.Path) -> None:
    """Show the compact result of a paper, and the folder of its files."""
    open_console().print(show_digest(digest))
    say(f"{digest.figures} figures, summary.json and report.html: {folder}\n")


def show_digest(digest: Digest) -> Group:
    """Return title, table, number of agreeing values and verdicts of a paper, in 80 columns."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for heading, *cells in zip(digest.headings, *digest.lines, strict=True):
        words = heading == digest.headings[0] or any(cell[:1].isalpha() for cell in cells)
        table.add_column(heading, justify="left" if words else "right", overflow="fold")
    for line in digest.lines:
        table.add_row(*line)
    verdicts = Table.grid(padding=(0, 2, 0, 0))
    for word, sentence in digest.verdicts:
        verdicts.add_row(word, sentence)
    return Group(digest.title, table, *digest.agreement, verdicts)


def show_proof(result: JsonObject, title: str, units: Mapping[str, str], verdict: str) -> None:
    """Show a gain, the proof, and the vertices of its polytope."""
    gains = Table("state", "gain")
    for state, value in zip(result["states"], result["gain"], strict=True):
        gains.add_row(state, f"{value:.8g}")
    show_titled_table(title, gains)
    numbers = Table("quantity", "value", "unit")
    numbers.add_row("common Lyapunov matrix" if result["besides"] else "quadratically stable", verdict, "")
    if further := result["besides"]:
        loops, fall = further["frozen"], further["proved_for_a_speed_falling_by"]
        numbers.add_row("systems of the ranges, each fixed", f"{loops['stable']} of {loops['systems']} stable", "")
        numbers.add_row("slowest of them decays at", f"{loops['slowest']:.6g}", "1/s")
        if fall is not None:
            numbers.add_row("proved stable for a speed falling by no more than", f"{fall:.4g}", "m/s^2")
    numbers.add_row("verified exactly", "yes" if result["verified_exactly"] else "no", "")
    for name, unit in PROOF.items():
        if result[name] is not None:
            numbers.add_row(name.replace("_", " "), f"{result[name]:.8g}", unit)
    show_titled_table("proof", numbers)
    if sentences := [sentence for name, sentence in COSTS.items() if result[name] is not None]:
        open_console().print(" ".join(sentences))
    corners = result["corners"] or [{} for _ in result["poles"]]
    discrete = result["period"] is not None
    names = [f"{name} [{units[name]}]" for name in corners[0]]
    vertices = Table("vertex", *names, "largest |pole| [1]" if discrete else "slowest pole, real part [1/s]")
    for i, (corner, pole) in enumerate(zip(corners, result["poles"], strict=True)):
        vertices.add_row(str(i), *(f"{value:.6g}" for value in corner.values()), f"{pole:.6g}")
    covered = (
        result["coverage"] and f"; their hull covers {result['coverage']['checked']} systems checked within the ranges"
    )
    show_titled_table(f"{result['vertices']} vertices{covered or ', the systems on a grid of the ranges'}", vertices)


def show_verification(result: JsonObject, json_wanted: bool) -> None:
    """Show a line for each claim, or the JSON document.

    A claim is "proved", "NOT PROVED", or "not refuted" if only a sample of the cells was proved again (`complete`).
    """
    if json_wanted:
        return as_json(result)
    console = open_console()
    proved = "proved" if result.get("complete", True) else "not refuted"
    for claim in result["claims"]:
        line = f"{proved if claim['proved'] else 'NOT PROVED'}  {claim['kind']}: {claim['says']}"
        console.print(line, soft_wrap=not console.is_terminal)
    return None


def show_tuning(result: JsonObject, scenario: Scenario) -> None:
    """Show parameters, metrics and constraints before and after, and the course of the tuning."""
    free = Table("parameter", "before", "after", "low", "high", "unit")
    for path, row in result["free"].items():
        free.add_row(path, *(format_brief(row[key]) for key in ("before", "after", "low", "high")), row["unit"])
    show_titled_table(f"{scenario.title or scenario.name}: free parameters", free)
    metrics = Table("metric", "mean before", "mean after", "worst before", "worst after", "unit")
    for name in result["metrics"]["before"]["mean"]:
        numbers = (result["metrics"][when][of][name] for of in ("mean", "worst") for when in ("before", "after"))
        metrics.add_row(name, *map(format_brief, numbers), unit_of(scenario.objectives[name], scenario.loop.plant))
    show_titled_table(f"over {result['lanes']} run{'s' if result['lanes'] > 1 else ''}", metrics)
    if result["constraints"]:
        limits = Table("constraint", "bound", "before", "after", "met")
        for row in result["constraints"]:
            numbers = ("" if row[key] is None else format_brief(row[key]) for key in ("bound", "before", "after"))
            limits.add_row(row["name"], *numbers, "yes" if row["met"] else f"NO, {format_shortfall(row)}")
        show_titled_table("constraints, worst run or vertex", limits)
    how = Table("tuning", "")
    for name in ("before", "after"):
        how.add_row(f"objective {name}", format_brief(result["objective"][name]))
    how.add_row("gradients computed", str(result["evaluations"]))
    how.add_row("gradient mode", result["mode"])
    how.add_row("greatest component of the last gradient", f"{result['gradient_norm']:.2g}")
    how.add_row("it ended because", result["reason"])
    if bounds := list(numbers_at_bounds(result["free"])):
        how.add_row("parameters at bounds", ", ".join(bounds))
    show_titled_table("", how)
    show_files(result)


def show_identification(result: JsonObject) -> None:
    """Show values with standard deviations, residuals and strong correlations."""
    values = Table("parameter", "before", "identified", "standard deviation", "unit")
    for name, row in result["values"].items():
        deviation = row["why"] if row["deviation"] is None else f"{row['deviation']:.3g}"
        values.add_row(name, format_brief(row["before"]), format_brief(row["value"]), deviation, row["unit"])
    show_titled_table(f"{result['scenario']}: identified from {result['data']['samples']} instants", values)
    residuals = Table("column", "sigma", "rms", "mean", "largest", "unit")
    for name, row in result["residuals"].items():
        residuals.add_row(name, *(f"{row[key]:.3g}" for key in ("sigma", "rms", "mean", "largest")), row["unit"])
    show_titled_table("simulated minus measured", residuals)
    for row in result["correlations"]:
        say(f"note: {row['between'][0]} and {row['between'][1]} are correlated by {row['correlation']:.4f}")
    for line in result["notes"]:
        say(f"note: {line}")
    say(f"it ended because {result['reason']}, after {result['evaluations']} evaluations")
    show_files(result)


def show_files(result: JsonObject) -> None:
    """Write the names of the written files to stderr."""
    for name, path in result["files"].items():
        say(f"{name}: {path}")


def format_brief(value: object) -> str:
    """Return a number with six digits, or the first four entries of a list."""
    if isinstance(value, list):
        return f"[{', '.join(map(format_brief, value[:4]))}{', ...' if len(value) > 4 else ''}]"
    return round_for_table(value) if isinstance(value, float) else str(value)
