"""The verification of a proof's file: coverage by halving, and a sample of the cells by the checker.

A file is text that anybody can edit, so only statements that are proved again here count. They are the
list `statements` of `FileVerdict`: about the loop and the duration of the scenario in the file, and over its box.
"""

import math
import multiprocessing
import random
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from diffabs.core.renamed import refuse_old_names
from diffabs.core.types import JsonObject, Table
from diffabs.host.values import format_given
from diffabs.loop.closed_loop import Loop
from diffabs.robust.reach.certificate import FORMAT, proved_ends
from diffabs.robust.reach.cover import RunClaim, check_box, comes_from_halving, name_contradiction
from diffabs.robust.reach.equations import Equations, RealOperation, derive_equations
from diffabs.robust.reach.tail import RunTail, TailPiece, equations_from

SAMPLED_STEPS = 2  # steps of the checker between two ticks
PACED_STEP, STEPS = 4e-4, 500  # length in eta [s^2/m] of a paced loop; number of steps of other continuous loops
CELL_HALVINGS = 3  # of a cell whose bounds by the checker are too wide

Cell = list[list[float]]


class PlacedCell(NamedTuple):
    """A cell to check.

    Attributes:
        piece: Number of the piece of the tail that it belongs to; None for a cell of the box.
        ends: Ends of each parameter; in the tail the speed [m/s] comes last.
    """

    piece: int | None
    ends: Cell


Bounds = dict[str, tuple[float | None, float | None]]


class FileVerdict(NamedTuple):
    """Findings of the checker about a file.

    Attributes:
        checked: Number of cells that were proved again.
        cells: Number of cells in the file.
        reason: Why the file is not verified, empty if it is.
        statements: Statements of the file about every run of the box, such as `greatest slip <= 0.33`.
    """

    checked: int
    cells: int
    reason: str
    statements: tuple[str, ...]


class ProofFile(NamedTuple):
    """The content of a proof's file.

    Attributes:
        over: Range (low, high) of each parameter of the box, by path, in SI units.
        cells: Ends of each parameter, one row for each cell, shape (cells, parameters, 2).
        claims: Claims of the proof.
        bounds: Proved ends (low, high) of each quantity; None where the file states nothing.
        horizon: Duration after which a run was no longer followed [s].
        tail: Settled states in which cells may end; None without any.
    """

    over: dict[str, tuple[float, float]]
    cells: list[Cell]
    claims: tuple[RunClaim, ...]
    bounds: Bounds
    horizon: float
    tail: RunTail | None

    @property
    def pieces(self) -> tuple[TailPiece, ...]:
        """The pieces of the tail."""
        return () if self.tail is None else self.tail.pieces

    @property
    def signals(self) -> list[str]:
        """The signals that the file bounds."""
        return list(dict.fromkeys(name.partition(" ")[2] for name in self.bounds if " " in name))

    @property
    def statements(self) -> tuple[str, ...]:
        """What the file states of every run of the box: its claims, then its bounds, with all digits."""
        claims = (f"{x.quantity} {'>=' if x.quantity.startswith('least') else '<='} {x.bound!r}" for x in self.claims)
        bounds = (
            f"{name} {sign} {end!r}"
            for name, ends in self.bounds.items()
            for sign, end in zip((">=", "<="), ends, strict=True)
            if end is not None
        )
        return (*claims, *bounds)


