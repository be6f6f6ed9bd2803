"""From how many starts does the hanging arm recover, and do gradients find LQ weights that recover more?

The region of attraction is a strip, bounded by what 48 V can do about the one unstable mode. Its share of the box
|theta0|, |phi0| <= 0.1 is a count, which has no derivative; minimised is the mean of `SoftLoss` over starts, a sigmoid
of log |x(T)|, through the closed loop and through the Riccati equation, in the weights Q = diag(q) and R. The count is
shown beside it, and the share that some control at 48 V recovers in the linear model (`diffabs.design.recovery`).

What comes out is then certified at the linearisation: a common Lyapunov matrix for riders of 40 to 100 kg whose spring
and damper are off by 30 %.

    python experiments/arm_weights.py
"""

import dataclasses
from typing import Any

import jax
import numpy as np

from diffabs import FixedStep, plot
from diffabs.balance_model import BalanceModel
from diffabs.basin import Basin, attraction, recoverable
from diffabs.design import certify
from diffabs.design.gridded import gridded
from diffabs.design.recovery import mode_bounds
from diffabs.objectives import SoftLoss
from diffabs.papers import record
from diffabs.pytree import replace
from diffabs.scenario import load
from diffabs.tune import Method, Stopping, grid, tune
from diffabs.tune.weights import lq_weights, regulator

PAPER_START = {"initial.theta": 0.5, "initial.phi": 0.2}


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    box: float = 0.1  # rad
    starts: int = 100  # of each axis of a map
    step: float = 1e-3  # s, of a map
    duration: float = 10.0
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
    off: float = 0.3  # of the rider's spring and damper
    proof_points: int = 5  # of each parameter of the certificate's grid
    out: str = "out/experiments/arm_weights"


def tuned(config: Config) -> Any:
    """Weights that lose fewer starts."""
    loop = load("arm-hanging").loop
    design = regulator(BalanceModel(plant=loop.plant))
    first, second = config.tuned_starts
    axes = {"initial.theta": np.linspace(0, config.box, first), "initial.phi": np.linspace(-1, 1, second) * config.box}
    return tune(
        lq_weights(loop, np.ones(6), config.effort, design),
        free={"log_diagonal": config.q_range, "log_effort": config.effort_range},
        objective={"loss": 1.0},
        over=grid(axes),
        solver=FixedStep(step=config.tuned_step, duration=config.tuned_duration),
        measured={"loss": SoftLoss(radius=config.radius, softness=config.softness)},
        method=Method(stopping=Stopping(iterations=config.iterations)),
    )


def possible(config: Config, axis: np.ndarray) -> np.ndarray:
    """Which starts some control at 48 V recovers, by the linear model."""
    loop = load("arm-hanging").loop
    a, b = BalanceModel(plant=loop.plant).matrices()
    limit, unit = float(loop.actuator.voltage_max), np.eye(6)
    (theta,), (phi,) = (mode_bounds(a, b, unit[i], limit).values() for i in (0, 2))
    return np.abs(np.add.outer(axis / theta, axis / phi)) <= 1


def judged(config: Config, gain: Any) -> tuple[Basin, dict[str, Any]]:
    """Map of a gain, and what is proved of it over the riders."""
    loop = replace(load("arm-hanging").loop, {"controller.gain": np.asarray(gain)})
    solver = FixedStep(step=config.step, duration=config.duration)
    axis = np.linspace(-config.box, config.box, config.starts)
    basin = attraction(loop, axis, axis, solver)
    low, high = 1 - config.off, 1 + config.off
    spring, damper = loop.plant.stiffness, loop.plant.damping
    over = {
        "plant.rider_mass": config.riders,
        "plant.stiffness": (low * spring, high * spring),
        "plant.damping": (low * damper, high * damper),
    }
    proof = certify(gain, gridded(BalanceModel(plant=loop.plant), over, config.proof_points))
    return basin, {
        "share of the box": basin.share,
        "multiple of (.5, 0, .2)": recoverable(loop, PAPER_START, solver),
        "common P over the riders": {True: "yes", False: "none", None: "undecided"}[proof.quadratically_stable],
        "systems": config.proof_points**3,
        "largest |k| [V/rad]": float(np.max(np.abs(gain))),
    }


def figure(maps: dict[str, Basin], bound: np.ndarray) -> Any:
    """The maps side by side; the line is the linear bound."""
    drawn, axes = plot.sheet(
        1, len(maps), title="Which starts 48 V recover (hanging arm)", size=(4.4, 4.0), sharey=True
    )
    for i, (ax, (name, basin)) in enumerate(zip(axes, maps.items(), strict=True)):
        plot.region(ax, basin.first, basin.second, basin.recovered)
        ax.contour(basin.first, basin.second, bound.T, levels=[0.5], colors="black", linewidths=1)
        plot.label(ax, "frame theta0 [rad]", "" if i else "rider phi0 [rad]", f"{name}: {100 * basin.share:.1f} %")
    return drawn


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    found = tuned(config)
    start = lq_weights(found.part.loop, np.ones(6), config.effort, found.part.design).closed()
    known = load("arm-hanging").loop.controller.gain
    gains = {"Q = I": start.controller.gain, "Q = diag(1, 100, 1, 1, 1, 1)": known, "tuned": found.loop.controller.gain}
    gains = {name: np.asarray(gain) for name, gain in gains.items()}
    maps, rows = {}, []
    for name, gain in gains.items():
        maps[name], row = judged(config, gain)
        rows.append({"weights": name, **row})
    bound = possible(config, maps["tuned"].first)
    record.show("Hanging arm at 48 V", rows)
    weights = {"q": np.exp(2 * np.asarray(found.part.log_diagonal)).tolist(), "R": float(np.exp(found.part.log_effort))}
    results = {
        "table": rows,
        "gains": {name: gain.tolist() for name, gain in gains.items()},
        "weights": weights,
        "possible share, linear model": float(bound.mean()),
        "soft loss": list(found.objective),
        "gradients": found.evaluations,
        "ended": found.reason.value,
    }
    return record.experiment(config, results, {"attraction": figure(maps, bound)})


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
