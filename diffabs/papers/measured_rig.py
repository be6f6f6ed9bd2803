"""The laboratory rig as INTECO measured it: its records, the loop that models them, and the fit of its parameters.

    experiment 1   relay at slip 0.1: the parameters are fitted to it
    experiment 2   relay at slip 0.7: it judges the fitted loop, and nothing is fitted to it

A loop runs in two ways. *Given*: the brake receives the commands that the relay of the experiment sent. *Own*: the
loop's relay reads the slip that the loop's encoders measure, every 10 ms.

Source: INTECO, ABS, The laboratory Anti-lock Braking System, user's manual (2014), Fig. 3.11, 3.13, 5.5 and 5.6. The
readings of `measured_rig.csv` were taken from its figures. A curve has at most 80 of them; straight lines between them
follow the curve. A folder of finer readings replaces them (`read_record`).
"""

import csv
import dataclasses
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.pytree import param, part, pytree, replace
from diffabs.core.types import JsonObject, Params, Scalar, Vector
from diffabs.engine.solvers import FixedStep
from diffabs.host import files
from diffabs.host.values import ScenarioError
from diffabs.loop.closed_loop import Loop
from diffabs.loop.result import Run
from diffabs.loop.run import run_unchecked
from diffabs.parts.actuators import DeadTime
from diffabs.parts.controllers import ConstantTorque, PlayedCommand, Relay, Sampled
from diffabs.parts.plants import BrakeStart, LabRig
from diffabs.parts.references import FixedSlip
from diffabs.parts.roads import RIG_UNROUNDED
from diffabs.parts.sensors import EncoderSlip
from diffabs.parts.stops import Standstill
from diffabs.scenario.defaults import braking
from diffabs.tune.identify import Identified, Tolerances, fit

PERIOD = 0.01  # s, sampling of the rig's computer
RUN_STEP = 1.25e-4  # s; stable down to standstill, with the mask's friction down to 0.07 m/s
FIT_STEP = 1e-3  # s; against RUN_STEP it changes the wheel's error by 0.005 % of full scale, the stop by 3 ms
RPM = 2 * np.pi / 60  # rad/s
FULL_SCALE = 1800 * RPM  # rad/s, to which the manual accelerates the wheel: 100 % of an error
BRAKING_SPEED = 1700 * RPM  # rad/s of the drum, at which the motor stops and the relay starts
SIGMA_SPEED, SIGMA_SLIP = 3.0, 0.01  # rad/s and 1: scales of the residuals; only their ratio counts
WHEEL_RADIUS, DRUM_RADIUS = 0.6004 / (2 * np.pi), 0.619 / (2 * np.pi)  # m, the perimeters in the driver
HARDLY_TURNS = 20.0  # rad/s; below it a slip counts less in the fit
MAX_KNOWN_SLIP, MIN_KNOWN = 0.9, 4  # largest slip of a reading that tells the vehicle's speed; fewest for a cubic
# the rig with the numbers in the mask of the maker's Simulink model
MASK = LabRig(
    wheel_inertia=7.5281e-3, drum_inertia=25.603e-3, wheel_friction=1.2e-4, drum_friction=2.25e-4, drum_stiction=0.093,
    brake_rate=1 / 0.048, brake_threshold=6.21 / 15.24, road=RIG_UNROUNDED,
)  # fmt: skip


