"""A second proof of one cell of parameters, in Arb's balls, by code that shares nothing with the native prover.

The checker reads the operations of `Equations` and nothing else. It needs python-flint (extra `proof`).

**Sets.** All runs of a cell lie in a set {c + G p + B r}. Here p in [-1, 1] are the cell's own parameters. The matrix G
keeps the dependence on them through time. The vector r lies in a box with the axes B (Lohner's method).

**One step** of length h has five parts.

1. Each limit becomes a chord: clamp(x) = lambda x + c + w with |w| <= delta, for x in the range of the whole step.
   Then delta is 0 unless the range lies across a limit.
2. Picard's iteration gives a box that no run leaves during the step. It gives the ranges of all limited numbers, too.
3. A Taylor polynomial is evaluated at the centre c, and its derivatives along G and B over the whole set. The mean
   value theorem adds them. The next coefficient over the box is Lagrange's remainder.
4. The disturbances w(t) move the state by at most D, where h (b + |M| D) <= D (Gronwall). Here b bounds their effect
   on the rates, and M is the Jacobian over the box.
5. The new B is orthonormal in scaled states (QR in floats). `arb_mat.inv` encloses its inverse, so B need not be exact.

A step fails if a part gives no result, or if its remainder or its disturbance is too wide. The checker then takes two
steps of half the length. That is its only choice of step lengths.

**A tick** is one relaxation: each limit adds a direction for its w.

**The end** of a run is where the margin m is 0. One set near the end is captured. All boxes from the first possible end
to the last bound m' < 0. By the mean value theorem a run ends m/|m'| after the captured set, where m is its own margin.

**The tail.** Given pieces of settled states (`reach/tail`), a cell ends once its set is inside one of them. What the
file says of that piece then holds for the rest of its runs. The file's pieces are checked as cells of their own.

**Series.** Coefficients of operations are computed when they are asked for, in lists of balls. The power u^2.1 has no
third derivative at u = 0. A step of lower order does not ask for it, and the checker takes such a step there.
"""

from collections.abc import Iterable, Sequence
from math import inf, isfinite
from sys import float_info
from typing import Any, NamedTuple, TypeVar

import numpy as np
from flint import arb, arb_mat, arb_poly, ctx

from diffabs.robust.reach import balls
from diffabs.robust.reach.balls import NotProved as NotProved
from diffabs.robust.reach.equations import LARGEST_INPUT, SLOWEST, Equations, RealOperation
from diffabs.robust.reach.tail import RunTail, TailPiece, stop_speed

LIMITED = ("clamp", "round")  # operations that a chord stands for
PRECISION = 96  # bits
ORDER = 7  # of the Taylor polynomials
LOWER_ORDERS = (2, 1)  # where a number has no more derivatives
TOLERANCE = 1e-9  # radius of a remainder, or of a disturbance's effect, that a step may add to a state
REMAINDER_SHARE = 1e-4  # of a state's own radius, which a remainder may be in addition
MAX_HALVINGS = 40  # of one given step
PICARD_TRIES = 40
BALANCE_INTERVAL = 16  # ticks, or steps of a continuous loop, between two choices of the scales of QR
NEW_SCALE_SHARE = 1 / 16  # of a new choice in the logarithms of the scales: each turn of the axes widens the set
SPEED_WEIGHT = 256.0  # of the speed over the slip, in the scales of QR for a sampled loop
ALONE_WEIGHT = 4096.0  # of a state that only itself moves, over the slip: the axes must not turn others into it
PIECES = 8  # of a step, for the bounds of a signal
SLICES = 40  # of the speeds that a settled run passes, for its time to the stop
FASTEST_SLIP = 1.0  # `check_slip_chart` holds for a slip below 1 and a speed above `SLOWEST`
ZERO, ONE, NO_SLOPE = arb(0), arb(1), arb_poly([])


Number = TypeVar("Number", arb, arb_poly)


class _StepFails(Exception):
    """A step is too long."""


class CheckedBounds(NamedTuple):
    """Proved bounds of all runs of a cell.

    Attributes:
        stop_time: Bounds of the time at which a run ends, low and high [s]; high is inf if the horizon comes first.
        distance: Bounds of the distance at the end, low and high [m]; high is inf if the horizon comes first.
        upper: Upper bound of each signal, in the signal's unit.
        lower: Lower bound of each signal, in the signal's unit.
    """

    stop_time: tuple[float, float]
    distance: tuple[float, float]
    upper: dict[str, float]
    lower: dict[str, float]


class _Chord(NamedTuple):
    """A limit for all arguments x of a range: clamp(x) = slope x + offset + w with |w| <= width.

    `limited` holds all values of the limit, and `values` those of the chord for every w as well.
    """

    slope: arb
    offset: arb
    width: arb
    limited: arb
    values: arb


# The operations, on power series.


class _Program:
    """The operations of a loop, and which of them the proof needs."""

    def __init__(self, equations: Equations, signals: Iterable[str]):
        e = self.equations = equations
        self.operations = e.operations
        self.static = self._find_static()
        self.signals = {name: e.signals[name] for name in signals}
        self.states = self._find_states()
        self.place = {state: i for i, state in enumerate(self.states)}
        self.flow = [e.flow[i] for i in self.states]
        self.tick = [e.tick[i] for i in self.states] if e.tick else []
        self.limits = self._limits([*self.flow, e.margin, *self.signals.values()])
        self.tick_limits = self._limits(self.tick)
        self.start_limits = self._limits([e.start[i] for i in self.states])

    def _find_static(self) -> list[bool]:
        """Return which operations depend on no state and no limit, whose chord may differ between two sets."""
        moving = [operation.name in ("state", *LIMITED) for operation in self.operations]
        while True:  # a factor may come after its function
            now = [m or any(moving[a] for a in o.args if a >= 0) for m, o in zip(moving, self.operations, strict=True)]
            if now == moving:
                return [not m for m in moving]
            moving = now

    def read_by(self, roots: Iterable[int]) -> set[int]:
        """Return the operations that `roots` need, themselves included."""
        needed: set[int] = set()
        pending = [root for root in roots if root >= 0]
        while pending:
            i = pending.pop()
            if i not in needed:
                needed.add(i)
                pending += [a for a in self.operations[i].args if a >= 0]
        return needed

    def _find_states(self) -> list[int]:
        """Return the states that decide the margin, the signals, the distance and the time, or may not be negative."""
        e = self.equations
        roots = {e.margin, *self.signals.values()} | {
            e.flow[i] for i in (e.travelled, e.clock if e.paced else -1) if i >= 0
        }
        while True:
            states = {self.operations[i].value for i in self.read_by(roots) if self.operations[i].name == "state"}
            states |= set(e.nonnegative)
            more = roots | {e.flow[i] for i in states} | ({e.tick[i] for i in states} if e.tick else set())
            if more == roots:
                return sorted(states)
            roots = more

    def _limits(self, roots: Iterable[int]) -> list[int]:
        """Return the limits and roundings among the operations that `roots` need, operands first."""
        limits = sorted(i for i in self.read_by(roots) if self.operations[i].name in LIMITED)
        for i in limits:
            if any(b >= 0 and not self.static[b] for b in self.operations[i].args[1:]):
                raise NotProved("a limit that changes during a run")
        return limits

    def states_alone(self) -> set[int]:
        """Return the states that only they themselves and others of this set move, such as a filtered target."""
        e, alone = self.equations, set[int]()
        while True:
            more = {
                i
                for i in self.states
                if {
                    self.operations[j].value
                    for j in self.read_by([e.flow[i], *([e.tick[i]] if e.tick else [])])
                    if self.operations[j].name == "state"
                }
                <= alone | {i}
            }
            if more <= alone:
                return alone
            alone |= more

    def keeps(self, state: int) -> bool:
        """Return whether a tick leaves a state unchanged."""
        e = self.equations
        return not e.tick or self.operations[e.tick[state]] == RealOperation("state", (), state)


