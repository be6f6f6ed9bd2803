"""The opened loop's polynomials over boxes of parameters, in intervals with outward rounding, with their derivatives.

    L = B(s)/P(s) e^(-s tau),    P = s^n + a_(n-1) s^(n-1) + ... + a_0,    B = b_(n-1) s^(n-1) + ... + b_0

In continuous time s = jw. A sampled loop has the polynomials in s = z - 1, z = e^(jwT): near z = 1, where the slow
poles lie, they do not cancel. The plant is then sampled exactly under a held input, and tau is in whole periods.

1. Newton's method finds the rest at the middle of a box in floats, and Krawczyk's operator encloses it over the box.
2. The matrices follow, with derivatives along the parameters; the rest brings its own (implicit function theorem).
3. The exponential of the plant is a Taylor polynomial, scaled and squared. Its remainder is a number of a small
   interval. In the mean value theorem it counts as a enclose_number, that of the point, so it needs no derivative.
4. Determinants are expanded along rows: no division, and every product of entries occurs once.

An interval is NaN where a step fails; the prover then halves the box.
"""

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from diffabs.core.types import Any
from diffabs.robust.frequency.intervals import (
    Enclosure,
    Jet,
    cosine,
    enclose_number,
    enclose_power,
    intersection,
    monotone,
    sine,
    union,
)
from diffabs.robust.frequency.opened import FUNCTIONS, NO_ENTRY, OpenedEquations, is_nought

NEWTON_STEPS = 8
KRAWCZYK_TRIES = 6
INFLATION = 1.3  # of a guess of the rest's range
TAYLOR_TERMS = 18
LARGEST_NORM = 1e4  # of a plant's matrix times the period

Entry: TypeAlias = Jet | None  # None: 0 whatever the numbers are
Entries: TypeAlias = list[list[Entry]]
Polynomial: TypeAlias = list[Entry]
Slopes: TypeAlias = dict[int, Enclosure]
ONE = Jet(Enclosure(np.float64(1.0)))


class Coefficients(NamedTuple):
    """The polynomials of an opened loop, for each box of parameters.

    Attributes:
        minors: P det L[J, I] for each pair of `list_minors`, without the delay. The first is P, a_0 to a_n, with `ONE`
            as a_n. Of one control the second is B, b_0 to b_n; b_n is None but for the rest of a delay of a sampled
            loop.
        delay: Delay in front of all controls [s]; of a sampled loop whole periods.
    """

    minors: list[Polynomial]
    delay: Jet

    @property
    def poles(self) -> Polynomial:
        """P."""
        return self.minors[0]


Pair: TypeAlias = tuple[tuple[int, ...], tuple[int, ...]]


class MinorSum(NamedTuple):
    """P det (I + L)[J, I] as a sum of minors.

    Attributes:
        pair: J and I.
        terms: Number of the minor, its sign, and its power of e^(-s tau).
    """

    pair: Pair
    terms: tuple[tuple[int, int, int], ...]


def list_minors(controls: int) -> list[Pair]:
    """Return the pairs (J, I) of equally many rows and columns of L, the smallest first."""
    return [
        (rows, columns)
        for size in range(controls + 1)
        for rows in itertools.combinations(range(controls), size)
        for columns in itertools.combinations(range(controls), size)
    ]


def list_forms(controls: int) -> list[MinorSum]:
    """Return P det (I + L)[J, I] for all pairs, the whole matrix first and P last.

    A column in which the entry of I stands in place of that of L is left out, with its row.
    """
    pairs = list_minors(controls)
    forms = []
    for rows, columns in reversed(pairs):
        terms = []
        common = [i for i in rows if i in columns]
        for left_out in itertools.chain.from_iterable(
            itertools.combinations(common, size) for size in reversed(range(len(common) + 1))
        ):
            places = sum(rows.index(i) + columns.index(i) for i in left_out)
            lines, inputs = (tuple(i for i in side if i not in left_out) for side in (rows, columns))
            terms.append((pairs.index((lines, inputs)), -1 if places % 2 else 1, len(lines)))
        forms.append(MinorSum((rows, columns), tuple(terms)))
    return forms


