"""The hybrid closed loop: plant, sensor, reference, feed-forward, controller, actuator, and stop condition.

    between instants   dz/dt = flow(t, z; held)         z: plant state and the blocks' continuous memories
    at instants        (z, held) -> change(z, held)     sensor, reference, controller, actuator, in this order

An instant is a tick of a clock or an event, at which a margin of a block falls through zero.

A `Loop` is one pytree: every parameter of every part is a leaf with a dotted path, `loop.plant.road.scale`.
"""

from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import cache, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.blocks import Direct, NoFeedforward, next_tick, offers, record_signal
from diffabs.core.cubic import HermiteStep
from diffabs.core.messages import tracked_outputs
from diffabs.core.protocols import (
    Block,
    Clock,
    Feedforward,
    Memory,
    Objective,
    Plant,
    Reference,
    Sample,
    Stop,
    Tracking,
    no_flow,
)
from diffabs.core.pytree import parameters, part, parts, prepare_parts, pytree
from diffabs.core.summary import Summary
from diffabs.core.types import Int, Part, PyTree, Scalar
from diffabs.engine.hybrid import Margins


class LoopState(NamedTuple):
    """The state of the plant and the memories of the blocks."""

    plant: Part
    sensor: Memory
    reference: Memory
    controller: Memory
    actuator: Memory

    def flow(self) -> tuple[PyTree, ...]:
        """Return the integrated part of the state: plant state and continuous memories."""
        return (self.plant, *(m.flow for m in self[1:]))

    def memories(self) -> list[PyTree]:
        """Return the held memories."""
        return [memory.held for memory in self[1:]]

    def with_flow(self, flow: tuple[PyTree, ...]) -> "LoopState":
        """Return the state with plant state and continuous memories from `flow`, and the same held memories."""
        return LoopState(flow[0], *(m._replace(flow=f) for m, f in zip(self[1:], flow[1:], strict=True)))


class Signals(NamedTuple):
    """All signals of the loop at an instant.

    Attributes:
        sample: Signals of a sample.
        measured: Output of the sensor.
        tracking: Input of the controller.
        recorded: The signals that a block records, by the name of the block.
    """

    sample: Sample
    measured: PyTree
    tracking: Tracking
    recorded: dict[str, PyTree]


AUDIT_METRIC = ""  # name of a plant's audit among the objectives; no metric has an empty name
BLOCKS = ("sensor", "reference", "controller", "actuator")
LOOP_SIGNALS = tuple(name for name in Sample._fields if name not in ("t", "output"))
# Names that no output of a plant may have: files and proofs use them for other signals, columns and variables.
RESERVED_SIGNALS = {*LOOP_SIGNALS, "t", "time", "sample", "metrics", "units"}


@pytree
class LoopParts:
    """The parts of a closed loop, without what ends its run."""

    plant: Plant = part()
    initial: Part = part()
    sensor: Block = part(default=Direct)
    reference: Reference = part()
    feedforward: Feedforward = part(default=NoFeedforward)
    controller: Block = part()
    actuator: Block = part(default=Direct)


