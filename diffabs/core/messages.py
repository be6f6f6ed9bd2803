"""Data that the parts of a loop exchange: plant outputs, memories, the clock, samples, and segments of a run.

`core.protocols`, the page of contracts, re-exports these names.
"""

from collections import namedtuple
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.arrays import steps_in_period
from diffabs.core.cubic import Cubic
from diffabs.core.types import Bool, Int, Key, PyTree, Scalar


class BrakeSignals(NamedTuple):
    """The fields of a `BrakeOutput`."""

    slip: Scalar  # [1] (v - r omega)/v
    speed: Scalar  # [m/s] of the vehicle
    wheel_speed: Scalar  # [m/s] r omega, of the wheel's rim
    deceleration: Scalar  # [m/s^2] of the vehicle, positive in braking
    distance: Scalar  # [m] travelled


class BrakeOutput(BrakeSignals):
    """The outputs of a braking plant, which are also the signals of its sensor."""

    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType({
        **{"slip": "1", "speed": "m/s", "wheel_speed": "m/s", "deceleration": "m/s^2", "distance": "m"},
    })  # fmt: skip
    highest: ClassVar[float] = 1.0  # greatest possible value of the first signal


class BalanceSignals(NamedTuple):
    """The fields of a `BalanceOutput`."""

    theta: Scalar  # [rad] frame, from the vertical
    psi: Scalar  # [rad] arm, from the frame
    phi: Scalar  # [rad] rider, from the frame
    theta_rate: Scalar  # [rad/s]
    psi_rate: Scalar  # [rad/s]
    phi_rate: Scalar  # [rad/s]
    constant: Scalar  # [N m/A] torque per ampere, at the joint
    emf: Scalar  # [V] induced by the turning joint
    resistance: Scalar  # [ohm]
    current_max: Scalar  # [A]


class BalanceOutput(BalanceSignals):
    """The outputs of a balancing plant, which are also the signals of its sensor.

    The motor's torque under a voltage u is constant * clamp((u - emf)/resistance, -current_max, current_max).
    """

    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType({
        **{"theta": "rad", "psi": "rad", "phi": "rad", "theta_rate": "rad/s", "psi_rate": "rad/s", "phi_rate": "rad/s"},
        **{"constant": "N m/A", "emf": "V", "resistance": "ohm", "current_max": "A"},
    })  # fmt: skip


class Memory(NamedTuple):
    """The memory of a block: `flow` is integrated with the plant, `held` changes only in ticks and events."""

    flow: PyTree = ()
    held: PyTree = ()


class Clock(NamedTuple):
    """An instant at which blocks may change.

    Attributes:
        t: Time [s].
        h: Step of the integration grid [s].
        k: Number of the last grid instant.
        key: Random key of the run, or None.
        on_grid: Whether this is that grid instant; False for an event between two grid instants.
        before: Signal of the block just before this instant. An earlier block in the loop may change the signal at the
            instant. None stands for an unchanged signal.
    """

    t: Scalar
    h: Scalar
    k: Int
    key: Key | None
    on_grid: Bool = True
    before: Any = None

    def ticks(self, period: Scalar | None = None) -> tuple[PyTree, PyTree]:
        """Return whether a clock of this `period` [s] ticks now, and the number of its latest tick, counted from 0.

        A `period` of None is the step of the grid.
        """
        if period is None:
            return jnp.asarray(self.on_grid), self.k
        n = steps_in_period(period, self.h)
        return self.on_grid & (self.k % n == 0), self.k // n


class Tracking(NamedTuple):
    """The input of a controller: target (a slip, an angle), measured output, and feed-forward input.

    Target and feed-forward are numbers, or NamedTuples in a loop with several inputs (`core.channels`).
    """

    target: Any
    measured: PyTree
    feedforward: Any


class Sample(NamedTuple):
    """The signals of a run at an instant; the input of an objective.

    All but time and output are numbers, or NamedTuples in a loop with several inputs (`core.channels`).
    """

    t: Scalar  # [s]
    output: PyTree  # true outputs of the plant, not the measurement
    target: Any  # present target of the controller, in the unit of the first output
    setpoint: Any  # final value of the target
    feedforward: Any  # in the unit of the control
    command: Any  # output of the controller
    control: Any  # output of the actuator

    def show(self) -> "Shown":
        """Return outputs and setpoint."""
        return Shown(self.output, self.setpoint)

    def error_controlled_signals(self) -> PyTree:
        """Return the outputs that have a target, whose errors limit an adaptive step."""
        return tracked_outputs(self.output)

    def signal_scales(self) -> PyTree:
        """Return the greater one of |output| and |setpoint| for each of them."""
        tracked = tracked_outputs(self.output)
        if not hasattr(self.setpoint, "_fields"):
            return jnp.maximum(jnp.abs(tracked), jnp.abs(self.setpoint))
        setpoints = (getattr(self.setpoint, name) for name in tracked._fields)
        return type(tracked)(*(jnp.maximum(jnp.abs(y), jnp.abs(r)) for y, r in zip(tracked, setpoints, strict=True)))


@cache
def named_tuple(name: str, fields: tuple[str, ...]) -> Any:
    """Return the NamedTuple with these fields; the same class every time, because JAX compares the classes of trees."""
    return namedtuple(name, fields)


