"""Proofs about the nonlinear loop: a tube over runs, errors that the cured loop bears, a tuning with proofs.

`diffabs prove` decides a claim about every run of a box. The study uses it for the rig of Maeda and Sugiura at 50
km/h, for every mass from 5.3 to 6.2 kg:

1. The tube that is proved for the published gain with torque limits, over 1,000 simulated runs.
2. The errors that the cured loop (`slip-cured`) bears with an overshoot of at most 5 %. A wrong factor of the speed is
   one more parameter of the box. A quantised slip is a disturbance of at most half a step at each sample, so the
   proof holds for every error of that size.
3. A tuning of the target filter and the gain. The cured loop settles soonest, and a proved overshoot of at most 1 % is
   the constraint.

    python experiments/proofs/run.py
"""

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import diffabs as d
from diffabs.parts.objectives import SettlingTime
from diffabs.parts.sensors import Quantisation, SpeedScale
from diffabs.robust.reach import RunClaim, cover_box
from diffabs.robust.reach.engine import Prover
from diffabs.scenario.scenario import load

KMH = 3.6


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    mass: tuple[float, float] = (5.3, 6.2)  # kg
    limits: tuple[float, float] = (0.0, 9.03)  # N m, of the published gain
    slip: float = 0.2
    cell: float = 0.02  # kg, of the tube
    runs: int = 1000
    shown: float = 0.5  # s, of the tube
    step: float = 1e-4  # s^2/m, of the tube: about 1 ms
    borne: float = 0.05  # overshoot under errors
    tuned: float = 0.01  # overshoot of the tuning
    halvings: int = 6  # of the range in which a bound is looked for
    gains: tuple[float, ...] = (0.7, 0.85, 1.0, 1.2)  # relative to the cured loop's
    filters: tuple[float, float] = (0.004, 0.06)  # s
    budget: float = 20.0  # s, of a proof
    out: str = "out/experiments/proofs"


def is_proved(
    config: Config, loop: d.Loop, overshoot: float, more: dict[str, tuple[float, float]] | None = None
) -> bool:
    """Return whether the overshoot of every run is proved to be at most a bound; `more`: further sides of the box."""
    claim = RunClaim("greatest slip", (1 + overshoot) * config.slip)
    box = {"plant.mass": config.mass, **(more or {})}
    return cover_box(loop, box, [claim], signals=("slip",), horizon=3.0, budget=config.budget).verdict == "proved"


def greatest_that_holds(config: Config, low: float, high: float, holds: Callable[[float], bool]) -> float:
    """Return by bisection the greatest number for which `holds` is true; `low` if it is true for none above."""
    for _ in range(config.halvings):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def borne_errors(config: Config) -> dict[str, float]:
    """Return the greatest speed error and the greatest measurement error of the slip that are proved to be borne."""
    cured = load("slip-cured").loop
    scaled = dataclasses.replace(cured, sensor=SpeedScale())

    def bears_factor(error: float) -> bool:
        return is_proved(config, scaled, config.borne, {"sensor.factor": (1 - error, 1 + error)})

    def bears_step(step: float) -> bool:
        return is_proved(config, dataclasses.replace(cured, sensor=Quantisation(slip=step)), config.borne)

    return {
        "speed": greatest_that_holds(config, 0.0, 0.02, bears_factor),
        "slip": 0.5 * greatest_that_holds(config, 0.0, 1e-3, bears_step),
    }


def proved_tuning(config: Config) -> list[dict[str, float]]:
    """Return, for each gain, the shortest filter with which the overshoot is proved, and the worst settling time."""
    cured = load("slip-cured").loop
    gain, rows = np.asarray(cured.controller.controller.gain), []
    for factor in config.gains:

        def changed(time_constant: float, factor: float = factor) -> d.Loop:
            return d.replace(
                cured,
                {"controller.controller.gain": factor * gain, "reference.time_constant": time_constant},
            )

        low, high = config.filters
        if not is_proved(config, changed(high), config.tuned):
            rows.append({"gain": factor, "filter": np.nan, "settling": np.nan})
            continue
        # Bisection for the shortest filter is that for the greatest -filter.
        shortest = -greatest_that_holds(config, -high, -low, lambda x: is_proved(config, changed(-x), config.tuned))
        masses = d.Batch({"plant.mass": np.linspace(*config.mass, 9)})
        solver = d.FixedStep(2.5e-4, 2.0)
        runs = d.run_batch(changed(shortest), masses, solver, {"settling": SettlingTime()})
        rows.append({"gain": factor, "filter": shortest, "settling": float(np.max(runs.metrics["settling"]))})
    return rows


