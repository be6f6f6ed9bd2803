"""A design as one semidefinite program, in the coordinates of a frame.

For V = x'X^-1 x and F = K X each inequality is a positive semidefinite matrix that is affine in X, F, Z and g. `flow`
is A X + B F, `drift` dX/dt along a schedule. In discrete time x+ = A x + B u, and a Schur complement with X takes the
place of the derivative.

Sources: Maeda and Sugiura, eqs. (30), (32); M. Chilali and P. Gahinet, H-infinity design with pole placement
constraints (1996); S. Boyd et al., Linear Matrix Inequalities in System and Control Theory (1994).
"""

import itertools
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from diffabs.robust.design.polytopes import Polytope, Schedule
from diffabs.robust.design.proof.exact import he
from diffabs.robust.design.sdp.scaling import Frame, whitening_matrix
from diffabs.robust.design.sdp.solver import SdpBlock, Unknowns, group_blocks, symmetric_from_blocks
from diffabs.robust.design.spec import Spec

# Weight of trace Z in the minimisation of an L2 gain: without it the infimum often needs infinite feedback.
L2_TRACE_WEIGHT = 1e-4
SPECIFICATION_TIGHTENING = 1e-6  # relative tightening of each specification, so that the exact proof has a margin
Values = Mapping[str, np.ndarray]


class VertexAtNode(NamedTuple):
    """A vertex (A, B) and E in scaled coordinates, at a node of the schedule.

    dX/dt is the sum of rate times X[node] over the pairs (node, rate) of `drift`.
    """

    A: np.ndarray
    B: np.ndarray
    E: np.ndarray
    node: int
    drift: tuple[tuple[int, float], ...] = ()


