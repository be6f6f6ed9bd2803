"""The stops that the clauses ask for, as one batch: each has a speed, a load, and two surfaces for each side.

All wheels of a stop have the same two surfaces, one before and one behind an edge; on a split road those of the right
side differ. Every run ends at 15 km/h, below which a wheel may lock.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from diffabs.assess.program import StopProgram
from diffabs.assess.surfaces import make_surface
from diffabs.core.protocols import Objective
from diffabs.core.pytree import get, replace
from diffabs.core.types import AnyArray, Array, Part, Scalar
from diffabs.engine.solvers import Solver
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.loop.ensemble import run_batch
from diffabs.loop.result import Run
from diffabs.parts.objectives import InChannel, LockedTime, PeakOutput, RiseTime, TimeBetweenSpeeds
from diffabs.parts.plants import GRAVITY
from diffabs.parts.roads import Burckhardt, Patches, RoadTyre
from diffabs.parts.stops import SpeedReached

ONE_KMH = 1 / 3.6  # m/s
NO_EDGE = 1e6  # m, beyond the end of every run
UP_EDGE = 0.5 * ONE_KMH * 50.0  # m, half a second at 50 km/h
CURVE = ("c1", "c2", "c3", "c4")
SOON = 2.0  # s, the time of the first limit of the steering
HIGH, LOW = (False, False), (True, True)
Population = Mapping[str, AnyArray]  # parameters of several cars by path, shape (cars,)


class RuleStop(NamedTuple):
    """One stop.

    Attributes:
        kind: "adhesion", "lock", "down", "up" or "split".
        speed: Speed at its start [km/h].
        laden: Whether the car carries the load.
        left_side: The surfaces of the left wheels before and behind the edge: True for the slippery one.
        right_side: Those of the right wheels.
        edge: Distance of the edge [m].
    """

    kind: str
    speed: float
    laden: bool
    left_side: tuple[bool, bool]
    right_side: tuple[bool, bool]
    edge: float

    def describe(self) -> str:
        """Return surfaces, speed and load in words."""
        sides = [" to ".join(dict.fromkeys("low" if slippery else "high" for slippery in side)) for side in self[3:5]]
        return f"{' | '.join(dict.fromkeys(sides))}, {self.speed:g} km/h, {'laden' if self.laden else 'unladen'}"


def tyre_fields(plant: Part) -> tuple[str, ...]:
    """Return the names of a plant's tyres. Raises ValueError for a plant without any."""
    names = tuple(name for name in vars(plant) if name.endswith("_tyre"))
    if not names:
        raise ValueError(f"{type(plant).__name__} has no tyres with roads; the plants half-car and car have them")
    return names


def has_two_sides(plant: Part) -> bool:
    """Return whether a plant has tyres on the left and on the right. Raises ValueError for a plant without any."""
    return any("left" in name for name in tyre_fields(plant))


def plan_stops(plant: Part, program: StopProgram) -> list[RuleStop]:
    """Return the stops of the clauses: unladen, then laden. A split road needs a car with two sides."""
    split, fast = has_two_sides(plant), float(program.fast)
    return [stop for laden in (False, True) for stop in _plan_load(laden, fast, split)]


