"""Batches: many runs of one loop at once, with different masses, speeds, roads or noise, one row of values for each
run.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.compiling import is_traced
from diffabs.core.loop import Loop
from diffabs.core.protocols import Objective
from diffabs.core.pytree import as_arrays, get, parameters, replace
from diffabs.core.types import Array, Bool, Key, Params, Part, PyTree
from diffabs.simulate.admissible import batch_admissibility, first_refusal
from diffabs.simulate.drive.engine import check_process, resolve_request, run_with_engine
from diffabs.simulate.drive.packed import EarlyEnd, run_packed
from diffabs.simulate.drive.sharding import describe_placement, run_on_all_cores, run_on_auto_mesh
from diffabs.simulate.run import refuse, run_unchecked
from diffabs.simulate.types import Run, Solver

# Part of a message: why a batch cannot run in a kernel.
TOGETHER_REASON = "lanes run together, for trajectories or for derivatives in either mode"
TRACED_REASON = "the call is traced (jit, grad, vmap)"
MAX_LENGTH_RATIO = 2.0  # runs in one group differ by less than this factor in duration


@dataclasses.dataclass(frozen=True)
class Batch:
    """The parameters that differ between the runs of a batch, one row for each run. An empty batch is a single run of
    the loop.

    Attributes:
        values: Parameter values by dotted path, in SI units, shape (runs, ...).
        keys: Random keys of `jax.random`, or whole numbers as seeds of keys, shape (runs,), for noisy sensors.
        weights: Positive weights, shape (runs,). `tune` multiplies the objective of each run by its weight, for example
            by 1/the shortest possible distance.
        durations: Upper bounds on the end times of the runs [s], shape (runs,). They matter only to runs that step
            together without trajectories. Runs of similar durations then form a group (`groups`), so that short runs do
            not wait for long ones. A run that exceeds the duration of its group has `timed_out`. None gives all runs
            `solver.duration`.
    """

    values: Params = dataclasses.field(default_factory=dict)
    keys: PyTree = None
    weights: PyTree = None
    durations: Any = None

    @property
    def size(self) -> int:
        """Number of runs.

        Raises:
            ValueError: The columns have different lengths, or a column has no length.
        """
        others = {name: getattr(self, name) for name in ("keys", "weights", "durations")}
        columns = {**self.values, **{name: column for name, column in others.items() if column is not None}}
        lengths = {name: np.shape(column)[0] if np.ndim(column) else 0 for name, column in columns.items()}
        if len(set(lengths.values())) > 1 or 0 in lengths.values():
            listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise ValueError(f"the lanes' values have different lengths, or none: {listed}")
        return next(iter(lengths.values()), 1)

    def check(self, loop: Part, solver: Solver | None = None) -> "Batch":
        """Return the batch itself if its values fit the loop.

        Args:
            loop: Loop that the runs have in common.
            solver: Solver of all runs. If it is given, each run must pass `batch_admissibility`.

        Raises:
            ValueError: A path does not exist, columns have different lengths, a value is out of range, a weight or a
                duration is not positive and finite, or a run is refused.
        """
        specs, _ = {path: spec for path, spec, _ in parameters(loop)}, self.size
        for path, column in self.values.items():
            if path not in specs:
                raise ValueError(f"{path} is not a parameter of the loop; there is {', '.join(specs)}")
            if np.shape(column)[1:] != np.shape(get(loop, path)):
                raise ValueError(f"{path}: a lane has shape {np.shape(column)[1:]}, not {np.shape(get(loop, path))}")
            if not specs[path].holds(column):
                low, high = np.min(column), np.max(column)
                raise ValueError(f"{path} = {low:g} ... {high:g} leaves {specs[path].interval()}")
        for name in ("weights", "durations"):
            column = getattr(self, name)
            if column is not None and not (np.isfinite(column) & (np.asarray(column) > 0)).all():
                raise ValueError(f"{name} = {np.min(column):g} ... {np.max(column):g} are not all positive and finite")
        if solver and (line := first_refusal(loop, self.values, solver)):
            raise ValueError(line)
        return self

    def groups(self, duration: float) -> list[tuple[np.ndarray, float]]:
        """Return groups of runs whose `durations` differ by less than a factor of 2.

        Each group is a pair: the numbers of its runs, and the longest of their durations [s]. The batch must have
        `durations`.

        Args:
            duration: Upper limit of all durations [s].
        """
        wanted = np.minimum(np.asarray(self.durations, float), duration)
        classes = np.floor(np.log(wanted.max() / wanted) / np.log(MAX_LENGTH_RATIO)).astype(int)
        members = [np.flatnonzero(classes == i) for i in np.unique(classes)]
        return [(lanes, float(wanted[lanes].max())) for lanes in members]

    def lane(self, loop: Part, i: int) -> PyTree:
        """Return the loop of run `i`, given the common `loop`."""
        return replace(loop, {path: np.asarray(column)[i] for path, column in self.values.items()})

    def each(self, loop: Part, function: Callable[[PyTree, PyTree], PyTree], lanes: Any = None) -> PyTree:
        """Return function(loop, key) for every run, stacked along a leading axis (runs,), by `jax.vmap`;
        differentiable.

        An empty batch calls the function once, with the key None; its result has a leading axis (1,).

        Args:
            loop: Loop that the runs have in common.
            function: Function of the loop and the key of one run. The key is None in a batch without keys.
            lanes: Numbers of the runs to include; None for all runs. It has no effect in an empty batch.
        """
        columns = {path: jnp.asarray(column, float) for path, column in self.values.items()}, self._keys()
        if not jax.tree.leaves(columns):
            return jax.tree.map(lambda x: jnp.asarray(x)[None], function(loop, None))
        if lanes is not None:
            columns = jax.tree.map(lambda column: column[lanes], columns)
        return jax.vmap(lambda values, key: function(replace(loop, values), key))(*columns)

    def _keys(self) -> Any:
        if self.keys is None or jnp.issubdtype(jnp.asarray(self.keys).dtype, jax.dtypes.prng_key):
            return self.keys
        return jax.vmap(jax.random.key)(jnp.asarray(self.keys))


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
            modes, with respect to the loop and the batch's values. False has no reverse mode, but a run that has ended
            makes room for the next, so that a few long runs do not delay the rest. Both agree to rounding. None is True
            if loop, values or objectives are traced (inside jit, grad, vmap). Trajectories always use True. An empty
            batch uses True under XLA. Runs of a kernel never step together.
        accepted: Runs to execute, shape (runs,), or True for all. The others have `diverged`, and their metrics are
            NaN, also where they step together with the rest. None means the runs that `batch_admissibility` accepts, or
            all if the call is traced.
        enough: Condition that ends runs early. Such a run has neither stopped, timed out nor diverged. Not
            for runs that step together.
        engine: "xla" compiles with XLA. "kernel" translates the loop's step to a program of this machine, which needs a
            C++ compiler. It returns the same numbers to rounding and has forward derivatives (`jax.jvp`, `jax.jacfwd`),
            but no reverse mode and no trajectories. "auto" uses a kernel for values on a processor where possible. It
            uses XLA if the call is traced or the runs step together. It also does so on a GPU or on several devices,
            and if a kernel is impossible; only then the log has a warning. The environment variable `DIFFABS_ENGINE`
            replaces "auto" by "xla" or "kernel".

    Examples:
        >>> import diffabs as d
        >>> from diffabs.objectives import StopDistance
        >>> masses = d.Batch({"plant.mass": [12.0, 18.0]})
        >>> run = d.run_batch(d.braking(), masses, d.FixedStep(1e-4, 4.0), {"distance": StopDistance()})
        >>> print(*(f"{distance:.1f}" for distance in run.metrics["distance"]))
        43.9 43.8

    Raises:
        ValueError: Columns have different lengths, `measure` rejects the arguments, or `enough` is given for runs that
            step together. Also if engine "kernel" is impossible; `simulate.drive.kernel.kernel_objection` returns
            the reason without a run.
        KeyError: A path does not exist.
        RuntimeError: The engine is "auto" or "kernel", in a process that was forked after JAX had started.
    """
    engine = resolve_request(engine)
    if engine != "xla":
        check_process()

    # Everything that may lie on devices is an argument, so that `run_on_auto_mesh` sees it.
    def run(loop: Loop, values: PyTree, keys: Key, objectives: Any, accepted: Bool, enough: Any) -> Run:
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
    refuse(replace(loop, {path: _first_member(column) for path, column in batch.values.items()}), solver, objectives)
    # Traced values cannot be checked. A traced batch runs every member, also an impossible one.
    live = is_traced(loop, dict(batch.values), dict(objectives))
    if accepted is None:
        asked = bool(batch.values) and not live
        accepted = (
            batch_admissibility(loop, batch.values, solver).accepted
            if asked
            else live or not first_refusal(loop, {}, solver)
        )
    given = (
        loop,
        batch.values,
        batch._keys(),
        solver,
        objectives,
        jnp.broadcast_to(jnp.asarray(accepted, bool), count),
    )
    as_one = trajectories or (live if together is None else together) or (not batch.values and batch.keys is None)
    if as_one and enough is not None:
        raise ValueError("enough: lanes that run together, or have trajectories, all run to their ends")

    def by_kernel() -> Run:
        from diffabs.simulate.drive.kernel import run_native

        return run_native(*given, enough)

    def by_xla() -> Run:
        if not as_one:
            everything = given[1], given[2], given[-1]  # values, keys, accepted

            def run(columns: PyTree, numbers: Array) -> Run:
                values, keys, accepted = columns
                return run_packed(loop, values, keys, solver, objectives, accepted, enough, numbers)

            if traced:
                return run(everything, jnp.arange(count))
            return run_on_all_cores(run, everything, count)
        return _mark_refused(_run_vmapped(loop, batch, solver, objectives, trajectories), accepted)

    why_not = TOGETHER_REASON if trajectories or together else ""
    traced = live or is_traced(given, enough)  # such as by keys, under vmap
    why_xla = TRACED_REASON if traced else TOGETHER_REASON if as_one else describe_placement(given)
    return run_with_engine(engine, by_kernel, by_xla, (given, enough), why_not, why_xla)


