"""The frozen loops of a box, each with its parameters fixed, for a gain that has no common P.

Stable frozen loops are no proof for parameters that vary, and their poles are floating point. A gain without a common
Lyapunov matrix is not necessarily unstable: the frozen loops show how stable it is for fixed parameters.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffabs.core.numerics import spectral_bound
from diffabs.core.types import AnyArray, Part
from diffabs.robust.design.parameter_box import check_box_bounds, evaluate_grid
from diffabs.robust.design.polytopes import as_gain_matrix

MAX_POINTS_PER_AXIS, MAX_BOX_SYSTEMS = 17, 5000  # points per parameter; systems in all


class FrozenLoops(NamedTuple):
    """Stability of the frozen loops of a box.

    Attributes:
        systems: Number of systems on the grid.
        stable: Number of these systems that the gain stabilises.
        slowest: Smallest decay rate [1/s] of any mode of any system, negative if the mode grows. In discrete time it is
            -ln |pole| / period.
        at: Value by path of every parameter of the box, at the system with this mode.
    """

    systems: int
    stable: int
    slowest: float
    at: dict[str, float]


def analyse_frozen_loops(gain: AnyArray, model: Part, over: Mapping[str, Sequence[float]]) -> FrozenLoops:
    """Return the stability of A + B K at the points of a grid over a box {path: (low, high)}, corners included.

    Each parameter has 17 grid points, or fewer so that there are at most 5000 systems, but at least 2.
    """
    low, high = check_box_bounds(model, over)
    free = sum(low[path] < high[path] for path in over)
    # The largest equal number of points per axis whose grid stays within MAX_BOX_SYSTEMS; 1e-9 undoes rounding of the
    # root.
    count = max(2, min(MAX_POINTS_PER_AXIS, int(MAX_BOX_SYSTEMS ** (1 / max(free, 1)) + 1e-9)))
    data, labels, model = evaluate_grid(model, over, count)
    a, b = data.matrices
    closed = a + b @ as_gain_matrix(gain, (data.inputs, data.order))
    slowest = spectral_bound(closed, discrete=model.period is not None)
    if model.period is None:
        rates = -slowest
    else:
        # A deadbeat loop has only poles at 0: the smallest float keeps its rate finite.
        rates = -np.log(np.maximum(slowest, np.finfo(float).tiny)) / float(model.period)
    i = int(np.argmin(rates))
    return FrozenLoops(len(labels), int((rates > 0).sum()), float(rates[i]), labels[i])
