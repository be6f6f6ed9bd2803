"""Open loops and their margins against python-control, closed forms, poles, and the loops' own linear models."""

import dataclasses
import json
import math

import control
import jax
import numpy as np
import pytest
from commands import run as command
from marks import cases
from mutants import killed_by
from project import ROOT
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.signal import cont2discrete

from diffabs.core.blocks import Series
from diffabs.linear import Band, OpenLoop, Transfer, band, from_control, margins, open_loop, to_control
from diffabs.linear.stability_margins import MARGIN_UNITS, closed_loop_poles, find_crossovers, is_stable
from diffabs.linear.transfer import check_transfer
from diffabs.parts.actuators import Delay, Lag, RateLimit
from diffabs.parts.controllers import PID, ConstantTorque, HoldingInput, Relay, Sampled, StateFeedback
from diffabs.parts.plants import BrakeStart, LabRig, MirroredRig
from diffabs.parts.references import FixedSlip
from diffabs.parts.sensors import Noise, WheelSpeed
from diffabs.robust.design.state_feedback import reduce_loop
from diffabs.scenario.defaults import braking
from diffabs.scenario.scenario import load


def rig(**parts):
    usual = {"initial": BrakeStart(speed=8.0), "reference": FixedSlip(slip=0.2), "feedforward": HoldingInput()}
    return braking(**{"plant": MirroredRig(), **usual, "controller": StateFeedback(), **parts})


def random_loop(seed, sampled):
    """A stable closed loop of a random system of order 2 to 5 under a gain that leaves it margins."""
    draw = np.random.default_rng(seed)
    while True:
        n = int(draw.integers(2, 6))
        poles = -np.exp(draw.normal(0, 1.2, n))
        a = np.diag(poles) + np.triu(draw.normal(0, 1.0, (n, n)), 1)
        if n >= 3:
            a[:2, :2] = [[-0.3, 2.0], [-2.0, -0.3]]
        system = Transfer(a, draw.normal(size=(n, 1)), draw.normal(size=(1, n)), np.zeros((1, 1)))
        if sampled:
            period = float(np.exp(draw.normal(-2.5, 0.5)))
            a, b = cont2discrete((system.A, system.B, system.C, system.D), period)[:2]  # pyright: ignore
            system = system._replace(A=a, B=b, period=period)
        system = system._replace(C=system.C * draw.uniform(0.5, 4.0))
        if is_stable(system) and len(find_crossovers(system).unit_at):
            return system


@killed_by(
    "linear.stability_margins",
    "phases = np.angle(-_response",
    "phases = np.angle(-1j * _response",
    case="continuous",
)
@killed_by("linear.stability_margins", "-1 / values[real]", "-values[real]", case="sampled")
@killed_by("linear.stability_margins", "while np.any(high - low > 1e-9 * high):", "while False:", case="continuous")
@pytest.mark.parametrize(
    ("sampled", "seeds"),
    [
        pytest.param(False, range(4), id="continuous"),
        pytest.param(False, range(4, 40), id="continuous, more", marks=pytest.mark.slow),
        pytest.param(True, range(40), id="sampled", marks=pytest.mark.slow),
    ],
)
def test_margins_are_those_of_python_control(sampled, seeds):
    compared = 0
    for seed in seeds:
        system = random_loop(seed, sampled)
        found, crossed = margins(system), find_crossovers(system)
        gm, pm, sm, wpc, wgc, _ = control.stability_margins(to_control(system), returnall=True, method="poly")
        there = np.abs(np.abs(system.response(wgc)[:, 0, 0]) - 1)
        if np.max(there, initial=0.0) > 1e-10:
            continue  # roots of polynomials in z lose digits: theirs are none of |L| = 1
        compared += 1
        np.testing.assert_allclose(np.sort(crossed.unit_at), np.sort(wgc), rtol=1e-8)
        np.testing.assert_allclose(math.degrees(found.phase), np.min(np.abs(pm)), rtol=1e-8)
        half = math.pi / system.period if sampled else math.inf
        inner = (wpc > 1e-6) & (wpc < half * (1 - 1e-6))  # ends of the axis are `test_ends_of_the_axis`
        ours = (crossed.negative_at > 1e-6) & (crossed.negative_at < half * (1 - 1e-6))
        at = system.response(wpc)[:, 0, 0]
        real = np.abs(at.imag) < 1e-10 * np.abs(at)  # and there are some of theirs at which L is not real
        assert len(wpc[inner & ~real]) or np.sum(ours) == np.sum(inner)
        for w, factor in zip(wpc[inner & real], gm[inner & real], strict=True):
            i = np.argmin(np.abs(crossed.negative_at - w))
            assert crossed.negative_at[i] == pytest.approx(w, rel=1e-8)
            assert crossed.factors[i] == pytest.approx(factor, rel=1e-8)
        if len(sm):
            assert found.modulus <= np.min(sm) * (1 + 1e-12)
        assert found.modulus == pytest.approx(nearest(system), rel=1e-8)
    assert compared >= min(15, 0.75 * len(seeds))


def nearest(system):
    """The least distance from -1, by python-control's response on finer and finer grids."""
    seen, half = to_control(system), math.pi / system.period if system.period else 1e5

    def distance(log_w):
        w = np.exp(log_w)
        return np.abs(1 + seen(np.exp(1j * w * system.period) if system.period else 1j * w))

    low, high, best = math.log(1e-4), math.log(half), distance(-math.inf)
    for _ in range(5):  # each 500 times finer
        grid = np.linspace(low, high, 2_001)
        values = distance(grid)
        i = int(np.argmin(values))
        best = min(best, values[i])
        low, high = grid[max(i - 2, 0)], grid[min(i + 2, len(grid) - 1)]
    return min(best, math.inf if system.period else 1.0)


