"""Is it worth while to differentiate? Gains, and LQ weights through the Riccati equation and through the LMI.

L-BFGS on the gradient is compared with two derivative-free searches from well-kept libraries, Nelder-Mead and CMA-ES,
from the same start (`searches.py` says how they are counted), on problems of 2 to 48 parameters (`search_problems.py`
says which).

What counts is rollouts of the batch until the objective is within a hundredth, a ten thousandth and a millionth of the
way from the start to the best that any of the three ever found; and rollouts to where each derivative-free search
itself ended, to a millionth of its way. Where that is its budget and not its own end it proves little: a search still
on its way would have gone on to where gradients are slow as well. Two prices of a gradient: over a rollout that
measures all of a braking report, as `tune` does by default, and over one that measures nothing but the objective.

Chosen after results were seen: the tables (of the schedule most gains do not matter, and its filter ends at the end of
its range), L-BFGS's memory of 100 steps instead of 10, and budgets that the time allowed.

    python experiments/lq_weights.py [PROBLEM ...]      (needs the package cma, of the dependency group test)

Each problem is kept in a file of its own; table and figure show all that are there.
"""

import dataclasses
import json
import pathlib
import sys
from typing import Any

import jax
import numpy as np
import searches
from search_problems import NAMES, Config, box, problems

from diffabs import plot
from diffabs.controllers import StateFeedback
from diffabs.design import Spec, certify, design
from diffabs.papers import record
from diffabs.tune import Method, Stopping, Tuned, tune
from diffabs.tune.problem import Problem
from diffabs.tune.tuning import posed
from diffabs.tune.weights import LQWeights


def bare(problem: Problem) -> Problem:
    """Measuring nothing but the objective."""
    return dataclasses.replace(problem, measured={name: problem.measured[name] for name in problem.weights})


def allowed(config: Config, parameters: int) -> int:
    """Evaluations of a derivative-free search."""
    return next(budget for most, budget in config.budgets if parameters <= most)


def compared(config: Config, name: str) -> tuple[dict[str, Any], Tuned]:
    """One problem, three searches."""
    pose = problems(config)[name]
    problem = pose(posed)
    large = int(problem.space.size > 2)
    prices = [searches.prices(p, config.repeats) for p in (problem, bare(problem))]
    mode = min(prices[0], key=lambda mode: prices[0][mode])
    stopping = Stopping(gradient=1e-9, change=1e-11, iterations=config.iterations[large])
    found = pose(tune, method=Method(mode=mode, memory=config.memory, stopping=stopping))
    print(f"{name}: L-BFGS {found.objective[1]:.9g}, {found.evaluations} gradients; {found.reason.value}", flush=True)
    budget = allowed(config, problem.space.size)
    traces = {"L-BFGS": [(float(p.evaluations), p.objective) for p in found.history]}
    traces["Nelder-Mead"] = searches.nelder_mead(bare(problem), budget)
    print(f"{name}: Nelder-Mead {traces['Nelder-Mead'][-1]}", flush=True)
    traces["CMA-ES"] = searches.cma_es(bare(problem), budget, config.seed)
    return {
        "problem": name,
        "parameters": problem.space.size,
        "lanes": problem.batch.size,
        "prices": [{m.value: p for m, p in price.items()} for price in prices],
        "price": prices[0][mode],
        "price, bare": min(prices[1].values()),
        "start": found.objective[0],
        "found": {who: trace[-1][1] for who, trace in traces.items()},
        "spent": {who: trace[-1][0] for who, trace in traces.items()},
        "traces": traces,
        "values": {path: np.asarray(value).tolist() for path, value in found.values.items()},
    }, found


