"""Assessments of cars by the clauses of a regulation as sections of a report: of one car, and of several compared."""

import shlex
from collections.abc import Iterable, Iterator, Sequence

from diffabs.core.types import PyTree, Table
from diffabs.output.report.documents import Document
from diffabs.output.report.page import (
    ReportTable,
    ReportVerdict,
    Section,
    describe_origin,
    format_known,
    format_pairs,
    model_tables,
)

REGULATION = "Regulation (EU) 2015/68, Annex XI"
CLAUSE_COLUMNS = ("figure", "limit", "verdict", "worst stop")
OWN_RULE = "own rule"  # in place of a clause's number
OWN_RULES_NOTE = f"A row with the number {OWN_RULE} is not from the regulation, and counts for no verdict."


def assessment_section(document: Document) -> Section:
    """Return the section of an assessment."""
    content = document.content
    clauses = content["clauses"]
    return Section(
        title=f"Clauses of {_title(content)}",
        question=f"Do the brakes meet the clauses of {REGULATION}, about anti-lock brakes?",
        answer=[_describe_runs(content)],
        verdicts=[ReportVerdict(row["verdict"], _sentence(row)) for row in clauses if row["confirmed"]],
        model=model_tables(content["model"]),
        model_note="Tyres, stop, speed and load are those of the clauses.",
        tables=[
            ReportTable(
                "Clauses",
                ("clause", "rule", *CLAUSE_COLUMNS),
                [[row["number"] or OWN_RULE, row["rule"], *_cells(row)] for row in clauses],
            )
        ],
        notes=[*_notes(clauses), *([] if all(row["confirmed"] for row in clauses) else [OWN_RULES_NOTE])],
        provenance=describe_origin(content, program=format_pairs(content["program"])),
        command=content["made"]["command"],
    )


def comparison_section(documents: Sequence[Document]) -> Section:
    """Return the section that compares assessments, with the figures of each clause in a table of its own."""
    titles = [_title(document.content) for document in documents]
    titles = [title if titles.count(title) == 1 else f"{title} ({i})" for i, title in enumerate(titles, 1)]
    contents = {title: document.content for title, document in zip(titles, documents, strict=True)}
    rows = {title: {_key(row): row for row in content["clauses"]} for title, content in contents.items()}
    keys = list(dict.fromkeys(key for clauses in rows.values() for key in clauses))
    first = {key: next(clauses[key] for clauses in rows.values() if key in clauses) for key in keys}
    passed = [title for title, clauses in rows.items() if _meets_all(clauses.values())]
    verdicts = [
        [title, *(clauses[key]["verdict"] if key in clauses else "" for key in keys)] for title, clauses in rows.items()
    ]
    paths = [str(document.path) for document in documents]
    programs = {format_pairs(content["program"]) for content in contents.values()}
    return Section(
        title=f"{len(contents)} cars on the same clauses",
        question=f"Which of them meet the clauses of {REGULATION}, about anti-lock brakes?",
        answer=[f"{len(passed)} of {len(contents)} meet all{': ' if passed else ''}{'; '.join(passed)}."],
        tables=[
            ReportTable("Verdicts", ("car", *map(_name, first.values())), verdicts),
            *(
                ReportTable(
                    _name(first[key]),
                    ("car", *CLAUSE_COLUMNS),
                    [[title, *_cells(clauses[key])] for title, clauses in rows.items() if key in clauses],
                )
                for key in keys
            ),
        ],
        notes=[
            *(f"{title}: {note}" for title, clauses in rows.items() for note in _notes(clauses.values())),
            *(f"{title}: {_describe_runs(content)}" for title, content in contents.items() if content["unfinished"]),
            *([] if all(row["confirmed"] for row in first.values()) else [OWN_RULES_NOTE]),
            *(["The programs of the stops differ: compare with care."] if len(programs) > 1 else []),
        ],
        model_note="The model of each is below.",
        provenance=[(title, document.path.name) for title, document in zip(contents, documents, strict=True)],
        again=[shlex.join(["diffabs", "report", *paths, "-o", "clauses.html"])],
    )


def _title(content: Table) -> str:
    return content["model"]["title"] or content["scenario"]


def _key(row: Table) -> tuple[str, str]:
    return row["number"], row["rule"]


def _name(row: Table) -> str:
    return f"{row['number'] or OWN_RULE} {row['rule']}"


def _cells(row: Table) -> list[PyTree]:
    """Return the cells of `CLAUSE_COLUMNS`; JSON has null for a figure that is infinite, or unknown."""
    figure = "not finite" if row["figure"] is None else row["figure"]
    return [figure, _limit(row), row["verdict"], row["stop"]]


def _limit(row: Table) -> str:
    unit = "" if row["unit"] == "1" else f" {row['unit']}"
    return f"{'at least' if row['at_least'] else 'at most'} {format_known(row['limit'], 3)}{unit}"


def _sentence(row: Table) -> str:
    return f"{row['number']} {row['rule']}: {format_known(row['figure'], 3)}, {_limit(row)}; worst stop: {row['stop']}"


def _meets_all(clauses: Iterable[Table]) -> bool:
    met = [row["verdict"] == "met" for row in clauses if row["confirmed"]]
    return bool(met) and all(met)


def _notes(clauses: Iterable[Table]) -> Iterator[str]:
    return (f"{row['number']} {row['rule']}: {row['note']}" for row in clauses if row.get("note"))


def _describe_runs(content: Table) -> str:
    cars = f"{content['cars']:,} car{'s' if content['cars'] != 1 else ''}"
    line = f"{cars}, {content['stops']} stops each; {content['unfinished']:,} runs diverged or did not reach 15 km/h."
    if "probability" in content:
        low, high = content["interval"]
        share = f"{content['probability']:.4g}, 95 % interval {low:.4g} to {high:.4g}"
        line += f" {content['passed']:,} cars meet all clauses: {share}."
    return line
