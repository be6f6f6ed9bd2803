"""Panels of a plant with several wheels: signals of one quantity share a panel, and the path is seen from above."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from mutants import killed_by
from scipy.optimize import minimize_scalar

from diffabs.core.messages import Sample, tracked_outputs
from diffabs.output.explore import charts, curves, path_chart
from diffabs.output.explore.path import OUTLINES, PATH_RATIO, trace_path
from diffabs.parts.plants import Car, HalfCar
from diffabs.parts.plants.car import CarControls, CarOutput
from diffabs.parts.plants.half_car import AxleBrakes, HalfCarOutput
from diffabs.parts.roads import DRY_ASPHALT, SNOW, Patches, RoadTyre

COUNT = 90
SPEED = 15.0  # m/s


def signals(shows, **columns):
    """Return outputs of a kind: another constant for each, or the given columns."""
    constants = {name: np.full(COUNT, float(i)) for i, name in enumerate(shows._fields)}
    return shows(**(constants | columns))


def quarter_turn():
    """Return t, and the outputs of a car on a quarter of a circle to the left, with the radius 20 m."""
    yaw = np.linspace(0.0, np.pi / 2, COUNT)
    place = {"distance": 20 * np.sin(yaw), "lateral_position": 20 * (1 - np.cos(yaw)), "yaw": yaw}
    return 20 * yaw / SPEED, signals(CarOutput, **place)


def layout(plant, output, controls):
    """Return the panels of a run with these outputs, which are the targets, too; the commands are 0, 10, 20, ..."""
    command = controls(*(np.full(COUNT, 10.0 * i) for i in range(len(controls._fields))))
    target = tracked_outputs(output)
    sample = Sample(np.arange(COUNT), output, target, target, command, command, command)
    return curves._layout(SimpleNamespace(trajectory=SimpleNamespace(sample=sample)), plant)


@killed_by(
    "output.explore.curves", "(unit, _last_word(name) if name in channels else", "(unit, name if name in channels else"
)
@killed_by("output.explore.curves", "name.removesuffix(tail)", "name")
@killed_by("output.explore.charts", "panel.quantity or single", "single")
@pytest.mark.parametrize(
    ("plant", "shows", "controls", "wheels"),
    [
        (Car(), CarOutput, CarControls, ["front left", "front right", "rear left", "rear right"]),
        (HalfCar(), HalfCarOutput, AxleBrakes, ["front", "rear"]),
    ],
    ids=["car", "half-car"],
)
def test_the_slips_of_all_wheels_share_a_panel(plant, shows, controls, wheels):
    count = len(wheels)
    slip, speed, brake, *steer = layout(plant, signals(shows), controls)
    assert [line.name for line in slip.lines] == [*wheels, *["target"] * count, *["setpoint"] * count]
    assert [line.values[0] for line in slip.lines] == [*range(count)] * 3  # each target belongs to its slip
    assert [line.name for line in brake.lines] == [*wheels, *["command"] * count]
    assert (slip.unit, brake.unit) == ("1", "N m")
    assert speed.unit == "km/h"
    assert [charts.axis_label(panel) for panel in (slip, speed, brake)] == ["slip [1]", "speed [km/h]", "brake [N m]"]
    assert [charts.axis_label(panel) for panel in steer] == (["steer angle [rad]"] if count == 4 else [])


@killed_by("output.explore.charts", "place = (j - signals) % followed if aim else j", "place = j")
@killed_by(
    "output.explore.charts", "dict.fromkeys(line.name for line in panel.lines)", "(line.name for line in panel.lines)"
)
@killed_by(
    "output.explore.charts", 'for line in panel.lines if line.name != "command"])', "for line in panel.lines[:1]])"
)
def test_the_target_of_a_wheel_has_the_colour_of_the_wheel():
    panels = layout(Car(), signals(CarOutput), CarControls)
    run = curves.Curves(np.arange(COUNT), tuple(panels), {}, "", draft=False)
    chart = charts.run_chart(run)
    lines = [line for line in chart["series"] if line["datasetId"] == "now" and line["xAxisIndex"] == 0]
    colours = [line["lineStyle"]["color"] for line in lines]
    assert colours == colours[:4] * 3
    assert len(set(colours)) == 4
    assert chart["legend"][0]["data"][:6] == [
        "front left",
        "front right",
        "rear left",
        "rear right",
        "target",
        "setpoint",
    ]
    assert chart["yAxis"][2]["max"] >= 30.0  # the greatest of the four torques
    speeds = [line for line in chart["series"] if line["datasetId"] == "now" and line["xAxisIndex"] == 3]
    assert [line["lineStyle"]["type"] for line in speeds] == ["solid", "dashed"]
    assert speeds[1]["lineStyle"]["color"] == charts.RED  # one command among one control


@killed_by("output.explore.path", "[[cosine, sine], [-sine, cosine]]", "[[cosine, -sine], [sine, cosine]]")
@killed_by(
    "output.explore.path", "np.linspace(0.0, length[-1], OUTLINES)", "np.linspace(0.0, length[-1] / 2, OUTLINES)"
)
def test_outlines_stand_along_the_path_with_their_yaw():
    car, (t, output) = Car(), quarter_turn()
    path = trace_path(t, output, car)
    assert len(path.outlines) == OUTLINES
    first, last = path.outlines[0], path.outlines[-1]
    # A quarter of a turn to the left: x becomes y, and y becomes -x; from the origin to (20, 20).
    np.testing.assert_allclose(last, np.stack([20 - first[:, 1], 20 + first[:, 0]], axis=1), atol=1e-9)
    np.testing.assert_array_equal(first[0], first[-1])  # closed
    wheelbase = car.to_front + car.to_rear
    assert wheelbase < np.ptp(first[:, 0]) < 1.8 * wheelbase
    assert car.front_track < np.ptp(first[:, 1]) < 1.4 * car.front_track
    assert np.ptp(first[first[:, 0] == first[:, 0].max()][:, 1]) < np.ptp(first[:, 1])  # narrower in front
    middles = path.outlines[:, :-1].mean(axis=1)
    steps = np.hypot(*np.diff(middles, axis=0).T)
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.05)


@killed_by("output.explore.path", "max(high[0] - low[0], PATH_RATIO *", "max(high[0] - low[0], 0 *")
@pytest.mark.parametrize("scale", [0.0, 1.0, 5.0])
def test_the_window_has_the_ratio_of_the_chart_and_all_of_the_path(scale):
    t, output = quarter_turn()
    path = trace_path(t, output._replace(lateral_position=scale * output.lateral_position), Car())
    (left, right), (bottom, top) = path.window
    assert (right - left) / (top - bottom) == pytest.approx(PATH_RATIO)
    points = path.outlines.reshape(-1, 2)
    assert np.all((points > (left, bottom)) & (points < (right, top)))
    sides = path_chart.AXES_MARGINS
    axes = path_chart.ELEMENT_RATIO * (1 - (sides["left"] + sides["right"]) / 100)
    assert axes / (1 - (sides["top"] + sides["bottom"]) / 100) == pytest.approx(PATH_RATIO)  # equal on the screen


def greatest_friction(road) -> float:
    """Return the maximum over the slip of Burckhardt's formula at `SPEED`."""
    c1, c2, c3, c4 = (float(getattr(road, name)) for name in ("c1", "c2", "c3", "c4"))

    def falling(s: float) -> float:
        return -(c1 * (1 - math.exp(-c2 * s)) - c3 * s) * math.exp(-c4 * s * SPEED)

    return -minimize_scalar(falling, bounds=(0.0, 1.0), method="bounded").fun