@pytest.mark.slow
def test_margins_are_where_the_closed_loop_turns_unstable():
    for seed in range(12):
        for sampled in (False, True):
            system, inside = random_loop(seed, sampled), 1e-6
            found = margins(system)
            for factor, step in ((found.gain[1], inside), (found.gain[0], -inside)):
                if math.isfinite(factor) and factor > 0:
                    assert is_stable(system._replace(C=system.C * factor * (1 - step)))
                    assert not is_stable(system._replace(C=system.C * factor * (1 + step)))
            if not sampled and math.isfinite(found.delay):
                assert is_stable(system._replace(delay=found.delay * (1 - inside)))
                assert not is_stable(system._replace(delay=found.delay * (1 + inside)))


def test_a_delay_in_continuous_time_against_the_closed_form():
    """L = k e^(-s d)/s: stable for k d < pi/2; phase pi/2 - k d, gain pi/(2 k d), delay pi/(2 k) - d."""
    k, d = 3.0, 0.2
    loop = Transfer(np.zeros((1, 1)), np.ones((1, 1)), np.full((1, 1), k), np.zeros((1, 1)), delay=d)
    found = margins(loop)
    assert found.stable
    assert found.phase == pytest.approx(math.pi / 2 - k * d, rel=1e-12)
    assert found.gain[1] == pytest.approx(math.pi / (2 * k * d), rel=1e-12)
    assert found.gain_at[1] == pytest.approx(math.pi / (2 * d), rel=1e-12)
    assert found.delay == pytest.approx(math.pi / (2 * k) - d, rel=1e-12)
    w = np.linspace(0.01, 20, 200_001)
    assert found.sensitivity == pytest.approx(np.max(1 / np.abs(1 + k * np.exp(-1j * w * d) / (1j * w))), rel=1e-8)
    assert not margins(loop._replace(delay=0.99 * math.pi / (2 * k) + 0.02)).stable


@pytest.mark.slow
@killed_by("linear.stability_margins", "1 + np.floor((delays - first) * w / (2 * math.pi))", "1")
@killed_by("linear.stability_margins", "2 * times if falls else -2 * times", "2 * times")
def test_a_delay_can_bring_back_what_it_took():
    """x'' + x = -k x'(t - d) loses stability and regains it as d grows; the counts are those with a Pade approximat."""
    k = 0.3
    loop = Transfer(
        np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[0.0, k]]), np.zeros((1, 1))
    )
    for d in np.linspace(0.1, 9.0, 60):
        closed = control.feedback(to_control(loop._replace(delay=d), pade=9), 1)
        assert is_stable(loop._replace(delay=d)) == bool(np.all(closed.poles().real < 0)), d
    assert not is_stable(loop._replace(delay=3.0))
    assert is_stable(loop._replace(delay=6.0))


@killed_by("linear.stability_margins", "[end for end in ends if _is_real(system, end)]", "[]")
def test_ends_of_the_axis():
    """A first-order loop that needs its gain, L = k/(s - 1), may lose a factor k; sampled, it turns over at z = -1."""
    one = np.ones((1, 1))
    found = margins(Transfer(one, one, 4 * one, 0 * one))
    assert found.gain == (pytest.approx(0.25, rel=1e-12), math.inf)
    assert found.gain_at[0] == 0.0
    found = margins(Transfer(0.5 * one, one, one, 0 * one, period=0.1))  # z = 0.5 - k: -1 at k = 1.5
    assert found.gain == (0.0, pytest.approx(1.5, rel=1e-12))
    assert found.gain_at[1] == pytest.approx(math.pi / 0.1)


def biproper(direct, residue, pole, **more):
    """D + r/(s - p), or the same in z."""
    return Transfer(*(np.array([[float(x)]]) for x in (pole, 1.0, residue, direct)), **more)


def static(direct, **more):
    return Transfer(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[float(direct)]]), **more)


END = (math.nan, math.inf)  # no lower limit, and the upper one at infinite frequency
# The closed pole of k (D + r/(s - p)) is p - k r/(1 + k D). |T| of (D s + b)/(s + c) is monotonic in w.
DIRECT = {
    "constant 0.5": (static(0.5), {"sensitivity": 2 / 3, "complementary": 1 / 3, "delay": math.inf}),
    "constant 2": (static(2.0), {"sensitivity": 1 / 3, "complementary": 2 / 3, "delay": 0.0}),
    "constant 1": (static(1.0), {"complementary": 0.5, "phase": math.pi, "crossover": math.inf, "delay": 0.0}),
    "D = -0.5": (biproper(-0.5, 0.5, -1), {"gain": (0.0, 2.0), "gain_at": END, "sensitivity": 2.0}),
    "D = -2": (biproper(-2, -4, -1), {"gain": (0.5, math.inf), "gain_at": (math.inf, math.nan), "delay": 0}),
    "D = 2": (biproper(2, 2, -1), {"complementary": 0.8, "gain": (0.0, math.inf), "delay": 0.0}),
    "constant 0.5, late": (static(0.5, delay=1e-6), {"sensitivity": 2.0, "complementary": 1.0, "gain": (0.0, 2.0)}),
    "D = 0.5, late": (
        biproper(0.5, -0.5, -1, delay=0.1),
        {"sensitivity": 2.0, "complementary": 1.0, "gain_at": END},
    ),
    "sampled": (biproper(-0.5, 0.4, 0.5, period=0.1), {"gain": (0.0, 1.5 / 1.15), "stable": True}),
    "sampled constant": (static(2.0, period=0.1), {"complementary": 2 / 3, "delay": 0.1}),
}


@killed_by("linear.stability_margins", "abs(far / (1 + far)))", "abs(far))", case="constant 2")
@killed_by("linear.stability_margins", "if far < 0:", "if False:", case="D = -0.5")
@killed_by("linear.stability_margins", "-abs(direct) if system.delay", "direct if True", case="constant 0.5, late")
@pytest.mark.parametrize("name", DIRECT)
def test_a_direct_path_counts_at_infinite_frequency(name):
    system, wanted = DIRECT[name]
    found = margins(system)
    assert found.stable
    for margin, value in wanted.items():
        assert getattr(found, margin) == pytest.approx(value, rel=1e-9, nan_ok=True), margin


