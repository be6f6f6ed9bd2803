"""Parameters of a loop from measurements: time traces of one or several runs, or tables of what runs were measured at.

    found = identify(loop, Traces(t=t, columns={"wheel_speed": w}, sigma={"wheel_speed": 0.05}),
                     {"plant.inertia": (0.2, 5.0), "plant.road.scale": None}, solver=FixedStep(1e-3, 4.0))

The data are compared with the loop's measured outputs, behind its sensor; nothing is drawn at random. What is fitted,
and how, is in `fit`; what is known afterwards, and what is not, in `uncertainty`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from diffabs.core.bijectors import Range
from diffabs.core.loop import Loop
from diffabs.core.pytree import canonical_dtypes, replace
from diffabs.core.validity import check_part
from diffabs.identify.data import Comparison, Data
from diffabs.identify.fit import Identified, Tolerances, fit
from diffabs.identify.residuals import Prior
from diffabs.simulate.admissible import batch_admissibility
from diffabs.simulate.solution import Solver
from diffabs.simulate.stable_step import stable_steps


def identify(
    loop: Loop,
    data: Data,
    free: Sequence[str] | Mapping[str, Range | None],
    *,
    solver: Solver,
    absolute: bool = True,
    prior: Prior | None = None,
    starts: Sequence[Mapping[str, Any]] = (),
    norm: float = 2.0,
    tolerances: Tolerances | None = None,
    progress: Callable[[int, float], None] | None = None,
    stopping: Callable[[], bool] = lambda: False,
) -> Identified:
    """Return the parameters of a loop, by dotted path, that fit the data best, with their uncertainty.

    data: measured traces, or a table of metrics
    free: paths, with a range each or None for the declared one
    solver: of every run
    absolute, prior, starts, norm, tolerances, progress, stopping: as in `fit`

    A point is rejected where a run diverges, or must not be run: see `batch_admissibility`.

    Raises:
        ValueError: what `fit` and the data object to; a run that must not be run at the start.
    """
    check_part(loop)
    comparison = data.against(loop, list(free), solver)
    _check_starts(loop, starts or ({},), comparison, solver)
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


def _check_starts(loop: Loop, starts: Sequence[Mapping[str, Any]], comparison: Comparison, solver: Solver) -> None:
    """Raises ValueError for a start from which a run must not be run, with the longest step that may."""
    for start in starts:
        if why := _describe_refusal(first := replace(loop, dict(start)), comparison, solver):
            most = min(float(stable_steps(canonical_dtypes(batch)).min()) for batch in comparison.loops(first))
            raise ValueError(f"{why} at the start; at most {most:.2g} s is" if most < solver.step else why)


def _describe_refusal(loop: Any, comparison: Comparison, solver: Solver) -> str | None:
    """Why the first run that must not be run must not."""
    asked = (
        batch_admissibility(None, jax.device_get(canonical_dtypes(batch)), solver) for batch in comparison.loops(loop)
    )
    return next((next(filter(None, found.texts)) for found in asked if found.number), None)
