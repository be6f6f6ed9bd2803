"""The laboratory rig at constant commands, and the published gain behind a brake with a lag of 49 ms.

First come checks of the rig itself: forces, derivatives, and stops from 50 km/h. Then the mirrored rig of Maeda and
Sugiura runs under their gain, with the brake's lag T in front of it:

    x1' = x2,   omega x2' = alpha x2 + beta u,   T u' = k1 x1 + k2 x2 - u

By Routh and Hurwitz it is stable for T below (beta |k2| - alpha)/(beta |k1| + alpha (beta |k2| - alpha)/omega).

    python experiments/lab_rig/run.py
"""

import dataclasses
import math
from typing import Any

import jax
import numpy as np

from diffabs import BrakeStart, FixedStep, Loop, Run, run_batch
from diffabs.loop.batch import stack_loops
from diffabs.output import plot
from diffabs.papers import record
from diffabs.parts.actuators import Lag
from diffabs.parts.controllers import ConstantTorque, HoldingInput, StateFeedback
from diffabs.parts.objectives import BRAKING
from diffabs.parts.plants import GRAVITY, LabRig, MirroredRig
from diffabs.parts.plants.lab_rig import LabRigState
from diffabs.parts.references import FixedSlip
from diffabs.parts.stops import SpeedReached
from diffabs.scenario.defaults import braking
from experiments._shared.numbers import store_numbers


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment; the checks were computed independently."""

    commands: tuple[float, ...] = (0.45, 0.5, 0.6, 0.8, 1.0)
    start_kmh: float = 50.0
    stop_kmh: float = 5.0
    mass: float = 5.3  # kg
    gain: tuple[float, float] = (-11753.0, -48.0)
    lags: tuple[float, ...] = (1e-3, 2e-3, 3e-3, 3.9e-3, 4.1e-3, 5e-3, 1e-2, 4.9e-2)  # s
    torque_max: float = 9.03  # N m, the brake's at full command
    speeds_kmh: tuple[float, ...] = (50.0, 20.0, 5.0)
    step: float = 1e-4  # s
    duration: float = 8.0  # s
    static_force: float = 58.217466  # N
    derivative: tuple[float, float, float] = (25.7927789186, -129.512606509, -1.34442)
    out: str = "out/experiments/lab_rig"


def checks(config: Config) -> list[dict[str, Any]]:
    """Normal force at rest, derivative at one state, and the stuck wheel: held by the brake, or turned by the road."""
    rig = LabRig()
    _, force, _ = rig.contact(LabRigState(0.0, 0.0, 0.0, 0.0))
    rates = rig.derivative(0.0, LabRigState(100.0, 140.0, 3.0, 0.0), 0.6)
    rows = [record.computed_row("at rest", "normal force", "N", force, reference=config.static_force)]
    for name, unit, ours, exact in zip(
        ("wheel", "drum", "brake"), ("rad/s^2", "rad/s^2", "N m/s"), rates[:3], config.derivative, strict=True
    ):
        rows.append(record.computed_row("at (100, 140, 3), u = 0.6", f"d({name})/dt", unit, ours, reference=exact))
    _, _, torque = rig.contact(LabRigState(0.0, 100.0, 9.0, 0.0))
    rows.append(record.computed_row("locked, brake 9 N m", "torque carried", "N m", torque))
    for brake in (9.0, 1.0):
        rate = rig.derivative(0.0, LabRigState(0.0, 100.0, brake, 0.0), 1.0).wheel
        rows.append(record.computed_row(f"locked, brake {brake:g} N m", "d(wheel)/dt", "rad/s^2", rate))
    return rows


def open_loop(config: Config) -> dict[str, Run]:
    """The rig at constant commands."""
    start, stop = BrakeStart(speed=config.start_kmh / 3.6), SpeedReached(speed=config.stop_kmh / 3.6)
    lanes = stack_loops(
        [
            braking(plant=LabRig(), initial=start, controller=ConstantTorque(torque=u), stop=stop)
            for u in config.commands
        ]
    )
    solver = FixedStep(step=config.step, duration=config.duration, every=20)
    runs = run_batch(*lanes, solver, BRAKING, trajectories=True, accepted=True)
    return {f"command {u:g}": record.lane(runs, i) for i, u in enumerate(config.commands)}


def lock_table(runs: dict[str, Run]) -> list[dict[str, Any]]:
    """When the wheel locks, how long it sticks, and when the drum has slowed down."""
    rows = []
    for name, run in runs.items():
        sample: Any = run.trajectory.sample  # pyright: ignore[reportOptionalMemberAccess]
        still = np.asarray(sample.output.wheel_speed) <= 0
        lock = float(sample.t[np.argmax(still)]) if still.any() else None
        sticks = bool(still[np.argmax(still) :].all()) if still.any() else None
        stop = float(run.metrics["stop_time"]) if run.stopped else None
        rows.append({"run": name, "locks at [s]": lock, "stays locked": sticks, "5 km/h at [s]": stop})
    return rows


def alpha_beta(config: Config) -> tuple[float, float]:
    """The coefficients of eq. (17) at slip 0.2, friction slope by automatic differentiation."""
    rig = MirroredRig(mass=config.mass)
    force, body = rig.mass * GRAVITY, rig.inertia_factor * rig.mass * rig.body_radius**2
    mu, slope = jax.jvp(lambda s: rig.road.friction(s, 0.0, 0.0), (0.2,), (1.0,))
    wheel = rig.wheel_radius**2 / (rig.wheel_inertia * rig.body_radius)
    alpha = -force * (wheel * slope + (0.8 * slope - mu) * rig.body_radius / body)
    return float(alpha), float(rig.wheel_radius / (rig.wheel_inertia * rig.body_radius))


def critical_lags(config: Config) -> list[dict[str, Any]]:
    """The longest lag that is stable, by formula and by bisection on the eigenvalues, at each speed and for ever."""
    alpha, beta = alpha_beta(config)
    k1, k2 = map(abs, config.gain)
    excess, rows = beta * k2 - alpha, []
    for speed in (*config.speeds_kmh, math.inf):
        omega = speed / 3.6 / MirroredRig().body_radius
        formula = excess / (beta * k1 + alpha * excess / omega)
        critical = None if math.isinf(omega) else bisected(config, omega)
        name = "any speed" if math.isinf(omega) else f"{speed:g} km/h"
        rows.append(
            {
                "at": name,
                "formula [ms]": 1e3 * formula,
                "eigenvalues [ms]": None if critical is None else 1e3 * critical,
            }
        )
    return rows


def bisected(config: Config, omega: float) -> float:
    """The lag [s] at which the frozen loop's rightmost eigenvalue crosses the axis."""
    (alpha, beta), (k1, k2) = alpha_beta(config), config.gain

    def rightmost(lag: float) -> float:
        matrix = [[0, 1, 0], [0, alpha / omega, beta / omega], [k1 / lag, k2 / lag, -1 / lag]]
        return float(np.linalg.eigvals(np.array(matrix, float)).real.max())

    low, high = 1e-4, 0.1
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rightmost(middle) < 0 else (low, middle)
    return 0.5 * (low + high)