class Polynomials:
    """A function from boxes of parameters to the coefficients of an opened loop.

    A box has the parameters of the equations and, behind them, an added delay [s].
    """

    def __init__(self, equations: OpenedEquations, middle: Sequence[float], whole: int = 0, *, broken: bool = False):
        """Store the equations.

        Args:
            middle: Parameters, without the added delay, at which `equations.guess` is the rest.
            whole: Whole periods in the delay of a sampled loop.
            broken: Whether the delay of a sampled loop has a rest, which is within a period.
        """
        e = self.equations = equations
        self.whole, self.broken, self.params = whole, broken, len(e.params)
        entries = [x for matrix in (*e.plant, *e.controller) for row in matrix for x in row if x != NO_ENTRY]
        self.entries = _Evaluation(e, [*entries, *([e.delay] if e.delay != NO_ENTRY else [])])
        self.rest = _Evaluation(e, e.rest)
        self.rows = [*range(len(e.rest))]
        if e.spare:
            self._leave_rows_out([Enclosure(np.full(1, x)) for x in middle])

    def _leave_rows_out(self, middle: list[Enclosure]) -> None:
        """Leave out the rows of the rest that follow from the others."""
        e, n = self.equations, len(self.rows)
        unknown = [np.full(1, x) for x in e.guess]
        jacobian = self._residual(middle, [Enclosure(x) for x in unknown])[1].middle()[0]
        for axis in (1, 0):
            jacobian = jacobian / np.maximum(np.abs(jacobian).max(axis, keepdims=True), 1e-300)
        dropped = itertools.combinations(range(n - e.spare, n), n - len(e.unknown))
        choices = [[i for i in self.rows if i not in rows] for rows in dropped]
        if not np.isfinite(jacobian).all():  # a kink: no choice encloses the rest
            self.rows = choices[0]
            return
        self.rows = max(choices, key=lambda rows: np.linalg.svd(jacobian[rows], compute_uv=False).min(initial=np.inf))

    def over(self, low: np.ndarray, high: np.ndarray, *, slopes: bool = True) -> Coefficients:
        """Return the coefficients over boxes with the ends low and high, shape (boxes, parameters + 1).

        Args:
            slopes: Also return the derivatives along the parameters; the added delay counts as the last.
        """
        e, count = self.equations, len(low)
        box = [Enclosure(low[:, i], high[:, i]) for i in range(self.params)]
        with np.errstate(all="ignore"):
            unknown, moves = self._enclose_rest(box, slopes)
            values, tangents = self.entries(box, unknown, range(self.params + len(unknown)) if slopes else ())

            def entry(i: int) -> Entry:
                if i == NO_ENTRY:
                    return None
                value = Enclosure(*(np.broadcast_to(x, (count,)) for x in (values[i].low, values[i].high)))
                total: Slopes = {}
                for k, slope in tangents.get(i, {}).items():
                    if k < self.params:
                        total[k] = total[k] + slope if k in total else slope
                    else:
                        for j, move in moves[k - self.params].items():
                            total[j] = total[j] + slope * move if j in total else slope * move
                return Jet(value, total)

            plant, controller = (
                [[[entry(i) for i in row] for row in matrix] for matrix in matrices]
                for matrices in (e.plant, e.controller)
            )
            added = Enclosure(low[:, -1], high[:, -1])
            delay = Jet(added, {self.params: Enclosure(np.ones(count))} if slopes else {})
            if e.delay != NO_ENTRY:
                delay = delay + (entry(e.delay) or delay)
            if e.period is not None:
                period = enclose_number(e.period)
                rest = delay - Jet(period.times(float(self.whole))) if self.broken else None
                # The input before the instant is one period older.
                plant, delay = (
                    _hold_input(plant, period, rest, count),
                    Jet(period.times(float(self.whole + self.broken))),
                )
            return Coefficients(_polynomials(plant, controller), delay)

    def _residual(
        self, box: list[Enclosure], unknown: list[Enclosure], slopes: bool = True
    ) -> tuple[Enclosure, Enclosure, Enclosure]:
        """Return the rest's rows (boxes, rows), their derivatives along unknowns and along parameters."""
        e, count = self.equations, len(unknown[0].low)
        values, tangents = self.rest(box, unknown, range(self.params + len(unknown)) if slopes else ())
        zero = Enclosure(np.zeros(()))

        def stack(columns: Sequence[Enclosure]) -> Enclosure:
            ends = [(np.broadcast_to(x.low, (count,)), np.broadcast_to(x.high, (count,))) for x in columns]
            return Enclosure(*(np.stack([pair[i] for pair in ends], -1) for i in (0, 1)))

        def along(variables: Iterable[int]) -> Enclosure:
            variables = list(variables)
            rows = [stack([tangents.get(i, {}).get(k, zero) for k in variables]) for i in e.rest] if variables else []
            if not rows:
                return Enclosure(np.zeros((count, len(e.rest), 0)))
            return Enclosure(np.stack([x.low for x in rows], 1), np.stack([x.high for x in rows], 1))

        n = self.params
        return stack([values[i] for i in e.rest]), along(range(n, n + len(unknown))), along(range(n))

    def _enclose_rest(self, box: list[Enclosure], slopes: bool) -> tuple[list[Enclosure], list[Slopes]]:
        """Return a range of each unknown over the boxes, and its derivatives along the parameters; NaN where none."""
        e, rows, n = self.equations, self.rows, len(self.equations.unknown)
        if not n:
            return [], []
        count = len(box[0].low) if box else 1
        middle = [Enclosure(x.middle()) for x in box]
        y = np.repeat(np.array(e.guess)[None], count, 0)
        inverse = np.full((count, n, n), np.nan)
        for _ in range(NEWTON_STEPS):
            residual, jacobian, _ = self._residual(middle, [Enclosure(x) for x in y.T])
            inverse = _inverses(jacobian.middle()[:, rows])
            step = (inverse @ residual.middle()[:, rows, None])[:, :, 0]
            y = y - step
            if not (np.abs(step) > 1e-12 * (1e-30 + np.abs(y))).any():
                break
        here = self._residual(box, [Enclosure(x) for x in y.T], slopes=False)[0]
        move = -_matmul(Enclosure(inverse), here[:, rows, None])[:, :, 0]  # -C F(y, P)
        radius = INFLATION * move.size() + 1e-13 * np.abs(y) + 1e-30
        good, ranges = np.zeros(count, bool), Enclosure(np.full_like(y, np.nan))
        eye = Enclosure(np.eye(n)[None])
        for _ in range(KRAWCZYK_TRIES):
            trial = Enclosure(np.nextafter(y - radius, -np.inf), np.nextafter(y + radius, np.inf))
            jacobian = self._residual(box, _columns(trial))[1]
            spread = eye - _matmul(Enclosure(inverse), jacobian[:, rows])
            image = Enclosure(y) + move + _matmul(spread, (trial - Enclosure(y))[:, :, None])[:, :, 0]
            inside = ((trial.low < image.low) & (image.high < trial.high)).all(1)
            new = inside & ~good
            ranges = Enclosure(
                *(np.where(new[:, None], a, b) for a, b in ((image.low, ranges.low), (image.high, ranges.high)))
            )
            good |= inside
            if good.all():
                break
            radius = INFLATION * np.maximum(image.high - y, y - image.low) + 1e-13 * np.abs(y) + 1e-30
        unknown = _columns(ranges)
        residual, jacobian, along = self._residual(box, unknown)
        for row in set(range(len(e.rest))) - set(rows):  # the row left out must follow from the others
            lost = ~((residual.low[:, row] <= 0) & (residual.high[:, row] >= 0))
            unknown = [Enclosure(*(np.where(lost, np.nan, x) for x in (u.low, u.high))) for u in unknown]
        if not slopes:
            return unknown, [{} for _ in unknown]
        matrix = _matmul(Enclosure(inverse), jacobian[:, rows])
        moves = _solve(matrix, -_matmul(Enclosure(inverse), along[:, rows])) if self.params else along
        return unknown, [{j: moves[:, i, j] for j in range(self.params)} for i in range(n)]


