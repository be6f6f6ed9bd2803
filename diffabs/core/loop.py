"""One hybrid closed loop: plant, sensor, reference, feed-forward, controller, actuator, and when it ends.

    between instants   dz/dt = flow(t, z; held)         z: plant state and the blocks' continuous memories
    at instants        (z, held) -> change(z, held)     sensor, reference, controller, actuator, in this order

An instant is a tick of a clock, or an event: a margin of a block falls through zero.

A `Loop` is one pytree: every parameter of every part is a leaf with a dotted path, `loop.plant.road.scale`.
"""

from collections.abc import Callable
from functools import cache, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.blocks import Direct, NoFeedforward, Passage, next_tick, offers, record_signal
from diffabs.core.protocols import (
    Block,
    Clock,
    Feedforward,
    Memory,
    Plant,
    Reference,
    Sample,
    Stop,
    Tracking,
    no_flow,
)
from diffabs.core.pytree import Scalar, part, parts, pytree


class LoopState(NamedTuple):
    """Plant state and the memories of the blocks."""

    plant: Any
    sensor: Memory
    reference: Memory
    controller: Memory
    actuator: Memory

    def flow(self) -> tuple[Any, ...]:
        """What is integrated."""
        return (self.plant, *(m.flow for m in self[1:]))

    def with_flow(self, flow: tuple[Any, ...]) -> "LoopState":
        """The same held memories with other continuous ones."""
        return LoopState(flow[0], *(m._replace(flow=f) for m, f in zip(self[1:], flow[1:], strict=True)))


class Signals(NamedTuple):
    """Every signal of the loop at an instant; once more, by the name of the block, those that a block records."""

    sample: Sample
    measured: Any
    tracking: Tracking
    recorded: dict[str, Any]


Margins = dict[str, tuple[Any, ...]]  # of the stop and of each block that has events, by name
BLOCKS = ("sensor", "reference", "controller", "actuator")


