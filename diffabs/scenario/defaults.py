"""The usual loops, from which a scenario or an example starts: a braking car, a balanced two-wheeler."""

from typing import Any

from diffabs.actuators import VoltageLimit
from diffabs.controllers import PID, BalanceFeedback
from diffabs.core.loop import Loop
from diffabs.core.protocols import BalanceOutput, BrakeOutput, Plant
from diffabs.plants import ArmBalance, BalanceStart, BrakeStart, QuarterCar
from diffabs.references import FixedSlip, Upright
from diffabs.stops import Fallen, Standstill


def braking(**parts: Any) -> Loop:
    """Return a quarter car under a PID that holds a fixed slip until standstill, with `parts` in place of its own."""
    usual = {
        "plant": QuarterCar(),
        "initial": BrakeStart(),
        "reference": FixedSlip(),
        "controller": PID(),
        "stop": Standstill(),
    }
    return Loop(**{**usual, **parts})


def balancing(**parts: Any) -> Loop:
    """Return the two-wheeler upright under state feedback until it falls, with `parts` in place of its own."""
    usual = {
        "plant": ArmBalance(),
        "initial": BalanceStart(),
        "reference": Upright(),
        "controller": BalanceFeedback(),
        "actuator": VoltageLimit(),
        "stop": Fallen(),
    }
    return Loop(**{**usual, **parts})


USUAL = {BrakeOutput: braking, BalanceOutput: balancing}


def around(plant: Plant) -> Loop:
    """Return the usual loop around a plant, by what it shows. Raises KeyError for an output that no loop here reads."""
    return USUAL[plant.shows](plant=plant)