@killed_by("linear.stability_margins", "abs(system.D[0, 0]) >= 1", "abs(system.D[0, 0]) >= 3", case="2.0")
@pytest.mark.parametrize("direct", [2.0, -1.5, 0.5, -0.4])
def test_a_large_direct_path_bears_no_delay(direct):
    """1 + L e^(-s d) has zeros near s = (log(-D) + 2 pi j k)/d for large k; Newton's method finds one."""
    d, loop = 0.01, biproper(direct, direct, -1)

    def denominator(s):
        return 1 + direct * (s + 2) / (s + 1) * np.exp(-s * d)

    s = (np.log(-direct + 0j) + 200j * math.pi) / d
    for _ in range(20):
        s -= 2e-6 * denominator(s) / (denominator(s + 1e-6) - denominator(s - 1e-6))
    assert abs(denominator(s)) < 1e-9
    assert is_stable(loop._replace(delay=d)) == (s.real < 0) == (abs(direct) < 1)


@killed_by("linear.stability_margins", "gained += np.round(delays / system.period)", "pass")
@killed_by("linear.stability_margins", "return float(added[unstable[0]])", "return float(added[0])")
@pytest.mark.parametrize("count", cases([12, 200], 200))
def test_a_sampled_loop_bears_the_periods_of_its_margin(count):
    """Poles with n periods of delay are the roots of z^n (z - p) + D (z - p) + r. Many loops have |L| > 1 at z = -1."""
    draw, compared = np.random.default_rng(5), 0
    for _ in range(count):
        direct, residue, pole = draw.normal(size=3)
        direct *= draw.integers(2)

        def is_late_stable(n, p=pole, rest=(direct, residue - direct * pole)):
            return np.abs(np.roots(np.polyadd([1.0, -p, *np.zeros(n)], rest))).max() < 1

        if is_late_stable(0):
            compared += 1
            found = margins(biproper(direct, residue, pole, period=0.1)).delay / 0.1
            first = next((n for n in range(1, 50) if not is_late_stable(n)), math.inf)
            assert first == (pytest.approx(found) if found < 49 else math.inf)
    assert compared > count / 4


def test_a_sampled_transfer_bears_two_periods():
    """The closed loop with 0, 1 and 2 periods is stable by its poles and with 3 it is not."""
    a, b, c = np.array([[-1, -0.8], [0.7, 0.3]]), np.array([[-1.1], [-0.7]]), np.array([[-0.2, -0.6]])
    assert margins(Transfer(a, b, c, np.zeros((1, 1)), 1.0)).delay == 3.0
    for n in range(1, 4):
        late = np.zeros((2 + n, 2 + n))
        late[:2, :2], late[:2, -1:], late[2, :2] = a, b, -c[0]
        late[3:, 2:-1] = np.eye(n - 1)
        assert (np.abs(np.linalg.eigvals(late)).max() < 1) == (n < 3)


def held_loop_radius(plant, gain, period, delay):
    """Spectral radius of x' = A x + B u(t - d) under u_k = -gain y_k, with SciPy's exponentials and a register of u."""
    n, whole = len(plant.A), int(delay / period + 1e-9)
    rates = np.zeros((n + 1, n + 1))
    rates[:n] = np.hstack([plant.A, plant.B])
    before, after = expm(rates * (delay - whole * period)), expm(rates * (period - delay + whole * period))
    closed = np.zeros((n + whole + 1, n + whole + 1))
    closed[:n, :n] = expm(plant.A * period)
    old, new, control = after[:n, :n] @ before[:n, n:], after[:n, n:], -gain * plant.C
    closed[:n, n + whole : n + whole + 1] += old
    if whole:
        closed[:n, n + whole - 1 : n + whole] += new
    else:
        closed[:n, :n] += new @ control
    closed[n, :n] = control[0]
    closed[n + 1 :, n:-1] = np.eye(whole)
    return np.abs(np.linalg.eigvals(closed)).max()


def held_loop(a, b, c, gain, period):
    plant = Transfer(*(np.array(x, float) for x in (a, b, c)), np.zeros((1, 1)))
    return OpenLoop(plant, static(-gain, period=period), 0.0)


def resonance(w, damping):
    return [[0, 1], [-w * w, -2 * damping * w]]


SUM = [[-1, 0, 0], [0, 0, 1], [0, -((23 * math.pi) ** 2), -0.46 * math.pi]]  # a lag beside a resonance
HELD = {
    # |L| is infinite at 5 rad/s
    "no damping": (
        held_loop(resonance(5.0, 0.0), [[0], [1]], [[0, 1]], 0.5, 0.1),
        0.2490334,
        [0.01, 0.1, 0.2, 0.249, 0.2491, 0.26],
    ),
    # |L| < 1 without an added delay, and above 1 with a sixth of a period
    "small gain at first": (
        held_loop(resonance(10 * math.pi, 0.05), [[0], [1]], [[0, 1]], 5.0, 0.1),
        0.01657211,
        [0.0, 0.0165, 0.0166, 0.05, 0.1],
    ),
    # unstable from 1.2535 to 1.267 periods, stable from there to 2.24
    "short window": (
        held_loop(SUM, [[1], [0], [1]], [[1, 0, 0.6]], 6.6212013, 0.1),
        0.12534849,
        [0.1, 0.125, 0.1253, 0.126, 0.127, 0.22, 0.225],
    ),
}


