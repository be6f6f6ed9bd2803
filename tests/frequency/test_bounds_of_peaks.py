"""Bounds of peaks over a hull: closed forms, scans, SLICOT's bound of mu, and refusals."""

import math

import numpy as np
import pytest
import slycot
from mutants import killed_by
from scipy.linalg import expm

from diffabs.core.pytree import replace
from diffabs.linear import multivariable_margins, open_loop
from diffabs.linear.responses.response import TracedSystem
from diffabs.robust.frequency import bound_peaks
from diffabs.robust.frequency.peaks import _count_periods
from diffabs.robust.frequency.vertices import VertexSystems, _Frequencies, bound_constant, bound_varying, is_positive
from diffabs.scenario import load


def resonances(stiffness, damping, period=None):
    """x'' + c x' + k x = k w, z = x: one vertex for each stiffness k and damping c."""
    a = np.array([[[0.0, 1.0], [-k, -c]] for k, c in zip(stiffness, damping, strict=True)])
    b = np.array([[[0.0], [k]] for k in stiffness])
    if period is not None:
        both = np.array([expm(period * np.block([[x, y], [np.zeros((1, 3))]])) for x, y in zip(a, b, strict=True)])
        a, b = both[:, :2, :2], both[:, :2, 2:]
    outputs = np.tile([[1.0, 0.0]], (len(a), 1, 1))
    return VertexSystems(a, b, outputs, np.zeros((len(a), 1, 1)), period)


def scan(systems, shares, w):
    """The greatest gain of convex combinations of two vertices on a grid of frequencies."""
    s = 1j * w if systems.period is None else np.exp(1j * w * systems.period)
    a, b = (x[0] + shares[:, None, None] * (x[1] - x[0]) for x in systems[:2])
    return np.abs((systems.C[0] @ np.linalg.solve(s[:, None, None, None] * np.eye(2) - a, b + 0j))[..., 0, 0])


@killed_by(
    "robust.frequency.vertices",
    'whole = v["g"] * self.on_input - square',
    'whole = v["g"] * self.on_input - 0.5 * square',
)
def test_constant_damping_has_the_peak_of_the_least():
    """1/(2 z sqrt(1 - z^2)) at z = 0.1, whatever the hull holds besides."""
    peak = 1 / (0.2 * math.sqrt(0.99))
    bound = bound_constant(resonances([1.0, 1.0], [0.2, 0.6]), peak, math.sqrt(0.98))
    assert peak < bound.value < 1.002 * peak
    assert bound.at == pytest.approx(math.sqrt(0.98), rel=0.02)


@pytest.mark.parametrize("period", [None, 0.3])
def test_constant_stiffness_against_a_scan(period):
    """The peak moves in frequency with the stiffness, so every range of frequencies matters."""
    systems = resonances([0.8, 1.6], [0.4, 0.4], period)
    shares, w = np.linspace(0, 1, 101), np.linspace(0.01, 3.0, 2000)
    gains = scan(systems, shares, w)
    i, _ = np.unravel_index(np.argmax(gains), gains.shape)
    bound = bound_constant(systems, float(gains.max()), float(w[i]))
    assert gains.max() < bound.value < 1.02 * gains.max()


@killed_by("robust.frequency.vertices", "+ [1.0] * m) - x.outputs.mT", "+ [1.0] * m) - 0.5 * x.outputs.mT")
def test_varying_parameters():
    """One vertex: the H-infinity norm. Stiffness 0.8 to 1.6 is more than its norm; pumped much more, it is unstable."""
    single = resonances([1.0], [0.2])
    peak = slycot.ab13dd(
        "C", "I", "N", "D", 2, 1, 1, single.A[0], np.eye(2), single.B[0], single.C[0], np.zeros((1, 1))
    )[0]
    assert bound_varying(single, peak) == pytest.approx(peak, rel=1e-5)
    sampled = resonances([1.0], [0.2], 0.3)
    gain = np.max(
        scan(sampled._replace(A=sampled.A[[0, 0]], B=sampled.B[[0, 0]]), np.zeros(1), np.linspace(0.9, 1.1, 20001))
    )
    assert bound_varying(sampled, float(gain)) == pytest.approx(gain, rel=1e-5)
    assert bound_varying(resonances([0.8, 1.6], [1.0, 1.0]), 1.0) > 1.0
    assert bound_varying(resonances([0.5, 5.0], [0.1, 0.1]), 1.0) == math.inf


