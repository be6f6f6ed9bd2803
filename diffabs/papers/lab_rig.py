"""INTECO's laboratory rig: measured against simulated.

Bearing friction is identified from four coasting curves, the seven parameters of `FREE` from experiment 1. Experiment 2
judges the result. Three braking runs with one step of the command each (Fig. 5.6 a) judge both rigs once more.
`experiments/measured_rig/run.py` shows how the model was chosen, and what the identified rig means for the controllers.
"""

import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.blocks import Direct
from diffabs.core.pytree import get, param, part, pytree
from diffabs.core.types import JsonObject, Params, Scalar, Table, Vector
from diffabs.engine.solvers import FixedStep
from diffabs.host import provenance
from diffabs.loop.closed_loop import Loop
from diffabs.loop.result import Run
from diffabs.output import plot
from diffabs.papers import record
from diffabs.papers.digest import Digest
from diffabs.papers.measured_rig import (
    DRUM_RADIUS,
    EXPERIMENTS,
    FIT_STEP,
    HARDLY_TURNS,
    MASK,
    RUN_STEP,
    WHEEL_RADIUS,
    Record,
    RecordedRun,
    RecordMatch,
    build_record_loop,
    compare_with_maker,
    compare_with_record,
    describe_record,
    fit_record,
    read_curves,
    read_record,
    run_at_step,
    simulate,
    simulate_readings,
    solver_for,
    with_values,
)
from diffabs.parts.controllers import ConstantTorque
from diffabs.parts.plants import BrakeStart, LabRig
from diffabs.parts.stops import Standstill
from diffabs.scenario.defaults import braking
from diffabs.tune.identify import Identified, Tolerances, fit

TITLE = "INTECO's laboratory rig: measured against simulated (relay at slip 0.1 and 0.7, from 1,700 rpm)"
PIXEL = {"wheel": 0.35, "drum": 0.5}  # rad/s, of the coasting curves
READING_SHARE = 0.29  # rms error of a reading, uniform in its pixel

# Each free parameter of experiment 1: unit, and what it is.
FREE = {
    "loop.plant.road.w4": ("1", "friction of the tyre"),
    "loop.plant.brake_gain": ("N m", "torque of the brake at full command"),
    "loop.plant.brake_rate": ("1/s", "rate of the brake's lag"),
    "loop.plant.wheel_inertia": ("kg m^2", "inertia of the braked wheel"),
    "loop.actuator.rise": ("s", "dead time before the brake grips"),
    "loop.actuator.fall": ("s", "dead time before the brake releases"),
    "counter_lag": ("s", "age of the wheel speed in the record"),
}
PARAMETER_RANGES: Params = {
    "loop.plant.road.w4": (0.02, 0.8),
    "loop.plant.brake_gain": (2.0, 80.0),
    "loop.plant.brake_rate": (10.0, 1500.0),
    "loop.plant.wheel_inertia": (2e-3, 2e-2),
    "loop.actuator.rise": (2e-3, 0.05),
    "loop.actuator.fall": (2e-3, 0.05),
    "counter_lag": (0.0, 0.03),
}
LOAD, FRICTION = "loop.plant.weight_torque", "loop.plant.road.w4"
LOAD_RANGE = (2.0, 40.0)  # N m


def starts_from(brakes: Sequence[tuple[float, float]]) -> tuple[Params, ...]:
    """Return starts of the fit: two pairs of dead times with each brake, a torque [N m] and a rate of its lag [1/s].

    A brake that grips a sample earlier shifts a whole cycle, so a far start may end in another minimum.
    """
    return tuple(
        {
            FRICTION: 0.22,
            "loop.plant.brake_gain": torque,
            "loop.plant.brake_rate": rate,
            "loop.actuator.rise": rise,
            "loop.actuator.fall": fall,
        }
        for rise, fall in ((0.013, 0.007), (0.016, 0.010))
        for torque, rate in brakes
    )


STARTS = starts_from([(20.0, 400.0)])

