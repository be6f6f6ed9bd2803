"""Constrained minimisation by the method of multipliers (augmented Lagrangian).

A first descent has the multipliers zero. Each round then updates them and descends again:

    m <- max(0, m + c (g + d))

g are the excesses of the constraints, d is the margin and c the penalty. Each start has its own m and c. The penalty c
grows if the violation has not shrunk to `MAX_VIOLATION_RATIO` of its earlier value. A start has converged if all its
constraints hold, and the update would change each multiplier by at most c times a tolerance:

    |max(g + d, -m/c)| <= max(d, MIN_TOLERANCE)

Otherwise a search could end far inside a bound, because its multiplier is still too great. Rounds end when every start
that can be used has converged, or after `Method.rounds` of them.

Source: J. Nocedal and S. J. Wright, Numerical Optimization, 2nd ed., sec. 17.4; R. Andreani et al., On augmented
Lagrangian methods with general lower-level constraints, SIAM J. Optim. 18 (2007), for the condition.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax

from diffabs.core.pytree import get
from diffabs.core.reason import Reason
from diffabs.core.types import PyTree
from diffabs.engine.drive.engine import describe_engine
from diffabs.tune.descent import Descent, DescentState, Optimiser, lbfgs, slice_start
from diffabs.tune.method import Method
from diffabs.tune.problem import Multipliers, ObjectiveEvaluation, Problem
from diffabs.tune.result import DescentPoint, StartError, StartResult, Tuned, TuningProgress

FIRST_PENALTY = 10.0  # penalty of the first round; the scaled loss is of the order of one
PENALTY_GROWTH = 4.0  # factor of the penalty if the violation does not shrink enough
MAX_VIOLATION_RATIO = 0.3  # violation after a round over the violation after the round before
MAX_PENALTY = 1e7
MIN_TOLERANCE = 1e-4  # of the condition that ends the rounds of a start


class AugmentedLagrangianSearch:
    """A search for a constrained minimum by the method of multipliers, from several starts at once."""

    def __init__(
        self,
        problem: Problem,
        method: Method,
        progress: Callable[[TuningProgress], None] | None,
        stopping: Callable[[], bool] = lambda: False,
    ):
        """Choose the starts and evaluate the objective at the subject's own parameters.

        The first start is the subject itself. The method draws the others at random from the ranges of the parameters.
        `progress` and `stopping` are those of `tune`.
        """
        self.problem = problem
        self.method = method
        self.progress = progress
        self.stopping = stopping
        self.refused: str | None = problem.find_refusal()
        if self.refused and method.starts == 1:
            raise StartError(f"{Reason.START.value}: {self.refused}")
        subject_start = problem.space.place(problem.subject)[None]
        drawn = problem.space.spread(jax.random.key(method.seed), method.starts - 1)
        self.starts: np.ndarray = np.concatenate([subject_start, drawn])
        # Copies of the own start give the same batch shape as the search, so that both share one compiled program.
        alike = np.repeat(subject_start, len(self.starts), axis=0)
        self.before: ObjectiveEvaluation = jax.device_get(
            slice_start(problem.evaluator(1.0)(alike, self._multipliers()).evaluation, 0)
        )
        if self.refused:  # the results of inadmissible runs are meaningless
            self.before = jax.tree.map(lambda x: np.full(np.shape(x), np.nan), self.before)._replace(diverged=0, slid=0)
        size = abs(float(self.before.objective))
        self.scale: float = size if np.isfinite(size) and size > 0 else 1.0
        self.round: int = 0
        self.earlier: list[list[DescentPoint]] = [[] for _ in self.starts]  # points of the earlier rounds
        self.best: DescentState | None = None  # snapshot of the best start so far

    def result(self) -> Tuned:
        """Run the search and return the best result over all starts."""
        problem, method = self.problem, self.method
        optimiser = (
            lbfgs(method.memory)
            if method.optimiser is None
            else Optimiser(optax.with_extra_args_support(method.optimiser), False)
        )
        loss = problem.loss(self.scale)
        descent = Descent(
            problem.evaluator(self.scale),
            lambda z, m: loss(z, m)[0],
            problem.steady(),
            optimiser,
            method.stopping,
            self._report,
            self.stopping,
            problem.space.steepness,
        )
        descent_states = self._run_rounds(descent)
        usable = [descent_state for descent_state in descent_states if descent_state.reason is not Reason.START]
        if not usable:
            raise StartError(self._describe_failure())
        for descent_state in usable:
            descent_state.go_back()
        best = min(usable, key=lambda descent_state: self._rank(descent_state.history[-1]))
        if self.stopping() and self.best:
            best = dataclasses.replace(self.best, reason=Reason.INTERRUPTED)
        last = best.history[-1]
        part = problem.space.at(problem.subject, jnp.asarray(best.z))
        return Tuned(
            part=jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, part),
            values=self._values(best.z),
            objective=(float(self.before.objective), last.objective),
            violation=(float(np.max(self.before.excess, initial=0.0)), last.violation),
            metrics=(self.before.metrics, best.evaluation.metrics),
            met=last.violation <= 0,
            reason=best.reason or Reason.LIMIT,
            history=best.history,
            starts=[
                StartResult(
                    values=self._values(descent_state.z),
                    objective=descent_state.history[-1].objective,
                    violation=descent_state.history[-1].violation,
                    reason=descent_state.reason or Reason.LIMIT,
                    history=descent_state.history,
                )
                for descent_state in descent_states
            ],
            mode=problem.mode,
            diverged=(int(self.before.diverged), int(best.evaluation.diverged)),
            engine=describe_engine(problem.find_engine()[0]),
            start={entry.path: get(problem.subject, entry.path) for entry in problem.space.entries},
        )

    def _run_rounds(self, descent: Descent) -> list[DescentState]:
        """Run a descent, then rounds of a multiplier update and a descent, until all starts have converged."""
        m = self._multipliers()
        descent_states = descent.run(self.starts, m)
        if not self.problem.excesses:
            return descent_states
        before, violations = np.full(len(self.starts), np.inf), _violations(descent_states)
        while self.round < self.method.rounds and not all(_have_converged(m, descent_states)):
            if self.stopping():
                break
            self.round += 1
            m = _raise_penalty(_raise_multipliers(m, descent_states), before, violations)
            self.earlier = [descent_state.history for descent_state in descent_states]
            last, descent_states = (
                descent_states,
                descent.run(np.stack([descent_state.z for descent_state in descent_states]), m),
            )
            for earlier_state, descent_state in zip(last, descent_states, strict=True):
                descent_state.history = _join_histories(earlier_state.history, descent_state.history)
                descent_state.keep(earlier_state.best_feasible)
            before, violations = violations, _violations(descent_states)
        for descent_state, converged in zip(descent_states, _have_converged(m, descent_states), strict=True):
            descent_state.converged = converged
        return descent_states

    def _multipliers(self) -> Multipliers:
        """Return the multipliers of the first descent: zero, with the initial penalty and the margin of the method."""
        count, k = len(self.starts), self.problem.excesses
        return Multipliers(np.zeros((count, k)), np.full(count, FIRST_PENALTY), np.full(count, self.method.margin))

    def _rank(self, point: DescentPoint) -> tuple[bool, float]:
        """Return a sort key: feasible points first, by objective; then infeasible points, by violation."""
        met = point.violation <= 0
        return not met, point.objective if met else point.violation

    def _report(self, descent_states: list[DescentState]) -> None:
        """Record the best feasible or least infeasible point so far and report the progress."""
        for before, descent_state in zip(self.earlier, descent_states, strict=True):
            better = self.best is None or self._rank(descent_state.history[-1]) < self._rank(self.best.history[-1])
            if better and descent_state.reason is not Reason.START:
                self.best = dataclasses.replace(descent_state, history=_join_histories(before, descent_state.history))
        if self.progress:
            best = min(
                (descent_state.history[-1] for descent_state in descent_states),
                key=lambda p: (not np.isfinite(p.loss), *self._rank(p)),
            )
            self.progress(
                TuningProgress(self.round, sum(descent_state.reason is None for descent_state in descent_states), best)
            )

    def _describe_failure(self) -> str:
        """Return why the subject's own values are no start."""
        lost, lanes = int(self.before.diverged), self.problem.batch.size
        if lost or self.refused:
            return f"{Reason.START.value}: {self.refused or f'{lost} of {lanes} lanes diverge there'}"
        if slid := int(self.before.slid):
            return (
                f"{slid} of {lanes} lanes slide along a switching surface at the start, and have no derivatives there"
            )
        bounds = filter(None, (getattr(constraint, "metric", None) for constraint in self.problem.constraints))
        for name in (*self.problem.weights, *bounds):
            value, unreached = self.before.metrics[name], getattr(self.problem.measured[name], "unreached", np.nan)
            if never := np.count_nonzero(value == unreached):
                finding = f"{name} is infinite at the start in {never} of {lanes} lanes"
                return f"{finding}: such a run never settles; start from one that does, or take iae"
            if lost := np.count_nonzero(~np.isfinite(value)):
                return f"{name} is not finite at the start in {lost} of {lanes} lanes"
        return (
            "the objective, a constraint or a derivative is not finite at the start; a run that slides, as with"
            " clamping at rest on its target, has no derivatives"
        )

    def _values(self, z: np.ndarray) -> dict[str, PyTree]:
        return {path: np.asarray(value) for path, value in self.problem.space.values(z).items()}


