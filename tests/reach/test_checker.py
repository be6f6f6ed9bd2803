"""The checker's bounds against closed forms, runs and the native prover, with which it shares no code."""

import dataclasses
import math
import random
from fractions import Fraction

import jax
import numpy as np
import pytest
from mutants import killed_by
from seams import replace_seam

import diffabs as d
from diffabs.robust.reach.equations import Derivation, Equations, RealOperation, derive_equations
from diffabs.scenario.scenario import load

flint = pytest.importorskip("flint")
checker = pytest.importorskip("diffabs.robust.reach.checker")
balls = pytest.importorskip("diffabs.robust.reach.balls")
arb, check_cell, NotProved = flint.arb, checker.check_cell, checker.NotProved

LMI = ("slip-lmi", ["controller.low=0", "controller.high=9.03"])
CURED = ("slip-cured", [])
BOX = ("plant.mass", "initial.speed")
FULL = 50 / 3.6


class Tape:
    """Operations of equations that a test writes by hand."""

    def __init__(self):
        self.operations = []

    def __call__(self, name, *args, value=None):
        self.operations.append(RealOperation(name, args, value))
        return len(self.operations) - 1

    def number(self, value):
        return self("const", value=value)

    def states(self, count):
        return [self("state", value=i) for i in range(count)]

    def equations(self, start, flow, margin, signals, *, tick=(), period=None, nonnegative=()):
        """The last two states are the distance and the time."""
        n = len(start)
        names = tuple(f"x{i}" for i in range(n))
        params = tuple(o.value for o in self.operations if o.name == "param")
        return Equations(
            tuple(self.operations), params, names, tuple(start), tuple(flow), tuple(tick), period, signals, margin,
            nonnegative, n - 2, -1, n - 1, False,
        )  # fmt: skip


def oscillator(frequency, until):
    """x'' = -w^2 x, x(0) = p, x'(0) = 0; the distance is the integral of x; the run ends at a time."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, v, _, time = t.states(4)
    rate = t("neg", t("mul", t.number(frequency**2), x))
    margin = t("sub", t.number(until), time)
    return t.equations((p, zero, zero, zero), (v, rate, x, one), margin, {"x": x, "v": v})


def logistic(growth, until):
    """x' = r x (1 - x), x(0) = p; the run ends at x = `until`."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, *_ = t.states(3)
    rate = t("mul", t("mul", t.number(growth), x), t("sub", one, x))
    return t.equations((p, zero, zero), (rate, x, one), t("sub", t.number(until), x), {"x": x})


def limited(until):
    """x' = min(x, 1), x(0) = p; the run ends at x = `until`."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, *_ = t.states(3)
    rate = t("clamp", x, -1, one)
    return t.equations((p, zero, zero), (rate, x, one), t("sub", t.number(until), x), {"x": x, "rate": rate})


def held(gain, limit, period, until):
    """x' = -u, u := clamp(gain x, +-limit) every period, x(0) = p; the run ends at a time."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, u, distance, time = t.states(4)
    after = t("clamp", t("mul", t.number(gain), x), t.number(-limit), t.number(limit))
    flow, margin = (t("neg", u), zero, x, one), t("sub", t.number(until), time)
    return t.equations(
        (p, zero, zero, zero), flow, margin, {"x": x, "u": u}, tick=(x, after, distance, time), period=period
    )


def exact(x):
    """The fraction that an exact ball is."""
    mantissa, exponent = x.man_exp()
    return Fraction(int(mantissa)) * Fraction(2) ** int(exponent)


def ends(x):
    return exact(x.lower()), exact(x.upper())


def within(inner, outer):
    return outer[0] <= min(inner) and max(inner) <= outer[1]


