"""The contracts, on one page: the map of the project.

    initial --> Plant <-- Road
                  |  output(x) = y                       (the truth)
                Sensor       y -> measured y
                Reference    measured y -> target
                Feedforward  (plant, target) -> input
                Controller   (target, measured, feedforward) -> command
                Actuator     command -> control
                  |
                Plant.derivative(t, x, control)

Sensor, Reference, Controller and Actuator are `Block`s: dynamic systems with a flow, which is evaluated inside every
Runge-Kutta stage, and, if they offer them, with ticks and events, between which the flow is smooth. At a tick the
computer's clock strikes; an event is where a margin of the block falls through zero, and a step ends exactly there.
That is how a continuous PID, a computer's controller and a relay live in one loop. Nothing here is a base class: a part
satisfies a contract by its shape.

A plant says what it shows, a NamedTuple of named signals with their `units`: a `BrakeOutput`, a `BalanceOutput`, or one
of your own. The target is of the first signal. Blocks, stops and objectives that read a signal that the plant does not
show do not fit; tracing the loop finds them.

What a part may offer beyond its contract, as a method or an attribute of its class:

    of             offer                                what it is for
    any part       problems(), rules()                  what is wrong with its fields; rules between its numbers
                   grid_rules(step)                     rules about the integration step
                   cautions()                           what is allowed but hardly meant
                   prepared(), refined(times)           the part for a run; for a step that is so many times shorter
                   family = "sensor"                    which blocks from outside it is among
                   jumps = True                         its rates jump where a comparison changes: a step ends there
    block          tick()                               what a clock changes: see Ticking
                   margins(), event()                   what changes where a margin falls through zero: see Switching
                   period                               of its clock [s]; without it, it ticks on the whole grid
                   every_step = True                    it ticks in every step of the integration
                   record(memory, passage)              told of every step, when it is over: `core.blocks.Passage`
                   offers(hook)                         of a block made of blocks: whether one has tick, or margins
    plant          usual_parts(), usual_objectives()    the loop around it, and its metrics, where a scenario says none
                   audit(initial)                       an objective whose value exceeds 1 where a run cannot have been
                   probes(initial, setpoint, stop)      starts (k,) where its loop may be stiffest
                   frozen = ("speed", ...)              outputs that a linear model of its first signal holds
    output         highest                              the greatest value that the first signal can have
    stop           otherwise = "..."                    what a reader must know of a run that ended as it should not
    objective      physical = (low, high)               where the value of a real run lies
                   failure = 0.0                        a run with a greater value has failed

Units may be relative to the loop, in the words `control` and `signal` (the first that the plant shows): the gain of a
PID is in "control/signal", N m around a brake, V/rad around a servo.

Conventions. Arguments come in the order (t, x, u). SI units. slip = (v - r omega)/v, positive in braking. A positive
torque brakes. State feedback is u = K x with x = (integral of (slip - target), slip - target): the sign of K is the
papers', so a stabilising K is negative. A balance leans to the side of positive angles, and u = K x there too.
"""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from diffabs.core.cubic import Cubic
from diffabs.core.pytree import Scalar
from diffabs.core.timing import steps


class BrakeOutput(NamedTuple):
    """What a braking plant shows of itself, and what a sensor measures."""

    slip: Scalar  # [1] (v - r omega)/v
    speed: Scalar  # [m/s] of the vehicle
    wheel_speed: Scalar  # [m/s] r omega, of the wheel's rim
    deceleration: Scalar  # [m/s^2] of the vehicle, positive in braking
    distance: Scalar  # [m] travelled

    units = MappingProxyType({
        **{"slip": "1", "speed": "m/s", "wheel_speed": "m/s", "deceleration": "m/s^2", "distance": "m"},
    })  # fmt: skip
    highest = 1.0  # that the first signal can be


class BalanceOutput(NamedTuple):
    """What a balancing plant shows of itself, and what a sensor measures. The motor's torque under a voltage u is
    constant * clamp((u - emf)/resistance, -current_max, current_max)."""

    theta: Scalar  # [rad] frame, from the vertical
    psi: Scalar  # [rad] arm, from the frame
    phi: Scalar  # [rad] rider, from the frame
    theta_rate: Scalar  # [rad/s]
    psi_rate: Scalar  # [rad/s]
    phi_rate: Scalar  # [rad/s]
    constant: Scalar  # [N m/A] torque per ampere, at the joint
    emf: Scalar  # [V] that the turning joint induces
    resistance: Scalar  # [ohm]
    current_max: Scalar  # [A]

    units = MappingProxyType({
        **{"theta": "rad", "psi": "rad", "phi": "rad", "theta_rate": "rad/s", "psi_rate": "rad/s", "phi_rate": "rad/s"},
        **{"constant": "N m/A", "emf": "V", "resistance": "ohm", "current_max": "A"},
    })  # fmt: skip


