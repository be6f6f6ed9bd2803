"""Is it worth while to differentiate? Gains, and LQ weights through the Riccati equation and through the LMI.

One problem in three sets of two coordinates and in one of thirteen, and another one with eight. In each, L-BFGS on the
gradient is compared with two derivative-free searches from well-kept libraries, Nelder-Mead (SciPy) and CMA-ES (cma),
from the same start. What counts is evaluations of the batch until the objective is within a hundredth, a ten thousandth
and a millionth of the way from the start to the best that any of the three ever found. A gradient counts at its price,
measured here as the median ratio of times.

    gain       (k1, k2) themselves
    Riccati    Q = L L', R = 1, through the regulator of the rig at 20 km/h
    LMI        the same through the paper's robust design over masses and speeds: every trial is a robust gain
    schedule   gains at six speeds and the filter of the target: thirteen
    eight      PID, derivative filter, anti-windup, reference and estimator of the quarter car on 32 roads

    python experiments/lq_weights.py      (needs the package cma, of the dependency group test)
"""

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import cma
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from diffabs import BrakeStart, FixedStep, Loop, plot
from diffabs.actuators import Lag
from diffabs.controllers import PID, BackCalculation, HoldingInput, ScheduledFeedback, StateFeedback
from diffabs.design import Spec, certify, design
from diffabs.design.box import polytope
from diffabs.linearize import SlipModel
from diffabs.objectives import BRAKING, Effort, QuadraticCost
from diffabs.papers import record
from diffabs.plants import MirroredRig, QuarterCar
from diffabs.references import FilteredSlip, PeakRobust
from diffabs.roads import MagicFormula
from diffabs.stops import SpeedReached, Standstill
from diffabs.tune import Batch, Method, Stopping, Tuned, grid, latin, tune
from diffabs.tune.problem import Multipliers, Problem
from diffabs.tune.tuning import posed
from diffabs.tune.weights import LQWeights, lq_weights, regulator, robust

NAMES = ("gain", "Riccati", "LMI", "schedule", "eight")


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
    roads: int = 64  # of the larger problem
    car_step: float = 2e-3
    car_duration: float = 6.0
    car_stop: float = 2.0  # m/s
    near: tuple[float, ...] = (1e-2, 1e-4, 1e-6)  # of the way from the start to the best
    budgets: tuple[int, int] = (400, 5000)  # evaluations of a derivative-free search, for two and for more parameters
    iterations: tuple[int, int] = (30, 120)  # of L-BFGS
    repeats: int = 7  # of every timing
    seed: int = 3
    out: str = "out/experiments/lq_weights"


