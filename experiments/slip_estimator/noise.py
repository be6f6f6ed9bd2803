"""How does a real accelerometer, with noise and bias, affect the slip estimator?

Noise: the latch takes the first fall of the deceleration for its maximum, and noise makes it fall at once. `PeakRobust`
low-passes deceleration and slip alike, waits for a fall of a few percent, and is armed above 3 m/s^2. Which time
constant and threshold work? A threshold above the fall from the peak to the first target, 8 % here, never latches.

Bias: the vehicle's speed is the accelerometer's integral. A forward bias b makes it b t too fast. Near standstill the
slip is then large, which releases the brake. A floor on the speed in the slip's denominator keeps its error below
b t/floor. Under a fixed target the car stops if the floor exceeds about b t_stop/slip.

The estimator takes the size of the acceleration, as in the paper. A forward bias of 0.02 m/s^2 shows an acceleration
before the wheel slips. Its size falls through zero, and the latch takes it for the maximum. The target becomes a slip
of 0, and at 5 kHz no floor helps: the car rolls on. Sampled more slowly, the latch misses the fall of a small bias.
`PeakRobust` with a floor of 4 m/s stops in 43.96 m at 0.1 m/s^2, and does not stop at 0.2.

    python experiments/slip_estimator/run.py noise
"""

import dataclasses
from typing import Any

import jax
import numpy as np

from diffabs import FixedStep, Loop, measure, run_batch
from diffabs.loop.batch import stack_loops
from diffabs.output import plot
from diffabs.papers import record
from diffabs.parts.controllers import PID
from diffabs.parts.objectives import StopDistance
from diffabs.parts.plants import QuarterCar
from diffabs.parts.references import FixedSlip, PeakLatch, PeakRobust
from diffabs.parts.roads import MagicFormula
from diffabs.parts.sensors import IntegratedAccelerometer, Noise
from diffabs.parts.stops import Standstill
from diffabs.scenario.defaults import braking


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    noises: tuple[float, ...] = (0.0, 0.05, 0.1, 0.3)  # m/s^2, standard deviation of each sample
    seeds: int = 32
    seed: int = 0
    time_constants: tuple[float, ...] = (0.005, 0.01, 0.02, 0.05)  # s
    thresholds: tuple[float, ...] = (0.01, 0.02, 0.03, 0.05, 0.1)  # of the greatest deceleration
    arming: float = 3.0  # m/s^2
    biases: tuple[float, ...] = (-0.2, -0.05, 0.0, 0.02, 0.05, 0.1, 0.2)  # m/s^2
    floors: tuple[float, ...] = (0.05, 0.5, 1.0, 2.0, 4.0)  # m/s
    ki: float = 5000.0  # N m/s, of the PI controller
    step: float = 1e-3  # s, and so also the period of the sensor
    stop: float = 0.5  # m/s; slower, a step of 1 ms is not stable, and the last deceleration not that of the braking
    duration: float = 10.0  # s, of the bare latch and of the runs with bias
    robust_duration: float = 6.0  # s
    bias_step: float = 2e-4  # s, stable to the 0.05 m/s at which those runs end: what bias does is seen at low speed
    out: str = "out/experiments/slip_estimator/noise"


CARS = {"spline B": QuarterCar(), "Magic Formula": QuarterCar(inertia=1.0539, road=MagicFormula())}
OBJECTIVES = {"distance": StopDistance()}


def noisy_loop(config: Config, car: QuarterCar, noise: float, reference: Any, ki: float = 0.0) -> Loop:
    """The closed loop with a noisy accelerometer."""
    stop, sensor = Standstill(speed=config.stop), Noise(deceleration=noise, period=config.step)
    return braking(plant=car, sensor=sensor, reference=reference, controller=PID(ki=ki, low=0.0, high=90.0), stop=stop)


def noisy(config: Config, loops: list[Loop], duration: float) -> tuple[Any, Any]:
    """Return the distance [m] and whether the car stopped, by loop and seed. For a car still moving it is the
    distance so far."""
    keys = jax.random.split(jax.random.key(config.seed), config.seeds)
    solver = FixedStep(step=config.step, duration=duration)
    runs = jax.vmap(lambda loop, key: measure(loop, solver, OBJECTIVES, key=key), (None, 0))
    first, lanes = stack_loops(loops)
    run = lanes.each(first, lambda loop, key: runs(loop, keys))
    stopped = np.asarray(run.stopped)
    return np.where(stopped, run.metrics["distance"], run.ending.sample.output.distance), stopped


def statistics(distance: Any, stopped: Any) -> dict[str, Any]:
    """Return the statistics of one loop over the seeds."""
    mean, deviation, worst = (float(f(distance)) for f in (np.mean, lambda x: np.std(x, ddof=1), np.max))
    return {"mean [m]": mean, "deviation [m]": deviation, "worst [m]": worst, "stopped": int(stopped.sum())}


def bare(config: Config) -> list[dict[str, Any]]:
    """The latch of the paper under noise."""
    rows = []
    for car_name, car in CARS.items():
        for name, ki in (("P", 0.0), ("PI", config.ki)):
            loops = [noisy_loop(config, car, n, PeakLatch(), ki) for n in config.noises]
            results = zip(config.noises, *noisy(config, loops, config.duration), strict=True)
            rows += [{"car": car_name, "controller": name, "noise [m/s2]": n, **statistics(*r)} for n, *r in results]
    return rows