@killed_by("output.explore.path", "float(wheel.y) > 0", "float(wheel.y) < 0")
@killed_by("output.explore.path", "jnp.max(jax.vmap", "jnp.mean(jax.vmap")
@killed_by(
    "output.explore.path",
    "        if y[0] < y[1] and np.ptp(values, axis=0).max() < FRICTION_STEP\n",
    "        if y[0] < y[1]\n",
)
def test_a_split_road_has_two_halves_where_its_tyres_agree():
    snow, (t, output) = RoadTyre(road=SNOW), quarter_turn()
    path = trace_path(t, output, Car(front_right_tyre=snow, rear_right_tyre=snow))
    left, right = path.strips
    assert (left.x, right.x) == (path.window[0], path.window[0])
    assert (left.y, right.y) == ((0.0, path.window[1][1]), (path.window[1][0], 0.0))
    assert left.friction == pytest.approx(greatest_friction(DRY_ASPHALT), abs=2e-3)
    assert right.friction == pytest.approx(greatest_friction(SNOW), abs=2e-3)
    (strip,) = trace_path(t, output, Car()).strips
    assert (strip.x, strip.y) == path.window
    (half,) = trace_path(t, output, Car(front_right_tyre=snow)).strips  # the right tyres are on different roads
    assert half.y == left.y


