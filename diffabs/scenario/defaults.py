"""The usual loops, from which a scenario or an example starts: a braking car, a balanced two-wheeler."""

from diffabs.core.types import Part
from diffabs.loop.closed_loop import Loop
from diffabs.parts.plants import ArmBalance, QuarterCar


def braking(**parts: Part) -> Loop:
    """Return a loop of a quarter car, with PID control of the slip at a fixed target until standstill.

    Args:
        **parts: Parts of the loop by field, in place of the usual ones.
    """
    return Loop(**{"plant": QuarterCar(), **QuarterCar().usual_parts(), **parts})


def balancing(**parts: Part) -> Loop:
    """Return a loop of the two-wheeler, which state feedback keeps upright; the run ends early if it falls.

    Args:
        **parts: Parts of the loop by field, in place of the usual ones.
    """
    return Loop(**{"plant": ArmBalance(), **ArmBalance().usual_parts(), **parts})
