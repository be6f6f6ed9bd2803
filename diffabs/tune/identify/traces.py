"""Measured signals over time, compared with simulated ones."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import clamp, ratio
from diffabs.core.pytree import canonical_dtypes
from diffabs.core.types import Array, Matrix, Params, Scalar, Table, Vector
from diffabs.engine.solvers import FixedStep, Solver
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.loop.run import rollout
from diffabs.tune.identify.data import Comparison, check_positive, check_sigma_table
from diffabs.tune.identify.fit import Identified

# Parts into which the grid of adaptive steps is divided at most; how near to an instant of the data a grid must come,
# relative to the instant's number.
MAX_GRID_DIVISOR, INSTANT_TOLERANCE = 1000, 1e-9


@dataclasses.dataclass(frozen=True, eq=False)
class Traces:
    """Measured signals over time.

    The simulated signals are those behind the loop's sensor. Each run keeps them at the instants t, whatever
    `solver.every` says. Between the steps of a `FixedStep` they are interpolated linearly. A run that ends before its
    data stays at its last sample. Without the rest, an early end would lower the cost. If the loop's stop ends a run
    that is not at rest, cut longer data with `until`.

    Attributes:
        t: Instants [s] from the start of the run, shape (n,), increasing, not necessarily equally spaced.
        columns: Measured values by the name of a field of the plant's output, shape (n,), or (runs, n) for several
            runs.
        sigma: Standard deviation of each column's noise, in its unit: a number, shape (n,) or (runs, n). None if
            unknown, with one column only.
        over: Parameters that differ between runs, by path, with one row for each run.
        until: Last instant [s] of each run that is compared, a number or shape (runs,). None compares all instants.
    """

    t: Scalar
    columns: Table
    sigma: Table | None = None
    over: Params = dataclasses.field(default_factory=dict)
    until: Scalar | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Number of runs and of instants."""
        return Batch(self.over).size, np.size(self.t)

    def against(self, loop: Loop, free: Sequence[str], solver: Solver) -> Comparison:
        """Return the comparison with runs of the loop.

        Args:
            loop: Loop that is run.
            free: Paths of the free parameters.
            solver: Solver of every run.

        Raises:
            ValueError: A parameter is both free and in `over`, or `t` does not increase within the solver's duration.
            ValueError: A column is not an output, or a shape, a value or sigma is wrong.
        """
        self._check(loop, free, solver)
        compared = np.flatnonzero(self._kept_rows())
        over = {path: np.asarray(rows, float) for path, rows in self.over.items()}
        target = np.concatenate([self._broadcast_column(column) for column in self.columns.values()])[compared]
        weights = self.sigma
        sigma = (
            None
            if weights is None
            else np.concatenate([self._broadcast_column(weights[name]) for name in self.columns])[compared]
        )
        simulated = _TraceResiduals(_keep_instants(solver, np.asarray(self.t, float)), tuple(self.columns))
        return Comparison(
            simulated,
            (over, np.asarray(self.t, float), compared, target),
            sigma,
            lambda part: [Batch(over).each(canonical_dtypes(part), lambda loop, key: loop)],
        )

    def residuals(self, fit: Identified) -> dict[str, np.ndarray]:
        """Return simulated minus measured values of a fit by column, shape (runs, n).

        Instants after `until` are NaN.
        """
        whole = np.full(len(self.columns) * math.prod(self.shape), np.nan)
        whole[np.flatnonzero(self._kept_rows())] = fit.residuals
        return dict(zip(self.columns, whole.reshape(len(self.columns), *self.shape), strict=True))

    def _broadcast_column(self, column: object) -> np.ndarray:
        return np.broadcast_to(np.asarray(column, float), self.shape).ravel()

    def _kept_rows(self) -> np.ndarray:
        until = np.inf if self.until is None else np.asarray(self.until, float)
        compared = np.asarray(self.t, float) <= np.broadcast_to(until, self.shape[:1])[:, None]
        return np.tile(compared.ravel(), len(self.columns))

    def _check(self, loop: Loop, free: Sequence[str], solver: Solver) -> None:
        Batch(self.over).check(loop)
        if both := set(free) & set(self.over):
            raise ValueError(f"{', '.join(sorted(both))}: both free and given for each run (over)")
        t = np.asarray(self.t, float)
        if t.ndim != 1 or not t.size or not np.isfinite(t).all() or not (np.diff(t) > 0).all():
            raise ValueError(f"t has shape {t.shape}; it must be finite numbers in increasing order [s]")
        if t[0] < 0 or t[-1] > solver.duration:
            raise ValueError(f"t = {t[0]:g} ... {t[-1]:g} s leaves [0, {solver.duration:g}] s, the solver's duration")
        if not self.columns or set(self.columns) - set(_output_names(loop)):
            named = ", ".join(self.columns) or "none"
            raise ValueError(f"columns: {named}; there is {', '.join(_output_names(loop))}")
        shapes = (self.shape, self.shape[1:]) if self.shape[0] == 1 else (self.shape,)
        for name, values in self.columns.items():
            column = np.asarray(values, float)
            if column.shape not in shapes:
                needed = " or ".join(map(str, shapes))
                raise ValueError(f"{name} has shape {column.shape}; t and the runs (over) need {needed}")
            bad = ~np.isfinite(column)
            if bad.any():
                first = t[np.nonzero(bad)[-1][0]]
                raise ValueError(
                    f"{name}: {bad.sum()} values are not finite, the first at t = {first:g} s; leave them out"
                )
        self._check_sigma(loop.plant.shows.units)
        if self.until is not None and np.shape(self.until) not in ((), self.shape[:1]):
            raise ValueError(f"until has shape {np.shape(self.until)}; it must be a number [s] or ({self.shape[0]},)")

    def _check_sigma(self, units: Mapping[str, str]) -> None:
        if self.sigma is None:
            if len(self.columns) > 1:
                raise ValueError(f"sigma: needed to weigh {', '.join(self.columns)} against each other")
            return
        check_sigma_table(self.sigma, "columns")
        if set(self.sigma.keys()) != set(self.columns):
            named = ", ".join(self.sigma.keys()) or "no column"
            raise ValueError(f"sigma is that of {named}; the columns are {', '.join(self.columns)}")
        for name, value in self.sigma.items():
            if np.shape(value) not in ((), self.shape[1:], self.shape):
                raise ValueError(f"sigma.{name} has shape {np.shape(value)}, not () or {self.shape}")
            check_positive(f"sigma.{name}", value, units[name])


