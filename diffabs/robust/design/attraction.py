"""Regions of attraction: the starts from which a closed loop returns to rest, found by one run for each start.

    recovered   the run entered an ellipsoid about rest from which the nonlinear loop, with its limits, provably
                returns (`design.capture`); the run ends there
    fell        the run reached its stop
    diverged    the run has invalid numbers, or starts beyond its stop
    unstable    the linear loop about rest grows; almost no start comes to rest, so the run ends at its start
    undecided   none of these within the solver's duration; choose the duration so that no run is undecided

The starts of a map are the centres of equal cells, so a share of them is a share of the box by area. A share is a count
and has no derivative. `objectives.SoftLoss` is its differentiable surrogate: the mean of a sigmoid of log |x(T)| over
the same starts. Its time T is so early that a run that will fall has not yet landed.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.protocols import Sample
from diffabs.core.types import AnyArray, Array, Bool, Params, PyTree, Scalar
from diffabs.engine.solvers import Solver
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.loop.ensemble import run_batch
from diffabs.parts.controllers.balance import state_of
from diffabs.robust.design.capture import capture_ellipsoids

# Search for the largest multiple: relative width of the last interval; runs of one batch.
MULTIPLE_TOLERANCE, SEARCH_POINTS = 1e-4, 33
INITIAL_PREFIX = "initial."  # paths of the start, on which the system and its ellipsoid do not depend
CAPTURE_LEVEL = 0.98  # value of x'Sx at which a run ends: rounding cannot take it out of the ellipsoid again


class Outcomes(NamedTuple):
    """The outcome of each run, as one array of booleans for each kind of outcome, and the time of its end.

    The kinds are those of the module `design.attraction`. All arrays have the shape (runs,), or (n, m) in a `Basin`.

    Attributes:
        recovered: Whether the run came to rest, by its ellipsoid or by the band.
        fell: Whether the run reached its stop.
        unstable: Whether the linear loop about rest grows.
        diverged: Whether the run has invalid numbers, or starts beyond its stop.
        time: Time [s] at which the run ended.
    """

    recovered: np.ndarray
    fell: np.ndarray
    unstable: np.ndarray
    diverged: np.ndarray
    time: np.ndarray

    @property
    def undecided(self) -> np.ndarray:
        """Whether the run has none of the four outcomes at the end of its time, in the shape of the outcomes."""
        return ~(self.recovered | self.fell | self.unstable | self.diverged)


class Cells(NamedTuple):
    """An axis divided into `number` equal cells from `low` to `high`."""

    low: float
    high: float
    number: int

    @property
    def centres(self) -> np.ndarray:
        """Centres of the cells, shape (number,)."""
        return self.low + (self.high - self.low) * (np.arange(self.number) + 0.5) / self.number


class Basin(NamedTuple):
    """Cells of two axes, n and m of them, and the outcome of the run from each centre, shape (n, m)."""

    first: Cells
    second: Cells
    outcomes: Outcomes

    @property
    def share(self) -> float:
        """Recovered share [1] of the box by area."""
        return float(np.mean(self.outcomes.recovered))

    @property
    def undecided(self) -> float:
        """Share [1] of the box by area whose runs have no outcome."""
        return float(np.mean(self.outcomes.undecided))


class Reach(NamedTuple):
    """The largest multiple up to which every tried start recovers.

    Attributes:
        multiple: This multiple; 0 if the smallest tried start does not recover.
        undecided: Whether the run at the next larger tried multiple is undecided. A longer duration may then give more.
    """

    multiple: float
    undecided: bool


class _Ellipsoids(NamedTuple):
    """Ellipsoids |R x| <= 1 with R (systems, 6, 6), and whether a system is unstable (systems,).

    Run i belongs to the system `system[i]`.
    """

    roots: AnyArray
    hopeless: AnyArray
    system: AnyArray

    def data_of(self, number: Scalar) -> tuple[Array, Array]:
        """Return R and the instability flag of run `number`."""
        # An empty slot of a packed batch has a number beyond the last run.
        system = self.system[jnp.minimum(number, len(self.system) - 1)]
        return self.roots[system], self.hopeless[system]

    def has_reached(self, data: PyTree, sample: Sample) -> Bool:
        """Return whether a run is inside its ellipsoid, with a margin, or unstable."""
        root, hopeless = data
        return (jnp.sum((root @ state_of(sample.output)) ** 2) <= CAPTURE_LEVEL) | hopeless

    def contain(self, x: np.ndarray) -> np.ndarray:
        """Return whether each state (runs, 6) is inside its ellipsoid; False for NaN."""
        return np.sum(np.einsum("nij,nj->ni", self.roots[self.system], x) ** 2, axis=1) <= 1


def classify_starts(
    loop: Loop,
    starts: Params,
    solver: Solver,
    *,
    band: float | None = None,
    key: object = None,
    engine: str = "auto",
) -> Outcomes:
    """Return the outcome of each run within the solver's duration, shape (runs,).

    Args:
        starts: Values by path in which the runs differ, each of shape (runs,). Paths outside `initial` are allowed.
        band: None for a proof by the capture ellipsoid. With a number a run is recovered if |x| <= band at its end,
            the norm of three angles [rad] and three rates [rad/s]. It proves nothing about the time after the run,
            and serves loops without an ellipsoid (noise, observers, sampled control). `unstable` is then False.
        key: Random key of a noisy loop; run i draws from fold_in(key, i).
    """
    starts, count = _read_columns("starts", starts)
    return _classify_starts(loop, starts, solver, *_find_ellipsoids(loop, starts, count, band), key, engine)


def _read_columns(name: str, columns: Params) -> tuple[dict[str, np.ndarray], int]:
    """Return columns as arrays, and their common length; raise ValueError without one of at least 1."""
    arrays = {path: np.asarray(column) for path, column in columns.items()}
    lengths = {column.shape[:1] for column in arrays.values()}
    if len(lengths) != 1 or lengths & {(), (0,)}:
        shapes = ", ".join(f"{path} {column.shape}" for path, column in arrays.items())
        raise ValueError(f"{name} = {{{shapes}}}: it needs columns of one length, at least 1")
    return arrays, lengths.pop()[0]


def _check_direction(direction: Mapping[str, float]) -> None:
    """Raise ValueError unless a direction has finite values of the initial state, not all zero."""
    if foreign := [path for path in direction if not path.startswith(INITIAL_PREFIX)]:
        raise ValueError(f"{', '.join(foreign)}: a direction is one of the initial state")
    values = np.array(list(direction.values()), float)
    if not (np.isfinite(values).all() and values.any()):
        raise ValueError(f"direction = {dict(direction)}: it needs finite values of the initial state, not all zero")


def _classify_starts(
    loop: Loop,
    starts: dict[str, np.ndarray],
    solver: Solver,
    inside: _Ellipsoids,
    enough: _Ellipsoids | None,
    key: PyTree,
    engine: str,
) -> Outcomes:
    count = len(inside.system)
    # fold_in by the run's number, so that the draws do not depend on the split over cores.
    keys = None if key is None else jax.vmap(lambda i: jax.random.fold_in(key, i))(np.arange(count))
    run = jax.device_get(run_batch(loop, Batch(starts, keys), solver, enough=enough, engine=engine))
    x = np.stack(list(state_of(run.ending.sample.output)), axis=-1)
    return Outcomes(
        recovered=inside.contain(x) & ~run.stopped & ~run.diverged,
        fell=run.stopped,
        unstable=inside.hopeless[inside.system] & ~run.stopped & ~run.diverged,
        diverged=run.diverged,
        time=run.ending.sample.t,
    )


def region_of_attraction(
    loop: Loop,
    first: Cells,
    second: Cells,
    solver: Solver,
    *,
    paths: tuple[str, str] = ("initial.theta", "initial.phi"),
    band: float | None = None,
    key: object = None,
    engine: str = "auto",
) -> Basin:
    """Return the region of attraction of a balance over the cells of two axes, the first axis in rows: shape (n, m).

    Args:
        first: Cells of the first axis, in the unit of its path (rad for the default).
        band: Bound on |x| at the end, as for `classify_starts`.
    """
    grid = np.meshgrid(first.centres, second.centres, indexing="ij")
    starts = {path: axis.ravel() for path, axis in zip(paths, grid, strict=True)}
    outcomes = classify_starts(loop, starts, solver, band=band, key=key, engine=engine)
    return Basin(first, second, Outcomes(*(column.reshape(grid[0].shape) for column in outcomes)))


def largest_recovered_multiples(
    loop: Loop,
    rows: Params,
    direction: Mapping[str, float],
    multiples: np.ndarray,
    solver: Solver,
    *,
    engine: str = "auto",
) -> list[Reach]:
    """Return for each row the largest of `multiples` up to which the loop recovers from all of them, 0 for none.

    Args:
        rows: Values by path, each of shape (rows, ...): one loop for each row.
        direction: Values of the initial state by path; a run starts from a multiple of them, not from the loop's start.
        multiples: Increasing multiples to try, shape (k,).
    """
    _check_direction(direction)
    multiples = np.array(multiples, float)
    if not (multiples.ndim == 1 and multiples.size and (np.diff(multiples, prepend=0.0) > 0).all()):
        raise ValueError(f"multiples = {multiples.tolist()}: they need to increase, the first above 0")
    rows, count = _read_columns("rows", rows)
    runs = {path: np.repeat(column, len(multiples), axis=0) for path, column in rows.items()}
    runs |= {path: np.tile(value * multiples, count) for path, value in direction.items()}
    outcomes = classify_starts(loop, runs, solver, engine=engine)
    recovered, open_ = (x.reshape(count, -1) for x in (outcomes.recovered, outcomes.undecided))
    # argmin of booleans is the index of the first failure.
    good = np.where(recovered.all(axis=1), len(multiples), np.argmin(recovered, axis=1))
    reached = np.concatenate([[0.0], multiples])
    return [Reach(float(reached[g]), bool(g < len(multiples) and row[g])) for g, row in zip(good, open_, strict=True)]


def recoverable_multiple(
    loop: Loop,
    direction: Mapping[str, float],
    solver: Solver,
    *,
    largest: float = 1.0,
    band: float | None = None,
    key: object = None,
    engine: str = "auto",
) -> Reach:
    """Return the largest c in [0, `largest`] up to which the loop recovers from every tried multiple of `direction`.

    The search tries 33 multiples in a batch, and then refines the interval up to the first failure, to 1e-4 of c.

    Args:
        direction: Values of the initial state by path, such as {"initial.theta": 1.0}; a run starts from c times these.
        band: Bound on |x| at the end, as for `classify_starts`.
    """
    _check_direction(direction)
    if not 0 < largest < np.inf:
        raise ValueError(f"largest = {largest:g} is outside (0, inf)")
    alike = {path: np.full(SEARCH_POINTS, value) for path, value in direction.items()}
    # All starts of the search share one system, so its ellipsoid is computed once.
    inside, enough = _find_ellipsoids(loop, alike, SEARCH_POINTS, band)
    low, high, undecided = 0.0, float(largest), False
    while high - low > MULTIPLE_TOLERANCE * high:
        tried = np.linspace(low, high, SEARCH_POINTS + 1)[1:]
        starts = {path: value * tried for path, value in direction.items()}
        outcomes = _classify_starts(loop, starts, solver, inside, enough, key, engine)
        good = SEARCH_POINTS if outcomes.recovered.all() else int(np.argmin(outcomes.recovered))
        if good == SEARCH_POINTS:
            return Reach(high, undecided)
        low, high, undecided = (tried[good - 1] if good else low), float(tried[good]), bool(outcomes.undecided[good])
        if high < 1e-9 * largest:
            return Reach(0.0, undecided)
    return Reach(float(low), undecided)


def _find_ellipsoids(
    loop: Loop, starts: Mapping[str, np.ndarray], count: int, band: float | None
) -> tuple[_Ellipsoids, _Ellipsoids | None]:
    """Return the ellipsoids for the verdict, and those that end a run early (None: no run ends early).

    With a band the ball |x| <= band is the ellipsoid of all runs, and no run ends early.
    """
    if not hasattr(loop.initial, "theta"):
        raise ValueError(f"plant {type(loop.plant).__name__} is no balance; recovery is defined for a balance only")
    if band is not None:
        if not 0 < band < np.inf:
            raise ValueError(f"band = {band:g} is outside (0, inf)")
        return _Ellipsoids(np.eye(6)[None] / band, np.zeros(1, bool), np.zeros(count, int)), None
    columns = [column.reshape(count, -1) for path, column in starts.items() if not path.startswith(INITIAL_PREFIX)]
    first, system = np.zeros(1, int), np.zeros(count, int)
    if columns:
        # One ellipsoid for each distinct row of values: `first` is a representative, `system` maps runs to rows.
        _, first, system = np.unique(np.concatenate(columns, axis=1), axis=0, return_index=True, return_inverse=True)
    shapes, unstable = capture_ellipsoids(loop, {path: column[first] for path, column in starts.items()})
    finite = np.isfinite(shapes[:, 0, 0])
    roots = np.full_like(shapes, np.inf)
    # S = R'R. An unknown ellipsoid keeps R = inf, so that |R x| <= 1 is false everywhere.
    roots[finite] = np.swapaxes(np.linalg.cholesky(shapes[finite]), 1, 2)
    ellipsoids = _Ellipsoids(roots, unstable, system.reshape(-1))
    return ellipsoids, ellipsoids
