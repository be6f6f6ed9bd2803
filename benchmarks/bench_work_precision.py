"""Error against time of our own solvers: FixedStep, and Adaptive, on six problems (problems.py).

The error of a setting is the worst relative one of its metrics over ALL lanes, against FixedStep in float64 with steps
that end on kinks; how far those of half the step are from it is in the last column of its table. There are `--distinct`
different lanes; more lanes repeat them, which costs the same and can be compared. Times are those of `run_batch` as a
user calls it, on one device, taken in turn within a round; medians. A setting that would take longer than
`--longest` is left out. Prints a table for every precision and number of lanes; writes JSON.

    python benchmarks/bench_work_precision.py [--quick] [--problems lmi arm] [--lanes 1 64 4096 131072]
"""

import argparse
import functools
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
from typing import Any

import jax
import numpy as np
import problems
import record
from peers import ours
from rich.console import Console
from rich.table import Table

import diffabs

NAMES = ("lmi", "est-pi", "est-latch", "slip-cured", "arm", "lmi-noisy")
ASKED = 1e-4  # relative, on every lane
FINER = 30.0  # a setting so many times better than asked ends the ladder


def child(options: Any) -> dict[str, Any]:
    """Return what is found in one precision, in this process: {problem: {"apart", "points"}}."""
    jax.config.update("jax_enable_x64", options.dtype == "float64")
    every = problems.problems()
    return {name: one(name, every[name], options) for name in options.problems}


def one(name: str, problem: problems.Problem, options: Any) -> dict[str, Any]:
    """Return the points of one problem, and how far its references are apart."""
    exact, apart = reference(name, problem, options)
    points = []
    for count in options.lanes:
        points += measured(problem, count, exact, options)
        print(f"{options.dtype}, {name}, {count:,} lanes", file=sys.stderr)
    return {"title": problem.title, "exact_step": problem.exact / 2, "apart": apart, "points": points}


def reference(name: str, problem: problems.Problem, options: Any) -> tuple[dict[str, np.ndarray], float]:
    """Return (the metrics of the distinct lanes, how far they are from those of twice the step), made by the process in
    float64, and kept in the folder for the others."""
    path = pathlib.Path(options.folder) / f"{name}.npz"
    if not path.exists():
        batch, _ = problem.lanes(options.distinct, options.distinct)
        half, whole = (solved(problem, batch, problem.solver("exact", h)) for h in (problem.exact / 2, problem.exact))
        np.savez(path, apart=max(errors(whole, half).values()), **half)
    with np.load(path) as stored:
        found = dict(stored)
    return found, float(found.pop("apart"))


def solved(problem: problems.Problem, batch: diffabs.Batch, solver: Any) -> dict[str, np.ndarray]:
    """Return the metrics of every lane."""
    run = diffabs.run_batch(problem.loop, batch, solver, problem.metrics, engine="xla")
    return {name: np.asarray(value, float) for name, value in run.metrics.items()}


