"""Frozen dataclasses as tables of TOML or JSON, `{type = "normal", mean = 5.75, deviation = 0.3}`, and back; what
their problems have in common; how they are written in messages."""

import dataclasses
import difflib
import re
import reprlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from diffabs.core.pytree import Spec

FINITE = Spec("1")
POSITIVE = Spec("1", low=0.0, open_low=True)


def kebab(cls: type) -> str:
    """The name of a class in tables: `LogNormal` is `log-normal`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", cls.__name__).lower()


def table(part: Any) -> dict[str, Any]:
    """Type and fields as plain values, without those that are as by default."""
    fields = {f.name: (getattr(part, f.name), f.default) for f in dataclasses.fields(part)}
    kept = {name: _plain(value) for name, (value, default) in fields.items() if value is not default}
    return {"type": kebab(type(part)), **{n: v for n, v in kept.items() if v != fields[n][1]}}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def written(part: Any) -> str:
    """As in messages: `normal(5.75, 0.3, low = 5)`."""
    cells = []
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if field.default is dataclasses.MISSING or value != field.default:
            text = f"{value:g}" if isinstance(value, int | float) else reprlib.repr(_plain(value))
            cells.append(text if field.default is dataclasses.MISSING else f"{field.name} = {text}")
    return f"{kebab(type(part))}({', '.join(cells)})"


def outside(part: Any, name: str, **ranges: Spec) -> Iterator[str]:
    """One line for each of these fields that is not in its range. NaN is not."""
    for field, spec in ranges.items():
        value = getattr(part, field)
        if not spec.holds(value):
            yield f"{name}: {field} = {value:g} is outside {spec.interval()}"


def crossed(part: Any, name: str) -> Iterator[str]:
    """A line if `low` is not below `high`; none for NaN."""
    if part.low >= part.high:
        yield f"{name}: low = {part.low:g} is not below high = {part.high:g}"


def weightless(weights: Sequence[float] | None, count: int, name: str, each: Spec) -> Iterator[str]:
    """Lines on weights that are not as many as what they weigh, not all in `each`, or all zero."""
    if weights is None:
        return
    if len(weights) != count:
        yield f"{name}: weights are {len(weights)}; there are {count} to weigh"
    if not each.holds(np.asarray(weights, float)):
        yield f"{name}: weights = {reprlib.repr(_plain(weights))} are not all in {each.interval()}"
    elif not np.sum(weights) > 0:
        yield f"{name}: weights have sum {np.sum(weights):g}"


def described(kinds: Mapping[str, type], given: Any, where: str, **readers: Callable[[Any, str], Any]) -> Any:
    """The instance of one of these classes that a table describes; `readers`: of fields with types not known here.

    Raises ValueError, in one line, for whatever is wrong with it."""
    if not isinstance(given, Mapping):
        raise wrong(where, given, "a table")
    kind = given.get("type")
    if kind is None:
        raise ValueError(f"{where}.type is missing; there is {', '.join(kinds)}")
    if kind not in list(kinds):
        raise unknown(f"{where}.type = {_brief(kind)} is unknown", kind, kinds)
    fields = {f.name: f for f in dataclasses.fields(kinds[kind])}
    values = {}
    for key, item in given.items():
        if key != "type" and key not in fields:
            raise unknown(f"{where}: {reprlib.repr(key)} is not a field of {kind}", key, fields)
        if key != "type":
            read = readers.get(key) or READERS[fields[key].type]
            values[key] = read(item, f"{where}.{key}")
    for name, field in fields.items():
        if name not in values and field.default is field.default_factory is dataclasses.MISSING:
            raise ValueError(f"{where}.{name} is missing: {kind} needs it")
    made = kinds[kind](**values)
    if lines := list(made.problems(where)):
        raise ValueError("; ".join(lines))
    return made


def unknown(what: str, name: Any, there: Iterable[str]) -> ValueError:
    """An error for a name that is not there, with the nearest one that is."""
    near = difflib.get_close_matches(str(name).lower(), list(there), 1, 0.5)
    hint = f"did you mean {near[0]}? There is" if near else "there is"
    return ValueError(f"{what}; {hint} {', '.join(there) or 'nothing'}")


def wrong(where: str, given: Any, needed: str) -> ValueError:
    """An error for a value of the wrong kind."""
    return ValueError(f"{where} = {_brief(given)} is not {needed}")


def _brief(value: Any) -> str:
    try:
        return reprlib.repr(value)
    except ValueError:  # more digits than Python writes
        return "a number of thousands of digits"


def number(given: Any, where: str) -> float:
    """A number as a float. Raises ValueError for anything else, and for one that is too large."""
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise wrong(where, given, "a number")
    try:
        return float(given)
    except OverflowError:
        raise wrong(where, given, "a number below 1.8e308") from None


def whole(given: Any, where: str) -> int:
    """A whole number. Raises ValueError for anything else."""
    if isinstance(given, bool) or not isinstance(given, int):
        raise wrong(where, given, "a whole number")
    return given


def listed(item: Callable[[Any, str], Any]) -> Callable[[Any, str], tuple[Any, ...]]:
    """A reader of lists whose items this one reads."""

    def read(given: Any, where: str) -> tuple[Any, ...]:
        if not isinstance(given, list | tuple):
            raise wrong(where, given, "a list")
        return tuple(item(value, f"{where}.{i}") for i, value in enumerate(given))

    return read


def text(given: Any, where: str) -> str:
    """A text. Raises ValueError for anything else."""
    if not isinstance(given, str):
        raise wrong(where, given, "text")
    return given


def _switch(given: Any, where: str) -> bool:
    if not isinstance(given, bool):
        raise wrong(where, given, "true or false")
    return given


def _choice(given: Any, where: str) -> float | str:
    return given if isinstance(given, str) else number(given, where)


READERS: dict[Any, Callable[[Any, str], Any]] = {
    float: number,
    int: whole,
    bool: _switch,
    tuple[str, ...]: listed(text),
    tuple[float, ...]: listed(number),
    tuple[float, ...] | None: listed(number),
    tuple[float | str, ...]: listed(_choice),
    tuple[tuple[float, ...], ...]: listed(listed(number)),
}
