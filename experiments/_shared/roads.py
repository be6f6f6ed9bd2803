"""The roads and cars of `pid_over_roads` and `best_slip`: drawn ranges, and the shortest stop that friction allows."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.stats import qmc

from diffabs import Batch
from diffabs.output import plot
from diffabs.parts.plants import GRAVITY
from diffabs.parts.roads import MagicFormula


@dataclasses.dataclass(frozen=True)
class Roads:
    """How many roads are drawn, and from which ranges."""

    roads: int = 256  # for tuning; powers of two, for Sobol's sequence
    held_out: int = 2048
    seed: int = 1
    peak_slip: tuple[float, float] = (0.05, 0.2)
    peak_mu: tuple[float, float] = (0.1, 1.1)
    shape: tuple[float, float] = (1.2, 1.7)  # C of the Magic Formula
    curvature: tuple[float, float] = (-1.0, 0.5)  # E
    mass: tuple[float, float] = (12.0, 20.0)  # kg
    speed: tuple[float, float] = (40.0, 120.0)  # km/h
    uniform: float = 1 / 3  # of the roads, without a patch
    patch: tuple[float, float] = (0.15, 0.65)  # where it begins, of the shortest distance on the first surface
    width: float = 0.3  # m, of the patch's edge


class Family(NamedTuple):
    """Roads and cars: values by path, shortest distance [m] and time [s] that friction allows."""

    values: dict[str, Any]
    distance: np.ndarray
    time: np.ndarray

    def batch(self) -> Batch:
        """Return lanes that count relative to their shortest distance."""
        return Batch(self.values, weights=1 / self.distance, durations=1.3 * self.time + 1.0)

    def with_paper(self, share: float) -> Batch:
        """Return these lanes, and the paper's own car and road, which has this share of the whole weight."""
        road, v, n = MagicFormula(), 100 / plot.KMH, len(self.time)
        papers = {"plant.mass": 15.0, "initial.speed": v, "plant.road.edges": [1e4]}
        for i in (0, 1):
            papers |= {f"plant.road.roads.{i}.{name}": getattr(road, name) for name in ("B", "C", "D", "E")}
        values = {path: np.concatenate([column, [papers[path]]]) for path, column in self.values.items()}
        distance, time = v**2 / (2 * GRAVITY * road.D), v / (GRAVITY * road.D)
        weights = np.concatenate([(1 - share) / n / self.distance, [share / distance]]) * (n + 1)
        return Batch(values, weights=weights, durations=1.3 * np.append(self.time, time) + 1.0)


def stiffness(peak_slip: float, shape: float, curvature: float) -> float:
    """Return B of a Magic Formula whose peak is at this slip.

    C arctan(x - E (x - arctan x)) = pi/2 holds at x = B slip.
    """
    level = math.tan(math.pi / (2 * shape))
    return brentq(lambda x: x - curvature * (x - math.atan(x)) - level, 0.0, 1e3) / peak_slip


def family(config: Roads, count: int, seed: int) -> Family:
    """Return roads and cars of a scrambled Sobol sequence. Frictions of patches and peak slips are in logarithms."""
    u = qmc.Sobol(9, rng=np.random.default_rng(seed)).random(count).T

    def between(ends: tuple[float, float], part: np.ndarray, *, log: bool = False) -> np.ndarray:
        low, high = ends
        return low * (high / low) ** part if log else low + (high - low) * part

    plain = u[6] < config.uniform
    again = (u[6] - config.uniform) / (1 - config.uniform)
    mu, slip = between(config.peak_mu, u[1]), between(config.peak_slip, u[0], log=True)
    shape, curvature = between(config.shape, u[2]), between(config.curvature, u[3])
    mass, v = between(config.mass, u[4]), between(config.speed, u[5]) / plot.KMH
    second_mu = np.where(plain, mu, between(config.peak_mu, np.maximum(again, 0), log=True))
    second_slip = np.where(plain, slip, between(config.peak_slip, u[8], log=True))
    edge = between(config.patch, u[7]) * v**2 / (2 * GRAVITY * mu)
    later = np.sqrt(v**2 - 2 * GRAVITY * mu * edge)
    values = {"plant.mass": mass, "initial.speed": v, "plant.road.edges": edge[:, None]}
    for i, (s, d) in enumerate(((slip, mu), (second_slip, second_mu))):
        b = np.array([stiffness(*x) for x in zip(s, shape, curvature, strict=True)])
        for name, column in {"B": b, "C": shape, "D": d, "E": curvature}.items():
            values[f"plant.road.roads.{i}.{name}"] = column
    return Family(
        values,
        edge + later**2 / (2 * GRAVITY * second_mu),
        (v - later) / (GRAVITY * mu) + later / (GRAVITY * second_mu),
    )
