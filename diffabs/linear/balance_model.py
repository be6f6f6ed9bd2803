"""The linear model of a balancing plant about upright, used to design its feedback u = K x.

The first line is the model in continuous time; the second is the model sampled with period T. G(T) is the integral of
e^(A r) over r in [0, T].

    x' = A x + B u
    x+ = e^(A T) x + G(T) B u
    x = (theta, psi, phi, theta', psi', phi')
"""

from collections.abc import Iterator
from typing import Any

import jax

from diffabs.core.arrays import as_rule_array
from diffabs.core.protocols import Plant
from diffabs.core.pytree import canonical_dtypes, part, pytree
from diffabs.core.rules import Rule
from diffabs.linear.linearization import StateSpace, linearize
from diffabs.linear.slip_model import Continuous, Sampling
from diffabs.linear.zero_order_hold import discretise_held_input
from diffabs.parts.plants import ArmBalance, BalanceStart
from diffabs.parts.plants.arm_balance import ArmState


@pytree
class BalanceModel:
    """A balancing plant, linearised at rest and upright. With `Sampling` the control is held over the period, without
    delay.
    """

    plant: Plant = part(default=ArmBalance)
    """Plant to linearise."""
    sampling: Continuous | Sampling = part(default=Continuous)
    """`Continuous`, or `Sampling` with delay 0."""

    @property
    def period(self) -> float | None:
        """Period of the samples [s]; None in continuous time."""
        return float(self.sampling.period) if isinstance(self.sampling, Sampling) else None

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the six states."""
        return ArmState._fields

    def matrices(self) -> StateSpace:
        """Return A (6, 6) and B (6, 1), differentiable in every parameter; they compile once for each kind of model.

        At a kink of the plant, such as dry friction at rest, both are NaN. In single precision it is not noticed.
        """
        return _matrices(self)

    def rules(self) -> Iterator[Rule]:
        """Yield the rule that a sampling delay is 0, because this model has no state for the previous input."""
        if isinstance(self.sampling, Sampling):
            delay, line = self.sampling.delay, "is outside [0, 0] s: this model has none"
            yield Rule(
                as_rule_array(delay) == 0, f"sampling.delay {line}", lambda: f"sampling.delay = {delay:g} s {line}"
            )


@jax.jit
def _matrices(model: BalanceModel) -> StateSpace:
    model = canonical_dtypes(model)
    upright: Any = model.plant.start(canonical_dtypes(BalanceStart()))
    a, b = linearize(model.plant, upright, 0.0)
    system = StateSpace(a, b.reshape(len(a), 1))
    if not isinstance(model.sampling, Sampling):
        return system
    n = len(a)
    # A delay of 0 in the period's own type. The previous input then has no effect, and its state is cut off.
    whole = discretise_held_input(system, model.sampling.period, 0.0 * model.sampling.period)
    return StateSpace(whole.A[:n, :n], whole.B[:n])