@killed_by("robust.reach.checker", "for y in (a, b, *inside)]", "for y in (a, b)]")
@killed_by("robust.reach.balls", "return near + 0.0 if arb(near) >= high else nextafter(near, inf)", "return near")
@killed_by("robust.reach.balls", "return arb(value, float(np.spacing(abs(value))))", "return arb(value)")
def test_the_balls_contain_the_intervals():
    """Sums of ends are compared in fractions; a limit lies within its chord; signs are kept."""
    draw = random.Random(1)
    number = lambda: draw.choice([0.0, draw.uniform(-2, 2), draw.uniform(-1, 1) * 10 ** draw.uniform(-12, 3)])  # noqa: E731
    for _ in range(2000):
        a, b = sorted((number(), number()))
        p, q = sorted((number(), number()))
        x, y = balls.between(arb(a), arb(b)), balls.between(arb(p), arb(q))
        assert within((Fraction(a), Fraction(b)), ends(x))
        assert (a < 0 or ends(x)[0] >= 0) and (b > 0 or ends(x)[1] <= 0)  # noqa: PT018
        assert within([Fraction(s) * Fraction(t) for s in (a, b) for t in (p, q)], ends(balls.product(x, y)))
        assert within(
            [0, Fraction(a) * Fraction(0.3), Fraction(b) * Fraction(0.3)], ends(balls.integral_range(x, arb(0.3)))
        )
        assert within([Fraction(s) for s in (a, b, p, q)], ends(balls.hull(x, y)))
        if max(a, p) <= min(b, q):
            assert within([Fraction(max(a, p)), Fraction(min(b, q))], ends(balls.common(x, y)))
        low, high = sorted((number(), number()))
        low, high = draw.choice([(None, high), (low, None), (low, high)])
        chord = checker._relax(x, None if low is None else arb(low), None if high is None else arb(high))
        for argument in (a, b, draw.uniform(a, b)):
            limited = argument if low is None else max(argument, low)
            limited = Fraction(limited if high is None else min(limited, high))
            rest = ends(chord.offset + balls.symmetric(chord.width))
            assert within([limited - exact(chord.slope) * Fraction(argument)], rest)
            assert within([limited], ends(chord.limited))
            assert within([limited], ends(chord.values))
    for value in (0.1, 2.1, 1e-300, 13.88888888888889):
        assert within([Fraction(value), Fraction(repr(value))], ends(balls.constant(value)))
        with flint.ctx.workprec(checker.PRECISION):
            third = arb(value) / 3
            low, high = balls.below(third), balls.above(third)
            assert ends(third)[0] >= Fraction(low)
            assert ends(third)[1] <= Fraction(high)


def assert_encloses(bounds, truths, width):
    """Assert that bounds contain all truths and exceed them by at most `width`."""
    low, high = bounds
    assert min(truths) - width <= low <= min(truths)
    assert max(truths) <= high <= max(truths) + width


@killed_by("robust.reach.checker", "return series.value(rate, order - 1) / order", "return ZERO")
@killed_by("robust.reach.checker", "sums.append((q, middle + extra, along,", "sums.append((q, middle, along,")
@pytest.mark.parametrize(("cell", "width"), [((1.0, 1.0), 1e-10), ((0.9, 1.1), 1e-10)])
def test_an_oscillator_is_enclosed(cell, width):
    w, until = 3.0, 1.25
    bounds = check_cell(oscillator(w, until), ("x", "v"), [cell], [0.05], 10.0)
    assert_encloses(bounds.stop_time, [until], width)
    assert_encloses(bounds.distance, [p * math.sin(w * until) / w for p in cell], width)
    assert cell[1] <= bounds.upper["x"] <= cell[1] + 1e-9
    assert -cell[1] >= bounds.lower["x"] >= -cell[1] - 1e-3  # within a piece, the rate of all runs is bounded
    assert -3 * cell[1] >= bounds.lower["v"] >= -3 * cell[1] - 3e-3


@killed_by("robust.reach.checker", "return _dot(x, y, 0, k, k)", "return _dot(x, y, 0, 0, k)")
@killed_by("robust.reach.checker", "(inverse - alpha) * margin.whole", "ZERO")
@pytest.mark.parametrize(("cell", "width"), [((0.1, 0.1), 1e-6), ((0.1, 0.101), 1e-4)])
def test_a_logistic_equation_is_enclosed(cell, width):
    r, until = 2.0, 0.9
    bounds = check_cell(logistic(r, until), ("x",), [cell], [0.05] * 43 + [1e-3], 10.0)
    starts = np.linspace(*cell, 5)
    assert_encloses(bounds.stop_time, [math.log(until / (1 - until) * (1 - p) / p) / r for p in starts], width)
    assert_encloses(bounds.distance, [math.log((1 - p) / (1 - until)) / r for p in starts], width)
    assert bounds.lower["x"] <= cell[0]