def _columns(x: Enclosure) -> list[Enclosure]:
    return [x[:, i] for i in range(x.low.shape[1])]


def _inverses(matrices: np.ndarray) -> np.ndarray:
    """Return the inverses of matrices in floats, NaN where there is none."""
    valid = np.isfinite(matrices).all((1, 2))
    scale = np.where(valid, np.abs(matrices).max((1, 2), initial=0.0), np.nan)
    valid &= (
        np.abs(np.linalg.det(np.where(valid, matrices.T, 1.0).T / np.where(scale > 0, scale, 1)[:, None, None])) > 0
    )
    inverse = np.linalg.inv(np.where(valid[:, None, None], matrices, np.eye(matrices.shape[1])))
    return np.where(valid[:, None, None], inverse, np.nan)


def _matmul(x: Enclosure, y: Enclosure) -> Enclosure:
    return (x[:, :, :, None] * y[:, None, :, :]).sum(2)


def _solve(matrix: Enclosure, right: Enclosure) -> Enclosure:
    """Return the solutions of interval equations by Gauss's elimination, for matrices close to I."""
    n, low, high = matrix.low.shape[1], right.low.copy(), right.high.copy()
    a_low, a_high = (
        np.broadcast_to(x, right.low.shape[:1] + matrix.low.shape[1:]).copy() for x in (matrix.low, matrix.high)
    )
    a, b = Enclosure(a_low, a_high), Enclosure(low, high)

    def set_row(x: Enclosure, i: int, row: Enclosure) -> None:
        x.low[:, i], x.high[:, i] = row.low, row.high

    for i in range(n):
        pivot = a[:, i, i].inverse()[:, None]
        for j in range(i + 1, n):
            factor = a[:, j, i][:, None] * pivot
            set_row(a, j, a[:, j] - factor * a[:, i])
            set_row(b, j, b[:, j] - factor * b[:, i])
    for i in reversed(range(n)):
        row = b[:, i]
        for j in range(i + 1, n):
            row = row - a[:, i, j][:, None] * b[:, j]
        set_row(b, i, row * a[:, i, i].inverse()[:, None])
    return b