def read_proof(document: JsonObject) -> ProofFile:
    """Return the content of a proof's file; every number is finite, and every quantity is one that a proof bounds."""
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f'not a proof\'s file: its "format" is not {FORMAT!r}')
    if document.get("verdict") != "proved":
        raise ValueError(f"nothing to verify: the file's verdict is {document.get('verdict')}, not proved")
    pair = "a pair [low, high] of finite numbers"
    over = _read_entries(document, "over", dict, lambda ends: tuple(_pair(ends)), pair)
    check_box(over)
    cells = _read_entries(document, "cells", list, lambda cell: list(map(_pair, cell)), f"a list, each entry {pair},")
    claims = _read_entries(
        document, "claims", list, lambda x: RunClaim(str(x["quantity"]), _number(x["bound"])),
        '{"quantity": name, "bound": finite number}',
    )  # fmt: skip
    bounds = _read_entries(document, "bounds", dict, _open_pair, "a pair [low, high] of finite numbers or null")
    try:
        horizon = _number(document.get("horizon"))
    except (ValueError, OverflowError):
        raise ValueError(f"horizon = {format_given(document.get('horizon'))}; a finite number [s] is needed") from None
    if any(len(cell) != len(over) for cell in cells.values()):
        raise ValueError("not a proof's file: a cell has not one pair of numbers for each parameter of the box")
    for name, ends in bounds.items():
        for word, end, proved in zip(("low", "high"), ends, proved_ends(name), strict=True):
            if end is not None and not proved:
                raise ValueError(f"bounds: the checker proves no {word} end of {name}, and the file has {end:.9g}")
    for claim in claims.values():
        if claim.quantity not in bounds:
            raise ValueError(f"claims: {claim.quantity} has no bound in the file")
    tail = None if document.get("tail") is None else _read_tail(document, len(over))
    return ProofFile(over, list(cells.values()), tuple(claims.values()), bounds, horizon, tail)


def _read_tail(document: JsonObject, params: int) -> RunTail:
    """Return the tail of a proof's file, for a box of so many parameters."""
    table = document["tail"]
    if not isinstance(table, dict):
        raise ValueError(f"tail = {format_given(table)} is not a table")
    table = {f"tail.{name}": value for name, value in table.items()}
    states = tuple(_read_entries(table, "tail.states", list, str, "a name").values())

    def numbers(values: Sequence[object], count: int) -> tuple[float, ...]:
        if len(values) != count:
            raise ValueError("another number of numbers")
        return tuple(map(_number, values))

    def ranges(values: Table) -> dict[str, tuple[float, float]]:
        return {str(name): (ends[0], ends[1]) for name, ends in ((n, _pair(e)) for n, e in values.items())}

    def piece(entry: Table) -> TailPiece:
        n = len(states)
        if len(entry["by_param"]) != n:
            raise ValueError("another number of states")
        cells = [[_pair(ends) for ends in cell] for cell in entry["cells"]]
        if any(len(cell) != params + 1 for cell in cells):
            raise ValueError("a cell has not one pair for each parameter and the speed")
        tail_piece = TailPiece(
            low=_number(entry["low"]),
            high=_number(entry["high"]),
            centre=numbers(entry["centre"], n),
            by_speed=numbers(entry["by_speed"], n),
            by_param=tuple(numbers(row, params) for row in entry["by_param"]),
            width=numbers(entry["width"], n),
            later_states=ranges(entry["later_states"]),
            later_signals=ranges(entry["later_signals"]),
            cells=tuple(tuple((low, high) for low, high in cell) for cell in cells),
        )
        if not (0 < tail_piece.low < tail_piece.high and all(width >= 0 for width in tail_piece.width)):
            raise ValueError("its speeds are not positive and in order, or a width is negative")
        return tail_piece

    middle = tuple(_read_entries(table, "tail.middle", list, _number, "a finite number").values())
    pieces = tuple(_read_entries(table, "tail.pieces", list, piece, "a piece of the tail").values())
    if len(middle) != params:
        raise ValueError("tail.middle has not one number for each parameter of the box")
    return RunTail(states, middle, pieces)


def _read_entries(
    document: JsonObject, name: str, kind: type, read: Callable[[Any], Any], needed: str
) -> dict[Any, Any]:
    """Return each entry of a member as `read` returns it, by its key or index.

    Args:
        kind: Type of the member, dict or list.
        read: Function that returns the value of an entry, or raises an error if the entry is wrong.
        needed: What an entry has to be, in words.
    """
    member = document.get(name)
    if not isinstance(member, kind):
        word = "a table" if kind is dict else "a list"
        raise ValueError(f"{name} is missing" if member is None else f"{name} = {format_given(member)} is not {word}")
    entries = {}
    for key, entry in member.items() if isinstance(member, dict) else enumerate(member or ()):
        try:
            entries[key] = read(entry)
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
            raise ValueError(f"{name}.{key} = {format_given(entry)}; {needed} is needed") from None
    return entries


