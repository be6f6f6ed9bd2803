"""The tuning of a rule by gradients: several starts on a few roads, then all roads from the best of them.

CMA-ES from the same start, and central differences, check it.
"""

import dataclasses
import time
from typing import Any

import cma
import jax
import jax.numpy as jnp
import numpy as np

from diffabs import FixedStep, Loop, run_batch
from diffabs.core.bijectors import parameter_space
from diffabs.parts.objectives import LockedTime, StopDistance
from diffabs.tune import Method, Stopping, Tuned, build_problem, tune
from diffabs.tune.problem import Problem
from experiments.best_slip.fixed import EXACT, Fixed, Lanes, lanes
from experiments.best_slip.rules import Ranges, start

MEASURED = {"stop_distance": StopDistance(), "locked_time": LockedTime()}


@dataclasses.dataclass(frozen=True)
class Search:
    """Every number of the search, the same for all rules."""

    roads: int = 256  # on which the best start is tuned
    few: int = 64  # of them, on which all starts are tried
    starts: int = 6
    tried: int = 12  # steps of each
    iterations: int = 20  # steps of the best
    seed: int = 19
    exact_step: float = 2e-3  # s
    noisy_step: float = 1e-3  # s: the period of the noise
    cma_evaluations: int = 320
    spread: float = 0.5  # of CMA-ES at its start, in the coordinates of `tune`
    widths: tuple[float, ...] = (1e-2, 1e-3, 1e-4)  # of differences, in the same coordinates
    agreement: float = 0.01  # of a lane's derivative


@dataclasses.dataclass(frozen=True)
class Found:
    """A tuned rule, with the number of runs whose derivatives it took. Starts that had ended count, too."""

    tuned: Tuned
    tried: Tuned
    seconds: float  # of processor time

    @property
    def loop(self) -> Loop:
        """The loop that was found."""
        return self.tuned.loop


def mean_logarithm(values: Any) -> Any:
    """Return the objective of distances in units of their bounds (n,).

    It is nearly the mean excess. A lane that hardly stops counts as some 500 %, not as 100,000 %.
    """
    return jnp.mean(jnp.log(values))


def task(search: Search, fixed: Fixed, sensors: str, rule: str, ranges: Ranges, roads: Lanes) -> dict[str, Any]:
    """The arguments of `build_problem`, but for the loop."""
    step = search.exact_step if sensors == EXACT else search.noisy_step
    return {
        "free": ranges.of(rule),
        "objective": {"stop_distance": 1.0},
        "over": roads.batch(sensors, weights=1 / roads.bound.distance),
        # A step of 2 ms is long beside the band in which extremum seeking holds its limits. One lane of 256 then counts
        # as a slide, if steps end on kinks. `against_differences` checks the derivatives lane by lane.
        "solver": FixedStep(step=step, duration=fixed.longest, kinks=False),
        "measured": MEASURED,
        "aggregate": mean_logarithm,
        "engine": "kernel",
    }


def tuned(search: Search, fixed: Fixed, sensors: str, rule: str, ranges: Ranges) -> Found:
    """Return the best of several starts, tuned on all roads of the tuning."""
    begun = time.process_time()
    seed = fixed.roads.seed

    def descend(loop: Any, count: int, starts: int, iterations: int) -> Tuned:
        how = Method(starts=starts, seed=search.seed, stopping=Stopping(change=1e-6, iterations=iterations))
        roads = lanes(fixed, count, seed)
        return tune(build_problem(loop, **task(search, fixed, sensors, rule, ranges, roads)), method=how)

    tried = descend(start(ranges, fixed, sensors, rule), search.few, search.starts, search.tried)
    tuning = descend(tried.part, search.roads, 1, search.iterations)
    return Found(tuning, tried, time.process_time() - begun)


def described(search: Found) -> dict[str, Any]:
    """Return the result of a search, and how it ended."""
    tuning = search.tuned
    return {
        "objective": {"before": float(tuning.objective[0]), "after": float(tuning.objective[1])},
        "values": {path: np.asarray(x).tolist() for path, x in tuning.values.items()},
        "reason": tuning.reason.value,
        "gradients": tuning.evaluations,
        "starts": [{"objective": s.objective, "reason": s.reason.value} for s in search.tried.starts],
        "gradients of the starts": sum(s.history[-1].evaluations for s in search.tried.starts),
        "seconds": search.seconds,
    }


def problem(search: Search, fixed: Fixed, sensors: str, rule: str, ranges: Ranges, loop: Loop) -> Problem:
    """The tuning's problem on all of its roads, around a loop."""
    roads = lanes(fixed, search.roads, fixed.roads.seed)
    return build_problem(loop, **task(search, fixed, sensors, rule, ranges, roads))


def by_cma_es(search: Search, fixed: Fixed, sensors: str, rule: str, ranges: Ranges) -> dict[str, Any]:
    """CMA-ES on all roads, from where the gradients started: the least objective, and where."""
    begun = time.process_time()
    origin = start(ranges, fixed, sensors, rule)
    posed_ = problem(search, fixed, sensors, rule, ranges, origin)
    evaluate = posed_.objective_evaluator()
    options = {"maxfevals": search.cma_evaluations, "verbose": -9, "verb_log": 0, "seed": search.seed}
    strategy = cma.CMAEvolutionStrategy(posed_.space.place(origin), search.spread, options)
    while not strategy.stop():
        population = strategy.ask()
        values = np.asarray(evaluate(jnp.asarray(np.array(population))).objective)
        strategy.tell(population, np.nan_to_num(values, nan=1e3, posinf=1e3).tolist())
    best = strategy.result
    values = {path: np.asarray(x).tolist() for path, x in posed_.space.values(best.xbest).items()}
    seconds = time.process_time() - begun
    return {"objective": best.fbest, "values": values, "evaluations": best.evaluations, "seconds": seconds}


def against_differences(
    search: Search, fixed: Fixed, sensors: str, rule: str, ranges: Ranges, loop: Loop
) -> dict[str, Any]:
    """Return on how many lanes central differences agree with the derivative at the end of a search.

    The derivative is that of distance/bound along one random direction in the coordinates of `tune`. The study compares
    lane by lane: a mean of differences says nothing if a lane jumps, as a latch that takes another maximum. A lane
    agrees with a width to `agreement` of the derivative, or to 1e-5.
    """
    roads = lanes(fixed, search.roads, fixed.roads.seed)
    arguments = task(search, fixed, sensors, rule, ranges, roads)
    coordinates, solver = parameter_space(loop, arguments["free"]), dataclasses.replace(arguments["solver"], kinks=True)
    z = np.asarray(coordinates.place(loop))
    way = np.random.default_rng(search.seed).normal(size=len(z))
    way /= np.linalg.norm(way)

    def ratios(z: Any) -> Any:
        run = run_batch(coordinates.at(loop, z), arguments["over"], solver, MEASURED, engine="kernel")
        return run.metrics["stop_distance"] / roads.bound.distance

    along = jax.jit(lambda z: jax.jvp(ratios, (z,), (jnp.asarray(way),)))
    slope = np.asarray(along(z)[1])
    verified, each = np.zeros(len(slope), bool), {}
    for width in search.widths:
        high, low = (np.asarray(along(z + sign * width * way)[0]) for sign in (1, -1))
        agrees = np.abs((high - low) / (2 * width) - slope) <= search.agreement * np.abs(slope) + 1e-5
        each[f"{width:g}"], verified = int(np.sum(agrees)), verified | agrees
    return {"lanes": len(slope), "agree by width": each, "agree with one": int(np.sum(verified))}
