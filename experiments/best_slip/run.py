"""Which rule for the target slip comes nearest to the shortest possible stop?

Aoki and Nakamura target the slip at the greatest deceleration. The study compares five rules: their latch, a latch for
noisy sensors, extremum seeking, one fixed slip, and a slip by the measured deceleration. Gradients tune each rule on
the same roads, with the PI and its anti-windup, for exact sensors. `rules` tunes for noise and bias, too. Distances
are relative to the shortest stop of each road with a brake of 90 N m (`bound.py`). `fixed.py` has the criterion.

    python experiments/best_slip/run.py
"""

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from diffabs import Batch, FixedStep, Loop, run_batch
from diffabs.output import plot
from diffabs.papers import record
from experiments._shared.entry import with_times
from experiments._shared.numbers import SEARCH_TOLERANCE, store_numbers
from experiments._shared.statistics import interval
from experiments.best_slip.fixed import ERRORS, EXACT, Fixed, Lanes, best, good, lanes, line
from experiments.best_slip.rules import FIXED, KNOWN, PAPER, ROBUST, RULES, Ranges, start, told_the_peak, untuned
from experiments.best_slip.search import MEASURED, Search, against_differences, by_cma_es, described, tuned

Metrics = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    fixed: Fixed = dataclasses.field(default_factory=Fixed)
    ranges: Ranges = dataclasses.field(default_factory=Ranges)
    search: Search = dataclasses.field(default_factory=Search)
    rules: Mapping[str, tuple[str, ...]] = dataclasses.field(  # that are tuned, by sensors: exact ones first, and then
        default_factory=lambda: {EXACT: RULES, ERRORS: ()}  # a fixed slip is among them. Others are carried over
    )
    searched_again: tuple[str, ...] = (ROBUST,)  # by CMA-ES, with exact sensors
    farthest: float = 25.0  # % above the bound, end of the figure
    out: str = "out/experiments/best_slip"


def judged(config: Config, loop: Loop, batch: Batch, finer: int = 1) -> Metrics:
    """Metrics of every lane, with so many times shorter steps."""
    solver = FixedStep(step=config.fixed.step / finer, duration=config.fixed.longest)
    runs = jax.device_get(run_batch(loop, batch, solver, MEASURED, engine="kernel"))
    return {**runs.metrics, "stopped": runs.stopped, "diverged": runs.diverged}


def contenders(config: Config, sensors: str, unseen: Lanes, loops: dict[str, Loop]) -> dict[str, tuple[Loop, Batch]]:
    """Return loops and lanes: untuned, tuned, and with known roads under the controller of the fixed slip."""
    batch = unseen.batch(sensors)
    sensor = start(config.ranges, config.fixed, sensors, FIXED).sensor
    cases = {name: (loop, batch) for name, loop in untuned(config.ranges, config.fixed, sensors)}
    cases |= {name: (dataclasses.replace(loop, sensor=sensor), batch) for name, loop in loops.items()}
    return cases | {KNOWN: told_the_peak(config.fixed, sensors, loops[FIXED].controller, unseen)}


def by_road(name: str, metrics: Metrics, unseen: Lanes) -> dict[str, Any]:
    """Return means above the bound [%] on kinds of roads, with and without a stop that attains the bound."""
    bound, ended = unseen.bound, good(metrics)
    excess = 100 * (metrics["stop_distance"] / bound.distance - 1)
    level = unseen.family.values["plant.road.roads.0.D"]
    kinds = {
        "one surface": bound.attained,
        "one surface, peak below 0.3": bound.attained & (level < 0.3),
        "one surface, peak above 0.8": bound.attained & (level > 0.8),
        "with an edge, to less friction": ~bound.attained & _falls(unseen),
        "with an edge, to more": ~bound.attained & ~_falls(unseen),
    }
    means = {
        kind: float(np.mean(excess[lanes & ended])) if np.any(lanes & ended) else None for kind, lanes in kinds.items()
    }
    return {"rule": name, **means}


def _falls(unseen: Lanes) -> np.ndarray:
    values = unseen.family.values
    return values["plant.road.roads.1.D"] < values["plant.road.roads.0.D"]


def halved(config: Config, loop: Loop, batch: Batch, metrics: Metrics, shortest: np.ndarray) -> dict[str, Any]:
    """By how much the mean above the bound changes [%] if steps are half as long; lanes that end otherwise."""
    again = judged(config, loop, batch, finer=2)
    both = good(metrics) & good(again)
    change = (again["stop_distance"] - metrics["stop_distance"])[both] / shortest[both]
    return {
        "mean change [%]": 100 * float(np.mean(change)) if both.any() else None,
        "lanes that end otherwise": int(np.sum(good(metrics) != good(again))),
    }


