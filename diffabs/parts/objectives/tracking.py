"""Objectives of tracking: peak, overshoot, settling, and integrals of the error.

They read the first signal y that the plant shows: a brake's slip, a servo's angle. The error is e = y - setpoint. The
setpoint is the final value of the reference and not a filtered target on its way there.
"""

import math
import operator
from collections.abc import Callable, Iterator
from functools import reduce
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.arrays import as_rule_array
from diffabs.core.blocks import Parallel
from diffabs.core.channels import has_channels
from diffabs.core.cubic import Cubic
from diffabs.core.numerics import larger, later_of_larger, sign, smaller
from diffabs.core.protocols import Ending, Memory, Sample, Segment
from diffabs.core.pytree import param, parts, pytree, static
from diffabs.core.rules import Rule, order_rule
from diffabs.core.types import Any, Bool, Numbers, Part, PyTree, Scalar, Vector
from diffabs.core.units import channel_unit

STEP_EPS = 1000.0  # a shorter step, in eps of the signal, is rounding: a first slip of 0.2 is one of two speeds


class FinalValue:
    """Base of objectives; without further methods the memory stays empty."""

    def start(self, sample: Sample) -> Memory:
        """Return an empty memory."""
        del sample
        return Memory()

    def flow(self, memory: Memory, sample: Sample) -> PyTree:
        """Return (): there is no integral."""
        del memory, sample
        return ()

    def update(self, memory: Memory, segment: Segment) -> PyTree:
        """Return the held memory unchanged."""
        del segment
        return memory.held


class Integral(FinalValue):
    """Base of objectives that are only an integral, from 0."""

    def start(self, sample: Sample) -> Memory:
        """Return the integral 0."""
        return Memory(flow=0.0 * sample.output[0])

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the integral."""
        del ending
        return memory.flow


class HeldValue(FinalValue):
    """Base of objectives that update what they hold at each step; by default a number, from 0."""

    def start(self, sample: Sample) -> Memory:
        """Return the held number 0."""
        return Memory(held=0.0 * sample.output[0])

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the held number."""
        del ending
        return memory.held


def tracking_error(sample: Sample) -> Scalar:
    """Return the first signal minus its setpoint."""
    return sample.output[0] - sample.setpoint


def absolute_integral(cubic: Cubic, integral: Callable[[PyTree], PyTree]) -> Scalar:
    """Return the integral of |p|, or of |p| times a positive weight, over [0, 1], for p of one change of sign at most.

    Args:
        integral: Function of x that returns the integral from 0 to x of p, or of p times the weight.
    """
    whole = integral(1.0)
    before_root = integral(cubic.root())
    return jnp.where(cubic.start * cubic.end < 0, jnp.abs(before_root) + jnp.abs(whole - before_root), jnp.abs(whole))


@pytree
class IAE(HeldValue):
    """Integral of |e| dt, e = y - setpoint, in the unit of y times s; for a slip [s].

    The cubic of e is integrated on both sides of its zero.
    """

    unit = "signal s"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Return the sum with the integral of |e| over the step."""
        e = segment.error()
        return memory.held + segment.h * absolute_integral(e, e.integral)


@pytree
class ITAE(HeldValue):
    """Integral of t |e| dt, by the method of `IAE`, in the unit of y times s^2; for a slip [s^2]."""

    unit = "signal s^2"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Return the sum with the integral of t |e| over the step."""
        e, t, h = segment.error(), segment.start.t, segment.h
        return memory.held + h * absolute_integral(e, lambda x: t * e.integral(x) + h * e.moment(x))


class Extremes(NamedTuple):
    """Memory of an overshoot: the first, the lowest and the highest value of the signal, in its unit."""

    first: Scalar
    lowest: Scalar
    highest: Scalar


@pytree
class MaxSlip(HeldValue):
    """Greatest slip of the run [1], at most 1. Its derivative jumps where two maxima are equal."""

    unit = "1"
    physical: ClassVar[tuple[float, float]] = (-1.0, 1.0)

    def start(self, sample: Sample) -> Memory:
        """Return the first slip."""
        return Memory(held=sample.output.slip)

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Return the greatest slip up to the end of the step, from the step's cubic."""
        slip = segment.output(lambda output: output.slip)
        return later_of_larger(memory.held, smaller(slip.greatest(), 1.0), slip.falls)


