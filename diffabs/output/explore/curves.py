"""Curves of a run, panel by panel, and a fan of many runs around them."""

import dataclasses
import math

import jax
import numpy as np

from diffabs.core.channels import select_channel
from diffabs.core.pytree import get, parameters
from diffabs.core.types import Part, PyTree, Scalar
from diffabs.core.units import control_units
from diffabs.engine.solvers import Adaptive, FixedStep, Solver
from diffabs.linear.robustness import low_discrepancy_points
from diffabs.loop.admissible import batch_admissibility
from diffabs.loop.convert import trajectory_columns
from diffabs.loop.faults import describe_faults
from diffabs.loop.result import Run
from diffabs.output.explore.friction import FACTOR_PATH
from diffabs.output.explore.knobs import is_vehicle
from diffabs.output.explore.members import run_alone, run_members, spread_paths, takes_kernel
from diffabs.output.explore.panels import Curve, Curves, Fan, Panel, Spread
from diffabs.output.explore.path import trace_path
from diffabs.scenario.registry import KMH
from diffabs.scenario.scenario import Scenario

INSTANTS = 400  # number of instants of a curve
DRAFT_INSTANTS = 200  # number of instants of a fan, few because the browser lays all of them out with every redraw
KEPT_MULTIPLE = 16  # a run that stops early must have enough instants: it keeps more, and is thinned afterwards
KERNEL_MULTIPLE = 4  # the same for a run in a kernel, in which an instant costs more than a step
MIN_DRAFT_STEPS = 4 * INSTANTS  # number of steps above which a draft is quicker
DRAFT_RTOL = 1e-3  # relative error of a draft's step
MEMBERS = 200  # number of runs of a fan
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
SETTLED_SHARE = 0.05  # settled: the distance from the target stays below this share of its largest value
TRANSIENT_MULTIPLE = 1.5  # length of a fitted time axis in transients
MIN_TRANSIENT_SHARE = 0.1  # a fan is drawn while this share of its runs goes on


def drawing_solver(scenario: Scenario, instants: int = INSTANTS) -> Solver:
    """Return the scenario's solver, with `every` set for a run that may stop after a small part of its duration.

    The step of the integration does not change. Over the whole duration, `KEPT_MULTIPLE` or `KERNEL_MULTIPLE` times
    `instants` are stored.
    """
    multiple = KERNEL_MULTIPLE if takes_kernel(scenario) else KEPT_MULTIPLE
    every = math.ceil(scenario.solver.steps / (multiple * instants))
    return dataclasses.replace(scenario.solver, every=max(1, every))


def thin(count: int, instants: int) -> np.ndarray:
    """Return the places of at most `instants` intervals among `count` instants, the first and the last included."""
    return np.unique(np.linspace(0, count - 1, min(count, instants + 1)).round().astype(int))


def draft_solver(scenario: Scenario) -> Solver | None:
    """Return a quicker, adaptive solver for the curve during a drag, or None if the scenario's own is to be used.

    The own solver stays if it is adaptive or has few steps, or if a kernel makes the runs. It also stays if a clock in
    the loop needs its grid.
    """
    solver = scenario.solver
    if (
        takes_kernel(scenario)
        or scenario.loop.ticks
        or not isinstance(solver, FixedStep)
        or solver.steps <= MIN_DRAFT_STEPS
    ):
        return None
    return Adaptive(rtol=DRAFT_RTOL, duration=solver.duration, step=solver.duration / (KEPT_MULTIPLE * INSTANTS))


def run_curves(scenario: Scenario, by: Solver | None = None) -> Curves:
    """Return the curves of a scenario's run by a solver; None is the scenario's own."""
    run = run_alone(scenario, by or drawing_solver(scenario))
    assert run.trajectory is not None
    # Samples after the end of the run are no part of the curves.
    count = len(trajectory_columns(run, scenario.loop.plant)["t"][1])
    shown = thin(count, INSTANTS)
    t = np.asarray(run.trajectory.sample.t)[shown]
    panels = tuple(
        panel._replace(lines=tuple(Curve(line.name, line.values[shown]) for line in panel.lines))
        for panel in _layout(run, scenario.loop.plant)
    )
    metrics = {name: float(run.metrics[name]) for name in scenario.objectives}
    path = trace_path(t, jax.tree.map(lambda values: values[shown], run.trajectory.sample.output), scenario.loop.plant)
    return Curves(t, panels, metrics, _describe_end(scenario, run, t), by is not None, path)


def transient_end(curves: Curves) -> float:
    """Return the end [s] of a time axis that fits the transient.

    It is 1.5 times the settling time of the first signal, and at most the end of the run. Settled means within 5 % of
    the largest distance from the target. Without a target the last value takes its place. A run that does not settle is
    shown whole.
    """
    signal = curves.panels[0].lines[0].values
    target = next(line.values for line in curves.panels[0].lines if line.name == "target")
    away = np.abs(signal - np.where(np.isfinite(target), target, signal[-1]))
    far = np.flatnonzero(away > SETTLED_SHARE * np.max(away, initial=0.0))
    end = float(curves.t[-1])
    return (
        end
        if not far.size or far[-1] + 1 >= len(signal)
        else min(end, TRANSIENT_MULTIPLE * float(curves.t[far[-1] + 1]))
    )


