"""Output feedback without a sensor of the rider: LQG at 100 Hz from noisy angles of frame and arm, hanging arm, 48 V.

A vehicle measures its own lean and its arm, but neither the rider nor rates. A steady Kalman filter estimates the rest
in the computer of the controller. It knows the voltage limit. It begins at the first measured angles, with all rates
and the rider at zero.

The start of the paper's Fig. 3, frame 0.5 and rider 0.2 rad, is scaled until the vehicle falls for one of many seeds of
the noise. A run is recovered if the vehicle stands after 10 s with the frame within `band` of upright. A run that
stands outside of the band is undecided, and counted apart.

    python experiments/two_wheeler/run.py lqg
"""

import dataclasses
from typing import Any

import jax
import numpy as np

from diffabs import Batch, FixedStep, run_batch
from diffabs.linear.gaussian import lqg
from diffabs.loop.closed_loop import Loop
from diffabs.output import plot
from diffabs.papers import record
from diffabs.parts.objectives import SoftLoss
from diffabs.parts.sensors import AngleSensor
from diffabs.scenario.scenario import load

WEIGHTS, EFFORT = np.diag([1.0, 100.0, 1.0, 1.0, 1.0, 1.0]), 0.01
FRAME = SoftLoss(weight=np.eye(6)[0], radius=1.0, softness=1.0)  # |theta|/(1 + |theta|): rises with the last lean


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    noises: tuple[tuple[float, float], ...] = ((0.0, 0.0), (1e-3, 1e-3), (3e-3, 3e-3), (1e-2, 1e-2))  # rad, theta, psi
    period: float = 0.01  # s
    disturbance: tuple[float, float, float] = (1.0, 1.0, 1.0)  # rad/s^2, what the filter thinks it does not know
    least_noise: float = 1e-4  # rad, that the filter is designed for where there is none
    seeds: int = 64  # of the noise, the same at every multiple
    multiples: tuple[float, float, int] = (0.02, 0.09, 71)
    band: float = 0.05  # rad
    step: float = 1e-3  # s
    duration: float = 10.0
    seed: int = 0
    engine: str = "auto"  # a kernel where there is a C++ compiler
    out: str = "out/experiments/two_wheeler/lqg"


def observed(config: Config, noise: tuple[float, float]) -> Loop:
    """The hanging arm under LQG."""
    loop = load("arm-hanging").loop
    deviations = tuple(max(x, config.least_noise) for x in noise)
    limit = float(loop.actuator.high)
    controller = lqg(
        loop.plant,
        WEIGHTS,
        EFFORT,
        period=config.period,
        disturbance=config.disturbance,
        noise=deviations,
        predicted_high=limit,
    )
    sensor = AngleSensor(theta=noise[0], psi=noise[1], period=config.period)
    return dataclasses.replace(loop, controller=controller, sensor=sensor)


def share(config: Config, loop: Loop) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Multiples, of each the share of seeds that recover, and the share that is undecided."""
    multiples = np.linspace(*config.multiples)
    lanes = np.repeat(multiples, config.seeds)
    starts = {"initial.theta": 0.5 * lanes, "initial.phi": 0.2 * lanes}
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(config.seed), i))(
        np.tile(np.arange(config.seeds), len(multiples))
    )
    solver = FixedStep(step=config.step, duration=config.duration)
    runs = jax.device_get(run_batch(loop, Batch(starts, keys), solver, {"frame": FRAME}, engine=config.engine))
    recovered = ~runs.stopped & (runs.metrics["frame"] < config.band / (1 + config.band))
    undecided = ~runs.stopped & ~runs.diverged & ~recovered
    return multiples, *(x.reshape(len(multiples), config.seeds).mean(axis=1) for x in (recovered, undecided))


def largest(multiples: np.ndarray, shares: np.ndarray, level: float = 1.0) -> float:
    """Return the greatest multiple up to which this share of the seeds recovers; 0 where the first one does not."""
    enough = shares >= level
    good = len(shares) if enough.all() else int(np.argmin(enough))
    return float(multiples[good - 1]) if good else 0.0


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    shares_by_loop = {"full state, no noise": share(config, load("arm-hanging").loop)}
    for noise in config.noises:
        shares_by_loop[f"LQG, {1e3 * noise[0]:g} mrad"] = share(config, observed(config, noise))
    full = largest(*shares_by_loop["full state, no noise"][:2])
    rows = [
        {
            "controller": name,
            "multiple": (c := largest(*loop_shares[:2])),
            "of the full state's": c / full,
            "95 % of the seeds": largest(*loop_shares[:2], 0.95),
            "half of the seeds": largest(*loop_shares[:2], 0.5),
            "seeds": config.seeds,
            "undecided runs": float(loop_shares[2].mean()),
        }
        for name, loop_shares in shares_by_loop.items()
    ]
    record.print_rows("Recovered by every seed, hanging arm at 48 V", rows)
    drawn, (ax,) = plot.sheet(title="Hanging arm at 48 V, angles measured at 100 Hz", size=(6.6, 3.8))
    for i, (name, (multiples, shares, _)) in enumerate(shares_by_loop.items()):
        ax.plot(multiples, shares, plot.DASHES[i], color=plot.COLOURS[i], label=name)
    plot.label_axes(ax, "multiple of (0.5, 0, 0.2) rad", "share of seeds recovered")
    shares = {name: loop_shares[1].tolist() for name, loop_shares in shares_by_loop.items()}
    return record.experiment(config, {"table": rows, "shares": shares}, {"lqg": drawn})
