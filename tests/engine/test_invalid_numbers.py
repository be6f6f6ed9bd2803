"""A result that is NaN has no derivative: it is NaN, never 0, in both modes. Spans that are empty have their start."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs import controllers, objectives
from diffabs.engine.field import SolutionStatus
from diffabs.engine.step.event_location import RunStatus
from diffabs.loop.arguments import prepare_arguments
from diffabs.loop.result import finish_run


@pytest.mark.slow
@pytest.mark.parametrize("solver", [d.Adaptive(1e-8), d.FixedStep(0.1)], ids=["adaptive", "fixed"])
def test_a_solution_without_a_value_has_no_derivative(solver):
    def final(p, engine="xla"):
        return d.solve(lambda t, y, p: p * y, 1.0, 0.0, 1.0, p, solver=solver, engine=engine).y

    numbers = jnp.array([0.5, jnp.nan, jnp.inf])
    for slopes in (
        jax.vmap(jax.grad(final)),
        jax.vmap(jax.jacfwd(final)),
        jax.vmap(jax.jacfwd(lambda p: final(p, "kernel"))),
    ):
        np.testing.assert_allclose(slopes(numbers), [np.exp(0.5), np.nan, np.nan], rtol=1e-5)


ENDS = jnp.array([0.2, 0.7, 1.2])


def saved(start, end, save):
    """dy/dt = -y from 1: exp(t0 - save)."""
    found = d.solve(lambda t, y, args: -y, 1.0, start, end, solver=d.Adaptive(1e-8), save=save)
    return found.y, found.status


@killed_by("engine.admission", "jnp.where(save == t0, 1.0, jnp.nan)", "jnp.nan")
def test_an_empty_span_has_its_start_at_its_saves():
    values, status = jax.jit(jax.vmap(saved, (None, 0, None)))(0.2, ENDS, jnp.array([0.2, 0.7]))
    np.testing.assert_allclose(values, [[1.0, np.nan], [1.0, np.exp(-0.5)], [1.0, np.exp(-0.5)]], atol=1e-7)
    assert set(status.tolist()) == {SolutionStatus.FINISHED}


@pytest.mark.slow
def test_an_empty_span_has_derivatives_at_its_saves():
    """Of exp(t0 - save): 1, 0 and -1 by t0, t1 and `save`."""
    save = jnp.array([0.2])
    slopes, status = jax.vmap(jax.jacrev(saved, argnums=(0, 1, 2), has_aux=True), (None, 0, None))(0.2, ENDS, save)
    np.testing.assert_allclose(np.concatenate([x.reshape(3, 1) for x in slopes], 1), 3 * [[1.0, 0.0, -1.0]], atol=1e-7)
    assert set(status.tolist()) == {SolutionStatus.FINISHED}


LOOP = d.braking(controller=controllers.ConstantTorque(torque=300.0))


def weighted(weight):
    return {"cost": objectives.QuadraticCost(q=jnp.stack([weight, 0.0]), r=1e-3)}


@killed_by("loop.result", "diverged, (loop, objectives))", "diverged, loop)")
def test_a_diverged_run_has_no_derivative_by_a_number_of_its_objective():
    def cost(weight):
        loop, measured, method = prepare_arguments(LOOP, d.Adaptive(1e-6, 1.0, 1e-2), weighted(weight))
        loop, audit = loop.prepare_run()
        carry = jax.lax.stop_gradient(method.start(loop, measured | audit, None))
        status = jnp.full_like(carry.status, RunStatus.DIVERGED)
        return finish_run(loop, measured | audit, carry._replace(status=status))[0].metrics["cost"]

    assert np.isnan(jax.jit(jax.grad(cost))(1.0))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["xla", "kernel"])
@pytest.mark.parametrize("solver", [d.Adaptive(1e-5, 0.2, 1e-2), d.FixedStep(1e-2, 0.2)], ids=["adaptive", "fixed"])
def test_a_run_without_a_value_has_no_derivative(solver, engine, monkeypatch):
    monkeypatch.setenv("DIFFABS_ENGINE", engine)

    def cost(torque, weight):
        return d.measure(d.replace(LOOP, {"controller.torque": torque}), solver, weighted(weight)).metrics["cost"]

    assert np.isnan(jax.vmap(cost, (0, None))(jnp.array([jnp.nan, jnp.nan]), 1.0)).all()
    for mode in (jax.jacrev, jax.jacfwd):
        assert np.isnan(mode(cost, (0, 1))(jnp.nan, 1.0)).all()
