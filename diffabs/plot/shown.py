"""What a figure shows, as numbers: for readers who look closer (`diffabs report`)."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.collections import PathCollection
from matplotlib.colors import to_hex
from matplotlib.patches import StepPatch

from diffabs.plot.style import Axes, Figure

AXES_DIGITS = 6
MAX_SERIES_POINTS = 1000  # points of a curve or cloud; more are thinned out evenly, with both ends


def describe_axes(figure: Figure) -> list[dict[str, Any]]:
    """Return the axes of a figure that was drawn: their `box` (left, top, right, bottom, as shares of the figure),
    ends, whether each is logarithmic, names, and `series` of points in the axes' units. Axes with another scale are
    left out, and areas."""
    return [one for ax in figure.axes if (one := _axes(ax))]


def _axes(ax: Axes) -> dict[str, Any] | None:
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


def _series(ax: Axes) -> Iterator[dict[str, Any]]:
    for line in ax.lines:
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


def _points(name: Any, colour: Any, x: Any, y: Any) -> Iterator[dict[str, Any]]:
    """A series, or none: of its finite points."""
    x, y = (np.ma.filled(np.ma.asarray(values, float), np.nan).ravel() for values in (x, y))
    there = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(there):
        some = there[np.unique(np.linspace(0, len(there) - 1, min(MAX_SERIES_POINTS, len(there))).round().astype(int))]
        name = "" if str(name).startswith("_") else str(name)
        yield {"name": name, "colour": to_hex(colour), "x": _short(x[some]), "y": _short(y[some])}


def _short(values: Any) -> list[float]:
    return [float(f"{value:.{AXES_DIGITS}g}") for value in values]
