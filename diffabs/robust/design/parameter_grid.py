"""Polytopes of the systems on a grid of a box, for models that are rational in their parameters.

A balance's A and B contain the inverse of a mass matrix. The hull of the corners of a box of masses then covers the box
only with a large spread. Such a hull contains systems that no vehicle has, and no gain stabilises them.

The vertices are therefore the systems on the grid, corners included, and a proof is about their hull. Coverage of the
systems between the points is likely, not proved. A finer grid makes it more likely.
"""

import numbers
from collections.abc import Mapping, Sequence

from diffabs.core.types import Part
from diffabs.robust.design.parameter_box import check_box_bounds, evaluate_grid
from diffabs.robust.design.polytopes import MAX_VERTICES, Polytope


def grid_polytope(model: Part, over: Mapping[str, Sequence[float]], points: int = 3) -> Polytope:
    """Return the polytope whose vertices are the systems on a grid over a box; `corners` has the parameters of each."""
    if not isinstance(points, numbers.Integral) or points < 2:
        raise ValueError(f"points = {points} is no whole number in [2, inf): a grid has the ends of the box")
    low, high = check_box_bounds(model, over)
    count = points ** sum(low[path] < high[path] for path in over)
    if count > MAX_VERTICES:
        raise ValueError(f"a grid of {count} systems is more than {MAX_VERTICES}; take fewer points")
    data, labels, model = evaluate_grid(model, over, points)
    return Polytope(*data.matrices, model.period, tuple(model.states), labels)
