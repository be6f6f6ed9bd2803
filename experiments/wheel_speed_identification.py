"""Can the road and the wheel be identified from the wheel's speed alone, noise and all? A check of `identify` on data
whose truth is known.

A quarter car brakes with full torque until the wheel locks, which takes the slip over the whole friction curve. The
wheel's speed is read at 1 kHz with independent noise; inertia and Magic Formula, five parameters, are fitted to it from
a textbook's asphalt, once for each seed of the noise. The standard deviations that a fit states are right if the truth
lies within one of them for 68 % of the seeds and within two for 95 %.

    python experiments/wheel_speed_identification.py
"""

import dataclasses
from typing import Any

import jax
import numpy as np

from diffabs import FixedStep, Loop, plot, rollout
from diffabs.controllers import ConstantTorque
from diffabs.identify.fit import Identified, Tolerances
from diffabs.identify.identification import identify
from diffabs.identify.traces import Traces
from diffabs.papers import record
from diffabs.plants import QuarterCar
from diffabs.roads import MagicFormula
from diffabs.scenario.defaults import braking
from diffabs.stops import Standstill

PATHS = ("plant.inertia", "plant.road.B", "plant.road.C", "plant.road.D", "plant.road.E")
SHORT = ("J", "B", "C", "D", "E")


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment: truth and start are J [kg m^2], B, C, D, E."""

    truth: tuple[float, ...] = (1.0539, 13.00891, 1.47692, 0.98483, -1.08841)
    start: tuple[float, ...] = (0.6, 10.0, 1.65, 1.0, 0.3)
    torque: float = 90.0  # N m
    noise: float = 0.05  # m/s
    seeds: int = 20
    step: float = 1e-3  # s, of the integration and of the data
    end: float = 2.4  # s; the wheel locks shortly before
    out: str = "out/experiments/wheel_speed_identification"


def truth(config: Config) -> tuple[Loop, FixedStep]:
    """The run whose parameters are known."""
    inertia, *coefficients = config.truth
    car = QuarterCar(inertia=inertia, road=MagicFormula(**dict(zip(SHORT[1:], coefficients, strict=True))))
    loop = braking(plant=car, controller=ConstantTorque(torque=config.torque), stop=Standstill(speed=0.5))
    return loop, FixedStep(step=config.step, duration=config.end)


def recovered(config: Config) -> tuple[list[Identified], Traces]:
    """Fits of the wheel's speed, one per noise seed, and the last data."""
    loop, solver = truth(config)
    seen: Any = rollout(loop, solver).trajectory
    t, clean = np.arange(solver.steps + 1) * solver.step, np.asarray(seen.sample.output.wheel_speed)
    start, found, traces = dict(zip(PATHS, config.start, strict=True)), [], None
    for seed in range(config.seeds):
        noisy = clean + config.noise * np.random.default_rng(seed).standard_normal(len(clean))
        traces = Traces(t=t, columns={"wheel_speed": noisy}, sigma={"wheel_speed": config.noise})
        ends = Tolerances(cost=1e-8, step=1e-8)
        found.append(identify(loop, traces, PATHS, solver=solver, starts=[start], tolerances=ends))
    assert traces is not None
    return found, traces


def errors(config: Config, found: list[Identified]) -> np.ndarray:
    """(found - true)/deviation, (seeds, 5)."""
    values = np.array([[float(one.values[path]) for path in PATHS] for one in found])
    deviations = np.array([[one.uncertainty.deviations[path] for path in PATHS] for one in found])
    return (values - np.array(config.truth)) / deviations


def coverage(config: Config, found: list[Identified]) -> list[dict[str, Any]]:
    """How often the truth lies within one, two and three standard deviations."""
    z = np.abs(errors(config, found))
    return [
        {
            "parameter": path,
            "true": config.truth[i],
            "found, seed 0": float(found[0].values[path]),
            "deviation": found[0].uncertainty.deviations[path],
            **{f"within {k}": int((z[:, i] <= k).sum()) for k in (1, 2, 3)},
            "of": len(found),
        }
        for i, path in enumerate(PATHS)
    ]


def draw_recovery(config: Config, found: list[Identified], traces: Traces) -> Any:
    """The noisy trace with the fit, and every error in standard deviations."""
    figure, (left, right) = plot.sheet(1, 2, title="Known parameters from a noisy wheel speed", size=(5.6, 3.8))
    t, w = np.asarray(traces.t), np.asarray(traces.columns["wheel_speed"])
    left.plot(t, w, ".", color=plot.COLOURS[5], markersize=2, label="data")
    left.plot(t, w + traces.residuals(found[-1])["wheel_speed"][0], color=plot.COLOURS[1], label="fit")
    plot.label_axes(left, "time [s]", "wheel speed [m/s]")
    z = errors(config, found)
    for i in range(z.shape[1]):
        right.plot(np.full(len(z), i) + np.linspace(-0.25, 0.25, len(z)), z[:, i], "o", color=plot.COLOURS[i], ms=4)
    for k in (1, 2, 3):
        right.axhspan(-k, k, color=plot.GREY, alpha=0.1, linewidth=0)
    right.set_xticks(range(5), SHORT)
    plot.label_axes(right, f"parameter, {len(z)} seeds each", "error [standard deviations]")
    return figure


def draw_correlation(found: Identified) -> Any:
    """Which parameters the trace tells apart badly."""
    figure, (ax,) = plot.sheet(title="Correlation, seed 0", size=(4.6, 4.0))
    matrix = found.uncertainty.correlation
    ax.imshow(matrix, cmap="RdBu", vmin=-1, vmax=1)
    for i, j in np.ndindex(*matrix.shape):
        dark = "white" if abs(matrix[i, j]) > 0.6 else "black"
        ax.text(j, i, f"{matrix[i, j]:.2f}", ha="center", va="center", fontsize=9, color=dark)
    ax.set_xticks(range(5), SHORT)
    ax.set_yticks(range(5), SHORT)
    ax.grid(False)
    return figure


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    found, traces = recovered(config)
    table = coverage(config, found)
    record.print_rows("Known parameters from a noisy wheel speed", table)
    spread = [
        {"relative spread": one.spread, "direction": one.describe()} for one in found[0].uncertainty.directions[::-1]
    ]
    record.print_rows("What the trace says least about", spread)
    noise = float(np.mean([np.sqrt(one.chi2 / one.uncertainty.degrees) for one in found]) * config.noise)
    record.print_rows("Noise", [{"true [m/s]": config.noise, "left by the fits [m/s]": noise}])
    drawn = {"recovery": draw_recovery(config, found, traces), "correlation": draw_correlation(found[0])}
    return record.experiment(config, {"table": table, "directions": spread, "noise": noise}, drawn)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
