"""All parts with their parameters, and the packaged scenarios, as JSON values by the plural of their family."""

from diffabs.core.channels import control_names
from diffabs.core.types import JsonObject, Part
from diffabs.core.units import control_units
from diffabs.scenario import registry
from diffabs.scenario.scenario import names, read_header

PLURALS = {f"{name}s": name for name in ("plant", "road", "tyre", "controller", "reference", "actuator", "sensor")}
PLURALS |= {"feedforward": "feedforward", "antiwindup": "antiwindup", "initial": "initial"}
PLURALS |= {"stops": "stop", "objectives": "objective"}
LISTED_FAMILIES = (*PLURALS, "scenarios")


def describe_family(plural: str) -> JsonObject:
    """Return the members of a family as plain values."""
    if plural == "scenarios":
        return {name: read_header(name) for name in names()}
    family = PLURALS[plural]
    return {
        name: {
            "summary": registry.part_summary(part),
            **({"unit": registry.unit_of(part)} if family == "objective" else {}),
            **({"channels": _describe_channels(part)} if control_names(part) else {}),
            "parameters": registry.describe_part(family, part),
        }
        for name, part in registry.family_types(family).items()
    }


def _describe_channels(plant: Part) -> JsonObject:
    """Return the units of a plant's controls, and of its outputs with a target, by name."""
    shows = plant.shows
    return {"controls": control_units(plant), "targets": {name: shows.units[name] for name in shows.tracked}}
