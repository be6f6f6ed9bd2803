"""What is tuned, as a function of the unbounded vector z: loss, gradient, and what is needed to judge a step.

    J(z) = aggregate over the lanes of (sum of weight * metric)
    L(z) = J/s + sum over the constraints of [max(0, m + c (g + d))^2 - m^2]/(2 c)

L is the augmented Lagrangian of Powell, Hestenes and Rockafellar for g + d <= 0 with multipliers m and penalty c; s is
the objective's size at the start, so that L is of the order of one. d is a margin: multipliers come to a bound from
outside and never quite reach it, so what is aimed at lies a little inside, and g <= 0 holds where a search ends.
"""

import dataclasses
import enum
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.bijectors import FreeSpace
from diffabs.core.compiling import SAME_RESULT_OPTIONS
from diffabs.core.loop import Loop
from diffabs.core.protocols import Objective
from diffabs.core.pytree import canonical_dtypes
from diffabs.kernel.compilers import NoCompiler
from diffabs.simulate.admissible import batch_admissibility, first_refusal
from diffabs.simulate.batch import Batch, run_batch
from diffabs.simulate.engine import REQUESTABLE_ENGINES, EngineError, log_xla_reason
from diffabs.simulate.solution import Run, Solver
from diffabs.tune.constraints import Constraint
from diffabs.tune.risk import Aggregate

MAX_QUICK_COMPILE_RUNS = 64  # lanes from which on their runs take longer than compiling them
NO_REVERSE_MESSAGE = "a kernel has no reverse mode; forward mode, or engine = 'xla'"
MAX_FORWARD_PARAMETERS = 6  # parameters up to which forward mode is the cheaper one (benchmarks/bench_gradient.py)


class DerivativeMode(enum.Enum):
    """How a gradient is computed: one rollout with a tangent per parameter, or a checkpointed backward pass."""

    FORWARD = "forward"
    REVERSE = "reverse"


class ObjectiveEvaluation(NamedTuple):
    """What is known at one z: objective J, excesses (k,), how many lanes diverged, the metrics of every lane."""

    objective: Any
    excess: Any
    diverged: Any
    metrics: dict[str, Any]


class LossEvaluation(NamedTuple):
    """Loss, its gradient (p,), and what was seen; with a leading axis of starts where there are several."""

    loss: Any
    gradient: Any
    seen: ObjectiveEvaluation


class Multipliers(NamedTuple):
    """Multipliers (k,), penalty and margin of the augmented Lagrangian; None is no margin."""

    values: Any
    penalty: Any
    margin: Any = None