@killed_by("linear.stability_margins", "if delayed.largest < REACHING:", "if True:", case="small gain at first")
@killed_by(
    "linear.delay_steps", "np.minimum(within, remainder)", "5 * np.minimum(within, remainder)", case="short window"
)
@killed_by("linear.delay_steps", "np.where(huge, np.fmin(alone[1:], alone[:-1]), steps)", "steps", case="no damping")
@pytest.mark.parametrize("name", cases(HELD, "short window"))
def test_the_delay_margin_of_a_sampled_loop_is_the_first_delay_that_destabilises(name):
    loop, wanted, delays = HELD[name]
    plant, gain, period = loop.plant, -loop.controller.D[0, 0], loop.period
    found = margins(loop).delay
    assert found == pytest.approx(wanted, rel=1e-6)
    assert (
        held_loop_radius(plant, gain, period, found * (1 - 1e-7))
        < 1
        < held_loop_radius(plant, gain, period, found * (1 + 1e-7))
    )
    assert all(held_loop_radius(plant, gain, period, d) < 1 for d in np.linspace(0, found * (1 - 1e-7), 20))
    for d in delays:
        assert is_stable(loop.transfer(d)) == (held_loop_radius(plant, gain, period, d) < 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", HELD)
def test_every_shorter_delay_leaves_it_stable(name):
    loop, wanted, _ = HELD[name]
    plant, gain, period = loop.plant, -loop.controller.D[0, 0], loop.period
    assert all(held_loop_radius(plant, gain, period, d) < 1 for d in np.linspace(0, wanted * (1 - 1e-6), 300))


@killed_by("linear.stability_margins", "if delayed.largest < REACHING:", "if False:")
def test_a_sampled_loop_of_small_gain_bears_every_delay():
    loop = held_loop([[-1]], [[1]], [[1]], 0.5, 0.1)
    assert margins(loop).delay == math.inf
    assert all(held_loop_radius(loop.plant, 0.5, 0.1, d) < 1 for d in np.linspace(0, 3, 100))


@killed_by("linear.stability_margins", "return math.nan\n\n\ndef _bisect", "return math.inf\n\n\ndef _bisect")
@pytest.mark.slow
def test_an_undecided_delay_margin_is_nan():
    """|L| reaches 0.995, so no delay is too long, but the reserve for peaks between points says nothing."""
    assert math.isnan(margins(held_loop([[-1]], [[1]], [[1]], 0.995, 0.1)).delay)


@killed_by("linear.stability_margins", "return unstable_poles(system._replace(delay=0.0)) + int(", "return 0 * int(")
@pytest.mark.parametrize("gain", cases([0.5, 3.0], 3.0))
def test_many_periods_of_delay_are_counted(gain):
    loop = held_loop([[-0.05]], [[0.05]], [[1]], gain, 0.1)
    for d in (3.5, 5.03, 12.01, 14.0):
        assert is_stable(loop.transfer(d)) == (held_loop_radius(loop.plant, gain, 0.1, d) < 1)
    if gain > 1:
        found = margins(loop).delay
        assert held_loop_radius(loop.plant, gain, 0.1, found * 0.9999) < 1
        assert held_loop_radius(loop.plant, gain, 0.1, found * 1.0001) > 1


@killed_by("linear.stability_margins", "return np.union1d(w, between[between < half])", "return w")
def test_close_crossings_are_both_found():
    """k s/(s^2 + 2 z w s + w^2) has |L| = k/(2 z w) at w, above 1 by 1e-9 between two frequencies 9e-5 z apart."""
    z, w0 = 0.5, 1.3
    k = 2 * z * w0 * (1 + 1e-9)
    loop = Transfer(np.array(resonance(w0, z), float), np.array([[0.0], [1.0]]), np.array([[0.0, k]]), np.zeros((1, 1)))
    # |L| = 1 where w0^2 - w^2 = +-w sqrt(k^2 - (2 z w0)^2)
    half = math.sqrt(k**2 - (2 * z * w0) ** 2) / 2
    wanted = np.array([-half, half]) + math.hypot(w0, half)
    np.testing.assert_allclose(find_crossovers(loop).unit_at, wanted, rtol=1e-7)
    assert margins(loop).delay == pytest.approx(math.pi / w0, rel=1e-3)


REFUSED = {
    "period": ({"period": -0.1}, r"^period = -0\.1 s is outside \(0, inf\) s$"),
    "no period": ({"period": 0.0}, r"^period = 0 s is outside \(0, inf\) s$"),
    "NaN": ({"A": np.array([[math.nan]])}, r"^A = nan is outside \(-inf, inf\)$"),
    "shape": ({"B": np.ones((2, 1))}, r"^B has shape \(2, 1\); it needs \(1, 1\)"),
    "vector": ({"C": np.ones(1)}, r"^C has shape \(1,\); it needs two dimensions$"),
    "text": ({"D": "x"}, r"^D is no matrix of real numbers$"),
}


@killed_by("linear.transfer", "0 < system.period < math.inf", "True", case="period")
@killed_by("linear.transfer", "if not np.isfinite(matrix).all():", "if False:", case="NaN")
@killed_by("linear.transfer", "if matrices[name].shape != shape:", "if False:", case="shape")
@pytest.mark.parametrize("name", REFUSED)
def test_a_transfer_that_cannot_be_is_refused(name):
    fields, words = REFUSED[name]
    for judge in (margins, is_stable):
        with pytest.raises(ValueError, match=words):
            judge(biproper(0.0, 0.5, -0.5)._replace(**fields))


def test_lists_are_matrices():
    lists = Transfer([[-1.0]], [[1.0]], [[2.0]], [[0.0]])
    assert margins(lists).crossover == pytest.approx(math.sqrt(3))


@killed_by("linear.opened_loop", "    check_part(loop)\n", "")
@killed_by("linear.opened_loop", "if target is not None and not np.isfinite(target):", "if False:")
@killed_by("linear.opened_loop", "if not 0 <= delay < np.inf:", "if False:")
def test_an_open_loop_that_cannot_be_is_refused():
    for sampling, words in (
        ({"period": -0.01}, r"^controller\.period = -0\.01 is outside \(0, inf\) s$"),
        ({"period": 0.01, "delay": 0.05}, r"^controller\.delay = 0\.05 s exceeds the period of 0\.01 s$"),
    ):
        with pytest.raises(ValueError, match=words):
            open_loop(rig(controller=Sampled(controller=StateFeedback(), **sampling)))
    with pytest.raises(ValueError, match=r"^target = nan is outside \(-inf, inf\)"):
        open_loop(rig(), math.nan)
    with pytest.raises(ValueError, match=r"^loop = Loop is no OpenLoop or Transfer"):
        margins(rig())  # pyright: ignore
    with pytest.raises(ValueError, match=r"^delay = -0\.1 s is outside \[0, inf\) s$"):
        HELD["short window"][0].transfer(-0.1)
    loop = HELD["short window"][0]
    with pytest.raises(ValueError, match=r"^plant: D = 1 is outside \[0, 0\]"):
        margins(loop._replace(plant=loop.plant._replace(D=np.ones((1, 1)))))


@killed_by("linear.transfer", "if not 0 <= system.delay < math.inf:", "if False:", case="is_stable-None")
@pytest.mark.parametrize("period", [None, 0.1])
@pytest.mark.parametrize("judge", [margins, is_stable])
def test_a_negative_delay_is_refused(judge, period):
    with pytest.raises(ValueError, match=r"^delay = -0\.1 s is outside \[0, inf\) s$"):
        judge(biproper(0.0, 0.5, 0.5, period=period, delay=-0.1))


LOOPS = {
    "state feedback": {},
    "PID": {"controller": PID(kp=60.0, ki=400.0, kd=0.3, low=-np.inf, high=np.inf)},
    "lag": {"actuator": Lag(time_constant=4e-3)},
    "sampled": {"controller": Sampled(controller=StateFeedback(), period=2e-3)},
    "sampled, half a period late": {"controller": Sampled(controller=StateFeedback(), period=2e-3, delay=1e-3)},
    "sampled PID, lag": {
        "controller": Sampled(controller=PID(kp=60.0, ki=400.0, kd=0.3, high=np.inf, low=0.0), period=2e-3, delay=2e-3),
        "actuator": RateLimit(time_constant=4e-3),
    },
}


@killed_by(
    "linear.opened_loop",
    "delay = delay + (sampled.delay if sampled else 0.0)",
    "pass",
    case="sampled, half a period late",
)
@pytest.mark.parametrize(
    "name", cases(LOOPS, "sampled PID, lag", "sampled", "lag", "state feedback", "PID", "sampled, half a period late")
)
def test_closed_is_the_loop_of_the_certificates(name):
    """Its poles are those of A + B K, which the linear slip model has from elsewhere."""
    loop = rig(**LOOPS[name])
    reduced = reduce_loop(loop)
    model = reduced.model.matrices()
    wanted = np.linalg.eigvals(np.asarray(model.A) + np.asarray(model.B) @ reduced.gain[None])
    opened = open_loop(loop).transfer().without_delay()
    found = np.linalg.eigvals(opened.A - opened.B @ opened.C)
    wanted, found = (np.sort_complex(p[np.abs(p) > 1e-7]) for p in (wanted, found))
    np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-9)