def lines(config: Config, kept: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of one problem: each accuracy, and the ends of both derivative-free searches."""
    start, traces, best = kept["start"], kept["traces"], min(kept["found"].values())
    theirs = [who for who in traces if who != "L-BFGS"]
    asked = [(f"{near:g}", best + near * (start - best), theirs) for near in config.near]
    budget = allowed(config, kept["parameters"])
    ends = {who: "budget" if kept["spent"][who] >= budget else "end" for who in theirs}
    asked += [(f"{who}'s {ends[who]}", searches.own(traces[who], start)[0], [who]) for who in theirs]
    return [line(kept, *one) for one in asked]


def line(kept: dict[str, Any], accuracy: str, target: float, theirs: list[str]) -> dict[str, Any]:
    """Rollouts to a target; None where it was not reached. Where no derivative-free search reached it, they count as
    what the longer one spent, and the ratio is a lower bound."""
    counts = {who: searches.needed(kept["traces"][who], target) for who in kept["traces"]}
    other = min(counts[who] for who in theirs)
    other = other if np.isfinite(other) else max(kept["spent"][who] for who in theirs)
    ours = {name: 1 + counts["L-BFGS"] * kept[name] for name in ("price", "price, bare")}
    shown = {who: n if np.isfinite(n) and (who in theirs or who == "L-BFGS") else None for who, n in counts.items()}
    return {
        "problem": kept["problem"],
        "parameters": kept["parameters"],
        "accuracy": accuracy,
        "gradients": shown.pop("L-BFGS"),
        "price": kept["price"],
        "rollouts": ours["price"] if np.isfinite(ours["price"]) else None,
        **shown,
        "times fewer": other / ours["price"],
        "price, bare": kept["price, bare"],
        "times fewer, bare": other / ours["price, bare"],
    }


def gains(config: Config, found: dict[str, Tuned]) -> list[dict[str, Any]]:
    """The gain that each problem on the rig ended with, what it does, and what is proved of it without the lag."""
    rows = []
    for name, one in found.items():
        if not isinstance(one.loop.controller, StateFeedback):
            continue
        gain = np.asarray(one.loop.controller.gain)
        proof = certify(gain, box(config), fastest=True)
        metrics = one.metrics[1]
        rows.append(
            {
                "tuned": name,
                "k1": float(gain[0]),
                "k2": float(gain[1]),
                "Q": np.round(np.asarray(one.part.weights()[0]), 1).tolist() if isinstance(one.part, LQWeights) else "",
                "objective": one.objective[1],
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


def figures(kept: list[dict[str, Any]]) -> dict[str, Any]:
    """Distance to the best over rollouts, one panel per problem."""
    figure, axes = plot.sheet(-(-len(kept) // 3), min(3, len(kept)), title="What a gradient is worth", size=(5.0, 3.3))
    for ax, row in zip(axes, kept, strict=False):
        best = min(row["found"].values())
        for i, (name, trace) in enumerate(row["traces"].items()):
            n, value = np.array(trace).T
            n = 1 + n * row["price"] if name == "L-BFGS" else n
            gap = np.maximum((value - best) / (row["start"] - best), 1e-9)
            named = "L-BFGS, gradients at their price" if name == "L-BFGS" else name
            ax.loglog(n, gap, plot.DASHES[i], color=plot.COLOURS[i], label=named, drawstyle="steps-post")
        title = f"{row['problem']}: {row['parameters']} parameters"
        plot.label(ax, "rollouts of the batch", "distance to the best", title)
    for ax in axes[len(kept) :]:
        ax.set_visible(False)
    return {"searches": figure}


def main(config: Config | None = None, names: tuple[str, ...] = NAMES) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    folder = pathlib.Path(config.out)
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        kept, found = compared(config, name)
        record.write(folder, kept | {"gains": gains(config, {name: found})}, f"{name.replace(' ', '_')}.json")
    files = [folder / f"{name.replace(' ', '_')}.json" for name in NAMES]
    kept = [json.loads(path.read_text(encoding="utf-8")) for path in files if path.exists()]
    rows = [row for one in kept for row in lines(config, one)]
    record.show("Rollouts of the batch", rows)
    end = [row for one in kept for row in one["gains"]]
    if end:
        record.show("Gains on the rig", end)
    results = {"table": rows, "gains": end, "paper_weights_gain": paper(config).tolist()}
    return record.experiment(config, results, figures(kept))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(names=tuple(sys.argv[1:]) or NAMES)
