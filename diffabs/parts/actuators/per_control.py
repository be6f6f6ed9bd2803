"""Actuators of several controls."""

from collections.abc import Iterator

from diffabs.core.blocks import Parallel, find_unnamed
from diffabs.core.channels import select_channel
from diffabs.core.protocols import Block
from diffabs.core.pytree import part, pytree
from diffabs.core.types import PyTree, Scalar
from diffabs.core.units import Units


@pytree
class PerControl(Parallel):
    """An actuator for each of several controls, by the control's name; other commands pass unchanged.

    >>> from diffabs.parts.actuators import Lag, Limits, PerControl
    >>> pumps = PerControl(actuator={"pump_1": Lag(time_constant=0.5), "pump_2": Limits(low=0.0, high=10.0)})
    """

    actuator: dict[str, Block] = part(default=dict, named=True)
    """Actuator of each control."""

    def by_channel(self) -> dict[str, Block]:
        """Return the actuator of each control, in alphabetical order: JAX rebuilds a dictionary with sorted keys."""
        return dict(sorted(self.actuator.items()))

    def select(self, name: str, signal: PyTree) -> Scalar:
        """Return the command of a control."""
        return select_channel(signal, name)

    def join(self, signal: PyTree, outputs: dict[str, PyTree]) -> PyTree:
        """Return the controls."""
        return signal._replace(**outputs)

    def units_inside(self, name: str, units: Units) -> Units:
        """Return the units of a control's actuator, from those of the loop."""
        return units.of_channel(name, "")

    def problems(self) -> Iterator[str]:
        """Yield a line if there is no actuator, or one without a name."""
        yield from find_unnamed("actuator", self.actuator, '{"pump_1": Lag()}')
