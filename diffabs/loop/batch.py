"""Batches: many runs of one loop at once, with different masses, speeds, roads or noise, one row of values for each
run.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core import kinds, shapes
from diffabs.core.pytree import canonical_dtypes, get, parameters, replace, stack_lists
from diffabs.core.summary import Summary
from diffabs.core.types import AnyArray, Params, Part, PyTree
from diffabs.engine.solvers import Solver
from diffabs.loop.admissible import first_refusal
from diffabs.loop.closed_loop import Loop

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
    keys: shapes.Shaped[AnyArray, " runs"] | Sequence[int] | None = None
    weights: shapes.Float[AnyArray, " runs"] | Sequence[float] | None = None
    durations: shapes.Float[AnyArray, " runs"] | Sequence[float] | None = None

    def __post_init__(self) -> None:
        """Raise a ValueError if `values` are no mapping, or a column has no numbers (or, for `keys`, no keys)."""
        if not isinstance(self.values, Mapping):
            text = kinds.format_value(self.values)
            raise ValueError(f'values = {text} is no mapping by path, such as {{"plant.mass": [12.0, 18.0]}}')
        for name, column in self._columns().items():
            if name == "keys" and jnp.issubdtype(getattr(column, "dtype", float), jax.dtypes.prng_key):
                continue
            line = kinds.find_value_objection(column)
            if not line and isinstance(column, list | tuple) and len({*map(kinds.value_shape, column)}) > 1:
                line = "has rows of different shapes"
            elif not line and name == "keys" and not _are_seeds(column):
                line = "is neither keys of jax.random.key nor whole numbers"
            if line:
                raise ValueError(f"{name} = {kinds.format_value(column)} {line}; one value for each run is needed")

    def _columns(self) -> Params:
        named = {name: getattr(self, name) for name in ("keys", "weights", "durations")}
        return {**self.values, **{name: column for name, column in named.items() if column is not None}}

    def _repr_html_(self) -> str:
        """Return the columns as a table for a notebook."""
        rows = []
        for name, column in self._columns().items():
            numbers = jnp.issubdtype(getattr(column, "dtype", float), jnp.number)
            rows.append((name, *((np.min(column), np.max(column)) if numbers else ("", "")), str(np.shape(column))))
        title = f"Batch of {self.size} run{'' if self.size == 1 else 's'}"
        return Summary(title, ("column", "least", "greatest", "shape"), tuple(rows))._repr_html_()

    @property
    def size(self) -> int:
        """Number of runs.

        Raises:
            ValueError: The columns have different lengths, or a column has no length.
        """
        columns = self._columns()
        lengths = {name: np.shape(column)[0] if np.ndim(column) else 0 for name, column in columns.items()}
        if len(set(lengths.values())) > 1 or 0 in lengths.values():
            descriptions = {
                name: f"has {n} values" if np.ndim(columns[name]) else "is one number" for name, n in lengths.items()
            }
            listed = ", ".join(f"{name} {words}" for name, words in descriptions.items())
            raise ValueError(f"a batch needs columns of the same length, with one value for each run: {listed}")
        return next(iter(lengths.values()), 1)

    def check(self, loop: Loop, solver: Solver | None = None) -> "Batch":
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
        """Return groups of runs whose `durations`, each at most `duration` [s], differ by less than a factor of 2.

        Each group is a pair: the numbers of its runs, and the longest of their durations [s]. The batch must have
        `durations`.
        """
        durations = np.minimum(np.asarray(self.durations, float), duration)
        if not (durations > 0).all():
            raise ValueError(f"durations = {np.min(durations):g} s is not positive")
        classes = np.floor(np.log(durations.max() / durations) / np.log(MAX_LENGTH_RATIO)).astype(int)
        members = [np.flatnonzero(classes == i) for i in np.unique(classes)]
        return [(lanes, float(durations[lanes].max())) for lanes in members]

    def lane(self, loop: object, i: int) -> PyTree:
        """Return the loop of run `i`, given the common `loop`."""
        return replace(loop, {path: np.asarray(column)[i] for path, column in self.values.items()})

    def each(self, loop: Part, function: Callable[[PyTree, PyTree], PyTree], lanes: PyTree = None) -> PyTree:
        """Return function(loop, key) for every run, stacked along a leading axis (runs,), by `jax.vmap`;
        differentiable.

        The values get the floating-point type of the loop. A batch without values and keys calls the function once,
        with the key None, and repeats its result. `lanes` holds the numbers of the runs to include; None includes all.
        """
        if not self.values and self.keys is None:
            count = self.size if lanes is None else len(lanes)
            return jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *jnp.shape(x))), function(loop, None))
        dtype = jax.tree.leaves(canonical_dtypes(loop))[0].dtype
        columns = {path: jnp.asarray(column, dtype) for path, column in self.values.items()}, self._keys()
        if lanes is not None:
            columns = jax.tree.map(lambda column: column[lanes], columns)
        return jax.vmap(lambda values, key: function(replace(loop, values), key))(*columns)

    def _keys(self) -> Any:
        if self.keys is None or jnp.issubdtype(jnp.asarray(self.keys).dtype, jax.dtypes.prng_key):
            return self.keys
        return jax.vmap(jax.random.key)(jnp.asarray(self.keys))


def _are_seeds(column: Any) -> bool:
    # Not by `jnp.asarray`: it would start JAX's backend.
    shape = kinds.value_shape(column)
    dtype = column.dtype if hasattr(column, "dtype") else np.result_type(*(column if shape else [column]))
    return len(shape) < 2 and jnp.issubdtype(dtype, np.integer)


def group_by_structure(loops: Sequence[PyTree]) -> list[list[int]]:
    """Return the indices of the loops in groups of equal structure and shapes; each group can be one batch."""
    groups: dict[PyTree, list[int]] = {}
    for place, loop in enumerate(map(stack_lists, loops)):
        groups.setdefault((jax.tree.structure(loop), *map(np.shape, jax.tree.leaves(loop))), []).append(place)
    return list(groups.values())


def stack_loops(loops: Sequence[PyTree]) -> tuple[PyTree, Batch]:
    """Return loops of one structure as a batch for `run_batch`: the first loop, and every parameter of each, shape
    (runs, ...).
    """
    if (count := len(group_by_structure(loops))) != 1:
        raise ValueError(f"loops of {count} structures are no lanes of one batch")
    each = [{path: value for path, _, value in parameters(loop)} for loop in loops]
    return loops[0], Batch({path: np.stack([np.asarray(values[path], float) for values in each]) for path in each[0]})


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
