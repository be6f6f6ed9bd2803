"""Regions of attraction: from which starts a closed loop returns, by running every one of them.

    recovered   the run came into an ellipsoid about rest from which the nonlinear loop, with its limits, provably
                returns (`design.capture`); it ends there
    fell        the run reached its stop
    unstable    the linear loop about rest grows: from almost nowhere does it come to rest, so it is not run
    undecided   none of these when its time was over, counted as what it is: `duration` is to be so long that there are
                none

The starts of a map are the centres of equal cells, so that a share of them is a share of the box by area. A share is a
count and has no derivative. `SoftLoss` is its differentiable surrogate: the mean of a sigmoid of log |x(T)| over the
same starts, at a time T so early that a run that will fall has not yet landed.
"""

import concurrent.futures
import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.controllers.balance import state_of
from diffabs.core.loop import Loop
from diffabs.design.capture import capture_ellipsoids
from diffabs.simulate.batch import Batch, run_batch
from diffabs.simulate.solution import Solver

MIN_RUNS_PER_CORE = 256  # lanes that a core is given on its own
MULTIPLE_TOLERANCE, SEARCH_POINTS = (
    1e-4,
    33,
)  # of a search for the greatest multiple: relative width of its last interval; runs at once
INITIAL_PREFIX = "initial."  # paths of what a loop does not depend on
CAPTURE_LEVEL = 0.98  # of x'Sx, where a run is ended: rounding does not take it out again


class Outcomes(NamedTuple):
    """What became of each run (lanes,), and when [s] it was known."""

    recovered: np.ndarray
    fell: np.ndarray
    unstable: np.ndarray
    diverged: np.ndarray
    time: np.ndarray

    @property
    def undecided(self) -> np.ndarray:
        """Nothing is known when the time was over; the run is finite."""
        return ~(self.recovered | self.fell | self.unstable | self.diverged)


class Cells(NamedTuple):
    """An axis in `number` equal cells from `low` to `high`."""

    low: float
    high: float
    number: int

    @property
    def centres(self) -> np.ndarray:
        """(number,)."""
        return self.low + (self.high - self.low) * (np.arange(self.number) + 0.5) / self.number


class Basin(NamedTuple):
    """Cells of two axes, n and m of them, and what became of the run from each centre (n, m)."""

    first: Cells
    second: Cells
    outcomes: Outcomes

    @property
    def share(self) -> float:
        """Of the box by area, what is recovered."""
        return float(np.mean(self.outcomes.recovered))

    @property
    def undecided(self) -> float:
        """Of the box by area, what neither fell nor came to rest in time."""
        return float(np.mean(self.outcomes.undecided))


class Reach(NamedTuple):
    """The greatest multiple that is recovered, and whether the run from the next one that was tried is undecided: then
    more may be recovered."""

    multiple: float
    undecided: bool


class _Ellipsoids(NamedTuple):
    """|R x| <= 1, R (systems, 6, 6), and whether there is nothing to hope for (systems,); lane i is of system[i]."""

    roots: Any
    hopeless: Any
    system: Any

    def own(self, number: Any) -> Any:
        """Root and hopelessness of lane `number`."""
        mine = self.system[jnp.minimum(number, len(self.system) - 1)]
        return self.roots[mine], self.hopeless[mine]

    def reached(self, own: Any, output: Any) -> Any:
        """Whether a lane is inside, with something to spare, or hopeless."""
        root, hopeless = own
        return (jnp.sum((root @ state_of(output)) ** 2) <= CAPTURE_LEVEL) | hopeless

    def of(self, runs: slice) -> "_Ellipsoids":
        """For some lanes only."""
        return self._replace(system=self.system[runs])

    def contain(self, x: np.ndarray) -> np.ndarray:
        """Whether each state (lanes, 6) is inside; NaN is not."""
        return np.sum(np.einsum("nij,nj->ni", self.roots[self.system], x) ** 2, axis=1) <= 1


def classify_starts(
    loop: Loop,
    starts: Mapping[str, Any],
    solver: Solver,
    *,
    band: float | None = None,
    key: Any = None,
    engine: str = "xla",
) -> Outcomes:
    """Of lanes that differ in the values (lanes,) at these paths: what becomes of each within the solver's duration.

    band: |x| at the end of the run below which it counts as recovered, for loops of which no ellipsoid is known (noise,
        observers, samples), where nothing is proved of what comes after
    key: lanes of a noisy loop draw from fold_in(key, lane)
    engine: what makes the runs, as in `run_batch`

    Raises ValueError for a loop of which no ellipsoid is known, without a band.
    """
    starts = {path: np.asarray(column) for path, column in starts.items()}
    count = len(next(iter(starts.values())))
    inside = _system_ellipsoids(loop, starts, count) if band is None else _ball_as_ellipsoid(band, count)
    return _classify_starts(loop, starts, solver, inside, band is None, key, engine)