def errors(found: dict[str, np.ndarray], exact: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the worst relative error of each metric: infinite where a number is none."""
    relative = {name: np.abs(found[name] / exact[name] - 1) for name in exact}
    return {name: float(np.where(np.isfinite(x), x, np.inf).max()) for name, x in relative.items()}


def measured(problem: problems.Problem, count: int, exact: Any, options: Any) -> list[dict[str, Any]]:
    """Return a point for each solver and setting."""
    batch, which = problem.lanes(count, options.distinct)
    right, points, takers = {name: x[which] for name, x in exact.items()}, [], {}
    for kind in ours.KINDS:
        rate = 0.0  # seconds of a lane and a step, or of a lane, of the setting before
        for setting in problem.ladder(kind):
            if rate * count > options.longest:
                break
            run = functools.partial(solved, problem, batch, problem.solver(kind, setting))
            each = errors(run(), right)
            point = {"solver": kind, "setting": setting, "lanes": count, "error": max(each.values()), "errors": each}
            points.append(point)
            takers[kind, setting] = lambda run=run: record.timed(run)
            if point["error"] <= ASKED / FINER:
                break
            rate = takers[kind, setting]() / count * 2  # the next one costs about twice as much
    taken = record.in_turn(takers, options.rounds)
    for point in points:
        point["seconds"] = taken[point["solver"], point["setting"]]
        point["run_s"] = statistics.median(point["seconds"])
    return points


def parent(options: Any) -> dict[str, Any]:
    """Return {dtype: what its process found}: float64 first, which makes the references."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for dtype in ("float64", "float32"):
            out = pathlib.Path(folder) / f"{dtype}.json"
            lists = ["--problems", *options.problems, "--lanes", *map(str, options.lanes)]
            numbers = [f"--{name}={getattr(options, name)}" for name in ("rounds", "distinct", "longest")]
            command = [sys.executable, __file__, *lists, *numbers, "--dtype", dtype, "--folder", folder, "--out", out]
            subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
            found[dtype] = json.loads(out.read_text())
    return found


def show(found: dict[str, Any], options: Any) -> None:
    """A table for every precision and number of lanes, and how good the references are."""
    console = Console(width=80)
    for dtype, by_problem in found.items():
        for count in options.lanes:
            console.print(table(by_problem, f"{count:,} lanes, {dtype}", count))
    worst = max(one_problem["apart"] for by_problem in found.values() for one_problem in by_problem.values())
    console.print("! the most accurate of the ladder, which is not what is asked")
    console.print(f"references change by at most {worst:.0e} if their step is halved")


def table(by_problem: dict[str, Any], what: str, count: int) -> Table:
    """Return the coarsest accurate setting of each solver, its error and its rate, and the ratio of the rates."""
    shown = Table(title=f"{what}: the coarsest with errors <= {ASKED:g}", expand=True)
    shown.add_column("problem", ratio=1)
    for heading in ("step [s]", "error", "runs/s", "rtol", "error", "runs/s", "times"):
        shown.add_column(heading, justify="right", no_wrap=True)
    for one_problem in by_problem.values():
        pair = [cheapest(one_problem["points"], kind, count) for kind in ("fixed", "adaptive")]
        faster = f"{record.ratio(pair[0]['seconds'], pair[1]['seconds']):.3g}" if all(pair) else "-"
        shown.add_row(one_problem["title"], *(cell for point in pair for cell in figures(point)), faster)
    return shown


def cheapest(points: list[dict[str, Any]], kind: str, count: int) -> dict[str, Any] | None:
    """Return the first accurate point of a solver, coarse to fine, else its most accurate; None if it has none."""
    return record.best((p for p in points if p["solver"] == kind and p["lanes"] == count), ASKED)


def figures(point: dict[str, Any] | None) -> tuple[str, str, str]:
    """Return setting, error, runs/s of a point; dashes for none."""
    if point is None:
        return ("-", "-", "-")
    mark = "" if point["error"] <= ASKED else "!"
    return f"{point['setting']:g}", f"{point['error']:.0e}{mark}", f"{point['lanes'] / point['run_s']:,.0f}"


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", choices=NAMES, default=list(NAMES))
    parser.add_argument("--lanes", nargs="+", type=int, default=[1, 64, 4096, 131072])
    parser.add_argument("--distinct", type=int, default=512)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--longest", type=float, default=60.0, help="seconds of one batch")
    parser.add_argument("--quick", action="store_true", help="1, 64 and 1024 lanes, 64 distinct ones")
    parser.add_argument("--dtype", choices=("float32", "float64"), help=argparse.SUPPRESS)
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    if options.dtype:
        options.out.write_text(json.dumps(child(options)), encoding="utf-8")
        return
    if options.quick:
        options.lanes, options.distinct = [1, 64, 1024], 64
    found = parent(options)
    show(found, options)
    written = record.written("work-precision", {"found": found, "asked": ASKED, "lanes": options.lanes}, options.out)
    Console().print(f"written to {written}", soft_wrap=True)


if __name__ == "__main__":
    main()