def _pair(pair: Sequence[object]) -> list[float]:
    low, high = pair
    return [_number(low), _number(high)]


def _open_pair(pair: Sequence[object]) -> tuple[float | None, float | None]:
    """Return a pair of finite numbers or None. Raises TypeError or ValueError for anything else."""
    low, high = pair
    return None if low is None else _number(low), None if high is None else _number(high)


def _number(number: object) -> float:
    if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
        raise ValueError(f"{number!r} is not a finite number")
    return float(number)


@refuse_old_names
def verify_box(
    loop: Loop,
    horizon: float,
    document: JsonObject,
    share: float = 0.01,
    *,
    suspects: Sequence[Sequence[float]] = (),
    extremes: Mapping[str, tuple[float, float]] | None = None,
    progress: Callable[[str], None] = lambda line: None,
    processes: int = 1,
) -> FileVerdict:
    """Prove a sample of the cells of a proof's file again, by code that shares only the equations with the prover.

    The cells of the suspects come first. The system's random numbers draw the others, so a file cannot choose them. A
    share of 1 proves the whole file.

    Args:
        horizon: Duration of the file's scenario [s].
        share: Share of the cells to check, in (0, 1]; at least one is checked.
        suspects: Points of the box whose runs may violate a bound, shape (points, parameters), in SI units.
        extremes: Least and greatest value of a quantity in simulated runs. A bound that such a run violates by more
            than 0.1 % is not verified.
        progress: Called with a line about how far the check is.
        processes: Number of processes that check cells at the same time. Several need a main module that can be
            imported, as always with `multiprocessing`.
    """
    if not 0 < share <= 1:
        raise ValueError(f"share = {share:g} is outside (0, 1]")
    file = read_proof(document)
    cells, over = file.cells, file.over
    bounds = {
        name: (-math.inf if low is None else low, math.inf if high is None else high)
        for name, (low, high) in file.bounds.items()
    }
    reason, checked = _find_contradiction(file, horizon) or name_contradiction(bounds, extremes or {}), 0
    if not reason:
        equations = derive_equations(loop, over)
        if unknown := [name for name in file.signals if name not in equations.signals]:
            raise ValueError(f"bounds: the loop has no signal {unknown[0]}")
        names = {
            *(() if file.tail is None else file.tail.states),
            *(name for x in file.pieces for name in x.later_states),
        }
        names -= {*equations.states}
        names |= {name for x in file.pieces for name in x.later_signals} - {*equations.signals}
        if names:
            raise ValueError(f"tail: the loop has no state or signal {min(names)}")
        check = partial(_check_cell, equations, file)
        tail_cells = [
            PlacedCell(k, [[*ends] for ends in cell]) for k, piece in enumerate(file.pieces) for cell in piece.cells
        ]
        sample = [PlacedCell(None, cells[i]) for i in _choose_cells(cells, share, suspects)]
        sample += [tail_cells[i] for i in _choose_cells(tail_cells, share, ())]
        for checked, (cell, why) in enumerate(_map_cells(check, sample, processes), 1):
            if why:
                where = "cell" if cell.piece is None else "cell of the tail"
                ends = zip([*over, "speed"], cell.ends, strict=False)
                text = ", ".join(f"{path} {low:.9g} to {high:.9g}" for path, (low, high) in ends)
                reason, checked = f"{where} {text}: {why}", checked - 1
                break
            progress(f"{checked} of {len(sample)} cells")
    return FileVerdict(checked, len(cells) + sum(len(piece.cells) for piece in file.pieces), reason, file.statements)


