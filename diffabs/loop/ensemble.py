"""The runs of a batch: by a kernel or by XLA, on all cores, together or packed."""

import dataclasses
import functools
import logging
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core import kinds
from diffabs.core.compiling import is_traced
from diffabs.core.jax_flags import default_flags
from diffabs.core.protocols import Objective
from diffabs.core.pytree import canonical_dtypes, get, replace
from diffabs.core.types import Array, Bool, Key, Params, PyTree
from diffabs.engine.drive.batches import EarlyEnd, describe_placement, run_on_all_cores, run_on_auto_mesh, run_packed
from diffabs.engine.drive.engine import check_process, resolve_request, run_with_engine
from diffabs.engine.hybrid import Objectives
from diffabs.engine.solvers import Solver
from diffabs.host.process import default_platform
from diffabs.loop.admissible import batch_admissibility, find_impossible_values, find_unstable_step
from diffabs.loop.arguments import forbid_derivatives, prepare_arguments, refuse, refuse_unnamed
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.loop.faults import Fault
from diffabs.loop.result import Run, finish_run
from diffabs.loop.run import cut_trajectory, plan_run, run_unchecked

log: logging.Logger = logging.getLogger("diffabs")
# Part of a message: why a batch cannot run in a kernel.
TOGETHER_REASON = "lanes run together, for trajectories or for derivatives in either mode"
OBSERVED_REASON = "a kernel has trajectories on a processor only, and of a call that is not traced"
TRACED_REASON = "the call is traced (jit, grad, vmap)"


@default_flags()
def run_batch(
    loop: Loop,
    batch: Batch,
    solver: Solver,
    objectives: Mapping[str, Objective] | None = None,
    *,
    trajectories: bool = False,
    together: bool | None = None,
    accepted: Bool | None = None,
    enough: EarlyEnd | None = None,
    engine: str = "auto",
) -> Run:
    """Simulate every run of a batch and return a `Run` with a leading axis (runs,), in the order of the batch.

    Each element is the result of `measure` for that run. The function is compiled once for a structure and a number of
    runs, not for new values, keys or durations. Runs whose arrays lie on several devices are computed there. The axes
    of the mesh may have any type, but Explicit axes do not work within jit.

    Args:
        loop: Loop that the runs have in common.
        batch: Parameters that differ between the runs. An empty batch is one run.
        solver: Step and duration [s] of every run.
        objectives: Objectives by the names of the metrics, each with shape (runs,); None for no metrics.
        trajectories: True keeps trajectories, shape (runs, instants, ...), with every `solver.every`-th instant.
        together: True is `jax.vmap` of `measure`: all runs step until the last has ended, and derivatives exist in both
            modes, with respect to the loop and the batch's values. With False, a run that has ended makes room for the
            next, so that a few long runs do not delay the rest. XLA then has no derivatives, a kernel forward ones.
            True and False agree to rounding. None is True if loop, values or objectives are traced (inside jit, grad,
            vmap). Trajectories always use True. An empty batch uses True under XLA. Runs of a kernel never wait for
            each other.
        accepted: Runs to execute, shape (runs,), or True for all. The others have `diverged`, and their metrics are
            NaN, also where they step together with the rest. None means the runs that `batch_admissibility` accepts, or
            all if the call is traced; a warning says how many runs are refused, and why. A batch without values has no
            accepted run if the step is not stable.
        enough: Condition that ends runs early. Such a run has neither stopped, timed out nor diverged. Not
            for runs that step together.
        engine: "xla" compiles with XLA. "kernel" translates the loop's step to a program of this machine. It needs a
            C++ compiler on a processor, and NVRTC, which JAX brings, on an NVIDIA GPU. It returns the same numbers to
            rounding and has first derivatives in both modes. On a processor it also keeps trajectories, without
            derivatives; for loops of thousands of operations a step it takes a tenth of XLA's time. "auto" uses a
            kernel where possible. It uses XLA for trajectories, for second derivatives, for reverse mode by more than
            32 numbers of a run (not with adaptive steps on a processor), for concrete runs that step together, and for
            runs that lie on several devices or on one of another kind than JAX's default.
            It also uses XLA if a kernel is impossible. The log says so. The environment variable `DIFFABS_ENGINE`
            replaces "auto" by "xla" or "kernel".

    Raises:
        ValueError: Columns have different lengths, `measure` rejects the arguments, or `enough` is given for runs that
            step together. Also if a batch without values has a loop that `measure` rejects, if `accepted` has a wrong
            shape, or if engine "kernel" is impossible; `simulate.drive.kernel.kernel_objection` returns
            the reason without a run.
        KeyError: A path does not exist.
        RuntimeError: The engine is "auto" or "kernel", in a process that was forked after JAX had started.

    See also:
        `Batch`: The parameters that differ, and keys of noise.
        `measure`: One run, also inside `jax.vmap`.
        `sweep.sweep`: Millions of runs into files, with statistics.
        `tune.worst_case`: The worst run of a box.

    Notes:
        The runs are independent, so their order and number change results by rounding only. With `together=False` a run
        that has ended makes room for the next: n runs of s_1, ..., s_n steps cost about sum s_i steps, those of
        `jax.vmap` n max s_i. `docs/performance.md` has times.

    Examples:
        >>> import diffabs as d
        >>> from diffabs.parts.objectives import StopDistance
        >>> masses = d.Batch({"plant.mass": [12.0, 18.0]})
        >>> run = d.run_batch(d.braking(), masses, d.FixedStep(1e-4, 4.0), {"distance": StopDistance()})
        >>> print(*(f"{distance:.1f}" for distance in run.metrics["distance"]))
        43.9 43.8
    """
    if not isinstance(batch, Batch):
        raise ValueError(f"batch = {kinds.format_value(batch)} is no Batch; d.Batch(values by path) is needed")
    refuse_unnamed(objectives)
    engine = resolve_request(engine)
    if engine != "xla":
        check_process()

    # Everything that may lie on devices is an argument, so that `run_on_auto_mesh` sees it.
    def run(
        loop: Loop, values: Params, keys: Key, objectives: Objectives, accepted: Bool, enough: EarlyEnd | None
    ) -> Run:
        lanes = dataclasses.replace(batch, values=values, keys=keys)
        return _dispatch_batch(loop, lanes, solver, objectives, trajectories, together, accepted, enough, engine)

    return run_on_auto_mesh(run, (loop, dict(batch.values), batch.keys, dict(objectives or {}), accepted, enough))


