"""Which values have a place in a range of a free parameter, and which are at an end."""

import math

import numpy as np
import pytest
from mutants import killed_by
from scipy.special import logit

from diffabs.core.bijectors import parameter_space
from diffabs.parts.controllers import PID, StateFeedback


@killed_by("core.bijectors", "if inside and isinstance(mapping, Decades):", "if False:")
def test_a_low_start_in_many_decades_has_a_place():
    """The range is mapped in the logarithm: there 5e-4 is in the middle, and 1e-6 (1 + 1e-9) at the end."""
    part, ends = PID(kp=60.0, ki=5e-4), {"ki": (1e-6, 1e6)}
    wanted = logit(math.log(5e-4 / 1e-6) / math.log(1e12))
    np.testing.assert_allclose(parameter_space(part, ends).place(part), [wanted], rtol=1e-12)
    part = StateFeedback(gain=(-5e-4, -10.0))
    found = parameter_space(part, {"gain": (-1e6, -1e-6)}).place(part)
    np.testing.assert_allclose(found, logit(np.log(np.array([5e-4, 10.0]) / 1e-6) / math.log(1e12)), rtol=1e-12)
    with pytest.raises(ValueError, match=r"ki = 1e-06 is not inside \(1e-06, 1e\+06\)"):
        parameter_space(PID(kp=60.0, ki=1e-6 * (1 + 1e-9)), ends)


@killed_by("core.bijectors", "else sum(finite))", "else max(1.0, *finite))", case="5e-10-0.0")
@pytest.mark.parametrize(("start", "end"), [(5e-10, 0.0), (1e-300, 0.0), (1.0 + 1e-6, 1.0)])
def test_a_start_near_the_end_of_a_half_line_has_a_place(start, end):
    """It is 0, and a unit there is a factor e in the distance from the end."""
    part = PID(kp=start)
    space = parameter_space(part, {"kp": (end, math.inf)})
    np.testing.assert_array_equal(space.place(part), [0.0])
    assert space.values(np.ones(1))["kp"] - end == pytest.approx(math.e * (start - end), rel=1e-6)


@killed_by("core.bijectors", "inside = low < value < high", "inside = low <= value <= high", case="0.0-0.0")
@killed_by("core.bijectors", "room = END_SHARE * (", "room = 0.0 * (", case="1.000000000001-1.0")
@pytest.mark.parametrize(("start", "end"), [(0.0, 0.0), (0.5, 1.0), (1.0 + 1e-12, 1.0), (math.inf, 0.0)])
def test_a_start_that_cannot_leave_its_end_is_refused(start, end):
    with pytest.raises(ValueError, match=r"is not inside .*: it cannot be moved from there"):
        parameter_space(PID(high=start, kp=1.0), {"high": (end, math.inf)})