def tube(config: Config) -> tuple[Any, Any]:
    """Return the proved tube of the slip on a grid of times, shape (times, 3), and the slips of runs at these times."""
    low, high = config.limits
    loop = load("slip-lmi", [f"controller.low={low}", f"controller.high={high}"]).loop
    proof = cover_box(loop, {"plant.mass": config.mass}, signals=("slip",), horizon=3.0, budget=config.budget)
    if proof.verdict != "proved":
        raise SystemExit("the tube is not proved within the budget")
    grid = np.arange(0.0, config.shown, 1e-3)
    lower, upper = np.full(len(grid), np.inf), np.full(len(grid), -np.inf)
    cells = [
        np.array([[a, min(a + config.cell, cell[0, 1])]])
        for cell in proof.cells
        for a in np.arange(cell[0, 0], cell[0, 1], config.cell)
    ]
    prover = Prover(proof.equations, ("slip",), config.shown, longest=config.step)
    prover.choose_weights(np.array([np.mean(config.mass)]))
    for cell in cells:
        flow = prover.follow(cell)
        first = np.searchsorted(grid, flow.time[:, 0])
        last = np.searchsorted(grid, flow.time[:, 1], side="right")
        for a, b, x, y in zip(first, last, flow.lower[:, 0], flow.upper[:, 0], strict=True):
            lower[a:b], upper[a:b] = np.minimum(lower[a:b], x), np.maximum(upper[a:b], y)
    masses = np.random.default_rng(0).uniform(*config.mass, config.runs)
    solver = d.FixedStep(1e-4, config.shown, every=10)
    with jax.enable_x64(True):  # a run in single precision leaves the tube by its rounding, 1e-6
        loops = (d.replace(loop, {"plant.mass": mass}) for mass in masses)
        slips = [np.asarray(d.rollout(loop, solver).trajectory.sample.output.slip) for loop in loops]
    return np.stack([grid, lower, upper], 1), np.stack(slips)[:, : len(grid)]


def draw_tube(config: Config, bounds: Any, slips: Any) -> pathlib.Path:
    """Draw the tube over the runs, and return the file."""
    from diffabs.output.plot.style import COLOURS, GREY, label_axes, save_figure, sheet

    figure, axes = sheet(title="Published gain with torque limits: every mass 5.3 to 6.2 kg", size=(7.0, 3.6))
    times, lower, upper = bounds.T
    for i, slip in enumerate(slips):
        label = f"{len(slips):,} runs" if not i else None
        axes[0].plot(times[: len(slip)], slip, color=GREY, linewidth=0.2, label=label)
    for bound, label in ((lower, "proved tube"), (upper, None)):
        axes[0].plot(times, bound, color=COLOURS[0], linewidth=1.0, label=label)
    axes[0].axhline(config.slip, color="black", linestyle=":", linewidth=0.8, label="target")
    label_axes(axes[0], "t [s]", "slip [1]", legend=False)
    axes[0].legend(loc="upper right")
    folder = pathlib.Path(config.out)
    folder.mkdir(parents=True, exist_ok=True)
    return save_figure(figure, folder / "tube.png")


def main(config: Config = Config()) -> None:
    """Print the errors that are borne and the tuning, and draw the tube."""
    bounds, slips = tube(config)
    inside = (slips >= bounds[: slips.shape[1], 1] - 1e-8) & (slips <= bounds[: slips.shape[1], 2] + 1e-8)
    print(f"tube: {len(slips):,} runs, {100 * inside.mean():.4g} % of their samples inside")
    print(f"figure: {draw_tube(config, bounds, slips)}")
    borne = borne_errors(config)
    print(
        f"overshoot at most {100 * config.borne:.0f} % is proved for speed errors within {100 * borne['speed']:.2g} %,"
    )
    print(f"and for errors of the measured slip within {borne['slip']:.2g}")
    print("gain   shortest filter [s]   worst settling time [s]   (overshoot at most 1 % proved)")
    for row in proved_tuning(config):
        print(f"{row['gain']:4.2f}   {row['filter']:19.5f}   {row['settling']:23.4f}")


if __name__ == "__main__":
    main()
