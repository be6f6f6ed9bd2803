"""The Runge-Kutta step: its order, what it integrates exactly, and where it is stable."""

import math

import jax
import numpy as np
import pytest
from mutants import killed_by

from diffabs.core.numerics import axpy
from diffabs.engine.step.runge_kutta import rk4_step


def integrate(derivative, x, end, steps):
    h = end / steps
    return jax.jit(lambda x: jax.lax.fori_loop(0, steps, lambda k, x: rk4_step(derivative, k * h, x, h), x))(x)


def oscillator(t, x):
    """q'' = -q as a pytree with names; q(0) = 1, q'(0) = 0 gives q = cos t."""
    return {"position": x["velocity"], "velocity": -x["position"]}


def forced(t, x):
    """x' = -2 t x, whose solution exp(-t^2) shows a stage evaluated at the wrong time."""
    return -2 * t * x


@killed_by("engine.step.runge_kutta", "(1 / 6, 1 / 3, 1 / 3, 1 / 6)", "(1 / 6, 1 / 4, 5 / 12, 1 / 6)")
@killed_by("engine.step.runge_kutta", "rates.append(f(t + place * h,", "rates.append(f(t,", case="time-dependent")
@pytest.mark.parametrize(
    ("derivative", "x0", "end", "error"),
    [
        (oscillator, {"position": 1.0, "velocity": 0.0}, 2.0, lambda x: abs(x["position"] - math.cos(2.0))),
        (forced, 1.0, 1.0, lambda x: abs(x - math.exp(-1.0))),
    ],
    ids=["oscillator", "time-dependent"],
)
def test_fourth_order(derivative, x0, end, error):
    counts = np.array([20, 40, 80, 160])
    errors = [float(error(integrate(derivative, jax.tree.map(float, x0), end, int(n)))) for n in counts]
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert 3.9 < order < 4.1


def test_exact_for_a_cubic_rate():
    """Simpson's rule: exact for x' = polynomial of degree 3 in t, not for degree 4."""
    coefficients = np.array([0.7, -1.3, 2.1, 0.4])  # of t^3 .. 1

    def quartic(t):
        return np.polyval(np.polyint(coefficients), t)

    x = rk4_step(lambda t, x: np.polyval(coefficients, t), 0.3, quartic(0.3), 1.1)
    np.testing.assert_allclose(x, quartic(1.4), rtol=1e-14, atol=1e-14)
    x = rk4_step(lambda t, x: t**4, 0.0, 0.0, 1.0)
    assert abs(x - 0.2) > 1e-3


@pytest.mark.parametrize("z", [-2.7, -0.3, 0.4, 1.7])
def test_stability_polynomial(z):
    """On x' = lambda x a step multiplies by the exponential series cut after the fourth power."""
    series = sum(z**n / math.factorial(n) for n in range(5))
    x = rk4_step(lambda t, x: -4.0 * x, 0.0, 1.0, z / -4.0)
    np.testing.assert_allclose(x, series, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(("factor", "grows"), [(0.999, False), (1.001, True)])
def test_edge_of_stability(factor, grows):
    """On the negative real axis the series has modulus one where 24 + 12 z + 4 z^2 + z^3 = 0, z = -2.785."""
    edge = min(np.roots([1.0, 4.0, 12.0, 24.0]), key=lambda root: abs(root.imag)).real
    assert (abs(rk4_step(lambda t, x: factor * edge * x, 0.0, 1.0, 1.0)) > 1) == grows


def test_axpy_on_trees():
    np.testing.assert_allclose(axpy(2.0, (1.0, {"a": 3.0}), (10.0, {"a": 5.0}))[1]["a"], 11.0, rtol=0, atol=0)