@killed_by("robust.reach.checker", "return [balls.symmetric(x) for x in moved], slack", "return [ZERO] * n, slack")
@killed_by("robust.reach.checker", "y = y + _along(*self.seeds[i])", "pass")
@killed_by(
    "robust.reach.checker", "if all(b.contains(m) for b, m in zip(box, moved, strict=True)) and all(", "if True or all("
)
@pytest.mark.parametrize(("cell", "width"), [((0.5, 0.5), 1e-5), ((0.5, 0.51), 1e-3)])
def test_a_limit_within_a_flow_is_enclosed(cell, width):
    bounds = check_cell(limited(2.0), ("x", "rate"), [cell], [0.05] * 33 + [1e-3], 10.0)
    assert_encloses(bounds.stop_time, [1 - math.log(p) for p in np.linspace(*cell, 5)], width)
    assert_encloses(bounds.distance, [1 - p + 1.5 for p in np.linspace(*cell, 5)], width)
    assert 1.0 <= bounds.upper["rate"] <= 1.0 + width


def test_a_limit_of_a_limit_is_enclosed():
    """x' = min(min(x, 1) + 1/4, 1.125), x(0) = p; the run ends at x = 2."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, *_ = t.states(3)
    inner = t("add", t("clamp", x, -1, one), t.number(0.25))
    rate = t("clamp", inner, -1, t.number(1.125))
    e = t.equations((p, zero, zero), (rate, x, one), t("sub", t.number(2.0), x), {"x": x})
    cell = (0.5, 0.505)
    bounds = check_cell(e, ("x",), [cell], [0.05] * 20 + [1e-3], 10.0)
    truths = [math.log(1.125 / (p + 0.25)) + 1.125 / 1.125 for p in cell]
    assert_encloses(bounds.stop_time, truths, 2e-3)


@pytest.mark.parametrize("steps", [1, 3])
def test_a_limit_at_a_tick_is_enclosed(steps):
    gain, limit, period, until = 4.0, 0.75, 0.125, 0.95

    def run(x):
        distance, time, moves = 0.0, 0.0, []
        while time < until:
            u, h = min(limit, max(-limit, gain * x)), min(period, until - time)
            distance, x, time = distance + x * h - u * h * h / 2, x - u * h, time + h
            moves.append(u)
        return distance, max(moves)

    cell = (0.35, 0.36)
    bounds = check_cell(held(gain, limit, period, until), ("x", "u"), [cell], steps, 10.0)
    truths = [run(p)[0] for p in np.linspace(*cell, 11)]
    assert_encloses(bounds.stop_time, [until], 1e-12)
    assert_encloses(bounds.distance, truths, 1e-3)
    assert limit <= bounds.upper["u"] <= limit + 0.02


def test_a_lost_remainder_shows(monkeypatch):
    """The closed form leaves the enclosure if Lagrange's remainder is 0."""
    truth = math.sin(3.0 * 1.25) / 3.0
    replace_seam(monkeypatch, "checker_remainder", lambda series, rate, order: arb(0))
    bounds = check_cell(oscillator(3.0, 1.25), ("x",), [(1.0, 1.0)], [0.05], 10.0)
    assert not bounds.distance[0] <= truth <= bounds.distance[1]


def test_a_lost_disturbance_shows(monkeypatch):
    """The closed form leaves the enclosure if a chord is taken for the limit itself."""
    relax = checker._relax
    replace_seam(monkeypatch, "checker_chord", lambda x, low, high: relax(x, low, high)._replace(width=arb(0)))
    low, high = check_cell(limited(2.0), ("x",), [(0.5, 0.5)], [0.3], 10.0).stop_time
    assert not low <= 1 + math.log(2.0) <= high


