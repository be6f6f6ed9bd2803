"""Safeguarded gradient descent from many starts at once, with any optimiser of optax.

The optimiser proposes an update u. The search takes the step t u if every run there is finite and its integration is
stable. Updates of L-BFGS are only directions; the step must then also satisfy the weak Wolfe conditions

    L(z + t u) <= L(z) + 1e-4 t g'u,   g(z + t u)'u >= 0.9 g'u

Bisection and expansion find t, as A. S. Lewis and M. L. Overton, Nonsmooth optimization via quasi-Newton methods, Math.
Program. 141 (2013), recommend for functions with kinks. A trial point whose runs diverge or are unstable shortens the
step, and the search never uses its gradient. One compiled call evaluates all starts; each start accepts or rejects its
step independently.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax

from diffabs.core.reason import Reason
from diffabs.core.types import Array, Matrix, PyTree, Scalar, Vector
from diffabs.tune.method import Stopping
from diffabs.tune.problem import LossEvaluation, Multipliers
from diffabs.tune.result import DescentPoint

T = TypeVar("T")


ARMIJO_FRACTION, WOLFE_FRACTION = 1e-4, 0.9
MIN_STEP_FACTOR = 1e-10  # least t of a line search
STEP_EXPANSION = 4.0  # factor of t while no upper bound on t is known
MAX_TRIALS = 12  # of a line search that holds a point with sufficient decrease, before it accepts that point
# Consecutive line searches that end at MAX_TRIALS with an upper bound on t: the loss jumps at that bound, and its
# gradient gives no information about the jump.
MAX_JUMPS = 2
MAX_UPDATE_COMPONENT = 2.0  # greatest |u_i|, in units of z: about half of a finite range
# Slope of a free parameter by z, relative to the middle of its range, below which the parameter is at a flat end of the
# range: closer than 0.025 % of its length. Updates that lead back into the range are longer there.
FLAT = 1e-3
MAX_IDLE_STEPS = 3  # consecutive accepted steps without a significant change of the loss


class FeasiblePoint(NamedTuple):
    """An accepted step that meets every constraint."""

    z: np.ndarray
    evaluation: Any
    point: DescentPoint


@dataclasses.dataclass
class DescentState:
    """The state of the descent from one start.

    Attributes:
        z: Present point, shape (p,).
        loss, gradient, evaluation: Loss L at `z`, its gradient (p,), and the evaluation of the objective.
        update: Update u from the optimiser, shape (p,).
        t: Factor of the next trial step t u.
        low: Greatest t known to be too short.
        high: Least t known to be too long.
        better: Point and evaluation at `low`, or None.
        trials: Number of trials since the last accepted step.
        idle: Number of consecutive accepted steps without a significant change of the loss.
        jumps: Number of consecutive line searches that end at `MAX_TRIALS` with an upper bound on t.
        slides: Whether runs slide at the least t known to be too long.
        evaluations: Number of gradients so far.
        iterations: Number of accepted steps so far.
        reason: Reason for the end; None while the descent continues.
        history: Start, and the points after the accepted steps.
        best_feasible: Best feasible step so far.
        converged: Whether the constraints hold and their multipliers pass the test of `augmented_lagrangian`; True
            without constraints.
    """

    z: np.ndarray
    loss: float
    gradient: Vector
    evaluation: Any
    update: np.ndarray
    t: float = 1.0
    low: float = 0.0
    high: float = np.inf
    better: tuple[np.ndarray, PyTree] | None = None
    trials: int = 0
    idle: int = 0
    jumps: int = 0
    slides: bool = False
    evaluations: int = 1
    iterations: int = 0
    reason: Reason | None = None
    history: list[DescentPoint] = dataclasses.field(default_factory=list)
    best_feasible: FeasiblePoint | None = None
    converged: bool = True

    def note(self) -> None:
        """Append the present point to the history, and keep it if it is the best feasible point so far."""
        worst = float(np.max(self.evaluation.excess, initial=0.0))
        self.history.append(
            DescentPoint(
                self.iterations,
                float(self.evaluation.objective),
                self.loss,
                float(np.max(np.abs(self.gradient))),
                worst,
                self.evaluations,
            )
        )
        if worst <= 0:
            self.keep(FeasiblePoint(self.z, self.evaluation, self.history[-1]))

    def keep(self, point: FeasiblePoint | None) -> None:
        """Keep a feasible point if its objective is less than that of the point kept so far."""
        if point and not (self.best_feasible and self.best_feasible.point.objective <= point.point.objective):
            self.best_feasible = point

    def go_back(self) -> None:
        """Go back to the feasible point that was kept, and note it, if it is better than the present point.

        It is better if the present point violates a constraint. If the present point is no minimum, because the
        multipliers have not converged or the iterations ran out, the lower objective decides. A converged minimum is
        the result, although steps on its way may have had a lower objective within the margin of a constraint.
        """
        last, best = self.history[-1], self.best_feasible
        is_minimum = self.converged and self.reason is not Reason.LIMIT
        if best and (not last.violation <= 0 or (not is_minimum and best.point.objective < last.objective)):
            self.z, self.evaluation, self.reason = best.z, best.evaluation, Reason.KEPT
            self.history.append(best.point._replace(iteration=last.iteration, evaluations=last.evaluations))
        elif not self.converged and self.reason is not Reason.INTERRUPTED:
            self.reason = Reason.LIMIT


class Optimiser(NamedTuple):
    """The source of the updates of a descent, in the form of optax.

    Attributes:
        transformation: The transformation from gradients to updates.
        searches: True if the updates are directions for the line search of this module; False if they are complete
            steps.
    """

    transformation: optax.GradientTransformationExtraArgs
    searches: bool


def lbfgs(memory: int = 10) -> Optimiser:
    """Return the optimiser that gives L-BFGS directions for the line search of this module."""
    chain = optax.chain(optax.scale_by_lbfgs(memory_size=memory), optax.scale(-1.0))
    return Optimiser(optax.with_extra_args_support(chain), True)


Evaluate = Callable[[Any, Multipliers], LossEvaluation]


class Descent:
    """A descent from the starts z (starts, p) under fixed multipliers."""

    def __init__(
        self,
        evaluate: Evaluate,
        loss: Callable[[PyTree, PyTree], PyTree],
        steady: Callable[[np.ndarray], np.ndarray],
        optimiser: Optimiser,
        stopping: Stopping,
        report: Callable[[list[DescentState]], None],
        interrupted: Callable[[], bool] = lambda: False,
        steepness: Callable[[np.ndarray], np.ndarray] = np.ones_like,
    ):
        """Set the evaluations and the conditions that end the descent.

        Args:
            evaluate: Function (z (starts, p), multipliers) -> loss and gradient of all starts.
            loss: Function (z (p,), multipliers) -> loss of one start, for optimisers with a line search of their own.
            steady: Maps z (starts, p) to whether every run there is admissible, shape (starts,).
            report: Called with all starts after every evaluation.
            interrupted: Called after `report`; True ends the descent of all starts.
            steepness: Maps z (p,) to the slope of each free parameter by z, relative to its slope at z = 0.
        """
        self.evaluate = evaluate
        self.steady = steady
        self.stopping = stopping
        self.report = report
        self.interrupted = interrupted
        self.steepness = steepness
        self.searches: bool = optimiser.searches
        self._init = jax.jit(jax.vmap(optimiser.transformation.init))

        def update(g: Matrix, state: object, z: Matrix, value: Scalar, m: Scalar) -> tuple[PyTree, PyTree]:
            more = {"value": value, "grad": g, "value_fn": lambda z: loss(z, m)}
            return optimiser.transformation.update(g, state, z, **more)

        self._update = jax.jit(jax.vmap(update))

    def run(self, starts: np.ndarray, multipliers: Multipliers) -> list[DescentState]:
        """Run the descent from each of `starts` (starts, p) under `multipliers`, and return the final states."""
        self.multipliers = multipliers
        first, usable = self._evaluate_at(starts)
        descent_states = [
            DescentState(z, float(first.loss[i]), first.gradient[i], slice_start(first.evaluation, i), np.zeros_like(z))
            for i, z in enumerate(starts)
        ]
        for descent_state, ok in zip(descent_states, usable, strict=True):
            descent_state.reason = self._finish_reason(descent_state) if ok else Reason.START
            descent_state.note()
        self.states = self._init(jnp.asarray(starts))
        self._propose(descent_states, [descent_state.reason is None for descent_state in descent_states])
        self.report(descent_states)
        while any(descent_state.reason is None for descent_state in descent_states) and not self.interrupted():
            # One trial step of each start that has not ended; the others only fill the compiled batch.
            trials = np.stack(
                [descent_state.z + descent_state.t * descent_state.update for descent_state in descent_states]
            )
            evaluation, usable = self._evaluate_at(trials)
            moved = []
            for i, descent_state in enumerate(descent_states):
                accepted = (
                    self._judge(descent_state, usable[i], trials[i], slice_start(evaluation, i))
                    if descent_state.reason is None
                    else None
                )
                if accepted:
                    self._take(descent_state, *accepted)
                moved.append(accepted is not None and descent_state.reason is None)
            self._propose(descent_states, moved)
            self.report(descent_states)
        for descent_state in descent_states:
            descent_state.reason = descent_state.reason or Reason.INTERRUPTED
        return descent_states

    def _evaluate_at(self, z: np.ndarray) -> tuple[LossEvaluation, np.ndarray]:
        """Return the evaluation at z and a mask (starts,) of the finite, admissible points."""
        evaluation = jax.device_get(self.evaluate(jnp.asarray(z), self.multipliers))
        usable = (
            np.isfinite(evaluation.loss)
            & np.isfinite(evaluation.gradient).all(axis=1)
            & (evaluation.evaluation.diverged == 0)
        )
        return evaluation, usable & self.steady(z)

    def _judge(
        self, descent_state: DescentState, usable: bool, z: np.ndarray, evaluation: LossEvaluation
    ) -> tuple[np.ndarray, LossEvaluation] | None:
        """Return the accepted point and its evaluation; otherwise None, with the next trial step set in the state."""
        descent_state.evaluations += 1
        descent_state.trials += 1
        slope = float(descent_state.gradient @ descent_state.update)
        # At the greatest step no expansion is possible, so the curvature condition is waived there.
        longest = _is_longest(descent_state)
        if usable and not self.searches:
            return z, evaluation
        if not usable or float(evaluation.loss) > descent_state.loss + ARMIJO_FRACTION * descent_state.t * slope:
            descent_state.high, descent_state.slides = descent_state.t, bool(evaluation.evaluation.slid > 0)
        elif float(evaluation.gradient @ descent_state.update) < WOLFE_FRACTION * slope and not longest:
            descent_state.low, descent_state.better = descent_state.t, (z, evaluation)
        else:
            descent_state.jumps = 0
            return z, evaluation
        if descent_state.better and descent_state.trials >= MAX_TRIALS:
            # No trial below `high` satisfies the curvature condition: the loss jumps near `high`, or has a kink there.
            descent_state.jumps += np.isfinite(descent_state.high)
            return descent_state.better
        descent_state.t = _next_step_factor(descent_state, float(evaluation.loss) if usable else np.inf, slope)
        if descent_state.t < MIN_STEP_FACTOR:
            descent_state.reason = Reason.SLIDE if descent_state.slides else Reason.STEP
        return None

    def _take(self, descent_state: DescentState, z: np.ndarray, evaluation: LossEvaluation) -> None:
        gained = abs(descent_state.loss - float(evaluation.loss))
        small = gained <= self.stopping.change * max(abs(descent_state.loss), 1e-12)
        # A greatest step from a flat end of a range may hardly change the loss: it does not count as idle.
        descent_state.idle = descent_state.idle + 1 if small and not _is_longest(descent_state) else 0
        descent_state.z, descent_state.loss, descent_state.gradient, descent_state.evaluation = (
            z,
            float(evaluation.loss),
            evaluation.gradient,
            evaluation.evaluation,
        )
        descent_state.t, descent_state.low, descent_state.high, descent_state.better, descent_state.trials = (
            1.0,
            0.0,
            np.inf,
            None,
            0,
        )
        descent_state.iterations += 1
        descent_state.note()
        descent_state.reason = self._finish_reason(descent_state)

    def _finish_reason(self, descent_state: DescentState) -> Reason | None:
        """Return the reason why the descent of this start ends, or None if it continues."""
        z, gradient = descent_state.z, descent_state.gradient
        # At a flat end, a derivative that leads back into the range counts as it would in the middle.
        gradient = np.where(gradient * z > 0, gradient / self._steepness_at_ends(z), gradient)
        if np.max(np.abs(gradient)) <= self.stopping.gradient:
            return Reason.GRADIENT
        if descent_state.idle >= MAX_IDLE_STEPS:
            return Reason.CHANGE
        if descent_state.jumps >= MAX_JUMPS:
            return Reason.SLIDE if descent_state.slides else Reason.JUMP
        return Reason.LIMIT if descent_state.iterations >= self.stopping.iterations else None

    def _steepness_at_ends(self, z: np.ndarray) -> np.ndarray:
        """Return the steepness of each free parameter at a flat end of its range, and 1 elsewhere, shape (p,)."""
        steepness = self.steepness(z)
        return np.where(steepness < FLAT, np.maximum(steepness, 1e-300), 1.0)

    def _propose(self, descent_states: list[DescentState], fresh: list[bool]) -> None:
        """Compute new updates for the starts that have moved; the others keep theirs.

        A component that leaves a flat end is divided by the steepness there. No component exceeds
        `MAX_UPDATE_COMPONENT`.
        """
        if not any(fresh):
            return
        z, g = (
            jnp.stack([getattr(descent_state, name) for descent_state in descent_states]) for name in ("z", "gradient")
        )
        loss = jnp.array([descent_state.loss for descent_state in descent_states])
        # A start rejected at its first evaluation may have a NaN gradient; zero keeps the optimiser's state finite.
        g = jnp.where(jnp.isfinite(g), g, 0.0)
        updates, states = self._update(g, self.states, z, loss, self.multipliers)
        updates = np.array(updates)
        bad = [
            self.searches and not _is_descent_direction(u, descent_state.gradient)
            for u, descent_state in zip(updates, descent_states, strict=True)
        ]
        if any(b and f for b, f in zip(bad, fresh, strict=True)):
            # The curvature memory of L-BFGS gives an ascent direction: restart it, which gives steepest descent.
            again, restarted = self._update(g, self._init(z), z, loss, self.multipliers)
            updates = np.where(np.array(bad)[:, None], again, updates)
            states = _select_by_start(np.array(bad), restarted, states)
        self.states: PyTree = _select_by_start(np.array(fresh), states, self.states)
        for descent_state, update, new in zip(descent_states, updates, fresh, strict=True):
            if new:
                z, g = descent_state.z, descent_state.gradient
                leaves = (update * z < 0) & (update * g < 0) & self.searches
                faster = np.clip(update / self._steepness_at_ends(z), -MAX_UPDATE_COMPONENT, MAX_UPDATE_COMPONENT)
                update = np.where(leaves & (np.abs(faster) > np.abs(update)), faster, update)
                descent_state.update = update * min(
                    1.0, MAX_UPDATE_COMPONENT / max(float(np.max(np.abs(update))), 1e-300)
                )


def _is_longest(descent_state: DescentState) -> bool:
    """Return whether the trial step is the greatest that is allowed (1e-9: rounding)."""
    return descent_state.t * np.max(np.abs(descent_state.update)) >= MAX_UPDATE_COMPONENT * (1 - 1e-9)


def _next_step_factor(descent_state: DescentState, loss: float, slope: float) -> float:
    """Return the next step factor t of a line search.

    Without an upper bound on t the step expands. With both bounds it is bisected. With only an upper bound, the next t
    is the minimum of the parabola through both losses and the slope. It is kept between 0.1 t and 0.5 t. If the loss at
    t is not finite, it is t/4.
    """
    if not np.isfinite(descent_state.high):
        return min(STEP_EXPANSION * descent_state.t, MAX_UPDATE_COMPONENT / float(np.max(np.abs(descent_state.update))))
    if descent_state.low > 0 or not np.isfinite(loss):
        return 0.5 * (descent_state.low + descent_state.high) if descent_state.low > 0 else 0.25 * descent_state.high
    bend = loss - descent_state.loss - descent_state.t * slope
    return descent_state.t * min(0.5, max(0.1, -slope * descent_state.t / (2 * bend)))


def _is_descent_direction(update: np.ndarray, gradient: Vector) -> bool:
    """Return whether the update is finite and at an acute angle to the negative gradient."""
    size = np.linalg.norm(update) * np.linalg.norm(gradient)
    return bool(np.isfinite(size) and update @ gradient < -1e-10 * size)


def _select_by_start(mask: np.ndarray, a: Scalar, b: Scalar) -> Array:
    """Return the leaves of `a` for the starts in `mask` and the leaves of `b` for the others."""
    return jax.tree.map(lambda x, y: jnp.where(mask.reshape(-1, *[1] * (jnp.ndim(x) - 1)), x, y), a, b)


def slice_start(tree: T, i: int) -> T:
    """Return the tree of one start: entry `i` along the leading axis of each leaf."""
    return jax.tree.map(lambda x: x[i], tree)
