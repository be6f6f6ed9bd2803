"""How many starts does the hanging arm recover, and do gradients find LQ weights that recover more?

The region of attraction is a strip, bounded by the effect of 48 V on the one unstable mode. Its share of the box
|theta0|, |phi0| <= 0.1, by area, is a count without a derivative. So gradients minimise the mean of `SoftLoss` over
starts, a sigmoid of log |x(T)|. It depends on the weights Q = diag(q) and R through the Riccati equation and the closed
loop. The tables show the count, and the share that some control at 48 V recovers in the linear model
(`linear.recoverable`).

A common Lyapunov matrix then certifies the linear loop, for riders of 40 to 100 kg whose spring and damper are off by
30 %.

    python experiments/two_wheeler/run.py weights
"""

import dataclasses
from typing import Any

import numpy as np

from diffabs import FixedStep
from diffabs.core.pytree import replace
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.recoverable import mode_bounds
from diffabs.output import plot
from diffabs.papers import record
from diffabs.parts.objectives import SoftLoss
from diffabs.robust.design import certify
from diffabs.robust.design.attraction import Basin, Cells, recoverable_multiple, region_of_attraction
from diffabs.robust.design.parameter_grid import grid_polytope
from diffabs.scenario.scenario import load
from diffabs.tune import Method, Stopping, build_problem, grid, tune
from diffabs.tune.weights import lq_weights, lqr_gain_design

PAPER_START = {"initial.theta": 0.5, "initial.phi": 0.2}


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    box: float = 0.1  # rad
    starts: int = 100  # of each axis of a map
    step: float = 1e-3  # s, of a map
    duration: float = 60.0  # s, at most: a run ends when it is decided
    effort: float = 0.01  # R at the start, where Q = I
    tuned_starts: tuple[int, int] = (13, 25)  # theta0 >= 0 (the loop is odd) and phi0
    tuned_step: float = 4e-3  # s
    tuned_duration: float = 1.5
    radius: float = 0.3  # of SoftLoss
    softness: float = 0.5
    q_range: tuple[float, float] = (-8.0, 8.0)  # logarithm of the root of each q
    effort_range: tuple[float, float] = (-12.0, 2.0)  # logarithm of R
    iterations: int = 40
    riders: tuple[float, float] = (40.0, 100.0)  # kg
    deviation: float = 0.3  # of the rider's spring and damper
    proof_points: int = 5  # of each parameter of the certificate's grid
    out: str = "out/experiments/two_wheeler/weights"


def tuned(config: Config) -> Any:
    """Weights that lose fewer starts."""
    loop = load("arm-hanging").loop
    design = lqr_gain_design(BalanceModel(plant=loop.plant))
    first, second = config.tuned_starts
    axes = {"initial.theta": np.linspace(0, config.box, first), "initial.phi": np.linspace(-1, 1, second) * config.box}
    return tune(
        build_problem(
            lq_weights(loop, np.ones(6), config.effort, design),
            free={"log_diagonal": config.q_range, "log_effort": config.effort_range},
            objective={"loss": 1.0},
            over=grid(axes),
            # Nearly bang-bang gains slide for a moment along the voltage limit, and would end the search there.
            solver=FixedStep(step=config.tuned_step, duration=config.tuned_duration, kinks=False),
            measured={"loss": SoftLoss(radius=config.radius, softness=config.softness)},
        ),
        method=Method(stopping=Stopping(iterations=config.iterations)),
    )


def possible(config: Config) -> tuple[float, tuple[float, float]]:
    """Return the share of the box, by area, from which some control at 48 V recovers in the linear model.

    Also returns t, p [rad] of the strip |theta0/t + phi0/p| <= 1.
    """
    loop = load("arm-hanging").loop
    a, b = BalanceModel(plant=loop.plant).matrices()
    limit, unit = float(loop.actuator.high), np.eye(6)
    (theta,), (phi,) = (mode_bounds(a, b, unit[i], limit).values() for i in (0, 2))
    a, b = config.box / theta, config.box / phi
    beyond = max(a + b - 1, 0.0) ** 2 - max(abs(a - b) - 1, 0.0) ** 2  # two corners of the box, less what leaves it
    return 1 - beyond / (4 * a * b), (theta, phi)


