"""Tables in a user's field: `jnp.interp`, `jnp.searchsorted` and `jnp.digitize`, by either engine."""

import os
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs.engine.field import SolutionStatus
from diffabs.robust.reach import NoRule
from diffabs.robust.reach.equations import derive_equations

KNOTS, VALUES = np.array([0.0, 0.3, 0.31, 1.0]), np.array([0.0, 1.0, -50.0, 2.0])
WIDTHS = np.diff(KNOTS)
AREA = np.sum(WIDTHS * (VALUES[1:] + VALUES[:-1]) / 2)  # of the polygon: what y' = interp(t) adds from 0 to 1
HATS = np.convolve(WIDTHS, [0.5, 0.5])  # its derivatives by the values
# y' = VALUES[i] on (KNOTS[i - 1], KNOTS[i]] from the search to the left, and VALUES[i - 1] from the one to the right
STEPS = np.sum(WIDTHS * VALUES[1:]), np.sum(WIDTHS * VALUES[:-1])
SOLVER = d.Adaptive(1e-9)

FIELDS = {
    "interp": lambda t, knots, values: jnp.interp(t, knots, values),
    "left": lambda t, knots, values: values[jnp.searchsorted(knots, t)],
    "right": lambda t, knots, values: values[jnp.searchsorted(knots, t, side="right") - 1],
    "digitize": lambda t, knots, values: values[jnp.digitize(t, knots) - 1],
    "compared": lambda t, knots, values: values[jnp.searchsorted(knots, t, method="compare_all")],
}
AREAS = {"interp": AREA, "left": STEPS[0], "right": STEPS[1], "digitize": STEPS[1], "compared": STEPS[0]}
LEFT, RIGHT = np.append(0.0, WIDTHS), np.append(WIDTHS, 0.0)  # derivatives of the steps by the values
SLOPES = {"interp": HATS, "left": LEFT, "right": RIGHT, "digitize": RIGHT, "compared": LEFT}


@pytest.mark.slow
@killed_by("compiler.lower.elementwise", '"lt_to le_to"', '"lt_too le_to"', case="kernel")
@pytest.mark.parametrize("engine", ["xla", "kernel"])
def test_tables_are_integrated_with_their_derivatives(engine):
    """Steps end on the knots; a crossing is located to some 1e-8 of the span, times a jump of 51."""

    def final(values):
        def field(t, y, args):
            return {name: rate(t, *args) for name, rate in FIELDS.items()}

        zero = dict.fromkeys(FIELDS, 0.0)
        solved = d.solve(field, zero, 0.0, 1.0, (jnp.asarray(KNOTS), values), solver=SOLVER, engine=engine)
        return solved.y, (solved.y, solved.status)

    slopes, (areas, status) = jax.jit(jax.jacfwd(final, has_aux=True))(VALUES)
    assert status == SolutionStatus.FINISHED
    for name in FIELDS:
        np.testing.assert_allclose(areas[name], AREAS[name], rtol=0, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(slopes[name], SLOPES[name], rtol=0, atol=1e-7, err_msg=name)


INSIDE = "lambda t, y, a: jnp.interp(t, jnp.array([0.0, 0.3, 0.31, 1.0]), jnp.array([0.0, 1.0, -50.0, 2.0]))"
OUTSIDE = "lambda t, y, a: jnp.interp(t, X, Y)"
HOST = "lambda t, y, a: jnp.interp(t, np.asarray(X), np.asarray(Y))"


@pytest.mark.slow
@killed_by("engine.step.comparisons", "jnp.asarray(x) if isinstance(x, np.ndarray) else x", "x", case="inside")
@pytest.mark.parametrize("order", [(INSIDE, OUTSIDE, HOST), (OUTSIDE, HOST, INSIDE)], ids=["inside", "outside"])
def test_the_first_table_of_a_process_may_be_made_anywhere(order):
    """In a process of its own: JAX keeps the program of the first `jnp.interp` for the later ones."""
    lines = [f"print(float(d.solve({field}, 0.0, 0.0, 1.0, solver=d.Adaptive(1e-8)).y))" for field in order]
    program = textwrap.dedent("""
        import jax, jax.numpy as jnp, numpy as np
        jax.config.update("jax_enable_x64", True)
        import diffabs as d
        X, Y = jnp.array([0.0, 0.3, 0.31, 1.0]), jnp.array([0.0, 1.0, -50.0, 2.0])
    """)
    told = [sys.executable, "-c", "\n".join([program, *lines])]
    done = subprocess.run(told, capture_output=True, text=True, check=False, env={**os.environ, "JAX_PLATFORMS": "cpu"})
    assert done.returncode == 0, done.stderr[-2000:]
    np.testing.assert_allclose([float(line) for line in done.stdout.split()], AREA, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_proof_refuses_a_search_in_a_table():
    """A run that crosses a knot decides the place differently from its neighbours, so the line says what to write."""
    loop = d.braking(controller=Table())
    with pytest.raises(NoRule, match=r"lt_to: a proof has no rule for a search in a table, as of jnp\.interp"):
        derive_equations(loop, ["plant.mass"])


@d.core.pytree.pytree
class Table:
    """The torque is a table of the speed."""

    start, flow = d.core.protocols.no_memory, d.core.protocols.no_flow

    def output(self, t, memory, signal):
        return jnp.interp(signal.measured.speed, jnp.array([0.0, 5.0, 20.0]), jnp.array([0.0, 300.0, 500.0]))