def of_sensors(
    config: Config, sensors: str, report: Callable[[str], None], carried: dict[str, Loop]
) -> tuple[dict[str, Any], dict[str, Metrics], dict[str, Loop]]:
    """Tune, judge and check the rules for these sensors. Returns the results, the metrics of every lane, and the
    loops by rule."""
    fixed, searches = config.fixed, {}
    for rule in config.rules[sensors]:
        searches[rule] = tuned(config.search, fixed, sensors, rule, config.ranges)
        report(f"{sensors}, {rule}: {searches[rule].tuned.objective[1]:.5f}")
    loops = carried | {rule: search.loop for rule, search in searches.items()}
    unseen = lanes(fixed, fixed.roads.held_out, fixed.roads.seed + 1)
    shortest = unseen.bound.distance
    those = contenders(config, sensors, unseen, loops)
    results = {name: judged(config, *case) for name, case in those.items()}
    report(f"{sensors}: judged")
    named = {n: (f"tuned, {n}" if n in searches else f"tuned for {EXACT}, {n}") if n in loops else n for n in results}
    checks = {named[name]: halved(config, *those[name], results[name], shortest) for name in (PAPER, *loops)}
    report(f"{sensors}: halved")
    slopes = {
        rule: against_differences(config.search, fixed, sensors, rule, config.ranges, search.loop)
        for rule, search in searches.items()
    }
    report(f"{sensors}: differences")
    said = {
        "table": [{"rule": named[n], **line(fixed, result, results[PAPER], shortest)} for n, result in results.items()],
        "by road": [by_road(named[name], result, unseen) for name, result in results.items()],
        "best": best(fixed, {rule: results[rule] for rule in loops}, shortest),
        "tuning": {rule: described(search) for rule, search in searches.items()},
        "half the step": checks,
        "derivatives": slopes,
    }
    return said, results, loops


def of_bounds(fixed: Fixed) -> dict[str, Any]:
    """Return how much the bound exceeds the distance at the peak's friction alone, and the shares of the kinds of
    roads."""
    bound = lanes(fixed, fixed.roads.held_out, fixed.roads.seed + 1).bound
    mean, half = interval(bound.distance / bound.friction - 1, fixed.confidence)
    return {
        "above friction alone [%]": 100 * mean,
        "+- [%]": 100 * half,
        "attained": int(bound.attained.sum()),
        "torque too weak for the first peak": int(bound.weak.sum()),
    }


def figure(config: Config, results: dict[str, dict[str, Metrics]], shortest: np.ndarray) -> Any:
    """Share of all roads that a rule stops within so many per cent of the bound; failures never count."""
    sheet, axes = plot.sheet(1, len(results), title="Stops on roads not tuned for", size=(5.6, 4.4), sharey=True)
    for ax, (sensors, those) in zip(axes, results.items(), strict=True):
        for j, name in enumerate((PAPER, *RULES, KNOWN)):
            if name not in those:
                continue
            result = those[name]
            above = np.sort(100 * (result["stop_distance"] / shortest - 1)[good(result)])
            share = 100 * np.arange(1, len(above) + 1) / len(shortest)
            if not np.any(above <= config.farthest):  # a legend entry without a curve says why there is none
                name = f"{name}: none within {config.farthest:g} %"
            ax.plot(above, share, plot.DASHES[j], color=plot.COLOURS[j], label=name)
        ax.set_xlim(0.0, config.farthest)
        ax.set_ylim(0.0, 100.0)
        plot.label_axes(ax, "above the bound [%]", "share of the roads [%]" if ax is axes[0] else "", sensors)
    return sheet


def main(config: Config | None = None, progress: Callable[[str], None] = lambda line: None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config, begun = config or Config(), time.process_time()
    tables, results, loops = {}, {}, {}
    for sensors in config.rules:
        tables[sensors], results[sensors], loops = of_sensors(config, sensors, progress, loops)
        count = config.fixed.roads.held_out
        record.print_rows(
            f"{sensors}: {count} roads, intervals of {config.fixed.confidence:.0%}", tables[sensors]["table"]
        )
        record.print_rows(f"{sensors}: means above the bound [%] by kind of road", tables[sensors]["by road"])
    again = {rule: by_cma_es(config.search, config.fixed, EXACT, rule, config.ranges) for rule in config.searched_again}
    shortest = lanes(config.fixed, config.fixed.roads.held_out, config.fixed.roads.seed + 1).bound.distance
    whole = {**tables, "bound": of_bounds(config.fixed), "CMA-ES, exact sensors": again}
    whole["seconds of processor time"] = time.process_time() - begun
    return record.experiment(config, whole, {"roads": figure(config, results, shortest)})


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    store_numbers(__file__, main(progress=with_times()), SEARCH_TOLERANCE)
