"""From a box of parameters to a polytope that covers it.

The corners of the box give the vertices. Where the matrices depend on the parameters as they do in Maeda and Sugiura's
eq. (16), through alpha(m)/omega and beta/omega, the hull of the corners contains the whole box. In general it does
not, so it is checked on grids and random points, and the vertices are moved outwards until all of those lie inside. What
lies between the checked points is not proved to be covered.

    gauge(x) = min t with x in c + t (hull - c),  c the vertices' mean:  covered if gauge <= 1
"""

import difflib
import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from diffabs.design.polytope import LARGEST, Coverage, Polytope, Schedule
from diffabs.pytree import check, parameters, replace

CHUNK = 1024  # systems computed at once
SAME = 1e-12  # an entry that varies by less, relative to itself, is constant
SPAN = 1e-9  # a direction in which the data reach less far than this, relative to the furthest, does not count
SLACK = 1e-9  # gauges are known to about this
RANDOM = 2000  # points checked between those of a grid, each time
ROUNDS = 6  # of checking and growing
FACETS = (6, 512)  # facets are computed up to this dimension and number of vertices; above, linear programs
PROBES = 200  # directions whose extreme systems the linear programs check


class _Data(NamedTuple):
    """Systems as rows A, B flattened."""

    rows: np.ndarray
    order: int
    inputs: int


def polytope(
    model: Any, over: Mapping[str, Sequence[float]], *, grid: int = 9, most: int = 20_000
) -> Polytope:
    """The polytope of `model`, which has `matrices()`, `states` and `period`, over a box {path: (low, high)}.

    `grid` points per parameter are checked, then again with half the spacing, but not more than `most` of them at once,
    and 2000 random points with each grid. If some lie outside of the corners' hull, the corners are spread about their
    mean by the smallest factor that covers them; `coverage.spread` is that factor, 1 where the corners suffice. Where
    the systems leave the plane of the corners (a curved dependence on one parameter), or a box along their principal
    directions is smaller, its 2^d corners are the vertices, `corners` is empty, and `spread` is the factor that would
    have been needed (infinite in the first case). Vertices inside the hull of the others are dropped.

    Raises:
        ValueError: a path that is no parameter of the model, an interval that is inverted, not finite or outside of the
            parameter's range, a period that varies, more than 2^12 vertices, matrices that are not finite.
    """
    _scipy()
    low, high = _bounds(model, over)
    free = tuple(path for path in over if low[path] < high[path])
    if 2 ** len(free) > LARGEST:
        raise ValueError(f"a box of {len(free)} parameters has {2 ** len(free)} corners, more than {LARGEST}; fix some")
    model = replace(model, low)
    box = np.array([[low[path], high[path]] for path in free]).reshape(-1, 2)
    corners = np.array(list(itertools.product(*box))).reshape(-1, len(free))
    data = _systems(model, free, corners)
    rows, kept, coverage = _covered(model, free, box, data, grid, most)
    n, m = data.order, data.inputs
    a, b = np.split(rows, [n * n], axis=1)
    labels = tuple({**low, **dict(zip(free, corners[i].tolist(), strict=True))} for i in kept)
    return Polytope(
        a.reshape(-1, n, n), b.reshape(-1, n, m), model.period, tuple(model.states), labels, coverage
    )


def schedule(
    model: Any, over: Mapping[str, Sequence[float]], along: str, nodes: int | Sequence[float], **options: Any
) -> Schedule:
    """A chain of polytopes: the box, cut along one of its parameters at `nodes`. A number of cells cuts in geometric
    progression (linearly where the interval reaches 0 or below). Options as for `polytope`.

    Raises:
        ValueError: a parameter that is not in the box, nodes that do not increase from its low to its high end.
    """
    if along not in over:
        raise ValueError(f"along = '{along}' is not a parameter of the box; there is {', '.join(over) or 'nothing'}")
    low, high = (bound[along] for bound in _bounds(model, over))
    if isinstance(nodes, int):
        if nodes < 1:
            raise ValueError(f"nodes = {nodes} cells; it needs at least 1")
        at = np.geomspace(low, high, nodes + 1) if low > 0 else np.linspace(low, high, nodes + 1)
    else:
        at = np.array(nodes, float)
    fits = at.ndim == 1 and len(at) > 1 and bool(np.all(np.diff(at) > 0))
    if not (fits and np.allclose(at[[0, -1]], [low, high], rtol=1e-12, atol=0)):
        raise ValueError(f"nodes = {at.tolist()} do not increase from {low:g} to {high:g}, the ends of {along}")
    cells = [polytope(model, {**over, along: (a, b)}, **options) for a, b in itertools.pairwise(at.tolist())]
    return Schedule(along, at, tuple(cells))


