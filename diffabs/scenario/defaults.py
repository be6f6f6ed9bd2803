"""The usual loops, from which a scenario or an example starts: a braking car, a balanced two-wheeler."""

from typing import Any

from diffabs.core.loop import Loop
from diffabs.plants import ArmBalance, QuarterCar


def braking(**parts: Any) -> Loop:
    """Return a quarter car under a PID that holds a fixed slip until standstill, with `parts` in place of its own."""
    return Loop(**{"plant": QuarterCar(), **QuarterCar().usual_parts(), **parts})


def balancing(**parts: Any) -> Loop:
    """Return the two-wheeler upright under state feedback until it falls, with `parts` in place of its own."""
    return Loop(**{"plant": ArmBalance(), **ArmBalance().usual_parts(), **parts})
