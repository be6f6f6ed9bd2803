"""The Lorenz system as a plant: its start needs no description, and it moves from there."""

from types import MappingProxyType
from typing import Any, NamedTuple

import diffabs as d
from diffabs import controllers, references, stops
from diffabs.core.pytree import param, pytree


class Place(NamedTuple):
    x: Any
    y: Any
    z: Any
    units = MappingProxyType({"x": "1", "y": "1", "z": "1"})


@pytree
class Lorenz:
    """From (1, 0, 0); the control has no effect."""

    rho: Any = param(default=21.0, unit="1")
    shows, control_unit = Place, "1"
    project = output = lambda self, state: state

    def start(self, initial):
        return Place(1.0 + 0.0 * self.rho, 0.0 * self.rho, 0.0 * self.rho)

    def derivative(self, t, state, control):
        x, y, z = state
        return Place(10.0 * (y - x), x * (self.rho - z) - y, x * y - 8 / 3 * z)

    def holding(self, output, target):
        return 0.0 * target


LOOP = d.Loop(
    plant=Lorenz(),
    initial=(),
    reference=references.Setpoint(value=0.0),
    controller=controllers.ConstantTorque(torque=0.0),
    stop=stops.NoStop(),
)
