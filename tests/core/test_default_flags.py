"""JAX's flags for the search of faults judge a user's program, and the insides of a run pass under all of them."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs import objectives
from diffabs.core.jax_flags import DEFAULTS, default_flags

STRICT = {
    "debug_nans": True,
    "debug_infs": True,
    "numpy_dtype_promotion": "strict",
    "numpy_rank_promotion": "raise",
    "transfer_guard": "disallow",
}
START, TIMES, RATE = jnp.array([1.0, 0.0]), jnp.linspace(0.0, 1.0, 5), jnp.asarray(1.5)
RATES = jnp.linspace(1.0, 2.0, 3)
ACCURATE = d.Adaptive(1e-8)


@pytest.fixture
def strict():
    """All flags at once, as a user's program sets them."""
    with contextlib.ExitStack() as stack:
        for name, value in STRICT.items():
            stack.enter_context(getattr(jax, name)(value))
        yield


def spring(t, y, rate):
    """The position of a mass on a spring from 1 at rest is cos(rate t)."""
    return jnp.stack([y[1], -rate * rate * y[0]])


def position(rate, solver=ACCURATE):
    fall = d.Event(lambda t, y, rate: y[0] + 2.0, terminal=True)  # never: its row of crossings has only NaN
    return d.solve(spring, START, 0.0, 1.0, rate, solver=solver, save=TIMES, events=[fall]).y


def exact_slopes():
    """Of cos(rate t) by the rate."""
    return -np.asarray(TIMES) * np.sin(np.outer(RATES, TIMES))


@killed_by("engine.solve", "@default_flags()\ndef solve(", "def solve(")
def test_fields(strict):
    rows = np.asarray(position(RATE))
    np.testing.assert_allclose(rows[:, 0], np.cos(np.asarray(RATE) * np.asarray(TIMES)), atol=1e-6)


@pytest.mark.slow
def test_many_fields(strict):
    many = np.asarray(jax.jit(jax.vmap(position))(RATES))
    np.testing.assert_allclose(many[:, :, 0], np.cos(np.outer(RATES, TIMES)), atol=1e-6)


@pytest.mark.slow
def test_derivatives_of_fields(strict):
    slopes = jax.jit(jax.vmap(jax.jacfwd(lambda rate: position(rate, d.FixedStep(0.02)))))(RATES)
    np.testing.assert_allclose(np.asarray(slopes)[:, :, 0], exact_slopes(), atol=1e-5)


@pytest.mark.slow
@killed_by("engine.drive.deferred", "@default_flags()\ndef _lower(", "def _lower(")
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_fields_with_adaptive_steps(strict, mode):
    slopes = jax.jit(jax.vmap(mode(position)))(RATES)
    np.testing.assert_allclose(np.asarray(slopes)[:, :, 0], exact_slopes(), atol=1e-5)


def test_a_user_may_get_nan_from_a_run_that_diverges():
    """y' = y^2 from 1.5 has no solution at t = 2."""
    with jax.debug_nans(True):
        run = d.solve(lambda t, y, a: y * y, RATE, 0.0, 2.0, solver=d.Adaptive(1e-6))
    assert np.isnan(run.y)


LOOP, SOLVER = d.braking(), d.FixedStep(1e-4, 0.01)
MEASURED = {"error": objectives.IAE(), "distance": objectives.StopDistance()}
MASSES = jnp.linspace(15.0, 15.5, 600)  # so many that threads share them


def run_all():
    """Metrics of a run and of a batch, whether the run slid, and its trajectory."""
    run = d.measure(LOOP, SOLVER, MEASURED)
    many = d.run_batch(LOOP, d.Batch({"plant.mass": MASSES}), SOLVER, MEASURED, engine="xla")
    return run.metrics, many.metrics, run.slid, d.rollout(LOOP, SOLVER).trajectory


@pytest.fixture(scope="module")
def usual():
    return run_all()


@pytest.mark.slow
@killed_by("engine.drive.batches", "with default_flags(), jax.enable_x64", "with jax.enable_x64")
@killed_by("loop.run", "@default_flags()\ndef measure(", "def measure(")
@killed_by("loop.run", "@default_flags()\ndef rollout(", "def rollout(")
def test_loops_compute_the_same(strict, usual):
    jax.clear_caches()  # a traced program keeps the flags of its trace
    jax.tree.map(np.testing.assert_array_equal, run_all(), usual)


@pytest.mark.slow
def test_linear_quadratic_design(strict):
    """The double integrator with unit weights has the gain (1, sqrt(3))."""
    gain = d.linear.lqr(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1)).gain
    np.testing.assert_allclose(np.abs(gain), [[1.0, np.sqrt(3.0)]], rtol=1e-12)


def test_the_flags_are_the_users_again():
    with jax.numpy_dtype_promotion("strict"):
        with default_flags():
            assert jax.config.jax_numpy_dtype_promotion == "standard"
        assert jax.config.jax_numpy_dtype_promotion == "strict"
    assert STRICT.keys() == DEFAULTS.keys()
