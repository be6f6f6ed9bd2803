"""Tables of the commands on many samples: a sweep, a small probability, a comparison of two sweeps."""

import math
from typing import TYPE_CHECKING

from rich.table import Table

from diffabs.cli.console import say
from diffabs.cli.show import format_brief
from diffabs.cli.tables import show_titled_table
from diffabs.core.types import JsonObject
from diffabs.scenario.registry import unit_of
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.uncertainty.sweep import Results


def show_sweep(result: JsonObject, scenario: Scenario) -> None:
    """Show failures, statistics with intervals, sensitivities and the worst samples of a sweep."""
    percent = f"{100 * result['confidence']:g} % intervals: {result['intervals']}"
    show_titled_table(
        f"{scenario.title or scenario.name}: {result['samples']} runs; {percent}", _failures(result["failures"])
    )
    constant = [name for name, row in result["metrics"].items() if row and row["least"] == row["greatest"]]
    moving = {name: row for name, row in result["metrics"].items() if name not in constant}
    show_titled_table(
        "statistics of the runs that did not diverge; summary.json has all intervals", _statistics(moving, scenario)
    )
    for name in constant:
        unit = unit_of(scenario.objectives[name], scenario.loop.plant)
        say(f"{name} is {format_brief(result['metrics'][name]['mean']['value'])} {unit} in every run")
    for name, row in result["never"].items():
        where = f"{row['count']} runs, the first sample {row['samples'][0]}"
        say(f"warning: {name} is infinite (never) or not a number in {where}: its statistics leave them out")
    paths = list(next(iter(result["sensitivity"].values()), {}))
    if paths:
        kind = list(next(iter(result["sensitivity"].values()))[paths[0]])[-1]
        moves = Table("metric", *paths)
        for name, row in result["sensitivity"].items():
            if name in constant:
                continue
            moves.add_row(
                name, *("" if row[p][kind]["value"] is None else f"{row[p][kind]['value']:.3f}" for p in paths)
            )
        show_titled_table({"spearman": "rank correlations", "total": "total Sobol' indices"}[kind], moves)
    if (refused := result["refused"])["count"]:
        why = "; ".join(f"{reason} ({count})" for reason, count in refused["reasons"].items())
        say(
            f"refused: {refused['count']} of {result['samples']} samples were not run and are left out of all numbers,"
            f" the first sample {refused['samples'][0]}: {why}"
        )
    if result["accuracy"] and result["accuracy"]["metrics"]:
        changes = Table("metric", "median change", "largest", "in sample")
        for name, row in result["accuracy"]["metrics"].items():
            changes.add_row(name, f"{row['median']:.1e}", f"{row['largest']:.1e}", str(row["sample"]))
        count = len(result["accuracy"]["samples"])
        show_titled_table(
            f"relative change by a half step, in {count} run{'s' if count > 1 else ''} drawn from all", changes
        )
    for name, rows in result["worst"].items():
        if rows:
            say(f"greatest {name}: {format_brief(rows[0]['value'])} in sample {rows[0]['sample']}")
    if "report" in result["files"]:
        say(f"report: {result['files']['report']}")
    say(f"chunks and summary.json: {result['out']}; table {result['digest'][:16]}")


def _failures(failures: JsonObject) -> Table:
    """Return a table with a row for each failure that occurred, and one row for all others."""
    table = Table("failure", "runs", "probability", "low", "high")
    for name, row in failures.items():
        if row["count"]:
            table.add_row(name, str(row["count"]), *_estimate(row))
    unseen = [name for name, row in failures.items() if not row["count"]]
    if unseen:
        table.add_row(", ".join(unseen), "0", *_estimate(failures[unseen[0]]))
    return table