STEP_COMMANDS = (0.65, 0.7, 0.75)  # of the step-braking curves, Fig. 5.6 a
STEP_DURATION = 1.5  # s
STEP_FREE: Params = {
    "loop.plant.road.w4": (0.02, 0.8),
    "loop.plant.brake_gain": (2.0, 80.0),
    "loop.plant.brake_rate": (5.0, 1500.0),
    "instant": (-0.2, 0.5),
}
STEP_STARTS: tuple[Params, ...] = tuple(
    {"loop.plant.road.w4": 0.35, "loop.plant.brake_gain": 11.0, "loop.plant.brake_rate": rate} for rate in (30.0, 300.0)
)

NOTES = [
    "The readings come from the figures of the manual, so a pixel limits them: 10 ms, 5.3 rpm and 0.004 of slip.",
    "The radii are those of the driver's perimeters, 0.0956 and 0.0985 m. With the radii of the manual's table a "
    "rolling wheel would slip by -3.6 %.",
    "A run starts at the sample of the first command, with the drum at 1,700 rpm and the wheel rolling. The relay "
    "reads the slip of the encoders every 10 ms.",
    "The standard deviations come from the model linearised at the fit. The residuals estimate their scale. They do "
    "not cover errors of the model.",
]


@pytree
class Coasting:
    """A wheel that only its bearing brakes: J w' = -(d w + M), so w(t) = (w0 + M/d) exp(-d t/J) - M/d."""

    speed: Scalar = param(default=100.0, unit="rad/s", above=0.0)
    """Speed w0 at t = 0."""
    friction: Scalar = param(default=1e-4, unit="N m s", above=0.0)
    """Viscous friction d of the wheel."""
    stiction: Scalar = param(default=1e-2, unit="N m", above=0.0)
    """Dry friction M of the wheel."""
    inertia: Scalar = param(default=7.5281e-3, unit="kg m^2", above=0.0)
    """Inertia J of the wheel."""

    def at(self, t: Vector) -> Vector:
        """Return the speed [rad/s] at instants `t` [s]."""
        dry = self.stiction / self.friction
        return (self.speed + dry) * jnp.exp(-self.friction * t / self.inertia) - dry


def _coasting_residuals(wheel: Coasting, t: Vector, speed: Vector) -> Vector:
    return wheel.at(t) - speed


def fit_coasting() -> dict[str, Identified]:
    """Return a fit of speed, viscous and dry friction to each of the four coasting curves, by name of the curve."""
    fits = {}
    for name, curve in read_curves().items():
        if name.startswith("coasting-"):
            body = name.split("-")[1]
            inertia = MASK.wheel_inertia if body == "wheel" else MASK.drum_inertia
            start = Coasting(speed=float(curve[0, 1]), inertia=inertia)
            data = (jnp.asarray(curve[:, 0]), jnp.asarray(curve[:, 1]))
            fits[name] = fit(start, ["speed", "friction", "stiction"], _coasting_residuals, data=data,
                              sigma=np.array(READING_SHARE * PIXEL[body]), absolute=False)  # fmt: skip
    return fits


def build_rig(coasting: Params) -> LabRig:
    """Return the rig before the fit of experiment 1: the driver's radii, and each bearing's mean over its two curves.

    The relay commands 0 or 1 only, so its brake has one torque: `brake_gain` at full command, with `brake_offset` 0.
    """
    means = {
        f"{body}_{kind}": float(
            np.mean([identified.values[kind] for name, identified in coasting.items() if body in name])
        )
        for body in ("wheel", "drum")
        for kind in ("friction", "stiction")
    }
    return dataclasses.replace(
        MASK,
        wheel_radius=WHEEL_RADIUS,
        drum_radius=DRUM_RADIUS,
        brake_offset=0.0,
        brake_gain=MASK.brake_gain + MASK.brake_offset,
        **means,
    )


