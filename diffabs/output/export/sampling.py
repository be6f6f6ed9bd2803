"""A continuous controller in the sampled form that a computer's program has."""

import dataclasses

from diffabs.core.units import units_of
from diffabs.core.validity import find_problems
from diffabs.loop.closed_loop import Loop
from diffabs.parts.controllers import Sampled, SampledOnGrid


def sample_controller(loop: Loop, period: float) -> Loop:
    """Return a loop whose continuous controller is evaluated every `period` [s].

    Args:
        loop: Loop with a continuous controller.
        period: Sampling period [s].

    Raises:
        ValueError: The controller is sampled already, or cannot have this period.

    Examples:
        >>> import diffabs as d
        >>> from diffabs.output.export import sample_controller
        >>> sample_controller(d.braking(), 1e-3).controller.period
        0.001
    """
    if isinstance(loop.controller, Sampled | SampledOnGrid):
        raise ValueError("the controller is sampled; it has a period of its own")
    controller = Sampled(controller=loop.controller, period=period)
    if lines := list(find_problems(controller, "controller.", units_of(loop.plant))):
        raise ValueError("; ".join(lines))
    return dataclasses.replace(loop, controller=controller)
