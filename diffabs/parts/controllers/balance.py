"""Feedback that balances a two-wheeler: of the whole state, or of the two angles that a vehicle can measure.

    BalanceFeedback     u = K x,   x = (theta, psi, phi, theta', psi', phi')
    ObserverFeedback    x^- = A x^ + B clamp(u),   x^ = x^- + L (y - C x^-),   u = K x^,   y = (theta, psi)

The sign convention is u = +K x, as in all of diffabs. `Sampled` runs the observer as a computer does; A and B are the
discrete-time matrices of one period. `diffabs.linear.lqg` computes K and L.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import clamp
from diffabs.core.protocols import BalanceOutput, Clock, Memory, Tracking, no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Array, Matrix, PyTree, Scalar, Vector

STATE_NAMES = ("theta", "psi", "phi", "theta_rate", "psi_rate", "phi_rate")
MEASURED_NAMES = ("theta", "psi")
# LQR gain of the paper's machine for Q = I, R = 1. The observer shares it as its default.
DEFAULT_BALANCE_GAIN = (24208.064, 2293.1921, 7667.1, 8683.2995, 889.36867, 2860.7285)


def state_of(output: BalanceOutput) -> Array:
    """Return the state x = (theta, psi, phi, theta', psi', phi') [rad, rad/s] from a plant output, shape (6,)."""
    return jnp.stack([getattr(output, name) for name in STATE_NAMES])


@pytree
class BalanceFeedback:
    """u = K x [V], with every angle and every rate measured. The default gain is an LQR's (Q = I, R = 1) for the
    paper's machine.

    The target and the feed-forward have no effect.
    """

    gain: Vector = param(default=DEFAULT_BALANCE_GAIN, unit="V/rad, V s/rad")
    """Gain K, shape (6,)."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return u = K x [V], without a limit. An actuator such as `VoltageLimit` limits it."""
        del t, memory
        terms = [k * getattr(signal.measured, name) for k, name in zip(self.gain, STATE_NAMES, strict=True)]
        return sum(terms[1:], terms[0])


class ObserverMemory(NamedTuple):
    """Memory of the observer.

    Attributes:
        state: Estimated state, shape (6,).
        voltage: Voltage u = K x^ for this estimate, before its limit [V].
    """

    state: PyTree
    voltage: Scalar


@pytree
class ObserverFeedback:
    """u = K x^: a steady-state Kalman filter in discrete time estimates the state x^ from theta and psi.

    The prediction uses the voltage clamped to +-predicted_high. The output itself has no limit. Without `Sampled`, the
    observer computes in every step of the integration, so A and B must be those of this step. The target and the
    feed-forward have no effect.
    """

    gain: Vector = param(default=DEFAULT_BALANCE_GAIN, unit="V/rad, V s/rad")
    """Gain K, shape (6,)."""
    transition: Matrix = param(default=np.eye(6), unit="1")
    """Matrix A of the prediction, shape (6, 6)."""
    entry: Vector = param(default=np.zeros(6), unit="rad/V, rad/(s V)")
    """Column B of the prediction, shape (6,)."""
    correction: Matrix = param(default=np.eye(6)[:, :2], unit="1, 1/s")
    """Kalman gain L, shape (6, 2)."""
    predicted_high: Scalar = param(default=np.inf, unit="V", above=0.0, infinite=True)
    """Upper limit of the voltage in the prediction; the lower one is its negative."""

    every_step = True
    flow = no_flow

    def start(self, signal: Tracking) -> Memory:
        """Return the measured angles as the estimate, with phi, all rates and the voltage 0."""
        zero = 0.0 * signal.target
        angles = [getattr(signal.measured, name) if name in MEASURED_NAMES else zero for name in STATE_NAMES]
        return Memory(held=ObserverMemory(jnp.stack(angles), zero))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return u = K x^ [V] for the latest estimate, without a limit; 0 before the first tick."""
        del t, signal
        return memory.held.voltage

    def tick(self, clock: Clock, memory: Memory, signal: Tracking) -> Memory:
        """Return the memory after a sample; the first sets the estimate to the measured angles, with zero rates.

        The memory from `start` cannot serve as the first estimate, because a sensor adds no noise before its first
        sample.
        """
        now, number = clock.ticks()
        estimate: ObserverMemory = memory.held
        voltage = clamp(estimate.voltage, -self.predicted_high, self.predicted_high)
        predicted = self.transition @ estimate.state + self.entry * voltage
        error = jnp.stack(
            [getattr(signal.measured, name) - predicted[STATE_NAMES.index(name)] for name in MEASURED_NAMES]
        )
        state = jnp.where(number > 0, predicted + self.correction @ error, self.start(signal).held.state)
        new = ObserverMemory(state, self.gain @ state)
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(now, a, b), new, estimate))
