"""Fields that end at a surface with rate 0, behind a guard: a tank that runs empty."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from project import ROOT
from scipy.optimize import brentq

import diffabs as d
from diffabs.engine.field import SolutionStatus

SOLVER, END, INFLOW = d.Adaptive(1e-8), 4.0, 0.3
RATES = jnp.array([0.4, 1.0, 1.3])  # the tank is empty after 2/rate


def guarded(t, h, rate):
    """Outflow of the level, with a guard on both sides of the switch."""
    return jnp.where(h > 0, -rate * jnp.sqrt(jnp.where(h > 0, h, 1.0)), 0.0)


GUARDS = {
    "double where": guarded,
    "where": lambda t, h, rate: jnp.where(h > 0, -rate * jnp.sqrt(h), 0.0),
    "max": lambda t, h, rate: -rate * jnp.sqrt(jnp.maximum(h, 0.0)),
}


def solve(field, engine="xla"):
    return lambda rate: d.solve(field, 1.0, 0.0, END, rate, solver=SOLVER, engine=engine)


@pytest.mark.slow
@killed_by(
    "engine.step.adaptive",
    "stuck = jnp.logical_and(new, ~decision.valid) & (carry.length <= self.closest)",
    "pass",
    case="max-xla",
)
@killed_by("engine.step.adaptive", "(carry.status == RunStatus.REFRESHING) | carry.unrestricted", "False")
@pytest.mark.parametrize("engine", ["xla", "kernel"])
@pytest.mark.parametrize("name", GUARDS)
def test_an_empty_tank_stays_empty(name, engine):
    """The level is (1 - rate t/2)^2 until it is 0."""
    found = jax.vmap(solve(GUARDS[name], engine))(RATES)
    assert found.status.tolist() == 3 * [SolutionStatus.FINISHED]
    np.testing.assert_allclose(found.y, np.maximum(1 - RATES * END / 2, 0.0) ** 2, atol=1e-7)


@pytest.mark.slow
def test_an_empty_tank_has_derivatives():
    slopes = -np.maximum(1 - RATES * END / 2, 0.0) * END
    for mode in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.vmap(mode(lambda rate: solve(guarded)(rate).y))(RATES), slopes, atol=1e-6)


@pytest.mark.slow
def test_an_empty_tank_fills_again():
    """An inflow from 3 on. With s = sqrt(h), the time from 0 to s is the integral of 2 s/(inflow - rate s)."""

    def field(t, h, rate):
        return jnp.where(t < 3.0, 0.0, INFLOW) + guarded(t, h, rate)

    def level(rate):
        full = INFLOW / rate

        def left(s):
            return 2 / rate * (full * np.log(full / (full - s)) - s) - 1.0

        return brentq(left, 0.0, full * (1 - 1e-12)) ** 2

    found = jax.vmap(solve(field))(RATES[1:])
    np.testing.assert_allclose(found.y, [level(float(rate)) for rate in RATES[1:]], atol=1e-6)


@pytest.mark.slow
@killed_by("engine.step.switching", "carry.unrestricted & is_surface_moving(dynamics.surfaces, changed)", "False")
def test_a_level_that_may_fall_on_is_reported():
    """With sqrt(|h|) both 0 and -(rate t/2 - 1)^2 are solutions beyond the end."""
    found = jax.vmap(solve(lambda t, h, rate: -rate * jnp.sqrt(jnp.abs(h))))(RATES)
    assert found.status.tolist() == [SolutionStatus.FINISHED, SolutionStatus.GRAZED, SolutionStatus.GRAZED]
    assert np.isnan(found.y).tolist() == [False, True, True]


# The rows of the table of guards in docs/fields.md: fields, steps, statuses beyond the end, whether there is a value,
# and whether a derivative; None is either.
FIXED = d.FixedStep(1e-3)
TABLE = {
    "the double `where` above": ([guarded], SOLVER, {"FINISHED"}, (True, True)),
    "`jnp.sqrt(jnp.maximum(h, 0.0))`, or one `where` around `jnp.sqrt(h)`": (
        [GUARDS["max"], GUARDS["where"]],
        SOLVER,
        {"FINISHED"},
        (True, None),
    ),
    "`jnp.sqrt(jnp.abs(h))`, also times `jnp.sign(h)`": (
        [
            lambda t, h, rate: -rate * jnp.sqrt(jnp.abs(h)),
            lambda t, h, rate: -rate * jnp.sign(h) * jnp.sqrt(jnp.abs(h)),
        ],
        SOLVER,
        {"GRAZED"},
        (False, False),
    ),
    "none": ([lambda t, h, rate: -rate * jnp.sqrt(h)], SOLVER, {"DIVERGED"}, (False, False)),
    "any, with fixed steps": (list(GUARDS.values()), FIXED, {"SLID"}, (False, False)),
    "any, with an outflow that goes on at 0": (
        [lambda t, h, rate, guard=guard: guard(t, h, rate) - 0.1 for guard in GUARDS.values()],
        SOLVER,
        {"DIVERGED", "GRAZED", "SLID"},
        (False, False),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("row", TABLE, ids=["double", "single", "abs", "none", "fixed", "outflow"])
def test_a_row_of_the_table_of_guards(row):
    page = (ROOT / "docs" / "fields.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| guard \| result \|\n.*?\n\n", page, re.MULTILINE | re.DOTALL)[0].splitlines()[2:]
    assert {line.split(" | ")[0].removeprefix("| ") for line in rows if line} == TABLE.keys()
    fields, solver, statuses, finite = TABLE[row]
    for field in fields:

        def level(rate, field=field):
            found = d.solve(field, 1.0, 0.0, END, rate, solver=solver, engine="xla")
            return found.y, (found.y, found.status)

        slope, (value, status) = jax.jit(jax.grad(level, has_aux=True))(1.3)
        assert SolutionStatus(int(status)).name in statuses
        for number, needed in zip((value, slope), finite, strict=True):  # both are 0 in the empty tank
            assert needed is None or bool(jnp.isfinite(number)) == needed
            if jnp.isfinite(number):
                np.testing.assert_allclose(number, 0.0, atol=1e-6)
