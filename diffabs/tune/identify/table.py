"""Tables of measured metrics, compared with the metrics of simulated runs."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffabs.core.protocols import Objective
from diffabs.core.pytree import canonical_dtypes, get, parameters, replace
from diffabs.core.types import Array, Params, Part, PyTree, Scalar, Vector
from diffabs.core.validity import check_part
from diffabs.engine.solvers import Solver
from diffabs.loop.batch import Batch, group_by_structure, stack_loops
from diffabs.loop.closed_loop import Loop
from diffabs.loop.run import measure
from diffabs.parts.objectives import BRAKING
from diffabs.tune.identify.data import Comparison, check_positive, check_sigma_table


@dataclasses.dataclass(frozen=True, eq=False)
class Table:
    """Published or measured metrics of runs that share the free parameters.

    Attributes:
        loops: Loops by row. Their structures may differ; loops of equal structure run together.
        values: Measured values as {row: {metric: value}}. A row may lack some metrics.
        sigma: Standard deviation by metric, in its unit. None if unknown, with one metric only.
        measured: Objectives by metric.
    """

    loops: Mapping[str, Loop]
    values: Mapping[str, Mapping[str, float]]
    sigma: Mapping[str, float] | None = None
    measured: Mapping[str, Objective] = dataclasses.field(default_factory=lambda: BRAKING)

    @property
    def labels(self) -> list[tuple[str, str]]:
        """Pairs (row, metric), one for each residual."""
        return [(row, metric) for row, line in self.values.items() for metric in line]

    def against(self, loop: Loop, free: Sequence[str], solver: Solver) -> Comparison:
        """Return the comparison with the metrics of every row's loop.

        Args:
            loop: Loop whose parameters are identified; the rows' own loops are run, with these parameters.
            free: Paths of the parameters that all rows share.
            solver: Solver of every run.

        Raises:
            ValueError: A row has no loop, a parameter is missing in a loop, or a metric is not measured.
            ValueError: A value is not finite, or sigma is missing or not positive.
        """
        self._check(loop, free)
        loops = [self.loops[row] for row in self.values]
        groups = group_by_structure(loops)
        order = [list(self.values)[i] for places in groups for i in places]
        lanes = (stack_loops([loops[i] for i in places]) for places in groups)
        batches = [(canonical_dtypes(stacked), batch.values) for stacked, batch in lanes]
        metrics = list(dict.fromkeys(metric for _, metric in self.labels))
        place = np.array([(order.index(row), metrics.index(metric)) for row, metric in self.labels])
        target = np.array([self.values[row][metric] for row, metric in self.labels])
        weights = self.sigma
        sigma = None if weights is None else np.array([weights[metric] for _, metric in self.labels])
        measured = _MetricResiduals(solver, tuple(free), tuple((name, self.measured[name]) for name in metrics))
        data = batches, place, target
        return Comparison(measured, data, sigma, lambda part: measured.each(part, batches, lambda loop: loop))

    def _check(self, loop: Loop, free: Sequence[str]) -> None:
        for row, line in self.values.items():
            if row not in self.loops:
                raise ValueError(f"row {row}: no loop; there is {', '.join(self.loops)}")
            check_part(self.loops[row], f"{row}: ")
            own_paths = {path for path, _, _ in parameters(self.loops[row])}
            for path in free:
                if path not in own_paths or np.shape(get(self.loops[row], path)) != np.shape(get(loop, path)):
                    raise ValueError(f"row {row}: {path} is not a parameter of its loop, or of another shape")
            for metric, value in line.items():
                if metric not in self.measured:
                    raise ValueError(f"row {row}: {metric} is not measured; there is {', '.join(self.measured)}")
                if not math.isfinite(value):
                    raise ValueError(f"row {row}: {metric} = {value} is not finite")
        self._check_sigma({metric for _, metric in self.labels})

    def _check_sigma(self, metrics: set[str]) -> None:
        if self.sigma is None:
            if len(metrics) > 1:
                raise ValueError(f"sigma: needed to weigh {', '.join(sorted(metrics))} against each other")
            return
        check_sigma_table(self.sigma, "metrics")
        for metric in sorted(metrics):
            if metric not in self.sigma:
                raise ValueError(f"sigma: none for {metric}")
            check_positive(f"sigma.{metric}", self.sigma[metric], "in the metric's unit")


@dataclasses.dataclass(frozen=True)
class _MetricResiduals:
    """Simulated minus measured metrics. Equal instances compile once."""

    solver: Solver
    shared: tuple[str, ...]
    objectives: tuple[tuple[str, Objective], ...]

    def each(self, part: Part, batches: Any, function: Callable[[PyTree], PyTree]) -> list[PyTree]:
        """Return `function` of the rows of each batch, with the shared parameters taken from `part`."""
        values = {path: get(part, path) for path in self.shared}
        return [Batch(rows).each(loop, lambda row, key: function(replace(row, values))) for loop, rows in batches]

    def __call__(self, part: Part, batches: Sequence[Params], place: Vector, target: Scalar) -> Array:
        def row(loop: Loop) -> Array:
            metrics = measure(loop, self.solver, dict(self.objectives)).metrics
            return jnp.stack([metrics[name] for name, _ in self.objectives])

        simulated = jnp.concatenate(self.each(part, batches, row))
        return simulated[place[:, 0], place[:, 1]] - target
