"""Accuracy of a sweep's metrics: a random sample of its runs, repeated with steps of half the length."""

import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.pytree import refine_parts
from diffabs.core.types import Bool, JsonObject, Key
from diffabs.engine.solvers import describe_solver, refine_solver
from diffabs.loop.accuracy import is_comparable
from diffabs.loop.batch import Batch, group_by_structure, stack_loops
from diffabs.loop.closed_loop import Loop
from diffabs.loop.result import differs_in_kind
from diffabs.uncertainty.sweep.runner import Columns, Runner
from diffabs.uncertainty.sweep.study import Study, is_accepted, precision

if TYPE_CHECKING:
    from diffabs.uncertainty.sweep.results import Results

ACCURACY_STREAM = 0x0ACC  # stream of random numbers, independent of the designs
NEGLIGIBLE_CHANGE = 1e-9  # smaller changes, or changes below solver.rtol, give no warning; in the unit of the metric
MAX_RELATIVE_CHANGE = 0.01  # largest relative change by a half step without a warning


def check_accuracy(study: Study, results: "Results", count: int) -> JsonObject:
    """Return how much a half step changes each metric, for at most `count` runs that did not diverge.

    The seed chooses the runs. The result has these entries:

    - `samples`: Numbers of the compared samples.
    - `step`, `solver`: The half step [s], and the description of the sweep's solver.
    - `ended otherwise`, `not comparable`: Numbers of runs left out, because they end differently or draw other noise.
    - `turned`: For each metric that is finite with one step and not with the other, the `count` and numbers of such
      `samples`. They are not in `metrics`.
    - `metrics`: For each metric the `median` and `largest` relative change, and the `sample` with the largest. Its
      `difference` is the absolute change of this sample, in the metric's unit.

    A change is relative to the metric's absolute value, or to the median of these if that is larger. A metric without
    finite values is left out of `metrics`.
    """
    samples = _choose_samples(study, results, count)
    rows = np.searchsorted(results.column("sample"), samples)  # missing chunks have no rows
    stopped = results.column("stopped")[rows]
    if len(samples):
        half = _run_finer(study, samples)
        alike = ~half["diverged"] & (half["stopped"] == stopped)
        same_noise = _draw_same_noise(study, samples)
    else:
        half = {name: np.zeros(0) for name in results.metrics}
        alike = same_noise = np.zeros(0, bool)
    comparable = same_noise & alike
    compared, rows = samples[comparable], rows[comparable]
    pairs = {name: (results.column(name)[rows], half[name][comparable]) for name in results.metrics}
    turned = {name: compared[differs_in_kind(*pair)].tolist() for name, pair in pairs.items()}
    changes = {name: _summarise_changes(*pair, compared) for name, pair in pairs.items()}
    return {
        "samples": compared.tolist(),
        "step": study.solver.step / 2,
        "solver": describe_solver(study.solver),
        "ended otherwise": int((same_noise & ~alike).sum()),
        "not comparable": int((~same_noise).sum()),
        "turned": {name: {"count": len(numbers), "samples": numbers} for name, numbers in turned.items() if numbers},
        "metrics": {name: row for name, row in changes.items() if row},
    }


def accuracy_warnings(result: JsonObject) -> list[str]:
    """Return warnings for a reader of the statistics, one line each."""
    lines = []
    rows = result["metrics"].items()
    nothing = max(NEGLIGIBLE_CHANGE, result.get("solver", {}).get("rtol", 0.0))
    loose = {name: row for name, row in rows if row["largest"] > MAX_RELATIVE_CHANGE and row["difference"] > nothing}
    if loose:
        each = (f"{name} by up to {100 * row['largest']:.3g} % (sample {row['sample']})" for name, row in loose.items())
        cure = "lower solver.rtol" if "rtol" in result.get("solver", {}) else "shorten solver.step"
        lines.append(f"a half step changes {', '.join(each)}: {cure}")
    lines += describe_turned_metrics(result)
    if result["ended otherwise"]:
        lines.append(f"with a half step {result['ended otherwise']} of the lanes looked at ended in another way")
    if result["not comparable"]:
        lines.append("accuracy unknown: a half step draws other noise, or a block computes once in every step")
    return lines


def describe_turned_metrics(result: JsonObject) -> Iterator[str]:
    """Yield a line for each metric that the half step turns from a number into never, or back; old results lack it."""
    for name, row in result.get("turned", {}).items():
        where = f"{row['count']} of {len(result['samples'])} runs, the first sample {row['samples'][0]}"
        yield f"{name} is finite with one step and never with the other in {where}: its statistics cannot be trusted"


def _choose_samples(study: Study, results: "Results", count: int) -> np.ndarray:
    """Return the numbers of at most `count` samples with metrics, in ascending order."""
    good = results.column("sample")[is_accepted(results.column("refused")) & ~results.column("diverged")]
    random = np.random.default_rng([study.seed, ACCURACY_STREAM])
    return np.sort(random.choice(good, min(count, len(good)), replace=False))


def _run_finer(study: Study, samples: np.ndarray) -> Columns:
    """Return the columns of samples with half the step, by the engine of the study."""
    parts = {path: {name: refine_parts(part, 2) for name, part in each.items()} for path, each in study.parts.items()}
    loop, solver = refine_parts(study.loop, 2), refine_solver(study.solver, 2)
    # Runs that are no chunk of a sweep, but of its size: JAX then has traced their program already.
    return Runner(dataclasses.replace(study, loop=loop, parts=parts, solver=solver)).run_samples(samples.tolist())


def _draw_same_noise(study: Study, samples: np.ndarray) -> np.ndarray:
    """Return for each sample whether a half step draws the same noise, and blocks compute at the same instants."""
    mask = np.zeros(len(samples), bool)
    loops, keys = zip(*map(study.lane, samples.tolist()), strict=True)
    for places in group_by_structure(loops):  # loops of one structure share a program
        loop, batch = stack_loops([loops[i] for i in places])
        loop = jax.tree.map(np.asarray, loop)  # an array of JAX would ask for its double precision in single
        lanes = batch.values, jnp.stack([keys[i] for i in places])

        def compare(loop: Loop, key: Key) -> Bool:
            return is_comparable(loop, study.solver, key, (2,))

        with precision(study.dtype):
            mask[places] = jax.jit(lambda *lanes, loop=loop: Batch(*lanes).each(loop, compare))(*lanes)
    return mask


def _summarise_changes(values: np.ndarray, half: np.ndarray, samples: np.ndarray) -> JsonObject:
    finite = np.isfinite(values) & np.isfinite(half)  # a run that never settles has an infinite settling time
    values, half, samples = values[finite], half[finite], samples[finite]
    if not len(values):
        return {}
    # A value near zero would have a huge relative change, so the median bounds the reference from below.
    typical = np.maximum(np.abs(values), np.median(np.abs(values)))
    change = np.abs(half - values)
    relative = np.divide(change, typical, out=np.where(change > 0, np.inf, 0.0), where=typical > 0)
    worst = int(np.argmax(relative))
    return {
        "median": float(np.median(relative)),
        "largest": float(relative[worst]),
        "difference": float(change[worst]),
        "sample": int(samples[worst]),
    }
