"""The step of fifth order against closed forms, SciPy, and the conditions of order."""

import itertools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from scipy.integrate import solve_ivp

from diffabs.core.cubic import Cubic
from diffabs.simulate.step import tsit5
from diffabs.simulate.step.tsit5 import midpoint_error, tsit5_step_from, tsit5_step_with_error

A = np.zeros((6, 6))
for i, row in enumerate(tsit5.STAGE_COEFFICIENTS, 1):
    A[i, : len(row)] = row
B, C = np.array(tsit5.STEP_WEIGHTS), np.array([0.0, *tsit5.STAGE_NODES])


def trees(order):
    """Return all rooted trees of so many nodes, each the sorted tuple of what hangs on its root."""
    if order == 1:
        return [()]
    found = set()
    for parts in partitions(order - 1):
        for branches in itertools.product(*(trees(part) for part in parts)):
            found.add(tuple(sorted(branches)))
    return sorted(found)


def partitions(count, largest=None):
    """Return how a number is a sum, greatest first."""
    if count == 0:
        return [()]
    most = min(count, largest or count)
    return [(first, *rest) for first in range(most, 0, -1) for rest in partitions(count - first, first)]


def size(tree):
    return 1 + sum(size(branch) for branch in tree)


def density(tree):
    return size(tree) * np.prod([density(branch) for branch in tree], initial=1)


def weight(tree):
    """Return the stages' elementary weight of a tree (6,)."""
    return np.prod([A @ weight(branch) for branch in tree], axis=0) if tree else np.ones(6)


@killed_by("simulate/step/tsit5.py", "4.3622954328695815", "4.3622954328795815", case="5")
@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_all_conditions_of_order_hold(order):
    """Butcher: sum_i b_i Phi_i(t) = 1/gamma(t) for each rooted tree of up to five nodes; there are 1, 1, 2, 4, 9. The
    paper gives sixteen digits."""
    all_trees = trees(order)
    assert len(all_trees) == [1, 1, 2, 4, 9][order - 1]
    for tree in all_trees:
        assert B @ weight(tree) == pytest.approx(1 / density(tree), abs=5e-14)
    np.testing.assert_allclose(A.sum(axis=1), C, atol=5e-14)


def pendulum(t, z):
    return {"angle": z["rate"], "rate": -jnp.sin(z["angle"]) + 0.1 * jnp.cos(3 * t)}


@jax.jit
def ended(count):
    h, z = 2.0 / count, {"angle": jnp.asarray(1.0), "rate": jnp.asarray([0.5, -0.2])[0]}

    def step(i, z):
        return tsit5_step_with_error(pendulum, i * h, z, pendulum(i * h, z), h)[0]

    return jax.lax.fori_loop(0, count, step, z)


def test_its_error_goes_as_the_fifth_power():
    exact = solve_ivp(
        lambda t, y: [y[1], -np.sin(y[0]) + 0.1 * np.cos(3 * t)],
        (0, 2),
        [1.0, 0.5],
        method="DOP853",
        rtol=1e-13,
        atol=1e-14,
    ).y[:, -1]
    errors = [np.hypot(*(float(x) - y for x, y in zip(ended(n).values(), exact, strict=True))) for n in (5, 10)]
    assert np.log2(errors[0] / errors[1]) > 4.7
    assert errors[1] < 1e-7


@pytest.mark.parametrize("power", [1, 2, 3, 4])
def test_the_middle_of_a_power_is_that_of_its_cubic_or_known(power):
    """x = t^p from t to t + h: the cubic is exact up to the third power, and off by h^4/16 at the fourth."""
    t, h = Fraction(3, 10), Fraction(1, 2)

    def f(t, x):
        return power * t ** (power - 1) + 0.0 * x

    x, so_far = tsit5_step_with_error(f, float(t), jnp.asarray(float(t**power)), f(float(t), 0.0), float(h))
    assert float(x) == pytest.approx(float((t + h) ** power), rel=1e-14)
    off = midpoint_error(so_far, f(float(t + h), 0.0), float(h))
    assert float(off) == pytest.approx(float(h) ** 4 / 16 if power == 4 else 0.0, abs=1e-14)


@killed_by(
    "simulate/step/tsit5.py",
    "h * (a + MIDPOINT_ERROR_WEIGHTS[-1] * b)",
    "0.5 * h * (a + MIDPOINT_ERROR_WEIGHTS[-1] * b)",
)
def test_the_error_at_the_middle_is_that_of_the_cubic():
    """x' = -x + sin 2t: against the closed form."""

    def exact(t):
        return (np.sin(2 * t) - 2 * np.cos(2 * t)) / 5 + 1.4 * np.exp(-t)

    def f(t, x):
        return -x + jnp.sin(2 * t)

    for h in (0.1, 0.05):
        t, x = 0.4, exact(0.4)
        end, so_far = tsit5_step_with_error(f, t, x, f(t, x), h)
        off = midpoint_error(so_far, f(t + h, end), h)
        cubic = Cubic(x, end, h * f(t, x), h * f(t + h, end))(0.5)
        assert float(off) == pytest.approx(exact(t + h / 2) - float(cubic), rel=0.4 * h)


def moved(step):
    def end(a, t, x, h):
        def f(t, x, given):
            return {"u": -a * x["u"] ** 2 + x["v"][1] * jnp.cos(t), "v": given[0] * x["v"] * x["u"]}

        given = (jnp.asarray([2.0, 3.0]),)
        return step(f, t, x, f(t, x, given), h, given)

    x = {"u": jnp.asarray(1.2), "v": jnp.asarray([0.3, 0.7])}
    return end, (jnp.asarray(0.8), jnp.asarray(0.1), x, jnp.asarray(0.2))


def written_out(f, t, x, rate, h, given):
    return tsit5_step_with_error(lambda t, x: f(t, x, given), t, x, rate, h)[0]


@pytest.mark.slow
@killed_by(
    "simulate/step/tsit5.py",
    "rounds = (jnp.arange(1, count), jnp.asarray(STAGE_NODES, dtype), jnp.asarray(rows, dtype))",
    "rounds = (jnp.arange(1, count - 1), jnp.asarray(STAGE_NODES[:-1], dtype), jnp.asarray(rows[:-1], dtype))",
)
def test_a_loop_over_stages_has_the_unrolled_derivatives():
    end, at = moved(tsit5_step_from)
    plain, _ = moved(written_out)
    for found, expected in zip(jax.tree.leaves(end(*at)), jax.tree.leaves(plain(*at)), strict=True):
        np.testing.assert_array_equal(found, expected)
    for mode in (jax.jacfwd, jax.jacrev):
        both = (jax.tree.leaves(mode(one, argnums=(0, 1, 2, 3))(*at)) for one in (end, plain))
        for found, expected in zip(*both, strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("degrees", [95, 120, 150, 180])
def test_it_is_stable_as_far_as_it_says(degrees):
    """x' = lambda x: |x(1)/x(0)| <= 1 up to 2.7, and to 3.5 on the negative axis; not much beyond."""
    far = 3.5 if degrees == 180 else 2.7

    def grows(size):
        z = size * np.exp(1j * np.radians(degrees))
        stages = np.linalg.solve(np.eye(6) - z * A, np.ones(6))
        return abs(1 + z * B @ stages)

    assert all(grows(size) <= 1 for size in np.linspace(0.01, far, 200))
    assert grows(1.35 * far) > 1
