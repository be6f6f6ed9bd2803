"""The study of car controllers: what its rows must obey whatever the controller, and the stored table."""

import importlib
import json

import numpy as np
import pytest
from project import ROOT

from diffabs.assess import RuleStop, StopProgram
from diffabs.parts.plants import GRAVITY

STORED = ROOT / "experiments" / "car_controllers" / "numbers.json"


@pytest.fixture(scope="module")
def study():
    return importlib.import_module("experiments.car_controllers.run")


def test_the_shortest_distance_is_that_of_friction(study):
    """v dv = -k g dx from 90 to 15 km/h."""
    stop = RuleStop("lock", 90.0, False, (True, True), (True, True), 1e6)
    speeds = np.linspace(15 / 3.6, 25.0, 100_001)
    expected = np.trapezoid(speeds / (0.3 * GRAVITY), speeds)
    assert study.shortest(stop, StopProgram()) == pytest.approx(expected, rel=1e-9)


def test_no_stored_controller_stops_before_the_shortest_distance():
    table = json.loads(STORED.read_text())["tables"]["table"]
    assert len(table) == 7
    for row in table:
        assert row["lost runs"] == 0
        assert min(row["good, 120 km/h [% over least]"], row["slippery, 55 km/h [% over least]"]) > 0


@pytest.mark.slow
def test_three_cars_give_the_ranks_of_the_table(study):
    """With select-low the car turns less on a split road, and needs more distance."""
    names = ("PID of each wheel", "PID, select-low at the rear")
    config = study.Config(cars=3, controllers=names)
    cars = study.draw_cars(config)
    each, low = (study.judge(config, name, study.list_controllers(config)[name](), cars) for name in names)
    assert low["split: yaw [rad]"] < 0.5 * each["split: yaw [rad]"]
    assert low["split: distance [m]"] > each["split: distance [m]"]
    stored = {row["controller"]: row for row in json.loads(STORED.read_text())["tables"]["table"]}
    for row in (each, low):
        assert row["lost runs"] == 0
        for column in ("good, 120 km/h [% over least]", "slippery, 55 km/h [% over least]"):
            assert row[column] == pytest.approx(stored[row["controller"]][column], rel=0.1)