def _find_contradiction(file: ProofFile, horizon: float) -> str:
    """Return where a file contradicts itself or its scenario's duration [s], empty if it does not."""
    if file.horizon != horizon:
        return f"the file follows runs for {file.horizon:g} s, its scenario for {horizon:g} s"
    for claim in file.claims:
        low, high = file.bounds[claim.quantity]
        worst, is_lower = (low, True) if claim.quantity.startswith("least") else (high, False)
        if worst is None or (worst < claim.bound if is_lower else worst > claim.bound):
            return f"the file's bound {worst} of {claim.quantity} violates its claim"
    if not file.statements:
        return "the file states nothing"
    if not comes_from_halving(list(file.over.values()), file.cells):
        return "the cells do not cover the box: they do not come from halving it"
    return _find_gap(file)


def _find_gap(file: ProofFile) -> str:
    """Return why the pieces of a tail do not follow from their cells and from one another, empty if they do."""
    for k, piece in enumerate(file.pieces):
        box = [*map(list, file.over.values()), [piece.low, piece.high]]
        if not comes_from_halving(box, piece.cells):
            return f"the cells of piece {k} of the tail do not cover it"
        for later in ("later_states", "later_signals"):
            ranges, earlier = getattr(piece, later), getattr(file.pieces[max(k - 1, 0)], later)
            if ranges.keys() != earlier.keys() or any(
                low > earlier[name][0] or high < earlier[name][1] for name, (low, high) in ranges.items()
            ):
                return f"the ranges of piece {k} of the tail do not contain those of the piece before"
        if missing := [name for name in file.signals if name not in piece.later_signals]:
            return f"piece {k} of the tail has no range of {missing[0]}"
    return ""


def _choose_cells(cells: Sequence[Any], share: float, suspects: Sequence[Sequence[float]]) -> list[int]:
    """Return the indices of the cells with suspects, then of a random sample of all cells."""
    if not cells:
        return []
    holding = [
        i
        for point in suspects
        for i, cell in enumerate(cells)
        if all(low <= x <= high for x, (low, high) in zip(point, cell, strict=True))
    ]
    sample = random.SystemRandom().sample(range(len(cells)), max(1, math.ceil(share * len(cells))))
    return list(dict.fromkeys([*holding, *sample]))


def _map_cells(
    check: Callable[[PlacedCell], str], cells: Sequence[PlacedCell], processes: int
) -> Iterator[tuple[PlacedCell, str]]:
    """Yield each cell and the result of its check, in order; a cell whose process dies is not proved."""
    if min(processes, len(cells)) <= 1:
        yield from ((cell, check(cell)) for cell in cells)
        return
    # `spawn`: a process that has started threads, as JAX does, must not be forked. Pipes and not a `Pool`, whose
    # semaphores would outlive a command that Ctrl-C ends.
    context, readers, workers = multiprocessing.get_context("spawn"), [], []
    count = min(processes, len(cells))
    try:
        for k in range(count):
            reader, writer = context.Pipe(duplex=False)
            workers.append(context.Process(target=_send_results, args=(check, cells[k::count], writer), daemon=True))
            workers[-1].start()
            writer.close()
            readers.append(reader)
        for i, cell in enumerate(cells):
            try:
                why = readers[i % count].recv()
            except EOFError:
                why = "the process that checked it has ended"
            yield cell, why
    finally:
        for worker in workers:
            worker.kill()