@pytree
class Loop:
    """Plant and controller with what is around them."""

    plant: Plant = part()
    initial: Any = part()
    sensor: Block = part(default=Direct)
    reference: Reference = part()
    feedforward: Feedforward = part(default=NoFeedforward)
    controller: Block = part()
    actuator: Block = part(default=Direct)
    stop: Stop = part()

    def start(self) -> LoopState:
        """State at t = 0, before the first tick."""
        x = self.plant.start(self.initial)
        y = self.plant.output(x)
        sensor = self.sensor.start(y)
        measured = self.sensor.output(0.0, sensor, y)
        reference = self.reference.start(measured)
        tracking = self._tracking(0.0, reference, measured)
        controller = self.controller.start(tracking)
        actuator = self.actuator.start(self.controller.output(0.0, controller, tracking))
        return LoopState(x, sensor, reference, controller, actuator)

    def signals(self, t: Scalar, state: LoopState) -> Signals:
        """Follow the signal once around the loop."""
        y = self.plant.output(state.plant)
        measured = self.sensor.output(t, state.sensor, y)
        tracking = self._tracking(t, state.reference, measured)
        command = self.controller.output(t, state.controller, tracking)
        control = self.actuator.output(t, state.actuator, command)
        setpoint = self.reference.setpoint(state.reference)
        sample = Sample(t, y, tracking.target, setpoint, tracking.feedforward, command, control)
        given = _block_inputs(Signals(sample, measured, tracking, {}))
        kept = {
            name: record_signal(getattr(self, name), t, getattr(state, name), given[name]) for name in self.recorders
        }
        return Signals(sample, measured, tracking, kept)

    def flow(self, t: Scalar, state: LoopState, signals: Signals) -> tuple[Any, ...]:
        """d(state.flow())/dt, from the signals at (t, state)."""
        sample, measured, tracking, _ = signals
        return (
            self.plant.derivative(t, state.plant, sample.control),
            self.sensor.flow(t, state.sensor, sample.output),
            self.reference.flow(t, state.reference, measured),
            self.controller.flow(t, state.controller, tracking),
            self.actuator.flow(t, state.actuator, sample.command),
        )

    @property
    def changes(self) -> bool:
        """Whether a block has ticks or events."""
        return any(offers(getattr(self, name)) for name in BLOCKS)

    @property
    def ticks(self) -> bool:
        """Whether a block has ticks."""
        return any(offers(getattr(self, name), "tick") for name in BLOCKS)

    def next_tick(self, k: Any, h: Scalar) -> Any:
        """The number of the first instant after the k-th of a grid of step h [s] at which a block ticks."""
        blocks = (getattr(self, name) for name in BLOCKS)
        return reduce(jnp.minimum, (next_tick(block, k, h) for block in blocks if offers(block, "tick")))

    @property
    def eventful(self) -> bool:
        """Whether a block has events."""
        return any(offers(getattr(self, name), "margins") for name in BLOCKS)

    @property
    def jumps(self) -> bool:
        """Whether a rate in the flow jumps where a comparison changes, as a part of the loop says."""
        return any(_jumps(getattr(self, name)) for name in ("plant", *BLOCKS))

    @property
    def recorders(self) -> tuple[str, ...]:
        """The blocks that record their signal, by name."""
        return tuple(name for name in BLOCKS if offers(getattr(self, name), "record"))

    def margins(self, t: Scalar, state: LoopState, signals: Signals, flow: Callable[[], Any]) -> Margins:
        """The stop's margin and those of the blocks; `flow()` is d(state.flow())/dt, for those that need a rate."""
        rates = cache(lambda: _block_inputs(self.signal_rates(t, state, flow())))
        seen = _block_inputs(signals)

        def of(name: str) -> tuple[Any, ...]:
            return getattr(self, name).margins(t, getattr(state, name), seen[name], lambda: rates()[name])

        found = {name: of(name) for name in BLOCKS if offers(getattr(self, name), "margins")}
        return {"stop": (self.stop.margin(signals.sample.output),), **found}

    def change(
        self,
        clock: Clock,
        state: LoopState,
        before: Signals,
        margins: Margins,
        fired: Margins,
        passed: dict[str, Passage] | None = None,
    ) -> LoopState:
        """The state after an instant: each block, in the order of the signal, has its events, records the step that
        ends here, and has its tick.

        before, margins: those until now. An event also happens where the change of a block before it makes a margin
            negative, at either end of the jump of the signal and with the jump for a rate: a maximum is where it falls
        fired: a bool for each margin, whether it has just fallen through zero
        passed: the step that ends here, for the blocks that record it; none does at the start of a run
        """
        was, moved = _block_inputs(before), False

        def changed(name: str, signal: Any) -> Memory:
            nonlocal state, moved
            block, memory = getattr(self, name), getattr(state, name)
            if name in fired:
                happens = fired[name]
                if moved:
                    jump = jax.tree.map(jnp.subtract, signal, was[name])
                    ends = (block.margins(clock.t, memory, end, lambda: jump) for end in (was[name], signal))
                    crossed = zip(happens, margins[name], *ends, strict=True)
                    happens = tuple(one | ((a >= 0) & ((b < 0) | (c < 0))) for one, a, b, c in crossed)
                memory = block.event(clock.t, memory, was[name], happens)
            if passed and name in passed:
                memory = block.record(memory, passed[name])
            if offers(block, "tick"):
                memory = block.tick(clock._replace(before=was[name]), memory, signal)
            moved = moved or offers(block)
            state = state._replace(**{name: memory})
            return memory

        t, y = clock.t, before.sample.output
        measured = self.sensor.output(t, changed("sensor", y), y)
        tracking = self._tracking(t, changed("reference", measured), measured)
        command = self.controller.output(t, changed("controller", tracking), tracking)
        changed("actuator", command)
        return state

    def signal_rates(self, t: Scalar, state: LoopState, flow: Any) -> Signals:
        """d(signals)/dt where nothing jumps and d(state.flow())/dt is `flow`."""
        moves = (jnp.ones_like(jnp.asarray(t)), flow)
        return jax.jvp(lambda t, z: self.signals(t, state.with_flow(z)), (jnp.asarray(t), state.flow()), moves)[1]

    def _tracking(self, t: Scalar, reference: Memory, measured: Any) -> Tracking:
        target = self.reference.output(t, reference, measured)
        setpoint = self.reference.setpoint(reference)
        return Tracking(target, measured, self.feedforward.input(self.plant, measured, setpoint))


def _jumps(one: Any) -> bool:
    """Whether a part says so, or one in it; of a block without a flow nothing is integrated."""
    if getattr(type(one), "flow", None) is no_flow:
        return False
    return getattr(one, "jumps", False) or any(map(_jumps, parts(one)))


def _block_inputs(signals: Signals) -> dict[str, Any]:
    """What each block is given."""
    sample, measured, tracking, _ = signals
    return {"sensor": sample.output, "reference": measured, "controller": tracking, "actuator": sample.command}


def run_signals(sample: Sample, plant: Plant) -> dict[str, tuple[str, Any]]:
    """Unit and values of what is kept of a run, by name: time, all that the plant shows, target, command, control."""
    units = plant.shows.units
    shown = {name: (units[name], values) for name, values in sample.output._asdict().items()}
    asked = {"target": (units[sample.output._fields[0]], sample.target)}
    given = {name: (plant.control_unit, getattr(sample, name)) for name in ("command", "control")}
    return {"t": ("s", sample.t), **shown, **asked, **given}
