"""How a run is asked for, and what it returns."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.protocols import Ending, Sample


@dataclasses.dataclass(frozen=True)
class FixedStep:
    """Steps of equal length [s], up to `duration` [s]; a trajectory keeps every `every`-th instant.

    kinks: whether a step ends where a comparison in the flow changes (a limit, the knot of a measured road, a wheel
    that locks) as it does on events. None: where a derivative is asked for. A value is exact to h^2 in such a step
    without, a derivative only to h; it costs up to twice as much."""

    step: float = 1e-3
    duration: float = 10.0
    every: int = 1
    kinks: bool | None = None

    @property
    def steps(self) -> int:
        """How many steps the duration takes."""
        return math.ceil(self.duration / self.step * (1 - 1e-12))


class Trajectory(NamedTuple):
    """What was seen, with a leading time axis. After the end of a run its last sample is repeated."""

    sample: Sample
    measured: Any  # output of the sensor
    state: Any  # of the plant
    running: Any  # bool: False once the run has ended

    def finite(self) -> Any:
        """Whether every number of the run is finite."""
        return jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(self.sample)]))


class Run(NamedTuple):
    """The result: metrics by name (NaN for a run that diverged), how it ended, and the trajectory if asked for."""

    metrics: dict[str, Any]
    stopped: Any  # bool: the stop was reached in time
    diverged: Any  # bool: its numbers mean nothing: one became infinite, NaN or impossible, or it began beyond its stop
    timed_out: Any  # bool: the duration was over before the stop; a run is one of the three, or was ended from outside
    ending: Ending
    trajectory: Trajectory | None
