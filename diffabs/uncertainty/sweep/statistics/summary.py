"""The summary of a finished sweep, as JSON values.

It contains counts, failure probabilities, statistics of each metric, sensitivities, and the worst samples. Columns are
read one at a time, so that ten million rows fit into memory. The design decides the intervals:

    random                      of independent samples
    sobol, replicates > 1       from the spread between the replicates (`replicated`)
    sobol, latin-hypercube      as of independent samples, usually too wide
    grid, corners               none: nothing is random; limits of intervals are null
    saltelli                    of its rows A, as of one Sobol' sequence; Sobol' indices by a bootstrap of all groups
"""

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy import stats

from diffabs.core.types import JsonObject
from diffabs.uncertainty.sweep.checking import check_accuracy
from diffabs.uncertainty.sweep.results import Results
from diffabs.uncertainty.sweep.statistics.estimates import Count, IntervalEstimate, Tail, summarise_column, varies
from diffabs.uncertainty.sweep.statistics.replicated import Replicates
from diffabs.uncertainty.sweep.statistics.rows import RowMasks
from diffabs.uncertainty.sweep.statistics.sensitivity import correlations, sobol_indices
from diffabs.uncertainty.sweep.study import Study

CONFIDENCE, QUANTILE_LEVELS, CVAR_LEVEL = 0.95, (0.05, 0.5, 0.95), 0.95
MAX_CORRELATED_SAMPLES = 200_000  # correlations use at most this number of samples, the first ones
MAX_LISTED_SAMPLES = 10
# Skewness of the mean with a warning, |skewness|/sqrt(n). `experiments/mean_intervals`: where 95 % intervals of a
# mean cover less than 94 %, it warns of 80 to 99 % of the samples; of 30 normal values each, of 1.2 % of the samples.
MAX_SKEWNESS = 0.2
MIN_SAMPLES = 4  # smallest number of samples with statistics
INTERVAL_NOTES = {
    "random": "independent samples",
    "sobol": "spread between replicates; rare failures and correlations as of independent samples",
    "one sobol": "as of independent samples: usually too wide for a Sobol' sequence",
    "latin-hypercube": "as of independent samples: usually too wide for a Latin hypercube",
    "saltelli": "as of independent samples, rows A only: usually too wide; indices by a bootstrap",
    "grid": "none: a grid is not random",
    "corners": "none: corners are not random",
}
DETERMINISTIC_DESIGNS = ("grid", "corners")


def summarise_sweep(results: Results) -> JsonObject:
    """Return the summary of the finished chunks.

    Its entries are:

    - `samples`, `complete`, `digest`: Number of rows, whether all chunks are finished, and the digest of the table.
    - `diverged`, `refused`: `count` and first `samples`; `refused` also counts each reason.
    - `confidence`, `intervals`: Confidence, and the meaning of the intervals as text.
    - `failures`: Probability of each kind of failure, and of `any`, with the `count` of failed samples.
    - `never`: Runs with an infinite value, or none, by metric, where there are some.
    - `metrics`: Statistics by metric.
    - `sensitivity`: Correlations, or Sobol' indices, by metric and variable.
    - `worst`: Samples with the largest values, by metric.

    Each estimate has `value`, `low`, `high`, and the number of `samples` that it is of. Of a Saltelli design these are
    the runs A, and for an index the groups of runs. Correlations are of at most the first 200,000 samples. Diverged
    runs enter the failures but no other statistic. Refused samples enter none. An infinite end is None.
    """
    view = RowMasks(results)
    skewed = [name for name in results.metrics if _is_skewed(_known_values(results, view, name))]
    warning = f"; few samples of a skewed law, so intervals of the mean may be too narrow: {', '.join(skewed)}"
    refused, count = ~view.accepted, _replicate_count(results)
    reasons, counts = np.unique(results.column("refused")[refused].astype(str), return_counts=True)
    return {
        "samples": len(view.samples),
        "complete": results.complete,
        "diverged": _list_samples(view, view.accepted & ~view.good),
        "refused": {
            **_list_samples(view, refused),
            "reasons": dict(zip(reasons.tolist(), counts.tolist(), strict=True)),
        },
        "confidence": CONFIDENCE,
        "intervals": INTERVAL_NOTES["one sobol" if view.design == "sobol" and count == 1 else view.design]
        + (warning if skewed and view.design not in DETERMINISTIC_DESIGNS else ""),
        "failures": dict(_failure_probabilities(results, view)),
        "never": {name: never for name in results.metrics if (never := _list_never(results, view, name))["count"]},
        "metrics": {name: _summarise_metric(results, view, name) for name in results.metrics},
        "sensitivity": _summarise_sensitivity(results, view),
        "worst": {name: _worst_samples(results, view, name) for name in results.metrics},
        "digest": results.digest,
    }


def summarise_checked_sweep(results: Results, study: Study, count: int) -> JsonObject:
    """Return the summary with `accuracy`, that of `check_accuracy` for `count` runs; None without any."""
    # Half steps run beside the statistics: compiled code and NumPy release Python's global lock.
    with ThreadPoolExecutor(1) as beside:
        halved = beside.submit(check_accuracy, study, results, count) if count else None
        summary = summarise_sweep(results)
    return {**summary, "accuracy": halved.result() if halved else None}


def _list_samples(view: RowMasks, rows: np.ndarray) -> JsonObject:
    """Return the number and the first samples of the rows in a mask."""
    return {"count": int(rows.sum()), "samples": view.samples[rows][:MAX_LISTED_SAMPLES].tolist()}