class Memory(NamedTuple):
    """What a block remembers: `flow` is integrated with the plant, `held` changes only in ticks and events."""

    flow: Any = ()
    held: Any = ()


class Clock(NamedTuple):
    """An instant at which blocks may change: time [s]; step of the integration's grid [s] and number of the grid's last
    instant; whether this is that instant, and no event between two of them; the run's random key (or None). `before` is
    the block's signal until then (None: the same), which a block before it may have changed."""

    t: Scalar
    h: Scalar
    k: Any
    key: Any
    on_grid: Any = True
    before: Any = None

    def ticks(self, period: Scalar | None = None) -> tuple[Any, Any]:
        """Whether a clock of this period [s] (None: that of the grid) strikes now, and for how many times before."""
        if period is None:
            return jnp.asarray(self.on_grid), self.k
        n = steps(period, self.h)
        return self.on_grid & (self.k % n == 0), self.k // n


class Tracking(NamedTuple):
    """What a controller is given: target (a slip, an angle), measured output, and the feed-forward input."""

    target: Scalar
    measured: Any
    feedforward: Scalar


class Sample(NamedTuple):
    """What is seen of a run at an instant; the input of an objective."""

    t: Scalar  # [s]
    output: Any  # the truth, not the measurement: what the plant shows
    target: Scalar  # what the controller is told to follow now, in the unit of the first signal
    setpoint: Scalar  # where the target will settle
    feedforward: Scalar  # in the unit of the control
    command: Scalar  # what the controller asks for
    control: Scalar  # what the actuator delivers


class Ending(NamedTuple):
    """How a run ended: its last sample, whether it reached the stop, and what remains to be added after the last sample
    (the way from the stop speed to standstill; for a run that did not stop, the pessimistic rest)."""

    sample: Sample
    stopped: Any
    time_left: Scalar  # [s]
    distance_left: Scalar  # [m]


class Shown(NamedTuple):
    """Of a sample: what the plant shows, and the setpoint of its first signal; or their rates."""

    output: Any
    setpoint: Scalar

    @classmethod
    def of(cls, sample: Sample) -> "Shown":
        """That of a sample."""
        return cls(sample.output, sample.setpoint)


class Segment(NamedTuple):
    """A step of a run, from one instant to the next, within which nothing jumps: the samples at both ends (the first
    after the jumps there, the last before them), its length [s], and the step of the grid [s]. What `output`,
    `error` and `sample` return is the cubic of something seen, from values and rates at both ends: its extrema, roots
    and integrals are those of the run to the order of the method."""

    start: Sample
    end: Sample
    h: Scalar
    step: Scalar
    shown_rates: Callable[[], tuple[Shown, Shown]]
    sample_rates: Callable[[], tuple[Sample, Sample]]

    def output(self, read: Callable[[Any], Scalar] = lambda output: output[0]) -> Cubic:
        """The cubic of read(output): by default of the first signal that the plant shows."""
        start, end = self.shown_rates()
        return self._cubic(read, (self.start.output, self.end.output), (start.output, end.output))

    def error(self) -> Cubic:
        """The cubic of the first signal - setpoint, which a reference may move within a step."""
        ends = Shown.of(self.start), Shown.of(self.end)
        return self._cubic(lambda shown: shown.output[0] - shown.setpoint, ends, self.shown_rates())

    def sample(self, read: Callable[[Sample], Scalar]) -> Cubic:
        """The cubic of read(sample): of anything seen. It costs the rates of all signals."""
        return self._cubic(read, (self.start, self.end), self.sample_rates())

    def _cubic(self, read: Callable[[Any], Scalar], ends: tuple[Any, Any], rates: tuple[Any, Any]) -> Cubic:
        (a, da), (b, db) = (jax.jvp(read, (end,), (rate,)) for end, rate in zip(ends, rates, strict=True))
        return Cubic(a, b, self.h * da, self.h * db)


def still(sample: Sample, h: Scalar) -> Segment:
    """Return a step of length h [s] in which nothing moves."""
    sample = jax.tree.map(jnp.asarray, sample)
    rest = jax.tree.map(jnp.zeros_like, sample)
    return Segment(sample, sample, h, h, lambda: (Shown.of(rest), Shown.of(rest)), lambda: (rest, rest))


