"""Reading of options that assign a value to a name, such as `--over plant.mass=5.3:6.2`."""

from collections.abc import Iterator, Sequence

from diffabs.core.types import JsonObject
from diffabs.host.separated import read_decimal
from diffabs.host.values import ScenarioError, format_given
from diffabs.scenario.parameter_paths import BoxSide, read_box
from diffabs.scenario.scenario import Scenario


def read_assignments(texts: Sequence[str], option: str, form: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield name, value and the whole text of each `NAME=VALUE`. The value is empty without `=`.

    With a `form`, for messages, both must be there. No name may come twice.
    """
    names = set()
    for text in texts:
        name, equals, value = (word.strip() for word in text.partition("="))
        if form and not (equals and name):
            raise ScenarioError(f"{option} {format_given(text)} is not of the form {form}")
        if name in names:
            raise ScenarioError(f"{option} {name} is given twice")
        names.add(name)
        yield name, value, text


def read_sides(options: Sequence[str], scenario: Scenario) -> list[BoxSide]:
    """Return the range of each parameter of --over."""
    table: JsonObject = {}
    for path, ends, text in read_assignments(options, "--over"):
        low, _, high = ends.partition(":")
        try:
            table[path] = [read_decimal(low), read_decimal(high)]
        except ValueError:
            raise ScenarioError(f"--over {format_given(text)} is not of the form path=low:high") from None
    return read_box(table, "--over", scenario.loop)
