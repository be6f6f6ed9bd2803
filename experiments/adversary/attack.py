"""A controller under attack: overshoots of the adversary's points, gradients, and the price of a gradient in runs."""

import dataclasses
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs import Batch, FixedStep, Loop, run_batch
from diffabs.parts.objectives import IAE, LockedTime, Overshoot
from experiments.adversary.bounds import Bounds, drawn, parameters

MEASURED = {"overshoot": Overshoot(), "locked": LockedTime(), "iae": IAE()}
NOTHING = -1.0  # in place of the overshoot of a run that is none


@dataclasses.dataclass(frozen=True)
class Running:
    """How the runs are made."""

    step: float = 1e-3  # s
    duration: float = 3.2  # s, in which every run ends
    block: int = 512  # lanes of a call, at most
    timed: int = 5  # times that a price is measured
    engine: str = "auto"


@dataclasses.dataclass(frozen=True, eq=False)
class Attack:
    """Points are in units of the bounds (n, size), and have to be in the set."""

    loop: Loop
    bounds: Bounds = dataclasses.field(default_factory=Bounds)
    running: Running = dataclasses.field(default_factory=Running)

    def solver(self, finer: int = 1) -> FixedStep:
        """Return what integrates, with so many times shorter steps."""
        return FixedStep(self.running.step / finer, self.running.duration, kinks=False)

    def runs(self, z: np.ndarray, finer: int = 1) -> Any:
        """Return the runs at points, as `simulate` would make and flag them."""
        lanes = Batch(parameters(self.bounds, z))
        return jax.device_get(run_batch(self.loop, lanes, self.solver(finer), MEASURED, engine=self.running.engine))

    def overshoots(self, z: np.ndarray) -> np.ndarray:
        """Return overshoots (n,), NOTHING for a run that is flagged. In calls of few sizes, since each is compiled."""
        count = len(z)
        size = min(self.running.block, 1 << (count - 1).bit_length())
        padded = np.concatenate([z, np.repeat(z[-1:], -count % size, axis=0)])
        runs = [self.runs(part) for part in np.split(padded, len(padded) // size)]
        overshoots = [np.where(run.stopped & ~run.diverged, run.metrics["overshoot"], NOTHING) for run in runs]
        return np.concatenate(overshoots)[:count]

    def gradients(self, z: np.ndarray) -> np.ndarray:
        """Return the derivatives of the overshoots (n, size), by reverse mode; 0 where one is no number."""
        slopes = _slopes(jnp.asarray(z), self.loop, self.bounds, self.solver())
        return np.nan_to_num(np.asarray(slopes), posinf=0.0, neginf=0.0)

    def priced(self, gradients: int, runs: int) -> float:
        """Return how many runs a gradient costs, where so many of either are asked for at once: processor time, taken
        alternately, medians."""
        random = np.random.default_rng(0)
        points = [drawn(self.bounds, count, random) for count in (gradients, runs)]
        calls: list[Callable[[Any], Any]] = [self.gradients, self.overshoots]
        taken = np.zeros((1 + self.running.timed, 2))
        for row in taken:
            for k, (call, z) in enumerate(zip(calls, points, strict=True)):
                begun = time.process_time()
                call(z)
                row[k] = (time.process_time() - begun) / len(z)
        gradient, run = np.median(taken[1:], axis=0)
        return float(gradient / run)


@partial(jax.jit, static_argnums=(2, 3))
def _slopes(z: Any, loop: Loop, bounds: Bounds, solver: FixedStep) -> Any:
    """Compiled once for a structure of the loop."""

    def total(z: Any) -> Any:
        measured = {"overshoot": MEASURED["overshoot"]}
        run = run_batch(loop, Batch(parameters(bounds, z)), solver, measured, together=True)
        return jnp.sum(run.metrics["overshoot"])

    return jax.grad(total)(z)
