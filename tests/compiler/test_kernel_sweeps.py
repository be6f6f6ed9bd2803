"""Reverse mode of a kernel: a launch that logs the steps of its lanes and transposes them, against XLA.

The lanes make logistic steps y' = a y - g y^2, weighted by a number that each attempt measures. Every third attempt is
rejected, and each lane ends after its own number of attempts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels import FOLDER
from mutants import killed_by
from seams import replace_seam

from diffabs.compiler.lower.rules import Unsupported
from diffabs.compiler.pipeline import run_lanes
from diffabs.compiler.runtime import library_cache

pytestmark = pytest.mark.xdist_group("kernel sweeps")

LANES, MOST = 21, 40  # more lanes than a block has, and more attempts than a round
RATES, STARTS = jnp.linspace(0.5, 2.0, LANES), jnp.linspace(0.2, 0.4, LANES)
COUNTS = MOST - jnp.arange(LANES)
GAINS = jnp.array([1.1, 0.3])


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch):
    monkeypatch.setenv(library_cache.CACHE, FOLDER)


def grow(gains, rate, measured, y):
    return y + 0.1 * measured * (rate * y - gains[0] * y * y) + 0.01 * gains[1] * jnp.sin(y)


def by_kernel(gains, rates, starts):
    """The last y of each lane."""

    def attempt(lane, carry):
        i, _, _, y = carry
        made = i + 1, (i % 3 != 1) & (i < lane[1]), 1.0 + 0.1 * jnp.cos(i.astype(y.dtype)), y
        return repeat(lane, made)

    def repeat(lane, carry):
        i, accepted, measured, y = carry
        return i, accepted, measured, jnp.where(accepted, grow(gains, lane[0], measured, y), y)

    carry = jnp.zeros(LANES, int), jnp.zeros(LANES, bool), jnp.ones_like(starts), starts
    flag = False, True, False, False
    lanes = rates, COUNTS
    return run_lanes(
        *(lambda _, c: c, attempt, lambda lane, c: c[0] < lane[1], lanes, carry),
        **{"steps": 4, "rounds": 2, "replay": (repeat, flag)},
    )[3]


def by_xla(gains, rates, starts):
    def step(y, i):
        accepted = (i % 3 != 1) & (i < COUNTS)
        return jnp.where(accepted, grow(gains, rates, 1.0 + 0.1 * jnp.cos(i.astype(y.dtype)), y), y), None

    return jax.lax.scan(step, starts, jnp.arange(MOST))[0]


def total(f):
    return lambda *args: jnp.sum(jnp.cos(jnp.arange(LANES)) * f(*args) ** 2)


NESTINGS = {
    "grad": lambda f: jax.grad(total(f), (0, 1, 2))(GAINS, RATES, STARTS),
    "value_and_grad": lambda f: jax.jit(jax.value_and_grad(total(f)))(GAINS, RATES, STARTS),
    "jacrev": lambda f: jax.jacrev(f)(GAINS, RATES, STARTS),
    "vmap of gains": lambda f: jax.vmap(jax.grad(total(f)), (0, None, None))(jnp.outer(RATES, GAINS), RATES, STARTS),
    "vmap of rates": lambda f: jax.vmap(jax.grad(total(f)), (None, 1, None))(GAINS, jnp.outer(RATES, GAINS), STARTS),
    "linearize": lambda f: jax.linearize(lambda g: f(g, RATES, STARTS), GAINS)[1](GAINS),
    "transpose of two tangents": lambda f: jax.linear_transpose(
        jax.vmap(jax.linearize(lambda g: f(g, RATES, STARTS), GAINS)[1]), jnp.eye(2)
    )(jnp.outer(GAINS, RATES)),
}


@killed_by("compiler/native/sweeps.h", "row.on[q] = row.on[q] & on[q]", "row.on[q] = row.on[q] | on[q]")
@killed_by("compiler/native/sweeps.h", "rows[--count]", "rows[count -= 1 + (count > 2)]")
@killed_by("compiler.emit.sweeps", "if p.array in sweeps.changed]", "if False]")
@killed_by("compiler.runtime.jax_primitive", "total = jnp.sum(x, 0) if shared else x", "total = x[0] if shared else x")
@pytest.mark.parametrize("nesting", NESTINGS)
def test_equals_xla(nesting):
    found, known = (jax.tree.leaves(NESTINGS[nesting](f)) for f in (by_kernel, by_xla))
    for a, b in zip(found, known, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


def test_in_single_precision():
    arguments = [x.astype(jnp.float32) for x in (GAINS, RATES, STARTS)]
    found, known = (jax.grad(total(f), (0, 1, 2))(*arguments) for f in (by_kernel, by_xla))
    for a, b in zip(found, known, strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(a, b, rtol=1e-4)


@killed_by("compiler/native/sweeps.h", "i < RESULTS && !whole", "i < RESULTS && false")
def test_a_log_without_room_has_no_derivative(monkeypatch):
    replace_seam(monkeypatch, "max_log_bytes", 1 << 9)
    values, slopes = jax.value_and_grad(total(by_kernel), (0, 1))(GAINS, RATES, STARTS)
    assert np.isfinite(values)
    assert np.all(np.isnan(slopes[0]))
    assert np.all(np.isnan(slopes[1]))


@killed_by("compiler.runtime.jax_primitive", "lanes.sweeps(how[", "lambda: lanes.sweeps(how[")
def test_a_program_that_is_too_large_is_refused_before_it_is_transposed(monkeypatch):
    replace_seam(monkeypatch, "max_sweep_operations", 3)
    with pytest.raises(Unsupported, match="; 3 are the most"):
        jax.linearize(lambda g: by_kernel(g, RATES, STARTS), GAINS)


def test_second_derivatives_are_refused():
    with pytest.raises(ValueError, match="a kernel has no second derivatives"):
        jax.hessian(lambda g: total(by_kernel)(g, RATES, STARTS))(GAINS)
