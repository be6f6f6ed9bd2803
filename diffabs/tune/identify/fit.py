"""Nonlinear least squares over parameters of any part, given by dotted path.

    minimise  sum_i |r_i(part)/sigma_i|^norm + sum_j prior_j(part)^2

The fit works in the unbounded coordinates z of `parameter_space`, so no step leaves a parameter's range. SciPy's
trust-region reflective method minimises the cost. The Jacobian is computed in forward mode, through events and stops.

A norm of 2 is least squares. A norm of 8 or more approaches the minimum of the largest residual. A point with a number
that is not finite is rejected, and the trust region shrinks.

Source: M. A. Branch, T. F. Coleman and Y. Li, SIAM J. Sci. Comput. 21 (1999).
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from diffabs.core.bijectors import FreeSpace, HalfLine, Range, parameter_space
from diffabs.core.jax_flags import default_flags
from diffabs.core.pytree import canonical_dtypes, parameters, replace
from diffabs.core.reason import Reason
from diffabs.core.summary import Summary, round_for_table
from diffabs.core.types import AnyArray, JsonObject, Part, PyTree, Table
from diffabs.core.validity import check_part
from diffabs.host.interactive import ProgressLine, report_to
from diffabs.tune.identify.residuals import FitProblem, Prior, ResidualEvaluation, Residuals, as_partial, check_prior
from diffabs.tune.identify.uncertainty import Uncertainty, uncertainty

HIGH_CORRELATION = 0.95  # of two values, above which a record names them
END_COORDINATE = 7.0  # |z| beyond which a value may be held: exp(-7) of the range, or of the start's distance
MAX_END_DISTANCE = 0.01  # of a held value from its end, in standard deviations with the others fixed

SCIPY_REASONS = {0: Reason.LIMIT, 1: Reason.GRADIENT, 2: Reason.CHANGE, 3: Reason.CHANGE, 4: Reason.CHANGE}


@dataclasses.dataclass(frozen=True)
class Tolerances:
    """Stopping criteria of a fit, for each start; one of them is enough.

    Attributes:
        cost: Relative change of the cost.
        step: Relative change of the unbounded coordinates z.
        gradient: Largest component of the scaled gradient.
        evaluations: Maximum number of evaluations, rejected points included.
    """

    cost: float = 1e-10
    step: float = 1e-10
    gradient: float = 1e-10
    evaluations: int = 100


@dataclasses.dataclass(frozen=True, eq=False)
class Identified:
    """The best fit, with its uncertainty.

    Attributes:
        part: The given part with its free parameters changed.
        values: Values of the free parameters by path.
        residuals: Residuals in their own units, shape (n,).
        sigma: Given standard deviations of the residuals, shape (n,); ones if none were given.
        chi2: sum (residual/sigma)^2.
        cost: Minimised value: sum |residual/sigma|^norm plus the sum of the squared prior terms.
        uncertainty: Covariance, standard deviations, correlation, and the directions that the data do not determine. It
            is always that of least squares at this point, for every norm.
        history: Cost at the start and after every accepted step.
        evaluations: Number of evaluations from this start, rejected points included.
        reason: Reason for the end of the iteration.
        start: Values at the start by path.
        starts: Fits from all usable starts, in their order.
        diverged: Values by path of each start that could not be used.
        ends: End of the range by name, for each parameter that the end holds. Such a parameter has no standard
            deviation.
    """

    part: Part
    values: JsonObject
    residuals: np.ndarray
    sigma: np.ndarray
    chi2: float
    cost: float
    uncertainty: Uncertainty
    history: list[float]
    evaluations: int
    reason: Reason
    start: JsonObject
    starts: tuple["Identified", ...] = ()
    diverged: tuple[JsonObject, ...] = ()
    ends: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def table(self) -> Summary:
        """Return a table of the parameters before and after the fit, with their standard deviations.

        A parameter without a meaningful deviation has a word instead: "end of range" or "undetermined". The note below
        the table explains it.
        """
        numbers = zip(
            *(np.concatenate([np.ravel(x) for x in at.values()]) for at in (self.start, self.values)), strict=True
        )
        names = self.uncertainty.names
        rows = tuple((name, *pair, self.describe_deviation(name)) for name, pair in zip(names, numbers, strict=True))
        title = (
            f"Identified from {len(self.residuals)} residuals, chi2 = {round_for_table(self.chi2)}: {self.reason.value}"
        )
        return Summary(title, ("parameter", "before", "identified", "standard deviation"), rows, self.describe_limits())

    def describe_deviation(self, name: str) -> float | str:
        """Return the standard deviation of a parameter, or "end of range" or "undetermined" if it has none.

        Args:
            name: Name of the parameter, one of the uncertainty's.
        """
        if name in self.ends:
            return "end of range"
        return (
            "undetermined" if name in self.uncertainty.undetermined_parameters() else self.uncertainty.deviations[name]
        )

    def describe_limits(self) -> str:
        """Return one line for each parameter at an end of its range and each undetermined direction; or nothing."""
        ends = [
            f"{name} is at the end {round_for_table(end)} of its range, so it has no standard deviation; those of"
            " the others are for this value"
            for name, end in self.ends.items()
        ]
        open_ = [
            f"the data do not determine {direction.describe()} (relative changes)"
            for direction in self.uncertainty.undetermined_directions()
        ]
        return "\n".join([*ends, *open_])

    def record(self, before: Part, free: Mapping[str, Range | None]) -> JsonObject:
        """Return the fit as JSON values.

        `values` has a row for each number: a list `controller.gain` gives `controller.gain.0` and so on. A number
        without a meaningful `deviation` has the reason as `why`. `correlations` are those above 0.95.

        Args:
            before: Part or loop before the fit.
            free: Ranges of the free parameters, as given to the fit.
        """
        uncertainty = self.uncertainty
        pairs = [(i, j) for i in range(len(uncertainty.names)) for j in range(i)]
        return {
            "values": dict(self._value_records(before, free)),
            "correlations": [
                {
                    "between": [uncertainty.names[i], uncertainty.names[j]],
                    "correlation": float(uncertainty.correlation[i, j]),
                }
                for i, j in pairs
                if abs(uncertainty.correlation[i, j]) > HIGH_CORRELATION
            ],
            "notes": self.describe_limits().splitlines(),
            "undetermined": [
                {"direction": direction.describe(), "spread": direction.spread, "components": direction.components}
                for direction in uncertainty.undetermined_directions()
            ],
            "chi2": self.chi2,
            "degrees": uncertainty.degrees,
            "scale": uncertainty.scale,
            "reason": self.reason.value,
            "evaluations": self.evaluations,
            "parameters": {path: np.asarray(v, float).tolist() for path, _, v in parameters(self.part)},
        }

    def _value_records(self, before: Part, free: Mapping[str, Range | None]) -> Iterator[tuple[str, JsonObject]]:
        present = {path: (spec, value) for path, spec, value in parameters(before)}
        for path, ends in free.items():
            spec, value = present[path]
            rows = (value, self.values[path], *(ends or (spec.low, spec.high)))
            columns = np.broadcast_arrays(*(np.asarray(row, float) for row in rows))
            for at in np.ndindex(columns[0].shape):
                name = ".".join([path, *map(str, at)])
                numbers = zip(
                    ("before", "value", "low", "high"), (float(column[at]) for column in columns), strict=True
                )
                deviation = self.describe_deviation(name)
                why = {"deviation": None, "why": deviation} if isinstance(deviation, str) else {"deviation": deviation}
                yield name, dict(numbers) | why | {"unit": spec.unit}

    def __repr__(self) -> str:
        """Return the table as text."""
        return str(self.table())

    def _repr_html_(self) -> str:
        return self.table()._repr_html_()


@default_flags()
def fit(
    part: object,
    free: Sequence[str] | Mapping[str, Range | None],
    residuals: Residuals,
    *,
    data: tuple[PyTree, ...] = (),
    sigma: AnyArray | None = None,
    absolute: bool = True,
    prior: Prior | None = None,
    starts: Iterable[Table] = (),
    norm: float = 2.0,
    tolerances: Tolerances | None = None,
    usable: Callable[[PyTree], bool] | None = None,
    progress: Callable[[int, float], None] | None = None,
    stopping: Callable[[], bool] = lambda: False,
) -> Identified:
    """Return the free parameters of a part that minimise the weighted residuals, with their uncertainty.

    Args:
        part: Part or loop whose parameters are fitted.
        free: Paths of the free parameters, each with a range, or with None for the declared range.
        residuals: JAX function residuals(part, *data) that returns shape (n,).
        data: Arrays that are passed to `residuals`. Other arrays of the same shapes do not compile again.
        sigma: Standard deviations of the residuals, a number or shape (n,). Without it all residuals have equal weight,
            and they estimate the variance s^2 of one residual.
        absolute: False if only the ratios of sigma are known. The residuals then estimate a factor s^2 of all
            variances.
        prior: JAX function of the part that returns deviations from prior knowledge, in standard deviations. `gaussian`
            makes one; a roughness penalty is another. Arguments in a `jax.tree_util.Partial` are traced. A prior needs
            a sigma that is known absolutely.
        starts: For each start, initial values by path; empty for one start from the part's own. The fit with the lowest
            cost is returned.
        norm: Exponent of the weighted residuals, >= 2: 2 is least squares, larger ones approach the largest residual.
        tolerances: Stopping criteria of each start, with the maximum number of evaluations.
        usable: Function of a part that returns whether it may be evaluated; it runs outside jit.
        progress: Called at each start and accepted point, with the number of evaluations over all starts so far and the
            cost. None shows a line in a notebook and in an interactive session.
        stopping: Called before every evaluation. True ends the fit at the last accepted point and skips further starts.

    Raises:
        ValueError: A path, a range or the shape of sigma does not fit, sigma is not positive and finite, or norm is
            outside [2, inf).
        ValueError: There are fewer residuals than parameters (without an absolute sigma: than parameters + 1) and no
            prior.
        ValueError: There is a prior, but no sigma that is known absolutely. Or the prior is that of `gaussian`, and one
            of its parameters is not free.
        ValueError: No start can be used: at each one a residual or derivative is not finite, or `usable` returns False.
    """
    part = canonical_dtypes(check_part(part))
    where = parameter_space(part, free)
    points = [where.place(check_part(replace(part, dict(start)))) for start in starts] or [where.place(part)]
    problem = FitProblem(where, part, residuals, data, as_partial(prior), norm, usable)
    n, k = problem.shapes()
    if sigma is not None:
        sigmas = np.asarray(sigma, float)
        if sigmas.shape not in ((), (n,)):
            raise ValueError(f"sigma has shape {sigmas.shape}; {n} residuals need a number or ({n},)")
        if not (np.isfinite(sigmas) & (sigmas > 0)).all():
            raise ValueError(f"sigma = {np.min(sigmas):g} is not positive and finite")
    estimated = sigma is None or not absolute
    if k and estimated:
        needed = "sigma" if sigma is None else "sigma with absolute = True"
        raise ValueError(f"a prior needs {needed}: nothing else says how much the data weigh against it")
    check_prior(prior, [entry.path for entry in where.entries])
    if n < where.size + estimated and not (k and n > 0):  # a prior makes up for missing data
        more = " and one more for the estimate of s^2" if estimated else ""
        raise ValueError(f"{n} data do not determine {where.size} parameters{more}: free fewer, or state a prior")
    if not 2 <= norm < np.inf:
        raise ValueError(f"norm = {norm:g} is outside [2, inf)")
    deviations = np.broadcast_to(np.asarray(1.0 if sigma is None else sigma, float), (n,))
    tolerances = tolerances or Tolerances()
    fits: list[Identified | None] = []
    with ProgressLine() as line:
        watch = _FitMonitor(report_to(line, progress, _describe_progress) or (lambda _, __: None), stopping)
        for z in points:
            # An interruption skips further starts only if there is a fit to return.
            if not (any(fits) and watch.stopping()):
                fits.append(_fit_start(problem, z, deviations, estimated, tolerances, watch))
    finished = tuple(candidate for candidate in fits if candidate is not None)
    if not finished:
        causes = "the run diverges, slides along a switching surface, or its step is not stable"
        raise ValueError(f"{causes}, at each of the {len(fits)} starts")
    diverged = tuple(_values_by_path(where, z) for z, candidate in zip(points, fits, strict=False) if candidate is None)
    return dataclasses.replace(min(finished, key=lambda candidate: candidate.cost), starts=finished, diverged=diverged)


def _describe_progress(evaluations: int, cost: float) -> str:
    return f"identification: {evaluations} evaluations, cost {cost:.6g}"


class _FitInterrupted(Exception):
    """The signal that ends SciPy's iteration when `stopping` returns True."""


