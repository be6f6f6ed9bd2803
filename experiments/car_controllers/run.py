"""Eight brake controllers of one car on the stops of a regulation and on four roads: how far, and how straight?

The stops are those of `diffabs assess` (`assess.plan_stops`), and further ones on Burckhardt's dry and wet asphalt,
snow and ice, and with a lane change. Every controller brakes the same cars, drawn at random in mass and height of the
centre of gravity, unladen and laden, with the same driver. Distances are relative to the shortest one that friction
allows.

    python experiments/car_controllers/run.py
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from diffabs import Adaptive, Loop, replace
from diffabs.assess import RuleStop, StopProgram, clause_figures, plan_stops, run_stops
from diffabs.assess.runs import NO_EDGE
from diffabs.assess.surfaces import make_surface
from diffabs.linear import SlipModel, lqr
from diffabs.loop.result import Run
from diffabs.output import plot
from diffabs.papers import record
from diffabs.parts.actuators import HydraulicBrake, PerControl
from diffabs.parts.controllers import (
    PID,
    Clamping,
    ConstantTorque,
    FivePhase,
    FourPhase,
    HoldCourse,
    PerChannel,
    ProportionalFeedback,
    SelectLow,
    SlidingMode,
)
from diffabs.parts.objectives import BrakeWork, InChannel, PeakOutput, StopDistance
from diffabs.parts.plants import GRAVITY, QuarterCar
from diffabs.parts.plants.car import BRAKES
from diffabs.parts.references import ExtremumSeeking, PerTarget
from diffabs.parts.roads import DRY_ASPHALT, ICE, SNOW, WET_ASPHALT, Burckhardt
from diffabs.scenario import load
from experiments._shared.numbers import store_numbers

KMH, END = 1 / 3.6, 15.0  # m/s; km/h, where the stops end
REAR = tuple(BRAKES)[2:]
WORKS = {
    f"work_{brake}": InChannel(objective=BrakeWork(), control=brake, output=slip) for brake, slip in BRAKES.items()
}
OBJECTIVES = {
    "distance": StopDistance(),
    "yaw": PeakOutput(output="yaw"),
    "lateral": PeakOutput(output="lateral_position"),
    **WORKS,
}
ROADS = {"dry": (DRY_ASPHALT, 100.0), "wet": (WET_ASPHALT, 100.0), "snow": (SNOW, 50.0), "ice": (ICE, 50.0)}  # km/h
LANE = 3.5  # m, to the left
LANE_SPEEDS = {False: 80.0, True: 50.0}  # km/h, by whether the road is slippery


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    cars: int = 2_000
    seed: int = 68
    mass: tuple[float, float] = (1000.0, 1300.0)  # kg, unladen
    height: tuple[float, float] = (0.5, 0.65)  # m
    front_torque: float = 1800.0  # N m of each front wheel without anti-lock brakes
    rear_torque: float = 900.0
    rtol: float = 1e-4
    duration: float = 40.0  # s
    program: StopProgram = dataclasses.field(default_factory=StopProgram)
    controllers: tuple[str, ...] = ()  # all
    out: str = "out/experiments/car_controllers"


def drive(controller: Any, low: bool, **parts: Any) -> Loop:
    """Return the loop of a driver with one controller of all brakes; `low` gives both rear wheels the lower command."""
    base = load("car-straight").loop
    brakes = controller if isinstance(controller, dict) else dict.fromkeys(BRAKES, controller)
    channels = PerChannel(brakes, BRAKES)
    controller_of_brakes = SelectLow(controller=channels, groups=(REAR,)) if low else channels
    return replace(base, {"controller": HoldCourse(controller=controller_of_brakes), **parts})


def design_lq(config: Config) -> ProportionalFeedback:
    """Return the LQ gain of a wheel at slip 0.1 and 100 km/h, in proportion to the speed as in the cure of [lmi].

    The weights are the inverse squares of sizes: 1e-3 s of the integral, a slip of 0.02, 1,000 N m (Bryson's rule).
    """
    speed = 100 * KMH
    car = load("car-straight").loop.plant
    road = make_surface(config.program.high, slippery=False)
    wheel = QuarterCar(mass=car.mass / 4, inertia=car.front_wheel_inertia, radius=car.radius, road=road)
    A, B = SlipModel(plant=wheel, slip=0.1, speed=speed).matrices()
    gain = lqr(A, B, np.diag([1e3**2, 50.0**2]), [[1e-3**2]]).gain[0]
    return ProportionalFeedback(gain=gain, reference_speed=speed, low=0.0, high=2000.0, antiwindup=Clamping())


def list_controllers(config: Config) -> dict[str, Callable[[], Loop]]:
    """Return the loops by the names of their controllers."""
    pid = PID(kp=1e4, ki=1.5e5, low=0.0, high=2000.0, antiwindup=Clamping())
    torques = {
        brake: ConstantTorque(torque=config.rear_torque if brake in REAR else config.front_torque) for brake in BRAKES
    }
    seeking = PerTarget(reference=dict.fromkeys(BRAKES.values(), ExtremumSeeking(slip=0.06)))
    logic = FourPhase(torque_low=80.0, torque_high=2000.0, slip_low=0.03, slip_high=0.2, rate=15e3)
    hydraulic = PerControl(actuator=dict.fromkeys(BRAKES, HydraulicBrake()))
    return {
        "constant torque": lambda: drive(torques, low=False),
        "PID of each wheel": lambda: drive(pid, low=False),
        "PID, select-low at the rear": lambda: drive(pid, low=True),
        "PID, extremum seeking": lambda: drive(pid, low=True, reference=seeking),
        "LQ, gain by the speed": lambda: drive(design_lq(config), low=True),
        "sliding mode": lambda: drive(SlidingMode(gain=2000.0, boundary=0.05, low=0.0, high=2000.0), low=True),
        "four phases": lambda: drive(logic, low=False),
        "five phases, hydraulic": lambda: drive(FivePhase(), low=True, actuator=hydraulic),
    }


def draw_cars(config: Config) -> dict[str, np.ndarray]:
    """Return mass and height of the cars by path."""
    random = np.random.default_rng(config.seed)
    ranges = {"plant.mass": config.mass, "plant.height": config.height}
    return {path: random.uniform(*ends, config.cars) for path, ends in ranges.items()}


def shortest(stop: RuleStop, program: StopProgram) -> float:
    """Return the shortest distance from the speed of a stop to 15 km/h on one surface [m]."""
    adhesion = float(program.low if stop.left_side[0] else program.high)
    return ((stop.speed * KMH) ** 2 - (END * KMH) ** 2) / (2 * GRAVITY * adhesion)


def shortest_on(road: Burckhardt, speed: float) -> float:
    """Return the shortest distance on a road whose friction depends on the speed, down to 15 km/h [m]."""
    speeds = np.linspace(END * KMH, speed * KMH, 400)
    greatest = np.asarray(road.friction(np.linspace(1e-3, 1.0, 2000)[:, None], speeds)).max(axis=0)
    return float(np.trapezoid(speeds / (GRAVITY * greatest), speeds))


def brake_on_roads(config: Config, loop: Loop, cars: dict[str, np.ndarray]) -> tuple[dict[str, float | None], int]:
    """Return the excess over the shortest distance on each road, unladen and laden [%], and how many runs are lost."""
    row, lost = {}, 0
    for pair in (("dry", "snow"), ("wet", "ice")):
        surfaces = tuple(ROADS[name][0] for name in pair)
        stops = [
            RuleStop("adhesion", ROADS[name][1], laden, (slippery,) * 2, (slippery,) * 2, NO_EDGE)
            for slippery, name in zip((False, True), pair, strict=True)
            for laden in (False, True)
        ]
        runs = run_stops(loop, solver_of(config), stops, config.program, cars, OBJECTIVES, surfaces=surfaces)
        out = lost_runs(runs, stops)
        distances = np.where(out, np.nan, np.asarray(runs.metrics["distance"]).reshape(out.shape))
        for place, name in enumerate(pair):
            nearest = shortest_on(*ROADS[name])
            row[f"{name}, {ROADS[name][1]:g} km/h [% over least]"] = mean_of(
                100 * (distances[:, 2 * place : 2 * place + 2] / nearest - 1)
            )
        lost += int(out.sum())
    return row, lost


def change_lanes(config: Config, loop: Loop, cars: dict[str, np.ndarray]) -> tuple[dict[str, float | None], int]:
    """Return how far a driver who wants to reach the next lane gets while braking [m], and how many runs are lost."""
    stops = [
        RuleStop("adhesion", LANE_SPEEDS[slippery], laden, (slippery,) * 2, (slippery,) * 2, NO_EDGE)
        for slippery in (False, True)
        for laden in (False, True)
    ]
    lines = {"controller.line": np.full(len(stops), LANE)}
    runs = run_stops(loop, solver_of(config), stops, config.program, cars, OBJECTIVES, per_stop=lines)
    out = lost_runs(runs, stops)
    lateral = np.where(out, np.nan, np.asarray(runs.metrics["lateral"]).reshape(out.shape))
    names = {"lane change, good [m]": lateral[:, :2], "lane change, slippery [m]": lateral[:, 2:]}
    return {name: mean_of(values) for name, values in names.items()}, int(out.sum())


def solver_of(config: Config) -> Adaptive:
    """Return the solver of all runs."""
    return Adaptive(config.rtol, config.duration)


def lost_runs(runs: Run, stops: list[RuleStop]) -> np.ndarray:
    """Return whether each run of each car diverged or did not reach 15 km/h, shape (cars, stops)."""
    return (np.asarray(runs.diverged) | ~np.asarray(runs.stopped)).reshape(-1, len(stops))


def mean_of(values: np.ndarray) -> float | None:
    """Return the mean of the runs that were not lost; None if all were."""
    return float(np.nanmean(values)) if np.isfinite(values).any() else None


def judge(config: Config, name: str, loop: Loop, cars: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the row of a controller."""
    program = config.program
    stops = plan_stops(loop.plant, program)
    runs = run_stops(loop, solver_of(config), stops, program, cars, OBJECTIVES)
    lost = lost_runs(runs, stops)
    metrics = {metric: np.asarray(values).reshape(lost.shape) for metric, values in runs.metrics.items()}
    locked = np.max([values for metric, values in metrics.items() if metric.startswith("locked_")], axis=0)
    met = np.all([_met(row, lost) for row in clause_figures(runs, stops, program) if row.confirmed], axis=0)

    def places(kind: str, slippery: bool | None = None, speed: float | None = None) -> list[int]:
        return [
            i
            for i, stop in enumerate(stops)
            if stop.kind == kind and slippery in (None, stop.left_side[0]) and speed in (None, stop.speed)
        ]

    def mean(values: np.ndarray, at: list[int]) -> float | None:
        return mean_of(np.where(lost, np.nan, values)[:, at])

    def excess(at: list[int]) -> float | None:
        distances = np.array([shortest(stops[i], program) for i in at])
        whole = np.full(lost.shape, np.nan)
        whole[:, at] = metrics["distance"][:, at] / distances - 1
        return mean(100 * whole, at)

    split = places("split")
    on_roads, lost_on_roads = brake_on_roads(config, loop, cars)
    lanes, lost_in_lanes = change_lanes(config, loop, cars)
    work = 1e-3 * np.sum([metrics[name] for name in WORKS], axis=0)
    return {
        "controller": name,
        "good, 120 km/h [% over least]": excess(places("lock", False, program.fast)),
        "slippery, 55 km/h [% over least]": excess(places("adhesion", True)),
        **on_roads,
        "locked, one surface [s]": mean(locked, places("lock") + places("adhesion")),
        "locked, jump down [s]": mean(locked, places("down")),
        "rise, jump up [s]": mean(np.minimum(metrics["rise_time"], 10.0), places("up")),
        "split: distance [m]": mean(metrics["distance"], split),
        "split: yaw [rad]": mean(metrics["yaw"], split),
        "split: lateral [m]": mean(metrics["lateral"], split),
        "split: steering wheel [deg]": mean(np.degrees(program.steering_ratio * metrics["steer"]), split),
        **lanes,
        "brake work, good, 120 km/h [kJ]": mean(work, places("lock", False, program.fast)),
        "all clauses [% of cars]": float(100 * np.mean(met)),
        "lost runs": int(lost.sum()) + lost_on_roads + lost_in_lanes,
    }


def _met(row: Any, lost: np.ndarray) -> np.ndarray:
    """Return whether each car meets a clause."""
    values = np.asarray(row.values)
    within = values >= row.limit if row.at_least else values <= row.limit
    return np.all(within & ~lost[:, list(row.stop_indices)], axis=1)


def figures(table: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figure: distance on two roads and lateral position on a split one."""
    columns = {
        "good, 120 km/h [% over least]": "stopping distance, good road [% over least]",
        "slippery, 55 km/h [% over least]": "stopping distance, slippery road [% over least]",
        "split: lateral [m]": "split road: lateral position [m]",
    }
    figure, axes = plot.sheet(1, 3, title="One car, eight controllers", size=(3.6, 3.0), sharey=True)
    names = [row["controller"] for row in table]
    for ax, (column, words) in zip(axes, columns.items(), strict=True):
        ax.barh(names, [row[column] or 0.0 for row in table], color=plot.COLOURS[0])
        ax.set_xlabel(words)
    axes[0].invert_yaxis()
    return {"controllers": figure}


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config, table = config or Config(), []
    cars = draw_cars(config)
    for name, build in list_controllers(config).items():
        if name in (config.controllers or (name,)):
            table.append(judge(config, name, build(), cars))
            print(table[-1], flush=True)
    record.print_rows("Eight controllers on the same stops", table)
    return record.experiment(config, {"table": table}, figures(table))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    store_numbers(__file__, main(), tolerance=1e-3)
