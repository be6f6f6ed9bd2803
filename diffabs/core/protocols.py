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
                   limits()                             of a controller or actuator: between which the control stays
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
from typing import Any, Protocol

from diffabs.core.messages import BalanceOutput as BalanceOutput
from diffabs.core.messages import BrakeOutput as BrakeOutput
from diffabs.core.messages import Clock as Clock
from diffabs.core.messages import Ending as Ending
from diffabs.core.messages import Memory as Memory
from diffabs.core.messages import Sample as Sample
from diffabs.core.messages import Segment as Segment
from diffabs.core.messages import Shown as Shown
from diffabs.core.messages import Tracking as Tracking
from diffabs.core.messages import resting_segment as resting_segment
from diffabs.core.pytree import Scalar


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
    or no number, has `diverged`. An objective may have an attribute `unreached`, an infinite value: the answer of a run
    that does not get to what is measured."""

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