def greatest_magnitude(name_of: Callable[[Any], str]) -> tuple[PyTree, PyTree]:
    """Return start and update of an objective: the greatest |y| of an output, whose name `name_of(objective)` gives.

    An empty name is that of the first output.
    """

    def read(objective: object, output: Any) -> Scalar:
        name = name_of(objective)
        return getattr(output, name) if name else output[0]

    def start(self: object, sample: Sample) -> Memory:
        return Memory(held=jnp.abs(read(self, sample.output)))

    def update(self: object, memory: Memory, segment: Segment) -> Scalar:
        cubic = segment.output(lambda output: read(self, output))
        # `falls` refers to |y|, so a negative y is mirrored.
        falls = jnp.where(cubic.start >= 0, cubic.falls, cubic.times(-1.0).falls)
        return later_of_larger(memory.held, larger(cubic.greatest(), cubic.times(-1.0).greatest()), falls)

    return start, update


@pytree
class PeakOutput(HeldValue):
    """Greatest magnitude of an output during the run, in its unit.

    >>> from diffabs.parts.objectives import PeakOutput
    >>> yaw = PeakOutput(output="yaw")
    """

    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    output: str = static(default="")
    """Name of the output; empty for the first one."""
    until: Scalar = param(default=math.inf, unit="s", above=0.0, infinite=True)
    """Time after which the output does not count."""

    start, within = greatest_magnitude(lambda objective: objective.output)

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Return the greatest magnitude up to the end of the step, from the step's cubic."""
        return jnp.where(segment.start.t < self.until, self.within(memory, segment), memory.held)

    @property
    def unit(self) -> str:
        """Return the unit of the output."""
        return channel_unit("signal", "", self.output)


