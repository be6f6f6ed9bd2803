"""The results of a tuning search."""

import dataclasses
from typing import NamedTuple

import numpy as np

from diffabs.core.reason import Reason
from diffabs.core.summary import Summary
from diffabs.core.types import Part, PyTree
from diffabs.loop.closed_loop import Loop
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

    def __str__(self) -> str:
        """Return the progress in a few words."""
        point, more = self.point, f"round {self.round + 1}, " if self.round else ""
        return f"tuning: {more}iteration {point.iteration}, loss {point.loss:.6g}, {point.evaluations} evaluations"


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
        start: The subject's own values of the free parameters by path.
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
    start: dict[str, PyTree] = dataclasses.field(default_factory=dict)

    def table(self) -> Summary:
        """Return a table, before and after: free parameters, metrics (mean and greatest finite value), objective."""
        rows: list[tuple[PyTree, ...]] = [
            (name, self.start.get(name, ""), value) for name, value in self.values.items()
        ]
        for name in self.metrics[0]:
            runs = [_finite(metrics[name]) for metrics in self.metrics]
            rows.append((f"mean {name}", *(float(values.mean()) for values in runs)))
            if any(values.size > 1 for values in runs):
                rows.append((f"worst {name}", *(float(values.max()) for values in runs)))
        rows.append(("objective", *self.objective))
        lanes = np.size(next(iter(self.metrics[0].values()), ()))
        title = f"Tuned over {lanes} lane{'' if lanes == 1 else 's'}: {self.reason.value}"
        met = "" if self.met else "NOT every constraint is met"
        return Summary(title, ("", "before", "after"), tuple(rows), met)

    def __repr__(self) -> str:
        """Return the table as text."""
        return str(self.table())

    def _repr_html_(self) -> str:
        return self.table()._repr_html_()

    @property
    def loop(self) -> Loop:
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
    """Return the closed loop of `subject`: the subject itself, or the result of its method `closed_loop()`."""
    return subject if isinstance(subject, Loop) else subject.closed_loop()


def _finite(values: PyTree) -> np.ndarray:
    """Return the finite values; one NaN if there are none."""
    finite = np.asarray(values, float)[np.isfinite(values)]
    return finite if finite.size else np.array([np.nan])
