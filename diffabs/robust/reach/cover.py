"""Proofs over a box: cells of parameters cover it. A cell that fails, or bounds too little, is halved.

    proved     every cell of the cover satisfies the claim
    refuted    in one cell every run violates it; a cell may be a single run
    undecided  neither within the budget

Cells come from halving, and `comes_from_halving` shows that they cover the box.
"""

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffabs.core.jax_flags import default_flags
from diffabs.core.renamed import refuse_old_names
from diffabs.core.types import PyTree
from diffabs.loop.closed_loop import Loop
from diffabs.robust.reach.engine import FAILURES, CellBounds, Prover
from diffabs.robust.reach.equations import LARGEST_INPUT, Equations, derive_equations
from diffabs.robust.reach.search_tail import find_tail
from diffabs.robust.reach.tail import RunTail

BATCH = 64  # cells between two looks at the clock
LARGER, LARGER_TRIED = 1.5, 4  # size of a cell to try, in those proved just before; number that may be larger
SMALLEST = 2.0**-40  # of the box's side: a smaller cell is not halved again
FEWEST = 4  # a side that is not wider than so many floats is not halved: its middle must lie between its ends
PROBE_SIZES = (1e-3, 1e-4, 1e-5)  # sizes of the cell that shows how much each parameter matters, in sides of the box
SPEED_COST = 3.0
CURVE_BITS = 12  # of a place on Morton's curve, for each parameter
CLOSE = 5e-4  # a bound is refined while it is farther than this from the worst run found, relative
MANY = 256  # cells tried, after which a proof of the tail is worth its time
TAIL_WIDTH, NARROW_TAIL_WIDTH = 2e-3, 3e-4  # half widths of the tail in the slip; the second where the stop counts
RUN_ERROR = 1e-3  # of a value found in a run, relative: a run farther beyond a proved bound contradicts it

Box = dict[str, tuple[float, float]]


class RunClaim(NamedTuple):
    """A statement about all runs of a box.

    Attributes:
        quantity: `greatest NAME` or `least NAME` of a signal, `stop_time` or `stop_distance`.
        bound: The quantity is at most this; of `least NAME`, at least.
    """

    quantity: str
    bound: float

    def __str__(self) -> str:
        """Return the claim in words, with every digit of its bound."""
        return f"{self.quantity} {'>=' if self.quantity.startswith('least') else '<='} {self.bound!r}"


class BoxProof(NamedTuple):
    """Bounds and verdicts proved about a box.

    Attributes:
        verdict: proved, refuted or undecided.
        bounds: Proved range (low, high) of each quantity over the box; infinite ends where nothing is proved.
        cells: Cells that are proved, shape (cells, parameters, 2).
        rows: Bounds of these cells.
        undecided: Cells that are not, shape (cells, parameters, 2).
        refuting: Cell that refutes a claim, or None.
        failure: Why most of the last cells that failed did, or an empty text.
        tried: Number of cells that were tried.
        seconds: Computing time [s].
        equations: Equations of the loop.
        prover: Native prover with its settings.
        tail: Settled states, from which the rest of all runs is proved once; None if no cell ends there.
    """

    verdict: str
    bounds: dict[str, tuple[float, float]]
    cells: np.ndarray
    rows: CellBounds | None
    undecided: np.ndarray
    refuting: np.ndarray | None
    failure: str
    tried: int
    seconds: float
    equations: Equations
    prover: Prover
    tail: RunTail | None


