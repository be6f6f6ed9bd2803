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
from scipy.optimize import brentq

import diffabs as d
from diffabs import controllers, references
from diffabs.core.pytree import get, replace
from diffabs.engine.solve import SolutionStatus
from diffabs.engine.step import fixed, slides
from diffabs.engine.step.modes import ComparisonAnswers, Mode, SlidingSurface
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
    assert refused <= 12


def steer_to_the_line(t, y, p):
    """Return the rates of a mass under sliding-mode control without a boundary layer: v' = -k sign(v + c x)."""
    x, v = y
    return v, -p["k"] * test_slides.sign(v + p["c"] * x)


def exact_on_the_line(p, end):
    """Return position and speed: constant acceleration from (1, 0) up to the line v = -c x, then x' = -c x."""
    k, c = p["k"], p["c"]
    lands = 1 / c * (np.sqrt(1 + 2 * c**2 / k) - 1)  # the line's root -k t + c (1 - k t^2/2) = 0
    x = (1 - k * lands**2 / 2) * np.exp(-c * (end - lands))
    return np.array([x, -c * x])


def heat_by_relay(t, y, p):
    """Return the rate of a temperature that a relay without a band holds on a rising target: y' = q (y < r) - y."""
    return p["q"] * jnp.where(y < target_at(t), 1.0, 0.0) - y


def target_at(t):
    return 1.0 + 0.25 * t**2


def exact_heat(p, end):
    """Return the temperature: heating up to the target, along it, and below it once it rises faster than q permits."""
    q = p["q"]
    lands = brentq(lambda t: q * (1 - np.exp(-t)) - target_at(t), 0.0, 1.5)
    leaves = -1 + np.sqrt(4 * (q - 1) + 1)  # r' + r = q, with r = 1 + t^2/4
    assert lands < leaves < end
    return q + (target_at(leaves) - q) * np.exp(leaves - end)


CONTROLLED = {
    "sliding mode": (steer_to_the_line, (1.0, 0.0), {"k": 2.0, "c": 1.5}, exact_on_the_line),
    "relay on a rising target": (heat_by_relay, 0.0, {"q": 2.5}, exact_heat),
}


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", cases(CONTROLLED, "sliding mode"))
@killed_by("engine.step.slides", "ahead, bits = share * (1.0 - share),", "ahead, bits = share - share + 1.0,")
def test_laws_that_switch_without_end_have_the_exact_derivatives(name, solver):
    rates, y0, p, exact = CONTROLLED[name]

    def end(p):
        solution = d.solve(rates, y0, 0.0, END, p, solver=solver, engine="xla")
        return jnp.stack(jax.tree.leaves(solution.y)), solution.status

    slopes, status = jax.jit(jax.jacfwd(end, has_aux=True))(p)
    assert status == SolutionStatus.FINISHED
    np.testing.assert_allclose(jax.jit(end)(p)[0], np.atleast_1d(exact(p, END)), rtol=1e-7)
    for parameter, number in p.items():
        for width in (1e-3, 3e-4, 1e-4):
            high, low = (exact({**p, parameter: number + move}, END) for move in (width, -width))
            np.testing.assert_allclose(slopes[parameter], np.atleast_1d(high - low) / (2 * width), rtol=1e-5)


def push_with_wave(t, y, p):
    """Return the rates of a force that pushes to zero, with a square wave, and of the integral of state and wave."""
    wave = jnp.sin(p * t) > 0
    return -jnp.sign(y[0]) + jnp.where(wave, 0.3, -0.3), y[0] + wave


def exact_wave_integral(p, end=2.0):
    """Return the integral over `end` seconds from the state 1: it falls to zero in straight pieces, and stays."""
    integral, state, begin = 0.0, 1.0, 0.0
    for k in range(int(end * p / np.pi) + 1):
        until, on = min((k + 1) * np.pi / p, end), k % 2 == 0
        length, rate = until - begin, -0.7 if on else -1.3
        falls = min(length, -state / rate)
        integral += state * falls + rate * falls**2 / 2 + on * length
        state, begin = max(0.0, state + rate * length), until
    return integral


