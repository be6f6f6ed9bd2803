"""Figures of measured signals over simulated ones."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from diffabs.core.types import AnyArray
from diffabs.output.plot.style import COLOURS, Figure, label_axes, sheet


class MeasuredPanel(NamedTuple):
    """A panel of a figure: readings as points, the simulation as a line.

    Attributes:
        label: Label of the vertical axis, with its unit.
        t: Instants [s], shape (n,).
        measured: Readings, shape (n,); NaN leaves one out.
        simulated: Simulated signal at the same instants, shape (n,).
        name: Name of the simulation in the legend.
    """

    label: str
    t: Any
    measured: AnyArray
    simulated: AnyArray
    name: str


def draw_measured(panels: Sequence[MeasuredPanel], *, title: str = "") -> Figure:
    """Return a figure with one panel below the other, each with measured points over a simulated line.

    Args:
        panels: Panels from top to bottom.
        title: Title of the figure.
    """
    figure, axes = sheet(len(panels), 1, title=title, size=(8.4, 2.2), sharex=True)
    for axis, panel in zip(axes, panels, strict=True):
        axis.plot(panel.t, panel.measured, ".", markersize=3, color=COLOURS[0], label="measured")
        axis.plot(panel.t, panel.simulated, linewidth=1, color=COLOURS[1], label=panel.name)
        label_axes(axis, "time [s]" if panel is panels[-1] else "", panel.label)
    return figure