def _classify_starts(
    loop: Loop,
    starts: dict[str, np.ndarray],
    solver: Solver,
    inside: "_Ellipsoids",
    early: bool,
    key: Any,
    engine: str,
) -> Outcomes:
    """early: a run that comes inside ends there."""
    count = len(inside.system)
    keys = None if key is None else jax.vmap(lambda i: jax.random.fold_in(key, i))(np.arange(count))
    parts = (
        max(1, min(os.cpu_count() or 1, count // MIN_RUNS_PER_CORE)) if engine == "xla" else 1
    )  # a kernel has its threads

    def part(runs: slice) -> Any:
        """Every so many lanes: neighbours take equally long."""
        mine = {path: column[runs] for path, column in starts.items()}
        own = None if keys is None else keys[runs]
        enough = inside.of(runs) if early else None
        return jax.device_get(run_batch(loop, Batch(mine, own), solver, enough=enough, engine=engine))

    found = Outcomes(*np.zeros((4, count), bool), time=np.zeros(count))
    slices = [slice(i, None, parts) for i in range(parts)]
    with concurrent.futures.ThreadPoolExecutor(parts) as pool:
        for runs, run in zip(slices, pool.map(part, slices), strict=True):
            found.fell[runs], found.diverged[runs] = run.stopped, run.diverged
            found.time[runs] = run.ending.sample.t
            x = np.stack(list(state_of(run.ending.sample.output)), axis=-1)
            found.recovered[runs] = inside.of(runs).contain(x) & ~run.stopped & ~run.diverged
    found.unstable[:] = inside.hopeless[inside.system] & ~found.fell & ~found.diverged
    return found


def region_of_attraction(
    loop: Loop,
    first: Cells,
    second: Cells,
    solver: Solver,
    *,
    paths: tuple[str, str] = ("initial.theta", "initial.phi"),
    band: float | None = None,
    key: Any = None,
    engine: str = "xla",
) -> Basin:
    """The region of attraction over the cells of two axes, the first rows; `band`, `key` and `engine` as for
    `outcomes`."""
    grid = np.meshgrid(first.centres, second.centres, indexing="ij")
    starts = {path: axis.ravel() for path, axis in zip(paths, grid, strict=True)}
    found = classify_starts(loop, starts, solver, band=band, key=key, engine=engine)
    return Basin(first, second, Outcomes(*(column.reshape(grid[0].shape) for column in found)))


def largest_recovered_multiples(
    loop: Loop,
    rows: Mapping[str, Any],
    direction: Mapping[str, float],
    multiples: np.ndarray,
    solver: Solver,
    *,
    engine: str = "xla",
) -> list[Reach]:
    """For each of the values (rows,) at these paths the greatest of the rising `multiples` of `direction` (values by
    path of the initial state) up to which all are recovered, 0 if none is. One batch."""
    count = len(next(iter(rows.values())))
    runs = {path: np.repeat(np.asarray(column), len(multiples), axis=0) for path, column in rows.items()}
    runs |= {path: np.tile(value * np.asarray(multiples), count) for path, value in direction.items()}
    found = classify_starts(loop, runs, solver, engine=engine)
    fine, open_ = (x.reshape(count, -1) for x in (found.recovered, found.undecided))
    good = np.where(fine.all(axis=1), len(multiples), np.argmin(fine, axis=1))
    known = np.concatenate([[0.0], multiples])
    return [Reach(float(known[g]), bool(g < len(multiples) and row[g])) for g, row in zip(good, open_, strict=True)]


def recoverable_multiple(
    loop: Loop,
    direction: Mapping[str, float],
    solver: Solver,
    *,
    most: float = 1.0,
    band: float | None = None,
    key: Any = None,
    engine: str = "xla",
) -> Reach:
    """The greatest c in [0, most] such that the loop recovers from c' times `direction` (values by path of the initial
    state) for every c' up to c that is tried; to a relative width of 1e-4. Every refinement is one batch.

    Raises ValueError for other paths, and as `outcomes` does."""
    if others := [path for path in direction if not path.startswith(INITIAL_PREFIX)]:
        raise ValueError(f"{', '.join(others)}: a direction is one of the initial state")
    alike = {path: np.full(SEARCH_POINTS, value) for path, value in direction.items()}
    inside = (
        _system_ellipsoids(loop, alike, SEARCH_POINTS) if band is None else _ball_as_ellipsoid(band, SEARCH_POINTS)
    )  # wherever the runs start
    low, high, undecided = 0.0, float(most), False
    while high - low > MULTIPLE_TOLERANCE * high:
        tried = np.linspace(low, high, SEARCH_POINTS + 1)[1:]
        starts = {path: value * tried for path, value in direction.items()}
        found = _classify_starts(loop, starts, solver, inside, band is None, key, engine)
        good = SEARCH_POINTS if found.recovered.all() else int(np.argmin(found.recovered))
        if good == SEARCH_POINTS:
            return Reach(high, undecided)
        low, high, undecided = (tried[good - 1] if good else low), float(tried[good]), bool(found.undecided[good])
        if high < 1e-9 * most:
            return Reach(0.0, undecided)
    return Reach(float(low), undecided)


def _system_ellipsoids(loop: Loop, starts: Mapping[str, np.ndarray], count: int) -> _Ellipsoids:
    """One for each system among the lanes: where a run starts does not change it."""
    own = [column.reshape(count, -1) for path, column in starts.items() if not path.startswith(INITIAL_PREFIX)]
    first, system = np.zeros(1, int), np.zeros(count, int)
    if own:
        _, first, system = np.unique(np.concatenate(own, axis=1), axis=0, return_index=True, return_inverse=True)
    shapes, unstable = capture_ellipsoids(loop, {path: column[first] for path, column in starts.items()})
    known = np.isfinite(shapes[:, 0, 0])
    roots = np.full_like(shapes, np.inf)
    roots[known] = np.swapaxes(np.linalg.cholesky(shapes[known]), 1, 2)
    return _Ellipsoids(roots, unstable, system.reshape(-1))


def _ball_as_ellipsoid(radius: float, count: int) -> _Ellipsoids:
    """|x| <= radius for all."""
    return _Ellipsoids(np.eye(6)[None] / radius, np.zeros(1, bool), np.zeros(count, int))
