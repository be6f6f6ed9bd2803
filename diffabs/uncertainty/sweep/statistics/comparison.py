"""Comparison of two sweeps over the same samples, sample by sample."""

from collections.abc import Sequence

import numpy as np

from diffabs.core.types import JsonObject
from diffabs.uncertainty.sweep.results import Results
from diffabs.uncertainty.sweep.seal import SweepError
from diffabs.uncertainty.sweep.statistics.estimates import Moments
from diffabs.uncertainty.sweep.statistics.paired import compare_pairs
from diffabs.uncertainty.sweep.store import describe_differences

MIN_PAIRS = 4  # common samples below which a metric has no statistics
STATISTICS = (
    *("first", "second", "difference", "median difference", "share in which the second is less", "equal"),
    "variance reduction",
)
SHARED_FIELDS = ("space", "seed", "samples")  # fields that two studies of the same samples share


def compare_sweeps(first: Results, second: Results, metrics: Sequence[str] = ()) -> JsonObject:
    """Return statistics of the differences of two sweeps over the same samples, second minus first, as JSON values.

    The samples are common random numbers, so the intervals of the differences are narrow. `samples` counts them, and
    `left out` those that diverged or were refused in either sweep. `metrics` has for each metric:

    - `samples`, `never`: Pairs with finite values, and pairs without, which are left out.
    - `first`, `second`: Means. These and all below are None with fewer than 4 pairs.
    - `difference`, `median difference`, `share in which the second is less`: Estimates with their intervals.
    - `equal`: Number of equal pairs.
    - `variance reduction`: Factor by which sweeps without common samples would need more samples.

    Args:
        first: Complete sweep.
        second: Complete sweep over the same samples, of another loop, for example.
        metrics: Names of metrics that both sweeps have; by default all of these.

    Raises:
        SweepError: A sweep is not complete, the samples differ, or a metric is not in both.

    See also:
        `sweep.Results`: The columns of one sweep.
    """
    for results in (first, second):
        if not results.complete:
            raise SweepError(f"{results.folder} is not complete; diffabs sweep ... --resume completes it")
    first_fields, second_fields = ({name: results.study[name] for name in SHARED_FIELDS} for results in (first, second))
    for line in describe_differences(first_fields, second_fields):
        difference = line.replace(" there, ", " in the first, ")
        raise SweepError(f"the samples are not the same: {difference} in the second")
    common = common_metrics(first, second)
    if foreign := [name for name in metrics if name not in common]:
        raise SweepError(f"{foreign[0]} is not a metric of both sweeps")
    return _compare_metrics(first, second, metrics or common)


def common_metrics(first: Results, second: Results) -> list[str]:
    """Return the names of the metrics that two sweeps share."""
    return [name for name in first.metrics if name in second.metrics]


def _compare_metrics(a: Results, b: Results, metrics: Sequence[str]) -> JsonObject:
    """Return paired statistics of second minus first.

    Samples that diverged or were refused in either sweep are left out. A sample with an infinite metric in either sweep
    is left out of that metric, and counted. With fewer than `MIN_PAIRS` samples the statistics are None.
    """
    lost = a.column("diverged") | b.column("diverged") | ~a.accepted | ~b.accepted
    rows = {}
    for name in metrics:
        both = ~lost & np.isfinite(a.column(name)) & np.isfinite(b.column(name))
        before, after = a.column(name)[both], b.column(name)[both]
        numbers = [None] * len(STATISTICS)
        if len(before) >= MIN_PAIRS:
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
