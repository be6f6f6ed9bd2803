"""Is it worth while to differentiate? Gains, and LQ weights through the Riccati equation and through the LMI.

L-BFGS on the gradient is compared with two derivative-free searches from well-kept libraries, Nelder-Mead and CMA-ES,
from the same start (`searches.py` says how they are counted), on problems of 2 to 48 parameters:

    gain       (k1, k2) of the rig, over masses and speeds
    Riccati    Q = L L', R = 1, through the regulator of the rig at 20 km/h
    LMI        the same through the paper's robust design over masses and speeds: every trial is a robust gain
    schedule   gains at six speeds and the filter of the target: 13, many of which hardly matter
    table 6    gains at six speeds, over the first half second from 24 speeds, so that every gain matters: 12
    table 24   the same at 24 speeds: 48
    together   Q at six speeds through six Riccati equations, feed-forward, filter of the target, anti-windup: 15
    eight      PID, derivative filter, anti-windup, reference and estimator of the quarter car on 64 roads: 8

What counts is rollouts of the batch until the objective is within a hundredth, a ten thousandth and a millionth of the
way from the start to the best that any of the three ever found; and rollouts to where each derivative-free search
itself ended, to a millionth of its way. Where that is its budget and not its own end it proves little: a search still
on its way would have gone on to where gradients are slow as well. Two prices of a gradient: over a rollout that
measures all of a braking report, as `tune` does by default, and over one that measures nothing but the objective.

Chosen after results were seen: the tables (of the schedule most gains do not matter, and its filter ends at the end of
its range), L-BFGS's memory of 100 steps instead of 10, and budgets that the time allowed.

    python experiments/lq_weights.py [PROBLEM ...]      (needs the package cma, of the dependency group test)

Each problem is kept in a file of its own; table and figure show all that are there.
"""

import dataclasses
import json
import pathlib
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import searches

from diffabs import BrakeStart, FixedStep, Loop, plot
from diffabs.actuators import Lag
from diffabs.controllers import PID, BackCalculation, ConstantInput, HoldingInput, ScheduledFeedback, StateFeedback
from diffabs.design import Spec, certify, design
from diffabs.design.box import polytope
from diffabs.design.regulator import lqr
from diffabs.linearize import SlipModel
from diffabs.objectives import BRAKING, Effort, QuadraticCost
from diffabs.papers import record
from diffabs.plants import MirroredRig, QuarterCar
from diffabs.pytree import Vector, param, part, pytree, replace
from diffabs.references import FilteredSlip, PeakRobust
from diffabs.roads import MagicFormula
from diffabs.stops import SpeedReached, Standstill
from diffabs.tune import Batch, Method, Stopping, Tuned, grid, latin, tune
from diffabs.tune.problem import Problem
from diffabs.tune.tuning import posed
from diffabs.tune.weights import LQWeights, lq_weights, regulator, robust

NAMES = ("gain", "Riccati", "LMI", "schedule", "table 6", "table 24", "together", "eight")


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
    budgets: tuple[tuple[int, int], ...] = ((2, 400), (8, 2000), (15, 4000), (48, 12000))  # up to so many parameters:
    # evaluations of a derivative-free search
    iterations: tuple[int, int] = (30, 400)  # of L-BFGS
    memory: int = 100  # of L-BFGS
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


def scheduled(config: Config, speeds: np.ndarray) -> ScheduledFeedback:
    """A gain at each of these speeds, all alike."""
    integral, proportional = (np.full(len(speeds), k) for k in config.gain)
    limits = {"torque_min": 0.0, "torque_max": 9.03}
    return ScheduledFeedback(speeds=speeds, integral_gains=integral, gains=proportional, **limits)


@pytree
class Weights:
    """A loop with scheduled gains; those at each speed are designed from Q = diag(exp(2 d)), R = 1. The other entry of
    Q does not matter: the states are an error and its integral, so that it multiplies a total derivative."""

    loop: Loop = part(default=Loop)
    log_diagonal: Vector = param(default=(0.0, 0.0), unit="1")

    def closed(self) -> Loop:
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


