"""The usual loops, from which a scenario or an example starts: a braking car, a balanced two-wheeler."""

from typing import Any

from diffabs.core.loop import Loop
from diffabs.plants import ArmBalance, QuarterCar


def braking(**parts: Any) -> Loop:
    """Return a quarter car under a PID that holds a fixed slip until standstill.

    Args:
        **parts: Parts of the loop by field, in place of the usual ones.
    """
    return Loop(**{"plant": QuarterCar(), **QuarterCar().usual_parts(), **parts})


def balancing(**parts: Any) -> Loop:
    """Return the two-wheeler upright under state feedback until it falls.

    Args:
        **parts: Parts of the loop by field, in place of the usual ones.
    """
    return Loop(**{"plant": ArmBalance(), **ArmBalance().usual_parts(), **parts})
