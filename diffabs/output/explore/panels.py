"""Contents of a chart: curves in panels, and the quantiles of many runs."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

NO_VALUE = "-"
DISPLAY_ROUNDING = 1e-12  # smaller magnitudes are shown as 0


class Curve(NamedTuple):
    """A curve: its name, and its values in the displayed unit, NaN for missing ones."""

    name: str
    values: np.ndarray


class Panel(NamedTuple):
    """Curves of one unit; the fan belongs to the first curve."""

    unit: str
    lines: tuple[Curve, ...]


class Curves(NamedTuple):
    """The curves of a run.

    Attributes:
        t: Instants [s].
        panels: Panels of the chart.
        metrics: Metrics by name.
        end: Sentence about the end of the run.
        draft: True for a quick run by another solver than the scenario's.
    """

    t: np.ndarray
    panels: tuple[Panel, ...]
    metrics: dict[str, float]
    end: str
    draft: bool


class Fan(NamedTuple):
    """Quantiles of many runs.

    Attributes:
        t: Instants [s].
        bands: Quantiles of the first curve of each panel, shape (QUANTILES, instants).
        members: Number of members.
        refused: Number of members that must not be run.
        diverged: Number of diverged runs.
        words: Parameters that differ between the runs, with their spread.
    """

    t: np.ndarray
    bands: tuple[np.ndarray, ...]
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