class Record(NamedTuple):
    """One braking experiment, from the start of the brake to standstill.

    Attributes:
        threshold: Slip at which the relay switches [1].
        t: Instants [s] from the start of the brake, shape (n,), every 10 ms.
        wheel: Speed of the braked wheel [rad/s], shape (n,), as a counter shows it.
        slip: Slip [1], shape (n,), as the computer measures it.
        commands: Commands of the relay [1], shape (n,), 0 or 1, as the slip of the finest readings gives them.
        printed_distance: Braking distance that the manual prints [m].
    """

    threshold: float
    t: np.ndarray
    wheel: np.ndarray
    slip: np.ndarray
    commands: np.ndarray
    printed_distance: float

    @property
    def stop_time(self) -> float:
        """Time of the last sample with a wheel speed above 0 or a slip beyond 0.01, and one period more [s].

        It is infinite if the record ends before standstill.
        """
        moves = (self.wheel > 0) | (np.abs(self.slip) > 0.01)
        return float(np.inf if moves[-1] else self.t[np.flatnonzero(moves)[-1]] + PERIOD)

    @property
    def stop_distance(self) -> float:
        """Braking distance [m]: the integral of a cubic through the vehicle speeds that wheel speed and slip give.

        Near slip 1 they say little about the vehicle: each reading has the weight 1 - slip. The distance is infinite if
        the record ends before standstill.
        """
        if np.isinf(self.stop_time):
            return float(np.inf)
        usable = (self.slip < MAX_KNOWN_SLIP) & (self.t < self.stop_time)
        complement = 1 - self.slip[usable]
        cubic = np.polyfit(self.t[usable], self.wheel[usable] * WHEEL_RADIUS / complement, 3, w=complement)
        t = np.linspace(0.0, self.stop_time, 400)
        return float(np.trapezoid(np.maximum(np.polyval(cubic, t), 0.0), t))


class Experiment(NamedTuple):
    """Where a record is, and what the manual prints about it."""

    name: str
    threshold: float
    start: float  # time of the first command on the axis of the figure [s]
    printed_distance: float  # m


def run_at_step(loop: Loop, solver: FixedStep) -> Run:
    """Return a run with a trajectory of every step, whose step is not checked.

    `FIT_STEP` is not stable below some 0.5 m/s; the comment at its value says how much that changes.
    """
    return run_unchecked(loop, solver, {}, None, solver.every)


simulate = jax.jit(run_at_step, static_argnums=1)  # one function, so that runs of one structure compile once
EXPERIMENTS = (Experiment("relay-slip-0.1", 0.1, 6.46, 26.5), Experiment("relay-slip-0.7", 0.7, 6.12, 22.8))


@pytree
class DrivenStart:
    """Speed and slip at the start of braking; the wheel may be faster than the vehicle, unlike in a `BrakeStart`."""

    speed: Scalar = param(default=17.82, unit="m/s", above=0.0)
    """Speed of the vehicle at t = 0."""
    slip: Scalar = param(default=0.0, unit="1", above=-1.0, high=1.0)
    """Slip at t = 0; a negative one is that of a wheel that drives."""


@pytree
class RecordedRun:
    """A loop, and the age of the wheel speed that the counter of its record shows."""

    loop: Loop = part()
    """Loop of the experiment."""
    counter_lag: Scalar = param(default=0.013, unit="s", low=0.0)
    """Age of the wheel speed in the record."""


@dataclasses.dataclass(frozen=True)
class RecordMatch:
    """Differences of a run from a record, and the run's own cycles, stopping time and distance.

    Attributes:
        wheel_rms_percent: Rms difference of the wheel speeds, in per cent of 1,800 rpm.
        slip_rms: Rms difference of the slips, while the wheel turns faster than 20 rad/s.
        cycles: Number of brake applications.
        stop_time: Time until the encoders show no speed [s]; infinite if the run does not stop.
        stop_distance: Distance to standstill [m]; infinite if the run does not stop.
    """

    wheel_rms_percent: float
    slip_rms: float
    cycles: int
    stop_time: float
    stop_distance: float


def read_curves() -> dict[str, np.ndarray]:
    """Return the readings of `measured_rig.csv` by name of the curve, each of shape (n, 2): abscissa and value."""
    path = pathlib.Path(__file__).with_name("measured_rig.csv")
    curves: dict[str, list[tuple[float, float]]] = {}
    with path.open(encoding="utf-8") as lines:
        for name, x, y in list(csv.reader(line for line in lines if not line.startswith("#")))[1:]:
            curves.setdefault(name, []).append((float(x), float(y)))
    return {name: np.array(rows) for name, rows in curves.items()}