def rig(config: Config) -> Loop:
    """The rig with limits and a lag."""
    return Loop(
        plant=MirroredRig(),
        initial=BrakeStart(speed=config.speeds[-1] / plot.KMH),
        controller=StateFeedback(gain=np.array(config.gain), torque_min=0.0, torque_max=9.03),
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
    loop = Loop(
        plant=QuarterCar(inertia=1.0539, road=MagicFormula()),
        reference=PeakRobust(slip=0.2, arming=1.0),
        controller=PID(kp=1500.0, ki=3000.0, kd=5.0, antiwindup=BackCalculation(tracking_time=0.2)),
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


def schedule(config: Config) -> Loop:
    """The rig with a gain at each of six speeds, all alike at first, and a filtered target."""
    low, high = config.last_speed / plot.KMH, config.speeds[-1] / plot.KMH
    speeds, (integral, proportional) = np.geomspace(low, high, 6), config.gain
    feedback = ScheduledFeedback(
        speeds=speeds,
        integral_gains=np.full(6, integral),
        gains=np.full(6, proportional),
        torque_min=0.0,
        torque_max=9.03,
    )
    return dataclasses.replace(rig(config), controller=feedback, reference=FilteredSlip(time_constant=config.filter))


def problems(config: Config) -> dict[str, Callable[..., Any]]:
    """By name, a function that is called with `tune` or `posed`."""
    loop, low_high = rig(config), config.logarithms
    solver = FixedStep(step=config.rig_step, duration=config.rig_duration)
    lanes = grid({"plant.mass": config.masses, "initial.speed": [v / plot.KMH for v in config.speeds]})
    cost = {**BRAKING, "cost": QuadraticCost(q=np.array(config.cost[:2]), r=config.cost[2])}
    rest = {"objective": {"cost": 1.0}, "over": lanes, "solver": solver, "measured": cost}
    weighed = {"log_diagonal": low_high}
    (low, first), (high, last) = config.gain_range
    scheduled = {
        "controller.integral_gains": (low, high),
        "controller.gains": (first, last),
        "reference.time_constant": config.filter_range,
    }
    at = regulator(SlipModel(speed=config.design_speed / plot.KMH))
    many, roads = car(config)
    long = FixedStep(step=config.car_step, duration=config.car_duration)
    measured = {**BRAKING, "effort": Effort()}
    larger = {"objective": {"stop_distance": 1.0, "effort": 1e-7}, "over": roads, "solver": long, "measured": measured}
    return {
        "gain": lambda f, **k: f(loop, free={"controller.gain": config.gain_range}, **rest, **k),
        "Riccati": lambda f, **k: f(lq_weights(loop, config.weights, 1.0, at), free=weighed, **rest, **k),
        "LMI": lambda f, **k: f(lq_weights(loop, config.weights, 1.0, robust(box(config))), free=weighed, **rest, **k),
        "schedule": lambda f, **k: f(schedule(config), free=scheduled, **rest, **k),
        "eight": lambda f, **k: f(many, free=CAR_RANGES, **larger, **k),
    }


def price(config: Config, problem: Problem) -> float:
    """Median time of a gradient over that of a value."""
    z = jnp.asarray(problem.space.place(problem.subject))[None]
    m = Multipliers(jnp.zeros((1, 0)), jnp.ones(1))
    value, gradient = problem.valuer(), problem.evaluator(1.0)
    ratios = []
    jax.block_until_ready((value(z), gradient(z, m)))
    for _ in range(config.repeats):
        times = []
        for call in (lambda: gradient(z, m), lambda: value(z)):
            begun = time.perf_counter()
            jax.block_until_ready(call())
            times.append(time.perf_counter() - begun)
        ratios.append(times[0] / times[1])
    return statistics.median(ratios)


class Counted:
    """The objective as a plain function of z, which keeps what it has seen: (evaluations so far, least value)."""

    def __init__(self, problem: Problem):
        """Compiled once, one z at a time."""
        self._seen, self.count, self.least = problem.valuer(), 0, np.inf
        self.steady = problem.steady()
        self.trace: list[tuple[int, float]] = []

    def __call__(self, z: Any) -> float:
        """The objective; a large number where the run or its step fails, as the libraries want it."""
        z = np.asarray(z, float)[None]
        seen = jax.device_get(self._seen(jnp.asarray(z)))
        value = float(seen.objective[0])
        fine = np.isfinite(value) and seen.diverged[0] == 0 and self.steady(z)[0]
        self.count += 1
        if fine and value < self.least:
            self.least = value
            self.trace.append((self.count, value))
        return value if fine else 1e6


def nelder_mead(problem: Problem, budget: int) -> Counted:
    """SciPy's, adaptive, to its own end or the budget."""
    f, start = Counted(problem), problem.space.place(problem.subject)
    options = {"maxfev": budget, "xatol": 1e-6, "fatol": 1e-12, "adaptive": len(start) > 2}
    minimize(f, start, method="Nelder-Mead", options=options)
    return f


def cma_es(problem: Problem, budget: int, seed: int) -> Counted:
    """The reference implementation, first step 0.5 in units of z."""
    f, start = Counted(problem), problem.space.place(problem.subject)
    cma.fmin(f, start, 0.5, {"maxfevals": budget, "verbose": -9, "seed": seed, "verb_log": 0, "tolfun": 1e-12})
    return f


def needed(trace: list[tuple[int, float]], target: float) -> float:
    """Evaluations until the target was reached; infinity if it was not."""
    return next((float(n) for n, value in trace if value <= target), np.inf)


def compared(config: Config, name: str) -> tuple[dict[str, Any], dict[str, list[tuple[float, float]]], Tuned]:
    """One problem, three searches."""
    pose = problems(config)[name]
    problem = pose(posed)
    large = int(problem.space.size > 2)
    stopping = Stopping(gradient=1e-9, change=1e-11, iterations=config.iterations[large])
    found = pose(tune, method=Method(stopping=stopping))
    cost = price(config, problem)
    budget = config.budgets[large]
    searches = {
        "Nelder-Mead": nelder_mead(problem, budget).trace,
        "CMA-ES": cma_es(problem, budget, config.seed).trace,
    }
    mine = [(p.evaluations, p.objective) for p in found.history]
    best = min(min(value for _, value in trace) for trace in (mine, *searches.values()))
    row = {
        "problem": name,
        "parameters": problem.space.size,
        "gradient by": problem.mode.value,
        "price of a gradient": cost,
        "start": found.objective[0],
        "best": best,
        "L-BFGS found": found.objective[1],
        **{f"{search} found": min(value for _, value in trace) for search, trace in searches.items()},
    }
    for near in config.near:
        target = best + near * (found.objective[0] - best)
        ours = needed(mine, target) * cost
        theirs = {search: needed(trace, target) for search, trace in searches.items()}
        counts = {"L-BFGS": ours, **theirs}
        row |= {f"{who} to {near:g}": n if np.isfinite(n) else None for who, n in counts.items()}
        row[f"times fewer to {near:g}"] = min(*theirs.values(), budget) / ours
    return row, {"L-BFGS, gradients at their price": [(n * cost, v) for n, v in mine], **searches}, found


def gains(config: Config, found: dict[str, Tuned]) -> list[dict[str, Any]]:
    """The gain that each problem on the rig ended with, what it does, and what is proved of it without the lag."""
    rows = []
    for name, one in found.items():
        if not isinstance(one.loop.controller, StateFeedback):
            continue
        gain = np.asarray(one.loop.controller.gain)
        proof = certify(gain, box(config), fastest=True)
        metrics = one.metrics[1]
        rows.append(
            {
                "tuned": name,
                "k1": float(gain[0]),
                "k2": float(gain[1]),
                "Q": np.round(np.asarray(one.part.weights()[0]), 1).tolist() if isinstance(one.part, LQWeights) else "",
                "objective": one.objective[1],
                "worst overshoot [%]": 100 * float(metrics["overshoot"].max()),
                "mean IAE [s]": float(metrics["iae"].mean()),
                "common P": {True: "yes", False: "none", None: "undecided"}[proof.quadratically_stable],
                "decay proved [1/s]": proof.decay_rate,
            }
        )
    return rows


def paper(config: Config) -> np.ndarray:
    """The robust design with the paper's weights, for orientation."""
    return design(box(config), Spec(Q=config.weights, R=1.0)).gain[0]


def figures(traces: dict[str, dict[str, Any]], rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Distance to the best over rollouts, one panel per problem."""
    figure, axes = plot.sheet(2, 3, title="What a gradient is worth", size=(5.0, 3.3))
    for ax, row in zip(axes, rows, strict=False):
        for i, (name, trace) in enumerate(traces[row["problem"]].items()):
            n, value = np.array(trace).T
            gap = np.maximum((value - row["best"]) / (row["start"] - row["best"]), 1e-9)
            ax.loglog(n, gap, plot.DASHES[i], color=plot.COLOURS[i], label=name, drawstyle="steps-post")
        plot.label(
            ax, "rollouts of the batch", "distance to the best", f"{row['problem']}: {row['parameters']} parameters"
        )
    return {"searches": figure}


def main(
    config: Config | None = None, names: tuple[str, ...] = ("gain", "Riccati", "LMI", "schedule", "eight")
) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    rows, traces, found = [], {}, {}
    for name in names:
        row, traces[name], found[name] = compared(config, name)
        rows.append(row)
        record.show(name, [row])
    end = gains(config, found)
    record.show("Gains on the rig", end)
    results = {"table": rows, "gains": end, "paper_weights_gain": paper(config).tolist()}
    return record.experiment(config, results, figures(traces, rows) if names == NAMES else {})


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
