"""What is wrong with a part: ranges of its parameters, and what the parts themselves object to.

Parts say it by the methods `problems` (shapes of fields), `rules` (between numbers), `grid_rules` (of an integration
step) and `cautions` (allowed, but hardly meant). Each is asked here, of a part and of all parts in it."""

from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

import numpy as np

from diffabs.core import kinds
from diffabs.core.pytree import Spec, children, parameters
from diffabs.core.rules import Rule
from diffabs.core.units import Units, insert_unit, units_of

T = TypeVar("T")


def find_problems(part: Any, prefix: str = "", units: Units | None = None) -> Iterator[str]:
    """One line for each field that is out of range, then what the parts themselves object to: the shapes of their
    fields (a method `problems`), and if these are right, the rules between their numbers (`rules`)."""
    found = False
    units = units or units_of(getattr(part, "plant", None))
    for name, field, value in children(part, prefix):
        if field is not None and "spec" in field.metadata:
            spec: Spec = field.metadata["spec"].around(units)
            if line := _find_unfit(name, spec, value):
                found = True
                yield line
            elif not spec.holds(value):
                found = True
                yield f"{name} = {_show(value)} is outside {spec.interval()}"
        else:
            within = list(find_problems(value, f"{name}.", units))
            found |= bool(within)
            yield from within
    if not found:
        shapes = list(part.problems()) if hasattr(part, "problems") else []
        yield from (prefix + insert_unit(line, units) for line in shapes or find_broken(_own(part, "rules")))


def part_rules(part: Any, prefix: str = "") -> Iterator[Rule]:
    """Every rule of a part and the parts in it, ranges of fields first: `problems` as arrays, for lanes whose values
    differ. The shapes are taken to be right."""
    for name, spec, value in parameters(part, prefix):
        outside = f"is outside {spec.interval()}"
        line = f"{name} = {{}} {outside}"
        yield Rule(spec.within(value), f"{name} {outside}", lambda line=line, value=value: line.format(_show(value)))
    yield from _below(part, prefix, units_of(getattr(part, "plant", None)), "rules")


def grid_rules(part: Any, step: float, prefix: str = "") -> Iterator[Rule]:
    """What the parts demand of an integration step [s]."""
    yield from _below(part, prefix, units_of(getattr(part, "plant", None)), "grid_rules", step)


def find_broken(rules: Iterable[Rule]) -> Iterator[str]:
    """A line for each rule of concrete numbers that does not hold."""
    yield from (rule.says() for rule in rules if not bool(rule.holds))


def _own(part: Any, hook: str, *args: Any) -> Iterator[Rule]:
    if hasattr(part, hook):
        yield from getattr(part, hook)(*args)


def _below(part: Any, prefix: str, units: Units | None, hook: str, *args: Any) -> Iterator[Rule]:
    for name, field, value in children(part, prefix):
        if field is None or "spec" not in field.metadata:
            yield from _below(value, f"{name}.", units, hook, *args)
    yield from (rule.under(prefix, units) for rule in _own(part, hook, *args))


def find_misshapen(part: Any, prefix: str = "") -> Iterator[str]:
    """One line for each parameter of a single part that is no number, or has another shape than its field. It may be
    traced: values are not looked at."""
    for name, spec, value in parameters(part, prefix):
        if line := _find_unfit(name, spec, value):
            yield line
        elif spec.shape is not None and kinds.value_shape(value) != spec.shape:
            yield f"{name} = {kinds.format_value(value)} has shape {kinds.value_shape(value)}; it needs {spec.shape}"


def _find_unfit(name: str, spec: Spec, value: Any) -> str:
    """A line for what is no number, or empty."""
    line = kinds.find_value_objection(value)
    return line and f"{name} = {kinds.format_value(value)} {line}; a number in {spec.interval()} is needed"


def find_cautions(part: Any, prefix: str = "") -> Iterator[str]:
    """One line for each thing that is allowed but hardly meant: what the parts' methods `cautions` say."""
    for name, field, value in children(part, prefix):
        if field is None or "spec" not in field.metadata:
            yield from find_cautions(value, f"{name}.")
    if hasattr(part, "cautions"):
        yield from (prefix + line for line in part.cautions())


def check_part(part: T, prefix: str = "") -> T:
    """Return `part` if every parameter is in its range.

    prefix: is put before every name in a message, `"plant."`

    Raises:
        ValueError: names every offending field with its value, range and unit. NaN offends.
    """
    lines = list(find_problems(part, prefix))
    if lines:
        raise ValueError("; ".join(lines))
    return part


def _show(value: Any) -> str:
    array = np.asarray(value, float)
    return f"{float(array):g}" if array.ndim == 0 else np.array2string(array, threshold=8, precision=4)
