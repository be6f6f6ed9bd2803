"""Four searches for the adversary's worst point at equal cost: gradients, CMA-ES, random points, corners.

The cost is a number of simulated runs. A gradient counts as the runs that take its time (`Attack.priced`). The searches
of all seeds run side by side, as lanes of one batch. `feasible` brings each point into the set.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import cma
import numpy as np

from experiments.adversary.ascent import tries
from experiments.adversary.attack import Attack
from experiments.adversary.bounds import Bounds, corners, drawn, feasible


@dataclasses.dataclass(frozen=True)
class Searching:
    """Every number of the searches. Lengths are in units of the bounds."""

    budget: int = 5000  # runs of one search, 40 for each number of the adversary's
    seeds: tuple[int, ...] = (1, 2, 3, 4, 5)
    screened: int = 64  # random points that gradients and CMA-ES begin with
    starts: int = 4  # at a time, of gradients and of CMA-ES
    first: float = 1.0  # step of an ascent, a root mean square
    tried: tuple[float, ...] = (4.0, 1.0, 0.25, 0.06)  # times the last step
    shares: tuple[float, ...] = (1.0, 0.5, 0.2, 0.05)  # of the way to the farthest point along the gradient
    shorter: float = 0.1  # the next step, where no point was better
    least_step: float = 1e-3  # step with which a start is given up for another
    enough: float = 1e-6  # of overshoot, gained by a gradient, or a start is given up
    spread: float = 1.0  # first deviation of CMA-ES

    def priced(self, attack: Attack) -> float:
        """Return how many runs a gradient costs, each in batches of those sizes in which it is asked for."""
        generation = len(self.seeds) * self.starts * (4 + int(3 * np.log(attack.bounds.size)))  # of CMA-ES, its default
        return attack.priced(len(self.seeds) * self.starts, 1 << (generation - 1).bit_length())


@dataclasses.dataclass(eq=False)
class Log:
    """The costs and overshoots of searches, one for each seed."""

    points: np.ndarray  # the worst so far (seeds, size)
    overshoots: np.ndarray  # there (seeds,)
    spent: float = 0.0  # runs, of each search
    history: list[tuple[float, np.ndarray]] = dataclasses.field(default_factory=list)

    def add(self, cost: float, z: np.ndarray, overshoots: np.ndarray) -> None:
        """Count points (seeds, n, size) and their overshoots (seeds, n)."""
        self.spent += cost
        best = overshoots.argmax(axis=1)
        for i, k in enumerate(best):
            if overshoots[i, k] > self.overshoots[i]:
                self.overshoots[i], self.points[i] = overshoots[i, k], z[i, k]
        self.history.append((self.spent, self.overshoots.copy()))

    def at(self, cost: float) -> np.ndarray:
        """Return the greatest overshoots (seeds,) up to this cost; -inf before the first count."""
        return next(
            (overshoots for spent, overshoots in reversed(self.history) if spent <= cost), 0 * self.overshoots - np.inf
        )

    def cost_of(self, overshoot: float) -> np.ndarray:
        """Return the cost at which each search reached this overshoot (seeds,); inf for a search that did not."""
        costs, overshoots = np.array([s for s, _ in self.history]), np.array([o for _, o in self.history])
        reached = overshoots >= overshoot
        return np.where(reached.any(axis=0), costs[reached.argmax(axis=0)], np.inf)


def _log(config: Searching, bounds: Bounds) -> Log:
    seeds = len(config.seeds)
    return Log(np.zeros((seeds, bounds.size)), np.full(seeds, -np.inf))


def _asked(attack: Attack, z: np.ndarray) -> np.ndarray:
    """Overshoots of (seeds, n, size), (seeds, n)."""
    return attack.overshoots(z.reshape(-1, z.shape[-1])).reshape(z.shape[:2])


def _sampled(attack: Attack, config: Searching, points: Callable[[Bounds, int, Any], np.ndarray]) -> Log:
    log = _log(config, attack.bounds)
    z = np.stack([points(attack.bounds, config.budget, np.random.default_rng(seed)) for seed in config.seeds])
    for part in np.array_split(z, max(1, config.budget // 100), axis=1):
        log.add(part.shape[1], part, _asked(attack, part))
    return log


def random_points(attack: Attack, config: Searching, price: float) -> Log:
    """Search at random."""
    del price
    return _sampled(attack, config, drawn)


def at_corners(attack: Attack, config: Searching, price: float) -> Log:
    """Search at corners of the set."""
    del price
    return _sampled(attack, config, corners)


def _screened(attack: Attack, config: Searching, log: Log) -> np.ndarray:
    """Random points of each search, the worst of them first (seeds, n, size)."""
    z = np.stack([drawn(attack.bounds, config.screened, np.random.default_rng([seed, 1])) for seed in config.seeds])
    overshoots = _asked(attack, z)
    log.add(config.screened, z, overshoots)
    return np.take_along_axis(z, np.argsort(-overshoots, axis=1)[:, :, None], axis=1)


def cma_es(attack: Attack, config: Searching, price: float, starts: int | None = None) -> Log:
    """Search by CMA-ES on f(feasible(z)), from the worst of the screened points.

    By default as many points run at a time as for gradients. A search that ends makes room for the next start.
    """
    del price
    log, size, starts = _log(config, attack.bounds), attack.bounds.size, starts or config.starts
    queue = _screened(attack, config, log)
    seeds, waiting, _ = queue.shape
    taken = np.full(seeds, starts)

    def begun(seed: int, start: int) -> Any:
        options = {"verbose": -9, "verb_log": 0, "maxfevals": np.inf, "seed": config.seeds[seed] + 1000 * start}
        return cma.CMAEvolutionStrategy(queue[seed, start % waiting], config.spread, options)

    searches = [[begun(seed, start) for start in range(starts)] for seed in range(seeds)]
    while log.spent < config.budget:
        populations = np.array(
            [[search.ask() for search in row] for row in searches]
        )  # (seeds, starts, population, size)
        z = feasible(attack.bounds, populations.reshape(-1, size)).reshape(seeds, -1, size)
        overshoots = _asked(attack, z)
        log.add(overshoots.shape[1], z, overshoots)
        for (i, j), values in zip(np.ndindex(seeds, starts), overshoots.reshape(seeds * starts, -1), strict=True):
            searches[i][j].tell(list(populations[i, j]), list(-values))
            if searches[i][j].stop():
                searches[i][j] = begun(i, taken[i])
                taken[i] += 1
    return log


def gradients(attack: Attack, config: Searching, price: float) -> Log:
    """Search by gradients from the worst of the screened points, several at a time. A start that gets no further
    makes room for the next."""
    bounds, log = attack.bounds, _log(config, attack.bounds)
    queue = _screened(attack, config, log)
    seeds, waiting, size = queue.shape
    z, taken = queue[:, : config.starts].copy(), np.full(seeds, config.starts)
    value, step = np.full(z.shape[:2], -np.inf), np.full(z.shape[:2], config.first)
    cost = config.starts * (price + len(config.tried) + len(config.shares))
    while log.spent + cost <= config.budget:
        flat = z.reshape(-1, size)
        lengths = step.reshape(-1, 1) * np.array(config.tried)
        points = tries(bounds, flat, attack.gradients(flat), lengths, config.shares).reshape(*z.shape[:2], -1, size)
        overshoots = _asked(attack, points.reshape(seeds, -1, size)).reshape(points.shape[:3])
        log.add(cost, points.reshape(seeds, -1, size), overshoots.reshape(seeds, -1))
        best = overshoots.argmax(axis=2)
        for i, j in np.ndindex(*best.shape):
            k = best[i, j]
            gained = overshoots[i, j, k] - value[i, j]
            if gained > 0:
                z[i, j], value[i, j] = points[i, j, k], overshoots[i, j, k]
                step[i, j] *= config.tried[k] if k < len(config.tried) else 1.0
            else:
                step[i, j] *= config.shorter
            if step[i, j] < config.least_step or gained < config.enough:
                z[i, j], value[i, j], step[i, j] = queue[i, taken[i] % waiting], -np.inf, config.first
                taken[i] += 1
    return log


SEARCHES: dict[str, Callable[..., Log]] = {
    "gradients": gradients,
    "CMA-ES": cma_es,
    "CMA-ES, one start": partial(cma_es, starts=1),
    "random": random_points,
    "corners": at_corners,
}
