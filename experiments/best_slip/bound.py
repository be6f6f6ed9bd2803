"""The shortest stop of a car on a road of `pid_over_roads`, under any control of its brake.

Let F(s, u) = (r/J)(u - r mu m g) - (1 - s) mu g and dt = v dtau. Then ds/dtau = F, d ln v/dtau = -mu g and dx/dtau =
v^2, so the slip does not depend on the speed. F grows with the torque u. So from slip 0 the whole torque gives the
greatest slip at any tau. Up to the peak more slip is more friction. The car that is slowest at every place therefore
brakes with the whole torque up to the peak, and holds the peak. If the torque is too weak for the peak, it holds the
greatest slip that it can. On one surface such a stop exists, and the bound is

    x = int_0^s1 v^2/F ds + v1^2/(2 mu(s1) g),    v = v0 exp(-int_0^s mu g/F ds),    s1 the peak, or the root of F

The simpler v0^2/(2 mu_max g), `friction`, has the peak's friction from the first instant. On a road with an edge
(surfaces mix over `width`) the bound takes that car up to the edge. Behind the edge it takes the friction of each
place's peak. No car changes its slip at once, so no stop attains the bound there.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from diffabs.parts.plants import GRAVITY, QuarterCar
from experiments._shared.roads import stiffness

POINTS = 4000  # of the quadrature: 1e-7 of the distance
DEPTH = 25.0  # a slip that only comes near its end is followed to exp(-25) of it
INERTIA = 1.0539  # kg m^2, of the cars of `pid_over_roads`


class Bound(NamedTuple):
    """Of each lane: the bound and two conditions under which it holds.

    - distance: the bound [m].
    - friction: the distance at the peak's friction alone [m].
    - slips: the slip of the peak on both surfaces [1].
    - attained: one surface only, so that a stop attains the bound.
    - weak: the torque is too weak for the peak of the first surface.
    """

    distance: np.ndarray
    friction: np.ndarray
    peaks: tuple[np.ndarray, np.ndarray]
    attained: np.ndarray
    weak: np.ndarray


class Way(NamedTuple):
    """Braking with all the torque, (points, lanes): places [m] and speeds [m/s]; friction at the end [1] (lanes,)."""

    places: np.ndarray
    speeds: np.ndarray
    friction: np.ndarray
    weak: np.ndarray


def bound(values: Mapping[str, Any], torque: float, width: float) -> Bound:
    """Return the bounds of lanes with these values by path, for a greatest torque [N m] and a width of the edges
    [m]."""
    surfaces = [{n: np.asarray(values[f"plant.road.roads.{i}.{n}"]) for n in "BCDE"} for i in (0, 1)]
    first, second = surfaces
    peaks = [np.array([stiffness(1.0, c, e) for c, e in zip(s["C"], s["E"], strict=True)]) / s["B"] for s in surfaces]
    mass, v0 = np.asarray(values["plant.mass"]), np.asarray(values["initial.speed"])
    edge = np.asarray(values["plant.road.edges"])[:, 0]
    way = whole_torque(first, peaks[0], mass, v0, torque)
    uniform = np.all([first[n] == second[n] for n in "BCDE"], axis=0)
    alone = way.places[-1] + way.speeds[-1] ** 2 / (2 * GRAVITY * way.friction)
    before = edge - width / 2
    v = np.maximum(speed_at(way, before) ** 2 - GRAVITY * (first["D"] + second["D"]) * width, 0.0)
    mixed = before + width + v / (2 * GRAVITY * second["D"])
    later = np.maximum(v0**2 - 2 * GRAVITY * first["D"] * edge, 0.0)
    friction = np.where(uniform, v0**2 / (2 * GRAVITY * first["D"]), edge + later / (2 * GRAVITY * second["D"]))
    return Bound(np.where(uniform, alone, mixed), friction, (peaks[0], peaks[1]), uniform, way.weak)


def mu(surface: Mapping[str, Any], slip: Any) -> Any:
    """The Magic Formula, in NumPy."""
    x = surface["B"] * slip
    return surface["D"] * np.sin(surface["C"] * np.arctan(x - surface["E"] * (x - np.arctan(x))))


def whole_torque(surface: Mapping[str, Any], peak: np.ndarray, mass: np.ndarray, v0: np.ndarray, torque: float) -> Way:
    """Return the braking from slip 0 to the peak, or to the greatest slip that the torque reaches."""
    radius = float(QuarterCar().radius)

    def rate(slip: Any) -> Any:
        friction = mu(surface, slip)
        return radius / INERTIA * (torque - radius * friction * mass * GRAVITY) - (1 - slip) * friction * GRAVITY

    low, high = np.zeros_like(peak), peak.copy()
    weak = rate(peak) <= 0
    for _ in range(60):
        middle = 0.5 * (low + high)
        more = rate(middle) > 0
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    y = np.linspace(0.0, 1.0, POINTS + 1)[:, None]
    near = np.exp(-DEPTH * y)
    slip = np.where(weak, low * (1 - near), peak * y)
    change = np.where(weak, low * DEPTH * near, peak) / np.maximum(rate(slip), 1e-300)
    speeds = v0 * np.exp(-_integral(GRAVITY * mu(surface, slip) * change))
    return Way(_integral(speeds**2 * change), speeds, mu(surface, slip[-1]), weak)


def speed_at(way: Way, place: np.ndarray) -> np.ndarray:
    """Speed [m/s] at a place [m] of each lane, 0 where it stands before."""
    after = way.speeds[-1] ** 2 - 2 * GRAVITY * way.friction * (place - way.places[-1])
    columns = zip(place, way.places.T, way.speeds.T, strict=True)
    inside = np.array([np.interp(x, places, speeds) for x, places, speeds in columns])
    return np.where(place < way.places[-1], inside, np.sqrt(np.maximum(after, 0.0)))


def _integral(rates: np.ndarray) -> np.ndarray:
    """By the trapezoidal rule from the first point on, over [0, 1]."""
    steps = 0.5 * (rates[1:] + rates[:-1]) / POINTS
    return np.concatenate([np.zeros((1, rates.shape[1])), np.cumsum(steps, axis=0)])
