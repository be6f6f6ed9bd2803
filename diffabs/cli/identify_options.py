"""Options of the command `identify`: columns of the data and their noise, and ranges of the parameters."""

import pathlib
from collections.abc import Mapping, Sequence

from diffabs.cli import console
from diffabs.cli.options import read_assignments
from diffabs.core.protocols import Plant
from diffabs.core.pytree import ParameterSpec
from diffabs.host.values import ScenarioError, format_given, read_number_in_range, unknown_name_error
from diffabs.scenario import section_tune, toml
from diffabs.scenario.measurements import Readings, loop_columns, read_measurements
from diffabs.scenario.parameter_paths import flatten_table
from diffabs.scenario.scenario import Scenario

DEPENDENT = {"slip", "speed", "wheel_speed"}
REDUNDANT = (
    "slip, speed and wheel_speed depend on each other; together they make the standard deviations too small; choose"
    " columns with --column"
)


def read_renames(options: Sequence[str]) -> dict[str, str]:
    """Return signals by the name of their column in the file."""
    names = {}
    for text in options:
        column, equals, name = (word.strip() for word in text.rpartition("="))
        if not (equals and column and name):
            raise ScenarioError(f"--rename {format_given(text)} is not of the form column=name")
        if column in names:
            raise ScenarioError(f"--rename {format_given(column)} is given twice")
        names[column] = name
    return names


def read_columns(
    data: pathlib.Path,
    names: Sequence[str] | None,
    plant: Plant,
    renamed: Mapping[str, str] | None = None,
    separator: str | None = None,
) -> Readings:
    """Return the columns of a file that are compared. Who names some columns may have others in the file."""
    form = {"renamed": renamed, "separator": separator, "strict": not (names or renamed)}
    readings = read_measurements(data, plant.shows.units, ignored=loop_columns(plant), **form)
    if readings.unread:
        console.say(f"note: not compared: {', '.join(readings.unread)}")
    if readings.infinite and not names:
        console.say(f"note: {', '.join(readings.infinite)} is infinite in every row of the data, and is not compared")
    compared = readings.select(names or (), "--column")
    if set(compared.columns) >= DEPENDENT:
        console.say(f"note: {REDUNDANT}")
    return compared


def read_noise(options: Sequence[str], readings: Readings, units: Mapping[str, str]) -> dict[str, float]:
    """Return standard deviations by column, in SI."""
    deviations: dict[str, float] = {}
    for name, number, _ in read_assignments(options, "--sigma", "column=number"):
        if name not in readings.columns:
            raise unknown_name_error(
                f"--sigma {format_given(name)} is not a column of the data", name, readings.columns
            )
        spec = ParameterSpec(units[name], low=0.0, open_low=True)
        deviations[name] = read_number_in_range(toml.parse_value(number), spec, f"--sigma {name}")
    return deviations


def read_ranges(options: Sequence[str], scenario: Scenario) -> dict[str, section_tune.Ends | None]:
    """Return ranges by path; None for the declared range."""
    table = {}
    for path, ends, text in read_assignments(options, "--free"):
        words = [word.strip() for word in ends.split(":", 1)]
        if not path or ("=" in text and len(words) < 2):
            raise ScenarioError(f"--free {format_given(text)} is not of the form path or path=low:high")
        (path,) = flatten_table({path: 0.0}, "--free")
        if path in table:
            raise ScenarioError(f"--free {path} is given twice")
        table[path] = [*map(toml.parse_value, words)] if "=" in text else section_tune.DECLARED_RANGE
    ranges = section_tune.free_ranges(table, scenario.loop, "--free")
    section_tune.check_starts(scenario.loop, ranges, "--free")
    return ranges
