"""Runs that follow the surface along which they slide: values and derivatives against exact solutions in pieces."""

import filippov
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sliding
import test_slides
from marks import cases
from mutants import killed_by

import diffabs as d
from diffabs.core.pytree import get, replace
from diffabs.engine.solve import SolutionStatus
from diffabs.loop.sliding import describe_slide
from diffabs.parts.objectives import IAE

END = 3.0
FIXED, ADAPTIVE = d.FixedStep(1e-2, END, follow_slides=True), d.Adaptive(1e-8, END, 1e-2, follow_slides=True)
SOLVERS = [FIXED, pytest.param(ADAPTIVE, marks=pytest.mark.slow)]


def exact_iae(name, number):
    """Return the IAE over `END` seconds of a loop of `test_slides.SLIDING`, by its parameter."""
    if name == "textbook anti-windup":
        return sliding.limited_pi_iae(ki=number, end=END)
    friction = {"dry friction": number, "bang-bang law": 0.7 + number}[name]
    return 1.0 / (2.0 * friction)  # a block with speed 1 that comes to rest


EXACT = ("textbook anti-windup", "dry friction", "bang-bang law")


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", cases(dict.fromkeys(EXACT), "textbook anti-windup", "bang-bang law"))
@killed_by(
    "engine.step.slides",
    "select(begins, SlidingSurface(number, answers)",
    "select(begins & False, SlidingSurface(number, answers)",
)
def test_a_loop_that_slides_has_the_derivative_of_the_exact_solution(name, solver):
    loop, path, _ = test_slides.SLIDING[name]
    at = float(get(loop, path))

    def iae(x):
        run = d.measure(replace(loop, {path: x}), solver, {"iae": IAE()})
        return run.metrics["iae"], run

    _, slope, run = jax.jvp(iae, (at,), (1.0,), has_aux=True)
    assert not run.slid
    assert not run.diverged
    np.testing.assert_allclose(run.metrics["iae"], exact_iae(name, at), rtol=1e-7)
    for width in (1e-3, 3e-4, 1e-4):
        difference = (exact_iae(name, at + width) - exact_iae(name, at - width)) / (2 * width)
        np.testing.assert_allclose(slope, difference, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [FIXED, ADAPTIVE])
def test_values_reverse_mode_and_kernels_are_those_of_forward_mode(solver):
    loop, path, _ = test_slides.SLIDING["textbook anti-windup"]

    def iae(x):
        return d.measure(replace(loop, {path: x}), solver, {"iae": IAE()}).metrics["iae"]

    exact, slope = exact_iae("textbook anti-windup", 5.0), jax.jacfwd(iae)(5.0)
    np.testing.assert_allclose(iae(5.0), exact, rtol=1e-7)
    np.testing.assert_allclose(jax.grad(iae)(5.0), slope, rtol=1e-9)
    runs = d.run_batch(loop, d.Batch({path: jnp.array([4.0, 5.0])}), solver, {"iae": IAE()}, engine="kernel")
    np.testing.assert_allclose(runs.metrics["iae"], [exact_iae("textbook anti-windup", 4.0), exact], rtol=1e-7)


def field(t, y, p):
    """Return the rates of a `filippov.Field`."""
    margins = p.n @ y + p.m * (y @ y) + p.k * jnp.sin(t)
    sides = jnp.where(margins > 0, 1.0, -1.0)
    return p.A @ y + p.b[0] + p.b[1] * jnp.sin(t) + jnp.einsum("i,inm,m->n", sides, p.C, y) + sides @ p.d


def check_fields(count, seed, switches, solver):
    """Compare random fields with SciPy, and return how many slide, along two surfaces at once, and are refused."""
    rng = np.random.default_rng(seed)
    fields = [filippov.draw_field(rng, 3, switches) for _ in range(count)]
    moves = [jax.tree.map(lambda x: rng.normal(size=x.shape), p) for p in fields]
    stacked = [jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *rows) for rows in (fields, moves)]

    def end(p):
        solution = d.solve(field, p.y0, 0.0, END, p, solver=solver, engine="xla")
        return solution.y, solution.status

    def push(p, v):
        return jax.jvp(end, (p,), (v,), has_aux=True)

    values, slopes, statuses = jax.jit(jax.vmap(push))(*stacked)
    slides = both = refused = 0
    for i, (p, v) in enumerate(zip(fields, moves, strict=True)):
        exact = filippov.solve_exactly(p, END)
        if exact is None or exact.slowest < 3e-2:  # nearly a touch, where nothing has a derivative
            continue
        slides, both = slides + (exact.slides > 0), both + (exact.both > 0)
        if statuses[i] != SolutionStatus.FINISHED:
            refused += 1
            continue
        np.testing.assert_allclose(values[i], exact.y, rtol=1e-5, atol=1e-5 * np.max(np.abs(exact.y)), err_msg=str(i))
        errors = []
        for width in (1e-4, 1e-5, 1e-6):
            sides = [
                filippov.solve_exactly(jax.tree.map(lambda x, dx, h=h: x + h * dx, p, v), END) for h in (width, -width)
            ]
            if all(side is not None and side.slides == exact.slides for side in sides):
                difference = (sides[0].y - sides[1].y) / (2 * width)
                errors.append(np.max(np.abs(difference - slopes[i])) / (1e-3 + np.max(np.abs(difference))))
        assert not errors or min(errors) < 1e-3, (i, errors, exact)
    return slides, both, refused


@pytest.mark.slow
@pytest.mark.parametrize("solver", [d.Adaptive(1e-8, follow_slides=True), d.FixedStep(5e-3, END, follow_slides=True)])
def test_random_fields_slide_along_one_surface(solver):
    slides, _, refused = check_fields(250, 1, 1, solver)
    assert slides > 100
    assert refused <= 5


@pytest.mark.slow
def test_random_fields_slide_along_two_surfaces():
    slides, both, refused = check_fields(250, 5, 2, d.Adaptive(1e-8, follow_slides=True))
    assert slides > 120
    assert both > 50
    assert refused <= 20


def test_without_the_option_the_line_names_it():
    loop, _, _ = test_slides.SLIDING["dry friction"]
    solver = d.FixedStep(1e-2, END, kinks=True)
    run = d.measure(loop, solver, {"iae": IAE()})
    assert run.slid
    assert "follow_slides=True" in describe_slide(loop, solver, {"iae": IAE()}, run)


def test_it_needs_steps_that_end_on_kinks():
    with pytest.raises(ValueError, match=r"solver\.kinks = False: a run follows a switching surface only with steps"):
        d.measure(d.braking(), d.FixedStep(follow_slides=True, kinks=False), {"iae": IAE()})
    with pytest.raises(ValueError, match=r"solver\.follow_slides = 1 is not a Python bool"):
        d.measure(d.braking(), d.Adaptive(follow_slides=1), {"iae": IAE()})
