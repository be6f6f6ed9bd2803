"""A run of a hybrid system from its start to its result: for values, by forward and by reverse mode.

    values          a while loop (`loops.run_to_end`)
    derivatives     fixed steps: a checkpointed scan. Adaptive steps: a logged run for values, replayed (`step.replay`)

What becomes of the last state is the client's: `RunPlan.finish` and `RunPlan.observe`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from diffabs.core.arrays import as_array
from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once, is_traced
from diffabs.core.numerics import void_derivatives
from diffabs.core.pytree import prepare_derivatives
from diffabs.core.tracing import differentiated_paths, jvp_nonzero
from diffabs.core.types import Array, Key, PyTree, Scalar
from diffabs.engine.drive.loops import (
    Step,
    log_run,
    replay_log,
    round_up_capacity,
    run_to_end,
    run_with_trajectory,
    scan_steps,
    scan_with_trajectory,
    step_until,
)
from diffabs.engine.hybrid import Finish, HybridSystem, Objectives, Observe
from diffabs.engine.solvers import Adaptive, Solver
from diffabs.engine.step.adaptive import AdaptiveStepping, clip_rtol, keep_steps
from diffabs.engine.step.event_location import end_unfinished
from diffabs.engine.step.fixed import FixedStepping
from diffabs.engine.step.replay import ReplayStepping, log_attempt, log_capacity, refuse_derivative, states_between
from diffabs.engine.step.slides import has_slid, slide_of
from diffabs.engine.step.switching import FREE_MODES, KEPT_MODES, KeptModes


class RunPlan(NamedTuple):
    """What is fixed at compilation: what a client makes of a run, and for how many steps and instants there is room.

    Attributes:
        finish: Function that returns the result from system, objectives and the last carry, and the last observation.
            The result of a run with a trajectory has the fields `trajectory` and `diverged`.
        observe: Function that returns an observation from system, time, state, and whether the run goes on: a pytree
            with an attribute `running`; None if no run has a trajectory.
        room: Capacity for attempts in the whole run with adaptive steps. With fixed steps for steps of the grid;
            not read for a trajectory.
        instants: Capacity for instants of a trajectory after t = 0; 0 without one.
        every: Number of grid steps between two instants; 0 without a trajectory.
    """

    finish: Finish
    observe: Observe | None
    room: int
    instants: int = 0
    every: int = 0


def build_stepping(solver: Solver, dtype: DTypeLike) -> FixedStepping | AdaptiveStepping:
    """Return the stepping method of a solver, with numbers of one data type: a pytree, for compiled programs."""
    number = jnp.asarray if is_traced() else as_array
    # `device_put` instead of `jnp.asarray`, which would compile a program.
    h, steps = number(float(solver.step), dtype), jax.device_put(solver.steps)
    if isinstance(solver, Adaptive):
        rtol = number(float(clip_rtol(np.asarray(solver.rtol, dtype))), dtype)
        return AdaptiveStepping(h, steps, rtol, KeptModes(follows=True) if solver.follow_slides else FREE_MODES)
    if solver.follow_slides:
        return FixedStepping(h, steps, KeptModes(follows=True))
    return FixedStepping(h, steps, {True: KEPT_MODES, False: FREE_MODES, None: None}[solver.kinks])


def run_system(
    system: HybridSystem, solver: Solver, finish: Finish, objectives: Objectives | None = None, key: Key | None = None
) -> PyTree:
    """Return a run of any hybrid system, as `finish` makes it of the last carry; differentiable by the system's leaves.

    Args:
        system: The system, a pytree whose leaves are arrays of one type.
        solver: Steps and duration [s].
        finish: Function of system, objectives and the last `Carry` that returns the result and None, such as
            (carry.point.state, None). A function of a module: the program is compiled for it, again for a new lambda.
        objectives: Objectives by name, whose accumulators the carry has.
        key: Random key, which `HybridSystem.change` reads.

    See also:
        `solve`: Fields with events, without a class.
        `rollout`: Closed loops.
    """
    method = build_stepping(solver, jax.tree.leaves(system)[0].dtype)
    room = log_capacity(system, solver) if isinstance(solver, Adaptive) else solver.steps
    plan = RunPlan(finish, None, round_up_capacity(room))
    return run_differentiable(plan, (system, objectives or {}, method, key))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def run_differentiable(plan: RunPlan, inputs: tuple[PyTree, ...]) -> PyTree:
    """Return the run of (system, objectives, method, key), as `plan.finish` makes it of the last carry."""
    hybrid, objectives, method, key = inputs
    every, static = jax.device_put(plan.every), plan._replace(room=0, every=0)
    return _vary_together(_run(hybrid, objectives, method, key, every, plan=static))


def _vary_together(result: PyTree) -> PyTree:
    """Return the result of a run, all of whose arrays have the axis of `jax.vmap` if one has it.

    Under `jax.vmap` JAX takes the axes of a custom derivative's results from the values' run where it stages them, and
    from the derivative's run where it differentiates. A constant signal of a trajectory has it only there.
    """
    if getattr(result, "trajectory", None) is None:
        return result
    return jax.tree.map(lambda x: jnp.where(result.diverged, x, x), result)


def _rule(plan: RunPlan, primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
    hybrid, objectives, method, _ = primals[0]
    refuse_derivative(hybrid, objectives, method)
    paths = differentiated_paths(tangents[0][0])

    def reversible(inputs: tuple[PyTree, ...]) -> PyTree:
        return _vary_together(_run_reversible(prepare_derivatives(inputs[0], paths), *inputs[1:], plan=plan))

    return jvp_nonzero(reversible, primals, tangents, once=_second_derivative_objection(hybrid, method))


def _second_derivative_objection(hybrid: HybridSystem, method: object) -> str:
    """Return the reason why a run has no second derivatives, or an empty string."""
    if isinstance(method, AdaptiveStepping):
        return "runs with adaptive steps have no second derivatives; d.FixedStep has"
    if hybrid.recorders:
        return "runs with a pure delay have no second derivatives; controllers.Sampled(delay=) and actuators.Lag have"
    return ""


run_differentiable.defjvp(_rule, symbolic_zeros=True)


@compile_once(static=("plan",), options=SAME_RESULT_OPTIONS)
def _run(
    hybrid: HybridSystem, objectives: Objectives, method: PyTree, key: Key, every: Any, *, plan: RunPlan
) -> PyTree:
    """Return a run for values, with room for the instants of a trajectory."""
    hybrid, objectives, stepped = _prepare_run(hybrid, objectives, method, key)
    carry, renew, instants = method.start(hybrid, objectives, key), partial(method.renew, hybrid), plan.instants
    if not instants:
        return plan.finish(hybrid, objectives, run_to_end(stepped, renew, carry))[0]
    look, count, carry = _observer(hybrid, method, plan), -(-method.steps // every), method.keep_steps(carry)
    first = look(carry, 0)
    advance_to = partial(step_until, stepped, renew, method.is_active)
    carry, trajectory = run_with_trajectory(advance_to, look, carry, every, count, instants)
    return attach_trajectory(plan.finish(hybrid, objectives, carry), first, trajectory)


def _observer(hybrid: HybridSystem, method: PyTree, plan: RunPlan) -> Callable[[PyTree, Any], PyTree]:
    """Return a function of the carry and an instant of the grid that returns the observation there."""
    observe = plan.observe
    assert observe is not None
    return lambda carry, instant: observe(hybrid, *method.state_at(carry, instant))


@partial(jax.jit, static_argnames="plan")
def _run_reversible(hybrid: HybridSystem, objectives: Objectives, method: PyTree, key: Key, *, plan: RunPlan) -> PyTree:
    """Return a run for derivatives in both modes."""
    if isinstance(method, AdaptiveStepping):
        return _run_by_replay(hybrid, objectives, method.for_replay(), key, plan)
    method = method.for_derivatives()
    hybrid, objectives, stepped = _prepare_run(hybrid, objectives, method, key)
    carry, (finish, _, room, instants, every) = method.start(hybrid, objectives, key), plan

    def attempts(steps: int) -> int:
        return round_up_capacity(method.capacity(hybrid, steps))

    if not every:
        # A run that needs more attempts than there is room for is still running: `end_unfinished`.
        carry = scan_steps(stepped, method.is_active, carry, 0, None, room, attempts)
        return finish(hybrid, objectives, end_unfinished(carry))[0]
    look, count = _observer(hybrid, method, plan), -(-method.steps // every)
    first = look(carry, 0)
    carry, trajectory = scan_with_trajectory(stepped, method.is_active, look, carry, every, count, instants, attempts)
    judged, slides = finish(hybrid, objectives, end_unfinished(carry)), has_slid(slide_of(carry))
    return attach_trajectory(judged, *void_derivatives((first, trajectory), slides, hybrid))


def _run_by_replay(
    hybrid: HybridSystem, objectives: Objectives, live: AdaptiveStepping, key: Key, plan: RunPlan
) -> PyTree:
    """Return a run with adaptive steps for derivatives in both modes: logged for its values, then replayed."""
    hybrid, further = hybrid.prepare_run()
    objectives, (finish, observe, room, instants, every) = {**objectives, **further}, plan
    # The log holds values only: derivatives come from the replay.
    still, measures = jax.tree.map(jax.lax.stop_gradient, (hybrid, objectives))
    carry, log = log_run(
        partial(live.step, still, measures, key),
        partial(live.renew, still),
        log_attempt,
        live.start(still, measures, key),
        room,
    )
    log = jax.lax.stop_gradient(log)
    status = end_unfinished(carry).status
    replay = ReplayStepping(live)
    start = replay.start(hybrid, objectives, key)
    start = keep_steps(start) if every else start
    again, spans = replay_log(
        partial(replay.step, hybrid, objectives, key),
        lambda carry: carry.control.last_step,
        lambda log: log.accepted,
        start,
        log,
    )
    slide = jax.tree.map(jax.lax.stop_gradient, carry.slides)
    judged = finish(hybrid, objectives, again._replace(status=status, slides=slide))
    if not every or observe is None:
        return judged[0]

    instants = jnp.arange(1, instants + 1) * every * live.h
    states = states_between(spans, log.accepted, instants)
    goes_on = instants < jax.lax.stop_gradient(again.point.t)
    first = observe(hybrid, start.point.t, start.point.state, jnp.asarray(True))
    trajectory = jax.vmap(partial(observe, hybrid))(instants, states, goes_on)
    return attach_trajectory(judged, *void_derivatives((first, trajectory), has_slid(slide_of(carry)), hybrid))


def _prepare_run(
    hybrid: HybridSystem, objectives: Objectives, method: PyTree, key: Key
) -> tuple[HybridSystem, Objectives, Step]:
    """Return the prepared system, all objectives of its run, and the step as a function of the carry."""
    hybrid, further = hybrid.prepare_run()
    objectives = {**objectives, **further}
    return hybrid, objectives, partial(method.step, hybrid, objectives, key)


def attach_trajectory(judged: tuple[PyTree, PyTree], first: PyTree, later: PyTree) -> PyTree:
    """Return the run with its trajectory: first and later instants, and the last one repeated after the end."""
    run, last = judged

    def join(a: Scalar, b: Array, c: Scalar) -> Array:
        # Rows after the end contain anything, so the last instant replaces them.
        b = jnp.where(jnp.expand_dims(later.running, range(1, b.ndim)), b, c)
        return jnp.concatenate([jnp.asarray(a)[None], b])

    return run._replace(trajectory=jax.tree.map(join, first, later, last))
