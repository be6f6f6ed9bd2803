"""Tune any parameters of any part by gradients, under constraints, over a batch of runs."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from diffabs.core.bijectors import Range, parameter_space
from diffabs.core.protocols import Objective
from diffabs.core.pytree import get
from diffabs.core.validity import check_part
from diffabs.kernel.compilers import NoCompiler
from diffabs.objectives import default_objectives
from diffabs.simulate.batch import Batch
from diffabs.simulate.engine import EngineError
from diffabs.simulate.solution import Solver
from diffabs.tune import one_sided
from diffabs.tune.augmented_lagrangian import AugmentedLagrangianSearch
from diffabs.tune.constraints import Constraint
from diffabs.tune.problem import DerivativeMode, Problem, build_subject_loop, choose_gradient_mode
from diffabs.tune.result import Method, Tuned, TuningProgress
from diffabs.tune.risk import Aggregate, Mean


def tune(
    subject: Any,
    *,
    free: Sequence[str] | Mapping[str, Range | None],
    objective: Mapping[str, float],
    over: Batch | None = None,
    solver: Solver,
    measured: Mapping[str, Objective] | None = None,
    aggregate: Aggregate | None = None,
    constraints: Sequence[Constraint] = (),
    method: Method | None = None,
    progress: Callable[[TuningProgress], None] | None = None,
    stopping: Callable[[], bool] = lambda: False,
    engine: str = "xla",
) -> Tuned:
    """Minimise an aggregate, over a batch of runs, of a weighted sum of metrics, and return what was found.

    subject: a Loop, or a part with a method `closed()`
    free: dotted paths of its parameters, with ranges in which they stay (declared ones where None)
    measured: objectives by metric; None is what is usual for what the plant shows
    objective: weight of each metric of `measured`, `{"stop_distance": 1.0, "effort": 1e-4}`
    over: the runs, parameters of the loop by path; none is the loop itself
    solver: of every run
    aggregate: from a number per lane to one: Mean (as None), SmoothWorst, CVaR, Quantile
    constraints: what must hold: AtMost of a metric on every lane, Poles, CertifiedDecay
    method: optimiser, starts, iterations; None is L-BFGS from the subject's own values
    progress: told the best so far after every iteration
    stopping: asked after every evaluation; True ends the search with the best that it has met so far
    engine: what makes the runs and their derivatives, as in `run_batch`; a kernel's are forward, of however many
        parameters

    >>> import diffabs as d
    >>> from diffabs import controllers, objectives, plants, roads, stops, tune
    >>> parts = {"plant": plants.QuarterCar(road=roads.DRY_ASPHALT), "stop": stops.SpeedReached(speed=5.0)}
    >>> loop = d.braking(controller=controllers.ConstantTorque(torque=20.0), **parts)
    >>> free, measured = {"controller.torque": (10.0, 100.0)}, {"iae": objectives.IAE()}
    >>> solver = d.FixedStep(1e-3, 6.0)
    >>> found = tune.tune(loop, free=free, objective={"iae": 1.0}, measured=measured, solver=solver)
    >>> print(f"{found.values['controller.torque']:.1f} N m, {found.objective[0]:.2f} to {found.objective[1]:.2f} s")
    85.6 N m, 1.14 to 0.18 s

    Warns where a derivative by a free parameter is that of one side (`docs/gradients.md`), in a run of the start or the
    result: a search may end there without a minimum.

    Raises:
        ValueError: a path, range, metric or batch that does not fit; a lane that must not be run whatever is tuned.
        EngineError: what stands against the engine "kernel".
        StartError: a start that diverges, or at which the integration step is not stable, if there is no other.
    """
    method = method or Method()
    problem = build_problem(
        subject,
        free=free,
        objective=objective,
        over=over,
        solver=solver,
        measured=measured,
        aggregate=aggregate,
        constraints=constraints,
        mode=method.mode,
        engine=engine,
    )
    one_sided.warn(subject, {path: get(subject, path) for path in free}, problem.batch, solver, "start")
    try:
        found = AugmentedLagrangianSearch(problem, method, progress, stopping).result()
    except NoCompiler as error:
        raise EngineError.of(error) from None
    one_sided.warn(subject, found.values, problem.batch, solver, "result")
    return found


def build_problem(
    subject: Any,
    *,
    free: Sequence[str] | Mapping[str, Range | None],
    objective: Mapping[str, float],
    over: Batch | None = None,
    solver: Solver,
    measured: Mapping[str, Objective] | None = None,
    aggregate: Aggregate | None = None,
    constraints: Sequence[Constraint] = (),
    mode: DerivativeMode | None = None,
    engine: str = "xla",
) -> Problem:
    """Return the problem that `tune` solves, for those who bring their own search.

    subject, free, objective, over, solver, measured, aggregate, constraints, engine: as in `tune`
    mode: of differentiation, forward or reverse; None is the cheaper one

    Raises ValueError as `tune` does."""
    check_part(subject)
    loop = build_subject_loop(subject)
    measured = default_objectives(loop.plant) if measured is None else measured
    batch = (over or Batch()).check(loop)
    _check_metrics(objective, measured, constraints)
    free_space = parameter_space(subject, free)
    problem = Problem(
        subject=subject,
        space=free_space,
        solver=solver,
        measured=measured,
        weights=objective,
        batch=batch,
        aggregate=aggregate or Mean(),
        constraints=constraints,
        mode=mode or choose_gradient_mode(free_space),
    )
    return problem.with_engine(engine, mode)


def _check_metrics(objective: Mapping[str, float], measured: Mapping[str, Objective], constraints: Any) -> None:
    wanted = [*objective, *(c.metric for c in constraints if hasattr(c, "metric"))]
    if not objective:
        raise ValueError("the objective has no metric")
    for name in wanted:
        if name not in measured:
            raise ValueError(f"{name} is not measured; there is {', '.join(measured)}")
    for name, weight in objective.items():
        if not np.isfinite(weight):
            raise ValueError(f"objective: the weight of {name} is {weight}, not a finite number")
