"""The command `compare`: two sweeps over the same samples, sample by sample."""

import pathlib
from typing import Annotated

import typer

from diffabs.cli import console, show, show_samples
from diffabs.host import documents
from diffabs.host.values import unknown_name_error


def compare(
    first: Annotated[pathlib.Path, typer.Argument(help="Folder of a sweep.")],
    second: Annotated[pathlib.Path, typer.Argument(help="Folder of another sweep over the same samples.")],
    metric: Annotated[list[str] | None, typer.Option(help="Only this metric; may be repeated.")] = None,
    as_json: console.Json = False,
) -> None:
    """Compare two sweeps on common random numbers.

    The samples are the same, so differences of the second from the first have narrow intervals."""
    with console.end_on_errors():
        console.need_extra("sweep")
        from diffabs.uncertainty.sweep import Results
        from diffabs.uncertainty.sweep.statistics.comparison import common_metrics, compare_sweeps

        a, b = Results(first), Results(second)
        for results in (a, b):
            show_samples.warn_of_strays(results)
        common = common_metrics(a, b)
        for name in metric or ():
            if name not in common:
                raise unknown_name_error(f"--metric {name} is not in both sweeps", name, common)
        result = {"first": str(first), "second": str(second), **compare_sweeps(a, b, metric or ())}
        result = documents.stamp("compare", result)
        show.show_result(as_json, show_samples.show_comparison, result)
