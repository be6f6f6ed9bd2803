"""A loop that compiles in a moment: x' = u - rate x under a constant u, from rest: x(t) = u/rate (1 - exp(-rate t))."""

from typing import Any, NamedTuple

from shown_state import ShownState

import diffabs as d
from diffabs import controllers, references, stops
from diffabs.core.pytree import param, pytree


class Place(NamedTuple):
    """[m]"""

    x: Any

    units = {"x": "m"}  # noqa: RUF012  # as every output has it


@pytree
class Decay(ShownState):
    """x' = u - rate x."""

    rate: Any = param(default=1.0, unit="1/s", above=0.0)
    shows, control_unit = Place, "m/s"

    def start(self, initial: Any) -> Place:
        return Place(0.0 * self.rate)

    def derivative(self, t: Any, state: Place, control: Any) -> Place:
        return Place(control - self.rate * state.x)


def decay_loop(rate: Any = 1.0) -> d.Loop:
    return d.Loop(
        plant=Decay(rate=rate), initial=(), reference=references.Setpoint(value=0.0),
        controller=controllers.ConstantTorque(torque=1.0), stop=stops.NoStop(),
    )  # fmt: skip
