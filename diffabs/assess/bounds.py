"""Clauses as constraints of a tuning."""

import dataclasses

import jax.numpy as jnp

from diffabs.assess.clauses import Clause, Figures, assess, evaluate_clauses
from diffabs.assess.program import StopProgram
from diffabs.assess.runs import plan_stops
from diffabs.core.types import Array, Params, Scalar
from diffabs.engine.solvers import Solver
from diffabs.loop.closed_loop import Loop


@dataclasses.dataclass(frozen=True, eq=False)
class ClauseBounds:
    """The constraint that a loop's own car meets clauses in all their stops; also for `tune.build_problem`.

    A run that diverges or does not end has the excess NaN: a search rejects a step there, and its start must decide
    every clause. A deceleration that never rises (5.3.3) has an infinite excess, with the same effect.

    Attributes:
        clauses: Numbers of the clauses.
        solver: Solver of the stops, with a duration as for `assess`.
        program: Roads, load, speed and limits.
        engine: Engine of the runs, as in `run_batch`.
    """

    clauses: tuple[str, ...]
    solver: Solver
    program: StopProgram = dataclasses.field(default_factory=StopProgram)
    engine: str = "auto"

    def excess(self, loop: Loop, metrics: Params) -> Scalar:
        """Return the excesses of each clause and stop over the limit, in units of the limit, (k,); 1 for a limit of 0.

        `metrics` is not used: the stops are runs of their own.
        """
        del metrics
        stops = plan_stops(loop.plant, self.program)
        rows, failed = evaluate_clauses(loop, self.solver, stops, self.program, engine=self.engine)
        return jnp.concatenate([find_excess(row, failed) for row in rows if row.number in self.clauses])

    def judge(self, loop: Loop) -> tuple[Clause, ...]:
        """Return the clauses of a loop with concrete parameters, judged as `assess` does."""
        return tuple(row for row in assess(loop, self.solver, self.program).clauses if row.number in self.clauses)


def find_excess(row: Figures, failed: Array) -> Array:
    """Return the excesses of a clause in its stops, over the limit in units of it, NaN for a run that failed."""
    beyond = row.limit - row.values if row.at_least else row.values - row.limit
    scale = jnp.where(jnp.asarray(row.limit) == 0, 1.0, row.limit)
    return jnp.where(failed[:, jnp.asarray(row.stop_indices)], jnp.nan, beyond / scale).ravel()