def run_stops(
    loop: Loop,
    solver: Solver,
    stops: list[RuleStop],
    program: StopProgram,
    population: Population | None = None,
    objectives: Mapping[str, Objective] | None = None,
    engine: str = "auto",
    per_stop: Population | None = None,
    surfaces: tuple[Burckhardt, Burckhardt] | None = None,
) -> Run:
    """Return the runs of all stops, those of a car after another; also for a traced loop.

    Args:
        loop: Loop of the car, whose tyres, stop, mass and speed the stops replace.
        solver: Solver with a duration that lasts for the longest stop.
        stops: Stops of each car.
        program: Roads, load and speeds.
        population: Parameters of several cars by path, shape (cars,); without one there is one car.
        objectives: Further metrics by name.
        engine: Engine of the runs, as in `run_batch`.
        per_stop: Further parameters of each stop by path, shape (stops,).
        surfaces: The good and the slippery surface, instead of those of the program.

    Returns:
        Runs with metrics of shape (cars * stops,).
    """
    population, columns, plant = population or {}, {}, loop.plant
    cars = next((len(column) for column in population.values()), 1)
    curves = surfaces or (make_surface(program.high, slippery=False), make_surface(program.low, slippery=True))
    for name in tyre_fields(plant):
        on_road = f"{name}.tyre" if hasattr(getattr(plant, name), "relax") else name  # a relaxation length stays
        road = Patches(roads=(curves[0], curves[0]), edges=np.array([NO_EDGE]))
        plant = replace(plant, {on_road: RoadTyre(road=road)})
        sides = [stop.right_side if "right" in name else stop.left_side for stop in stops]
        for place in (0, 1):
            for coefficient in CURVE:
                values = _stack(getattr(curves[side[place]], coefficient) for side in sides)
                columns[f"plant.{on_road}.road.roads.{place}.{coefficient}"] = jnp.tile(values, cars)
        columns[f"plant.{on_road}.road.edges"] = jnp.tile(_stack(stop.edge for stop in stops), cars)[:, None]
    columns["initial.speed"] = jnp.tile(ONE_KMH * _stack(stop.speed for stop in stops), cars)
    columns |= {path: jnp.repeat(jnp.asarray(column), len(stops)) for path, column in population.items()}
    columns |= {path: jnp.tile(jnp.asarray(column), cars) for path, column in (per_stop or {}).items()}
    empty = columns.get("plant.mass", get(loop, "plant.mass"))
    columns["plant.mass"] = empty + jnp.tile(program.load * _stack(stop.laden for stop in stops), cars)
    ready = replace(loop, {"plant": plant, "stop": SpeedReached(speed=15 * ONE_KMH)})
    measured = {**_objectives(loop.plant, program), **(objectives or {})}
    return run_batch(ready, Batch(columns), solver, measured, engine=engine)


def _plan_load(laden: bool, fast: float, split: bool) -> Iterator[RuleStop]:
    """Yield the stops of a laden or an unladen car."""
    for road in (HIGH, LOW):
        yield RuleStop("adhesion", 55.0, laden, road, road, NO_EDGE)
        for speed in (40.0, fast):
            yield RuleStop("lock", speed, laden, road, road, NO_EDGE)
    for speed in (40.0, fast):
        yield RuleStop("down", speed, laden, (False, True), (False, True), 0.5 * ONE_KMH * speed)
    yield RuleStop("up", 50.0, laden, (True, False), (True, False), UP_EDGE)
    if split:
        yield RuleStop("split", 50.0, laden, HIGH, LOW, NO_EDGE)


def _objectives(plant: Part, program: StopProgram) -> dict[str, Objective]:
    """Return the objectives of every stop."""
    locked: dict[str, Objective] = {
        f"locked_{slip}": InChannel(objective=LockedTime(), control=f"{slip.removesuffix('_slip')}_brake", output=slip)
        for slip in plant.shows.tracked
    }
    steered: dict[str, Objective] = {
        "steer": PeakOutput(output="steer"),
        "early_steer": PeakOutput(output="steer", until=SOON),
        "lateral": PeakOutput(output="lateral_position"),
    }
    return {
        "time": TimeBetweenSpeeds(fast=45 * ONE_KMH, slow=15 * ONE_KMH),
        "rise_time": RiseTime(place=UP_EDGE, deceleration=0.75 * program.high * GRAVITY),
        **locked,
        **(steered if "steer" in plant.shows._fields else {}),
    }


def _stack(values: Iterator[Scalar]) -> Array:
    return jnp.stack([jnp.asarray(value, float) for value in values])
