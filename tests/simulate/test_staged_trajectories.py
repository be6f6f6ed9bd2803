"""Trajectories of a batch that JAX stages and differentiates later, as optimisers under `jit` do."""

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from mutants import killed_by

import diffabs as d


@killed_by("simulate/run.py", 'if getattr(run, "trajectory", None) is None:', "if True:")
def test_a_staged_batch_has_derivatives():
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
