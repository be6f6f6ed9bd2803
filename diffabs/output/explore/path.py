"""The path of a run seen from above, with outlines of the vehicle, and the road under its wheels.

It is a function of signals: the plant's outputs have `distance`, `lateral_position` and `yaw`. A plant with a method
`wheel_places` has outlines, and a road whose friction its tyres state.
"""

from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.protocols import Tyre
from diffabs.core.types import Array, Part, PyTree
from diffabs.output.explore.panels import Path, Strip

PATH_SIGNALS = ("distance", "lateral_position", "yaw")
PATH_RATIO = 6.0  # width of the drawn window over its height; that of the chart's axes on the screen
MARGIN = 1.5  # m around the path and the outlines
OUTLINES = 6  # of the vehicle, at equal lengths of the path
OVERHANG, CHAMFER, SIDE = 0.75, 0.35, 0.15  # m beyond the wheels, at both ends and at the sides; a chamfer is in front
ROAD_PLACES = 240  # along the road, at which the friction is evaluated
TEST_SLIPS = 100  # slips up to 1, among which the friction has its greatest value
TEST_LOAD = 3000.0  # N of a wheel, for tyres whose friction depends on the load a little
FRICTION_STEP = 0.02  # frictions that differ by less are one surface


def trace_path(t: np.ndarray, output: PyTree, plant: Part) -> Path | None:
    """Return the path of a run from the outputs at its instants [s], or None for a plant without one."""
    if not set(PATH_SIGNALS) <= {*type(output)._fields}:
        return None
    x, y, yaw = (np.asarray(getattr(output, name), float) for name in PATH_SIGNALS)
    going = np.isfinite(x + y + yaw)
    t, x, y, yaw = (values[going] for values in (t, x, y, yaw))
    wheels = tuple(plant.wheel_places().values()) if hasattr(plant, "wheel_places") and len(x) else ()
    outlines = _outlines(x, y, yaw, wheels)
    window = _window(np.concatenate([np.stack([x, y], axis=1), outlines.reshape(-1, 2)]))
    speed = float(np.hypot(*(np.gradient(values, t)[0] for values in (x, y)))) if len(t) > 1 else 0.0
    return Path(t, x, y, yaw, outlines, window, _strips(wheels, window, speed))


def _outlines(x: np.ndarray, y: np.ndarray, yaw: np.ndarray, wheels: tuple[Any, ...]) -> np.ndarray:
    """Return closed outlines (vehicles, corners, 2) [m] at equal lengths of a path."""
    if not wheels:
        return np.empty((0, 0, 2))
    along, across = (np.array([float(getattr(wheel, name)) for wheel in wheels]) for name in ("x", "y"))
    rear, front, side = along.min() - OVERHANG, along.max() + OVERHANG, np.abs(across).max() + SIDE
    half = np.array([(rear, side), (front - CHAMFER, side), (front, side - CHAMFER)])
    corners = np.concatenate([half, half[::-1] * (1, -1), half[:1]])
    length = np.append(0.0, np.cumsum(np.hypot(np.diff(x), np.diff(y))))
    places = np.searchsorted(length, np.linspace(0.0, length[-1], OUTLINES)).clip(max=len(x) - 1)
    turned = []
    for place in np.unique(places):
        cosine, sine = np.cos(yaw[place]), np.sin(yaw[place])
        turned.append(corners @ np.array([[cosine, sine], [-sine, cosine]]) + (x[place], y[place]))
    return np.array(turned)


def _window(points: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the limits of x and y around some points (n, 2) [m], in the ratio of the chart."""
    low, high = points.min(axis=0, initial=0.0) - MARGIN, points.max(axis=0, initial=0.0) + MARGIN
    middle, width = (low + high) / 2, max(high[0] - low[0], PATH_RATIO * (high[1] - low[1]))
    (x_low, y_low), (x_high, y_high) = (middle + sign * np.array([width, width / PATH_RATIO]) / 2 for sign in (-1, 1))
    return (float(x_low), float(x_high)), (float(y_low), float(y_high))


def _strips(
    wheels: tuple[Any, ...], window: tuple[tuple[float, float], tuple[float, float]], speed: float
) -> tuple[Strip, ...]:
    """Return the surfaces of the left and the right half of a road; none where the tyres of a half differ."""
    if not wheels:
        return ()
    places = np.linspace(*window[0], ROAD_PLACES)
    frictions = np.array([friction_along(wheel.tyre, places, speed) for wheel in wheels])
    on_left = np.array([float(wheel.y) > 0 for wheel in wheels])
    bottom, top = window[1]
    halves = {(0.0, top): frictions[on_left], (bottom, 0.0): frictions[~on_left]}
    if np.ptp(frictions, axis=0).max() < FRICTION_STEP:
        halves = {window[1]: frictions}
    return tuple(
        Strip(x, y, friction)
        for y, values in halves.items()
        if y[0] < y[1] and np.ptp(values, axis=0).max() < FRICTION_STEP
        for x, friction in _surfaces(places, values[0])
    )


def _surfaces(places: np.ndarray, friction: np.ndarray) -> list[tuple[tuple[float, float], float]]:
    """Return ((first, last place), friction) of each surface of a road."""
    starts = [0]
    for i, value in enumerate(friction):
        if abs(value - friction[starts[-1]]) >= FRICTION_STEP:
            starts.append(i)
    ends = pairwise([*starts, len(places) - 1])
    return [((float(places[i]), float(places[j])), float(friction[i])) for i, j in ends if i < j]


@jax.jit
def friction_along(tyre: Tyre, places: Array, speed: Array) -> Array:
    """Return the greatest friction coefficient (n,) [1] of a tyre at n places [m] on its road, at a speed [m/s]."""
    slips = jnp.linspace(0.0, 1.0, TEST_SLIPS + 1)[1:]

    def greatest(place: Array) -> Array:
        return jnp.max(jax.vmap(lambda slip: tyre.braking_force(slip, TEST_LOAD, speed, place))(slips)) / TEST_LOAD

    return jax.vmap(greatest)(places)
