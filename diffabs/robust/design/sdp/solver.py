"""Linear matrix inequalities as semidefinite programs; the only module that imports cvxpy.

    minimise c'y   subject to   h_b + sum_d y_d G_bd >= 0   for every block b

A formula such as eq. (30) of Maeda and Sugiura is written once, in NumPy, for unknown matrices X, F. `Unknowns.affine`
reads off h and G by inserting unit matrices. The program is parametrised by c, h and G, so cvxpy compiles one program
for each pattern of sizes. A new weight, vertex or gain then costs only the solution.

The status of a solver is no criterion: `Answer` carries the multipliers, and `gap` and `violation` are computed here.
"""

import functools
import threading
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from cvxpy import Parameter, Problem, Variable

from diffabs.core.types import Part, PyTree

SOLVERS = ("CLARABEL", "MOSEK", "CVXOPT")  # in order of preference; SCS has errors of 1e-3 and is not used
OPTIONS = {"CLARABEL": {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}}
HINT = 'pip install ".[design]" in a clone'
SOLVER_LOCK = threading.Lock()  # threads share a compiled program, which holds the values of its parameters


class SdpBlock(NamedTuple):
    """Inequalities h + sum_d y_d G_d >= 0, b of them, of one size k: h (b, k, k), G (b, d, k, k)."""

    h: np.ndarray
    G: np.ndarray


class Answer(NamedTuple):
    """Unknowns y, multipliers of each group of blocks (b, k, k), and the solver's status."""

    y: np.ndarray
    multipliers: list[np.ndarray]
    status: str

    def violation(self, blocks: list[SdpBlock]) -> float:
        """Return the amount by which the smallest eigenvalue of any of the `blocks` is below 0, at least 0."""
        values = (b.h + np.einsum("d,bdij->bij", self.y, b.G) for b in blocks)
        return max(0.0, *(-float(np.linalg.eigvalsh(value).min()) for value in values))

    def gap(self, c: np.ndarray, blocks: list[SdpBlock]) -> float:
        """Return a bound on c'y - optimum: the duality gap plus the multipliers' residual times the unknowns."""
        # Weak duality with multipliers W >= 0 that satisfy the dual equation only approximately: |c - gradient| |y|
        # covers the rest.
        bound = -sum(float(np.sum(b.h * w)) for b, w in zip(blocks, self.multipliers, strict=True))
        gradient = sum(np.einsum("bdij,bij->d", b.G, w) for b, w in zip(blocks, self.multipliers, strict=True))
        return float(c @ self.y) - bound + float(np.abs(c - gradient) @ np.abs(self.y))


class Unknowns:
    """Unknown matrices by name, packed into one vector y.

    A shape (r, c) stands for a matrix, a number n for a symmetric (n, n) matrix.
    """

    def __init__(self, **shapes: tuple[int, int] | int):
        """Lay out the matrices of the given `shapes` in order."""
        self.basis: dict[str, np.ndarray] = {}
        units = {name: _units(shape) for name, shape in shapes.items()}
        self.size: int = sum(map(len, units.values()))
        at = 0
        for name, unit in units.items():
            whole = np.zeros((self.size, *unit.shape[1:]))
            whole[at : at + len(unit)] = unit
            self.basis[name], at = whole, at + len(unit)
        # The first entry of a stack is the zero matrix: the formula gives h there, and h + G_d at the unit matrices.
        self.stacked: dict[str, np.ndarray] = {
            name: np.concatenate([np.zeros((1, *b.shape[1:])), b]) for name, b in self.basis.items()
        }

    def values(self, y: np.ndarray) -> dict[str, np.ndarray]:
        """Return the matrices in a vector `y`."""
        return {name: np.tensordot(y, unit, 1) for name, unit in self.basis.items()}

    def blocks(self, formulas: Callable[[Mapping[str, np.ndarray]], list[PyTree]]) -> list[SdpBlock]:
        """Return the blocks h + sum y_d G_d of `formulas`, which are affine in the unknowns and accept stacks."""
        values = formulas(self.stacked)
        # A formula without unknowns gives one matrix, with G = 0.
        wholes = [np.broadcast_to(value, (self.size + 1, *value.shape[-2:])) for value in values]
        return [SdpBlock(whole[:1], (whole[1:] - whole[0])[None]) for whole in wholes]

    def affine(self, formula: Callable[[Mapping[str, np.ndarray]], PyTree]) -> SdpBlock:
        """Return the block of one affine `formula`."""
        return self.blocks(lambda v: [formula(v)])[0]

    def row(self, formula: Callable[[Mapping[str, np.ndarray]], PyTree]) -> np.ndarray:
        """Return the coefficients c of a `formula` that is linear in the unknowns."""
        return np.asarray(formula(self.basis), float).reshape(self.size)


def _units(shape: tuple[int, int] | int) -> np.ndarray:
    if isinstance(shape, tuple):
        return np.eye(shape[0] * shape[1]).reshape(-1, *shape)
    pairs = [(i, j) for i in range(shape) for j in range(i + 1)]
    units = np.zeros((len(pairs), shape, shape))
    for unit, (i, j) in zip(units, pairs, strict=True):
        unit[i, j] = unit[j, i] = 1.0
    return units