@killed_by("robust.reach.checker", "self.stays_nonnegative(box, chords)", "pass")
@killed_by("robust.reach.checker", "states |= set(e.nonnegative)", "pass")
@killed_by("robust.reach.checker", "if value(a).contains(0):", "if False:")
@killed_by("robust.reach.checker", "not box[s].upper() < FASTEST_SLIP:", "False:")
@killed_by("robust.reach.checker", "not box[self.speed].lower() > float(SLOWEST):", "False:")
def test_what_has_no_proof_is_refused():
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, _, time = t.states(3)
    inverse = t("inv", t("sub", x, one))
    pole = t.equations((p, zero, zero), (inverse, x, one), t("sub", t.number(9.0), time), {"x": x})
    with pytest.raises(NotProved, match="division"):
        check_cell(pole, ("x",), [(0.5, 1.5)], [0.1], 10.0)
    switch = t("select", t("lt", x, t.number(0.55)), zero, one)
    relay = t.equations((p, zero, zero), (switch, x, one), t("sub", t.number(9.0), time), {"x": x})
    with pytest.raises(NotProved, match="decide"):
        check_cell(relay, ("x",), [(0.5, 0.6)], [0.1], 10.0)
    falling = t.equations(
        (p, zero, zero), (t("neg", one), x, one), t("sub", t.number(9.0), time), {"x": x}, nonnegative=(0,)
    )
    with pytest.raises(NotProved, match="negative"):
        check_cell(falling, ("x",), [(0.5, 0.6)], [0.1], 10.0)
    unread = dataclasses.replace(falling, flow=(falling.flow[0], one, one), signals={"t": time})
    with pytest.raises(NotProved, match="negative"):
        check_cell(unread, ("t",), [(0.5, 0.6)], [0.1], 10.0)
    rising = t.equations((p, zero, zero), (one, x, one), t("sub", t.number(0.8), time), {"x": x})
    with pytest.raises(NotProved, match="may lock"):
        check_cell(dataclasses.replace(rising, nonnegative=(0,)), ("x",), [(0.5, 0.6)], [0.1], 10.0)
    slower = t.equations((p, zero, zero), (t("neg", one), x, one), t("sub", t.number(0.9), time), {"x": x})
    with pytest.raises(NotProved, match="may stand"):
        check_cell(dataclasses.replace(slower, speed=0), ("x",), [(0.85, 0.86)], [0.1], 10.0)
    with pytest.raises(NotProved, match="at its start"):
        check_cell(logistic(2.0, 0.9), ("x",), [(0.8, 0.95)], [0.1], 10.0)
    with pytest.raises(NotProved, match="number of steps"):
        check_cell(held(4.0, 0.75, 0.125, 1.0), ("x",), [(0.3, 0.3)], [0.1], 10.0)
    end = x
    for _ in range(2000):
        end = t("add", end, x)
    chain = t.equations((p, zero, zero), (end, x, one), t("sub", t.number(9.0), time), {"x": x})
    with pytest.raises(NotProved, match="a chain of too many operations"):
        check_cell(chain, ("x",), [(0.5, 0.6)], [0.1], 10.0)


