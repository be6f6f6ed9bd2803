"""Figures of the identification: the curves, and the residuals of the tables."""

from typing import Any

import jax
import numpy as np

from diffabs.output import plot
from diffabs.papers import slip_estimator
from diffabs.parts.roads import SPLINE_B, MagicFormula
from diffabs.tune.identify.fit import Identified

UNITS = ("s", "m")


def draw_curves(config: Any, formula: Identified, splines: dict[str, Identified]) -> Any:
    """Draw the stated curves, and their fits to the tables."""
    figure, axes = plot.sheet(1, 2, title="Friction curves from Tables 1 and 2", size=(6, 4))
    s = np.linspace(0, 1, 2001)
    for ax in axes:
        for i, (name, means) in enumerate(config.priors):
            road = MagicFormula(**dict(zip("BCDE", means[1:], strict=True)))
            ax.plot(s, road.friction(s), ":", color=plot.COLOURS[i], linewidth=1.1)
            curve = jax.vmap(splines[name].part.plant.road.friction)(s)
            ax.plot(s, curve, color=plot.COLOURS[i], linewidth=1.4, label=f"spline, {name}")
        ax.plot(s, formula.part.plant.road.friction(s), "--", color="black", linewidth=1.6, label="Magic Formula, all")
        ax.plot(s, jax.vmap(SPLINE_B.friction)(s), "-.", color=plot.GREY, linewidth=1.8, label="spline B, to compare")
        plot.label_axes(ax, "slip [1]", "friction coefficient [1]", legend=ax is axes[0])
    axes[0].set_title("dotted: the stated priors", fontsize=11)
    axes[1].set_title("where the runs have been", fontsize=11)
    axes[1].set_xlim(0, 0.3)
    axes[1].set_ylim(0.8, 1.02)
    return figure


def draw_residuals(config: Any, fits: dict[str, Identified]) -> Any:
    """Differences from the tables by row."""
    figure, axes = plot.sheet(1, 2, title="What the fits leave of Tables 1 and 2", size=(6, 4), sharey=True)
    rows = list(slip_estimator.PUBLISHED_STOPS)
    for j, (ax, unit) in enumerate(zip(axes, UNITS, strict=True)):
        for i, (name, fit) in enumerate(fits.items()):
            y = np.arange(len(rows)) + 0.12 * (i - (len(fits) - 1) / 2)
            ax.plot(fit.residuals.reshape(-1, 2)[:, j], y, "osD^v"[i % 5], color=plot.COLOURS[i], label=name, ms=5)
        ax.axvspan(-config.rounding[j], config.rounding[j], color="#DDDDDD", zorder=0)
        for sign in (-1, 1):
            ax.axvline(sign * config.weights[j], color=plot.GREY, linewidth=1, linestyle="--")
        ax.set_yticks(range(len(rows)), rows)
        quantity = ("stopping time", "stopping distance")[j]
        plot.label_axes(
            ax, f"{quantity}, ours - published [{unit}]", "", "grey: rounding; dashed: bound", legend=j == 0
        )
    axes[0].invert_yaxis()
    return figure