def with_scaled_brake(rig: LabRig) -> LabRig:
    """Return a rig whose brake has the manual's shape b(u) = b1 (u - u0), scaled to its torque at full command.

    That torque is the `brake_gain` of `rig`, and `brake_offset` is 0.
    """
    slope = rig.brake_gain / (1 - rig.brake_threshold)
    return dataclasses.replace(rig, brake_gain=slope, brake_offset=-rig.brake_threshold * slope)


def build_run(record: Record, replays: bool, rig: LabRig) -> RecordedRun:
    """Return a run of the measured rig from 1,700 rpm.

    Args:
        replays: True plays the recorded commands; False lets the loop's relay switch.
    """
    return RecordedRun(loop=build_record_loop(record, replays, rig))


def fit_load(record: Record, rig: LabRig, friction_fit: Identified) -> Identified:
    """Return the other reading of a record: the mask's friction, and a load on the wheel that is free instead.

    A normal force is the moment that presses the wheel on the drum, over a lever. The drum and the wheel feel friction
    times normal force, so a record of both hardly tells a small friction from a small load.
    """
    friction = float(get(MASK, "road.w4"))
    load = float(rig.weight_torque * friction_fit.values[FRICTION] / friction)
    free = {path: PARAMETER_RANGES[path] for path in FREE if path != FRICTION} | {LOAD: LOAD_RANGE}
    run = with_values(build_run(record, True, rig), {**friction_fit.values, FRICTION: friction, LOAD: load})
    return fit_record(run, free, record)


def judge(record: Record, rig: LabRig, values: Params) -> JsonObject:
    """Return how far the loop is from a record under recorded commands and under its own relay, and the readings."""
    replayed, relayed = (
        compare_with_record(with_values(build_run(record, mode, rig), values), record) for mode in (True, False)
    )
    measured = describe_record(record)
    return {
        "wheel_rms_percent_given": replayed.wheel_rms_percent,
        "slip_rms_given": replayed.slip_rms,
        "wheel_rms_percent_own": relayed.wheel_rms_percent,
        "slip_rms_own": relayed.slip_rms,
        **_ends(relayed),
        "given": _ends(replayed),
        "measured": {**_ends(measured), "printed_distance": record.printed_distance},
    }


def _ends(match: RecordMatch) -> JsonObject:
    time, distance = (record.format_time(x) for x in (match.stop_time, match.stop_distance))
    return {"cycles": match.cycles, "stop_time": time, "stop_distance": distance}


def compare_tables(rig: LabRig) -> list[JsonObject]:
    """Return the rms distance of two rigs from the manual's readings of brake torque and friction, Fig. 5.6 b and c.

    The brake torque is b(u), 0 below the threshold.

    Returns:
        For each table its name, its unit, and the rms distance of the `mask` and of the `identified` rig.
    """

    def torque(candidate: LabRig, u: np.ndarray) -> np.ndarray:
        return np.where(
            u >= candidate.brake_threshold, np.maximum(candidate.brake_gain * u + candidate.brake_offset, 0.0), 0.0
        )

    def friction(candidate: LabRig, slip: np.ndarray) -> np.ndarray:
        return np.asarray(candidate.road.friction(jnp.asarray(slip), 0.0, 0.0))

    rows = []
    for name, unit, ours in (("brake-torque", "N m", torque), ("friction", "1", friction)):
        x, measured = read_curves()[name].T
        mask, identified = (float(np.sqrt(np.mean((ours(candidate, x) - measured) ** 2))) for candidate in (MASK, rig))
        rows.append({"table": name, "unit": unit, "mask": mask, "identified": identified})
    return rows


@pytree
class StepRun:
    """A loop that brakes with one step of the command, and the instant of this step on the axis of the drawing."""

    loop: Loop = part()
    """Loop whose brake receives the command at t = 0."""
    instant: Scalar = param(default=0.14, unit="s")
    """Instant of the step on the axis of the drawing."""


