"""Proofs of the greatest sensitivity |1/(1 + L)| over a box of parameters and all frequencies, by halving.

With L = B/P e^(-s tau) and N = P + B e^(-s tau), the closed loop's denominators multiplied out,

    |S| <= M   <=>   f = |N|^2 - |P|^2/M^2 >= 0:   products, cos and sin; no division, no pole on the axis

**Several controls.** L is a matrix and N = P det(I + L). |S| is the largest singular value of S = (I + L)^-1, and

    f = |N|^2 det(I - S^H S/M^2) = sum over J, I of (-1/M^2)^(m - k) |P det (I + L)[J, I]|^2,   k rows J and columns I

by the formulas of Cauchy and Binet and of Jacobi. P det (I + L)[J, I] is a polynomial in s and e^(-s tau). The
eigenvalues of I - S^H S/M^2 are positive at high frequencies, and none becomes 0 on the way as f > 0: so |S| < M. One
that is negative, f < 0, refutes the claim.

**A cell** is a range of frequencies and a box of parameters. The mean value theorem bounds f from below there: its
value at the middle, minus each derivative's greatest size over the cell times half of that side. A cell that is not
proved is halved along the side that costs bound. A middle with f < 0 refutes the claim.

**High frequencies.** |L| < 1 - 1/M for all w >= W follows from the sizes of the coefficients alone: divided by w^n, all
terms fall. A sampled loop has no frequency above pi/T. At w = 0 integrators give P = 0, and f > 0 all the same.

**Stability.** A small sensitivity is that of a stable loop only. The closed loop's poles are the zeros of N. At the
middle of the box the change of arg N along the axis counts those in the right half plane (outside of the unit circle).
On the way from there to any point of the box no zero can cross the axis, because f > 0 says that N has none there, and
none can come from infinity: N is s^n and terms of lower order, whatever the delay is. So the whole box is stable.

**Delay margin.** The loop with an added delay is stable for all delays in [0, D]: the delay is one more parameter, and
M is infinite. A sampled loop has other polynomials after each whole period; the delays are cut there.
"""

import contextlib
import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from diffabs.linear.transfer import WHOLE_PERIOD_TOLERANCE
from diffabs.loop.closed_loop import Loop
from diffabs.robust.frequency.coefficients import (
    ONE,
    Coefficients,
    Entry,
    MinorSum,
    Polynomials,
    list_forms,
    list_minors,
)
from diffabs.robust.frequency.intervals import Enclosure, cosine, enclose_number, sine
from diffabs.robust.frequency.opened import NO_ENTRY, OpenedEquations, derive_opened
from diffabs.robust.reach.cover import check_box
from diffabs.robust.reach.equations import NoRule

STRIPS = 24  # halvings of the frequencies before anything is tried; the last strip begins at 0
CELLS_AT_ONCE = 1 << 14
LEAST_SHARE = 2.0**-44  # of a side, relative to the box; such a cell is not halved
TAIL_HALVINGS = 16
MANY_CORNERS = 64  # at which the stability is tried
HIGHEST = 1e12  # rad/s
LEAF = "."

# Ends of the added delay [s], whole periods in the delay, and whether it has a rest.
DelayRange: TypeAlias = tuple[tuple[float, float], int, bool]

Complex: TypeAlias = tuple[Enclosure | None, Enclosure | None]


class FrequencyClaim(NamedTuple):
    """A statement about a loop for all parameters of a box and all frequencies: it is stable, and |S| <= `bound`.

    Attributes:
        bound: Bound of |1/(1 + L)|, above 1; infinite to claim stability only.
        added: The statement holds for every added delay from 0 to `added` [s].
    """

    bound: float
    added: float = 0.0

    def __str__(self) -> str:
        """Return the claim in words, with every digit of its numbers."""
        parts = [] if math.isinf(self.bound) else [f"sensitivity <= {self.bound!r}"]
        return " and ".join([*parts, *([f"delay margin >= {self.added!r} s"] if self.added or not parts else [])])


class Place(NamedTuple):
    """A frequency [rad/s], the parameters of the box, the added delay [s], and |S| there (of a witness: at least)."""

    frequency: float
    params: tuple[float, ...]
    added: float
    sensitivity: float


class DelayPiece(NamedTuple):
    """A range of added delays with one set of polynomials, covered by cells.

    Attributes:
        delays: Ends of the added delay [s].
        whole: Whole periods in the delay of a sampled loop.
        broken: Whether the delay of a sampled loop has a rest.
        top: Greatest frequency of the cells [rad/s].
        strips: Halvings of each strip of frequencies, the highest first: the number of the halved side before the text
            of the lower half and of the upper half, or `.` for a proved cell. Side 0 is the frequency.
        tail: Halvings of the parameters for the frequencies above; empty for a sampled loop.
    """

    delays: tuple[float, float]
    whole: int
    broken: bool
    top: float
    strips: tuple[str, ...]
    tail: str


