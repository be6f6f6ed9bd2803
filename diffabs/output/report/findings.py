"""Tunings and identifications as sections of a report."""

from collections.abc import Iterator

from diffabs.core.types import Table
from diffabs.output.report import proofs
from diffabs.output.report.charts import draw_lines
from diffabs.output.report.documents import Document
from diffabs.output.report.page import (
    Figure,
    ReportTable,
    ReportVerdict,
    Section,
    describe_missing,
    describe_origin,
    embed_named,
    format_known,
    format_pairs,
    join_words,
    model_tables,
    table_unit,
)

NORMAL = 1.959964  # half-width of a 95 % interval, in standard deviations


def tuning_section(document: Document) -> Section:
    """Return the section of a tuning."""
    content = document.content
    before, after = (format_known(content["objective"][when]) for when in ("before", "after"))
    limits = [row["name"] for row in content["constraints"]]
    under = f", so that {join_words(limits)} keep{'s' if len(limits) == 1 else ''} the bound" if limits else ""
    lanes = f"{content['lanes']} run{'s' if content['lanes'] != 1 else ''}"
    return Section(
        title=f"Tuning of {content['scenario']}",
        question=f"Which values of {join_words(content['free'])} make the objective least over {lanes}{under}?",
        answer=[f"The objective went from {before} to {after}; it ended because {content['reason']}."],
        verdicts=[_constraint_row(row) for row in content["constraints"]],
        model=model_tables(content["model"]),
        model_note="Before the tuning.",
        figures=(figures := list(_figures(document))),
        figures_note=describe_missing(figures, _picture(document)),
        tables=list(_tuning_tables(content)),
        certificate=proofs.proof_verdicts(content["certificate"]),
        certificate_tables=proofs.proof_tables(content["certificate"], content),
        notes=["Interrupted: the best so far, not a minimum."] if content.get("interrupted") else [],
        provenance=describe_origin(content, gradients=content["evaluations"], mode=content["mode"],
                          seed=content["model"]["solver"]["seed"],
                          engine=format_pairs(content["engine"])),
        command=content["made"]["command"],
    )  # fmt: skip


def _constraint_row(row: Table) -> ReportVerdict:
    after, bound = (format_known(row[key]) for key in ("after", "bound"))
    return ReportVerdict("met" if row["met"] else "not met", f"{row['name']}: {after}, bound {bound}")


def _figures(document: Document) -> Iterator[Figure]:
    """Yield the objective over the gradients, and the picture that the command drew, if the file still exists."""
    history = document.content["history"]
    points = [(row["evaluations"], row["objective"]) for row in history]
    if len(points) > 1:
        yield Figure(
            "The objective after so many gradients", drawn=draw_lines(points, "gradients computed", "objective")
        )
    caption = "How the tuning went, and its worst run before and after"
    if figure := embed_named(document.folder, _picture(document), caption):
        yield figure


def _picture(document: Document) -> str | None:
    return document.content["files"].get("plot")


def _tuning_tables(content: Table) -> Iterator[ReportTable]:
    units = content["model"]["metrics"]
    keys = ("before", "after", "low", "high")
    rows = [[path, *(row[key] for key in keys), table_unit(row["unit"])] for path, row in content["free"].items()]
    yield ReportTable("Free parameters", ("parameter", *keys, "unit"), rows)
    metrics = [
        [name, *(content["metrics"][when][of][name] for of in ("mean", "worst") for when in ("before", "after")),
         table_unit(units.get(name))]
        for name in content["metrics"]["before"]["mean"]
    ]  # fmt: skip
    headings = ("metric", "mean before", "mean after", "worst before", "worst after", "unit")
    yield ReportTable(f"Over {content['lanes']} runs", headings, metrics)
    if content["constraints"]:
        keys = ("name", "bound", "before", "after", "met")
        rows = [[row[key] for key in keys] for row in content["constraints"]]
        yield ReportTable("Constraints, worst run or vertex", ("constraint", *keys[1:]), rows)
    starts = [[i, row["objective"], row["violation"], row["reason"]] for i, row in enumerate(content["starts"], 1)]
    yield ReportTable("Starts", ("start", "objective", "violation", "ended because"), starts)


def identification_section(document: Document) -> Section:
    """Return the section of an identification."""
    content = document.content
    data = content["data"]
    return Section(
        title=f"Identification of {content['scenario']}",
        question=f"Which values of {join_words(content['values'])} explain {data['samples']:,} measured instants of"
        f" {join_words(data['columns'])} until {data['until']:g} s, and how well do these determine them?",
        answer=[f"chi2 = {format_known(content['chi2'])} with {content['degrees']} degrees of freedom; it ended because"
                f" {content['reason']}."],
        verdicts=[ReportVerdict("not determined", row["direction"]) for row in content["undetermined"]]
        or [ReportVerdict("determined", "every parameter that was free")],
        model=model_tables(content["model"]),
        model_note="Before the identification.",
        tables=list(_identification_tables(content)),
        notes=["Interrupted: the values so far, not the best ones."] if content.get("interrupted") else [],
        provenance=describe_origin(content, evaluations=content["evaluations"]),
        command=content["made"]["command"],
    )  # fmt: skip


def _identification_tables(content: Table) -> Iterator[ReportTable]:
    rows = []
    for name, row in content["values"].items():
        value, deviation = row["value"], row["deviation"]
        ends = (None, None) if deviation is None else (value - NORMAL * deviation, value + NORMAL * deviation)
        rows.append([name, row["before"], value, deviation, *ends, row["low"], row["high"], table_unit(row["unit"])])
    headings = ("parameter", "before", "identified", "standard deviation", "low (95 %)", "high (95 %)", "least allowed",
                "greatest allowed", "unit")  # fmt: skip
    yield ReportTable("Parameters", headings, rows, "intervals: of a normal distribution with this standard deviation")
    keys = ("sigma", "rms", "mean", "largest")
    rows = [[name, *(row[key] for key in keys), table_unit(row["unit"])] for name, row in content["residuals"].items()]
    yield ReportTable("Simulated minus measured", ("column", *keys, "unit"), rows)
    if content["correlations"]:
        rows = [[join_words(row["between"]), row["correlation"]] for row in content["correlations"]]
        yield ReportTable("Strong correlations", ("between", "correlation"), rows)
