"""Estimator, reference and controller, tuned together by gradients over thousands of lanes."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from diffabs import Batch, FixedStep, Loop
from diffabs.parts.controllers import BackCalculation, ProportionalFeedback
from diffabs.parts.objectives import IAE, Overshoot
from diffabs.parts.references import LimitedSlip
from diffabs.parts.sensors import SpeedEstimator
from diffabs.tune import CVaR, DerivativeMode, Method, SmoothWorst, Stopping, Tuned, build_problem, tune
from experiments.real_rig.box import ESTIMATED, KNOWN, Box, Fixed, batch, columns, spread
from experiments.real_rig.floor import Deviation, floor, stopping_time
from experiments.real_rig.loops import loop

MEASURED = {"overshoot": Overshoot(), "iae": IAE(), "deviation": Deviation()}
ONE_SIDED: Mapping[str, float] = {"overshoot": 1.0, "iae": 1.0}  # 1, 1/s
TWO_SIDED: Mapping[str, float] = {"deviation": 1.0, "iae": 1.0}


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Every number of the tuning. Paths of the sensor are those of the loop whose speed is estimated."""

    step: float = 1e-3  # s
    few: int = 512  # lanes on which all starts are tried
    lanes: int = 4096  # lanes on which the best of them is tuned
    starts: Mapping[str, int] = dataclasses.field(default_factory=lambda: {KNOWN: 4, ESTIMATED: 3})
    tried: int = 12  # steps of each start
    iterations: int = 8  # steps of the best
    level: float = 0.95  # of CVaR
    softness: float = 0.3  # of the smooth worst case, in units of the mean
    seed: int = 19
    engine: str = "auto"
    gain: tuple[float, float] = (-2000.0, -120.0)  # starts, at 50 km/h
    rate: float = 4.0  # 1/s
    time_constant: float = 0.02  # s
    tracking_time: float = 0.05  # s
    gate: float = 0.01
    growth: float = 1.0  # m/s/s^0.5
    free: Mapping[str, Any] = dataclasses.field(
        default_factory=lambda: {
            "controller.controller.gain": ((-2e4, -400.0), (-10.0, -10.0)),
            "controller.controller.antiwindup.tracking_time": (0.002, 1.0),
            "reference.rate": (0.5, 20.0),
            "reference.time_constant": (0.002, 0.1),
        }
    )
    of_estimator: Mapping[str, Any] = dataclasses.field(
        default_factory=lambda: {"sensor.blocks.4.gate": (0.001, 0.3), "sensor.blocks.4.growth": (1e-3, 30.0)}
    )


class Above:
    """An aggregate of the lanes' numbers above their floors. A controller can reduce these."""

    def __init__(self, inner: Any, floors: np.ndarray):
        """`floors`: of the weighted sum of the metrics (lanes,)."""
        self.inner, self.floors = inner, floors

    def __call__(self, values: Any) -> Any:
        """values (n,) -> scalar."""
        return self.inner(values - self.floors)


def start(config: Tuning, fixed: Fixed, speed: str) -> Loop:
    """Return the loop before its tuning, with noise in place of the quantisation."""
    windup = BackCalculation(tracking_time=config.tracking_time)
    controller = ProportionalFeedback(gain=np.array(config.gain), antiwindup=windup)
    target = LimitedSlip(slip=fixed.slip, rate=config.rate, time_constant=config.time_constant)
    estimator = SpeedEstimator(gate=config.gate, growth=config.growth, period=fixed.period)
    return loop(fixed, controller, speed, target, estimator, smooth=True)


def longest(points: dict[str, np.ndarray], fixed: Fixed) -> np.ndarray:
    """In which every lane is sure to end [s]."""
    return 0.3 + 1.2 * stopping_time(points, fixed)


def lanes(
    config: Tuning, box: Box, fixed: Fixed, speed: str, count: int, weights: Mapping[str, float]
) -> tuple[Batch, np.ndarray]:
    """Points of the box, spread evenly, with their noise; and the floor of the objective of each."""
    points = spread(box, speed, count, config.seed)
    over = dataclasses.replace(batch(columns(points), config.seed), durations=longest(points, fixed))
    two_sided = "deviation" in weights
    weight = weights["deviation" if two_sided else "overshoot"]
    return over, weight * floor(points, speed, fixed, two_sided=two_sided)


@dataclasses.dataclass(frozen=True)
class Stage:
    """A search: the objective of the lanes, their number, the starts and the iterations."""

    name: str
    aggregate: Any
    lanes: int
    starts: int
    iterations: int
    weights: Mapping[str, float] = dataclasses.field(default_factory=lambda: ONE_SIDED)


def searched(
    stage: Stage, subject: Loop, config: Tuning, box: Box, fixed: Fixed, speed: str, progress: Callable[[str], None]
) -> Tuned:
    """Return the result of a search from a loop."""
    over, floors = lanes(config, box, fixed, speed, stage.lanes, stage.weights)
    stopping = Stopping(change=1e-4, iterations=stage.iterations)
    return tune(
        build_problem(
            subject,
            free={**config.free, **({} if speed == KNOWN else config.of_estimator)},
            objective=stage.weights,
            over=over,
            solver=FixedStep(step=config.step, duration=float(np.max(over.durations)), kinks=False),
            measured={name: MEASURED[name] for name in stage.weights},
            aggregate=Above(stage.aggregate, floors),
            mode=DerivativeMode.FORWARD,
            engine=config.engine,
        ),
        method=Method(starts=stage.starts, seed=config.seed, stopping=stopping),
        progress=lambda p: progress(f"{speed}, {stage.name}: {p.point.evaluations} gradients, {p.point.objective:.5g}"),
    )


def tuned(
    config: Tuning, box: Box, fixed: Fixed, speed: str, progress: Callable[[str], None] = lambda line: None
) -> dict[str, Tuned]:
    """Return the results of all stages.

    Several starts run on few lanes under CVaR. The best of them goes on with many lanes under CVaR, then under the
    smooth worst. Where the speed is known, CVaR of the deviation to both sides follows.
    """
    risk, worst = CVaR(level=config.level), SmoothWorst(softness=config.softness)
    lanes, steps = config.lanes, config.iterations
    task = (config, box, fixed, speed, progress)
    first = searched(
        Stage("starts", risk, config.few, config.starts[speed], config.tried), start(config, fixed, speed), *task
    )
    cvar = searched(Stage("CVaR", risk, lanes, 1, steps), first.part, *task)
    later = [Stage("smooth worst", worst, lanes, 1, steps)]
    if speed == KNOWN:
        later.append(Stage("both sides", risk, lanes, 1, steps, TWO_SIDED))
    return {"starts": first, "CVaR": cvar} | {stage.name: searched(stage, cvar.part, *task) for stage in later}
