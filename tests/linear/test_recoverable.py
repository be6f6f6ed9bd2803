"""Zeros and bounds of linear systems whose answer is known by hand, in any units and coordinates."""

import numpy as np
import pytest
from mutants import killed_by
from scipy.linalg import expm

from diffabs.linear.recoverable import mode_bounds, transmission_zeros

STIFF = np.array([[0.0, 1.0, 0.0], [-1e13, -1e5, 1.0], [0.0, 0.0, -1e3]])  # a spring in N/m, and a slow actuator


@killed_by("linear.recoverable", "a, b, rows = _balance(a, b, rows)\n", "")
@killed_by("linear.recoverable", "whole[:, i] *= unit", "pass")
def test_a_fast_mode_hides_no_zero():
    """The force x3 + u = (1/(s + 1000) + 1) u is zero at s = -1001; a position behind it shows it, too."""
    assert transmission_zeros(STIFF, [[0.0], [1.0], [1.0]], [1.0, 0.0, 0.0]) == pytest.approx([-1001.0], rel=1e-9)
    slower = np.block([[STIFF, np.zeros((3, 1))], [np.zeros((1, 4))]])
    slower[2:, 2:] = [[0.0, 1.0], [-1.0, -1.0]]  # the force is (s + 2)/(s^2 + s + 1) u
    assert transmission_zeros(slower, [[0.0], [0.0], [1.0], [1.0]], [1.0, 0.0, 0.0, 0.0]) == pytest.approx([-2.0])


@killed_by("linear.recoverable", "np.linalg.norm(abs(row) @ abs(a))", "np.linalg.norm(a, 2)")
def test_a_zero_does_not_depend_on_units():
    """(s + 3)/((s + 1)(s + 2)(s + 4)) in states whose units differ by up to 1e12, beside a mode at 1e14 1/s."""
    a = np.eye(3, k=1)
    a[2] = -np.poly([-1.0, -2.0, -4.0])[:0:-1]
    a = np.block([[a, np.zeros((3, 1))], [np.zeros((1, 3)), -1e14]])
    b, c = np.array([0.0, 0.0, 1.0, 0.0]), np.array([3.0, 1.0, 0.0, 0.0])
    for units in 10.0 ** np.random.default_rng(0).uniform(-6, 6, (20, 4)):
        found = transmission_zeros(a * units / units[:, None], b / units, c * units)
        assert np.sort(found) == pytest.approx([-1e14, -3.0], rel=1e-9)  # the mode is an invariant zero


@killed_by("linear.recoverable", "if not all(np.isfinite(x).all() for x in (a, b, rows)):", "if False:")
@pytest.mark.parametrize("place", range(3), ids=["A", "B", "output"])
def test_zeros_of_numbers_that_are_not_finite(place):
    for wrong in (np.nan, np.inf):
        given = [STIFF.copy(), np.ones((3, 1)), np.ones(3)]
        given[place].flat[1] = wrong
        with pytest.raises(ValueError, match=r"^A, B or the output has an entry that is not finite$"):
            transmission_zeros(*given)


@killed_by("linear.recoverable", "np.linalg.norm(offset - along * moved) > ROUNDING", "0.0 > ROUNDING")
@killed_by("linear.recoverable", "<= 2 * ROUNDING * pole", "<= 0.0")
def test_one_input_returns_one_direction_of_equal_poles():
    """x' = s x + b u leaves b as the only direction from which a start returns: |x| < |b| U/s."""
    b, turn = np.array([0.6, 0.8]), expm(np.array([[0.0, 0.3], [-0.3, 0.0]]))
    for basis in (np.eye(2), turn, np.array([[1.0, 2.0], [0.0, 1.0]])):
        a, reach = basis @ np.diag([1.7, 1.7]) @ np.linalg.inv(basis), basis @ b
        for start, bound in (([0.6, 0.8], 3.0 / 1.7), ([0.3, 0.4], 6.0 / 1.7), ([1.0, 0.0], 0.0), ([0.0, 0.0], np.inf)):
            (found,) = mode_bounds(a, reach, basis @ np.array(start), 3.0).values()
            assert found == pytest.approx(bound, rel=1e-9)
    assert mode_bounds(np.eye(2), [[1.0], [1.0]], [1.0, 0.0], 1.0) == {1.0: 0.0}


@killed_by("linear.recoverable", "basis[sizes > ROUNDING * sizes[0]]", "basis")
def test_a_chain_of_equal_poles_has_one_eigenvector():
    """x1' = x1 + x2, x2' = x2 + u: only x2 is a mode of its own."""
    assert mode_bounds([[1.0, 1.0], [0.0, 1.0]], [0.0, 1.0], [5.0, 2.0], 3.0) == {1.0: pytest.approx(1.5)}
