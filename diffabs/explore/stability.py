"""Poles and margins of the linearised loop, here and at the corners of the ranges of [design.over]."""

import math
from typing import NamedTuple

import numpy as np

from diffabs.linear.robustness import band
from diffabs.linear.stability_margins import Margins, closed_poles
from diffabs.scenario.scenario import Scenario

MOST_RANGES = 3  # whose corners are followed while one drags

NAMES = ("gain_up", "gain_down", "phase", "delay", "modulus")


class Stability(NamedTuple):
    """A loop, linearised at rest on its setpoint.

    period: of its controller [s], None in continuous time; delay: in the loop [s], which poles in continuous time are
        without
    poles: of the closed loop, in z where it is sampled, else in s; corners: those at the corners of the ranges
    margins: as numbers by name, in SI; worst: over the corners, empty where there are none or one is not stable
    stable: here; unstable, systems: how many corners are not, and how many there are
    """

    period: float | None
    delay: float
    poles: np.ndarray
    corners: np.ndarray
    margins: dict[str, float]
    worst: dict[str, float]
    stable: bool
    unstable: int
    systems: int


def stability(chosen: Scenario) -> Stability:
    """Return what is known of the linearised loop. Raises ValueError for a loop that has no linear model."""
    here = band(chosen.loop, {}, 0).systems[0]
    ranges = chosen.design.ranges(chosen.loop)
    over = band(chosen.loop, ranges, 0) if 0 < len(ranges) <= MOST_RANGES else None
    systems = over.systems if over else ()
    worst = {name: numbers(one.margins)[name] for name, one in over.worst().items() if name in NAMES} if over else {}
    corners = [closed_poles(one.loop.transfer()) for one in systems]
    return Stability(
        here.loop.period,
        here.loop.delay,
        closed_poles(here.loop.transfer()),
        np.concatenate(corners) if corners else np.array([]),
        numbers(here.margins),
        worst,
        here.margins.stable,
        len(over.unstable) if over else 0,
        len(systems),
    )


def numbers(found: Margins) -> dict[str, float]:
    """Return the margins by name, in SI; NaN where the loop is not stable."""
    low, high = found.gain
    values = (high, low, found.phase, found.delay, found.modulus)
    return dict(zip(NAMES, values, strict=True))


def said(name: str, value: float) -> str:
    """Return a margin as it is shown, with its unit."""
    if math.isnan(value):
        return "none"
    if value == math.inf:
        return "no limit"
    scale, unit = {"phase": (math.degrees(1), "°"), "delay": (1e3, " ms")}.get(name, (1.0, ""))
    sign = "\N{MULTIPLICATION SIGN} " if name.startswith("gain") else ""
    return f"{sign}{value * scale:.3g}{unit}"