@killed_by("linear.opened_loop", "setpoint)[0]) if around.frozen else target", "setpoint)[0]) if False else target")
@pytest.mark.slow
def test_the_brake_lab_rig_and_a_filtered_sensor_come_to_rest():
    lab = rig(plant=LabRig(), initial=BrakeStart(speed=14.0), controller=StateFeedback(gain=(-60.0, -4.0)))
    reduced = reduce_loop(lab)
    model = reduced.model.matrices()
    wanted = np.linalg.eigvals(np.asarray(model.A) + np.asarray(model.B) @ reduced.gain[None])
    opened = open_loop(lab).transfer()
    found = np.linalg.eigvals(opened.A - opened.B @ opened.C)
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(wanted), rtol=1e-8)
    direct, filtered = open_loop(rig()).transfer(), open_loop(rig(sensor=WheelSpeed(time_constant=3e-3))).transfer()
    w = np.geomspace(1, 1e4, 30)
    np.testing.assert_allclose(filtered.response(w), direct.response(w) / (1 + 3e-3j * w[:, None, None]), rtol=1e-9)


@killed_by(
    "linear.opened_loop",
    "delay = sum((block.time for block in blocks if isinstance(block, Delay)), 0.0)",
    "delay = 0.0",
)
@pytest.mark.slow
def test_a_pure_delay_turns_the_phase_and_nothing_else():
    w = np.geomspace(1, 2000, 40)
    plain = open_loop(rig(actuator=Lag(time_constant=1e-3))).transfer()
    late = open_loop(rig(actuator=Series(blocks=(Delay(time=1e-3), Lag(time_constant=1e-3))))).transfer()
    np.testing.assert_allclose(late.response(w)[:, 0, 0], plain.response(w)[:, 0, 0] * np.exp(-1e-3j * w), rtol=1e-12)
    one, other = margins(plain), margins(late)
    assert other.delay == pytest.approx(one.delay - 1e-3, rel=1e-9)


