"""Proofs over a box: cells of parameters that cover it, each proved, those that fail or say too little halved.

    proved     every cell of the cover satisfies the claim
    refuted    in one cell every run violates it; a cell may be a single run
    undecided  neither within the budget

Cells come from halving, and the sum of their volumes equals the volume of the box in fractions.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from diffabs.core.loop import Loop
from diffabs.reach.engine import Cells, Prover
from diffabs.reach.equations import Equations, derive_equations

BATCH = 64  # cells between two looks at the clock
SMALLEST = 2.0**-40  # of the box's side: a smaller cell is not halved again
CLOSE = 5e-4  # a bound is refined while it is farther than this from the worst run found, relative

Box = dict[str, tuple[float, float]]


class Claim(NamedTuple):
    """A statement about all runs of a box.

    Attributes:
        quantity: `greatest NAME` or `least NAME` of a signal, `stop_time` or `stop_distance`.
        bound: The quantity is at most this; of `least NAME`, at least.
    """

    quantity: str
    bound: float


class BoxProof(NamedTuple):
    """What was proved about a box.

    Attributes:
        verdict: proved, refuted or undecided.
        bounds: Proved range (low, high) of each quantity over the box; infinite ends where nothing is proved.
        cells: Cells that are proved, shape (cells, parameters, 2).
        rows: Bounds of these cells.
        left: Cells that are not, shape (cells, parameters, 2).
        refuting: Cell that refutes a claim, or None.
        tried: Number of cells that were tried.
        seconds: Computing time [s].
        equations: Equations of the loop.
        prover: Native prover with its settings.
    """

    verdict: str
    bounds: dict[str, tuple[float, float]]
    cells: np.ndarray
    rows: Cells | None
    left: np.ndarray
    refuting: np.ndarray | None
    tried: int
    seconds: float
    equations: Equations
    prover: Prover


def prove_box(
    loop: Loop,
    over: Mapping[str, tuple[float, float]],
    claims: Sequence[Claim] = (),
    *,
    signals: Sequence[str] = (),
    horizon: float = 10.0,
    budget: float = 60.0,
    known: Mapping[str, float] | None = None,
    suspects: Sequence[Sequence[float]] = (),
    progress: Callable[[str], None] = lambda line: None,
    threads: int | None = None,
) -> BoxProof:
    """Return what can be proved about all runs of a loop over a box within the budget.

    Args:
        loop: Closed loop with concrete parameters.
        over: Range (low, high) of each parameter of the box, by path, in SI units.
        claims: Statements to decide. Without one, the bounds are refined for the whole budget.
        signals: Further signals whose range is wanted, by name.
        horizon: Duration after which a run that has not stopped is no longer followed [s].
        budget: Computing time [s].
        known: Greatest value of a quantity in runs that were found: bounds are not refined beyond it.
        suspects: Points of the box whose runs may violate a claim; each is tried first, as a cell of one run.
        progress: Called with a line about how far the proof is.
        threads: Number of threads; None for one for each core.

    Raises:
        NoRule: A part, an operation or a parameter of the loop has no sound rule.
        NoCompiler: No C++ compiler of this machine works.
    """
    began = time.monotonic()
    paths = tuple(over)
    equations = derive_equations(loop, paths)
    wanted = tuple(dict.fromkeys([*signals, *(c.quantity.split()[1] for c in claims if " " in c.quantity)]))
    prover = Prover(equations, wanted, horizon)
    box = np.array([over[path] for path in paths], float)
    fastest = [high if path == "initial.speed" else (low + high) / 2 for path, (low, high) in over.items()]
    prover.choose_weights(np.array(fastest))
    sides = box[:, 1] - box[:, 0]
    quantities = _Quantities(prover.signals)
    left, done, rows, refuting, tried = box[None], [], [], None, 0
    if suspects:
        points = np.repeat(np.asarray(suspects, float)[:, :, None], 2, 2)
        refuting = _violated(quantities, claims, points, prover.prove(points, threads))
    while len(left) and refuting is None and time.monotonic() - began < budget:
        left = left[np.lexsort(left[:, ::-1, 0].T)]
        now, left = left[:BATCH], left[BATCH:]
        found = prover.prove(now, threads)
        tried += len(now)
        refuting = _violated(quantities, claims, now, found)
        fine = _ended(found) & _satisfied(quantities, claims, found)
        done.append(now[fine])
        rows.append(_select(found, fine))
        again, reach = now[~fine], found.reach[~fine]
        small = ((again[:, :, 1] - again[:, :, 0]) <= SMALLEST * sides).all(1)
        left = np.concatenate([left, again[small], _halve(again[~small], reach[~small], sides)])
        if small.any():
            break
        progress(f"{sum(map(len, done)):,} cells proved, {len(left):,} left")
    cells = np.concatenate(done) if done else np.empty((0, *box.shape))
    merged = Cells(*(np.concatenate(columns) for columns in zip(*rows, strict=True))) if rows else None
    if not claims and not len(left) and merged is not None:
        cells, merged, more = _refine(
            prover, quantities, cells, merged, sides, known or {}, began + budget, progress, threads
        )
        tried += more
    covered = not len(left) and merged is not None
    if covered and sum((_volume(cell) for cell in cells.tolist()), Fraction(0)) != _volume(box.tolist()):
        raise AssertionError("the cells do not cover the box")
    bounds = quantities.over_all(merged) if covered and merged is not None else quantities.nothing()
    verdict = "refuted" if refuting is not None else "proved" if covered else "undecided"
    return BoxProof(verdict, bounds, cells, merged, left, refuting, tried, time.monotonic() - began, equations, prover)


class _Quantities:
    """The quantities that a proof bounds: those of signals, stop time and stop distance."""

    def __init__(self, signals: Sequence[str]):
        self.signals = tuple(signals)

    def names(self) -> list[str]:
        return [
            *(f"{word} {name}" for name in self.signals for word in ("greatest", "least")),
            "stop_time",
            "stop_distance",
        ]

    def of_cells(self, found: Cells, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return, for each cell, proved lower and upper bounds of a quantity of all its runs."""
        if " " not in name:
            both = found.time if name == "stop_time" else found.distance
            return both[:, 0], both[:, 1]
        word, signal = name.split()
        i = self.signals.index(signal)
        if word == "greatest":
            return found.above[:, i], found.greatest[:, i]
        return found.least[:, i], found.below[:, i]

    def over_all(self, found: Cells) -> dict[str, tuple[float, float]]:
        pairs = {name: self.of_cells(found, name) for name in self.names()}
        return {name: (float(low.min()), float(high.max())) for name, (low, high) in pairs.items()}

    def nothing(self) -> dict[str, tuple[float, float]]:
        return dict.fromkeys(self.names(), (-math.inf, math.inf))


