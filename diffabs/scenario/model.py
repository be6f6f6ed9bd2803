"""The contents of a scenario as JSON values, for the documents of the commands and for their readers."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from diffabs.core.pytree import parameters
from diffabs.core.types import JsonObject, Scalar
from diffabs.core.units import units_of
from diffabs.engine.solvers import describe_solver
from diffabs.host import documents, provenance
from diffabs.scenario import registry

if TYPE_CHECKING:
    from diffabs.scenario.scenario import Scenario


def describe_source(scenario: "Scenario") -> JsonObject:
    """Return the first entries of a document on a scenario: its name, `describe_model` and `describe_command`."""
    return {"scenario": scenario.name, "model": describe_model(scenario), "made": provenance.describe_command()}


def result_document(kind: str, scenario: "Scenario", values: JsonObject, *packages: str) -> JsonObject:
    """Return the JSON document of a result: its source, its values, the versions of `packages`, and no files yet."""
    content = {**describe_source(scenario), **values, "versions": provenance.versions(*packages), "files": {}}
    return documents.stamp(kind, content)


def describe_model(scenario: "Scenario") -> JsonObject:
    """Return title, description, parts, parameters with units, solver, and units of the metrics as JSON values."""
    return {
        "title": scenario.title,
        "description": scenario.description,
        "parts": describe_parts(scenario),
        "parameters": describe_numbers(scenario),
        "solver": {**describe_solver(scenario.solver), "seed": scenario.seed},
        "metrics": {
            name: registry.unit_of(objective, scenario.loop.plant) for name, objective in scenario.objectives.items()
        },
    }


def describe_parts(scenario: "Scenario") -> dict[str, JsonObject]:
    """Return every part, objectives included, by its path: its type, and its fields that are not parameters."""
    parts = dict(registry.part_choices(scenario.loop))
    for name, objective in scenario.objectives.items():
        parts |= registry.part_choices(objective, f"objective.{name}")
    return parts


def describe_numbers(scenario: "Scenario") -> dict[str, JsonObject]:
    """Return value (in SI) and unit of every parameter, those of objectives included, by its path.

    JSON has no infinity and no NaN: these become texts, which an override accepts.
    """

    def plain(value: Scalar) -> Any:
        return value if math.isfinite(value) else str(value)

    objectives = (
        (f"objective.{name}.{path}", spec, value)
        for name, objective in scenario.objectives.items()
        for path, spec, value in parameters(objective, units=units_of(scenario.loop.plant))
    )
    return {
        path: {"value": np.vectorize(plain, otypes=[object])(np.asarray(value, float)).tolist(), "unit": spec.unit}
        for path, spec, value in (*parameters(scenario.loop), *objectives)
    }