@default_flags()
@refuse_old_names
def cover_box(
    loop: Loop,
    over: Mapping[str, tuple[float, float]],
    claims: Sequence[RunClaim] = (),
    *,
    signals: Sequence[str] = (),
    horizon: float = 10.0,
    budget: float = 60.0,
    extremes: Mapping[str, tuple[float, float]] | None = None,
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
        extremes: Least and greatest value of a quantity in runs that were found: bounds are not refined beyond them. A
            bound that such a run violates by more than 0.1 % proves nothing: either it or the run is wrong.
        suspects: Points of the box whose runs may violate a claim; each is tried first, as a cell of one run.
        progress: Called with a line about how far the proof is.
        threads: Number of threads; None for one for each core.

    Raises:
        ValueError: A number is out of its range, a claim is about no quantity of the loop, or a signal does not exist.
        NoRule: A part, an operation or a parameter of the loop has no sound rule.
        NoCompiler: No C++ compiler of this machine works.

    See also:
        `tune.worst_case`: The worst run that a search finds, a bound from the other side.
        `design.certify`: Proofs about linear models.

    Notes:
        Cells of parameters cover the box. From each, a set of states is carried along the runs

            {c + G q + B r},   q: the cell's parameters,   r: errors, in a box

        by Taylor steps whose remainders and roundings are bounded, with B kept orthogonal. A cell that proves too
        little is halved. A claim is proved if every cell satisfies it, and refuted if all runs of one cell violate it.
        `docs/proofs.md` explains limits, sampling and the stop. Source: R. J. Lohner, Enclosing the solutions of
        ordinary initial and boundary value problems, in Computerarithmetic, Teubner, 1987.

    Examples:
        The published gain of a laboratory brake keeps the slip below 0.31 for all masses of 5.75 to 5.76 kg:

        >>> from diffabs.robust.reach import RunClaim, cover_box
        >>> from diffabs.scenario import load
        >>> loop = load("slip-lmi").loop
        >>> proof = cover_box(loop, {"plant.mass": (5.75, 5.76)}, [RunClaim("greatest slip", 0.31)], horizon=2.0)
        >>> proof.verdict, proof.bounds["greatest slip"][1] <= 0.31
        ('proved', True)
    """
    began = time.monotonic()
    for name, value in (("horizon", horizon), ("budget", budget)):
        if not 0 < value < math.inf:
            raise ValueError(f"{name} = {value:g} is outside (0, inf) s")
    check_box(over)
    paths = tuple(over)
    equations = derive_equations(loop, paths)
    if unknown := [name for name in signals if name not in equations.signals]:
        raise ValueError(f"signals: {unknown[0]!r} is no signal of this loop; there is {', '.join(equations.signals)}")
    _check_claims(claims, equations.signals)
    names = tuple(dict.fromkeys([*signals, *(c.quantity.split()[1] for c in claims if " " in c.quantity)]))
    prover = Prover(equations, names, horizon)
    box = np.array([over[path] for path in paths], float)
    fastest = [high if path == "initial.speed" else (low + high) / 2 for path, (low, high) in over.items()]
    prover.choose_weights(np.array(fastest))
    influence = _measure_influence(prover, box, np.array(fastest), threads)
    smallest = np.maximum(SMALLEST * (box[:, 1] - box[:, 0]), FEWEST * np.spacing(np.abs(box).max(1)))
    quantities = _Quantities(prover.signals)
    unproved, proved, rows, refuting, tried, fitting, failure = box[None], [], [], None, 0, math.inf, ""
    suspects = [point for point in suspects if ((box[:, 0] <= point) & (point <= box[:, 1])).all()]
    if suspects:
        points = np.repeat(np.asarray(suspects, float)[:, :, None], 2, 2)
        refuting = _find_violation(quantities, claims, points, prover.prove(points, threads))
    alone = prover.prove(np.repeat(np.array(fastest)[None, :, None], 2, 2), threads)
    hopeless = not alone.status[0]  # a cell that contains this run is not proved either
    if hopeless:
        failure = f"even one run is not proved: {FAILURES[int(alone.failure[0])]}"
    tail, sought = None, False
    while len(unproved) and refuting is None and not hopeless and time.monotonic() - began < budget:
        if tried >= MANY and not sought:
            sought, tail = True, _find_tail(prover, over, claims, extremes or {}, began + budget, threads)
            prover.use_tail(tail)
        unproved = unproved[_order_neighbours(box, unproved)]
        now, unproved = unproved[:BATCH], unproved[BATCH:]
        now, postponed = _cut_to_size(now, fitting * LARGER, influence, smallest)
        unproved = np.concatenate([unproved, postponed])
        cell_bounds = prover.prove(now, threads)
        if tail is not None:
            cell_bounds = _follow_to_stop(prover, quantities, claims, now, cell_bounds, tail, threads)
        tried += len(now)
        refuting = _find_violation(quantities, claims, now, cell_bounds)
        satisfied = (cell_bounds.status > 0) & _satisfy(quantities, claims, cell_bounds)
        fitting = float(_sizes(now[satisfied]).max()) if satisfied.any() else fitting
        proved.append(now[satisfied])
        rows.append([column[satisfied] for column in cell_bounds])
        failed = cell_bounds.failure[~satisfied]
        failure = FAILURES[int(np.bincount(failed[failed > 0]).argmax())] if (failed > 0).any() else ""
        matters = _widths(now) * influence
        for claim in claims:
            vague = (cell_bounds.status > 0) & ~_satisfy(quantities, [claim], cell_bounds)
            matters[vague] = quantities.weigh_sides(claim.quantity, cell_bounds, _widths(now) * influence)[vague]
        again = now[~satisfied]
        # A side that is too short is not halved, however much it matters.
        matters = np.where(_widths(now) > smallest, matters, -1.0)[~satisfied]
        small = (matters < 0).all(1)
        unproved = np.concatenate([unproved, again[small], _halve(again[~small], matters[~small])])
        if small.any():
            break
        progress(f"{sum(map(len, proved)):,} cells proved, {len(unproved):,} left")
    cells = np.concatenate(proved) if proved else np.empty((0, *box.shape))
    merged = CellBounds(*(np.concatenate(columns) for columns in zip(*rows, strict=True))) if rows else None
    if not claims and not len(unproved) and merged is not None:
        cells, merged, more = _refine(
            *(prover, quantities, cells, merged, influence, smallest, extremes or {}),
            *(began + budget, progress, threads),
        )
        tried += more
    covered = not len(unproved) and merged is not None
    if covered and not comes_from_halving(box.tolist(), cells.tolist()):
        raise AssertionError("the cells do not cover the box")
    bounds = quantities.over_all(merged) if covered and merged is not None else quantities.unbounded
    verdict = "refuted" if refuting is not None else "proved" if covered else "undecided"
    if verdict == "proved" and not claims and (nothing := quantities.name_unbounded(bounds)):
        verdict, failure = "undecided", nothing
    if verdict == "proved" and (contradiction := name_contradiction(bounds, extremes or {})):
        verdict, failure, bounds = "undecided", contradiction, quantities.unbounded
    return BoxProof(
        *(verdict, bounds, cells, merged, unproved, refuting, failure if verdict == "undecided" else "", tried),
        *(time.monotonic() - began, equations, prover, tail),
    )


def _follow_to_stop(
    prover: Prover, quantities: "_Quantities", claims: Sequence[RunClaim], cells: np.ndarray, cell_bounds: CellBounds,
    tail: RunTail, threads: int | None,
) -> CellBounds:  # fmt: skip
    """Return the bounds of cells; those that miss a claim about the stop are proved again without the tail.

    The tail has one range of the deceleration for all parameters, so its bounds of the stop are wider.
    """
    stops = [claim for claim in claims if " " not in claim.quantity]
    vague = np.flatnonzero((cell_bounds.status > 0) & ~_satisfy(quantities, stops, cell_bounds))
    if not len(vague):
        return cell_bounds
    prover.use_tail(None)
    again = prover.prove(cells[vague], threads)
    prover.use_tail(tail)
    better = again.status > 0
    for column, replacement in zip(cell_bounds, again, strict=True):
        column[vague[better]] = replacement[better]
    return cell_bounds


def _find_tail(
    prover: Prover, over: Mapping[str, tuple[float, float]], claims: Sequence[RunClaim],
    extremes: Mapping[str, tuple[float, float]], until: float, threads: int | None,
) -> RunTail | None:  # fmt: skip
    """Return a tail of the runs in which all claims hold, or None."""
    bounds = [claim.bound for claim in claims if claim.quantity == "greatest slip"]
    greatest = min(bounds, default=extremes.get("greatest slip", (0.0, math.inf))[1])
    stops = not claims or any(" " not in claim.quantity for claim in claims)
    width = NARROW_TAIL_WIDTH if stops else TAIL_WIDTH
    tail = find_tail(prover, over, width, greatest, until=until, threads=threads)
    if tail is None:
        return None
    for claim in claims:
        word, _, name = claim.quantity.partition(" ")
        low, high = tail.pieces[-1].later_signals.get(name, (-math.inf, math.inf))
        if name and not (low >= claim.bound if word == "least" else high <= claim.bound):
            return None
    return tail


class _Quantities:
    """The quantities that a proof bounds: those of signals, stop time and stop distance."""

    def __init__(self, signals: Sequence[str]):
        self.signals = tuple(signals)

    def names(self) -> list[str]:
        pairs = (f"{word} {name}" for name in self.signals for word in ("greatest", "least"))
        return [*pairs, "stop_time", "stop_distance"]

    def of_cells(self, cell_bounds: CellBounds, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return, for each cell, proved lower and upper bounds of a quantity of all its runs."""
        if " " not in name:
            both = cell_bounds.time if name == "stop_time" else cell_bounds.distance
            return both[:, 0], both[:, 1]
        word, signal = name.split()
        i = self.signals.index(signal)
        if word == "greatest":
            return cell_bounds.above[:, i], cell_bounds.upper[:, i]
        return cell_bounds.lower[:, i], cell_bounds.below[:, i]

    def weigh_sides(self, name: str, cell_bounds: CellBounds, otherwise: np.ndarray) -> np.ndarray:
        """Return about how much each side of a cell widens its bounds of a quantity, shape (cells, sides).

        If no side does, return the row of `otherwise`.
        """
        influence = cell_bounds.reach[:, ("stop_time", "stop_distance").index(name) + 1 if " " not in name else 0]
        return np.where((influence > 0).any(1, keepdims=True), influence, otherwise)

    def over_all(self, cell_bounds: CellBounds) -> dict[str, tuple[float, float]]:
        pairs = {name: self.of_cells(cell_bounds, name) for name in self.names()}
        return {name: (float(low.min()), float(high.max())) for name, (low, high) in pairs.items()}

    def name_unbounded(self, bounds: Mapping[str, tuple[float, float]]) -> str:
        """Return in words that a proof without claims says nothing about a signal, or nothing at all; else empty."""
        signals = [name for name in self.names() if " " in name]
        if infinite := [name for name in signals if not all(map(math.isfinite, bounds[name]))]:
            return f"no bound of the {infinite[0]} is proved"
        times = [bounds[name][1] for name in ("stop_time", "stop_distance")]
        return "" if signals or any(map(math.isfinite, times)) else "no bound is proved, and nothing is claimed"

    @property
    def unbounded(self) -> dict[str, tuple[float, float]]:
        return dict.fromkeys(self.names(), (-math.inf, math.inf))


def _check_claims(claims: Sequence[RunClaim], signals: Collection[str]) -> None:
    """Raise a ValueError unless each claim is about one of these signals, the stop time or distance, with a bound."""
    quantities = _Quantities(tuple(signals)).names()
    for claim in claims:
        if claim.quantity not in quantities:
            names = f"stop_time, stop_distance, and greatest NAME or least NAME of a signal: {', '.join(signals)}"
            raise ValueError(f"claims: {claim.quantity!r} is no quantity of this loop; there is {names}")
        if not math.isfinite(claim.bound):
            raise ValueError(f"claims: {claim.quantity} has the bound {claim.bound:g}, outside (-inf, inf)")


def _satisfy(quantities: _Quantities, claims: Sequence[RunClaim], cell_bounds: CellBounds) -> np.ndarray:
    """Return the cells in which every run satisfies all claims."""
    satisfied = np.ones(len(cell_bounds.status), bool)
    for claim in claims:
        low, high = quantities.of_cells(cell_bounds, claim.quantity)
        satisfied &= low >= claim.bound if claim.quantity.startswith("least") else high <= claim.bound
    return satisfied


def _find_violation(
    quantities: _Quantities, claims: Sequence[RunClaim], cells: np.ndarray, cell_bounds: CellBounds
) -> np.ndarray | None:
    """Return a cell in which every run violates a claim, or None."""
    for claim in claims:
        low, high = quantities.of_cells(cell_bounds, claim.quantity)
        wrong = high < claim.bound if claim.quantity.startswith("least") else low > claim.bound
        # A stop needs a cell that ended. A signal went above its value even if the proof broke off later.
        wrong = wrong & (cell_bounds.status == 1) if " " not in claim.quantity else wrong
        if wrong.any():
            return cells[np.flatnonzero(wrong)[0]]
    return None


def name_contradiction(bounds: Mapping[str, tuple[float, float]], extremes: Mapping[str, tuple[float, float]]) -> str:
    """Return in words the first bound that a run violates by more than the errors of runs, empty without any.

    `extremes` has the least and greatest value of quantities in simulated runs.
    """
    for name, (smallest, greatest) in extremes.items():
        low, high = bounds.get(name, (-math.inf, math.inf))
        for run, bound, beyond in ((smallest, low, low - smallest), (greatest, high, greatest - high)):
            if beyond > RUN_ERROR * abs(run):
                return f"a simulated run has {name} = {run:.6g}, beyond the bound {bound:.6g}: one of the two is wrong"
    return ""


def _measure_influence(prover: Prover, box: np.ndarray, point: np.ndarray, threads: int | None) -> np.ndarray:
    """Return how much a unit of each parameter moves the slip, else state 0, in the runs near a point of the box.

    A cell that is not proved is halved along the side that moves it most. A wrong choice costs time, and no more.
    """
    sides = box[:, 1] - box[:, 0]
    for share in PROBE_SIZES:
        cell = np.stack([np.maximum(point - share * sides, box[:, 0]), point], 1)
        cell_bounds = prover.prove(cell[None], threads)
        if cell_bounds.status[0] and (cell_bounds.reach[0, 0] > 0).any():
            widths = cell[:, 1] - cell[:, 0]
            influence = cell_bounds.reach[0, 0] / np.where(widths > 0, widths, 1.0)
            break
    else:
        influence = 1 / np.where(sides > 0, sides, 1.0)
    if prover.equations.speed >= 0 and not prover.equations.paced and "initial.speed" in prover.equations.params:
        # The rates of a sampled loop go with 1/v, so a range of speeds costs more than the slip alone shows.
        influence[prover.equations.params.index("initial.speed")] *= SPEED_COST
    return np.maximum(influence, 1e-3 * (influence * sides).max() / np.where(sides > 0, sides, 1.0))


def _halve(cells: np.ndarray, matters: np.ndarray) -> np.ndarray:
    """Return the halves of cells, each along the side that matters most; `matters` has the shape (cells, sides)."""
    side = matters.argmax(1)
    rows = np.arange(len(cells))
    middle = 0.5 * (cells[rows, side, 0] + cells[rows, side, 1])
    lower, upper = cells.copy(), cells.copy()
    lower[rows, side, 1] = upper[rows, side, 0] = middle
    return np.concatenate([lower, upper])


def _order_neighbours(box: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the indices of cells along Morton's curve, so that cells of one group are near each other on every side.

    The lanes of a group share the lengths of their steps, which limits shorten at other times in other cells.
    """
    bits = min(CURVE_BITS, 62 // len(box))
    sides = np.where(box[:, 1] > box[:, 0], box[:, 1] - box[:, 0], 1.0)
    places = ((cells[:, :, 0] - box[:, 0]) / sides * (2**bits - 1)).astype(np.int64)
    key = np.zeros(len(cells), np.int64)
    for bit in range(bits - 1, -1, -1):
        for place in places.T:
            key = key * 2 + (place >> bit & 1)
    return np.argsort(key, kind="stable")


def _widths(cells: np.ndarray) -> np.ndarray:
    return cells[:, :, 1] - cells[:, :, 0]


def _sizes(cells: np.ndarray) -> np.ndarray:
    """Return the volumes of cells in floats; sides of length 0 count as 1."""
    return np.where(_widths(cells) > 0, _widths(cells), 1.0).prod(1)


def _cut_to_size(
    cells: np.ndarray, largest: float, influence: np.ndarray, smallest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return at most a batch of cells to try, and the others.

    A cell that is larger than `largest` is halved untried, as its neighbours of that size could not be proved. A few
    stay as they are: if they are proved, larger cells are tried again.
    """
    uncut, cells = cells[:LARGER_TRIED], cells[LARGER_TRIED:]
    while len(cells) < 4 * BATCH:
        matters = np.where(_widths(cells) > smallest, _widths(cells) * influence, 0.0)
        wide = (_sizes(cells) > largest) & (matters > 0).any(1)
        if not wide.any():
            break
        cells = np.concatenate([cells[~wide], _halve(cells[wide], matters[wide])])
    cells = np.concatenate([uncut, cells])
    return cells[:BATCH], cells[BATCH:]


def check_box(over: Mapping[str, tuple[float, float]]) -> None:
    """Check that a box has a parameter, and that the ends of each are below `LARGEST_INPUT` and in order."""
    if not over:
        raise ValueError("over: the box has no parameter")
    for path, (low, high) in over.items():
        if not -LARGEST_INPUT < low <= high < LARGEST_INPUT:
            raise ValueError(
                f"over.{path} = [{low:.9g}, {high:.9g}]; two numbers below {LARGEST_INPUT:g} are needed, the lower "
                "first"
            )


def comes_from_halving(box: Sequence[Sequence[float]], cells: Sequence[PyTree]) -> bool:
    """Return whether the cells are the leaves of a tree of halvings of the box.

    Then they cover it. A leaf is exactly its part of the box, and the parts of a halving have the whole as their union.
    """
    parts = [(list(map(list, box)), cells)]
    while parts:
        part, inside = parts.pop()
        if len(inside) == 1 and list(map(list, inside[0])) == part:
            continue
        for i, (low, high) in enumerate(part):
            middle = 0.5 * (low + high)
            below = [cell for cell in inside if cell[i][1] <= middle]
            above = [cell for cell in inside if cell[i][0] >= middle]
            if below and above and len(below) + len(above) == len(inside):
                # No other halving need be tried: the cells of a tree that lie in one half are a tree of that half.
                halves = ([low, middle], below), ([middle, high], above)
                parts += [([*part[:i], ends, *part[i + 1 :]], some) for ends, some in halves]
                break
        else:
            return False
    return True


def _refine(
    prover: Prover, quantities: _Quantities, cells: np.ndarray, rows: CellBounds,
    influence: np.ndarray, smallest: np.ndarray, extremes: Mapping[str, tuple[float, float]],
    until: float, progress: Callable[[str], None], threads: int | None,
) -> tuple[np.ndarray, CellBounds, int]:  # fmt: skip
    """Halve the cells whose bounds are far from the least and the greatest value found, until the time is over."""
    tried = 0
    while time.monotonic() < until:
        matters = np.zeros(cells.shape[:2])
        for name, (lowest, greatest) in extremes.items():
            low, high = quantities.of_cells(rows, name)
            for excess, size in ((high - greatest, abs(greatest)), (lowest - low, abs(lowest))):
                order = np.argsort(excess)[::-1][: BATCH // 2]
                loose = order[excess[order] > CLOSE * size]
                matters[loose] = quantities.weigh_sides(name, rows, _widths(cells) * influence)[loose]
        matters[_widths(cells) <= smallest] = 0.0
        worst = np.any(matters > 0, axis=1)
        if not worst.any():
            break
        halves = _halve(cells[worst], matters[worst])
        cell_bounds = prover.prove(halves, threads)
        tried += len(halves)
        n = int(worst.sum())
        better = (cell_bounds.status[:n] > 0) & (cell_bounds.status[n:] > 0)
        keep = np.logical_not(worst)
        keep[np.flatnonzero(worst)[~better]] = True
        new = np.concatenate([better, better])
        if not new.any():
            break
        cells = np.concatenate([cells[keep], halves[new]])
        rows = CellBounds(*(np.concatenate([a[keep], b[new]]) for a, b in zip(rows, cell_bounds, strict=True)))
        progress(f"{len(cells):,} cells proved, refining the worst")
    return cells, rows, tried