def _send_results(check: Callable[[PlacedCell], str], cells: Sequence[PlacedCell], results: Connection) -> None:
    """Send the result of each check. Ctrl-C does not end this process: the parent does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for cell in cells:
        results.send(check(cell))


def _check_cell(equations: Equations, file: ProofFile, cell: PlacedCell) -> str:
    """Return why the checker does not prove the file's bounds in a cell of the file, empty if it does."""
    if cell.piece is None or file.tail is None:
        return _check(equations, file, file.bounds, file.tail, None, cell.ends, _choose_sides(file.over, cell.ends))
    piece, slip = file.pieces[cell.piece], [equations.states[i] for i in equations.nonnegative]
    used = {name for i, name in enumerate(equations.states) if RealOperation("state", (), i) in equations.operations}
    if unknown := sorted({*file.tail.states, *piece.later_states} - used):
        return f"the runs have no state {unknown[0]}"
    shown = [name for name in piece.later_states if name not in equations.signals]
    if len(shown) < len(piece.later_states) or equations.speed < 0 or not slip:
        return "a state of the tail has the name of a signal, or the loop has no slip"
    runs = equations_from(equations, file.tail, piece, shown)
    ends = {**piece.later_signals, **piece.later_states}
    stated: Bounds = {f"least {name}": (low, None) for name, (low, _) in ends.items()}
    stated |= {f"greatest {name}": (None, high) for name, (_, high) in ends.items()}
    across = [[-1.0, 1.0]] * len(file.tail.states)
    box = {**file.over, "speed": (piece.low, piece.high)}
    sides = _choose_sides(box, cell.ends)
    entries = file.tail.without_signals(cell.piece, ends)
    return _check(runs, file, stated, entries, math.inf, [*cell.ends, *across], sides)


def _choose_sides(over: Mapping[str, tuple[float, float]], cell: Cell) -> list[int]:
    """Return the parameters along which the checker halves a cell, one after the other.

    Parameters that the prover has halved most often come first: they move the runs most.
    """
    shares = [
        (high - low) / (b - a) if low < high else 0.0 for (low, high), (a, b) in zip(cell, over.values(), strict=True)
    ]
    order = sorted((i for i, share in enumerate(shares) if share > 0), key=lambda i: shares[i])
    return (order * CELL_HALVINGS)[:CELL_HALVINGS]


def _check(
    equations: Equations, file: ProofFile, stated: Bounds, tail: RunTail | None, latest: float | None,
    cell: Cell, sides: Sequence[int],
) -> str:  # fmt: skip
    """Return why the checker does not prove stated bounds in a cell, empty if it does.

    A cell in which it fails is halved along the first of `sides`: its bounds of a smaller cell are narrower.
    """
    from diffabs.robust.reach.checker import NotProved, check_cell

    steps = SAMPLED_STEPS if equations.period is not None else [PACED_STEP if equations.paced else file.horizon / STEPS]
    signals = list(dict.fromkeys(name.partition(" ")[2] for name in stated if " " in name))
    try:
        proved = check_cell(
            equations, signals, [(low, high) for low, high in cell], steps, file.horizon, tail=tail, latest=latest
        )
    except NotProved as error:
        reason = f"not proved: {error}"
    else:
        reason = _compare(
            stated,
            {
                **{f"greatest {name}": (None, x) for name, x in proved.upper.items()},
                **{f"least {name}": (x, None) for name, x in proved.lower.items()},
                "stop_time": proved.stop_time,
                "stop_distance": proved.distance,
            },
        )
        if reason and tail is not None and latest is None:  # followed to their stop, runs may have narrower bounds
            return _check(equations, file, stated, None, None, cell, sides)
    if not reason or not sides:
        return reason
    side = sides[0]
    low, high = cell[side]
    middle = 0.5 * (low + high)
    halves = ([*cell[:side], ends, *cell[side + 1 :]] for ends in ([low, middle], [middle, high]))
    return next((why for half in halves if (why := _check(equations, file, stated, tail, latest, half, sides[1:]))), "")


def _compare(stated: Bounds, proved: Mapping[str, tuple[float | None, float | None]]) -> str:
    """Return a stated end that the proved ends do not imply, empty if they prove all; NaN proves nothing."""
    for name, (low, high) in stated.items():
        proved_low, proved_high = proved[name]
        if high is not None and not (proved_high is not None and proved_high <= high):
            return f"{name} up to {proved_high:.9g}, in the file {high:.9g}"
        if low is not None and not (proved_low is not None and proved_low >= low):
            return f"{name} from {proved_low:.9g}, in the file {low:.9g}"
    return ""
