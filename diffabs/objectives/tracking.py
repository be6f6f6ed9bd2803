"""How well a run follows its setpoint: peak, overshoot, settling, integrals of the error. They read the first signal
that the plant shows, y: a brake's slip, a servo's angle.

The error e = y - setpoint is against where the reference will settle, not against a filtered target on its way
there."""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.cubic import Cubic
from diffabs.core.numerics import larger, later_of_larger, sign, smaller
from diffabs.core.protocols import Ending, Memory, Sample, Segment
from diffabs.core.pytree import Scalar, Vector, param, parts, pytree
from diffabs.core.rules import Rule, order_rule

MIN_SETPOINT = 0.01  # of the first signal, of which an overshoot is a fraction


def no_integral(self: Any, memory: Memory, sample: Sample) -> Any:
    """`flow` of an objective without an integral."""
    del self, memory, sample
    return ()


def keep_memory(self: Any, memory: Memory, segment: Segment) -> Any:
    """`update` of an objective that is only an integral."""
    del self, segment
    return memory.held


def integral_value(self: Any, memory: Memory, ending: Ending) -> Scalar:
    """`value` of an objective that is only an integral."""
    del self, ending
    return memory.flow


def start_integral(self: Any, sample: Sample) -> Memory:
    """`start` of an objective that is only an integral."""
    del self
    return Memory(flow=0.0 * sample.output[0])


def tracking_error(sample: Sample) -> Scalar:
    """The first signal - setpoint."""
    return sample.output[0] - sample.setpoint


def highest_signal(output: Any) -> float:
    """The greatest value that the first signal can have; infinite where the output does not say."""
    return getattr(output, "highest", math.inf)


def _side(sample: Sample) -> Any:
    """-1 below a setpoint of 0, else 1."""
    return jnp.where(sample.setpoint < 0, -1.0, 1.0)


def absolute_integral(cubic: Cubic, integral: Callable[[Any], Any]) -> Any:
    """The integral of |p| over [0, 1], where `integral(x)` is that of p, or of p times something positive, to x."""
    whole = integral(1.0)
    left = integral(cubic.root())
    return jnp.where(cubic.start * cubic.end < 0, jnp.abs(left) + jnp.abs(whole - left), jnp.abs(whole))


def held_value(self: Any, memory: Memory, ending: Ending) -> Scalar:
    """`value` of an objective that is what it remembers."""
    del self, ending
    return memory.held


def start_held(self: Any, sample: Sample) -> Memory:
    """`start` of an objective that adds up what it sees."""
    del self
    return Memory(held=0.0 * sample.output[0])


@pytree
class IAE:
    """Integral of |e| dt, e = y - setpoint: for a slip [s]. The cubic of e is integrated on either side of its zero."""

    unit = "signal s"
    physical = (0.0, math.inf)

    start, flow, value = start_held, no_integral, held_value

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Add |e| over the step."""
        e = segment.error()
        return memory.held + segment.h * absolute_integral(e, e.integral)


@pytree
class ITAE:
    """Integral of t |e| dt, by the method of IAE: for a slip [s^2]."""

    unit = "signal s^2"
    physical = (0.0, math.inf)

    start, flow, value = start_held, no_integral, held_value

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Add t |e| over the step."""
        e, t, h = segment.error(), segment.start.t, segment.h
        return memory.held + h * absolute_integral(e, lambda x: t * e.integral(x) + h * e.moment(x))


class Sided(NamedTuple):
    """1, or -1 below a setpoint of 0; and the greatest value on that side."""

    side: Scalar
    greatest: Scalar


@pytree
class MaxSlip:
    """Greatest slip of the run [1], at most 1. Where the greatest of two maxima changes, its derivative jumps."""

    unit = "1"
    physical = (-1.0, 1.0)

    flow, value = no_integral, held_value

    def start(self, sample: Sample) -> Memory:
        """The first slip."""
        return Memory(held=sample.output.slip)

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """The greatest of the step, from its cubic."""
        slip = segment.output(lambda output: output.slip)
        return later_of_larger(memory.held, smaller(slip.greatest(), 1.0), slip.falls)


