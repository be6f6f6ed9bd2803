"""Two rooms with a wall between them, and a heater in each.

C T1' = P1 - (T1 - Ta)/R - (T1 - T2)/W,   C T2' = P2 - (T2 - Ta)/R - (T2 - T1)/W
"""

from types import MappingProxyType
from typing import NamedTuple

from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar
from diffabs.parts.actuators import Limits, PerControl
from diffabs.parts.controllers import PID, BackCalculation, HoldingInput, PerChannel
from diffabs.parts.objectives import IAE, InChannel, Overshoot
from diffabs.parts.references import PerTarget, Setpoint
from diffabs.parts.stops import NoStop

CHANNELS = {"heater_1": "room_1", "heater_2": "room_2"}


class Rooms(NamedTuple):
    """Outputs: both temperatures, and both have a target."""

    room_1: Scalar
    room_2: Scalar

    units = MappingProxyType({"room_1": "degC", "room_2": "degC"})
    tracked = ("room_1", "room_2")


class Heaters(NamedTuple):
    """Controls: the power of each heater."""

    heater_1: Scalar
    heater_2: Scalar

    units = MappingProxyType({"heater_1": "W", "heater_2": "W"})


@pytree
class RoomsStart:
    """Temperatures at t = 0."""

    room_1: Scalar = param(default=15.0, unit="degC")
    room_2: Scalar = param(default=15.0, unit="degC")


@pytree
class TwoRooms:
    """Two rooms of heat capacity C behind outer walls R and an inner wall W."""

    capacity: Scalar = param(default=2e5, unit="J/K", above=0.0)
    outer: Scalar = param(default=0.02, unit="K/W", above=0.0)
    inner: Scalar = param(default=0.01, unit="K/W", above=0.0)
    ambient: Scalar = param(default=5.0, unit="degC")

    shows = Rooms
    controls = Heaters

    def start(self, initial):
        return Rooms(initial.room_1, initial.room_2)

    def derivative(self, t, state, control):
        lost = self.lost(state)
        return Rooms(
            (control.heater_1 - lost.room_1) / self.capacity,
            (control.heater_2 - lost.room_2) / self.capacity,
        )

    def lost(self, rooms):
        """Return the heat that leaves each room [W]."""
        across = (rooms.room_1 - rooms.room_2) / self.inner
        return Rooms(
            (rooms.room_1 - self.ambient) / self.outer + across,
            (rooms.room_2 - self.ambient) / self.outer - across,
        )

    def project(self, state):
        return state

    def output(self, state):
        return state

    def holding(self, output, target):
        return Heaters(*self.lost(target))

    def usual_parts(self):
        gains = PID(
            kp=400.0, ki=0.5, cutoff=0.05, low=0.0, high=3000.0, antiwindup=BackCalculation(tracking_time=300.0)
        )
        return {
            "initial": RoomsStart(),
            "reference": PerTarget(reference={"room_1": Setpoint(value=21.0), "room_2": Setpoint(value=18.0)}),
            "feedforward": HoldingInput(),
            "controller": PerChannel({"heater_1": gains, "heater_2": gains}, CHANNELS),
            "actuator": PerControl(actuator={name: Limits(low=0.0, high=3000.0) for name in CHANNELS}),
            "stop": NoStop(),
        }

    def usual_objectives(self):
        metrics = {"iae": IAE(), "overshoot": Overshoot()}
        return {
            f"{metric}_{output}": InChannel(objective=objective, control=control, output=output)
            for control, output in CHANNELS.items()
            for metric, objective in metrics.items()
        }
