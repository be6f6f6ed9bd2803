"""Single runs of a loop by fixed or adaptive Runge-Kutta steps, with a trajectory or with metrics only.

If a step crosses the stop or the event of a block, shorter steps are attempted until one ends there
(`step/event_location`). So every objective is exact to the order of the method and differentiable, independent of the
place of the crossing in the step.
"""

from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core import kinds
from diffabs.core.compiling import is_traced
from diffabs.core.jax_flags import default_flags
from diffabs.core.protocols import Objective
from diffabs.core.types import Key, PyTree
from diffabs.engine.drive.deferred import run_deferred
from diffabs.engine.drive.engine import default_engine
from diffabs.engine.drive.loops import round_up_capacity
from diffabs.engine.drive.runs import RunPlan, run_differentiable
from diffabs.engine.solvers import Adaptive, Solver
from diffabs.engine.step.replay import log_capacity
from diffabs.loop.arguments import prepare_arguments, refuse_values
from diffabs.loop.closed_loop import Loop
from diffabs.loop.result import Run, finish_run, observe


@default_flags()
def rollout(
    loop: Loop, solver: Solver, objectives: Mapping[str, Objective] | None = None, *, key: Key | None = None
) -> Run:
    """Run a loop and return a `Run` with its trajectory and metrics.

    The trajectory has ceil(steps/`every`) + 1 instants, from t = 0 on. Beyond the end of the run its last sample is
    repeated.

    The function is pure and compiled once per structure of the loop: new values and another duration do not compile
    again. A trajectory or a derivative does compile again if it outgrows its capacity, which is at most an eighth more
    than requested. Traced parameters are not checked: a warning says so of the step, unless it was stable for such a
    loop. A run with impossible ones diverges only if its numbers are invalid or not physically possible
    (`Run.diverged`).

    Args:
        loop: Closed loop with every part and parameter; differentiable in each leaf, and batched by `jax.vmap` over
            any.
        solver: Solver with step, duration [s], and stride `every` of the trajectory's instants.
        objectives: Objectives by the names of their metrics; None for no metrics.
        key: Random key of `jax.random`, for noisy sensors.

    Raises:
        ValueError: A step, duration or stride is not positive, or the step is longer than the duration. A parameter is
            not a real number of at least 32 bits, or has a wrong shape. A concrete parameter is out of range or breaks
            a rule of its part. The start is beyond the stop, or a clock is off the grid. The step
            is not stable; `run_batch` with `accepted=True` makes such a run all the same.

    See also:
        `measure`: Metrics only, in memory that does not grow with the number of steps.
        `run_batch`: Many runs, also with trajectories.
        `solve`: Any other field, without parts.
        `check`: Lines about what is wrong with a loop, before a run.

    Notes:
        A loop is a hybrid system, of plant x, controller m and what the sensor and the actuator remember

            x' = f(t, x, u),   y = h(x),   u = c(t, m, r - y),   m' = k(t, m, r - y)

        Steps end where a margin g(t, x) falls through zero: at the stop, at a limit, where a wheel locks. The time t*
        of such an event depends on the parameters p by

            dt*/dp = -(g_x dx/dp + g_p)/(g_t + g_x f)

        and derivatives of the run contain this term, so that they are right across events. Source: I. A. Hiskens and M.
        A. Pai, Trajectory sensitivity analysis of hybrid systems, IEEE Trans. Circuits Syst. I 47 (2000).

    Examples:
        >>> import diffabs as d
        >>> run = d.rollout(d.braking(), d.FixedStep(1e-4, 3.0, every=10000))
        >>> print(*(f"{speed:.1f}" for speed in run.trajectory.sample.output.speed))  # after 0, 1, 2, 3 s
        27.8 19.1 10.0 1.0
    """
    objectives = objectives or {}
    refuse_values(loop, solver, objectives)
    return run_unchecked(loop, solver, objectives, key, solver.every)


