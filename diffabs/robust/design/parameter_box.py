"""Polytopes that cover a box of parameters.

The corners of the box give the vertices. If the matrices depend on the parameters as in eq. (16) of Maeda and Sugiura,
through alpha(m)/omega and beta/omega, the hull of the corners contains the whole box. In general it does not. The
module therefore checks the hull on grids and random points, and moves the vertices outwards until all points lie
inside. The systems between the checked points have no proof of coverage.

    gauge(x) = min t with x in c + t (hull - c),  c the vertices' mean:  covered if gauge <= 1
"""

import difflib
import itertools
import numbers
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull

from diffabs.core.jax_flags import default_flags
from diffabs.core.pytree import parameters, replace
from diffabs.core.renamed import refuse_old_names
from diffabs.core.types import AnyArray, Part, PyTree
from diffabs.core.validity import check_part
from diffabs.robust.design.polytopes import MAX_VERTICES, Coverage, Polytope, Schedule

CHUNK = 1024  # systems of one batch
MIN_ENTRY_EXTENT = 1e-10  # relative variation below which an entry counts as constant
MIN_RELATIVE_EXTENT = 1e-9  # relative extent of the data below which a direction is ignored
GAUGE_TOLERANCE = 1e-9  # accuracy of a gauge
RANDOM_POINTS = 2000  # random points of each check, between the points of the grid
MAX_COVER_ROUNDS = 6  # rounds of checking and growing
MAX_CORNER_SPREAD = 2.0  # largest factor by which corners are spread; above it a box replaces them
RANK_TOLERANCE = 1e-6  # corners with a smaller extent in some direction are flat
FACETS = (6, 256)  # facets are computed up to this dimension and number of vertices; above, linear programs
PROBES = 200  # directions whose extreme systems the linear programs check


class _SystemRows(NamedTuple):
    """Systems as rows of the flattened A and B."""

    rows: np.ndarray
    order: int
    inputs: int

    @property
    def matrices(self) -> tuple[np.ndarray, np.ndarray]:
        """A (N, n, n) and B (N, n, m)."""
        n, m = self.order, self.inputs
        a, b = np.split(self.rows, [n * n], axis=1)
        return a.reshape(-1, n, n), b.reshape(-1, n, m)


@default_flags()
@refuse_old_names
def polytope(model: Part, over: Mapping[str, Sequence[float]], *, grid: int = 9, max_points: int = 20_000) -> Polytope:
    """Return the polytope that covers `model` over a box {path: (low, high)}.

    Each check uses a grid and 2000 new random points; from the second check on, the grid is twice as fine. The checks
    end when one finds no system outside, or after six. The final hull covers all checked systems.

    If systems lie outside the corners' hull, the corners are spread about their mean by the smallest factor that covers
    them. `coverage.spread` is that factor with a small margin, 1 if the corners suffice.

    If the factor exceeds 2, a box along the systems' principal directions replaces the corners, if it has few enough
    vertices. The factor is inf if the systems leave the plane of the corners (a curved dependence on one parameter).
    `corners` of such a polytope is empty.

    Vertices inside the hull of the others are dropped. Coverage holds to 1e-9 of the range of an entry. An entry that
    varies by less than 1e-10 of its size counts as constant, and keeps its value at the first corner.

    Args:
        model: Model with `matrices()`, `states` and `period`.
        over: Box {path: (low, high)} of parameters of the model; a parameter with low = high is fixed.
        grid: Points per parameter of the first check.
        max_points: Largest number of grid points in one check; the grid gets coarser to stay below it.

    Raises:
        ValueError: A path that is no parameter of the model; an interval that is inverted, not finite or out of range;
            a period that varies; `max_points` below 1; more than 2^12 vertices; matrices that are not finite.
        ModuleNotFoundError: SciPy is not installed.

    Examples:
        >>> from diffabs.robust.design import polytope
        >>> from diffabs.linear import SlipModel
        >>> box = polytope(SlipModel(), {"plant.mass": (5.3, 6.2), "speed": (1.4, 13.9)})
        >>> box.A.shape, box.B.shape, box.coverage.spread
        ((4, 2, 2), (4, 2, 1), 1.0)
    """
    _require_scipy()
    if max_points < 1:
        raise ValueError(f"max_points = {max_points} is outside [1, inf): a check needs a point of the grid")
    low, high = check_box_bounds(model, over)
    free = tuple(path for path in over if low[path] < high[path])
    if 2 ** len(free) > MAX_VERTICES:
        raise ValueError(
            f"a box of {len(free)} parameters has {2 ** len(free)} corners, more than {MAX_VERTICES}; fix some"
        )
    box = np.array([[low[path], high[path]] for path in free]).reshape(-1, 2)
    data, corners, model = evaluate_grid(model, over, 2)
    rows, spanning, coverage = _cover_box(model, free, box, data, grid, max_points)
    labels = tuple(corners[i] for i in spanning)
    return Polytope(*data._replace(rows=rows).matrices, model.period, tuple(model.states), labels, coverage)