@pytest.mark.slow
@killed_by("engine.step.advance", "& (regular | decision.crosses_surface)", "& regular")
@pytest.mark.parametrize("step", ["fixed", "adaptive"])
def test_a_wave_that_switches_during_a_slide_is_no_surface_to_slide_along(step):
    follows = {"follow_slides": True}
    solver = d.FixedStep(1e-2, 2.0, **follows) if step == "fixed" else d.Adaptive(1e-8, 2.0, 1e-2, **follows)

    def integral(p):
        solution = d.solve(push_with_wave, (1.0, 0.0), 0.0, 2.0, p, solver=solver, engine="xla")
        return solution.y[1], solution.status

    frequencies = jnp.array([30.0, 50.0, 120.0])
    values, slopes, statuses = jax.vmap(lambda p: jax.jvp(integral, (p,), (1.0,), has_aux=True))(frequencies)
    assert not statuses.any()
    np.testing.assert_allclose(values, [exact_wave_integral(p) for p in frequencies], rtol=1e-8)
    for width in (1e-3, 1e-4, 1e-5):
        ends = [[exact_wave_integral(p + side * width) for side in (-1, 1)] for p in frequencies]
        np.testing.assert_allclose(slopes, np.diff(ends)[:, 0] / (2 * width), rtol=1e-6)


def sampled_square(friction):
    """Return the integral of the square of the speed: constant accelerations between ticks, until friction holds."""
    speed, total = 1.0, 0.0
    while speed > 0:
        rate = 2.0 * (0.1 - speed) - friction
        length = min(0.25, -speed / rate)
        total += speed**2 * length + speed * rate * length**2 + rate**2 * length**3 / 3
        speed = speed + rate * length if length == 0.25 else 0.0
    return total


@killed_by("engine.step.advance", "& request.strikes & ticks", "& request.strikes")
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_slide_goes_on_between_the_ticks_of_a_clock(solver):
    controller = controllers.Sampled(controller=controllers.PID(kp=2.0, cutoff=3.0), period=0.25, delay=0.0)
    loop = test_slides.loop_of(sliding.Block(), controller=controller, reference=references.Setpoint(value=0.1))

    def square(friction):
        run = d.measure(replace(loop, {"plant.Fc": friction}), solver, {"square": test_slides.Square()})
        return run.metrics["square"], run.slid

    value, slope, slid = jax.jvp(square, (0.7,), (1.0,), has_aux=True)
    assert not slid
    np.testing.assert_allclose(value, sampled_square(0.7), rtol=1e-7)
    for width in (1e-3, 3e-4, 1e-4):
        difference = (sampled_square(0.7 + width) - sampled_square(0.7 - width)) / (2 * width)
        np.testing.assert_allclose(slope, difference, rtol=1e-5)


@killed_by("engine.step.outlook", "(read_bits(ended.answers, numbers)", "(False & read_bits(ended.answers, numbers)")
@pytest.mark.parametrize("solver", [d.FixedStep(5e-3, END, follow_slides=True), SOLVERS[1]])
def test_a_run_leaves_a_surface_that_two_comparisons_share(solver):
    """A growing force leaves friction with rate 0: rounding gave the other comparison of the sign a turn."""

    def push(t, y, p):
        slope, friction = p
        return slope * t - friction * jnp.sign(y)

    def end(p):
        solution = d.solve(push, jnp.array([0.2]), 0.0, END, p, solver=solver, engine="xla")
        return solution.y[0], solution.status

    slopes, frictions = 0.6 + jnp.linspace(-0.05, 0.05, 24), 1.0 + 0.03 * jnp.sin(jnp.arange(24.0))
    ends, statuses = jax.vmap(end)((slopes, frictions))
    assert not statuses.any()
    np.testing.assert_allclose(ends, slopes * (END - frictions / slopes) ** 2 / 2, rtol=1e-8)


@killed_by("engine.step.slides", "strays |= jnp.any(", "strays &= jnp.any(", case="FIXED")
@pytest.mark.parametrize("solver", SOLVERS)
def test_two_surfaces_met_at_one_instant_are_no_single_one(solver):
    """From (0.35, 0.7) both switches change at t = 0.5. A little apart, the run slides along both, into the corner."""

    def corner(t, y, slope):
        return jnp.array([0.3 - jnp.sign(y[0]), slope - 1.2 * jnp.sign(y[1])])

    ends = jax.jit(lambda slope: d.solve(corner, jnp.array([0.35, 0.7]), 0.0, 3.0, slope, solver=solver, engine="xla"))
    at_once, later = ends(-0.2), ends(-0.2 + 1e-4)
    assert bool(jnp.all(jnp.isnan(at_once.y)))
    np.testing.assert_allclose(later.y, 0.0, atol=1e-9)


