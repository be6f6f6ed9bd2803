"""Reading of options that assign a value to a name, such as `--over plant.mass=5.3:6.2`."""

from collections.abc import Iterator, Sequence

from diffabs.host.values import ScenarioError, format_given


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