@dataclasses.dataclass
class _FitMonitor:
    """The callbacks of a fit, and the number of evaluations of earlier starts."""

    progress: Callable[[int, float], None]
    stopping: Callable[[], bool]
    before: int = 0


def _fit_start(
    problem: FitProblem,
    start: np.ndarray,
    sigma: np.ndarray,
    estimated: bool,
    tolerances: Tolerances,
    watch: _FitMonitor,
) -> Identified | None:
    """Return the fit from one start, or None if the start cannot be used."""
    problem.evaluations, problem.last = 0, None
    first = problem.at(start)
    if first is None:
        return None
    # A residual that is not finite makes SciPy reject the step and shrink its trust region.
    rejected = np.full(len(problem.vector(first, sigma)), np.nan)
    history, accepted = [], [start]

    def value(z: np.ndarray) -> np.ndarray:
        if watch.stopping():
            raise _FitInterrupted
        evaluation = problem.at(z)
        return rejected if evaluation is None else problem.vector(evaluation, sigma)

    # SciPy calls for the Jacobian at the start and at accepted points only, so this function records the history.
    def jacobian(z: np.ndarray) -> np.ndarray:
        evaluation = _accepted_evaluation(problem, z)
        history.append(float(np.sum(problem.vector(evaluation, sigma) ** 2)))
        accepted.append(z.copy())
        watch.progress(watch.before + problem.evaluations, history[-1])
        return problem.jacobian(evaluation, sigma)

    try:
        solution = least_squares(
            value,
            start,
            jacobian,  # pyright: ignore[reportArgumentType]  # SciPy's stub infers a string from the default
            method="trf",
            x_scale="jac",
            ftol=tolerances.cost,
            xtol=tolerances.step,
            gtol=tolerances.gradient,
            max_nfev=tolerances.evaluations,
        )
        end, reason = solution.x, SCIPY_REASONS[solution.status]
    except _FitInterrupted:
        end, reason = accepted[-1], Reason.INTERRUPTED
    # Read the count first: the final point may be computed once more below, which is no evaluation of the fit.
    evaluations = problem.evaluations
    watch.before += evaluations
    evaluation = _accepted_evaluation(problem, end)
    parameter_uncertainty, ends = _parameter_uncertainty(problem.space, end, evaluation, sigma, estimated)
    return Identified(
        part=jax.tree.map(np.asarray, problem.space.at(problem.part, jnp.asarray(end))),
        values=_values_by_path(problem.space, end),
        residuals=evaluation.residuals,
        sigma=sigma,
        chi2=float(np.sum((evaluation.residuals / sigma) ** 2)),
        cost=float(np.sum(problem.vector(evaluation, sigma) ** 2)),
        uncertainty=parameter_uncertainty,
        history=history,
        evaluations=evaluations,
        reason=reason,
        start=_values_by_path(problem.space, start),
        ends=ends,
    )


