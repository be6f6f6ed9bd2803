"""Bounds of the peak gain of all systems in the hull of vertices, by linear matrix inequalities.

    s x = A x + B w,  z = C x + D w,    (A, B, C, D) in the hull of vertices,    gamma: |z| <= gamma |w|

**Constant systems.** At a frequency the system says N v = 0 with v = (x, w) and N = [s I - A, -B]. If some F has

    gamma^2 |w|^2 - |z|^2 - 2 Re v* F N v > 0    for all v != 0, at each vertex

then |z| < gamma |w| for the whole hull: the left side is concave in (A, B, C, D), for F is common. This bounds the
structured singular value of constant real parameters and a full performance block; F takes the place of the scalings D
and G (Finsler's lemma; C. Scherer, LPV control and full block multipliers, Automatica 37 (2001)). No pole is on the
axis there, since w = 0 would have x = 0.

**All frequencies.** The left side is affine in s, too. With one F for both ends of a range of frequencies the
inequality holds between them. A ray (a, b) of s = j b/a, at [j b I - a A, -a B], makes infinity an end like others. In
a sampled loop the arc of z = s between two ends lies in the triangle with the tangents' intersection. Ranges are halved
until the greatest bound exceeds that of a single frequency by a thousandth.

**Varying systems.** One matrix P > 0 with

    -d/dt x'P x - |z|^2 + gamma^2 |w|^2 > 0      at each vertex (bounded real lemma)

bounds the gain from w to z, root mean square, of a system that moves in the hull arbitrarily fast.

A solver finds F and P in floating point. Then every inequality is evaluated, and its least eigenvalue must exceed what
errors of 2^-40 of each entry can change.
"""

import heapq
import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from diffabs.robust.design.proof.dyadic import RELATIVE_ERROR_BITS
from diffabs.robust.design.proof.exact import he
from diffabs.robust.design.sdp import solver
from diffabs.robust.design.sdp.scaling import Frame, analysis_frame
from diffabs.robust.design.sdp.solver import Unknowns, group_blocks, symmetric_from_blocks

ENTRY_ERROR = 2.0**-RELATIVE_ERROR_BITS  # relative, of each entry of a vertex
STATE_MARGIN = 1e-7  # of |x|^2 in scaled coordinates, that the solver keeps
LOOSENINGS = (1e-6, 1e-5, 1e-4, 1e-3)  # of a bound, in this order, until its check succeeds
FIRST_RANGES, MAX_RANGES = 8, 300  # ranges of frequencies
RANGE_TOLERANCE = 1e-3  # between the bound over ranges and that of a single frequency, relative
OVERLAP = 1e-9  # of neighbouring arcs [rad]: roundings leave no gap

Point = tuple[float, complex]  # (a, s) of N = [s I - a A, -a B]