@killed_by("robust.reach.checker", "x.nonnegative_part() if low >= 0 else x", "x")
def test_a_state_that_may_not_be_negative_may_be_zero():
    """x' = 1 from x(0) = p until x = 0.5; half of 0.1 has more digits than the radius of a ball."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, *_ = t.states(3)
    rising = t.equations((p, zero, zero), (one, x, one), t("sub", t.number(0.5), x), {"x": x}, nonnegative=(0,))
    low, high = check_cell(rising, ("x",), [(0.0, 0.1)], [0.1], 10.0).stop_time
    assert within((0.4, 0.5), (low, high))


def test_a_horizon_ends_the_proof_early():
    bounds = check_cell(oscillator(3.0, 5.0), ("x",), [(1.0, 1.0)], [0.05], 0.3)
    assert 0.3 <= bounds.stop_time[0] < 0.36
    assert bounds.stop_time[1] == math.inf
    assert bounds.distance[0] == pytest.approx(math.sin(3 * bounds.stop_time[0]) / 3, abs=1e-9)


@killed_by("robust.reach.checker", "y += j * u[j] * g[k - j]", "pass")
@killed_by(
    "robust.reach.checker",
    "return balls.positive_power(x, value(o.args[2]))",
    "return balls.positive_power(x.mid(), value(o.args[2]))",
)
@pytest.mark.parametrize("name", ["exp", "log", "sin", "atan", "power", "inv"])
@pytest.mark.parametrize(("cell", "width"), [((0.5, 0.5), 1e-7), ((0.5, 0.54), 3e-2)])
def test_functions_are_enclosed(name, cell, width):
    """x' = 1 with x(0) = p, and the distance is the integral of a function of u = x^2 over 1 s."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, _, time = t.states(3)
    u = t("mul", x, x)
    at = len(t.operations)
    match name:
        case "exp":
            f, function = t("exp", u, at), np.exp
        case "log":
            inverse = t("inv", u)
            f, function = t("log", u, inverse), np.log
        case "sin":
            t("sin", u, at + 1)
            t("cos", u, at + 2)
            t("neg", at)
            f, function = at, np.sin
        case "atan":
            inverse = t("inv", t("add", one, t("mul", u, u)))
            f, function = t("atan", u, inverse), np.arctan
        case "inv":
            f, function = t("inv", u), np.reciprocal
        case _:  # power
            exponent = t.number(0.3)
            at = t("power", u, at + 4, exponent)
            t("inv", u)
            t("mul", at, at + 1)
            t("mul", exponent, at + 2)
            f, function = at, lambda y: y**0.3
    e = t.equations((p, zero, zero), (one, f, one), t("sub", one, time), {"f": f})
    nodes, weights = np.polynomial.legendre.leggauss(40)
    truths = [0.5 * weights @ function((start + 0.5 + 0.5 * nodes) ** 2) for start in cell]
    bounds = check_cell(e, ("f",), [cell], [0.05], 10.0)
    assert_encloses(bounds.distance, truths, width)
    values = function(np.linspace(cell[0], cell[1] + 1.0, 1001) ** 2)
    assert bounds.lower["f"] <= values.min()
    assert values.max() <= bounds.upper["f"]


RISING = {  # a function f, c and x of about the same slopes c and f'(x): a wrong sign of f' would lose both
    "exp": (1.0, 0.0, math.exp),
    "log": (1.0, 1.0, math.log),
    "sin": (1.0, 0.0, math.sin),
    "cos": (-1.0, math.pi / 2, math.cos),
    "atan": (1.0, 0.0, math.atan),
    "power": (0.3, 1.0, lambda x: x**0.3),
    "inv": (-1.0, 1.0, lambda x: 1 / x),
}


@killed_by(
    "robust.reach.checker",
    "return -self._convolve(o.args[0], self._sq",
    "return self._convolve(o.args[0], self._sq",
    case="inv",
)
@killed_by("robust.reach.equations", 'RealOperation("neg", (at,))', 'RealOperation("add", (at, at))', case="cos")
@killed_by(
    "robust.reach.equations", '(self.number(1.0), self.make("mul", (u, u)))', "(self.number(9.0), u)", case="atan"
)
@killed_by(
    "robust.reach.equations",
    'RealOperation("mul", (exponent, at + 2))',
    'RealOperation("const", (), -0.3)',
    case="power",
)
@pytest.mark.parametrize("name", RISING)
def test_a_function_has_its_own_derivative(name):
    """x' = 0, x(0) = p, and the distance is that of c x + f(x) over 1 s; the derivative is that of the equations."""
    c, centre, function = RISING[name]
    derivation = object.__new__(Derivation)
    derivation.operations, derivation.indices = [], {}
    make, number = derivation.make, derivation.number
    x, time = make("state", (), 0), make("state", (), 2)
    if name == "power":
        f = derivation.power(x, number(0.3), 0.3)
    else:
        f = make("inv", (x,)) if name == "inv" else derivation.function(name, x)
    rate = make("add", (make("mul", (number(c), x)), f))
    p, zero, one = make("param", (), 0), number(0.0), number(1.0)
    margin = make("sub", (one, time))
    e = Equations(
        tuple(derivation.operations), ("p",), ("x", "s", "t"), (p, zero, zero), (zero, rate, one), (), None, {"x": x},
        margin, (), 1, -1, 2, False,
    )  # fmt: skip
    cell = (centre - 0.1, centre + 0.1)
    assert_encloses(check_cell(e, ("x",), [cell], [0.25], 10.0).distance, [c * y + function(y) for y in cell], 0.1)