class _Series:
    """Power series in time of all operations along the runs from one set, with derivatives along directions.

    A coefficient is computed when it is asked for. That of a state comes from that of its rate, so the series of the
    states solve the differential equation. Derivatives along all directions are one polynomial, used as a vector.
    """

    def __init__(
        self, program: _Program, parameters: Sequence[arb], states: Sequence[arb], *,
        halves: Sequence[arb] | None = None, tangents: Sequence[arb_poly] | None = None,
        centre: "_Series | None" = None, chords: dict[int, _Chord] | None = None, forced: bool = False,
        seeds: dict[int, tuple[int, arb]] | None = None, constants: "_Series | None" = None,
    ):  # fmt: skip
        """Make the series of one set.

        Args:
            states: Values of the states at the start.
            halves: Derivative of each parameter along the direction of its number; None: 0.
            tangents: Derivatives of each state along the directions.
            centre: The series at the centre of the set: values are then also within the mean value form.
            chords: Of limits. Those without one have no value.
            forced: Limits take all values of the true and of the relaxed limit, and `states` is a box of a whole step.
            seeds: Direction of each limit's disturbance w, and its size there.
            constants: Series whose values of what depends on no state are taken.
        """
        self.program, self.parameters, self.start = program, parameters, states
        self.halves, self.tangents, self.centre = halves, tangents, centre
        self.forced = forced
        # Both may be filled later, so an empty one is kept.
        self.chords, self.seeds = {} if chords is None else chords, {} if seeds is None else seeds
        count = len(program.operations)
        self.v: list[list[arb]] = [[] for _ in range(count)]
        self.d: list[list[arb_poly]] = [[] for _ in range(count)]
        self.squares: dict[int, list[arb]] = {}
        if constants is not None:
            for i, static in enumerate(program.static):
                if static:
                    self.v[i], self.d[i] = constants.v[i], constants.d[i]

    def value(self, i: int, k: int = 0) -> arb:
        """Return coefficient k of operation i."""
        if k and self.program.static[i]:
            return ZERO
        coefficients = self.v[i]
        while len(coefficients) <= k:
            x = self._value(i, len(coefficients))
            name = self.program.operations[i].name
            # The program computes the value itself, but no further coefficient, in doubles.
            largest = inf if coefficients else LARGEST_INPUT if name in ("state", "param") else float_info.max
            if not (x.is_finite() and x.abs_upper() < largest):
                raise balls.Undefined(f"{name}: no finite value")
            coefficients.append(x)
        return coefficients[k]

    def values(self, i: int, k: int) -> list[arb]:
        """Return coefficients 0 to k of operation i, which depends on a state; further ones may follow."""
        self.value(i, k)
        return self.v[i]

    def slope(self, i: int, k: int = 0) -> arb_poly:
        """Return the derivatives of coefficient k of operation i along the directions."""
        if k and self.program.static[i]:
            return NO_SLOPE
        derivatives = self.d[i]
        while len(derivatives) <= k:
            derivatives.append(self._slope(i, len(derivatives)))
        return derivatives[k]

    def width(self, i: int) -> arb:
        """Return the ball of all changes of operation i from the centre of the set, to first order."""
        return sum((balls.symmetric(x) for x in self.slope(i).coeffs()), ZERO)

    def range(self, i: int) -> arb:
        """Return a ball with all values of operation i at the start, from the mean value theorem too."""
        x = self.value(i)
        if self.centre is None or self.program.static[i]:
            return x
        return balls.common(x, self.centre.value(i) + self.width(i))

    def truth(self, i: int) -> bool:
        """Return a condition that all numbers of the set decide alike."""
        o = self.program.operations[i]
        match o.name:
            case "truth":
                return bool(o.value)
            case "not":
                return not self.truth(o.args[0])
            case "and":
                return self.truth(o.args[0]) and self.truth(o.args[1])
            case "or":
                return self.truth(o.args[0]) or self.truth(o.args[1])
        x, y = (self.range(a) for a in o.args)
        match o.name:
            case "lt":
                yes, no = x.upper() < y.lower(), x.lower() >= y.upper()
            case "le":
                yes, no = x.upper() <= y.lower(), x.lower() > y.upper()
            case "eq" | "ne":
                equal, apart = x.is_exact() and y.is_exact() and x == y, not x.overlaps(y)
                yes, no = (equal, apart) if o.name == "eq" else (apart, equal)
            case _:
                raise NotProved(f"{o.name}: no such condition")
        if not (yes or no):
            raise balls.Undefined("a condition that the runs decide differently")
        return yes

    def _value(self, i: int, k: int) -> arb:
        o, value, static = self.program.operations[i], self.value, self.program.static
        match o.name:
            case "const":
                return balls.constant(o.value)
            case "param":
                return self.parameters[o.value]
            case "state":
                place = self.program.place[o.value]
                return value(self.program.flow[place], k - 1) / k if k else self.start[place]
            case "add":
                return value(o.args[0], k) + value(o.args[1], k)
            case "sub":
                return value(o.args[0], k) - value(o.args[1], k)
            case "neg":
                return -value(o.args[0], k)
            case "mul":
                a, b = o.args
                if k == 0:
                    y = balls.product(value(a), value(b))
                    return y.nonnegative_part() if a == b and y.lower() < 0 else y
                if static[a]:
                    return value(a) * value(b, k)
                if static[b]:
                    return value(a, k) * value(b)
                x, y = self.values(a, k), self.values(b, k)
                return _dot(x, y, 0, k, k)
            case "inv":
                (a,) = o.args
                if k == 0:
                    if value(a).contains(0):
                        raise balls.Undefined("a division by a number that may be 0")
                    return 1 / value(a)
                x, y = self.values(a, k), self.v[i]
                return -_dot(x, y, 1, k, k) * y[0]
            case "clamp" | "round":
                return self._limit(i, k)
            case "select":
                return value(o.args[2 if self.truth(o.args[0]) else 1], k)
            case "meet":
                x = value(o.args[0], k)
                return x if k else balls.common(x, value(o.args[1]))
        if k == 0:
            x = value(o.args[0])
            match o.name:
                case "power":
                    return balls.positive_power(x, value(o.args[2]))
                case "exp":
                    return x.exp()
                case "log":
                    return x.log()
                case "sin":
                    return x.sin()
                case "cos":
                    return x.cos()
                case "atan":
                    return x.atan()
            raise NotProved(f"{o.name}: the checker has no such operation")
        u, g = self.values(o.args[0], k), self.values(o.args[1], k - 1)  # y' = g u'
        y = k * u[k] * g[0]
        for j in range(1, k):
            y += j * u[j] * g[k - j]
        return y / k

    def _chord(self, i: int) -> _Chord:
        if i not in self.chords:
            raise balls.Undefined("a limit of a number that has no value")
        return self.chords[i]

    def _limit(self, i: int, k: int) -> arb:
        """Return coefficient k of a limit."""
        chord, a = self._chord(i), self.program.operations[i].args[0]
        if self.forced:
            if k == 0:
                return chord.values
            x = self.value(a, k)
            # The limit has the slope 0 or 1 nearly everywhere, and the chord a slope between them.
            return chord.slope * x if chord.width.is_zero() else balls.hull(ZERO, x)
        if chord.slope.is_zero():
            y = chord.offset if k == 0 else ZERO
        else:
            y = chord.slope * self.value(a, k) + (chord.offset if k == 0 else ZERO)
        if k == 0 and i in self.seeds:
            y += balls.symmetric(chord.width)
        return y

    def _slope(self, i: int, k: int) -> arb_poly:
        o, value, slope, static = self.program.operations[i], self.value, self.slope, self.program.static
        match o.name:
            case "const":
                return NO_SLOPE
            case "param":
                return _along(o.value, self.halves[o.value]) if self.halves is not None else NO_SLOPE
            case "state":
                place = self.program.place[o.value]
                if k:
                    return slope(self.program.flow[place], k - 1) * (ONE / k)
                return self.tangents[place] if self.tangents is not None else NO_SLOPE
            case "add":
                return slope(o.args[0], k) + slope(o.args[1], k)
            case "sub":
                return slope(o.args[0], k) - slope(o.args[1], k)
            case "neg":
                return -slope(o.args[0], k)
            case "mul":
                a, b = o.args
                if static[a]:
                    return slope(b, k) * value(a) + slope(a) * value(b, k)
                if static[b]:
                    return slope(a, k) * value(b) + slope(b) * value(a, k)
                return self._convolve(a, self.values(b, k), k) + self._convolve(b, self.values(a, k), k)
            case "inv":  # d(1/a) = -(1/a)^2 da
                return -self._convolve(o.args[0], self._squares(i, k), k)
            case "clamp" | "round":
                chord = self._chord(i)
                y = NO_SLOPE if chord.slope.is_zero() else slope(o.args[0], k) * chord.slope
                if k == 0 and i in self.seeds:
                    y = y + _along(*self.seeds[i])
                return y
            case "select":
                return slope(o.args[2 if self.truth(o.args[0]) else 1], k)
            case "meet":
                return slope(o.args[0], k)
        return self._convolve(o.args[0], self.values(o.args[1], k), k)  # dy = g du

    def _squares(self, i: int, k: int) -> list[arb]:
        """Return coefficients 0 to k of the square of operation i."""
        coefficients, x = self.squares.setdefault(i, []), self.values(i, k)
        while len(coefficients) <= k:
            m = len(coefficients)
            coefficients.append(_dot(x, x, 0, m, m))
        return coefficients

    def _convolve(self, a: int, values: list[arb], k: int) -> arb_poly:
        """Return coefficient k of the derivatives of operation a times the series with these coefficients."""
        self.slope(a, k)
        return _dot(self.d[a], values, 0, k, k)


