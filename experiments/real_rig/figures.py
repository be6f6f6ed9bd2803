"""The figures of the study."""

import dataclasses
from typing import Any

import jax
import numpy as np

from diffabs import FixedStep, Loop, run_batch
from diffabs.output import plot
from experiments.real_rig.box import ESTIMATED, KNOWN, NOMINAL, Box, Fixed, batch, columns, drawn
from experiments.real_rig.floor import floor
from experiments.real_rig.judge import Judging, runs

Maps = dict[str, dict[str, Any]]


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two parameters that leave the box: names, units, and how far."""

    x: str
    y: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]


PAIRS = {
    KNOWN: (
        Pair("inertia", "lag", (0.6, 1.6), (0.5e-3, 8e-3)),
        Pair("height", "place", (0.5, 1.4), (0.5, 2.0)),
        Pair("last", "speed", (-0.08, 0.08), (10.0, 120.0)),
    ),
    ESTIMATED: (
        Pair("inertia", "lag", (0.6, 1.6), (0.5e-3, 8e-3)),
        Pair("height", "place", (0.5, 1.4), (0.5, 2.0)),
        Pair("bias", "speed", (-0.3, 0.3), (10.0, 120.0)),
    ),
}
AXES = {  # label, and what a number is multiplied by
    "inertia": ("inertia of the wheel [of nominal]", 1.0),
    "lag": ("lag of the brake [ms]", 1e3),
    "height": ("height of the friction [of nominal]", 1.0),
    "place": ("slip of its peak [of nominal]", 1.0),
    "last": ("relative error of the seen speed [%]", 100.0),
    "bias": ("bias of the accelerometer [m/s^2]", 1.0),
    "speed": ("speed of the start [km/h]", 1.0),
}
LEVELS = (0, 2, 5, 10, 20, 40, 60, 100)  # %
SEEDS = 2


def degradation(loop: Loop, speed: str, config: Judging, count: int) -> Maps:
    """Return the overshoot [%] over pairs of parameters around the nominal point (count, count): the worst of SEEDS
    noises, drawn for each point."""
    maps = {}
    for pair in PAIRS[speed]:
        x, y = np.linspace(*pair.x_range, count), np.linspace(*pair.y_range, count)
        grid = np.meshgrid(x, y, range(SEEDS), indexing="ij")
        points = {name: np.full(grid[0].size, value) for name, value in NOMINAL.items() if _mine(name, speed)}
        points |= {pair.x: grid[0].ravel(), pair.y: grid[1].ravel()}
        if pair.x == "last":
            points["first"] = points["last"]
        worst = runs(loop, points, config, config.seed + 3)
        overshoot = worst["overshoot"].reshape(grid[0].shape).max(axis=2)
        locked = worst["locked"].reshape(grid[0].shape).max(axis=2)
        maps[f"{pair.x}, {pair.y}"] = {
            "x": x.tolist(),
            "y": y.tolist(),
            "overshoot [%]": np.nan_to_num(100 * overshoot, posinf=1e4).tolist(),
            "locks": (locked > 0).tolist(),
        }
    return maps


def _mine(name: str, speed: str) -> bool:
    return name not in (("bias",) if speed == KNOWN else ("first", "last"))


def map_figure(maps: Maps, speed: str, box: Box) -> Any:
    """How it degrades outside of the box, which is drawn."""
    from matplotlib.colors import BoundaryNorm
    from matplotlib.patches import Rectangle

    figure, axes = plot.sheet(
        1,
        len(maps),
        title=f"Overshoot [%] beyond the box, speed {speed}: the worse of {SEEDS} noises at each point",
        size=(4.8, 3.8),
    )
    for ax, pair in zip(axes, PAIRS[speed], strict=True):
        panel = maps[f"{pair.x}, {pair.y}"]
        values = np.clip(np.array(panel["overshoot [%]"]), 0.0, 100.0)
        (x_label, x_scale), (y_label, y_scale) = AXES[pair.x], AXES[pair.y]
        x, y = x_scale * np.array(panel["x"]), y_scale * np.array(panel["y"])
        filled = ax.contourf(x, y, values.T, levels=LEVELS, cmap="viridis", norm=BoundaryNorm(LEVELS, 256))
        figure.colorbar(filled, ax=ax)
        if np.any(panel["locks"]):
            ax.contour(x, y, np.array(panel["locks"], float).T, levels=[0.5], colors="red")
        (x0, x1), (y0, y1) = x_scale * np.array(getattr(box, pair.x)), y_scale * np.array(getattr(box, pair.y))
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor="white", linewidth=1.5))
        plot.label_axes(ax, x_label, y_label, legend=False)
    return figure


def distributions(ones: dict[str, Loop], speed: str, box: Box, fixed: Fixed, config: Judging, count: int) -> Any:
    """How often an overshoot is exceeded, beside the floor."""
    points = drawn(box, speed, count, config.seed)
    figure, (ax,) = plot.sheet(1, 1, title=f"Overshoot over the box, speed {speed}", size=(7.0, 4.6))
    share = 1 - (np.arange(count) + 0.5) / count
    floors = 100 * np.sort(floor(points, speed, fixed))
    ax.plot(floors, share, color="black", linestyle=":", label="floor: the error of the speed alone")
    for i, (name, loop) in enumerate(ones.items()):
        values = 100 * np.sort(runs(loop, points, config, config.seed)["overshoot"])
        style = {"color": plot.COLOURS[i % len(plot.COLOURS)], "linestyle": plot.DASHES[i % len(plot.DASHES)]}
        ax.plot(np.clip(values, 0, 400), share, label=name, **style)
    ax.set_yscale("log")
    ax.set_ylim(1 / count, 1)
    ax.set_xlim(0, 120)
    plot.label_axes(ax, "overshoot [%]", "share of the box that exceeds it")
    return figure


def traces(ones: dict[str, Loop], speed: str) -> Any:
    """Draw slip and torque at the nominal point and under several errors."""
    wrong = {"mass": 6.2, "speed": 70.0, "height": 1.1, "inertia": 1.1, "lag": 2e-3, "delay": 1e-3}
    wrong |= {"first": -0.03, "last": -0.03} if speed == KNOWN else {"bias": 0.1}
    titles = ("nominal, 50 km/h", "70 km/h and much wrong")
    lanes = batch(columns({name: np.array([NOMINAL[name], x]) for name, x in wrong.items()}), 7)
    figure, axes = plot.sheet(2, len(titles), title=f"Slip and torque, speed {speed}", size=(6.0, 3.2))
    for i, (name, loop) in enumerate(ones.items()):
        run = run_batch(loop, lanes, FixedStep(step=1e-3, duration=2.6, kinks=False), trajectories=True)
        trajectory = jax.device_get(run.trajectory)
        style = {"color": plot.COLOURS[i % len(plot.COLOURS)], "linestyle": plot.DASHES[i % len(plot.DASHES)]}
        for column in range(len(titles)):
            sample, on = jax.tree.map(lambda x, at=column: x[at], (trajectory.sample, trajectory.running))
            axes[column].plot(sample.t[on], sample.output.slip[on], label=name, linewidth=1.1, **style)
            axes[len(titles) + column].plot(sample.t[on], sample.control[on], linewidth=0.9, **style)
    for column, title in enumerate(titles):
        axes[column].axhline(0.2, color="black", linewidth=0.8, linestyle=":")
        axes[column].set_ylim(0, 0.6)
        plot.label_axes(axes[column], "", "slip [1]" if column == 0 else "", title, legend=column == 0)
        plot.label_axes(axes[len(titles) + column], "time [s]", "torque [N m]" if column == 0 else "", legend=False)
    return figure


def descents(stages_by_speed: dict[str, Any]) -> Any:
    """How the tunings went: all starts on few lanes, the best of them on many."""
    figure, axes = plot.sheet(1, len(stages_by_speed), title="How the tuning went", size=(5.0, 3.6))
    for ax, (speed, stages) in zip(axes, stages_by_speed.items(), strict=True):
        for i, (stage, tuned) in enumerate(stages.items()):
            for j, start in enumerate(tuned.starts):
                points = start.history
                ax.plot(
                    [p.evaluations for p in points],
                    [p.objective for p in points],
                    "o-",
                    markersize=2.5,
                    color=plot.COLOURS[i % len(plot.COLOURS)],
                    label=stage if j == 0 else None,
                )
        ax.set_yscale("log")
        plot.label_axes(ax, "gradients", "objective", f"speed {speed}")
    return figure
