"""The paths of a car that brakes on a split road, seen from above: `split.png` beside this file.

python experiments/car_controllers/paths.py
"""

import pathlib
from typing import Any

import jax
import numpy as np

from diffabs import rollout
from diffabs.output import plot
from diffabs.scenario import load

CASES = {  # by what the page says of them
    "select-low at the rear, a driver": [],
    "select-low, hands off": ["controller.gain=0"],
    "each rear wheel by itself": ["controller.controller.groups=[]"],
}
TIMES = 6  # outlines of each car
SIZE = (4.2, 1.7)  # m, of the outline


def follow(changes: list[str]) -> tuple[np.ndarray, ...]:
    """Return place x and y [m] and yaw [rad] over time, up to a stop or a yaw of more than a right angle."""
    scenario = load("car-split", [*changes, "solver.every=20"])
    output = rollout(scenario.loop, scenario.solver, {}).trajectory.sample.output
    columns = [np.asarray(values) for values in (output.distance, output.lateral_position, output.yaw)]
    valid = np.isfinite(columns[0]) & (np.abs(columns[2]) < 0.5 * np.pi)
    return tuple(column[valid] for column in columns)


def draw_paths(paths: dict[str, tuple[np.ndarray, ...]]) -> Any:
    """Return the figure of the paths, with the outline of each car at equal distances."""
    title = "From 50 km/h: asphalt on the left, snow on the right"
    figure, axes = plot.sheet(1, len(paths), title=title, size=(3.2, 1.9), sharey=True)
    corners = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1)]) * np.array(SIZE) / 2
    for ax, (words, (x, y, yaw)) in zip(axes, paths.items(), strict=True):
        ax.axhspan(-6.0, 0.0, color="#dce9f2")
        ax.axhspan(0.0, 9.0, color="#e3e3e3")
        ax.plot(x, y, color=plot.COLOURS[0])
        for i in np.searchsorted(x, np.linspace(x[0], x[-1], TIMES)).clip(max=len(x) - 1):
            turn = np.array([[np.cos(yaw[i]), np.sin(yaw[i])], [-np.sin(yaw[i]), np.cos(yaw[i])]])
            ax.plot(*(corners @ turn + (x[i], y[i])).T, color="black", linewidth=0.8)
        ax.set_aspect("equal")
        ax.set_xlim(-3.0, 26.0)
        ax.set_ylim(-3.0, 6.0)
        plot.label_axes(ax, "x [m]", "y [m]" if ax is axes[0] else "", words)
    return figure


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    figure = draw_paths({words: follow(changes) for words, changes in CASES.items()})
    figure.savefig(pathlib.Path(__file__).with_name("split.png"), dpi=110)