class StepCurves(NamedTuple):
    """The curves of one step-braking run. A rim speed is a fraction of its value before the step.

    Attributes:
        command: Command after the step [1].
        speed: Rim speed of the drum before the step [m/s].
        t: Instants of the wheel's readings [s], shape (n,), on the axis of the drawing.
        wheel: Rim speed of the wheel [1], shape (n,).
        drum_t: Instants of the drum's readings [s], shape (m,).
        drum: Rim speed of the drum [1], shape (m,).
    """

    command: float
    speed: float
    t: np.ndarray
    wheel: np.ndarray
    drum_t: np.ndarray
    drum: np.ndarray


def read_step(command: float) -> StepCurves:
    """Return the step-braking curves of a command, from Fig. 5.6 a of the manual.

    Before the step the drawn rim of the wheel is 1.8 % faster than that of the drum. The radii of the manual are not
    those of the rig. Each curve is therefore divided by its own first reading.
    """
    (t, wheel), (drum_t, drum) = (read_curves()[f"step-braking {command:g} {body}"].T for body in ("wheel", "drum"))
    return StepCurves(command, float(drum[0]), t, wheel / wheel[0], drum_t, drum / drum[0])


def build_step(curves: StepCurves, rig: LabRig) -> Loop:
    """Return the loop of a step-braking run: both wheels roll, and the brake receives its command at t = 0.

    The drawing does not show the instant of the step, so a dead time has no effect on a comparison and is left out.
    """
    return braking(
        plant=rig, initial=BrakeStart(speed=curves.speed), controller=ConstantTorque(torque=curves.command),
        actuator=Direct(), stop=Standstill(speed=0.05),
    )  # fmt: skip


def _rims(run: Run, speed: float) -> tuple[Any, Any, Any]:
    """Return time [s] and the rim speeds of wheel and drum as fractions of the first speed."""
    assert run.trajectory is not None
    sample = run.trajectory.sample
    return sample.t, sample.output.wheel_speed / speed, sample.output.speed / speed


def _step_residuals(step: StepRun, t: Vector, wheel: Vector, drum_t: Vector, drum: Vector) -> Vector:
    run = run_at_step(step.loop, FixedStep(step=FIT_STEP, duration=STEP_DURATION))
    at, ours, ours_drum = _rims(run, step.loop.initial.speed)
    return jnp.concatenate(
        [jnp.interp(t - step.instant, at, ours) - wheel, jnp.interp(drum_t - step.instant, at, ours_drum) - drum]
    )


def match_step(curves: StepCurves, rig: LabRig) -> JsonObject:
    """Return how far a simulated step-braking run is from the measured one.

    Both are aligned where the wheel has lost 10 % of its rim speed.

    Returns:
        Rms errors of both rim speeds in per cent of the speed before the step, and the `fall_time` in which the wheel's
        falls from 80 to 20 % [s].
    """
    run = jax.tree.map(np.asarray, simulate(build_step(curves, rig), FixedStep(step=RUN_STEP, duration=STEP_DURATION)))
    t, wheel, drum = _rims(run, curves.speed)
    shift = _time_at(0.9, t, wheel) - _time_at(0.9, curves.t, curves.wheel)
    errors = (
        np.interp(curves.t + shift, t, wheel) - curves.wheel,
        np.interp(curves.drum_t + shift, t, drum) - curves.drum,
    )
    wheel_rms, drum_rms = (float(100 * np.sqrt(np.mean(error**2))) for error in errors)
    return {"wheel_rms_percent": wheel_rms, "drum_rms_percent": drum_rms, "fall_time": _fall_time(t, wheel)}


def _time_at(level: float, t: np.ndarray, falling: np.ndarray) -> float:
    return float(np.interp(-level, -falling, t))


def _fall_time(t: np.ndarray, wheel: np.ndarray) -> float:
    return _time_at(0.2, t, wheel) - _time_at(0.8, t, wheel)


