"""Elementary functions against their definitions, at the ends of the range of their numbers."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

from diffabs.core.numerics import invalidate

LARGEST = np.finfo(float).max


@killed_by("core.numerics", "return jnp.zeros_like(x)", "return x")
@pytest.mark.parametrize("inputs", [[LARGEST, LARGEST], [np.inf, 1.0], [-np.inf, np.inf]])
def test_a_valid_number_stays_with_inputs_of_any_size(inputs):
    value, slope = jax.value_and_grad(lambda x: invalidate(3.0 * x[0], False, x[1:]))(jnp.array([2.0, *inputs]))
    assert value == 6.0
    np.testing.assert_array_equal(slope, [3.0, 0.0, 0.0])


def test_an_invalid_number_has_no_derivative():
    value, slope = jax.value_and_grad(lambda x: invalidate(3.0 * x[0], True, x[1:]))(jnp.array([2.0, LARGEST, 1.0]))
    assert np.isnan(value)
    assert np.isnan(slope).all()


@killed_by("core.numerics", "(_vanish(*at), moves[0])", "(_vanish(*at), 0.0 * moves[0])")
@pytest.mark.parametrize("bad", [math.nan, math.inf, 2.0])
def test_the_derivative_of_a_number_that_is_nan_is_nan(bad):
    """In both modes, by an input that is NaN or infinite, too."""

    def ended(p):
        return invalidate(0.0 * jax.lax.stop_gradient(p), True, {"p": p})

    assert math.isnan(jax.grad(ended)(bad))
    assert math.isnan(jax.jacfwd(ended)(bad))
