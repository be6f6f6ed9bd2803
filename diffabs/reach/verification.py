"""The verification of a proof's file: coverage in fractions, and a sample of the cells by the checker."""

import math
import random
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple

from diffabs.core.loop import Loop
from diffabs.core.types import JsonObject
from diffabs.reach.certificate import FORMAT
from diffabs.reach.equations import Equations, derive_equations

SAMPLED_STEPS = 2  # steps of the checker between two ticks
PACED_STEP, STEPS = 2e-4, 500  # length in eta [s^2/m]; number of steps of another continuous loop
CELL_HALVINGS = 3  # of a cell whose bounds by the checker are too wide
ALLOWED = 1e-3  # a bound of the file may be this much below the checker's, relative: both are upper bounds


class FileVerdict(NamedTuple):
    """What the checker found about a file.

    Attributes:
        checked: Number of cells that were proved again.
        cells: Number of cells in the file.
        reason: Why the file is not verified, empty if it is.
    """

    checked: int
    cells: int
    reason: str


def verify_box(
    loop: Loop, document: JsonObject, share: float = 0.01, progress: Callable[[str], None] = lambda line: None
) -> FileVerdict:
    """Prove a sample of the cells of a proof's file again, by code that shares nothing with the prover.

    The sample is drawn by the system's random numbers, so a file cannot choose it.

    Args:
        loop: Closed loop of the file's scenario.
        document: Content of the file, from `certificate_document`.
        share: Share of the cells to check, in (0, 1]; at least one is checked.
        progress: Called with a line about how far the check is.

    Raises:
        ModuleNotFoundError: The extra `proof` is not installed.
        NoRule: A part of the loop has no sound rule.
        ValueError: The document is not a proof's file.
    """
    over, cells, claims, bounds = _read(document)
    if reason := _find_gap(over, cells):
        return FileVerdict(0, len(cells), reason)
    for claim in claims:
        low, high = bounds[claim["quantity"]]
        worst, least = (low, True) if claim["quantity"].startswith("least") else (high, False)
        if worst is None or (worst < claim["bound"] if least else worst > claim["bound"]):
            return FileVerdict(0, len(cells), f"the file's bound {worst} of {claim['quantity']} violates its claim")
    equations = derive_equations(loop, over)
    count = max(1, math.ceil(share * len(cells)))
    for done, i in enumerate(random.SystemRandom().sample(range(len(cells)), count)):
        reason = _check(equations, document, cells[i], bounds, CELL_HALVINGS)
        if reason:
            ends = ", ".join(
                f"{path} {low:.9g} to {high:.9g}" for path, (low, high) in zip(over, cells[i], strict=True)
            )
            return FileVerdict(done, len(cells), f"cell {ends}: {reason}")
        progress(f"{done + 1} of {count} cells")
    return FileVerdict(count, len(cells), "")


def _read(document: JsonObject) -> tuple[JsonObject, list[list[list[float]]], list[JsonObject], JsonObject]:
    """Return box, cells, claims and bounds of a file. Raises ValueError if they do not have the form of one."""
    try:
        if document["format"] != FORMAT or document["verdict"] != "proved":
            raise ValueError("no proof")
        over = {str(path): (float(low), float(high)) for path, (low, high) in document["over"].items()}
        cells = [[[float(low), float(high)] for low, high in cell] for cell in document["cells"]]
        claims = [{"quantity": str(x["quantity"]), "bound": float(x["bound"])} for x in document["claims"]]
        bounds = {str(name): (low, high) for name, (low, high) in document["bounds"].items()}
        if any(len(cell) != len(over) for cell in cells) or any(x["quantity"] not in bounds for x in claims):
            raise ValueError("cells or claims do not fit the box")
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"not a proof's file: {error}") from None
    return over, cells, claims, bounds


def _find_gap(over: JsonObject, cells: Sequence[Sequence[Sequence[float]]]) -> str:
    """Return why the cells do not cover the box, empty if they do.

    Cells that come from halving are nested or apart. So they cover the box if they differ, lie in it, and their volumes
    add up to its volume.
    """

    def volume(cell: Sequence[Sequence[float]]) -> Fraction:
        widths = (Fraction(high) - Fraction(low) for low, high in cell)
        return math.prod((w for w in widths if w), start=Fraction(1))

    box = list(over.values())
    for cell in cells:
        if any(not low <= a <= b <= high for (a, b), (low, high) in zip(cell, box, strict=True)):
            return f"the cell {cell} is not in the box"
    if len({tuple(map(tuple, cell)) for cell in cells}) < len(cells):
        return "a cell occurs twice"
    if not _comes_from_halving(box, cells):
        return "the cells do not come from halving the box"
    if sum((volume(cell) for cell in cells), Fraction(0)) != volume(box):
        return "the cells do not cover the box"
    return ""


def _comes_from_halving(box: Sequence[Sequence[float]], cells: Sequence[Sequence[Sequence[float]]]) -> bool:
    """Return whether the cells are the leaves of a tree of halvings of the box, so that no two overlap."""
    if len(cells) == 1:
        return [list(ends) for ends in cells[0]] == [list(ends) for ends in box]
    for i, (low, high) in enumerate(box):
        middle = 0.5 * (low + high)
        left = [cell for cell in cells if cell[i][1] <= middle]
        right = [cell for cell in cells if cell[i][0] >= middle]
        if left and right and len(left) + len(right) == len(cells):
            parts = ([*box[:i], end, *box[i + 1 :]] for end in ((low, middle), (middle, high)))
            if all(_comes_from_halving(part, some) for part, some in zip(parts, (left, right), strict=True)):
                return True
    return False


def _check(
    equations: Equations, document: JsonObject, cell: list[list[float]], bounds: JsonObject, halvings: int
) -> str:
    """Return why the checker does not confirm the file's bounds in a cell, empty if it does."""
    from diffabs.reach.checker import NotProved, check_cell

    horizon = float(document["horizon"])
    steps = SAMPLED_STEPS if equations.period is not None else [PACED_STEP if equations.paced else horizon / STEPS]
    try:
        found = check_cell(equations, document["signals"], [(low, high) for low, high in cell], steps, horizon)
    except NotProved as error:
        reason = f"not proved: {error}"
    else:
        reason = ""
        upper = {f"greatest {name}": x for name, x in found.greatest.items()}
        upper |= {"stop_time": found.stop_time[1], "stop_distance": found.distance[1]}
        lower = {f"least {name}": x for name, x in found.least.items()}
        lower |= {"stop_time": found.stop_time[0], "stop_distance": found.distance[0]}
        for name, (low, high) in bounds.items():
            if high is not None and name in upper and upper[name] > high + ALLOWED * abs(high):
                reason = f"{name} up to {upper[name]:.9g}, in the file {high:.9g}"
            if low is not None and name in lower and lower[name] < low - ALLOWED * abs(low):
                reason = f"{name} from {lower[name]:.9g}, in the file {low:.9g}"
    if not reason or not halvings:
        return reason
    widths = [(high - low) / max(abs(high), 1e-300) for low, high in cell]
    side = widths.index(max(widths))
    low, high = cell[side]
    middle = 0.5 * (low + high)
    halves = ([*cell[:side], ends, *cell[side + 1 :]] for ends in ([low, middle], [middle, high]))
    return next((why for half in halves if (why := _check(equations, document, half, bounds, halvings - 1))), "")