def fit_step(curves: StepCurves, rig: LabRig) -> Identified:
    """Return the friction, brake torque, lag and instant of the step with which a rig follows step-braking curves.

    Args:
        rig: Identified rig; its brake torque is `brake_gain` times the command, with `brake_offset` 0.
    """
    data = tuple(jnp.asarray(x) for x in (curves.t, curves.wheel, curves.drum_t, curves.drum))
    return fit(
        StepRun(loop=build_step(curves, rig)), STEP_FREE, _step_residuals, data=data, sigma=np.array(1.0),
        absolute=False, starts=STEP_STARTS, tolerances=Tolerances(cost=1e-4, step=1e-6, gradient=1e-6, evaluations=40),
    )  # fmt: skip


def compare_steps(rig: LabRig, loaded: LabRig) -> list[JsonObject]:
    """Return how far the mask's and the identified rigs are from the three step-braking curves.

    Returns:
        For each command: `measured`, with the `fall_time` [s]; `mask`, `identified` and `mask_friction` (the loaded
        rig), from `match_step`. `fitted` is the same for a fit of `rig` to each curve alone, with `friction` [1],
        `brake_torque` [N m], `brake_rate` [1/s] and their deviations. No other number depends on this fit.
    """
    rows = []
    for command in STEP_COMMANDS:
        curves = read_step(command)
        step_fit = fit_step(curves, rig)
        values, deviations = step_fit.values, step_fit.uncertainty.deviations
        fitted = match_step(curves, step_fit.part.loop.plant) | {
            name + suffix: factor * float(of[f"loop.plant.{path}"])
            for name, path, factor in (("friction", "road.w4", 1.0), ("brake_torque", "brake_gain", command),
                                       ("brake_rate", "brake_rate", 1.0))
            for suffix, of in (("", values), ("_deviation", deviations))
        }  # fmt: skip
        row = {
            "command": command,
            "measured": {"fall_time": _fall_time(curves.t, curves.wheel)},
            "mask": match_step(curves, MASK),
            "identified": match_step(curves, with_scaled_brake(rig)),
            "mask_friction": match_step(curves, with_scaled_brake(loaded)),
            "fitted": fitted,
        }
        rows.append(row)
    return rows


def parameter_rows(identified: Identified, coasting: Params) -> list[JsonObject]:
    """Return each identified parameter with the value of the model's mask, unit and standard deviation."""
    rows = [
        {"name": f"{name}: {kind}", "value": float(bearing.values[kind]), "unit": unit, "mask": float(mask),
         "standard_deviation": float(bearing.uncertainty.deviations[kind]), "what": f"bearing's {kind}, from its curve"}
        for name, bearing in coasting.items()
        for kind, unit in (("friction", "N m s"), ("stiction", "N m"))
        for mask in [getattr(MASK, f"{name.split('-')[1]}_{kind}")]
    ]  # fmt: skip
    for path, (unit, meaning) in (FREE | {LOAD: ("N m", "moment that presses the wheel on the drum")}).items():
        if path not in identified.values:
            continue
        head, _, field = path.partition("loop.plant.")
        mask = None if head else float(get(MASK, field))
        if field == "brake_gain":
            mask = float(MASK.brake_gain + MASK.brake_offset)
        rows.append(
            {"name": path, "value": float(identified.values[path]), "unit": unit, "mask": mask,
             "standard_deviation": float(identified.uncertainty.deviations[path]), "what": meaning}
        )  # fmt: skip
    return rows