@pytree
class Overshoot(HeldValue):
    """Overshoot as a fraction of the step [1]: max(0, max y - r)/(r - y0) for a step up, max(0, r - min y)/(y0 - r) for
    a step down.

    The step is that of `SettlingTime`: from the first value y0 of the signal to the final setpoint r. A reference that
    filters its target does not change the step. A run without overshoot has value and derivative 0.

    A run that starts on its final setpoint, to a rounding of 1000 eps, has no step: its overshoot is NaN, with NaN
    derivatives. The run is valid.
    """

    unit = "1"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)
    unreached: ClassVar[float] = math.nan

    def start(self, sample: Sample) -> Memory:
        """Return the memory with the first value."""
        return Memory(held=Extremes(*(sample.output[0],) * 3))

    def update(self, memory: Memory, segment: Segment) -> Extremes:
        """Return the extremes up to the end of the step, from the step's cubic."""
        first, lowest, highest = memory.held
        signal, output = segment.output(), segment.end.output
        mirrored = signal.times(-1.0)
        top = smaller(signal.greatest(), getattr(output, "highest", math.inf))
        bottom = -later_of_larger(-lowest, mirrored.greatest(), mirrored.falls)
        return Extremes(first, bottom, later_of_larger(highest, top, signal.falls))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the overshoot [1]; NaN without a step."""
        first, lowest, highest = memory.held
        setpoint = ending.sample.setpoint
        step = setpoint - first
        excess = jnp.where(step > 0, highest - setpoint, setpoint - lowest)
        rounding = STEP_EPS * jnp.finfo(jnp.result_type(step)).eps * larger(jnp.abs(setpoint), jnp.abs(first))
        # A NaN denominator, unlike a selected NaN, makes the derivatives NaN, too.
        return larger(excess, 0.0) / jnp.where(jnp.abs(step) <= rounding, jnp.nan, jnp.abs(step))


class Settling(NamedTuple):
    """Memory of a settling time.

    Attributes:
        first: First value of the signal.
        entered: Time of the last entry into the band [s].
    """

    first: Scalar
    entered: Scalar


@pytree
class SettlingTime(HeldValue):
    """Time [s] from t = 0 after which |y - setpoint| stays within a band.

    The value is 0 for a run that never leaves the band, and infinite for one that ends outside. The band is `share` of
    the step from the first value to the setpoint (2 % by default), or `band` if this is wider. A run that starts on its
    setpoint has no step: it settles only if `band` is given.

    The entry is the root of the step's cubic. The method misses an excursion that begins and ends within one step. The
    time jumps where a local extremum just touches the band.
    """

    unit = "s"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)
    unreached: ClassVar[float] = math.inf

    share: Scalar = param(default=0.02, unit="1", low=0.0, below=1.0)
    """Half width of the band, relative to the step from the first value to the setpoint."""
    band: Scalar = param(default=0.0, unit="signal", low=0.0)
    """Least half width of the band."""

    def start(self, sample: Sample) -> Memory:
        """Return the memory of a run that is settled from t = 0."""
        return Memory(held=Settling(sample.output[0], 0.0 * sample.t))

    def update(self, memory: Memory, segment: Segment) -> Settling:
        """Return the memory with the last entry into the band."""
        first, entered = memory.held
        # The band is one-sided for the error at the start of the step; the sign has no derivative.
        side = sign(jax.lax.stop_gradient(segment.error().start))
        excess = segment.shown_cubic(
            lambda shown: side * (shown.output[0] - shown.setpoint) - self._width(shown, first)
        )
        entry = segment.start.t + segment.h * excess.root()
        return Settling(first, jnp.where(excess.start > 0, entry, entered))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the last entry [s]; infinity if the last sample is outside the band."""
        last = ending.sample
        outside = jnp.abs(tracking_error(last)) > self._width(last, memory.held.first)
        return jnp.where(outside, self.unreached, memory.held.entered)

    def _width(self, sample: PyTree, first: Scalar) -> Scalar:
        """Return half the width of the band, for a sample or another tuple with a `setpoint`."""
        return larger(self.share * jnp.abs(sample.setpoint - first), self.band)

    def rules(self) -> Iterator[Rule]:
        """Yield the rule that `share` or `band` is positive."""
        line = "share and band are both 0; a settling time needs a band of some width"
        yield Rule((as_rule_array(self.share) > 0) | (as_rule_array(self.band) > 0), line, lambda: line)


@pytree
class ShareAtLimit(HeldValue):
    """Fraction of the run's time [1] during which the controller's command is at or beyond `low` or `high`.

    A step with one end at a limit counts by half. `at_limits` returns this objective with the limits of a loop. With
    several controls the limits have an entry for each, and one control at a limit counts.
    """

    unit = "1"
    physical: ClassVar[tuple[float, float]] = (0.0, 1.0)

    low: Numbers = param(default=-math.inf, unit="control", below=math.inf, infinite=True, free=True)
    """Lower limit of the control."""
    high: Numbers = param(default=math.inf, unit="control", above=-math.inf, infinite=True, free=True)
    """Upper limit of the control."""

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Return the sum with the step, half the step, or 0 [s]."""
        ends = [self._is_at_limit(x.command) for x in (segment.start, segment.end)]
        return memory.held + segment.h * sum(jnp.where(end, 0.5, 0.0) for end in ends)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the share [1]; 0 for a run of zero length."""
        t = ending.sample.t
        # The sum of the steps may exceed t by rounding.
        return jnp.where(t > 0, smaller(memory.held / jnp.where(t > 0, t, 1.0), 1.0), 0.0)

    def rules(self) -> Iterator[Rule]:
        """Yield the rule low <= high of a single control."""
        if not np.ndim(self.low):
            yield order_rule(("low", self.low), ("high", self.high), "{control}")

    def _is_at_limit(self, command: PyTree) -> Bool:
        if not has_channels(command):
            return (command <= self.low) | (command >= self.high)
        ends = zip(jax.tree.leaves(command), jnp.asarray(self.low), jnp.asarray(self.high), strict=True)
        return reduce(operator.or_, ((u <= low) | (u >= high) for u, low, high in ends))