@pytree
class Overshoot:
    """max(0, max y/setpoint - 1), a fraction of the final setpoint [1], or of 0.01 where that is more: an estimator may
    end at a slip of 0. Where the first setpoint is negative, it is the same of -y. Zero derivative where there is none.
    """

    unit = "1"
    physical = (0.0, math.inf)

    flow = no_integral

    def start(self, sample: Sample) -> Memory:
        """The first value, and the side on which it shall not go too far."""
        side = _side(sample)
        return Memory(held=Sided(side, side * sample.output[0]))

    def update(self, memory: Memory, segment: Segment) -> Sided:
        """The greatest of the step, from its cubic."""
        side, greatest = memory.held
        signal = segment.output().times(side)
        value = smaller(signal.greatest(), highest_signal(segment.end.output))
        return Sided(side, later_of_larger(greatest, value, signal.falls))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Overshoot."""
        side, greatest = memory.held
        setpoint = side * ending.sample.setpoint
        usual = setpoint >= MIN_SETPOINT
        fraction = greatest / jnp.where(usual, setpoint, MIN_SETPOINT) - 1
        excess = jnp.where(usual, fraction, (greatest - setpoint) / MIN_SETPOINT)
        return jnp.where(excess > 0, excess, 0.0)


class Settling(NamedTuple):
    """The first value of the signal, and the last entry into the band [s]."""

    first: Scalar
    entered: Scalar


@pytree
class SettlingTime:
    """Time [s] after which |y - setpoint| stays within a band; infinite for a run that ends outside of it.

    The band is `share` of the step from the first value to the setpoint (2 % by default), or `band` where that is more.
    A run that starts on its setpoint has no step: it settles only if `band` is given. The entry is the root of the
    cubic of a step. A visit outside that begins and ends within one step is not seen. The time jumps where a lobe just
    touches the band.
    """

    unit = "s"
    physical = (0.0, math.inf)
    unreached = math.inf  # the value of a run that does not settle

    share: Scalar = param(default=0.02, unit="1", low=0.0, below=1.0)
    band: Scalar = param(default=0.0, unit="signal", low=0.0)

    flow = no_integral

    def start(self, sample: Sample) -> Memory:
        """Settled from the start."""
        return Memory(held=Settling(sample.output[0], 0.0 * sample.t))

    def update(self, memory: Memory, segment: Segment) -> Settling:
        """Note the last entry into the band."""
        first, entered = memory.held
        side = sign(jax.lax.stop_gradient(segment.error().start))
        excess = segment.shown(lambda shown: side * (shown.output[0] - shown.setpoint) - self._width(shown, first))
        entry = segment.start.t + segment.h * excess.root()
        return Settling(first, jnp.where(excess.start > 0, entry, entered))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """The last entry; infinite if the last sample is outside."""
        last = ending.sample
        outside = jnp.abs(tracking_error(last)) > self._width(last, memory.held.first)
        return jnp.where(outside, self.unreached, memory.held.entered)

    def _width(self, seen: Any, first: Scalar) -> Any:
        """Half the width of the band; `seen` has a setpoint."""
        return larger(self.share * jnp.abs(seen.setpoint - first), self.band)

    def problems(self) -> Iterator[str]:
        """A band without width."""
        if np.all(np.asarray(self.share) == 0) and np.all(np.asarray(self.band) == 0):
            yield "share and band are both 0; a settling time needs a band of some width"


@pytree
class ShareAtLimit:
    """Share of the run's time [1] for which the command stands at `low` or `high`, or beyond. A step with one end there
    counts by half. `at_limits` gives one with the limits of a loop."""

    unit = "1"
    physical = (0.0, 1.0)

    low: Scalar = param(default=-math.inf, unit="control", infinite=True)
    high: Scalar = param(default=math.inf, unit="control", infinite=True)

    start, flow = start_held, no_integral

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Add the step, or half of it."""
        ends = [(x.command <= self.low) | (x.command >= self.high) for x in (segment.start, segment.end)]
        return memory.held + segment.h * sum(jnp.where(end, 0.5, 0.0) for end in ends)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """The share; 0 for a run without length."""
        t = ending.sample.t
        return jnp.where(t > 0, memory.held / jnp.where(t > 0, t, 1.0), 0.0)

    def rules(self) -> Iterator[Rule]:
        """Limits that do not exclude each other."""
        yield order_rule(("low", self.low), ("high", self.high), "{control}")


def at_limits(loop: Any) -> ShareAtLimit:
    """Return the objective that measures for which share of a run the control of a loop is limited.

    loop: whose controller and actuator say their limits with a method `limits()`; the tightest count. A relay's two
        torques are levels, not limits.

    >>> import diffabs as d
    >>> from diffabs.objectives import at_limits
    >>> loop = d.braking()
    >>> run = d.measure(loop, d.FixedStep(1e-3, 4.0), {"at a limit": at_limits(loop)})
    >>> print(f"{run.metrics['at a limit']:.2f}")
    0.00
    """
    low, high = -math.inf, math.inf
    pending = [loop.controller, loop.actuator]
    while pending:
        one = pending.pop()
        pending.extend(parts(one))
        if hasattr(one, "limits"):
            below, above = one.limits()
            low, high = larger(low, below), smaller(high, above)
    return ShareAtLimit(low=low, high=high)


@pytree
class FinalError:
    """|y - setpoint| at the end."""

    unit = "signal"
    physical = (0.0, math.inf)

    flow, update = no_integral, keep_memory

    def start(self, sample: Sample) -> Memory:
        """Nothing to remember."""
        del sample
        return Memory()

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Final error."""
        del memory
        return jnp.abs(tracking_error(ending.sample))


class Quadratic(NamedTuple):
    """Integral of the error, and of the cost."""

    error: Scalar
    cost: Scalar


@pytree
class QuadraticCost:
    """Integral of q1 x1^2 + q2 x2^2 + r (u - ff)^2 dt, x1 = integral of e, x2 = e: eq. (24) of Maeda and Sugiura with
    eps = 0.

    u is what the actuator delivers.
    """

    unit = ""
    physical = (0.0, math.inf)

    q: Vector = param(default=(1.0, 1.0), unit="1", low=0.0)
    r: Scalar = param(default=1.0, unit="1", above=0.0)

    update = keep_memory

    def start(self, sample: Sample) -> Memory:
        """Zero."""
        return Memory(flow=Quadratic(*(0.0 * sample.output[0],) * 2))

    def flow(self, memory: Memory, sample: Sample) -> Quadratic:
        """e, and the integrand."""
        x1, x2, u = memory.flow.error, tracking_error(sample), sample.control - sample.feedforward
        return Quadratic(x2, self.q[0] * x1**2 + self.q[1] * x2**2 + self.r * u**2)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Cost."""
        del ending
        return memory.flow.cost

    def problems(self) -> Iterator[str]:
        """Weights of the wrong length."""
        if np.shape(self.q) != (2,):
            yield f"q has shape {np.shape(self.q)}; it needs (2,): integral and error"
