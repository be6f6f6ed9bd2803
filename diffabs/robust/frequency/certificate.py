"""The file of proofs over all frequencies: claims, halvings and the scenario; and its check by code of its own.

A file is text that anybody can edit. Only what is proved again counts: the halvings are read as letters, so their cells
cover the box whatever they say, and each cell, the high frequencies and the stability at the middle are checked.
"""

import math
import random
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

from diffabs.core.types import JsonObject
from diffabs.host import provenance
from diffabs.host.values import format_given
from diffabs.linear.transfer import WHOLE_PERIOD_TOLERANCE
from diffabs.loop.closed_loop import Loop
from diffabs.robust.frequency.opened import NO_ENTRY, OpenedEquations, derive_opened
from diffabs.robust.frequency.sensitivity import (
    DelayPiece,
    FrequencyClaim,
    SensitivityProof,
    check_frequency_claim,
    delay_rounding,
)
from diffabs.robust.reach.cover import check_box
from diffabs.robust.reach.verification import FileVerdict

FREQUENCY_FORMAT = "diffabs frequency proof 1"

Ends = tuple[tuple[float, float], ...]


class FrequencyFile(NamedTuple):
    """The content of a file.

    Attributes:
        over: Range (low, high) of each parameter of the box, by path, in SI units.
        target: Setpoint; None for the loop's own.
        claims: Claims with the pieces that prove each.
    """

    over: dict[str, tuple[float, float]]
    target: float | None
    claims: tuple[tuple[FrequencyClaim, tuple[DelayPiece, ...]], ...]


def frequency_document(
    proofs: Sequence[SensitivityProof], scenario: str, over: Mapping[str, tuple[float, float]], target: float | None
) -> JsonObject:
    """Return the JSON document of proofs about one box; an infinite bound is null."""
    return {
        "format": FREQUENCY_FORMAT,
        "verdict": "proved" if all(proof.verdict == "proved" for proof in proofs) else "undecided",
        "scenario": scenario,
        "target": target,
        "over": {path: list(ends) for path, ends in over.items()},
        "claims": [
            {
                "sensitivity": proof.claim.bound if math.isfinite(proof.claim.bound) else None,
                "added_delay": proof.claim.added,
                "pieces": [piece._asdict() for piece in proof.pieces],
            }
            for proof in proofs
        ],
        "versions": provenance.versions("numpy"),
    }


def read_frequency_file(document: JsonObject) -> FrequencyFile:
    """Return the content of a document. Raises ValueError."""
    if document.get("format") != FREQUENCY_FORMAT:
        raise ValueError(f'"format" is not {FREQUENCY_FORMAT!r}')
    if document.get("verdict") != "proved":
        raise ValueError(f"nothing to verify: the file's verdict is {document.get('verdict')}, not proved")
    try:
        over = {str(path): (_number(low), _number(high)) for path, (low, high) in document["over"].items()}
        target = None if document.get("target") is None else _number(document["target"])
        claims = tuple(_read_claim(entry) for entry in document["claims"])
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"not a file of proofs: {error!r:.200}") from None
    if over:
        check_box(over)
    for claim, _ in claims:
        check_frequency_claim(claim)
    return FrequencyFile(over, target, claims)


def _read_claim(entry: Any) -> tuple[FrequencyClaim, tuple[DelayPiece, ...]]:
    bound = entry["sensitivity"]
    claim = FrequencyClaim(math.inf if bound is None else _number(bound), _number(entry["added_delay"]))
    return claim, tuple(_read_piece(piece) for piece in entry["pieces"])


def _read_piece(piece: Any) -> DelayPiece:
    low, high = piece["delays"]
    texts = (*piece["strips"], piece["tail"])
    whole, broken = piece["whole"], piece["broken"]
    if not all(isinstance(text, str) for text in texts) or type(whole) is not int or type(broken) is not bool:
        raise ValueError(f"piece {format_given(piece)}")
    return DelayPiece((_number(low), _number(high)), whole, broken, _number(piece["top"]), texts[:-1], texts[-1])


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{value!r} is not a finite number")
    return float(value)