def schedule(
    model: object, over: Mapping[str, Sequence[float]], along: str, nodes: int | Sequence[float], **options: Any
) -> Schedule:
    """Return a chain of polytopes: the box {path: (low, high)}, cut along one of its parameters at `nodes`.

    Args:
        nodes: Increasing nodes from the low to the high end, or the number N of cells, an int >= 1. N cells have N + 1
            nodes in geometric progression, or evenly spaced if the low end is not positive.
        options: Options of `polytope`.
    """
    if along not in over:
        raise ValueError(f"along = '{along}' is not a parameter of the box; there is {', '.join(over) or 'nothing'}")
    low, high = (bound[along] for bound in check_box_bounds(model, over))
    if isinstance(nodes, numbers.Integral) and not isinstance(nodes, bool):
        nodes = int(nodes)
        if nodes < 1:
            raise ValueError(f"nodes = {nodes} cells; it needs at least 1")
        at = np.geomspace(low, high, nodes + 1) if low > 0 else np.linspace(low, high, nodes + 1)
    else:
        at = np.array(nodes, float)
    fits = at.ndim == 1 and len(at) > 1 and bool(np.all(np.diff(at) > 0))
    if not (fits and np.allclose(at[[0, -1]], [low, high], rtol=1e-12, atol=0)):
        raise ValueError(
            f"nodes = {at.tolist() if at.ndim else nodes} do not increase from {low:g} to {high:g}, the ends of {along}"
        )
    cells = [polytope(model, {**over, along: (a, b)}, **options) for a, b in itertools.pairwise(at.tolist())]
    return Schedule(along, at, tuple(cells))


def _require_scipy() -> None:
    try:
        import scipy.optimize  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ModuleNotFoundError:
        raise ModuleNotFoundError('a polytope needs SciPy: pip install ".[design]" in a clone') from None


