"""Files in the folder of a sweep: the summary, trajectories, figures and a report."""

import pathlib
from typing import TYPE_CHECKING

from diffabs.cli import report
from diffabs.core.types import JsonObject
from diffabs.host import documents, files, provenance

if TYPE_CHECKING:
    from diffabs.uncertainty.sweep import Results, Study

SUMMARY, FIGURES = "summary.json", "figures"


def write_statistics(results: "Results", study: "Study", out: pathlib.Path, check: int) -> JsonObject:
    """Return the JSON document, which is also written into the folder: at first without the names of other files.

    A picture that cannot be drawn then loses no statistics.
    """
    from diffabs.uncertainty.sweep.statistics.summary import summarise_checked_sweep

    values = {"out": str(out), **summarise_checked_sweep(results, study, check)}
    result = documents.stamp("sweep", {**values, "made": provenance.describe_command(), "files": {}})
    _write_summary(out, result)
    return result


def write_files(
    result: JsonObject, results: "Results", study: "Study", out: pathlib.Path, numbers: list[int], figures: bool
) -> None:
    """Write trajectories, figures and report, and add their names to the document here and in the folder."""
    from diffabs.uncertainty.sweep.trajectories import write_trajectories

    if numbers:
        result["files"]["trajectories"] = str(write_trajectories(study, out, numbers))
    if figures:
        from diffabs.output.plot.sweeps import draw_sweep

        folder = out / FIGURES
        folder.mkdir(exist_ok=True)
        result["files"]["figures"] = [str(path) for path in draw_sweep(results, result, folder, study.units())]
        result["files"]["report"] = str(out / report.DEFAULT_NAME)
    if result["files"]:
        _write_summary(out, result)
    if figures:
        report.write_report_file([out], out / report.DEFAULT_NAME)


def _write_summary(out: pathlib.Path, result: JsonObject) -> None:
    # The sweep's lock is released by now: another --resume of a complete sweep may write the same file.
    files.write_synced(out / SUMMARY, documents.format_document(result, 1).encode())
