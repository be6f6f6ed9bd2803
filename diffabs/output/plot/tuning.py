"""Figures of a tuning: convergence, runs before and after, and the front of two objectives."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from diffabs.core.channels import outputs_like
from diffabs.core.types import PyTree, Scalar
from diffabs.core.units import control_units
from diffabs.linear.opened_loop import OpenLoop, open_loop
from diffabs.loop.closed_loop import Loop
from diffabs.loop.result import Trajectory
from diffabs.loop.run import rollout
from diffabs.output.plot.frequency import draw_sensitivities
from diffabs.output.plot.style import (
    COLOURS,
    GREY,
    Axes,
    Figure,
    control_label,
    curve_style,
    label_axes,
    make_logarithmic,
    sheet,
    signal_label,
)

if TYPE_CHECKING:
    from diffabs.scenario.tuning import Work
    from diffabs.tune import FrequencyBounds, Tuned

MARKS = "osD^v"
MAX_DECADES = 5.0  # an objective that falls by less is easier to read on a linear axis
SETTLED_MULTIPLE = 1.5  # length of the time axis, in transients


def draw_tuning(
    points: Sequence[PyTree],
    runs: Mapping[str, Trajectory],
    *,
    title: str = "",
    lane: str = "",
    unit: str = "N m",
    bounds: "FrequencyBounds | None" = None,
    boxes: Mapping[str, Sequence[OpenLoop]] | None = None,
) -> Figure:
    """Return the figure of `diffabs tune`: convergence above, the runs before and after below.

    With `bounds` a third row has |S| and |T| of the loops of the `boxes`, before and after.
    """
    figure, axes = sheet(3 if bounds else 2, 2, title=title, size=(5.8, 3.1))
    objective, gradient, slip, torque, *closed = axes
    if bounds and boxes:
        draw_sensitivities(closed[0], closed[1], boxes, bounds)
    _objective(objective, points)
    _gradient(gradient, points)
    _runs(slip, torque, runs, lane and f"worst lane: {lane}", unit)
    return figure


def draw_worst_run(work: "Work", tuned: "Tuned") -> Figure:
    """Return the history of a scenario's tuning, and the run that is worst after it, before and after it."""
    scenario, metrics = work.scenario, tuned.metrics[1]
    worst = int(np.argmax(sum(w * np.asarray(metrics[name]) for name, w in scenario.tune.objective.items())))
    solver = dataclasses.replace(scenario.solver, every=min(scenario.solver.every, scenario.solver.steps))

    def roll_out(loop: Loop) -> Trajectory:
        run = jax.device_get(rollout(work.batch.lane(loop, worst), solver, key=scenario.key()))
        assert run.trajectory is not None
        return run.trajectory

    loops = {"before": scenario.loop, "after": tuned.loop}
    runs = {name: roll_out(loop) for name, loop in loops.items()}
    bounds, boxes = work.frequency_bounds, {}
    if bounds:
        points = bounds.points
        boxes = {
            name: [open_loop(points.lane(loop, i)) for i in range(max(points.size, 1))] for name, loop in loops.items()
        }
    where = ", ".join(f"{name} = {np.asarray(column)[worst]:.4g}" for name, column in work.batch.values.items())
    title, unit = scenario.title or scenario.name, ", ".join({*control_units(scenario.loop.plant).values()})
    return draw_tuning(tuned.history, runs, title=title, lane=where, unit=unit, bounds=bounds, boxes=boxes)


def draw_pareto(
    fronts: Mapping[str, tuple[PyTree, PyTree]],
    *,
    marks: Mapping[str, tuple[float, float]] | None = None,
    x: str = "effort [N² m² s]",
    y: str = "stopping distance [m]",
    title: str = "",
) -> Figure:
    """Return a figure of one objective over another, with the Pareto front of each set of points.

    Both objectives are minimised, as in `pareto_front`. Points on a front are joined; the others are pale.

    Args:
        fronts: Points (x, y) by name, each coordinate an array of shape (n,).
    """
    figure, (ax,) = sheet(title=title, size=(6.2, 4.0))
    for i, (name, (across, up)) in enumerate(fronts.items()):
        across, up = np.asarray(across, float), np.asarray(up, float)
        best = pareto_front(across, up)
        ax.plot(across, up, "o", color=COLOURS[i % 7], alpha=0.25, markersize=4)
        ax.plot(across[best], up[best], "o-", color=COLOURS[i % 7], markersize=5, label=name)
    for i, (name, point) in enumerate((marks or {}).items()):
        ax.plot([point[0]], [point[1]], MARKS[i % 5], color=COLOURS[(i + len(fronts)) % 7], markersize=8, label=name)
    label_axes(ax, x, y)
    return figure


