"""The settings of a tuning search."""

import dataclasses
import enum
import math
import numbers

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

    def __post_init__(self) -> None:
        _check_whole("iterations", self.iterations, 0)
        _check_size("gradient", self.gradient)
        _check_size("change", self.change)


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

    def __post_init__(self) -> None:
        _check_whole("starts", self.starts, 1)
        _check_whole("rounds", self.rounds, 0)
        _check_whole("memory", self.memory, 1)
        _check_size("margin", self.margin)


def _check_whole(name: str, value: int, minimum: int) -> None:
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < minimum:
        raise ValueError(f"{name} = {value!r} is no whole number in [{minimum}, inf)")


def _check_size(name: str, value: float) -> None:
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not 0 <= value < math.inf:
        raise ValueError(f"{name} = {value!r} is no number in [0, inf)")
