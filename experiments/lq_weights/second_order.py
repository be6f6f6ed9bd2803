"""Do second derivatives pay in a search? SciPy's L-BFGS-B beside searches with Hessians, counted in gradients.

    L-BFGS-B            on gradients
    BFGS                on gradients, from the inverse of the Hessian at the start, eigenvalues made positive
    L-BFGS-B, BFGS      15 gradients of the first; then the second, from the best point
    trust-exact         a Hessian at every step, in a trust region

Gradients come from a kernel. A Hessian is p forward differences of them and counts as p gradients, for p parameters.
The exact Hessian, forward mode over forward mode by XLA, agrees and costs more: `--exact` prints its processor time.
All searches have equal starts and budgets. An accuracy is relative to the best of all searches from a start.

    python experiments/lq_weights/run.py second-order [PROBLEM ...] [--starts 3] [--budget 150] [--exact]
"""

import argparse
import dataclasses
import json
import pathlib
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import minimize

from diffabs.tune.problem import Problem
from experiments.lq_weights.problems import NAMES, Config, problems
from experiments.lq_weights.searches import MEMORY, NEAR, REJECTED

OUT = pathlib.Path("out/experiments/lq_weights/second_order")
WIDTH, FLOOR, FIRST = 1e-4, 1e-3, 15  # of differences in z; least eigenvalue over the greatest; gradients before BFGS
NEARNESS = (1e-3, 1e-4, 1e-6)
NAMED = ("L-BFGS-B", "BFGS", "L-BFGS-B, BFGS", "trust-exact")


class Spent(Exception):
    """The budget is used up."""


