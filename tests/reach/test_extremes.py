"""The extreme runs of a box: a small grid, and its greatest values with their places."""

from typing import NoReturn

import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs.robust.reach.extremes import ExtremeRuns, find_extreme_runs
from diffabs.scenario.scenario import load


@killed_by("robust.reach.extremes", "if n**wide <= MAX_RUNS)", "if True)", case="7-1-128")
@killed_by("robust.reach.extremes", "n > 1 and is_wide(ends)", "n > 1", case="1-1-9")
@killed_by("robust.reach.extremes", "n > 1 and is_wide(ends)", "is_wide(ends)", case="10-0-1")
@pytest.mark.parametrize(("wide", "pinned", "count"), [(1, 1, 9), (3, 1, 125), (4, 0, 625), (7, 1, 128), (10, 0, 1)])
def test_few_runs_of_a_box_are_simulated(wide: int, pinned: int, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The runs are a grid of at most 1,000; a single value, also 0, has one."""
    sizes: list[int] = []

    def count_runs(loop: d.Loop, batch: d.Batch, *rest: object) -> NoReturn:
        sizes.append(batch.size)
        assert np.median(batch.values["plant.mass"]) == 2.5  # a single run is in the middle
        assert not np.any(batch.values.get("initial.slip", 0.0))
        raise InterruptedError

    monkeypatch.setattr("diffabs.robust.reach.extremes.run_batch", count_runs)
    road = (f"road.{name}" for name in ("w1", "w2", "w3", "w4", "a"))
    plant = ("mass", "wheel_radius", "body_radius", "wheel_inertia", *road)
    names = [*(f"plant.{name}" for name in plant), "initial.speed"]
    over = dict.fromkeys(names[:wide], (2.0, 3.0)) | dict.fromkeys(["initial.slip"][:pinned], (0.0, 0.0))
    scenario = load("slip-lmi")
    with pytest.raises(InterruptedError):
        find_extreme_runs(scenario.loop, scenario.solver, over)
    assert sizes == [count]


MASSES_AND_SPEEDS = {"plant.mass": (5.3, 6.2), "initial.speed": (5.0, 6.0)}


@killed_by("robust.reach.extremes", "np.nanargmax(column)", "np.nanargmin(column)")
@killed_by("robust.reach.extremes", "np.nanmin(columns[name])", "np.nanmax(columns[name])")
@pytest.mark.slow
def test_the_fastest_brake_needs_the_longest_way() -> None:
    scenario = load("slip-lmi", ["solver.duration=3"], integrated=False)
    extremes = find_extreme_runs(scenario.loop, scenario.solver, MASSES_AND_SPEEDS)
    assert extremes.worst["stop_distance"] == [5.3, 6.0]
    least, greatest = extremes.ranges["stop_distance"]
    assert 0 < least < greatest


@pytest.mark.slow
def test_the_extremes_are_those_of_single_runs_at_the_ends_of_the_box() -> None:
    scenario = load("slip-lmi", ["solver.duration=3"])
    extremes = find_extreme_runs(scenario.loop, scenario.solver, MASSES_AND_SPEEDS)
    for end, (mass, speed) in zip(extremes.ranges["stop_distance"], ((6.2, 5.0), (5.3, 6.0)), strict=True):
        loop = d.replace(scenario.loop, {"plant.mass": mass, "initial.speed": speed})
        distance = d.measure(loop, scenario.solver, scenario.objectives).metrics["stop_distance"]
        assert end == pytest.approx(float(distance), rel=1e-4)


@killed_by("robust.reach.extremes", "dict.fromkeys(map(tuple, self.worst.values()))", "map(tuple, self.worst.values())")
def test_a_run_that_is_worst_twice_is_one_point() -> None:
    extremes = ExtremeRuns({}, {"stop_time": [6.2], "stop_distance": [6.2], "greatest slip": [5.3]})
    assert extremes.points == [[6.2], [5.3]]


def test_a_plant_that_is_no_brake_has_no_extreme_runs() -> None:
    scenario = load("arm-hanging")
    assert find_extreme_runs(scenario.loop, scenario.solver, {}) == ({}, {})