def robust(config: Config) -> list[dict[str, Any]]:
    """The robust estimator under P control, over its settings; the last row per car and noise is not armed."""
    settings = [(t, th, config.arming) for t in config.time_constants for th in config.thresholds]
    settings.append((config.time_constants[2], config.thresholds[2], 0.0))
    cases = [(n, *setting) for n in config.noises for setting in settings]
    rows = []
    for car_name, car in CARS.items():
        loops = [
            noisy_loop(config, car, n, PeakRobust(time_constant=t, threshold=th, arming=arming))
            for n, t, th, arming in cases
        ]
        for case, distance, stopped in zip(cases, *noisy(config, loops, config.robust_duration), strict=True):
            names = ("noise [m/s2]", "time constant [s]", "threshold [1]", "arming [m/s2]")
            rows.append({"car": car_name, **dict(zip(names, case, strict=True)), **statistics(distance, stopped)})
    return rows


def best(config: Config, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each setting, its worst run over all noises, seeds and cars; the best setting first."""
    settings = []
    for t in config.time_constants:
        for th in config.thresholds:
            group = [r for r in rows if (r["time constant [s]"], r["threshold [1]"]) == (t, th) and r["arming [m/s2]"]]
            mean = float(np.mean([r["mean [m]"] for r in group]))
            worst = max(r["worst [m]"] for r in group)
            settings.append({"time constant [s]": t, "threshold [1]": th, "mean [m]": mean, "worst [m]": worst})
    return sorted(settings, key=lambda r: r["worst [m]"])


def biased(config: Config) -> list[dict[str, Any]]:
    """Stopping distance over bias and floor; None where the car has not stopped in time."""
    cases = [(floor, bias) for floor in config.floors for bias in config.biases]
    solver = FixedStep(step=config.bias_step, duration=config.duration)
    rows = []
    for method, reference, ki in (("conventional P", FixedSlip(), 0.0), ("proposed P", PeakLatch(), 0.0)):
        loops = [
            braking(
                sensor=IntegratedAccelerometer(bias=b, floor=f),
                reference=reference,
                controller=PID(ki=ki, low=0.0, high=90.0),
            )
            for f, b in cases
        ]
        run = run_batch(*stack_loops(loops), solver, OBJECTIVES, together=True, accepted=True)
        distances = np.where(run.stopped, run.metrics["distance"], np.nan).reshape(len(config.floors), -1)
        for floor, line in zip(config.floors, distances, strict=True):
            columns = {f"{b:+g}": None if np.isnan(x) else float(x) for b, x in zip(config.biases, line, strict=True)}
            rows.append({"method": method, "floor [m/s]": floor, **columns})
    return rows


def figures(config: Config, rows: list[dict[str, Any]], latch: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean and worst distance over noise: bare latch, and the robust one at each time constant."""
    figure, axes = plot.sheet(1, 2, title="Accelerometer noise, P control, spline B", size=(5.6, 3.8))
    group = [r for r in latch if r["car"] == "spline B" and r["controller"] == "P"]
    axes[0].plot(config.noises, [r["mean [m]"] for r in group], "o-", color=plot.COLOURS[6], label="bare latch")
    for ax, kind in zip(axes, ("mean [m]", "worst [m]"), strict=True):
        for i, t in enumerate(config.time_constants):
            y = [
                r[kind]
                for r in rows
                if r["car"] == "spline B"
                and (r["time constant [s]"], r["threshold [1]"]) == (t, 0.03)
                and r["arming [m/s2]"]
            ]
            name = f"robust, {1e3 * t:g} ms, 3 %"
            ax.plot(config.noises, y, "o" + plot.DASHES[i], color=plot.COLOURS[i], markersize=4, label=name)
        ax.set_yscale("log")
        plot.label_axes(ax, "noise [m/s²]", f"distance, {kind}")
    axes[1].set_yscale("linear")
    axes[1].set_ylim(42, 52)
    axes[1].set_title("worst of all seeds, robust only", fontsize=11)
    axes[0].set_title("mean of all seeds", fontsize=11)
    return {"noise": figure}


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    latch, rows = bare(config), robust(config)
    ranked, bias = best(config, rows), biased(config)
    record.print_rows(f"The bare latch under noise, {config.seeds} seeds", latch)
    record.print_rows("The robust estimator: best settings over all noises, seeds and cars", ranked[:6])
    unarmed = [r for r in rows if not r["arming [m/s2]"]]
    record.print_rows("The robust estimator, not armed", unarmed)
    setting = (ranked[0]["time constant [s]"], ranked[0]["threshold [1]"])
    group = [r for r in rows if (r["time constant [s]"], r["threshold [1]"]) == setting and r["arming [m/s2]"]]
    record.print_rows("The best setting", group)
    record.print_rows("Accelerometer bias [m/s2]: stopping distance [m], empty where it did not stop", bias)
    results = {"bare": latch, "robust": rows, "ranked": ranked, "bias": bias}
    return record.experiment(config, results, figures(config, rows, latch))
