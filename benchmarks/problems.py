"""The loops on which our own solvers are measured: lanes in a box of parameters, metrics, and the steps and
tolerances that are tried, coarse to fine."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from peers import ours

import diffabs
from diffabs import objectives, references, sensors
from diffabs.parts.sensors import noise
from diffabs.scenario.scenario import load

TOLERANCES = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 3e-7, 1e-7)
BRAKING = ours.MEASURED
BALANCED = {name: objectives.BALANCE[name] for name in ("settling_time", "peak_lean", "peak_arm_angle")}


@dataclasses.dataclass(frozen=True)
class Problem:
    """A loop, what differs between its lanes, and what is measured for how long [s].

    box: low and high by path, in SI
    steps: of FixedStep, coarse to fine; `exact` is that of the reference, whose steps end on kinks
    noisy: whether each lane has a key of its own"""

    title: str
    loop: Any
    box: dict[str, tuple[float, float]]
    duration: float
    steps: tuple[float, ...]
    exact: float
    metrics: dict[str, Any] = dataclasses.field(default_factory=lambda: dict(BRAKING))
    noisy: bool = False

    def lanes(self, count: int, distinct: int) -> tuple[diffabs.Batch, np.ndarray]:
        """Return (the batch of `count` lanes, the number of the distinct lane that each repeats): fewer than the
        distinct ones are spread over them, more go through them again and again."""
        which = np.arange(count) % distinct if count > distinct else (np.arange(count) + 0.5) * distinct // count
        which = which.astype(int)
        values = diffabs.loop.batch.latin(self.box, distinct).values
        keys = np.arange(distinct)[which] if self.noisy else None
        return diffabs.Batch({path: np.asarray(x)[which] for path, x in values.items()}, keys), which

    def solver(self, kind: str, setting: float) -> Any:
        """Return the solver: "fixed" of a step [s], "adaptive" of a tolerance, or the reference's, "exact"."""
        if kind == "exact":
            return diffabs.FixedStep(setting, self.duration, kinks=True)
        return ours.solver(kind, setting, self.duration)

    def ladder(self, kind: str) -> tuple[float, ...]:
        """Return the settings that are tried, coarse to fine."""
        return TOLERANCES if kind == "adaptive" else self.steps


RIG = {"plant.mass": (5.3, 6.2), "initial.speed": (30 / 3.6, 60 / 3.6)}
CAR = {"plant.mass": (13.0, 17.0), "initial.speed": (60 / 3.6, 110 / 3.6)}


def estimator(reference: Any) -> Any:
    """Return the loop of [est] under its PI."""
    return dataclasses.replace(load("slip-estimator", ("controller.kd=0",)).loop, reference=reference)


def same_noise() -> None:
    """Draw the same noise in both precisions, that of float32, from now on in this process: else a run in float32 is
    another run than its reference."""

    def drawn(like: Any, key: Any, number: Any) -> Any:
        return jax.random.normal(jax.random.fold_in(key, number), (), jnp.float32).astype(like.dtype)

    noise._normal = drawn


def problems() -> dict[str, Problem]:
    """Return the problems by name."""
    same_noise()
    cured, arm = load("slip-cured").loop, load("arm-hanging").loop
    noisy = dataclasses.replace(ours.LOOP, sensor=sensors.Noise(slip=0.005))
    stiff = (1e-4, 5e-5)  # stable at the end of a stop, at 0.05 m/s
    return {
        "lmi": Problem("lmi, limited", ours.LOOP, RIG, 2.1, (2e-3, 1e-3, 5e-4, 2e-4, 1e-4), 1e-4),
        "est-pi": Problem("est, PI", estimator(references.FixedSlip()), CAR, 4.0, stiff, 5e-5),
        "est-latch": Problem("est, PI latch", estimator(references.PeakLatch()), CAR, 4.0, stiff, 5e-5),
        "slip-cured": Problem("slip-cured", cured, RIG, 2.1, (1e-3, 5e-4, 2.5e-4, 1.25e-4), 2.5e-4),
        "arm": Problem(
            "hanging arm",
            arm,
            {"plant.rider_mass": (40.0, 60.0), "initial.theta": (0.01, 0.03)},
            10.0,
            (5e-3, 2e-3, 1e-3, 5e-4, 2.5e-4),
            5e-4,
            BALANCED,
        ),
        "lmi-noisy": Problem("lmi, noisy", noisy, RIG, 2.1, (1e-3, 5e-4, 2e-4, 1e-4), 1e-4, noisy=True),
    }