def _dispatch_batch(
    loop: Loop,
    batch: Batch,
    solver: Solver,
    objectives: dict[str, Objective],
    trajectories: bool,
    together: bool | None,
    accepted: Bool,
    enough: EarlyEnd | None,
    engine: str,
) -> Run:
    """Return the result of `run_batch`, whose arguments these are; `engine` is resolved (`resolve_request`).

    Under XLA the runs step together (`_run_vmapped`) or make room for each other (`run_packed`, on all cores).
    """
    count = batch.size
    columns = {path: jnp.asarray(x) if isinstance(x, list | tuple) else x for path, x in batch.values.items()}
    batch = dataclasses.replace(batch, values=columns)
    for path in columns:
        if line := kinds.find_value_objection(get(loop, path)):
            raise ValueError(f"{path} {line}; the path of a number or an array is needed")
    refuse(replace(loop, {path: _first_member(column) for path, column in batch.values.items()}), solver, objectives)
    # Traced values cannot be checked. A traced batch runs every member, also an impossible one.
    live = is_traced(loop, dict(batch.values), dict(objectives))
    if accepted is None and live:
        accepted = True
    elif accepted is None and batch.values:
        checks = batch_admissibility(loop, batch.values, solver)
        accepted = checks.accepted
        for code, reason in enumerate(checks.reasons[1:], 1):
            _warn_refused(int(np.count_nonzero(checks.codes == code)), count, reason)
    elif accepted is None:
        if lines := find_impossible_values(loop, solver.step):  # all runs are the same loop
            raise ValueError("; ".join(lines))
        lines = list(find_unstable_step(loop, solver))
        accepted = not lines
        if lines:
            _warn_refused(count, count, lines[0])
    elif np.shape(accepted) not in ((), (count,)):
        raise ValueError(f"accepted has shape {np.shape(accepted)}; ({count},) is needed, one value for each run")
    keys, flags = batch._keys(), jnp.broadcast_to(jnp.asarray(accepted, bool), count)
    arguments = loop, batch.values, keys, solver, objectives, flags
    as_one = trajectories or (live if together is None else together) or (not batch.values and batch.keys is None)
    if as_one and enough is not None:
        raise ValueError("enough: lanes that run together, or have trajectories, all run to their ends")
    traced = live or is_traced(arguments, enough)  # such as by keys, under vmap
    if traced and engine != "xla" and together is not False and not trajectories:
        # Each run is a call of its own, whose engine is chosen once it is known how the batch is differentiated.
        return _mark_refused(_run_vmapped(loop, batch, solver, objectives, trajectories, engine), accepted)

    def by_kernel() -> Run:
        from diffabs.engine.drive.kernel import run_native, run_native_trajectories

        prepared, values, method, measured = _prepare_batch(loop, batch.values, solver, objectives)
        if trajectories:
            plan = plan_run(prepared, solver, solver.every)
            run = run_native_trajectories(prepared, values, keys, method, measured, flags, plan)
            return cut_trajectory(run, solver, solver.every, axis=1)
        return run_native(prepared, values, keys, method, measured, flags, finish_run, enough)

    def by_xla() -> Run:
        if not as_one:
            columns = batch.values, keys, flags

            def run(columns: PyTree, numbers: Array) -> Run:
                values, keys, accepted = columns
                prepared, values, method, measured = _prepare_batch(loop, values, solver, objectives)
                return run_packed(prepared, values, keys, method, measured, accepted, finish_run, enough, numbers)

            if traced:
                return run(columns, jnp.arange(count))
            return run_on_all_cores(run, columns, count)
        return _mark_refused(_run_vmapped(loop, batch, solver, objectives, trajectories, "xla"), accepted)

    why_not = TOGETHER_REASON if together else ""
    if trajectories and (traced or default_platform() != "cpu"):
        why_not = OBSERVED_REASON
    why_xla = TRACED_REASON if traced else TOGETHER_REASON if as_one else describe_placement(arguments)
    return run_with_engine(engine, by_kernel, by_xla, (arguments, enough), why_not, why_xla)