def reproduce(folder: pathlib.Path, progress: Callable[[str], None], data: pathlib.Path | None = None) -> JsonObject:
    """Write figures and `summary.json` into the folder, and return the summary.

    Args:
        data: Folder with finer readings of both experiments; None takes the packaged ones.
    """
    first, second = (read_record(experiment, data) for experiment in EXPERIMENTS)
    progress("lab-rig: the maker's own simulations")
    maker = compare_with_maker()
    progress("lab-rig: bearing friction from four coasting curves")
    coasting = fit_coasting()
    rig = build_rig(coasting)
    progress("lab-rig: fitting experiment 1")
    identified = fit_record(
        build_run(first, True, rig), {path: PARAMETER_RANGES[path] for path in FREE}, first, starts=STARTS
    )
    progress("lab-rig: judging by experiment 2")
    judged = {
        name: judge(recording, rig, identified.values) for name, recording in (("fitted", first), ("judged", second))
    }
    progress("lab-rig: the mask's friction with another load")
    loaded = fit_load(first, rig, identified)
    with_load = {FRICTION: float(get(MASK, "road.w4")), **loaded.values}
    with_other_load = {
        name: judge(recording, rig, with_load) for name, recording in (("fitted", first), ("judged", second))
    }
    before = {name: judge(recording, MASK, MASK_VALUES) for name, recording in (("fitted", first), ("judged", second))}
    parameters = parameter_rows(identified, coasting)
    progress("lab-rig: step braking")
    rigs: Any = (
        with_values(build_run(first, True, rig), values).loop.plant for values in (identified.values, with_load)
    )
    plant, pressed = rigs
    steps = compare_steps(plant, pressed)
    progress("lab-rig: figures")
    names = record.save_figures(draw_figures((first, second), rig, identified.values, coasting), folder)
    open_directions = [
        {"spread": direction.spread, "direction": direction.describe()}
        for direction in identified.uncertainty.undetermined_directions(0.1)
    ]
    summary = {
        "paper": "lab-rig",
        "scenario": "lab-rig-measured",
        "title": TITLE,
        "rows": [*_rows(judged), *_step_rows(steps)],
        **judged,
        "before": before,
        "mask_friction": {
            **with_other_load,
            "tables": compare_tables(with_scaled_brake(pressed)),
            "parameters": parameter_rows(loaded, {}),
        },
        "maker": maker,
        "tables": compare_tables(with_scaled_brake(plant)),
        "steps": steps,
        "parameters": parameters,
        "correlation": {
            "names": list(identified.uncertainty.names),
            "matrix": identified.uncertainty.correlation.tolist(),
        },
        "hardly_determined": open_directions,
        "readings": "of the manual's figures, thinned to 80 a curve" if data is None else "finer, from a folder",
        "figures": names,
        "notes": NOTES,
        "solver": record.solver_settings(solver_for(second), sampling_period=0.01),
        "made": provenance.describe_making(("reproduce", "lab-rig")),
        "versions": record.origin_of_numbers(),
    }
    return record.write_summary(folder, summary, compact)


MASK_VALUES: Params = {"loop.actuator.rise": 1e-3, "loop.actuator.fall": 1e-3}  # the mask has no dead time: one step


def _rows(judged: Table) -> list[JsonObject]:
    """Return the rows of `record.computed_row`: the loop's own run beside the measured one."""
    rows = []
    for name, title in (("fitted", "experiment 1 (fitted)"), ("judged", "experiment 2 (judged)")):
        of = judged[name]
        for quantity, unit in (("cycles", "1"), ("stop_time", "s"), ("stop_distance", "m")):
            rows.append(record.computed_row(title, quantity, unit, of[quantity], reference=of["measured"][quantity]))
        for quantity, unit in (("wheel_rms_percent_given", "%"), ("wheel_rms_percent_own", "%"),
                               ("slip_rms_given", "1"), ("slip_rms_own", "1")):  # fmt: skip
            rows.append(record.computed_row(title, quantity, unit, of[quantity]))
    return rows


def _step_rows(steps: list[JsonObject]) -> list[JsonObject]:
    """Return the rows of `record.computed_row` for the step-braking runs."""
    rows = []
    for step in steps:
        for state in ("mask", "identified", "mask_friction", "fitted"):
            name = f"step braking with {step['command']:g} ({state})"
            for quantity, unit in (("wheel_rms_percent", "%"), ("drum_rms_percent", "%")):
                rows.append(record.computed_row(name, quantity, unit, step[state][quantity]))
            rows.append(record.computed_row(name, "fall_time", "s", step[state]["fall_time"],
                                            reference=step["measured"]["fall_time"]))  # fmt: skip
    return rows


