"""Validity of a part: ranges of its parameters, and the conditions that the parts declare themselves.

Parts declare conditions by the methods `problems` (shapes and static fields), `rules` (between numbers), `grid_rules`
(on the integration step) and `cautions` (allowed, but hardly intended). The functions here evaluate them for a part and
for all parts in it.
"""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any, TypeVar

import jax
import numpy as np

from diffabs.core import kinds
from diffabs.core.pytree import ParameterSpec, children, parameters, stack_lists
from diffabs.core.rules import Rule
from diffabs.core.types import Scalar
from diffabs.core.units import Units, insert_unit, units_inside, units_of

T = TypeVar("T")


def find_problems(part: object, prefix: str = "", units: Units | None = None) -> Iterator[str]:
    """Yield one line for each field that is out of range, and for each condition of the parts that fails.

    For each part, four groups are checked in order: its numbers and the parts in it, the shapes of its numbers, its
    `problems`, its `rules`. The lines are those of the first group with a fault.
    """
    has_fault, shapes = False, []
    units = units or units_of(getattr(part, "plant", None))
    for name, field, value in children(part, prefix):
        if field is not None and "spec" in field.metadata:
            spec: ParameterSpec = field.metadata["spec"].around(units)
            if line := _find_unfit(name, spec, value):
                has_fault = True
                yield line
            elif not spec.holds(value):
                has_fault = True
                yield f"{name} = {_show(value)} is outside {spec.interval()}"
            elif line := _find_wrong_shape(spec, value):
                shapes.append(f"{field.name} {line}")
        else:
            within = list(find_problems(value, f"{name}.", units_inside(part, name.removeprefix(prefix), units)))
            has_fault |= bool(within)
            yield from within
    if not has_fault:
        shapes = shapes or list(_from_hook(part, "problems"))
        yield from (prefix + insert_unit(line, units) for line in shapes or find_broken(_from_hook(part, "rules")))


def part_rules(part: object, prefix: str = "") -> Iterator[Rule]:
    """Yield every rule of a part and of the parts in it, first the ranges of fields.

    These are the ranges and rules of `find_problems` in array form, for runs with different values. Only `problems` is
    missing, so the shapes must be correct.
    """
    for name, spec, value in parameters(part, prefix):
        outside = f"is outside {spec.interval()}"
        line = f"{name} = {{}} {outside}"
        # The defaults bind the values of this iteration; the lambda is called after the loop.
        yield Rule(spec.within(value), f"{name} {outside}", lambda line=line, value=value: line.format(_show(value)))
    yield from _below(part, prefix, units_of(getattr(part, "plant", None)), "rules")


def grid_rules(part: object, step: float, prefix: str = "") -> Iterator[Rule]:
    """Yield the rules of the parts on an integration step [s]."""
    yield from _below(part, prefix, units_of(getattr(part, "plant", None)), "grid_rules", step)


def find_broken(rules: Iterable[Rule]) -> Iterator[str]:
    """Yield a line for each rule that does not hold; the rules have concrete numbers."""
    yield from (rule.says() for rule in rules if not bool(rule.holds))


def _from_hook(part: object, hook: str, *args: object) -> Iterator[Any]:
    """Yield the rules or lines from a method of this part alone."""
    if hasattr(part, hook):
        yield from getattr(part, hook)(*args)


def _below(part: object, prefix: str, units: Units | None, hook: str, *args: object) -> Iterator[Any]:
    """Yield the rules or lines from a method of the part and of the parts in it, the innermost first."""
    for name, field, value in children(part, prefix):
        if field is None or "spec" not in field.metadata:
            yield from _below(value, f"{name}.", units_inside(part, name.removeprefix(prefix), units), hook, *args)
    for finding in _from_hook(part, hook, *args):
        yield finding.under(prefix, units) if isinstance(finding, Rule) else prefix + insert_unit(finding, units)


def find_misshapen(part: object, prefix: str = "") -> Iterator[str]:
    """Yield one line for each parameter of the wrong type or shape in an unbatched part, or else its `problems`.

    The values may be traced.
    """
    lines = []
    for name, spec, value in parameters(part, prefix):
        if line := _find_unfit(name, spec, value):
            lines.append(line)
        elif line := _find_wrong_shape(spec, value):
            lines.append(f"{name} = {kinds.format_value(value)} {line}")
    with suppress(jax.errors.JAXTypeError):  # `problems` that need the value of a traced number
        yield from lines or _below(stack_lists(part), prefix, units_of(getattr(part, "plant", None)), "problems")


def _find_unfit(name: str, spec: ParameterSpec, value: Scalar) -> str:
    """Return a line for a value that is not a number of a run, or an empty text."""
    line = kinds.find_value_objection(value)
    return line and f"{name} = {kinds.format_value(value)} {line}; a number in {spec.interval()} is needed"


def _find_wrong_shape(spec: ParameterSpec, value: Scalar) -> str:
    """Return the end of a line for a value of another shape than its field, or an empty text."""
    shape = kinds.value_shape(value)
    return "" if spec.shape in (None, shape) else f"has shape {shape}; it needs {spec.shape}"


def find_cautions(part: object, prefix: str = "") -> Iterator[str]:
    """Yield one line for each setting that is allowed but hardly intended (`cautions`)."""
    yield from _below(part, prefix, None, "cautions")


def check_part(part: T, prefix: str = "") -> T:
    """Return `part` if `find_problems` finds nothing, or else raise a ValueError of all its lines."""
    lines = list(find_problems(part, prefix))
    if lines:
        raise ValueError("; ".join(lines))
    return part


def _show(value: Scalar) -> str:
    array = np.asarray(value, float)
    return f"{float(array):g}" if array.ndim == 0 else np.array2string(array, threshold=8, precision=4)
