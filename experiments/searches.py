"""A search by gradients and two without them on one problem, counted in rollouts of its batch.

    Nelder-Mead   SciPy's, with coefficients adapted to the dimension where there are more than two parameters
    CMA-ES        the reference implementation (cma), its own population size, first step 0.5 in units of z
    L-BFGS        `diffabs.tune`; a gradient counts at its price, and the one value it asks for at the start as one

The price of a gradient is the median of ratios of times, gradient over value, measured alternately; forward mode or
reverse mode, whichever is cheaper. All three start from the same point. A point counts as found if its run did not
diverge and its integration step is stable; derivative-free searches are asked about the step only where a value would
be their least and z has moved by NEAR since they were asked last, because the answer takes longer than a short run."""

import dataclasses
import statistics
import time
from typing import Any

import cma
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from diffabs.tune.problem import Mode, Multipliers, Problem

FORWARD = 6  # parameters beyond which forward mode is not timed: benchmarks/bench_gradient.py found it slower there
REJECTED = 1e6  # the value of a run that failed, as the libraries want it
NEAR = 0.05  # greatest component of a move in z after which the step is as stable as before
OWN = 1e-6  # of the way from the start to its least value: there a search has reached its own optimum

Trace = list[tuple[float, float]]  # (rollouts so far, least value)


def prices(problem: Problem, repeats: int) -> dict[Mode, float]:
    """Median of ratios of times, gradient over value, by mode."""
    z = jnp.asarray(problem.space.place(problem.subject))[None]
    m = Multipliers(jnp.zeros((1, 0)), jnp.ones(1))
    modes = [mode for mode in Mode if mode is Mode.REVERSE or problem.space.size <= FORWARD]
    gradients = {mode: dataclasses.replace(problem, mode=mode).evaluator(1.0) for mode in modes}
    value = problem.valuer()
    jax.block_until_ready([value(z), *(gradient(z, m) for gradient in gradients.values())])
    ratios: dict[Mode, list[float]] = {mode: [] for mode in modes}
    for _ in range(repeats):
        for mode, gradient in gradients.items():
            own, other = _time(value, z), _time(gradient, z, m)
            ratios[mode].append(other / own)
    return {mode: statistics.median(ratio) for mode, ratio in ratios.items()}


def _time(call: Any, *arguments: Any) -> float:
    begun = time.perf_counter()
    jax.block_until_ready(call(*arguments))
    return time.perf_counter() - begun


class Counted:
    """The objective as a plain function of z, which keeps what it has seen."""

    def __init__(self, problem: Problem):
        """Compiled once."""
        self._seen, self._steady = problem.valuer(), problem.steady()
        self._asked: np.ndarray | None = None
        self.count, self.least = 0, np.inf
        self.trace: Trace = []

    def __call__(self, z: Any) -> float:
        """At one point."""
        z = np.asarray(z, float)
        seen = jax.device_get(self._seen(jnp.asarray(z)[None]))
        value = float(seen.objective[0])
        self.count += 1
        if not np.isfinite(value) or seen.diverged[0]:
            return REJECTED
        if value < self.least:
            if not self._stable(z):
                return REJECTED
            self.least = value
            self.trace.append((self.count, value))
        return value

    def _stable(self, z: np.ndarray) -> bool:
        if self._asked is None or np.max(np.abs(z - self._asked)) > NEAR:
            if not self._steady(z[None])[0]:
                return False
            self._asked = z
        return True


def nelder_mead(problem: Problem, budget: int) -> Trace:
    """To its own end or the budget."""
    f, start = Counted(problem), problem.space.place(problem.subject)
    options = {"maxfev": budget, "maxiter": budget, "xatol": 1e-6, "fatol": 1e-12, "adaptive": len(start) > 2}
    minimize(f, start, method="Nelder-Mead", options=options)
    return [*f.trace, (f.count, f.least)]


def cma_es(problem: Problem, budget: int, seed: int) -> Trace:
    """To its own end or the budget, a population at a time."""
    f, start = Counted(problem), problem.space.place(problem.subject)
    options = {"maxfevals": budget, "verbose": -9, "seed": seed, "verb_log": 0, "tolfun": 1e-12}
    search = cma.CMAEvolutionStrategy(start, 0.5, options)
    while not search.stop():
        asked = search.ask()
        search.tell(asked, [f(z) for z in asked])
    return [*f.trace, (f.count, f.least)]


def needed(trace: Trace, target: float) -> float:
    """Rollouts until the target was reached; infinity if it was not."""
    return next((float(n) for n, value in trace if value <= target), np.inf)


def own(trace: Trace, start: float) -> tuple[float, float]:
    """Where a search ended, to within a millionth of its way, and the rollouts until there."""
    target = trace[-1][1] + OWN * (start - trace[-1][1])
    return target, needed(trace, target)