@killed_by("linear.opened_loop", "rest = max(delay - whole * period, 0.0)", "rest = 0.0")
@pytest.mark.slow
def test_a_sampled_loop_with_delay_fits_its_step_response():
    """2.6 periods of delay: the pulse response of L(z) is that of the continuous plant, which has one state."""
    period, delay, gain = 2e-3, 5.2e-3, -20.0
    controller = Sampled(controller=StateFeedback(gain=(0.0, gain)), period=period)
    found = open_loop(rig(controller=controller, actuator=Delay(time=delay))).transfer()
    assert found.delay == pytest.approx(2 * period)
    plant = open_loop(rig(controller=StateFeedback(gain=(0.0, gain)))).transfer()
    a, b, c = plant.A[0, 0], plant.B[0, 0], plant.C[0, 0]

    def step(t):
        return c * b * math.expm1(a * t) / a if t > 0 else 0.0

    wanted = [step(k * period - delay) - step((k - 1) * period - delay) for k in range(60)]
    whole = found.without_delay()
    states = [whole.B]
    for _ in wanted[2:]:
        states.append(whole.A @ states[-1])
    np.testing.assert_allclose([0.0, *((whole.C @ x).item() for x in states)], wanted, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@killed_by(
    "linear.stability_margins", "if loop.period is None:\n        return guess", "if True:\n        return guess"
)
def test_a_sampled_loop_is_unstable_beyond_its_delay_margin():
    loop = rig(controller=Sampled(controller=StateFeedback(gain=(-3000.0, -48.0)), period=4e-3))
    opened = open_loop(loop)
    found = margins(opened)
    worst = brentq(
        lambda d: max(abs(p) for p in closed_poles(opened.transfer(d))) - 1, 0.5 * found.delay, 1.5 * found.delay
    )
    assert found.delay == pytest.approx(worst, rel=1e-8)
    crossover = margins(opened.transfer())
    assert found.delay != pytest.approx(crossover.delay, rel=1e-5)  # which forgets that the hold is sampled anew


def closed_poles(system):
    system = system.without_delay()
    return np.linalg.eigvals(system.A - system.B @ system.C)


@killed_by("linear.opened_loop", "TARGET_OFFSETS = (0.0, 1e-4, -1e-4, 1e-2, -1e-2)", "TARGET_OFFSETS = (0.0,)")
@killed_by("core.tracing", "lambda step: not _zero(step)", "lambda step: True")
@pytest.mark.slow
def test_noise_is_a_disturbance_and_limits_do_not_act():
    plain = open_loop(rig()).transfer()
    w = np.geomspace(1, 1e3, 9)
    noisy = rig(sensor=Noise(slip=0.01), controller=StateFeedback(low=0.0, high=9.03))
    np.testing.assert_allclose(open_loop(noisy).transfer().response(w), plain.response(w), rtol=1e-12)
    integrating = rig(controller=PID(ki=300.0, low=0.0, high=9.03))
    held = dataclasses.replace(integrating, feedforward=load("slip-estimator", integrated=False).loop.feedforward)
    np.testing.assert_allclose(
        open_loop(held).transfer().response(w), open_loop(integrating).transfer().response(w), rtol=1e-9
    )


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        pytest.param({"controller": ConstantTorque()}, "its command does not follow", marks=pytest.mark.slow),
        ({"controller": Relay()}, "acts at instants"),
        pytest.param(
            {"controller": PID(kp=1.0, high=0.5, low=0.0)},
            "does not follow what is measured at the setpoint",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["constant", "relay", "at its limit"],
)
def test_what_has_no_linear_loop_says_why(parts, words):
    with pytest.raises(ValueError, match=words):
        open_loop(rig(**parts))


@killed_by("linear.transfer", "for _ in range(self.count_periods()):", "for _ in range(0):")
def test_python_control_there_and_back():
    system = random_loop(3, True)._replace(delay=0.0)
    back = from_control(to_control(system))
    assert back.period == system.period
    w = np.linspace(0.1, 1, 5)
    np.testing.assert_allclose(back.response(w), system.response(w), rtol=1e-12)
    late = system._replace(delay=3 * system.period)
    np.testing.assert_allclose(to_control(late)(np.exp(1j * w * system.period)), late.response(w)[:, 0, 0], rtol=1e-10)
    with pytest.raises(ValueError, match="pade=ORDER"):
        to_control(random_loop(3, False)._replace(delay=0.1))
    assert to_control(random_loop(3, False)._replace(delay=0.1), pade=3).nstates == len(random_loop(3, False).A) + 3
    with pytest.raises(ValueError, match="whole number of periods"):
        to_control(system._replace(delay=0.4 * system.period))
    with pytest.raises(ValueError, match="dt is True"):
        from_control(control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], True))
    with pytest.raises(ValueError, match="one input and one output"):
        margins(Transfer(np.eye(2) * -1, np.eye(2), np.eye(2), np.zeros((2, 2))))


@pytest.mark.slow
@killed_by("linear.robustness", "return {name: max(self.systems", "return {name: min(self.systems")
def test_a_band_is_of_the_corners_and_of_samples_between():
    loop, over = rig(), {"plant.mass": (5.3, 6.2), "initial.speed": (2.0, 10.0)}
    found = band(loop, over, samples=5)
    assert found.corners == 4
    assert len(found.systems) == 9
    inside = [tuple(one.values.values()) for one in found.systems[4:]]
    assert all(5.3 < mass < 6.2 and 2.0 < speed < 10.0 for mass, speed in inside)
    assert len(set(inside)) == 5
    one = found.systems[2]
    alone = margins(open_loop(jax.tree.map(lambda x: x, dataclasses.replace(
        loop, plant=MirroredRig(mass=6.2), initial=BrakeStart(speed=2.0)))))  # fmt: skip
    assert one.values == {"plant.mass": 6.2, "initial.speed": 2.0}
    assert one.margins.phase == pytest.approx(alone.phase, rel=1e-12)
    worst = found.worst()
    assert worst["phase"].margins.phase == min(one.margins.phase for one in found.systems)
    assert worst["gain_down"].margins.gain[0] == max(one.margins.gain[0] for one in found.systems)
    with pytest.raises(ValueError, match="inverted"):
        band(loop, {"plant.mass": (6.2, 5.3)})


