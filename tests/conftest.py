"""Every test runs in float64 unless it says otherwise, and compiled functions are kept between runs."""

import os
import pathlib

import jax
import numpy as np
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


@pytest.fixture(scope="module")
def any_step_is_stable():
    """Loading a scenario without the seconds of the stability check, which has tests of its own."""
    from diffabs.simulate import refusals

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refusals, "stable_step", lambda loop: np.inf)
        yield


@pytest.fixture(scope="module")
def without_load():
    """No lines on stderr that depend on the machine's load."""
    from diffabs.cli import console

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(console, "PATIENCE", np.inf)
        yield


@pytest.fixture
def file(tmp_path: pathlib.Path):
    """Write a scenario file."""

    def write(text: str, name: str = "mine.toml") -> pathlib.Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write
