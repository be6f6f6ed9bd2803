"""The adversary's set, fixed before the first search.

The adversary chooses 124 numbers: 58 factors of the friction along the road (a cubic spline of the distance), 64 errors
of the measured slip, and mass and speed of the start. Each error lasts a millisecond, and the 64 repeat. In units of
their bounds:

    road    |z_i| <= 1,  |z_(i+1) - z_i| <= steepest:   factors 1 + height z
    noise   mean 0, root mean square at most 1, |z_k| <= peak:   errors deviation z
    start   |z| <= 1:   mass and speed from one end of the box of `real_rig` to the other

`feasible` brings any numbers into the set; every search uses it. README.md has the same in a table.
"""

import dataclasses
from typing import Any

import numpy as np

from experiments.real_rig.box import KMH, NOMINAL, Box, Fixed

ROAD, NOISE = "plant.road.factors", "sensor.blocks.0.noise"
Range = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Every number of the set."""

    factors: int = 58
    spacing: float = 0.5  # m, between factors: 28.5 m, more than a stop takes
    height: float = 0.15  # of the friction, up and down
    slope: float = 0.15  # 1/m, of the factor: from the least to the greatest in 2 m
    noises: int = 64  # errors of the slip, played again and again: no 64 ms have more than their share
    deviation: float = Fixed.slip_noise  # greatest root mean square of the errors
    peak: float = 3.0  # of an error, in deviations
    mass: Range = Box.mass  # kg
    speed: Range = Box.speed  # km/h

    @property
    def size(self) -> int:
        """How many numbers."""
        return self.factors + self.noises + 2

    @property
    def blocks(self) -> tuple[slice, slice, slice]:
        """Where road, noise and start stand."""
        noise = slice(self.factors, self.factors + self.noises)
        return slice(0, noise.start), noise, slice(noise.stop, self.size)


def feasible(bounds: Bounds, z: np.ndarray) -> np.ndarray:
    """Return points of the set (n, size) for any numbers; points of the set stay unchanged.

    The road is the mean of two roads: the slope is limited from the beginning, and from the end.
    """
    road, noise, start = (np.array(z[:, block], float) for block in bounds.blocks)
    road = np.clip(road, -1.0, 1.0)
    steepest = bounds.slope * bounds.spacing / bounds.height
    road = 0.5 * (_limited(road, steepest) + _limited(road[:, ::-1], steepest)[:, ::-1])
    noise -= noise.mean(axis=1, keepdims=True)
    noise /= np.maximum(1.0, np.sqrt(np.mean(noise**2, axis=1, keepdims=True)))
    noise = np.clip(noise, -bounds.peak, bounds.peak)
    noise -= noise.mean(axis=1, keepdims=True)
    noise /= np.maximum(1.0, np.abs(noise).max(axis=1, keepdims=True) / bounds.peak)
    return np.concatenate([road, noise, np.clip(start, -1.0, 1.0)], axis=1)


def _limited(z: np.ndarray, steepest: float) -> np.ndarray:
    limited = z.copy()
    for i in range(1, z.shape[1]):
        limited[:, i] = limited[:, i - 1] + np.clip(z[:, i] - limited[:, i - 1], -steepest, steepest)
    return limited


def parameters(bounds: Bounds, z: Any) -> dict[str, Any]:
    """Parameters of the loop by path, for points in units of the bounds (..., size), by the same rule for NumPy and
    JAX."""
    road, noise, start = (z[..., block] for block in bounds.blocks)
    (light, heavy), (slow, fast) = bounds.mass, bounds.speed
    return {
        ROAD: 1.0 + bounds.height * road,
        NOISE: bounds.deviation * noise,
        "plant.mass": 0.5 * (light + heavy) + 0.5 * (heavy - light) * start[..., 0],
        "initial.speed": (0.5 * (slow + fast) + 0.5 * (fast - slow) * start[..., 1]) / KMH,
    }


def nominal(bounds: Bounds) -> np.ndarray:
    """Return the nominal point (1, size): an even road, no noise, 5.75 kg from 50 km/h. The excess counts from
    there."""
    z = np.zeros((1, bounds.size))
    for i, (name, ends) in enumerate((("mass", bounds.mass), ("speed", bounds.speed))):
        z[:, bounds.blocks[2].start + i] = (2 * NOMINAL[name] - sum(ends)) / (ends[1] - ends[0])
    return z


def drawn(bounds: Bounds, count: int, random: np.random.Generator) -> np.ndarray:
    """Random points (count, size): a Gaussian road, correlated over 0.5 to 8 m, Gaussian noise, uniform starts."""
    length = np.exp(random.uniform(np.log(0.5), np.log(8.0), count)) / bounds.spacing
    apart = np.subtract.outer(np.arange(bounds.factors), np.arange(bounds.factors))
    kernels = np.exp(-0.5 * (apart / (length[:, None, None] / 2)) ** 2)
    kernels /= np.sqrt((kernels**2).sum(axis=2, keepdims=True))
    road = 0.7 * np.einsum("nij,nj->ni", kernels, random.normal(size=(count, bounds.factors)))
    noise = random.normal(size=(count, bounds.noises))
    start = random.uniform(-1.0, 1.0, (count, 2))
    return feasible(bounds, np.concatenate([road, noise, start], axis=1))


def corners(bounds: Bounds, count: int, random: np.random.Generator) -> np.ndarray:
    """Return corners of the set (count, size).

    The first ones are those that a person would try: roads that are high, low, or change once or periodically, with a
    square wave as noise. The others have random signs.
    """
    waves = 2 ** random.integers(1, 7, count)  # samples of a wave of noise
    phase = random.integers(0, bounds.noises, count)[:, None]
    noise = np.where((np.arange(bounds.noises) + phase) % waves[:, None] < waves[:, None] / 2, 1.0, -1.0)
    length = np.exp(random.uniform(np.log(4.0), np.log(200.0), count)) / bounds.spacing  # of a wave of the road
    shift = random.uniform(0.0, 1.0, count)[:, None]
    road = np.where((np.arange(bounds.factors) / length[:, None] + shift) % 1.0 < 0.5, 1.0, -1.0)
    start = random.choice([-1.0, 1.0], (count, 2))
    z = np.concatenate([road, noise, start], axis=1)
    z[count // 2 :] = random.choice([-1.0, 1.0], (count - count // 2, bounds.size))
    return feasible(bounds, z)
