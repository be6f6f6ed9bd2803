"""Each operation of the native prover, as compiled, against exact fractions and decimals of 60 digits."""

import decimal
from fractions import Fraction

import numpy as np
import pytest
from mutants import killed_by

from diffabs.robust.reach.engine import apply_operation, decimal_ends

pytestmark = pytest.mark.usefixtures("native_prover")
CONTEXT = decimal.Context(prec=60)


def intervals(rng: np.random.Generator, count: int, low: float = -8, high: float = 8) -> np.ndarray:
    """Intervals of all magnitudes: the half of them points."""
    ends = np.sign(rng.uniform(-1, 1, (count, 2))) * 10.0 ** rng.uniform(low, high, (count, 2))
    ends[: count // 2, 1] = ends[: count // 2, 0]
    return np.sort(ends, 1)


@pytest.mark.parametrize("count", [5_000, pytest.param(50_000, marks=pytest.mark.slow)], ids=["few", "many"])
@pytest.mark.parametrize("name", ["add", "sub", "mul", "inv"])
@killed_by("robust/reach/native/prove.cpp", "double* out) {\n  Upward upward;\n  for", "double* out) {\n  for")
@killed_by(
    "robust/reach/native/interval.h",
    "  none |= ~fine;\n  V low = fine ? -a.n : fill(1.0)",
    "  V low = fine ? -a.n : fill(1.0)",
    case="inv-few",
)
@killed_by(
    "robust/reach/native/interval.h",
    "return {a.n + b.n, a.h + b.h};",
    "return {a.n + b.n, -(-a.h - b.h)};",
    case="add-few",
)
def test_operations_contain_the_exact_results(name: str, count: int) -> None:
    rng = np.random.default_rng(1)
    a, b = intervals(rng, count), intervals(rng, count)
    found = apply_operation(name, a, b)
    exact = {
        "add": lambda x, y: x + y,
        "sub": lambda x, y: x - y,
        "mul": lambda x, y: x * y,
        "inv": lambda x, y: 1 / x,
    }[name]
    for (a_low, a_high), (b_low, b_high), (low, high) in zip(a.tolist(), b.tolist(), found.tolist(), strict=True):
        if name == "inv" and a_low <= 0 <= a_high:
            assert low == -np.inf
            assert high == np.inf
            continue
        corners = [exact(Fraction(x), Fraction(y)) for x in (a_low, a_high) for y in (b_low, b_high)]
        assert Fraction(low) <= min(corners)
        assert max(corners) <= Fraction(high)
        # The bounds are the next doubles, and no wider.
        assert low >= np.nextafter(float(min(corners)), -np.inf)
        assert high <= np.nextafter(float(max(corners)), np.inf)


def exact_value(name: str, x: float, y: float) -> decimal.Decimal:
    """A function at a double, to 55 digits at least."""
    X = decimal.Decimal(x)
    match name:
        case "exp":
            return CONTEXT.exp(X)
        case "log":
            return CONTEXT.ln(X)
        case "power":
            return CONTEXT.exp(CONTEXT.multiply(decimal.Decimal(y), CONTEXT.ln(X)))
        case "atan":
            halvings = 0
            with decimal.localcontext(CONTEXT):
                while abs(X) > decimal.Decimal("0.05"):
                    X = X / (1 + (1 + X * X).sqrt())
                    halvings += 1
                total = sum((-1) ** k * X ** (2 * k + 1) / (2 * k + 1) for k in range(30))
                return total * 2**halvings
    with decimal.localcontext(decimal.Context(prec=110)):  # the terms are as large as e^|x|
        power, total, k = (X if name == "sin" else decimal.Decimal(1)), decimal.Decimal(0), (1 if name == "sin" else 0)
        while abs(power) > decimal.Decimal("1e-70") or k < abs(x):
            total += power
            power *= -X * X / ((k + 1) * (k + 2))
            k += 2
        return total


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("exp", -600, 600),
        ("log", 1e-12, 1e12),
        ("power", 1e-9, 10),
        ("sin", -60, 60),
        ("cos", -60, 60),
        ("atan", -1e4, 1e4),
    ],
)
@killed_by(
    "robust/reach/native/interval.h",
    "k <= 16; k++) term = term * y * inverses()[k], sum = sum + term;\n  sum = sum + symmetric(term.mag());",
    "k <= 9; k++) term = term * y * inverses()[k], sum = sum + term;",
    case="exp--600-600",
)
@killed_by(
    "robust/reach/native/interval.h",
    "for (int k = 1; k <= 22; k++) {",
    "for (int k = 1; k <= 6; k++) {",
    case="atan--10000.0-10000.0",
)
def test_functions_contain_the_exact_values(name: str, low: float, high: float) -> None:
    rng = np.random.default_rng(2)
    x = rng.uniform(low, high, 2000) if low < 0 else np.exp(rng.uniform(np.log(low), np.log(high), 2000))
    points, y = np.stack([x, x], 1), rng.uniform(0.05, 3.0, 2000)
    found = apply_operation(name, points, np.stack([y, y], 1))
    for at, e, (lowest, highest) in zip(x.tolist(), y.tolist(), found.tolist(), strict=True):
        truth = exact_value(name, at, e)
        assert decimal.Decimal(lowest) <= truth <= decimal.Decimal(highest), (name, at)
        assert (
            highest - lowest <= 1e-13 * max(1.0, abs(highest))
            if name not in ("exp", "power")
            else highest / lowest - 1 < 1e-12
        )


@pytest.mark.parametrize("name", ["exp", "log", "power", "sin", "cos", "atan"])
def test_functions_of_intervals_contain_those_of_their_points(name: str) -> None:
    rng = np.random.default_rng(3)
    middle, half = rng.uniform(0.5, 3.0, 400), rng.uniform(0, 0.4, 400)
    a, e = np.stack([middle - half, middle + half], 1), np.full((400, 2), 2.1)
    found = apply_operation(name, a, e)
    for share in np.linspace(0, 1, 7):
        x = a[:, 0] + share * (a[:, 1] - a[:, 0])
        inner = apply_operation(name, np.stack([x, x], 1), e)
        assert (found[:, 0] <= inner[:, 1]).all()
        assert (inner[:, 0] <= found[:, 1]).all()


def test_a_power_of_zero_is_zero() -> None:
    found = apply_operation("power", np.array([[0.0, 0.0], [0.0, 0.5]]), np.full((2, 2), 2.1))
    assert found[0].tolist() == [0.0, 0.0]
    assert found[1, 0] == 0.0
    assert 0.5**2.1 <= found[1, 1] < 0.5**2.1 * (1 + 1e-12)


def test_a_constant_stands_for_its_decimal() -> None:
    low, high = decimal_ends(0.407)
    assert Fraction(low) < Fraction("0.407") < Fraction(high)
    assert decimal_ends(0.5) == (0.5, 0.5)
