"""Targets of several outputs, each from a reference of its own."""

from collections.abc import Iterator

from diffabs.core.blocks import Parallel, find_unnamed
from diffabs.core.channels import select_output
from diffabs.core.messages import named_tuple
from diffabs.core.protocols import Memory, Reference
from diffabs.core.pytree import part, pytree
from diffabs.core.types import PyTree
from diffabs.core.units import Units


@pytree
class PerTarget(Parallel):
    """A reference for each of several outputs, by the output's name: the target has a field for each.

    The names are those in `tracked` of the plant's output type; the target has them in alphabetical order. A reference
    sees the measured outputs with its own first.

    >>> from diffabs.parts.references import PerTarget, Setpoint
    >>> levels = PerTarget(reference={"level_1": Setpoint(value=0.12), "level_2": Setpoint(value=0.13)})
    """

    reference: dict[str, Reference] = part(default=dict, named=True)
    """Reference of each output."""

    def by_channel(self) -> dict[str, Reference]:
        """Return the reference of each output, in alphabetical order: JAX rebuilds a dictionary with sorted keys."""
        return dict(sorted(self.reference.items()))

    def select(self, name: str, signal: PyTree) -> PyTree:
        """Return the measured outputs with this one first."""
        return select_output(signal, name)

    def join(self, signal: PyTree, outputs: dict[str, PyTree]) -> PyTree:
        """Return the targets."""
        del signal
        return self._target(outputs)

    def setpoint(self, memory: Memory) -> PyTree:
        """Return the final values of the targets."""
        return self._target({name: reference.setpoint(m) for name, reference, m in self._each(memory)})

    def _target(self, values: dict[str, PyTree]) -> PyTree:
        return named_tuple("Target", tuple(values))(**values)

    def units_inside(self, name: str, units: Units) -> Units:
        """Return the units of an output's reference, from those of the loop."""
        return units.of_channel("", name)

    def problems(self) -> Iterator[str]:
        """Yield a line if there is no reference, or one without a name."""
        yield from find_unnamed("reference", self.reference, '{"level_1": Setpoint()}')