def _output_names(loop: Loop) -> tuple[str, ...]:
    return jax.eval_shape(
        lambda loop: loop.plant.output(loop.plant.start(loop.initial)), canonical_dtypes(loop)
    )._fields


def _keep_instants(solver: Solver, t: np.ndarray) -> Solver:
    """Return the solver with the fewest kept instants among which are the instants t [s], or the nearest steps.

    Fixed steps stay as they are. The grid of adaptive steps is divided: their interpolation is as exact as the steps.
    """
    divisors = (1,) if isinstance(solver, FixedStep) else range(1, MAX_GRID_DIVISOR + 1)
    for divisor in divisors:
        counts = t * divisor / solver.step
        whole = np.round(counts)
        if (np.abs(counts - whole) <= INSTANT_TOLERANCE * np.maximum(1.0, counts)).all():
            every = math.gcd(*whole.astype(int).tolist()) or 1
            return dataclasses.replace(solver, step=solver.step / divisor, every=every)
    return dataclasses.replace(solver, step=solver.step / divisors[-1], every=1)


@dataclasses.dataclass(frozen=True)
class _TraceResiduals:
    """Simulated minus measured signals. Equal instances compile once."""

    solver: Solver
    fields: tuple[str, ...]

    def __call__(self, loop: object, over: Params, t: Vector, compared: object, target: Scalar) -> Array:
        simulated = Batch(over).each(canonical_dtypes(loop), lambda run_loop, key: self._columns(run_loop, t))
        return jnp.swapaxes(simulated, 0, 1).ravel()[compared] - target

    def _columns(self, loop: Loop, t: Vector) -> Matrix:
        """Return the simulated columns of one run at the instants t, shape (columns, n); NaN if the run diverged."""
        run = rollout(loop, self.solver)
        assert run.trajectory is not None
        times, stride = jnp.asarray(run.trajectory.sample.t), self.solver.step * self.solver.every
        # Kept instants are equally spaced up to the end of the run, so the index needs no search.
        i = jnp.clip(jnp.floor(t / stride).astype(int), 0, len(times) - 2)
        # The last sample repeats after the end of a run. Its zero interval makes `ratio` return 0, not NaN.
        part = clamp(ratio(t - times[i], times[i + 1] - times[i]), 0.0, 1.0)
        columns = [getattr(run.trajectory.measured, name) for name in self.fields]
        values = jnp.stack([x[i] + part * (x[i + 1] - x[i]) for x in columns])
        return jnp.where(run.diverged, jnp.nan, values)
