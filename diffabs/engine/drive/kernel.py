"""Batches in a compiled program of this machine: a run stays in the processor's registers from start to stop.

XLA computes the starts and the results, as for every other run. The package `compiler` translates the step of
`FixedStep` or `Adaptive` from its jaxpr, with everything that the parts contribute to it. A run that has ended makes
room for the next one, as in `batches`. The kernel deals the runs to threads of its own, on all cores of the processor.
"""

import functools
import operator

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from diffabs.compiler.lower.indexing import MAX_COMPARED_ENTRIES
from diffabs.compiler.lower.rules import Unsupported
from diffabs.compiler.pipeline import run_lanes
from diffabs.compiler.runtime.toolchain import NoCompiler
from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once, is_traced
from diffabs.core.log import log_rows
from diffabs.core.pytree import prepare_derivatives
from diffabs.core.tracing import differentiated_paths, jvp_nonzero, read_leaves
from diffabs.core.types import Bool, Int, Key, Params, PyTree, Scalar, Vector
from diffabs.engine.drive.batches import STEPS_PER_EXCHANGE, EarlyEnd, sample_now, split_by_lane
from diffabs.engine.drive.engine import check_process
from diffabs.engine.drive.loops import STEPS_PER_BLOCK, run_with_trajectory
from diffabs.engine.drive.runs import RunPlan, attach_trajectory
from diffabs.engine.hybrid import Finish, HybridState, HybridSystem, Objectives
from diffabs.engine.step.adaptive import AdaptiveStepping
from diffabs.engine.step.event_location import RunStatus
from diffabs.engine.step.replay import LaggedReplay, LaggedReplayStepping, refuse_derivative

MAX_LANES_PER_LAUNCH = 1 << 17  # runs that are started together: the carries of more runs would fill the memory


def run_native(
    hybrid: HybridSystem,
    values: Params,
    keys: Key | None,
    method: PyTree,
    objectives: Objectives,
    accepted: Vector,
    finish: Finish,
    enough: EarlyEnd | None = None,
) -> PyTree:
    """Return the result of `batches.run_packed`, equal to rounding and with forward derivatives.

    A step with an operation without a translation raises Unsupported, a machine without a compiler NoCompiler.
    """
    count = len(accepted)
    enough = jax.tree.map(jnp.asarray, enough)
    early_data = None if enough is None else jax.vmap(enough.data_of)(jnp.arange(count))
    lanes = values, keys, accepted, early_data

    def run_launch(rows: tuple[PyTree, ...]) -> PyTree:
        """Return the runs of one launch; `rows` are theirs of `lanes`."""
        inputs = hybrid, rows[0], dict(objectives), method, *rows[1:], enough
        # A call through a derivative rule costs more than a short run.
        return _run_differentiable(finish, inputs) if is_traced(inputs) else _run(*inputs, finish=finish)

    if count <= MAX_LANES_PER_LAUNCH:
        return run_launch(lanes)
    runs = [
        run_launch(jax.tree.map(operator.itemgetter(slice(i, i + MAX_LANES_PER_LAUNCH)), lanes))
        for i in range(0, count, MAX_LANES_PER_LAUNCH)
    ]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *runs)


def run_single(
    hybrid: HybridSystem, objectives: object, method: object, finish: Finish, key: Key | None = None
) -> PyTree:
    """Return one run, as `finish` makes it of the last carry; `jax.vmap` makes a lane of each run of a batch.

    The errors are those of `run_native`, and a RuntimeError in a process that was forked after JAX had started.
    """
    check_process()
    keys = None if key is None else key[None]
    lane = _run_differentiable(finish, (hybrid, {}, objectives, method, keys, jnp.ones(1, bool), None, None))
    return jax.tree.map(operator.itemgetter(0), lane)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _run_differentiable(finish: Finish, arguments: tuple[PyTree, ...]) -> PyTree:
    """Return the runs of (system, values, objectives, method, keys, accepted, data for early ends, early ends)."""
    return _run(*arguments, finish=finish)


