"""The summary of a finished sweep, as JSON values.

It contains counts, failure probabilities, statistics of each metric, sensitivities, and the worst samples. Columns are
read one at a time, so that ten million rows fit into memory. The design decides the intervals:

    random                      of independent samples
    sobol, replicates > 1       from the spread between the replicates
    sobol, latin-hypercube      of independent samples, which are too wide
    grid, corners               none: nothing is random; limits of intervals are null
    saltelli                    of its rows A, too wide as those of Sobol' sequences; Sobol' indices from all
"""

import math
from collections.abc import Iterator

import numpy as np

from diffabs.core.types import JsonObject, PyTree
from diffabs.sweep.results import Results
from diffabs.sweep.statistics.estimates import Count, Tail, cvar, mean_of_replicates, quantile
from diffabs.sweep.statistics.estimates import summarise_column as summarised
from diffabs.sweep.statistics.sensitivity import correlations, sobol_indices

QUANTILE_LEVELS, CVAR_LEVEL = (0.05, 0.5, 0.95), 0.95
MAX_CORRELATED_SAMPLES = 200_000  # correlations use at most this number of samples, the first ones
MAX_LISTED_SAMPLES = 10
MIN_SAMPLES = 4  # smallest number of samples with statistics
INTERVAL_NOTES = {
    "random": "independent samples",
    "sobol": "spread between replicates",
    "one sobol": "as of independent samples: too wide for a Sobol' sequence",
    "latin-hypercube": "as of independent samples: too wide for a Latin hypercube",
    "saltelli": "as of independent samples, rows A only: too wide for a Sobol' sequence",
    "grid": "none: a grid is not random",
    "corners": "none: corners are not random",
}


def summarise_sweep(found: Results, confidence: float = 0.95) -> JsonObject:
    """Return the summary of the finished chunks.

    Its entries are:

    - `samples`, `complete`, `digest`: Number of rows, whether all chunks are finished, and the digest of the table.
    - `diverged`, `refused`: `count` and first `samples`; `refused` also counts each reason.
    - `confidence`, `intervals`: Confidence, and the meaning of the intervals as text.
    - `failures`: Probability of each kind of failure, and of `any`.
    - `never`: Runs with an infinite value, by metric, where there are some.
    - `metrics`: Statistics by metric.
    - `sensitivity`: Correlations, or Sobol' indices, by metric and variable.
    - `worst`: Samples with the largest values, by metric.

    Diverged runs enter the failures but no other statistic. Refused samples enter none. An infinite end is None.

    Args:
        found: Results of the sweep.
        confidence: Confidence of the intervals, in (0, 1).
    """
    accepted = found.accepted
    diverged = found.column("diverged") & accepted
    view = _RowSelection(found, accepted & ~diverged, accepted)
    kind = found.study["space"]["design"]["type"]
    note = INTERVAL_NOTES["one sobol" if kind == "sobol" and view.replicates == 1 else kind]
    reasons, counts = np.unique(found.column("refused")[~accepted].astype(str), return_counts=True)
    return {
        "samples": len(diverged),
        "complete": found.complete,
        "diverged": {
            "count": int(diverged.sum()),
            "samples": found.column("sample")[diverged][:MAX_LISTED_SAMPLES].tolist(),
        },
        "refused": {
            "count": int(np.sum(~accepted)),
            "samples": found.column("sample")[~accepted][:MAX_LISTED_SAMPLES].tolist(),
            "reasons": dict(zip(reasons.tolist(), counts.tolist(), strict=True)),
        },
        "confidence": confidence,
        "intervals": note,
        "failures": dict(_failure_probabilities(found, view, confidence)),
        "never": {name: never for name in found.metrics if (never := view.never(name))["count"]},
        "metrics": {name: _summarise_metric(view, name, confidence) for name in found.metrics},
        "sensitivity": _summarise_sensitivity(found, view, confidence),
        "worst": {name: _worst_samples(found, view, name) for name in found.metrics},
        "digest": found.digest,
    }


class _RowSelection:
    """The rows that enter the statistics, and their groups."""

    def __init__(self, found: Results, good: np.ndarray, accepted: np.ndarray):
        design = found.study["space"]["design"]
        self.found, self.good, self.accepted = found, good, accepted
        self.random = design["type"] not in ("grid", "corners")
        self.replicates = design.get("replicates", 1) if found.complete else 1
        self.period = len(found.study["space"]["variables"]) + 2 if design["type"] == "saltelli" else 1
        self.rows = np.arange(len(good)) % self.period == 0

    def column(self, name: str) -> np.ndarray:
        return self.found.column(name)[self.good & self.rows]

    def blocks(self, name: str) -> list[np.ndarray]:
        """Return one column for each replicate."""
        values = np.where(self.good, self.found.column(name), np.nan)
        return [block[np.isfinite(block)] for block in np.split(values, self.replicates)]

    def never(self, name: str) -> JsonObject:
        """Return the number and the first samples of runs with an infinite value, which never reach the measured event.

        No other statistic includes them.
        """
        rows = self.good & self.rows & np.isinf(self.found.column(name))
        return {"count": int(rows.sum()), "samples": self.found.column("sample")[rows][:MAX_LISTED_SAMPLES].tolist()}


