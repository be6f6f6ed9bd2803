"""A driver who steers against a side wind, a slope or unequal brakes: the car stays near a line along the road.

    steer angle = -clamp(k (y - line + p sin(yaw)), -full, full)

y + p sin(yaw) is the lateral position of a point p ahead of the car. Plant and actuator have the lags of steering.

Source: R. Rajamani, Vehicle Dynamics and Control, 2nd ed., sec. 3.5, for the look-ahead point.
"""

import jax.numpy as jnp

from diffabs.core.blocks import ChangedCommand
from diffabs.core.numerics import clamp
from diffabs.core.protocols import Block, Tracking
from diffabs.core.pytree import param, part, pytree
from diffabs.core.types import PyTree, Scalar
from diffabs.parts.controllers.per_channel import PerChannel


@pytree
class HoldCourse(ChangedCommand):
    """The commands of a controller of the brakes, and the steer angle of a driver who holds a line along the road.

    The plant needs the control `steer_angle` and the outputs `lateral_position` and `yaw`, as `plants.Car` has them.

    >>> from diffabs.parts.controllers import HoldCourse
    >>> from diffabs.parts.plants import Car
    >>> Car().usual_parts()["controller"].preview
    15.0
    """

    controller: Block = part(default=PerChannel)
    """Controller of the brakes."""
    gain: Scalar = param(default=0.03, unit="rad/m", low=0.0)
    """Steer angle k per lateral distance of the point ahead; 0 for hands off the wheel."""
    preview: Scalar = param(default=15.0, unit="m", low=0.0)
    """Distance p of this point."""
    line: Scalar = param(default=0.0, unit="m")
    """Lateral position of the line, to the left of the start."""
    full_angle: Scalar = param(default=0.5, unit="rad", above=0.0)
    """Lock of the front wheels, the greatest steer angle; 458 degrees at the steering wheel with a ratio of 16."""

    def change(self, t: Scalar, command: PyTree, signal: Tracking) -> PyTree:
        """Return the commands with the driver's steer angle [rad]."""
        del t
        ahead = signal.measured.lateral_position - self.line + self.preview * jnp.sin(signal.measured.yaw)
        return command._replace(steer_angle=-clamp(self.gain * ahead, -self.full_angle, self.full_angle))
