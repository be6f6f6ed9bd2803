"""How a minimum is looked for, and what was found."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import optax

from diffabs.core.reason import Reason
from diffabs.core.summary import Summary
from diffabs.tune.descent import DescentPoint, Stopping
from diffabs.tune.problem import DerivativeMode, build_subject_loop


class StartError(ValueError):
    """No start could be left: the runs diverge there, or the integration step is not stable."""


@dataclasses.dataclass(frozen=True)
class Method:
    """How a minimum is looked for.

    optimiser: any of optax; None is L-BFGS with a line search that rejects what diverges
    starts: the first is the part itself, the others are drawn from the ranges with `seed`
    mode: forward or reverse; None decides by the number of parameters
    stopping: of each descent; with constraints there is one per round
    rounds: of the augmented Lagrangian, at most
    margin: how far inside of every constraint it aims, in units of the constraint's scale (of a bound, relative to it),
        so that what was asked for holds where it ends, without a tolerance
    memory: how many steps L-BFGS remembers; more than there are parameters is of little use
    """

    optimiser: optax.GradientTransformation | None = None
    starts: int = 1
    seed: int = 0
    mode: DerivativeMode | None = None
    stopping: Stopping = dataclasses.field(default_factory=Stopping)
    rounds: int = 12
    margin: float = 1e-3
    memory: int = 10


class TuningProgress(NamedTuple):
    """What is told on the way: of the best start so far."""

    round: int
    starts: int  # that are still on their way
    point: DescentPoint


class StartResult(NamedTuple):
    """How a descent went: parameters by path, objective J, greatest excess, why it ended, and its history."""

    values: dict[str, Any]
    objective: float
    violation: float
    reason: Reason
    history: list[DescentPoint]


@dataclasses.dataclass(frozen=True, eq=False)
class Tuned:
    """The best part found.

    part: the given one with its free parameters changed; `loop` is what it stands for
    values: the free parameters by path
    objective: J before and after; violation: the greatest excess before and after; metrics (lanes,) before and after
    met: whether every constraint holds, without a tolerance
    reason: why the descent of the best start ended, in its last round
    history: of the best start; `starts` has all of them
    engine: what made the runs, with compiler and flags of a kernel
    evaluations: gradients that were computed for the best start, rejected trials included
    """

    part: Any
    values: dict[str, Any]
    objective: tuple[float, float]
    violation: tuple[float, float]
    metrics: tuple[dict[str, Any], dict[str, Any]]
    met: bool
    reason: Reason
    history: list[DescentPoint]
    starts: list[StartResult]
    mode: DerivativeMode
    diverged: tuple[int, int]
    engine: dict[str, str]

    def table(self) -> Summary:
        """What was found: the free parameters; means of the metrics and the objective, before and after."""
        rows: list[tuple[Any, ...]] = [(name, "", value) for name, value in self.values.items()]
        rows += [(f"mean {name}", *(_finite_mean(one[name]) for one in self.metrics)) for name in self.metrics[0]]
        rows.append(("objective", *self.objective))
        lanes = np.size(next(iter(self.metrics[0].values()), ()))
        title = f"Tuned over {lanes} lane{'' if lanes == 1 else 's'}: {self.reason.value}"
        met = "" if self.met else "NOT every constraint is met"
        return Summary(title, ("", "before", "after"), tuple(rows), met)

    def __repr__(self) -> str:
        """The table."""
        return str(self.table())

    def _repr_html_(self) -> str:
        """The table for a notebook."""
        return self.table()._repr_html_()

    @property
    def loop(self) -> Any:
        """The tuned loop."""
        return build_subject_loop(self.part)

    @property
    def gradient(self) -> float:
        """The greatest component of the gradient where it ended."""
        return self.history[-1].gradient

    @property
    def evaluations(self) -> int:
        """Gradients computed for the best start."""
        return self.history[-1].evaluations


def _finite_mean(values: Any) -> float:
    """Of the lanes that did not diverge; NaN where all did."""
    good = np.asarray(values)[np.isfinite(values)]
    return float(good.mean()) if good.size else float("nan")
