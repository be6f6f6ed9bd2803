"""The cubic through the ends of a step."""

import jax
from mutants import killed_by

from diffabs.core.cubic import Cubic


@killed_by("core.cubic", "jax.lax.optimization_barrier(jax.lax.stop_gradient(self))", "jax.lax.stop_gradient(self)")
def test_a_root_is_not_fused_with_what_computes_its_cubic():
    """Without the barrier XLA of JAX 0.11 and 0.12 took 270 s for an adaptive loop of benchmarks/peers, with it 7 s."""
    program = jax.jit(Cubic.root).lower(Cubic(1.0, -1.0, 0.0, 0.0)).as_text()
    assert "optimization_barrier" in program