@default_flags()
def measure(loop: Loop, solver: Solver, objectives: Mapping[str, Objective], *, key: Key | None = None) -> Run:
    """Run a loop and return a `Run` with metrics only: memory does not grow with the number of steps.

    Args:
        loop: Closed loop with every part and parameter, as in `rollout`.
        solver: Solver with step and duration [s].
        objectives: Objectives by the names of their metrics.
        key: Random key of `jax.random`, for noisy sensors.

    Raises:
        ValueError: The arguments are invalid, as in `rollout`.

    See also:
        `rollout`: The same run with its trajectory.
        `run_batch`: Many runs by the fastest engine.
        `replace`: New values of parameters, for a function that JAX differentiates.
        `tune.tune`: A descent along these derivatives.

    Notes:
        An objective is an integral, an extreme or the value at an instant. Within a step each signal is the cubic of
        its values and rates at both ends (Hermite)

            y(t + a h) = (1 - a) y0 + a y1 + a (a - 1) ((1 - 2 a) (y1 - y0) + (a - 1) h y0' + a h y1'),   0 <= a <= 1

        so integrals, peaks and crossings have the fourth order of the steps. Source: E. Hairer, S. P. Norsett and G.
        Wanner, Solving Ordinary Differential Equations I, sec. II.6.

    Examples:
        >>> import jax
        >>> import diffabs as d
        >>> from diffabs.parts.objectives import StopDistance
        >>> solver, metrics = d.FixedStep(1e-4, 4.0), {"distance": StopDistance()}
        >>> print(f"{d.measure(d.braking(), solver, metrics).metrics['distance']:.2f} m")
        43.85 m

        A metric is a differentiable function of every parameter:

        >>> def distance(mass):
        ...     return d.measure(d.replace(d.braking(), {"plant.mass": mass}), solver, metrics).metrics["distance"]
        >>> print(f"{jax.jvp(distance, (15.0,), (1.0,))[1]:.3f} m/kg")
        -0.017 m/kg
    """
    refuse_values(loop, solver, objectives)
    return run_unchecked(loop, solver, objectives, key, 0, default_engine())


def run_unchecked(
    loop: Loop, solver: Solver, objectives: Mapping[str, Objective], key: Key | None, every: int, engine: str = "auto"
) -> Run:
    """Return a run without a check of the parameters' values.

    A run with impossible values has diverged only if its numbers are invalid or not physically possible
    (`Run.diverged`). `every` is the stride of the trajectory's instants, or 0 for none. `engine` is that of a traced
    run without a trajectory: "auto", "xla" or "kernel". All others are made by XLA.
    """
    if not (key is None or np.ndim(key) or jnp.issubdtype(getattr(key, "dtype", float), jax.dtypes.prng_key)):
        raise ValueError(f"key = {kinds.format_value(key)} is no random key; one of jax.random.key is needed")
    loop, objectives, method = prepare_arguments(loop, solver, objectives)
    plan = plan_run(loop, solver, int(every))
    arguments = loop, objectives, method, key
    if not every and engine != "xla" and is_traced(loop, objectives, key):
        return run_deferred(run_differentiable, plan, arguments, required=engine == "kernel")
    run = run_differentiable(plan, arguments)
    return cut_trajectory(run, solver, every) if every else run


def plan_run(loop: Loop, solver: Solver, every: int) -> RunPlan:
    """Return the plan of a run; `every` is the stride of the trajectory's instants, or 0 for none."""
    steps = solver.steps
    between = min(every, steps) if every else round_up_capacity(steps)
    # Capacities are static and rounded up, so that similar durations share one compiled program.
    room = round_up_capacity(log_capacity(loop, solver)) if isinstance(solver, Adaptive) else between
    return RunPlan(finish_run, observe, room, round_up_capacity(_count_instants(solver, every)) if every else 0, every)


def cut_trajectory(run: Run, solver: Solver, every: int, axis: int = 0) -> Run:
    """Return the run with the planned instants of its trajectory; the capacity has more. They lie along the `axis`."""
    return run._replace(trajectory=_cut(run.trajectory, _count_instants(solver, every) + 1, axis))


def _count_instants(solver: Solver, every: int) -> int:
    return -(-solver.steps // every)


@partial(jax.jit, static_argnums=(1, 2))
def _cut(trajectory: object, count: int, axis: int) -> PyTree:
    return jax.tree.map(lambda x: jax.lax.slice_in_dim(x, 0, count, axis=axis), trajectory)
