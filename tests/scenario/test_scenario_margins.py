"""Margins of a scenario, here and over its ranges."""

import json

import pytest
from mutants import killed_by

from diffabs.scenario import load
from diffabs.scenario.robustness import examine_margins


@killed_by("scenario.robustness", "if path not in values", "if True")
@killed_by("scenario.robustness", "loop = replace(scenario.loop, values)", "loop = scenario.loop")
def test_a_fixed_value_replaces_the_loops_own_and_its_range() -> None:
    scenario = load("slip-cured", integrated=False)
    fixed = {"initial.speed": 5.0}
    margins = examine_margins(scenario, fixed, samples=3)
    record = json.loads(json.dumps(margins.record()))
    assert (record["at"], list(record["over"])) == (fixed, ["plant.mass"])
    assert (record["corners"], len(record["systems"])) == (2, 5)
    assert record["worst"]["delay"]["value"] <= record["margins"]["delay"]
    assert record["period"] == scenario.loop.controller.period
    own = examine_margins(scenario, {**fixed, "plant.mass": 5.3})
    assert (own.band.record()["systems"], own.over) == ([], {})
    assert own.nominal.margins.delay != pytest.approx(examine_margins(scenario, samples=0).nominal.margins.delay)
