"""Parameters of a loop from measurements: time traces of one or several runs, or tables of what runs were measured at.

    found = identify(loop, Traces(t=t, columns={"wheel_speed": w}, sigma={"wheel_speed": 0.05}),
                     {"plant.inertia": (0.2, 5.0), "plant.road.scale": None}, solver=FixedStep(1e-3, 4.0))

The data are compared with the loop's measured outputs, behind its sensor; nothing is drawn at random. What is fitted,
and how, is in `fit`; what is known afterwards, and what is not, in `uncertainty`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from diffabs.loop import Loop
from diffabs.pytree import check, replace, strong
from diffabs.rollout import FixedStep
from diffabs.stability import stable_steps
from diffabs.tune.comparison import Data
from diffabs.tune.fit import Identified, Tolerances, fit
from diffabs.tune.space import Range
from diffabs.tune.squares import Prior


def identify(
    loop: Loop,
    data: Data,
    free: Sequence[str] | Mapping[str, Range | None],
    *,
    solver: FixedStep,
    absolute: bool = True,
    prior: Prior | None = None,
    starts: Sequence[Mapping[str, Any]] = (),
    norm: float = 2.0,
    tolerances: Tolerances | None = None,
    progress: Callable[[int, float], None] | None = None,
    stopping: Callable[[], bool] = lambda: False,
) -> Identified:
    """Fit free parameters of a loop, by dotted path, to data. The other arguments are those of `fit`.

    A point is rejected where the run diverges and where `solver.step` is not stable.

    Raises:
        ValueError: what `fit` and the data object to; a step that is not stable at the start.
    """
    check(loop)
    against = data.against(loop, list(free), solver)

    def limit(part: Any) -> float:
        return min(float(stable_steps(strong(batch)).min()) for batch in against.loops(part))

    for start in starts or ({},):
        if limit(replace(loop, dict(start))) < solver.step:
            most = limit(replace(loop, dict(start)))
            raise ValueError(f"solver.step = {solver.step:g} s is not stable at the start; at most {most:.2g} s is")
    return fit(
        loop,
        free,
        against.residuals,
        data=against.data,
        sigma=against.sigma,
        absolute=absolute,
        prior=prior,
        starts=starts,
        norm=norm,
        tolerances=tolerances,
        usable=lambda part: limit(part) >= solver.step,
        progress=progress,
        stopping=stopping,
    )
