"""Input from TOML, JSON or the command line: values are read once or refused in one line. Also the conversion back.

A table becomes a dataclass. The fields of the dataclass declare their readers, by `table_field(read, default)` or by
their type. A reader takes the given value and its path for messages, and returns the value.
"""

import dataclasses
import datetime
import difflib
import json
import math
import numbers
import re
import reprlib
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

import numpy as np

from diffabs.core.channels import Channels
from diffabs.core.pytree import ParameterSpec
from diffabs.core.renamed import current_name
from diffabs.core.types import Part, PyTree, Scalar
from diffabs.host.separated import read_decimal

FINITE_SPEC = ParameterSpec("1")
POSITIVE_SPEC = ParameterSpec("1", low=0.0, open_low=True)
SECONDS = {"s": 0, "ms": -3, "us": -6}  # powers of ten
RADIANS = {"rad": 1.0, "deg": math.pi / 180}
MIN_LIKENESS = 0.5  # least likeness of two names, of which one is probably a misspelling of the other
PLAIN_TYPES = (str, bool, int, float, type(None))

T = TypeVar("T")
Reader = Callable[[Any, str], Any]


class ScenarioError(ValueError):
    """A value that cannot be used, or whose part cannot be used; the message is one line for a person."""

    def __init__(self, message: str):
        """Set the `message`, joined to one line."""
        super().__init__(" ".join(message.split()))


def kebab_case(name: str) -> str:
    """Return the name in tables: `QuarterCar`, `PID`, `RIG_UNROUNDED` are `quarter-car`, `pid`, `rig-unrounded`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z]{2})(?=[A-Z][a-z])", "-", name).replace("_", "-").lower()


def dotted_path(path: str, key: str) -> str:
    """Return the path of a key below another path, in a form for messages."""
    key = key if re.fullmatch(r"[\w-]{1,60}", key) else format_given(key)
    return f"{path}.{key}" if path else key


def format_given(value: object, length: int = 60) -> str:
    """Return a value from TOML, JSON or the command line for a message: on one line, of bounded length."""
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, float) or (isinstance(value, int) and abs(value) < 10**15):
        return f"{value:.15g}" if not isinstance(value, bool) else str(value).lower()
    try:
        text = json.dumps(value, ensure_ascii=True) if isinstance(value, str) else repr(value)
    except (ValueError, RecursionError):  # more digits than Python converts, or deeper nesting than its recursion limit
        text = "a number of thousands of digits" if isinstance(value, int) else "something nested too deeply"
    return text if len(text) <= length else f"{text[: length - 3]}..."


def unknown_name_error(beginning: str, name: object, names: Iterable[str]) -> ScenarioError:
    """Return the error for an unknown name, with its new name if it has one, else with the nearest existing name."""
    names = list(names)
    if new := current_name(str(name), names):
        return ScenarioError(f"{beginning}; it is now {new}")
    near = _find_near_name(str(name), names)
    hint = f"did you mean {near}? There is" if near else "there is"
    return ScenarioError(f"{beginning}; {hint} {', '.join(names) or 'nothing'}")


def _find_near_name(name: str, names: list[str]) -> str | None:
    """Return the existing name that is probably meant: that of a part inside, or one with a similar last word."""
    words = name.split(".")
    for path in names:
        remaining = iter(path.split("."))
        # `in` moves `remaining` on, so the words are in this order.
        if len(words) > 1 and all(word in remaining for word in words):
            return path
    # Paths to the fields of one part begin alike. Only their last words show whether one is meant.
    last = difflib.SequenceMatcher(b=words[-1].lower())

    def is_similar(path: str) -> bool:
        last.set_seq1(path.rpartition(".")[2].lower())
        return last.ratio() >= MIN_LIKENESS

    alike = [path for path in names if len(words) == 1 or is_similar(path)]
    return next(iter(difflib.get_close_matches(name.lower(), alike, 1, MIN_LIKENESS)), None)


def wrong_kind_error(path: str, value: object, needed: str) -> ScenarioError:
    """Return the error for a value of the wrong kind."""
    kinds = ((bool, "a boolean"), (str, "text"), ((int, float), "a number"), (list, "a list"), (dict, "a table"))
    kinds = (*kinds, (datetime.date | datetime.time, "a date or time"), (type(None), "nothing"))
    kind = next((name for of, name in kinds if isinstance(value, of)), f"of type {type(value).__name__}")
    return ScenarioError(f"{path} = {format_given(value)} is {kind}; {needed} is needed")


def read_number(value: object, spec: ParameterSpec, path: str) -> float:
    """Return a number as a float, without a check of its range, which the messages show."""
    # bool is a subclass of int, so it is excluded first.
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise wrong_kind_error(path, value, f"a number in {spec.interval()}")
    try:
        return float(value)
    except OverflowError:
        raise ScenarioError(f"{path} = {format_given(value)} is too large for a number in {spec.interval()}") from None


def read_number_in_range(value: object, spec: ParameterSpec, path: str) -> float:
    """Return a number as a float."""
    number = read_number(value, spec, path)
    if not spec.holds(number):
        raise ScenarioError(f"{path} = {format_given(number)} is outside {spec.interval()}")
    return number


def read_whole(value: Scalar, low: int, high: int, path: str) -> int:
    """Return a whole number."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise wrong_kind_error(path, value, f"a whole number in [{low}, {high}]")
    number = int(value)
    if not low <= number <= high:
        raise ScenarioError(f"{path} = {format_given(value)} is outside [{low}, {high}]")
    return number


