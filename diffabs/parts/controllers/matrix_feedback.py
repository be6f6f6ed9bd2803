"""State feedback with a full gain matrix, for plants with one or several inputs.

    u = clamp(ff + K (z, x - x0), low, high),   z' = y - r + E (u - u_raw)

z has one integral for each target r, x is the state: measured outputs, or an estimate. The sign is u = + K x, as in
`StateFeedback`. At a limit the matrix E changes the integrals. With K = (Kz, Kx) and a square Kz, E = Kz^-1/Tt lets
the excess of each control decay with the time constant Tt (back-calculation for several inputs).

Source: K. J. Astrom and R. M. Murray, Feedback Systems, 2nd ed. (2021), sec. 7.4 (integral action), sec. 8.2 and 8.3
(observer, Kalman filter).
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.arrays import as_rule_array
from diffabs.core.channels import outputs_like
from diffabs.core.numerics import clamp
from diffabs.core.protocols import Memory, Tracking
from diffabs.core.pytree import param, pytree, static
from diffabs.core.rules import Rule
from diffabs.core.types import Array, Matrix, PyTree, Scalar, Vector


class MatrixGain:
    """Base of controllers with a gain for integrals and state, and limits of each control."""

    gain: Matrix
    windup: Matrix
    low: Vector
    high: Vector

    def commands(self, integrals: Array, state: Array, signal: Tracking) -> tuple[Array, Array]:
        """Return the commands before and after the limits, shape (m,), for a state relative to rest."""
        ahead = as_vector(signal.feedforward)
        m, p, n = len(ahead), len(integrals), len(state)
        needs = f"{m} controls, {p} targets and {n} states"
        for name, shape in {"gain": (m, p + n), "windup": (p, m), "low": (m,), "high": (m,)}.items():
            expect_shape(self, name, shape, needs)
        raw = ahead + jnp.asarray(self.gain) @ jnp.concatenate([integrals, state])
        limited: Any = clamp(raw, jnp.asarray(self.low), jnp.asarray(self.high))
        return raw, limited

    def limits(self) -> tuple[Vector, Vector]:
        """Return the lower and the upper limits of the controls."""
        return self.low, self.high

    def rules(self) -> Iterator[Rule]:
        """Yield the rule low <= high."""
        low, high = as_rule_array(self.low), as_rule_array(self.high)
        if low.shape == high.shape:
            line = "low exceeds high for a control"
            yield Rule((low <= high).all(), line, lambda: line)

    def integral_rates(self, raw: Array, limited: Array, signal: Tracking) -> Array:
        """Return z', shape (p,), as the limits change it."""
        errors = as_vector(outputs_like(signal.measured, signal.target)) - as_vector(signal.target)
        return errors + jnp.asarray(self.windup) @ (limited - raw)


def expect_shape(part: object, name: str, shape: tuple[int, ...], needs: str) -> None:
    """Raise a ValueError for a field of another shape; `needs` says what decides it."""
    if (actual := np.shape(getattr(part, name))) != shape:
        raise ValueError(f"controller.{name} has shape {actual}; {shape} is needed, for {needs}")


@pytree
class MatrixFeedback(MatrixGain):
    """u = clamp(ff + K (z, x - x0), low, high), where x are measured outputs and z the integrals of the errors.

    See also:
        `linear.lqr`: The gain for weights of states and controls.
        `controllers.ObservedFeedback`: The same with an estimated state.

    Notes:
        The order of the controls is that of the plant's `controls`, the order of z that of the target's fields. A
        `references.PerTarget` has them in alphabetical order.
    """

    gain: Matrix = param(default=np.zeros((1, 1)), unit="1", free=True)
    """Gain K, shape (m, p + n): columns of the p integrals, then of the n states. An entry is in the unit of its
    control per unit of its integral or state."""
    outputs_at_rest: Vector = param(default=np.zeros(0), unit="1", free=True)
    """Outputs at rest x0, shape (n,), each in its unit."""
    windup: Matrix = param(default=np.zeros((1, 1)), unit="1", free=True)
    """Matrix E of the anti-windup, shape (p, m); zeros for none."""
    low: Vector = param(default=(-1.0,), unit="control", infinite=True, free=True)
    """Lower limit of the control, shape (m,), one for each."""
    high: Vector = param(default=(1.0,), unit="control", infinite=True, free=True)
    """Upper limit of the control, shape (m,), one for each."""
    states: tuple[str, ...] = static(default=())
    """Names of the outputs that are the states x, n of them."""

    def start(self, signal: Tracking) -> Memory:
        """Return the memory with integrals of 0."""
        return Memory(flow=0.0 * as_vector(signal.target))

    def flow(self, t: Scalar, memory: Memory, signal: Tracking) -> Array:
        """Return z', shape (p,)."""
        del t
        return self.integral_rates(*self._commands(memory, signal), signal)

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> PyTree:
        """Return the limited commands."""
        del t
        return like_signal(self._commands(memory, signal)[1], signal.feedforward)

    def _commands(self, memory: Memory, signal: Tracking) -> tuple[Array, Array]:
        expect_shape(self, "outputs_at_rest", (len(self.states),), f"the states {', '.join(self.states)}")
        state = read_outputs(signal, self.states)
        return self.commands(memory.flow, state - jnp.asarray(self.outputs_at_rest), signal)