def _along(direction: int, size: arb) -> arb_poly:
    return arb_poly([*[ZERO] * direction, size])


def _dot(x: Sequence[Number], y: Sequence[arb], first: int, last: int, k: int) -> Number:
    """Return the sum of x[j] y[k - j] for j from `first` to `last`."""
    total = x[first] * y[k - first]
    for j in range(first + 1, last + 1):
        total += x[j] * y[k - j]
    return total


def _at(coefficients: Sequence[Number], t: arb) -> Number:
    y = coefficients[-1]
    for x in reversed(coefficients[:-1]):
        y = y * t + x
    return y


def _relax(x: arb, low: arb | None, high: arb | None) -> _Chord:
    """Return the chord of a limit for all arguments in x."""

    def clamp(y: arb) -> arb:
        a, b = y.lower(), y.upper()
        if low is not None:
            a, b = max(a, low.lower()), max(b, low.upper())
        if high is not None:
            a, b = min(a, high.lower()), min(b, high.upper())
        return balls.between(a, b)

    a, b = x.lower(), x.upper()
    if low is not None and b <= low.lower():
        return _Chord(ZERO, low, ZERO, low, low)
    if high is not None and a >= high.upper():
        return _Chord(ZERO, high, ZERO, high, high)
    if (low is None or a >= low.upper()) and (high is None or b <= high.lower()):
        return _Chord(ONE, ZERO, ZERO, x, x)
    slope = arb(min(1.0, max(0.0, float(((clamp(b) - clamp(a)) / (b - a)).mid())))) if b > a else ZERO
    # clamp(y) - slope y is piecewise linear: its extremes lie at the ends and at the limits between them.
    inside = [y for y in (low, high) if y is not None and not (y.upper() < a or y.lower() > b)]
    gaps = [clamp(y) - slope * y for y in (a, b, *inside)]
    offset = (min(y.lower() for y in gaps) + max(y.upper() for y in gaps)) / 2
    offset = arb(float(offset.mid()))
    width = max((y - offset).abs_upper() for y in gaps).upper()
    return _Chord(slope, offset, width, clamp(x), balls.hull(clamp(x), slope * x + offset + balls.symmetric(width)))


def _remainder(series: _Series, rate: int, order: int) -> arb:
    """Return Lagrange's remainder of the integral of a rate, divided by h^order; `series` is that over the box."""
    return series.value(rate, order - 1) / order


# Sets, and what moves them.


class _Quadrature:
    """A state that the runs add up and nothing reads: centre + slopes p + [-uncertainty, uncertainty]."""

    def __init__(self, rate: int, centre: arb, slopes: np.ndarray):
        self.rate, self.centre, self.slopes, self.uncertainty = rate, centre, slopes, ZERO

    def copy(self) -> "_Quadrature":
        twin = _Quadrature(self.rate, self.centre, self.slopes.copy())
        twin.uncertainty = self.uncertainty
        return twin

    def add(self, centre: arb, slopes: arb_poly, slack: arb) -> None:
        """Add an integral with a centre, derivatives along the directions, and an uncertainty."""
        n = len(self.slopes)
        total = [arb(float(self.slopes[j])) + slopes[j] for j in range(n)]
        self.slopes = np.array([float(x.mid()) for x in total])
        lost = sum((balls.symmetric(x - float(s)) for x, s in zip(total, self.slopes, strict=True)), ZERO)
        lost += sum((balls.symmetric(slopes[j]) for j in range(n, len(slopes))), ZERO)
        self.centre += centre
        self.uncertainty = (self.uncertainty + (lost + balls.symmetric(slack)).abs_upper()).upper()

    def box(self) -> arb:
        return (
            self.centre
            + sum((balls.symmetric(arb(float(s))) for s in self.slopes), ZERO)
            + balls.symmetric(self.uncertainty)
        )


class _Capture(NamedTuple):
    """The set at one time near the end: margin and its derivatives, time, distance."""

    margin: arb
    slopes: arb_poly
    whole: arb
    clock: _Quadrature
    travelled: _Quadrature | None