@pytree
class Loop(LoopParts):
    """A closed loop of plant and controller with the blocks around them."""

    stop: Stop = part()

    def _repr_html_(self) -> str:
        """Return the parts and their parameters as a table for a notebook."""
        parts_ = ", ".join(f"{field.name} {type(getattr(self, field.name)).__name__}" for field in fields(self))
        rows = tuple((path, value, spec.interval()) for path, spec, value in parameters(self))
        return Summary(f"Loop: {parts_}", ("parameter", "value", "range"), rows)._repr_html_()

    def problems(self) -> Iterator[str]:
        """Yield a line if an output of the plant has the name of another signal."""
        shown = getattr(getattr(self.plant, "shows", None), "_fields", ())
        if clash := sorted(RESERVED_SIGNALS & set(shown)):
            yield f"plant.shows: no output can be called {', '.join(clash)}, like a signal of the loop or of its files"

    def prepare_run(self) -> tuple["Loop", dict[str, Objective]]:
        """Return the loop with all that is constant during a run computed, and the plant's audit, if there is one."""
        loop = prepare_parts(self)
        audit = getattr(loop.plant, "audit", None)
        return loop, {AUDIT_METRIC: audit(loop.initial)} if audit else {}

    def start(self) -> LoopState:
        """Return the state at t = 0, before the first tick."""
        x = self.plant.start(self.initial)
        y = self.plant.output(x)
        sensor = self.sensor.start(y)
        measured = self.sensor.output(0.0, sensor, y)
        reference = self.reference.start(measured)
        tracking = self._track(0.0, reference, measured)
        controller = self.controller.start(tracking)
        actuator = self.actuator.start(self.controller.output(0.0, controller, tracking))
        return LoopState(x, sensor, reference, controller, actuator)

    def signals(self, t: Scalar, state: LoopState) -> Signals:
        """Return the signals at time `t` [s] in `state`, computed once around the loop."""
        y = self.plant.output(state.plant)
        measured = self.sensor.output(t, state.sensor, y)
        tracking = self._track(t, state.reference, measured)
        command = self.controller.output(t, state.controller, tracking)
        control = self.actuator.output(t, state.actuator, command)
        setpoint = self.reference.setpoint(state.reference)
        sample = Sample(t, y, tracking.target, setpoint, tracking.feedforward, command, control)
        inputs = _block_inputs(Signals(sample, measured, tracking, {}))
        recorded = {
            name: record_signal(getattr(self, name), t, getattr(state, name), inputs[name]) for name in self.recorders
        }
        return Signals(sample, measured, tracking, recorded)

    def flow(self, t: Scalar, state: LoopState, signals: Signals) -> tuple[PyTree, ...]:
        """Return d(state.flow())/dt from the `signals` at (t, state)."""
        sample, measured, tracking, _ = signals
        return (
            self.plant.derivative(t, state.plant, sample.control),
            self.sensor.flow(t, state.sensor, sample.output),
            self.reference.flow(t, state.reference, measured),
            self.controller.flow(t, state.controller, tracking),
            self.actuator.flow(t, state.actuator, sample.command),
        )

    def project(self, state: LoopState) -> LoopState:
        """Return the state with the plant state projected onto the plant's admissible states."""
        return state._replace(plant=self.plant.project(state.plant))

    def join_state(self, flow: tuple[PyTree, ...], held: list[PyTree]) -> LoopState:
        """Return the state that has this `LoopState.flow` and these `LoopState.memories`."""
        return LoopState(flow[0], *(Memory(*pair) for pair in zip(flow[1:], held, strict=True)))

    def error_controlled_signals(self, state: LoopState) -> PyTree:
        """Return the plant's outputs that have a target."""
        return tracked_outputs(self.plant.output(state.plant))

    def least_scales(self, state: LoopState) -> tuple[PyTree, ...] | None:
        """Return the plant's least scales, with zeros for the blocks; None if the plant has none."""
        least_scales = getattr(self.plant, "least_scales", None)
        return least_scales and (least_scales(), *jax.tree.map(jnp.zeros_like, state.flow()[1:]))

    @property
    def changes(self) -> bool:
        """Whether a block has ticks or events."""
        return any(offers(getattr(self, name), "tick", "margins") for name in BLOCKS)

    @property
    def ticks(self) -> bool:
        """Whether a block has ticks."""
        return any(offers(getattr(self, name), "tick") for name in BLOCKS)

    def next_tick(self, k: Int, h: Scalar) -> Scalar:
        """Return the number of the first grid instant after the `k`-th at which a block ticks.

        `h` is the step of the grid [s]. At least one block must have ticks.
        """
        blocks = (getattr(self, name) for name in BLOCKS)
        return reduce(jnp.minimum, (next_tick(block, k, h) for block in blocks if offers(block, "tick")))

    @property
    def eventful(self) -> bool:
        """Whether a block has events."""
        return any(offers(getattr(self, name), "margins") for name in BLOCKS)

    @property
    def jumps(self) -> bool:
        """Whether a part of the loop declares that a rate in the flow jumps where a comparison changes."""
        return any(_jumps(getattr(self, name)) for name in ("plant", "feedforward", *BLOCKS))

    @property
    def recorders(self) -> tuple[str, ...]:
        """Names of the blocks that record their signal."""
        return tuple(name for name in BLOCKS if offers(getattr(self, name), "record"))

    def margins(self, t: Scalar, state: LoopState, signals: Signals, flow: Callable[[], PyTree]) -> Margins:
        """Return the margins of the stop and of the blocks; `flow()` is d(state.flow())/dt, for blocks that need a
        rate.
        """
        # The rates cost a derivative of the loop: they are computed at most once, and only if a block calls `rate`.
        rates = cache(lambda: _block_inputs(self.signal_rates(t, state, flow())))
        inputs = _block_inputs(signals)

        def of(name: str) -> tuple[PyTree, ...]:
            return getattr(self, name).margins(t, getattr(state, name), inputs[name], lambda: rates()[name])

        block_margins = {name: of(name) for name in BLOCKS if offers(getattr(self, name), "margins")}
        return {"stop": (self.stop.margin(signals.sample.output),), **block_margins}

    def change(
        self,
        clock: Clock,
        state: LoopState,
        before: Signals,
        margins: Margins,
        fired: Margins,
        passed: dict[str, HermiteStep] | None = None,
    ) -> LoopState:
        """Return the state after an instant, of the state, signals and margins before it.

        Each block, in the order of the signal, has its events, records the step that ends here (`passed`), and has its
        tick. An event also occurs if the change of an earlier block makes the input jump so that a margin turns
        negative. The margin is tested with the input before and after the jump, and with the jump as the rate. A margin
        that is the input's rate thus also detects a maximum. `event` gets the input before the instant.
        """
        was, input_may_jump = _block_inputs(before), False

        def change_block(name: str, signal: object) -> Memory:
            nonlocal state, input_may_jump
            block, memory = getattr(self, name), getattr(state, name)
            if name in fired:
                happens = fired[name]
                if input_may_jump:
                    # An earlier block with ticks or events may have changed, and the input may cross a margin's zero.
                    jump = jax.tree.map(jnp.subtract, signal, was[name])
                    ends = (block.margins(clock.t, memory, end, lambda: jump) for end in (was[name], signal))
                    crossed = zip(happens, margins[name], *ends, strict=True)
                    happens = tuple(event | ((a >= 0) & ((b < 0) | (c < 0))) for event, a, b, c in crossed)
                memory = block.event(clock.t, memory, was[name], happens)
            if passed and name in passed:
                memory = block.record(memory, passed[name])
            if offers(block, "tick"):
                memory = block.tick(clock._replace(before=was[name]), memory, signal)
            input_may_jump = input_may_jump or offers(block, "tick", "margins")
            state = state._replace(**{name: memory})
            return memory

        t, y = clock.t, before.sample.output
        measured = self.sensor.output(t, change_block("sensor", y), y)
        tracking = self._track(t, change_block("reference", measured), measured)
        command = self.controller.output(t, change_block("controller", tracking), tracking)
        change_block("actuator", command)
        return state

    def signal_rates(self, t: Scalar, state: LoopState, flow: object) -> Signals:
        """Return d(signals)/dt at time `t` in `state`, away from jumps, for d(state.flow())/dt equal to `flow`."""
        moves = (jnp.ones_like(jnp.asarray(t)), flow)
        return jax.jvp(lambda t, z: self.signals(t, state.with_flow(z)), (jnp.asarray(t), state.flow()), moves)[1]

    def _track(self, t: Scalar, reference: Memory, measured: object) -> Tracking:
        target = self.reference.output(t, reference, measured)
        setpoint = self.reference.setpoint(reference)
        return Tracking(target, measured, self.feedforward.input(self.plant, measured, setpoint))


def _jumps(component: object) -> bool:
    """Return whether a part declares jumps, or a part in it, unless the outer one integrates nothing."""
    if getattr(component, "jumps", False):
        return True
    return getattr(type(component), "flow", None) is not no_flow and any(map(_jumps, parts(component)))


def _block_inputs(signals: Signals) -> dict[str, PyTree]:
    """Return the input of each block by its name."""
    sample, measured, tracking, _ = signals
    return {"sensor": sample.output, "reference": measured, "controller": tracking, "actuator": sample.command}
