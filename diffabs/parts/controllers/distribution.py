"""Brake distribution: one command for the brakes of both axles.

    front: f u        rear: r - (1 - valve_ratio) max(r - knee, 0),  r = (1 - f) u

u is the command of all brakes and f the share of the front axle. A pressure-proportioning valve bends the rear axle's
torque at the knee. Both axles of a car use the adhesion mu alike for

    f = (b + mu h)/(a + b),

with the distances a and b from the centre of gravity to the front and the rear axle, and its height h. The ideal share
rises with mu, so a fixed one is too great for one road and too small for another: the axle with too much brakes less
than its load allows, or locks first.

Source: R. Limpert, Brake Design and Safety, 3rd ed., ch. 7.
"""

from collections.abc import Iterator

from diffabs.core.blocks import Parallel
from diffabs.core.channels import select_channel, select_output
from diffabs.core.numerics import larger
from diffabs.core.protocols import Block, Tracking
from diffabs.core.pytree import param, part, pytree, static
from diffabs.core.types import PyTree, Scalar
from diffabs.core.units import Units
from diffabs.parts.controllers.per_channel import check_group
from diffabs.parts.controllers.pid import PID

WHOLE = "controller"


@pytree
class BrakeDistribution(Parallel):
    """One controller for all brakes: each axle gets a share of its command, in equal parts for the brakes of the axle.

    See also:
        `controllers.PerChannel`: A controller for each brake.

    Notes:
        The controller sees the target and the output `controlled`, and the sum of the feed-forwards of all brakes. A
        `ConstantTorque` or a `PlayedCommand` is a pedal without anti-lock brakes. With a `valve_ratio` of 1 there is no
        valve.

    Examples:
        >>> from diffabs.parts.controllers import BrakeDistribution, ConstantTorque
        >>> pedal = BrakeDistribution(controller=ConstantTorque(torque=3000.0), knee=800.0, valve_ratio=0.3)
        >>> front, rear = pedal.split(3000.0)
        >>> print(f"{front:.0f} and {rear:.0f} N m")
        1980 and 866 N m
    """

    controller: Block = part(default=PID)
    """Controller of all brakes."""
    front_share: Scalar = param(default=0.66, unit="1", low=0.0, high=1.0)
    """Share f of the front axle."""
    knee: Scalar = param(default=500.0, unit="N m", low=0.0)
    """Torque of the rear axle at which the valve begins to act."""
    valve_ratio: Scalar = param(default=1.0, unit="1", low=0.0, high=1.0)
    """Rise of the rear axle's torque above the knee, relative to the one below."""
    controlled: str = static(default="front_slip")
    """Output that the controller controls."""
    front: tuple[str, ...] = static(default=("front_brake",))
    """Names of the controls of the front axle."""
    rear: tuple[str, ...] = static(default=("rear_brake",))
    """Names of the controls of the rear axle."""

    def split(self, command: Scalar) -> tuple[Scalar, Scalar]:
        """Return the torques of the front and of the rear axle [N m]."""
        rear = (1 - self.front_share) * command
        return self.front_share * command, rear - (1 - self.valve_ratio) * larger(rear - self.knee, 0.0)

    def by_channel(self) -> dict[str, Block]:
        """Return the controller of all brakes."""
        return {WHOLE: self.controller}

    def select(self, name: str, signal: Tracking) -> Tracking:
        """Return the input of the controller."""
        del name
        brakes = (*self.front, *self.rear)
        check_group("front, rear", brakes, signal.feedforward)
        units = type(signal.feedforward).units
        if unbraked := [name for name in units if name not in brakes and units[name] == units[brakes[0]]]:
            raise ValueError(f"front, rear: {', '.join(unbraked)} [{units[brakes[0]]}] is in neither list")
        return Tracking(
            select_channel(signal.target, self.controlled),
            select_output(signal.measured, self.controlled),
            sum(select_channel(signal.feedforward, brake) for brake in brakes),
        )

    def join(self, signal: Tracking, outputs: dict[str, PyTree]) -> PyTree:
        """Return the torques of all brakes; other controls get their feed-forward."""
        torques = {
            brake: torque / len(axle)
            for axle, torque in zip((self.front, self.rear), self.split(outputs[WHOLE]), strict=True)
            for brake in axle
        }
        return signal.feedforward._replace(**torques)

    def units_inside(self, name: str, units: Units) -> Units:
        """Return the units of the controller, from those of the loop."""
        del name
        return units.of_channel(next(iter(self.front), ""), self.controlled)

    def problems(self) -> Iterator[str]:
        """Yield a line for an axle without controls, one name in place of a list, or a control of both axles."""
        for field in ("front", "rear"):
            names = getattr(self, field)
            if isinstance(names, str) or not names:
                yield f'{field} = {names!r} is no list of names; one is needed, such as ["{field}_brake"]'
            elif repeated := sorted({name for name in names if names.count(name) > 1}):
                yield f"{field} has {', '.join(repeated)} twice"
        if both := sorted({*self.front} & {*self.rear}):
            yield f"front and rear have {', '.join(both)} both; each control belongs to one axle"
