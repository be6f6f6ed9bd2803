"""Cascade control: the command of an outer controller is the target of an inner one.

    r_inner = outer(target, measured)            in the unit of the inner signal
    u       = inner(r_inner, measured) + ff      in the unit of the control

The outer controller follows the plant's first signal, the inner one another signal, which the control moves faster: the
speed of a position drive, the current of a motor. Each has limits and an anti-windup of its own. The outer limits bound
the inner target: with limits that the inner loop can follow, the outer integral does not wind up.

Source: Astrom and Hagglund, PID Controllers, 2nd ed., sec. 7.2 (cascade control).
"""

from collections.abc import Iterator

from diffabs.core.blocks import offers
from diffabs.core.channels import put_first
from diffabs.core.protocols import Memory, Tracking
from diffabs.core.pytree import part, pytree, static
from diffabs.core.types import Part, PyTree, Scalar
from diffabs.core.units import Units
from diffabs.parts.controllers.pid import PID

CASCADED = ("outer", "inner")


@pytree
class Cascade:
    """u = inner(target = outer(target, measured), measured), where `inner` follows the signal `inner_signal`.

    Both are controllers with a flow, such as PID. For a computer, wrap the cascade in `Sampled`.
    """

    outer: Part = part(default=PID)
    """Controller of the plant's first signal; its gains are in units of the inner signal."""
    inner: Part = part(default=PID)
    """Controller of the inner signal; the loop's feed-forward is added to its command."""
    inner_signal: str = static(default="")
    """Name of the plant's output that the inner controller follows; empty for the second one."""

    def start(self, signal: Tracking) -> Memory:
        """Return the memories of both controllers, the inner one started on the outer one's command."""
        outer = self.outer.start(self._outer_signal(signal))
        inner = self.inner.start(self._inner_signal(0.0, outer, signal))
        return Memory((outer.flow, inner.flow), (outer.held, inner.held))

    def flow(self, t: Scalar, memory: Memory, signal: Tracking) -> tuple[PyTree, ...]:
        """Return the rates of both memories."""
        outer, inner = self._memories(memory)
        rate = self.outer.flow(t, outer, self._outer_signal(signal))
        return rate, self.inner.flow(t, inner, self._inner_signal(t, outer, signal))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the inner controller's command, in the plant's unit."""
        outer, inner = self._memories(memory)
        return self.inner.output(t, inner, self._inner_signal(t, outer, signal))

    def limits(self) -> tuple[Scalar, Scalar]:
        """Return the limits of the inner controller."""
        return self.inner.limits()

    def units_inside(self, name: str, units: Units) -> Units:
        """Return the units of the outer or the inner controller, from those of the loop."""
        outputs = dict(units.outputs)
        inner = outputs.get(_inner_name(self.inner_signal, tuple(outputs)), "1") if outputs else "1"
        return units._replace(control=inner) if name == "outer" else units._replace(signal=inner)

    def problems(self) -> Iterator[str]:
        """Yield a line for a controller with ticks, events or a record, or without limits."""
        for name in CASCADED:
            controller = getattr(self, name)
            if offers(controller, "tick", "margins", "record"):
                yield (
                    f"{name} = {type(controller).__name__} computes at instants; a cascade takes controllers with a"
                    " flow, such as PID: wrap the cascade in Sampled"
                )
        if not hasattr(self.inner, "limits"):
            yield f"inner = {type(self.inner).__name__} has no limits(): the limits of the control are unknown"

    def _memories(self, memory: Memory) -> list[Memory]:
        return [Memory(flow, held) for flow, held in zip(memory.flow, memory.held, strict=True)]

    def _outer_signal(self, signal: Tracking) -> Tracking:
        return signal._replace(feedforward=0.0 * signal.feedforward)  # a feed-forward is in the unit of the control

    def _inner_signal(self, t: Scalar, outer: Memory, signal: Tracking) -> Tracking:
        """Return the input of the inner controller: the measured signals, its own first."""
        names = type(signal.measured)._fields
        name = _inner_name(self.inner_signal, names)
        if name not in names:
            raise ValueError(f"controller.inner_signal = {name} is no output of the plant; there is {', '.join(names)}")
        measured = put_first(signal.measured, name)
        return Tracking(self.outer.output(t, outer, self._outer_signal(signal)), measured, signal.feedforward)


def _inner_name(name: str, names: tuple[str, ...]) -> str:
    """Return the name of the inner signal: the given one, or the second of the plant's outputs."""
    return name or names[min(1, len(names) - 1)]