def at_limits(loop: Part) -> ShareAtLimit:
    """Return the `ShareAtLimit` whose limits are those of a loop's controller and actuator.

    The tightest limits count, also those of controllers inside a controller. Without limits they are infinite. The two
    torques of a relay are levels and not limits. The limits bound the command. An `IntegratingValve`, whose command is
    a rate, has none.

    With several controls the limits have an entry for each.

    Args:
        loop: Loop. A part gives its limits by a method `limits()`.

    Examples:
        >>> import diffabs as d
        >>> from diffabs.parts.objectives import at_limits
        >>> loop = d.braking()
        >>> run = d.measure(loop, d.FixedStep(1e-4, 4.0), {"at a limit": at_limits(loop)})
        >>> print(f"{run.metrics['at a limit']:.2f}")
        0.31
    """
    controls = getattr(loop.plant, "controls", None)
    if controls is None:
        low, high = _tightest_limits(loop, "")
        return ShareAtLimit(low=low, high=high)
    lows, highs = zip(*(_tightest_limits(loop, channel) for channel in controls._fields), strict=True)
    return ShareAtLimit(low=jnp.stack([*map(jnp.asarray, lows)]), high=jnp.stack([*map(jnp.asarray, highs)]))


def _tightest_limits(loop: Part, channel: str) -> tuple[Scalar, Scalar]:
    """Return the tightest limits of the loop's control, or of one of several."""
    low, high = -math.inf, math.inf
    pending = [loop.controller, loop.actuator]
    while pending:
        component: Part = pending.pop()
        # Controllers may contain controllers (`Sampled`), so the search descends into all parts.
        pending.extend(
            _parts_of_channel(component, channel, loop.plant.controls._fields) if channel else parts(component)
        )
        if limits := getattr(component, "limits", None):
            below, above = limits()
            if np.ndim(below):  # of a controller with several commands
                place = loop.plant.controls._fields.index(channel)
                below, above = below[place], above[place]
            low, high = larger(low, below), smaller(high, above)
    return low, high


def _parts_of_channel(component: Part, channel: str, controls: tuple[str, ...]) -> list[Part]:
    """Return the parts of a component that act on one of the `controls`."""
    if isinstance(component, Parallel) and component.by_channel().keys() <= {*controls}:
        return [block for name, block in component.by_channel().items() if name == channel]
    return [*parts(component)]


@pytree
class FinalError(FinalValue):
    """|y - setpoint| at the end of the run, in the unit of y."""

    unit = "signal"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the final error."""
        del memory
        return jnp.abs(tracking_error(ending.sample))


class Quadratic(NamedTuple):
    """Integrals of a quadratic cost.

    Attributes:
        error: Integral of the error.
        cost: Integral of the cost.
    """

    error: Scalar
    cost: Scalar


@pytree
class QuadraticCost(Integral):
    """Integral of q1 x1^2 + q2 x2^2 + r (u - ff)^2 dt, without a unit of its own.

    Here x1 is the integral of e, and x2 = e. u is the actuator's output, and ff the feedforward.

    Source: eq. (24) of Maeda and Sugiura with eps = 0.
    """

    unit = ""
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    q: Vector = param(default=(1.0, 1.0), unit="1", low=0.0)
    """Weights (q1, q2) of the squared states, shape (2,)."""
    r: Scalar = param(default=1.0, unit="1", above=0.0)
    """Weight of the squared control."""

    def start(self, sample: Sample) -> Memory:
        """Return the memory with both integrals 0."""
        return Memory(flow=Quadratic(*(0.0 * sample.output[0],) * 2))

    def flow(self, memory: Memory, sample: Sample) -> Quadratic:
        """Return e and the integrand of the cost."""
        x1, x2, u = memory.flow.error, tracking_error(sample), sample.control - sample.feedforward
        return Quadratic(x2, self.q[0] * x1**2 + self.q[1] * x2**2 + self.r * u**2)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the cost."""
        del ending
        return memory.flow.cost
