"""Trajectories of a batch that JAX stages and differentiates later, as optimisers under `jit` do."""

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
import pytest
from decaying import decay_loop, decay_place
from mutants import killed_by

import diffabs as d


@killed_by("simulate/run.py", 'if getattr(run, "trajectory", None) is None:', "if True:")
def test_a_staged_batch_has_derivatives():
    """That of the exact places: Runge-Kutta steps of 0.01 have errors of 1e-10."""
    batch, controls = d.Batch({"controller.torque": np.array([1.0, 2.0])}), jnp.array([[1.0], [2.0]])

    def places(rate):
        run = d.run_batch(decay_loop(rate), batch, d.FixedStep(1e-2, 0.1, every=5), trajectories=True)
        return run.trajectory.sample.output.x

    rate = jnp.asarray(2.0)
    staged = jex.jaxpr_as_fun(jax.make_jaxpr(places)(rate))
    (slope,) = jax.jvp(staged, (rate,), (jnp.ones_like(rate),))[1]
    exact = jax.jacfwd(lambda rate: decay_place(jnp.array([0.0, 0.05, 0.1]), rate, controls))(rate)
    np.testing.assert_allclose(slope, exact, rtol=1e-6)


@pytest.mark.slow
def test_a_staged_batch_of_braking_cars_has_derivatives():
    """The derivative of the staged program is that of the program."""
    car, batch = d.braking(), d.Batch({"initial.speed": np.array([8.0, 9.0])})

    def slips(mass):
        loop = d.replace(car, {"plant.mass": mass})
        run = d.run_batch(loop, batch, d.FixedStep(1e-4, 1e-3, every=5), trajectories=True)
        return run.trajectory.sample.output.slip

    mass = jnp.asarray(15.0)
    staged = jex.jaxpr_as_fun(jax.make_jaxpr(slips)(mass))
    (slope,) = jax.jvp(staged, (mass,), (jnp.ones_like(mass),))[1]
    np.testing.assert_allclose(slope, jax.jacfwd(slips)(mass), rtol=1e-12)