class VertexSystems(NamedTuple):
    """Stable systems A (V, n, n), B (V, n, m), C (V, p, n), D (V, p, m), whose hull is meant; period [s] or None."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    period: float | None

    @property
    def outputs(self) -> np.ndarray:
        """[C, D], shape (V, p, n + m)."""
        return np.concatenate([self.C, self.D], axis=2)


class RangeBound(NamedTuple):
    """A bound over all frequencies.

    Attributes:
        value: Bound; infinite if a frequency has none, NaN if the check after the solver fails.
        at: Frequency whose own bound, for it alone, is the greatest [rad/s].
        ranges: Number of frequency ranges, each with its own F.
    """

    value: float
    at: float
    ranges: int


def bound_constant(systems: VertexSystems, peak: float, at: float) -> RangeBound:
    """Return a bound of the peak gain of every constant system of the hull, for all frequencies.

    Args:
        systems: Vertices, all of them stable.
        peak: A peak gain that a system of the hull has, above 0.
        at: Its frequency [rad/s].
    """
    return _Frequencies(systems, peak).bound(at)


class _Frequencies:
    """The search for the multipliers F of one hull."""

    def __init__(self, systems: VertexSystems, peak: float):
        self.systems, self.peak = systems, peak
        self.frame = _frame(systems)
        self.scaled = _scale(systems, self.frame, peak)
        n, m = systems.B.shape[1:]
        self.unknowns = Unknowns(R=(n + m, n), J=(n + m, n), g=(1, 1))
        self.on_input, self.on_state = np.diag([0.0] * n + [1.0] * m), np.diag([1.0] * n + [0.0] * m)

    def bound(self, at: float) -> RangeBound:
        period, tau = self.systems.period, self.frame.tau
        end = math.pi / 2 if period is None else math.pi
        peak_angle = math.atan(at / tau) if period is None else min(at * period, end)
        edges = sorted({*np.linspace(0.0, end, FIRST_RANGES + 1).tolist(), peak_angle})
        reached, reached_at = self.peak, at
        ranges: list[tuple[float, float, float, np.ndarray]] = []
        for low, high in itertools.pairwise(edges):
            self._add(ranges, low, high)
        while -ranges[0][0] > reached * (1 + RANGE_TOLERANCE) and len(ranges) < MAX_RANGES:
            _, low, high, _ = heapq.heappop(ranges)
            middle = 0.5 * (low + high)
            single, _ = self._solve([self._point(middle)])
            w = tau * math.tan(middle) if period is None else middle / period
            if math.isinf(single):
                return RangeBound(math.inf, w, len(ranges) + 1)
            if single > reached:
                reached, reached_at = single, w
            self._add(ranges, low, middle)
            self._add(ranges, middle, high)
        for loosening in LOOSENINGS:
            value = -ranges[0][0] * (1 + loosening)
            if math.isinf(value) or all(self._holds(value, low, high, f) for _, low, high, f in ranges):
                return RangeBound(value, reached_at, len(ranges))
        return RangeBound(math.nan, reached_at, len(ranges))

    def _add(self, ranges: list[tuple[float, float, float, np.ndarray]], low: float, high: float) -> None:
        value, f = self._solve(self._points(low, high))
        heapq.heappush(ranges, (-value, low, high, f))

    def _point(self, angle: float) -> Point:
        """Return the point of an angle in units of the frame."""
        if self.systems.period is not None:
            return 1.0, complex(math.cos(angle), math.sin(angle))
        return (0.0 if angle == math.pi / 2 else math.cos(angle)), 1j * math.sin(angle)

    def _points(self, low: float, high: float) -> list[Point]:
        """Return points whose hull contains those of a range of angles."""
        if self.systems.period is None:
            return [self._point(low), self._point(high)]
        low, high = low - OVERLAP, high + OVERLAP
        _, middle = self._point(0.5 * (low + high))
        return [self._point(low), self._point(high), (1.0, middle / math.cos(0.5 * (high - low)) * (1 + 1e-12))]

    def _solve(self, points: list[Point]) -> tuple[float, np.ndarray]:
        """Return the least bound that one F proves at some points, and F in original coordinates."""
        a, b, outputs = self.scaled.A, self.scaled.B, self.scaled.outputs
        squares = outputs.mT @ outputs + STATE_MARGIN * self.on_state
        blocks = []
        shift = np.eye(a.shape[1], a.shape[1] + b.shape[2])
        for share, s in points:
            rest = np.concatenate([-share * a, -share * b], axis=2)
            for real, square in zip(rest + s.real * shift, squares, strict=True):
                blocks += self.unknowns.blocks(lambda v, n=real, q=square, y=s.imag * shift: [self._matrix(v, n, y, q)])
        answer = solver.solve_sdp(self.unknowns.row(lambda v: v["g"]), group_blocks(blocks))
        if not np.isfinite(answer.y).all() or answer.status not in ("optimal", "optimal_inaccurate"):
            return math.inf, np.zeros(0)
        values = self.unknowns.values(answer.y)
        f = values["R"] + 1j * values["J"]
        n = a.shape[1]
        f = np.concatenate([self.frame.inverse.T @ f[:n], f[n:] / math.sqrt(self.frame.tau)])
        return self.peak * math.sqrt(max(values["g"][0, 0], 0.0)), self.peak**2 * f @ self.frame.inverse

    def _matrix(
        self, v: Mapping[str, np.ndarray], real: np.ndarray, imag: np.ndarray, square: np.ndarray
    ) -> np.ndarray:
        """Return the inequality at a point of a vertex as a real matrix, [[Re M, -Im M], [Im M, Re M]]."""
        product = he(v["R"] @ real - v["J"] @ imag)
        skew = v["R"] @ imag + v["J"] @ real
        whole = v["g"] * self.on_input - square - product
        return symmetric_from_blocks([[whole], [skew.mT - skew, whole]])

    def _holds(self, value: float, low: float, high: float, f: np.ndarray) -> bool:
        """Return whether F proves a bound over a range of angles, with errors of the vertices' entries."""
        systems, n = self.systems, self.systems.A.shape[1]
        shift = np.eye(n, n + systems.B.shape[2])
        rows, outputs = np.concatenate([systems.A, systems.B], axis=2), systems.outputs
        for share, s in self._points(low, high):
            s = s * (1.0 if systems.period is not None else self.frame.tau)
            product = f @ (s * shift - share * rows)
            matrices = value**2 * self.on_input - outputs.mT @ outputs - product - np.conj(product.mT)
            terms = np.abs(f) @ (abs(s) * shift + share * np.abs(rows)) + np.abs(outputs).mT @ np.abs(outputs)
            if not is_positive(matrices, ENTRY_ERROR * (he(terms) + value**2 * self.on_input)):
                return False
        return True