def _first_member(column: PyTree) -> Any:
    """Return column[0]; for a column on the processor by NumPy, since JAX's indexing costs as much as 20 runs."""
    on_processor = isinstance(column, jax.Array) and not is_traced(column) and column.platform() == "cpu"
    return (np.asarray(column) if on_processor and column.is_fully_addressable else column)[0]


def _run_vmapped(
    loop: Loop, batch: Batch, solver: Solver, objectives: Mapping[str, Objective], trajectories: bool
) -> Run:
    """Run the batch with `jax.vmap`, in groups of similar duration. With trajectories there is one group, since all
    share their instants.
    """
    every = solver.every if trajectories else 0

    def run_group(lanes: Any, duration: float) -> Run:
        like = dataclasses.replace(solver, duration=duration)
        return batch.each(loop, lambda one, key: run_unchecked(one, like, objectives, key, every), lanes)

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
    return run._replace(metrics=metrics, diverged=run.diverged | ~accepted, **flags)


def group_by_structure(loops: Sequence[PyTree]) -> list[list[int]]:
    """Return the indices of the loops in groups of equal structure and shapes; each group can be one batch.

    Args:
        loops: Loops to group.
    """
    groups: dict[PyTree, list[int]] = {}
    for place, loop in enumerate(map(as_arrays, loops)):
        groups.setdefault((jax.tree.structure(loop), *map(np.shape, jax.tree.leaves(loop))), []).append(place)
    return list(groups.values())