def _statistics(metrics: JsonObject, scenario: Scenario) -> Table:
    """Return a table with a row for each metric; only the mean has its interval."""
    kinds = [
        kind for kind in next((row for row in metrics.values() if row), {}) if kind not in ("mean", "least", "greatest")
    ]
    table = Table("metric", "unit", "mean", "low", "high", *kinds)
    for name, row in metrics.items():
        unit = unit_of(scenario.objectives[name], scenario.loop.plant)
        cells = [*_estimate(row["mean"]), *(_estimate(row[kind])[0] for kind in kinds)] if row else []
        table.add_row(name, unit, *cells)
    return table


def show_rare_event(result: JsonObject, scenario: Scenario) -> None:
    """Show a small probability, its levels, and the likeliest failures."""
    levels = Table("level", "metric", "share", "coefficient of variation", "accepted", "diverged")
    for i, row in enumerate(result["levels"], 1):
        reached = f"{'>' if row['strict'] else '>='} {row['threshold']:.4g}"
        numbers = (f"{row[name]:.4g}" for name in ("share", "cov", "acceptance"))
        levels.add_row(str(i), reached, *numbers, str(row["diverged"]))
    show_titled_table(
        f"{scenario.title or scenario.name}: {result['metric']} > {result['bound']:g} {result['unit']}", levels
    )
    estimates = Table("estimate", "probability", "low", "high", "coefficient of variation")
    for name in ("first level alone", "subset simulation", "importance sampling"):
        if row := result[name]:
            numbers = (f"{x:.4g}" for x in (*row["interval"], row["cov"]))
            estimates.add_row(name, _format_probability(row["probability"]), *numbers)
    low, high = result["interval"]
    probability = _format_probability(result["probability"])
    show_titled_table(f"probability {probability}, 95 % interval {low:.3g} to {high:.3g}", estimates)
    count = len(next(iter(result["failures"].values()), ()))
    failures = Table("likeliest failures", *map(str, range(1, count + 1)))
    for path, column in result["failures"].items():
        failures.add_row(path, *map(format_brief, column))
    if result["failures"]:
        show_titled_table("", failures)
    say(f"{result['note']}; {result['reason']}")
    say(f"{result['runs']} runs and {result['gradients']} gradients; {result['diverged']} diverged")


def _format_probability(probability: float) -> str:
    return "undecided" if math.isnan(probability) else f"{probability:.4g}"


def show_comparison(result: JsonObject) -> None:
    """Show means of two sweeps, and their difference sample by sample."""
    table = Table("metric", "first", "second", "second - first", "low", "high", "less in", "variance reduction")
    for name, row in result["metrics"].items():
        if row["difference"] is None:
            table.add_row(name)
            say(f"warning: {name} is finite in {row['samples']} common samples: too few for statistics")
            continue
        if row["never"]:
            where = f"{row['never']} common samples"
            say(f"warning: {name} is infinite (never) or not a number in {where}: its statistics leave them out")
        less = f"{100 * row['share in which the second is less']['value']:.1f} %"
        means = (format_brief(row[key]) for key in ("first", "second"))
        table.add_row(name, *means, *_estimate(row["difference"]), less, format_brief(row["variance reduction"]))
    out = f", {result['left out']} left out that diverged or were refused" if result["left out"] else ""
    show_titled_table(f"{result['second']} against {result['first']}: {result['samples']} common samples{out}", table)
    say("variance reduction: factor by which sweeps without common samples would need more samples")


def _estimate(row: JsonObject) -> list[str]:
    return ["" if row[key] is None else format_brief(row[key]) for key in ("value", "low", "high")]


def say_unused_seed(scenario: Scenario) -> None:
    """Say that the seed of the solver has no effect on a study of samples, if a scenario gives one."""
    if scenario.seed:
        say(f"note: solver.seed = {scenario.seed} has no effect: sweep.seed decides the noise of a sweep")


def warn_of_strays(results: "Results") -> None:
    """Warn of files among the chunks that are not part of the sweep: other readers would read them too."""
    if results.strays:
        more = f" (and {len(results.strays) - 1} more)" if results.strays[1:] else ""
        say(f"warning: {results.strays[0]}{more} is not a chunk of this sweep; other programs would read it, too")