def read_time(text: str, path: str) -> float:
    """Return the time [s] of a text such as `5 ms`; without a unit it is in seconds."""
    words = text.split()
    try:
        power = SECONDS[words[1]] if len(words) == 2 else 0
        value = read_decimal(words[0])
        return float(f"{value!r}e{power}") if len(words) <= 2 and "e" not in repr(value) else value * 10.0**power
    except (IndexError, KeyError, ValueError):
        raise ScenarioError(f'{path} = {format_given(text)}: a time is needed, as in "5 ms"') from None


def read_angle(text: str, path: str) -> float:
    """Return the angle [rad] of a text such as `40 deg`; without a unit it is in radians."""
    number, _, unit = text.strip().partition(" ")
    try:
        return read_decimal(number) * RADIANS[unit.strip() or "rad"]
    except (KeyError, ValueError):
        raise ScenarioError(f'{path} = {format_given(text)}: an angle is needed, as in "40 deg"') from None


def whole_reader(low: int, high: int) -> Reader:
    """Return the reader of whole numbers in a range."""
    return lambda value, path: read_whole(value, low, high, path)


def range_reader(spec: ParameterSpec) -> Reader:
    """Return the reader of numbers in a range."""
    return lambda value, path: read_number_in_range(value, spec, path)


def text_or_number_reader(read: Callable[[str, str], float], spec: ParameterSpec) -> Reader:
    """Return the reader of a number in a range, or of a text that `read` turns into one."""
    return lambda value, path: read_number_in_range(read(value, path) if isinstance(value, str) else value, spec, path)


def choice_reader(*names: str) -> Reader:
    """Return the reader of one of several texts."""

    def read(value: object, path: str) -> str:
        if not isinstance(value, str):
            raise wrong_kind_error(path, value, f"one of {', '.join(names)}")
        if value not in names:
            raise unknown_name_error(f"{path} = {format_given(value)} is unknown", value, names)
        return value

    return read


def list_reader(item: Reader) -> Reader:
    """Return the reader of lists, which it returns as tuples."""

    def read(values: object, path: str) -> tuple[PyTree, ...]:
        if not isinstance(values, list | tuple):
            raise wrong_kind_error(path, values, "a list")
        return tuple(item(value, f"{path}.{i}") for i, value in enumerate(values))

    return read


def table_reader(item: Reader, contents: str = "") -> Reader:
    """Return the reader of tables with any keys."""

    def read(table: object, path: str) -> dict[str, PyTree]:
        if not isinstance(table, Mapping):
            raise wrong_kind_error(path, table, f"a table of {contents}" if contents else "a table")
        return {key: item(value, dotted_path(path, key)) for key, value in table.items()}

    return read


def read_as_given(value: Scalar, path: str) -> Scalar:
    """Return the value unchanged."""
    del path
    return value


def read_text(value: object, path: str) -> str:
    """Return a text."""
    if not isinstance(value, str):
        raise wrong_kind_error(path, value, "text")
    return value


def read_printable_line(value: object, path: str) -> str:
    """Return a text that is one printable line."""
    line = read_text(value, path)
    if not line.isprintable():
        raise ScenarioError(f"{path} = {format_given(line)} is outside one line of printable characters")
    return line


def read_printable_lines(value: object, path: str) -> str:
    """Return a text of printable lines."""
    text = read_text(value, path)
    if not all(line.isprintable() for line in text.split("\n")):
        raise ScenarioError(f"{path} = {format_given(text)} is outside lines of printable characters")
    return text


def make_printable(text: str) -> str:
    """Return a text as one printable line, with a replacement character for each unprintable character."""
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)


def read_switch(value: object, path: str) -> bool:
    """Return true or false."""
    if not isinstance(value, bool):
        raise wrong_kind_error(path, value, "true or false")
    return value


def read_any_number(value: object, path: str) -> float:
    """Return any number, also NaN and infinity, as a float."""
    return read_number(value, FINITE_SPEC, path)


def _choice(value: object, path: str) -> float | str:
    """Return a text unchanged, or a number as a float."""
    return value if isinstance(value, str) else read_any_number(value, path)


def _read_names(value: object, path: str) -> str | tuple[PyTree, ...]:
    """Return a text, or texts in lists that are nested to any depth, as tuples."""
    return list_reader(_read_names)(value, path) if isinstance(value, list | tuple) else read_text(value, path)