class Road(Protocol):
    """A friction curve. Odd in slip, finite with finite derivatives on [-1, 1]."""

    def friction(self, slip: Scalar, speed: Scalar, distance: Scalar) -> Scalar:
        """Friction coefficient mu [1] at a slip [1], vehicle speed [m/s] and place on the road [m]."""
        ...


class Plant(Protocol):
    """dx/dt = derivative(t, x, u), y = output(x).

    An `audit` watches every run of the plant. Its value is at most 1 for a run that is physically possible; a run of
    another value has `diverged`, although all its numbers are finite."""

    @property
    def shows(self) -> Any:
        """The type of `output`, a NamedTuple whose class has `units`, by name; a class attribute."""
        ...

    @property
    def control_unit(self) -> str:
        """ "N m", "V", or "1" for a command; a class attribute."""
        ...

    def start(self, initial: Any) -> Any:
        """The state at t = 0."""
        ...

    def derivative(self, t: Scalar, state: Any, control: Scalar) -> Any:
        """dx/dt, with the structure of the state."""
        ...

    def project(self, state: Any) -> Any:
        """The nearest admissible state, applied after every step: a stopped wheel does not turn backwards."""
        ...

    def output(self, state: Any) -> Any:
        """What is seen of the state."""
        ...

    def holding(self, output: Any, target: Scalar) -> Scalar:
        """The control that holds the plant at `target`: the feed-forward tau*."""
        ...


class Block(Protocol):
    """A dynamic block: Sensor, Reference, Controller or Actuator, by the signal it maps."""

    def start(self, signal: Any) -> Memory:
        """The memory at t = 0, given the first signal."""
        ...

    def flow(self, t: Scalar, memory: Memory, signal: Any) -> Any:
        """d(memory.flow)/dt."""
        ...

    def output(self, t: Scalar, memory: Memory, signal: Any) -> Any:
        """The block's output. Does not change the memory."""
        ...


class Ticking(Block, Protocol):
    """A Block with a clock."""

    def tick(self, clock: Clock, memory: Memory, signal: Any) -> Memory:
        """The memory after an instant. It need not be one of the block's own clock: `clock.ticks(period)`."""
        ...


class Switching(Block, Protocol):
    """A Block with events."""

    def margins(self, t: Scalar, memory: Memory, signal: Any, rate: Callable[[], Any]) -> tuple[Scalar, ...]:
        """Numbers that are positive until an event, which is where one falls through zero. `rate()` is d(signal)/dt;
        it costs an evaluation of the loop and of its derivative."""
        ...

    def event(self, t: Scalar, memory: Memory, signal: Any, fired: tuple[Any, ...]) -> Memory:
        """The memory after the events whose `fired` is true."""
        ...


class Reference(Block, Protocol):
    """A Block whose output is the target."""

    def setpoint(self, memory: Memory) -> Scalar:
        """Where the target will settle, as known now: what settling and overshoot are measured against."""
        ...


class Feedforward(Protocol):
    """The input that a controller adds its feedback to."""

    def input(self, plant: Any, output: Any, target: Scalar) -> Scalar:
        """Control for a target, in the plant's unit."""
        ...


class Stop(Protocol):
    """When a run ends."""

    @property
    def success(self) -> bool:
        """Whether a run shall reach the stop (a car that brakes), or shall not (a fall); a class attribute."""
        ...

    def margin(self, output: Any) -> Scalar:
        """Positive while the run goes on; the run ends where it crosses zero."""
        ...

    def remainder(self, sample: Sample, stopped: Any) -> tuple[Scalar, Scalar]:
        """Time [s] and distance [m] that are left after the last sample."""
        ...


class Objective(Protocol):
    """What is measured on a run, streamed: a sweep stores no trajectories. A run whose value is outside of `physical`,
    or no number, has `diverged`."""

    @property
    def unit(self) -> str:
        """Of the value; a class attribute. "" where it depends on parameters."""
        ...

    def start(self, sample: Sample) -> Memory:
        """The accumulator before the first step."""
        ...

    def flow(self, memory: Memory, sample: Sample) -> Any:
        """d(memory.flow)/dt, integrated with the plant at the order of the method."""
        ...

    def update(self, memory: Memory, segment: Segment) -> Any:
        """`memory.held` after a step."""
        ...

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """The scalar result."""
        ...


def no_memory(self: Any, signal: Any) -> Memory:
    """`start` of a block that remembers nothing."""
    del self, signal
    return Memory()


def no_flow(self: Any, t: Scalar, memory: Memory, signal: Any) -> Any:
    """`flow` of a block without continuous memory."""
    del self, t, memory, signal
    return ()