class SensitivityProof(NamedTuple):
    """What is proved of a claim.

    Attributes:
        claim: The claim.
        verdict: proved, refuted or undecided.
        reason: Why it is not proved; empty if it is.
        worst: Greatest sensitivity met at the middle of a cell, and its place; None if no cell has a value.
        witness: Place that refutes the claim, in intervals, or None.
        pieces: The cells that prove the claim.
        cells: Number of cells that are proved.
        tried: Number of cells that were tried.
        seconds: Computing time [s], without the derivation of the equations.
    """

    claim: FrequencyClaim
    verdict: str
    reason: str
    worst: Place | None
    witness: Place | None
    pieces: tuple[DelayPiece, ...]
    cells: int
    tried: int
    seconds: float


def prove_sensitivity(
    loop: Loop,
    over: Mapping[str, tuple[float, float]],
    bound: float = math.inf,
    *,
    added: float = 0.0,
    target: float | None = None,
    budget: float = 60.0,
    progress: Callable[[str], None] = lambda line: None,
) -> SensitivityProof:
    """Return what can be proved of the greatest sensitivity of a loop over a box and all frequencies.

    Args:
        loop: Loop in continuous time or with a `Sampled` controller, with exact delays. A sampled loop has one control.
        over: Range (low, high) of each parameter of the box, by path, in SI units. The ends are exact decimals.
        bound: Bound to prove of |1/(1 + L)|, above 1. Infinity proves stability only.
        added: The bound has to hold for every added delay from 0 to `added` [s].
        target: Setpoint; None for the loop's own, as in `linear.open_loop`.
        budget: Computing time [s].
        progress: Called with a line about how far the proof is.

    Raises:
        ValueError: A number is out of its range, or the loop has no linear model at the middle of the box.
        NoRule: A part, an operation or a parameter of the loop has no sound rule.

    See also:
        `linear.margins`: The sensitivity at a point.
        `linear.band`: Its greatest value at samples of a box, a bound from the other side.
        `reach.cover_box`: Proofs about the nonlinear loop.

    Notes:
        L is the loop linearised at rest on its setpoint, opened at the command. `docs/proofs.md` explains the method
        and the file, which `scenario.verify` checks by other code.

    Examples:
        The published gain of a laboratory brake, for all masses and speeds:

        >>> from diffabs.robust.frequency import prove_sensitivity
        >>> from diffabs.scenario import load
        >>> box = {"plant.mass": (5.3, 6.2), "initial.speed": (1.4, 13.9)}
        >>> prove_sensitivity(load("slip-lmi").loop, box, 1.5).verdict
        'proved'
    """
    claim = FrequencyClaim(bound, added)
    check_frequency_claim(claim)
    check_box(over)
    if not 0 < budget < math.inf:
        raise ValueError(f"budget = {budget:g} is outside (0, inf) s")
    return prove_claim(derive_opened(loop, dict(over), target), over, claim, budget=budget, progress=progress)


def check_frequency_claim(claim: FrequencyClaim) -> None:
    """Raise ValueError for a claim that says nothing or cannot hold."""
    if not claim.bound > 1:
        raise ValueError(f"sensitivity = {claim.bound:g} is outside (1, inf): |S| goes to 1 at high frequencies")
    if not 0 <= claim.added < math.inf:
        raise ValueError(f"delay margin = {claim.added:g} is outside [0, inf) s")


def prove_claim(
    equations: OpenedEquations, over: Mapping[str, tuple[float, float]], claim: FrequencyClaim, *,
    budget: float = 60.0, progress: Callable[[str], None] = lambda line: None,
) -> SensitivityProof:  # fmt: skip
    """Return what can be proved of a claim about an opened loop; see `prove_sensitivity`."""
    return _Proof(equations, over, claim, time.monotonic() + budget, progress).conclude()


class _Open(Exception):
    """The proof ends here; the message says why."""


class _Refuted(Exception):
    """The claim is wrong."""

    def __init__(self, place: Place | None, reason: str):
        super().__init__(reason)
        self.place: Place | None = place


