"""A step of ten lines after each pass of the compiler: texts that a reader can follow, and that docs/compiler.md shows.

`python tests/compiler/test_passes.py` writes the texts of tests/data/passes again."""

import inspect
import re

import jax
import jax.numpy as jnp
import pytest
from mutants import killed_by
from project import ROOT

from diffabs.compiler.emit.cpp import LaunchShape, emit_cpp
from diffabs.compiler.passes import find_lane_calls, list_pass
from diffabs.compiler.pipeline import run_lanes

TEXTS = ROOT / "tests" / "data" / "passes"


def braking_step(lane, carry):
    """A body that brakes with a force in proportion to its speed, up to a limit; below 0.5 m/s it rolls to its end."""
    gain, v, x = lane["gain"], carry["speed"], carry["distance"]
    force = jnp.minimum(gain * v, 6.0)
    v_next = v - 0.01 * force / 1.5

    def roll_out(v, x):
        return jnp.zeros_like(v), x + v * v / (2.0 * gain)

    v_end, x_end = jax.lax.cond(v_next < 0.5, roll_out, lambda v, x: (v_next, x + 0.01 * v), v, x)
    return {"speed": v_end, "distance": x_end}


def lane_call(derivative):
    """The call of a kernel for three gains, with the derivative by the gain or without."""

    def run(gains):
        start = {"speed": jnp.full(3, 10.0), "distance": jnp.zeros(3)}
        return run_lanes(
            lambda lane, carry: carry, braking_step, lambda lane, carry: carry["speed"] > 0.0, {"gain": gains}, start,
            steps=16, rounds=1,
        )  # fmt: skip

    gains = jnp.array([1.0, 2.0, 3.0])
    function = (lambda x: jax.jvp(run, (x,), (x,))) if derivative else run
    (call,) = find_lane_calls(jax.make_jaxpr(function)(gains))
    return call


def text_of(name):
    """The text after a pass: values up to `lower`, `schedule` and `c`, a derivative after `jvp` and `eliminate`."""
    call = lane_call(name in ("jvp", "eliminate"))
    if name != "c":
        return list_pass(call, name)
    text = emit_cpp(call.program(), LaunchShape(vectors=1, steps=16, rounds=1))
    return re.search(r"^BODY void step.*?^}\n", text, re.MULTILINE | re.DOTALL)[0]


@killed_by("compiler.schedule", "use(gate.args[2], branch.yes)", "use(gate.args[2], block)", case="schedule")
@killed_by("compiler.autodiff.replicate", 'name = "sub" if factor.negative', 'name = "add" if False', case="eliminate")
@killed_by("compiler.operations", '"lt({0}, {1})"', '"le({0}, {1})"', case="c")
@pytest.mark.parametrize("name", ["lower", "jvp", "eliminate", "schedule", "c"])
def test_the_text_after_a_pass(name):
    if name in ("jvp", "eliminate") and jax.__version_info__ >= (0, 11):
        pytest.skip("JAX 0.11 differentiates a minimum by other comparisons")
    assert text_of(name) == (TEXTS / f"{name}.txt").read_text(encoding="utf-8")


def test_the_page_on_the_compiler_shows_these_texts():
    page = (ROOT / "docs" / "compiler.md").read_text(encoding="utf-8")
    for name in ("lower", "eliminate", "schedule", "c"):
        assert (TEXTS / f"{name}.txt").read_text(encoding="utf-8") in page
    head, _, rest = inspect.getsource(braking_step).partition('    """')
    assert head + rest.partition('"""\n')[2] in page


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name in ("lower", "jvp", "eliminate", "schedule", "c"):
        (TEXTS / f"{name}.txt").write_text(text_of(name), encoding="utf-8")