@killed_by("robust.reach.checker", "h * slack.get(q.rate, ZERO)))", "ZERO))", case="y")
@killed_by("robust.reach.checker", "(b[i] + sum((M[i][j] * D[j] for j in range(n)), ZERO))", "b[i]", case="z")
@pytest.mark.parametrize("rate", ["y", "z"])
def test_a_disturbance_reaches_what_it_moves(rate):
    """x' = 0, y' = max(x, 0), z' = 50 y, and the distance is that of y or z, in one step of 0.1 s."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, y, z, _, time = t.states(5)
    flow = (zero, t("clamp", x, zero, -1), t("mul", t.number(50.0), y), {"y": y, "z": z}[rate], one)
    e = t.equations((p, zero, zero, zero, zero), flow, t("sub", t.number(0.1), time), {"z": z})
    distance = check_cell(e, ("z",), [(-1.0, 1.0)], [0.1], 10.0).distance
    assert_encloses(distance, [0.0, {"y": 0.5 * 0.1**2, "z": 50 * 0.1**3 / 6}[rate]], 0.05)


@killed_by("robust.reach.checker", "+ remainder * t**order + slack", "+ slack")
def test_a_signal_has_the_remainder_of_its_polynomial():
    """The second order of a step of 1e-3 s is 5e-6; the run ends 1e-6 s before step 100 does."""
    until = 0.1 - 1e-6
    bounds = check_cell(oscillator(3.0, until), ("x",), [(1.0, 1.0)], [1e-3], 10.0, order=2)
    assert math.cos(0.3) - 1e-5 <= bounds.lower["x"] <= math.cos(3.0 * until)


def test_a_cell_of_two_neighbouring_numbers_is_a_set():
    """Its middle is one of them."""
    ends = (1.0, float(np.nextafter(1.0, 2.0)))
    assert all(checker._Check(oscillator(1.0, 1.0), ("x",), [ends], 7).all[0].contains(arb(x)) for x in ends)


def growth(until):
    """x' = x, x(0) = p; the run ends at x = `until`."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, *_ = t.states(3)
    return t.equations((p, zero, zero), (x, x, one), t("sub", t.number(until), x), {"x": x})


@killed_by(
    "robust.reach.checker",
    "near if self.rates is None else {x: balls.hull(near[x], self.rates[x]) for x in near}",
    "near",
)
def test_the_rates_of_all_ends_count():
    """The slowest run of a wide cell ends at a lower rate than the others, which have gone on, have then."""
    cell = (0.8, 1.2)
    bounds = check_cell(growth(2.0), ("x",), [cell], [0.01], 10.0)
    assert_encloses(bounds.stop_time, [math.log(2 / p) for p in cell], 0.3)


@killed_by("robust.reach.checker", "return self.rates is None and self.time()", "return self.time()")
def test_a_horizon_between_two_ends_is_no_end():
    bounds = check_cell(growth(2.0), ("x",), [(0.8, 1.2)], [0.01], 0.7)
    assert bounds.stop_time[0] <= math.log(2 / 1.2)
    assert math.log(2 / 0.8) <= bounds.stop_time[1] < math.inf