def judged(config: Config, gain: Any) -> tuple[Basin, dict[str, Any]]:
    """Return the map of a gain, and its certificate over the riders."""
    loop = replace(load("arm-hanging").loop, {"controller.gain": np.asarray(gain)})
    solver = FixedStep(step=config.step, duration=config.duration)
    cells = Cells(-config.box, config.box, config.starts)
    basin = region_of_attraction(loop, cells, cells, solver)
    low, high = 1 - config.deviation, 1 + config.deviation
    spring, damper = loop.plant.stiffness, loop.plant.damping
    over = {
        "plant.rider_mass": config.riders,
        "plant.stiffness": (low * spring, high * spring),
        "plant.damping": (low * damper, high * damper),
    }
    proof = certify(gain, grid_polytope(BalanceModel(plant=loop.plant), over, config.proof_points))
    reach = recoverable_multiple(loop, PAPER_START, solver)
    return basin, {
        "share of the box": basin.share,
        "undecided": basin.undecided,
        "multiple of (.5, 0, .2)": reach.multiple,
        "next multiple undecided": reach.undecided,
        "common P over the riders": {True: "yes", False: "none", None: "undecided"}[proof.quadratically_stable],
        "systems": config.proof_points**3,
        "largest |k| [V/rad]": float(np.max(np.abs(gain))),
    }


def figure(maps: dict[str, Basin], axes_of_bound: tuple[float, float]) -> Any:
    """The maps side by side; the line is the linear bound."""
    drawn, axes = plot.sheet(
        1, len(maps), title="Which starts 48 V recover (hanging arm)", size=(4.4, 4.0), sharey=True
    )
    for i, (ax, (name, basin)) in enumerate(zip(axes, maps.items(), strict=True)):
        plot.shade_region(
            ax, basin.first.centres, basin.second.centres, basin.outcomes.recovered, basin.outcomes.undecided
        )
        ends, (theta, phi) = np.array([basin.first.low, basin.first.high]), axes_of_bound
        for sign in (-1, 1):
            ax.plot(ends, phi * (sign - ends / theta), color="black", linewidth=1)
        ax.set_xlim(*ends)
        ax.set_ylim(basin.second.low, basin.second.high)
        plot.label_axes(ax, "frame theta0 [rad]", "" if i else "rider phi0 [rad]", f"{name}: {100 * basin.share:.1f} %")
    return drawn


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    tuning = tuned(config)
    unit = [lq_weights(tuning.part.loop, np.ones(6), r, tuning.part.design).closed_loop() for r in (1.0, config.effort)]
    published = load("arm-hanging").loop.controller.gain
    gains = {
        "Q = I, R = 1": unit[0].controller.gain,
        f"Q = I, R = {config.effort:g}": unit[1].controller.gain,
        "Q = diag(1, 100, 1, 1, 1, 1)": published,
        "tuned": tuning.loop.controller.gain,
    }
    gains = {name: np.asarray(gain) for name, gain in gains.items()}
    maps, rows = {}, []
    for name, gain in gains.items():
        maps[name], row = judged(config, gain)
        rows.append({"weights": name, **row})
    share, lines = possible(config)
    record.print_rows("Hanging arm at 48 V", rows)
    weights = {
        "q": np.exp(2 * np.asarray(tuning.part.log_diagonal)).tolist(),
        "R": float(np.exp(tuning.part.log_effort)),
    }
    results = {
        "table": rows,
        "gains": {name: gain.tolist() for name, gain in gains.items()},
        "weights": weights,
        "possible share, linear model": share,
        "soft loss": list(tuning.objective),
        "gradients": tuning.evaluations,
        "ended": tuning.reason.value,
    }
    return record.experiment(config, results, {"attraction": figure(maps, lines)})
