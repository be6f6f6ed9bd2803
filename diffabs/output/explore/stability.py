"""Poles and margins of the linearised loop, for the current values and at the corners of the [design.over] ranges."""

import math
from typing import NamedTuple

import jax
import numpy as np

from diffabs.core.pytree import replace
from diffabs.core.types import PyTree
from diffabs.linear.robustness import band
from diffabs.linear.stability_margins import Margins, closed_loop_poles
from diffabs.scenario.scenario import Scenario

MOST_RANGES = 3  # three ranges have 8 corners, quick enough to follow a drag

MARGIN_KEYS = ("gain_up", "gain_down", "phase", "delay", "modulus")


class Stability(NamedTuple):
    """Poles and margins of a loop, linearised at rest on its setpoint.

    Attributes:
        period: Sampling period of the controller [s], or None in continuous time.
        delay: Delay in the loop [s]. In continuous time the poles do not include it.
        poles: Poles of the closed loop, in z for a sampled loop, else in s.
        margins: Margins by name, in SI.
        stable: Whether the loop with the current values is stable.
        corners: Poles and worst margins at the corners of the ranges.
    """

    period: float | None
    delay: float
    poles: np.ndarray
    margins: dict[str, float]
    stable: bool
    corners: "CornerLoops"


class CornerLoops(NamedTuple):
    """Poles and worst margins at the corners of the ranges of [design.over].

    The corners do not depend on the current values of the parameters that have a range.

    Attributes:
        of: Key of `corners_of`: equal keys mean equal corners.
        poles: Poles of all corners.
        worst: Worst margins by name; empty without corners or with an unstable corner.
        unstable: Number of unstable corners.
        systems: Number of corners.
    """

    of: tuple[PyTree, ...]
    poles: np.ndarray
    worst: dict[str, float]
    unstable: int
    systems: int


def corners_of(scenario: Scenario) -> tuple[PyTree, ...]:
    """Return a key for comparison: it is equal for two scenarios if their corners are equal.

    It holds the ranges, and the loop with each ranged parameter at its lower end.
    """
    ranges = scenario.design.ranges(scenario.loop)
    # With ranged parameters at fixed values, the key changes only if another parameter changes.
    fixed = replace(scenario.loop, {path: low for path, (low, _) in ranges.items()})
    leaves, kind = jax.tree.flatten(fixed)
    return kind, tuple(ranges.items()), *(np.asarray(leaf).tobytes() for leaf in leaves)


def linearise_corners(scenario: Scenario, earlier: CornerLoops | None = None) -> CornerLoops:
    """Return poles and worst margins of the linearised loops at the corners of the [design.over] ranges.

    A scenario without ranges, or with more than three, gets a result with zero corners. `earlier` is returned if the
    corners have not changed. Raises ValueError for a loop without a linear model.
    """
    of = corners_of(scenario)
    if earlier and earlier.of == of:
        return earlier
    ranges = scenario.design.ranges(scenario.loop)
    if not 0 < len(ranges) <= MOST_RANGES:
        return CornerLoops(of, np.array([]), {}, 0, 0)
    over = band(scenario.loop, ranges, 0)
    worst = {name: margin_values(system.margins)[name] for name, system in over.worst().items() if name in MARGIN_KEYS}
    poles = np.concatenate([closed_loop_poles(system.loop.transfer()) for system in over.systems])
    return CornerLoops(of, poles, worst, len(over.unstable), len(over.systems))


def linear_stability(scenario: Scenario, corners: CornerLoops | None) -> Stability:
    """Return poles and margins of the linearised loop. Raises ValueError for a loop without a linear model."""
    here = band(scenario.loop, {}, 0).systems[0]
    return Stability(
        here.loop.period,
        here.loop.delay,
        closed_loop_poles(here.loop.transfer()),
        margin_values(here.margins),
        here.margins.stable,
        corners or CornerLoops((), np.array([]), {}, 0, 0),
    )


def margin_values(margins: Margins) -> dict[str, float]:
    """Return the margins by the names of `MARGIN_KEYS`, in SI; NaN for an unstable loop.

    Gain and modulus margins are factors [1], the phase margin is in rad, and the delay margin in s.
    """
    low, high = margins.gain
    values = (high, low, margins.phase, margins.delay, margins.modulus)
    return dict(zip(MARGIN_KEYS, values, strict=True))


def format_margin(name: str, value: float, stable: bool) -> str:
    """Return a margin, in SI, as text with its unit."""
    if math.isnan(value):
        return "undecided" if name == "delay" and stable else "none"
    if value == math.inf:
        return "no limit"
    scale, unit = {"phase": (math.degrees(1), "°"), "delay": (1e3, " ms")}.get(name, (1.0, ""))
    sign = "\N{MULTIPLICATION SIGN} " if name.startswith("gain") else ""
    return f"{sign}{value * scale:.3g}{unit}"