def _prepare_batch(
    loop: Loop, values: Params, solver: Solver, objectives: Mapping[str, Objective]
) -> tuple[Loop, Params, PyTree, PyTree]:
    """Return loop, values (runs, ...), stepping method and objectives of one data type, as the engine needs them."""
    loop, measured, method = prepare_arguments(loop, solver, objectives)
    columns = canonical_dtypes(jax.tree.map(lambda x: jnp.asarray(x, method.h.dtype), dict(values)))
    return loop, {**columns, **forbid_derivatives(loop, columns)}, method, measured


def kernel_objection(loop: Loop, values: Params, solver: Solver, objectives: Mapping[str, Objective]) -> str | None:
    """Return one line with the reason why a kernel cannot make these runs, or None if it can.

    A reason is an operation without a translation, no compiler on this machine, or traced numbers. The function
    executes no run, but it compiles and keeps the kernel. `values` have at least one path, with columns (runs, ...).
    """
    from diffabs.engine.drive.kernel import find_objection

    check_process()
    if is_traced(loop, dict(values), dict(objectives)):
        return "this is traced; ask with numbers"
    prepared, columns, method, measured = _prepare_batch(loop, values, solver, objectives)
    return find_objection(prepared, columns, method, dict(measured), finish_run)


_warn_refused = functools.cache(functools.partial(log.warning, "%d of %d runs are refused and count as diverged: %s"))


def _first_member(column: PyTree) -> Any:
    """Return column[0]; for a column on the processor by NumPy, since JAX's indexing costs as much as 20 runs."""
    on_processor = isinstance(column, jax.Array) and not is_traced(column) and column.platform() == "cpu"
    return (np.asarray(column) if on_processor and column.is_fully_addressable else column)[0]


def _run_vmapped(
    loop: Loop, batch: Batch, solver: Solver, objectives: Mapping[str, Objective], trajectories: bool, engine: str
) -> Run:
    """Run the batch with `jax.vmap`, in groups of similar duration. With trajectories there is one group, since all
    share their instants.
    """
    every = solver.every if trajectories else 0

    def run_group(lanes: object, duration: float) -> Run:
        like = dataclasses.replace(solver, duration=duration)
        return batch.each(loop, lambda member, key: run_unchecked(member, like, objectives, key, every, engine), lanes)

    if trajectories or batch.durations is None:
        return run_group(None, solver.duration)
    groups = batch.groups(solver.duration)
    # The inverse permutation restores the order of the batch after the groups are joined.
    order = np.argsort(np.concatenate([lanes for lanes, _ in groups]))
    return jax.tree.map(lambda *x: jnp.concatenate(x)[order], *(run_group(*group) for group in groups))


def _mark_refused(run: Run, accepted: Bool) -> Run:
    """Return the runs with the results of refused runs replaced as in a packed batch: diverged, with NaN metrics."""
    if accepted is True:
        return run
    accepted = jnp.asarray(accepted, bool)
    metrics = {name: jnp.where(accepted, value, jnp.nan) for name, value in run.metrics.items()}
    flags = {"stopped": run.stopped & accepted, "timed_out": run.timed_out & accepted}
    fault = jnp.where(accepted, jnp.asarray(run.fault), Fault.REFUSED.value)
    return run._replace(metrics=metrics, diverged=run.diverged | ~accepted, fault=fault, **flags)
