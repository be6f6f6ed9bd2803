"""Feedback that holds a two-wheeler upright: of the whole state, or of the two angles that a vehicle can measure.

    BalanceFeedback     u = K x,   x = (theta, psi, phi, theta', psi', phi')
    ObserverFeedback    x^- = A x^ + B clamp(u),   x^ = x^- + L (y - C x^-),   u = K x^,   y = (theta, psi)

The sign is that of the rest of the package: u = +K x. An observer is a computer's: `Sampled` runs it, and A, B are
those of one period. `diffabs.linear.lqg` computes K and L.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import clamp
from diffabs.core.protocols import BalanceOutput, Clock, Memory, Tracking, no_flow, no_memory
from diffabs.core.pytree import Matrix, Scalar, Vector, param, pytree

STATE_NAMES = ("theta", "psi", "phi", "theta_rate", "psi_rate", "phi_rate")
MEASURED_NAMES = ("theta", "psi")
# K of the paper's machine for Q = I, R = 1, and the machine at rest, so that an observer has a default.
DEFAULT_BALANCE_GAIN = (24208.064, 2293.1921, 7667.1, 8683.2995, 889.36867, 2860.7285)


def state_of(output: BalanceOutput) -> Any:
    """x (6,)."""
    return jnp.stack([getattr(output, name) for name in STATE_NAMES])


@pytree
class BalanceFeedback:
    """u = K x [V]: every angle and every rate is measured. The default gain is an LQR's (Q = I, R = 1) for the paper's
    machine."""

    gain: Vector = param(default=DEFAULT_BALANCE_GAIN, unit="V/rad, V s/rad")

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Voltage [V]."""
        del t, memory
        terms = [k * getattr(signal.measured, name) for k, name in zip(self.gain, STATE_NAMES, strict=True)]
        return sum(terms[1:], terms[0])

    def problems(self) -> Iterator[str]:
        """A gain of the wrong length."""
        yield from _shape_problems(self, gain=(6,))


class ObserverMemory(NamedTuple):
    """Estimated state (6,), and the voltage that was asked for at it."""

    state: Any
    voltage: Scalar


@pytree
class ObserverFeedback:
    """u = K x^, x^ from theta and psi by a steady Kalman filter in discrete time; it knows the voltage's limit. It
    computes in every step of the integration unless it is `Sampled`."""

    gain: Vector = param(default=DEFAULT_BALANCE_GAIN, unit="V/rad, V s/rad")
    transition: Matrix = param(default=np.eye(6), unit="1")
    entry: Vector = param(default=np.zeros(6), unit="rad/V, rad/(s V)")
    correction: Matrix = param(default=np.eye(6)[:, :2], unit="1, 1/s")
    voltage_max: Scalar = param(default=np.inf, unit="V", above=0.0, infinite=True)

    every_step = True
    flow = no_flow

    def start(self, signal: Tracking) -> Memory:
        """At the measured angles, the rest zero."""
        zero = 0.0 * signal.target
        angles = [getattr(signal.measured, name) if name in MEASURED_NAMES else zero for name in STATE_NAMES]
        return Memory(held=ObserverMemory(jnp.stack(angles), zero))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Voltage [V]."""
        del t, signal
        return memory.held.voltage

    def tick(self, clock: Clock, memory: Memory, signal: Tracking) -> Memory:
        """Begin at the angles of the first sample; then predict from the last sample and correct by this one.

        The memory of `start` does not serve: a sensor has no noise before its first sample.
        """
        now, number = clock.ticks()
        estimate: ObserverMemory = memory.held
        voltage = clamp(estimate.voltage, -self.voltage_max, self.voltage_max)
        predicted = self.transition @ estimate.state + self.entry * voltage
        error = jnp.stack(
            [getattr(signal.measured, name) - predicted[STATE_NAMES.index(name)] for name in MEASURED_NAMES]
        )
        state = jnp.where(number > 0, predicted + self.correction @ error, self.start(signal).held.state)
        new = ObserverMemory(state, self.gain @ state)
        return Memory(held=jax.tree.map(lambda a, b: jnp.where(now, a, b), new, estimate))

    def problems(self) -> Iterator[str]:
        """Arrays of the wrong shape."""
        yield from _shape_problems(self, gain=(6,), transition=(6, 6), entry=(6,), correction=(6, 2))


def _shape_problems(part: Any, **shapes: tuple[int, ...]) -> Iterator[str]:
    for name, shape in shapes.items():
        found = np.shape(getattr(part, name))
        if found != shape:
            yield f"{name} has shape {found}; it needs {shape}, for {', '.join(STATE_NAMES)}"