def read_record(experiment: Experiment, data: pathlib.Path | None = None) -> Record:
    """Return the record of an experiment at every sample of its computer.

    Args:
        data: Folder with finer readings, `relay-slip-0.1.csv` and `relay-slip-0.7.csv`, with the columns time_s,
            wheel_speed_rad_per_s and slip_1, every 10 ms on the axis of the figure. None takes the packaged readings.
    """
    if data is None:
        curves = read_curves()
        last = curves[f"{experiment.name} slip"][-1, 0]
        times = np.arange(round((last - experiment.start) / PERIOD) + 1) * PERIOD
        at = times + experiment.start
        wheel, slip = (np.interp(at, *curves[f"{experiment.name} {column}"].T) for column in ("wheel", "slip"))
        changes = curves[f"{experiment.name} commands"]
        commands = changes[np.searchsorted(changes[:, 0], at + 0.5 * PERIOD) - 1, 1]
    else:
        table = _read_table(data / f"{experiment.name}.csv", ("time_s", "wheel_speed_rad_per_s", "slip_1"))
        t, wheel, slip = table[table[:, 0] > experiment.start - 0.5 * PERIOD].T
        begins = len(t) > 1 and t[0] <= experiment.start + 0.5 * PERIOD
        if not begins or not np.allclose(np.diff(t), PERIOD, atol=1e-4):
            raise ScenarioError(
                f"{data}: {experiment.name}.csv needs a row every {PERIOD:g} s from {experiment.start} s on"
            )
        if np.sum((wheel > 0) & (slip < MAX_KNOWN_SLIP)) < MIN_KNOWN:
            needed = f"{MIN_KNOWN} rows with a wheel speed above 0 rad/s and a slip below {MAX_KNOWN_SLIP}"
            raise ScenarioError(f"{data}: {experiment.name}.csv needs {needed}")
        times, commands = np.arange(len(t)) * PERIOD, np.where(slip < experiment.threshold, 1.0, 0.0)
    return Record(experiment.threshold, times, wheel, slip, commands, experiment.printed_distance)


def _read_table(path: pathlib.Path, columns: tuple[str, ...]) -> np.ndarray:
    """Return these columns of a CSV file with a header, shape (n, columns)."""
    raw = files.read_content(path)
    try:
        rows = list(csv.DictReader(raw.decode().splitlines()))
        table = np.array([[float(row[name]) for name in columns] for row in rows]).reshape(-1, len(columns))
        if np.isfinite(table).all():
            return table
    except (KeyError, TypeError, ValueError, csv.Error):
        pass
    raise ScenarioError(f"{path}: needs UTF-8 text with the columns {', '.join(columns)}, and a number in every row")


def build_record_loop(record: Record, replays: bool, rig: LabRig = MASK) -> Loop:
    """Return the loop of an experiment.

    Args:
        replays: True plays the recorded commands; False lets the loop's relay switch.
    """
    relay = Sampled(controller=Relay(band=1e-9, low=0.0, high=1.0), period=PERIOD)
    return braking(
        plant=rig,
        initial=BrakeStart(speed=BRAKING_SPEED * rig.drum_radius),
        sensor=EncoderSlip(period=PERIOD),
        reference=FixedSlip(slip=record.threshold),
        controller=PlayedCommand(commands=record.commands, period=PERIOD) if replays else relay,
        actuator=DeadTime(),
        stop=Standstill(speed=0.05),
    )


def solver_for(record: Record) -> FixedStep:
    """Return the solver of runs that last 1 s longer than a record."""
    return FixedStep(step=RUN_STEP, duration=round(float(record.t[-1]) + 1.0, 2))