def verify_frequency(
    loop: Loop, document: JsonObject, share: float = 1.0, progress: Callable[[str], None] = lambda line: None
) -> FileVerdict:
    """Prove the cells of a file again, in Arb's balls.

    Args:
        loop: Loop of the file's scenario.
        share: Share of the cells to check, in (0, 1]; the system's random numbers draw them.
        progress: Called with a line about how far the check is.

    Raises:
        ValueError: The file is none, or is about a loop without rules.
        ModuleNotFoundError: python-flint is not installed.
    """
    from diffabs.robust.frequency import checker

    if not 0 < share <= 1:
        raise ValueError(f"share = {share:g} is outside (0, 1]")
    file = read_frequency_file(document)
    equations = derive_opened(loop, file.over, file.target)
    statements = tuple(str(claim) for claim, _ in file.claims)
    reason, tasks, checked = "" if file.claims else "the file states nothing", [], 0
    try:
        for claim, pieces in file.claims:
            _check_delays(equations, claim, pieces)
            for number, piece in enumerate(pieces):
                check = checker.LoopChecker(equations, claim.bound, piece.whole, broken=piece.broken)
                box = (*map(_outer, file.over.values()), (min(piece.delays), max(piece.delays)))
                if not number:
                    check.check_stable([*(0.5 * (low + high) for low, high in file.over.values()), 0.0], piece.top)
                tasks += _list_cells(check, piece, box, equations.period)
        sample = random.SystemRandom().sample(range(len(tasks)), max(1, math.ceil(share * len(tasks)))) if tasks else []
        for index in sorted(sample):
            check, cell, top = tasks[index]
            if top is None:
                check.check_cell(cell)
            else:
                check.check_tail(cell, top)
            checked += 1
            progress(f"{checked:,} of {len(sample):,} cells")
    except checker.NotProved as error:
        reason = str(error)
    except ValueError as error:
        reason = f"the file contradicts itself: {error}"
    return FileVerdict(checked, len(tasks), reason, statements)


def _list_cells(check: Any, piece: DelayPiece, box: Ends, period: float | None) -> list[tuple[Any, Ends, float | None]]:
    """Return what a piece asserts: a checker, a cell, and for the high frequencies their least one."""
    from diffabs.robust.frequency.checker import read_halvings

    if not piece.top > 0 or not piece.strips:
        raise ValueError("no frequency is covered")
    tasks = []
    if period is None:
        tasks += [(check, cell, piece.top) for cell in read_halvings(piece.tail, box)]
    elif not check.passes_half_rate(piece.top):
        raise ValueError(f"the cells end at {piece.top:.9g} rad/s, below pi/T")
    last = len(piece.strips) - 1
    for i, text in enumerate(piece.strips):
        ends = (0.0 if i == last else math.ldexp(piece.top, -i - 1), math.ldexp(piece.top, -i))
        tasks += [(check, cell, None) for cell in read_halvings(text, (ends, *box))]
    return tasks


def _outer(ends: tuple[float, float]) -> tuple[float, float]:
    """Return doubles around the exact decimals of a range."""
    return math.nextafter(ends[0], -math.inf), math.nextafter(ends[1], math.inf)


def _check_delays(equations: OpenedEquations, claim: FrequencyClaim, pieces: Sequence[DelayPiece]) -> None:
    """Raise ValueError unless the pieces cover [0, added], each with the polynomials of its delays."""
    if not pieces:
        raise ValueError("a claim without cells")
    ends = [piece.delays for piece in pieces]
    if ends[0][0] > 0 or Fraction(ends[-1][1]) < Fraction(repr(claim.added)):
        raise ValueError("the added delays are not covered")
    period = equations.period
    if period is None:
        if len(pieces) > 1 or pieces[0].whole or pieces[0].broken:
            raise ValueError("a loop in continuous time has one piece of delays")
        return
    delay = 0.0 if equations.delay == NO_ENTRY else _sum_constants(equations, equations.delay)
    rounding, last = delay_rounding(delay + claim.added, period), len(pieces) - 1
    for number, piece in enumerate(pieces):
        if not piece.broken:
            if claim.added or abs(delay / period - piece.whole) > WHOLE_PERIOD_TOLERANCE:
                raise ValueError("the delay is not in whole periods")
            continue
        low, high = delay + piece.delays[0] - piece.whole * period, delay + piece.delays[1] - piece.whole * period
        if number and (piece.whole != pieces[number - 1].whole + 1 or low > -rounding):
            raise ValueError("a gap between two pieces of delays")
        if number < last and high < period + rounding:
            raise ValueError("a gap between two pieces of delays")
        if not -4 * rounding <= low <= high <= period + 4 * rounding:
            raise ValueError("a piece of delays has the polynomials of other ones")


def _sum_constants(equations: OpenedEquations, i: int) -> float:
    name, args, number = equations.operations[i]
    if name == "const":
        return float(number)
    if name != "add":
        raise ValueError("the delay of a sampled loop is no number")
    return sum(_sum_constants(equations, a) for a in args)
