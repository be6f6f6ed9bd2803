"""The linear model of a balance about upright, for which its feedback u = K x is designed.

x' = A x + B u,   x = (theta, psi, phi, theta', psi', phi')      or, sampled,   x+ = e^(A T) x + G(T) B u
"""

from collections.abc import Iterator
from typing import Any

import jax

from diffabs.core.protocols import Plant
from diffabs.core.pytree import canonical_dtypes, part, pytree
from diffabs.linear.linearization import StateSpace, linearize
from diffabs.linear.slip_model import Continuous, Sampling, SlipModel
from diffabs.linear.zero_order_hold import discretise_held_input
from diffabs.plants import ArmBalance, BalanceStart
from diffabs.plants.arm_balance import ArmState


@pytree
class BalanceModel:
    """A plant at rest, upright. Sampled, its control is held over the period, and there is no delay."""

    plant: Plant = part(default=ArmBalance)
    sampling: Continuous | Sampling = part(default=Continuous)

    period = SlipModel.period

    @property
    def states(self) -> tuple[str, ...]:
        """What the states are."""
        return ArmState._fields

    def matrices(self) -> StateSpace:
        """A (6, 6) and B (6, 1), differentiable in every parameter; compiled once for each kind of model."""
        return _matrices(self)

    def problems(self) -> Iterator[str]:
        """A delay, which needs another state."""
        if isinstance(self.sampling, Sampling) and self.sampling.delay != 0:
            yield f"sampling.delay = {self.sampling.delay:g} s is outside [0, 0] s: this model has none"


@jax.jit
def _matrices(model: BalanceModel) -> StateSpace:
    model = canonical_dtypes(model)
    rest: Any = model.plant.start(canonical_dtypes(BalanceStart()))
    a, b = linearize(model.plant, rest, 0.0)
    system = StateSpace(a, b.reshape(len(a), 1))
    if not isinstance(model.sampling, Sampling):
        return system
    n = len(a)
    whole = discretise_held_input(system, model.sampling.period, 0.0 * model.sampling.period)
    return StateSpace(whole.A[:n, :n], whole.B[:n])
