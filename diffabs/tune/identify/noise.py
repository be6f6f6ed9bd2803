"""Identification from one measured run whose noise is unknown: the residuals of a fit give the noise of the next."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from diffabs.core.bijectors import Range
from diffabs.core.types import JsonObject, Table
from diffabs.engine.solvers import Solver
from diffabs.loop.closed_loop import Loop
from diffabs.tune.identify.fit import Identified
from diffabs.tune.identify.identification import identify
from diffabs.tune.identify.traces import Traces

ROUNDS = 3  # fits; each estimates unknown noise from the residuals of the previous fit
MIN_RELATIVE_NOISE = 1e-6  # of a column's spread: a lower bound of estimated noise
MAX_INSTANTS = 20_000  # of a simulated trajectory
FILE_ROUNDING = 1e-11  # relative, of an instant in a file of `simulate --csv`
SPARE_STEPS = 2  # so that the run covers the last instant of the data


def identify_with_noise(
    loop: Loop,
    t: np.ndarray,
    columns: Mapping[str, np.ndarray],
    free: Mapping[str, Range | None],
    *,
    solver: Solver,
    sigma: Mapping[str, float] | None = None,
    progress: Callable[[int, float], None] | None = None,
    stopping: Callable[[], bool] = lambda: False,
) -> tuple[Identified, dict[str, float]]:
    """Return the fit of one measured run, and the standard deviation of each column's noise.

    An unknown deviation starts as the spread of its column. It then becomes the root mean square of the column's
    residuals, over three fits in all.

    Args:
        t: Instants [s] from the start of the run, shape (n,).
        columns: Measured values by the name of a field of the plant's output, shape (n,).
        free: Range of each free parameter by path; None for the declared range.
        solver: Solver, whose steps are shortened to the end of the data.
        sigma: Known standard deviations by column.
        progress, stopping: As in `fit`.

    Raises:
        ValueError: `identify` refuses its arguments.
    """
    known_noise = dict(sigma or {})
    solver, t = match_times(solver, t)

    def fit_traces(
        noise: Mapping[str, float], starts: Sequence[Table] = (), absolute: bool = bool(known_noise)
    ) -> tuple[Identified, dict[str, np.ndarray]]:
        traces = Traces(t=t, columns=columns, sigma=noise)
        options = {"solver": solver, "absolute": absolute, "starts": starts}
        fit = identify(loop, traces, dict(free), **options, progress=progress, stopping=stopping)
        return fit, traces.residuals(fit)

    spread = {name: float(np.std(values)) or 1.0 for name, values in columns.items()}
    noise = {**spread, **known_noise}
    fit, residuals = fit_traces(noise)
    evaluations = fit.evaluations
    # Weights by residuals change the fit, and the fit its residuals: iterate a few times from the last values.
    for _ in range(0 if len(known_noise) == len(columns) else ROUNDS - 1):
        if stopping():
            break
        noise_floors = {name: MIN_RELATIVE_NOISE * size for name, size in spread.items()}
        residual_noise = {name: root_mean_square(values) for name, values in residuals.items()}
        noise = {name: known_noise.get(name) or max(residual_noise[name], noise_floors[name]) for name in columns}
        # Residuals below the bound are errors of the solver and of the search, not noise: they do not scale the bound.
        exact = any(residual_noise[name] < noise_floors[name] for name in columns if name not in known_noise)
        # A value at an end of its range cannot be moved from there: the scenario's own values are the start again.
        fit, residuals = fit_traces(noise, [] if fit.ends else [fit.values], bool(known_noise) or exact)
        evaluations += fit.evaluations
    return dataclasses.replace(fit, evaluations=evaluations), noise


def match_times(solver: Solver, t: np.ndarray) -> tuple[Solver, np.ndarray]:
    """Return a solver whose whole steps cover the instants `t`, but not more steps than the given solver's, and `t`.

    The solver keeps at most `MAX_INSTANTS` instants. The last instant becomes its end if it exceeds that only by the
    rounding of a file.
    """
    steps = min(math.ceil(float(t[-1]) / solver.step) + SPARE_STEPS, solver.steps)
    end = steps * solver.step
    solver = dataclasses.replace(solver, duration=end, every=max(1, math.ceil(steps / MAX_INSTANTS)))
    # A file has an instant in 12 digits, and the product of the steps may be less than the duration by a rounding.
    return solver, np.where(t <= end * (1 + FILE_ROUNDING), np.minimum(t, end), t)


def describe_residuals(fit: Identified, sigma: Mapping[str, float], units: Mapping[str, str]) -> JsonObject:
    """Return statistics of simulated minus measured by column, whose deviations `sigma` are in the order of the fit."""
    residuals = np.split(np.asarray(fit.residuals), len(sigma))
    return {
        name: {
            "sigma": sigma[name],
            "rms": root_mean_square(values),
            "mean": float(np.mean(values)),
            "largest": float(np.max(np.abs(values))),
            "unit": units[name],
        }
        for name, values in zip(sigma, residuals, strict=True)
    }


def root_mean_square(values: np.ndarray) -> float:
    """Return the root of the mean of the squares."""
    return float(np.sqrt(np.mean(np.square(values))))
