"""Every old name of a parameter or an argument is refused with its new name, wherever a user may still write it."""

import dataclasses
import inspect

import pytest
from mutants import killed_by

import diffabs as d
from diffabs import controllers, design, linear, reach
from diffabs.core.renamed import RENAMED
from diffabs.host.values import ScenarioError
from diffabs.robust.reach.verification import verify_box
from diffabs.scenario.registry import FAMILIES, family_types
from diffabs.scenario.scenario import load
from diffabs.tune import identify

CLASSES = {type(part).__name__: type(part) for family in FAMILIES for part in family_types(family).values()}
FUNCTIONS = (linear.lqg, design.polytope, identify.gaussian, reach.cover_box, verify_box)
OWNERS = CLASSES | {call.__name__: call for call in FUNCTIONS}
NAMES = [(owner, old, new) for owner, names in RENAMED.items() for old, new in names.items()]


@killed_by("core.pytree", "if cls.__name__ in RENAMED:", "if False:", case="Relay-torque_max-high")
@pytest.mark.parametrize(("owner", "old", "new"), NAMES)
def test_a_call_with_an_old_name(owner, old, new):
    names = inspect.signature(OWNERS[owner]).parameters
    assert (new in names, old in names) == (True, False)
    with pytest.raises(TypeError, match=f"^{owner} has no {old}: it is now {new}$"):
        OWNERS[owner](**{old: 1.0})


def test_a_replaced_field_with_an_old_name():
    with pytest.raises(TypeError, match=r"^Relay has no torque_max: it is now high$"):
        dataclasses.replace(controllers.Relay(), torque_max=1.0)


@killed_by("core.pytree", "new = current_name(name, names)", "new = None")
def test_a_path_with_an_old_name():
    with pytest.raises(KeyError, match=r"no 'torque_max' in controller\.torque_max; it is now high"):
        d.replace(d.braking(controller=controllers.StateFeedback()), {"controller.torque_max": 5.0})


@killed_by("host.values", "if new := current_name(str(name), names):", "if new := None:")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("controller.torque_max=5", "controller.torque_max is not a field of state-feedback; it is now high"),
        ("sweep.over.controller.torque_min=0:1", "it is now controller.low"),
        ("tune.free.controller.torque_max=0:1", "it is now controller.high"),
    ],
)
def test_an_override_with_an_old_name(change, message):
    with pytest.raises(ScenarioError) as refusal:
        load("slip-lmi", [change])
    assert str(refusal.value).endswith(message)


def test_an_old_name_elsewhere_is_an_unknown_name():
    with pytest.raises(ScenarioError, match=r"there is nothing$"):
        load("slip-lmi", ["controller.antiwindup.torque_max=5"])
