"""Trajectories of a batch that JAX stages and differentiates later, as optimisers under `jit` do."""

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d

MASS = jnp.asarray(15.0)


def slips(mass):
    loop, batch = d.replace(d.braking(), {"plant.mass": mass}), d.Batch({"initial.speed": np.array([8.0, 9.0])})
    run = d.run_batch(loop, batch, d.FixedStep(1e-4, 1e-3, every=5), trajectories=True)
    return run.trajectory.sample.output.slip


@pytest.fixture(scope="module")
def staged():
    """The staged program, and its derivative."""
    program = jex.jaxpr_as_fun(jax.make_jaxpr(slips)(MASS))
    return program, jax.jvp(program, (MASS,), (jnp.ones_like(MASS),))[1][0]


@killed_by("engine.drive.runs", 'if getattr(result, "trajectory", None) is None:', "if True:")
@pytest.mark.slow
def test_a_staged_batch_can_be_differentiated():
    program = jex.jaxpr_as_fun(jax.make_jaxpr(slips)(MASS))
    (slope,) = jax.eval_shape(lambda mass: jax.jvp(program, (mass,), (jnp.ones_like(mass),))[1], MASS)
    assert slope.shape == (2, 3)


@pytest.mark.slow
def test_a_staged_batch_has_derivatives(staged):
    program, slope = staged
    h = 1e-2
    ends = [np.asarray(program(MASS + change)[0]) for change in (h, -h)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * h), rtol=1e-5, atol=1e-12)


@pytest.mark.slow
def test_they_are_those_of_the_program(staged):
    np.testing.assert_allclose(staged[1], jax.jacfwd(slips)(MASS), rtol=1e-12)
