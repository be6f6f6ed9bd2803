"""Many runs at once: masses, speeds, roads, noise, one lane each."""

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
from diffabs.simulate.admissible import batch_admissibility, first_refusal
from diffabs.simulate.engine import check_process, run_with_engine
from diffabs.simulate.packed import EarlyEnd, run_packed
from diffabs.simulate.run import refuse, run_unchecked
from diffabs.simulate.sharding import run_on_auto_mesh
from diffabs.simulate.solution import Run, Solver

TOGETHER_REASON = "lanes run together, for trajectories or for derivatives in either mode"
MAX_LENGTH_RATIO = 2.0  # lanes that run together differ by less than this factor in length


@dataclasses.dataclass(frozen=True)
class Batch:
    """Lanes: what differs between runs of a loop, a row for each. An empty batch is the loop itself, one lane.

    values: parameters by dotted path, in SI, (lanes, ...)
    keys: for noisy sensors, keys of `jax.random` or whole numbers, the seeds of keys (lanes,)
    weights: positive (lanes,); `tune` multiplies the lane's objective by it (1/the shortest distance possible, say)
    durations: [s] (lanes,), in which each lane is sure to end; lanes that run together are then of similar length, so
        that the short ones do not wait for the long ones. Without them all run for `solver.duration`
    """

    values: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    keys: Any = None
    weights: Any = None
    durations: Any = None

    @property
    def size(self) -> int:
        """How many lanes. Raises ValueError for columns of different lengths, or of none."""
        others = {name: getattr(self, name) for name in ("keys", "weights", "durations")}
        columns = {**self.values, **{name: column for name, column in others.items() if column is not None}}
        lengths = {name: np.shape(column)[0] if np.ndim(column) else 0 for name, column in columns.items()}
        if len(set(lengths.values())) > 1 or 0 in lengths.values():
            listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise ValueError(f"the lanes' values have different lengths, or none: {listed}")
        return next(iter(lengths.values()), 1)

    def check(self, loop: Any, solver: Solver | None = None) -> "Batch":
        """Return the batch if its lanes fit the loop. Raises ValueError for a path that does not exist, columns of
        different lengths, a value out of range, and, with a solver, a lane that `batch_admissibility` refuses."""
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
        """Lanes (their numbers) of similar `durations`, and for how long [s] they are run, at most `duration`."""
        wanted = np.minimum(np.asarray(self.durations, float), duration)
        classes = np.floor(np.log(wanted.max() / wanted) / np.log(MAX_LENGTH_RATIO)).astype(int)
        members = [np.flatnonzero(classes == i) for i in np.unique(classes)]
        return [(lanes, float(wanted[lanes].max())) for lanes in members]

    def lane(self, loop: Any, i: int) -> Any:
        """The loop of lane i."""
        return replace(loop, {path: np.asarray(column)[i] for path, column in self.values.items()})

    def each(self, loop: Any, function: Callable[[Any, Any], Any], lanes: Any = None) -> Any:
        """Return function(loop, key) of every lane (key None without keys), or of those of the numbers `lanes`, with a
        leading axis: `jax.vmap`, differentiable."""
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
    accepted: Any = None,
    enough: EarlyEnd | None = None,
    engine: str = "xla",
) -> Run:
    """Run every lane of a batch and return what `measure` returns of each: a `Run` with a leading axis, in their order.

    loop: what the lanes have in common
    batch: what differs between them; an empty one is one lane
    solver: step and duration [s] of every run
    objectives: by the names of the metrics, which are (lanes,); None is none
    trajectories: keep them, (lanes, instants, ...), every `solver.every`-th instant
    together: True is `jax.vmap` of `measure`: all lanes step until the last has ended, and there are derivatives in
        both modes, in the loop and in the batch's values. False has no reverse mode, but a lane that has ended makes
        room for the next, so that few long ones do not hold up the rest. The two agree to rounding. None is True if
        the call is traced (inside jit, grad, vmap); trajectories and an empty batch are always run together
    accepted: which lanes are run (lanes,), or True for all; the others have `diverged`, and their metrics are NaN.
        None is those that `batch_admissibility` accepts, or all if the call is traced
    enough: ends runs early, which then have neither stopped, timed out nor diverged; not together
    engine: "kernel" makes of the loop's step a program of this machine (a C++ compiler is needed): the same numbers to
        rounding, and derivatives, forward (`jax.jvp`, `jax.jacfwd`) and not in reverse; no trajectories. "auto" does so
        for values where it can, and otherwise what "xla" does

    Compiled once for a structure and a number of lanes, not for new values, keys or durations. Lanes that lie on
    several devices run there, whatever the type of their mesh's axes; on Explicit ones not within jit.

    >>> import diffabs as d
    >>> from diffabs.objectives import StopDistance
    >>> masses = d.Batch({"plant.mass": [12.0, 18.0]})
    >>> run = d.run_batch(d.braking(), masses, d.FixedStep(1e-4, 4.0), {"distance": StopDistance()})
    >>> print(*(f"{distance:.1f}" for distance in run.metrics["distance"]))
    43.9 43.8

    Raises:
        ValueError: columns of different lengths; what `measure` objects to; `enough` for lanes that run together; what
            stands against the engine "kernel" (`simulate.native.kernel_objection` says it without running anything).
        KeyError: a path that does not exist.
        RuntimeError: a kernel in a process that was forked after JAX had started.
    """
    if engine != "xla":
        check_process()

    def run(loop: Loop, values: Any, keys: Any, objectives: Any, accepted: Any, enough: Any) -> Run:
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
    accepted: Any,
    enough: EarlyEnd | None,
    engine: str,
) -> Run:
    count = batch.size
    columns = {path: jnp.asarray(x) if isinstance(x, list | tuple) else x for path, x in batch.values.items()}
    batch = dataclasses.replace(batch, values=columns)
    refuse(replace(loop, {path: column[0] for path, column in batch.values.items()}), solver, objectives)
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
        from diffabs.simulate.native import run_native

        return run_native(*given, enough)

    def by_xla() -> Run:
        if not as_one:
            return run_packed(*given, enough)
        return _mark_refused(_run_vmapped(loop, batch, solver, objectives, trajectories), accepted)

    why_not = TOGETHER_REASON if trajectories or together or (as_one and engine == "auto") else ""
    return run_with_engine(engine, by_kernel, by_xla, why_not)


