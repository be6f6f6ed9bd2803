"""The command `report`: results as one HTML file. It needs the extra `report`."""

import pathlib
from collections.abc import Sequence
from typing import Annotated

import typer

from diffabs.cli import console, targets

DEFAULT_NAME = "report.html"
ENDINGS = (".html", ".htm")


def report(
    sources: Annotated[
        list[pathlib.Path],
        typer.Argument(
            metavar="DIR|FILE.json...",
            help="Results of reproduce, sweep, rare, tune, identify, prove, design, assess or certify.",
        ),
    ],
    out: Annotated[
        pathlib.Path | None,
        typer.Option("--out", "-o", metavar="FILE.html", help="File to write; default: report.html in the folder."),
    ] = None,
) -> None:
    """Make one HTML file of results. Several of assess are compared, clause by clause.

    It has question, answer, figures, tables, certificate, model and provenance."""
    with console.end_on_errors():
        console.need_extra("report")
        source = sources[0]
        if not out and len(sources) > 1:
            console.fail("--out FILE.html is needed for several sources")
        target = out or (source / DEFAULT_NAME if source.is_dir() else source.with_suffix(".html"))
        if target.suffix.lower() not in ENDINGS:
            console.fail(f"--out {target}: the name must end in {' or '.join(ENDINGS)}")
        if missing := [str(path) for path in sources if not path.exists()]:
            console.fail(f"{', '.join(missing)}: there is no such folder or file")
        check_target(target)
        if not target.parent.is_dir():
            console.fail(f"--out {target}: there is no folder {target.parent}")
        console.run_with_progress(lambda: write_report_file(sources, target), "writing the report")
        console.say(f"report: {target}")


def write_report_file(sources: Sequence[pathlib.Path], target: pathlib.Path, title: str = "") -> None:
    """Write a report; see `write_report`, which needs the extra."""
    from diffabs.output.report import write_report

    write_report(sources, target, title)


def check_target(target: pathlib.Path) -> None:
    """Check that a report may be written to a file."""
    from diffabs.output.report import is_report

    target = targets.resolve_path(target, "--out")
    if target.exists() and not (target.is_file() and is_report(target)):
        console.fail(f"--out {target}: exists and is not an earlier report; move it away")
