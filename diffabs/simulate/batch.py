"""The runs that a controller is judged on: masses, speeds, roads, noise, one lane each."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.protocols import Objective
from diffabs.core.pytree import get, parameters, replace
from diffabs.simulate.refusals import first_line, traced
from diffabs.simulate.run import measure
from diffabs.simulate.solution import FixedStep, Run

LONGER = 2.0  # lanes that run together differ by less than this factor in length


@dataclasses.dataclass(frozen=True)
class Batch:
    """Lanes: parameters of a loop by dotted path, an array with one row per lane each. An empty batch is the loop
    itself, one lane.

    seeds: of noisy sensors, one per lane
    weights: positive, one per lane; the lane's objective is multiplied by it (1/the shortest distance possible, say)
    durations: [s], in which each lane is sure to end; lanes of similar length are run together, so that the short ones
        do not wait for the long ones. Without them all run for `solver.duration`
    """

    values: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    seeds: Sequence[int] | None = None
    weights: Any = None
    durations: Any = None

    @property
    def size(self) -> int:
        """How many lanes."""
        return next((len(column) for column in self._columns().values()), 1)

    def _columns(self) -> dict[str, Any]:
        others = {name: getattr(self, name) for name in ("seeds", "weights", "durations")}
        return {**self.values, **{name: column for name, column in others.items() if column is not None}}

    def check(self, loop: Any) -> "Batch":
        """Raises ValueError for a path that does not exist, columns of different lengths, a value out of range."""
        specs = {path: spec for path, spec, _ in parameters(loop)}
        lengths = {name: np.shape(column)[0] if np.ndim(column) else 0 for name, column in self._columns().items()}
        if len(set(lengths.values())) > 1 or 0 in lengths.values():
            listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise ValueError(f"the lanes' values have different lengths, or none: {listed}")
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
        return self

    def groups(self, duration: float) -> list[tuple[np.ndarray, float]]:
        """Lanes (their numbers) that are run together, and for how long [s]."""
        if self.durations is None:
            return [(np.arange(self.size), duration)]
        wanted = np.minimum(np.asarray(self.durations, float), duration)
        classes = np.floor(np.log(wanted.max() / wanted) / np.log(LONGER)).astype(int)
        members = [np.flatnonzero(classes == i) for i in np.unique(classes)]
        return [(lanes, float(wanted[lanes].max())) for lanes in members]

    def arrays(self) -> tuple[dict[str, Any], Any]:
        """Values and keys with a leading lane axis, for `jax.vmap`; keys None without seeds."""
        seeds = None if self.seeds is None else jax.vmap(jax.random.key)(jnp.asarray(self.seeds))
        return {path: jnp.asarray(column, float) for path, column in self.values.items()}, seeds

    def lane(self, loop: Any, i: int) -> Any:
        """The loop of lane i."""
        return replace(loop, {path: np.asarray(column)[i] for path, column in self.values.items()})


def check_lanes(loop: Any, batch: Batch, solver: FixedStep) -> None:
    """Raises ValueError, one line, for the first lane that must not be run: see `refusals`."""
    if line := first_line(loop, batch.values, solver):
        raise ValueError(line)


def run(loop: Any, batch: Batch, solver: FixedStep, measured: Mapping[str, Objective]) -> Run:
    """Run every lane of a batch, in order, and return the metrics (lanes,), without trajectories.

    loop: a Loop, or a part with a method `closed()`; differentiable in it
    solver: of every run
    measured: objectives by metric

    Raises ValueError for a lane that must not be run, unless the call is traced: then ask `check_lanes` before."""
    if not traced(loop, dict(batch.values)):
        check_lanes(loop, batch, solver)
    columns = batch.arrays()
    if not jax.tree.leaves(columns):
        return jax.tree.map(lambda x: x[None], measure(loop, solver, measured))
    groups = batch.groups(solver.duration)
    found = []
    for lanes, duration in groups:
        values, keys = jax.tree.map(lambda column: column[lanes], columns)  # noqa: B023
        found.append(_together(loop, values, keys, dataclasses.replace(solver, duration=duration), measured))
    order = np.argsort(np.concatenate([lanes for lanes, _ in groups]))
    return jax.tree.map(lambda *x: jnp.concatenate(x)[order], *found)


def _together(loop: Any, values: Any, keys: Any, solver: FixedStep, measured: Mapping[str, Objective]) -> Run:
    def lane(values: Any, key: Any) -> Run:
        return measure(replace(loop, values), solver, measured, key=key)

    return jax.vmap(lane)(values, keys)


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
