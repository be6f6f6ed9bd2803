"""The problems of the study, each from a function of its own, with all their numbers:

- gain: (k1, k2) of the rig, over masses and speeds.
- Riccati: Q = L L', R = 1, through the regulator of the rig at 20 km/h.
- LMI: the same through the paper's robust design over masses and speeds. Every trial is a robust gain.
- schedule: gains at six speeds and the filter of the target, 13 numbers. Many hardly matter.
- table 6: gains at six speeds, 12 numbers. Runs of half a second begin at 24 speeds, so every gain matters.
- table 12, table 24: the same with gains at 12 and 24 speeds, 24 and 48 numbers.
- together: Q at six speeds through six Riccati equations, feed-forward, target filter, anti-windup, 15 numbers.
- eight: PID, derivative filter, anti-windup, reference and estimator of the quarter car, 8 numbers, on 64 roads.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs import Batch, BrakeStart, FixedStep, Loop
from diffabs.core.pytree import param, part, pytree, replace
from diffabs.core.types import Vector
from diffabs.linear.regulator import lqr
from diffabs.linear.slip_model import SlipModel
from diffabs.output import plot
from diffabs.parts.actuators import Lag
from diffabs.parts.controllers import (
    PID,
    BackCalculation,
    ConstantInput,
    HoldingInput,
    ScheduledFeedback,
    StateFeedback,
)
from diffabs.parts.objectives import BRAKING, Effort, QuadraticCost
from diffabs.parts.plants import MirroredRig, QuarterCar
from diffabs.parts.references import FilteredSlip, PeakRobust
from diffabs.parts.roads import MagicFormula
from diffabs.parts.stops import SpeedReached, Standstill
from diffabs.robust.design.parameter_box import polytope
from diffabs.scenario.defaults import braking
from diffabs.tune import Problem, build_problem, grid, latin
from diffabs.tune.weights import lq_weights, lqr_gain_design, robust_gain_design

NAMES = ("gain", "Riccati", "LMI", "schedule", "table 6", "table 12", "table 24", "together", "eight")


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    masses: tuple[float, ...] = (5.3, 5.5, 5.75, 6.0, 6.2)  # kg
    speeds: tuple[float, ...] = (20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0)  # km/h
    last_speed: float = 5.0  # km/h
    lag: float = 1e-3  # s; without it slip alone drives k2 to its limit
    gain: tuple[float, float] = (-3000.0, -60.0)
    gain_range: tuple[tuple[float, float], tuple[float, float]] = ((-2e4, -300.0), (-10.0, -5.0))
    filter: float = 0.03  # s, of the schedule's target
    filter_range: tuple[float, float] = (0.001, 0.1)
    weights: tuple[float, float] = (1e7, 3e3)
    logarithms: tuple[float, float] = (1.0, 10.0)  # of the Cholesky factor's diagonal
    design_speed: float = 20.0  # km/h, of the Riccati equation
    cost: tuple[float, float, float] = (1e3, 1.0, 1e-4)  # of x1^2, x2^2 and (u - tau*)^2 in what is minimised
    rig_step: float = 5e-4  # s
    rig_duration: float = 1.7
    first_step: float = 1e-3  # s, of the tables and of everything together: the first of a braking
    first: float = 0.5
    table_masses: tuple[float, ...] = (5.3, 5.75, 6.2)  # kg
    table_speeds: tuple[float, float, int] = (9.0, 50.0, 24)  # km/h: from, to, how many
    table_range: tuple[tuple[float, float], tuple[float, float]] = ((-2e4, -10.0), (-300.0, -5.0))
    together: tuple[float, float, float] = (5.0, 0.02, 0.05)  # feed-forward [N m], filter [s], tracking time [s]
    roads: int = 64  # of the larger problem
    car_step: float = 2e-3
    car_duration: float = 6.0
    car_stop: float = 2.0  # m/s
    near: tuple[float, ...] = (1e-2, 1e-4, 1e-6)  # of the way from the start to the best
    # up to so many parameters: evaluations of a derivative-free search
    budgets: tuple[tuple[int, int], ...] = ((2, 400), (8, 2000), (15, 4000), (24, 12000), (48, 30000))
    iterations: tuple[int, int] = (30, 400)  # of L-BFGS, for 2 parameters and for more
    first_steps: tuple[float, ...] = (0.1, 0.2, 0.5)  # of CMA-ES, in units of z
    repeats: int = 11  # of every timing
    seed: int = 3
    out: str = "out/experiments/lq_weights"


ALL_RANGES = {
    "log_diagonal": (1.0, 12.0),
    "loop.feedforward.value": (1.0, 9.0),
    "loop.reference.time_constant": (0.001, 0.1),
    "loop.controller.antiwindup.tracking_time": (0.005, 0.5),
}


def rig(config: Config) -> Loop:
    """The rig with limits and a lag."""
    return braking(
        plant=MirroredRig(),
        initial=BrakeStart(speed=config.speeds[-1] / plot.KMH),
        controller=StateFeedback(gain=np.array(config.gain), low=0.0, high=9.03),
        feedforward=HoldingInput(),
        actuator=Lag(time_constant=config.lag),
        stop=SpeedReached(speed=config.last_speed / plot.KMH),
    )


def box(config: Config) -> Any:
    """Masses and speeds of the paper, without the lag: its own design."""
    ends = (config.last_speed / plot.KMH, config.speeds[-1] / plot.KMH)
    return polytope(SlipModel(), {"plant.mass": (min(config.masses), max(config.masses)), "speed": ends})


def car(config: Config) -> tuple[Loop, Batch]:
    """The quarter car under PID control at the estimated slip, and many roads, masses and speeds."""
    loop = braking(
        plant=QuarterCar(inertia=1.0539, road=MagicFormula()),
        reference=PeakRobust(slip=0.2, arming=1.0),
        controller=PID(kp=1500.0, ki=3000.0, kd=5.0, antiwindup=BackCalculation(tracking_time=0.2), low=0.0, high=90.0),
        stop=Standstill(speed=config.car_stop),
    )
    ranges = {
        "plant.mass": (12.0, 20.0),
        "plant.road.B": (8.0, 25.0),
        "plant.road.D": (0.5, 1.1),
        "initial.speed": (50 / plot.KMH, 100 / plot.KMH),
    }
    drawn = latin(ranges, config.roads, config.seed)
    shortest = drawn.values["initial.speed"] ** 2 / (2 * 9.81 * drawn.values["plant.road.D"])
    return loop, dataclasses.replace(drawn, weights=1 / shortest)


CAR_RANGES = {
    "controller.kp": (300.0, 8000.0),
    "controller.ki": (10.0, 1e5),
    "controller.kd": (0.1, 50.0),
    "controller.cutoff": (10.0, 300.0),
    "controller.antiwindup.tracking_time": (0.005, 2.0),
    "reference.slip": (0.05, 0.9),
    "reference.time_constant": (0.004, 0.05),
    "reference.threshold": (0.005, 0.1),
}


def scheduled(config: Config, speeds: np.ndarray) -> ScheduledFeedback:
    """A gain at each of these speeds, all alike."""
    integral, proportional = (np.full(len(speeds), k) for k in config.gain)
    limits = {"low": 0.0, "high": 9.03}
    return ScheduledFeedback(speeds=speeds, integral_gains=integral, gains=proportional, **limits)


@pytree
class Weights:
    """A loop with scheduled gains; those at each speed are designed from Q = diag(exp(2 d)), R = 1. The other entry of
    Q does not matter: the states are an error and its integral, so that it multiplies a total derivative."""

    loop: Loop = part(default=Loop)
    log_diagonal: Vector = param(default=(0.0, 0.0), unit="1", free=True)

    def closed_loop(self) -> Loop:
        """The loop with the gains of these weights."""

        def gain(speed: Any, d: Any) -> Any:
            a, b = SlipModel(speed=speed).matrices()
            return lqr(a, b, jnp.diag(jnp.exp(2 * d)), jnp.eye(1)).gain[0]

        gains = jax.vmap(gain)(jnp.asarray(self.loop.controller.speeds), jnp.asarray(self.log_diagonal))  # pyright: ignore[reportAttributeAccessIssue]
        return replace(self.loop, {"controller.integral_gains": gains[:, 0], "controller.gains": gains[:, 1]})


def larger(config: Config, count: int) -> tuple[Loop, Batch, np.ndarray]:
    """The rig with gains at `count` speeds, evenly spaced; many masses and speeds to start from; those speeds."""
    speeds = np.linspace(config.last_speed, config.speeds[-1], count) / plot.KMH
    lanes = {"plant.mass": config.table_masses, "initial.speed": np.linspace(*config.table_speeds) / plot.KMH}
    return dataclasses.replace(rig(config), controller=scheduled(config, speeds)), grid(lanes), speeds


def together(config: Config) -> Weights:
    """Weights at six speeds, and a controller that does not know the mass."""
    loop, _, speeds = larger(config, 6)
    feedforward, filter_, tracking = config.together
    controller = dataclasses.replace(loop.controller, antiwindup=BackCalculation(tracking_time=tracking))
    loop = dataclasses.replace(
        loop,
        controller=controller,
        feedforward=ConstantInput(value=feedforward),
        reference=FilteredSlip(time_constant=filter_),
    )
    return Weights(loop=loop, log_diagonal=np.tile(0.5 * np.log(config.weights), (len(speeds), 1)))


def problems(config: Config) -> dict[str, Callable[..., Problem]]:
    """By name, a function that returns the problem; its arguments are further ones of `build_problem`."""
    loop, low_high = rig(config), config.logarithms
    solver = FixedStep(step=config.rig_step, duration=config.rig_duration)
    lanes = grid({"plant.mass": config.masses, "initial.speed": [v / plot.KMH for v in config.speeds]})
    cost = {**BRAKING, "cost": QuadraticCost(q=np.array(config.cost[:2]), r=config.cost[2])}
    rest = {"objective": {"cost": 1.0}, "over": lanes, "solver": solver, "measured": cost}
    weighed = {"log_diagonal": low_high}
    (low, first), (high, last) = config.gain_range
    six = np.geomspace(config.last_speed, config.speeds[-1], 6) / plot.KMH
    filtered = FilteredSlip(time_constant=config.filter)
    thirteen = dataclasses.replace(loop, controller=scheduled(config, six), reference=filtered)
    slow = {
        "controller.integral_gains": (low, high),
        "controller.gains": (first, last),
        "reference.time_constant": config.filter_range,
    }
    at = lqr_gain_design(SlipModel(speed=config.design_speed / plot.KMH))
    many, roads = car(config)
    long = FixedStep(step=config.car_step, duration=config.car_duration)
    measured = {**BRAKING, "effort": Effort()}
    driven = {"objective": {"stop_distance": 1.0, "effort": 1e-7}, "over": roads, "solver": long, "measured": measured}
    return {
        "gain": lambda **k: build_problem(loop, free={"controller.gain": config.gain_range}, **rest, **k),
        "Riccati": lambda **k: build_problem(lq_weights(loop, config.weights, 1.0, at), free=weighed, **rest, **k),
        "LMI": lambda **k: build_problem(
            lq_weights(loop, config.weights, 1.0, robust_gain_design(box(config))), free=weighed, **rest, **k
        ),
        "schedule": lambda **k: build_problem(thirteen, free=slow, **rest, **k),
        **{f"table {n}": table(config, n, rest) for n in (6, 12, 24)},
        "together": lambda **k: build_problem(together(config), free=ALL_RANGES, **whole(config), **k),
        "eight": lambda **k: build_problem(many, free=CAR_RANGES, **driven, **k),
    }


def table(config: Config, count: int, rest: dict[str, Any]) -> Callable[..., Problem]:
    """Gains at `count` speeds, the first of a braking."""
    loop, lanes, _ = larger(config, count)
    free = dict(zip(("controller.integral_gains", "controller.gains"), config.table_range, strict=True))
    rest = rest | {"over": lanes, "solver": FixedStep(step=config.first_step, duration=config.first)}
    return lambda **k: build_problem(loop, free=free, **rest, **k)


def whole(config: Config) -> dict[str, Any]:
    """What everything together is judged by: as in `overshoot_cured`."""
    return {
        "objective": {"iae": 1.0, "overshoot": 0.3},
        "over": larger(config, 6)[1],
        "solver": FixedStep(step=config.first_step, duration=config.first),
        "measured": BRAKING,
    }
