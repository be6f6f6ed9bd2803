"""Contents of a chart: curves in panels, and the quantiles of many runs."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

NO_VALUE = "-"
# Signals that the loop should follow, with their dashes.
AIMS = {"target": "dashed", "setpoint": "dotted", "command": "dashed"}
DISPLAY_ROUNDING = 1e-12  # smaller magnitudes are shown as 0


class Curve(NamedTuple):
    """A curve: its name, and its values in the displayed unit, NaN for missing ones."""

    name: str
    values: np.ndarray


class Panel(NamedTuple):
    """Curves of one unit.

    Attributes:
        unit: Unit of all curves.
        lines: Signals, then their targets and setpoints, or the commands, each in the order of the signals.
        quantity: What the signals have in common, such as "slip" of wheels; empty if their names say it.
    """

    unit: str
    lines: tuple[Curve, ...]
    quantity: str = ""

    @property
    def compared(self) -> tuple[Curve, ...]:
        """Signals that have a fan and a curve to compare with: all signals of one quantity, otherwise the first."""
        return tuple(line for line in self.lines if line.name not in AIMS) if self.quantity else self.lines[:1]


class Strip(NamedTuple):
    """A part of a road seen from above, with one friction.

    Attributes:
        x: First and last place along the road [m].
        y: Right and left edge [m].
        friction: Greatest friction coefficient of its tyres [1].
    """

    x: tuple[float, float]
    y: tuple[float, float]
    friction: float


class Path(NamedTuple):
    """A run seen from above, in the axes of the road: x along it, y to the left.

    Attributes:
        t: Instants [s].
        x: Places along the road [m].
        y: Places to the left of the first heading [m].
        yaw: Angles from the road to the heading [rad].
        outlines: The vehicle at some instants, shape (vehicles, corners, 2) [m].
        window: Limits (low, high) of x and y that are drawn [m].
        strips: The road.
    """

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    outlines: np.ndarray
    window: tuple[tuple[float, float], tuple[float, float]]
    strips: tuple[Strip, ...]


class Curves(NamedTuple):
    """The curves of a run.

    Attributes:
        t: Instants [s].
        panels: Panels of the chart.
        metrics: Metrics by name.
        end: Sentence about the end of the run.
        draft: True for a quick run by another solver than the scenario's.
        path: The run seen from above; None for a plant whose outputs have no path.
    """

    t: np.ndarray
    panels: tuple[Panel, ...]
    metrics: dict[str, float]
    end: str
    draft: bool
    path: Path | None = None


class Fan(NamedTuple):
    """Quantiles of many runs.

    Attributes:
        t: Instants [s].
        bands: For each panel the quantiles of each of its `compared` signals, shape (QUANTILES, instants).
        members: Number of members.
        refused: Number of members that must not be run.
        diverged: Number of diverged runs.
        words: Parameters that differ between the runs, with their spread.
    """

    t: np.ndarray
    bands: tuple[tuple[np.ndarray, ...], ...]
    members: int
    refused: int
    diverged: int
    words: str


@dataclasses.dataclass(frozen=True)
class Spread:
    """Relative half widths of the uniform spread of a fan's members around the current values.

    Attributes:
        mass: Half width of the mass [1].
        road: Half width of the friction factor [1].
    """

    mass: float = 0.1
    road: float = 0.2


def format_reading(value: float) -> str:
    """Return a metric as text, without digits that are rounding errors; NaN is "-"."""
    return NO_VALUE if math.isnan(value) else "0" if abs(value) < DISPLAY_ROUNDING else f"{value:.5g}"