def _scipy() -> None:
    try:
        import scipy.optimize  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ModuleNotFoundError:
        raise ModuleNotFoundError('a polytope needs SciPy: pip install "diffabs[design]"') from None


def _bounds(model: Any, over: Mapping[str, Sequence[float]]) -> tuple[dict[str, float], dict[str, float]]:
    """The low and the high end of every interval, checked."""
    known = {path: value for path, _, value in parameters(model)}
    for path, ends in over.items():
        if path not in known:
            near = difflib.get_close_matches(path, known, 3, 0.4) or known
            raise ValueError(f"over: the model has no parameter '{path}'; there is {', '.join(near)}")
        if np.ndim(known[path]):
            raise ValueError(f"over: {path} is an array of shape {np.shape(known[path])}, not a number")
        if np.shape(ends) != (2,):
            raise ValueError(f"over: {path} = {ends} is not an interval (low, high)")
        if ends[0] > ends[1]:
            raise ValueError(f"over: {path} = ({ends[0]:g}, {ends[1]:g}) is inverted")
    low, high = ({path: float(ends[i]) for path, ends in over.items()} for i in (0, 1))
    ends = [check(replace(model, bound), "over: ") for bound in (low, high)]
    if ends[0].period != ends[1].period:
        raise ValueError("over: the sampling period cannot vary within a polytope")
    return low, high


@partial(jax.jit, static_argnums=1)
def _batch(model: Any, free: tuple[str, ...], points: Any) -> Any:
    return jax.vmap(lambda p: replace(model, dict(zip(free, p, strict=True))).matrices())(points)


def _systems(model: Any, free: tuple[str, ...], points: np.ndarray) -> _Data:
    """The matrices at points (N, k) of the box, in float64."""
    parts = []
    with jax.enable_x64(True):
        for chunk in np.split(points, range(CHUNK, len(points), CHUNK)):
            filled = np.concatenate([chunk, np.repeat(chunk[:1], CHUNK - len(chunk), 0)])  # one shape, one compilation
            a, b = (np.asarray(x, float)[: len(chunk)] for x in _batch(model, free, filled))
            parts.append(np.concatenate([a.reshape(len(a), -1), b.reshape(len(b), -1)], axis=1))
    rows = np.concatenate(parts)
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        where = ", ".join(f"{path} = {value:g}" for path, value in zip(free, points[bad][0], strict=True))
        raise ValueError(f"the model's matrices are not finite at {where or 'its parameters'}")
    return _Data(rows, a.shape[1], b.shape[2])


def _points(box: np.ndarray, grid: int, most: int, seed: int) -> np.ndarray:
    """A grid over the box and random points in it."""
    k = len(box)
    count = max(2, min(grid, int(most ** (1 / k) + 1e-9)))
    axes = [np.linspace(low, high, count) for low, high in box]
    on_grid = itertools.islice(itertools.product(*axes), most)
    random = np.random.default_rng(seed).uniform(box[:, 0], box[:, 1], (RANDOM, k))
    return np.concatenate([np.array(list(on_grid)), random])


def _covered(
    model: Any, free: tuple[str, ...], box: np.ndarray, corners: _Data, grid: int, most: int
) -> tuple[np.ndarray, Sequence[int], Coverage]:
    """Vertices as rows, which corners they are, and what was checked."""
    if not free:
        return corners.rows, [0], Coverage(1, 1.0, 1.0)
    seen, spread, margin = corners.rows, 1.0, 1.0
    for i in range(ROUNDS):
        new = _systems(model, free, _points(box, (grid - 1) * 2 ** min(i, 1) + 1, most, i)).rows
        seen = np.concatenate([seen, new])
        hull = _Hull.of(corners.rows, seen, margin)
        if i and hull.size <= spread * (1 + SLACK):
            break
        margin *= hull.size / spread if i else 1.0  # what the last look added may be added again between its points
        spread = hull.size
    return hull.result()
