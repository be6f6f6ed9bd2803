"""Anti-lock logic that compares the rim's acceleration and the slip with thresholds, and commands a valve.

Every period T, with the rim's speed w and its filtered acceleration a,

    a_k = a_(k-1) + T/(T + time_constant) ((w_k - w_(k-1))/T - a_(k-1)),

    phase       command         leaves it for                               where
    BUILD       1               HOLD                                        a < -a1
    HOLD        0               DUMP                                        slip > slip_low
                                SLOW_BUILD                                  a >= -a1
    DUMP        -1              RECOVER                                     a > a2
                                WAIT                                        a >= -a1 and slip <= slip_high
    WAIT        0               DUMP                                        a < -a1 or slip > slip_high
                                RECOVER                                     a > a2
                                SLOW_BUILD                                  slip < slip_low
    RECOVER     1 for a > a3    SLOW_BUILD                                  a <= a2
                0 otherwise
    SLOW_BUILD  opening         DUMP                                        a < -a1

The first row that holds counts. Below `lowest_speed` the logic builds. A locked wheel has a = 0; slip_high keeps the
outlet open for it. The thresholds must not be near the acceleration of the car: a1 must exceed the greatest mu g.

The cycle of build, hold, dump, hold until a2 is passed, and slow build is that of production systems; there WAIT
and RECOVER are one phase. The two ways out of a hold by the slip, and slip_high, are additions for roads on which the
wheel recovers slowly.

Phases change at ticks only. So a run is no continuous function of the thresholds, and they are not tunable by
derivatives. Sources: U. Kiencke and L. Nielsen, Automotive Control Systems, 2nd ed., control cycles of the anti-lock
brake; M. Burckhardt, Fahrwerktechnik: Radschlupf-Regelsysteme, 1993.
"""

from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.protocols import Clock, Memory, Tracking, no_flow
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import Rule, order_rule, period_on_grid
from diffabs.core.types import PyTree, Scalar


class BrakePhase(IntEnum):
    """The phases of `FivePhase`; the fourth one has two parts."""

    BUILD = 0
    HOLD = 1
    DUMP = 2
    WAIT = 3
    RECOVER = 4
    SLOW_BUILD = 5


class ThresholdMemory(NamedTuple):
    """Memory of the threshold logic.

    Attributes:
        phase: Number of the `BrakePhase`.
        wheel_speed: Speed of the rim at the latest tick [m/s].
        acceleration: Filtered acceleration of the rim [m/s^2].
    """

    phase: Scalar
    wheel_speed: Scalar
    acceleration: Scalar


