"""Which effects does the measured laboratory rig have, and how do controllers do on the identified rig?

The study adds effects one at a time, fits each to the first half of experiment 1, and judges by the second half, under
the recorded commands. An effect stays under three conditions. It lowers the wheel's error there by 5 %, it does not
raise that of the slip, and its parameters differ from zero by two standard deviations. Then all of experiment 1 is
fitted with the effects that stay. Experiment 2 judges; no fit uses it. Fits from ten starts show the minima, without
and with the compliance of tyre and belt.

Last, controllers run on the rig of the maker's mask and on the identified rig (README.md).

    python experiments/measured_rig/run.py [PART ...] [--data FOLDER]
"""

import argparse
import dataclasses
import functools
import json
import math
import pathlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from diffabs import Batch, FixedStep, Loop, measure, run_batch
from diffabs.core.blocks import Direct, Series
from diffabs.core.protocols import Memory
from diffabs.core.pytree import param, pytree, replace
from diffabs.core.types import Scalar
from diffabs.papers import lab_rig, measured_rig, record
from diffabs.papers.measured_rig import MASK, Record, RecordedRun, compare_with_record, fit_record, with_values
from diffabs.parts.actuators import AsymmetricLag, DeadTime, Delay, Lag
from diffabs.parts.controllers import (
    PID,
    BackCalculation,
    Clamping,
    ConstantInput,
    ProportionalFeedback,
    Sampled,
    StateFeedback,
)
from diffabs.parts.objectives import BRAKING
from diffabs.parts.plants import BrakeStart, LabRig, MirroredRig
from diffabs.parts.plants.lab_rig import LabRigState
from diffabs.parts.references import FilteredSlip, FixedSlip, LimitedSlip
from diffabs.parts.roads import Burckhardt
from diffabs.parts.sensors import EncoderSlip
from diffabs.parts.stops import SpeedReached
from diffabs.scenario.defaults import braking
from diffabs.tune.identify import Identified
from experiments._shared.numbers import store_numbers

HALF = 1.5  # s; experiment 1 lasts 3 s
# Ten starts: brakes (torque [N m], rate of the lag [1/s]) with two pairs of dead times each.
TEN_STARTS = lab_rig.starts_from([(20.0, 400.0), (24.0, 200.0), (16.0, 100.0), (30.0, 400.0), (20.0, 800.0)])
LEAST_GAIN = 0.05  # relative fall of the wheel's error in the second half for which an effect stays


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    data: str | None = None
    parts: tuple[str, ...] = ()  # of PARTS; all without one
    controllers_step: float = 5e-4  # s
    draws: int = 200  # of the identified parameters
    out: str = "out/experiments/measured_rig"