def _failure_probabilities(found: Results, view: _RowSelection, confidence: float) -> Iterator[tuple[str, PyTree]]:
    kinds = found.failures()
    kinds["any"] = np.any(list(kinds.values()), axis=0)
    asked = view.rows & view.accepted
    if not asked.any():
        return
    parts = np.split(view.accepted, view.replicates)
    for name, failed in kinds.items():
        count = Count(int(failed[asked].sum()), int(asked.sum()))
        one = count.probability(confidence=confidence).table()
        if view.replicates > 1 and all(part.any() for part in parts):
            blocks = zip(np.split(failed, view.replicates), parts, strict=True)
            shares = [float(block[part].mean()) for block, part in blocks]
            one = mean_of_replicates(shares, confidence=confidence).table() | {"value": count.failures / count.samples}
        yield name, {"count": count.failures, **_json_estimate(one, view.random)}


def _summarise_metric(view: _RowSelection, name: str, confidence: float) -> JsonObject:
    values = view.column(name)
    values = values[np.isfinite(values)]
    if len(values) < MIN_SAMPLES:
        return {}
    found = summarised(values, confidence, QUANTILE_LEVELS, CVAR_LEVEL)
    if view.replicates > 1:
        blocks = view.blocks(name)
        kinds: JsonObject = {"mean": np.mean}
        kinds |= {f"quantile {level:g}": lambda x, level=level: quantile(x, level).value for level in QUANTILE_LEVELS}
        kinds[f"cvar {CVAR_LEVEL:g}"] = lambda x: cvar(x, CVAR_LEVEL, replicates=100).value
        found |= {
            k: mean_of_replicates([float(of(b)) for b in blocks], confidence=confidence).table()
            for k, of in kinds.items()
        }
    ends = {"least": float(values.min()), "greatest": float(values.max())}
    return {**{kind: _json_estimate(one, view.random) for kind, one in found.items()}, **ends}


def _summarise_sensitivity(found: Results, view: _RowSelection, confidence: float) -> JsonObject:
    """Return by metric and variable the correlations, or the Sobol' indices of a Saltelli design."""
    variables = [path for path in found.variables if found.is_number(path)]
    metrics = {name: found.column(name) for name in found.metrics}
    if view.period > 1:
        names = list(found.study["space"]["variables"])
        return {name: _summarise_indices(values, view, names, confidence) for name, values in metrics.items()}
    rows = np.flatnonzero(view.good)[:MAX_CORRELATED_SAMPLES]
    if not view.random or not variables or len(rows) < MIN_SAMPLES:
        return {}
    x = np.stack([found.column(path)[rows] for path in variables], axis=1)
    result = {}
    for name, values in metrics.items():
        y = values[rows]
        known = np.isfinite(y)
        if known.sum() < MIN_SAMPLES:
            continue
        both = correlations(x[known], y[known], confidence=confidence, binormal=False)
        result[name] = {
            path: {"pearson": _json_estimate(p.table(), True), "spearman": _json_estimate(s.table(), True)}
            for path, p, s in zip(variables, *both, strict=True)
        }
    return result


def _summarise_indices(values: np.ndarray, view: _RowSelection, names: list[str], confidence: float) -> JsonObject:
    """Return the Sobol' indices of one metric, without rows in which a run diverged or has an infinite value."""
    whole = len(values) // view.period * view.period
    table, good = values[:whole].reshape(-1, view.period), view.good[:whole] & np.isfinite(values[:whole])
    good = good.reshape(-1, view.period).all(axis=1)
    if good.sum() < MIN_SAMPLES:
        return {}
    a, b, *ab = table[good].T
    both = sobol_indices(a, b, np.array(ab), confidence=confidence)
    return {
        name: {"first": _json_estimate(first.table(), True), "total": _json_estimate(total.table(), True)}
        for name, first, total in zip(names, *both, strict=True)
    }


def _worst_samples(found: Results, view: _RowSelection, name: str) -> list[JsonObject]:
    known = view.good & np.isfinite(found.column(name))
    values, samples = found.column(name)[known], found.column("sample")[known]
    tail = Tail.of(values, samples, MAX_LISTED_SAMPLES)
    return [{"sample": int(i), "value": float(v)} for i, v in zip(tail.indices, tail.values, strict=True)]


def _json_estimate(estimate: JsonObject, random: bool) -> JsonObject:
    """Return an estimate with null for ends that are infinite or do not exist."""
    ends = {end: estimate[end] if random and math.isfinite(estimate[end]) else None for end in ("low", "high")}
    value = estimate["value"]
    return {"value": value if math.isfinite(value) else None, **ends}
