"""The checks of `shape_checks`, and sizes that are arguments."""

import jaxtyping
import numpy as np
import pytest

from diffabs.core import shapes
from diffabs.linear import lyapunov
from diffabs.linear.robustness import low_discrepancy_points


def test_a_wrong_shape_is_an_error_in_the_tests():
    assert lyapunov(-np.eye(2), np.eye(2)).P.shape == (2, 2)
    with pytest.raises(jaxtyping.TypeCheckError, match="parameter 'Q'"):
        lyapunov(-np.eye(2), np.eye(3))


def test_a_size_may_be_an_argument():
    assert low_discrepancy_points(3, 2).shape == (3, 2)
    assert shapes.Float is jaxtyping.Float