def tracked_outputs(output: PyTree) -> PyTree:
    """Return the outputs that have a target: the first one, or those named by `tracked` of the output's type."""
    names = getattr(type(output), "tracked", None)
    return output[0] if names is None else named_tuple("Tracked", names)(*(getattr(output, name) for name in names))


class Ending(NamedTuple):
    """The end of a run.

    Attributes:
        sample: Last sample.
        stopped: Whether the run reached the stop.
        time_left: Time to add after the last sample [s]: from the stop speed to standstill; a pessimistic estimate for
            a run that did not stop.
        distance_left: Distance to add after the last sample [m].
    """

    sample: Sample
    stopped: Bool
    time_left: Scalar
    distance_left: Scalar


class Shown(NamedTuple):
    """The plant outputs and the setpoint of the first output, or their rates."""

    output: PyTree
    setpoint: Any

    def show(self) -> "Shown":
        """Return all of it."""
        return self


class Segment(NamedTuple):
    """A step of a run between two instants, without a jump inside.

    `output`, `error`, `shown_cubic` and `sample` return the cubic of a signal from values and rates at both ends. The
    extrema, roots and integrals of the cubic are those of the run to the order of the method.

    Attributes:
        start: `Sample` of a loop at the start, after the jumps there.
        end: The same at the end, before the jumps there.
        h: Length [s].
        step: Step of the grid [s].
        shown_rates: Function that returns the rates of plant outputs and setpoint at both ends.
        sample_rates: Function that returns the rates of all signals at both ends.
        smooth: True if a step ends where a limit is reached, so that none is reached inside. Otherwise the cubic of a
            limited signal may exceed the limits.
        within: For the start and for the end, whether the rate there is also the rate inside the step. At a limit it
            need not be. With one such rate, the cubic of a signal that is no plant output is the parabola through both
            ends with that rate. With none, it is the straight line.
    """

    start: Any
    end: Any
    h: Scalar
    step: Scalar
    shown_rates: Callable[[], tuple[Any, Any]]
    sample_rates: Callable[[], tuple[Any, Any]]
    smooth: Bool = False
    within: tuple[PyTree, PyTree] = (True, True)

    def output(self, read: Callable[[PyTree], Scalar] = lambda output: output[0]) -> Cubic:
        """Return the cubic of `read`(output), by default of the first plant output."""
        slopes = (jax.tree.map(lambda rate: self.h * rate, rates.output) for rates in self.shown_rates())
        return _read_cubic(read, (self.start.show().output, self.end.show().output), slopes)

    def error(self) -> Cubic:
        """Return the cubic of the first plant output minus its setpoint, which a reference may move within a step."""
        return self.shown_cubic(lambda shown: shown.output[0] - shown.setpoint)

    def shown_cubic(self, read: Callable[[Shown], Scalar]) -> Cubic:
        """Return the cubic of `read`(shown), a function of the plant outputs and the setpoint."""
        ends = (self.start.show(), self.end.show())
        first, last = (jax.tree.map(lambda rate: self.h * rate, rates) for rates in self.shown_rates())
        # The error of a step bounds a jump in the rates of the plant, so both of them are used. It does not see the
        # setpoint, whose rate may jump at the end of a step.
        setpoint = self._inside(Cubic(ends[0].setpoint, ends[1].setpoint, first.setpoint, last.setpoint))
        slopes = (first._replace(setpoint=setpoint.start_slope), last._replace(setpoint=setpoint.end_slope))
        return _read_cubic(read, ends, slopes)

    def sample(self, read: Callable[[Sample], Scalar]) -> Cubic:
        """Return the cubic of `read`(sample), a function of any signals. It costs the rates of all signals."""
        slopes = (jax.tree.map(lambda rate: self.h * rate, rates) for rates in self.sample_rates())
        return self._inside(_read_cubic(read, (self.start, self.end), slopes))

    def _inside(self, cubic: Cubic) -> Cubic:
        """Return the cubic without the slopes that are not those inside the step."""
        rise, (start, end) = cubic.end - cubic.start, self.within
        # `within` may be traced; the comparison with True is decided at trace time and skips the selections.
        if start is True and end is True:
            return cubic
        first, last = cubic.start_slope, cubic.end_slope
        return cubic._replace(
            start_slope=jnp.where(start, first, jnp.where(end, 2.0 * rise - last, rise)),
            end_slope=jnp.where(end, last, jnp.where(start, 2.0 * rise - first, rise)),
        )


def _read_cubic(read: Callable[[PyTree], Scalar], ends: Iterable[PyTree], slopes: Iterable[PyTree]) -> Cubic:
    """Return the cubic of `read` from its arguments at both ends, and their rates times the length of the step."""
    (a, da), (b, db) = (jax.jvp(read, (end,), (slope,)) for end, slope in zip(ends, slopes, strict=True))
    return Cubic(a, b, da, db)


def resting_segment(sample: Sample, h: Scalar) -> Segment:
    """Return a segment of length h [s] in which nothing moves."""
    sample = jax.tree.map(jnp.asarray, sample)
    still = jax.tree.map(jnp.zeros_like, sample)
    return Segment(sample, sample, h, h, lambda: (still.show(), still.show()), lambda: (still, still))