@dataclasses.dataclass(frozen=True)
class RecordResiduals:
    """Residuals of a fit to a record: wheel speed and slip at its samples, in standard deviations.

    Attributes:
        solver: Solver of the run.
    """

    solver: FixedStep

    def __call__(self, recorded: RecordedRun, t: Vector, wheel: Vector, slip: Vector, weight: Vector) -> Vector:
        """Return the residuals, shape (2 n,).

        Args:
            t: Instants of the record [s], shape (n,).
            wheel: Measured wheel speed [rad/s], shape (n,).
            slip: Measured slip [1], shape (n,).
            weight: Weights of the slips [1], shape (n,).
        """
        run = run_at_step(recorded.loop, self.solver)
        turns, slips = simulate_readings(run, recorded, self.solver, t)
        return jnp.concatenate([(turns - wheel) / SIGMA_SPEED, weight * (slips - slip) / SIGMA_SLIP])


def simulate_readings(run: Run, recorded: RecordedRun, solver: FixedStep, t: Vector) -> tuple[Vector, Vector]:
    """Return the counter's wheel speed [rad/s] and the computer's slip [1] at instants t [s], all of shape (n,).

    The wheel speed is the true one, older by the counter's lag. The slip is that of the encoders. After the end of the
    run both are 0: the driver's dead zone hides slower speeds.
    """
    assert run.trajectory is not None
    output, measured, running = run.trajectory.sample.output, run.trajectory.measured, run.trajectory.running
    rig: Any = recorded.loop.plant
    turns = jnp.where(running, output.wheel_speed / rig.wheel_radius, 0.0)
    late = jnp.clip((t - recorded.counter_lag) / solver.step, 0.0, len(turns) - 1.0)
    i = jnp.clip(jnp.floor(jax.lax.stop_gradient(late)).astype(int), 0, len(turns) - 2)
    wheel = turns[i] + (late - i) * (turns[i + 1] - turns[i])
    # A sample is held: half a period later it is the same, and no rounding of the time decides.
    now, held = (jnp.clip(jnp.round(at / solver.step).astype(int), 0, len(turns) - 1) for at in (t, t + 0.5 * PERIOD))
    return wheel, jnp.where(running[now], measured.slip[held], 0.0)


def slip_weight(wheel: np.ndarray) -> np.ndarray:
    """Return the weights of slips: the wheel speed over 20 rad/s, clipped to 0.1 and 1, shape (n,)."""
    return np.clip(wheel / HARDLY_TURNS, 0.1, 1.0)


def fit_record(
    recorded: RecordedRun,
    free: Mapping[str, Any],
    record: Record,
    until: float = np.inf,
    starts: Sequence[Params] = (),
    tolerance: float = 1e-4,
) -> Identified:
    """Return the free parameters that bring a loop under given commands nearest to a record.

    The standard deviations of the residuals are only relative: the residuals estimate their scale.

    Args:
        free: Paths of the free parameters, each with a range or None.
        until: Last instant that counts [s].
        starts: Values by path of each start; without any, the run's own. The best fit is returned.
        tolerance: Relative change of the cost at which a fit ends.
    """
    counted = record.t <= until
    solver = FixedStep(
        step=FIT_STEP, duration=round(float(record.t[counted][-1]) + PERIOD, 2)
    )  # to the last sample's end
    columns = (record.t, record.wheel, record.slip, slip_weight(record.wheel))
    data = tuple(jnp.asarray(x[counted]) for x in columns)
    return fit(
        recorded, free, RecordResiduals(solver), data=data, sigma=np.array(1.0), absolute=False,
        tolerances=Tolerances(cost=tolerance, step=1e-6, gradient=1e-6, evaluations=40), starts=starts,
    )  # fmt: skip