@pytest.mark.slow
@killed_by("engine.step.outlook", "surfaces &= numbers != surface.number", "pass", case="ADAPTIVE")
@killed_by("engine.step.outlook", "& (start.margins >= 0)", "", case="ADAPTIVE")
@pytest.mark.parametrize("solver", [FIXED, ADAPTIVE], ids=["FIXED", "ADAPTIVE"])
def test_a_slide_ends_where_its_share_jumps(solver):
    """The force jumps beyond the friction, and moves on: up or down, toward the friction or away from it."""

    def push(t, y, p):
        when, force, rise = p
        return jnp.where(t > when, force + rise * (t - when), 0.5) - jnp.sign(y)

    def end(p):
        solution = d.solve(push, 0.35, 0.0, END, p, solver=solver, engine="xla")
        return solution.y, solution.status

    cases = jnp.array([[1.3, 1.6, 0.4], [1.3, 1.6, -0.1], [1.3, -1.7, 0.1], [1.3, -1.7, -0.4]])
    slopes, statuses = jax.jit(jax.vmap(jax.jacfwd(end, has_aux=True)))(cases)
    assert not statuses.any()
    for (when, force, rise), value, slope in zip(
        np.array(cases), jax.jit(jax.vmap(end))(cases)[0], slopes, strict=True
    ):
        left, rate = END - when, force - np.sign(force)
        np.testing.assert_allclose(value, rate * left + rise * left**2 / 2, atol=1e-7)
        np.testing.assert_allclose(slope, [-rate - rise * left, left, left**2 / 2], atol=1e-6)


@killed_by("engine.step.slides", "larger(share, 1.0 - share)", "share")
@killed_by("engine.step.slides", "jnp.where(near == beyond, MAX_SHARE, ", "jnp.where(False, MAX_SHARE, ")
# The rates p and q of the margin on this and on the other side; where they oppose, the other side's share is p/(p - q).
@pytest.mark.parametrize(
    ("pushes", "share"),
    [((-1.0, 3.0), 0.25), ((-2.0, -1.0), 2.0), ((-1.0, -3.0), 1.5), ((-1.0, -1.0), 2.0), ((3.0, 1.0), -0.5)],
)
def test_a_run_leaves_a_surface_to_the_side_that_both_flows_push_to(pushes, share):
    along = (SlidingSurface(jnp.asarray(0), (jnp.uint32(1),)),)

    def look(t, z, mode):
        answer = mode.words[0] & 1
        rate = jnp.where(answer == 1, pushes[0], pushes[1])
        answers = ComparisonAnswers(mode.words, (jnp.uint32(0),), np.array([0]), jnp.where(answer == 1, z, -z)[None])
        return ({"z": rate},), answers

    def look_at_flow(t, z, mode):
        return look(t, z[0]["z"], mode)

    dynamics = slides.slide(
        look_at_flow, jnp.asarray(0.0), ({"z": jnp.asarray(0.0)},), Mode((jnp.uint32(1),), along=along)
    )
    assert dynamics.shares[0] == pytest.approx(share)


@killed_by("engine.step.slides", "unrestricted & (slides | gives_up)", "unrestricted & slides")
def test_a_followed_run_whose_search_gives_up_is_reported(monkeypatch):
    monkeypatch.setattr(fixed, "MAX_ATTEMPTS_PER_STEP", 0)  # no search comes to its end
    loop, path, _ = test_slides.SLIDING["dry friction"]

    def iae(x):
        run = d.measure(replace(loop, {path: x}), FIXED, {"not compiled before": IAE()})
        return run.metrics["not compiled before"], run.slid

    _, slope, slid = jax.jvp(iae, (float(get(loop, path)),), (1.0,), has_aux=True)
    assert slid
    assert np.isnan(slope)


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
