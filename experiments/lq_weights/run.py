"""What is a gradient worth? Searches with and without derivatives tune gains and LQ weights.

SciPy's L-BFGS-B runs on gradients and on forward differences. Beside it stand `diffabs.tune`, Nelder-Mead, and CMA-ES
at the best of several first steps, chosen afterwards for each accuracy. `searches.py` counts them, `problems.py` has
the problems of 2 to 48 parameters, through the Riccati equation or the LMI in some.

The study counts rollouts of the batch until the objective is near the best of all searches: within a hundredth, a ten
thousandth or a millionth of the way from the start. A gradient counts at its price over a rollout that measures the
objective only.

    python experiments/lq_weights/run.py searches [PROBLEM ...]    (needs the package cma, of the dependency group test)

Each problem has a file of results. Table and figure show all files.
"""

import dataclasses
import json
import pathlib
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from diffabs.output import plot
from diffabs.papers import record
from diffabs.parts.controllers import StateFeedback
from diffabs.robust.design import Spec, certify, design
from diffabs.tune import Method, Stopping, Tuned, tune
from diffabs.tune.problem import Problem
from diffabs.tune.weights import LQWeights
from experiments._shared.entry import run_part
from experiments._shared.numbers import store_numbers
from experiments.lq_weights import searches, second_order
from experiments.lq_weights.problems import NAMES, Config, box, problems

TUNE, GRADIENTS, DIFFERENCES = "tune", "L-BFGS-B", "L-BFGS-B, differences"
NELDER_MEAD, CMA_ES = "Nelder-Mead", "CMA-ES"
WITH = (TUNE, GRADIENTS)  # derivatives


def bare(problem: Problem) -> Problem:
    """Measuring nothing but the objective."""
    return dataclasses.replace(problem, measured={name: problem.measured[name] for name in problem.weights})


def allowed(config: Config, parameters: int) -> int:
    """Evaluations of a derivative-free search."""
    return next(budget for greatest, budget in config.budgets if parameters <= greatest)


def compared(config: Config, name: str) -> tuple[dict[str, Any], Tuned]:
    """One problem, all searches. Traces of `TUNE` and `GRADIENTS` count gradients, the others rollouts."""
    pose = problems(config)[name]
    problem = bare(pose())
    large = int(problem.space.size > 2)
    prices = searches.prices(problem, config.repeats)
    mode = min(prices, key=lambda mode: prices[mode])
    iterations = config.iterations[large]
    stopping = Stopping(gradient=1e-9, change=1e-11, iterations=iterations)
    tuning = tune(pose(mode=mode), method=Method(memory=searches.MEMORY, stopping=stopping))
    print(f"{name}: tune {tuning.objective[1]:.9g}, {tuning.evaluations} gradients; {tuning.reason.value}", flush=True)
    budget = allowed(config, problem.space.size)
    calls: dict[str, Callable[[], searches.Trace]] = {
        GRADIENTS: lambda: searches.gradients(problem, mode, iterations),
        DIFFERENCES: lambda: searches.differences(problem, budget),
        NELDER_MEAD: lambda: searches.nelder_mead(problem, budget),
        **{
            f"{CMA_ES}, first step {first:g}": partial(searches.cma_es, problem, budget, config.seed, first)
            for first in config.first_steps
        },
    }
    traces = {TUNE: [(float(p.evaluations), p.objective) for p in tuning.history]}
    for who, search in calls.items():
        traces[who] = search()
        print(f"{name}: {who} {traces[who][-1]}", flush=True)
    return {
        "problem": name,
        "parameters": problem.space.size,
        "lanes": problem.batch.size,
        "prices": {m.value: p for m, p in prices.items()},
        "price": prices[mode],
        "start": tuning.objective[0],
        "found": {who: trace[-1][1] for who, trace in traces.items()},
        "spent": {who: trace[-1][0] for who, trace in traces.items()},
        "traces": traces,
        "values": {path: np.asarray(value).tolist() for path, value in tuning.values.items()},
    }, tuning


