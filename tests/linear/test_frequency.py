"""Differentiable margins: against NumPy's, SLICOT, closed forms, and differences at three widths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import slycot
from mutants import killed_by
from scipy.signal import cont2discrete

from diffabs.core.pytree import get, replace
from diffabs.linear import Transfer, margins, multivariable_margins, open_loop
from diffabs.linear.frequency import (
    complementary_peak,
    delay_margin,
    disk_margin,
    gain_margins,
    open_transfer,
    phase_margin,
    sampled_delay_margin,
    sensitivity_peak,
)
from diffabs.linear.opened_loop import open_traced
from diffabs.linear.stability_margins import is_stable
from diffabs.scenario import load

WIDTHS = (3e-5, 1e-5, 3e-6)
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


@pytest.mark.parametrize("sampled", [False, True], ids=["continuous", "sampled"])
@killed_by(
    "linear.frequency.search", "slope = jax.lax.stop_gradient(slope)", "slope = 1.1 * jax.lax.stop_gradient(slope)"
)
def test_margins_and_their_derivatives(sampled):
    loops = random_loops(7, 60, sampled=sampled, delays=True)
    systems, period = stack(loops), loops[0].period
    margin = jax.vmap(lambda system: values(system._replace(period=period)))
    found = jax.jit(margin)(systems)
    expected = np.array([numpy_values(loop) for loop in loops])
    np.testing.assert_array_equal(np.isinf(found), np.isinf(expected))
    finite = np.isfinite(expected)
    np.testing.assert_allclose(np.asarray(found)[finite], expected[finite], rtol=1e-7)

    draw = np.random.default_rng(1)
    moves = jax.tree.map(lambda x: jnp.asarray(draw.normal(size=x.shape)) * 0.3, systems)
    moves = moves._replace(D=0 * systems.D, delay=0.1 * systems.delay * (not sampled))

    def along(step):
        return margin(jax.tree.map(lambda x, dx: x + step * dx, systems, moves))

    slopes = jax.jit(lambda: jax.jvp(along, (0.0,), (1.0,))[1])()
    along = jax.jit(along)
    differences = [np.asarray(along(h) - along(-h)) / (2 * h) for h in WIDTHS]
    best = np.min([np.abs((slopes - d)[finite]) / np.maximum(1.0, np.abs(d[finite])) for d in differences], axis=0)
    assert np.max(best) < 1e-6


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
    peaks = jax.jit(jax.vmap(lambda system: sensitivity_peak(system).value))(stack(loops))
    norms = [
        slycot.ab13dd("C", "I", "N", "D", 4, 1, 1, s.A - s.B @ s.C, np.eye(4), s.B, -s.C, np.eye(1))[0] for s in loops
    ]
    np.testing.assert_allclose(peaks, norms, rtol=1e-9)


def test_unstable_loop_has_no_margin():
    loop = Transfer(np.array([[0.5]]), np.ones((1, 1)), np.array([[0.2]]), np.zeros((1, 1)))
    assert np.isnan(sensitivity_peak(loop).value)
    assert np.isnan(phase_margin(loop).value)


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


@pytest.mark.parametrize("name", ["slip-lmi", "slip-cured"])
def test_loops_of_scenarios(name):
    loop = load(name).loop
    path = "controller.controller.gain" if name == "slip-cured" else "controller.gain"
    gain = jnp.asarray(get(loop, path))

    @jax.jit
    def margin(gain):
        tuned = replace(loop, {path: gain})
        opened = open_traced(tuned)
        system = open_transfer(tuned)
        delay = delay_margin(system) if system.period is None else sampled_delay_margin(opened)
        return jnp.stack([sensitivity_peak(system).value, phase_margin(system).value, delay.value])

    expected = margins(open_loop(loop))
    np.testing.assert_allclose(margin(gain), [expected.sensitivity, expected.phase, expected.delay], rtol=1e-7)
    slopes = jax.jit(jax.jacfwd(margin))(gain)
    for i in range(2):
        step = jnp.zeros(2).at[i].set(abs(gain[i]))
        errors = [
            np.abs((margin(gain + h * step) - margin(gain - h * step)) / (2 * h * step[i]) / slopes[:, i] - 1)
            for h in (3e-5, 1e-5, 3e-6)
        ]
        assert np.max(np.min(errors, axis=0)) < 1e-6


def test_singular_values_of_a_loop_with_two_channels():
    loop = load("quadruple-tank").loop
    expected = multivariable_margins(open_loop(loop)).input

    def peaks(gain):
        system = open_transfer(replace(loop, {"controller.pump_1.kp": gain}))
        return jnp.stack([sensitivity_peak(system).value, complementary_peak(system).value])

    gain = get(loop, "controller.pump_1.kp")
    found, slopes = jax.jit(peaks)(gain), jax.jit(jax.jacfwd(peaks))(gain)
    np.testing.assert_allclose(found, [expected.sensitivity, expected.complementary], rtol=1e-8)
    peaks, h = jax.jit(peaks), 1e-5 * gain
    np.testing.assert_allclose(slopes, (peaks(gain + h) - peaks(gain - h)) / (2 * h), rtol=1e-6)
