"""The overshoot that every gain has if the vehicle's speed is measured wrong.

The measured speed is (1 + e) v. A controller that holds the measured slip at s* has w = (1 - s*)(1 + e) v, so a true
slip of

    1 - w/v = s* - (1 - s*) e,     an overshoot of  -e (1 - s*)/s* = -4 e  at s* = 0.2:

A speed measured 3 % low is 12 % of overshoot, under any gain. The integral of an accelerometer whose bias b makes
decelerations too high has e = -b t/v, worst at the end. Noise, quantisation and the first approach add to this floor. A
controller can reduce these.

A controller that settles below its target undercuts the floor but does not hold the slip. `Deviation` counts both
sides, after the time of the first approach; its floor is that of |e|.
"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import larger
from diffabs.core.protocols import Memory, Segment
from diffabs.core.pytree import pytree
from diffabs.parts.objectives.tracking import HeldValue
from diffabs.parts.roads import RIG
from experiments.real_rig.box import KMH, KNOWN, Fixed

HELD = 0.25  # s, from which on every controller worth the name holds its target
GRAVITY, MIRRORED = 9.81, 2.0  # m/s^2; the rig's body decelerates at twice mu g
INSTANTS = 50


def stopping_time(points: dict[str, np.ndarray], fixed: Fixed) -> np.ndarray:
    """From the start to the end at the friction of the target slip [s], (n,)."""
    peak = np.asarray(RIG.friction(fixed.slip / np.asarray(points["place"])))
    return (points["speed"] - fixed.end) / KMH / (MIRRORED * GRAVITY * points["height"] * peak)


def error(points: dict[str, np.ndarray], speed: str, fixed: Fixed, t: np.ndarray) -> np.ndarray:
    """Return the relative error e of the speed at the times t (k, n), (k, n). For an estimated speed, the bias
    alone makes it."""
    if speed == KNOWN:
        return points["last"] + (points["first"] - points["last"]) * np.exp(-t / fixed.drift)
    remaining = points["speed"] / KMH - t * (points["speed"] - fixed.end) / KMH / stopping_time(points, fixed)
    return -points["bias"] * t / remaining


def floor(points: dict[str, np.ndarray], speed: str, fixed: Fixed, *, two_sided: bool = False) -> np.ndarray:
    """Return the overshoot that the error of the speed alone makes, while the target is held (n,); with `two_sided`
    the deviation to either side."""
    t = np.linspace(HELD, stopping_time(points, fixed), INSTANTS)
    errors = error(points, speed, fixed, t)
    worst = np.abs(errors) if two_sided else np.maximum(0.0, -errors)
    return worst.max(axis=0) * (1 - fixed.slip) / fixed.slip


@pytree
class Deviation(HeldValue):
    """Greatest deviation from the setpoint, as a fraction of it: above it at any time, below it from HELD on."""

    unit = "1"
    physical = (0.0, math.inf)

    def update(self, memory: Memory, segment: Segment) -> Any:
        """The greater of that so far and that at the end of the step."""
        deviation = segment.end.output.slip / segment.end.setpoint - 1
        counts = jnp.where(segment.end.t >= HELD, larger(deviation, -deviation), deviation)
        return larger(memory.held, counts)
