"""Controllers for plants with several inputs, made of controllers for one.

A channel is a control with the output that it controls. The controller of a channel sees target, feed-forward and
command of its channel as numbers, and the output that it controls as the first one.
"""

from collections.abc import Iterator, Mapping
from functools import reduce
from typing import Any

from diffabs.core.blocks import ChangedCommand, Parallel
from diffabs.core.channels import Channels, select_channel, select_tracking
from diffabs.core.numerics import smaller
from diffabs.core.protocols import Block, Tracking
from diffabs.core.pytree import part, pytree, static
from diffabs.core.types import PyTree, Scalar
from diffabs.core.units import Units
from diffabs.parts.controllers.pid import PID


@pytree
class PerChannel(Parallel):
    """One controller for each control: the same one for all, or one for each by name.

    See also:
        `actuators.PerControl`: An actuator for each control.
        `references.PerTarget`: A reference for each target.
        `objectives.InChannel`: Metrics of one channel.

    Notes:
        `channels` gives for each control of the plant (`plant.controls`) the output that it controls; a control without
        a channel gets its feed-forward alone. With a single
        controller all channels have the same gains, but memories of their own: its parameters are at
        `controller.controller.kp`. With one for each control they are at `controller.pump_1.kp`.

    Examples:
        >>> from diffabs.parts.controllers import PID, PerChannel
        >>> channels = {"pump_1": "level_1", "pump_2": "level_2"}
        >>> same = PerChannel(PID(kp=3.0, ki=0.1), channels)
        >>> each = PerChannel({"pump_1": PID(kp=3.0), "pump_2": PID(kp=2.7)}, channels)
        >>> each.controller["pump_2"].kp
        2.7
    """

    controller: Block | dict[str, Block] = part(default=PID, named=True)
    """Controller of all channels, or a controller for each control by name."""
    channels: Channels = static(default=Channels({}))
    """Output that each control controls."""

    def __init__(
        self, controller: Block | Mapping[str, Block] | None = None, channels: Mapping[str, str] | None = None
    ):
        """Take a controller, or controllers by control, and the output of each control."""
        # JAX rebuilds parts with placeholders in place of controllers, so only a mapping is changed.
        controller = PID() if controller is None else controller
        object.__setattr__(self, "controller", dict(controller) if isinstance(controller, Mapping) else controller)
        object.__setattr__(self, "channels", Channels(channels or {}))

    def by_channel(self) -> dict[str, Any]:
        """Return the controller of each control."""
        controllers: Any = self.controller
        return {name: controllers[name] if isinstance(controllers, dict) else controllers for name in self.channels}

    def select(self, name: str, signal: Tracking) -> Tracking:
        """Return the input of a control's controller."""
        return select_tracking(signal, name, self.channels[name])

    def join(self, signal: Tracking, outputs: dict[str, PyTree]) -> PyTree:
        """Return the commands of all controls."""
        return signal.feedforward._replace(**outputs)

    def units_inside(self, name: str, units: Units) -> Units:
        """Return the units of a control's controller, from those of the loop."""
        return units.of_channel(name, self.channels.get(name, ""))

    def problems(self) -> Iterator[str]:
        """Yield a line for channels without controller, controllers without channel, or no channel at all."""
        if not self.channels:
            yield 'channels = {} is empty; the output of each control is needed, such as {"pump_1": "level_1"}'
        if isinstance(self.controller, dict) and self.controller.keys() != self.channels.keys():
            yield f"channels has {', '.join(self.channels)}; there are controllers of {', '.join(self.controller)}"


@pytree
class SelectLow(ChangedCommand):
    """The commands of a controller, with the least one of each group for all controls of the group.

    Two wheels of an axle then brake like the one with less grip.
    """

    controller: Block = part(default=PerChannel)
    """Controller of all controls."""
    groups: tuple[tuple[str, ...], ...] = static(default=())
    """Names of the controls that get one command, for each group."""

    def change(self, t: Scalar, command: PyTree, signal: Tracking) -> PyTree:
        """Return the commands, with the least one in each group."""
        del t, signal
        for group in self.groups:
            check_group("groups", group, command)
            lowest = reduce(smaller, (select_channel(command, name) for name in group))
            command = command._replace(**dict.fromkeys(group, lowest))
        return command

    def problems(self) -> Iterator[str]:
        """Yield a line for a group that is no list of names, or an empty one."""
        needed = 'lists of names are needed, such as [["left", "right"]]'
        for group in self.groups:
            if isinstance(group, str):
                yield f"groups: {group} is one name; {needed}"
            elif not group:
                yield f"groups: a group is empty; {needed}"


def check_group(field: str, group: tuple[str, ...], command: Any) -> None:
    """Raise ValueError for a name that is no control, or for controls with different units; `field` has the names."""
    controls = getattr(command, "_fields", ())
    if unknown := [name for name in group if name not in controls]:
        offered = f"there is {', '.join(controls)}" if controls else "the plant has a single control without a name"
        raise ValueError(f"{field}: there is no control {', '.join(unknown)}; {offered}")
    units = {name: type(command).units[name] for name in group}
    if len({*units.values()}) > 1:
        named = ", ".join(f"{name} [{unit}]" for name, unit in units.items())
        raise ValueError(f"{field}: {named} have different units; they cannot have one command")