def run_fan(scenario: Scenario, spread: Spread) -> Fan | None:
    """Return the quantiles of `MEMBERS` runs with different masses and roads, or None if nothing differs.

    Refused and diverged runs do not count. The fan ends where too few runs still go on.
    """
    values, words = fan_members(scenario, spread)
    if not values:
        return None
    by = draft_solver(scenario) or drawing_solver(scenario, DRAFT_INSTANTS)
    accepted = batch_admissibility(scenario.loop, values, by).accepted
    run = run_members(scenario, values, by, accepted)
    # Samples after the end of a run, and diverged runs, are no part of the quantiles.
    lost = np.asarray(run.diverged)
    assert run.trajectory is not None
    going = np.asarray(run.trajectory.running) & ~lost[:, None]
    t = np.asarray(run.trajectory.sample.t)
    # Runs end at different times. The longest one has all instants; few remaining runs give no useful quantiles.
    longest = int(np.argmax(going.sum(axis=1)))
    count = int(np.sum(going.mean(axis=0) >= MIN_TRANSIENT_SHARE * max(1e-9, going[:, 0].mean())))
    shown = thin(count, DRAFT_INSTANTS)
    bands = tuple(
        tuple(_quantiles(np.where(going, line.values, np.nan)[:, shown]) for line in panel.compared)
        for panel in _layout(run, scenario.loop.plant)
    )
    refused = int(np.sum(~accepted))
    return Fan(t[longest, shown], bands, MEMBERS, refused, int(lost.sum()) - refused, words)


def fan_members(scenario: Scenario, spread: Spread) -> tuple[dict[str, np.ndarray], str]:
    """Return the values of a fan's members by path, each of shape (MEMBERS,) in SI, and their spread in words.

    Every call uses the same low-discrepancy points, so the fan does not flicker during a drag. Values stay below the
    upper end of the parameter's range. A parameter without spread is left out. The dictionary is empty if no parameter
    remains.
    """
    specs = {path: spec for path, spec, _ in parameters(scenario.loop)}
    spreads = {path: spread.road if path == FACTOR_PATH else spread.mass for path in spread_paths(scenario)}
    spreads = {path: part for path, part in spreads.items() if part > 0}
    unit = 2 * low_discrepancy_points(MEMBERS, len(spreads)) - 1
    values, words = {}, []
    for i, (path, part) in enumerate(spreads.items()):
        spec, here = specs[path], float(get(scenario.loop, path))
        low, high = (here * (1 + sign * part) for sign in (-1, 1))
        middle, half = (low + min(high, spec.high)) / 2, (min(high, spec.high) - low) / 2
        # unit is in [-1, 1]; a range that is cut at its upper end is filled evenly.
        values[path] = middle + half * unit[:, i]
        name = "friction" if path == FACTOR_PATH else path.rpartition(".")[2].replace("_", " ")
        words.append(f"{name} ± {100 * part:g} %")
    return values, ", ".join(words)


def _quantiles(values: np.ndarray) -> np.ndarray:
    if not values.size:
        return np.zeros((len(QUANTILES), 0))
    return np.nanquantile(values, QUANTILES, axis=0)


def _layout(run: Run, plant: Part) -> list[Panel]:
    """Return the panels of one run or a batch, in full length.

    They are each group of signals with target and setpoint, the first group without, and each group of controls with
    their commands. Signals without target are a group if they have one unit. Signals with targets, and controls, also
    need the same last word, such as the slips of four wheels.
    """
    assert run.trajectory is not None
    sample = run.trajectory.sample
    channels = getattr(sample.target, "_fields", ())
    groups: dict[tuple[str, str], list[str]] = {}
    for name, unit in type(sample.output).units.items():
        groups.setdefault((unit, _last_word(name) if name in channels else ""), []).append(name)
    aimed, others = [], []
    for (unit, quantity), names in groups.items():
        followed = [name for name in channels or sample.output._fields[:1] if name in names]
        lines = _family(names, quantity, sample.output)
        for aim in ("target", "setpoint") if followed else ():
            lines += [_curve(aim, select_channel(getattr(sample, aim), name)) for name in followed]
        (aimed if followed else others).append(Panel(unit, tuple(lines), quantity if len(names) > 1 else ""))
    shown = [*aimed, *others[:1]]
    shown = [_in_kmh(panel) for panel in shown] if is_vehicle(plant) else shown
    controls: dict[tuple[str, str], list[str]] = {}
    for name, unit in control_units(plant).items():
        controls.setdefault((unit, _last_word(name)), []).append(name)
    for (unit, quantity), names in controls.items():
        lines = _family(names, quantity, sample.control)
        lines += [_curve("command", select_channel(sample.command, name)) for name in names]
        shown.append(Panel(unit, tuple(lines), quantity if len(names) > 1 else ""))
    return shown


def _last_word(name: str) -> str:
    return name.rpartition("_")[2]


def _family(names: list[str], quantity: str, signals: PyTree) -> list[Curve]:
    """Return the curves of some signals; several of one quantity go without its name."""
    tail = f"_{quantity}" if quantity and len(names) > 1 else ""
    return [_curve(name.removesuffix(tail), select_channel(signals, name)) for name in names]


def _curve(name: str, values: Scalar) -> Curve:
    return Curve(name.replace("_", " "), np.asarray(values, float))


def _in_kmh(panel: Panel) -> Panel:
    if panel.unit != "m/s":
        return panel
    return panel._replace(unit="km/h", lines=tuple(Curve(line.name, KMH * line.values) for line in panel.lines))


def _describe_end(scenario: Scenario, run: Run, t: np.ndarray) -> str:
    if run.diverged:
        return f"diverged: {describe_faults(run)}"
    stop, end = scenario.loop.stop, f"after {float(t[-1]):.4g} s"
    if bool(run.stopped) == stop.success:
        return f"ends {end}"
    otherwise = getattr(stop, "otherwise", "")
    return f"{'stops early' if run.stopped else 'has not stopped'} {end}{otherwise and f': {otherwise}'}"