def draw_figures(records: tuple[Record, Record], rig: LabRig, values: Params, coasting: Params) -> JsonObject:
    """Return the figures by file name: both experiments, and the coasting curves."""
    titles = ("Experiment 1: relay at slip 0.1 (fitted)", "Experiment 2: relay at slip 0.7 (judged)")
    drawn = {
        f"experiment_{i + 1}": _draw_experiment(recording, rig, values, title)
        for i, (recording, title) in enumerate(zip(records, titles, strict=True))
    }
    panels = [
        plot.MeasuredPanel(
            f"{name.split('-')[1]} [rad/s]", t, speed, np.asarray(bearing.part.at(t)), "bearing friction"
        )
        for name, bearing in coasting.items()
        for t, speed in [read_curves()[name].T]
    ]
    return {**drawn, "coasting": plot.draw_measured(panels, title="Coasting: a wheel that only its bearing brakes")}


def _draw_experiment(recording: Record, rig: LabRig, values: Params, title: str) -> Any:
    panels, turns = [], recording.wheel > HARDLY_TURNS / 4
    for replays, name in ((True, "simulated, measured commands"), (False, "simulated, its own relay")):
        recorded = with_values(build_run(recording, replays, rig), values)
        wheel, slip = simulate_readings(
            simulate(recorded.loop, solver_for(recording)), recorded, solver_for(recording), recording.t
        )
        measured, ours = (np.where(turns, x, np.nan) for x in (recording.slip, np.asarray(slip)))
        panels.append(plot.MeasuredPanel("wheel [rad/s]", recording.t, recording.wheel, np.asarray(wheel), name))
        panels.append(plot.MeasuredPanel("slip [1]", recording.t, measured, ours, name))
    return plot.draw_measured(panels, title=title)


def compact(summary: Table) -> Digest:
    """Return the digest: both experiments measured and simulated, and the identified parameters."""
    headings = ("experiment", "given [%]", "own [%]", "cycles", "time [s]", "distance [m]")
    lines = []
    for number, key in (("1", "fitted"), ("2", "judged")):
        measured = summary[key]["measured"]
        lines.append((f"{number}, measured", "", "", *_cells(measured)))
        states = {
            "mask": summary["before"][key],
            f"identified ({key})": summary[key],
            f"mask's friction, load identified ({key})": summary["mask_friction"][key],
        }
        for state, of in states.items():
            rms = (f"{of[f'wheel_rms_percent_{mode}']:.1f}" for mode in ("given", "own"))
            lines.append((f"{number}, {state}", *rms, *_cells(of)))
    values = [
        f"{note}{row['name']} = {row['value']:.4g} +- {row['standard_deviation']:.1g} {row['unit']}"
        for note, rows in (("", summary["parameters"]), ("mask's friction: ", summary["mask_friction"]["parameters"]))
        for row in rows
        if ":" not in row["name"] and (not note or row["name"] == LOAD)
    ]
    rule = "Given, own: rms error of the wheel's speed under the measured commands and under its own relay."
    steps = [
        f"Step braking with {step['command']:g}: wheel's rms error {step['mask']['wheel_rms_percent']:.1f} % (mask), "
        f"{step['identified']['wheel_rms_percent']:.1f} % (identified), {step['fitted']['wheel_rms_percent']:.1f} % "
        f"(fitted to it: {step['fitted']['brake_torque']:.1f} N m, friction w4 = {step['fitted']['friction']:.3f})."
        for step in summary["steps"]
    ]
    sentences = [rule, *values, *steps]
    return Digest(summary["title"].split(" (")[0], headings, lines, sentences, (), len(summary["figures"]))


def _cells(of: Table) -> tuple[str, ...]:
    ends = ((of["stop_time"], ".2f"), (of["stop_distance"], ".1f"))
    return f"{of['cycles']}", *(end if end == "never" else format(end, digits) for end, digits in ends)