def lines(config: Config, comparison: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of one problem, one for each accuracy."""
    start, best = comparison["start"], min(comparison["found"].values())
    return [line(comparison, f"{near:g}", best + near * (start - best)) for near in config.near]


def line(problem: dict[str, Any], accuracy: str, target: float) -> dict[str, Any]:
    """Return the rollouts to a target; None if a search does not reach it.

    A ratio is None if gradients did not reach the accuracy. If the search without gradients did not, the ratio is a
    lower bound, from all its rollouts.
    """
    counts = {who: searches.needed(trace, target) for who, trace in problem["traces"].items()}
    rollouts = {who: n * problem["price"] if who in WITH else n for who, n in counts.items()}
    tuned = [who for who in counts if who.startswith(CMA_ES)]
    best = min(tuned, key=lambda who: (rollouts[who], problem["found"][who]))

    def fewer(other: str) -> float | None:
        theirs = rollouts[other] if np.isfinite(rollouts[other]) else problem["spent"][other]
        return theirs / rollouts[GRADIENTS] if np.isfinite(rollouts[GRADIENTS]) else None

    shown = {who: rollouts[who] for who in (TUNE, GRADIENTS, DIFFERENCES, NELDER_MEAD)} | {CMA_ES: rollouts[best]}
    return {
        "problem": problem["problem"],
        "parameters": problem["parameters"],
        "accuracy": accuracy,
        "price": problem["price"],
        "gradients": int(counts[GRADIENTS]) if np.isfinite(counts[GRADIENTS]) else None,
        **{who: round(n) if np.isfinite(n) else None for who, n in shown.items()},
        "best of CMA-ES": best.removeprefix(f"{CMA_ES}, "),
        "differences / gradients": fewer(DIFFERENCES),
        "CMA-ES / gradients": fewer(best),
    }


def gains(config: Config, tunings: dict[str, Tuned]) -> list[dict[str, Any]]:
    """Return the final gain of each problem on the rig, its metrics, and its certificate without the lag."""
    rows = []
    for name, tuning in tunings.items():
        if not isinstance(tuning.loop.controller, StateFeedback):
            continue
        gain = np.asarray(tuning.loop.controller.gain)
        proof = certify(gain, box(config), fastest=True)
        metrics = tuning.metrics[1]
        rows.append(
            {
                "tuned": name,
                "k1": float(gain[0]),
                "k2": float(gain[1]),
                "Q": np.round(np.asarray(tuning.part.weights()[0]), 1).tolist()
                if isinstance(tuning.part, LQWeights)
                else "",
                "objective": tuning.objective[1],
                "worst overshoot [%]": 100 * float(metrics["overshoot"].max()),
                "mean IAE [s]": float(metrics["iae"].mean()),
                "common P": {True: "yes", False: "none", None: "undecided"}[proof.quadratically_stable],
                "decay proved [1/s]": proof.decay_rate,
            }
        )
    return rows


def paper(config: Config) -> np.ndarray:
    """The robust design with the paper's weights, for orientation."""
    return design(box(config), Spec(Q=config.weights, R=1.0)).gain[0]


def figures(comparisons: list[dict[str, Any]]) -> dict[str, Any]:
    """Distance to the best over rollouts, one panel per problem."""
    figure, axes = plot.sheet(
        -(-len(comparisons) // 3), min(3, len(comparisons)), title="What a gradient is worth", size=(5.0, 3.3)
    )
    for ax, row in zip(axes, comparisons, strict=False):
        best = min(row["found"].values())
        for i, (name, trace) in enumerate(row["traces"].items()):
            n, value = np.array(trace).T
            n = n * row["price"] if name in WITH else n
            gap = np.maximum((value - best) / (row["start"] - best), 1e-9)
            style = {"ls": plot.DASHES[i % len(plot.DASHES)], "color": plot.COLOURS[i % len(plot.COLOURS)]}
            ax.loglog(n, gap, label=name, drawstyle="steps-post", **style)
        title = f"{row['problem']}: {row['parameters']} parameters"
        plot.label_axes(ax, "rollouts of the batch", "distance to the best", title)
    for ax in axes[len(comparisons) :]:
        ax.set_visible(False)
    return {"searches": figure}


def main(config: Config | None = None, names: tuple[str, ...] = NAMES) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    folder = pathlib.Path(config.out)
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        comparison, tuning = compared(config, name)
        record.write_summary(
            folder, comparison | {"gains": gains(config, {name: tuning})}, name=f"{name.replace(' ', '_')}.json"
        )
    files = [folder / f"{name.replace(' ', '_')}.json" for name in NAMES]
    comparisons = [json.loads(path.read_text(encoding="utf-8")) for path in files if path.exists()]
    rows = [row for comparison in comparisons for row in lines(config, comparison)]
    record.print_rows("Rollouts of the batch", rows)
    end = [row for comparison in comparisons for row in comparison["gains"]]
    if end:
        record.print_rows("Gains on the rig", end)
    results = {"table": rows, "gains": end, "paper_weights_gain": paper(config).tolist()}
    return record.experiment(config, results, figures(comparisons))


if __name__ == "__main__":

    def run_searches(names: list[str]) -> None:
        """Run the searches, and store the numbers of the page if they are of all problems."""
        results = main(names=tuple(names) or NAMES)
        if not names:
            store_numbers(__file__, results, 1e-2)

    run_part({"searches": run_searches, "second-order": second_order.main})
