"""JAX's flags for debugging, set for other programs in the environment, do not break a command."""

import jax
import pytest
from commands import run
from mutants import killed_by
from small_scenarios import TUNE

FLAGS = {
    "jax_numpy_dtype_promotion": "strict",
    "jax_numpy_rank_promotion": "raise",
    "jax_transfer_guard": "disallow",
    "jax_debug_nans": True,
    "jax_disable_jit": True,
    "jax_enable_checks": True,
}


@pytest.fixture
def flags():
    before = {flag: getattr(jax.config, flag) for flag in FLAGS}
    for flag, value in FLAGS.items():
        jax.config.update(flag, value)
    yield
    for flag, value in before.items():
        jax.config.update(flag, value)


@killed_by("cli.main", 'jax.config.update(f"jax_{flag}", value)', "pass")
@pytest.mark.slow
def test_a_command_runs_under_flags_for_debugging(file, flags):
    assert '"diverged": false' in run("simulate", file(TUNE), "--json").stdout