def compare_with_record(recorded: RecordedRun, record: Record, first: float = 0.0, last: float = np.inf) -> RecordMatch:
    """Return how far a run of the loop is from a record.

    Args:
        first: First instant that counts for the differences [s].
        last: Last instant that counts for the differences [s].
    """
    solver = solver_for(record)
    run = jax.tree.map(np.asarray, simulate(recorded.loop, solver))
    wheel, slip = (np.asarray(x) for x in simulate_readings(run, recorded, solver, record.t))
    counts = (record.t >= first) & (record.t <= last)
    turns = counts & (record.wheel > HARDLY_TURNS)
    assert run.trajectory is not None
    sample, moves = run.trajectory.sample, run.trajectory.measured.speed > 0
    rises = np.diff(sample.command, prepend=0.0) > 0.5
    return RecordMatch(
        wheel_rms_percent=float(100 / FULL_SCALE * np.sqrt(np.mean((wheel - record.wheel)[counts] ** 2))),
        slip_rms=float(np.sqrt(np.mean((slip - record.slip)[turns] ** 2))),
        cycles=int(np.sum(rises & moves)),
        stop_time=float(sample.t[np.flatnonzero(moves)[-1]] + solver.step) if run.stopped else float(np.inf),
        stop_distance=float(sample.output.distance[-1] if run.stopped else np.inf),
    )


def compare_with_maker() -> list[JsonObject]:
    """Return the largest differences of `MASK` from the maker's own simulations.

    Both wheels start at 180 rad/s. The relay reads the true slip every 10 ms. Below 1 m/s the maker's model smooths
    friction, so the comparison ends before, at 1.2 s.

    Returns:
        A row for each simulation: its name, `wheel_rpm` (not for the open loop) and `slip`.
    """
    curves = read_curves()
    start = DrivenStart(speed=180 * MASK.drum_radius, slip=1 - MASK.wheel_radius / MASK.drum_radius)

    def run_of(controller: object, name: str, end: float) -> tuple[Callable[[str], np.ndarray], JsonObject]:
        loop = braking(plant=MASK, initial=start, controller=controller, stop=Standstill(speed=0.05),
                       reference=FixedSlip(slip=0.7 if name.endswith("0.7") else 0.1))  # fmt: skip
        run = simulate(loop, FixedStep(step=RUN_STEP, duration=end))
        assert run.trajectory is not None
        sample = jax.tree.map(np.asarray, run.trajectory.sample)
        values = {"wheel": sample.output.wheel_speed / MASK.wheel_radius, "slip": np.abs(sample.output.slip)}

        def difference(column: str) -> np.ndarray:
            t, x = curves[f"{name} {column}" if f"{name} {column}" in curves else name].T
            counts = t <= end
            return np.abs(np.interp(t[counts], sample.t, values[column]) - x[counts])

        return difference, {"simulation": name}

    rows = []
    relay = Sampled(controller=Relay(band=1e-9, low=0.0, high=1.0), period=PERIOD)
    for threshold in ("0.1", "0.7"):
        difference, row = run_of(relay, f"maker-simulation-slip-{threshold}", 1.2)
        rows.append(
            {**row, "wheel_rpm": float(difference("wheel").max() / RPM), "slip": float(difference("slip").max())}
        )
    # After 0.31 s the wheel is nearly locked, and the solver of the maker's model chatters.
    difference, row = run_of(ConstantTorque(torque=1.0), "slip-open-loop", 0.31)
    return [*rows, {**row, "wheel_rpm": None, "slip": float(difference("slip").max())}]


def describe_record(record: Record) -> RecordMatch:
    """Return the measured cycles, stopping time and distance, in the form of `compare_with_record`."""
    rises = np.diff(record.commands, prepend=0.0) > 0.5
    return RecordMatch(0.0, 0.0, int(np.sum(rises & (record.t < record.stop_time))), record.stop_time,
                      record.stop_distance)  # fmt: skip


def with_values(recorded: RecordedRun, values: Params) -> RecordedRun:
    """Return the run with parameters replaced, by path; a path that it lacks is left out."""
    return replace(recorded, dict(values))
