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

Sensor, Reference, Controller and Actuator are `Block`s: dynamic systems with a flow. Every Runge-Kutta stage evaluates
the flow. A block may also have ticks and events; the flow is smooth between them. A tick is an instant of the
computer's clock. An event is the instant at which a margin of the block falls through zero; a step ends exactly there.
A continuous PID, a sampled controller and a relay thus fit into one loop. No contract is a base class: a part satisfies
a contract by its methods and attributes.

A plant declares its outputs, a NamedTuple of signals with their `units`: a `BrakeOutput`, a `BalanceOutput`, or another
one. The target refers to the first output. `loop/contracts` checks a loop before its first run. It refuses a part
that returns something else than its contract says, or that reads an output which the plant lacks.

A plant with several inputs declares them as `controls`, another such NamedTuple. Its type of outputs names in `tracked`
those that have a target. Control, command and feed-forward then have the type `controls`; target and setpoint have a
field for each tracked output (`core.channels`).

Optional methods or attributes of a part's class, beyond its contract:

    of             offer                                purpose
    any part       problems(), rules()                  wrong shapes or static fields; rules between its numbers
                   grid_rules(step)                     rules about the integration step
                   cautions()                           settings that are allowed but hardly intended
                   prepared(), refined(times)           the part for a run; for a step shorter by a factor `times`
                   enable_derivatives(names)            the part for derivatives by its parameters in `names`
                   family = "sensor"                    the family of a block from outside the package
                   units_inside(name, units)            units of the part in a field, where they are not the loop's
                   jumps = True                         its rates jump where a comparison changes: a step ends there
    block          tick()                               change at an instant of a clock: see Ticking
                   margins(), event()                   change where a margin falls through zero: see Switching
                   period                               period of its clock [s]; default: the step of the grid
                   every_step = True                    it ticks in every step of the integration
                   record(memory, step)                 called after every step: `core.cubic.HermiteStep`
                   limits()                             limits of the control, for a controller or actuator
                   offers(hook), recorded_signals()     for a composite block: whether one of its blocks has the hook;
                                                        the signals that its blocks record
    plant          usual_parts(), usual_objectives()    defaults of a scenario: the other parts of the loop, the metrics
                   audit(initial)                       an objective that exceeds 1 in a physically impossible run
                   probes(initial, setpoint, stop)      starts (k,) at which its loop may be stiffest
                   least_scales()                       sizes of states below which adaptive steps have absolute errors
                   frozen = ("speed", ...)              outputs that a linear model of its first output holds constant
                   valid_magnitudes = {"yaw": 1.57}     greatest magnitudes of outputs for which the model holds
                   controls                             NamedTuple with `units` of several inputs, for `control_unit`
    output         highest                              greatest possible value of the first output
                   tracked = ("level_1", ...)           outputs that have a target, instead of the first one
                   channel(name), with_channel(...)     the outputs that a part for one channel sees, and back
    tyre           relax(contact, slip, angle, speed)   d(contact)/dt of a tyre whose force follows the slip: `Contact`
    stop           otherwise = "..."                    note to the reader on a run that ended without success
    objective      physical = (low, high)               range of the value of a physically possible run
                   failure = 0.0                        a run with a greater value has failed

Units may be relative to the loop, in the words `control` and `signal` (the first output of the plant). The gain of a
PID is in "control/signal": N m for a brake, V/rad for a servo.

Conventions. Arguments come in the order (t, x, u). Units are SI. slip = (v - r omega)/v, positive in braking. A
positive torque brakes. State feedback is u = K x with x = (integral of (slip - target), slip - target). The sign of K
is that of the papers, so a stabilising K is negative. A balance leans to the side of positive angles, and u = K x
there, too.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

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
from diffabs.core.types import Bool, Part, PyTree, Scalar


class Road(Protocol):
    """A friction curve: odd in slip, and finite with finite derivatives on [-1, 1]."""

    def friction(self, slip: Scalar, speed: Scalar, distance: Scalar) -> Scalar:
        """Return the friction coefficient mu [1] at a `slip` [1], vehicle `speed` [m/s] and `distance` along the road
        [m].
        """
        ...


class TyreForces(NamedTuple):
    """The forces of the road on a tyre, in the axes of the wheel.

    Attributes:
        braking: Force against the wheel's heading [N].
        lateral: Force to the left [N].
    """

    braking: Scalar
    lateral: Scalar


class Contact(NamedTuple):
    """What the force of a tyre with a relaxation length follows; a state of the plant.

    Attributes:
        slip: Slip of the contact [1].
        slip_angle: Its slip angle [rad].
    """

    slip: Scalar
    slip_angle: Scalar


class Tyre(Protocol):
    """The force of a tyre, or of both tyres of an axle.

    `proportional` says whether the force is proportional to the load; then one linear equation gives loads and forces.
    """

    @property
    def proportional(self) -> bool:
        """Whether the friction does not depend on the load; a class attribute."""
        ...

    def braking_force(self, slip: Scalar, load: Scalar, speed: Scalar, distance: Scalar) -> Scalar:
        """Return the force against the straight motion [N] at a `slip` [1], `load` [N], vehicle `speed` [m/s] and
        `distance` along the road [m].
        """
        ...

    def forces(self, slip: Scalar, slip_angle: Scalar, load: Scalar, speed: Scalar, distance: Scalar) -> TyreForces:
        """Return both forces for a wheel that moves at `slip_angle` [rad] to the left of its heading."""
        ...