def check_box_bounds(model: Part, over: Mapping[str, Sequence[float]]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the low and the high end of every interval by path, after a check of each."""
    values = {path: value for path, _, value in parameters(model)}
    for path, ends in over.items():
        if path not in values:
            near = difflib.get_close_matches(path, values, 3, 0.4) or values
            raise ValueError(f"over: the model has no parameter '{path}'; there is {', '.join(near)}")
        if np.ndim(values[path]):
            raise ValueError(f"over: {path} is an array of shape {np.shape(values[path])}, not a number")
        if np.shape(ends) != (2,):
            raise ValueError(f"over: {path} = {ends} is not an interval (low, high)")
        if ends[0] > ends[1]:
            raise ValueError(f"over: {path} = ({ends[0]:g}, {ends[1]:g}) is inverted")
    low, high = ({path: float(ends[i]) for path, ends in over.items()} for i in (0, 1))
    ends = [check_part(replace(model, bound), "over: ") for bound in (low, high)]
    if ends[0].period != ends[1].period:
        raise ValueError("over: the sampling period cannot vary within a polytope")
    return low, high


@partial(jax.jit, static_argnums=1)
def _batch(model: Part, free: tuple[str, ...], points: PyTree) -> AnyArray:
    return jax.vmap(lambda p: replace(model, dict(zip(free, p, strict=True))).matrices())(points)


def evaluate_systems(model: object, free: tuple[str, ...], points: np.ndarray) -> _SystemRows:
    """Return the systems at points (N, k) of the free parameters, in float64; A and B are its property `matrices`."""
    parts, n, m = [], 0, 0
    # Rounding of float32 would exceed the tolerance of the gauge.
    with jax.enable_x64(True):
        for chunk in np.split(points, range(CHUNK, len(points), CHUNK)):
            filled = np.concatenate([chunk, np.repeat(chunk[:1], CHUNK - len(chunk), 0)])  # one shape, one compilation
            a, b = (np.asarray(x, float)[: len(chunk)] for x in _batch(model, free, filled))
            n, m = b.shape[1:]
            parts.append(np.concatenate([a.reshape(len(a), -1), b.reshape(len(b), -1)], axis=1))
    rows = np.concatenate(parts)
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        where = ", ".join(f"{path} = {value:g}" for path, value in zip(free, points[bad][0], strict=True))
        raise ValueError(f"the model's matrices are not finite at {where or 'its parameters'}")
    return _SystemRows(rows, n, m)


def evaluate_grid(
    model: object, over: Mapping[str, Sequence[float]], points: int
) -> tuple[_SystemRows, tuple[dict[str, float], ...], Part]:
    """Return the systems on a grid over a box, ends included, their parameters by path, and the model at the low ends.

    The model has the fixed parameters of all systems, and their period. The last parameter of the box runs first.
    """
    low, high = check_box_bounds(model, over)
    free = tuple(path for path in over if low[path] < high[path])
    axes = itertools.product(*(np.linspace(low[path], high[path], points) for path in free))
    grid = np.array(list(axes)).reshape(points ** len(free), len(free))
    labels = tuple({**low, **dict(zip(free, row, strict=True))} for row in grid.tolist())
    model = replace(model, low)
    return evaluate_systems(model, free, grid), labels, model


def _points(box: np.ndarray, grid: int, limit: int, seed: int) -> np.ndarray:
    """Return a grid over the box and random points in it, shape (points, k)."""
    k = len(box)
    count = max(2, min(grid, int(limit ** (1 / k) + 1e-9)))
    axes = [np.linspace(low, high, count) for low, high in box]
    on_grid = itertools.islice(itertools.product(*axes), limit)
    random = np.random.default_rng(seed).uniform(box[:, 0], box[:, 1], (RANDOM_POINTS, k))
    return np.concatenate([np.array(list(on_grid)), random])


def _cover_box(
    model: object, free: tuple[str, ...], box: np.ndarray, corners: _SystemRows, grid: int, limit: int
) -> tuple[np.ndarray, Sequence[int], Coverage]:
    """Return the vertices as rows, their corner numbers, and the coverage."""
    if not free:
        return corners.rows, [0], Coverage(1, 0.0, 1.0)
    points, hull = corners.rows, None
    for i in range(MAX_COVER_ROUNDS):
        # The seed differs in each round, so that the random points of the last round are new to the hull.
        new = evaluate_systems(model, free, _points(box, (grid - 1) * 2 ** min(i, 1) + 1, limit, i)).rows
        points, reach = np.concatenate([points, new]), hull.reach(new)[0] if hull else 1.0
        if hull and reach <= 1 + GAUGE_TOLERANCE:
            break
        # The excess that this check finds beyond the last hull is added once more, as a margin for the systems between
        # its points.
        hull = _Hull.around(corners.rows, points, reach if np.isfinite(reach) else 1.0)
    assert hull is not None
    furthest, checked = hull.reach(points)
    spanning = [] if hull.box else _extreme_points(hull.vertices)
    rows = hull.rows if hull.box else hull.rows[spanning]
    return rows, spanning, Coverage(checked, float(furthest), float(hull.spread))


class _PlaneCoordinates(NamedTuple):
    """The plane that contains the rows, and coordinates in it, each over an interval of length 2."""

    origin: np.ndarray
    scale: np.ndarray
    basis: np.ndarray
    half: np.ndarray

    @classmethod
    def of(cls, rows: np.ndarray) -> "_PlaneCoordinates":
        size, extent = np.abs(rows).max(axis=0), np.ptp(rows, axis=0)
        # A constant entry varies only by rounding. It must not become a direction of the plane.
        varies = extent > MIN_ENTRY_EXTENT * size
        scale = np.where(varies, extent, np.where(size > 0, size, 1.0))
        z = (rows - rows[0]) / scale
        # `* varies` removes the constant entries from the basis.
        basis = np.linalg.svd(z - z.mean(axis=0), full_matrices=False)[2] * varies
        half = np.ptp(z @ basis.T, axis=0) / 2
        return cls(rows[0], scale, basis[half > MIN_RELATIVE_EXTENT], half[half > MIN_RELATIVE_EXTENT])

    def to_plane(self, rows: np.ndarray) -> np.ndarray:
        return (rows - self.origin) / self.scale @ self.basis.T / self.half

    def from_plane(self, y: np.ndarray) -> np.ndarray:
        return self.origin + self.scale * (y * self.half @ self.basis)

    def holds(self, rows: np.ndarray) -> bool:
        return bool(np.all(np.abs(self.from_plane(self.to_plane(rows)) - rows) <= 2 * MIN_RELATIVE_EXTENT * self.scale))


class _Hull(NamedTuple):
    """Vertices as rows and in plane coordinates, the spread that the corners need, and whether the hull is a box."""

    frame: _PlaneCoordinates
    rows: np.ndarray
    vertices: np.ndarray
    spread: float
    box: bool

    @classmethod
    def around(cls, corners: np.ndarray, points: np.ndarray, margin: float) -> "_Hull":
        """Return the corners, spread by up to MAX_CORNER_SPREAD to cover all rows, or else a box."""
        frame = _PlaneCoordinates.of(points)
        v, x = frame.to_plane(corners), frame.to_plane(points)
        needed = _largest_gauge(v, x)[0]
        spread = 1.0 if needed <= 1 + GAUGE_TOLERANCE else needed * margin * (1 + GAUGE_TOLERANCE)
        count = 2 ** len(frame.half)
        # A box in many directions has too many vertices: then widely spread corners are the only hull.
        if spread <= MAX_CORNER_SPREAD or (np.isfinite(spread) and count > MAX_VERTICES):
            rows, v = (a.mean(axis=0) + spread * (a - a.mean(axis=0)) if spread > 1 else a for a in (corners, v))
            return cls(frame, rows, v, spread, False)
        if count > MAX_VERTICES:
            raise ValueError(
                f"the box needs {count} vertices, more than {MAX_VERTICES}: vary fewer parameters, or by less"
            )
        half, middle = np.ptp(x, axis=0) / 2 * margin * (1 + GAUGE_TOLERANCE), (x.max(axis=0) + x.min(axis=0)) / 2
        v = middle + half * np.array(list(itertools.product((-1.0, 1.0), repeat=len(half))))
        return cls(frame, frame.from_plane(v), v, spread, True)

    def reach(self, rows: np.ndarray) -> tuple[float, int]:
        """Return the largest gauge of the rows, and the number of checked rows."""
        if not self.frame.holds(rows):
            return np.inf, len(rows)
        x = self.frame.to_plane(rows)
        if self.box:
            middle = self.vertices.mean(axis=0)
            return float(np.max(np.abs(x - middle) / (self.vertices.max(axis=0) - middle))), len(x)
        return _largest_gauge(self.vertices, x)


def _largest_gauge(v: np.ndarray, x: np.ndarray) -> tuple[float, int]:
    """Return the largest gauge of points x (N, d) in the hull of v (V, d), and the number of checked points.

    For large hulls it checks only the points that reach furthest in one of many directions. The gauge is infinite if v
    is flat.
    """
    centre = v.mean(axis=0)
    v, x, d = v - centre, x - centre, v.shape[1]
    if not d:
        return 0.0, len(x)
    if np.linalg.matrix_rank(v, tol=RANK_TOLERANCE) < d:
        return np.inf, len(x)
    if d == 1:
        return float(max(x.max() / v.max(), x.min() / v.min())), len(x)
    if (hull := _facets(v)) is not None:
        facets = hull.equations
        slopes = facets[:, :-1] / -facets[:, -1:]
        return max(float((part @ slopes.T).max()) for part in np.split(x, range(CHUNK, len(x), CHUNK))), len(x)
    from scipy.optimize import linprog

    directions = np.concatenate([np.eye(d), -np.eye(d), np.random.default_rng(0).normal(size=(PROBES, d))])
    far = np.unique(np.argmax(x @ directions.T, axis=0))
    return max(linprog(np.ones(len(v)), A_eq=v.T, b_eq=x[i]).fun for i in far), len(far)


def _extreme_points(v: np.ndarray) -> list[int]:
    """Return the indices of the points that span the hull of v."""
    if not v.shape[1]:
        return [0]
    if v.shape[1] == 1:
        return sorted({int(v.argmin()), int(v.argmax())})
    if (hull := _facets(v)) is not None:
        return sorted(hull.vertices.tolist())
    return sorted(np.unique(v.round(12), axis=0, return_index=True)[1].tolist())


def _facets(v: np.ndarray) -> "ConvexHull | None":
    """Return the hull of v (V, d), or None for too many facets or facets that merge by rounding (64 points in 6-d)."""
    from scipy.spatial import ConvexHull, QhullError

    if v.shape[1] > FACETS[0] or len(v) > FACETS[1]:
        return None
    try:
        return ConvexHull(v)
    except QhullError:
        return None