def build_subject_loop(subject: Any) -> Loop:
    """The loop that a part stands for: itself, or what its method `closed()` makes of its parameters."""
    return subject if isinstance(subject, Loop) else subject.closed()


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A part, its free parameters, and how a choice of them is judged. `subject` is a Loop, or a part with a method
    `closed()`, whose parameters may then be anything that a loop can be computed from (LQ weights, say)."""

    subject: Any
    space: FreeSpace
    solver: Solver
    measured: Mapping[str, Objective]
    weights: Mapping[str, float]
    batch: Batch
    aggregate: Aggregate
    constraints: Sequence[Constraint]
    mode: DerivativeMode
    engine: str = "xla"

    def runs(self, z: Any) -> Run:
        """All lanes at z, without trajectories."""
        together = True if self.engine == "xla" else None
        loop = build_subject_loop(self.space.at(self.subject, z))
        return run_batch(loop, self.batch, self.solver, self.measured, together=together, engine=self.engine)

    def with_engine(self, engine: str, mode: DerivativeMode | None = None) -> "Problem":
        """Return the problem whose runs are made by this engine; "auto" is a kernel if it can be one, and tells the log
        once why it is not. Of a kernel the mode is forward, if none is asked for.

        Raises EngineError for a kernel in reverse mode."""
        if engine not in REQUESTABLE_ENGINES:
            raise ValueError(f"engine = {engine!r} is unknown; there is {', '.join(REQUESTABLE_ENGINES)}")
        if engine == "xla":
            return self
        line = NO_REVERSE_MESSAGE if mode is DerivativeMode.REVERSE else None
        found = dataclasses.replace(self, engine="kernel", mode=DerivativeMode.FORWARD)
        if engine == "kernel" and line:
            raise EngineError.of(line)
        if engine == "auto" and (line := line or found.objection()):
            log_xla_reason(line)
            return self
        return found

    def objection(self) -> str | None:
        """Return why its engine cannot make the runs and their derivatives, or None. None is made, but what makes them
        is compiled, and kept."""
        z = jax.ShapeDtypeStruct((1, self.space.size), jnp.result_type(float))
        none = Multipliers(np.zeros((1, self.excesses)), np.ones(1), None)
        try:
            self._evaluate.lower(z, none, 1.0)
        except EngineError as error:
            return str(error)
        except NoCompiler as error:  # where that is already known to be no objection, and is one now
            return str(EngineError.of(error))
        return None

    def seen(self, z: Any) -> ObjectiveEvaluation:
        """Objective and excesses at z."""
        runs = self.runs(z)
        each = sum(weight * runs.metrics[name] for name, weight in self.weights.items())
        each = each if self.batch.weights is None else each * jnp.asarray(self.batch.weights)
        loop = build_subject_loop(self.space.at(self.subject, z))
        excess = self._excess(loop, runs.metrics)
        return ObjectiveEvaluation(self.aggregate(jnp.asarray(each)), excess, jnp.sum(runs.diverged), runs.metrics)

    @functools.cached_property
    def excesses(self) -> int:
        """How many excesses there are."""
        lanes = {name: jax.ShapeDtypeStruct((self.batch.size,), jnp.result_type(float)) for name in self.measured}
        z = self.space.place(self.subject)
        return jax.eval_shape(
            lambda metrics: self._excess(build_subject_loop(self.space.at(self.subject, z)), metrics), lanes
        ).size

    def _excess(self, loop: Loop, metrics: dict[str, Any]) -> Any:
        excess = [jnp.ravel(c.excess(loop, metrics)) for c in self.constraints]
        return jnp.concatenate(excess) if excess else jnp.zeros(0)

    def loss(self, scale: Any) -> Callable[[Any, Multipliers], tuple[Any, tuple[Any, ObjectiveEvaluation]]]:
        """(z, multipliers) -> L, and (L, what was seen)."""

        def loss(z: Any, m: Multipliers) -> tuple[Any, tuple[Any, ObjectiveEvaluation]]:
            seen = self.seen(z)
            value = seen.objective / scale + _penalty(seen.excess, m)
            return value, (value, seen)

        return loss

    def evaluator(self, scale: float) -> Callable[[Any, Multipliers], LossEvaluation]:
        """(starts, p) and multipliers with a leading axis of starts -> Evaluation; compiled, one call for all, and once
        for every scale."""
        return lambda z, m: self._evaluate(z, m, scale)

    @functools.cached_property
    def _evaluate(self) -> Any:
        derivative = jax.jacfwd if self.mode is DerivativeMode.FORWARD else jax.grad

        def evaluate(z: Any, m: Multipliers, scale: Any) -> LossEvaluation:
            gradient, (value, seen) = derivative(self.loss(scale), has_aux=True)(z, m)
            return LossEvaluation(value, gradient, seen)

        options = SAME_RESULT_OPTIONS if self.batch.size <= MAX_QUICK_COMPILE_RUNS else None
        return jax.jit(jax.vmap(evaluate, in_axes=(0, 0, None)), compiler_options=options)

    def objective_evaluator(self) -> Callable[[Any], ObjectiveEvaluation]:
        """(starts, p) -> Seen: without a gradient."""
        return jax.jit(jax.vmap(self.seen))

    def refused(self) -> str | None:
        """The first lane of the part as it is that must not be run, and why, in a line; None if all may."""
        return first_refusal(build_subject_loop(self.subject), self.batch.values, self.solver)

    def steady(self) -> Callable[[np.ndarray], np.ndarray]:
        """(starts, p) -> whether every lane may be run there (starts,): the parts' rules, and a stable step. Compiled
        once."""

        def loops(z: Any) -> Loop:
            return self.batch.each(
                canonical_dtypes(build_subject_loop(self.space.at(self.subject, z))),
                lambda loop, key: canonical_dtypes(loop),
            )

        compiled = jax.jit(jax.vmap(loops))

        def accepted(z: np.ndarray) -> np.ndarray:
            flat = jax.tree.map(lambda x: np.reshape(x, (-1, *x.shape[2:])), jax.device_get(compiled(jnp.asarray(z))))
            return batch_admissibility(None, flat, self.solver).accepted.reshape(len(z), -1).min(axis=1)

        return accepted


def choose_gradient_mode(space: FreeSpace) -> DerivativeMode:
    """Forward for few parameters, reverse for many."""
    return DerivativeMode.FORWARD if space.size <= MAX_FORWARD_PARAMETERS else DerivativeMode.REVERSE


def _penalty(excess: Any, m: Multipliers) -> Any:
    """[max(0, m + c (g + d))^2 - m^2]/(2 c), summed."""
    aimed = excess if m.margin is None else excess + m.margin
    return jnp.sum(jnp.maximum(0.0, m.values + m.penalty * aimed) ** 2 - m.values**2) / (2 * m.penalty)
