"""The other controllers: published gain, robust designs, first cure, sliding mode, and a PI tuned without gradients."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import cma
import numpy as np
from scipy.optimize import minimize

from diffabs import Loop, replace
from diffabs.core.bijectors import parameter_space
from diffabs.linear.slip_model import SlipModel
from diffabs.papers import lmi_design
from diffabs.parts.controllers import PID, BackCalculation, ProportionalFeedback, SlidingMode, StateFeedback
from diffabs.parts.references import FilteredSlip
from diffabs.parts.roads import RIG
from diffabs.robust.design import Spec, design
from diffabs.robust.design.parameter_box import polytope
from diffabs.robust.design.spec import L2Gain
from diffabs.robust.design.synthesis import DesignError
from diffabs.scenario.scenario import load
from experiments.real_rig.box import INERTIA, KMH, Box, Fixed, spread
from experiments.real_rig.floor import floor
from experiments.real_rig.judge import Judging, runs
from experiments.real_rig.loops import loop


@dataclasses.dataclass(frozen=True)
class Others:
    """Every number of the comparison."""

    lanes: int = 1024  # of a search without gradients, and of the choice among designs
    evaluations: int = 240  # of a search: as many runs as the gradients took
    weights: tuple[tuple[float, ...], tuple[float, ...]] = ((1e2, 1e4, 1e6, 1e8), (1.0, 1e2, 1e4))  # of the LMI
    decays: tuple[float, ...] = (5.0, 10.0, 20.0, 40.0)  # 1/s
    bounds: tuple[float, ...] = (0.2, 0.1, 0.05, 0.03)  # 1/(N m), from a torque that disturbs to the slip error
    pi: tuple[float, float] = (100.0, 500.0)  # kp, ki, start
    pi_ranges: tuple[tuple[float, float], tuple[float, float]] = ((5.0, 500.0), (1.0, 2e4))
    sliding: tuple[float, float] = (5.0, 0.1)  # gain, boundary, start
    sliding_ranges: tuple[tuple[float, float], tuple[float, float]] = ((0.5, 20.0), (0.01, 0.5))
    tracking_time: float = 0.05  # s
    level: float = 0.95
    seed: int = 19


class Score:
    """The tuning's objective of a loop, on the rig with its quantisation. It counts the runs.

    It is the CVaR over the box of IAE plus the overshoot above its floor, or plus the deviation to both sides.
    """

    def __init__(self, config: Others, box: Box, fixed: Fixed, speed: str, weights: Any, judging: Judging):
        """On so many points, spread evenly. `weights`: of IAE, and of "overshoot" or "deviation"."""
        self.points = spread(box, speed, config.lanes, config.seed)
        self.weights, self.judging, self.config, self.rollouts = weights, judging, config, 0
        two_sided = "deviation" in weights
        self.floors = weights["deviation" if two_sided else "overshoot"] * floor(
            self.points, speed, fixed, two_sided=two_sided
        )

    def __call__(self, loop: Loop) -> float:
        """Of a loop; a great number where a run diverges."""
        metrics = runs(loop, self.points, self.judging, self.config.seed)
        self.rollouts += self.config.lanes
        each = sum(weight * metrics[name] for name, weight in self.weights.items()) - self.floors
        each = np.sort(np.nan_to_num(each, nan=1e3, posinf=1e3))
        tail = each[-int(np.ceil(len(each) * (1 - self.config.level))) :]
        return float(tail.mean())


Free = dict[str, Any]


def nelder_mead(score: Score, loop: Loop, free: Free, config: Others) -> Loop:
    """Nelder and Mead's search in the coordinates of `tune`."""
    coordinates = parameter_space(loop, free)
    options = {"maxfev": config.evaluations, "xatol": 1e-4, "fatol": 1e-6}
    minimum = minimize(
        lambda z: score(_at(loop, coordinates, z)), coordinates.place(loop), method="Nelder-Mead", options=options
    )
    return _at(loop, coordinates, minimum.x)


def cma_es(score: Score, loop: Loop, free: Free, config: Others) -> Loop:
    """CMA-ES in the coordinates of `tune`."""
    coordinates = parameter_space(loop, free)
    options = {"maxfevals": config.evaluations, "verbose": -9, "seed": config.seed, "verb_log": 0}
    search = cma.CMAEvolutionStrategy(coordinates.place(loop), 0.5, options)
    while not search.stop():
        population = search.ask()
        search.tell(population, [score(_at(loop, coordinates, z)) for z in population])
    return _at(loop, coordinates, search.result.xbest)


