"""A factor on the friction of any road, as a parameter of its own with one slider.

The road is wrapped in `Scaled` with the factor 1, which changes no bit of a run. The paths of the road's parameters in
the scenario become one level deeper. A factor that stays at 1 is removed again on saving.
"""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

from diffabs.core.types import JsonObject, Part, Table
from diffabs.parts.roads import Scaled

if TYPE_CHECKING:
    from diffabs.scenario.scenario import Scenario

ROAD, INNER = "plant.road.", "plant.road.road."
FACTOR_PATH = "plant.road.scale"


def with_factor(scenario: "Scenario") -> "Scenario":
    """Return the scenario with a friction factor at `plant.road.scale`.

    A scenario without a road, or whose road has a factor already, is returned unchanged.
    """
    road = getattr(scenario.loop.plant, "road", None)
    if road is None or isinstance(road, Scaled):
        return scenario
    plant: Part = scenario.loop.plant
    plant = dataclasses.replace(plant, road=Scaled(road=road))
    return _rename_paths(scenario, plant, lambda path: INNER + path[len(ROAD) :] if path.startswith(ROAD) else path)


def without_factor(scenario: "Scenario", original: "Scenario") -> "Scenario":
    """Return the scenario without the factor that `with_factor` added, if the factor is still 1."""
    road = getattr(scenario.loop.plant, "road", None)
    had = isinstance(getattr(original.loop.plant, "road", None), Scaled)
    if not isinstance(road, Scaled) or had or float(road.scale) != 1.0:
        return scenario
    plant: Part = scenario.loop.plant
    plant = dataclasses.replace(plant, road=road.road)
    return _rename_paths(scenario, plant, lambda path: ROAD + path[len(INNER) :] if path.startswith(INNER) else path)


def _rename_paths(scenario: "Scenario", plant: object, name: Callable[[str], str]) -> "Scenario":
    def keys(table: Table) -> JsonObject:
        return {name(path): value for path, value in table.items()}

    tune, sweep = scenario.tune, scenario.sweep
    correlation = sweep.correlation
    if correlation is not None:
        correlation = dataclasses.replace(correlation, paths=tuple(map(name, correlation.paths)))
    return dataclasses.replace(
        scenario,
        loop=dataclasses.replace(scenario.loop, plant=plant),
        design=dataclasses.replace(scenario.design, over=keys(scenario.design.over)),
        tune=dataclasses.replace(tune, free=keys(tune.free), over=keys(tune.over)),
        sweep=dataclasses.replace(sweep, over=keys(sweep.over), correlation=correlation),
    )