READER_BY_TYPE: dict[PyTree, Reader] = {
    tuple: list_reader(_read_names),
    Channels: lambda table, path: Channels(table_reader(read_text, "an output for each control")(table, path)),
    float: read_any_number,
    bool: read_switch,
    str: read_text,
    tuple[str, ...]: list_reader(read_text),
    tuple[float, ...]: list_reader(read_any_number),
    tuple[float, ...] | None: list_reader(read_any_number),
    tuple[float | str, ...]: list_reader(_choice),
}


def table_field(read: Reader, default: object = dataclasses.MISSING) -> Any:
    """Return the field of a dataclass with this reader; a default that can be called makes a new value each time."""
    if isinstance(default, type | types.FunctionType):
        return dataclasses.field(default_factory=default, metadata={"read": read})
    return dataclasses.field(default=default, metadata={"read": read})


def read_table(cls: type[T], table: object, path: str, kind: str = "", **readers: Reader) -> T:
    """Return the instance of a dataclass that a table describes.

    Args:
        readers: Readers by name of a field, in place of the one that the field declares.
    """
    fields = {field.name: field for field in dataclasses.fields(cls)}  # pyright: ignore[reportArgumentType]  # a dataclass
    if not isinstance(table, Mapping):
        raise wrong_kind_error(path, table, f"a table of {', '.join(fields)}")
    values = {}
    for key, item in table.items():
        if key not in fields:
            raise unknown_name_error(f"{dotted_path(path, key)} is not a field of {kind or path}", key, fields)
        values[key] = (readers.get(key) or _reader(fields[key]))(item, dotted_path(path, key))
    for name, field in fields.items():
        if name not in values and field.default is field.default_factory is dataclasses.MISSING:
            raise ScenarioError(f"{dotted_path(path, name)} is missing: {kind or path} needs it")
    return cls(**values)


def _reader(field: dataclasses.Field[Any]) -> Reader:
    """Return the reader of a field: of its range, its own, or of its type."""
    spec = field.metadata.get("spec")
    return range_reader(spec) if spec else field.metadata.get("read") or READER_BY_TYPE[field.type]


def find_field_faults(part: Part, name: str) -> Iterator[str]:
    """Yield an error for each field of a dataclass that its reader refuses."""
    for field in dataclasses.fields(part):
        try:
            _reader(field)(getattr(part, field.name), f"{name}: {field.name}")
        except ScenarioError as error:
            yield str(error)


def read_one(kinds: Mapping[str, type[T]], value: object, path: str, **readers: Reader) -> T:
    """Return an instance of one of several dataclasses, from a table with a key `type` or from the type's name alone.

    Args:
        readers: Readers by name of a field, in place of the one that the field declares.
    """
    table = {"type": value} if isinstance(value, str) else value
    if not isinstance(table, Mapping):
        raise wrong_kind_error(path, value, f"a table, or the name of a type ({', '.join(kinds)}),")
    if "type" not in table:
        raise ScenarioError(f"{path}.type is missing; there is {', '.join(kinds)}")
    kind = choice_reader(*kinds)(table["type"], f"{path}.type")
    return read_table(kinds[kind], {k: v for k, v in table.items() if k != "type"}, path, kind, **readers)


def check_sound(part: Part, name: str) -> PyTree:
    """Return the part unchanged if its method `problems(name)` reports no errors; the message contains all of them."""
    if lines := list(part.problems(name)):
        raise ScenarioError("; ".join(lines))
    return part


def as_plain(value: object, *, brief: bool = False) -> PyTree:
    """Return a value as TOML and JSON represent it: parts as tables, their numbers at full precision.

    With `brief`, tables omit fields with their default values.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {"type": kebab_case(type(value).__name__), **plain_fields(value, brief=brief)}
    if isinstance(value, Mapping):
        return {key: as_plain(item, brief=brief) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [as_plain(item, brief=brief) for item in value]
    return value if type(value) in PLAIN_TYPES else np.asarray(value).tolist()


def plain_fields(part: Part, *, brief: bool = False) -> dict[str, PyTree]:
    """Return the fields of a dataclass by name, converted by `as_plain`.

    Args:
        brief: Whether to omit fields with their default values. A field whose default comes from a function always
            stays.
    """
    values = {}
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if brief and field.default is not dataclasses.MISSING and as_plain(value) == as_plain(field.default):
            continue
        if field.metadata.get("named") and isinstance(value, dict):
            values |= as_plain(value, brief=brief)
            continue
        values[field.name] = (
            np.asarray(value, float).tolist() if "spec" in field.metadata else as_plain(value, brief=brief)
        )
    return values


def format_table(part: Part) -> str:
    """Return a dataclass as text for messages: `normal(5.75, 0.3, low = 5)`."""
    cells = []
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if field.default is dataclasses.MISSING or value != field.default:
            cell = f"{value:g}" if isinstance(value, int | float) else reprlib.repr(as_plain(value))
            cells.append(cell if field.default is dataclasses.MISSING else f"{field.name} = {cell}")
    return f"{kebab_case(type(part).__name__)}({', '.join(cells)})"
