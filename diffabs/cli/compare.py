"""The command `compare`: two sweeps over the same samples, sample by sample."""

import pathlib
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from diffabs.cli import console, show, show_samples
from diffabs.cli.show_samples import warn_of_strays
from diffabs.core.types import JsonObject
from diffabs.host.values import ScenarioError, unknown_name_error

if TYPE_CHECKING:
    from diffabs.uncertainty.sweep import Results

FEWEST = 4  # common samples below which a metric has no statistics
STATISTICS = (
    *("first", "second", "difference", "median difference", "share in which the second is less", "equal"),
    "variance reduction",
)
SHARED_FIELDS = ("space", "seed", "samples")  # fields that two studies of the same samples share


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
        from diffabs.uncertainty.sweep.store import describe_differences

        a, b = Results(first), Results(second)
        for results in (a, b):
            warn_of_strays(results)
            if not results.complete:
                raise ScenarioError(f"{results.folder} is not complete; diffabs sweep ... --resume completes it")
        first_fields, second_fields = ({name: results.study[name] for name in SHARED_FIELDS} for results in (a, b))
        for line in describe_differences(first_fields, second_fields):
            difference = line.replace(" there, ", " in the first, ")
            raise ScenarioError(f"the samples are not the same: {difference} in the second")
        both = [name for name in a.metrics if name in b.metrics]
        for name in metric or ():
            if name not in both:
                raise unknown_name_error(f"--metric {name} is not in both sweeps", name, both)
        result = {"first": str(first), "second": str(second), **_compare_metrics(a, b, metric or both)}
        show.as_json(result) if as_json else show_samples.show_comparison(result)


def _compare_metrics(a: "Results", b: "Results", metrics: list[str]) -> JsonObject:
    """Return paired statistics of second minus first.

    Samples that diverged or were refused in either sweep are left out. A sample with an infinite metric in either sweep
    is left out of that metric, and counted. With fewer than `FEWEST` samples the statistics are None.
    """
    from diffabs.uncertainty.sweep.statistics.estimates import Moments
    from diffabs.uncertainty.sweep.statistics.paired import compare_pairs

    lost = a.column("diverged") | b.column("diverged") | ~a.accepted | ~b.accepted
    rows = {}
    for name in metrics:
        both = ~lost & np.isfinite(a.column(name)) & np.isfinite(b.column(name))
        before, after = a.column(name)[both], b.column(name)[both]
        numbers = [None] * len(STATISTICS)
        if len(before) >= FEWEST:
            pairs = compare_pairs(after, before)
            numbers = [Moments.of(before).mean().value, Moments.of(after).mean().value]
            numbers += [estimate.table() for estimate in (pairs.mean, pairs.median, pairs.less)]
            numbers += [pairs.ties, pairs.reduction]
        rows[name] = {
            "samples": len(before),
            **dict(zip(STATISTICS, numbers, strict=True)),
            "never": int((~lost & ~both).sum()),
        }
    return {"samples": len(lost), "left out": int(lost.sum()), "metrics": rows}