class _Check:
    """The proof of one cell."""

    def __init__(self, equations: Equations, signals: Iterable[str], cell: Sequence[tuple[float, float]], order: int):
        e, self.order = equations, order
        if len(cell) != len(e.params):
            raise NotProved("the cell needs one pair of numbers for each parameter")
        p = self.program = _Program(e, signals)
        mids = [arb(float(low) + (float(high) - float(low)) / 2) for low, high in cell]
        self.halves = [
            max((arb(float(high)) - m).upper(), (m - arb(float(low))).upper())
            for m, (low, high) in zip(mids, cell, strict=True)
        ]
        # The radius of a ball is rounded up, so a cell from 0 would have negative numbers.
        balls = [(m + arb(0, h), low) for m, h, (low, _) in zip(mids, self.halves, cell, strict=True)]
        self.mids, self.all = mids, [x.nonnegative_part() if low >= 0 else x for x, low in balls]
        self.n, self.np = len(p.states), len(mids)
        self.slip = p.place.get(e.nonnegative[0], -1) if e.nonnegative else -1
        self.speed = p.place.get(e.speed, -1)
        if len(e.nonnegative) > 1 or any(not p.keeps(i) for i in e.nonnegative):
            raise NotProved("only one state that stays nonnegative, and that no tick moves, has a rule")
        margins = [p.operations[i].value for i in p.read_by([e.margin]) if p.operations[i].name == "state"]
        if any(not p.keeps(i) for i in margins) or (e.travelled >= 0 and not p.keeps(e.travelled)):
            raise NotProved("a tick moves the margin or the distance")
        self.top, self.bottom = {s: -arb("inf") for s in p.signals}, {s: arb("inf") for s in p.signals}
        nothing = [ZERO] * self.n
        self.constant_mid = _Series(p, self.mids, nothing)
        self.constant_all = _Series(p, self.all, nothing, halves=self.halves)
        self.weights = np.ones(self.n)
        self.alone = [p.place[i] for i in p.states_alone()]
        self.steps = 0
        self.elapsed = ZERO  # the independent variable
        self.rates: dict[str, arb] | None = None  # of the margin, the time and the distance, near the end
        self.capture: _Capture | None = None
        self.begin()

    def point(self, states: Sequence[arb], **how: Any) -> _Series:
        """Return the series at one state and the centre of the cell."""
        return _Series(self.program, self.mids, states, constants=self.constant_mid, **how)

    def whole(self, states: Sequence[arb], **how: Any) -> _Series:
        """Return the series of a set of states and all parameters of the cell."""
        return _Series(self.program, self.all, states, halves=self.halves, constants=self.constant_all, **how)

    def begin(self) -> None:
        e, p = self.program.equations, self.program
        tangents = [NO_SLOPE] * self.n
        start = [e.start[i] for i in p.states]
        if any(p.operations[i].name == "state" for i in p.read_by(start)):
            raise NotProved("a start that depends on a state")
        point, whole, _ = self.relax_limits(p.start_limits, [ZERO] * self.n, [ZERO] * self.n, tangents, self.np)
        self.B, self.r = np.eye(self.n), [ZERO] * self.n
        self.G, self.c = np.zeros((self.n, self.np)), [0.0] * self.n
        self.renew(
            [point.value(i) for i in start],
            [whole.slope(i) for i in start],
            [ZERO] * self.n,
            extra=len(p.start_limits),
            turn=False,
        )
        if self.slip >= 0 and whole.value(start[self.slip]).lower() < 0:
            raise NotProved("a state that must not be negative starts below 0")

        def quadrature(i: int) -> _Quadrature | None:
            return _Quadrature(e.flow[i], point.value(e.start[i]), np.zeros(self.np)) if i >= 0 else None

        for i in (e.travelled, e.clock if e.paced else -1):
            if i >= 0 and not whole.value(e.start[i]).is_exact():
                raise NotProved("distance and time must start at an exact number")
        self.travelled, self.clock = quadrature(e.travelled), quadrature(e.clock) if e.paced else None
        if not self.at_ends().value(e.margin).lower() > 0:
            raise NotProved("a run ends at its start")

    # The set.

    def directions(self) -> list[arb_poly]:
        """Return the derivatives of each state along the parameters, then along the axes B."""
        return [
            arb_poly(
                [*(arb(float(g)) for g in self.G[i]), *(arb(float(self.B[i, j])) * self.r[j] for j in range(self.n))]
            )
            for i in range(self.n)
        ]

    def centre(self) -> list[arb]:
        return [arb(x) for x in self.c]

    def box(self, tangents: Sequence[arb_poly] | None = None) -> list[arb]:
        """Return a box that contains the set."""
        tangents = self.directions() if tangents is None else tangents
        X = [
            c + sum((balls.symmetric(x) for x in t.coeffs()), ZERO)
            for c, t in zip(self.centre(), tangents, strict=True)
        ]
        s = self.slip
        if s >= 0 and X[s].lower() < 0:  # no run is there: see `stays_nonnegative`
            if self.c[s] < 0:
                raise NotProved("the centre of the set left the states that exist")
            X[s] = X[s].nonnegative_part()
        return X

    def at_ends(self) -> _Series:
        """Return the series of the set between two steps, without derivatives of limits."""
        tangents = self.directions()
        return self.whole(self.box(tangents), tangents=tangents, centre=self.point(self.centre()))

    def relax_limits(
        self,
        limits: Sequence[int],
        centre: Sequence[arb],
        states: Sequence[arb],
        tangents: Sequence[arb_poly],
        first: int,
    ) -> tuple[_Series, _Series, dict[int, _Chord]]:
        """Return the series at the centre and over the set, and the chords of limits for this set.

        The disturbance w of limit number q is the direction `first` + q.
        """
        chords: dict[int, _Chord] = {}
        seeds: dict[int, tuple[int, arb]] = {}
        point = self.point(centre, chords=chords)
        whole = self.whole(states, tangents=tangents, centre=point, chords=chords, seeds=seeds)
        for q, i in enumerate(limits):
            try:
                chords[i] = self.chord(whole, i, whole.range(self.program.operations[i].args[0]))
                seeds[i] = (first + q, chords[i].width)
            except balls.Undefined:
                continue  # an error where the limit is needed
        return point, whole, chords

    def chord(self, series: _Series, i: int, x: arb) -> _Chord:
        """Return the chord of a limit, or of a rounding x + w with |w| <= 1/2, for arguments in x."""
        if self.program.operations[i].name == "round":
            values = x + arb(0, 0.5)
            return _Chord(ONE, ZERO, arb(0.5), values, values)
        low, high = (series.value(b) if b >= 0 else None for b in self.program.operations[i].args[1:])
        return _relax(x, low, high)

    def renew(
        self,
        centre: Sequence[arb],
        slopes: Sequence[arb_poly],
        uncertainty: Sequence[arb],
        extra: int = 0,
        turn: bool = True,
    ) -> None:
        """Make the set of a centre, derivatives along the directions, and an uncertainty.

        The directions are the parameters, the axes B, and `extra` more.
        """
        n, np_ = self.n, self.np
        columns = n + extra
        c = [float(x.mid()) for x in centre]
        if self.slip >= 0 and c[self.slip] < 0 <= self.c[self.slip]:
            c[self.slip] = 0.0
        G = np.array([[float(slopes[i][j].mid()) for j in range(np_)] for i in range(n)]).reshape(n, np_)
        A = np.array([[float(slopes[i][np_ + j].mid()) for j in range(columns)] for i in range(n)]).reshape(n, columns)
        if not (np.isfinite(c).all() and np.isfinite(G).all() and np.isfinite(A).all()):
            raise _StepFails("the set has no bounds")
        E = [
            centre[i]
            - c[i]
            + uncertainty[i]
            + sum((balls.symmetric(slopes[i][j] - float(G[i, j])) for j in range(np_)), ZERO)
            for i in range(n)
        ]
        # A state without any spread keeps its own axis, so that a torque of exactly 0 stays exactly 0.
        spread = [
            i for i in range(n) if not E[i].is_zero() or any(not slopes[i][np_ + j].is_zero() for j in range(columns))
        ]
        B, r = np.eye(n), [ZERO] * n
        if spread:
            axes = self.axes(A[spread], self.weights[spread]) if turn else np.eye(len(spread))
            B[np.ix_(spread, spread)] = axes
            try:
                inverse = arb_mat(axes.tolist()).inv()
            except ZeroDivisionError:
                raise _StepFails("the axes have no inverse") from None
            for row, state in enumerate(spread):
                size = balls.symmetric(sum((inverse[row, k] * E[i] for k, i in enumerate(spread)), ZERO))
                for j in range(np_, np_ + columns):
                    size += balls.symmetric(sum((inverse[row, k] * slopes[i][j] for k, i in enumerate(spread)), ZERO))
                r[state] = arb(balls.above(size.abs_upper()))
        if not all(x.is_finite() for x in r):
            raise _StepFails("the set has no bounds")
        self.c, self.G, self.B, self.r = c, G, B, r

    @staticmethod
    def axes(A: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return axes near the columns of A, the longest first, which are orthonormal in states times `weights`."""
        scaled = weights[:, None] * A
        lengths = np.linalg.norm(scaled, axis=0)
        scaled = scaled[:, np.argsort(-lengths, kind="stable")]
        # The unit vectors complete the axes where A has too few.
        few = np.eye(len(A)) * 1e-30 * max(lengths.max(initial=0.0), 1e-300)
        return np.linalg.qr(np.hstack([scaled, few]))[0][:, : len(A)] / weights[:, None]

    def balance(self, period: float) -> None:
        """Choose the scales of the states for QR; every choice is sound.

        They balance the Jacobian of the loop without limits at the centre, for a sampled loop that of a whole period.
        They follow it slowly.
        """
        p, n = self.program, self.n
        tangents = [_along(i, ONE) for i in range(n)]
        free = {i: _Chord(ONE, ZERO, ZERO, ZERO, ZERO) for i in (*p.limits, *p.tick_limits)}
        series = _Series(p, self.mids, self.centre(), tangents=tangents, chords=free)

        def matrix(roots: Sequence[int]) -> np.ndarray:
            return np.array([[float(series.slope(r)[j].mid()) for j in range(n)] for r in roots])

        try:
            flow = matrix(p.flow)
            total = np.abs(flow)
            if p.tick:
                power = step = np.eye(n)
                for k in range(1, 30):
                    power = power @ flow * (period / k)
                    step = step + power
                tick = matrix(p.tick)
                total = np.maximum(np.abs(tick @ step), np.abs(step @ tick))  # a set is renewed after both
        except balls.Undefined:
            return
        if np.isfinite(total).all():
            weights = _balance_matrix(total)
            if self.slip >= 0:
                weights[self.alone] = ALONE_WEIGHT * weights[self.slip]
            if p.tick and self.speed >= 0 and self.slip >= 0:
                # An error of the speed stays, while one of the slip decays: the axes must not turn speed into slip.
                weights[self.speed] = weights[self.slip] * SPEED_WEIGHT
            share = NEW_SCALE_SHARE if self.steps else 1.0
            self.weights = weights**share * self.weights ** (1 - share)

    # Moves.

    def advance(self, h: arb, depth: int = 0) -> None:
        """Move the set by h, in halves where a step fails."""
        try:
            self.step(h)
        except (_StepFails, balls.Undefined) as reason:
            if depth >= MAX_HALVINGS:
                raise NotProved(f"{reason} at {float(self.elapsed.mid()):g}") from None
            self.advance(h / 2, depth + 1)
            self.advance(h / 2, depth + 1)

    def step(self, h: arb) -> None:
        p, e, n = self.program, self.program.equations, self.n
        tangents, centre = self.directions(), self.centre()
        X = self.box(tangents)
        box, chords, boxed = self.enclose(centre, X, tangents, h)
        self.stays_nonnegative(box, chords)
        moved, failure = None, balls.Undefined("no order")
        for order in (self.order, *LOWER_ORDERS):
            try:
                moved = self.taylor(centre, X, tangents, box, chords, order)
                break
            except balls.Undefined as reason:
                failure = reason
        if moved is None:
            raise failure
        point, whole, far, order = moved
        push, slack = self.disturb(box, chords, h)
        power = h ** (order + 1)
        remainders = [_remainder(far, rate, order + 1) * power for rate in p.flow]
        totals = [q for q in (self.travelled, self.clock) if q is not None]
        total_rest = [_remainder(far, q.rate, order + 1) * power for q in totals]
        room = [TOLERANCE + REMAINDER_SHARE * x.rad() for x in X] + [arb(TOLERANCE)] * len(totals)
        if not all(x.rad() < allowed for x, allowed in zip((*remainders, *total_rest), room, strict=True)):
            raise _StepFails("the remainder of a step is too wide")
        across = any(not x.is_zero() for x in push)
        crossed = [q for q, chord in chords.items() if not chord.width.is_zero()]
        if (
            across
            and max(x.abs_upper() for x in push) > TOLERANCE
            and any(self.ranges[q][1].rad() > 2 * self.ranges[q][0].rad() for q in crossed)
        ):
            raise _StepFails("a step across a limit is too long")

        def integral(rate: int, k: int) -> arb:
            return point.value(rate, k) / (k + 1)

        C = [_at([centre[i], *(integral(p.flow[i], k) for k in range(order))], h) for i in range(n)]
        J = [
            _at([tangents[i], *(whole.slope(p.flow[i], k) * (ONE / (k + 1)) for k in range(order))], h)
            for i in range(n)
        ]
        before = self.c, self.G, self.B, self.r
        sums = []
        for q, extra in zip(totals, total_rest, strict=True):
            middle = _at([ZERO, *(integral(q.rate, k) for k in range(order))], h)
            along = _at([NO_SLOPE, *(whole.slope(q.rate, k) * (ONE / (k + 1)) for k in range(order))], h)
            sums.append((q, middle + extra, along, h * slack.get(q.rate, ZERO)))
        limits = self.signal_bounds(point, whole, far, boxed, h, order, slack)
        margin, margin_rate = boxed.value(e.margin), boxed.value(e.margin, 1)
        near = {"margin": margin_rate, "clock": boxed.value(self.clock.rate) if self.clock else ONE}
        near["travelled"] = boxed.value(self.travelled.rate) if self.travelled else ZERO
        if self.clock is not None and not near["clock"].lower() > 0:
            raise _StepFails("time may stand still")
        ends = self.rates is not None or not margin.lower() > 0
        if ends and not margin_rate.upper() < 0:
            raise _StepFails("the margin may rise near the end")
        self.renew([x + y for x, y in zip(C, remainders, strict=True)], J, push)
        try:
            X = self.box()
        except NotProved as reason:
            self.c, self.G, self.B, self.r = before
            raise _StepFails(str(reason)) from None
        # Nothing fails from here.
        for q, *increment in sums:
            q.add(*increment)
        for name, (low, high) in limits.items():
            self.top[name], self.bottom[name] = max(self.top[name], high), min(self.bottom[name], low)
        if ends:
            self.rates = near if self.rates is None else {x: balls.hull(near[x], self.rates[x]) for x in near}
        self.elapsed += h
        self.steps += 1

    def enclose(
        self, centre: Sequence[arb], X: Sequence[arb], tangents: Sequence[arb_poly], h: arb
    ) -> tuple[list[arb], dict[int, _Chord], _Series]:
        """Return a box that no run leaves for a time h, the chords of limits there, and the series of the runs in it.

        A limit takes every value that it or its chord has for arguments in its range. Suppose that the integrals of the
        rates leave neither box nor ranges. Then these hold for the runs with limits and for those with chords (w = 0).
        """
        p, s = self.program, self.slip
        _, whole, _ = self.relax_limits(p.limits, centre, X, tangents, self.np + self.n)
        arguments = {i: p.operations[i].args[0] for i in whole.chords}
        at_start = {i: whole.range(a) for i, a in arguments.items()}
        # What depends on another limit jumps at the start of a step, where the chord of that limit changes.
        nested = {i for i, a in arguments.items() if any(p.operations[j].name == "clamp" for j in p.read_by([a]))}

        def image(
            box: list[arb], ranges: dict[int, arb]
        ) -> tuple[list[arb], dict[int, arb], dict[int, _Chord], _Series]:
            chords = {i: self.chord(whole, i, x) for i, x in ranges.items()}
            series = self.whole(box, chords=chords, forced=True)
            moved = [x + balls.integral_range(series.value(rate), h) for x, rate in zip(X, p.flow, strict=True)]
            if s >= 0:
                moved[s] = moved[s].nonnegative_part() if moved[s].lower() < 0 else moved[s]
            argument = {
                i: series.value(a) if i in nested else at_start[i] + balls.integral_range(series.value(a, 1), h)
                for i, a in arguments.items()
            }
            return moved, argument, chords, series

        box, ranges = list(X), dict(at_start)
        for _ in range(PICARD_TRIES):
            moved, argument, chords, _ = image(box, ranges)
            if all(b.contains(m) for b, m in zip(box, moved, strict=True)) and all(
                ranges[i].contains(argument[i]) for i in ranges
            ):
                break
            box = [b if b.contains(m) else _wider(balls.hull(b, m)) for b, m in zip(box, moved, strict=True)]
            if s >= 0:
                box[s] = box[s].nonnegative_part() if box[s].lower() < 0 else box[s]
            ranges = {
                i: x if x.contains(argument[i]) else _wider(balls.hull(x, argument[i])) for i, x in ranges.items()
            }
        else:
            raise _StepFails("no box holds the runs of a step")
        # The image holds the runs as well. Where it proves itself once more, its chords are narrower.
        narrow, narrower = moved, argument
        again, argument, new_chords, _ = image(narrow, narrower)
        if all(b.contains(m) for b, m in zip(narrow, again, strict=True)) and all(
            narrower[i].contains(argument[i]) for i in ranges
        ):
            ranges, chords = narrower, new_chords
        series = self.whole(narrow, chords=chords, forced=True)
        box = [
            balls.common(x + balls.integral_range(series.value(rate), h), b)
            for x, rate, b in zip(X, p.flow, narrow, strict=True)
        ]
        if s >= 0 and box[s].lower() < 0:
            box[s] = box[s].nonnegative_part()
        self.ranges = {i: (at_start[i], ranges[i]) for i in ranges}
        if s >= 0 and not box[s].upper() < FASTEST_SLIP:
            raise _StepFails("a wheel may lock")
        if self.speed >= 0 and not box[self.speed].lower() > float(SLOWEST):
            raise _StepFails("the vehicle may stand")
        true = {i: chord._replace(values=chord.limited) for i, chord in chords.items()}
        return box, chords, self.whole(box, chords=true, forced=True)

    def stays_nonnegative(self, box: Sequence[arb], chords: dict[int, _Chord]) -> None:
        """Check that no run leaves the states that are not negative: where that state is 0, it does not fall."""
        s = self.slip
        if s < 0 or box[s].lower() > 0:
            return
        face = list(box)
        face[s] = ZERO
        if self.whole(face, chords=chords, forced=True).value(self.program.flow[s]).lower() < 0:
            raise _StepFails("a state that must not be negative may fall below 0")

    def taylor(
        self, centre: Sequence[arb], X: Sequence[arb], tangents: Sequence[arb_poly], box: Sequence[arb],
        chords: dict[int, _Chord], order: int,
    ) -> tuple[_Series, _Series, _Series, int]:  # fmt: skip
        """Return the series at the centre, over the set and over the box, with all coefficients that a step needs."""
        point = self.point(centre, chords=chords)
        whole = self.whole(X, tangents=tangents, centre=None, chords=chords)
        far = self.whole(box, chords=chords)
        roots = [*self.program.flow, *(q.rate for q in (self.travelled, self.clock) if q is not None)]
        for k in range(order + 1):
            for rate in roots:
                far.value(rate, k)
                if k < order:
                    point.value(rate, k)
                    whole.slope(rate, k)
        return point, whole, far, order

    def disturb(self, box: Sequence[arb], chords: dict[int, _Chord], h: arb) -> tuple[list[arb], dict[int, arb]]:
        """Return how far the disturbances move each state by the end of a step, and each other operation at most.

        The other operations are the signals and the rates of the quadratures. Without disturbances there are none.
        """
        n, p = self.n, self.program
        crossed = [i for i, chord in chords.items() if not chord.width.is_zero()]
        if not crossed:
            return [ZERO] * n, {}
        seeds = {i: (n + q, chords[i].width) for q, i in enumerate(crossed)}
        tangents = [_along(i, ONE) for i in range(n)]
        series = _Series(
            p,
            self.all,
            box,
            tangents=tangents,
            chords=chords,
            forced=True,
            seeds=seeds,
            constants=_without_slopes(self.constant_all),
        )

        def largest(x: arb_poly, first: int, last: int) -> list[arb]:
            return [x[j].abs_upper() for j in range(first, last)]

        slopes = [series.slope(rate) for rate in p.flow]
        M = [largest(x, 0, n) for x in slopes]
        b = [sum(largest(x, n, n + len(crossed)), ZERO).upper() for x in slopes]
        D = [(h * x * arb("1.01")).upper() for x in b]
        for _ in range(60):
            moved = [(h * (b[i] + sum((M[i][j] * D[j] for j in range(n)), ZERO))).upper() for i in range(n)]
            if all(x <= y for x, y in zip(moved, D, strict=True)):
                break
            D = [y if x <= y else (x * arb("1.1")).upper() for x, y in zip(moved, D, strict=True)]
        else:
            raise _StepFails("a disturbance has no bound")
        slack = {}
        for i in (*p.signals.values(), *(q.rate for q in (self.travelled, self.clock) if q is not None)):
            x = series.slope(i)
            moves = sum((y * d for y, d in zip(largest(x, 0, n), D, strict=True)), ZERO)
            slack[i] = balls.symmetric(moves + sum(largest(x, n, n + len(crossed)), ZERO))
        return [balls.symmetric(x) for x in moved], slack

    def signal_bounds(
        self, point: _Series, whole: _Series, far: _Series, boxed: _Series, h: arb, order: int, slack: dict[int, arb]
    ) -> dict[str, tuple[arb, arb]]:
        """Return bounds of all signals during a step: from the box, or from polynomials where that extends them."""
        bounds = {}
        for name, i in self.program.signals.items():
            y = boxed.value(i)
            low, high = y.lower(), y.upper()
            if (high > self.top[name] or low < self.bottom[name]) and not self.program.static[i]:
                try:
                    a, b = self.polynomial_bounds(point, whole, far, i, h, order, slack.get(i, ZERO))
                    low, high = max(low, a), min(high, b)
                except balls.Undefined:
                    pass  # the box bounds the signal
            bounds[name] = low, high
        return bounds

    def polynomial_bounds(
        self, point: _Series, whole: _Series, far: _Series, i: int, h: arb, order: int, slack: arb
    ) -> tuple[arb, arb]:
        """Return bounds of operation i during a step by its Taylor polynomial, in pieces of the step.

        A piece takes the polynomial at its middle, and the polynomial's rate over the whole piece.
        """
        values = [point.value(i, k) for k in range(order)]
        slopes = [whole.slope(i, k) for k in range(order)]
        every = [v + sum((balls.symmetric(x) for x in s.coeffs()), ZERO) for v, s in zip(values, slopes, strict=True)]
        rates = [k * every[k] for k in range(1, order)] or [ZERO]
        remainder = far.value(i, order)
        lows, highs = [], []
        for piece in range(PIECES):
            t = balls.between(h * piece / PIECES, h * (piece + 1) / PIECES)
            middle = t.mid()
            y = _at(values, middle) + sum((balls.symmetric(x) for x in _at(slopes, middle).coeffs()), ZERO)
            y += _at(rates, t) * (t - middle) + remainder * t**order + slack
            if not y.is_finite():
                raise balls.Undefined("a signal without bounds")
            lows.append(y.lower())
            highs.append(y.upper())
        return min(lows), max(highs)

    def do_tick(self) -> None:
        p = self.program
        tangents, centre = self.directions(), self.centre()
        X = self.box(tangents)
        point, whole, _ = self.relax_limits(p.tick_limits, centre, X, tangents, self.np + self.n)
        try:
            after = [point.value(i) for i in p.tick]
            slopes = [whole.slope(i) for i in p.tick]
            for i in p.tick:
                whole.value(i)
            self.renew(after, slopes, [ZERO] * self.n, extra=len(p.tick_limits))
        except (balls.Undefined, _StepFails) as reason:
            raise NotProved(f"{reason} at a tick at {float(self.elapsed.mid()):g}") from None

    # The end.

    def time(self) -> _Quadrature:
        return self.clock.copy() if self.clock is not None else _Quadrature(-1, self.elapsed, np.zeros(self.np))

    def is_over(self) -> bool:
        """Return whether all runs have ended; capture the set in which half of them have."""
        if self.rates is None:
            return False
        margin = self.program.equations.margin
        try:
            series = self.at_ends()
            whole, slopes = series.range(margin), series.slope(margin)
            middle = self.point(self.centre()).value(margin)
        except balls.Undefined as reason:
            raise NotProved(f"the margin: {reason}") from None
        if self.capture is None and middle.mid() <= 0:
            self.capture = _Capture(
                middle, slopes, whole, self.time(), self.travelled.copy() if self.travelled else None
            )
        return whole.upper() < 0

    def past_horizon(self, horizon: float) -> bool:
        """Return whether the proof may end at its horizon: no run has ended before."""
        return self.rates is None and self.time().box().lower() >= horizon

    def at_zero(self, q: _Quadrature | None, rate: arb) -> tuple[float, float]:
        """Return the bounds of a quadrature where the margin is 0.

        The captured set has the margin m. The margin is 0 the time m/a later, with a = -m' in all boxes near the end.
        """
        if q is None or self.capture is None or self.rates is None:
            return -inf, inf
        inverse, margin = -1 / self.rates["margin"], self.capture
        alpha, pace = inverse.mid(), rate.mid()
        later = alpha * margin.margin + (inverse - alpha) * margin.whole  # without the slopes of the margin
        slopes = margin.slopes * alpha
        whole = later + sum((balls.symmetric(x) for x in slopes.coeffs()), ZERO)
        y = q.centre + balls.symmetric(q.uncertainty) + pace * later + (rate - pace) * whole
        for j in range(max(self.np, len(slopes))):
            slope = arb(float(q.slopes[j])) if j < self.np else ZERO
            y += balls.symmetric(slope + pace * slopes[j])
        return balls.below(y), balls.above(y)

    # The tail.

    def check_tail(self, tail: RunTail) -> None:
        """Check that a piece of a tail decides what follows: that it bounds all states which a tick or a rate reads."""
        p, e = self.program, self.program.equations
        settled = {e.states.index(name) for name in tail.states if name in e.states}
        end = stop_speed(e)
        if self.speed < 0 or end is None or not end > 0:
            raise NotProved("a tail needs a loop that stops at a positive speed")
        if len(settled) != len(tail.states) or e.speed in settled:
            raise NotProved("the states of the tail are not distinct states of the loop without its speed")
        unsettled = set(p.states) - settled - {e.speed}
        roots = p.tick if p.tick else p.flow
        read = {p.operations[i].value for i in p.read_by(roots) if p.operations[i].name == "state"}
        if wrong := settled - set(p.states) or unsettled & read or (unsettled if not p.tick else set()):
            raise NotProved(f"the tail has a state that no run needs, or lacks one: {e.states[min(wrong)]}")
        decides = {p.operations[i].value for i in p.read_by([e.acceleration]) if p.operations[i].name == "state"}
        for piece in tail.pieces:
            if {e.states.index(name) for name in piece.later_states} != decides - {e.speed}:
                raise NotProved("the tail has not the ranges of just the states that decide the deceleration")

    def piece_around(self, tail: RunTail) -> TailPiece | None:
        """Return a piece of a tail that contains the set, or None."""
        speed = self.box()[self.speed]
        for piece in reversed(tail.pieces):
            if arb(piece.low) <= speed.lower() and speed.upper() <= arb(piece.high) and self.is_within(tail, piece):
                return piece
        return None

    def is_within(self, tail: RunTail, piece: TailPiece) -> bool:
        """Return whether every settled state of the set is as close to its centre as a piece asks."""
        p, v = self.program, self.speed
        B, G = ([[arb(float(x)) for x in row] for row in matrix] for matrix in (self.B, self.G))
        faster = arb(self.c[v]) - piece.middle
        for i, name in enumerate(tail.states):
            k, by_speed = p.place[p.equations.states.index(name)], arb(piece.by_speed[i])
            distance = arb(self.c[k]) - piece.centre[i] - by_speed * faster
            spread = sum(((B[k][j] - by_speed * B[v][j]).abs_upper() * self.r[j] for j in range(self.n)), ZERO)
            for j in range(self.np):
                along = G[k][j] - by_speed * G[v][j]
                if j < len(tail.middle):
                    by_param = arb(piece.by_param[i][j])
                    distance -= by_param * (self.mids[j] - tail.middle[j])
                    along -= by_param * self.halves[j]
                spread += along.abs_upper()
            if not (distance.abs_upper() + spread).upper() <= arb(piece.width[i]):
                return False
        return True

    def inverse_deceleration(self, piece: TailPiece, speed: arb) -> arb:
        """Return 1/a for all settled runs of the cell at these speeds; a is the rate at which the speed falls."""
        p, e = self.program, self.program.equations
        states = [ZERO] * self.n
        for name, ends in piece.later_states.items():
            states[p.place[e.states.index(name)]] = balls.between(arb(ends[0]), arb(ends[1]))
        states[self.speed] = speed
        a = -self.whole(states).value(e.acceleration)
        if not a.lower() > 0:
            raise balls.Undefined("a settled run may not slow down")
        return 1 / a

    def settled_bounds(self, piece: TailPiece) -> CheckedBounds:
        """Return the bounds of runs that are in a piece: each passes every speed down to the stop once."""
        end, v = stop_speed(self.program.equations), self.speed
        assert end is not None
        stop, above, time, way = balls.constant(end), arb(self.c[v]), ZERO, ZERO
        for k in range(1, SLICES + 1):
            lower = arb(self.c[v] * (end / self.c[v]) ** (k / SLICES)) if k < SLICES else stop
            inverse = self.inverse_deceleration(piece, balls.hull(above, lower))
            time += (above - lower) * inverse
            way += (above - lower) * (above + lower) / 2 * inverse
            above = lower
        speeds = self.box()[v]
        per_speed = self.inverse_deceleration(piece, speeds)

        def total(q: _Quadrature | None, integral: arb, rate: arb) -> tuple[float, float]:
            if q is None:
                return -inf, inf
            y = q.centre + integral + balls.symmetric(q.uncertainty)
            for j in range(self.np):
                y += balls.symmetric(arb(float(q.slopes[j])) + rate * arb(float(self.G[v, j])))
            for j in range(self.n):
                y += balls.symmetric(rate * arb(float(self.B[v, j])) * self.r[j])
            return balls.below(y), balls.above(y)

        return CheckedBounds(
            total(self.time(), time, per_speed),
            total(self.travelled, way, per_speed * speeds),
            {name: max(balls.above(x), piece.later_signals[name][1]) for name, x in self.top.items()},
            {name: min(balls.below(x), piece.later_signals[name][0]) for name, x in self.bottom.items()},
        )

    def end_in_tail(self, tail: RunTail | None, latest: float) -> CheckedBounds | None:
        """Return the bounds of all runs if they are in a piece of a tail and stop by `latest` [s], else None."""
        piece = self.piece_around(tail) if tail is not None and self.rates is None else None
        if piece is None:
            return None
        try:
            bounds = self.settled_bounds(piece)
        except balls.Undefined:
            return None
        return bounds if bounds.stop_time[1] <= latest else None

    def bounds(self, ended: bool) -> CheckedBounds:
        """Return the bounds; up to the horizon only, unless the runs ended."""
        capture, rates = self.capture, self.rates
        greatest = {name: balls.above(x) for name, x in self.top.items()}
        smallest = {name: balls.below(x) for name, x in self.bottom.items()}
        if not ended or capture is None or rates is None:
            low = balls.below(self.travelled.box()) if self.travelled else -inf
            return CheckedBounds((balls.below(self.time().box()), inf), (low, inf), greatest, smallest)
        return CheckedBounds(
            self.at_zero(capture.clock, rates["clock"]),
            self.at_zero(capture.travelled, rates["travelled"]),
            greatest,
            smallest,
        )


def _without_slopes(series: _Series) -> _Series:
    """Return the constants of a series, with derivatives along states only, which are 0."""
    constants = _Series(series.program, series.parameters, series.start)
    for i, static in enumerate(series.program.static):
        if static:
            constants.v[i], constants.d[i] = series.v[i], [NO_SLOPE]
    return constants


def _wider(x: arb) -> arb:
    return x + arb(0, (x.rad() * arb("0.1") + arb("1e-14")).upper())


def _balance_matrix(matrix: np.ndarray) -> np.ndarray:
    """Return powers of two w for which the rows and columns of diag(w) matrix diag(1/w) have equal norms."""
    n = len(matrix)
    a, w = np.array(matrix, float), np.ones(n)
    np.fill_diagonal(a, 0.0)
    for _ in range(30):
        for i in range(n):
            row, column = np.linalg.norm(a[i]), np.linalg.norm(a[:, i])
            if row > 1e-12 and column > 1e-12:
                factor = 2.0 ** np.round(0.5 * np.log2(column / row))
                w[i] *= factor
                a[i] *= factor
                a[:, i] /= factor
    return w


def check_cell(
    equations: Equations,
    signals: Iterable[str],
    cell: Sequence[tuple[float, float]],
    steps: Sequence[float] | int,
    horizon: float,
    order: int = ORDER,
    *,
    tail: RunTail | None = None,
    latest: float | None = None,
) -> CheckedBounds:
    """Prove bounds of every run of a cell of parameters: of its end, and of the signals until the last run ends.

    Args:
        cell: Low and high end of each parameter, shape (parameters, 2), in the parameters' units; taken as exact.
        steps: Lengths of the steps in time [s], or in eta [s^2/m] for paced equations; the last one repeats. For a
            sampled loop, the number of steps between two ticks.
        horizon: Time at which the proof may stop if no run has ended [s].
        order: Order of the Taylor polynomials.
        tail: Pieces in which the proof may end; they are taken as true.
        latest: Time by which runs in the tail must stop [s]; None for the horizon.

    Raises:
        NotProved: The checker found no proof. The bounds may hold nevertheless.
    """
    before = ctx.prec
    ctx.prec = PRECISION
    try:
        check = _Check(equations, signals, cell, order)
        if tail is not None:
            check.check_tail(tail)
        return _prove(check, steps, horizon, tail, horizon if latest is None else latest)
    except (balls.Undefined, _StepFails) as reason:
        raise NotProved(str(reason)) from None
    except RecursionError:
        raise NotProved("a chain of too many operations, each of which reads the one before") from None
    finally:
        ctx.prec = before


def _prove(
    check: _Check, steps: Sequence[float] | int, horizon: float, tail: RunTail | None, latest: float
) -> CheckedBounds:
    """Move the set of a cell until all runs have ended or are in the tail, or the horizon is reached."""
    e = check.program.equations
    if e.period is not None:
        if not isinstance(steps, int) or steps < 1:
            raise NotProved("a sampled loop needs a number of steps between two ticks")
        period, tick = balls.constant(e.period), 0
        while True:
            if tick % BALANCE_INTERVAL == 0:
                check.balance(e.period)
            check.do_tick()
            for _ in range(steps):
                check.advance(period / steps)
                if check.is_over():
                    return check.bounds(True)
            tick += 1
            check.elapsed = period * tick
            if (settled := check.end_in_tail(tail, latest)) is not None:
                return settled
            if check.past_horizon(horizon):
                return check.bounds(False)
            if check.elapsed.lower() > 2 * horizon:
                raise NotProved("the runs do not end by twice the horizon")
    if isinstance(steps, int) or not len(steps):
        raise NotProved("a continuous loop needs the lengths of its steps")
    if not all(isfinite(h) and h > 0 for h in steps):
        raise NotProved("a step's length must be positive")
    number = 0
    while True:
        if number % BALANCE_INTERVAL == 0:
            check.balance(0.0)
        check.advance(arb(float(steps[min(number, len(steps) - 1)])))
        number += 1
        if check.is_over():
            return check.bounds(True)
        if (settled := check.end_in_tail(tail, latest)) is not None:
            return settled
        if check.past_horizon(horizon):
            return check.bounds(False)
        if check.time().box().lower() > 2 * horizon:
            raise NotProved("the runs do not end by twice the horizon")