class Counted:
    """Objective and derivatives of a problem, counted in gradients; it keeps the best point."""

    def __init__(self, problem: Problem):
        """Compile gradients at one point and at p points together."""

        def evaluate(z: Any) -> Any:
            def objective(z: Any) -> Any:
                evaluation = problem.evaluate(z)
                return evaluation.objective, (evaluation.objective, evaluation.diverged)

            gradient, (value, diverged) = jax.jacfwd(objective, has_aux=True)(z)
            return value, gradient, diverged

        self._gradient, self._gradients, self._steady = jax.jit(evaluate), jax.jit(jax.vmap(evaluate)), problem.steady()
        self.begin(np.inf)

    def begin(self, budget: float) -> None:
        """Start a new count of gradients, with this budget."""
        self.budget, self.spent, self.trace = budget, 0.0, []
        self.best: Any = None
        self._steady_at: Any = None

    def _pay(self, gradients: float) -> None:
        if self.spent >= self.budget:
            raise Spent
        self.spent += gradients

    def slope(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """Return value and gradient."""
        self._pay(1)
        value, gradient, diverged = jax.device_get(self._gradient(jnp.asarray(z)))
        finite = np.isfinite(value) and np.isfinite(gradient).all() and not diverged
        if not finite or not self._stable(z):
            return REJECTED, np.zeros_like(z)
        if not self.trace or value < self.trace[-1][1]:
            self.trace.append((self.spent, float(value)))
            self.best = z.copy()
        return float(value), gradient

    def _stable(self, z: np.ndarray) -> bool:
        if self._steady_at is None or np.max(np.abs(z - self._steady_at)) > NEAR:
            if not self._steady(z[None])[0]:
                return False
            self._steady_at = z.copy()
        return True

    def hessian(self, z: np.ndarray) -> np.ndarray:
        """Return the symmetric part of the forward differences of gradients."""
        self._pay(z.size)
        _, here, _ = self._gradient(jnp.asarray(z))  # known to the search, so that it costs nothing more
        _, ahead, _ = self._gradients(jnp.asarray(z + WIDTH * np.eye(z.size)))
        matrix = np.nan_to_num((np.asarray(ahead) - np.asarray(here)) / WIDTH)
        return (matrix + matrix.T) / 2

    def inverse(self, z: np.ndarray) -> np.ndarray:
        """Return the inverse of the Hessian with eigenvalues made positive."""
        values, vectors = np.linalg.eigh(self.hessian(z))
        matrix = (vectors / np.maximum(np.abs(values), FLOOR * np.abs(values).max())) @ vectors.T
        return (matrix + matrix.T) / 2


def searched(f: Counted, name: str, start: np.ndarray, budget: float) -> dict[str, Any]:
    """Return trace and cost of one search."""
    f.begin(budget)
    first = {"ftol": 1e-15, "gtol": 1e-10, "maxcor": MEMORY, "maxfun": int(budget) if name == NAMED[0] else FIRST}
    try:
        if name.startswith("L-BFGS-B"):
            minimize(f.slope, start, jac=True, method="L-BFGS-B", options=first)
        if name.endswith("BFGS"):
            at = start if f.best is None else f.best
            minimize(f.slope, at, jac=True, method="BFGS", options={"gtol": 1e-10, "hess_inv0": f.inverse(at)})
        if name == "trust-exact":
            options = {"gtol": 1e-10, "initial_trust_radius": 0.5, "max_trust_radius": 2.0}
            minimize(f.slope, start, jac=True, hess=f.hessian, method=name, options=options)
    except Spent:
        pass
    return {"trace": f.trace, "spent": f.spent, "best": f.trace[-1][1]}


def compared(name: str, starts: int, budget: float) -> list[dict[str, Any]]:
    """Return a row for each start and search."""
    problem = problems(Config())[name]()
    measured = {metric: problem.measured[metric] for metric in problem.weights}
    problem = dataclasses.replace(problem, measured=measured, engine="kernel")
    f, origin = Counted(problem), np.asarray(problem.space.place(problem.subject))
    drawn = origin + 0.5 * np.random.default_rng(3).normal(size=(starts - 1, origin.size))
    rows = []
    for number, start in enumerate([origin, *drawn]):
        results = {search: searched(f, search, start, budget) for search in NAMED}
        best = min(result["best"] for result in results.values())
        for who, result in results.items():
            reached = {
                f"{near:g}": next((n for n, value in result["trace"] if value <= best + near * abs(best)), None)
                for near in NEARNESS
            }
            rows.append({"problem": name, "start": number, "search": who, **result, "reached": reached})
    return rows


def prices(name: str, repeats: int = 5) -> dict[str, float]:
    """Return processor times of derivatives over that of a value by XLA, and how far the Hessians are apart."""
    problem = problems(Config())[name]()
    measured = {metric: problem.measured[metric] for metric in problem.weights}
    numbers = {}
    z = jnp.asarray(problem.space.place(problem.subject))
    for engine in ("kernel", "xla"):
        posed = dataclasses.replace(problem, measured=measured, engine=engine)
        value = lambda z, posed=posed: posed.evaluate(z).objective  # noqa: E731
        calls = {"value": jax.jit(value), "gradient": jax.jit(jax.jacfwd(value))}
        if engine == "xla":
            calls["Hessian"] = jax.jit(jax.jacfwd(jax.jacfwd(value)))
        results = {key: jax.block_until_ready(call(z)) for key, call in calls.items()}
        times: dict[str, list[float]] = {key: [] for key in calls}
        for _ in range(repeats):
            for key, call in calls.items():
                begun = time.process_time()
                jax.block_until_ready(call(z))
                times[key].append(time.process_time() - begun)
        for key, taken in times.items():
            ratios = [a / b for a, b in zip(taken, times["value"], strict=True)]
            numbers[f"{engine}: {key} over value"] = statistics.median(ratios)
        if engine == "xla":
            differences = Counted(dataclasses.replace(problem, measured=measured, engine="kernel")).hessian(np.array(z))
            exact = np.asarray(results["Hessian"])
            numbers["differences from exact"] = float(np.abs(differences - exact).max() / np.abs(exact).max())
    return numbers


def main(words: list[str]) -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", metavar="PROBLEM", help=f"of {', '.join(NAMES)}")
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument("--budget", type=float, default=150.0, help="gradients of one search")
    parser.add_argument("--exact", action="store_true", help="the price of exact Hessians in place of searches")
    options = parser.parse_args(words)
    names = options.problems or ["eight"]
    if options.exact:
        for name in names:
            Console().print(name, prices(name))
        return
    rows = [row for name in names for row in compared(name, options.starts, options.budget)]
    table = Table("problem", "start", "search", "best", *(f"{near:g}" for near in NEARNESS), "spent")
    for row in rows:
        reached = ["-" if n is None else f"{n:g}" for n in row["reached"].values()]
        table.add_row(
            row["problem"], str(row["start"]), row["search"], f"{row['best']:.7g}", *reached, f"{row['spent']:g}"
        )
    Console().print(table)
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "searches.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
