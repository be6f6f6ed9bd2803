"""Differentiable margins: against NumPy's, SLICOT, closed forms, and differences at three widths."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import slycot
from mutants import killed_by
from scipy.optimize import linprog
from scipy.signal import cont2discrete

from diffabs.core.compiling import SAME_RESULT_OPTIONS
from diffabs.core.pytree import get, replace
from diffabs.linear import Transfer, band, margins, multivariable_margins, open_loop
from diffabs.linear.opened_loop import OpenLoop, open_traced
from diffabs.linear.responses import (
    complementary_peak,
    delay_margin,
    disk_margin,
    gain_margins,
    h2_norm,
    hinf_norm,
    open_transfer,
    phase_margin,
    sampled_delay_margin,
    sensitivity_peak,
    structured_singular_value,
)
from diffabs.linear.responses.opening import join_halves
from diffabs.linear.responses.response import as_arrays, respond
from diffabs.linear.stability_margins import is_stable
from diffabs.loop.batch import Batch
from diffabs.scenario import load
from diffabs.tune import FrequencyBounds
from diffabs.tune.frequency_bounds import worst_of

WIDTHS = (1e-5, 1e-6, 3e-7)  # narrow: some loops are nearly unstable
NAMES = ("sensitivity", "complementary", "gain_down", "gain_up", "phase", "delay")


def random_loops(seed, count, order=4, sampled=False, delays=False):
    """Return stable loops of random systems, stacked; every second one has a delay."""
    draw, loops = np.random.default_rng(seed), []
    period = 0.1
    while len(loops) < count:
        a = np.diag(-np.exp(draw.normal(0, 1.2, order))) + np.triu(draw.normal(0, 1.0, (order, order)), 1)
        a[:2, :2] = [[-0.3, 2.0], [-2.0, -0.3]]
        b, c = draw.normal(size=(order, 1)), draw.uniform(0.5, 4.0) * draw.normal(size=(1, order))
        system = Transfer(a, b, c, np.zeros((1, 1)))
        if sampled:
            a, b = cont2discrete((a, b, c, system.D), period)[:2]  # pyright: ignore
            system = system._replace(A=a, B=b, period=period)
        if delays and len(loops) % 2:
            system = system._replace(delay=period * int(draw.integers(1, 3)) if sampled else draw.uniform(0.005, 0.1))
        if is_stable(system):
            loops.append(system)
    return loops


def stack(loops):
    fields = {name: jnp.array([getattr(loop, name) for loop in loops], float) for name in ("A", "B", "C", "D", "delay")}
    return Transfer(**fields)  # pyright: ignore[reportArgumentType]


def values(system):
    """The margins of one loop as a vector, in the order of NAMES."""
    low, high = gain_margins(system)
    delay = delay_margin(system).value if system.period is None else jnp.zeros(())
    peaks = (sensitivity_peak(system).value, complementary_peak(system).value)
    return jnp.stack([*peaks, low.value, high.value, phase_margin(system).value, delay])


def numpy_values(system):
    m = margins(system)
    return [m.sensitivity, m.complementary, *m.gain, m.phase, 0.0 if system.period else m.delay]


def compile_quickly(function):
    return jax.jit(function, compiler_options=SAME_RESULT_OPTIONS)


@pytest.mark.parametrize(
    "sampled", [pytest.param(False, id="continuous"), pytest.param(True, id="sampled", marks=pytest.mark.slow)]
)
@killed_by(
    "linear.responses.search", "step = jnp.where(usable, value, 0.0)", "step = jnp.where(usable, 0.9 * value, 0.0)"
)
def test_margins_and_their_derivatives(sampled):
    """Every margin of random loops, half of them with a delay, and its slope along a random direction."""
    loops = random_loops(7, 40, sampled=sampled, delays=True)
    systems, period, draw = stack(loops), loops[0].period, np.random.default_rng(1)
    moves = jax.tree.map(lambda x: jnp.asarray(draw.normal(size=x.shape)) * 0.3, systems)
    moves = moves._replace(D=0 * systems.D, delay=0.1 * systems.delay * (not sampled))
    margin = jax.vmap(lambda system: values(system._replace(period=period)))

    @compile_quickly
    def along(step):
        return jax.jvp(lambda h: margin(jax.tree.map(lambda x, dx: x + h * dx, systems, moves)), (step,), (1.0,))

    computed, slopes = along(0.0)
    expected = np.array([numpy_values(loop) for loop in loops])
    np.testing.assert_array_equal(np.isinf(computed), np.isinf(expected))
    finite = np.isfinite(expected)
    np.testing.assert_allclose(np.asarray(computed)[finite], expected[finite], rtol=1e-7)
    differences = [np.asarray(along(h)[0] - along(-h)[0])[finite] / (2 * h) for h in WIDTHS]
    errors = [np.abs(np.asarray(slopes)[finite] - d) / np.maximum(1.0, np.abs(d)) for d in differences]
    assert np.max(np.min(errors, axis=0)) < 1e-5


def test_peak_against_slicot():
    """CAR.md's loop 25/(s^3 + 10 s^2 + 10 s + 10), its disk margin, and random closed loops."""
    a = np.array([[-10.0, -10.0, -10.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    loop = Transfer(a, np.eye(3, 1), 25 * np.eye(3)[2:], np.zeros((1, 1)))
    peak = sensitivity_peak(loop)
    assert peak.value == pytest.approx(2.486659913635076, rel=1e-12)
    assert peak.at == pytest.approx(2.0114536324888324, rel=1e-8)
    disk = slycot.ab13dd("C", "I", "N", "D", 3, 1, 1, a - loop.B @ loop.C, np.eye(3), loop.B, -loop.C, 0.5 * np.eye(1))
    assert disk_margin(loop).value == pytest.approx(1 / disk[0], rel=1e-10)
    loops = random_loops(3, 60)
    peaks = compile_quickly(jax.vmap(lambda system: sensitivity_peak(system).value))(stack(loops))
    norms = [
        slycot.ab13dd("C", "I", "N", "D", 4, 1, 1, s.A - s.B @ s.C, np.eye(4), s.B, -s.C, np.eye(1))[0] for s in loops
    ]
    np.testing.assert_allclose(peaks, norms, rtol=1e-9)


def test_unstable_loop_has_no_margin():
    loop = Transfer(np.array([[0.5]]), np.ones((1, 1)), np.array([[0.2]]), np.zeros((1, 1)))
    assert np.isnan(sensitivity_peak(loop).value)
    assert np.isnan(phase_margin(loop).value)


@pytest.mark.parametrize(
    ("loop", "margin"),
    [
        (Transfer(-np.eye(1), np.eye(1), np.eye(1), 2 * np.eye(1)), 0.0),  # |D| >= 1: every delay is too long
        (Transfer(-np.eye(1), np.eye(1), np.eye(1), 0.5 * np.eye(1)), 2.0420166375518827),  # |L| = 1 at sqrt(5/3)
        (Transfer(-np.eye(1), np.eye(1), np.eye(1), 0.5 * np.eye(1), delay=0.1), np.nan),
        (Transfer(np.zeros((1, 1)), np.eye(1), np.eye(1), np.zeros((1, 1)), delay=-1.0), np.nan),
    ],
    ids=["direct", "small direct", "direct and delay", "negative delay"],
)
def test_delay_margin_with_a_direct_path_or_an_unfit_delay(loop, margin):
    np.testing.assert_allclose(delay_margin(loop).value, margin, rtol=1e-6)


def test_what_is_no_system_is_refused():
    with pytest.raises(ValueError, match=r"D has the shape \(\): A \(n, n\)"):
        sensitivity_peak(Transfer(-np.eye(1), np.eye(1), np.eye(1), 0.0))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="dict is no Transfer"):
        sensitivity_peak({})  # pyright: ignore[reportArgumentType]
    fraction = Transfer(0.5 * np.eye(1), np.eye(1), 0.5 * np.eye(1), np.zeros((1, 1)), 0.1, 0.05)
    assert np.isnan(sensitivity_peak(fraction).value)


def test_two_equal_peaks_are_shown():
    """Two equal channels have the same resonance; so do the two sides of a symmetric loop."""
    a = np.array([[-0.1, 1.0], [-1.0, -0.1]])
    slow, fast = a, 100.0 * a
    loop = Transfer(
        np.block([[slow, np.zeros((2, 2))], [np.zeros((2, 2)), fast]]),
        np.array([[0.1], [0.0], [10.0], [0.0]]),
        np.array([[1.0, 0.0, 1.0, 0.0]]),
        np.zeros((1, 1)),
    )
    peak = complementary_peak(loop)
    assert peak.runner_up == pytest.approx(float(peak.value), rel=0.05)
    assert peak.runner_up != peak.value


@pytest.mark.slow
@pytest.mark.parametrize("name", ["slip-cured", "slip-lmi"])
def test_loops_of_scenarios(name):
    loop = load(name).loop
    path = "controller.controller.gain" if name == "slip-cured" else "controller.gain"
    gain = jnp.asarray(get(loop, path))

    def margin(factors):
        tuned = replace(loop, {path: gain * factors})
        opened, system = open_traced(tuned), open_transfer(tuned)
        delay = delay_margin(system) if system.period is None else sampled_delay_margin(opened)
        return jnp.stack([sensitivity_peak(system).value, phase_margin(system).value, delay.value])

    @compile_quickly
    def along(step):
        return jax.jvp(lambda h: margin(1 + h * jnp.array([1.0, -0.7])), (step,), (1.0,))

    expected, (computed, slopes) = margins(open_loop(loop)), along(0.0)
    np.testing.assert_allclose(computed, [expected.sensitivity, expected.phase, expected.delay], rtol=1e-7)
    errors = [np.abs((along(h)[0] - along(-h)[0]) / (2 * h) / slopes - 1) for h in WIDTHS]
    assert np.max(np.min(errors, axis=0)) < 1e-6


@killed_by("linear.responses.opening", "as_arrays(halves.controller, 0)", "as_arrays(halves.controller)")
def test_a_controller_without_states():
    """L = k/(s^2 + s + 1) by a state feedback (k, 0); the controller alone is a gain."""
    plant = Transfer(np.array([[0.0, 1.0], [-1.0, -1.0]]), np.array([[0.0], [1.0]]), np.eye(2), np.zeros((2, 1)))
    gain, s = np.array([[-3.0, 0.0]]), 1j * np.array([0.3, 3.0])
    halves = OpenLoop(plant, Transfer(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), gain), 0.0)
    a, b, c = (np.asarray(matrix) for matrix in join_halves(halves)[:3])
    computed = c @ np.linalg.solve(s[:, None, None] * np.eye(2) - a, b + 0j)
    np.testing.assert_allclose(computed[:, 0, 0], 3 / (s**2 + s + 1), rtol=1e-12)
    np.testing.assert_array_equal(respond(as_arrays(halves.controller, 0), jnp.asarray(s.imag)), [gain, gain])


def test_singular_values_of_a_loop_with_two_channels():
    loop = load("quadruple-tank").loop
    expected, gain = multivariable_margins(open_loop(loop)).input, get(loop, "controller.pump_1.kp")

    @compile_quickly
    def along(gain):
        def peaks(gain):
            system = open_transfer(replace(loop, {"controller.pump_1.kp": gain}))
            return jnp.stack([sensitivity_peak(system).value, complementary_peak(system).value])

        return jax.jvp(peaks, (gain,), (jnp.ones_like(gain),))

    computed, slopes = along(gain)
    np.testing.assert_allclose(computed, [expected.sensitivity, expected.complementary], rtol=1e-8)
    h = 1e-5 * gain
    np.testing.assert_allclose(slopes, (along(gain + h)[0] - along(gain - h)[0]) / (2 * h), rtol=1e-6)


def test_norms_against_slicot():
    draw = np.random.default_rng(5)
    systems = []
    for _ in range(30):
        a = draw.normal(size=(5, 5))
        a -= (np.linalg.eigvals(a).real.max() + draw.uniform(0.01, 0.5)) * np.eye(5)
        systems.append(Transfer(a, draw.normal(size=(5, 2)), draw.normal(size=(2, 5)), np.zeros((2, 2))))
    both = compile_quickly(jax.vmap(lambda system: (hinf_norm(system).value, h2_norm(system))))
    norms = [slycot.ab13dd("C", "I", "N", "D", 5, 2, 2, s.A, np.eye(5), s.B, s.C, s.D)[0] for s in systems]
    squares = [slycot.ab13bd("C", "H", 5, 2, 2, s.A, s.B, s.C, s.D) for s in systems]
    hinf, h2 = both(stack(systems))
    np.testing.assert_allclose(hinf, norms, rtol=1e-9)
    np.testing.assert_allclose(h2, squares, rtol=1e-10)


@killed_by("linear.responses.response", "turned = (reduced @", "turned = (0.9 * reduced @")
def test_derivatives_of_a_norm_whose_smaller_singular_values_are_equal():
    """Two slow channels are equal, and the fourth is zero; the greatest, x^3/(s^2 + 2 z x s + x^2), has a closed form.

    Its peak is x/(2 z sqrt(1 - z^2)). A rotation of the inputs with x changes no singular value.
    """
    z = 0.1

    def norm(x):
        a = jnp.zeros((4, 4)).at[0, 1].set(x).at[1, 0].set(-x).at[1, 1].set(-2 * z * x)
        a = a.at[2, 2].set(-1.0).at[3, 3].set(-1.0)
        b = jnp.zeros((4, 4)).at[1, 0].set(x).at[2, 1].set(0.1).at[3, 2].set(0.1)
        turn = jnp.eye(4).at[:2, :2].set(jnp.array([[jnp.cos(x), -jnp.sin(x)], [jnp.sin(x), jnp.cos(x)]]))
        c = jnp.zeros((4, 4)).at[0, 0].set(x).at[1, 2].set(1.0).at[2, 3].set(1.0)
        return hinf_norm(Transfer(a, b @ turn, c, jnp.zeros((4, 4)))).value ** 2  # pyright: ignore[reportArgumentType]

    @compile_quickly
    def expand(x):
        value_and_slope = jax.value_and_grad(norm)
        (value, slope), (_, bend) = jax.jvp(value_and_slope, (x,), (1.0,))
        return value, slope, bend

    factor = (2 * z * np.sqrt(1 - z**2)) ** -2
    np.testing.assert_allclose(expand(1.5), [2.25 * factor, 3.0 * factor, 2.0 * factor], rtol=1e-8)


# The matrix of SLICOT's example of AB13MD, with the published bound 41.74753408.
ROWS = """-1+6j 2-3j 3+8j 3+8j -5-9j -6+2j|4+2j -2+5j -6-7j -4+11j 8-7j 12-1j|5-4j -4-8j 1-3j -6+14j 2-5j 4+16j"""
SLICOT_MATRIX = np.array([[complex(x) for x in row.split()] for row in ROWS.split("|")] * 2)


@pytest.mark.parametrize(
    "real",
    [
        pytest.param((True, True, False, False, False), id="mixed"),
        pytest.param((False,) * 5, id="complex", marks=pytest.mark.slow),
    ],
)
def test_structured_singular_value(real):
    """Published value, SLICOT, both bounds, and the derivative from the dual solution."""
    blocks, kinds = [1, 1, 2, 1, 1], np.where(real, 1, 2)
    direction = np.random.default_rng(2).normal(size=(6, 6, 2)) @ [1, 1j]

    @compile_quickly
    def along(step):
        def upper(h):
            mu = structured_singular_value(SLICOT_MATRIX + h * direction, blocks, real)
            return mu.upper, mu.lower

        return jax.jvp(upper, (step,), (1.0,))

    (upper, lower), (slope, _) = along(0.0)
    bound = slycot.ab13md(SLICOT_MATRIX, np.array(blocks), kinds)[0]
    assert upper == pytest.approx(bound, rel=1e-8)
    if any(real):
        assert upper == pytest.approx(41.74753408, rel=1e-9)
        assert 0.98 * upper < lower < (1 + 1e-9) * upper
    else:
        assert lower == pytest.approx(float(upper), rel=1e-6)
    differences = [(along(h)[0][0] - along(-h)[0][0]) / (2 * h) for h in (1e-3, 1e-4)]
    assert min(abs(d / slope - 1) for d in differences) < 1e-5


@killed_by("linear.responses.structured", "(t * members - squares), -turns]", "(t * members - squares), turns]")
def test_bounds_of_a_real_number_and_a_full_block():
    """The upper bound is mu (Meinsma, Shrivastava and Fu, 1997): a search over the real number gives the block."""
    draw, numbers = np.random.default_rng(5), np.geomspace(0.01, 30.0, 4001)
    numbers, matrices = np.concatenate([-numbers, [0.0], numbers]), draw.normal(size=(40, 3, 3, 2)) @ [1, 1j]
    scaled = matrices * np.array([1e4, 1.0, 1.0]) * np.array([1e-4, 1.0, 1.0])[:, None]  # D M D^-1 has the same mu
    mu = compile_quickly(jax.vmap(lambda m: structured_singular_value(m, [1, 2], [True, False])))(scaled)
    for m, lower, upper in zip(matrices, mu.lower, mu.upper, strict=True):
        rest = m[1:, 1:] + (numbers / (1 - m[0, 0] * numbers))[:, None, None] * (m[1:, :1] @ m[:1, 1:])
        exact = np.max(1 / np.maximum(np.abs(numbers), 1 / np.linalg.norm(rest, 2, axis=(1, 2))))
        assert exact * (1 - 1e-9) < upper < 1.003 * exact
        assert lower < (1 + 1e-9) * upper


def lower_bounds(matrices, blocks, real):
    """The lower bounds of matrices (k, n, n)."""
    return np.asarray(compile_quickly(jax.vmap(lambda m: structured_singular_value(m, blocks, real).lower))(matrices))


@killed_by("linear.responses.structured", "image / image", "image.conj() / image")
def test_lower_bound_of_mixed_blocks():
    """Below SLICOT's upper bound, mostly by less than 1 %."""
    draw, blocks, real = np.random.default_rng(0), [1, 1, 1, 2], (True, True, False, False)
    matrices = draw.normal(size=(100, 5, 5, 2)) @ [1, 1j]
    matrices[50:] = matrices[50:].real
    uppers = np.array([slycot.ab13md(m, np.array(blocks), np.where(real, 1, 2))[0] for m in matrices])
    ratios = lower_bounds(matrices, blocks, real) / uppers
    assert np.max(ratios) < 1 + 1e-6
    assert np.mean(ratios > 0.99) > 0.65
    assert np.mean(ratios > 0.95) > 0.9
    assert np.min(ratios) > 0.5


@killed_by(
    "linear.responses.structured", "rises = jnp.sum(signs * slopes.imag)", "rises = -jnp.sum(signs * slopes.imag)"
)
def test_lower_bound_of_real_blocks():
    """Real matrices: mu is at a corner. Rank one: a linear program. 2 x 2: both roots of the determinant."""
    draw, real = np.random.default_rng(1), (True,) * 4
    matrices = draw.normal(size=(40, 4, 4))
    signs = [np.diag(s) for s in itertools.product([-1.0, 1.0], repeat=4)]
    corners = np.linalg.eigvals(np.array(signs) @ matrices[:, None])
    corners = np.max(np.where(np.abs(corners.imag) < 1e-9, corners.real, 0.0), axis=(1, 2))
    columns, rows = draw.normal(size=(2, 40, 4, 2)) @ [1, 1j]
    products = columns * rows  # 1 = sum of delta_i product_i with the least maximum of |delta_i|
    sizes = []
    for p in products:
        equations = np.array([[*p.real, 0.0], [*p.imag, 0.0]])
        limits = np.hstack([np.vstack([np.eye(4), -np.eye(4)]), -np.ones((8, 1))])
        sizes.append(linprog([0, 0, 0, 0, 1], limits, np.zeros(8), equations, [1.0, 0.0], (None, None)).fun)
    pairs = np.zeros((40, 4, 4), complex)
    pairs[:, :2, :2] = draw.normal(size=(40, 2, 2, 2)) @ [1, 1j]
    exact = np.array([real_mu_of_pair(m[:2, :2]) for m in pairs])
    every = np.concatenate([matrices, columns[:, :, None] * rows[:, None], pairs])
    lower = lower_bounds(every, [1] * 4, real)
    expected = np.concatenate([corners, 1 / np.array(sizes), exact])
    assert np.max(lower - expected * (1 + 1e-7)) <= 1e-9
    reached = lower >= expected * (1 - 1e-6)
    assert reached[:40].mean() > 0.7
    assert reached[40:80].mean() > 0.9
    assert reached[80:].mean() > 0.6  # two isolated places or none
    assert np.sum(exact == 0) > 5  # no perturbation at all


def real_mu_of_pair(m):
    """1 - x a - y b + x y d = 0 has y = (1 - x a)/(b - x d), real at the roots of a quadratic."""
    a, b, d = m[0, 0], m[1, 1], np.linalg.det(m)
    roots = np.roots([(a * d.conj()).imag, -(a * b.conj() + d.conj()).imag, b.conj().imag])
    places = [(x.real, ((1 - x * a) / (b - x * d)).real) for x in roots if abs(x.imag) < 1e-12 * abs(x)]
    return max((1 / max(map(abs, place)) for place in places), default=0.0)


def test_mu_of_a_real_number_is_discontinuous():
    """|1 + 1e-3 j| with one real block: no real delta makes 1 - delta m vanish."""
    lower = lower_bounds(np.array([[[1.0 + 0j]], [[1.0 + 1e-3j]], [[0j]], [[-2.0 + 0j]]]), [1], (True,))
    np.testing.assert_allclose(lower, [1.0, 0.0, 0.0, 2.0], rtol=1e-9)


@pytest.mark.slow
def test_bounds_at_the_points_of_a_box():
    """Every bounded margin of the rig that is cured, at four corners, against NumPy's."""
    loop, over = load("slip-cured").loop, {"plant.mass": (5.3, 6.2), "initial.speed": (1.4, 13.8)}
    shape = ((10.0, 0.5), (100.0, 1.2), (1000.0, 2.0))
    names = {
        "sensitivity": 1.7,
        "complementary": 1.5,
        "delay_margin": 5e-3,
        "phase_margin": 0.7,
        "control_noise": 500.0,
        "pole_decay": 1.0,
        "pole_damping": 0.1,
    }
    corners = np.array(list(itertools.product(*over.values())))
    points = Batch({path: corners[:, i] for i, path in enumerate(over)})
    bounds = FrequencyBounds(**names, shape=shape, points=points)
    values, excess = compile_quickly(lambda loop: (bounds.evaluate(loop), bounds.excess(loop, {})))(loop)
    worst, expected = worst_of(values), band(loop, over, samples=0).worst()
    for name, source in {"sensitivity": "sensitivity", "delay_margin": "delay", "phase_margin": "phase"}.items():
        system = expected[source].margins
        assert worst[name] == pytest.approx(system.numbers()[source], rel=1e-7)
    noise, shaped, poles = [], [], []
    for corner in corners:
        opened = open_loop(replace(loop, dict(zip(over, corner, strict=True))))
        w = np.geomspace(0.1, np.pi / opened.period, 20000)
        s = 1 / (1 + opened.transfer().response(w)[:, 0, 0])
        column = opened.controller.rational_response(w)[:, 0, 1]  # target, slip, speed, ...
        noise.append(np.max(np.abs(s * column)))
        system = opened.transfer()
        poles.append(np.log(np.linalg.eigvals(system.A - system.B @ system.C).astype(complex)) / opened.period)
        shaped.append(np.max(np.abs(s) / np.exp(np.interp(np.log(w), *np.log(shape).T))))
    assert worst["control_noise"] == pytest.approx(max(noise), rel=1e-5)
    assert worst["shape"] == pytest.approx(max(shaped), rel=1e-5)
    modes = np.concatenate(poles)
    assert worst["pole_decay"] == pytest.approx(np.min(-modes.real), rel=1e-6)
    assert worst["pole_damping"] == pytest.approx(np.min(-modes.real / abs(modes)), rel=1e-6)
    assert np.max(excess) == pytest.approx(
        max(1 - worst["delay_margin"] / 5e-3, worst["shape"] - 1, max(noise) / 500 - 1)
    )


def test_bounds_of_one_control_refuse_two():
    with pytest.raises(ValueError, match="delay_margin: of one control; the plant has pump_1, pump_2"):
        FrequencyBounds(delay_margin=1.0).worst(load("quadruple-tank").loop)


@killed_by("linear.responses.grid", "return w * (1 - LEAST_GAP * jnp.arange(len(w))[::-1])", "return w")
def test_a_peak_between_equal_places_around_poles():
    """1/((s + 1) (s + 2) (s + p)): 5 times the slow pole is 1 times the fast one, so two frequencies would be equal."""
    for pole, gain, delay in ((5.0, 12.0, 0.2), (10.0, 36.0, 0.4)):
        a = np.diag([-1.0, -2.0, -pole]) + np.diag(np.ones(2), -1)
        loop = Transfer(a, np.eye(3, 1), gain * np.eye(3)[2:], np.zeros((1, 1)), None, delay)
        w = np.geomspace(0.1, 100.0, 20_000)
        dense = np.max(1 / np.abs(1 + loop.response(w)[:, 0, 0]))
        assert float(sensitivity_peak(loop).value) == pytest.approx(dense, rel=1e-6)
