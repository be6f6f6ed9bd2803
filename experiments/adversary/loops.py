"""The loops under attack: the rig of `real_rig` with known speed, around several controllers.

The road and the noise of the adversary replace those that `real_rig` draws.
"""

import dataclasses
from typing import Any

import numpy as np

from diffabs import Loop
from diffabs.core.blocks import Series
from diffabs.papers import lmi_design
from diffabs.parts.controllers import BackCalculation, ProportionalFeedback, StateFeedback
from diffabs.parts.references import FilteredSlip, LimitedSlip
from diffabs.parts.roads import ScaledAlong
from diffabs.parts.sensors import DriftingSpeed, PlayedWheelNoise
from diffabs.scenario.scenario import load
from experiments.adversary.bounds import Bounds
from experiments.real_rig.box import KNOWN, Fixed
from experiments.real_rig.loops import loop


@dataclasses.dataclass(frozen=True)
class Tuned:
    """The controller that `real_rig` tunes by CVaR for a known speed."""

    gain: tuple[float, float] = (-2745.747324210777, -131.502965099322)
    tracking_time: float = 0.0023010235539139743  # s
    rate: float = 18.694448866299464  # 1/s
    time_constant: float = 0.0028503544761874977  # s


LMI = (-9.67134972904379, -12.179492711292689)  # of the 12 designs of `real_rig`, the best in its box
TUNED = "tuned in the box"


def attacked(bounds: Bounds, fixed: Fixed, controller: Any, reference: Any = None) -> Loop:
    """Return the loop around a controller, on an even road and without noise until the adversary has chosen."""
    ideal = loop(fixed, controller, KNOWN, reference)
    road = ScaledAlong(road=ideal.plant.road, factors=np.ones(bounds.factors), spacing=bounds.spacing)  # pyright: ignore[reportAttributeAccessIssue]
    noise = PlayedWheelNoise(noise=np.zeros(bounds.noises), period=fixed.period)
    return dataclasses.replace(
        ideal, plant=dataclasses.replace(ideal.plant, road=road), sensor=Series(blocks=(noise, DriftingSpeed()))
    )


def tuned(bounds: Bounds, fixed: Fixed, at: Tuned) -> Loop:
    """Return the loop of a tuned controller."""
    windup = BackCalculation(tracking_time=at.tracking_time)
    controller = ProportionalFeedback(gain=np.array(at.gain), antiwindup=windup)
    return attacked(
        bounds, fixed, controller, LimitedSlip(slip=fixed.slip, rate=at.rate, time_constant=at.time_constant)
    )


def contenders(bounds: Bounds, fixed: Fixed) -> dict[str, Loop]:
    """The controllers by name."""
    cured: Any = load("slip-cured", integrated=False).loop
    real: Any = load("slip-real", integrated=False).loop
    first = ProportionalFeedback(gain=np.asarray(cured.controller.controller.gain, float))
    target = FilteredSlip(slip=fixed.slip, time_constant=cured.reference.time_constant)
    return {
        "published gain": attacked(bounds, fixed, StateFeedback(gain=np.array(lmi_design.PUBLISHED_GAIN))),
        "LMI": attacked(bounds, fixed, StateFeedback(gain=np.array(LMI))),
        "first cure": attacked(bounds, fixed, first, target),
        "slip-real": attacked(bounds, fixed, real.controller.controller, real.reference),
        TUNED: tuned(bounds, fixed, Tuned()),
    }
