"""The figures of the study."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from diffabs import replace, rollout
from diffabs.output import plot
from experiments.adversary.attack import Attack
from experiments.adversary.bounds import NOISE, drawn, parameters
from experiments.adversary.search import Log

KMH = 3.6


def cost_figure(logs_by_loop: Mapping[str, Mapping[str, Log]], nominals: Mapping[str, float], budget: int) -> Any:
    """Excess over the cost, of each search of each controller: medians, and from the least to the greatest seed."""
    figure, axes = plot.sheet(
        2, -(-len(logs_by_loop) // 2), title="Excess overshoot found, over its cost", size=(4.4, 3.2)
    )
    for ax, (name, logs) in zip(axes, logs_by_loop.items(), strict=False):
        for i, (search, log) in enumerate(logs.items()):
            cost = np.array([spent for spent, _ in log.history])
            excess = 100 * (np.array([values for _, values in log.history]) - nominals[name])
            ax.step(
                cost, np.median(excess, axis=1), where="post", color=plot.COLOURS[i], ls=plot.DASHES[i], label=search
            )
            ax.fill_between(
                cost, excess.min(axis=1), excess.max(axis=1), color=plot.COLOURS[i], alpha=0.15, lw=0, step="post"
            )
        ax.set_xscale("log")
        ax.set_xlim(60, budget)
        ax.set_ylim(bottom=0)
        plot.label_axes(ax, "cost [runs]", "excess overshoot [%]", name, legend=False)
        ax.legend(loc="lower right", fontsize=9.5, framealpha=0.9, edgecolor="none")
    for ax in axes[len(logs_by_loop) :]:
        ax.set_visible(False)
    return figure


def road_figure(attacks: Mapping[str, Attack], worst: Mapping[str, np.ndarray], seed: int) -> Any:
    """Draw the worst road and noise of each controller beside random ones, and the slips on both.

    All runs of a controller have the mass and start of the worst point.
    """
    figure, axes = plot.sheet(len(attacks), 3, title="The road that was found, and a random one", size=(4.4, 2.7))
    for row, (name, attack) in enumerate(attacks.items()):
        usual = drawn(attack.bounds, 1, np.random.default_rng(seed))
        start = parameters(attack.bounds, worst[name])
        same = {path: start[path] for path in ("plant.mass", "initial.speed")}
        random = parameters(attack.bounds, usual) | same
        for i, (label, values) in enumerate({"found": start, "random": random}.items()):
            style = {"color": plot.COLOURS[1 - i], "ls": plot.DASHES[i], "label": label}
            _drawn(axes[3 * row : 3 * row + 3], attack, {path: np.asarray(x)[0] for path, x in values.items()}, style)
        from_speed = f"{name}: {start['plant.mass'][0]:.2f} kg, {KMH * start['initial.speed'][0]:.0f} km/h"
        plot.label_axes(axes[3 * row], "distance [m]", "factor of the friction", from_speed)
        plot.label_axes(axes[3 * row + 1], "time in its 64 ms [ms]", "error of the slip", legend=False)
        plot.label_axes(axes[3 * row + 2], "time [s]", "slip", legend=False)
    return figure


def _drawn(axes: Any, attack: Attack, values: dict[str, Any], style: dict[str, Any]) -> None:
    loop: Any = replace(attack.loop, values)
    run = rollout(loop, attack.solver())
    sample, running = run.trajectory.sample, np.asarray(run.trajectory.running)  # pyright: ignore[reportOptionalMemberAccess]
    last = int(running.sum())
    x = np.linspace(0.0, float(sample.output.distance[last - 1]), 400)
    axes[0].plot(x, [float(loop.plant.road.factor(at)) for at in x], **style)
    axes[1].step(np.arange(len(values[NOISE])), values[NOISE], where="post", **style)
    axes[2].plot(np.asarray(sample.t)[:last], np.asarray(sample.output.slip)[:last], **style)
