"""Gradient-based tuning of any parameters of any part, under constraints, over a batch of runs."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import jax
import numpy as np

from diffabs.core.bijectors import FreeSpace, Range, parameter_space
from diffabs.core.jax_flags import default_flags
from diffabs.core.kinds import find_value_objection, format_value, value_shape
from diffabs.core.protocols import Objective
from diffabs.core.pytree import canonical_dtypes, get, replace
from diffabs.core.tracing import used_inputs
from diffabs.core.types import Params
from diffabs.core.validity import check_part
from diffabs.engine.drive.engine import resolve_request
from diffabs.engine.solvers import Solver
from diffabs.host.interactive import ProgressLine, report_to
from diffabs.loop.arguments import refuse
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.parts.objectives import default_objectives
from diffabs.tune import one_sided
from diffabs.tune.augmented_lagrangian import AugmentedLagrangianSearch
from diffabs.tune.constraints import Constraint
from diffabs.tune.method import DerivativeMode, Method
from diffabs.tune.problem import Problem, choose_gradient_mode
from diffabs.tune.result import Tuned, TuningProgress, build_subject_loop
from diffabs.tune.risk import Aggregate, Mean


@default_flags()
def tune(
    problem: Problem,
    *,
    method: Method | None = None,
    progress: Callable[[TuningProgress], None] | None = None,
    stopping: Callable[[], bool] = lambda: False,
) -> Tuned:
    """Solve a tuning problem by gradients, and return the best part found.

    The function warns if a derivative by a free parameter is one-sided (`docs/gradients.md`) in a run of the start or
    the result. A search may end at such a point without a minimum.

    Args:
        problem: The problem, from `build_problem`.
        method: Optimiser, starts, iterations; None is L-BFGS from the subject's own values.
        progress: Called after every evaluation, with the best of the last points of all starts. None shows a line in a
            notebook and in an interactive session.
        stopping: Called after every evaluation; True ends the search with the best point so far.

    Raises:
        ValueError: `problem` is no Problem.
        EngineError: The engine of the problem is "kernel", and a kernel cannot make the runs.
        StartError: At every start a run diverges or is inadmissible, or the objective or its gradient is not finite.

    See also:
        `tune.build_problem`: The problem, from a loop, free parameters and an objective.
        `tune.worst_case`: Whether the result holds in a box.
        `design.design`: A gain with a proof, for a linear model.

    Notes:
        A search works in unbounded coordinates z of the free parameters and descends along the gradient of

            L(z) = J(z)/s + sum [max(0, m + c (g(z) + d))^2 - m^2]/(2 c)

        with the objective J, its scale s, excesses g of the constraints, margin d, multipliers m and penalty c. Steps
        of L-BFGS satisfy the weak Wolfe conditions, found by bisection, which suits objectives with kinks. Sources: A.
        S. Lewis and M. L. Overton, Nonsmooth optimization via quasi-Newton methods, Math. Program. 141 (2013); J.
        Nocedal and S. J. Wright, Numerical Optimization, 2nd ed., sec. 17.4. The search is local: several starts show
        whether its minimum depends on the start.

    Examples:
        A constant brake torque is tuned for a slip of 0.2:

        >>> import diffabs as d
        >>> from diffabs import controllers, objectives, plants, roads, stops, tune
        >>> parts = {"plant": plants.QuarterCar(road=roads.DRY_ASPHALT), "stop": stops.SpeedReached(speed=5.0)}
        >>> loop = d.braking(controller=controllers.ConstantTorque(torque=20.0), **parts)
        >>> free, measured = {"controller.torque": (10.0, 100.0)}, {"iae": objectives.IAE()}
        >>> solver = d.FixedStep(1e-3, 6.0)
        >>> problem = tune.build_problem(loop, free=free, objective={"iae": 1.0}, measured=measured, solver=solver)
        >>> tuned = tune.tune(problem)
        >>> before, after = tuned.objective
        >>> print(f"{tuned.values['controller.torque']:.1f} N m, {before:.2f} to {after:.2f} s")
        85.6 N m, 1.14 to 0.18 s
    """
    if not isinstance(problem, Problem):
        kind = type(problem).__name__ if isinstance(problem, Loop) else format_value(problem)
        needed = "build_problem(loop, free=..., objective=..., solver=...) makes one"
        raise ValueError(f"problem = {kind} is no Problem; {needed}")
    subject, paths = problem.subject, [entry.path for entry in problem.space.entries]
    start_values = {path: get(subject, path) for path in paths}
    one_sided.warn(subject, start_values, problem.batch, problem.solver, "start")
    with ProgressLine() as line:
        report = report_to(line, progress, str)
        tuned = AugmentedLagrangianSearch(problem, method or Method(), report, stopping).result()
    one_sided.warn(subject, tuned.values, problem.batch, problem.solver, "result")
    return tuned


@default_flags()
def build_problem(
    subject: object,
    *,
    free: Sequence[str] | Mapping[str, Range | None],
    objective: Mapping[str, float],
    over: Batch | None = None,
    solver: Solver,
    measured: Mapping[str, Objective] | None = None,
    aggregate: Aggregate | None = None,
    constraints: Iterable[Constraint] = (),
    mode: DerivativeMode | None = None,
    engine: str = "auto",
) -> Problem:
    """Return the problem to minimise an aggregate, over a batch of runs, of a weighted sum of metrics.

    `tune` solves the problem. Another search can use its functions (`Problem.evaluator`, `Problem.steady`).

    Args:
        subject: A Loop, or a part with a method `closed_loop()`.
        free: Dotted paths of the free parameters. A mapping gives the range that bounds each; None is the declared
            range.
        objective: Weight of each metric of `measured` in the objective, `{"stop_distance": 1.0, "effort": 1e-4}`.
        over: The runs, as parameters of the loop by path; None is one run of the loop itself.
        solver: Solver of every run.
        measured: Objectives by metric; None takes the default objectives of the plant.
        aggregate: Map from one number for each run to one number: Mean (also for None), SmoothWorst, CVaR, Quantile.
        constraints: Constraints: AtMost of a metric in every run, Poles, CertifiedDecay.
        mode: Forward or reverse mode of differentiation; None decides by the number of free parameters.
        engine: Engine of the runs and their derivatives, "xla", "kernel" or "auto", as in `run_batch`. `Tuned.engine`
            names the engine that made them.

    Raises:
        ValueError: A path, range, metric, constraint or batch does not fit, or a parameter is out of range.
        ValueError: `over` or `closed_loop()` overwrites a free parameter, or the engine is unknown.

    See also:
        `tune.tune`: The search that solves it.
        `tune.AtMost`: A bound of a metric in every run.
        `tune.CVaR`, `tune.SmoothWorst`, `tune.Mean`, `tune.Quantile`: Aggregates over the runs.
        `Batch`: The runs.

    Notes:
        The objective is

            J(p) = aggregate over the runs i of sum_k w_k m_k(p, i)

        with the weights w of `objective` and the metrics m. A finite range of a parameter becomes the real line by the
        logistic function. Source of `CVaR`: R. T. Rockafellar and S. Uryasev, Optimization of conditional
        value-at-risk, J. Risk 2 (2000).

    Examples:
        The worst of three masses counts, and no wheel may lock:

        >>> import diffabs as d
        >>> from diffabs import controllers, objectives, tune
        >>> problem = tune.build_problem(
        ...     d.braking(controller=controllers.PID(kp=1000.0, ki=100.0)),
        ...     free={"controller.kp": (100.0, 1e4), "controller.ki": (1.0, 1e4)},
        ...     measured={"iae": objectives.IAE(), "locked": objectives.LockedTime()},
        ...     objective={"iae": 1.0},
        ...     constraints=[tune.AtMost("locked", 0.01)],
        ...     over=d.Batch({"plant.mass": [12.0, 15.0, 18.0]}),
        ...     aggregate=tune.SmoothWorst(),
        ...     solver=d.FixedStep(1e-4, 4.0),
        ... )
        >>> problem.space.size, len(problem.constraints), problem.mode.value
        (2, 1, 'forward')
    """
    check_part(subject)
    loop = build_subject_loop(subject)
    measured = default_objectives(loop.plant) if measured is None else measured
    refuse(loop, solver, measured)
    if over is not None and not isinstance(over, Batch):
        raise ValueError(f"over = {format_value(over)} is no Batch; d.Batch(values by path) is needed")
    batch = (over or Batch()).check(loop)
    _check_metrics(objective, measured)
    constraints = _check_constraints(constraints, measured, batch.size)
    free_space = parameter_space(subject, free)
    _check_not_overwritten(subject, free_space, batch)
    return Problem(
        subject=subject,
        space=free_space,
        solver=solver,
        measured=measured,
        weights=objective,
        batch=batch,
        aggregate=check_part(aggregate or Mean(), "aggregate."),
        constraints=constraints,
        mode=mode or choose_gradient_mode(free_space),
        engine=resolve_request(engine),
    )


def _check_metrics(objective: Mapping[str, float], measured: Mapping[str, Objective]) -> None:
    if not isinstance(objective, Mapping):
        raise ValueError(f"objective = {format_value(objective)} is no mapping from metrics to weights")
    if not objective:
        raise ValueError("the objective has no metric")
    for name, weight in objective.items():
        _check_measured(name, measured)
        if find_value_objection(weight) or not np.isfinite(weight):
            raise ValueError(f"objective: the weight of {name} is {weight!r}, not a finite number")


def _check_constraints(
    constraints: Iterable[Constraint], measured: Mapping[str, Objective], runs: int
) -> tuple[Constraint, ...]:
    """Return the constraints; raise a ValueError if one is no constraint, or a bound does not fit the runs."""
    listed = isinstance(constraints, Iterable) and not isinstance(constraints, Mapping | str)
    requirements = tuple(constraints) if listed else ()  # a generator can be read once only
    if not listed or not all(hasattr(requirement, "excess") for requirement in requirements):
        described = format_value(constraints)
        raise ValueError(f'constraints = {described} is no list of constraints, such as [AtMost("overshoot", 0.01)]')
    for requirement in requirements:  # AtMost, or a class of the user's own with such attributes
        if (metric := getattr(requirement, "metric", None)) is None:
            continue
        _check_measured(metric, measured)
        bound = getattr(requirement, "bound", 0.0)
        if find_value_objection(bound) or not np.isfinite(np.asarray(bound, float)).all():
            raise ValueError(f"constraints: the bound of {metric} is {bound!r}, not a finite number")
        if value_shape(bound) not in ((), (runs,)):
            needed = f"one number, or one for each of {runs} runs, is needed"
            raise ValueError(f"constraints: the bound of {metric} has the shape {value_shape(bound)}; {needed}")
    return requirements


def _check_not_overwritten(subject: object, space: FreeSpace, batch: Batch) -> None:
    """Raise a ValueError if `over` or `closed_loop()` overwrites a free parameter: the search could not move it."""

    def loops(values: Params) -> Loop:
        loop = canonical_dtypes(build_subject_loop(replace(subject, values)))
        return batch.each(loop, lambda loop, key: loop)

    start_values = {entry.path: np.asarray(get(subject, entry.path), float) for entry in space.entries}
    used = used_inputs(jax.make_jaxpr(loops)(start_values).jaxpr)
    if idle := [path for path, is_used in zip(sorted(start_values), used, strict=True) if not is_used]:
        by = "`over`" if isinstance(subject, Loop) else "`over` or `closed_loop()`"
        raise ValueError(f"{', '.join(idle)}: free, but {by} gives its value in every run")


def _check_measured(name: str, measured: Mapping[str, Objective]) -> None:
    if name not in measured:
        raise ValueError(f"{name} is not measured; there is {', '.join(measured)}")
