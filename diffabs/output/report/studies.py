"""Sweeps and rare events as sections of a report."""

import pathlib
import shlex
from collections.abc import Iterator, Mapping

from diffabs.core.types import JsonObject, Table
from diffabs.output.report.documents import Document
from diffabs.output.report.page import (
    Figure,
    ReportTable,
    ReportVerdict,
    Section,
    describe_origin,
    embed_image,
    format_known,
    format_pairs,
    join_words,
    model_tables,
    table_unit,
)
from diffabs.scenario.model import describe_model
from diffabs.scenario.scenario import ScenarioError, loads
from diffabs.uncertainty.sweep.checking import describe_turned_metrics
from diffabs.uncertainty.sweep.manifest import read_manifest

FIGURES, UNDRAWN = "figures", "No figures: diffabs sweep ... --figures draws them."
CAPTIONS = {
    "distributions": "How the metrics are distributed, with medians, quantiles and bounds",
    "exceedance": "How often a value is exceeded",
    "failure_map": "Failures over the two most influential parameters",
    "sensitivity": "Sensitivities, with intervals",
    "worst": "The worst runs among all",
}
MAX_WORST_RUNS = 3  # shown for each metric
INTERVAL = ("value", "low", "high")


def sweep_section(document: Document) -> Section:
    """Return the section of a sweep."""
    content = document.content
    manifest = read_manifest(document.folder)
    study, source, units = manifest["study"], manifest["source"], manifest.get("units") or {}
    commit = {"commit": manifest["commit"]} if manifest.get("commit") else {}
    origin = content.get("made", {})  # a summary of `summarise_sweep` has none
    model, note = _scenario_model(source, document.folder)
    varied, percent = join_words(study["space"]["variables"]), f"{100 * content['confidence']:g} %"
    return Section(
        title=f"Sweep of {source.get('name') or document.folder.name}",
        question=f"How do {join_words(content['metrics'])} spread while {varied} vary, and how probable is a"
        " failure?",
        answer=[_failure_tables(content, percent)],
        model=[*model_tables(model), _space(study["space"], units)],
        model_note=note,
        figures=_figures(document.folder),
        figures_note="" if (document.folder / FIGURES).is_dir() else UNDRAWN,
        tables=list(_tables(content, units, percent)),
        notes=list(_notes(content)),
        provenance=describe_origin(
            {"versions": manifest["versions"], "made": {**origin, **commit}},
            seed=study["seed"], samples=study["samples"], numbers=study["dtype"],
            engine=format_pairs(study.get("engine") or {}) or "xla", digest=content["digest"],
        ),
        command=origin.get("command", ""),
        again=_sample(content, document.folder),
    )  # fmt: skip


def _scenario_model(source: Table, folder: pathlib.Path) -> tuple[JsonObject | None, str]:
    """Return the model in a manifest and a note; None and the reason for a manifest without a readable scenario."""
    if "scenario" not in source:
        return None, "The sweep ran from Python, without a scenario: the model is in that script."
    try:
        return describe_model(
            loads(source["scenario"].encode(), source.get("name", ""), f"{folder}", integrated=False)
        ), ""
    except ScenarioError as error:
        return None, f"The scenario in the manifest cannot be read here: {error}"


def _space(space: Table, units: Mapping[str, str]) -> ReportTable:
    """Return a table of the distributions."""
    variables = space["variables"]
    keys = list(dict.fromkeys(key for distribution in variables.values() for key in distribution if key != "type"))
    rows = [
        [path, distribution["type"], *(distribution.get(key) for key in keys), table_unit(units.get(path))]
        for path, distribution in variables.items()
    ]
    design = ", ".join(map(str, space["design"].values()))
    return ReportTable("Varied parameters", ("parameter", "distribution", *keys, "unit"), rows, f"sampling: {design}")


def _failure_tables(content: Table, percent: str) -> str:
    failures = content["failures"].get("any")
    lost = content["diverged"]["count"]
    line = f"{content['samples']:,} runs; {lost:,} diverged, {content['refused']['count']:,} were refused."
    if failures and failures["value"] is not None:
        line += f" {failures['count']:,} of {failures['samples']:,} failed: a probability of {failures['value']:.4g}"
        # A grid and corners are not random, so their documents have no interval.
        has_interval = None not in (failures["low"], failures["high"])
        line += f" ({percent} interval {failures['low']:.4g} to {failures['high']:.4g})." if has_interval else "."
    return line


def _figures(folder: pathlib.Path) -> list[Figure]:
    return [
        figure
        for path in sorted((folder / FIGURES).glob("*"))
        if (figure := embed_image(path, folder, CAPTIONS.get(path.stem, "")))
    ]


