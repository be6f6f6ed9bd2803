"""The section [assess] of a scenario: roads, load, speed and limits for the clauses about anti-lock brakes.

    high, low         coefficients of adhesion of the good and of the slippery road
    load              kg, that a laden car carries
    fast              km/h, the high speed
    steering_ratio    angle of the steering wheel per steer angle
    brief             s, the longest time for which a wheel may lock
    adhesion          k of the utilised adhesion: "road", or "axles" for one measured by braking one axle at a time
    driven            driven axle, "front", "rear" or "both", whose rolling resistance counts in a measured k

`diffabs assess` runs its stops; [tune] takes the clauses as constraints. It is for plants with tyres on roads.
"""

from typing import TYPE_CHECKING

from diffabs.core.types import JsonObject
from diffabs.core.validity import find_problems
from diffabs.host.values import (
    ScenarioError,
    choice_reader,
    list_reader,
    plain_fields,
    read_table,
    wrong_kind_error,
)
from diffabs.loop.closed_loop import Loop

ALL = "all"  # clauses that a plant can meet

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


def read_clauses(value: object, path: str, loop: Loop) -> tuple[str, ...]:
    """Return the numbers of the clauses in a list, or all that a loop's plant can meet for the text "all"."""
    from diffabs.assess.program import OF_A_SPLIT_ROAD, OF_ONE_TRACK
    from diffabs.assess.runs import has_two_sides

    try:
        numbers = OF_ONE_TRACK + (OF_A_SPLIT_ROAD if has_two_sides(loop.plant) else ())
    except ValueError as error:
        raise ScenarioError(f"{path}: {error}") from None
    if value == ALL:
        return numbers
    if not isinstance(value, list | tuple):
        raise wrong_kind_error(path, value, f'"{ALL}" or a list of {", ".join(numbers)}')
    return list_reader(choice_reader(*numbers))(value, path)


def write_assess_section(program: "StopProgram | None") -> dict[str, JsonObject]:
    """Return the section by its name, as `read_assess_section` reads it; nothing without a program."""
    return {} if program is None else {"assess": plain_fields(program)}
