"""Figures of the study: slip and torque before and after tuning."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from diffabs import FixedStep, Loop, Run, replace, rollout, run_batch
from diffabs.output import plot
from diffabs.parts.objectives import BRAKING
from diffabs.tune import Tuned, grid

KMH = 3.6
PUBLISHED, CURE = "published gain", "the cure"
MASSES, STARTS, UNTIL = 13, 7, 0.35  # s


def seen(config: Any, loop: Loop, mass: float, speed: float) -> Run:
    """One run with its trajectory."""
    solver = FixedStep(step=config.step, duration=config.longer, every=4)
    return rollout(replace(loop, {"plant.mass": mass, "initial.speed": speed / KMH}), solver, BRAKING)


def figures(config: Any, tuning: Tuned, those: dict[str, tuple[Loop, str]]) -> dict[str, Any]:
    """All masses before and after; four controllers and their torque; and how the tuning went."""
    both = {f"before: {PUBLISHED}": those[PUBLISHED][0], "after: tuned by gradients": those[CURE][0]}
    return {
        "masses": all_masses(config, both),
        "cure": before_and_after(config, those),
        "tuning": tuning_figure(tuning),
    }


def all_masses(config: Any, loops: Mapping[str, Loop]) -> Any:
    """Slip of every mass and start of a grid over the box, a panel for each loop: by mass, with the worst."""
    low, high = config.mass
    lanes = grid({"plant.mass": np.linspace(low, high, MASSES), "initial.speed": np.linspace(20.0, 50.0, STARTS) / KMH})
    title = f"Slip of a rig whose mass nobody knows: {MASSES} masses from {STARTS} speeds, 20 to 50 km/h"
    figure, axes = plot.sheet(1, len(loops), title=title, size=(5.2, 3.3), sharex=True, sharey=True)
    norm, colours = Normalize(low, high), colormaps["viridis"]
    for i, (ax, (name, loop)) in enumerate(zip(axes, loops.items(), strict=True)):
        run = run_batch(loop, lanes, FixedStep(config.step, config.duration, every=4), BRAKING, trajectories=True)
        sample, masses = run.trajectory.sample, lanes.values["plant.mass"]
        shown = np.asarray(sample.t)[0] <= UNTIL
        for mass, slip in zip(masses, np.asarray(sample.output.slip), strict=True):
            ax.plot(np.asarray(sample.t)[0][shown], slip[shown], color=colours(norm(mass)), linewidth=0.7, alpha=0.7)
        ax.axhline(config.slip, color="black", linewidth=0.8, linestyle=":")
        worst = 100 * float(np.max(run.metrics["overshoot"]))
        plot.label_axes(
            ax, "time [s]", "" if i else "slip [1]", f"{name}: {worst:.2g} % overshoot at worst", legend=False
        )
    axes[0].set_xlim(0, UNTIL)
    axes[0].set_ylim(0, 0.45)
    figure.colorbar(ScalarMappable(norm, colours), ax=axes, label="mass [kg]", pad=0.01)
    return figure


def before_and_after(config: Any, those: dict[str, tuple[Loop, str]]) -> Any:
    """Slip and torque of four controllers: in the box, at its worst corner, and outside."""
    columns, title = len(config.drawn), "Slip of the rig before and after: the overshoot, cured, and where not"
    figure, axes = plot.sheet(2, columns, title=title, size=(5.2, 3.1), sharex=True, sharey="row")
    shown = (PUBLISHED, "LMI, weights of least overshoot", "published gain, filter 35 ms", CURE)
    for column, (mass, speed) in enumerate(config.drawn):
        for i, name in enumerate(shown):
            sample = seen(config, those[name][0], mass, speed).trajectory.sample
            t = np.asarray(sample.t)
            style = {
                "color": plot.COLOURS[i],
                "linestyle": plot.DASHES[i],
                "linewidth": 2.0 if name == CURE else 1.1,
            }
            axes[column].plot(t, sample.output.slip, label=name, **style)
            axes[columns + column].plot(t, sample.control, **style)
        axes[column].axhline(config.slip, color="black", linewidth=0.8, linestyle=":")
        where = f"{mass:g} kg from {speed:g} km/h" + (" (outside the box)" if speed > config.box.speeds[-1] else "")
        plot.label_axes(axes[column], "", "slip [1]" if column == 0 else "", where, legend=False)
        plot.label_axes(axes[columns + column], "time [s]", "brake torque [N m]" if column == 0 else "", legend=False)
        for ax in (axes[column], axes[columns + column]):
            ax.set_xlim(0, 0.35)
            ax.locator_params(axis="x", nbins=4)
        axes[column].set_ylim(0, 0.45)
    words = dict(loc="outside lower center", ncols=len(shown), frameon=False, fontsize=11)
    figure.legend(*axes[0].get_legend_handles_labels(), **words)
    return figure


def tuning_figure(tuning: Tuned) -> Any:
    """Objective, gradient and violation over the gradients that were computed."""
    figure, axes = plot.sheet(1, 3, title="How the tuning went", size=(4.4, 3.2))
    n = [p.evaluations for p in tuning.history]
    for ax, (name, unit) in zip(axes, {"objective": "IAE [s]", "gradient": "", "violation": ""}.items(), strict=True):
        ax.plot(n, [getattr(p, name) for p in tuning.history], "o-", markersize=3, color=plot.COLOURS[0])
        if name == "gradient":
            plot.make_logarithmic(ax, "y")
        plot.label_axes(ax, "gradients computed", f"{name} {unit}")
    return figure