@pytree
class FivePhase:
    """Build, hold, dump, hold until the wheel has recovered, build slowly. The target has no effect.

    See also:
        `actuators.HydraulicBrake`: The brake whose valve this logic commands.
        `controllers.FourPhase`: A logic that changes a torque at a rate.

    Examples:
        >>> from diffabs.parts.controllers import FivePhase, PerChannel
        >>> from diffabs.parts.plants.half_car import CHANNELS
        >>> logic = PerChannel(FivePhase(opening=0.2), CHANNELS)
        >>> logic.controller.period
        0.005
    """

    braking_threshold: Scalar = param(default=25.0, unit="m/s^2", above=0.0, tunable=False)
    """Deceleration a1 of the rim that ends a build."""
    recovery_threshold: Scalar = param(default=5.0, unit="m/s^2", above=0.0, tunable=False)
    """Acceleration a2 of a rim that recovers."""
    strong_threshold: Scalar = param(default=20.0, unit="m/s^2", above=0.0, tunable=False)
    """Acceleration a3 of the rim above which the inlet opens fully, > recovery_threshold."""
    slip_low: Scalar = param(default=0.1, unit="1", above=0.0, tunable=False)
    """Slip that ends the first hold."""
    slip_high: Scalar = param(default=0.25, unit="1", above=0.0, below=1.0, tunable=False)
    """Slip above which the logic dumps, > slip_low."""
    opening: Scalar = param(default=0.15, unit="1", above=0.0, high=1.0)
    """Opening of the inlet in the slow build."""
    time_constant: Scalar = param(default=0.01, unit="s", low=0.0, tunable=False)
    """Time constant of the acceleration's low-pass filter."""
    lowest_speed: Scalar = param(default=2.0, unit="m/s", low=0.0, tunable=False)
    """Speed of the vehicle below which the logic builds."""
    period: Scalar = param(default=5e-3, unit="s", above=0.0, tunable=False)
    """Period of the ticks T, a whole multiple of the integration step."""

    flow = no_flow
    grid_rules = period_on_grid

    def start(self, signal: Tracking) -> Memory:
        """Return the memory in the first build, with no acceleration."""
        rim = signal.measured.wheel_speed
        return Memory(held=ThresholdMemory(0.0 * rim, rim, 0.0 * rim))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the command of the valve, in [-1, 1]."""
        del t, signal
        phase, _, acceleration = memory.held
        strong = (phase == BrakePhase.RECOVER) & (acceleration > self.strong_threshold)
        slowly = jnp.where(phase == BrakePhase.SLOW_BUILD, self.opening, 0.0)
        closed = jnp.where(phase == BrakePhase.DUMP, -1.0, slowly)
        return jnp.where((phase == BrakePhase.BUILD) | strong, 1.0, closed)

    def tick(self, clock: Clock, memory: Memory, signal: Tracking) -> Memory:
        """Return the memory with a new acceleration and phase if a period begins, else the old memory."""
        now, _ = clock.ticks(self.period)
        m, wheel = memory.held, signal.measured
        change = (wheel.wheel_speed - m.wheel_speed) / self.period
        share = self.period / (self.period + self.time_constant)
        acceleration = m.acceleration + share * (change - m.acceleration)
        phase = self._follow_phase(m.phase, acceleration, wheel.slip)
        phase = jnp.where(wheel.speed < self.lowest_speed, 1.0 * BrakePhase.BUILD, phase)
        new = ThresholdMemory(phase, wheel.wheel_speed, acceleration)
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(now, a, b), new, m))

    def rules(self) -> Iterator[Rule]:
        """Yield the rules recovery_threshold < strong_threshold and slip_low < slip_high."""
        recovery, strong = ("recovery_threshold", self.recovery_threshold), ("strong_threshold", self.strong_threshold)
        yield order_rule(recovery, strong, "m/s^2", equal=False)
        yield order_rule(("slip_low", self.slip_low), ("slip_high", self.slip_high), "1", equal=False)

    def _follow_phase(self, phase: Scalar, acceleration: Scalar, slip: Scalar) -> Scalar:
        """Return the phase after a tick."""
        brakes, recovers = acceleration < -self.braking_threshold, acceleration > self.recovery_threshold
        rolls, locks = jnp.logical_not(brakes), slip > self.slip_high
        ways: dict[BrakePhase, list[tuple[BrakePhase, PyTree]]] = {
            BrakePhase.BUILD: [(BrakePhase.HOLD, brakes)],
            BrakePhase.HOLD: [
                (BrakePhase.DUMP, slip > self.slip_low),
                (BrakePhase.SLOW_BUILD, rolls),
            ],
            BrakePhase.DUMP: [(BrakePhase.RECOVER, recovers), (BrakePhase.WAIT, jnp.logical_not(brakes | locks))],
            BrakePhase.WAIT: [
                (BrakePhase.DUMP, brakes | locks),
                (BrakePhase.RECOVER, recovers),
                (BrakePhase.SLOW_BUILD, slip < self.slip_low),
            ],
            BrakePhase.RECOVER: [(BrakePhase.SLOW_BUILD, jnp.logical_not(recovers))],
            BrakePhase.SLOW_BUILD: [(BrakePhase.DUMP, brakes)],
        }
        following = phase
        for present, exits in ways.items():
            for target, leaves in reversed(exits):
                following = jnp.where((phase == present) & leaves, 1.0 * target, following)
        return following
