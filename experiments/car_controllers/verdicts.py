"""The verdicts of the eight controllers on every clause, for one car: a page, and a table in Markdown.

Each assessment is a JSON file as `diffabs assess --json` writes it; `diffabs report` makes the page of them.

    python experiments/car_controllers/verdicts.py
"""

import math
import pathlib
from collections.abc import Sequence

import jax

from diffabs import Adaptive
from diffabs.assess import Assessment, Clause, assess
from diffabs.host import documents, files
from diffabs.host.values import kebab_case, plain_fields
from diffabs.output.report import write_report
from diffabs.scenario import Scenario
from diffabs.scenario.model import result_document
from experiments.car_controllers.run import Config, list_controllers

FOLDER = pathlib.Path("out/experiments/car_controllers/verdicts")
PAGE = "clauses.html"


def judge_controllers(names: Sequence[str] = (), folder: pathlib.Path = FOLDER) -> dict[str, Assessment]:
    """Return the assessments by controller, all without `names`; write a file of each, and the page of all."""
    config, assessments, paths = Config(), {}, []
    for name, build in list_controllers(config).items():
        if names and name not in names:
            continue
        file = kebab_case(name.replace(",", "").replace(" ", "-"))
        scenario = Scenario(
            file, title=name, loop=build(), solver=Adaptive(config.rtol, config.duration), objectives={}
        )
        assessments[name] = assess(scenario.loop, scenario.solver, config.program)
        values = {"program": plain_fields(config.program), **assessments[name].record()}
        paths.append(folder / f"{file}.json")
        text = documents.format_document(result_document("assess", scenario, values))
        folder.mkdir(parents=True, exist_ok=True)
        files.write_file(paths[-1], text.encode())
        print(name, [f"{row.number} {row.verdict}" for row in assessments[name].clauses], flush=True)
    write_report(paths, folder / PAGE, "Eight brake controllers on the clauses")
    return assessments


def format_table(assessments: dict[str, Assessment]) -> list[list[str]]:
    """Return the cells of a table: for each clause its limit and, by controller, the figure of the worst stop.

    A figure that does not meet its limit is in bold.
    """
    clauses = zip(*(assessment.clauses for assessment in assessments.values()), strict=True)
    return [
        ["clause", "limit", *assessments],
        *([_format_name(row[0]), _format_limit(row[0]), *map(_format_cell, row)] for row in clauses),
    ]


def _format_name(clause: Clause) -> str:
    return f"{clause.number} {clause.rule}".strip()


def _format_limit(clause: Clause) -> str:
    return f"{'>=' if clause.at_least else '<='} {clause.limit:.3g} {clause.unit.replace('1', '')}".rstrip()


def _format_cell(clause: Clause) -> str:
    unit = clause.unit.replace("1", "")
    figure = "never" if math.isinf(clause.figure) else f"{clause.figure:.2f} {unit}".rstrip()
    return {"met": figure, "not met": f"**{figure}**", "undecided": "undecided"}[clause.verdict]


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(*(f"| {' | '.join(cells)} |" for cells in format_table(judge_controllers())), sep="\n")