def bound_varying(systems: VertexSystems, peak: float) -> float:
    """Return a bound of the gain of every system that moves in the hull, at any rate; infinite if no P proves one.

    It is NaN if the check after the solver fails. Arguments are those of `bound_constant`.
    """
    frame, n = _frame(systems), systems.A.shape[1]
    scaled = _scale(systems, frame, peak)
    unknowns = Unknowns(P=n, g=(1, 1))
    margin = STATE_MARGIN * np.diag([1.0] * n + [0.0] * systems.B.shape[2])
    blocks = unknowns.blocks(lambda v: [v["P"]])
    for i in range(len(systems.A)):
        a, b, c, d = (x[i : i + 1] for x in scaled[:4])
        vertex = VertexSystems(a, b, c, d, systems.period)
        blocks += unknowns.blocks(lambda v, x=vertex: [_decrease(x, v["P"], v["g"]) - margin])
    answer = solver.solve_sdp(unknowns.row(lambda v: v["g"]), group_blocks(blocks))
    if not np.isfinite(answer.y).all() or answer.status not in ("optimal", "optimal_inaccurate"):
        return math.inf
    values = unknowns.values(answer.y)
    p = peak**2 * frame.form(values["P"])
    for loosening in LOOSENINGS:
        square = float(values["g"][0, 0]) * peak**2 * (1 + loosening) ** 2
        errors = ENTRY_ERROR * _term_sizes(systems, np.abs(p), square)
        if is_positive(p[None], ENTRY_ERROR * np.abs(p)[None]) and is_positive(_decrease(systems, p, square), errors):
            return math.sqrt(square)
    return math.nan


def _decrease(x: VertexSystems, p: np.ndarray, square: float | np.ndarray) -> np.ndarray:
    """Return the matrices of -dV/dt - |z|^2 + gamma^2 |w|^2 for V = x'P x, or of V - V+; `square` is gamma^2."""
    n, m = x.B.shape[1:]
    rows, state = np.concatenate([x.A, x.B], axis=2), np.eye(n, n + m)
    spent = square * np.diag([0.0] * n + [1.0] * m) - x.outputs.mT @ x.outputs
    if x.period is not None:
        return spent + state.T @ p @ state - rows.mT @ p @ rows
    return spent - he(state.T @ p @ rows)


def _term_sizes(x: VertexSystems, p: np.ndarray, square: float) -> np.ndarray:
    """Return the sums of the sizes of all terms of `_decrease`, each as often as its factors may err; `p` is |P|."""
    n, m = x.B.shape[1:]
    rows, state = np.abs(np.concatenate([x.A, x.B], axis=2)), np.eye(n, n + m)
    spent = square * np.diag([0.0] * n + [1.0] * m) + 2 * np.abs(x.outputs).mT @ np.abs(x.outputs)
    if x.period is not None:
        return spent + state.T @ p @ state + 2 * rows.mT @ p @ rows
    return spent + he(state.T @ p @ rows)


def is_positive(matrices: np.ndarray, errors: np.ndarray) -> bool:
    """Return whether Hermitian matrices (k, n, n) are positive definite; `errors` bound the errors of their entries."""
    diagonal = np.real(np.diagonal(matrices, axis1=1, axis2=2))
    if not (np.isfinite(diagonal).all() and (diagonal > 0).all()):
        return False
    scale = diagonal**-0.5
    scale = scale[:, :, None] * scale[:, None]
    smallest = np.linalg.eigvalsh(matrices * scale)[:, 0]
    rounding = 1e-14 * matrices.shape[-1] ** 2
    return bool((smallest > np.max(np.sum(errors * scale, axis=2), axis=1) + rounding).all())


def _frame(systems: VertexSystems) -> Frame:
    return analysis_frame(systems.A, discrete=systems.period is not None)


def _scale(systems: VertexSystems, frame: Frame, peak: float) -> VertexSystems:
    """Return the systems in the coordinates and the time of a frame, with outputs in units of a peak gain."""
    root = math.sqrt(frame.tau)
    return VertexSystems(
        frame.states(systems.A),
        frame.inverse @ systems.B / root,
        systems.C @ frame.T / (root * peak),
        systems.D / peak,
        systems.period,
    )
