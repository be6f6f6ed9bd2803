"""Figures of runs: an overview of one run, several runs side by side, friction curves and convergence."""

from collections.abc import Mapping, Sequence

import jax
import numpy as np
from jax.typing import ArrayLike

from diffabs.core.channels import select_channel
from diffabs.core.protocols import Road
from diffabs.core.types import Table
from diffabs.loop.result import Run, Trajectory
from diffabs.output.plot.style import (
    COLOURS,
    GREY,
    KMH,
    Axes,
    Figure,
    ListedColormap,
    Patch,
    control_label,
    curve_style,
    label_axes,
    make_logarithmic,
    sheet,
    spaced_name,
)
from diffabs.parts.objectives.balance import motor_torque


def draw_braking(run: Run, *, title: str = "", unit: str = "N m") -> Figure:
    """Return an overview of a braking run: slip with target and setpoint, speeds, control and deceleration.

    Args:
        run: Run with a trajectory, as `rollout` returns it.
        title: Title of the figure.
        unit: Unit of the control.

    Raises:
        ValueError: The run has no trajectory, as from `measure`.
    """
    trajectory, title = _trajectory(run, title)
    figure, (top, speed, torque, brake) = sheet(2, 2, title=title, size=(5.6, 3.0), sharex=True)
    t, sample = np.asarray(trajectory.sample.t), trajectory.sample
    top.plot(t, sample.output.slip, color=COLOURS[0], label="slip")
    top.plot(t, sample.target, "--", color=COLOURS[1], label="target")
    top.plot(t, sample.setpoint, ":", color="black", label="setpoint")
    label_axes(top, "", "slip [1]")
    _speeds(speed, trajectory)
    label_axes(speed, "", "speed [km/h]")
    _control(torque, trajectory, unit)
    brake.plot(t, sample.output.deceleration, color=COLOURS[0])
    label_axes(brake, "time [s]", "deceleration [m/s²]")
    return figure


def draw_balance(run: Run, *, title: str = "", unit: str = "V") -> Figure:
    """Return an overview of a two-wheeler's run: angles, rates, control and motor torque.

    Args:
        run: Run with a trajectory, as `rollout` returns it.
        title: Title of the figure.
        unit: Unit of the control.

    Raises:
        ValueError: The run has no trajectory, as from `measure`.
    """
    trajectory, title = _trajectory(run, title)
    figure, (angles, rates, voltage, torque) = sheet(2, 2, title=title, size=(5.6, 3.0), sharex=True)
    t, sample = np.asarray(trajectory.sample.t), trajectory.sample
    draw_angle_lines(angles, trajectory)
    label_axes(angles, "", "angle [rad]")
    draw_angle_lines(rates, trajectory, "_rate")
    label_axes(rates, "", "rate [rad/s]", legend=False)
    _control(voltage, trajectory, unit)
    # The axis follows the delivered control: a command far beyond the supply would flatten it.
    peak = np.max(np.abs(sample.control))
    voltage.set_ylim(-1.5 * peak - 1e-9, 1.5 * peak + 1e-9)  # 1e-9: limits that differ at zero control
    torque.plot(t, motor_torque(sample), color=COLOURS[0])
    label_axes(torque, "time [s]", "motor torque [N m]")
    return figure