def problems(config: Config) -> dict[str, Callable[..., Any]]:
    """By name, a function that is called with `tune` or `posed`."""
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
    at = regulator(SlipModel(speed=config.design_speed / plot.KMH))
    many, roads = car(config)
    long = FixedStep(step=config.car_step, duration=config.car_duration)
    measured = {**BRAKING, "effort": Effort()}
    driven = {"objective": {"stop_distance": 1.0, "effort": 1e-7}, "over": roads, "solver": long, "measured": measured}
    return {
        "gain": lambda f, **k: f(loop, free={"controller.gain": config.gain_range}, **rest, **k),
        "Riccati": lambda f, **k: f(lq_weights(loop, config.weights, 1.0, at), free=weighed, **rest, **k),
        "LMI": lambda f, **k: f(lq_weights(loop, config.weights, 1.0, robust(box(config))), free=weighed, **rest, **k),
        "schedule": lambda f, **k: f(thirteen, free=slow, **rest, **k),
        **{f"table {n}": table(config, n, rest) for n in (6, 24)},
        "together": lambda f, **k: f(together(config), free=ALL_RANGES, **whole(config), **k),
        "eight": lambda f, **k: f(many, free=CAR_RANGES, **driven, **k),
    }


def table(config: Config, count: int, rest: dict[str, Any]) -> Callable[..., Any]:
    """Gains at `count` speeds, the first of a braking."""
    loop, lanes, _ = larger(config, count)
    free = dict(zip(("controller.integral_gains", "controller.gains"), config.table_range, strict=True))
    rest = rest | {"over": lanes, "solver": FixedStep(step=config.first_step, duration=config.first)}
    return lambda f, **k: f(loop, free=free, **rest, **k)


def whole(config: Config) -> dict[str, Any]:
    """What everything together is judged by: as in `cure_overshoot.py`."""
    return {
        "objective": {"iae": 1.0, "overshoot": 0.3},
        "over": larger(config, 6)[1],
        "solver": FixedStep(step=config.first_step, duration=config.first),
        "measured": BRAKING,
    }


def bare(problem: Problem) -> Problem:
    """Measuring nothing but the objective."""
    return dataclasses.replace(problem, measured={name: problem.measured[name] for name in problem.weights})


def allowed(config: Config, parameters: int) -> int:
    """Evaluations of a derivative-free search."""
    return next(budget for most, budget in config.budgets if parameters <= most)


def compared(config: Config, name: str) -> tuple[dict[str, Any], Tuned]:
    """One problem, three searches."""
    pose = problems(config)[name]
    problem = pose(posed)
    large = int(problem.space.size > 2)
    prices = [searches.prices(p, config.repeats) for p in (problem, bare(problem))]
    mode = min(prices[0], key=lambda mode: prices[0][mode])
    stopping = Stopping(gradient=1e-9, change=1e-11, iterations=config.iterations[large])
    found = pose(tune, method=Method(mode=mode, memory=config.memory, stopping=stopping))
    print(f"{name}: L-BFGS {found.objective[1]:.9g}, {found.evaluations} gradients; {found.reason.value}", flush=True)
    budget = allowed(config, problem.space.size)
    traces = {"L-BFGS": [(float(p.evaluations), p.objective) for p in found.history]}
    traces["Nelder-Mead"] = searches.nelder_mead(bare(problem), budget)
    print(f"{name}: Nelder-Mead {traces['Nelder-Mead'][-1]}", flush=True)
    traces["CMA-ES"] = searches.cma_es(bare(problem), budget, config.seed)
    return {
        "problem": name,
        "parameters": problem.space.size,
        "lanes": problem.batch.size,
        "prices": [{m.value: p for m, p in price.items()} for price in prices],
        "price": prices[0][mode],
        "price, bare": min(prices[1].values()),
        "start": found.objective[0],
        "found": {who: trace[-1][1] for who, trace in traces.items()},
        "spent": {who: trace[-1][0] for who, trace in traces.items()},
        "traces": traces,
        "values": {path: np.asarray(value).tolist() for path, value in found.values.items()},
    }, found


