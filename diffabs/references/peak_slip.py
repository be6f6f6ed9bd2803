"""References that find the best slip: the slip at which the measured deceleration was greatest.

Aoki and Nakamura, sec. 4, fig. 5: a running maximum of the deceleration |a|; when it is exceeded, the target becomes
the present slip. Read literally this cannot brake: while friction rises the target equals the slip, the error is zero,
and the car rolls on. `PeakLiteral` shows that. `PeakLatch` is the reading that reproduces the paper's table 2: brake
with the first target until |a| first falls below its maximum, then take the slip at that maximum. `PeakRobust` is the
latch for a noisy accelerometer.

The maximum lies between samples. The latch takes the vertex of the parabola through the last three decelerations, for
the slip and for the moment, and hands the time since that moment to the loop. Without this, values would depend on the
step and derivatives would be wrong by O(1) at every step size."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from diffabs.core.numerics import clamp, interpolate, parabola, ratio
from diffabs.core.protocols import BrakeOutput, Clock, Jump, Memory, no_flow
from diffabs.core.pytree import Scalar, param, pytree

# A later maximum counts only if it exceeds the greatest by this fraction: a controller that holds the best slip keeps
# the deceleration at its maximum to rounding, and comparisons of equal numbers would then decide on derivatives.
MARGIN = 1e-6


class PeakMemory(NamedTuple):
    """1 once latched; greatest |a| [m/s^2] and the slip [1] there; target [1]; the last two samples."""

    latched: Scalar
    greatest: Scalar
    slip: Scalar
    target: Scalar
    deceleration: tuple[Scalar, Scalar]
    slips: tuple[Scalar, Scalar]


def _size(signal: BrakeOutput) -> Any:
    """|a|, as the paper has it. It matters where the accelerometer has a forward bias: it shows an acceleration before
    the wheel slips, whose size falls before it rises."""
    return jnp.abs(signal.deceleration)


def _fresh(target: Scalar, deceleration: Scalar, slip: Scalar) -> PeakMemory:
    zero = 0.0 * deceleration
    return PeakMemory(zero, zero, slip, target + zero, (deceleration,) * 2, (slip,) * 2)


@pytree
class PeakLiteral:
    """The estimator as printed: whenever |a| exceeds its maximum, target := slip. It does not brake; kept as
    evidence."""

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)

    every_step = True  # how little it brakes is the delay of one sample
    flow = no_flow

    def start(self, signal: BrakeOutput) -> Memory:
        """Maximum so far: the first sample."""
        size = _size(signal)
        return Memory(held=_fresh(self.slip, size, signal.slip)._replace(greatest=size))

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Target slip [1]."""
        del t, signal
        return memory.held.target

    def setpoint(self, memory: Memory) -> Scalar:
        """The target as known now."""
        return memory.held.target

    def jump(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Jump:
        """Follow the slip while |a| rises."""
        del clock
        m: PeakMemory = memory.held
        size = _size(signal)
        exceeds = size > m.greatest
        greatest = jnp.where(exceeds, size, m.greatest)
        target = jnp.where(exceeds, signal.slip, m.target)
        return Jump(Memory(held=m._replace(greatest=greatest, target=target)))


@pytree
class PeakLatch:
    """target = slip until |a| first falls, then the slip at its maximum; a later, greater one moves the target there.

    For an exact accelerometer: noise of 0.05 m/s^2 at 1 kHz latches at once and at the wrong slip. So does a forward
    bias, under which |a| falls through zero before it rises.
    """

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)

    flow = no_flow
    output = PeakLiteral.output
    setpoint = PeakLiteral.setpoint

    def start(self, signal: BrakeOutput) -> Memory:
        """No maximum yet."""
        return Memory(held=_fresh(self.slip, _size(signal), signal.slip))

    def jump(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Jump:
        """Latch at a maximum greater than all before."""
        m: PeakMemory = memory.held
        place, higher, new = _tracked(m, _size(signal), signal.slip, clock.k == 0)
        new = new._replace(
            latched=jnp.where(higher, 1.0, m.latched),
            target=jnp.where(higher, new.slip, m.target),
        )
        return Jump(Memory(held=new), jnp.where(higher, (1 - place) * clock.h, 0.0))


class FilterMemory(NamedTuple):
    """Low-passed deceleration [m/s^2] and slip [1]."""

    deceleration: Scalar
    slip: Scalar


@pytree
class PeakRobust:
    """The latch for noisy and biased sensors: deceleration (with its sign: the size of noise has a mean) and slip pass
    the same low-pass (so their delays cancel), nothing happens below `arming`, and the fall must exceed the fraction
    `threshold` of the maximum."""

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)
    time_constant: Scalar = param(default=0.02, unit="s", above=0.0)
    threshold: Scalar = param(default=0.03, unit="1", above=0.0, below=1.0)
    arming: Scalar = param(default=3.0, unit="m/s^2", low=0.0, tunable=False)

    output = PeakLiteral.output
    setpoint = PeakLiteral.setpoint

    def start(self, signal: BrakeOutput) -> Memory:
        """Filters at the first sample."""
        flow = FilterMemory(signal.deceleration, signal.slip)
        return Memory(flow, _fresh(self.slip, *flow))

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> FilterMemory:
        """First-order low-pass of both signals."""
        del t
        a, s = memory.flow
        return FilterMemory((signal.deceleration - a) / self.time_constant, (signal.slip - s) / self.time_constant)

    def jump(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Jump:
        """Keep the maximum, latch at the threshold below it."""
        m: PeakMemory = memory.held
        a, s = memory.flow
        _, higher, new = _tracked(m, a, s, clock.k == 0)
        level = (1 - self.threshold) * new.greatest
        latch = (m.latched < 0.5) & (new.greatest > self.arming) & (a < level)
        late = clamp(ratio(level - a, m.deceleration[0] - a), 0.0, 1.0)
        moved = latch | ((m.latched > 0.5) & higher)
        new = new._replace(
            latched=jnp.where(latch, 1.0, m.latched),
            target=jnp.where(moved, new.slip, m.target),
        )
        return Jump(Memory(memory.flow, new), jnp.where(latch, late * clock.h, 0.0))


def _tracked(m: PeakMemory, deceleration: Scalar, slip: Scalar, first: Any) -> tuple[Any, Any, PeakMemory]:
    """Look for a maximum among the last three samples, greater than all before: its place (in steps from the middle
    one), whether there is one, and the memory with it.

    Where the deceleration did not rise before it fell, as at the start of a run, the maximum is the middle sample. The
    first sample decides nothing: it would be compared with itself, and compiled code may compute it twice and round it
    differently, in the forward and in the backward pass of a gradient for instance.
    """
    before, last = m.deceleration[1], m.deceleration[0]
    place = jnp.where(before < last, parabola(before, last, deceleration)[0], 0.0)
    top = interpolate(before, last, deceleration, place)
    higher = ~first & (deceleration < last) & (last >= before) & (top > (1 + MARGIN) * m.greatest)
    new = m._replace(
        greatest=jnp.where(higher, top, m.greatest),
        slip=jnp.where(higher, interpolate(m.slips[1], m.slips[0], slip, place), m.slip),
        deceleration=(deceleration, jnp.where(first, deceleration, last)),
        slips=(slip, jnp.where(first, slip, m.slips[0])),
    )
    return place, higher, new