# The operations.


class _Evaluation:
    """The values of some operations, and their derivatives along parameters and unknowns."""

    def __init__(self, equations: OpenedEquations, roots: Iterable[int]):
        e = self.equations = equations
        self.places = {state: i for i, state in enumerate(e.unknown)}
        self.slope_order = self._order(roots)
        factors = [e.operations[i].args[1] for i in self.slope_order if e.operations[i].name in FUNCTIONS]
        self.value_order = self._order([*self.slope_order, *factors])

    def _operands(self, i: int) -> list[int]:
        """Return the operations of which the value of another one is a function."""
        name, args, value = self.equations.operations[i]
        if name == "state":
            return [self.equations.settled[value]] if value in self.equations.settled else []
        if name in FUNCTIONS:
            return [args[0], *args[2:]]
        return [x for x in args if x >= 0]

    def _order(self, roots: Iterable[int]) -> list[int]:
        """Return the operations that the roots need, operands first."""
        order: dict[int, None] = {}
        stack = [(root, False) for root in roots]
        while stack:
            i, ready = stack.pop()
            if i in order:
                continue
            if ready:
                order[i] = None
            else:
                stack += [(i, True), *((x, False) for x in self._operands(i))]
        return list(order)

    def __call__(
        self, params: Sequence[Enclosure], unknown: Sequence[Enclosure], along: Iterable[int]
    ) -> tuple[dict[int, Any], dict[int, Slopes]]:
        """Return values, and derivatives along variables: parameters, then unknowns; a comparison is two truths."""
        values: dict[int, Any] = {}
        for i in self.value_order:
            values[i] = self._value(i, values, params, unknown)
        slopes: dict[int, Slopes] = {}
        variables = set(along)
        for i in self.slope_order if variables else ():
            if slope := self._slope(i, values, slopes, len(params), variables):
                slopes[i] = slope
        return values, slopes

    def _value(self, i: int, values: dict[int, Any], params: Sequence[Enclosure], unknown: Sequence[Enclosure]) -> Any:
        name, args, value = self.equations.operations[i]
        if name == "state":
            settled = self.equations.settled
            return values[settled[value]] if value in settled else unknown[self.places[value]]
        x: list[Any] = [values[a] if a >= 0 else None for a in (self._operands(i) if name in FUNCTIONS else args)]
        match name:
            case "const":
                return enclose_number(value)
            case "truth":
                return np.array(value), np.array(not value)
            case "param":
                return params[value]
            case "add":
                return x[0] + x[1]
            case "sub":
                return x[0] - x[1]
            case "mul":
                return x[0].square() if args[0] == args[1] else x[0] * x[1]
            case "neg":
                return -x[0]
            case "inv":
                return x[0].inverse()
            case "meet":
                return intersection(x[0], x[1])
            case "round":
                return Enclosure(np.rint(x[0].low), np.rint(x[0].high))
            case "sin" | "cos":
                return sine(x[0]) if name == "sin" else cosine(x[0])
            case "exp" | "atan":
                return monotone(np.exp if name == "exp" else np.arctan, x[0])
            case "log":
                return monotone(np.log, Enclosure(np.where(x[0].low > 0, x[0].low, np.nan), x[0].high))
            case "power":
                return enclose_power(x[0], x[1])
            case "clamp" | "inside":
                return _limit(name, *x)
            case "select":
                return _select(*x)
            case "lt" | "le" | "eq" | "ne":
                return _compare(name, x[0], x[1])
            case "not":
                return x[0][::-1]
            case "and":
                return x[0][0] & x[1][0], x[0][1] | x[1][1]
            case "or":
                return x[0][0] | x[1][0], x[0][1] & x[1][1]
        raise AssertionError(name)

    def _slope(
        self, i: int, values: dict[int, Any], slopes: dict[int, Slopes], params: int, variables: set[int]
    ) -> Slopes:
        name, args, value = self.equations.operations[i]
        if name == "param" or (name == "state" and value not in self.equations.settled):
            k = value if name == "param" else params + self.places[value]
            return {k: Enclosure(np.float64(1.0))} if k in variables else {}
        operands = self._operands(i)
        d = [slopes.get(a, {}) for a in operands]
        if name == "select":  # where the condition is open, the number may jump: no slope, though both sides have none
            zero, (yes, no) = Enclosure(np.float64(0.0)), values[args[0]]
            decided = yes | no
            valid = Enclosure(np.where(decided, 0.0, np.nan))
            both = {
                k: (d[1].get(k, zero), d[2].get(k, zero)) for k in ({**d[1], **d[2]} if decided.all() else variables)
            }
            return {k: _select((yes, no), a, b) + valid for k, (a, b) in both.items()}
        if not any(d):
            return {}
        if name in FUNCTIONS:
            return {k: values[args[1]] * x for k, x in d[0].items()}
        match name:
            case "state" | "meet":
                return d[0]
            case "add" | "sub":
                other = d[1] if name == "add" else {k: -x for k, x in d[1].items()}
                return _sum_slopes(d[0], other)
            case "neg":
                return {k: -x for k, x in d[0].items()}
            case "mul" if is_nought(self.equations.operations, i):
                nought: Enclosure = values[i]
                return dict.fromkeys((*d[0], *d[1]), nought)
            case "mul":
                x, y = (values[a] for a in args)
                return _sum_slopes({k: s * y for k, s in d[0].items()}, {k: x * s for k, s in d[1].items()})
            case "inv":
                factor = -values[i].square()
                return {k: factor * x for k, x in d[0].items()}
            case "clamp":
                inside = _limit("inside", values[args[0]], *(None if a < 0 else values[a] for a in args[1:]))
                moved = any(slopes.get(a) for a in args[1:])
                unknown = Enclosure(np.float64(np.nan))
                return {k: unknown if moved else inside * x for k, x in d[0].items()}
            case "inside" | "round" | "lt" | "le" | "eq" | "ne" | "not" | "and" | "or":
                valid = values[i] if name == "inside" else Enclosure(np.float64(np.nan))
                return {k: x * (valid - valid) for k, x in d[0].items()} if name in ("inside", "round") else {}
        raise AssertionError(name)