def pareto_front(x: Scalar, y: Scalar) -> np.ndarray:
    """Return the indices of the Pareto-optimal points (both objectives are minimised), in ascending order of x.

    The objectives `x` and `y` have shape (n,). A point is left out if another one is at least as small in both, or if a
    number is not finite. Of equal points one is kept.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    # In the order of x (of equal x the smallest y first), a point is on the front if its y is a new minimum.
    order = [i for i in np.lexsort((y, x)) if np.isfinite([x[i], y[i]]).all()]
    front, lowest = [], np.inf
    for i in order:
        if y[i] < lowest:
            front.append(i)
            lowest = y[i]
    return np.array(front, int)


def _objective(ax: Axes, points: Sequence[PyTree]) -> None:
    """Draw the objective and, on an axis of its own, the largest violation of a constraint."""
    n, values = [p.evaluations for p in points], np.array([p.objective for p in points])
    ax.plot(n, values, "o-", markersize=3.5, color=COLOURS[0], label="objective")
    finite = values[np.isfinite(values)]
    if len(finite) and finite.min() > 0 and finite.max() > MAX_DECADES * finite.min():
        make_logarithmic(ax, "y")
    violation = np.array([p.violation for p in points])
    if np.any(violation > 0):
        right = ax.twinx()
        right.spines[["top", "left"]].set_visible(False)
        right.plot(n, violation, "--", color=COLOURS[1], linewidth=1.2)
        right.set_ylabel("greatest violation [of its bound]", fontsize=10, color=COLOURS[1])
        right.set_ylim(0, None)
    label_axes(ax, "gradients computed", "objective", legend=False)


def _gradient(ax: Axes, points: Sequence[PyTree]) -> None:
    ax.plot([p.evaluations for p in points], [p.gradient for p in points], "o-", markersize=3.5, color=COLOURS[2])
    make_logarithmic(ax, "y")
    label_axes(ax, "gradients computed", "gradient, greatest component")


def _runs(slip: Axes, torque: Axes, runs: Mapping[str, Trajectory], title: str = "", unit: str = "N m") -> None:
    """Draw the signals with a target (the slip of a brake) and their setpoints, and the controls."""
    for i, (name, trajectory) in enumerate(runs.items()):
        t, sample = np.asarray(trajectory.sample.t), trajectory.sample
        _draw_channels(slip, t, outputs_like(sample.output, sample.setpoint), label=name, **curve_style(i))
        _draw_channels(torque, t, sample.control, label=name, linewidth=1.2, **curve_style(i))
    first = next(iter(runs.values())).sample
    grey = {"color": GREY, "linewidth": 0.9, "linestyle": ":"}
    _draw_channels(slip, np.asarray(first.t), first.setpoint, label="setpoint", **grey)
    label_axes(slip, "time [s]", signal_label(first.output), title)
    label_axes(torque, "time [s]", control_label(unit), legend=False)
    for ax in (slip, torque):
        ax.set_xlim(0, _arrival_time(runs))
        ax.locator_params(axis="x", nbins=6)


def _draw_channels(ax: Axes, t: np.ndarray, signal: PyTree, label: str, **style: Any) -> None:
    """Draw a signal, or each of its channels in the same style."""
    for i, values in enumerate(jax.tree.leaves(signal)):
        ax.plot(t, values, label=label if i == 0 else "_", **style)


def _arrival_time(runs: Mapping[str, Trajectory]) -> float:
    """Return the end of the time axis [s]: 1.5 times the longest transient, at most the longest run.

    The transient of a run ends when its first signal stays within 2 % of its largest magnitude around the setpoint.
    """
    ends = []
    for trajectory in runs.values():
        t, sample = np.asarray(trajectory.sample.t), trajectory.sample
        for signal, setpoint in zip(
            *map(jax.tree.leaves, (outputs_like(sample.output, sample.setpoint), sample.setpoint)), strict=True
        ):
            away = np.flatnonzero(np.abs(signal - setpoint) > 0.02 * np.max(np.abs(signal)))
            ends.append(float(t[away[-1]]) if len(away) else 0.0)
    whole = max(float(np.asarray(trajectory.sample.t)[-1]) for trajectory in runs.values())
    return min(whole, SETTLED_MULTIPLE * max(ends)) or whole
