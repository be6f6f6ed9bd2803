"""A second proof of cells of frequencies and parameters, in Arb's balls, by code that shares nothing with the prover.

The checker reads `OpenedEquations` and nothing else. It needs python-flint (extra `proof`). It has the same theorem,
the mean value form of f = |N|^2 - |P|^2/M^2, and other ways to its numbers:

- derivatives of the matrices by forward propagation in balls, the exponential and its derivatives by `arb_mat.exp`
- determinants along columns, in polynomials of balls
- powers of s by products of complex balls, and the derivatives of N and P along each side of the cell

A cell that fails is halved a few times: balls are slightly wider than intervals.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from flint import acb, arb, arb_mat, arb_poly, ctx

from diffabs.core.types import Any
from diffabs.robust.frequency.opened import NO_ENTRY, OpenedEquations
from diffabs.robust.reach import balls
from diffabs.robust.reach.balls import NotProved, Undefined

PRECISION = 96  # bits
REST_STEPS = 12
REST_TRIES = 8
GROWTH = arb("1.3")
EXTRA_HALVINGS = 10
TURN_HALVINGS = 60  # of the frequencies, for the poles at one point
TURN_PARTS = 24

Slopes = list[arb]
Ends = tuple[tuple[float, float], ...]


class _Number(NamedTuple):
    """A ball, and its derivatives along the parameters and the added delay."""

    value: arb
    slopes: Slopes

    def plus(self, other: "_Number") -> "_Number":
        return _Number(self.value + other.value, [a + b for a, b in zip(self.slopes, other.slopes, strict=True)])

    def times(self, other: "_Number") -> "_Number":
        pairs = zip(self.slopes, other.slopes, strict=True)
        return _Number(self.value * other.value, [a * other.value + self.value * b for a, b in pairs])

    def negative(self) -> "_Number":
        return _Number(-self.value, [-a for a in self.slopes])


class _Part(NamedTuple):
    """P det (I + L)[J, I] for rows J and columns I, a sum of polynomials in s times e^(-s tau d), d = 0, 1, ..."""

    rows: tuple[int, ...]
    columns: tuple[int, ...]
    turned: list[list[_Number]]


class _Coefficients(NamedTuple):
    """All parts, P first and N last, and the delay [s]; numbers have derivatives along the parameters."""

    parts: list[_Part]
    delay: _Number

    @property
    def degree(self) -> int:
        """Degree n of P."""
        return len(self.parts[0].turned[0]) - 1


class LoopChecker:
    """The checker of one claim about a loop, for one range of added delays."""

    def __init__(self, equations: OpenedEquations, bound: float, whole: int = 0, *, broken: bool = False):
        """Store what is to be proved.

        Args:
            bound: Bound M of |S|; infinite to prove that no pole crosses.
            whole: Whole periods in the delay of a sampled loop.
            broken: Whether the delay of a sampled loop has a rest, which is within a period.
        """
        self.equations, self.whole, self.broken = equations, whole, broken
        self.count = len(equations.params) + 1
        share = arb(0) if math.isinf(bound) else 1 / balls.constant(bound)
        self.share, self.square = share, share * share
        self.boxes: dict[Ends, _Coefficients] = {}
        self.constants: dict[int, arb] = {}

    def passes_half_rate(self, top: float) -> bool:
        """Return whether a frequency [rad/s] is at least pi/T."""
        with _precision():
            return bool(arb(top) * balls.constant(self.equations.period or 0.0) >= arb.pi())

    def over(self, box: Ends) -> _Coefficients:
        """Return the coefficients over a box of parameters and added delays."""
        if box not in self.boxes:
            if len(self.boxes) > 4096:
                self.boxes.clear()
            self.boxes[box] = self._coefficients([balls.between(arb(a), arb(b)) for a, b in box])
        return self.boxes[box]

    def check_cell(self, cell: Ends, halvings: int = EXTRA_HALVINGS) -> None:
        """Prove f > 0 in a cell: a range of frequencies, then of each parameter. Raises NotProved."""
        with _precision():
            self._check(cell, halvings)

    def _check(self, cell: Ends, halvings: int) -> None:
        costs: list[float] = []
        try:
            reserve, costs = self._bound_below(cell)
            if reserve.lower() > 0:
                return
            reason = "|S| may exceed the bound"
        except (Undefined, ZeroDivisionError) as error:
            reason = f"no bound: {error}"
        if not halvings:
            where = ", ".join(f"{low:.9g} to {high:.9g}" for low, high in cell)
            raise NotProved(f"{reason} in the cell {where}")
        sides = costs or [0.0, *(high - low for low, high in cell[1:])]
        side = max(range(len(cell)), key=lambda i: sides[i])
        low, high = cell[side]
        for ends in ((low, 0.5 * (low + high)), (0.5 * (low + high), high)):
            self._check((*cell[:side], ends, *cell[side + 1 :]), halvings - 1)

    def _bound_below(self, cell: Ends) -> tuple[arb, list[float]]:
        """Return a lower bound of f in a cell, and what each side costs."""
        middle = [min(max(0.5 * (low + high), low), high) for low, high in cell]
        at = self._square_form(self.over(tuple((x, x) for x in middle[1:])), arb(middle[0]), slopes=False)[0]
        w = balls.between(arb(cell[0][0]), arb(cell[0][1]))
        value, slopes = self._square_form(self.over(cell[1:]), w)
        radii = [max(arb(high) - x, x - arb(low)) for (low, high), x in zip(cell, map(arb, middle), strict=True)]
        costs = [slope.abs_upper() * radius for slope, radius in zip(slopes, radii, strict=True)]
        reserve = at - sum(costs, arb(0))
        return (value if value.lower() > 0 else reserve), [balls.above(x) for x in costs]

    def _square_form(self, c: _Coefficients, w: arb, *, slopes: bool = True) -> tuple[arb, list[arb]]:
        """Return f and its derivatives along the frequency, the parameters and the added delay."""
        s, rate = self._variable(w)
        powers = [acb(1)]
        for _ in range(c.degree + 1):
            powers.append(powers[-1] * s)
        controls = len(c.parts[-1].rows)
        turns = [(acb(0, -d) * w * c.delay.value).exp() for d in range(controls + 1)]
        value, moves = arb(0), [arb(0)] * (self.count + 1)
        for part in c.parts:
            weight = (-self.square) ** (controls - len(part.rows))
            sums = [_sum(y, powers) for y in part.turned]
            whole = sum((x * turns[d] for d, x in enumerate(sums)), acb(0))
            value += weight * _size(whole)
            if not slopes:
                continue
            derivatives = [acb(0)] * (self.count + 1)
            for d, y in enumerate(part.turned):
                by_s = sum((k * x.value * powers[k - 1] for k, x in enumerate(y) if k), acb(0))
                derivatives[0] += (by_s * rate - acb(0, d) * c.delay.value * sums[d]) * turns[d]
                for j in range(self.count):
                    by_j = sum((x.slopes[j] * powers[k] for k, x in enumerate(y)), acb(0))
                    derivatives[j + 1] += (by_j - acb(0, d) * w * c.delay.slopes[j] * sums[d]) * turns[d]
            moves = [a + 2 * weight * _inner(whole, b) for a, b in zip(moves, derivatives, strict=True)]
        return value, moves

    def _variable(self, w: arb) -> tuple[acb, acb]:
        """Return s and ds/dw."""
        if self.equations.period is None:
            return acb(0, w), acb(0, 1)
        period = balls.constant(self.equations.period)
        half = (w * period / 2).sin()
        z = acb((w * period).cos(), (w * period).sin())
        return acb(-2 * half * half, (w * period).sin()), acb(0, 1) * period * z

    def check_tail(self, box: Ends, top: float, halvings: int = EXTRA_HALVINGS) -> None:
        """Prove |L| < 1 - 1/M over a box for all frequencies of at least `top` [rad/s]. Raises NotProved."""
        with _precision():
            try:
                c = self.over(box)
                n, inverse = c.degree, 1 / arb(top)

                def size(polynomial: list[_Number]) -> arb:
                    return sum((x.value.abs_upper() * inverse ** (n - k) for k, x in enumerate(polynomial)), arb(0))

                below = size(c.parts[0].turned[0][:-1])
                gain = sum((size(part.turned[1]) for part in c.parts if len(part.rows) == 1), arb(0))
                change = below + sum(map(size, c.parts[-1].turned[1:]), arb(0))  # of N/(jw)^n from 1
                if top > 0 and ((1 - self.share) * (1 - below) - gain).lower() > 0 and change.upper() < 1:
                    return
                reason = "the gain may be too large"
            except (Undefined, ZeroDivisionError) as error:
                reason = f"no bound: {error}"
        if not halvings:
            raise NotProved(f"{reason} above {top:.6g} rad/s")
        widths = [(high - low) / (abs(low) + abs(high) + 1e-300) for low, high in box[:-1]]
        side = widths.index(max(widths, default=0.0)) if widths else 0
        low, high = box[side]
        for ends in ((low, 0.5 * (low + high)), (0.5 * (low + high), high)):
            self.check_tail((*box[:side], ends, *box[side + 1 :]), top, halvings - 1)

    def check_stable(self, point: Sequence[float], top: float) -> None:
        """Prove that the closed loop is stable at a point, by the change of arg N up to `top` [rad/s].

        In continuous time N has to be (jw)^n up to a factor near 1 above `top`, as `check_tail` proves.

        Raises:
            NotProved: It is unstable, or that is not decided.
        """
        with _precision():
            try:
                unstable = self._count_unstable(self.over(tuple((x, x) for x in point)), top)
            except (Undefined, ZeroDivisionError) as error:
                raise NotProved(f"the stability at the middle of the box: {error}") from None
        if not abs(unstable).upper() < arb("0.5"):
            raise NotProved(f"the loop at the middle of the box has {float(unstable.mid()):.3g} unstable poles")

    def _count_unstable(self, c: _Coefficients, top: float) -> arb:
        def difference(w: arb) -> acb:
            s, _ = self._variable(w)
            powers, turn = [s**k for k in range(c.degree + 1)], (acb(0, -1) * w * c.delay.value).exp()
            return sum((_sum(y, powers) * turn**d for d, y in enumerate(c.parts[-1].turned)), acb(0))

        edges = [0.0, *(top * 2.0**-k for k in reversed(range(TURN_PARTS)))]
        turned, stack = arb(0), [(low, high, 0) for low, high in pairwise(edges)]
        while stack:
            low, high, depth = stack.pop()
            around = difference(balls.between(arb(low), arb(high)))
            if around.real.contains(0) and around.imag.contains(0):
                if depth > TURN_HALVINGS:
                    raise Undefined("a pole on the stability limit")
                middle = 0.5 * (low + high)
                stack += [(low, middle, depth + 1), (middle, high, depth + 1)]
            else:  # a rectangle without 0 lies in a half plane, so the angle turns by less than pi
                turned += (difference(arb(high)) / difference(arb(low))).arg()
        n, pi = c.degree, arb.pi()
        if self.equations.period is None:
            turned -= (difference(arb(top)) / acb(0, 1) ** n).arg()
            return (n - 2 * turned / pi) / 2
        return n - turned / pi

    # The coefficients.

    def _coefficients(self, box: list[arb]) -> _Coefficients:
        e, count = self.equations, self.count
        params = box[:-1]
        unknown = self._enclose_rest(params)
        values = _Operations(e, params, unknown, self.constants)
        along = self._rest_slopes(values, len(unknown)) if unknown else []

        def number(i: int) -> _Number:
            if i == NO_ENTRY:
                return _Number(arb(0), [arb(0)] * count)
            slopes = values.slopes(i)
            total = [slopes.get(k, arb(0)) for k in range(count)]
            total[-1] = arb(0)
            for k, move in enumerate(along):
                if (factor := slopes.get(count - 1 + k)) is not None:
                    total = [a + factor * b for a, b in zip(total, [*move, arb(0)], strict=True)]
            return _Number(values.value(i), total)

        a, b, c, f, g, h, j = ([[number(i) for i in row] for row in matrix] for matrix in (*e.plant, *e.controller))
        delay = _Number(box[-1], [arb(0)] * (count - 1) + [arb(1)]).plus(number(e.delay))
        if e.period is not None:
            whole = _Number(balls.constant(e.period) * self.whole, [arb(0)] * count)
            a, b, c = self._sample(a, b, c, delay.plus(whole.negative()) if self.broken else None)
            delay = _Number(balls.constant(e.period) * (self.whole + self.broken), whole.slopes)
        return _Coefficients(_list_parts(a, b, c, f, g, h, j, count), delay)

    def _sample(self, a: Any, b: Any, c: Any, rest: _Number | None) -> tuple[Any, Any, Any]:
        """Return the sampled plant (A - I, B, C); behind the rest of a delay the inputs are u and s u, a period old."""
        n, zero = len(a), _Number(arb(0), [arb(0)] * self.count)
        unit = _Number(arb(1), zero.slopes)
        generator = [[*a[i], b[i][0]] for i in range(n)] + [[zero] * (n + 1)]
        period = _Number(balls.constant(self.equations.period or 0.0), zero.slopes)
        whole = self._exponential(generator, period)
        inner = [[whole[i][k].plus(unit.negative()) if i == k else whole[i][k] for k in range(n)] for i in range(n)]
        inputs = [[whole[i][n]] for i in range(n)]
        if rest is not None:
            early = self._exponential(generator, period.plus(rest.negative()))
            inputs = [[row[0], early[i][n]] for i, row in enumerate(inputs)]
        return inner, inputs, c

    def _exponential(self, generator: list[list[_Number]], time: _Number) -> list[list[_Number]]:
        """Return e^(M t); the derivative along dM is the corner of the exponential of [[M, dM], [0, M]]."""
        n = len(generator)
        x = [[entry.times(time) for entry in row] for row in generator]
        value = arb_mat([[entry.value for entry in row] for row in x]).exp()
        corners: list[arb_mat | None] = []
        for j in range(self.count):
            moves = [[entry.slopes[j] for entry in row] for row in x]
            if all(move.is_zero() for row in moves for move in row):
                corners.append(None)
                continue
            rows = [[entry.value for entry in x[i]] + moves[i] for i in range(n)]
            rows += [[arb(0)] * n + [entry.value for entry in x[i]] for i in range(n)]
            corners.append(arb_mat(rows).exp())
        return [
            [_Number(value[i, k], [arb(0) if m is None else m[i, n + k] for m in corners]) for k in range(n)]
            for i in range(n)
        ]

    # The rest.

    def _enclose_rest(self, params: list[arb]) -> list[arb]:
        """Return balls that contain the rest for all parameters of a box."""
        e = self.equations
        if not e.unknown:
            return []
        rows = [*range(len(e.rest))]
        spare = combinations(rows[len(rows) - e.spare :], len(rows) - len(e.unknown))
        choices = [[i for i in rows if i not in left_out] for left_out in spare]
        reasons = []
        for choice in choices:
            try:
                unknown = self._krawczyk(params, choice)
            except (Undefined, ZeroDivisionError, np.linalg.LinAlgError) as error:
                reasons.append(str(error))
                continue
            values = _Operations(e, params, unknown, self.constants)
            if all(values.value(i).contains(0) for i in e.rest):
                self.rows = choice
                return unknown
        raise Undefined("the loop may not come to rest " + "; ".join(reasons[:1]))

    def _krawczyk(self, params: list[arb], rows: list[int]) -> list[arb]:
        e, n = self.equations, len(self.equations.unknown)
        first, middle = self.count - 1, [x.mid() for x in params]
        y = [arb(x) for x in e.guess]
        inverse = np.eye(n)
        for _ in range(REST_STEPS):
            values = _Operations(e, middle, y, self.constants)
            slopes = [values.slopes(e.rest[i]) for i in rows]
            inverse = np.linalg.inv([[float(row.get(first + k, arb(0)).mid()) for k in range(n)] for row in slopes])
            residual = np.array([float(values.value(e.rest[i]).mid()) for i in rows])
            step = inverse @ residual
            y = [arb(float(x.mid()) - d) for x, d in zip(y, step, strict=True)]
            if all(abs(d) <= 1e-13 * (1e-12 + abs(float(x.mid()))) for x, d in zip(y, step, strict=True)):
                break
        c = arb_mat([[arb(float(a)) for a in row] for row in inverse])
        here = _Operations(e, params, y, self.constants)
        move = c * arb_mat([[-here.value(e.rest[i])] for i in rows])
        radius = [move[k, 0].abs_upper() * GROWTH + abs(y[k]) * arb("1e-20") + arb("1e-40") for k in range(n)]
        for _ in range(REST_TRIES):
            trial = [y[k] + arb(0, radius[k].upper()) for k in range(n)]
            values = _Operations(e, params, trial, self.constants)
            jacobian = arb_mat([[values.slopes(e.rest[i]).get(first + k, arb(0)) for k in range(n)] for i in rows])
            spread = arb_mat(n, n, [int(i == k) for i in range(n) for k in range(n)]) - c * jacobian
            step = move + spread * arb_mat([[arb(0, r.upper())] for r in radius])
            image = [y[k] + step[k, 0] for k in range(n)]
            if all(trial[k].contains_interior(image[k]) for k in range(n)):
                return image
            radius = [step[k, 0].abs_upper() * GROWTH + arb("1e-40") for k in range(n)]
        raise Undefined("no enclosure of the rest")

    def _rest_slopes(self, values: "_Operations", n: int) -> list[Slopes]:
        """Return the derivatives of the rest along the parameters."""
        e, first = self.equations, self.count - 1
        if not first:
            return [[] for _ in range(n)]
        slopes = [values.slopes(e.rest[i]) for i in self.rows]
        jacobian = arb_mat([[row.get(first + k, arb(0)) for k in range(n)] for row in slopes])
        solved = jacobian.solve(arb_mat([[-row.get(j, arb(0)) for j in range(first)] for row in slopes]))
        return [[solved[i, j] for j in range(first)] for i in range(n)]


class _Operations:
    """The values of operations over balls, and their derivatives along parameters, then unknowns."""

    def __init__(
        self, equations: OpenedEquations, params: list[arb], unknown: list[arb], constants: dict[int, arb] | None = None
    ):
        self.equations, self.params = equations, params
        self.unknown = dict(zip(equations.unknown, unknown, strict=True))
        self.values: dict[int, Any] = {}
        self.moves: dict[int, dict[int, arb]] = {}
        self.constants = {} if constants is None else constants

    def value(self, i: int) -> Any:
        """Return the ball of an operation, or the truth of a comparison."""
        if i not in self.values:
            x = self._compute(i)
            if isinstance(x, arb) and not x.is_finite():
                raise Undefined(f"{self.equations.operations[i].name} has no value")
            self.values[i] = x
        return self.values[i]

    def _compute(self, i: int) -> Any:
        name, args, number = self.equations.operations[i]
        match name:
            case "const":
                if i not in self.constants:
                    self.constants[i] = balls.constant(number)
                return self.constants[i]
            case "truth":
                return number
            case "param":
                return self.params[number]
            case "state":
                return self.unknown[number] if number in self.unknown else self.value(self.equations.settled[number])
            case "select":
                truth = self.value(args[0])
                if truth is None:
                    return balls.hull(self.value(args[1]), self.value(args[2]))
                return self.value(args[2] if truth else args[1])
            case "clamp":
                x = self.value(args[0])
                for limit, choose in ((args[1], max), (args[2], min)):
                    if limit >= 0:
                        y = self.value(limit)
                        x = balls.between(choose(x.lower(), y.lower()), choose(x.upper(), y.upper()))
                return x
            case "inside":
                return arb(self._inside(args))
            case "and" | "or":
                truths = [self.value(a) for a in args]
                decides = name == "or"
                return decides if decides in truths else None if None in truths else not decides
            case "not":
                truth = self.value(args[0])
                return None if truth is None else not truth
            case "exp" | "log" | "sin" | "cos" | "atan":
                return getattr(self.value(args[0]), name)()
            case "power":
                return balls.positive_power(self.value(args[0]), self.value(args[2]))
        x = [self.value(a) for a in args]
        match name:
            case "add":
                return x[0] + x[1]
            case "sub":
                return x[0] - x[1]
            case "mul":
                return balls.product(x[0], x[1])
            case "neg":
                return -x[0]
            case "inv":
                if x[0].contains(0):
                    raise Undefined("a division by a number that may be 0")
                return 1 / x[0]
            case "meet":
                return balls.common(x[0], x[1])
            case "lt" | "le" | "eq" | "ne":
                return _decide(name, x[0], x[1])
        raise NotProved(f"the operation {name}")

    def _inside(self, args: Sequence[int]) -> int:
        """Return the slope of a limit: 1 within it, 0 beyond it."""
        x = self.value(args[0])
        slope = 1
        for limit, sign in ((args[1], 1), (args[2], -1)):
            if limit >= 0:
                distance = sign * (x - self.value(limit))
                if distance.contains(0):
                    raise Undefined("the rest may be at a limit")
                slope = slope if distance > 0 else 0
        return slope

    def slopes(self, i: int) -> dict[int, arb]:
        """Return the derivatives of an operation; a missing one is 0."""
        if i not in self.moves:
            self.moves[i] = self._derive(i)
        return self.moves[i]

    def _derive(self, i: int) -> dict[int, arb]:
        name, args, number = self.equations.operations[i]
        match name:
            case "const" | "truth":
                return {}
            case "param":
                return {number: arb(1)}
            case "state" if number in self.unknown:
                return {len(self.params) + list(self.unknown).index(number): arb(1)}
            case "state":
                return self.slopes(self.equations.settled[number])
            case "add" | "sub":
                return _plus(self.slopes(args[0]), self.slopes(args[1]), 1 if name == "add" else -1)
            case "neg":
                return {k: -x for k, x in self.slopes(args[0]).items()}
            case "mul" if any(self.equations.operations[a][::2] == ("const", 0.0) for a in args):
                self.value(i)  # 0 times a number that has a value, whatever its slopes are
                return {}
            case "mul":
                x, y = (self.value(a) for a in args)
                first, second = self.slopes(args[0]), self.slopes(args[1])
                return _plus({k: d * y for k, d in first.items()}, {k: x * d for k, d in second.items()}, 1)
            case "meet":
                return self.slopes(args[0])
            case "select":
                truth = self.value(args[0])
                if truth is None:  # the number may jump, though both sides have slopes
                    raise Undefined("a condition that the parameters decide differently")
                return self.slopes(args[2] if truth else args[1])
            case "clamp":
                if any(self.slopes(limit) for limit in args[1:] if limit >= 0):
                    raise Undefined("a limit that the parameters move")
                return {k: self._inside(args) * x for k, x in self.slopes(args[0]).items()}
            case "inside":
                self.value(i)
                return {}
            case "inv" | "exp" | "log" | "sin" | "cos" | "atan" | "power":
                slopes = self.slopes(args[0])
                if not slopes:
                    return {}
                factor = -self.value(i) * self.value(i) if name == "inv" else self.value(args[1])
                return {k: factor * x for k, x in slopes.items()}
        raise NotProved(f"the derivative of {name}")


def _plus(x: dict[int, arb], y: dict[int, arb], sign: int) -> dict[int, arb]:
    total = dict(x)
    for k, slope in y.items():
        total[k] = total[k] + sign * slope if k in total else sign * slope
    return total


def _decide(name: str, x: arb, y: arb) -> bool | None:
    """Return whether a comparison is true for all numbers of two balls; None if for some only."""
    match name:
        case "lt":
            yes, no = x < y, x >= y
        case "le":
            yes, no = x <= y, x > y
        case _:
            yes, no = x.is_exact() and y.is_exact() and x == y, not x.overlaps(y)
            yes, no = (yes, no) if name == "eq" else (no, yes)
    return True if yes else False if no else None


def _sum(polynomial: Sequence[_Number], powers: Sequence[acb]) -> acb:
    return sum((x.value * powers[k] for k, x in enumerate(polynomial)), acb(0))


def _list_parts(a: Any, b: Any, c: Any, f: Any, g: Any, h: Any, j: Any, count: int) -> list[_Part]:
    """Return all parts of minus the controller behind the plant, without the states that its outputs do not read."""
    zero = _Number(arb(0), [arb(0)] * count)
    n, m, controls = len(a), len(f), len(j)
    matrix = [[*a[i], *([zero] * m)] for i in range(n)]
    matrix += [[*(_dot(g[i], [row[k] for row in c], zero) for k in range(n)), *f[i]] for i in range(m)]
    columns = [[row] if controls == 1 else [[x] for x in row] for row in b] + [[[zero]] * controls] * m
    outputs = [
        [*(_dot(j[i], [line[k] for line in c], zero) for k in range(n)), *(h[i] if m else [])] for i in range(controls)
    ]
    needed, pending = set[int](), [k for row in outputs for k, x in enumerate(row) if not x.value.is_zero()]
    while pending:
        k = pending.pop()
        if k not in needed:
            needed.add(k)
            pending += [i for i, x in enumerate(matrix[k]) if not x.value.is_zero()]
    keep = sorted(needed)
    unit = _Number(arb(1), zero.slopes)
    inner = [[_entry(matrix[i][k].negative(), *([unit] if i == k else [])) for k in keep] for i in keep]
    # [[sI - A, q B], [c, I]] has the determinant P det(I - c (sI - A)^-1 q B); the open loop is minus the controller.
    # q is s^far: a factor s^far in the determinant is one factor q.
    far = len(keep) + 2 * controls + 1
    parts = []
    for size in range(controls + 1):
        for rows in combinations(range(controls), size):
            for inputs in combinations(range(controls), size):
                whole = [
                    [*line, *(_entry(*[zero] * far, *columns[i][k]) for k in inputs)]
                    for line, i in zip(inner, keep, strict=True)
                ]
                for i in rows:
                    corner = (_entry(unit if i == k else zero) for k in inputs)
                    whole.append([*(_entry(outputs[i][k]) for k in keep), *corner])
                numbers = _read_polynomial(_determinant(whole, count), (size + 1) * far, count)
                turned = [numbers[d * far : d * far + len(keep) + 1] for d in range(size + 1)]
                parts.append(_Part(rows, inputs, turned))
    return parts


class _Polynomial(NamedTuple):
    """A polynomial in s, and its derivatives along the parameters."""

    value: arb_poly
    slopes: list[arb_poly]


def _entry(*x: _Number) -> _Polynomial:
    slopes = zip(*(number.slopes for number in x), strict=True)
    return _Polynomial(arb_poly([number.value for number in x]), [arb_poly(list(along)) for along in slopes])


def _read_polynomial(x: _Polynomial, size: int, count: int) -> list[_Number]:
    values, slopes = x.value.coeffs(), [y.coeffs() for y in x.slopes]
    return [
        _Number(
            values[k] if k < len(values) else arb(0),
            [slopes[j][k] if k < len(slopes[j]) else arb(0) for j in range(count)],
        )
        for k in range(size)
    ]


def _determinant(matrix: list[list[_Polynomial]], count: int) -> _Polynomial:
    """Return a determinant by expansion along the columns."""
    memory: dict[tuple[int, ...], _Polynomial] = {}
    unit = _Polynomial(arb_poly([1]), [arb_poly([])] * count)

    def minor(rows: tuple[int, ...]) -> _Polynomial:
        if not rows:
            return unit
        if rows not in memory:
            column = len(matrix) - len(rows)
            value, slopes = arb_poly([]), [arb_poly([])] * count
            for place, i in enumerate(rows):
                x = matrix[i][column]
                if x.value == arb_poly([]) and all(y == arb_poly([]) for y in x.slopes):
                    continue
                y = minor((*rows[:place], *rows[place + 1 :]))
                sign = -1 if place % 2 else 1
                value += sign * x.value * y.value
                slopes = [
                    s + sign * (a * y.value + x.value * b) for s, a, b in zip(slopes, x.slopes, y.slopes, strict=True)
                ]
            memory[rows] = _Polynomial(value, slopes)
        return memory[rows]

    return minor(tuple(range(len(matrix))))


def _dot(x: Iterable[_Number], y: Iterable[_Number], zero: _Number) -> _Number:
    total = zero
    for a, b in zip(x, y, strict=True):
        total = total.plus(a.times(b))
    return total


def _size(x: acb) -> arb:
    """Return |x|^2."""
    return x.real**2 + x.imag**2


def _inner(x: acb, y: acb) -> arb:
    """Return Re(conj(x) y)."""
    return x.real * y.real + x.imag * y.imag


class _precision:
    """The precision of the checker, for a block."""

    def __enter__(self) -> None:
        self.before = ctx.prec
        ctx.prec = PRECISION

    def __exit__(self, *error: object) -> None:
        ctx.prec = self.before


def read_halvings(text: str, box: Ends) -> Iterator[Ends]:
    """Yield the cells of the halvings of a box; see `DelayPiece.strips`. Raises ValueError for another text."""
    stack = [box]
    for letter in text:
        if not stack:
            raise ValueError("halvings: letters follow the last cell")
        cell = stack.pop()
        if letter == ".":
            yield cell
            continue
        side = int(letter, 36) if letter.isascii() and letter.isalnum() else len(cell)
        if side >= len(cell):
            raise ValueError(f"halvings: {letter!r} is no side of a cell")
        low, high = cell[side]
        middle = 0.5 * (low + high)
        stack += [(*cell[:side], ends, *cell[side + 1 :]) for ends in ((middle, high), (low, middle))]
    if stack:
        raise ValueError(f"halvings: {len(stack)} cells are missing")