def _at(loop: Loop, coordinates: Any, z: Any) -> Loop:
    return replace(loop, {path: np.asarray(value) for path, value in coordinates.values(z).items()})


def designs(config: Others, box: Box, fixed: Fixed) -> dict[str, list[np.ndarray]]:
    """Return gains of the package's robust designs, for a grid of their free settings.

    `wide` also has friction (height and place), inertia, and the speed's error as ranges. The error is one of the
    input's gain.
    """
    speeds = (fixed.end / KMH, box.speed[1] / KMH)
    narrow = {"plant.mass": box.mass, "speed": speeds}
    factor = 1 + box.first[1]
    wide = narrow | {
        "plant.wheel_inertia": (INERTIA * box.inertia[0] / factor, INERTIA * box.inertia[1] * factor),
        "plant.road.w4": tuple(RIG.w4 * x for x in box.height),
        "plant.road.a": tuple(RIG.a * x**RIG.q for x in box.place),
    }
    model = SlipModel(slip=fixed.slip)
    plain, ranged = polytope(model, narrow), polytope(model, wide)
    lq = [Spec(Q=q, R=1.0) for q in itertools.product(*config.weights)]
    fast = [Spec(Q=(1e4, 1e2), R=1.0, decay=rate) for rate in config.decays]
    specs = [Spec(Q=(1e4, 1e2), R=1.0, l2=L2Gain(output=[[0.0, 1.0]], bound=bound)) for bound in config.bounds]
    return {
        "LMI": list(_gains(plain, lq)),
        "LMI, wide": list(_gains(ranged, lq)),
        "decay, wide": list(_gains(ranged, fast)),
        "H-infinity, wide": list(_gains(ranged, specs)),
    }


def _gains(system: Any, specs: list[Spec]) -> Iterator[np.ndarray]:
    for spec in specs:
        try:
            yield np.asarray(design(system, spec).gain[0])
        except DesignError:
            continue


def contenders(
    config: Others,
    fixed: Fixed,
    speed: str,
    robust: dict[str, list[np.ndarray]],
    estimator: Any,
    score: Score,
    report: Callable[[str], None],
) -> dict[str, tuple[Loop, int]]:
    """Return loops by name, and the number of runs behind each. `robust`: the gains of `designs`."""

    def feedback(gain: Any) -> Loop:
        return loop(fixed, StateFeedback(gain=np.asarray(gain, float)), speed, estimator=estimator)

    results: dict[str, tuple[Loop, int]] = {"published gain": (feedback(lmi_design.PUBLISHED_GAIN), 0)}
    for name, gains in robust.items():
        score.rollouts = 0
        loops = [feedback(gain) for gain in gains]
        if loops:
            results[f"{name}, best of {len(loops)}"] = (
                loops[int(np.argmin([score(candidate) for candidate in loops]))],
                score.rollouts,
            )
        report(name)
    cured: Any = load("slip-cured", integrated=False).loop
    target = FilteredSlip(slip=fixed.slip, time_constant=cured.reference.time_constant)
    first = ProportionalFeedback(gain=np.asarray(cured.controller.controller.gain, float))
    results["first cure"] = (loop(fixed, first, speed, target, estimator), 0)
    searches = {
        "PI, Nelder-Mead": (nelder_mead, *proportional_integral(config)),
        "PI, CMA-ES": (cma_es, *proportional_integral(config)),
        "sliding mode, CMA-ES": (cma_es, *sliding(config)),
    }
    for name, (search, controller, free) in searches.items():
        score.rollouts = 0
        candidate = loop(fixed, controller, speed, estimator=estimator)
        results[name] = (search(score, candidate, free, config), score.rollouts)
        report(name)
    return results


def proportional_integral(config: Others) -> tuple[PID, Free]:
    """Return the start of the PI's search, and its ranges."""
    pi = PID(
        kp=config.pi[0],
        ki=config.pi[1],
        antiwindup=BackCalculation(tracking_time=config.tracking_time),
    )
    return pi, {
        f"controller.controller.{name}": ends for name, ends in zip(("kp", "ki"), config.pi_ranges, strict=True)
    }


def sliding(config: Others) -> tuple[SlidingMode, Free]:
    """Return the start of the sliding mode's search, and its ranges."""
    mode = SlidingMode(gain=config.sliding[0], boundary=config.sliding[1])
    names = zip(("gain", "boundary"), config.sliding_ranges, strict=True)
    return mode, {f"controller.controller.{name}": ends for name, ends in names}