def _ended(found: Cells) -> np.ndarray:
    return found.status > 0


def _satisfied(quantities: _Quantities, claims: Sequence[Claim], found: Cells) -> np.ndarray:
    """Return the cells in which every run satisfies all claims."""
    fine = np.ones(len(found.status), bool)
    for claim in claims:
        low, high = quantities.of_cells(found, claim.quantity)
        fine &= low >= claim.bound if claim.quantity.startswith("least") else high <= claim.bound
    return fine


def _violated(quantities: _Quantities, claims: Sequence[Claim], cells: np.ndarray, found: Cells) -> np.ndarray | None:
    """Return a cell in which every run violates a claim, or None."""
    for claim in claims:
        low, high = quantities.of_cells(found, claim.quantity)
        wrong = high < claim.bound if claim.quantity.startswith("least") else low > claim.bound
        # A stop is proved only for a cell that ended. A signal went above its value even if the proof broke off later.
        wrong = wrong & (found.status == 1) if " " not in claim.quantity else wrong
        if wrong.any():
            return cells[np.flatnonzero(wrong)[0]]
    return None


def _select(found: Cells, which: np.ndarray) -> Cells:
    return Cells(*(column[which] for column in found))


def _halve(cells: np.ndarray, reach: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return the halves of cells.

    A cell is halved along a parameter that moves its first signal much, or that has not been halved often.
    """
    if not len(cells):
        return cells
    widths = cells[:, :, 1] - cells[:, :, 0]
    shares = widths / np.where(sides > 0, sides, 1.0)
    moves = np.where(np.isfinite(reach), reach, 0.0)
    score = sum(x / np.maximum(x.max(1, keepdims=True), 1e-300) for x in (shares, moves))
    side = np.where(widths > 0, score, -1.0).argmax(1)
    rows = np.arange(len(cells))
    middle = 0.5 * (cells[rows, side, 0] + cells[rows, side, 1])
    left, right = cells.copy(), cells.copy()
    left[rows, side, 1] = right[rows, side, 0] = middle
    return np.concatenate([left, right])


def _volume(cell: Any) -> Fraction:
    """Return the product of the widths that are not 0, exactly."""
    widths = (Fraction(high) - Fraction(low) for low, high in cell)
    return math.prod((w for w in widths if w), start=Fraction(1))


def _refine(
    prover: Prover, quantities: _Quantities, cells: np.ndarray, rows: Cells, sides: np.ndarray,
    known: Mapping[str, float], until: float, progress: Callable[[str], None], threads: int | None,
) -> tuple[np.ndarray, Cells, int]:  # fmt: skip
    """Halve the cells whose upper bound is far from the worst run found, until the time is over."""
    tried = 0
    while time.monotonic() < until:
        worst = np.zeros(len(cells), bool)
        for name, value in known.items():
            high = quantities.of_cells(rows, name)[1]
            far = high > value + CLOSE * abs(value)
            order = np.argsort(high)[::-1][: BATCH // 2]
            worst[order[far[order]]] = True
        if not worst.any():
            break
        halves = _halve(cells[worst], rows.reach[worst], sides)
        found = prover.prove(halves, threads)
        tried += len(halves)
        n = int(worst.sum())
        better = (found.status[:n] > 0) & (found.status[n:] > 0)
        keep = ~worst
        keep[np.flatnonzero(worst)[~better]] = True
        new = np.concatenate([better, better])
        if not new.any():
            break
        cells = np.concatenate([cells[keep], halves[new]])
        rows = Cells(*(np.concatenate([a[keep], b[new]]) for a, b in zip(rows, found, strict=True)))
        progress(f"{len(cells):,} cells proved, refining the worst")
    return cells, rows, tried
