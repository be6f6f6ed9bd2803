"""What the tests of the kernel share: programs of single functions, runs beside XLA's, a cache folder of their own."""

import os
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
from project import CACHE

import diffabs as d
from diffabs.compiler.pipeline import run_lanes

FOLDER = str(pathlib.Path(os.environ.get("DIFFABS_JAX_CACHE", CACHE)) / "kernel")  # kept between runs


def applied(functions, *arrays):
    """The results of functions of one lane, by name, for the lanes of these arrays: made by a kernel in one step."""
    count = len(arrays[0])
    shapes = {name: jax.eval_shape(f, *(x[0] for x in arrays)) for name, f in functions.items()}
    empty = {name: jnp.zeros((count, *x.shape), x.dtype) for name, x in shapes.items()}

    def step(lane, carry):
        return {name: f(*carry[1]) for name, f in functions.items()}, carry[1]

    def run(arrays):
        same, over = (lambda lane, carry: carry), (lambda lane, carry: jnp.asarray(False))
        return run_lanes(same, step, over, (), (empty, arrays), steps=1, rounds=1)[0]

    return jax.device_get(jax.jit(run)(arrays))


def both(loop, values, solver, objectives, keys=None):
    """Runs by a kernel and by XLA."""
    lanes = d.Batch(values, keys)
    runs = (
        d.run_batch(loop, lanes, solver, objectives, together=False, accepted=True, engine=engine)
        for engine in ("kernel", "xla")
    )
    return jax.device_get(tuple(runs))


def same(found, expected, rtol, atol):
    """The same flags, and the same metrics but for rounding."""
    for name in ("stopped", "diverged", "timed_out"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    for name, value in expected.metrics.items():
        np.testing.assert_allclose(found.metrics[name], value, rtol=rtol, atol=atol, err_msg=name)
