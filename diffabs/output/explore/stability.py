"""Poles, margins, L and |S| of the linearised loop, for the current values and over the box of [design.over]."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from diffabs.core.channels import control_names
from diffabs.core.pytree import replace
from diffabs.core.types import PyTree
from diffabs.linear.opened_loop import OpenLoop, open_loop
from diffabs.linear.robustness import System, band, frequencies_around, loop_responses, sensitivity_gains, shape_bound
from diffabs.linear.stability_margins import Margins, closed_loop_poles, is_stable
from diffabs.scenario.scenario import Scenario

MOST_RANGES = 3  # three ranges have 8 corners, quick enough to follow a drag
INSIDE = 4  # points inside of the box, besides its corners
FREQUENCIES = 160  # points of a curve over frequency

MARGIN_KEYS = ("gain_up", "gain_down", "phase", "delay", "modulus")


class BoxCurves(NamedTuple):
    """Curves over frequency of k loops; without any loop all arrays are empty.

    Attributes:
        w: Frequencies [rad/s].
        opened: Open loops L [1], complex, shape (k, frequencies).
        low: Least |S| [1] of the loops; NaN if one is unstable.
        high: Greatest |S| [1]; NaN if one is unstable.
    """

    w: np.ndarray
    opened: np.ndarray
    low: np.ndarray
    high: np.ndarray


NO_CURVES = BoxCurves(np.empty(0), np.empty((0, 0)), np.empty(0), np.empty(0))


class LoopCurves(NamedTuple):
    """Curves over frequency of a loop, and the bounds of |S| in [tune.constraints].

    Attributes:
        w: Frequencies [rad/s].
        opened: Open loop L [1], complex; NaN for a loop with several controls.
        gain: |S| [1], with several controls its largest singular value; NaN for an unstable loop.
        goal: Lower one of the bounds `sensitivity` and `shape` of |S| [1]; infinite without any.
        peak: Bound `sensitivity` of |S| [1], the same at all frequencies; infinite without.
    """

    w: np.ndarray
    opened: np.ndarray
    gain: np.ndarray
    goal: np.ndarray
    peak: float


class Stability(NamedTuple):
    """Poles, margins and curves of a loop, linearised at rest on its setpoint.

    Attributes:
        period: Sampling period of the controller [s], or None in continuous time.
        delay: Delay in the loop [s]. In continuous time the poles do not include it.
        poles: Poles of the closed loop, in z for a sampled loop, else in s.
        margins: Margins by name, in SI.
        stable: Whether the loop with the current values is stable.
        curves: L and |S| of the loop, and its goal.
        box: Poles, worst margins and curves over the box of the ranges.
    """

    period: float | None
    delay: float
    poles: np.ndarray
    margins: dict[str, float]
    stable: bool
    curves: LoopCurves
    box: "BoxLoops"


class BoxLoops(NamedTuple):
    """Poles, worst margins and curves over the box of [design.over]: at its corners, and at some points inside.

    They do not depend on the current values of the parameters that have a range.

    Attributes:
        of: Key of `box_of`: equal keys mean equal boxes.
        poles: Poles at all points.
        worst: Worst margins by name; empty without points or with an unstable loop.
        unstable: Number of points with an unstable loop.
        systems: Number of points.
        curves: L and |S| at all points.
    """

    of: tuple[PyTree, ...]
    poles: np.ndarray
    worst: dict[str, float]
    unstable: int
    systems: int
    curves: BoxCurves


NO_BOX = BoxLoops((), np.array([]), {}, 0, 0, NO_CURVES)


def box_of(scenario: Scenario) -> tuple[PyTree, ...]:
    """Return a key for comparison: it is equal for two scenarios if their boxes are equal.

    It holds the ranges, and the loop with each ranged parameter at its lower end.
    """
    ranges = scenario.design.ranges(scenario.loop)
    # With ranged parameters at fixed values, the key changes only if another parameter changes.
    fixed = replace(scenario.loop, {path: low for path, (low, _) in ranges.items()})
    leaves, kind = jax.tree.flatten(fixed)
    return kind, tuple(ranges.items()), *(np.asarray(leaf).tobytes() for leaf in leaves)


def linearise_box(scenario: Scenario, earlier: BoxLoops | None = None) -> BoxLoops:
    """Return poles, worst margins and curves of the linearised loops over the box of [design.over].

    A scenario without ranges, or with more than three, gets a result with zero points. `earlier` is returned if the
    box has not changed. Raises ValueError for a loop without a linear model.
    """
    of = box_of(scenario)
    if earlier and earlier.of == of:
        return earlier
    ranges = scenario.design.ranges(scenario.loop)
    if not 0 < len(ranges) <= MOST_RANGES:
        return NO_BOX._replace(of=of)
    over = band(scenario.loop, ranges, INSIDE)
    worst = {name: margin_values(system.margins)[name] for name, system in over.worst().items() if name in MARGIN_KEYS}
    poles = np.concatenate([closed_loop_poles(system.loop.transfer()) for system in over.systems])
    systems = over.systems
    return BoxLoops(of, poles, worst, len(over.unstable), len(systems), find_box_curves(systems))


def linear_stability(scenario: Scenario, box: BoxLoops | None) -> Stability:
    """Return poles, margins and curves of the linearised loop. Raises ValueError for a loop without a linear model."""
    _refuse_several_controls(scenario)
    here = band(scenario.loop, {}, 0).systems[0]
    return Stability(
        here.loop.period,
        here.loop.delay,
        closed_loop_poles(here.loop.transfer()),
        margin_values(here.margins),
        here.margins.stable,
        _curves(scenario, here.loop, _frequencies([here]), stable=here.margins.stable),
        box or NO_BOX,
    )


def _refuse_several_controls(scenario: Scenario) -> None:
    """Raise a ValueError for a loop with several controls, whose linear model compiles for 10 s to minutes."""
    if names := control_names(scenario.loop.plant):
        raise ValueError(
            f"no poles and curves of a loop with {len(names)} controls: its linear model compiles for too long. "
            "`diffabs margins` has its singular values"
        )


def loop_curves(scenario: Scenario, w: np.ndarray) -> LoopCurves:
    """Return L, |S| and its goal at frequencies w [rad/s], without the margins, which take longer.

    Raises ValueError for a loop without a linear model.
    """
    _refuse_several_controls(scenario)
    loop = open_loop(scenario.loop)
    return _curves(scenario, loop, w, stable=is_stable(loop.transfer()))


def _curves(scenario: Scenario, loop: OpenLoop, w: np.ndarray, *, stable: bool) -> LoopCurves:
    opened = loop_responses([loop], w)
    gain = sensitivity_gains(opened)[0][0] if stable else np.full(w.shape, math.nan)
    peak = scenario.tune.constraints.sensitivity or math.inf
    return LoopCurves(w, opened[0, :, 0, 0], gain, find_sensitivity_goal(scenario, w), peak)


def find_sensitivity_goal(scenario: Scenario, w: np.ndarray) -> np.ndarray:
    """Return the lower one of the bounds `sensitivity` and `shape` of |S| in [tune.constraints], infinity without."""
    constraints = scenario.tune.constraints
    bound = np.full(w.shape, constraints.sensitivity or math.inf)
    return np.minimum(bound, shape_bound(constraints.shape, w)) if constraints.shape else bound


def _frequencies(systems: Sequence[System]) -> np.ndarray:
    crossovers, periods = zip(*((system.margins.crossover, system.loop.period) for system in systems), strict=True)
    return frequencies_around(crossovers, periods, count=FREQUENCIES)


def find_box_curves(systems: Sequence[System]) -> BoxCurves:
    """Return L, and the least and the greatest |S|, of some systems, around their crossovers."""
    w = _frequencies(systems)
    opened = loop_responses([system.loop for system in systems], w)
    if not all(system.margins.stable for system in systems):
        return BoxCurves(w, opened[:, :, 0, 0], *np.full((2, len(w)), math.nan))
    gains, _ = sensitivity_gains(opened)
    return BoxCurves(w, opened[:, :, 0, 0], gains.min(axis=0), gains.max(axis=0))


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
