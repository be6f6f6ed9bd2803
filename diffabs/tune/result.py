"""The results of a tuning search."""

import dataclasses
from typing import NamedTuple

import numpy as np

from diffabs.core.loop import Loop
from diffabs.core.reason import Reason
from diffabs.core.types import Part, PyTree
from diffabs.runtime.summary import Summary
from diffabs.tune.method import DerivativeMode


class StartError(ValueError):
    """No start is usable: runs diverge or never settle there, or the integration step is not stable."""


class DescentPoint(NamedTuple):
    """One line of the history of a descent: the point after an accepted step.

    Attributes:
        iteration: Number of accepted steps so far; 0 at the start.
        objective: Objective J, not scaled.
        loss: Loss L.
        gradient: Greatest |component| of the gradient of L.
        violation: Greatest excess over all constraints, in units of their scales, at least 0.
        evaluations: Number of gradients so far, including rejected trials.
    """

    iteration: int
    objective: float
    loss: float
    gradient: float
    violation: float
    evaluations: int


class TuningProgress(NamedTuple):
    """The progress of a search.

    Attributes:
        round: Number of the round, 0 in the first descent.
        starts: Number of starts whose descent has not ended.
        point: Best of the last points of all starts. Its iterations and evaluations count from the start of the round.
    """

    round: int
    starts: int
    point: DescentPoint


class StartResult(NamedTuple):
    """The result from one start.

    Attributes:
        values: Free parameters by path.
        objective: Objective J.
        violation: Greatest excess over all constraints, at least 0.
        reason: Reason for the end of the last descent.
        history: Accepted points over all rounds.
    """

    values: dict[str, PyTree]
    objective: float
    violation: float
    reason: Reason
    history: list[DescentPoint]


@dataclasses.dataclass(frozen=True, eq=False)
class Tuned:
    """The best part that a search has found; it may violate a constraint (`met`).

    A pair is (before, after). Before refers to the subject's own values; these numbers are NaN if such a run is
    inadmissible.

    Attributes:
        part: The given part with tuned values of the free parameters; `loop` is its closed loop.
        values: Free parameters by path.
        objective: Pair of objectives J.
        violation: Pair of greatest excesses, each at least 0.
        metrics: Pair of dictionaries of metrics, each of shape (runs,).
        met: Whether every constraint holds, without a tolerance.
        reason: Reason for the end of the best start's last descent.
        history: History of the best start.
        starts: Results and histories of all starts.
        mode: Mode of differentiation.
        diverged: Pair of numbers of diverged runs; 0 before if such a run is inadmissible.
        engine: Engine of the runs, with compiler and flags if it is a kernel.
    """

    part: Part
    values: dict[str, PyTree]
    objective: tuple[float, float]
    violation: tuple[float, float]
    metrics: tuple[dict[str, PyTree], dict[str, PyTree]]
    met: bool
    reason: Reason
    history: list[DescentPoint]
    starts: list[StartResult]
    mode: DerivativeMode
    diverged: tuple[int, int]
    engine: dict[str, str]

    def table(self) -> Summary:
        """Return a table: free parameters after, means of the finite metrics, and objective before and after."""
        rows: list[tuple[PyTree, ...]] = [(name, "", value) for name, value in self.values.items()]
        rows += [(f"mean {name}", *(_finite_mean(one[name]) for one in self.metrics)) for name in self.metrics[0]]
        rows.append(("objective", *self.objective))
        lanes = np.size(next(iter(self.metrics[0].values()), ()))
        title = f"Tuned over {lanes} lane{'' if lanes == 1 else 's'}: {self.reason.value}"
        met = "" if self.met else "NOT every constraint is met"
        return Summary(title, ("", "before", "after"), tuple(rows), met)

    def __repr__(self) -> str:
        """Return the table as text."""
        return str(self.table())

    def _repr_html_(self) -> str:
        """Return the table as HTML for a notebook."""
        return self.table()._repr_html_()

    @property
    def loop(self) -> PyTree:
        """Tuned closed loop."""
        return build_subject_loop(self.part)

    @property
    def gradient(self) -> float:
        """Greatest |component| of the gradient of the scaled loss L by z, at the last point."""
        return self.history[-1].gradient

    @property
    def evaluations(self) -> int:
        """Number of gradients computed for the best start, including rejected trials."""
        return self.history[-1].evaluations


def build_subject_loop(subject: Part) -> Loop:
    """Return the closed loop of `subject`: the subject itself, or the result of its method `closed_loop()`.

    Args:
        subject: Loop, or a part with a method `closed_loop()`.
    """
    return subject if isinstance(subject, Loop) else subject.closed_loop()


def _finite_mean(values: PyTree) -> float:
    """Return the mean over the finite values, NaN if there are none."""
    good = np.asarray(values)[np.isfinite(values)]
    return float(good.mean()) if good.size else float("nan")
