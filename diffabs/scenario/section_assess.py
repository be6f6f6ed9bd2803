"""The section [assess] of a scenario: roads, load, speed and limits for the clauses about anti-lock brakes.

    high, low         coefficients of adhesion of the good and of the slippery road
    load              kg, that a laden car carries
    fast              km/h, the high speed
    steering_ratio    angle of the steering wheel per steer angle
    brief             s, the longest time for which a wheel may lock

`diffabs assess` runs its stops; [tune] takes the clauses as constraints. It is for plants with tyres on roads.
"""

from typing import TYPE_CHECKING

from diffabs.core.types import JsonObject
from diffabs.core.validity import find_problems
from diffabs.host.values import ScenarioError, plain_fields, read_table
from diffabs.loop.closed_loop import Loop

if TYPE_CHECKING:
    from diffabs.assess import StopProgram


def read_assess_section(table: object, loop: Loop) -> "StopProgram | None":
    """Return the program of a section, None without one. Raises ScenarioError for a plant without tyres."""
    if table is None:
        return None
    from diffabs.assess import StopProgram
    from diffabs.assess.runs import tyre_fields

    program: StopProgram = read_table(StopProgram, table, "assess")
    try:
        tyre_fields(loop.plant)
    except ValueError as error:
        raise ScenarioError(f"assess: {error}") from None
    if lines := list(find_problems(program, "assess.")):
        raise ScenarioError("; ".join(lines))
    return program


def write_assess_section(program: "StopProgram | None") -> dict[str, JsonObject]:
    """Return the section by its name, as `read_assess_section` reads it; nothing without a program."""
    return {} if program is None else {"assess": plain_fields(program)}
