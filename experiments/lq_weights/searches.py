"""Searches with and without derivatives on one problem, counted in rollouts of its batch.

    tune                    `diffabs.tune`, L-BFGS with a line search for kinks
    L-BFGS-B                SciPy's, on derivatives
    L-BFGS-B, differences   the same on forward differences: 1 + p rollouts for p parameters
    Nelder-Mead             SciPy's, with coefficients adapted to the dimension from three parameters on
    CMA-ES                  the reference implementation (cma), its own population size, several first steps

The price of a gradient is a median of ratios of processor times, gradient over value, measured alternately. It is that
of the cheaper mode, forward or reverse. Both measure the objective only. All searches have the same start. A point
counts if its run does not diverge and its integration step is stable. This check takes longer than a short run. So in
searches without derivatives it waits for a new least value at a distance of NEAR from the last check.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import cma
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from diffabs.tune.method import DerivativeMode
from diffabs.tune.problem import Multipliers, Problem

FORWARD = 6  # parameters beyond which forward mode is not timed: benchmarks/bench_gradient.py found it slower there
REJECTED = 1e6  # the value of a run that failed, as the libraries want it
NEAR = 0.05  # greatest component of a move in z after which the step is as stable as before
MEMORY = 100  # steps that L-BFGS-B remembers, as many as `tune` does here
DIFFERENCE = 1e-7  # in z: forward differences

Trace = list[tuple[float, float]]  # (rollouts so far, least value)


def prices(problem: Problem, repeats: int) -> dict[DerivativeMode, float]:
    """Median of ratios of times, gradient over value, by mode."""
    z = jnp.asarray(problem.space.place(problem.subject))[None]
    m = Multipliers(jnp.zeros((1, 0)), jnp.ones(1))
    modes = [mode for mode in DerivativeMode if mode is DerivativeMode.REVERSE or problem.space.size <= FORWARD]
    gradients = {mode: dataclasses.replace(problem, mode=mode).evaluator(1.0) for mode in modes}
    value = problem.objective_evaluator()
    jax.block_until_ready([value(z), *(gradient(z, m) for gradient in gradients.values())])
    ratios: dict[DerivativeMode, list[float]] = {mode: [] for mode in modes}
    for _ in range(repeats):
        for mode, gradient in gradients.items():
            seconds, other = _time(value, z), _time(gradient, z, m)
            ratios[mode].append(other / seconds)
    return {mode: statistics.median(ratio) for mode, ratio in ratios.items()}


def _time(call: Any, *arguments: Any) -> float:
    begun = time.process_time()
    jax.block_until_ready(call(*arguments))
    return time.process_time() - begun


class Counted:
    """The objective as a plain function of z, which keeps the least value so far."""

    def __init__(self, problem: Problem):
        """Compiled once for each number of points that are asked for together."""
        self._evaluate, self._steady = problem.objective_evaluator(), problem.steady()
        self._steady_at: np.ndarray | None = None
        self.count, self.best = 0, np.inf
        self.trace: Trace = []

    def __call__(self, z: Any) -> float:
        """At one point."""
        return self.each(np.asarray(z, float)[None])[0]

    def each(self, points: np.ndarray) -> list[float]:
        """Return the values at several points, which run together and count one after the other."""
        evaluation = jax.device_get(self._evaluate(jnp.asarray(points)))
        return [self._counted(*point) for point in zip(points, evaluation.objective, evaluation.diverged, strict=True)]

    def slope(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """The value at z, and its forward differences."""
        value, *ahead = self.each(z + DIFFERENCE * np.concatenate([np.zeros((1, z.size)), np.eye(z.size)]))
        return value, (np.array(ahead) - value) / DIFFERENCE

    def _counted(self, z: np.ndarray, value: Any, diverged: Any) -> float:
        self.count += 1
        if not np.isfinite(value) or diverged:
            return REJECTED
        if value < self.best:
            if not self._stable(z):
                return REJECTED
            self.best = float(value)
            self.trace.append((self.count, self.best))
        return float(value)

    def _stable(self, z: np.ndarray) -> bool:
        if self._steady_at is None or np.max(np.abs(z - self._steady_at)) > NEAR:
            if not self._steady(z[None])[0]:
                return False
            self._steady_at = z
        return True


def nelder_mead(problem: Problem, budget: int) -> Trace:
    """To its own end or the budget."""
    f, start = Counted(problem), problem.space.place(problem.subject)
    options = {"maxfev": budget, "maxiter": budget, "xatol": 1e-6, "fatol": 1e-12, "adaptive": len(start) > 2}
    minimize(f, start, method="Nelder-Mead", options=options)
    return [*f.trace, (f.count, f.best)]


def cma_es(problem: Problem, budget: int, seed: int, first: float) -> Trace:
    """To its own end or the budget, a population at a time; `first` is its first step, in units of z."""
    f, start = Counted(problem), problem.space.place(problem.subject)
    options = {"maxfevals": budget, "verbose": -9, "seed": seed, "verb_log": 0, "tolfun": 1e-12}
    search = cma.CMAEvolutionStrategy(start, first, options)
    while not search.stop():
        population = search.ask()
        search.tell(population, f.each(np.array(population)))
    return [*f.trace, (f.count, f.best)]


def differences(problem: Problem, budget: int) -> Trace:
    """SciPy's L-BFGS-B on forward differences, to its own end or the budget of rollouts."""
    f = Counted(problem)
    _scipy_lbfgs(problem, f.slope, budget // (1 + problem.space.size))
    return [*f.trace, (f.count, f.best)]


def gradients(problem: Problem, mode: DerivativeMode, evaluations: int) -> Trace:
    """SciPy's L-BFGS-B on derivatives, to its own end or so many of them; counted in gradients."""
    evaluate, steady = dataclasses.replace(problem, mode=mode).evaluator(1.0), problem.steady()
    none, trace, spent = Multipliers(np.zeros((1, 0)), np.ones(1)), [], 0

    def slope(z: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal spent
        spent += 1
        result = jax.device_get(evaluate(jnp.asarray(z)[None], none))
        value, gradient = float(result.loss[0]), np.asarray(result.gradient[0])
        finite = np.isfinite(value) and np.isfinite(gradient).all() and not result.evaluation.diverged[0]
        if not finite or not steady(z[None])[0]:
            return REJECTED, np.zeros_like(z)
        if not trace or value < trace[-1][1]:
            trace.append((float(spent), value))
        return value, gradient

    _scipy_lbfgs(problem, slope, evaluations)
    return [*trace, (float(spent), trace[-1][1])]


def _scipy_lbfgs(problem: Problem, slope: Callable[[np.ndarray], tuple[float, np.ndarray]], evaluations: int) -> None:
    """Its tolerances are absolute, so it is given the objective in units of that at the start."""
    start = problem.space.place(problem.subject)
    size = abs(slope(start)[0])

    def scaled(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = slope(z)
        return value / size, gradient / size

    options = {"maxfun": evaluations - 1, "maxiter": evaluations, "ftol": 1e-15, "gtol": 1e-10, "maxcor": MEMORY}
    minimize(scaled, start, jac=True, method="L-BFGS-B", options=options)


def needed(trace: Trace, target: float) -> float:
    """Rollouts until the target was reached; infinity if it was not."""
    return next((float(n) for n, value in trace if value <= target), np.inf)
