"""Every test runs in float64 unless it says otherwise, and compiled functions are kept between runs."""

import os
import pathlib

import jax
import pytest

jax.config.update("jax_enable_x64", True)
cache = os.environ.get("DIFFABS_JAX_CACHE", str(pathlib.Path(__file__).parent.parent / ".jax_cache"))
jax.config.update("jax_compilation_cache_dir", cache)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@pytest.fixture(autouse=True)
def _float64():
    """A test that leaves another precision behind is an error."""
    yield
    assert jax.config.jax_enable_x64