@pytest.mark.slow
def test_the_command_says_margins_and_where_they_are_worst(tmp_path):
    done = command("margins", "slip-cured", "--json", "--samples", "4", "--plot", str(tmp_path / "loop.png"))
    result = json.loads(done.stdout)
    assert result["margins"]["stable"]
    assert result["corners"] == 4
    assert len(result["systems"]) == 8
    slow = {"plant.mass": 6.2, "initial.speed": 5 / 3.6}
    assert result["worst"]["phase"]["values"] == pytest.approx(slow)
    here = open_loop(load("slip-cured", integrated=False).loop)
    assert result["margins"]["phase"] == pytest.approx(margins(here).phase, rel=1e-12)
    assert (tmp_path / "loop.png").stat().st_size > 10_000
    assert "mass 6.2 kg, speed 5 km/h" in command("margins", "slip-cured", "--samples", "0").stdout
    done = command("margins", "slip-cured", "--at", "speed_kmh=6", "--at", "plant.mass=6.2", "--json")
    result = json.loads(done.stdout)
    assert result["systems"] == []
    assert result["margins"]["phase"] == pytest.approx(margins(open_loop(load(
        "slip-cured", ["plant.mass=6.2", "initial.speed_kmh=6"], integrated=False).loop)).phase, rel=1e-12)  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["slip-cured", "--at", "plant.mas=6"], 2, "did you mean plant.mass"),
        (["slip-cured", "--at", "speed"], 2, "a number is needed"),
        (["slip-cured", "--at", "speed=-1"], 2, "--at initial.speed = -1"),
        (["slip-cured", "--at", "speed=1", "--at", "speed=2"], 2, "given twice"),
        pytest.param(["lab-rig"], 1, "does not follow what is measured", marks=pytest.mark.slow),
        pytest.param(["slip-lmi", "--set", "controller.gain=30,30"], 1, "not stable", marks=pytest.mark.slow),
    ],
)
def test_the_command_refuses_in_one_line(arguments, status, words):
    done = command("margins", *arguments, "--samples", "0", status=status)
    kind = "verdict:" if words == "not stable" else "error:"
    (line,) = [line for line in done.stderr.splitlines() if line.startswith(("verdict:", "error:"))]
    assert line.startswith(kind)
    assert words in line


@pytest.mark.slow
def test_the_page_runs(capsys):
    page = ROOT / "docs" / "margins.md"
    code = page.read_text().partition("```python\n")[2].partition("```")[0]
    exec(compile(code.replace("samples=100", "samples=2"), "margins.md", "exec"), {})
    assert capsys.readouterr().out.count("\n") == 3


def companion(*rates):
    """Matrices of 1/((s + r1)(s + r2) ...), whose states differ by the rates."""
    a = np.diag(-np.array(rates)) + np.diag(np.ones(len(rates) - 1), 1)
    return a, np.eye(len(rates))[:, -1:], np.eye(len(rates))[:1]


@killed_by("linear.stability_margins", "MAX_RANGE_STEPS = 1e-60, 4", "MAX_RANGE_STEPS = 1e-9, 4", case="1e-30")
@pytest.mark.parametrize("c", [1e-30, 1e-12, 1.0, 1e15])
def test_margins_do_not_depend_on_the_unit_of_time(c):
    """L = 2 c^3/(s (s + c)(s + 2c)): gain 3; the rest is of c = 1, by bisection of |L| = 1 here."""
    a = c * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, -2.0]])
    found = margins(Transfer(a, c * np.eye(3)[:, -1:], 2 * np.eye(3)[:1], np.zeros((1, 1))))
    w = brentq(lambda w: abs(2 / (1j * w * (1j * w + 1) * (1j * w + 2))) - 1, 0.1, 10.0)
    lag = np.pi / 2 - np.arctan(w) - np.arctan(w / 2)
    assert found.stable
    assert found.gain[1] == pytest.approx(3.0, rel=1e-9)
    assert (found.phase, found.delay * c, found.crossover / c) == pytest.approx((lag, lag / w, w), rel=1e-9)
    assert found.sensitivity == pytest.approx(2.3123140146, rel=1e-9)


@killed_by("linear.stability_margins", "for way in (-1, 1):", "for way in ():", case="1e-12")
@pytest.mark.parametrize("k", [1e-14, 1e-12, 1e15])
def test_a_crossover_far_below_a_pole_is_found(k):
    """k/(s (s + 1)): w^2 = (sqrt(1 + 4 k^2) - 1)/2, and the phase margin is 90 deg less atan(w)."""
    found = margins(Transfer(*companion(0.0, 1.0)[:2], k * companion(0.0, 1.0)[2], np.zeros((1, 1))))
    w = np.sqrt(2) * k / np.sqrt(1 + np.sqrt(1 + 4 * k**2))
    assert found.stable
    assert (found.crossover, found.phase) == pytest.approx((w, np.arctan(1 / w)), rel=1e-9)


@killed_by("linear.stability_margins", "crossovers = _add_touches(system, w, crossovers)", "pass")
def test_a_gain_that_only_reaches_one_has_a_phase_margin():
    """A sampled gain of 1 is 180 deg from -1 at every frequency; 2 s/(s + 1)^2 is 1 at 1 rad/s and less elsewhere."""
    found = margins(static(1.0, period=0.1))
    assert (found.stable, found.phase, found.delay, found.gain) == (True, np.pi, 0.1, (0.0, np.inf))
    a, b, _ = companion(1.0, 1.0)
    found = margins(Transfer(a, b, 2 * np.array([[-1.0, 1.0]]), np.zeros((1, 1))))  # s = (s + 1) - 1
    assert (found.phase, found.phase_at, found.delay) == pytest.approx((np.pi, 1.0, np.pi), rel=1e-6)
    assert np.isinf(margins(static(0.999, period=0.1)).phase)


