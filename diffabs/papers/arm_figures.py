"""Figures of `arm_balance`."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from diffabs.core.types import JsonObject, PyTree
from diffabs.linear.recoverable import mode_bounds
from diffabs.loop.result import Run
from diffabs.output import plot
from diffabs.output.plot.style import Sheet
from diffabs.robust.design.attraction import Basin, Reach


def figures(
    runs: Mapping[str, Run],
    basins: Mapping[str, Basin],
    riders: np.ndarray,
    over_riders: Mapping[str, tuple[PyTree, list[Reach]]],
    limit: np.ndarray,
    start: np.ndarray,
    hanging: object,
) -> JsonObject:
    """Return the figures by file name.

    Args:
        riders: Masses of the rider [kg].
        over_riders: Gain and recovered multiples over the riders, by name.
        limit: Largest multiple that any control recovers, for each rider.
        start: Start of the paper's Fig. 3, shape (6,).
    """
    return {
        "fig3_printed_and_correct": _claim(runs),
        "hanging_arm": plot.draw_balance(
            runs["hanging"], title="Hanging arm at 48 V, from 0.06 of the start of Fig. 3"
        ),
        "attraction_48V": _maps(basins, start, hanging),
        "riders": _riders(riders, over_riders, limit),
    }


def _claim(runs: Mapping[str, Run]) -> Sheet:
    figure, axes = plot.sheet(1, 3, title="The same start, the same kind of LQR", size=(4.6, 3.4))
    titles = {
        "printed": "the paper's printed equations (its Fig. 3)",
        "correct, no limit": "correct equations, any voltage: falls",
        "correct, 48 V": "correct equations, 48 V: falls",
    }
    for i, (ax, (name, title)) in enumerate(zip(axes, titles.items(), strict=True)):
        trajectory = runs[name].trajectory
        assert trajectory is not None
        plot.draw_angle_lines(ax, trajectory)
        plot.label_axes(ax, "time [s]", "angle [rad]", title, legend=i == 0)
        ax.set_xlim(0, 6.0 if i == 0 else float(np.asarray(trajectory.sample.t)[-1]) * 1.05)
    return figure


def _maps(basins: Mapping[str, Basin], start: np.ndarray, hanging: Any) -> Sheet:
    figure, axes = plot.sheet(
        1, len(basins), title="Hanging arm at 48 V: which starts are recovered", size=(5.0, 4.4), sharey=True
    )
    (theta,), (phi,) = (mode_bounds(hanging.A, hanging.B, np.eye(6)[i], 48.0).values() for i in (0, 2))
    shades, undecided = [], any(basin.undecided for basin in basins.values())
    for i, (ax, (name, basin)) in enumerate(zip(axes, basins.items(), strict=True)):
        outcomes = basin.outcomes
        shades = plot.shade_region(
            ax, basin.first.centres, basin.second.centres, outcomes.recovered, outcomes.undecided
        )
        ends = np.array([basin.first.low, basin.first.high])
        for sign in (-1, 1):
            words = "no control beyond (linear)" if sign > 0 else None
            ax.plot(ends, phi * (sign - ends / theta), color="black", linewidth=1.2, label=words)
        ax.plot(ends, ends * start[2] / start[0], ":", color="black", label="multiples of Fig. 3's start")
        ax.set_xlim(*ends)
        ax.set_ylim(basin.second.low, basin.second.high)
        ax.locator_params(axis="x", nbins=5)
        title = f"{name}: {100 * basin.share:.1f} % of the box"
        title += f", {100 * basin.undecided:.1f} % undecided" if basin.undecided else ""
        plot.label_axes(ax, "frame theta0 [rad]", "" if i else "rider phi0 [rad]", title, legend=False)
    lines, words = axes[0].get_legend_handles_labels()
    named = dict(zip(("recovered", "undecided", "falls"), shades, strict=True))
    named = {name: shade for name, shade in named.items() if undecided or name != "undecided"}
    handles, words = [*named.values(), *lines], [*named, *words]
    figure.legend(handles, words, loc="outside lower center", ncols=len(words), frameon=False, fontsize=9.5)
    return figure


def _riders(riders: np.ndarray, over_riders: Mapping[str, tuple[PyTree, list[Reach]]], limit: np.ndarray) -> Sheet:
    figure, (ax,) = plot.sheet(title="One gain for every rider, hanging arm, 48 V", size=(6.6, 4.0))
    ax.plot(riders, limit, color="black", linewidth=1.2, label="no control beyond (linear)")
    for i, (name, (_, reaches)) in enumerate(over_riders.items()):
        multiples = [reach.multiple for reach in reaches]
        ax.plot(riders, multiples, "o" + plot.DASHES[i], color=plot.COLOURS[i], markersize=4, label=name)
        lower_bounds = [(m, reach.multiple) for m, reach in zip(riders, reaches, strict=True) if reach.undecided]
        if lower_bounds:
            ax.plot(*zip(*lower_bounds, strict=True), "^", color=plot.COLOURS[i], label="at least")
    plot.label_axes(ax, "rider [kg]", "recovered multiple of (0.5, 0, 0.2) rad")
    ax.set_ylim(0, None)
    return figure