@killed_by("output.explore.path", ">= FRICTION_STEP:", ">= 1e9:")
def test_patches_are_where_their_edges_are():
    tyre = RoadTyre(road=Patches(roads=(DRY_ASPHALT, SNOW, DRY_ASPHALT), edges=(8.0, 14.0), width=0.0))
    t, output = quarter_turn()
    path = trace_path(t, output, Car(**dict.fromkeys([f"{wheel}_tyre" for wheel in Car().wheel_places()], tyre)))
    spacing = (path.window[0][1] - path.window[0][0]) / 200
    assert [strip.x[0] for strip in path.strips[1:]] == pytest.approx([8.0, 14.0], abs=spacing)
    assert [strip.friction < 0.3 for strip in path.strips] == [False, True, False]
    assert path.strips[0].x[1] == path.strips[1].x[0]


def test_a_path_needs_its_signals_only():
    t, output = quarter_turn()
    assert trace_path(t, signals(HalfCarOutput), HalfCar()) is None
    plain = trace_path(t, output, SimpleNamespace())  # a plant that does not say where its wheels are
    assert (plain.outlines.size, plain.strips) == (0, ())
    np.testing.assert_array_equal(plain.y, output.lateral_position)
    diverged = trace_path(t, output._replace(yaw=np.full(COUNT, np.nan)), Car())
    assert (len(diverged.x), diverged.strips) == (0, ())


@killed_by("output.explore.path_chart", "np.round(column, DECIMALS)", "column")
@killed_by("output.explore.path_chart", "((0, 0), (0, 1), (0, 0))", "((0, 0), (0, 0), (0, 0))")
def test_the_chart_of_a_path_is_plain_json():
    t, output = quarter_turn()
    for path in (trace_path(t, output, Car()), trace_path(t, output._replace(yaw=np.nan * t), Car())):
        json.dumps([path_chart.path_chart(path), path_chart.change_path_before(path)], allow_nan=False)
    path = trace_path(t, output, Car())
    straight = path_chart.change_path(path._replace(y=np.full(COUNT, -1.7e-18)))
    assert straight["dataset"][0]["source"]["y"] == [0.0] * COUNT
    change = path_chart.change_path(path)
    source = change["dataset"][1]["source"]
    corners = path.outlines.shape[1]
    assert [i for i, x in enumerate(source["x"]) if x is None] == [(corners + 1) * i + corners for i in range(OUTLINES)]
    ((first, second),) = change["series"][0]["markArea"]["data"]
    assert first["name"] == f"friction {path.strips[0].friction:.2f}"
    assert (second["xAxis"], second["yAxis"]) == (path.window[0][1], path.window[1][1])
    assert path_chart.change_path_before(None)["dataset"][0]["source"] == {"x": [], "y": []}
