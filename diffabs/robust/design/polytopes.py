"""Sets of linear systems for robust design.

    Polytope    x' = A x + B u (or x+ = A x + B u),  (A, B) anywhere, at any time, in the convex hull of the vertices
    Schedule    a chain of polytopes along one measured parameter, such as speed

Source: Maeda and Sugiura, section 3. Their eq. (22) pairs A of one speed with B of another; here a vertex is a pair (A,
B) of the same parameters.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from diffabs.core.kinds import find_value_objection, format_value
from diffabs.core.types import AnyArray

MAX_VERTICES = 2**12  # each vertex adds an LMI


@dataclasses.dataclass(frozen=True)
class Coverage:
    """The check of a hull against systems of the box.

    The gauge of a system is 0 at the mean of the vertices and 1 on the boundary of the hull. Above 1 the system lies
    outside.

    Attributes:
        checked: Number of systems that were checked: corners, grid points and random points. Large hulls check only the
            extreme ones.
        furthest: Largest gauge [1] of these systems.
        spread: Factor [1] by which corners had to be spread about their mean to cover all systems. Above 2 a box
            replaced the corners, unless it had too many vertices.
    """

    checked: int
    furthest: float
    spread: float


@dataclasses.dataclass(frozen=True, eq=False)
class Polytope:
    """The convex hull of vertices A (V, n, n) and B (V, n, m).

    Attributes:
        A: State matrices of the vertices, shape (V, n, n).
        B: Input matrices of the vertices, shape (V, n, m).
        period: Sampling period [s] of a discrete-time system; None for continuous time.
        states: Names of the states, as labels.
        corners: Parameters by path at each vertex, as labels.
        coverage: Check of the hull, if there is one.

    Raises:
        ValueError: Shapes or labels that do not fit, entries that are not finite, a period that is not positive and
            finite, no vertex or more than 2^12.
    """

    A: np.ndarray
    B: np.ndarray
    period: float | None = None
    states: tuple[str, ...] = ()
    corners: tuple[Mapping[str, float], ...] = ()
    coverage: Coverage | None = None

    def __post_init__(self) -> None:
        """Convert the matrices to float64; check their shapes and the period."""
        for name in ("A", "B"):
            object.__setattr__(self, name, np.array(getattr(self, name), float))
        a, b = self.A.shape, self.B.shape
        if len(a) != 3 or len(b) != 3 or a[1] != a[2] or b[:2] != a[:2] or not a[1] or not b[2]:
            raise ValueError(f"a polytope needs A of shape (V, n, n) and B of shape (V, n, m); got {a} and {b}")
        if not 1 <= a[0] <= MAX_VERTICES:
            raise ValueError(f"a polytope of {a[0]} vertices is outside [1, {MAX_VERTICES}]: an LMI for each")
        if not (np.isfinite(self.A).all() and np.isfinite(self.B).all()):
            raise ValueError("a vertex of the polytope has an entry that is not finite")
        labels = len(self.corners), len(self.states)
        if labels[0] not in (0, a[0]) or labels[1] not in (0, a[1]):
            needed = f"0 or {a[0]}, one for each vertex, and 0 or {a[1]}, one for each state"
            raise ValueError(f"numbers of corners and of states' names = {labels}; needed: {needed}")
        if self.period is not None and (objection := find_value_objection(self.period)):
            raise ValueError(f"period = {format_value(self.period)} {objection}")
        if self.period is not None and not 0 < self.period < math.inf:
            raise ValueError(f"period = {self.period:g} is outside (0, inf) s")

    @property
    def vertices(self) -> int:
        """Number of vertices V."""
        return self.A.shape[0]

    @property
    def order(self) -> int:
        """Number of states n."""
        return self.A.shape[1]

    @property
    def inputs(self) -> int:
        """Number of inputs m."""
        return self.B.shape[2]

    def closed_loop(self, gain: Sequence[float] | AnyArray) -> np.ndarray:
        """Return A + B K at each vertex for K = `gain`, shape (V, n, n).

        Raises:
            ValueError: A gain of the wrong shape, or not finite.
        """
        return self.A + self.B @ as_gain_matrix(gain, (self.inputs, self.order))


@dataclasses.dataclass(frozen=True, eq=False)
class Schedule:
    """A chain of N polytopes along one measured parameter.

    Attributes:
        parameter: Path of the parameter.
        nodes: Increasing values of the parameter, shape (N + 1,).
        cells: Polytopes; `cells[i]` holds between `nodes[i]` and `nodes[i + 1]`.

    Raises:
        ValueError: Nodes that are not finite, do not increase or do not fit the cells. Also cells that differ in order,
            inputs or period.
    """

    parameter: str
    nodes: np.ndarray
    cells: tuple[Polytope, ...]

    def __post_init__(self) -> None:
        """Convert the nodes to float64; check that they are finite, increase, and have one cell between two of them."""
        object.__setattr__(self, "nodes", np.array(self.nodes, float))
        rising = np.isfinite(self.nodes).all() and (np.diff(self.nodes) > 0).all()
        if len(self.nodes) != len(self.cells) + 1 or not self.cells or not rising:
            raise ValueError(f"a schedule of {len(self.cells)} cells needs one node more, increasing: {self.nodes}")
        if len({(cell.order, cell.inputs, cell.period) for cell in self.cells}) != 1:
            raise ValueError("the cells of a schedule differ in order, inputs or period")


def as_gain_matrix(gain: Sequence[float] | AnyArray, shape: tuple[int, int]) -> np.ndarray:
    """Return a gain (m, n) or (n,) as a matrix of floats of this shape."""
    if objection := find_value_objection(gain):
        raise ValueError(f"gain = {format_value(gain)} {objection}")
    k = np.atleast_2d(np.array(gain, float))
    if k.shape != shape:
        raise ValueError(f"the gain has shape {k.shape}; inputs and states of the system need {shape}")
    if not np.isfinite(k).all():
        raise ValueError(f"the gain {k.tolist()} has an entry that is not finite")
    return k