class Pads(Protocol):
    """The pads and discs of a car's brakes: one temperature for each brake, of the front first, or none."""

    @property
    def heated(self) -> bool:
        """Whether there are temperatures, which the car then shows; a class attribute."""
        ...

    def start(self, brakes: int) -> tuple[Scalar, ...]:
        """Return the temperatures at t = 0 [K]."""
        ...

    def torques(self, temperatures: Sequence[Scalar], commands: Sequence[Scalar]) -> tuple[Scalar, ...]:
        """Return the brake torques [N m] that commands make."""
        ...

    def commands(self, temperatures: Sequence[Scalar], torques: Sequence[Scalar]) -> tuple[Scalar, ...]:
        """Return the commands that make brake torques [N m]."""
        ...

    def heat_rates(self, temperatures: Sequence[Scalar], powers: Sequence[Scalar]) -> tuple[Scalar, ...]:
        """Return the rates of the temperatures [K/s] under the powers of the brakes of single wheels [W]."""
        ...


class Plant(Protocol):
    """A plant dx/dt = derivative(t, x, u), y = output(x).

    An `audit` observes every run of the plant. Its value is at most 1 for a physically possible run. A run with another
    value has `diverged`, although all its numbers are finite.
    """

    @property
    def shows(self) -> type[Any]:
        """Type of `output`, a NamedTuple whose class has `units` by name; a class attribute."""
        ...

    @property
    def control_unit(self) -> str:
        """Unit of the control: "N m", "V", or "1" for a command; a class attribute, not of a plant with `controls`."""
        ...

    def start(self, initial: Part) -> PyTree:
        """Return the state at t = 0."""
        ...

    def derivative(self, t: Scalar, state: PyTree, control: Scalar) -> PyTree:
        """Return dx/dt, with the structure of the state."""
        ...

    def project(self, state: PyTree) -> PyTree:
        """Return the nearest admissible state, after every step: a stopped wheel does not turn backwards."""
        ...

    def output(self, state: PyTree) -> PyTree:
        """Return the outputs in a state."""
        ...

    def holding(self, output: PyTree, target: Scalar) -> Scalar:
        """Return the control that holds the plant at `target`: the feed-forward tau*."""
        ...


class Block(Protocol):
    """A dynamic block: Sensor, Reference, Controller or Actuator, depending on the signal that it maps."""

    def start(self, signal: PyTree) -> Memory:
        """Return the memory at t = 0 for the first signal."""
        ...

    def flow(self, t: Scalar, memory: Memory, signal: PyTree) -> PyTree:
        """Return d(memory.flow)/dt."""
        ...

    def output(self, t: Scalar, memory: Memory, signal: PyTree) -> PyTree:
        """Return the block's output, without a change of the memory."""
        ...


class Ticking(Block, Protocol):
    """A Block with a clock."""

    def tick(self, clock: Clock, memory: Memory, signal: PyTree) -> Memory:
        """Return the memory after an instant, which may be no tick of the block's own clock: `clock.ticks(period)`."""
        ...


class Switching(Block, Protocol):
    """A Block with events."""

    def margins(self, t: Scalar, memory: Memory, signal: PyTree, rate: Callable[[], PyTree]) -> tuple[Scalar, ...]:
        """Return numbers that are positive until an event; at the event, one of them falls through zero.

        `rate()` is d(signal)/dt. It costs an evaluation of the loop and of its derivative. In a sampled controller it
        raises a ValueError.
        """
        ...

    def event(self, t: Scalar, memory: Memory, signal: PyTree, fired: tuple[PyTree, ...]) -> Memory:
        """Return the memory after the events whose `fired` is true; `signal` is the input before the instant."""
        ...


class Reference(Block, Protocol):
    """A Block whose output is the target."""

    def setpoint(self, memory: Memory) -> Scalar:
        """Return the final value of the target, as known now: settling and overshoot refer to it."""
        ...


class Feedforward(Protocol):
    """The input to which a controller adds its feedback."""

    def input(self, plant: Part, output: PyTree, target: Scalar) -> Scalar:
        """Return the control for a target, in the plant's unit."""
        ...


class Stop(Protocol):
    """The condition that ends a run."""

    @property
    def success(self) -> bool:
        """Whether a run should reach the stop (a braking car) or should not (a fall); a class attribute."""
        ...

    def margin(self, output: PyTree) -> Scalar:
        """Return a number that is positive while the run goes on; the run ends at its zero crossing."""
        ...

    def remainder(self, sample: Sample, stopped: Bool) -> tuple[Scalar, Scalar]:
        """Return time [s] and distance [m] that remain after the last sample."""
        ...


class Objective(Protocol):
    """A metric of a run, accumulated step by step: a sweep stores no trajectories.

    A run whose value is outside `physical`, or NaN, has `diverged`. An objective may have an attribute `unreached`, the
    infinite value of a run that does not reach the measured condition, or NaN for a run that has no such metric. One
    whose attribute `counts_kinks` is True sums something over the bends of a signal.
    """

    @property
    def unit(self) -> str:
        """Unit of the value; a class attribute. "" if it depends on parameters."""
        ...

    def start(self, sample: Sample) -> Memory:
        """Return the accumulator before the first step."""
        ...

    def flow(self, memory: Memory, sample: Sample) -> PyTree:
        """Return d(memory.flow)/dt, integrated with the plant at the order of the method."""
        ...

    def update(self, memory: Memory, segment: Segment) -> PyTree:
        """Return `memory.held` after a step."""
        ...

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the scalar result."""
        ...


def no_memory(self: object, signal: object) -> Memory:
    """Return an empty memory: `start` of a block without memory."""
    del self, signal
    return Memory()


def no_flow(self: object, t: Scalar, memory: Memory, signal: object) -> tuple[()]:
    """Return no rates: `flow` of a block without continuous memory."""
    del self, t, memory, signal
    return ()
