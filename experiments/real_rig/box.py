"""The box of the study, fixed before the first run: the unknowns of the rig.

Each unknown is uniform within its range, and independent of the others. `Fixed` has the known numbers. The vehicle's
speed is either known, with an error that drifts, or estimated from the wheel's speed and an accelerometer. README.md
has the same numbers in a table.
"""

import dataclasses
import itertools
from typing import Any

import numpy as np
from scipy.stats import qmc

from diffabs import Batch
from diffabs.parts.roads import RIG

KMH = 3.6
KNOWN, ESTIMATED = "known", "estimated"  # the vehicle's speed
Range = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Fixed:
    """The numbers that are equal in every run."""

    torque: Range = (0.0, 9.03)  # N m
    known_mass: float = 5.75  # kg, whose holding torque is fed forward
    slip: float = 0.2  # target; an overshoot is a fraction of it
    end: float = 5.0  # km/h, where a run ends
    period: float = 1e-3  # s, of the controller, the noises and the accelerometer
    slip_noise: float = 0.005  # standard deviation, of the measured slip
    quantum: float = 0.02  # m/s, of the wheel's speed
    acceleration_noise: float = 0.1  # m/s^2, standard deviation
    drift: float = 0.5  # s, time constant with which the error of a known speed goes from the first to the last


@dataclasses.dataclass(frozen=True)
class Box:
    """Ranges of the unknowns.

    Factors multiply the values of Maeda and Sugiura. They are the height of the friction curve, the place of its peak
    (mu(slip) = height mu0(slip/place)), and the wheel's inertia.
    """

    mass: Range = (5.3, 6.2)  # kg
    speed: Range = (20.0, 70.0)  # km/h, of the start
    height: Range = (0.9, 1.1)
    place: Range = (0.9, 1.1)
    inertia: Range = (0.9, 1.1)
    lag: Range = (0.5e-3, 2e-3)  # s, of the brake
    delay: Range = (0.0, 1e-3)  # s, of computing
    first: Range = (-0.03, 0.03)  # relative error of a known speed at the start; below 0 it is seen low
    last: Range = (-0.03, 0.03)  # that to which it drifts
    bias: Range = (-0.1, 0.1)  # m/s^2, of the accelerometer's deceleration

    def ranges(self, speed: str) -> dict[str, Range]:
        """Return the ranges that matter under a known, or an estimated, speed."""
        whose = {"first": KNOWN, "last": KNOWN, "bias": ESTIMATED}
        return {name: r for name, r in dataclasses.asdict(self).items() if whose.get(name, speed) == speed}


INERTIA = 7.53e-3  # kg m^2
NOMINAL = {"mass": 5.75, "speed": 50.0, "height": 1.0, "place": 1.0, "inertia": 1.0, "lag": 1e-3, "delay": 0.0}
NOMINAL |= {"first": 0.0, "last": 0.0, "bias": 0.0}
SENSOR = {"first": "sensor.blocks.2.first", "last": "sensor.blocks.2.last", "bias": "sensor.blocks.3.deceleration"}


def drawn(box: Box, speed: str, count: int, seed: int) -> dict[str, np.ndarray]:
    """Independent uniform points of the box (count,), by name."""
    ranges = box.ranges(speed)
    random = np.random.default_rng(seed).uniform(size=(count, len(ranges)))
    return {n: low + (high - low) * random[:, i] for i, (n, (low, high)) in enumerate(ranges.items())}


def spread(box: Box, speed: str, count: int, seed: int) -> dict[str, np.ndarray]:
    """Return points of a scrambled Sobol sequence, for the tuning."""
    ranges = box.ranges(speed)
    points = qmc.Sobol(len(ranges), rng=np.random.default_rng(seed)).random(count)
    return {n: low + (high - low) * points[:, i] for i, (n, (low, high)) in enumerate(ranges.items())}


def corners(box: Box, speed: str, seeds: int = 1) -> dict[str, np.ndarray]:
    """Return all corners, each as often as there are seeds of the noise."""
    ranges = box.ranges(speed)
    points = np.repeat(np.array(list(itertools.product(*ranges.values()))), seeds, axis=0)
    return dict(zip(ranges, points.T, strict=True))


def columns(points: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return parameters of the loop by path, for points by name. Unnamed parameters are nominal."""
    at = {**{name: np.full(1, value) for name, value in NOMINAL.items()}, **points}
    h, c = at["height"], at["place"]
    road = {"w1": RIG.w1 * h / c, "w2": RIG.w2 * h / c**2, "w3": RIG.w3 * h / c**3, "w4": RIG.w4 * h}
    road["a"] = RIG.a * c**RIG.q
    values = {
        **{path: at[name] for name, path in SENSOR.items() if name in points},
        "plant.mass": at["mass"],
        "plant.wheel_inertia": INERTIA * at["inertia"],
        "initial.speed": at["speed"] / KMH,
        "actuator.time_constant": at["lag"],
        "controller.delay": at["delay"],
        **{f"plant.road.{name}": value for name, value in road.items()},
    }
    count = max(len(value) for value in values.values())
    return {path: np.broadcast_to(value, count) for path, value in values.items()}


def batch(values: dict[str, Any], seed: int) -> Batch:
    """Lanes with a key each."""
    count = len(next(iter(values.values())))
    return Batch(values, np.arange(count) + seed * 2**24)