class _Proof:
    """The proof of one claim."""

    def __init__(
        self, equations: OpenedEquations, over: Mapping[str, tuple[float, float]], claim: FrequencyClaim, until: float,
        progress: Callable[[str], None],
    ):  # fmt: skip
        self.equations, self.claim, self.until, self.progress = equations, claim, until, progress
        self.box = np.array([outer_ends(*ends) for ends in over.values()]).reshape(-1, 2)
        self.inner = list(over.values())
        self.controls = len(equations.controller[3])
        self.forms = list_forms(self.controls)
        self.middle = [0.5 * (low + high) for low, high in over.values()]
        self.tried = self.cells = 0
        self.worst: Place | None = None
        self.share = enclose_number(claim.bound).inverse() if math.isfinite(claim.bound) else Enclosure(np.float64(0.0))

    def conclude(self) -> SensitivityProof:
        """Return the proof."""
        began = time.monotonic()
        pieces: list[DelayPiece] = []
        verdict, reason, witness = "undecided", "", None
        try:
            parts = list(delay_pieces(self.equations, self.claim.added))
            self.check_stable(self.middle, 0.0, parts[0])
            if math.isinf(self.claim.bound):
                self.check_corners(parts)
            pieces += [self.cover(*part) for part in parts]
            verdict = "proved"
        except _Refuted as error:
            verdict, reason, witness = "refuted", str(error), error.place
        except _Open as error:
            reason = str(error)
        seconds = time.monotonic() - began
        done = tuple(pieces) if verdict == "proved" else ()
        return SensitivityProof(self.claim, verdict, reason, self.worst, witness, done, self.cells, self.tried, seconds)

    def polynomials(self, whole: int, broken: bool) -> Polynomials:
        return Polynomials(self.equations, self.middle, whole, broken=broken)

    def respond(self, coefficients: Coefficients, w: Enclosure, index: np.ndarray) -> "_Response":
        return _respond(coefficients, self.forms, w, self.equations.period, index)

    def check_stable(self, params: Sequence[float], added: float, part: DelayRange) -> None:
        """Count the unstable poles at a point; raise _Refuted for any, and _Open if that is undecided."""
        point = np.array([[*params, added]])
        coefficients = self.polynomials(*part[1:]).over(point, point, slopes=False)
        numbers = [x.value for minor in coefficients.minors for x in minor if x is not None]
        if not all(np.isfinite(x.low + x.high).all() for x in numbers):
            raise _Open(f"the point of rest is not enclosed where {self.name_params(params, added)}")
        period = self.equations.period
        top = self.find_top(coefficients) if period is None else sampled_top(period)
        cells = [(0.0 if k == STRIPS else top * 2.0 ** -(k + 1), top * 2.0**-k) for k in range(STRIPS + 1)]
        done: list[tuple[float, float]] = []
        while cells:
            low, high = np.array(cells).T
            response = self.respond(coefficients, Enclosure(low, high), np.zeros(len(low), int))
            clear = np.zeros(len(low), bool)
            for x in response.closed:
                clear |= False if x is None else (x.low > 0) | (x.high < 0)
            done += [cell for cell, free in zip(cells, clear, strict=True) if free]
            halved = [cell for cell, free in zip(cells, clear, strict=True) if not free]
            if any(b - a < 1e-12 * top for a, b in halved) or time.monotonic() > self.until:
                raise _Open("the stability at the middle of the box is not decided: a pole is on the stability limit")
            cells = [half for a, b in halved for half in ((a, 0.5 * (a + b)), (0.5 * (a + b), b))]
        edges = np.array(sorted({x for cell in done for x in cell}))
        closed = _middles(self.respond(coefficients, Enclosure(edges), np.zeros(len(edges), int)).closed, len(edges))
        turned = float(np.angle(closed[1:] * closed[:-1].conj()).sum())
        n = len(coefficients.poles) - 1
        if period is None:  # N is (jw)^n times a number whose distance from 1 is below 1, above `top`
            turned -= float(np.angle(closed[-1] / (1j) ** n))
            unstable = (n - 2 * turned / math.pi) / 2
        else:
            unstable = n - turned / math.pi
        if round(unstable) > 0:
            where = self.name_params(params, added)
            raise _Refuted(None, f"the loop is unstable where {where}: {round(unstable)} poles")

    def check_corners(self, parts: Sequence[DelayRange]) -> None:
        """Raise _Refuted if the loop is unstable at a corner of the box, with the least or the greatest added delay.

        f < 0 holds nowhere if M is infinite, so a claim of stability alone has no other witness.
        """
        corners = itertools.product(*(sorted({*ends}) for ends in self.inner))
        for corner in itertools.islice(corners, MANY_CORNERS):
            for added, part in {0.0: parts[0], self.claim.added: parts[-1]}.items():
                with contextlib.suppress(_Open):
                    self.check_stable(corner, added, part)

    def find_top(self, coefficients: Coefficients) -> float:
        """Return a frequency above which a loop at a point has a small gain, with some reserve."""
        top = 1.0
        while not np.all(self.is_small(coefficients, top / 2)):
            top *= 2
            if top > HIGHEST:
                raise _Open("no frequency is found above which the gain is small")
        return top

    def is_small(self, coefficients: Coefficients, top: float) -> np.ndarray:
        """Return whether |L| < 1 - 1/M, for each box, at all frequencies w >= top."""
        n, unit = len(coefficients.poles) - 1, Enclosure(np.float64(1.0))

        def bound(polynomial: Sequence[Entry]) -> Enclosure:
            """Return a bound of |polynomial|/w^n."""
            total = Enclosure(np.zeros(1))
            for k, x in enumerate(polynomial):
                if x is not None:
                    falling = unit
                    for _ in range(n - k):
                        falling = falling * Enclosure(np.float64(top)).inverse()
                    total = total + Enclosure(x.value.size()) * falling
            return total

        below, gain, change = bound(coefficients.poles[:-1]), Enclosure(np.zeros(1)), Enclosure(np.zeros(1))
        for (rows, columns), minor in zip(list_minors(self.controls), coefficients.minors, strict=True):
            if rows:
                size = bound(minor)
                gain = gain + size if len(rows) == 1 else gain
                change = change + size if rows == columns else change
        reserve = (unit - self.share) * (unit - below) - gain
        # Behind `top`, N has to be (jw)^n times a number whose distance from 1 is below 1; of one control it is.
        return np.logical_and(reserve.low > 0, (unit - below - change).low > 0)

    def cover(self, delays: tuple[float, float], whole: int, broken: bool) -> DelayPiece:
        """Return the cells that prove the claim for a range of added delays."""
        polynomials, period = self.polynomials(whole, broken), self.equations.period
        box = np.vstack([self.box, delays])
        if period is None:
            top, tail = self.cover_tail(polynomials, box)
        else:
            top, tail = sampled_top(period), ""
        tree = _Tree(STRIPS + 1)
        low = np.repeat(np.array([[0.0, *box[:, 0]]]), STRIPS + 1, 0)
        high = np.repeat(np.array([[top, *box[:, 1]]]), STRIPS + 1, 0)
        for k in range(STRIPS + 1):
            low[k, 0], high[k, 0] = 0.0 if k == STRIPS else top * 2.0 ** -(k + 1), top * 2.0**-k
        widths = np.concatenate([[top], box[:, 1] - box[:, 0]])
        waiting = [(low, high, np.arange(STRIPS + 1))]
        while waiting:
            low, high, nodes = waiting.pop()
            if len(low) > CELLS_AT_ONCE:
                waiting += [
                    tuple(x[part] for x in (low, high, nodes))
                    for part in (slice(CELLS_AT_ONCE, None), slice(CELLS_AT_ONCE))
                ]
                continue
            if time.monotonic() > self.until:
                remaining = len(low) + sum(len(x[0]) for x in waiting)
                raise _Open(f"{remaining:,} cells are left; a greater budget goes on")
            proved, costs = self.try_cells(polynomials, low, high)
            self.cells += int(proved.sum())
            again = ~proved
            low, high, nodes, costs = low[again], high[again], nodes[again], costs[again]
            if not len(low):
                continue
            small = high - low <= np.maximum(LEAST_SHARE * widths, 4 * np.spacing(np.abs(high)))
            costs = np.where(small, -1.0, costs)
            if (costs < 0).all(1).any():
                raise _Open(self.describe_stuck(low[(costs < 0).all(1)][0]))
            axis = costs.argmax(1)
            low, high = _halve(low, high, axis)
            waiting.append((low, high, tree.split(nodes, axis)))
            self.progress(f"{self.cells:,} cells proved, {sum(len(x[0]) for x in waiting):,} left")
        return DelayPiece(delays, whole, broken, top, tuple(tree.texts()), tail)

    def cover_tail(self, polynomials: Polynomials, box: np.ndarray) -> tuple[float, str]:
        """Return a frequency above which the gain is small over the box, and the halvings that prove it."""
        corners = itertools.islice(itertools.product(*(sorted({*ends}) for ends in box.tolist())), MANY_CORNERS)
        top = 1.0
        for point in ([list(corner)] for corner in corners):
            with contextlib.suppress(_Open):  # a corner without a rest; the halvings decide
                top = max(top, self.find_top(polynomials.over(np.array(point), np.array(point), slopes=False)))
        low, high = box[None, :, 0], box[None, :, 1]
        for _ in range(40):
            tree, low, high, nodes = _Tree(1), box[None, :, 0], box[None, :, 1], np.arange(1)
            for _ in range(TAIL_HALVINGS):
                self.tried += len(low)
                small = np.broadcast_to(self.is_small(polynomials.over(low, high, slopes=False), top), (len(low),))
                low, high, nodes = low[~small], high[~small], nodes[~small]
                self.cells += int(small.sum())
                if not len(low):
                    return top, tree.texts()[0]
                axis = ((high - low) / np.maximum(box[:, 1] - box[:, 0], 1e-300))[:, : max(1, len(box) - 1)].argmax(1)
                low, high = _halve(low, high, axis)
                nodes = tree.split(nodes, axis)
            top *= 2
        raise _Open(self.describe_stuck(np.concatenate([[top], low[0]])))

    def try_cells(self, polynomials: Polynomials, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which cells are proved, and what each side costs; raise _Refuted for a middle that violates."""
        self.tried += len(low)
        middle = np.clip(0.5 * (low + high), low, high)
        boxes, index = np.unique(np.concatenate([low[:, 1:], high[:, 1:]], 1), axis=0, return_inverse=True)
        index, count = index.ravel(), low.shape[1] - 1
        whole = polynomials.over(boxes[:, :count], boxes[:, count:])
        centre = np.clip(0.5 * (boxes[:, :count] + boxes[:, count:]), boxes[:, :count], boxes[:, count:])
        point = polynomials.over(centre, centre, slopes=False)
        square = self.share.square()
        with np.errstate(all="ignore"):
            at = self.respond(point, Enclosure(middle[:, 0]), index)
            f = square_form(at, self.forms, square)
            self.note_worst(at, f, middle)
            over = self.respond(whole, Enclosure(low[:, 0], high[:, 0]), index)
            slopes = _slopes(whole, over, self.forms, square, index, count)
            radius = Enclosure(np.nextafter(np.maximum(high - middle, middle - low), np.inf))
            costs = np.stack([(Enclosure(x.size()) * radius[:, k]).high for k, x in enumerate(slopes)], 1)
            reserve = Enclosure(f.low)
            for k in range(count + 1):
                reserve = reserve - Enclosure(costs[:, k])
            direct = square_form(over, self.forms, square)
            proved = np.logical_or(reserve.low > 0, direct.low > 0)
        failed = np.logical_not(np.isfinite(costs).all(1))  # no polynomial: the parameters, in turn
        shares = (high - low)[:, 1:] / np.maximum((self.box_widths())[None], 1e-300)
        costs = np.where(failed[:, None], np.concatenate([np.zeros((len(low), 1)), shares], 1), costs)
        return proved & np.isfinite(reserve.low), costs

    def box_widths(self) -> np.ndarray:
        return np.append(self.box[:, 1] - self.box[:, 0], self.claim.added or 1.0)

    def note_worst(self, at: "_Response", f: Enclosure, middle: np.ndarray) -> None:
        """Keep the greatest sensitivity at the middles of cells, and refute the claim where f < 0."""
        with np.errstate(all="ignore"):
            if self.controls == 1:
                ratio = np.sqrt(_square_modulus(at.open).middle() / _square_modulus(at.closed).middle())
                at_least = np.sqrt(_square_modulus(at.open).low / _square_modulus(at.closed).high) * (1 - 1e-14)
            else:  # f < 0 says that the bound is exceeded; by how much is computed in floats
                ratio = _singular_values(at, self.forms, self.controls, len(middle))
                at_least = np.maximum(ratio * (1 - 1e-9), self.claim.bound)
        i = int(np.argmax(np.where(np.isfinite(ratio), ratio, -1.0)))
        place = Place(float(middle[i, 0]), tuple(map(float, middle[i, 1:-1])), float(middle[i, -1]), float(ratio[i]))
        if self.worst is None or place.sensitivity > self.worst.sensitivity:
            self.worst = place if np.isfinite(place.sensitivity) else self.worst
        wrong = np.asarray(f.high < 0)
        if wrong.any():
            i = int(np.argmax(np.where(wrong & np.isfinite(at_least), at_least, -1.0)))
            witness = Place(
                float(middle[i, 0]), tuple(map(float, middle[i, 1:-1])), float(middle[i, -1]), float(at_least[i])
            )
            where = self.name_params(witness.params, witness.added)
            raise _Refuted(witness, f"|S| >= {witness.sensitivity:.6g} at {witness.frequency:.6g} rad/s where {where}")

    def describe_stuck(self, corner: np.ndarray) -> str:
        where = self.name_params(corner[1:-1].tolist(), float(corner[-1]))
        return (
            f"no bound near {corner[0]:.6g} rad/s where {where}: the rest, the limits or the bound are too close there"
        )

    def name_params(self, values: Sequence[float], added: float) -> str:
        words = [f"{path} = {value:.6g}" for path, value in zip(self.equations.params, values, strict=True)]
        return ", ".join([*words, *([f"added delay = {added:.6g} s"] if self.claim.added else [])]) or "it stands"


def outer_ends(low: float, high: float) -> tuple[float, float]:
    """Return doubles around a range whose ends are exact decimals."""
    return float(enclose_number(low).low), float(enclose_number(high).high)


def sampled_top(period: float) -> float:
    """Return a frequency of at least pi/period [rad/s]."""
    return math.pi / period * (1 + 1e-12)


def delay_pieces(equations: OpenedEquations, added: float) -> Iterator[DelayRange]:
    """Yield ranges of the added delay with one set of polynomials, their whole periods, and whether a rest is left."""
    high = float(enclose_number(added).high)
    if equations.period is None:
        yield (0.0, high), 0, False
        return
    e, period = equations, equations.period
    delay = 0.0 if e.delay == NO_ENTRY else _fixed_delay(e)
    first = delay / period
    whole = math.floor(first + WHOLE_PERIOD_TOLERANCE)
    if not added:
        yield (0.0, 0.0), whole, abs(first - whole) > WHOLE_PERIOD_TOLERANCE
        return
    edge = 0.0
    while edge < high:
        end = (whole + 1) * period - delay
        following = min(end, high)
        # Neighbours overlap by more than roundings: each delay lies in a piece with its own whole periods.
        slack = 2 * delay_rounding(delay + added, period)
        yield (edge - slack if edge else 0.0, following + slack), whole, True
        edge, whole = following, whole + 1


def delay_rounding(delay: float, period: float) -> float:
    """Return a bound of the roundings in a delay counted from whole periods [s]."""
    return 2.0**-49 * (delay + period)


def _fixed_delay(equations: OpenedEquations) -> float:
    """Return the delay of a sampled loop [s]; raise NoRule if it is a parameter of the box."""

    def value(i: int) -> float:
        name, args, number = equations.operations[i]
        if name == "const":
            return float(number)
        if name == "add":
            return value(args[0]) + value(args[1])
        raise NoRule("a range of delays of a sampled loop: only an added delay has a rule, as of --delay-margin")

    return value(equations.delay)


def _halve(low: np.ndarray, high: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower halves, then the upper ones."""
    k = np.arange(len(low))
    middle = 0.5 * (low[k, axis] + high[k, axis])
    below, above = high.copy(), low.copy()
    below[k, axis] = middle
    above[k, axis] = middle
    return np.concatenate([low, above]), np.concatenate([below, high])


class _Tree:
    """The halvings of some boxes; a node has the number of its halved side and of its lower and its upper half."""

    def __init__(self, roots: int):
        self.roots, self.count = roots, roots
        self.nodes: list[tuple[np.ndarray, np.ndarray, int]] = []

    def split(self, nodes: np.ndarray, axis: np.ndarray) -> np.ndarray:
        """Return the numbers of the lower halves, then of the upper ones."""
        self.nodes.append((nodes, axis, self.count))
        first = self.count
        self.count += 2 * len(nodes)
        return np.arange(first, self.count)

    def texts(self) -> list[str]:
        """Return the text of each root; see `DelayPiece.strips`."""
        axes, lower, upper = np.full(self.count, -1), np.zeros(self.count, int), np.zeros(self.count, int)
        for nodes, axis, first in self.nodes:
            axes[nodes] = axis
            lower[nodes], upper[nodes] = first + np.arange(len(nodes)), first + len(nodes) + np.arange(len(nodes))
        texts = []
        for root in range(self.roots):
            letters, stack = [], [root]
            while stack:
                node = stack.pop()
                letters.append(LEAF if axes[node] < 0 else SIDES[axes[node]])
                if axes[node] >= 0:
                    stack += [int(upper[node]), int(lower[node])]
            texts.append("".join(letters))
        return texts


SIDES = "0123456789abcdefghijklmnopqrstuvwxyz"


# The response at cells.


class _Response(NamedTuple):
    """Numbers of each cell.

    Attributes:
        minors: Values of the coefficients' minors.
        turns: e^(-jw tau d) for d = 0, 1, ...; None for 1.
        forms: P det (I + L)[J, I]; the first is N, the last P.
        w: Frequencies.
        powers: s^k.
        rates: Derivative of s^k along w.
    """

    minors: list[Complex]
    turns: list[Complex | None]
    forms: list[Complex]
    w: Enclosure
    powers: list[Complex]
    rates: list[Complex]

    @property
    def closed(self) -> Complex:
        """N."""
        return self.forms[0]

    @property
    def open(self) -> Complex:
        """P."""
        return self.forms[-1]


def square_form(at: _Response, forms: Sequence[MinorSum], square: Enclosure) -> Enclosure:
    """Return f = |N|^2 det(I - S^H S/M^2), the sum of (-1/M^2)^(m - k) |P det (I + L)[J, I]|^2 of all k by k minors."""
    total, controls = _square_modulus(at.forms[0]), len(forms[0].pair[0])
    for form, value in zip(forms[1:], at.forms[1:], strict=True):
        missing = controls - len(form.pair[0])
        size = _weigh(_square_modulus(value), square, missing)
        total = total - size if missing % 2 else total + size
    return total


def _weigh(x: Enclosure, square: Enclosure, power: int) -> Enclosure:
    for _ in range(power):
        x = x * square
    return x


def _respond(
    coefficients: Coefficients, forms: Sequence[MinorSum], w: Enclosure, period: float | None, index: np.ndarray
) -> _Response:
    """Return the response of the boxes `index` at frequencies."""
    powers, rates = _powers(w, period, len(coefficients.poles))
    minors = [_combine(minor, powers, index) for minor in coefficients.minors]
    delay = _pick(coefficients.delay.value, index)
    turns: list[Complex | None] = [None] * (len(forms[0].pair[0]) + 1)
    if np.any(delay.low) or np.any(delay.high):
        angle = w * delay
        for d in range(1, len(turns)):
            turned = angle if d == 1 else angle.times(float(d))
            turns[d] = (cosine(turned), -sine(turned))
    values = [_sum_terms(form, [_turn(minors[i], turns[d]) for i, _, d in form.terms]) for form in forms]
    return _Response(minors, turns, values, w, powers, rates)


def _turn(x: Complex, turn: Complex | None) -> Complex:
    return x if turn is None else _multiply(x, turn)


def _sum_terms(form: MinorSum, values: Sequence[Complex]) -> Complex:
    total: Complex = (None, None)
    for (_, sign, _), value in zip(form.terms, values, strict=True):
        total = _add(total, value if sign > 0 else _rotate(value, 2))
    return total


def _singular_values(at: _Response, forms: Sequence[MinorSum], controls: int, count: int) -> np.ndarray:
    """Return the largest singular value of S at the middles of cells, in floats; S is adj(I + L) P/N."""
    everything = range(controls)
    values = {form.pair: _middles(value, count) for form, value in zip(forms, at.forms, strict=True)}
    s = np.empty((count, controls, controls), complex)
    for i in everything:
        for j in everything:
            pair = tuple(k for k in everything if k != j), tuple(k for k in everything if k != i)
            s[:, i, j] = (-1) ** (i + j) * values[pair] / values[forms[0].pair]
    finite = np.isfinite(s).all((1, 2))
    s[~finite] = 0.0
    return np.where(finite, np.linalg.svd(s, compute_uv=False)[:, 0], np.nan)


def _slopes(
    coefficients: Coefficients,
    at: _Response,
    forms: Sequence[MinorSum],
    square: Enclosure,
    index: np.ndarray,
    count: int,
) -> list[Enclosure]:
    """Return the derivatives of f along the frequency, the parameters and the added delay."""
    delay = _pick(coefficients.delay.value, index)
    controls = len(forms[0].pair[0])

    def along(values: Callable[[int, int], Complex | None]) -> Enclosure:
        """Return half of the derivative of f, from those of the minors times their turns."""
        total = Enclosure(np.zeros(len(index)))
        for form, value in zip(forms, at.forms, strict=True):
            moved: Complex = (None, None)
            for i, sign, d in form.terms:
                if (move := values(i, d)) is not None:
                    moved = _add(moved, move if sign > 0 else _rotate(move, 2))
            if moved == (None, None):
                continue
            missing = controls - len(form.pair[0])
            part = _weigh(_inner(value, moved), square, missing)
            total = total - part if missing % 2 else total + part
        return total

    rates = [_combine(minor, at.rates, index) for minor in coefficients.minors]

    def by_frequency(i: int, d: int) -> Complex:  # (B e^(-jw tau d))' = (B' - j tau d B) e^(-jw tau d)
        if at.turns[d] is None:
            return rates[i]
        return _turn(_add(rates[i], _scale(_turn_right(at.minors[i]), delay.times(float(d)))), at.turns[d])

    parts = [along(by_frequency), *(Enclosure(np.zeros(len(index))) for _ in range(count))]
    for i, minor in enumerate(coefficients.minors):
        for x, power in zip(minor, at.powers, strict=False):
            if x is None or not x.slopes:
                continue
            factor = along(lambda k, d, i=i, power=power: _turn(power, at.turns[d]) if k == i else None)
            for j, slope in x.slopes.items():
                parts[j + 1] = parts[j + 1] + factor * _pick(slope, index)
    if coefficients.delay.slopes:
        turned = [_scale(_turn_right(x), at.w) for x in at.minors]
        factor = along(lambda i, d: _turn(_scale(turned[i], _exact(d)), at.turns[d]) if d else None)
        for j, slope in coefficients.delay.slopes.items():
            parts[j + 1] = parts[j + 1] + factor * _pick(slope, index)
    return [x.times(2.0) for x in parts]


def _exact(x: float) -> Enclosure:
    return Enclosure(np.float64(x))


def _powers(w: Enclosure, period: float | None, count: int) -> tuple[list[Complex], list[Complex]]:
    """Return s^k for k < count and their derivatives along w.

    s is jw, or e^(jwT) - 1 = 2 j sin(wT/2) e^(jwT/2). With r = 2 sin(wT/2), ds^k/dw = T k j^k r^(k-1) e^(j(k+1)wT/2).
    """
    unit = Enclosure(np.ones(np.shape(w.low)))
    if period is None:
        sizes, size = [unit], unit
        for _ in range(count):
            size = _nonnegative(size * w)
            sizes.append(size)
        return (
            [_rotate((sizes[k], None), k) for k in range(count)],
            [(None, None), *(_rotate((sizes[k - 1].times(float(k)), None), k) for k in range(1, count))],
        )
    step = enclose_number(period)
    half = (w * step).times(0.5)
    r = _nonnegative(sine(half).times(2.0))
    sizes, size = [unit], unit
    for _ in range(count):
        size = _nonnegative(size * r)
        sizes.append(size)
    turns = [(cosine(half.times(float(k))), sine(half.times(float(k)))) for k in range(count + 1)]
    powers: list[Complex] = [(unit, None)]
    rates: list[Complex] = [(None, None)]
    for k in range(1, count):
        powers.append(_rotate(_scale(turns[k], sizes[k]), k))
        rates.append(_rotate(_scale(turns[k + 1], sizes[k - 1].times(float(k)) * step), k))
    return powers, rates


def _nonnegative(x: Enclosure) -> Enclosure:
    return Enclosure(np.maximum(x.low, 0.0), np.maximum(x.high, 0.0))


def _rotate(x: Complex, k: int) -> Complex:
    """Return x j^k."""
    re, im = x
    for _ in range(k % 4):
        re, im = None if im is None else -im, re
    return re, im


def _turn_right(x: Complex) -> Complex:
    """Return -j x."""
    return _rotate(x, 3)


def _pick(x: Enclosure, index: np.ndarray) -> Enclosure:
    """Return the interval of each cell's box."""
    return x if np.size(x.low) == 1 and np.ndim(x.low) == 0 else Enclosure(x.low[index], x.high[index])


def _combine(polynomial: Sequence[Entry], powers: Sequence[Complex], index: np.ndarray) -> Complex:
    total: Complex = (None, None)
    for x, power in zip(polynomial, powers, strict=False):
        if x is not None:
            total = _add(total, power if x is ONE else _scale(power, _pick(x.value, index)))
    return total


def _add(x: Complex, y: Complex) -> Complex:
    a, b = (q if p is None else p if q is None else p + q for p, q in zip(x, y, strict=True))
    return a, b


def _scale(x: Complex, factor: Enclosure) -> Complex:
    a, b = (None if part is None else part * factor for part in x)
    return a, b


def _multiply(x: Complex, y: Complex) -> Complex:
    def product(a: Enclosure | None, b: Enclosure | None) -> Enclosure | None:
        return None if a is None or b is None else a * b

    less = product(x[1], y[1])
    return _add((product(x[0], y[0]), product(x[0], y[1])), (None if less is None else -less, product(x[1], y[0])))


def _inner(x: Complex, y: Complex) -> Enclosure:
    """Return Re(conj(x) y)."""
    terms = [a * b for a, b in zip(x, y, strict=True) if a is not None and b is not None]
    return terms[0] + terms[1] if len(terms) == 2 else terms[0] if terms else Enclosure(np.float64(0.0))


def _square_modulus(x: Complex) -> Enclosure:
    parts = [part.square() for part in x if part is not None]
    return parts[0] + parts[1] if len(parts) == 2 else parts[0] if parts else Enclosure(np.float64(0.0))


def _middles(x: Complex, count: int) -> np.ndarray:
    re, im = (np.zeros(count) if part is None else np.broadcast_to(part.middle(), (count,)) for part in x)
    return re + 1j * im
