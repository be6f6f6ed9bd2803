"""Does the estimator of Aoki and Nakamura find the best slip of a road that changes under the car?

Their introduction aims at this: the best slip changes with the road, so it has to be estimated during the stop. The
paper's car (15 kg, from 100 km/h, the Magic Formula identified from its tables) brakes on its own road up to an edge.
Behind it lies a more slippery surface, whose peak lies at another slip. `best_slip/bound.py` bounds each stop.

    python experiments/slip_estimator/run.py changing-road
"""

import dataclasses
import itertools
from typing import Any

import jax
import numpy as np

from diffabs import Batch, FixedStep, run_batch
from diffabs.papers import record
from diffabs.parts.controllers import PID
from diffabs.parts.objectives import BRAKING
from diffabs.parts.plants import GRAVITY, QuarterCar
from diffabs.parts.references import FixedSlip, PeakLatch
from diffabs.parts.roads import MagicFormula, Patches
from diffabs.parts.stops import Standstill
from diffabs.scenario.defaults import braking
from experiments.best_slip.bound import INERTIA, bound

OWN = MagicFormula()
RULES = {"conventional, slip 0.2": FixedSlip(), "proposed, latch": PeakLatch()}


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    heights: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)  # of the second peak, of the first
    places: tuple[float, ...] = (0.5, 0.6, 0.8, 1.0, 1.2, 1.4, 1.7, 2.0)  # its slip, of the first peak's
    edges: tuple[float, ...] = (0.1, 0.3, 0.5, 0.7)  # of the shortest distance on the first surface
    speed: float = 100.0  # km/h
    mass: float = 15.0  # kg
    torque: float = 90.0  # N m
    width: float = 0.3  # m, of the edge
    ki: float = 5000.0  # N m/s: the paper's PI
    stop: float = 2.0  # m/s; from there at the last deceleration
    step: float = 1e-3  # s
    longest: float = 80.0  # s
    out: str = "out/experiments/slip_estimator/changing_road"


def roads(config: Config) -> dict[str, Any]:
    """Return the values of all roads by path, for every height, place and edge."""
    height, place, edge = np.array(list(itertools.product(config.heights, config.places, config.edges))).T
    v = config.speed / 3.6
    values = {
        "plant.mass": np.full(len(edge), config.mass),
        "initial.speed": np.full(len(edge), v),
        "plant.road.edges": (edge * v**2 / (2 * GRAVITY * OWN.D))[:, None],
    }
    for i, (d, b) in enumerate(((1.0, 1.0), (height, 1 / place))):
        formula = {"B": OWN.B * b, "C": OWN.C, "D": OWN.D * d, "E": OWN.E}
        values |= {f"plant.road.roads.{i}.{name}": np.broadcast_to(x, len(edge)).copy() for name, x in formula.items()}
    return values | {"height": height, "place": place}


def excess(config: Config, reference: Any, values: dict[str, Any]) -> np.ndarray:
    """Return the distance of each stop over its bound, less one; NaN for a car that does not stop."""
    road = Patches(roads=(OWN, OWN), edges=np.array([10.0]), width=config.width)
    loop = braking(
        plant=QuarterCar(inertia=INERTIA, mass=config.mass, road=road),
        reference=reference,
        controller=PID(kp=3893.0, ki=config.ki, low=0.0, high=config.torque),
        stop=Standstill(speed=config.stop),
    )
    lanes = {path: value for path, value in values.items() if "." in path}
    solver = FixedStep(step=config.step, duration=config.longest)
    runs = jax.device_get(run_batch(loop, Batch(lanes), solver, {"distance": BRAKING["stop_distance"]}))
    shortest = bound(lanes, config.torque, config.width).distance
    return np.where(runs.stopped & ~runs.diverged, runs.metrics["distance"] / shortest - 1, np.nan)


def line(name: str, values: dict[str, Any], above: np.ndarray) -> dict[str, Any]:
    """Return a row of the table: mean, worst and where, in per cent of the bound."""
    worst = int(np.nanargmax(above))
    return {
        "rule": name,
        "roads": len(above),
        "not stopped": int(np.isnan(above).sum()),
        "mean [%]": 100 * float(np.nanmean(above)),
        "worst [%]": 100 * float(above[worst]),
        "height there": float(values["height"][worst]),
        "place there": float(values["place"][worst]),
    }


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    values = roads(config)
    excesses = {name: excess(config, reference, values) for name, reference in RULES.items()}
    rows = [line(name, values, above) for name, above in excesses.items()]
    record.print_rows("Distance above the bound, on a road that changes to a slippery one", rows)
    places: list[dict[str, Any]] = [
        {"place of the peak": p}
        | {name: 100 * float(np.nanmean(above[values["place"] == p])) for name, above in excesses.items()}
        for p in config.places
    ]
    record.print_rows("By the slip of the second peak, relative to the first: mean above the bound [%]", places)
    return record.experiment(config, {"table": rows, "by place": places}, {})
