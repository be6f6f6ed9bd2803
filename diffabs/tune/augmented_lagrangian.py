"""Descents under multipliers that are raised until the constraints hold: the method of multipliers.

    m <- max(0, m + c (g + d)) after each descent; c grows where the violation has not become much smaller

J. Nocedal and S. J. Wright, Numerical Optimization, 2nd ed., sec. 17.4.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from diffabs.core.reason import Reason
from diffabs.simulate.engine import describe_engine
from diffabs.tune.descent import Descent, Lane, Optimiser, Point, at, lbfgs
from diffabs.tune.problem import Multipliers, Problem, Seen
from diffabs.tune.result import Method, Progress, Start, StartError, Tuned

PENALTY = 10.0  # at first; the loss is of the order of one
HARDER = 4.0  # how much the penalty grows where the violation does not shrink enough
SHRINK = 0.3
HARDEST = 1e7


class Search:
    """Descents under multipliers that are raised until the constraints hold."""

    def __init__(
        self,
        problem: Problem,
        method: Method,
        progress: Callable[[Progress], None] | None,
        stopping: Callable[[], bool] = lambda: False,
    ):
        """Starts: the subject itself, and as many random ones as the method asks for. Raises StartError if the subject
        must not be run as it is, and there is no other start."""
        self.problem, self.method, self.progress, self.stopping = problem, method, progress, stopping
        self.refused = problem.refused()
        if self.refused and method.starts == 1:
            raise StartError(f"{Reason.START.value}: {self.refused}")
        own = problem.space.place(problem.subject)[None]
        drawn = problem.space.spread(jax.random.key(method.seed), method.starts - 1)
        self.starts = np.concatenate([own, drawn])
        alike = np.repeat(own, len(self.starts), axis=0)  # one program serves this and the search
        self.before: Seen = jax.device_get(at(problem.evaluator(1.0)(alike, self._multipliers()).seen, 0))
        if self.refused:  # its numbers mean nothing
            self.before = jax.tree.map(lambda x: np.full(np.shape(x), np.nan), self.before)._replace(diverged=0)
        size = abs(float(self.before.objective))
        self.scale = size if np.isfinite(size) and size > 0 else 1.0
        self.round = 0
        self.earlier: list[list[Point]] = [[] for _ in self.starts]  # points of the rounds before
        self.best: Lane | None = None  # so far, as it was when it was met

    def result(self) -> Tuned:
        """Raises StartError if no start could be left."""
        problem, method = self.problem, self.method
        chosen = (
            lbfgs(method.memory)
            if method.optimiser is None
            else Optimiser(optax.with_extra_args_support(method.optimiser), False)
        )
        loss = problem.loss(self.scale)
        descent = Descent(
            problem.evaluator(self.scale),
            lambda z, m: loss(z, m)[0],
            problem.steady(),
            chosen,
            method.stopping,
            self._told,
            self.stopping,
        )
        lanes = self._rounds(descent)
        usable = [lane for lane in lanes if lane.reason is not Reason.START]
        if not usable:
            raise StartError(f"{Reason.START.value}: {self._unusable()}")
        for lane in usable:
            lane.go_back()
        best = min(usable, key=lambda lane: self._rank(lane.history[-1]))
        if self.stopping() and self.best:
            best = dataclasses.replace(self.best, reason=Reason.INTERRUPTED)
        return self._tuned(best, lanes)

    def _rounds(self, descent: Descent) -> list[Lane]:
        m = self._multipliers()
        lanes = descent.run(self.starts, m)
        if not self.problem.excesses:
            return lanes
        worst = _violations(lanes)
        while self.round < self.method.rounds and not all(w <= 0 for w in worst):
            if self.stopping():
                break
            self.round += 1
            m = _raised(m, lanes)
            self.earlier = [lane.history for lane in lanes]
            last, lanes = lanes, descent.run(np.stack([lane.z for lane in lanes]), m)
            for before, lane in zip(last, lanes, strict=True):
                lane.history = _continued(before.history, lane.history)
                lane.keep(before.kept)
            m, worst = _harder(m, worst, _violations(lanes)), _violations(lanes)
        return lanes

    def _multipliers(self) -> Multipliers:
        """At the start."""
        count, k = len(self.starts), self.problem.excesses
        return Multipliers(np.zeros((count, k)), np.full(count, PENALTY), np.full(count, self.method.margin))

    def _rank(self, point: Point) -> tuple[bool, float]:
        """Those that meet the constraints first."""
        met = point.violation <= 0
        return not met, point.objective if met else point.violation

    def _told(self, lanes: list[Lane]) -> None:
        for before, lane in zip(self.earlier, lanes, strict=True):
            better = self.best is None or self._rank(lane.history[-1]) < self._rank(self.best.history[-1])
            if better and lane.reason is not Reason.START:
                self.best = dataclasses.replace(lane, history=_continued(before, lane.history))
        if self.progress:
            best = min((lane.history[-1] for lane in lanes), key=lambda p: (not np.isfinite(p.loss), *self._rank(p)))
            self.progress(Progress(self.round, sum(lane.reason is None for lane in lanes), best))

    def _unusable(self) -> str:
        worst = int(self.before.diverged)
        if not worst and np.isinf(self.before.objective):
            return "the objective is infinite there: a run never settles; start from one that does, or take iae"
        return (
            f"{worst} of {self.problem.batch.size} lanes diverge there"
            if worst
            else self.refused or f"solver.step = {self.problem.solver.step:g} s"
        )

    def _tuned(self, best: Lane, lanes: list[Lane]) -> Tuned:
        def start(lane: Lane) -> Start:
            last = lane.history[-1]
            return Start(
                self._values(lane.z), last.objective, last.violation, lane.reason or Reason.LIMIT, lane.history
            )

        last = best.history[-1]
        values = self._values(best.z)
        part = self.problem.space.at(self.problem.subject, jnp.asarray(best.z))
        part = jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, part)
        return Tuned(
            part=part,
            values=values,
            objective=(float(self.before.objective), last.objective),
            violation=(float(np.max(self.before.excess, initial=0.0)), last.violation),
            metrics=(self.before.metrics, best.seen.metrics),
            met=last.violation <= 0,
            reason=best.reason or Reason.LIMIT,
            history=best.history,
            starts=[start(lane) for lane in lanes],
            mode=self.problem.mode,
            diverged=(int(self.before.diverged), int(best.seen.diverged)),
            engine=describe_engine(self.problem.engine),
        )

    def _values(self, z: np.ndarray) -> dict[str, Any]:
        return {path: np.asarray(value) for path, value in self.problem.space.values(z).items()}


def _violations(lanes: list[Lane]) -> np.ndarray:
    return np.array([lane.history[-1].violation for lane in lanes])


def _raised(m: Multipliers, lanes: list[Lane]) -> Multipliers:
    """m <- max(0, m + c (g + d))."""
    excess = np.stack([lane.seen.excess for lane in lanes]) + m.margin[:, None]
    return m._replace(values=np.maximum(0.0, m.values + m.penalty[:, None] * np.nan_to_num(excess)))


def _harder(m: Multipliers, before: np.ndarray, after: np.ndarray) -> Multipliers:
    """A greater penalty where the violation has not become much smaller."""
    slow = after > SHRINK * before
    return m._replace(penalty=np.minimum(np.where(slow, HARDER * m.penalty, m.penalty), HARDEST))


def _continued(before: list[Point], history: list[Point]) -> list[Point]:
    """The history of a start over its rounds."""
    if not before:
        return list(history)
    shift = before[-1]
    moved = [
        p._replace(iteration=p.iteration + shift.iteration, evaluations=p.evaluations + shift.evaluations)
        for p in history
    ]
    return [*before, *moved]
