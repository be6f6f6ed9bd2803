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
from diffabs.core.loop import Loop
from diffabs.core.pytree import canonical_dtypes, replace
from diffabs.core.types import Part, Table
from diffabs.core.validity import check_part
from diffabs.identify.data import Comparison, Data
from diffabs.identify.fit import Identified, Tolerances, fit
from diffabs.identify.residuals import Prior
from diffabs.simulate.admissible import batch_admissibility
from diffabs.simulate.stability import stable_steps
from diffabs.simulate.types import Solver


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


def _describe_refusal(loop: Part, comparison: Comparison, solver: Solver) -> str | None:
    """Return the reason why the first refused run is not admissible, or None if all runs are."""
    verdicts = (
        batch_admissibility(None, jax.device_get(canonical_dtypes(batch)), solver) for batch in comparison.loops(loop)
    )
    return next((next(filter(None, verdict.texts)) for verdict in verdicts if verdict.number), None)