def _violations(descent_states: list[DescentState]) -> np.ndarray:
    return np.array([descent_state.history[-1].violation for descent_state in descent_states])


def _have_converged(m: Multipliers, descent_states: list[DescentState]) -> list[bool]:
    """Return for each start whether it has converged; a start that cannot be used counts as converged."""
    aimed = np.stack([descent_state.evaluation.excess for descent_state in descent_states]) + m.margin[:, None]
    change = np.abs(np.maximum(aimed, -m.values / m.penalty[:, None])).max(axis=1)
    settled = change <= np.maximum(m.margin, MIN_TOLERANCE)
    return [
        descent_state.reason is Reason.START or (bool(is_settled) and descent_state.history[-1].violation <= 0)
        for is_settled, descent_state in zip(settled, descent_states, strict=True)
    ]


def _raise_multipliers(m: Multipliers, descent_states: list[DescentState]) -> Multipliers:
    """Return the updated multipliers, m <- max(0, m + c (g + d))."""
    excess = np.stack([descent_state.evaluation.excess for descent_state in descent_states]) + m.margin[:, None]
    # A NaN excess (a start rejected at its first evaluation) leaves the multiplier unchanged.
    return m._replace(values=np.maximum(0.0, m.values + m.penalty[:, None] * np.nan_to_num(excess)))


def _raise_penalty(m: Multipliers, before: np.ndarray, after: np.ndarray) -> Multipliers:
    """Return the multipliers with a greater penalty for the starts whose violation has not shrunk enough."""
    slow = after > MAX_VIOLATION_RATIO * before
    return m._replace(penalty=np.minimum(np.where(slow, PENALTY_GROWTH * m.penalty, m.penalty), MAX_PENALTY))


def _join_histories(before: list[DescentPoint], history: list[DescentPoint]) -> list[DescentPoint]:
    """Return the history of a start over its rounds, with iterations and evaluations counted from the first round."""
    if not before:
        return list(history)
    shift = before[-1]
    moved = [
        p._replace(iteration=p.iteration + shift.iteration, evaluations=p.evaluations + shift.evaluations)
        for p in history
    ]
    return [*before, *moved]