def _run_vmapped(
    loop: Loop, batch: Batch, solver: Solver, objectives: Mapping[str, Objective], trajectories: bool
) -> Run:
    """In groups of similar length, but trajectories have all the same instants."""
    every = solver.every if trajectories else 0

    def found(lanes: Any, duration: float) -> Run:
        like = dataclasses.replace(solver, duration=duration)
        return batch.each(loop, lambda one, key: run_unchecked(one, like, objectives, key, every), lanes)

    if trajectories or batch.durations is None:
        return found(None, solver.duration)
    groups = batch.groups(solver.duration)
    order = np.argsort(np.concatenate([lanes for lanes, _ in groups]))
    return jax.tree.map(lambda *x: jnp.concatenate(x)[order], *(found(*group) for group in groups))


def _mark_refused(run: Run, accepted: Any) -> Run:
    """With lanes that are not accepted as refilled ones are."""
    if accepted is True:
        return run
    accepted = jnp.asarray(accepted, bool)
    metrics = {name: jnp.where(accepted, value, jnp.nan) for name, value in run.metrics.items()}
    flags = {"stopped": run.stopped & accepted, "timed_out": run.timed_out & accepted}
    return run._replace(metrics=metrics, diverged=run.diverged | ~accepted, **flags)


def group_by_structure(loops: Sequence[Any]) -> list[list[int]]:
    """Return the places of those loops that can be lanes of one batch: of equal structure and shapes."""
    groups: dict[Any, list[int]] = {}
    for place, loop in enumerate(map(as_arrays, loops)):
        groups.setdefault((jax.tree.structure(loop), *map(np.shape, jax.tree.leaves(loop))), []).append(place)
    return list(groups.values())


def stack_loops(loops: Sequence[Any]) -> tuple[Any, Batch]:
    """Return loops of one structure as lanes, for `run_batch`: the first of them, and every parameter of each (lanes,
    ...). Raises ValueError for loops of different structures: see `group_by_structure`."""
    if (kinds := len(group_by_structure(loops))) != 1:
        raise ValueError(f"loops of {kinds} structures are no lanes of one batch")
    each = [{path: value for path, _, value in parameters(loop)} for loop in loops]
    return loops[0], Batch({path: np.stack([np.asarray(one[path], float) for one in each]) for path in each[0]})


def grid(values: Mapping[str, Sequence[float]]) -> Batch:
    """Return a lane for every combination of the values by path."""
    axes = np.meshgrid(*(np.asarray(v, float) for v in values.values()), indexing="ij")
    return Batch({path: axis.ravel() for path, axis in zip(values, axes, strict=True)})


def latin(ranges: Mapping[str, tuple[float, float]], count: int, seed: int = 0) -> Batch:
    """Return `count` lanes spread over a box by a scrambled Latin hypercube (SciPy's).

    ranges: low and high by path
    seed: of the scrambling"""
    from scipy.stats import qmc

    low, high = np.array(list(ranges.values()), float).T
    points = low + (high - low) * qmc.LatinHypercube(len(ranges), rng=np.random.default_rng(seed)).random(count)
    return Batch(dict(zip(ranges, points.T, strict=True)))
