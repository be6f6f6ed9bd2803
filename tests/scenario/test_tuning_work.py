"""What [tune] says, as arguments of the library, and the constraints of a result in words."""

from typing import Any

from mutants import killed_by

from diffabs.scenario.scenario import load
from diffabs.scenario.tuning import Work, build_method, describe_unmet


@killed_by("scenario.tuning", "starts=goal.starts, seed=goal.seed", "starts=goal.starts")
@killed_by("scenario.tuning", "Stopping(iterations=goal.iterations)", "Stopping()")
def test_the_section_sets_the_method() -> None:
    scenario = load("arm-hanging", ["tune.starts=3", "tune.seed=7", "tune.iterations=11"])
    batch: Any = None
    method = build_method(Work(scenario, batch, {}, None))
    assert (method.starts, method.seed, method.stopping.iterations) == (3, 7, 11)


@killed_by("scenario.tuning", 'for row in rows if not row["met"]', "for row in rows")
def test_only_constraints_that_are_not_met_are_named() -> None:
    rows = [
        {"name": "overshoot", "met": False, "missed": 0.1, "bound": 0.2},
        {"name": "iae", "met": True, "missed": 0.0, "bound": 1.0},
        {"name": "damping", "met": False, "missed": None, "bound": 0.7},
    ]
    assert describe_unmet(rows) == "overshoot by 0.1 (50 %), damping not known"
    assert describe_unmet(rows[1:2]) == ""