def _accepted_evaluation(problem: FitProblem, z: np.ndarray) -> ResidualEvaluation:
    """Return the evaluation of an accepted point; compute it again if the cache holds another point."""
    evaluation = problem.at(z)
    if evaluation is None:
        raise RuntimeError("an accepted point is not finite when it is computed again")
    return evaluation


def _parameter_uncertainty(
    free: FreeSpace, z: np.ndarray, evaluation: ResidualEvaluation, sigma: np.ndarray, estimated: bool
) -> tuple[Uncertainty, dict[str, float]]:
    """Return the uncertainty in the parameters themselves, and the end by name of each parameter that an end holds.

    Each parameter has its own z, so dr/dp = dr/dz / (dp/dz).
    """
    maps = [m for entry in free.entries for m in entry.maps]
    slope = np.array([float(jax.grad(m.value)(x)) for m, x in zip(maps, z, strict=True)])
    values = np.concatenate([np.ravel(x) for x in _values_by_path(free, z).values()])
    chi2 = float(np.sum((evaluation.residuals / sigma) ** 2))
    # An exact fit has s = 0; the smallest normal number avoids 0/0 below.
    scale = (float(np.sqrt(chi2 / (len(sigma) - free.size))) if estimated else 1.0) or float(np.finfo(float).tiny)
    size = np.maximum(np.abs(values), np.abs(slope))
    over = np.divide(1.0, slope, out=np.zeros_like(slope), where=slope != 0)
    data, prior = evaluation.slopes[0] / sigma[:, None] * over, evaluation.slopes[1] * over
    ends = _find_ends(free, z, values, np.linalg.norm(np.concatenate([data / scale, prior]), axis=0))
    return uncertainty(free.names, size, data, prior, scale, held=ends), ends


