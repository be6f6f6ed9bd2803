"""The settings of a tuning search."""

import dataclasses
import enum

import optax


class DerivativeMode(enum.Enum):
    """How a gradient is computed: one rollout with a tangent per parameter, or a checkpointed backward pass."""

    FORWARD = "forward"
    REVERSE = "reverse"


@dataclasses.dataclass(frozen=True)
class Stopping:
    """The conditions that end a descent; one of them is enough.

    Attributes:
        gradient: Tolerance of the greatest |component| of the gradient of L; at the start it is of order one.
        change: Relative change of L; the descent ends after three consecutive steps that change L by no more.
        iterations: Greatest number of accepted steps.
    """

    gradient: float = 1e-6
    change: float = 1e-7
    iterations: int = 100


@dataclasses.dataclass(frozen=True)
class Method:
    """The settings of a tuning search.

    Attributes:
        optimiser: Any optimiser of optax; None is L-BFGS with a line search that rejects diverging runs.
        starts: Number of starts: the first is the part itself, the others are drawn from the ranges.
        seed: Seed of the drawn starts.
        stopping: Conditions that end a descent. With constraints each round has a descent of its own.
        rounds: Greatest number of rounds of the augmented Lagrangian, after a first descent without multipliers.
        margin: Distance inside each constraint at which the search aims, in units of the constraint's scale (relative
            to the bound). The result then meets the constraints without a tolerance.
        memory: Number of steps that L-BFGS stores; a number greater than the number of parameters is of little use.
    """

    optimiser: optax.GradientTransformation | None = None
    starts: int = 1
    seed: int = 0
    stopping: Stopping = dataclasses.field(default_factory=Stopping)
    rounds: int = 12
    margin: float = 1e-3
    memory: int = 10
