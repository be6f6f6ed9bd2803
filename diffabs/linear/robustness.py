"""Margins of a loop over a box of parameters: at its corners, and at samples inside."""

import itertools
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffabs.core.channels import need_single_control
from diffabs.core.jax_flags import default_flags
from diffabs.core.pytree import replace
from diffabs.core.shapes import Float
from diffabs.core.types import JsonObject, Scalar
from diffabs.linear.opened_loop import OpenLoop, open_loop
from diffabs.linear.stability_margins import Margins, margins
from diffabs.loop.closed_loop import Loop

MAX_BAND_CORNERS = 2**10

# A number for each margin that is larger for a worse margin.
BADNESS: Mapping[str, Callable[[Margins], float]] = {
    "gain_up": lambda m: -m.gain[1],
    "gain_down": lambda m: m.gain[0],
    "phase": lambda m: -m.phase,
    # NaN: the search for a delay that makes the loop unstable ended first. That is better than any number found.
    "delay": lambda m: -sys.float_info.max if math.isnan(m.delay) else -m.delay,
    "modulus": lambda m: m.sensitivity,
    "sensitivity": lambda m: m.sensitivity,
    "complementary": lambda m: m.complementary,
}


class System(NamedTuple):
    """A loop at one point of the box.

    Attributes:
        values: Values of the parameters, by path.
        loop: The open loop.
        margins: Its margins.
    """

    values: dict[str, float]
    loop: OpenLoop
    margins: Margins


class Band(NamedTuple):
    """The systems of a box of parameters.

    Attributes:
        systems: The systems at the corners, then those at the samples inside.
        corners: Number of distinct corners.
    """

    systems: tuple[System, ...]
    corners: int

    @property
    def unstable(self) -> tuple[System, ...]:
        """Systems with an unstable closed loop."""
        return tuple(system for system in self.systems if not system.margins.stable)

    def worst(self) -> dict[str, System]:
        """Return the system with the worst value of each margin, by its name in `BADNESS`; empty without
        systems, or if one is unstable.

        The names are `gain_up`, `gain_down`, `phase`, `delay`, `modulus`, `sensitivity` and `complementary`.
        """
        if self.unstable or not self.systems:
            return {}
        return {name: max(self.systems, key=lambda s, bad=bad: bad(s.margins)) for name, bad in BADNESS.items()}

    def record(self) -> JsonObject:
        """Return the systems, the worst value of each margin and its place, and two counts, as JSON values."""
        worst = self.worst().items()
        return {
            "systems": [{"values": system.values, **system.margins.record()} for system in self.systems],
            "corners": self.corners,
            "unstable": len(self.unstable),
            "worst": {name: {"value": s.margins.record()[name], "values": s.values} for name, s in worst},
        }


@default_flags()
def band(loop: Loop, over: Mapping[str, Sequence[float]], samples: int = 32, target: Scalar | None = None) -> Band:
    """Return the margins of a loop over a box {path: (low, high)}: at its corners, and at samples that fill it evenly.

    Equal corners count once, so a range with low = high adds none. If low = high in all ranges, there are no samples.

    Args:
        loop: Loop to examine.
        over: Range (low, high) of each parameter, by path, in the parameter's unit.
        samples: Number of samples inside the box.
        target: Setpoint, as in `open_loop`.

    Raises:
        ValueError: A range is inverted, there are more than 10 ranges, or the loop has no linear model at a point.
        KeyError: A path does not exist.
    """
    need_single_control(loop.plant, "a band of margins")
    free = {path: (float(low), float(high)) for path, (low, high) in over.items()}
    for path, (low, high) in free.items():
        if not low <= high:
            raise ValueError(f"{path}: the range ({low:g}, {high:g}) is inverted")
    if 2 ** len(free) > MAX_BAND_CORNERS:
        raise ValueError(f"{len(free)} ranges have {2 ** len(free)} corners; at most {MAX_BAND_CORNERS} are looked at")
    systems = []
    for at in box_points(list(free.values()), samples):
        values = dict(zip(free, map(float, at), strict=True))
        opened = open_loop(replace(loop, values), target)
        systems.append(System(values, opened, margins(opened)))
    return Band(tuple(systems), len(set(itertools.product(*free.values()))))


def box_points(ranges: Sequence[tuple[float, float]], samples: int) -> list[tuple[float, ...]]:
    """Return the distinct corners of a box of ranges (low, high), then samples inside that fill it evenly."""
    corners = list(dict.fromkeys(itertools.product(*ranges)))
    low, high = np.array(ranges).reshape(-1, 2).T
    inside = low_discrepancy_points(samples if (low < high).any() else 0, len(ranges))
    return [*corners, *map(tuple, (low + (high - low) * inside).tolist())]


def low_discrepancy_points(count: int, dimensions: int) -> Float[np.ndarray, "{count} {dimensions}"]:
    """Return points (count, dimensions) that fill the unit cube evenly, the same in every call.

    Coordinate i of point k is 1/2 + k/x^i modulo 1, both counted from 1. Here x is the root of x^(d+1) = x + 1
    (Roberts, 2018). In one dimension the root is the golden ratio.
    """
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (dimensions + 1))
    steps = root ** -np.arange(1, dimensions + 1)
    return (0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0


def frequencies(loops: Sequence[OpenLoop]) -> Float[np.ndarray, " n"]:
    """Return 400 frequencies [rad/s] around the crossovers of these loops, as `frequencies_around`."""
    return frequencies_around([margins(loop).crossover for loop in loops], [loop.period for loop in loops])


def frequencies_around(
    crossovers: Sequence[float], periods: Sequence[float | None], decades: float = 1.5, count: int = 400
) -> Float[np.ndarray, " {count}"]:
    """Return logarithmically spaced frequencies (count,) [rad/s], `decades` beyond the crossovers [rad/s].

    They end at half the lowest sampling rate at most; the periods [s] are None in continuous time. Without any
    crossover they surround 1 rad/s.
    """
    finite = [crossover for crossover in crossovers if math.isfinite(crossover)] or [1.0]
    low, high = min(finite) * 10**-decades, max(finite) * 10**decades
    half = [math.pi / period for period in periods if period]
    return np.geomspace(low, min([high, *half]), count)


def loop_responses(loops: Sequence[OpenLoop], w: np.ndarray) -> np.ndarray:
    """Return L, complex, (k, n, p, p), of k loops with p channels at n frequencies [rad/s]."""
    return np.array([loop.transfer().response(w) for loop in loops])


def sensitivity_gains(opened: np.ndarray) -> tuple[Float[np.ndarray, "k n"], ...]:
    """Return |S| and |T|, each (k, n), of k loops at n frequencies from L, (k, n, p, p).

    Of a loop with several channels they are the largest singular values.
    """
    identity = np.eye(opened.shape[-1])
    sensitivity = np.linalg.inv(identity + opened)
    return tuple(np.linalg.norm(gain, 2, axis=(2, 3)) for gain in (sensitivity, identity - sensitivity))


def shape_bound(shape: Sequence[tuple[float, float]], w: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the bound of |S| at frequencies [rad/s] by rows (frequency [rad/s], bound).

    It is straight between the rows on logarithmic axes, and constant outside.
    """
    at, limits = np.log(np.array(shape).T)
    return np.exp(np.interp(np.log(w), at, limits))