def _rule(finish: Finish, primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
    """Return the runs and their tangents.

    Fixed steps are those of `FixedStepping.for_derivatives`. Adaptive steps are replayed one by one
    (`LaggedReplayStepping`).
    """

    moves, (given_system, _, measured, method, *_) = tangents[0], primals[0]
    refuse_derivative(given_system, measured, method)
    paths = differentiated_paths(moves[0]) | {path for path, move in moves[1].items() if type(move) is not SymbolicZero}

    def run(arguments: tuple[PyTree, ...]) -> PyTree:
        # Only paths with a nonzero tangent are prepared for derivatives.
        hybrid, values, objectives, method, *lane_data = arguments
        hybrid = prepare_derivatives(hybrid, paths)
        method = (
            LaggedReplayStepping(method.for_replay())
            if isinstance(method, AdaptiveStepping)
            else method.for_derivatives()
        )
        return _run(hybrid, values, objectives, method, *lane_data, finish=finish)

    return jvp_nonzero(run, primals, tangents)


_run_differentiable.defjvp(_rule, symbolic_zeros=True)


@functools.partial(jax.jit, static_argnames="finish")
def _run(
    hybrid: HybridSystem,
    values: Params,
    objectives: Objectives,
    method: PyTree,
    keys: Key | None,
    accepted: Scalar,
    early_data: PyTree,
    enough: EarlyEnd | None,
    *,
    finish: Finish,
) -> PyTree:
    """Return the results of all runs; `method` is the stepping method, `early_data` the runs' data for `enough`."""
    leaves, build_lane = split_by_lane(hybrid, values, objectives)

    def start(lane_leaves: PyTree, key: Key | None, accepted: Scalar) -> PyTree:
        return _stop_unaccepted(accepted, method.start(*build_lane(lane_leaves), key))

    def is_running(lane: tuple[PyTree, ...], carry: PyTree) -> Bool:
        if enough is None:
            return carry.running
        sample = sample_now(build_lane(lane[0])[0], carry)
        return carry.running & ~enough.has_reached(lane[2], sample)

    def judge(lane_leaves: object, carry: object) -> PyTree:
        return finish(*build_lane(lane_leaves), carry)[0]

    def repeat(lane: tuple[PyTree, ...], carry: PyTree) -> PyTree:
        return method.repeat(*build_lane(lane[0]), lane[1], carry)

    begins = jax.vmap(start)(leaves, keys, accepted)
    replay = None
    if isinstance(begins, LaggedReplay):
        no = jax.tree.map(lambda _: False, begins)
        replay = repeat, no._replace(entry=no.entry._replace(accepted=True))
    _check_logs(hybrid, begins.point.state)
    # The kernel computes only leaves of the carry that the results depend on, and tangents that move the results.
    carry = run_lanes(
        lambda lane, carry: method.renew(build_lane(lane[0])[0], carry),
        lambda lane, carry: method.step(*build_lane(lane[0]), lane[1], carry),
        is_running,
        (leaves, keys, early_data),
        begins,
        steps=STEPS_PER_BLOCK,
        rounds=1 if enough is None else STEPS_PER_EXCHANGE // STEPS_PER_BLOCK,
        read=read_leaves(judge, leaves, begins),
        tangents_read=read_leaves(judge, leaves, begins, differentiably=True),
        replay=replay,
    )
    return jax.vmap(judge)(leaves, carry)


def run_native_trajectories(
    hybrid: HybridSystem,
    values: Params,
    keys: Key | None,
    method: PyTree,
    objectives: Objectives,
    accepted: Vector,
    plan: RunPlan,
) -> PyTree:
    """Return the result of `run_native`, for values only, with the trajectories that `plan` asks for.

    Between two instants the kernel makes the steps of all runs; XLA observes them there. Runs wait for each other.
    """
    every, static = jax.device_put(plan.every), plan._replace(room=0, every=0)
    return _run_observed(hybrid, values, objectives, method, keys, accepted, every, plan=static)


@compile_once(static=("plan",), options=SAME_RESULT_OPTIONS)
def _run_observed(
    hybrid: HybridSystem,
    values: Params,
    objectives: Objectives,
    method: PyTree,
    keys: Key | None,
    accepted: Vector,
    every: Int,
    *,
    plan: RunPlan,
) -> PyTree:
    """Return the runs of `run_native_trajectories`."""
    leaves, build_lane = split_by_lane(hybrid, values, objectives)
    observe = plan.observe
    assert observe is not None

    def start(lane_leaves: PyTree, key: Key | None, accepted: Scalar) -> PyTree:
        begins = method.start(*build_lane(lane_leaves), key)
        return method.keep_steps(_stop_unaccepted(accepted, begins))

    def advance_to(carry: PyTree, until: Int) -> PyTree:
        return run_lanes(
            lambda lane, carry: method.renew(build_lane(lane[0])[0], carry),
            lambda lane, carry: method.step(*build_lane(lane[0]), lane[1], carry, until=until),
            lambda _, carry: method.is_active(carry, until),
            (leaves, keys),
            carry,
            steps=1,  # few steps lie between two instants
            rounds=1,
        )

    def look(carry: PyTree, instant: Int) -> PyTree:
        def observe_lane(lane_leaves: PyTree, carry: PyTree) -> PyTree:
            return observe(build_lane(lane_leaves)[0], *method.state_at(carry, instant))

        return jax.vmap(observe_lane)(leaves, carry)

    carry = jax.vmap(start)(leaves, keys, accepted)
    _check_logs(hybrid, carry.point.state)
    first, count = look(carry, jnp.zeros_like(every)), -(-method.steps // every)
    carry, later = run_with_trajectory(advance_to, look, carry, every, count, plan.instants)
    judged = jax.vmap(lambda lane_leaves, carry: plan.finish(*build_lane(lane_leaves), carry))(leaves, carry)
    return jax.vmap(attach_trajectory, in_axes=(0, 0, 1))(judged, first, later)


def _check_logs(hybrid: HybridSystem, state: HybridState) -> None:
    """Raise Unsupported if a recorder keeps its past in more rows, shape (runs, rows, n), than a kernel can index."""
    for name in hybrid.recorders:
        for rows in log_rows(getattr(state, name)):
            if rows.shape[1] > MAX_COMPARED_ENTRIES:
                error = Unsupported("log", f"of {rows.shape[1]} rows; {MAX_COMPARED_ENTRIES} are the most")
                error.method = f"{type(getattr(hybrid, name)).__name__}.record"
                raise error


def _stop_unaccepted(accepted: Scalar, carry: PyTree) -> PyTree:
    """Return the carry, over from the beginning if the run is not accepted."""
    if isinstance(carry, LaggedReplay):
        return carry._replace(ahead=_stop_unaccepted(accepted, carry.ahead))
    status = jnp.where(accepted, carry.status, RunStatus.REFUSED)
    return carry._replace(status=status.astype(carry.status.dtype))


def find_objection(
    hybrid: HybridSystem, values: Params, method: PyTree, objectives: Objectives, finish: Finish
) -> str | None:
    """Return one line with the reason why a kernel cannot make these runs, or None if it can.

    A reason is an operation without a translation, or no compiler on this machine. The function executes no run, but it
    compiles and keeps the kernel. `values` have at least one path, with columns (runs, ...).
    """
    count = len(next(iter(values.values())))
    keys = jax.vmap(jax.random.key)(jnp.arange(count))
    arguments = hybrid, values, objectives, method, keys, jnp.ones(count, bool), None, None
    try:
        _run.lower(*arguments, finish=finish)
    except (Unsupported, NoCompiler) as error:
        return str(error)
    return None
