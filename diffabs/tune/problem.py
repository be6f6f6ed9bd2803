"""The tuning problem as a function of the unbounded vector z: loss, gradient and admissibility.

    J(z) = aggregate over the runs of (run weight * sum of metric weight * metric)
    L(z) = J/s + sum over the constraints of [max(0, m + c (g + d))^2 - m^2]/(2 c)

L is the augmented Lagrangian of Powell, Hestenes and Rockafellar for g + d <= 0, with multipliers m and penalty c. The
scale s is the magnitude of the objective at the start, so that L is of the order of one. Iterates of the method of
multipliers approach a bound from outside and do not quite reach it. The margin d moves the bound a little inside the
feasible set, so that the end of a search usually has g <= 0; `Tuned.met` says whether it does.

A search has several starts: values of z, each with a descent of its own. Functions of all starts take z of shape
(starts, p).
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.bijectors import FreeSpace
from diffabs.core.compiling import SAME_RESULT_OPTIONS
from diffabs.core.protocols import Objective
from diffabs.core.pytree import canonical_dtypes
from diffabs.core.types import AnyArray, Array, Int, Part, PyTree, Scalar, Vector
from diffabs.engine.drive.deferred import MANY_INPUTS_REASON, find_kernels
from diffabs.engine.solvers import Solver
from diffabs.loop.admissible import batch_admissibility, first_refusal
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.loop.ensemble import run_batch
from diffabs.loop.result import Run
from diffabs.tune.constraints import Constraint
from diffabs.tune.method import DerivativeMode
from diffabs.tune.result import build_subject_loop
from diffabs.tune.risk import Aggregate

MAX_QUICK_COMPILE_RUNS = 64  # above this number of runs, XLA's default options pay for their longer compilation
MAX_FORWARD_PARAMETERS = 6  # parameters up to which forward mode is cheaper (benchmarks/bench_gradient.py)


class ObjectiveEvaluation(NamedTuple):
    """The evaluation at one z: objective J, excesses (k,), number of diverged runs, metrics of every run, and number
    of sliding runs.
    """

    objective: Any
    excess: Array
    diverged: Int
    metrics: dict[str, PyTree]
    slid: Int = 0


class LossEvaluation(NamedTuple):
    """The loss, its gradient (p,) and the evaluation of the objective, with a leading axis of starts if batched."""

    loss: Array
    gradient: Vector
    evaluation: ObjectiveEvaluation


class Multipliers(NamedTuple):
    """The multipliers (k,), the penalty, a number, and the margin d, a number or None for zero.

    With several starts each has a leading axis of starts.
    """

    values: np.ndarray
    penalty: np.ndarray
    margin: Any = None


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A tuning problem: a part, its free parameters, the runs, the objective, and the constraints.

    Attributes:
        subject: Loop, or a part with a method `closed_loop()`. The parameters of such a part may be of any kind that
            determines a loop, for example LQ weights.
        space: Map from the unbounded vector z to the free parameters.
        solver: Solver of every run.
        measured: What computes each metric from a run, by the name of the metric.
        weights: Weights of the metrics in J, at least one.
        batch: The runs.
        aggregate: Map from one number for each run to J.
        constraints: Constraints on the loop and its metrics.
        mode: Forward or reverse mode of differentiation.
        engine: Engine of the runs, "xla", "kernel" or "auto".
    """

    subject: Part
    space: FreeSpace
    solver: Solver
    measured: Mapping[str, Objective]
    weights: Mapping[str, float]
    batch: Batch
    aggregate: Aggregate
    constraints: Sequence[Constraint]
    mode: DerivativeMode
    engine: str = "auto"

    def runs(self, z: AnyArray) -> Run:
        """Return all runs at `z`, without trajectories."""
        loop = build_subject_loop(self.space.at(self.subject, z))
        return run_batch(loop, self.batch, self.solver, self.measured, engine=self.engine)

    def find_engine(self) -> tuple[str, str]:
        """Return the engine that makes the runs and their derivatives, "xla" or "kernel", and the reason for XLA.

        The check makes no runs. It compiles the kernel and keeps it.

        Raises:
            EngineError: The engine is "kernel", and a kernel is impossible.
        """
        if self.engine == "xla":
            return "xla", ""
        z = jax.ShapeDtypeStruct((1, self.space.size), jnp.result_type(float))
        none = Multipliers(np.zeros((1, self.excesses)), np.ones(1), None)
        if kernels := find_kernels(self._evaluate.trace(z, none, 1.0).jaxpr):
            reason = next((reason for _, reason in kernels if reason), "")
            return ("xla" if reason else "kernel"), reason
        # The program of a reverse derivative by XLA has no mark of a run, so the program of the values has the reason.
        reasons = [
            reason or MANY_INPUTS_REASON for _, reason in find_kernels(jax.make_jaxpr(jax.vmap(self.evaluate))(z))
        ]
        return "xla", next(iter(reasons), "")

    def evaluate(self, z: AnyArray) -> ObjectiveEvaluation:
        """Return objective, excesses, number of diverged runs, metrics, and number of sliding runs at `z` (p,).

        If the batch has weights, each multiplies its run's sum of metrics before the aggregate.
        """
        runs = self.runs(z)
        each = sum(weight * runs.metrics[name] for name, weight in self.weights.items())
        each = each if self.batch.weights is None else each * jnp.asarray(self.batch.weights)
        loop = build_subject_loop(self.space.at(self.subject, z))
        excess = self._excess(loop, runs.metrics)
        lost, slid = jnp.sum(runs.diverged), jnp.sum(jnp.asarray(runs.slid))
        return ObjectiveEvaluation(self.aggregate(jnp.asarray(each)), excess, lost, runs.metrics, slid)

    @functools.cached_property
    def excesses(self) -> int:
        """Number of excesses over all constraints."""
        # eval_shape needs only the shapes of the metrics, so no run is made.
        lanes = {name: jax.ShapeDtypeStruct((self.batch.size,), jnp.result_type(float)) for name in self.measured}
        z = self.space.place(self.subject)
        return jax.eval_shape(
            lambda metrics: self._excess(build_subject_loop(self.space.at(self.subject, z)), metrics), lanes
        ).size

    def _excess(self, loop: Loop, metrics: dict[str, PyTree]) -> Array:
        excess = [jnp.ravel(c.excess(loop, metrics)) for c in self.constraints]
        return jnp.concatenate(excess) if excess else jnp.zeros(0)

    def loss(self, scale: Scalar) -> Callable[[PyTree, Multipliers], tuple[PyTree, tuple[PyTree, ObjectiveEvaluation]]]:
        """Return the function (z, multipliers) -> (L, (L, evaluation)) for an objective divided by `scale`.

        L is both the value to differentiate and, for the caller of `jax.grad(..., has_aux=True)`, a result beside it.
        """

        def loss(z: AnyArray, m: Multipliers) -> tuple[PyTree, tuple[PyTree, ObjectiveEvaluation]]:
            evaluation = self.evaluate(z)
            value = evaluation.objective / scale + _penalty(evaluation.excess, m)
            return value, (value, evaluation)

        return loss

    def evaluator(self, scale: float) -> Callable[[PyTree, Multipliers], LossEvaluation]:
        """Return the compiled function (z, multipliers) -> LossEvaluation for an objective divided by `scale`.

        z has shape (starts, p), and the multipliers have a leading axis of starts. One call evaluates all starts, and
        one compiled program serves every scale.
        """
        return lambda z, m: self._evaluate(z, m, scale)

    @functools.cached_property
    def _evaluate(self) -> Any:
        derivative = jax.jacfwd if self.mode is DerivativeMode.FORWARD else jax.grad

        def evaluate(z: AnyArray, m: Multipliers, scale: Scalar) -> LossEvaluation:
            gradient, (value, evaluation) = derivative(self.loss(scale), has_aux=True)(z, m)
            return LossEvaluation(value, gradient, evaluation)

        options = SAME_RESULT_OPTIONS if self.batch.size <= MAX_QUICK_COMPILE_RUNS else None
        return jax.jit(jax.vmap(evaluate, in_axes=(0, 0, None)), compiler_options=options)

    def objective_evaluator(self) -> Callable[[PyTree], ObjectiveEvaluation]:
        """Return the compiled function z (starts, p) -> ObjectiveEvaluation, without a gradient."""
        return jax.jit(jax.vmap(self.evaluate))

    def find_refusal(self) -> str | None:
        """Return one line on why the first inadmissible run is refused at the subject's own values, or None."""
        return first_refusal(build_subject_loop(self.subject), self.batch.values, self.solver)

    def steady(self) -> Callable[[np.ndarray], np.ndarray]:
        """Return the function z (starts, p) -> mask (starts,) of the starts at which every run is admissible.

        A run is admissible if it meets the rules of its parts and its integration step is stable. It need not be in a
        steady state. The function runs on the host and cannot be traced.
        """

        def loops(z: AnyArray) -> Loop:
            return self.batch.each(
                canonical_dtypes(build_subject_loop(self.space.at(self.subject, z))),
                lambda loop, key: canonical_dtypes(loop),
            )

        compiled = jax.jit(jax.vmap(loops))

        def accept(z: np.ndarray) -> np.ndarray:
            # Starts and runs share one axis, so that one call checks all of them.
            flat = jax.tree.map(lambda x: np.reshape(x, (-1, *x.shape[2:])), jax.device_get(compiled(jnp.asarray(z))))
            return batch_admissibility(None, flat, self.solver).accepted.reshape(len(z), -1).min(axis=1)

        return accept


def choose_gradient_mode(space: FreeSpace) -> DerivativeMode:
    """Return forward mode for up to `MAX_FORWARD_PARAMETERS` parameters, otherwise reverse mode."""
    return DerivativeMode.FORWARD if space.size <= MAX_FORWARD_PARAMETERS else DerivativeMode.REVERSE


def _penalty(excess: object, m: Multipliers) -> Scalar:
    """Return the sum over the excesses of [max(0, m + c (g + d))^2 - m^2]/(2 c)."""
    aimed = excess if m.margin is None else excess + m.margin
    return jnp.sum(jnp.maximum(0.0, m.values + m.penalty * aimed) ** 2 - m.values**2) / (2 * m.penalty)