@killed_by("robust.reach.checker", "return whole.upper() < 0\n", "return whole.mid() < 0\n")
def test_a_proof_goes_on_until_the_last_run_ends():
    """x' = t - 1.5, x(0) = p; the run ends at x = 0.5. Later runs end at lower rates."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, _, time = t.states(3)
    rate = t("sub", time, t.number(1.5))
    e = t.equations((p, zero, zero), (rate, x, one), t("sub", x, t.number(0.5)), {"x": x})
    cell = (0.8, 1.2)
    truths = [1.5 - math.sqrt(1.5**2 - 2 * (p - 0.5)) for p in cell]
    assert_encloses(check_cell(e, ("x",), [cell], [0.01], 10.0).stop_time, truths, 0.1)


def test_a_wide_cell_is_enclosed_where_the_end_is_not_linear_in_its_start():
    """x' = x^2, x(0) = p: x = p/(1 - p t), and the distance is -log(1 - p t)."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, _, time = t.states(3)
    e = t.equations((p, zero, zero), (t("mul", x, x), x, one), t("sub", one, time), {"x": x})
    cell = (0.4, 0.5)
    bounds = check_cell(e, ("x",), [cell], [0.05], 10.0)
    assert_encloses(bounds.distance, [-math.log(1 - p) for p in cell], 0.02)
    assert 1.0 <= bounds.upper["x"] <= 1.1


def test_a_parameter_of_the_flow_is_enclosed():
    """x' = -p x, x(0) = 1; the run ends at x = 1/2."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, *_ = t.states(3)
    e = t.equations((one, zero, zero), (t("neg", t("mul", p, x)), x, one), t("sub", x, t.number(0.5)), {"x": x})
    cell = (1.0, 1.2)
    bounds = check_cell(e, ("x",), [cell], [0.02], 10.0)
    assert_encloses(bounds.stop_time, [math.log(2) / p for p in cell], 0.05)
    assert_encloses(bounds.distance, [0.5 / p for p in cell], 0.05)


def test_a_wide_parameter_of_the_flow_is_enclosed():
    """x' = p^3, x(0) = 0, during 1 s: linear in time, far from linear in p."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, _, time = t.states(3)
    rate = t("mul", p, t("mul", p, p))
    e = t.equations((zero, zero, zero), (rate, x, one), t("sub", one, time), {"x": x})
    bounds = check_cell(e, ("x",), [(1.0, 2.0)], [1.0], 10.0)
    assert_encloses(bounds.distance, [0.5, 4.0], 3.5)
    assert 8.0 <= bounds.upper["x"] <= 18.0