def _tables(content: Table, units: Mapping[str, str], percent: str) -> Iterator[ReportTable]:
    bounds = (f"low ({percent})", f"high ({percent})")
    failures = [[name, row["count"], *(row[key] for key in INTERVAL)] for name, row in content["failures"].items()]
    yield ReportTable(
        "Failures", ("failure", "runs", "probability", *bounds), failures, f"intervals: {content['intervals']}"
    )
    rows = [
        [name, table_unit(units.get(name)), kind, *(estimate[key] for key in INTERVAL)]
        for name, row in content["metrics"].items()
        for kind, estimate in (row or {}).items()
        if isinstance(estimate, dict)
    ]
    yield ReportTable("Statistics of the runs that did not diverge", ("metric", "unit", "", "value", *bounds), rows)
    moved = [
        [name, path, kind, *(estimate[key] for key in INTERVAL)]
        for name, row in content["sensitivity"].items()
        for path, kinds in row.items()
        for kind, estimate in list(kinds.items())[-1:]
        if estimate["value"] is not None
    ]
    if moved:
        yield ReportTable("Sensitivities", ("metric", "parameter", "measure", "value", *bounds), moved)
    worst = [
        [name, table_unit(units.get(name)), row["value"], row["sample"]]
        for name, rows in content["worst"].items()
        for row in rows[:MAX_WORST_RUNS]
    ]
    yield ReportTable("The greatest values", ("metric", "unit", "value", "sample"), worst)
    if (accuracy := content.get("accuracy")) and accuracy.get("metrics"):
        rows = [[name, row["median"], row["largest"], row["sample"]] for name, row in accuracy["metrics"].items()]
        title = f"Relative change by a half step, in {len(accuracy['samples'])} runs drawn from all"
        yield ReportTable(title, ("metric", "median", "largest", "in sample"), rows)


def _notes(content: Table) -> Iterator[str]:
    for reason, count in (content["refused"].get("reasons") or {}).items():
        yield f"Refused samples, left out of all numbers: {count}, {reason}"
    if content["diverged"]["count"]:
        yield f"Diverged samples: {join_words(content['diverged']['samples'][:20])}."
    for name, row in content["never"].items():
        runs = f"{row['count']}, the first is sample {row['samples'][0]}"
        yield f"Runs with an infinite {name} (never), left out of its statistics: {runs}"
    yield from describe_turned_metrics(content.get("accuracy") or {})


def _sample(content: Table, folder: pathlib.Path) -> list[str]:
    worst = next((rows[0]["sample"] for rows in content["worst"].values() if rows), None)
    command = ["diffabs", "simulate", "--from-sweep", str(folder), "--sample", str(worst)]
    return [] if worst is None else [shlex.join(command)]


def rare_section(document: Document) -> Section:
    """Return the section of a small failure probability."""
    content = document.content
    low, high = (format_known(end, 3) for end in content["interval"])
    failure = f"{content['metric']} > {content['bound']:g} {content['unit']}"
    columns = ("threshold", "share", "cov", "acceptance", "diverged")
    levels = [
        [i, "above" if row.get("strict") else "at least", *(row[key] for key in columns)]
        for i, row in enumerate(content["levels"], 1)
    ]
    estimates = [
        [name, row["probability"], *row["interval"], row["cov"]]
        for name in ("first level alone", "subset simulation", "importance sampling")
        if (row := content.get(name))
    ]
    failing = [[path, *column] for path, column in content["failures"].items()]
    # JSON has no NaN: null stands for a probability that is undecided, as no sample failed.
    probability = "undecided" if content["probability"] is None else f"{content['probability']:.3g}"
    count = max((len(row) for row in failing), default=1) - 1
    return Section(
        title=f"A rare failure of {content['scenario']}",
        question=f"How probable is {failure}, while what [sweep.over] names varies?",
        answer=[f"{probability}, 95 % interval {low} to {high}. Diverged runs: {content['diverged']:,}."],
        verdicts=[ReportVerdict("ended", content["reason"])],
        model=model_tables(content["model"]),
        tables=[
            ReportTable("Estimates", ("by", "probability", "low (95 %)", "high (95 %)", "coefficient of variation"),
                  estimates),
            ReportTable("Levels", ("level", "metric", f"threshold [{content['unit']}]", "share",
                             "coefficient of variation", "accepted", "diverged"), levels),
            ReportTable("The likeliest failures", ("parameter", *map(str, range(1, count + 1))), failing, "in SI"),
        ],
        notes=[content["note"]] if content["note"] else [],
        provenance=describe_origin(
            content, seed=content["seed"], runs=content["runs"], engine=format_pairs(content["engine"])
        ),
        command=content["made"]["command"],
    )  # fmt: skip
