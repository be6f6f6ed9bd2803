"""Where is a controller of the rig weak? One deviation at a time, everywhere in its box.

The box of masses and start speeds includes its corners, and was fixed before the tuning. The deviations are faster
starts, friction, brake lag, inertia, computing delay, noise, and a vehicle speed that is measured low. The overshoot
is that of the true slip: a speed measured 1 % low alone holds the slip at 0.208.

`run.py` prints the result for each controller.
"""

import dataclasses
from typing import Any

import jax
import numpy as np

from diffabs import Batch, FixedStep, Loop, replace, rollout, run_batch
from diffabs.core.blocks import Series
from diffabs.core.pytree import get
from diffabs.parts.actuators import Limits
from diffabs.parts.objectives import Overshoot
from diffabs.parts.sensors import Noise, SpeedScale

KMH = 3.6
OVERSHOOT = {"overshoot": Overshoot()}


@dataclasses.dataclass(frozen=True)
class Box:
    """Every combination of masses and speeds of the start; a run ends at `end`, or at half its start if that is
    lower."""

    masses: tuple[float, ...] = (5.3, 5.6, 5.9, 6.2)  # kg
    speeds: tuple[float, ...] = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0)  # km/h
    end: float = 5.0  # km/h

    def lanes(self) -> dict[str, np.ndarray]:
        """Parameters of a loop by path, one row for each combination."""
        masses, speeds = (x.ravel() for x in np.meshgrid(self.masses, self.speeds, indexing="ij"))
        ends = np.minimum(self.end, speeds / 2)
        return {"plant.mass": masses, "initial.speed": speeds / KMH, "stop.speed": ends / KMH}


@dataclasses.dataclass(frozen=True)
class Spot:
    """One thing that goes wrong: parameters by path, times a factor or at a value; `speed`: of the start, instead of
    the box's [km/h]."""

    name: str
    factors: tuple[tuple[str, float], ...] = ()
    values: tuple[tuple[str, float], ...] = ()
    speed: float | None = None


SPOTS = (
    Spot("51 km/h", speed=51.0),
    Spot("55 km/h", speed=55.0),
    Spot("70 km/h", speed=70.0),
    Spot("friction +10 %", factors=(("plant.road.w4", 1.1),)),
    Spot("lag 2 ms", values=(("actuator.time_constant", 2e-3),)),
    Spot("inertia +10 %", factors=(("plant.wheel_inertia", 1.1),)),
    Spot("computing 1 ms", values=(("controller.delay", 1e-3),)),
    Spot("speed 1 % low", values=(("sensor.factor", 0.99),)),
    Spot("speed 5 % low", values=(("sensor.factor", 0.95),)),
)
NOISE = 0.005  # standard deviation of the measured slip
NOISY = f"slip noise {NOISE:g}"


def lanes(box: Box, loop: Loop, spot: Spot) -> dict[str, np.ndarray]:
    """The box's lanes with one thing wrong."""
    if spot.speed is not None:
        box = dataclasses.replace(box, speeds=(spot.speed,))
    box_lanes = box.lanes()
    wrong = {path: factor * float(get(loop, path)) for path, factor in spot.factors} | dict(spot.values)
    return box_lanes | {path: np.full(len(box_lanes["plant.mass"]), value) for path, value in wrong.items()}


def everything(box: Box, loop: Loop) -> tuple[Batch, list[str]]:
    """All spots but noise as one batch, which is compiled once, and the name of each lane's spot."""
    spot_lanes = [lanes(box, loop, spot) for spot in SPOTS]
    paths = dict.fromkeys(path for each in spot_lanes for path in each)
    count = [len(each["plant.mass"]) for each in spot_lanes]
    columns = {
        path: np.concatenate(
            [each.get(path, np.full(n, float(get(loop, path)))) for each, n in zip(spot_lanes, count, strict=True)]
        )
        for path in paths
    }
    return Batch(columns), [spot.name for spot, n in zip(SPOTS, count, strict=True) for _ in range(n)]


def noisy(box: Box, seeds: int) -> Batch:
    """Every lane of the box with every seed."""
    columns = {path: np.repeat(column, seeds) for path, column in box.lanes().items()}
    return Batch(columns, list(range(seeds)) * len(box.lanes()["plant.mass"]))


def weak_spots(loop: Loop, box: Box, solver: FixedStep, seeds: int = 4) -> dict[str, float | None]:
    """Worst overshoot [%] by what goes wrong; None where a run diverges."""
    scaled = dataclasses.replace(loop, sensor=SpeedScale())
    batch, names = everything(box, scaled)
    runs = jax.device_get(jax.jit(lambda loop: run_batch(loop, batch, solver, OVERSHOOT))(scaled))
    worst = {spot.name: _worst(runs, np.array(names) == spot.name) for spot in SPOTS}
    shaken = dataclasses.replace(loop, sensor=Noise(slip=NOISE, period=1e-3))
    drawn = noisy(box, seeds)
    runs = jax.device_get(jax.jit(lambda loop: run_batch(loop, drawn, solver, OVERSHOOT))(shaken))
    return {**worst, NOISY: _worst(runs, np.full(drawn.size, True))}


def _worst(runs: Any, lanes: np.ndarray) -> float | None:
    if np.any(runs.diverged[lanes]):
        return None
    return 100 * float(np.max(runs.metrics["overshoot"][lanes]))


def unlimited(loop: Loop) -> Loop:
    """Return the same loop with its torque limits in the actuator.

    The limits do the same there, since there is no anti-windup. So the run shows the commanded torque.
    """
    inner = loop.controller.controller  # pyright: ignore[reportAttributeAccessIssue]
    limits = Limits(low=inner.low, high=inner.high)
    free = dataclasses.replace(inner, low=-np.inf, high=np.inf)
    controller = dataclasses.replace(loop.controller, controller=free)  # pyright: ignore[reportArgumentType]
    return dataclasses.replace(loop, controller=controller, actuator=Series(blocks=(limits, loop.actuator)))


def torques(loop: Loop, box: Box, solver: FixedStep) -> tuple[float, float]:
    """Least and greatest torque asked for over the box [N m], before the limits."""
    free = unlimited(loop)
    commands = jax.jit(jax.vmap(lambda values: rollout(replace(free, values), solver).trajectory.sample.command))
    command = np.asarray(commands(box.lanes()))
    return float(command.min()), float(command.max())
