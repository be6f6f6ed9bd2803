"""The contents of a scenario as JSON values, for the documents of the commands and for their readers."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from diffabs.core.pytree import parameters
from diffabs.core.types import JsonObject, Scalar
from diffabs.core.units import units_of
from diffabs.scenario import registry
from diffabs.simulate.types import describe_solver

if TYPE_CHECKING:
    from diffabs.scenario.scenario import Scenario


def describe_model(chosen: "Scenario") -> JsonObject:
    """Return a scenario as JSON values.

    They are title, description, parts, parameters with units, solver, and units of the metrics.
    """
    return {
        "title": chosen.title,
        "description": chosen.description,
        "parts": describe_parts(chosen),
        "parameters": describe_numbers(chosen),
        "solver": {**describe_solver(chosen.solver), "seed": chosen.seed},
        "metrics": {name: registry.unit_of(one, chosen.loop.plant) for name, one in chosen.objectives.items()},
    }


def describe_parts(chosen: "Scenario") -> dict[str, JsonObject]:
    """Return every part, objectives included, by its path: its type, and its fields that are not parameters."""
    found = dict(registry.part_choices(chosen.loop))
    for name, one in chosen.objectives.items():
        found |= registry.part_choices(one, f"objective.{name}")
    return found


def describe_numbers(chosen: "Scenario") -> dict[str, JsonObject]:
    """Return value (in SI) and unit of every parameter, those of objectives included, by its path.

    JSON has no infinity and no NaN: these become texts, which an override accepts.
    """

    def plain(value: Scalar) -> Any:
        return value if math.isfinite(value) else str(value)

    objectives = (
        (f"objective.{name}.{path}", spec, value)
        for name, one in chosen.objectives.items()
        for path, spec, value in parameters(one, units=units_of(chosen.loop.plant))
    )
    return {
        path: {"value": np.vectorize(plain, otypes=[object])(np.asarray(value, float)).tolist(), "unit": spec.unit}
        for path, spec, value in (*parameters(chosen.loop), *objectives)
    }
