"""What the parts of a loop hand each other: what plants show, the memory of a block, the instant at which it may
change, the samples and segments of a run. Imported from `core.protocols`, the page of contracts."""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.cubic import Cubic
from diffabs.core.pytree import Scalar
from diffabs.core.timing import steps_in_period


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
        n = steps_in_period(period, self.h)
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
    and integrals are those of the run to the order of the method. `smooth`: no limit is reached within, either, because
    the step would end there; else the cubic of a signal that has limits may leave them. `within`: whether the
    rates at the start, and those at the end, are those within the step, also where a limit is reached there. Where one
    is not, the cubic is the parabola through both ends with the other rate; without either, the line."""

    start: Sample
    end: Sample
    h: Scalar
    step: Scalar
    shown_rates: Callable[[], tuple[Shown, Shown]]
    sample_rates: Callable[[], tuple[Sample, Sample]]
    smooth: Any = False
    within: tuple[Any, Any] = (True, True)

    def output(self, read: Callable[[Any], Scalar] = lambda output: output[0]) -> Cubic:
        """The cubic of read(output): by default of the first signal that the plant shows."""
        start, end = self.shown_rates()
        return self._cubic(read, (self.start.output, self.end.output), (start.output, end.output))

    def error(self) -> Cubic:
        """The cubic of the first signal - setpoint, which a reference may move within a step."""
        return self.shown(lambda shown: shown.output[0] - shown.setpoint)

    def shown(self, read: Callable[[Shown], Scalar]) -> Cubic:
        """The cubic of read(shown): of what the plant shows and the setpoint of its first signal."""
        return self._cubic(read, (Shown.of(self.start), Shown.of(self.end)), self.shown_rates())

    def sample(self, read: Callable[[Sample], Scalar]) -> Cubic:
        """The cubic of read(sample): of anything seen. It costs the rates of all signals."""
        return self._cubic(read, (self.start, self.end), self.sample_rates())

    def _cubic(self, read: Callable[[Any], Scalar], ends: tuple[Any, Any], rates: tuple[Any, Any]) -> Cubic:
        (a, da), (b, db) = (jax.jvp(read, (end,), (rate,)) for end, rate in zip(ends, rates, strict=True))
        first, last, rise, (start, end) = self.h * da, self.h * db, b - a, self.within
        if start is True and end is True:
            return Cubic(a, b, first, last)
        return Cubic(
            a,
            b,
            jnp.where(start, first, jnp.where(end, 2.0 * rise - last, rise)),
            jnp.where(end, last, jnp.where(start, 2.0 * rise - first, rise)),
        )


def resting_segment(sample: Sample, h: Scalar) -> Segment:
    """Return a step of length h [s] in which nothing moves."""
    sample = jax.tree.map(jnp.asarray, sample)
    rest = jax.tree.map(jnp.zeros_like, sample)
    return Segment(sample, sample, h, h, lambda: (Shown.of(rest), Shown.of(rest)), lambda: (rest, rest))
