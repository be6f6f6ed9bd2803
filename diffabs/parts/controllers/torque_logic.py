"""Anti-lock logics that change the brake torque at a rate: four phases, and a band of the slip.

`FourPhase`, a hybrid automaton:

    raise      u' = rate     until u reaches torque_high
    hold       u' = 0        until the slip rises to slip_high
    lower      u' = -rate    until u falls to torque_low
    hold       u' = 0        until the slip falls to slip_low; then again from the top

It skips a hold that is already over. It has a limit cycle on a road with the wheel's torque balance
Psi(slip) = (r + (1 - slip) J/(m r)) m g mu(slip) if

    torque_high > max Psi,   torque_low < Psi on [slip_low, slip_high],
    and the slip at the end of `lower` is below the unstable equilibrium of torque_low.

Source: M. Tanelli, G. Osorio, M. di Bernardo, S. M. Savaresi and A. Astolfi, Existence, stability and robustness
analysis of limit cycles in hybrid anti-lock braking systems, Int. J. Control 82 (2009).

`BandLogic`, a rule with a dead band:

    u' = growth u  for slip < slip_low,   u' = -decay u  for slip > slip_high,   else u' = 0

At high the growth stops. Inside a `sampled` controller of period T, one sample multiplies u by 1 + growth T or by
1 - decay T. Both must be positive: decay T < 1. The usual programs with this rule do so.
"""

from collections.abc import Iterator

import jax.numpy as jnp

from diffabs.core.numerics import clamp, smaller
from diffabs.core.protocols import Memory, Tracking
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import Rule, order_rule
from diffabs.core.types import PyTree, Scalar


@pytree
class FourPhase:
    """Raise the torque, hold it until the slip is high, lower it, hold it until the slip is low.

    It skips a hold that is already over. The target has no effect.
    """

    torque_low: Scalar = param(default=600.0, unit="control", low=0.0)
    """Torque at which the brake stops lowering."""
    torque_high: Scalar = param(default=900.0, unit="control", above=0.0)
    """Torque at which the brake stops raising, > torque_low."""
    slip_low: Scalar = param(default=0.08, unit="signal", above=0.0)
    """Slip that ends the second hold."""
    slip_high: Scalar = param(default=0.35, unit="signal", above=0.0)
    """Slip that ends the first hold, > slip_low."""
    rate: Scalar = param(default=5000.0, unit="control/s", above=0.0)
    """Rate of the torque."""

    def start(self, signal: Tracking) -> Memory:
        """Return torque 0 in the first phase."""
        zero = 0.0 * signal.measured[0]
        return Memory(flow=zero, held=zero)

    def flow(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the rate of the torque [control/s] in the present phase."""
        del t, signal
        phase = memory.held
        return self.rate * (jnp.where(phase == 0, 1.0, 0.0) - jnp.where(phase == 2, 1.0, 0.0))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the torque [N m]."""
        del t, signal
        return clamp(memory.flow, 0.0, self.torque_high)

    def limits(self) -> tuple[Scalar, Scalar]:
        """Return the lower and the upper limit of the control."""
        return 0.0 * self.torque_high, self.torque_high

    def margins(self, t: Scalar, memory: Memory, signal: Tracking, rate: object) -> tuple[PyTree, PyTree]:
        """Return the rest of a change of the torque [control], and the rest of the slip of a hold [signal].

        The margin that does not belong to the present phase is 1.
        """
        del t, rate
        phase, slip = memory.held, signal.measured[0]
        torque = jnp.where(phase == 0, self.torque_high - memory.flow, memory.flow - self.torque_low)
        hold = jnp.where(phase == 1, self.slip_high - slip, slip - self.slip_low)
        changes = (phase == 0) | (phase == 2)
        return jnp.where(changes, torque, 1.0), jnp.where(changes, 1.0, hold)

    def event(self, t: Scalar, memory: Memory, signal: Tracking, fired: tuple[PyTree, PyTree]) -> Memory:
        """Return the memory in the next phase, after a hold that is over, if an event of this phase has fired."""
        del t
        phase, slip = memory.held, signal.measured[0]
        phase_ends = jnp.where((phase == 0) | (phase == 2), fired[0], fired[1])
        reached = jnp.where(phase == 0, self.torque_high, jnp.where(phase == 2, self.torque_low, memory.flow))
        # A hold whose edge the slip has already passed would never end: no margin falls through zero.
        passed = jnp.where(phase == 0, slip >= self.slip_high, (phase == 2) & (slip <= self.slip_low))
        following = phase + jnp.where(passed, 2.0, 1.0)
        following = jnp.where(following > 3, 0.0, following)
        return Memory(jnp.where(phase_ends, reached, memory.flow), jnp.where(phase_ends, following, phase))

    def rules(self) -> Iterator[Rule]:
        """Yield the rules torque_low < torque_high and slip_low < slip_high."""
        yield order_rule(("torque_low", self.torque_low), ("torque_high", self.torque_high), "{control}", equal=False)
        yield order_rule(("slip_low", self.slip_low), ("slip_high", self.slip_high), "{signal}", equal=False)


@pytree
class BandLogic:
    """The torque grows below a band of the slip, decays above it, and stays within. The target has no effect."""

    slip_low: Scalar = param(default=0.145, unit="signal", above=0.0)
    """Lower edge of the band."""
    slip_high: Scalar = param(default=0.155, unit="signal", above=0.0)
    """Upper edge of the band, > slip_low."""
    growth: Scalar = param(default=0.5, unit="1/s", above=0.0)
    """Relative rate of the torque below the band."""
    decay: Scalar = param(default=1.2, unit="1/s", above=0.0)
    """Relative rate of its fall above the band."""
    torque: Scalar = param(default=800.0, unit="control", above=0.0)
    """Control at the start."""
    high: Scalar = param(default=1e5, unit="control", above=0.0)
    """Upper limit of the control."""

    jumps = True

    def start(self, signal: Tracking) -> Memory:
        """Return the torque at the start, at most `high`."""
        return Memory(flow=smaller(self.torque, self.high) + 0.0 * signal.measured[0])

    def flow(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the rate of the torque [control/s]: no growth at `high`, from which it thus falls at once."""
        del t
        slip = signal.measured[0]
        above = jnp.where(slip > self.slip_high, -self.decay, 0.0)
        grows = (slip < self.slip_low) & (memory.flow < self.high)
        return memory.flow * jnp.where(grows, self.growth, above)

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the torque [N m]."""
        del t, signal
        return clamp(memory.flow, 0.0, self.high)

    def limits(self) -> tuple[Scalar, Scalar]:
        """Return the lower and the upper limit of the control."""
        return 0.0 * self.high, self.high

    def rules(self) -> Iterator[Rule]:
        """Yield the rule slip_low < slip_high."""
        yield order_rule(("slip_low", self.slip_low), ("slip_high", self.slip_high), "{signal}", equal=False)
