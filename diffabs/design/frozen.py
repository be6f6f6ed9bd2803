"""The loops of a box one by one, each with its parameters fixed: what is known of a gain that has no common P.

Stable frozen loops are no proof for parameters that vary, and their poles are floating point; but a gain that no common
Lyapunov matrix proves is not therefore unstable.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from diffabs.core.pytree import replace
from diffabs.design.parameter_box import check_box_bounds, evaluate_systems
from diffabs.design.polytopes import as_gain_matrix

MAX_POINTS_PER_AXIS, MAX_BOX_SYSTEMS = 17, 5000  # per parameter, and in all


class FrozenLoops(NamedTuple):
    """How many systems of a box were looked at, how many of them a gain stabilises, and the decay rate [1/s] of the
    slowest mode of all, negative where it grows, with the parameters there."""

    systems: int
    stable: int
    slowest: float
    at: dict[str, float]


def analyse_frozen_loops(gain: Any, model: Any, over: Mapping[str, Sequence[float]]) -> FrozenLoops:
    """The poles of A + B K at the points of a grid over the box {path: (low, high)}, its corners among them.

    Raises ValueError as `box.polytope`, and for a gain that does not fit.
    """
    low, high = check_box_bounds(model, over)
    free = tuple(path for path in over if low[path] < high[path])
    count = max(2, min(MAX_POINTS_PER_AXIS, int(MAX_BOX_SYSTEMS ** (1 / max(len(free), 1)) + 1e-9)))
    points = itertools.product(*(np.linspace(low[path], high[path], count) for path in free))
    grid = np.array(list(points)).reshape(count ** len(free), len(free))
    data = evaluate_systems(replace(model, low), free, grid)
    a, b = data.matrices
    modes = np.linalg.eigvals(a + b @ as_gain_matrix(gain, (data.inputs, data.order)))
    if model.period is None:
        rates = -modes.real.max(axis=1)
    else:
        rates = -np.log(np.maximum(np.abs(modes).max(axis=1), np.finfo(float).tiny)) / float(model.period)
    i = int(np.argmin(rates))
    at = {**low, **dict(zip(free, grid[i].tolist(), strict=True))}
    return FrozenLoops(len(grid), int((rates > 0).sum()), float(rates[i]), at)
