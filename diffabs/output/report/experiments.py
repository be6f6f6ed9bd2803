"""Reproductions of papers as sections of a report."""

import pathlib

from diffabs.core.types import Table
from diffabs.output.report.documents import Document
from diffabs.output.report.page import (
    VERDICT_NAMES,
    ReportTable,
    ReportVerdict,
    Section,
    describe_origin,
    embed_image,
    model_tables,
)
from diffabs.scenario.model import describe_model
from diffabs.scenario.scenario import load, names

COLUMNS = {"name": "what", "quantity": "quantity", "unit": "unit", "ours": "ours", "published": "published",
           "reference": "independent", "difference": "difference"}  # fmt: skip
JUDGED_COLUMNS = {"source": "source", "quantity": "quantity", "unit": "unit", "printed": "printed", "ours": "ours",
                  "tolerance": "tolerance", "bound": "bound", "scheme": "source's scheme", "verdict": "verdict",
                  "cause": "cause", "command": "command"}  # fmt: skip


def paper_section(document: Document) -> Section:
    """Return the section of a paper's reproduction."""
    content = document.content
    name, digest = content["paper"], content["digest"]  # a KeyError of what an earlier release wrote
    if (scenario := content.get("scenario", name)) not in names():  # a document must not name a file
        raise KeyError(f"scenario {scenario}")
    # A name with a path is skipped, so that a document cannot name files outside of its folder.
    named = [document.folder / name for name in content["figures"] if pathlib.PurePath(name).name == name]
    return Section(
        title=content["title"],
        question="Are the numbers, figures and claims of this paper true? Its experiments are computed again, and"
        " compared with its printed values and with independent solutions.",
        answer=list(digest["agreement"]),
        verdicts=[ReportVerdict(*verdict) for verdict in digest["verdicts"]],
        model=model_tables(describe_model(load(scenario, integrated=False))),
        model_note=f"The packaged scenario {scenario}; the first column of the tables names the change of each row.",
        figures=[figure for path in named if (figure := embed_image(path, document.folder))],
        tables=[ReportTable("In short", digest["headings"], digest["lines"]), *_tables(content)],
        certificate=_certificates(content.get("design")),
        certificate_tables=_designs(content.get("design")),
        notes=list(content["notes"]),
        provenance=describe_origin(content, **{f"solver, {name}": value for name, value in content["solver"].items()}),
        command=content["made"]["command"],
    )


def _tables(content: Table) -> list[ReportTable]:
    titles = {"rows": "Every number", "judged": "What the paper prints of its machine"}
    columns = JUDGED_COLUMNS if any("verdict" in row for row in content["rows"]) else COLUMNS
    return [
        ReportTable(title, tuple(columns.values()), [[row.get(key) for key in columns] for row in content[part]])
        for part, title in titles.items()
        if isinstance(content.get(part), list) and content[part]
    ]


def _certificates(design: Table | None) -> list[ReportVerdict]:
    designs = (design or {}).get("designs") or []
    return [
        ReportVerdict(VERDICT_NAMES[row["certificate"]["quadratically_stable"]],
                f"u = K x with K = {row['gain']} is quadratically stable over the vertices"
                f"{', verified in exact arithmetic' if row['certificate']['verified_exactly'] else ''}")
        for row in designs
        if row.get("certificate")
    ]  # fmt: skip


def _designs(design: Table | None) -> list[ReportTable]:
    designs = (design or {}).get("designs") or []
    rows = [
        [row["Q"], row["R"], row["gain"], row["certificate"]["decay_rate"], row["certificate"]["guaranteed_cost"]]
        for row in designs
        if row.get("certificate")
    ]
    headings = ("Q", "R", "gain", "decay rate [1/s]", "guaranteed cost")
    return [ReportTable("Designs", headings, rows)] if rows else []
