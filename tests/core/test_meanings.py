"""Every parameter of every part says what it is, once; and one name is one thing, in one unit, in all parts."""

import collections
import dataclasses
import inspect
import re
import sys
import types

import pytest
from mutants import killed_by

import diffabs as d
from diffabs import controllers, linear
from diffabs.core import meanings as meanings_module
from diffabs.core.meanings import field_meanings
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar
from diffabs.scenario.registry import FAMILIES, describe_part, family_types

OTHERS = [linear.SlipModel, linear.LowPass, linear.Sampling]
CLASSES = {type(part) for family in FAMILIES for part in family_types(family).values()} | set(OTHERS)

# Names with several units, and why.
UNITS = {
    "band": "half a width, of what the part compares",
    "gain": "of the part's own law, which its class states",
    "growth": "of a torque, and of an uncertainty",
    "high": "a motor's control is a voltage",
    "q": "the letter of a weight in control, and of the exponent in the paper's curve",
    "r": "the letter of a weight in control",
    "radius": "of a wheel, and of a set of states",
    "rate": "of the part's own signal",
    "slip_low": "a reference sets a slip, a controller sees its loop's signal",
    "slip_high": "a reference sets a slip, a controller sees its loop's signal",
    "value": "of a constant block, in the unit of its output",
}
# Names with several meanings besides, and why: names of channels, which a sensor, a start or a stop applies to, and
# words that the class in which they stand completes.
MEANINGS = {
    **dict.fromkeys(("slip", "speed", "wheel_speed", "deceleration", "theta", "psi"), "a channel"),
    **dict.fromkeys(("rise", "fall"), "a direction: the time of a lag, or of a delay"),
    "noise": "its deviation, or its values",
    "threshold": "of the part's own comparison",
    "torque": "that of a constant control, or at the start",
    "slip_low": "an edge of the slip",
    "slip_high": "an edge of the slip",
}


def table():
    """Return (unit, meaning, class) of every parameter of every part, by name, sorted."""
    rows = collections.defaultdict(list)
    for cls in CLASSES:
        for field in dataclasses.fields(cls):
            if "spec" in field.metadata:
                meaning = field_meanings(cls).get(field.name, "")
                rows[field.name].append((field.metadata["spec"].unit, meaning, cls.__name__))
    return {name: sorted(rows[name]) for name in sorted(rows)}


TABLE = table()


@killed_by("parts.actuators.lag", '    """Lower limit of the control."""\n', "")
def test_every_parameter_has_a_meaning():
    """One sentence or two, without the unit and the range that the field declares."""
    assert len(TABLE) > 100
    texts = {f"{cls}.{name}": meaning for name, rows in TABLE.items() for _, meaning, cls in rows}
    assert {path: text for path, text in texts.items() if not re.fullmatch(r"[A-Z(|].*\.", text)} == {}
    assert {path: text for path, text in texts.items() if re.search(r" \[[^\]]+\]", text)} == {}


@killed_by("parts.actuators.valve", 'default=0.0, unit="control"', 'default=0.0, unit="1"')
def test_a_name_has_one_unit():
    several = {name: rows for name, rows in TABLE.items() if len({unit for unit, _, _ in rows}) > 1}
    assert {name: rows for name, rows in several.items() if name not in UNITS} == {}
    assert set(several) == set(UNITS)  # no reason stands without need


@killed_by("parts.actuators.lag", '"""Lower limit of the control."""', '"""Least value of the command."""')
def test_a_name_has_one_meaning():
    """The first two words say what it is; the rest may say of which part."""
    heads = {
        name: {" ".join(re.findall(r"\w+", meaning)[:2]) for _, meaning, _ in rows} for name, rows in TABLE.items()
    }
    several = {name for name, words in heads.items() if len(words) > 1}
    assert {name: TABLE[name] for name in several - MEANINGS.keys() - UNITS.keys()} == {}
    assert set(MEANINGS) <= several


@killed_by("parts.controllers.torque_logic", "    high: Scalar", "    torque_max: Scalar")
def test_a_limit_is_low_or_high():
    """The current of a motor has a greatest size; it is no control."""
    assert {unit for name in ("low", "high") for unit, _, _ in TABLE[name]} == {"control", "V"}
    assert [name for name in TABLE if re.search(r"(^|_)(min|max|least|greatest)(_|$)", name)] == ["current_max"]


def test_help_has_meaning_and_range_of_every_field():
    lines = inspect.getdoc(controllers.PID).splitlines()
    assert "    b: Set-point weight of the proportional part. In [0, inf)." in lines
    assert "    antiwindup: Anti-windup strategy of the integral." in lines
    assert "    every: A trajectory keeps every `every`-th instant." in inspect.getdoc(d.FixedStep).splitlines()


def test_a_list_has_the_meaning():
    assert describe_part("actuator", d.actuators.Limits())["low"]["meaning"] == "Lower limit of the control."


@killed_by("core.meanings", "reversed(cls.__mro__)", "(cls,)")
def test_a_field_of_a_base_keeps_its_meaning():
    class Slower(d.actuators.Lag):
        pass

    assert field_meanings(Slower) == {"time_constant": "Time constant of the control."}


@killed_by("core.meanings", "except (KeyError, OSError, TypeError, SyntaxError):", "except (TypeError, SyntaxError):")
@pytest.mark.parametrize("module", [{}, {"__file__": None}, {"__file__": "/gone.py"}], ids=["none", "typed", "gone"])
def test_a_class_without_source_has_no_meanings(module, monkeypatch):
    if module:
        monkeypatch.setitem(sys.modules, "typed_in", types.ModuleType("typed_in"))
        vars(sys.modules["typed_in"]).update(module)
    scope = {"__name__": "typed_in", "pytree": pytree, "param": param, "Scalar": Scalar}
    exec('@pytree\nclass Typed:\n    """Typed in."""\n    x: Scalar = param(default=1.0, unit="m")\n', scope)
    assert field_meanings(scope["Typed"]) == {}
    assert inspect.getdoc(scope["Typed"]) == "Typed in.\n\nAttributes:\n    x: In (-inf, inf) m."


@killed_by("core.meanings", "@functools.cache\ndef _meanings_by_class", "def _meanings_by_class")
def test_a_module_is_parsed_once_for_all_its_classes():
    class First:
        x: int
        """Read first."""

        class Inner:
            y: int
            """Read inside."""

    class Second:
        x: int
        """Read second."""

    meanings_module._meanings_by_class.cache_clear()
    meanings = [field_meanings(cls) for cls in (First, First.Inner, Second)]
    assert meanings == [{"x": "Read first."}, {"y": "Read inside."}, {"x": "Read second."}]
    assert meanings_module._meanings_by_class.cache_info().misses == 1


@pytest.mark.parametrize("cls", [controllers.PID, d.FixedStep])
def test_a_part_is_made_without_reading_its_source(cls, monkeypatch):
    monkeypatch.setattr(inspect, "findsource", lambda _: pytest.fail("the source was read"))
    assert dataclasses.replace(cls()) is not None