def lagged(config: Config, lag: float, low: float, high: float) -> Loop:
    """The paper's loop with a lag in the brake; the limits are those of the command."""
    return braking(
        plant=MirroredRig(mass=config.mass),
        initial=BrakeStart(speed=config.start_kmh / 3.6),
        reference=FixedSlip(),
        feedforward=HoldingInput(),
        controller=StateFeedback(gain=np.array(config.gain), low=low, high=high),
        actuator=Lag(time_constant=lag),
        stop=SpeedReached(speed=config.stop_kmh / 3.6),
    )


def lag_table(config: Config) -> tuple[list[dict[str, Any]], dict[str, Run]]:
    """Greatest slip and lock over the lag, for each kind of torque limit; the runs at the longest lag."""
    limits = {
        "unlimited": (-math.inf, math.inf),
        ">= 0": (0.0, math.inf),
        f"0..{config.torque_max:g}": (0.0, config.torque_max),
    }
    cases = [(name, lag) for name in limits for lag in config.lags]
    lanes = stack_loops([lagged(config, lag, *limits[name]) for name, lag in cases])
    solver = FixedStep(step=config.step, duration=config.duration, every=5)
    runs = run_batch(*lanes, solver, BRAKING, trajectories=True, accepted=True)
    rows, drawn = [], {}
    for i, (name, lag) in enumerate(cases):
        run = record.lane(runs, i)
        sample: Any = run.trajectory.sample  # pyright: ignore[reportOptionalMemberAccess]
        still = np.asarray(sample.output.wheel_speed) <= 0
        lock = float(sample.t[np.argmax(still)]) if still.any() else None
        slip = min(float(run.metrics["max_slip"]), 1.0)
        rows.append({"torque [N m]": name, "lag [ms]": 1e3 * lag, "max slip [1]": slip, "locks at [s]": lock})
        if lag == config.lags[-1]:
            drawn[f"command {name} N m"] = run
    return rows, drawn


def settles(config: Config) -> list[dict[str, Any]]:
    """Does the simulation agree with the eigenvalues? Slip error that is left at the end, just below and above T*."""
    lags = [factor * bisected(config, config.start_kmh / 3.6 / MirroredRig().body_radius) for factor in (0.9, 1.1)]
    lanes = stack_loops([lagged(config, lag, -math.inf, math.inf) for lag in lags])
    solver = FixedStep(step=config.step, duration=config.duration)
    metrics = run_batch(*lanes, solver, BRAKING, together=True, accepted=True).metrics
    return [
        {"lag [ms]": 1e3 * lag, "final slip error [1]": float(e), "max slip [1]": float(m)}
        for lag, e, m in zip(lags, metrics["final_slip_error"], metrics["max_slip"], strict=True)
    ]


def figures(runs: dict[str, Run], lagging: dict[str, Run]) -> dict[str, Any]:
    """Speeds of the rig at constant commands; slips under the longest lag."""
    trajectories: dict[str, Any] = {name: run.trajectory for name, run in runs.items()}
    middle = dict(list(trajectories.items())[1:4])
    braked = list(lagging.items())[1:]  # unlimited torque also drives the wheel, which no brake does
    slips: dict[str, Any] = {name: run.trajectory for name, run in braked}
    return {
        "open_loop": plot.draw_speeds(middle, title="Laboratory rig, constant brake command"),
        "lag": plot.draw_slips(slips, title="Published gain behind the rig's 49 ms brake lag", until=2.0),
    }


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    checked, runs = checks(config), open_loop(config)
    locks, critical = lock_table(runs), critical_lags(config)
    (lags, lagging), ends = lag_table(config), settles(config)
    record.print_rows("The laboratory rig: checks", checked)
    record.print_rows("The laboratory rig from 50 km/h at constant commands", locks)
    record.print_rows("Longest lag of the brake at which the published gain is stable", critical)
    record.print_rows("Just below and above it", ends)
    record.print_rows("Published gain behind a lagging brake, 50 to 5 km/h", lags)
    results = {"checks": checked, "open_loop": locks, "critical_lag": critical, "around_it": ends, "lag": lags}
    return record.experiment(config, results, figures(runs, lagging))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    store_numbers(__file__, main())
