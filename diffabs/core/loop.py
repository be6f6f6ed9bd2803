"""One hybrid closed loop: plant, sensor, reference, feed-forward, controller, actuator, and when it ends.

    between instants   dz/dt = flow(t, z; held)      z: plant state and the blocks' continuous memories
    at instants        (z, held) -> jump(z, held)    sensor, reference, controller, actuator, in this order

A `Loop` is one pytree: every parameter of every part is a leaf with a dotted path, `loop.plant.road.scale`.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.blocks import Direct, NoFeedforward
from diffabs.core.protocols import Block, Clock, Feedforward, Memory, Plant, Reference, Sample, Stop, Tracking
from diffabs.core.pytree import Scalar, part, pytree


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
    """Every signal of the loop at an instant."""

    sample: Sample
    measured: Any
    tracking: Tracking


class Event(NamedTuple):
    """A jump whose cause lies `elapsed` seconds back: the state before and after it."""

    before: LoopState
    after: LoopState
    elapsed: Scalar


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
        """State at t = 0, before the first jump."""
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
        return Signals(
            Sample(t, y, tracking.target, setpoint, tracking.feedforward, command, control), measured, tracking
        )

    def flow(self, t: Scalar, state: LoopState, signals: Signals) -> tuple[Any, ...]:
        """d(state.flow())/dt, from the signals at (t, state)."""
        sample, measured, tracking = signals
        return (
            self.plant.derivative(t, state.plant, sample.control),
            self.sensor.flow(t, state.sensor, sample.output),
            self.reference.flow(t, state.reference, measured),
            self.controller.flow(t, state.controller, tracking),
            self.actuator.flow(t, state.actuator, sample.command),
        )

    def jump(self, clock: Clock, state: LoopState, before: Signals | None = None) -> tuple[LoopState, list[Event]]:
        """The blocks' jumps in the order of the signal, and those that are localised events. `before` are the signals
        at (clock.t, state), if they are known."""
        t, events, start = clock.t, [], state
        seen = _seen(before or self.signals(t, state))

        def rate(name: str) -> Any:
            return _seen(self._signal_rates(t, start, before or self.signals(t, start)))[name]

        def jumped(name: str, signal: Any) -> Memory:
            nonlocal state, clock
            clock = clock._replace(before=seen[name], rate=partial(rate, name))
            memory, elapsed = getattr(self, name).jump(clock, getattr(state, name), signal)
            after = state._replace(**{name: memory})
            if elapsed is not None:
                events.append(Event(state, after, elapsed))
                clock = clock._replace(late=clock.late + elapsed)
            state = after
            return memory

        y = self.plant.output(state.plant)
        measured = self.sensor.output(t, jumped("sensor", y), y)
        tracking = self._tracking(t, jumped("reference", measured), measured)
        command = self.controller.output(t, jumped("controller", tracking), tracking)
        jumped("actuator", command)
        return state, events

    def _signal_rates(self, t: Scalar, state: LoopState, signals: Signals) -> Signals:
        """d(signals)/dt where nothing jumps."""
        moves = (jnp.ones_like(jnp.asarray(t)), self.flow(t, state, signals))
        return jax.jvp(lambda t, z: self.signals(t, state.with_flow(z)), (jnp.asarray(t), state.flow()), moves)[1]

    def _tracking(self, t: Scalar, reference: Memory, measured: Any) -> Tracking:
        target = self.reference.output(t, reference, measured)
        setpoint = self.reference.setpoint(reference)
        return Tracking(target, measured, self.feedforward.input(self.plant, measured, setpoint))


def _seen(signals: Signals) -> dict[str, Any]:
    """What each block is given."""
    sample, measured, tracking = signals
    return {"sensor": sample.output, "reference": measured, "controller": tracking, "actuator": sample.command}


def signals(sample: Sample, plant: Plant) -> dict[str, tuple[str, Any]]:
    """Unit and values of what is kept of a run, by name: time, all that the plant shows, target, command, control."""
    units = plant.shows.units
    shown = {name: (units[name], values) for name, values in sample.output._asdict().items()}
    asked = {"target": (units[sample.output._fields[0]], sample.target)}
    given = {name: (plant.control_unit, getattr(sample, name)) for name in ("command", "control")}
    return {"t": ("s", sample.t), **shown, **asked, **given}