def stack_loops(loops: Sequence[PyTree]) -> tuple[PyTree, Batch]:
    """Return loops of one structure as a batch for `run_batch`: the first loop, and every parameter of each, shape
    (runs, ...).

    Args:
        loops: Loops of one structure (see `group_by_structure`).

    Raises:
        ValueError: The loops have different structures.
    """
    if (kinds := len(group_by_structure(loops))) != 1:
        raise ValueError(f"loops of {kinds} structures are no lanes of one batch")
    each = [{path: value for path, _, value in parameters(loop)} for loop in loops]
    return loops[0], Batch({path: np.stack([np.asarray(one[path], float) for one in each]) for path in each[0]})


def grid(values: Mapping[str, Sequence[float]]) -> Batch:
    """Return a batch with one run for every combination of the values; the last parameter varies fastest.

    Args:
        values: Values of each parameter, by dotted path. The numbers of values multiply to the number of runs.
    """
    axes = np.meshgrid(*(np.asarray(v, float) for v in values.values()), indexing="ij")
    return Batch({path: axis.ravel() for path, axis in zip(values, axes, strict=True)})


def latin(ranges: Mapping[str, tuple[float, float]], count: int, seed: int = 0) -> Batch:
    """Return a batch of `count` runs spread over a box by SciPy's scrambled Latin hypercube.

    Args:
        ranges: Lowest and highest value of each scalar parameter, by dotted path. Their order is not checked.
        count: Number of runs.
        seed: Seed of the random numbers. The same seed gives the same batch.
    """
    from scipy.stats import qmc

    low, high = np.array(list(ranges.values()), float).T
    points = low + (high - low) * qmc.LatinHypercube(len(ranges), rng=np.random.default_rng(seed)).random(count)
    return Batch(dict(zip(ranges, points.T, strict=True)))