def draw_signals(run: Run, *, title: str = "", unit: str = "1") -> Figure:
    """Return an overview of a run of any plant: one panel for each unit of its signals, and one for each control.

    The panel of a signal with a target also shows target and setpoint. With several targets each has its own panel.

    Args:
        run: Run with a trajectory, as `rollout` returns it.
        title: Title of the figure.
        unit: Unit of the control.

    Raises:
        ValueError: The run has no trajectory, as from `measure`.
    """
    trajectory, title = _trajectory(run, title)
    t, sample = np.asarray(trajectory.sample.t), trajectory.sample
    groups: dict[tuple[str, str], list[str]] = {}
    for name, of_signal in sample.output.units.items():
        groups.setdefault((of_signal, name if name in getattr(sample.target, "_fields", ()) else ""), []).append(name)
    controls = getattr(sample.control, "_fields", ("",))
    count = len(groups) + len(controls)
    figure, axes = sheet(-(-count // 2), 2, title=title, size=(5.6, 3.0), sharex=True)
    tracked = getattr(sample.target, "_fields", sample.output._fields[:1])
    for ax, ((of_signal, _), names) in zip(axes, groups.items(), strict=False):
        for i, name in enumerate(names):
            ax.plot(t, getattr(sample.output, name), label=spaced_name(name), **curve_style(i))
        if followed := next((name for name in tracked if name in names), ""):
            ax.plot(t, select_channel(sample.target, followed), "--", color=GREY, label="target")
            ax.plot(t, select_channel(sample.setpoint, followed), ":", color="black", label="setpoint")
        alone = len(names) == 1
        words = f"{spaced_name(names[0])} " if alone else ""
        label_axes(ax, "", f"{words}[{of_signal}]", legend=bool(followed) or not alone)
    for ax, name in zip(axes[len(groups) :], controls, strict=False):
        _control(ax, trajectory, unit, name)
    for ax in axes[count:]:
        ax.set_visible(False)
    # With a shared time axis only the last row has labels; above a hidden panel they must be shown again.
    for ax in axes[max(0, count - 2) : count]:
        ax.set_xlabel("time [s]", fontsize=11)
        ax.tick_params(labelbottom=True)
    return figure


def _control(ax: Axes, trajectory: Trajectory, unit: str, channel: str = "") -> None:
    """Draw the controller's command and the control that the actuator delivers, of one channel if there are several."""
    t, sample = np.asarray(trajectory.sample.t), trajectory.sample
    ax.plot(t, select_channel(sample.command, channel), "--", color=COLOURS[1], linewidth=1, label="command")
    ax.plot(t, select_channel(sample.control, channel), color=COLOURS[0], label="control")
    text = f"{spaced_name(channel)} [{sample.control.units[channel]}]" if channel else control_label(unit)
    label_axes(ax, "time [s]", text)


FIGURE_BY_SIGNALS = {  # figures of one run by the signals that they draw
    frozenset(("slip", "speed", "wheel_speed", "deceleration")): draw_braking,
    frozenset(("theta", "psi", "phi", "theta_rate", "psi_rate", "phi_rate", "constant", "emf")): draw_balance,
}


def draw_run(run: Run, *, title: str = "", unit: str = "") -> Figure:
    """Return an overview of one run of any plant.

    It is that of `draw_braking` or `draw_balance` if the plant shows all signals of that figure, else that of
    `draw_signals`.

    Args:
        run: Run with a trajectory, as `rollout` returns it.
        title: Title of the figure.
        unit: Unit of the control; empty for that of the figure.

    Raises:
        ValueError: The run has no trajectory, as from `measure`.
    """
    signals = {*type(run.ending.sample.output).units}
    draw = next((figure for drawn, figure in FIGURE_BY_SIGNALS.items() if drawn <= signals), draw_signals)
    return draw(run, title=title, **({"unit": unit} if unit else {}))


def draw_angle_lines(ax: Axes, trajectory: Trajectory, suffix: str = "") -> None:
    """Draw the angles of frame, arm and rider into an axes, or their rates.

    Args:
        ax: Axes to draw into.
        trajectory: Trajectory of the run.
        suffix: "" for angles [rad], "_rate" for rates [rad/s].
    """
    for i, (name, words) in enumerate({"theta": "frame", "psi": "arm", "phi": "rider"}.items()):
        values = getattr(trajectory.sample.output, name + suffix)
        ax.plot(np.asarray(trajectory.sample.t), values, label=f"{words} {name}", **curve_style(i))


def shade_region(
    ax: Axes, first: ArrayLike, second: ArrayLike, inside: ArrayLike, unknown: ArrayLike | None = None
) -> list[Patch]:
    """Shade the cells of a grid by a Boolean value, and return three patches for a legend.

    The patches stand for true, unknown and false, in this order.

    Args:
        ax: Axes to draw into.
        first: Cell centres along the horizontal axis, shape (n,).
        second: Cell centres along the vertical axis, shape (m,).
        inside: Value of each cell (first, second), shape (n, m).
        unknown: True for cells without a value, shape (n, m), or None. A cell with true `inside` is never unknown.
    """
    shades = (COLOURS[0], "#9A9A9A", "#F3E3D7")
    value = np.where(inside, 0, 2 if unknown is None else np.where(unknown, 1, 2))
    colours = ListedColormap(shades)
    ax.pcolormesh(np.asarray(first), np.asarray(second), value.T, cmap=colours, vmin=0, vmax=2, rasterized=True)
    return [Patch(color=shade) for shade in shades]


def draw_slips(runs: Mapping[str, Trajectory], *, title: str = "", until: float | None = None) -> Figure:
    """Return a figure of slip over time, with one curve per run and the setpoint of the first run.

    Args:
        runs: Trajectories by name.
        title: Title of the figure.
        until: End of the time axis [s]; None is automatic.
    """
    figure, (ax,) = sheet(title=title, size=(6.4, 3.8))
    draw_slip_lines(ax, runs)
    label_axes(ax, "time [s]", "slip [1]")
    ax.set_xlim(0, until)
    return figure


def draw_slip_lines(ax: Axes, runs: Mapping[str, Trajectory]) -> None:
    """Draw the slips of all runs and the setpoint of the first run into an axes.

    Args:
        ax: Axes to draw into.
        runs: Trajectories by name.
    """
    for i, (name, trajectory) in enumerate(runs.items()):
        ax.plot(np.asarray(trajectory.sample.t), trajectory.sample.output.slip, label=name, **curve_style(i))
    first = next(iter(runs.values())).sample
    ax.plot(np.asarray(first.t), first.setpoint, color="black", linewidth=0.9, linestyle=":", label="setpoint")


def draw_speeds(runs: Mapping[str, Trajectory], *, title: str = "") -> Figure:
    """Return a figure of vehicle and wheel speed [km/h] over time, with one panel per run, side by side.

    Args:
        runs: Trajectories by name.
        title: Title of the figure.
    """
    figure, axes = sheet(1, len(runs), title=title, size=(5.2 if len(runs) > 1 else 6.4, 3.6), sharex=True, sharey=True)
    for i, (ax, (name, trajectory)) in enumerate(zip(axes, runs.items(), strict=True)):
        _speeds(ax, trajectory)
        words = f"{name}: ends at {float(np.asarray(trajectory.sample.t)[-1]):.2f} s" if name else ""
        label_axes(ax, "time [s]", "" if i else "speed [km/h]", words)
        ax.set_xlim(0, None)
    # The automatic end below 0 keeps the line of a locked wheel off the axis.
    axes[0].set_ylim(min(axes[0].get_ylim()[0], 0.0), None)
    return figure


def _speeds(ax: Axes, trajectory: Trajectory) -> None:
    t, y = np.asarray(trajectory.sample.t), trajectory.sample.output
    ax.plot(t, KMH * np.asarray(y.wheel_speed), color=COLOURS[1], linestyle="--", linewidth=1.3, label="wheel")
    ax.plot(t, KMH * np.asarray(y.speed), color=COLOURS[0], linewidth=1.6, label="vehicle")


def draw_positions(
    panels: Sequence[Mapping[str, Trajectory]], *, title: str = "", zoom: tuple[float, float] | None = None
) -> Figure:
    """Return a figure of position [m] over time, with one panel per group of runs.

    Args:
        panels: Groups of trajectories by name.
        title: Title of the figure.
        zoom: First and last time [s] of one more panel with the last group, or None.
    """
    groups = list(panels) + ([panels[-1]] if zoom else [])
    figure, axes = sheet(1, len(groups), title=title, size=(5.2, 3.6), sharey=zoom is None)
    for i, (ax, runs) in enumerate(zip(axes, groups, strict=True)):
        single = len(runs) == 1
        for j, (name, trajectory) in enumerate(runs.items()):
            t, x = np.asarray(trajectory.sample.t), np.asarray(trajectory.sample.output.distance)
            ax.plot(t, x, label=None if single else f"{name}: {x[-1]:.2f} m", **curve_style(j))
            ax.plot(t[-1:], x[-1:], marker="o", markersize=4.5, **curve_style(j))
        label_axes(ax, "time [s]", "" if i else "position [m]", next(iter(runs)) if single else "")
        ax.set_xlim(0, None)
    if zoom:
        ends = [
            np.interp(zoom, trajectory.sample.t, trajectory.sample.output.distance)
            for trajectory in panels[-1].values()
        ]
        low, high = float(np.min(ends)), float(np.max(ends))
        axes[-1].set_xlim(*zoom)
        axes[-1].set_ylim(low, high + 0.08 * (high - low))
    return figure


def draw_friction(
    roads: Mapping[str, Road],
    *,
    marks: Mapping[str, tuple[float, float]] | None = None,
    zoom: tuple[float, float, float, float] | None = None,
    speed: float = 0.0,
    title: str = "",
) -> Figure:
    """Return a figure of the friction coefficient over slip, with named points.

    Args:
        roads: Roads by name.
        marks: Points (slip, friction coefficient) by name.
        zoom: Window (slip, slip, mu, mu) of a second panel, or None.
        speed: Speed [m/s] at which friction is evaluated.
        title: Title of the figure.
    """
    figure, axes = sheet(1, 2 if zoom else 1, title=title, size=(5.6, 3.8))
    for ax in axes:
        limits = zoom[:2] if zoom and ax is axes[-1] else (0.0, 1.0)
        s = np.linspace(*limits, 1001)
        for i, (name, road) in enumerate(roads.items()):
            # road=road binds the road of this iteration.
            mu = jax.vmap(lambda x, road=road: road.friction(x, speed, 0.0))(s)
            ax.plot(s, np.asarray(mu), label=name, **curve_style(i))
        for i, (name, (x, y)) in enumerate((marks or {}).items()):
            if limits[0] <= x <= limits[1]:
                ax.plot([x], [y], "osD^v"[i % 5], color=COLOURS[(i + len(roads)) % 7], markersize=7, label=name)
        label_axes(ax, "slip [1]", "friction coefficient [1]")
    if zoom:
        axes[-1].set_xlim(*zoom[:2])
        axes[-1].set_ylim(*zoom[2:])
    return figure


def draw_convergence(
    panels: Mapping[str, Table], steps: Sequence[float], *, orders: Sequence[int], title: str = ""
) -> Figure:
    """Return a figure of error over step length in logarithmic axes, with one panel per case.

    Args:
        panels: Relative errors as {case: {quantity: values}}, values of shape (steps,).
        steps: Step lengths [s], shape (steps,).
        orders: Slope of the guide line in each panel, one per case.
        title: Title of the figure.
    """
    figure, axes = sheet(1, len(panels), title=title, size=(5.2, 3.8), sharey=True)
    h = np.asarray(steps)
    for i, (ax, order, (name, curves)) in enumerate(zip(axes, orders, panels.items(), strict=True)):
        for j, (quantity, errors) in enumerate(curves.items()):
            words = "IAE" if quantity == "iae" else spaced_name(quantity)
            ax.loglog(h, errors, marker="o", markersize=4.5, label=words, **curve_style(j))
        # The guide line has the slope of the order and starts a factor of 3 above the largest error.
        top = 3.0 * np.max([np.max(e) for e in curves.values()])
        ax.loglog(h, top * (h / h.max()) ** order, color=GREY, linewidth=0.9, label=f"slope {order}")
        make_logarithmic(ax, "x")
        make_logarithmic(ax, "y")
        label_axes(ax, "step [s]", "" if i else "relative error [1]", name, legend=False)
        ax.legend(fontsize=9, loc="lower right", framealpha=0.9, edgecolor="none")
    return figure


def _trajectory(run: Run, title: str) -> tuple[Trajectory, str]:
    """Return the trajectory and the title, which says so if the run diverged: the curves look like those of others."""
    if run.trajectory is None:
        raise ValueError("the run has no trajectory: use rollout, not measure")
    return run.trajectory, f"{title} (diverged)".lstrip() if run.diverged else title