class Estimate(NamedTuple):
    """Continuous memory of a controller with an observer: integrals z, shape (p,), and estimated state, shape (n,)."""

    integrals: Any
    state: Any


@pytree
class ObservedFeedback(MatrixGain):
    """u = clamp(ff + K (z, x^), low, high), where an observer estimates x^ from measured outputs y.

        x^' = A x^ + B (u - ff) + L (y - y0 - C x^)

    The state is that of a linear model around rest, so x^ = 0 and y = y0 there. The observer gets the limited command,
    so that it stays right at a limit. With K of `linear.lqr`, and with L = -G' for the gain G of `linear.lqr(A', C', W,
    V)`, this is LQG for noise of the covariances W and V.
    """

    gain: Matrix = param(default=np.zeros((1, 1)), unit="1", free=True)
    """Gain K, shape (m, p + n): columns of the p integrals, then of the n states."""
    state_matrix: Matrix = param(default=np.zeros((0, 0)), unit="1/s", free=True)
    """Matrix A, shape (n, n)."""
    input_matrix: Matrix = param(default=np.zeros((0, 1)), unit="1", free=True)
    """Matrix B, shape (n, m)."""
    output_matrix: Matrix = param(default=np.zeros((0, 0)), unit="1", free=True)
    """Matrix C, shape (q, n)."""
    observer_gain: Matrix = param(default=np.zeros((0, 0)), unit="1/s", free=True)
    """Matrix L, shape (n, q)."""
    outputs_at_rest: Vector = param(default=np.zeros(0), unit="1", free=True)
    """Outputs at rest y0, shape (q,), each in its unit."""
    windup: Matrix = param(default=np.zeros((1, 1)), unit="1", free=True)
    """Matrix E of the anti-windup, shape (p, m); zeros for none."""
    low: Vector = param(default=(-1.0,), unit="control", infinite=True, free=True)
    """Lower limit of the control, shape (m,), one for each."""
    high: Vector = param(default=(1.0,), unit="control", infinite=True, free=True)
    """Upper limit of the control, shape (m,), one for each."""
    outputs: tuple[str, ...] = static(default=())
    """Names of the measured outputs y, q of them."""

    def start(self, signal: Tracking) -> Memory:
        """Return the memory with integrals and estimate of 0."""
        zero = 0.0 * as_vector(signal.target)
        return Memory(flow=Estimate(zero, zero[0] * jnp.ones(len(self.state_matrix))))

    def flow(self, t: Scalar, memory: Memory, signal: Tracking) -> Estimate:
        """Return z' and the rate of the estimate."""
        del t
        estimate: Estimate = memory.flow
        raw, limited = self.commands(estimate.integrals, estimate.state, signal)
        n, q, m = len(estimate.state), len(self.outputs), len(raw)
        shapes = {"state_matrix": (n, n), "input_matrix": (n, m), "output_matrix": (q, n), "observer_gain": (n, q)}
        for name, shape in {**shapes, "outputs_at_rest": (q,)}.items():
            expect_shape(self, name, shape, f"{n} states, {q} outputs and {m} controls")
        a, b, c, gain = (jnp.asarray(getattr(self, name)) for name in shapes)
        surprise = read_outputs(signal, self.outputs) - jnp.asarray(self.outputs_at_rest) - c @ estimate.state
        moved = a @ estimate.state + b @ (limited - as_vector(signal.feedforward))
        return Estimate(self.integral_rates(raw, limited, signal), moved + gain @ surprise)

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> PyTree:
        """Return the limited commands."""
        del t
        estimate: Estimate = memory.flow
        return like_signal(self.commands(estimate.integrals, estimate.state, signal)[1], signal.feedforward)


def read_outputs(signal: Tracking, names: tuple[str, ...]) -> Array:
    """Return the measured outputs of these names as an array."""
    if unknown := [name for name in names if not hasattr(signal.measured, name)]:
        outputs = ", ".join(signal.measured._fields)
        raise ValueError(f"controller: {', '.join(unknown)} is no output of the plant; there is {outputs}")
    return jnp.stack([getattr(signal.measured, name) for name in names]) if names else jnp.zeros(0)


def as_vector(signal: PyTree) -> Array:
    """Return the channels of a control or target as an array; one number is an array of one."""
    return jnp.stack(jax.tree.leaves(signal))


def like_signal(vector: Array, signal: PyTree) -> PyTree:
    """Return the entries of an array as the channels of a control or target like `signal`."""
    leaves, structure = jax.tree.flatten(signal)
    return structure.unflatten([vector[i] for i in range(len(leaves))])