def symmetric_from_blocks(rows: list[list[PyTree]]) -> np.ndarray:
    """Return symmetric matrices from the blocks on and below the diagonal; None stands for zero."""
    stack = np.broadcast_shapes(*(np.shape(x)[:-2] for row in rows for x in row if x is not None))
    sizes = [np.shape(row[-1])[-1] for row in rows]
    ends = np.cumsum([0, *sizes])
    whole = np.zeros((*stack, ends[-1], ends[-1]))
    for i, row in enumerate(rows):
        for j, x in enumerate(row):
            if x is not None:
                whole[..., ends[i] : ends[i + 1], ends[j] : ends[j + 1]] = x
                if i != j:
                    whole[..., ends[j] : ends[j + 1], ends[i] : ends[i + 1]] = np.swapaxes(x, -1, -2)
    return whole


def group_blocks(blocks: Iterable[SdpBlock]) -> list[SdpBlock]:
    """Return groups of blocks of equal size, each block scaled to a largest coefficient of 1."""
    groups: dict[int, list[SdpBlock]] = {}
    for block in blocks:
        size = max(float(np.abs(block.G).max()), float(np.abs(block.h).max()))
        groups.setdefault(block.h.shape[-1], []).append(SdpBlock(block.h / size, block.G / size))
    return [stack_blocks(group) for group in groups.values()]


def stack_blocks(blocks: list[SdpBlock]) -> SdpBlock:
    """Return blocks of one size as one group."""
    return SdpBlock(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))


@functools.cache
def solvers() -> tuple[str, ...]:
    """Return the installed solvers among `SOLVERS`, in that order."""
    try:
        import cvxpy
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"robust design needs {error.name}: {HINT}", name=error.name) from error
    installed = cvxpy.installed_solvers()
    usable = tuple(name for name in SOLVERS if name in installed)
    if not usable:
        raise ModuleNotFoundError(f"robust design needs one of {', '.join(SOLVERS)}: {HINT}", name="clarabel")
    return usable


def solve_sdp(c: np.ndarray, blocks: list[SdpBlock], solver: str = "CLARABEL") -> Answer:
    """Minimise c'y under grouped blocks and return the answer; NaN in y stands for a failure."""
    shapes = tuple(b.h.shape[:2] for b in blocks)
    with SOLVER_LOCK:
        program = _program(len(c), shapes)
        program.cost.value = c
        for block, h, g in zip(blocks, program.h, program.g, strict=True):
            h.value = block.h.ravel()
            g.value = np.swapaxes(block.G.reshape(*block.G.shape[:2], -1), 1, 2).reshape(-1, len(c))
        status = _run(program.problem, solver)
        solved = program.y.value is not None
        y = np.array(program.y.value) if solved else np.full(len(c), np.nan)
        # Read inside the lock: another thread would overwrite the values of the shared program.
        duals = [[w.dual_value for w in group] for group in program.constraints]
    multipliers = [
        np.array([np.full((k, k), np.nan) if w is None else w for w in group])
        for group, (_, k) in zip(duals, shapes, strict=True)
    ]
    return Answer(y, multipliers, status)


class _Program(NamedTuple):
    problem: "Problem"
    y: "Variable"
    cost: "Parameter"
    h: "list[Parameter]"
    g: "list[Parameter]"
    constraints: list[list[PyTree]]


@functools.lru_cache(maxsize=64)
def _program(unknowns: int, shapes: tuple[tuple[int, int], ...]) -> _Program:
    """Return the parametrised program for groups of (count, size) blocks.

    It follows the rules for disciplined parametrised programs, so cvxpy compiles it once.
    """
    import cvxpy as cp

    y, cost = cp.Variable(unknowns), cp.Parameter(unknowns)
    h = [cp.Parameter(count * k * k) for count, k in shapes]
    g = [cp.Parameter((count * k * k, unknowns)) for count, k in shapes]
    constraints = []
    for (count, k), h_all, g_all in zip(shapes, h, g, strict=True):
        flat = g_all @ y + h_all
        parts = [flat[i * k * k : (i + 1) * k * k] for i in range(count)]
        constraints.append([cp.reshape(part, (k, k), order="C") >> 0 for part in parts])
    problem = cp.Problem(cp.Minimize(cost @ y), [constraint for group in constraints for constraint in group])
    return _Program(problem, y, cost, h, g, constraints)


def _run(problem: Part, solver: str) -> str:
    """Solve a program and return its status; an exception in the solver becomes a status."""
    import cvxpy as cp

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the numbers of an inaccurate answer decide, not its warning
        try:
            # No warm start: Clarabel would keep the scaling of other data, and an answer would depend on earlier
            # programs.
            problem.solve(solver=solver, warm_start=False, **OPTIONS.get(solver, {}))
        except (cp.SolverError, ArithmeticError, ValueError) as error:
            return f"failed: {' '.join(str(error).split())}"
    return str(problem.status)