@pytest.mark.slow
def test_an_end_with_different_rates_is_enclosed():
    """x' = x^2 ends at x = 2: while the runs pass the end one after another, the rates change."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, *_ = t.states(3)
    e = t.equations((p, zero, zero), (t("mul", x, x), x, one), t("sub", t.number(2.0), x), {"x": x})
    cell = (0.45, 0.46)
    bounds = check_cell(e, ("x",), [cell], [0.002], 10.0)
    assert_encloses(bounds.stop_time, [1 / p - 0.5 for p in cell], 0.1)
    assert_encloses(bounds.distance, [math.log(2 / p) for p in cell], 0.3)


def test_a_set_across_a_limit_at_a_tick_is_enclosed():
    """One period: the greatest distance belongs to an end of the cell, where the chord alone would miss it."""
    until, cell = 0.9, (0.1, 0.3)
    bounds = check_cell(held(4.0, 0.75, 1.0, until), ("x", "u"), [cell], 1, 10.0)
    truths = [p * until - min(4 * p, 0.75) * until**2 / 2 for p in np.linspace(*cell, 41)]
    assert_encloses(bounds.distance, truths, 0.2)


def measured(scenario, mass, speed):
    """Stop time, distance and greatest slip of one run, in small steps."""
    with jax.enable_x64(True):
        rig = load(*scenario)
        solver = d.FixedStep(2e-5 if scenario is LMI else 1e-4, 2.5)
        found = d.measure(
            d.replace(rig.loop, {"plant.mass": mass, "initial.speed": speed}), solver, rig.objectives
        ).metrics
        return tuple(float(found[name]) for name in ("stop_time", "stop_distance", "max_slip"))


def cell_at(mass, speed, mass_side, speed_side):
    return [(mass - mass_side / 2, mass + mass_side / 2), (speed - speed_side / 2, speed + speed_side / 2)]


def proved_by_engine(equations, cell, horizon):
    """Bounds of the native prover, or None if it has no proof."""
    engine = pytest.importorskip("diffabs.robust.reach.engine")
    prover = engine.Prover(equations, ("slip",), horizon, tolerance=1e-8)
    prover.choose_weights(np.mean(cell, axis=1))
    found = prover.prove(np.array([cell] * 8), 1)
    return (found.time[0], found.distance[0], found.upper[0, 0]) if found.status[0] else None


@pytest.mark.slow
def test_the_published_gain_with_limits():
    e = derive_equations(load(*LMI, integrated=False).loop, BOX)
    cell = cell_at(5.3, FULL, 0.002, 0.02 / 3.6)
    bounds = check_cell(e, ("slip",), cell, [2e-4], 2.5)
    for mass, speed in ((5.3, FULL), (cell[0][0], cell[1][0]), (cell[0][1], cell[1][1])):
        time, distance, slip = measured(LMI, mass, speed)
        assert bounds.stop_time[0] <= time <= bounds.stop_time[1]
        assert bounds.distance[0] <= distance <= bounds.distance[1]
        assert slip - 1e-6 <= bounds.upper["slip"] <= slip + 1e-4
    assert bounds.stop_time[1] - bounds.stop_time[0] < 1e-3
    small = cell_at(5.3, FULL, 0.0005, 0.005 / 3.6)  # within the cell, and one that the engine proves
    if found := proved_by_engine(e, small, 2.5):
        assert found[0] == pytest.approx(bounds.stop_time, rel=1e-3)
        assert found[1] == pytest.approx(bounds.distance, rel=1e-3)
        assert found[2] == pytest.approx(bounds.upper["slip"], rel=1e-3)


@pytest.mark.slow
def test_the_cured_gain():
    e = derive_equations(load(*CURED, integrated=False).loop, BOX)
    cell = cell_at(5.3, FULL, 0.002, 0.02 / 3.6)
    bounds = check_cell(e, ("slip",), cell, 2, 0.1)
    _, _, slip = measured(CURED, 5.3, FULL)  # its slip is greatest at 0.05 s
    assert 0.1 <= bounds.stop_time[0] <= 0.102
    assert bounds.stop_time[1] == math.inf
    assert slip - 1e-6 <= bounds.upper["slip"] <= slip + 1e-4
    if found := proved_by_engine(e, cell, 0.1):
        assert found[2] == pytest.approx(bounds.upper["slip"], rel=1e-3)


@killed_by(
    "robust.reach.checker",
    "return _Chord(ONE, ZERO, arb(0.5), values, values)",
    "return _Chord(ONE, ZERO, ZERO, values, values)",
)
def test_a_rounding_at_a_tick_is_enclosed():
    """x := x/2 + round(4 x)/16 every second from x(0) = p, and the run ends after 3 s."""
    t = Tape()
    p, zero, one = t("param", value=0), t.number(0.0), t.number(1.0)
    x, distance, time = t.states(3)
    rounded = t("round", t("mul", t.number(4.0), x))
    after = t("add", t("mul", t.number(0.5), x), t("mul", t.number(0.0625), rounded))
    margin = t("sub", t.number(2.5), time)
    e = t.equations((p, zero, zero), (zero, x, one), margin, {"x": x}, tick=(after, distance, time), period=1.0)
    bounds = check_cell(e, ("x",), [(0.9, 1.4)], 1, 10.0)
    runs, ways = np.linspace(0.9, 1.4, 1001), []
    for _ in range(2):
        runs = runs / 2 + np.round(4 * runs) / 16
        ways.append(runs)
    last = runs / 2 + np.round(4 * runs) / 16
    truths = ways[0] + ways[1] + 0.5 * last
    assert_encloses(bounds.distance, truths.tolist(), 0.4)
    assert bounds.upper["x"] >= max(map(np.max, ways))
