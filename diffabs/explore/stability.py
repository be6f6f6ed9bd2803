"""Poles and margins of the linearised loop, here and at the corners of the ranges of [design.over]."""

import math
from typing import Any, NamedTuple

import jax
import numpy as np

from diffabs.core.pytree import replace
from diffabs.linear.robustness import band
from diffabs.linear.stability_margins import Margins, closed_loop_poles
from diffabs.scenario.scenario import Scenario

MOST_RANGES = 3  # whose corners are followed while one drags

MARGIN_KEYS = ("gain_up", "gain_down", "phase", "delay", "modulus")


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


class CornerLoops(NamedTuple):
    """The corners of the ranges of [design.over]. They do not depend on the values that have a range: `of` is what they
    follow from. Poles, the worst margins, how many are not stable, how many there are."""

    of: tuple[Any, ...]
    poles: np.ndarray
    worst: dict[str, float]
    unstable: int
    systems: int


def corners_of(chosen: Scenario) -> tuple[Any, ...]:
    """Return what the corners follow from, to be compared: their ranges, and the loop without what has a range."""
    ranges = chosen.design.ranges(chosen.loop)
    rest = replace(chosen.loop, {path: low for path, (low, _) in ranges.items()})
    leaves, kind = jax.tree.flatten(rest)
    return kind, tuple(ranges.items()), *(np.asarray(leaf).tobytes() for leaf in leaves)


def linearise_corners(chosen: Scenario, known: CornerLoops | None = None) -> CornerLoops:
    """Return the corners of a scenario: `known` itself where they have not moved."""
    of = corners_of(chosen)
    if known and known.of == of:
        return known
    ranges = chosen.design.ranges(chosen.loop)
    if not 0 < len(ranges) <= MOST_RANGES:
        return CornerLoops(of, np.array([]), {}, 0, 0)
    over = band(chosen.loop, ranges, 0)
    worst = {name: margin_values(one.margins)[name] for name, one in over.worst().items() if name in MARGIN_KEYS}
    poles = np.concatenate([closed_loop_poles(one.loop.transfer()) for one in over.systems])
    return CornerLoops(of, poles, worst, len(over.unstable), len(over.systems))


def linear_stability(chosen: Scenario, corners: CornerLoops | None) -> Stability:
    """Return poles and margins of the linearised loop.

    Args:
        chosen: the scenario
        corners: those that are shown with it, or None where none are known yet

    Raises:
        ValueError: the loop has no linear model
    """
    here = band(chosen.loop, {}, 0).systems[0]
    corners = corners or CornerLoops((), np.array([]), {}, 0, 0)
    return Stability(
        here.loop.period,
        here.loop.delay,
        closed_loop_poles(here.loop.transfer()),
        corners.poles,
        margin_values(here.margins),
        corners.worst,
        here.margins.stable,
        corners.unstable,
        corners.systems,
    )


def margin_values(found: Margins) -> dict[str, float]:
    """Return the margins by name, in SI; NaN where the loop is not stable."""
    low, high = found.gain
    values = (high, low, found.phase, found.delay, found.modulus)
    return dict(zip(MARGIN_KEYS, values, strict=True))


def format_margin(name: str, value: float) -> str:
    """Return a margin as it is shown, with its unit."""
    if math.isnan(value):
        return "none"
    if value == math.inf:
        return "no limit"
    scale, unit = {"phase": (math.degrees(1), "°"), "delay": (1e3, " ms")}.get(name, (1.0, ""))
    sign = "\N{MULTIPLICATION SIGN} " if name.startswith("gain") else ""
    return f"{sign}{value * scale:.3g}{unit}"