def test_an_unstable_system_within_the_hull_has_no_bound():
    """Two stable vertices; their mean has the eigenvalues -1 +- 2."""
    a = np.array([[[-1.0, 4.0], [0.0, -1.0]], [[-1.0, 0.0], [4.0, -1.0]]])
    b, c = np.ones((2, 2, 1)), np.ones((2, 1, 2))
    assert bound_constant(VertexSystems(a, b, c, np.zeros((2, 1, 1)), None), 1.0, 0.0).value == math.inf


def test_a_single_frequency_against_the_bound_of_mu():
    """A = A0 + d1 E1 + d2 E2 of rank one: the least gain at which SLICOT's mu, real blocks and performance, is 1."""
    draw = np.random.default_rng(3)
    for _ in range(4):
        a = draw.normal(size=(3, 3)) - 3 * np.eye(3)
        columns, rows = 0.6 * draw.normal(size=(2, 3, 1)), draw.normal(size=(2, 1, 3))
        b, c, w = draw.normal(size=(3, 1)), draw.normal(size=(1, 3)), 1.3
        corners = [(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)]
        vertices = np.array([a + x * columns[0] @ rows[0] + y * columns[1] @ rows[1] for x, y in corners])
        whole = VertexSystems(vertices, np.tile(b, (4, 1, 1)), np.tile(c, (4, 1, 1)), np.zeros((4, 1, 1)), None)
        search = _Frequencies(whole, 1.0)
        value, _ = search._solve([search._point(math.atan(w / search.frame.tau))])
        left, right = np.vstack([*rows, c]), np.hstack([*columns, b])
        matrix = left @ np.linalg.solve(1j * w * np.eye(3) - a, right)
        low, high = 1e-3, 1e3
        for _ in range(40):
            gain = math.sqrt(low * high)
            scaled = matrix / np.array([1.0, 1.0, gain])[:, None]
            low, high = (
                (gain, high) if slycot.ab13md(scaled, np.ones(3, int), np.array([1, 1, 2]))[0] > 1 else (low, gain)
            )
        mixed = [a + x * columns[0] @ rows[0] + y * columns[1] @ rows[1] for x, y in draw.uniform(-1, 1, (2000, 2))]
        gains = np.abs(c @ np.linalg.solve(1j * w * np.eye(3) - np.array([*mixed, *vertices]), b + 0j))
        assert gains.max() * (1 - 1e-6) < value < 1.02 * low


def test_a_matrix_that_errors_make_indefinite_is_not_positive():
    matrix, error = np.array([[[1.0, 0.5], [0.5, 1.0]]]), np.ones((1, 2, 2))
    assert is_positive(matrix, 0.2 * error)
    assert not is_positive(matrix, 0.3 * error)
    assert not is_positive(-matrix, 0.0 * error)


def test_delays_without_a_finite_state_are_refused():
    system = TracedSystem(*(np.zeros((1, 1)),) * 4, None, np.asarray(0.01))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"a pure delay of 0.01 s in continuous time"):
        _count_periods([system])
    with pytest.raises(ValueError, match="from 1 to 2 whole periods"):
        _count_periods([system._replace(period=0.01), system._replace(period=0.01, delay=np.asarray(0.02))])
    assert _count_periods([system._replace(period=0.005)]) == 2


@pytest.mark.slow
def test_bounds_of_a_brake():
    """The bound of constant parameters lies between the peak of the worst corner and the bound that balls prove."""
    box = {"plant.mass": (5.3, 6.2), "initial.speed": (1.4, 13.9)}
    peaks = bound_peaks(load("slip-lmi").loop, box)
    assert peaks["sensitivity"].reached == pytest.approx(2.40264625, rel=1e-8)
    assert peaks["sensitivity"].reached < peaks["sensitivity"].constant < 2.4030
    assert peaks["sensitivity"].no_common
    assert peaks["complementary"].reached < peaks["complementary"].constant < 1.001 * peaks["complementary"].reached


@pytest.mark.slow
def test_bounds_of_two_pumps():
    """Two controls: no sample of the box exceeds the bounds, by the margins in NumPy."""
    box, loop = {"plant.share_1": (0.65, 0.75), "plant.share_2": (0.55, 0.65)}, load("quadruple-tank").loop
    peaks, draw = bound_peaks(loop, box), np.random.default_rng(0)
    samples = draw.uniform([0.65, 0.55], [0.75, 0.65], (10, 2)).tolist() + [[0.65, 0.55]]
    at = [multivariable_margins(open_loop(replace(loop, dict(zip(box, x, strict=True))))).input for x in samples]
    greatest = max(margins.complementary for margins in at)
    assert peaks["complementary"].reached == pytest.approx(greatest, rel=1e-6)
    assert greatest < peaks["complementary"].constant < 1.03 * greatest
    assert peaks["complementary"].constant < peaks["complementary"].varying < 2.0