def _sum_slopes(x: Slopes, y: Slopes) -> Slopes:
    return {k: x[k] + y[k] if k in x and k in y else x[k] if k in x else y[k] for k in {**x, **y}}


def _limit(name: str, x: Enclosure, low: Enclosure | None, high: Enclosure | None) -> Enclosure:
    """Return x limited to [low, high], or the slope of that, which is NaN where x may be at a limit."""
    if name == "clamp":
        for limit, choose in ((low, np.maximum), (high, np.minimum)):
            x = x if limit is None else Enclosure(choose(x.low, limit.low), choose(x.high, limit.high))
        return x
    above = np.array(True) if low is None else x.low > low.high
    below = np.array(True) if high is None else x.high < high.low
    outside = np.zeros(np.shape(x.low), bool)
    outside = outside if low is None else outside | (x.high < low.low)
    outside = outside if high is None else outside | (x.low > high.high)
    return Enclosure(np.where(above & below, 1.0, np.where(outside, 0.0, np.nan)))


def _select(truth: tuple[Any, Any], no: Enclosure, yes: Enclosure) -> Enclosure:
    either = union(no, yes)
    return Enclosure(
        np.where(truth[0], yes.low, np.where(truth[1], no.low, either.low)),
        np.where(truth[0], yes.high, np.where(truth[1], no.high, either.high)),
    )


