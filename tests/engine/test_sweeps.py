"""Reverse mode of adaptive runs by a kernel's backward sweep: derivatives of forward directions, to rounding.

A direction of a gradient, g v, is that of forward mode along v, which no sweep is part of."""

import functools
import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import random_loops
from gradients_random import _at, _moved
from kernels import FOLDER
from mutants import killed_by
from seams import replace_seam

import diffabs as d
from diffabs.compiler.runtime import library_cache
from diffabs.core.pytree import canonical_dtypes
from diffabs.engine.drive import deferred
from diffabs.loop.run import run_unchecked

pytestmark = pytest.mark.xdist_group("sweeps")
SOLVER = d.Adaptive(rtol=1e-6, duration=1.0)
COUNT, RUNS = 10, 11  # inputs of a run, more than a launch has directions; runs, more than a block
RATES = jnp.linspace(0.5, 1.5, RUNS)
INPUTS = 1.0 + 0.1 * jnp.sin(jnp.arange(1.0, COUNT + 1))


@pytest.fixture(autouse=True)
def _kernels_by_default(users_engine, monkeypatch):
    monkeypatch.setenv(library_cache.CACHE, FOLDER)
    deferred._log_choice.cache_clear()


@pytest.fixture
def engines(caplog):
    """The lines in which the package says which engine makes the derivatives."""
    caplog.set_level(logging.INFO, "diffabs")
    return lambda: [m.split(" (")[0] for m in (r.getMessage() for r in caplog.records) if m.startswith("reverse")]


def heater(t, y, args):
    """Two switches in time, of which the second is never reached in some runs."""
    inputs, rate = args
    heat = jnp.where(y < 0.3 * inputs[0], inputs[1] * 4.0, inputs[2]) + jnp.where(y > 0.6 * rate, -inputs[3], 0.0)
    return rate * heat * jnp.cos(inputs[4] * t) - y * (inputs[5:] @ jnp.linspace(0.2, 1.0, COUNT - 5))


def warm(inputs, rate, engine="auto"):
    return d.solve(heater, inputs[6] * 0.1, 0.0, 1.0, (inputs, rate), solver=SOLVER, engine=engine).y


def bounce(inputs, rate):
    """A ball that falls twice onto the ground, with drag that differs upwards and downwards."""
    ground = d.Event(lambda t, y, a: y[0], lambda t, y, a: jnp.stack([0.0 * y[0], -a[2] * 0.7 * y[1]]))

    def fall(t, y, a):
        drag = jnp.where(y[1] > 0, a[1], a[4]) * jnp.sum(a[3:] ** 2)
        return jnp.stack([y[1], -9.81 * a[0] - drag * y[1]])

    start = jnp.stack([0.3 * inputs[3], rate])
    return d.solve(fall, start, 0.0, 1.0, inputs, solver=SOLVER, events=[ground]).y[0]


def explode(inputs, rate):
    """y = 1/(1/y0 - t) is infinite at t = 1/y0, in some runs before the end."""
    return d.solve(lambda t, y, a: y * y * a[0], inputs @ inputs * 0.1 * rate, 0.0, 1.0, inputs, solver=SOLVER).y


def mean(f):
    return lambda inputs: jnp.mean(jax.vmap(f, (None, 0))(inputs, RATES))


@killed_by("engine.drive.deferred", "few = _count_inputs(call, leaves) < MIN_SWEEP_INPUTS", "few = True")
@killed_by(
    "engine.step.replay",
    "after = LaggedReplay(new, carry.behind, log_attempt(old, new))",
    "after = carry._replace(ahead=new)",
)
@pytest.mark.parametrize("function", [pytest.param(warm, marks=pytest.mark.slow), bounce])
def test_gradients_are_those_of_forward_directions(function, engines):
    found = jax.jit(jax.grad(mean(function)))(INPUTS)
    known = jax.jit(jax.jacfwd(mean(function)))(INPUTS)
    assert engines() == ["reverse mode: a kernel"]
    np.testing.assert_allclose(found, known, rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_gradients_are_those_of_xla():
    found, known = (
        jax.jit(jax.vmap(jax.grad(functools.partial(warm, engine=engine)), (None, 0)))(INPUTS, RATES)
        for engine in ("auto", "xla")
    )
    np.testing.assert_allclose(found, known, rtol=1e-8, atol=1e-10)


def test_a_run_that_diverges_has_no_derivative():
    found, known = (jax.vmap(way(explode), (None, 0))(INPUTS, RATES) for way in (jax.grad, jax.jacfwd))
    lost = np.isnan(known).any(axis=1)
    assert 0 < lost.sum() < RUNS
    np.testing.assert_array_equal(np.isnan(found), np.isnan(known))
    np.testing.assert_allclose(found[~lost], known[~lost], rtol=1e-9)


@pytest.mark.slow
def test_second_derivatives_are_refused_as_without_a_kernel():
    with pytest.raises(ValueError, match="adaptive steps have no second derivatives"):
        jax.hessian(mean(warm))(INPUTS)


@pytest.mark.slow
@killed_by(
    "engine.drive.deferred",
    "except (Unsupported, NoCompiler):\n        return []",
    "except NoCompiler:\n        return []",
)
def test_a_sweep_that_is_impossible_leaves_forward_directions(monkeypatch, engines):
    jax.clear_caches()  # a sweep of another test would be taken from there
    replace_seam(monkeypatch, "max_sweep_operations", 3)
    known = jax.jacfwd(mean(warm))(INPUTS)
    np.testing.assert_allclose(jax.grad(mean(warm))(INPUTS), known, rtol=1e-10)
    assert engines() == []


# Not "rig, limited, clamped": forward mode itself moves by 2e-8 there if all numbers move by 1e-15.
LOOPS = ("computer, latch", "robust latch, noise", "scheduled, robust latch", "lab rig, lock", "sliding mode, patches")


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_of_a_random_loop(name):
    """Numbers of the loop and of its objectives differ between runs; so do the random keys."""
    loop, measures = random_loops.drawn(name, 0, 7), dict(list(random_loops.STRUCTURES[name].objectives.items())[:2])
    loop, measures = canonical_dtypes(loop), canonical_dtypes(measures)
    places = random_loops.numbers(loop, measures)
    x = np.array([_at(loop, measures, path)[place] for path, every in places.items() for place in every])
    draw = np.random.default_rng(0)
    rows, keys = (
        jnp.asarray(x * (1 + 0.005 * draw.standard_normal((RUNS, len(x))))),
        jax.random.split(jax.random.key(3), RUNS),
    )
    sides = np.where(np.abs(x) > 1e-6, np.abs(x), 1e-2) * draw.standard_normal((4, len(x)))

    def total(x, key):
        moved = _moved(loop, measures, places, x)
        run = run_unchecked(moved[0], d.Adaptive(1e-5, 1.5), moved[1], key, 0, "kernel")
        return sum(run.metrics.values())

    slopes = np.asarray(jax.jit(jax.vmap(jax.grad(total)))(rows, keys))
    along = lambda x, key: jax.vmap(lambda side: jax.jvp(lambda x: total(x, key), (x,), (side,))[1])(sides)  # noqa: E731
    known = np.asarray(jax.jit(jax.vmap(along))(rows, keys))
    assert np.isfinite(known).any()
    errors = np.abs(slopes @ sides.T - known) / (np.abs(slopes) @ np.abs(sides.T))
    np.testing.assert_array_equal(np.isnan(slopes @ sides.T), np.isnan(known))
    assert np.nanmax(errors) < 1e-10