class DesignProgram:
    """A program that minimises the mean of trace Z over the nodes, or the squared L2 gain g, under the specification.

    The unknowns are X, F, Z for each node (a polytope has one), and g. `level` bounds V on the set of starts of an
    input limit.
    """

    def __init__(self, system: Polytope | Schedule, whole: Polytope, spec: Spec, frame: Frame):
        """Lay out the unknowns for `system` under `spec` in `frame`; `whole` has all vertices of the system."""
        self.system = system
        self.spec = spec
        self.frame = frame
        self.period: float | None = whole.period
        self.nodes: int = len(system.nodes) if isinstance(system, Schedule) else 1
        n, m = whole.order, whole.inputs
        shapes: dict[str, tuple[int, int] | int] = {}
        for i in range(self.nodes):
            shapes |= {f"X{i}": n, f"F{i}": (m, n), f"Z{i}": n}
        if spec.l2 is not None:
            shapes |= {"g": (1, 1)} if spec.l2.bound is None else {"s": (1, 1)}
        self.unknowns: Unknowns = Unknowns(**shapes)
        weight = frame.trace_weight()
        # Trace Z of the original coordinates is a weighted trace of the scaled Z. `scale` keeps the solver's objective
        # near 1.
        self.scale: float = float(np.trace(weight)) if spec.Q is not None else 1.0
        self.weight: np.ndarray = weight / np.trace(weight)
        # In the frame P = I and R = I, so K = -B' is the gain of the Riccati solution.
        k = -frame.inputs(whole.B[0]).T
        self.output: float = 1.0
        self.disturbance: float = 1.0
        if (l2 := spec.l2) is not None:
            # Units of z and w in which the gain of the frame's closed loop is about 1.
            z = np.linalg.norm(l2.output @ frame.T + l2.feedthrough @ frame.U @ k) / np.sqrt(frame.tau)
            e = whole.B[0] if l2.disturbance is None else l2.disturbance
            self.output = float(z) or 1.0
            self.disturbance = float(np.linalg.norm(frame.inverse @ e)) / np.sqrt(frame.tau) or 1.0
        self.root: np.ndarray = np.zeros((0, n))
        self.even: np.ndarray = np.eye(n)
        if spec.Q is not None:
            weight = frame.weight(spec.Q)
            self.root, self.even = _root(weight), whitening_matrix(weight + k.T @ k)
        self.common: list[SdpBlock] = list(self._common())

    def objective(self) -> np.ndarray:
        """Return c (unknowns,) of the objective c'y: with Q and R, `scale` c'y is the mean of trace Z."""
        trace = self.unknowns.row(
            lambda v: sum(np.einsum("ij,dji->d", self.weight, v[f"Z{i}"]) for i in range(self.nodes)) / self.nodes
        )
        return trace if self.spec.Q is not None else L2_TRACE_WEIGHT * trace + self.unknowns.row(lambda v: v["g"])

    def blocks(self, level: float) -> list[SdpBlock]:
        """Return all inequalities for a `level` of V, grouped by size."""
        return group_blocks([*self.common, *self._input(level)])

    def least_level(self) -> float:
        """Return the largest V of the frame's own solution over the starts of the input limit; 1 without a limit."""
        if self.spec.input is None:
            return 1.0
        return float(((self.frame.inverse @ self.spec.input.points.T) ** 2).sum(axis=0).max())

    def read(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gains (nodes, m, n) and forms P = X^-1 (nodes, n, n) of `y`, in the original coordinates."""
        v = self.unknowns.values(y)
        inverses = [np.linalg.inv(v[f"X{i}"]) for i in range(self.nodes)]
        gains = [self.frame.gain(v[f"F{i}"] @ inverse) for i, inverse in enumerate(inverses)]
        return np.array(gains), np.array([self.frame.form(inverse) for inverse in inverses])

    def _common(self) -> Iterator[SdpBlock]:
        for place in self._vertices_at_nodes():
            yield from self._at(place)
        for i in range(self.nodes):
            # Z >= X^-1, eq. (32).
            yield self.unknowns.affine(
                lambda v, i=i: symmetric_from_blocks([[v[f"Z{i}"]], [np.eye(v[f"X{i}"].shape[-1]), v[f"X{i}"]]])
            )

    def _vertices_at_nodes(self) -> Iterator[VertexAtNode]:
        """Yield the vertices at the nodes where an inequality has to hold.

        In a cell X and F are linear in the parameter, and the system is anywhere in the cell's polytope. The ends of
        the cell and of the rates therefore suffice.
        """
        cells = self.system.cells if isinstance(self.system, Schedule) else (self.system,)
        frame, l2 = self.frame, self.spec.l2
        for i, cell in enumerate(cells):
            for a, b in zip(cell.A, cell.B, strict=True):
                e = b if l2 is None or l2.disturbance is None else l2.disturbance
                scaled = frame.states(a), frame.inputs(b), frame.inverse @ e / np.sqrt(frame.tau)
                if isinstance(self.system, Polytope):
                    yield VertexAtNode(*scaled, 0)
                    continue
                width = self.system.nodes[i + 1] - self.system.nodes[i]
                for node, rate in itertools.product((i, i + 1), sorted(set(self.spec.rates or ()))):
                    # dX/dt = rate (X_b - X_a)/width, in the frame's unit of time.
                    slope = rate / width / frame.tau
                    yield VertexAtNode(*scaled, node, ((i, -slope), (i + 1, slope)))

    def _at(self, place: VertexAtNode) -> Iterator[SdpBlock]:
        spec, frame, discrete = self.spec, self.frame, self.period is not None

        def evaluate(v: Values) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
            x, f = v[f"X{place.node}"], v[f"F{place.node}"]
            drift = sum((rate * v[f"X{i}"] for i, rate in place.drift), np.zeros_like(x))
            return x, f, place.A @ x + place.B @ f, drift

        def cost(v: Values) -> np.ndarray:
            """Return the matrix of dV/dt + x'Qx + u'u <= 0 for R = I, its first rows and columns times `even`."""
            (x, f, flow, drift), even = evaluate(v), self.even
            spent = [self.root @ x @ even, f @ even]
            if discrete:
                rows = [[even.T @ x @ even], [flow @ even, x], [spent[0], None, np.eye(len(self.root))]]
                return symmetric_from_blocks([*rows, [spent[1], None, None, np.eye(f.shape[-2])]])
            rows = [[even.T @ (drift - he(flow)) @ even], [spent[0], np.eye(len(self.root))]]
            return symmetric_from_blocks([*rows, [spent[1], None, np.eye(f.shape[-2])]])

        def decay(v: Values) -> np.ndarray:
            """Return the matrix of dV/dt + 2 rate V <= 0, or in discrete time of V+ <= exp(-2 rate) V."""
            x, _, flow, drift = evaluate(v)
            rate = spec.decay * (1 + SPECIFICATION_TIGHTENING) * (self.period or 1 / frame.tau)
            if discrete:
                return symmetric_from_blocks([[np.exp(-2 * rate) * x], [flow, x]])
            # The inequality of P = X^-1, multiplied by X from both sides; d(X^-1)/dt gives drift its sign.
            return drift - he(flow) - 2 * rate * x

        def damping(v: Values) -> np.ndarray:
            # Tightened in 1 - zeta, so that zeta stays below 1.
            zeta = 1 - (1 - spec.damping) * (1 - SPECIFICATION_TIGHTENING)
            return damping_matrix(evaluate(v)[2], zeta / np.sqrt(1 - zeta**2))

        def gain(v: Values) -> np.ndarray:
            """Return the matrix of s dV/dt + |z|^2 - g |w|^2 <= 0, where z = (C X + D F) X^-1 x.

            It is affine in (X, F, s) for a fixed g, and in (X, F, g) for s = 1. The multiplier s lets V serve the cost
            and the gain at once, although their natural sizes differ.
            """
            (x, f, flow, drift), l2 = evaluate(v), spec.l2
            assert l2 is not None
            z = (l2.output @ frame.T @ x + l2.feedthrough @ frame.U @ f) / np.sqrt(frame.tau)
            # g is then near 1, as are the other unknowns.
            z, e = z / self.output, place.E / self.disturbance
            s, bound = v.get("s", 1.0), l2.bound
            g = (
                v["g"]
                if bound is None
                else (bound * (1 - SPECIFICATION_TIGHTENING) / self.output / self.disturbance) ** 2
            )
            # Divided by s and with w in units of s, the inequality is linear in s: its blocks are s E, s g I and s I.
            limit, unit = s * g * np.eye(e.shape[1]), s * np.eye(z.shape[-2])
            if discrete:
                return symmetric_from_blocks([[x], [None, limit], [flow, s * e, x], [z, None, None, unit]])
            return symmetric_from_blocks([[drift - he(flow)], [-s * e.T, limit], [z, None, unit]])

        formulas = ((spec.Q is not None, cost), (spec.decay > 0, decay), (spec.damping > 0, damping), (spec.l2, gain))
        yield from (self.unknowns.affine(formula) for applies, formula in formulas if applies)

    def _input(self, level: float) -> Iterator[SdpBlock]:
        """Yield the inequalities of the input limit for a level of V."""
        limit = self.spec.input
        if limit is None:
            return
        for start in limit.points @ self.frame.inverse.T:
            # V(start) <= level.
            yield self.unknowns.affine(
                lambda v, x=start[:, None]: symmetric_from_blocks([[np.full((1, 1), level)], [x, v["X0"]]])
            )
        for row, bound in zip(self.frame.U, limit.limit * (1 - SPECIFICATION_TIGHTENING), strict=True):
            # |u_j| <= bound while V <= level.
            yield self.unknowns.affine(
                lambda v, row=row[None], square=bound**2 / level: symmetric_from_blocks(
                    [[np.full((1, 1), square)], [np.swapaxes(row @ v["F0"], -1, -2), v["X0"]]]
                )
            )


def damping_matrix(flow: np.ndarray, cot: float) -> np.ndarray:
    """Return the matrix of the pole region |Im s| <= -Re s/cot, whose damping is cot/sqrt(1 + cot^2)."""
    skew = cot * (flow - np.swapaxes(flow, -1, -2))
    return -symmetric_from_blocks([[he(flow)], [-skew, he(flow)]])


def _root(q: np.ndarray) -> np.ndarray:
    """Return Qh with Qh'Qh = Q."""
    # An eigenvalue of a semidefinite Q may be below 0 by rounding.
    values, vectors = np.linalg.eigh(q)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
