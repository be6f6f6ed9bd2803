"""Constraints on a tuned loop.

Each constraint returns an array of excesses in units of its own scale. An excess is positive if the constraint is
violated. `augmented_lagrangian` has one multiplier for each excess. A constraint holds if no excess is above zero;
there is no tolerance.
"""

import dataclasses
from typing import Protocol

import jax.numpy as jnp

from diffabs.core.types import Params, PyTree, Scalar
from diffabs.loop.closed_loop import Loop
from diffabs.robust.design.interior.decay_rate import certified_decay
from diffabs.robust.design.polytopes import Polytope
from diffabs.robust.design.state_feedback import feedback_gain

MIN_POLE_MAGNITUDE = 1e-9  # |z| below which a discrete pole decays within one period


class Constraint(Protocol):
    """A requirement on a loop and on the metrics of its runs."""

    def excess(self, loop: Loop, metrics: Params) -> Scalar:
        """Return the excesses (k,) of `loop`, <= 0 where the constraint holds; each of `metrics` has shape (runs,)."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class AtMost:
    """The constraint metric <= bound in every run, for example `AtMost("overshoot", 0.01)`.

    Attributes:
        metric: Name of a measured metric.
        bound: One bound, or one for each run, shape (runs,). Its magnitude is the scale of the excess, 1 if it is zero.
    """

    metric: str
    bound: Scalar

    def excess(self, loop: Loop, metrics: Params) -> Scalar:
        """Return (metric - bound)/|bound|, shape (runs,); for a zero bound the metric itself.

        The metric is an entry of `metrics`; `loop` is not used.
        """
        del loop
        bound = jnp.asarray(self.bound)
        return (metrics[self.metric] - bound) / jnp.where(bound == 0, 1.0, jnp.abs(bound))


@dataclasses.dataclass(frozen=True, eq=False)
class Poles:
    """The constraint that the closed loop of every vertex has poles with a minimum decay rate and damping ratio.

    Every pole s satisfies -Re s >= decay and -Re s >= damping |s|. In discrete time, s = ln(z)/period.

    The closed loop uses the feedback gain of the loop's controller on the states of the polytope. The polytope is
    fixed. The constraint does not see free parameters that change the model, such as a lag or a filter's cutoff. The
    derivative is undefined where poles coincide; the search rejects a step to such a point.

    Attributes:
        system: Polytope of linear models.
        decay: Minimum decay rate [1/s].
        damping: Minimum damping ratio [1].
    """

    system: Polytope
    decay: float = 0.0
    damping: float = 0.0

    def excess(self, loop: Loop, metrics: Params) -> Scalar:
        """Return the excesses of each vertex and pole of `loop`, shape (k,); `metrics` is not used.

        First come (decay + Re s)/|decay|, or Re s without a decay rate. If a damping ratio is given, damping + Re s/|s|
        follow.
        """
        del metrics
        real, ratios = self._modes(loop)
        rates = (self.decay + real) / (abs(self.decay) or 1.0)
        return jnp.concatenate([rates.ravel(), (self.damping - ratios).ravel() if self.damping else jnp.zeros(0)])

    def least_damping(self, loop: Loop) -> Scalar:
        """Return the least damping ratio -Re s/|s| of `loop` over the poles s of all vertices."""
        return jnp.min(self._modes(loop)[1])

    def _modes(self, loop: Loop) -> tuple[PyTree, PyTree]:
        """Return Re s and -Re s/|s| of the poles, each of shape (vertices, n)."""
        gain = feedback_gain(loop, self.system.states)
        # A + B K of every vertex, with the gain K of the loop's controller.
        modes = jnp.linalg.eigvals(jnp.asarray(self.system.A) + jnp.asarray(self.system.B) @ gain[None, :])
        if self.system.period is not None:
            # ln 0 and its derivative are infinite, so a pole at z = 0 is replaced before the logarithm.
            alive = jnp.abs(modes) > MIN_POLE_MAGNITUDE
            modes = jnp.log(jnp.where(alive, modes, MIN_POLE_MAGNITUDE)) / self.system.period
        real = modes.real
        return real, -real / jnp.sqrt(real**2 + modes.imag**2)


@dataclasses.dataclass(frozen=True, eq=False)
class CertifiedDecay:
    """The constraint that a common Lyapunov matrix proves a minimum decay rate at every vertex.

    The proof holds for a system that varies arbitrarily fast between the vertices (`certified_decay` of
    `design.interior.decay_rate`). The gain is the same as in `Poles`. The computation uses floating point: apply
    `certify` to the result for a rigorous proof.

    Attributes:
        system: Polytope of linear models.
        decay: Minimum decay rate [1/s].
    """

    system: Polytope
    decay: float

    def excess(self, loop: Loop, metrics: Params) -> Scalar:
        """Return (decay - proved decay)/max(|decay|, 1) of `loop`, shape (1,); `metrics` is not used."""
        del metrics
        system = self.system
        proved = certified_decay(feedback_gain(loop, system.states), system.A, system.B, system.period)
        return ((self.decay - proved) / max(abs(self.decay), 1.0))[None]