def _compare(name: str, x: Enclosure, y: Enclosure) -> tuple[Any, Any]:
    """Return where a comparison is surely true, and where it is surely false."""
    match name:
        case "lt":
            return x.high < y.low, x.low >= y.high
        case "le":
            return x.high <= y.low, x.low > y.high
    equal, apart = (x.low == y.high) & (x.high == y.low), (x.high < y.low) | (x.low > y.high)
    return (equal, apart) if name == "eq" else (apart, equal)


# Sampling.


def _hold_input(matrices: list[Entries], period: Enclosure, delay: Jet | None, count: int) -> list[Entries]:
    """Return the sampled plant (A - I, B, C) for an input that is held and changes a `delay` after each instant.

    With a delay B has two columns, G(T) and G(T - delay), where G(t) is the integral of e^(A s) B over [0, t]: the
    state moves by G(T - delay) u + (G(T) - G(T - delay)) u', u' the input before, which is (G(T) + s G(T - delay)) u'.
    """
    a, b, c = matrices
    n = len(a)
    generator = [[*a[i], b[i][0]] for i in range(n)] + [[None] * (n + 1)]
    whole = _exponential(generator, Jet(period), count)
    inputs = [[row[n]] for row in whole[:n]]
    if delay is not None:
        early = _exponential(generator, Jet(period) - delay, count)
        inputs = [[*row, early[i][n]] for i, row in enumerate(inputs)]
    return [[row[:n] for row in whole[:n]], inputs, c]


def _exponential(generator: Entries, time: Jet, count: int) -> Entries:
    """Return e^(M t) - I."""
    n = len(generator)
    x: Entries = [[None if entry is None else entry * time for entry in row] for row in generator]
    sizes = [[np.zeros(count) if e is None else np.broadcast_to(e.value.size(), (count,)) for e in row] for row in x]
    norms = [np.sum(row, axis=0) * (1 + 1e-12) for row in sizes]  # row sums, with their rounding
    norm = np.max(np.stack(norms), axis=0)
    largest = min(float(np.nanmax(norm, initial=0.0)), LARGEST_NORM)
    squarings = max(0, math.ceil(math.log2(largest))) if largest > 1 else 0
    scale = 2.0**-squarings
    x = [[None if e is None else e.times(scale) for e in row] for row in x]
    norm = norm * scale
    # The remainder is at most q^(k+1)/(k+1)! (1 + q/(k+2) + ...), with q the norm; q <= 1 gives a factor below 2.
    tail = 2.0 * norm ** (TAYLOR_TERMS + 1) / math.factorial(TAYLOR_TERMS + 1) * (1 + 1e-12)
    tail = np.where(norm <= 1 + 1e-9, tail + 1e-300, np.nan)
    total: Entries = [[None] * n for _ in range(n)]
    for k in reversed(range(1, TAYLOR_TERMS + 1)):
        part = enclose_number(float(k)).inverse()
        factor: Entries = [[None if e is None else e.follow(e.value * part, part) for e in row] for row in x]
        total = _plus(factor, _times(factor, total))
    remainder = Enclosure(-tail, tail)
    total = [[None if e is None else Jet(e.value + remainder, e.slopes) for e in row] for row in total]
    for _ in range(squarings):
        total = _plus([[None if e is None else e.times(2.0) for e in row] for row in total], _times(total, total))
    return total


