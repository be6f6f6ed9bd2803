"""What does a shorter stop cost the brake?

The quarter car of Aoki and Nakamura stops from 100 km/h under PI control of a fixed slip. Distance and effort, the
integral of u^2 dt, cannot both be least: for a row of weights between them, target slip, kp and ki are tuned by
gradients. Each result is a point of the front; random parameters of the same ranges lie on or above it. The front is
nearly a line, because the brake has to carry the momentum away whatever it does; what can be saved is what chatter, a
locked wheel or slip beyond the peak waste.

    python experiments/pareto.py
"""

import dataclasses
from typing import Any

import jax
import numpy as np

from diffabs import Batch, FixedStep, Loop, measure, replace, run_batch
from diffabs.controllers import PID, BackCalculation
from diffabs.objectives import BRAKING, Effort
from diffabs.papers import record
from diffabs.plants import QuarterCar
from diffabs.plot import tuning
from diffabs.references import FixedSlip
from diffabs.roads import MagicFormula
from diffabs.scenario.defaults import braking
from diffabs.stops import Standstill
from diffabs.tune import Method, Stopping, build_problem, latin, tune

MEASURED = {**BRAKING, "effort": Effort()}


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    weights: tuple[float, ...] = (1e-5, 1e-3, 1.5e-3, 2e-3, 2.5e-3, 3e-3, 4e-3)  # m per N^2 m^2 s, of the effort
    ranges: tuple[tuple[str, float, float], ...] = (
        ("reference.slip", 0.01, 0.3),
        ("controller.kp", 300.0, 8000.0),
        ("controller.ki", 100.0, 1e5),
    )
    random: int = 400
    step: float = 1e-3  # s
    stop: float = 1.0  # m/s
    duration: float = 12.0  # s
    iterations: int = 25
    out: str = "out/experiments/pareto"


def car(config: Config) -> Loop:
    """The paper's gains with an anti-windup."""
    return braking(
        plant=QuarterCar(inertia=1.0539, road=MagicFormula()),
        reference=FixedSlip(slip=0.1),
        controller=PID(kp=3893.0, ki=5000.0, antiwindup=BackCalculation(tracking_time=0.05), low=0.0, high=90.0),
        stop=Standstill(speed=config.stop),
    )


def front(config: Config) -> list[dict[str, Any]]:
    """One tuning per weight, each from where the last one ended."""
    one, rows = car(config), []
    for weight in config.weights:
        found = tune(
            build_problem(
                one,
                free={path: (low, high) for path, low, high in config.ranges},
                objective={"stop_distance": 1.0, "effort": weight},
                solver=FixedStep(step=config.step, duration=config.duration),
                measured=MEASURED,
            ),
            method=Method(stopping=Stopping(iterations=config.iterations, change=1e-6)),
        )
        one, metrics = found.loop, found.metrics[1]
        rows.append(
            {
                "weight": weight,
                "distance [m]": float(metrics["stop_distance"][0]),
                "effort [N2 m2 s]": float(metrics["effort"][0]),
                **{path.split(".")[1]: float(value) for path, value in found.values.items()},
                "gradients": found.evaluations,
                "ended because": found.reason.value,
            }
        )
    return rows


def scattered(config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Effort and distance of random parameters."""
    batch: Batch = latin({path: (low, high) for path, low, high in config.ranges}, config.random)
    solver = FixedStep(step=config.step, duration=config.duration)
    metrics = jax.jit(lambda one: run_batch(one, batch, solver, MEASURED).metrics)(car(config))
    return np.asarray(metrics["effort"]), np.asarray(metrics["stop_distance"])


def published(config: Config) -> tuple[float, float]:
    """The paper's conventional PI, target 0.2 and no anti-windup."""
    one = replace(
        dataclasses.replace(car(config), controller=PID(ki=5000.0, low=0.0, high=90.0)), {"reference.slip": 0.2}
    )
    metrics = measure(one, FixedStep(step=config.step, duration=config.duration), MEASURED).metrics
    return float(metrics["effort"]), float(metrics["stop_distance"])


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    rows = front(config)
    record.print_rows("Stopping distance against control effort, from 100 km/h", rows)
    points = np.array([row["effort [N2 m2 s]"] for row in rows]), np.array([row["distance [m]"] for row in rows])
    effort, distance = scattered(config)
    near = distance < 1.1 * points[1].max()
    figure = tuning.draw_pareto(
        {"tuned by gradients": points, "random parameters": (effort[near], distance[near])},
        marks={"published conventional PI": published(config)},
        title="What a shorter stop costs",
    )
    return record.experiment(config, {"front": rows, "published": published(config)}, {"pareto": figure})


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
