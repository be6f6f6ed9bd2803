"""Runge-Kutta steps against closed forms, SciPy, and the conditions of order."""

import itertools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from scipy.integrate import solve_ivp

from diffabs.core.cubic import Cubic
from diffabs.engine.step.runge_kutta import RK4, TSIT5, midpoint_error, runge_kutta_step


def coefficients(tableau):
    """Return A, b and c of a method as arrays."""
    a = np.zeros((len(tableau.weights), len(tableau.weights)))
    for i, row in enumerate(tableau.stages, 1):
        a[i, : len(row)] = row
    return a, np.array(tableau.weights), np.array([0.0, *tableau.nodes])


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


def weight(tree, a):
    """Return the stages' elementary weight of a tree (stages,)."""
    return np.prod([a @ weight(branch, a) for branch in tree], axis=0) if tree else np.ones(len(a))


@killed_by("engine.step.runge_kutta", "4.3622954328695815", "4.3622954328795815", case="tsit5-5")
@killed_by("engine.step.runge_kutta", "(1 / 6, 1 / 3, 1 / 3, 1 / 6)", "(1 / 6, 1 / 4, 5 / 12, 1 / 6)", case="rk4-3")
@pytest.mark.parametrize(
    ("name", "order"), [*(("rk4", order) for order in range(1, 5)), *(("tsit5", order) for order in range(1, 6))]
)
def test_all_conditions_of_order_hold(name, order):
    """Butcher: sum_i b_i Phi_i(t) = 1/gamma(t) for each rooted tree of up to five nodes; there are 1, 1, 2, 4, 9. The
    paper of TSIT5 gives sixteen digits."""
    a, b, c = coefficients({"rk4": RK4, "tsit5": TSIT5}[name])
    all_trees = trees(order)
    assert len(all_trees) == [1, 1, 2, 4, 9][order - 1]
    for tree in all_trees:
        assert b @ weight(tree, a) == pytest.approx(1 / density(tree), abs=5e-14)
    np.testing.assert_allclose(a.sum(axis=1), c, atol=5e-14)


def without_more(f):
    return lambda t, x, given: f(t, x)


def pendulum(t, z):
    return {"angle": z["rate"], "rate": -jnp.sin(z["angle"]) + 0.1 * jnp.cos(3 * t)}


@jax.jit
def ended(count):
    h, z = 2.0 / count, {"angle": jnp.asarray(1.0), "rate": jnp.asarray([0.5, -0.2])[0]}

    def step(i, z):
        return runge_kutta_step(TSIT5, without_more(pendulum), i * h, z, pendulum(i * h, z), h)[0]

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

    first = jnp.asarray(f(float(t), 0.0))
    x, so_far = runge_kutta_step(
        TSIT5, without_more(f), jnp.asarray(float(t)), jnp.asarray(float(t**power)), first, jnp.asarray(float(h))
    )
    assert float(x) == pytest.approx(float((t + h) ** power), rel=1e-14)
    off = midpoint_error(TSIT5, so_far, f(float(t + h), 0.0), float(h))
    assert float(off) == pytest.approx(float(h) ** 4 / 16 if power == 4 else 0.0, abs=1e-14)


@killed_by(
    "engine.step.runge_kutta",
    "h * (a + tableau.midpoint[-1] * b)",
    "0.5 * h * (a + tableau.midpoint[-1] * b)",
)
def test_the_error_at_the_middle_is_that_of_the_cubic():
    """x' = -x + sin 2t: against the closed form."""

    def exact(t):
        return (np.sin(2 * t) - 2 * np.cos(2 * t)) / 5 + 1.4 * np.exp(-t)

    def f(t, x):
        return -x + jnp.sin(2 * t)

    for h in (0.1, 0.05):
        t, x = jnp.asarray(0.4), jnp.asarray(exact(0.4))
        end, so_far = runge_kutta_step(TSIT5, without_more(f), t, x, f(t, x), jnp.asarray(h))
        off = midpoint_error(TSIT5, so_far, f(t + h, end), h)
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


def written_out(tableau, f, t, x, rate, h, given):
    rates = [rate]
    for place, row in zip(tableau.nodes, tableau.stages, strict=True):
        moved = jax.tree.map(lambda x, *k, row=row: x + h * sum(a * b for a, b in zip(row, k, strict=True)), x, *rates)
        rates.append(f(t + place * h, moved, given))
    return jax.tree.map(lambda x, *k: x + h * sum(a * b for a, b in zip(tableau.weights, k, strict=True)), x, *rates)


@killed_by(
    "engine.step.runge_kutta",
    "rounds = (jnp.arange(1, count), jnp.asarray(tableau.nodes, dtype), jnp.asarray(rows, dtype))",
    "rounds = (jnp.arange(1, count - 1), jnp.asarray(tableau.nodes[:-1], dtype), jnp.asarray(rows[:-1], dtype))",
)
@pytest.mark.parametrize(
    "tableau",
    [pytest.param(RK4, marks=pytest.mark.slow, id="rk4"), pytest.param(TSIT5, marks=pytest.mark.slow, id="tsit5")],
)
def test_a_loop_over_stages_has_the_unrolled_derivatives(tableau):
    end, at = moved(lambda *step: runge_kutta_step(tableau, *step)[0])
    plain, _ = moved(lambda *step: written_out(tableau, *step))
    for found, expected in zip(jax.tree.leaves(end(*at)), jax.tree.leaves(plain(*at)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-15)
    for mode in (jax.jacfwd, jax.jacrev):
        both = (jax.tree.leaves(mode(one, argnums=(0, 1, 2, 3))(*at)) for one in (end, plain))
        for found, expected in zip(*both, strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("degrees", [95, 120, 150, 180])
def test_it_is_stable_as_far_as_it_says(degrees):
    """x' = lambda x: |x(1)/x(0)| <= 1 up to 2.7, and to 3.5 on the negative axis; not much beyond."""
    far, (a, b, _) = 3.5 if degrees == 180 else 2.7, coefficients(TSIT5)

    def grows(size):
        z = size * np.exp(1j * np.radians(degrees))
        stages = np.linalg.solve(np.eye(6) - z * a, np.ones(6))
        return abs(1 + z * b @ stages)

    assert all(grows(size) <= 1 for size in np.linspace(0.01, far, 200))
    assert grows(1.35 * far) > 1
