"""Intervals of NumPy contain the exact results: sums and products in fractions, functions in Arb's balls."""

from fractions import Fraction

import numpy as np
import pytest
from mutants import killed_by

from diffabs.robust.frequency.coefficients import _determinant, _exponential
from diffabs.robust.frequency.intervals import Enclosure, Jet, cosine, enclose_number, enclose_power, monotone, sine

COUNT = 400


def draw_intervals(seed: int, scale: float = 1.0) -> Enclosure:
    draw = np.random.default_rng(seed)
    middle = draw.normal(size=COUNT) * scale * 10.0 ** draw.integers(-6, 4, COUNT)
    width = np.abs(middle) * draw.choice([0.0, 1e-12, 1e-3, 2.0], COUNT)
    return Enclosure(middle - width, middle + width)


def points_of(x: Enclosure) -> list[list[Fraction]]:
    shares = (0.0, 0.3, 1.0)
    rows = zip(x.low.tolist(), x.high.tolist(), strict=True)
    return [[Fraction(low) + (Fraction(high) - Fraction(low)) * Fraction(s) for s in shares] for low, high in rows]


def assert_contains(result: Enclosure, exact: list[list[Fraction]]) -> None:
    for low, high, values in zip(result.low.tolist(), result.high.tolist(), exact, strict=True):
        assert Fraction(low) <= min(values)
        assert max(values) <= Fraction(high)


@killed_by(
    "robust.frequency.intervals",
    "Enclosure(_down(self.low + other.low), _up(self.high + other.high))",
    "Enclosure(self.low + other.low, self.high + other.high)",
)
@killed_by("robust.frequency.intervals", "    return np.nextafter(x, -np.inf)", "    return x")
def test_sums_products_and_inverses_contain_the_fractions():
    x, y = draw_intervals(1), draw_intervals(2)
    for result, function in ((x + y, lambda a, b: a + b), (x - y, lambda a, b: a - b), (x * y, lambda a, b: a * b)):
        pairs = zip(points_of(x), points_of(y), strict=True)
        assert_contains(result, [[function(a, b) for a in p for b in q] for p, q in pairs])
    assert_contains(x.square(), [[a * a for a in p] for p in points_of(x)])
    inverse = x.inverse()
    away = (x.low > 0) | (x.high < 0)
    assert np.isnan(inverse.low[~away]).all()
    exact = [[1 / a for a in p] for p, good in zip(points_of(x), away, strict=True) if good]
    assert_contains(inverse[away], exact)


@killed_by("robust.frequency.intervals", "high = np.where(even | far, 1.0,", "high = np.where(far, 1.0,")
@killed_by("robust.frequency.intervals", "low = np.where(odd | far, -1.0,", "low = np.where(far, -1.0,")
def test_functions_contain_arbs():
    flint = pytest.importorskip("flint")
    x = draw_intervals(3)
    positive = Enclosure(np.abs(x.middle()), np.abs(x.middle()) * 1.5)
    exponents = {
        "cos": (cosine(x), x),
        "sin": (sine(x), x),
        "atan": (monotone(np.arctan, x), x),
        "log": (monotone(np.log, positive), positive),
    }
    for name, (result, argument) in exponents.items():
        for i, values in enumerate(points_of(argument)):
            for value in [
                *values,
                *(Fraction(k * np.pi) for k in (-1, 0, 1) if argument.low[i] <= k * np.pi <= argument.high[i]),
            ]:
                ball = getattr(flint.arb(flint.fmpq(value.numerator, value.denominator)), name)()
                assert flint.arb(float(result.low[i])) <= ball.upper(), name
                assert flint.arb(float(result.high[i])) >= ball.lower(), name
    power = enclose_power(positive, enclose_number(2.1))
    for i, value in enumerate(positive.middle()):
        ball = flint.arb(float(value)) ** flint.arb("2.1")
        assert flint.arb(float(power.low[i])) <= ball <= flint.arb(float(power.high[i]))


@killed_by(
    "robust.frequency.coefficients",
    "total = [[None if e is None else Jet(e.value + remainder, e.slopes) for e in row] for row in total]",
    "pass",
    case="5",
)
@pytest.mark.parametrize("terms", [5, 18])
def test_the_exponential_contains_arbs(terms, monkeypatch):
    """With few terms the remainder of the Taylor polynomial is larger than a rounding."""
    monkeypatch.setattr("diffabs.robust.frequency.coefficients.TAYLOR_TERMS", terms)
    flint = pytest.importorskip("flint")
    matrix = [[0.0, 0.999], [-0.999, 0.0]]
    entries = [[Jet(Enclosure(np.full(1, x))) if x else None for x in row] for row in matrix]
    entries = [[x or Jet(Enclosure(np.zeros(1))) for x in row] for row in entries]
    result = _exponential(entries, Jet(Enclosure(np.ones(1))), 1)
    exact = flint.arb_mat([[flint.arb(x) for x in row] for row in matrix]).exp()
    for i in range(2):
        for k in range(2):
            ball = exact[i, k] - int(i == k)
            entry = result[i][k]
            assert entry is not None
            assert flint.arb(float(entry.value.low[0])) <= ball <= flint.arb(float(entry.value.high[0]))
            assert terms < 18 or float(entry.value.high[0] - entry.value.low[0]) < 1e-14


@killed_by("robust.frequency.coefficients", "if (mask >> k).bit_count() % 2:", "if False:")
def test_a_determinant_of_polynomials_is_numpys():
    draw = np.random.default_rng(5)
    numbers = draw.normal(size=(4, 4, 2))
    matrix = [[[Jet(Enclosure(np.full(1, x))) for x in entry] for entry in row] for row in numbers]
    polynomial = [x.value.middle()[0] for x in _determinant(matrix) if x is not None]
    for s in (0.0, 1.0, -0.7):
        assert np.polyval(polynomial[::-1], s) == pytest.approx(np.linalg.det(numbers[:, :, 0] + s * numbers[:, :, 1]))