def lines(config: Config, kept: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of one problem: each accuracy, and the ends of both derivative-free searches."""
    start, traces, best = kept["start"], kept["traces"], min(kept["found"].values())
    theirs = [who for who in traces if who != "L-BFGS"]
    asked = [(f"{near:g}", best + near * (start - best), theirs) for near in config.near]
    budget = allowed(config, kept["parameters"])
    ends = {who: "budget" if kept["spent"][who] >= budget else "end" for who in theirs}
    asked += [(f"{who}'s {ends[who]}", searches.own(traces[who], start)[0], [who]) for who in theirs]
    return [line(kept, *one) for one in asked]


def line(kept: dict[str, Any], accuracy: str, target: float, theirs: list[str]) -> dict[str, Any]:
    """Rollouts to a target; None where it was not reached. Where no derivative-free search reached it, they count as
    what the longer one spent, and the ratio is a lower bound."""
    counts = {who: searches.needed(kept["traces"][who], target) for who in kept["traces"]}
    other = min(counts[who] for who in theirs)
    other = other if np.isfinite(other) else max(kept["spent"][who] for who in theirs)
    ours = {name: 1 + counts["L-BFGS"] * kept[name] for name in ("price", "price, bare")}
    shown = {who: n if np.isfinite(n) and (who in theirs or who == "L-BFGS") else None for who, n in counts.items()}
    return {
        "problem": kept["problem"],
        "parameters": kept["parameters"],
        "accuracy": accuracy,
        "gradients": shown.pop("L-BFGS"),
        "price": kept["price"],
        "rollouts": ours["price"] if np.isfinite(ours["price"]) else None,
        **shown,
        "times fewer": other / ours["price"],
        "price, bare": kept["price, bare"],
        "times fewer, bare": other / ours["price, bare"],
    }


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


def figures(kept: list[dict[str, Any]]) -> dict[str, Any]:
    """Distance to the best over rollouts, one panel per problem."""
    figure, axes = plot.sheet(-(-len(kept) // 3), min(3, len(kept)), title="What a gradient is worth", size=(5.0, 3.3))
    for ax, row in zip(axes, kept, strict=False):
        best = min(row["found"].values())
        for i, (name, trace) in enumerate(row["traces"].items()):
            n, value = np.array(trace).T
            n = 1 + n * row["price"] if name == "L-BFGS" else n
            gap = np.maximum((value - best) / (row["start"] - best), 1e-9)
            named = "L-BFGS, gradients at their price" if name == "L-BFGS" else name
            ax.loglog(n, gap, plot.DASHES[i], color=plot.COLOURS[i], label=named, drawstyle="steps-post")
        title = f"{row['problem']}: {row['parameters']} parameters"
        plot.label(ax, "rollouts of the batch", "distance to the best", title)
    for ax in axes[len(kept) :]:
        ax.set_visible(False)
    return {"searches": figure}


def main(config: Config | None = None, names: tuple[str, ...] = NAMES) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    folder = pathlib.Path(config.out)
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        kept, found = compared(config, name)
        record.write(folder, kept | {"gains": gains(config, {name: found})}, f"{name.replace(' ', '_')}.json")
    files = [folder / f"{name.replace(' ', '_')}.json" for name in NAMES]
    kept = [json.loads(path.read_text(encoding="utf-8")) for path in files if path.exists()]
    rows = [row for one in kept for row in lines(config, one)]
    record.show("Rollouts of the batch", rows)
    end = [row for one in kept for row in one["gains"]]
    if end:
        record.show("Gains on the rig", end)
    results = {"table": rows, "gains": end, "paper_weights_gain": paper(config).tolist()}
    return record.experiment(config, results, figures(kept))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(names=tuple(sys.argv[1:]) or NAMES)
