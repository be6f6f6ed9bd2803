"""Single runs of a loop by fixed or adaptive Runge-Kutta steps, with a trajectory or with metrics only.

If a step crosses the stop or the event of a block, shorter steps are attempted until one ends there
(`step/event_location`). So every objective is exact to the order of the method and differentiable, independent of the
place of the crossing in the step.
"""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core import kinds
from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once, is_traced
from diffabs.core.jax_flags import default_flags
from diffabs.core.loop import Loop
from diffabs.core.numerics import void_derivatives
from diffabs.core.protocols import Objective
from diffabs.core.pytree import prepare_derivatives
from diffabs.core.tracing import differentiated_paths, jvp_nonzero
from diffabs.core.types import Array, Key, PyTree, Scalar
from diffabs.engine.arguments import prepare_arguments, refuse_derivative, refuse_values
from diffabs.engine.drive.deferred import run_deferred
from diffabs.engine.drive.engine import default_engine
from diffabs.engine.drive.loops import (
    log_run,
    replay_log,
    round_up_capacity,
    run_to_end,
    run_with_trajectory,
    scan_steps,
    scan_with_trajectory,
)
from diffabs.engine.result import Finish, finish_run, observe, prepare
from diffabs.engine.step.adaptive import AdaptiveStepping
from diffabs.engine.step.replay import ReplayStepping, log_attempt, log_capacity, states_between
from diffabs.engine.step.status import end_unfinished
from diffabs.engine.types import Adaptive, Run, Solver, Trajectory


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
    loop: Loop, solver: Solver, objectives: Mapping[str, Objective], key: PyTree, every: int, engine: str = "auto"
) -> Run:
    """Return a run without a check of the parameters' values.

    A run with impossible values has diverged only if its numbers are invalid or not physically possible
    (`Run.diverged`). `every` is the stride of the trajectory's instants, or 0 for none. `engine` is that of a traced
    run without a trajectory: "auto", "xla" or "kernel". All others are made by XLA.
    """
    if not (key is None or np.ndim(key) or jnp.issubdtype(getattr(key, "dtype", float), jax.dtypes.prng_key)):
        raise ValueError(f"key = {kinds.format_value(key)} is no random key; one of jax.random.key is needed")
    loop, objectives, method = prepare_arguments(loop, solver, objectives)
    steps, every = solver.steps, int(every)
    count = -(-steps // every) if every else 0
    between = min(every, steps) if every else round_up_capacity(steps)
    room = round_up_capacity(log_capacity(loop, solver)) if isinstance(solver, Adaptive) else between
    if every and isinstance(method, AdaptiveStepping):
        method = dataclasses.replace(method, keeps_last_step=True)
    capacity = RunCapacity(room, round_up_capacity(count) if every else 0, every)
    # Capacities are static and rounded up, so that similar durations share one compiled program.
    arguments = loop, objectives, method, key
    if not every and engine != "xla" and is_traced(loop, objectives, key):
        return run_deferred(run_differentiable, capacity, arguments, required=engine == "kernel")
    run = run_differentiable(capacity, arguments)
    return run._replace(trajectory=_truncate_trajectory(run.trajectory, count + 1)) if every else run


class RunCapacity(NamedTuple):
    """Capacities that are fixed at compilation.

    Attributes:
        room: Capacity for attempts in the whole run with adaptive steps. With fixed steps for steps of the grid: in the
            whole run, or between two instants of a trajectory.
        instants: Capacity for instants of a trajectory after t = 0; 0 without one.
        every: Number of grid steps between two instants; 0 without a trajectory.
        finish: Function that returns the result from loop, objectives and the last carry, and the last instant.
    """

    room: int
    instants: int
    every: int
    finish: Finish = finish_run


@partial(jax.jit, static_argnums=1)
def _truncate_trajectory(trajectory: object, count: int) -> PyTree:
    return jax.tree.map(lambda x: x[:count], trajectory)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def run_differentiable(capacity: RunCapacity, run: PyTree) -> PyTree:
    """Return the run of (loop, objectives, method, key), as `capacity.finish` makes it of the last carry."""
    loop, objectives, method, key = run
    _, instants, every, finish = capacity
    return _vary_together(_run(loop, objectives, method, key, jax.device_put(every), instants=instants, finish=finish))


def _vary_together(run: PyTree) -> PyTree:
    """Return the run, all of whose results have the axis of `jax.vmap` if one has it.

    Under `jax.vmap` JAX takes the axes of a custom derivative's results from the values' run where it stages them, and
    from the derivative's run where it differentiates. A constant signal of a trajectory has it only there.
    """
    if getattr(run, "trajectory", None) is None:
        return run
    return jax.tree.map(lambda x: jnp.where(run.diverged, x, x), run)


def _rule(capacity: RunCapacity, primals: PyTree, tangents: PyTree) -> tuple[PyTree, PyTree]:
    loop, objectives, method, _ = primals[0]
    refuse_derivative(loop, objectives, method)
    paths = differentiated_paths(tangents[0][0])

    def reversible(run: PyTree) -> Run:
        return _vary_together(_run_reversible(prepare_derivatives(run[0], paths), *run[1:], capacity=capacity))

    return jvp_nonzero(reversible, primals, tangents, once=_second_derivative_objection(loop, method))


def _second_derivative_objection(loop: Loop, method: object) -> str:
    """Return the reason why a run has no second derivatives, or an empty string."""
    if isinstance(method, AdaptiveStepping):
        return "runs with adaptive steps have no second derivatives; d.FixedStep has"
    if loop.recorders:
        return "runs with a pure delay have no second derivatives; controllers.Sampled(delay=) and actuators.Lag have"
    return ""


run_differentiable.defjvp(_rule, symbolic_zeros=True)


@compile_once(static=("instants", "finish"), options=SAME_RESULT_OPTIONS)
def _run(
    loop: Loop, objectives: dict[str, Objective], method: PyTree, key: Key, every: Any, *, instants: int, finish: Finish
) -> PyTree:
    """Return a run for values, with capacity for `instants` of a trajectory; 0 without one."""
    loop, objectives, stepped = _prepare_run(loop, objectives, method, key)
    carry = method.start(loop, objectives, key)
    if not instants:
        return finish(loop, objectives, run_to_end(stepped, partial(method.renew, loop), carry))[0]
    first, count = method.observe_at(loop, carry, 0), -(-method.steps // every)
    look = partial(method.observe_at, loop)
    carry, trajectory = run_with_trajectory(
        stepped, partial(method.renew, loop), method.is_active, look, carry, every, count, instants
    )
    return _attach_trajectory(finish_run(loop, objectives, carry), first, trajectory)


@partial(jax.jit, static_argnames="capacity")
def _run_reversible(
    loop: Loop, objectives: dict[str, Objective], method: PyTree, key: Key, *, capacity: RunCapacity
) -> Run:
    """Return a run for derivatives in both modes."""
    if isinstance(method, AdaptiveStepping):
        return _run_by_replay(loop, objectives, method.for_replay(), key, capacity)
    method = method.for_derivatives()
    loop, objectives, stepped = _prepare_run(loop, objectives, method, key)
    carry, (room, instants, every, finish) = method.start(loop, objectives, key), capacity

    def attempts(steps: int) -> int:
        return round_up_capacity(method.capacity(loop, steps))

    if not every:
        # A run that needs more attempts than there is room for is still running: `end_unfinished`.
        carry = scan_steps(stepped, method.is_active, carry, 0, None, room, attempts)
        return finish(loop, objectives, end_unfinished(carry))[0]
    first, count = method.observe_at(loop, carry, 0), -(-method.steps // every)
    carry, trajectory = scan_with_trajectory(
        stepped, method.is_active, partial(method.observe_at, loop), carry, every, count, instants, attempts
    )
    judged = finish_run(loop, objectives, end_unfinished(carry))
    return _attach_trajectory(judged, *_void_trajectories(loop, judged[0], first, trajectory))


def _run_by_replay(
    loop: Loop, objectives: dict[str, Objective], live: AdaptiveStepping, key: Key, capacity: RunCapacity
) -> Run:
    """Return a run with adaptive steps for derivatives in both modes: logged for its values, then replayed."""
    loop, audit = prepare(loop)
    objectives, (room, instants, every, finish) = objectives | audit, capacity
    # The log holds values only: derivatives come from the replay.
    still, measures = jax.tree.map(jax.lax.stop_gradient, (loop, objectives))
    logged = dataclasses.replace(live, keeps_last_step=False)
    carry, log = log_run(
        partial(logged.step, still, measures, key),
        partial(logged.renew, still),
        log_attempt,
        logged.start(still, measures, key),
        room,
    )
    log = jax.lax.stop_gradient(log)
    status = end_unfinished(carry).status
    replay = ReplayStepping(live)
    start = replay.start(loop, objectives, key)
    again, spans = replay_log(
        partial(replay.step, loop, objectives, key),
        lambda carry: carry.control.last_step,
        lambda log: log.accepted,
        start,
        log,
    )
    slide = jax.tree.map(jax.lax.stop_gradient, carry.slides)
    judged = finish(loop, objectives, again._replace(status=status, slides=slide))
    if not every:
        return judged[0]

    instants = jnp.arange(1, instants + 1) * every * live.h
    states = states_between(spans, log.accepted, instants)
    goes_on = instants < jax.lax.stop_gradient(again.point.t)
    first = observe(loop, start.point.t, start.point.state, jnp.asarray(True))
    trajectory = jax.vmap(partial(observe, loop))(instants, states, goes_on)
    return _attach_trajectory(judged, *_void_trajectories(loop, judged[0], first, trajectory))


def _void_trajectories(loop: Loop, run: Run, *signals: Trajectory) -> PyTree:
    """Return the signals of a run, without derivatives if it slides."""
    return void_derivatives(signals, run.slid, loop)


def _prepare_run(loop: Loop, objectives: dict[str, Objective], method: PyTree, key: Key) -> tuple[Loop, PyTree, PyTree]:
    """Return the prepared loop, the objectives with the plant's audit, and the step as a function of the carry."""
    loop, audit = prepare(loop)
    objectives = objectives | audit
    return loop, objectives, partial(method.step, loop, objectives, key)


def _attach_trajectory(judged: tuple[Run, Trajectory], first: Trajectory, later: PyTree) -> Run:
    """Return the run with its trajectory: first and later instants, and the last one repeated after the end."""
    run, last = judged

    def join(a: Scalar, b: Array, c: Scalar) -> PyTree:
        # Rows after the end contain anything, so the last instant replaces them.
        b = jnp.where(jnp.expand_dims(later.running, range(1, b.ndim)), b, c)
        return jnp.concatenate([jnp.asarray(a)[None], b])

    return run._replace(trajectory=jax.tree.map(join, first, later, last))
