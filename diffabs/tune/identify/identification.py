"""Identification of a loop's parameters from time traces of one or several runs, or from tables of measured metrics.

    found = identify(loop, Traces(t=t, columns={"wheel_speed": w}, sigma={"wheel_speed": 0.05}),
                     {"plant.inertia": (0.2, 5.0), "plant.road.scale": None}, solver=FixedStep(1e-3, 4.0))

The data are compared with the loop's measured outputs, behind its sensor. No random numbers are drawn. `fit` describes
the cost and the method, `uncertainty` the covariance and the directions that the data leave open.
"""

import decimal
from collections.abc import Callable, Iterable, Mapping, Sequence

import jax

from diffabs.core.bijectors import Range
from diffabs.core.jax_flags import default_flags
from diffabs.core.pytree import canonical_dtypes, replace
from diffabs.core.types import Table
from diffabs.core.validity import check_part
from diffabs.engine.solvers import Solver
from diffabs.loop.admissible import batch_admissibility
from diffabs.loop.closed_loop import Loop
from diffabs.loop.stability import stable_steps
from diffabs.tune.identify.data import Comparison, Data
from diffabs.tune.identify.fit import Identified, Tolerances, fit
from diffabs.tune.identify.residuals import Prior


@default_flags()
def identify(
    loop: Loop,
    data: Data,
    free: Sequence[str] | Mapping[str, Range | None],
    *,
    solver: Solver,
    absolute: bool = True,
    prior: Prior | None = None,
    starts: Iterable[Table] = (),
    norm: float = 2.0,
    tolerances: Tolerances | None = None,
    progress: Callable[[int, float], None] | None = None,
    stopping: Callable[[], bool] = lambda: False,
) -> Identified:
    """Return the parameters of a loop that fit the data best, with their uncertainty.

    A point is rejected if a run diverges or is not admissible: see `batch_admissibility`.

    Args:
        loop: Loop whose parameters are identified.
        data: Measured traces, or a table of metrics.
        free: Dotted paths of the free parameters, each with a range, or with None for the declared range.
        solver: Solver of every run.
        absolute, prior, starts, norm, tolerances, progress, stopping: As in `fit`.

    Raises:
        ValueError: `fit` or the data refuse their arguments, or a run is not admissible at a start.

    See also:
        `identify.Traces`: Measured signals over time.
        `identify.fit`: The same for any residuals.
        `tune.tune`: Parameters by a metric, without data.

    Notes:
        The parameters p minimise

            sum_i |r_i(p)/sigma_i|^norm + sum_j prior_j(p)^2

        with residuals r of model and data. With A = diag(1/sigma) dr/dp their covariance is (A'A/s^2 + P'P)^-1, P =
        d(prior)/dp, where s = 1 if sigma is known absolutely. The Jacobian is exact, by forward differentiation through
        the runs. Sources: M. A. Branch, T. F. Coleman and Y. Li, A subspace, interior, and conjugate gradient method
        for large-scale bound-constrained minimization problems, SIAM J. Sci. Comput. 21 (1999).

    Examples:
        The initial speed of a locked wheel, from its speed over half a second with a deviation of 0.05 m/s:

        >>> import diffabs as d
        >>> from diffabs import controllers, stops
        >>> from diffabs.tune import identify
        >>> parts = {"initial": d.BrakeStart(speed=10.0, slip=1.0), "stop": stops.SpeedReached(speed=5.0)}
        >>> loop = d.braking(controller=controllers.ConstantTorque(torque=500.0), **parts)
        >>> solver = d.FixedStep(1e-2, 0.5)
        >>> sample = d.rollout(loop, solver).trajectory.sample
        >>> data = identify.Traces(t=sample.t, columns={"speed": sample.output.speed}, sigma={"speed": 0.05})
        >>> guess = d.replace(loop, {"initial.speed": 9.0})
        >>> fitted = identify.identify(guess, data, {"initial.speed": (6.0, 14.0)}, solver=solver)
        >>> print(f"{fitted.values['initial.speed']:.2f} +- {fitted.uncertainty.deviations['initial.speed']:.3f} m/s")
        10.00 +- 0.007 m/s
    """
    check_part(loop)
    comparison = data.against(loop, list(free), solver)
    starts = tuple(starts)
    for start in starts or ({},):
        if why := _describe_refusal(first := replace(loop, dict(start)), comparison, solver):
            if why.endswith("is not stable"):  # the step is too long: the message gives the longest stable one
                step = min(float(stable_steps(canonical_dtypes(batch)).min()) for batch in comparison.loops(first))
                # Rounded down: the printed step must be stable, too.
                longest = decimal.Context(prec=3, rounding=decimal.ROUND_FLOOR).create_decimal(step)
                why += f" at the start; the longest stable step there is {longest} s"
            raise ValueError(why)
    return fit(
        loop,
        free,
        comparison.residuals,
        data=comparison.data,
        sigma=comparison.sigma,
        absolute=absolute,
        prior=prior,
        starts=starts,
        norm=norm,
        tolerances=tolerances,
        usable=lambda part: _describe_refusal(part, comparison, solver) is None,
        progress=progress,
        stopping=stopping,
    )


def _describe_refusal(loop: object, comparison: Comparison, solver: Solver) -> str | None:
    """Return the reason why the first refused run is not admissible, or None if all runs are."""
    verdicts = (
        batch_admissibility(None, jax.device_get(canonical_dtypes(batch)), solver) for batch in comparison.loops(loop)
    )
    return next((next(filter(None, verdict.texts)) for verdict in verdicts if verdict.number), None)