def _find_ends(free: FreeSpace, z: np.ndarray, values: np.ndarray, slopes: np.ndarray) -> dict[str, float]:
    """Return the end of the range by name, for each parameter that the end holds.

    The coordinate z goes far out to the side of the end. The end is within a hundredth of the deviation that the
    parameter has with the others fixed. An interior minimum counts as held only if almost half of its interval lies
    beyond the end.

    Args:
        slopes: Inverse of the standard deviation of each parameter with the others fixed, shape (p,).
    """
    ends = {}
    maps = [m for entry in free.entries for m in entry.maps]
    for name, m, place, value, slope, limits in zip(free.names, maps, z, values, slopes, free.ranges, strict=True):
        end = min(limits, key=lambda x: abs(x - value))
        # On a half line z goes to -inf at the end, and the scale is the distance of the start from it.
        far = -place if isinstance(m, HalfLine) else abs(place)
        size = abs(m.scale) if isinstance(m, HalfLine) else limits[1] - limits[0]
        # Without influence on the data any value is as good, so the end does not hold it.
        if far > END_COORDINATE and slope * size > 1 and abs(value - end) * slope < MAX_END_DISTANCE:
            ends[name] = float(end)
    return ends


def _values_by_path(free: FreeSpace, z: np.ndarray) -> JsonObject:
    return {path: np.asarray(value) for path, value in free.values(jnp.asarray(z)).items()}
