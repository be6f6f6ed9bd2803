"""Numbers behind a figure, for readers who look closer (`diffabs report`)."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.collections import PathCollection
from matplotlib.colors import to_hex
from matplotlib.patches import StepPatch

from diffabs.core.types import JsonObject, PyTree, Scalar
from diffabs.plot.style import Axes, Figure

AXES_DIGITS = 6  # significant digits
MAX_SERIES_POINTS = 1000  # points of a curve or cloud; more are thinned out evenly, with both ends


def describe_axes(figure: Figure) -> list[JsonObject]:
    """Return a description of each axes of a drawn figure.

    - `box`: left, top, right and bottom as shares of the figure.
    - `x`, `y`: ends of the axes.
    - `log`: for both axes, whether they are logarithmic.
    - `names`: labels of the axes.
    - `series`: for each curve or cloud its name, colour, and at most `MAX_SERIES_POINTS` points in the axes' units.

    Filled areas are left out. So are axes without a series, invisible axes, and axes with a scale other than linear or
    logarithmic.

    Args:
        figure: Figure that is already drawn, so that its axes have their final places.
    """
    return [one for ax in figure.axes if (one := _axes(ax))]


def _axes(ax: Axes) -> JsonObject | None:
    scales = {"x": ax.get_xscale(), "y": ax.get_yscale()}
    series = list(_series(ax))
    if not series or not ax.get_visible() or not set(scales.values()) <= {"linear", "log"}:
        return None
    place = ax.get_position()
    return {
        "box": _short([place.x0, 1 - place.y1, place.x1, 1 - place.y0]),
        "x": _short(ax.get_xlim()),
        "y": _short(ax.get_ylim()),
        "log": [scales["x"] == "log", scales["y"] == "log"],
        "names": [ax.get_xlabel(), ax.get_ylabel()],
        "series": series,
    }


def _series(ax: Axes) -> Iterator[JsonObject]:
    for line in ax.lines:
        # Guide lines such as axhline use another transform: their points are not in the axes' units.
        if line.get_visible() and line.get_transform() == ax.transData:
            yield from _points(line.get_label(), line.get_color(), line.get_xdata(), line.get_ydata())
    for patch in ax.patches:
        if isinstance(patch, StepPatch):
            counts, edges, _ = patch.get_data()
            yield from _points(patch.get_label(), patch.get_facecolor(), (edges[1:] + edges[:-1]) / 2, counts)
    for cloud in ax.collections:
        offsets = np.asarray(cloud.get_offsets(), float)
        if isinstance(cloud, PathCollection) and len(offsets):
            colours = np.asarray(cloud.get_facecolor()).reshape(-1, 4)
            yield from _points(cloud.get_label(), colours[0] if len(colours) else "black", *offsets.T)


def _points(name: Any, colour: Any, x: Scalar, y: Scalar) -> Iterator[JsonObject]:
    """Yield a series of the finite points, or nothing if there are none."""
    x, y = (np.ma.filled(np.ma.asarray(values, float), np.nan).ravel() for values in (x, y))
    there = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(there):
        some = there[np.unique(np.linspace(0, len(there) - 1, min(MAX_SERIES_POINTS, len(there))).round().astype(int))]
        # matplotlib gives a line without a label a name that starts with an underscore.
        name = "" if str(name).startswith("_") else str(name)
        yield {"name": name, "colour": to_hex(colour), "x": _short(x[some]), "y": _short(y[some])}


def _short(values: PyTree) -> list[float]:
    return [float(f"{value:.{AXES_DIGITS}g}") for value in values]