@killed_by("linear.stability_margins", "(values < after) & (values < NEAR_UNIT)", "(values < after) & (values < 0.0)")
def test_a_peak_that_reaches_one_counts_beside_a_crossing():
    """|D(jw)|^2 = x^3 - 9 x^2 + 24 x, x = w^2, is 16 at x = 1 and touches 16 at x = 4: the phase margin of 4/D."""
    b, gain = math.sqrt(24), 4 * (1 - 1e-13)  # rounding cannot make a crossing of the touch
    a = math.sqrt(2 * b - 9)
    states = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -b, -a]])
    found = margins(Transfer(states, np.eye(3)[:, 2:], gain * np.eye(3)[:1], np.zeros((1, 1))))
    touch = math.pi / 2 - math.atan2(2 * a, b - 4)
    assert found.stable
    assert (found.phase, found.phase_at, found.crossover) == pytest.approx((touch, 2.0, 2.0), rel=1e-6)


@killed_by("linear.stability_margins", "if not (np.isfinite(near) and np.isfinite(far)):", "if False:", case="late")
@pytest.mark.parametrize(
    "loop",
    [
        Transfer([[-1.0]], [[1.0]], [[0.0]], [[0.0]]),
        Transfer([[-1.0]], [[1.0]], [[0.0]], [[0.0]], delay=0.1),
        Transfer([[0.5]], [[1.0]], [[0.0]], [[0.0]], period=0.1),
        static(0.0),
        static(0.0, period=0.1),
    ],
    ids=["continuous", "late", "sampled", "constant", "sampled constant"],
)
def test_a_loop_without_a_path_has_no_limits(loop):
    """L = 0, as with a gain of zero."""
    found = margins(loop)
    assert found.stable
    assert (found.gain, found.phase, found.delay) == ((0.0, np.inf), np.inf, np.inf)
    assert (found.modulus, found.sensitivity, found.complementary) == (1.0, 1.0, 0.0)
    assert math.isnan(found.crossover)


@killed_by("linear.stability_margins", "return np.full(len(system.A), math.nan)", "pass")
def test_a_loop_that_is_not_well_posed_has_no_poles():
    loop = Transfer([[-1.0]], [[1.0]], [[0.5]], [[-1.0]])
    assert np.isnan(closed_loop_poles(check_transfer(loop))).all()
    assert not margins(loop).stable


@killed_by("linear.transfer", "np.expm1(1j * w * self.period)", "np.exp(1j * w * self.period) - 1", case="1e-09-0.001")
@pytest.mark.parametrize(("period", "k"), [(1e-6, 0.1), (1e-9, 0.1), (1e-9, 1e-3)])
def test_a_fast_sampled_integrator_has_the_margins_of_its_formula(period, k):
    """k T/(z - 1): |L| = 1 at sin(w T/2) = k T/2; a lag of m periods reaches -1 at m w T = pi/2 - w T/2."""
    found = margins(Transfer(np.eye(1), np.array([[k * period]]), np.eye(1), np.zeros((1, 1)), period))
    w = 2 * np.arcsin(k * period / 2) / period
    assert (found.crossover, found.phase) == pytest.approx((w, (np.pi - w * period) / 2), rel=1e-7)
    assert found.delay == pytest.approx(np.ceil((np.pi - w * period) / 2 / (w * period)) * period, rel=1e-7)


@killed_by("linear.stability_margins", "None if math.isnan(value) else float(value)", "float(value)")
@killed_by("linear.stability_margins", '"inf" if value == math.inf else', "")
def test_a_record_of_margins_is_plain_json_with_a_unit_for_each_number():
    limits = margins(Transfer([[-1.0]], [[1.0]], [[1.0]], [[0.0]]))
    record = json.loads(json.dumps(limits.record()))
    assert record["gain_up"] == "inf"
    assert set(record) == {"stable", *MARGIN_UNITS}
    assert record["modulus"] * record["sensitivity"] == pytest.approx(1.0, rel=1e-15)
    unstable = margins(Transfer([[1.0]], [[1.0]], [[0.5]], [[0.0]]))
    record = json.loads(json.dumps(unstable.record(), allow_nan=False))
    assert record == {"stable": False, **dict.fromkeys(MARGIN_UNITS)}


@killed_by("linear.robustness", 's.margins.record()[name], "values"', 's.margins.record()["modulus"], "values"')
@pytest.mark.slow
def test_a_record_of_a_band_has_the_worst_of_its_systems():
    over = band(load("slip-cured").loop, {"plant.mass": (5.3, 6.2)}, 3)
    record = json.loads(json.dumps(over.record()))
    rows = record["systems"]
    assert record["corners"] == 2
    assert len(rows) == 5
    assert record["worst"]["delay"]["value"] == min(row["delay"] for row in rows)
    assert record["worst"]["sensitivity"]["value"] == max(row["sensitivity"] for row in rows)
    assert Band((), 0).record() == {"systems": [], "corners": 0, "unstable": 0, "worst": {}}


@killed_by("linear.stability_margins", "NEAR_GREATEST = 0.05", "NEAR_GREATEST = 0.0")
def test_the_highest_of_many_peaks_of_a_delay():
    """A PID loop whose delay is 50 times the lag: one peak at 1.7 rad/s, and tens of peaks around 116 rad/s."""
    lag, filter_time, k, ki, kd = 0.02, 3.1e-3, 0.1671, 0.48068, 5.99e-3
    a = np.array([[-1 / lag, 0.0, 0.0], [1 / lag, 0.0, 0.0], [1 / lag / filter_time, 0.0, -1 / filter_time]])
    c = np.array([[(k + kd / filter_time) / lag, ki, -kd / filter_time]])
    result = margins(Transfer(a, np.eye(3, 1), c, np.zeros((1, 1)), None, 1.0))
    w = np.linspace(1.0, 400.0, 400_000)
    s = 1j * w
    loop = np.exp(-s) / (1 + lag * s) * (k + ki / s + kd * s / (1 + filter_time * s))
    assert result.sensitivity == pytest.approx(np.max(1 / np.abs(1 + loop)), rel=1e-6)
    assert result.sensitivity_at > 100
