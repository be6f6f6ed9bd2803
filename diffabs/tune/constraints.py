"""What a tuned loop must satisfy. Each constraint is an array of excesses, positive where it is violated, in units of
its own scale; `augmented_lagrangian` has a multiplier for each. Met is met: no excess above zero."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol

import jax.numpy as jnp

from diffabs.core.loop import Loop
from diffabs.design.interior.differentiable import certified_decay
from diffabs.design.polytopes import Polytope
from diffabs.design.state_feedback import feedback_gain

MIN_POLE_MAGNITUDE = 1e-9  # |z| of a discrete pole that decays at once


class Constraint(Protocol):
    """A requirement on a loop and on the metrics of its lanes."""

    def excess(self, loop: Loop, metrics: Mapping[str, Any]) -> Any:
        """(k,), <= 0 where met. `metrics` are (lanes,) each."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class AtMost:
    """metric <= bound on every lane: `AtMost("overshoot", 0.01)`; a bound for each lane (lanes,) will do. The scale is
    the bound, where it is not zero."""

    metric: str
    bound: Any

    def excess(self, loop: Loop, metrics: Mapping[str, Any]) -> Any:
        """(metric - bound)/|bound|, (lanes,)."""
        del loop
        bound = jnp.asarray(self.bound)
        return (metrics[self.metric] - bound) / jnp.where(bound == 0, 1.0, jnp.abs(bound))


@dataclasses.dataclass(frozen=True, eq=False)
class Poles:
    """Every pole s of every vertex has -Re s >= decay [1/s], -Re s >= damping |s|; in discrete time s = ln(z)/period.

    The gain is that of the loop's controller on the states of the polytope, which stays as it is: free parameters that
    move the model (a lag, a filter's cutoff) are not seen. Where poles meet, the derivative is not defined, and a step
    that lands there is rejected.
    """

    system: Polytope
    decay: float = 0.0
    damping: float = 0.0

    def excess(self, loop: Loop, metrics: Mapping[str, Any]) -> Any:
        """(decay + Re s)/decay, and damping + Re s/|s|, for each vertex and pole."""
        del metrics
        real, ratios = self._modes(loop)
        rates = (self.decay + real) / (self.decay or 1.0)
        return jnp.concatenate([rates.ravel(), (self.damping - ratios).ravel() if self.damping else jnp.zeros(0)])

    def least_damping(self, loop: Loop) -> Any:
        """The least -Re s/|s| of the poles s of all vertices."""
        return jnp.min(self._modes(loop)[1])

    def _modes(self, loop: Loop) -> tuple[Any, Any]:
        """Re s and -Re s/|s| of the poles (V, n)."""
        modes = jnp.linalg.eigvals(_closed_loop_matrices(self.system, loop))
        if self.system.period is not None:
            alive = jnp.abs(modes) > MIN_POLE_MAGNITUDE  # the rest decays at once
            modes = jnp.log(jnp.where(alive, modes, MIN_POLE_MAGNITUDE)) / self.system.period
        real = modes.real
        return real, -real / jnp.sqrt(real**2 + modes.imag**2)


@dataclasses.dataclass(frozen=True, eq=False)
class CertifiedDecay:
    """A common Lyapunov matrix proves a decay of at least `decay` [1/s] at every vertex, however fast the system varies
    between them (`certified_decay` of `design.interior.differentiable`). The gain is seen as by `Poles`. In floating
    point: `certify` proves it of the result."""

    system: Polytope
    decay: float

    def excess(self, loop: Loop, metrics: Mapping[str, Any]) -> Any:
        """(decay - what is proved)/max(|decay|, 1), (1,)."""
        del metrics
        system = self.system
        proved = certified_decay(feedback_gain(loop, system.states), system.A, system.B, system.period)
        return ((self.decay - proved) / max(abs(self.decay), 1.0))[None]


def _closed_loop_matrices(system: Polytope, loop: Loop) -> Any:
    """A + B K (V, n, n), K the loop's."""
    gain = feedback_gain(loop, system.states)
    return jnp.asarray(system.A) + jnp.asarray(system.B) @ gain[None, :]