def _plus(x: Entries, y: Entries) -> Entries:
    return [[_sum(a, b) for a, b in zip(p, q, strict=True)] for p, q in zip(x, y, strict=True)]


def _times(x: Entries, y: Entries) -> Entries:
    return [[_dot(row, [line[j] for line in y]) for j in range(len(y[0]))] for row in x] if y else []


def _dot(x: Sequence[Entry], y: Sequence[Entry]) -> Entry:
    total: Entry = None
    for a, b in zip(x, y, strict=True):
        total = _sum(total, _product(a, b))
    return total


def _sum(x: Entry, y: Entry) -> Entry:
    return y if x is None else x if y is None else x + y


def _product(x: Entry, y: Entry) -> Entry:
    if x is None or y is None:
        return None
    return y if x is ONE else x if y is ONE else x * y


# Polynomials.


def _polynomials(plant: list[Entries], controller: list[Entries]) -> list[Polynomial]:
    """Return the minors of the open loop: minus the controller behind the plant, without unobserved states.

    The inputs of the plant's B are those of all controls. Of a sampled loop behind the rest of a delay they are u, s u.
    """
    (a, b, c), (f, g, h, j) = plant, controller
    n, m, controls = len(a), len(f), len(j)
    whole = [[*row, *([None] * m)] for row in a]
    whole += [[*_times([g[i]], c)[0], *f[i]] if n else [*f[i]] for i in range(m)]
    into: list[list[Polynomial]] = [[row] if controls == 1 else [[x] for x in row] for row in b]
    nothing: Polynomial = [None]
    into += [[nothing] * controls for _ in range(m)]
    out = [[*row, *(h[i] if m else [])] for i, row in enumerate(_times(j, c))]
    observed = {i for row in out for i, x in enumerate(row) if x is not None}
    while more := {i for k in observed for i, x in enumerate(whole[k]) if x is not None} - observed:
        observed |= more
    keep = sorted(observed)
    size = len(keep) + 1
    matrix = [
        [[None if whole[i][k] is None else -_require(whole[i][k]), *([ONE] if i == k else [])] for k in keep]
        for i in keep
    ]
    minors = []
    for rows, columns in list_minors(controls):
        bordered = [[*row, *(into[i][k] for k in columns)] for row, i in zip(matrix, keep, strict=True)]
        bordered += [[*([out[i][k]] for k in keep), *([None] for _ in columns)] for i in rows]
        minor = _determinant(bordered)
        minors.append([*minor, *([None] * (size - len(minor)))])
    return minors


def _require(x: Entry) -> Jet:
    assert x is not None
    return x


def _determinant(matrix: list[list[Polynomial]]) -> Polynomial:
    """Return the determinant of a matrix of polynomials, by expansion along the rows."""
    minors: dict[int, Polynomial] = {0: [ONE]}
    for row in matrix:
        larger: dict[int, Polynomial] = {}
        for mask, minor in minors.items():
            for k, entry in enumerate(row):
                if mask >> k & 1 or all(x is None for x in entry):
                    continue
                product: Polynomial = [None] * (len(entry) + len(minor) - 1)
                for i, x in enumerate(entry):
                    for j, y in enumerate(minor):
                        product[i + j] = _sum(product[i + j], _product(x, y))
                if (mask >> k).bit_count() % 2:  # columns behind k that came before it
                    product = [None if x is None else -x for x in product]
                before = larger.get(mask | 1 << k, [])
                width = max(len(before), len(product))
                padded = [[*x, *([None] * (width - len(x)))] for x in (before, product)]
                larger[mask | 1 << k] = [_sum(x, y) for x, y in zip(*padded, strict=True)]
        minors = larger
    return minors.get((1 << len(matrix)) - 1, [])