@pytree
class ContactSurplus:
    """A brake that grips harder at first: control = (u + s (u - z))/(1 + s), T z' = u - z."""

    surplus: Scalar = param(default=0.1, unit="1", low=0.0)
    time_constant: Scalar = param(default=0.01, unit="s", above=0.0)

    def start(self, signal: Scalar) -> Memory:
        """Return the memory of a brake at rest."""
        return Memory(flow=0.0 * signal)

    def flow(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return z'."""
        return (signal - memory.flow) / self.time_constant

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return the control."""
        return (signal + self.surplus * (signal - memory.flow)) / (1 + self.surplus)


@pytree
class HeldFriction:
    """A road with one friction for every slip."""

    mu: Scalar = param(default=0.0, unit="1")

    def friction(self, slip: Scalar, speed: Scalar = 0.0, distance: Scalar = 0.0) -> Scalar:
        """Return mu [1]."""
        return self.mu + 0.0 * slip


class CompliantRigState(NamedTuple):
    """State of a `LabRig`, and the friction coefficient m that the deflected tyre transmits [1]."""

    wheel: Scalar
    drum: Scalar
    brake: Scalar
    distance: Scalar
    deflected: Scalar


@pytree
class CompliantRig(LabRig):
    """A `LabRig` whose tyre yields along the belt: the friction m follows mu(slip) over a rolled length L.

        L m' = v (mu(slip) - m),   v = speed of the drum's rim

    Source: H. B. Pacejka, Tire and Vehicle Dynamics, 3rd ed., ch. 7: a relaxation length stands for the compliance.
    """

    relaxation: Scalar = param(default=0.03, unit="m", above=0.0)

    def start(self, initial: BrakeStart) -> Any:
        """Return the state of a rolling tyre without deflection."""
        state = LabRig.start(self, initial)
        return CompliantRigState(*state, 0.0 * initial.speed)

    def derivative(self, t: Scalar, state: Any, control: Scalar) -> Any:
        """Return dx/dt under the brake command `control` [1]."""
        rigid = LabRigState(*state[:4])
        settled, _, _ = LabRig.contact(self, rigid)
        rate = self.drum_radius * state.drum / self.relaxation * (settled - state.deflected)
        return CompliantRigState(*LabRig.derivative(self, t, state, control), rate)

    def contact(self, state: Any) -> tuple[Any, Any, Any]:
        """Return friction coefficient [1], normal force [N], and braking torque [N m], as `LabRig` does."""
        return LabRig.contact(dataclasses.replace(self, road=HeldFriction(mu=state.deflected)), state)

    def project(self, state: Any) -> Any:
        """Return the state with neither wheel turning backwards."""
        return CompliantRigState(*LabRig.project(self, state), state.deflected)


def as_compliant(rig: LabRig) -> CompliantRig:
    """The rig with a tyre that yields."""
    return CompliantRig(**{field.name: getattr(rig, field.name) for field in dataclasses.fields(rig)})


@dataclasses.dataclass(frozen=True)
class Effect:
    """A change of the model: other parts, and free parameters with their ranges and starting values.

    `plant` makes another plant from the rig."""

    name: str
    parts: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    free: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    start: Mapping[str, float] = dataclasses.field(default_factory=dict)
    plant: Callable[[LabRig], LabRig] | None = None


def of(*names: str) -> dict[str, tuple[float, float]]:
    """The ranges of `lab_rig` of parameters by the end of their path."""
    return {path: range_ for path, range_ in lab_rig.PARAMETER_RANGES.items() if path.rpartition(".")[2] in names}


BASE = Effect(
    "friction, brake torque and lag identified",
    {"loop.actuator": Direct()},
    of("w4", "brake_gain", "brake_rate", "counter_lag"),
    {"loop.plant.road.w4": 0.22, "loop.plant.brake_gain": 20.0, "loop.plant.brake_rate": 60.0},
)
CHAIN = (
    Effect("one dead time", {"loop.actuator": Delay(time=0.012, capacity=128)}, {"loop.actuator.time": (2e-3, 0.05)}),
    Effect("dead times that differ", {"loop.actuator": DeadTime(rise=0.015, fall=0.008)}, of("rise", "fall")),
    Effect("inertia of the wheel", {}, of("wheel_inertia")),
)  # fmt: skip
SINGLE = (
    Effect(
        "lags that differ",
        {"loop.actuator": Series(blocks=(DeadTime(rise=0.012, fall=0.006), AsymmetricLag(rise=4e-3, fall=4e-3))),
         "loop.plant.brake_rate": 1500.0},
        {f"loop.actuator.blocks.{i}.{side}": (1e-3, 0.05) for i in (0, 1) for side in ("rise", "fall")},
    ),
    Effect("friction that falls with slip", {}, {"loop.plant.road.w1": (-0.2, 0.2)}),
    Effect(
        "friction that falls with speed (Burckhardt)",
        {"loop.plant.road": Burckhardt(c1=0.22, c2=60.0, c3=0.01, c4=0.001)},
        {"loop.plant.road.c1": (0.05, 0.6), "loop.plant.road.c3": (1e-4, 0.2), "loop.plant.road.c4": (1e-5, 0.1)},
    ),
    Effect("weight on the wheel", {}, {"loop.plant.weight_torque": (10.0, 40.0)}),
    Effect(
        "torque surplus at first contact",
        {"loop.actuator": Series(blocks=(DeadTime(rise=0.012, fall=0.006), ContactSurplus()))},
        {"loop.actuator.blocks.0.rise": (1e-3, 0.05), "loop.actuator.blocks.0.fall": (1e-3, 0.05),
         "loop.actuator.blocks.1.surplus": (1e-3, 3.0)},
    ),
    Effect(
        "compliance of tyre and belt", {}, {"loop.plant.relaxation": (8e-3, 0.5)}, plant=as_compliant
    ),
)  # fmt: skip


def changed(recorded: RecordedRun, effect: Effect) -> RecordedRun:
    """Return the run with the parts and starting values of an effect. The lag gets its first value again: a fit may
    end at its limit."""
    if effect.plant is not None:
        recorded = replace(recorded, {"loop.plant": effect.plant(recorded.loop.plant)})
    return replace(recorded, {"loop.plant.brake_rate": 300.0, **effect.parts, **effect.start})


def free_in(recorded: RecordedRun, free: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """The free parameters that a run has: an effect may have replaced the part of an earlier one."""

    def has(path: str) -> bool:
        try:
            replace(recorded, {path: 0.0})
        except (ValueError, AttributeError, KeyError):
            return False
        return True

    return {path: range_ for path, range_ in free.items() if has(path)}


def effects(first: Record, second: Record, rig: Any) -> list[dict[str, Any]]:
    """One row for each effect: errors in both halves of experiment 1, whether it stays, and experiment 2's error."""
    rows: list[dict[str, Any]] = []

    def row(name: str, recorded: RecordedRun, count: int, stays: bool | None) -> dict[str, Any]:
        fitted, rest = compare_with_record(recorded, first, last=HALF), compare_with_record(recorded, first, first=HALF)
        other = replace(recorded, {"loop": dataclasses.replace(
            recorded.loop, controller=lab_rig.build_run(second, True, rig).loop.controller)})  # fmt: skip
        judged = compare_with_record(other, second)
        line = {"effect": name, "parameters": count, "first half [%]": fitted.wheel_rms_percent,
                "second half [%]": rest.wheel_rms_percent, "its slip [1]": rest.slip_rms,
                "determined": None, "stays": stays,
                "experiment 2 [%]": judged.wheel_rms_percent, "its slip [1] ": judged.slip_rms}  # fmt: skip
        rows.append(line)
        return line

    def try_effect(recorded: RecordedRun, free: Mapping[str, tuple[float, float]], effect: Effect) -> tuple[Any, Any]:
        trial = changed(recorded, effect)
        ranges = free_in(trial, {**free, **effect.free})
        if effect.name == "lags that differ":
            ranges.pop("loop.plant.brake_rate")
        return fit_record(trial, ranges, first, until=HALF, tolerance=1e-3), ranges

    mask = lab_rig.build_run(first, True, MASK)
    row("the mask, no dead time", replace(mask, {"loop.actuator": Direct()}), 0, None)
    recorded, free = changed(lab_rig.build_run(first, True, rig), BASE), dict(BASE.free)
    best = (math.inf, math.inf)

    def add_row(effect: Effect, fit: Identified) -> tuple[float, float]:
        line = row(effect.name, fit.part, len(fit.values), None)
        errors = line["second half [%]"], line["its slip [1]"]
        deviations = fit.uncertainty.deviations
        line["determined"] = all(abs(fit.values[path]) > 2 * deviations[path] for path in effect.free)
        better = errors[0] < (1 - LEAST_GAIN) * best[0] and errors[1] <= best[1]
        line["stays"] = better and line["determined"]
        return errors

    for effect in (BASE, *CHAIN):
        fit, ranges = try_effect(recorded, free, effect)
        errors = add_row(effect, fit)
        if rows[-1]["stays"]:
            recorded, free, best = fit.part, ranges, errors
    for effect in SINGLE:
        add_row(effect, try_effect(recorded, free, effect)[0])
    return rows


def from_ten_starts(first: Record, second: Record, rig: LabRig) -> list[dict[str, Any]]:
    """Return the minima of ten starts, best first, and their errors in the second half and in experiment 2.

    Rigid and compliant tyre are fitted to half of experiment 1 and to all of it.
    """
    free, rows = {path: lab_rig.PARAMETER_RANGES[path] for path in lab_rig.FREE}, []
    for until, fitted in ((HALF, "first half"), (math.inf, "all")):
        for tyre, plant, more in (("rigid", rig, {}), ("compliant", as_compliant(rig), SINGLE[-1].free)):
            starts = [start | dict.fromkeys(more, 0.1) for start in TEN_STARTS]
            run = lab_rig.build_run(first, True, plant)
            for fit in sorted(fit_record(run, free | more, first, until, starts).starts, key=lambda fit: fit.cost):
                rest = compare_with_record(fit.part, first, first=HALF)
                here, other = lab_rig.judge(first, plant, fit.values), lab_rig.judge(second, plant, fit.values)
                rows.append({
                    "tyre": tyre, "fitted to": fitted, "cost": fit.cost,
                    **{path.rpartition(".")[2]: f"{float(value):.4g}" for path, value in fit.values.items()},
                    "second half [%]": rest.wheel_rms_percent, "its slip [1]": rest.slip_rms,
                    "1 given [%]": here["wheel_rms_percent_given"], "1 slip [1]": here["slip_rms_given"],
                    "1 own [%]": here["wheel_rms_percent_own"], "1 cycles": here["cycles"],
                    "1 stop [s]": here["stop_time"],
                    "2 given [%]": other["wheel_rms_percent_given"], "2 slip [1]": other["slip_rms_given"],
                    "2 own [%]": other["wheel_rms_percent_own"], "2 cycles": other["cycles"],
                    "2 stop [s]": other["stop_time"],
                })  # fmt: skip
    return rows


def diagnosis(first: Record, second: Record, rig: LabRig, fit: Identified) -> list[dict[str, Any]]:
    """Return the parameters that fit experiment 2 alone, beside those of experiment 1.

    Also returns how well each set follows both experiments under their commands. No number of the identified rig
    comes from here.
    """
    free = {path: lab_rig.PARAMETER_RANGES[path] for path in lab_rig.FREE}
    start = with_values(lab_rig.build_run(second, True, rig), fit.values)
    other = fit_record(start, free, second, starts=[{}, *lab_rig.STARTS[1:]])
    rows = []
    for name, result in (("experiment 1", fit), ("experiment 2", other)):
        errors = [compare_with_record(with_values(lab_rig.build_run(record, True, rig), result.values), record)
                  for record in (first, second)]  # fmt: skip
        deviations = result.uncertainty.deviations
        rows.append({
            "fitted to": name,
            **{path.rpartition(".")[2]: f"{float(value):.4g} +- {deviations[path]:.1g}"
               for path, value in result.values.items()},
            "wheel 1 [%]": errors[0].wheel_rms_percent, "wheel 2 [%]": errors[1].wheel_rms_percent,
            "cycles 2": errors[1].cycles, "stop 1 [s]": record.format_time(errors[0].stop_time),
            "stop 2 [s]": record.format_time(errors[1].stop_time),
        })  # fmt: skip
    return rows


def torque_controllers() -> dict[str, dict[str, Any]]:
    """The parts of three controllers of `overshoot_cured` and `real_rig`, for a plant whose input is a torque."""
    tuned = json.loads((pathlib.Path("docs") / "controllers" / "known-tuned-cvar.json").read_text())["parameters"]
    value = {path: entry["value"] for path, entry in tuned.items()}
    holding = ConstantInput(value=value["feedforward.value"])
    return {
        "published gain": {
            "feedforward": holding, "reference": FixedSlip(),
            "controller": StateFeedback(gain=np.array([-11753.0, -48.0]), low=0.0, high=9.03),
        },
        "first cure": {
            "feedforward": holding, "reference": FilteredSlip(time_constant=0.01732),
            "controller": ProportionalFeedback(gain=np.array([-17300.0, -348.6]), low=0.0, high=9.03),
        },
        "tuned for CVaR": {
            "feedforward": holding,
            "reference": LimitedSlip(
                rate=value["reference.rate"], time_constant=value["reference.time_constant"], period=1e-3
            ),
            "controller": ProportionalFeedback(
                gain=np.array(value["controller.controller.gain"]), low=0.0, high=9.03,
                antiwindup=BackCalculation(tracking_time=value["controller.controller.antiwindup.tracking_time"]),
            ),
        },
    }  # fmt: skip


def as_command(parts: Mapping[str, Any]) -> dict[str, Any]:
    """The parts for a rig whose input is a command: torque = 15.24 u - 6.21, as the mask says."""
    slope, offset, controller = float(MASK.brake_gain), float(MASK.brake_offset), parts["controller"]
    return {
        **parts,
        "feedforward": ConstantInput(value=(parts["feedforward"].value - offset) / slope),
        "controller": dataclasses.replace(
            controller, gain=np.asarray(controller.gain) / slope, low=0.0, high=1.0
        ),
    }  # fmt: skip


def surroundings(rig: LabRig, dead: DeadTime) -> dict[str, dict[str, Any]]:
    """Plant, sensor, actuator and sampling of each row of the comparison."""
    start = BrakeStart(speed=measured_rig.BRAKING_SPEED * float(rig.drum_radius))
    dead = dataclasses.replace(dead, capacity=32)
    lag = {"initial": BrakeStart(speed=50 / 3.6), "sensor": Direct(), "actuator": Lag(time_constant=1e-3)}
    return {
        "rig of [lmi], lag 1 ms": {"plant": MirroredRig(mass=5.75), "period": 1e-3, **lag},
        "mask, but lag 1 ms": {"plant": dataclasses.replace(MASK, brake_rate=1000.0), "period": 1e-3, **lag,
                               "actuator": Direct()},
        "mask (lag 48 ms)": {"plant": MASK, "period": 1e-3, **lag, "actuator": Direct()},
        "identified": {"plant": rig, "period": 1e-3, "initial": start, "sensor": Direct(), "actuator": dead},
        "identified, its encoders": {"plant": rig, "period": 1e-2, "initial": start,
                                     "sensor": EncoderSlip(period=1e-2), "actuator": dead},
    }  # fmt: skip


def loop_in(around: Mapping[str, Any], parts: Mapping[str, Any]) -> Loop:
    """The loop of a controller in its surroundings, from 1,700 rpm or 50 km/h to 5 km/h."""
    around = dict(around)
    period = around.pop("period")
    commanded = dict(parts) if isinstance(around["plant"], MirroredRig) else as_command(parts)
    inner = commanded.pop("controller")
    if isinstance(windup := getattr(inner, "antiwindup", None), BackCalculation):  # unstable if faster than the samples
        inner = dataclasses.replace(
            inner, antiwindup=dataclasses.replace(windup, tracking_time=max(float(windup.tracking_time), period))
        )
    controller = Sampled(controller=inner, period=period)
    if isinstance(commanded["reference"], LimitedSlip):
        commanded["reference"] = dataclasses.replace(commanded["reference"], period=period)
    return braking(**{**around, **commanded, "controller": controller, "stop": SpeedReached(speed=5 / 3.6)})


def old_controllers(config: Config, rig: LabRig, dead: DeadTime) -> list[dict[str, Any]]:
    """Return the metrics of the earlier pages' controllers on each rig."""
    rows, solver = [], FixedStep(step=config.controllers_step, duration=8.0)
    for name, parts in torque_controllers().items():
        for where, around in surroundings(rig, dead).items():
            metrics = measure(loop_in(around, parts), solver, BRAKING).metrics
            rows.append(outcome(name, where, metrics))
    return rows


def outcome(name: str, where: str, metrics: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the tables of controllers."""
    return {"controller": name, "on": where, "overshoot [%]": 100 * float(metrics["overshoot"]),
            "locked [s]": float(metrics["locked_time"]), "IAE [s]": float(metrics["iae"]),
            "distance [m]": float(metrics["stop_distance"])}  # fmt: skip


def pi_loop(rig: LabRig, holds: float, actuator: Any, gains: tuple[float, float] = (1.0, 1.0)) -> Loop:
    """A PI on the encoders' slip every 10 ms, with a constant command added; 1,700 rpm to 5 km/h."""
    pid = PID(kp=gains[0], ki=gains[1], low=0.0, high=1.0, antiwindup=Clamping())
    return braking(
        plant=rig, initial=BrakeStart(speed=measured_rig.BRAKING_SPEED * float(rig.drum_radius)),
        sensor=EncoderSlip(period=1e-2), reference=FixedSlip(), feedforward=ConstantInput(value=holds),
        controller=Sampled(controller=pid, period=1e-2), actuator=actuator, stop=SpeedReached(speed=5 / 3.6),
    )  # fmt: skip


def tuned_pi(config: Config, loop: Loop, over: Mapping[str, Any]) -> tuple[tuple[float, float], float]:
    """The gains of least mean IAE over the given parameters, of a grid of 24 x 24; the IAE. Locked runs count as they
    are: their IAE is large."""
    kp, ki = (x.ravel() for x in np.meshgrid(np.geomspace(0.01, 10.0, 24), [0.0, *np.geomspace(0.01, 30.0, 23)]))
    count = max([1, *(len(rows) for rows in over.values())])
    rows = {"controller.controller.kp": np.repeat(kp, count), "controller.controller.ki": np.repeat(ki, count),
            **{path: np.tile(values, len(kp)) for path, values in over.items()}}  # fmt: skip
    solver = FixedStep(step=config.controllers_step, duration=6.0)
    runs = run_batch(loop, Batch(rows), solver, {"iae": BRAKING["iae"]}, accepted=True)
    iae = np.where(np.asarray(runs.diverged), np.inf, np.asarray(runs.metrics["iae"])).reshape(len(kp), count)
    best = int(np.argmin(iae.mean(axis=1)))
    return (float(kp[best]), float(ki[best])), float(iae.mean(axis=1)[best])


def new_controllers(config: Config, rig: LabRig, dead: DeadTime, fit: Identified) -> list[dict[str, Any]]:
    """A PI tuned on the mask, on the identified rig, and on draws of its parameters, each judged on the draws."""
    names, draws = list(fit.uncertainty.names), np.random.default_rng(0).multivariate_normal(
        [float(fit.values[name]) for name in fit.uncertainty.names], fit.uncertainty.covariance, config.draws
    )  # fmt: skip
    of_loop = {name.removeprefix("loop."): draws[:, i] for i, name in enumerate(names) if name != "counter_lag"}
    slope = of_loop["plant.brake_gain"] / (1 - float(rig.brake_threshold))
    of_loop |= {"plant.brake_gain": slope, "plant.brake_offset": -float(rig.brake_threshold) * slope}
    rows = []
    for name, plant, actuator, over in (
        ("PI tuned on the mask", MASK, Direct(), {}),
        ("PI tuned on the identified rig", rig, dead, {}),
        ("PI tuned over its covariance", rig, dead, {path: values[:16] for path, values in of_loop.items()}),
    ):
        output = plant.output(plant.start(BrakeStart(speed=10.0)))
        holds = float(plant.holding(output, 0.2))
        gains, iae = tuned_pi(config, pi_loop(plant, holds, actuator), over)
        judged = pi_loop(rig, holds, dead, gains)
        solver = FixedStep(step=config.controllers_step, duration=6.0)
        runs = run_batch(judged, Batch(of_loop), solver, BRAKING, accepted=True)
        nominal = measure(pi_loop(plant, holds, actuator, gains), solver, BRAKING).metrics
        iaes = np.asarray(runs.metrics["iae"])
        rows.append({"controller": name, "kp, ki": f"{gains[0]:.3g}, {gains[1]:.3g}", "IAE where tuned [s]": iae,
                     "overshoot there [%]": 100 * float(nominal["overshoot"]),
                     "IAE on the draws, mean [s]": float(iaes.mean()), "worst [s]": float(iaes.max()),
                     "overshoot, worst [%]": 100 * float(np.max(np.asarray(runs.metrics["overshoot"]))),
                     "distance, mean [m]": float(np.mean(np.asarray(runs.metrics["stop_distance"])))})  # fmt: skip
    return rows


PARTS = {
    "effects": "Effects, one at a time (wheel rms in per cent of 1,800 rpm)",
    "minima": "Minima from ten starts",
    "experiment-2": "What experiment 2 asks for (fitted after it has judged)",
    "controllers": "Controllers of the earlier pages",
    "pi": "A PI at 10 ms, tuned on three rigs and judged on draws of the identified one",
}


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results by part."""
    config = config or Config()
    data = None if config.data is None else pathlib.Path(config.data)
    first, second = (measured_rig.read_record(name, data) for name in measured_rig.EXPERIMENTS)
    rig = lab_rig.build_rig(lab_rig.fit_coasting())

    @functools.cache
    def identified() -> Identified:
        free = {path: lab_rig.PARAMETER_RANGES[path] for path in lab_rig.FREE}
        return fit_record(lab_rig.build_run(first, True, rig), free, first, starts=lab_rig.STARTS)

    def with_brake() -> tuple[LabRig, DeadTime]:
        loop = identified().part.loop
        return lab_rig.with_scaled_brake(loop.plant), loop.actuator

    make = {
        "effects": lambda: effects(first, second, rig),
        "minima": lambda: from_ten_starts(first, second, rig),
        "experiment-2": lambda: diagnosis(first, second, rig, identified()),
        "controllers": lambda: old_controllers(config, *with_brake()),
        "pi": lambda: new_controllers(config, *with_brake(), identified()),
    }
    results = {}
    for name in config.parts or PARTS:
        results[name] = make[name]()
        record.print_rows(PARTS[name], results[name])
    return record.experiment(config, results, {})


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all without one")
    parser.add_argument("--data", help="folder with finer readings than the packaged ones")
    options = parser.parse_args()
    if unknown := [name for name in options.parts if name not in PARTS]:
        parser.error(f"PART = {unknown[0]!r} is unknown; known are {', '.join(PARTS)}")
    results = main(Config(data=options.data, parts=tuple(options.parts)))
    for name in PARTS.keys() & results.keys() if options.data is None else ():
        store_numbers(__file__, {"rows": results[name]}, 1e-2, name)
