"""How does the slip controller fare on a computer?

The controllers of Aoki and Nakamura run in continuous time. Here a computer samples the slip every `period` and holds
the torque, which acts a computing `delay` later. Conventional P and PI control run on the identified Magic Formula.
Then everything runs at 1 kHz, the estimator included.

The loop's gain grows as the car slows down: over a period T the slip changes by g times its error, g = r kp T/(J v).
With a delay of d periods the loop is stable for g d < 1 and g (1 - 2 d) < 2. So every sampled loop oscillates below
some speed. Rounding errors decide how soon the oscillation shows: distances mean something, peak slips do not.

    python experiments/slip_estimator/run.py sampled
"""

import dataclasses
from typing import Any

import numpy as np

from diffabs import FixedStep, Loop, Run, run_batch
from diffabs.loop.batch import stack_loops
from diffabs.output import plot
from diffabs.papers import record
from diffabs.parts.controllers import PID, Sampled
from diffabs.parts.objectives import BRAKING
from diffabs.parts.plants import QuarterCar
from diffabs.parts.references import FixedSlip, PeakLatch
from diffabs.parts.roads import MagicFormula
from diffabs.parts.stops import Standstill
from diffabs.scenario.defaults import braking


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment. Delays are in periods; the reference is an independent solution at 1 ms, which
    braked the last 0.05 m/s at the last deceleration."""

    periods: tuple[float, ...] = (1e-3, 2e-3, 3e-3, 5e-3, 7e-3, 1e-2, 1.5e-2, 2e-2)  # s
    delays: tuple[float, ...] = (0.0, 0.5, 1.0)
    drawn_periods: tuple[float, ...] = (1e-3, 1e-2, 2e-2)  # s, with a delay of one period
    kp: float = 3893.0  # N m
    ki: float = 5000.0  # N m/s
    step: float = 1e-4  # s
    stop: float = 0.01  # m/s; an oscillating loop may not be braking just then, so the way that is left must be short
    duration: float = 5.0  # s
    reference: tuple[tuple[str, float, float], ...] = (("P", 3.109, 43.870), ("PI", 3.203, 44.882))
    out: str = "out/experiments/slip_estimator/sampled"


def car() -> QuarterCar:
    """The quarter car with the Magic Formula that was identified from the paper's tables."""
    return QuarterCar(inertia=1.0539, road=MagicFormula())


def gains(config: Config) -> dict[str, PID]:
    """P and PI."""
    return {"P": PID(kp=config.kp, low=0.0, high=90.0), "PI": PID(kp=config.kp, ki=config.ki, low=0.0, high=90.0)}


def loop(config: Config, controller: PID, period: float, delay: float, reference: Any = None) -> Loop:
    """The closed loop with a computer in it."""
    sampled = Sampled(controller=controller, period=period, delay=delay)
    stop = Standstill(speed=config.stop)
    return braking(plant=car(), reference=reference or FixedSlip(), controller=sampled, stop=stop)


def slowest(config: Config, period: float, delay: float) -> float:
    """The speed below which the sampled loop is unstable, road neglected; `delay` in periods [m/s]."""
    limit = min(1 / delay if delay else np.inf, 2 / (1 - 2 * delay) if delay < 0.5 else np.inf)
    return float(car().radius * config.kp * period / (car().inertia * limit))


def sweep(config: Config) -> list[dict[str, Any]]:
    """Time and distance for each controller, period and delay."""
    cases = [(name, p, d) for name in gains(config) for d in config.delays for p in config.periods]
    lanes = stack_loops([loop(config, gains(config)[name], p, d * p) for name, p, d in cases])
    solver = FixedStep(step=config.step, duration=config.duration)
    metrics = run_batch(*lanes, solver, BRAKING, together=True, accepted=True).metrics
    return [
        {
            "controller": name,
            "period [ms]": 1e3 * period,
            "delay [ms]": 1e3 * period * delay,
            "time [s]": float(metrics["stop_time"][i]),
            "distance [m]": float(metrics["stop_distance"][i]),
            "oscillates below [m/s]": slowest(config, period, delay),
        }
        for i, (name, period, delay) in enumerate(cases)
    ]


def against_reference(config: Config, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Our 1 ms against the independent solution."""
    table = []
    for name, time, distance in config.reference:
        row = next(r for r in rows if r["controller"] == name and r["period [ms]"] == 1.0 and r["delay [ms]"] == 0.0)
        table.append(record.computed_row(f"{name}, 1 ms", "time", "s", row["time [s]"], reference=time))
        table.append(record.computed_row(f"{name}, 1 ms", "distance", "m", row["distance [m]"], reference=distance))
    return table


def all_at_one_kilohertz(config: Config) -> list[dict[str, Any]]:
    """Conventional and proposed with everything sampled: the step is the period, so the estimator sees 1 kHz too."""
    solver, rows = FixedStep(step=1e-3, duration=config.duration), []
    for method, reference in (("conventional", FixedSlip()), ("proposed", PeakLatch())):
        lanes = stack_loops([loop(config, pid, 1e-3, 0.0, reference) for pid in gains(config).values()])
        metrics = run_batch(*lanes, solver, BRAKING, together=True, accepted=True).metrics
        for i, name in enumerate(gains(config)):
            time, distance = float(metrics["stop_time"][i]), float(metrics["stop_distance"][i])
            rows.append({"method": method, "controller": name, "time [s]": time, "distance [m]": distance})
    return rows


def traces(config: Config) -> dict[str, Run]:
    """P control at a few periods, one of them as delay."""
    lanes = stack_loops([loop(config, gains(config)["P"], p, p) for p in config.drawn_periods])
    solver = FixedStep(step=config.step, duration=config.duration, every=20)
    runs = run_batch(*lanes, solver, BRAKING, trajectories=True, accepted=True)
    return {f"{1e3 * p:g} ms": record.lane(runs, i) for i, p in enumerate(config.drawn_periods)}


def figures(config: Config, rows: list[dict[str, Any]], runs: dict[str, Run]) -> dict[str, Any]:
    """Distance over period, and wheel speeds."""
    figure, axes = plot.sheet(1, 2, title="Sample-and-hold control costs distance through its delay", size=(5.4, 3.8))
    for ax, name in zip(axes, gains(config), strict=True):
        for i, delay in enumerate(config.delays):
            delayed = [
                r
                for r in rows
                if r["controller"] == name and np.isclose(r["delay [ms]"], delay * r["period [ms]"], atol=1e-9)
            ]
            x, y = ([r[key] for r in delayed] for key in ("period [ms]", "distance [m]"))
            ax.plot(x, y, "o" + plot.DASHES[i], color=plot.COLOURS[i], markersize=4, label=f"delay {delay:g} period")
        plot.label_axes(ax, "period [ms]", "stopping distance [m]", f"conventional {name}")
    trajectories: dict[str, Any] = {name: run.trajectory for name, run in runs.items()}
    return {
        "distance": figure,
        "speeds": plot.draw_speeds(trajectories, title="P control, sampled, one period of computing delay"),
    }


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    rows = sweep(config)
    compared, whole = against_reference(config, rows), all_at_one_kilohertz(config)
    record.print_rows("Conventional control on a computer, Magic Formula", rows)
    record.print_rows("At 1 ms, against an independent solution", compared)
    record.print_rows("Everything at 1 kHz", whole)
    results = {"sweep": rows, "reference": compared, "one_kilohertz": whole}
    return record.experiment(config, results, figures(config, rows, traces(config)))
