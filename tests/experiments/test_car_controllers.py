"""The study of car controllers: what its rows must obey whatever the controller, and the stored table."""

import importlib
import json

import numpy as np
import pytest
from project import ROOT
from reports import Page

from diffabs.assess import RuleStop, StopProgram
from diffabs.parts.plants import GRAVITY
from diffabs.parts.roads import Burckhardt

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
    assert len(table) == 8
    for row in table:
        assert row["lost runs"] == 0
        assert min(value for column, value in row.items() if "over least" in column) > 0


def test_the_shortest_distance_on_a_road_is_that_of_its_peak(study):
    """Burckhardt's curve without a factor of the speed has one greatest friction."""
    road = Burckhardt(c1=0.857, c2=33.822, c3=0.347, c4=0.0)
    slip = np.log(0.857 * 33.822 / 0.347) / 33.822
    friction = 0.857 * (1 - np.exp(-33.822 * slip)) - 0.347 * slip
    expected = (25.0**2 - (15 / 3.6) ** 2) / (2 * GRAVITY * friction)
    assert study.shortest_on(road, 90.0) == pytest.approx(expected, rel=1e-5)


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


@pytest.mark.slow
def test_the_page_of_verdicts_has_the_figures_of_the_table(tmp_path):
    """The command of the page, for one controller that meets all clauses and one that does not."""
    verdicts = importlib.import_module("experiments.car_controllers.verdicts")
    names = ("constant torque", "PID of each wheel")
    assessments = verdicts.judge_controllers(names, tmp_path)
    assert [assessment.passed for assessment in assessments.values()] == [0, 1]
    lines = (STORED.parent / "README.md").read_text(encoding="utf-8").splitlines()
    page = [[cell.strip() for cell in line[1:-1].split("|")] for line in lines]
    start = next(i for i, cells in enumerate(page) if cells[0] == "clause")
    columns = [page[start].index(heading) for heading in ("clause", "limit", *names)]
    rows = [page[start], *page[start + 2 : start + 12]]
    assert verdicts.format_table(assessments) == [[cells[column] for column in columns] for cells in rows]
    text = Page((tmp_path / verdicts.PAGE).read_text()).text
    assert "1 of 2 meet all: PID of each wheel." in text
    worst = assessments["constant torque"].clauses[0]
    assert f"constant torque {worst.figure:.6g} at least 0.75 not met {worst.stop}" in text