def _list_never(results: Results, view: RowMasks, name: str) -> JsonObject:
    """Return the number and the first samples of runs without a finite value: they never reach the measured event, or
    lack what the metric measures (NaN).

    An infinite value violates every bound of the metric. Its other statistics are of the finite values only.
    """
    return _list_samples(view, view.good & view.rows & ~np.isfinite(results.column(name)))


def _replicate_count(results: Results) -> int:
    return results.study["space"]["design"].get("replicates", 1) if results.complete else 1


def _select_replicates(results: Results, samples: np.ndarray) -> Replicates | None:
    """Return the replicates of these samples, or None if the samples are not replicated."""
    count = _replicate_count(results)
    return Replicates(samples // (results.study["samples"] // count), count, CONFIDENCE) if count > 1 else None


def _failure_probabilities(results: Results, view: RowMasks) -> Iterator[tuple[str, JsonObject]]:
    kinds = results.failures()
    kinds["any"] = np.any(list(kinds.values()), axis=0)
    eligible = view.rows & view.accepted
    if not eligible.any():
        return
    replicates = _select_replicates(results, view.samples[eligible])
    for name, failed in kinds.items():
        count = Count(int(failed[eligible].sum()), int(eligible.sum()))
        estimate = replicates.probability(failed[eligible]) if replicates else count.probability(confidence=CONFIDENCE)
        yield name, {"count": count.failures, **_json_estimate(estimate, view)}


def _is_known(results: Results, view: RowMasks, name: str) -> np.ndarray:
    return view.good & view.rows & np.isfinite(results.column(name))


def _known_values(results: Results, view: RowMasks, name: str) -> np.ndarray:
    return results.column(name)[_is_known(results, view, name)]


def _is_skewed(values: np.ndarray) -> bool:
    """Return whether so few samples are so skewed that the interval of the mean may be too narrow."""
    if len(values) < MIN_SAMPLES or not varies(values):
        return False
    return abs(float(stats.skew(values))) > MAX_SKEWNESS * math.sqrt(len(values))


def _summarise_metric(results: Results, view: RowMasks, name: str) -> JsonObject:
    finite = _is_known(results, view, name)
    values = results.column(name)[finite]
    if len(values) < MIN_SAMPLES:
        return {}
    rows = summarise_column(values, CONFIDENCE, QUANTILE_LEVELS, CVAR_LEVEL)
    if replicates := _select_replicates(results, view.samples[finite]):
        rows |= replicates.summarise_column(values, QUANTILE_LEVELS, CVAR_LEVEL)
    ends = {"least": float(values.min()), "greatest": float(values.max())}
    return {**{kind: _json_estimate(estimate, view) for kind, estimate in rows.items()}, **ends}


def _summarise_sensitivity(results: Results, view: RowMasks) -> JsonObject:
    """Return by metric and variable the correlations, or the Sobol' indices of a Saltelli design."""
    variables = [path for path in results.variables if results.is_number(path)]
    metrics = {name: results.column(name) for name in results.metrics}
    if view.period > 1:
        names = list(results.study["space"]["variables"])
        return {name: _summarise_indices(values, view, names) for name, values in metrics.items()}
    rows = np.flatnonzero(view.good)[:MAX_CORRELATED_SAMPLES]
    if view.design in DETERMINISTIC_DESIGNS or not variables or len(rows) < MIN_SAMPLES:
        return {}
    x = np.stack([results.column(path)[rows] for path in variables], axis=1)
    result = {}
    for name, values in metrics.items():
        y = values[rows]
        finite = np.isfinite(y)
        if finite.sum() < MIN_SAMPLES:
            continue
        both = correlations(x[finite], y[finite], confidence=CONFIDENCE)
        result[name] = {
            path: {"pearson": _json_estimate(p, view), "spearman": _json_estimate(s, view)}
            for path, p, s in zip(variables, *both, strict=True)
        }
    return result


def _summarise_indices(values: np.ndarray, view: RowMasks, names: list[str]) -> JsonObject:
    """Return the Sobol' indices of one metric, without groups in which a run diverged or has an infinite value."""
    groups = view.groups(values)
    if len(groups) < MIN_SAMPLES:
        return {}
    a, b, *ab = groups.T
    both = sobol_indices(a, b, np.array(ab), confidence=CONFIDENCE)
    return {
        name: {"first": _json_estimate(first, view), "total": _json_estimate(total, view)}
        for name, first, total in zip(names, *both, strict=True)
    }


def _worst_samples(results: Results, view: RowMasks, name: str) -> list[JsonObject]:
    finite = view.good & np.isfinite(results.column(name))
    tail = Tail.of(results.column(name)[finite], view.samples[finite], MAX_LISTED_SAMPLES)
    return [{"sample": int(i), "value": float(v)} for i, v in zip(tail.indices, tail.values, strict=True)]


def _json_estimate(estimate: IntervalEstimate, view: RowMasks) -> JsonObject:
    """Return an estimate with null for numbers that are infinite or do not exist."""
    low, high = (None, None) if view.design in DETERMINISTIC_DESIGNS else (estimate.low, estimate.high)
    numbers = {"value": estimate.value, "low": low, "high": high}
    fields = {name: x if x is not None and math.isfinite(x) else None for name, x in numbers.items()}
    return {**fields, "samples": estimate.samples}
