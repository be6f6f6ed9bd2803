"""Regions of attraction: from which starts a closed loop returns, by running every one of them.

    recovered   the run neither fell nor diverged, and ends with sqrt(x'x) below `tolerance`
    share       of the starts of a grid: the area of the region in the box, relative to the box

The share is a count and has no derivative. `SoftLoss` is its differentiable surrogate: the mean of a sigmoid of
log |x(T)| over the same starts, at a time T so early that a run that will fall has not yet landed.
"""

import concurrent.futures
import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from diffabs.conveyor import measure_lanes
from diffabs.loop import Loop
from diffabs.objectives import Fell, FinalNorm
from diffabs.rollout import FixedStep

TOLERANCE = 1e-2
MEASURED = {"fell": Fell(), "final_norm": FinalNorm()}
FEWEST = 256  # lanes that a core is given on its own
FINEST, POINTS = 1e-4, 33  # of a search for the greatest multiple: relative width of its last interval; runs at once


class Basin(NamedTuple):
    """Starts along two axes (n,) and (m,), whether each recovered (n, m), and how many runs diverged."""

    first: np.ndarray
    second: np.ndarray
    recovered: np.ndarray
    diverged: int

    @property
    def share(self) -> float:
        """Of the starts, how many recovered."""
        return float(np.mean(self.recovered))


def recovered(
    loop: Loop, starts: Mapping[str, Any], solver: FixedStep, *, tolerance: float = TOLERANCE, key: Any = None
) -> tuple[np.ndarray, np.ndarray]:
    """Of lanes that differ in the values (lanes,) at these paths: whether each recovered, and whether it diverged.
    Lanes of a noisy loop draw from fold_in(key, lane)."""
    count = len(next(iter(starts.values())))
    keys = None if key is None else jax.vmap(lambda i: jax.random.fold_in(key, i))(np.arange(count))
    parts = max(1, min(os.cpu_count() or 1, count // FEWEST))

    def part(i: int) -> Any:
        """Every so many lanes: neighbours take equally long."""
        mine = {path: np.asarray(column)[i::parts] for path, column in starts.items()}
        own = None if keys is None else keys[i::parts]
        return jax.device_get(measure_lanes(loop, mine, solver, MEASURED, keys=own))

    with concurrent.futures.ThreadPoolExecutor(parts) as pool:
        runs = list(pool.map(part, range(parts)))
    fine, diverged = np.zeros(count, bool), np.zeros(count, bool)
    for i, run in enumerate(runs):
        # NaN is not below anything
        fine[i::parts] = (run.metrics["fell"] == 0) & (run.metrics["final_norm"] < tolerance)
        diverged[i::parts] = run.diverged
    return fine, diverged


def attraction(
    loop: Loop,
    first: Any,
    second: Any,
    solver: FixedStep,
    *,
    paths: tuple[str, str] = ("initial.theta", "initial.phi"),
    tolerance: float = TOLERANCE,
    key: Any = None,
) -> Basin:
    """The region of attraction on the grid of two axes, the first rows."""
    first, second = np.asarray(first, float), np.asarray(second, float)
    grid = np.meshgrid(first, second, indexing="ij")
    starts = {path: axis.ravel() for path, axis in zip(paths, grid, strict=True)}
    fine, diverged = recovered(loop, starts, solver, tolerance=tolerance, key=key)
    return Basin(first, second, fine.reshape(grid[0].shape), int(diverged.sum()))


def recoverable(
    loop: Loop,
    direction: Mapping[str, float],
    solver: FixedStep,
    *,
    most: float = 1.0,
    tolerance: float = TOLERANCE,
    key: Any = None,
) -> float:
    """The greatest c in [0, most] such that the loop recovers from c' times `direction` (values by path of the initial
    state) for every c' up to c that is tried; to a relative width of 1e-4. Every refinement is one batch."""
    low, high = 0.0, float(most)
    while high - low > FINEST * high:
        tried = np.linspace(low, high, POINTS + 1)[1:]
        starts = {path: value * tried for path, value in direction.items()}
        fine, _ = recovered(loop, starts, solver, tolerance=tolerance, key=key)
        good = POINTS if fine.all() else int(np.argmin(fine))
        if good == POINTS:
            return high
        low, high = (tried[good - 1] if good else low), float(tried[good])
        if high < 1e-9 * most:
            return 0.0
    return float(low)
