"""The explorer without a page: what is turned, drawn, saved, refused, and who may speak to it."""

import asyncio
import dataclasses
import errno
import json
import math
import re
import socket
import subprocess
import sys
import threading
from types import MappingProxyType

import jax
import numpy as np
import pytest
from commands import left_in, run
from marks import cases
from mutants import killed_by
from seams import replace_seam

from diffabs import sensors
from diffabs.cli import console
from diffabs.core.pytree import get, parameters, replace
from diffabs.engine.drive.engine import EngineError
from diffabs.engine.solvers import FixedStep
from diffabs.host.values import ScenarioError
from diffabs.linear import margins, open_loop
from diffabs.linear.opened_loop import OpenLoop
from diffabs.linear.robustness import System
from diffabs.linear.stability_margins import closed_loop_poles
from diffabs.linear.transfer import Transfer
from diffabs.loop.run import rollout
from diffabs.output.explore import charts, curves, frequency_charts, friction, members, saving, stability, tuning
from diffabs.output.explore.knobs import SLIDER_STEPS, is_vehicle
from diffabs.output.explore.panels import Curve, Curves, Fan, Panel, Spread
from diffabs.output.explore.session import AS_GIVEN, Session, check_edit, load_basis
from diffabs.output.explore.work import NewestJobThread
from diffabs.scenario import dump, load, names

SHORT = """
[plant]
type = "mirrored-rig"
[road]
type = "rig"
[initial]
speed_kmh = 30.0
[feedforward]
type = "holding-input"
[controller]
type = "state-feedback"
gain = [-11753.0, -48.0]
low = -inf
high = inf
[stop]
type = "speed-reached"
speed_kmh = 10.0
[solver]
step = 1e-3
duration = 1.0
[design.over]
"plant.mass" = [5.3, 6.2]
[tune]
iterations = 3
[tune.free]
"controller.gain" = [[-1e5, -300.0], [-100.0, -15.0]]
[tune.objective]
iae = 1.0
[sweep.over]
"road.w4" = { low = 0.35, high = 0.45 }
"""

TOKEN = "a-b_c"  # as in an address

pytestmark = pytest.mark.usefixtures("any_step_is_stable")


@pytest.fixture
def session(file):
    """Of a short run."""
    return Session(str(file(SHORT)))


def turn(session, key, given):
    """Edit a number and wait for the check, as on the page."""
    session.put(key, given)
    now = session.scenario()
    try:
        check_edit(session.edited, now)
    except ScenarioError:
        session.withdraw()
        raise
    session.accept(now.loop)


@pytest.mark.slow
@pytest.mark.parametrize("name", names())
def test_every_packaged_scenario_opens_with_what_one_drags(name):
    found = Session(name)
    units = [found.knobs[key].spec.unit for key in found.first]
    heavy = {"kg", "kg m^2"} & {spec.unit for _, spec, _ in parameters(found.original.loop)}
    assert units[0] in heavy if heavy else units  # what is heavy comes first
    assert any(key.startswith("controller.") for key in found.first)
    assert ("plant.road.scale" in found.first) == hasattr(found.original.loop.plant, "road")
    assert ("initial.speed" in found.first) == hasattr(found.original.loop.initial, "speed")
    assert set(found.first) <= found.knobs.keys()
    assert {path.split(".")[0] for path in found.original.tune.free} <= {key.split(".")[0] for key in found.first}
    for key in found.first:  # the value as it is lies on its slider
        knob = found.knobs[key]
        assert knob.low <= found.value(key) * knob.scale <= knob.high
        assert knob.spec.holds(knob.low)
        assert knob.spec.holds(knob.high)


@killed_by("output.explore.knobs", "part = place / SLIDER_STEPS\n", "part = min(1.0, place / SLIDER_STEPS + 1e-3)\n")
@pytest.mark.parametrize("name", ["slip-cured", "arm-hanging"])
def test_places_of_a_slider_are_values(name):
    found = Session(name)
    for key in found.first:
        knob = found.knobs[key]
        for end, place in ((knob.low, 0), (knob.high, SLIDER_STEPS)):
            assert knob.value_at(place) * knob.scale == pytest.approx(end, rel=1e-12, abs=1e-300)
        for place in (1, 250, 500, 999):
            assert knob.place_of(knob.value_at(place)) == pytest.approx(place, abs=0.51)


@killed_by("output.explore.knobs", "return math.copysign(1.0, shown) * math", "return math", case="SHORT")
@killed_by(
    "output.explore.knobs", "shown = sign * math.exp(sign * on)", "shown = sign * math.exp(abs(on))", case="slip-cured"
)
@pytest.mark.parametrize("name", cases(["SHORT", *names()], *{*names()} - {"slip-cured"}))
def test_every_slider_rises_from_end_to_end(name, file):
    found = Session(str(file(SHORT)) if name == "SHORT" else name)
    part = np.arange(SLIDER_STEPS + 1) / SLIDER_STEPS
    for knob in found.knobs.values():
        if knob.low is None:
            continue
        shown = np.array([knob.value_at(place) * knob.scale for place in range(SLIDER_STEPS + 1)])
        ratio = knob.high / knob.low if knob.low * knob.high > 0 else 1.0
        over_decades = max(ratio, 1 / ratio) >= 10
        expected = knob.low * ratio**part if over_decades else knob.low + (knob.high - knob.low) * part
        np.testing.assert_allclose(shown, expected, rtol=5.1e-5, atol=1e-12 * max(abs(knob.low), abs(knob.high)))
        assert np.all(np.diff(shown) >= 0)
        rounding = 1e-12 * np.abs(shown)  # of the change of unit
        assert np.all(shown >= knob.low - rounding)
        assert np.all(shown <= knob.high + rounding)


@killed_by("output.explore.knobs", ">= LOGARITHMIC_RATIO * min(abs(low), abs(high))", "< 0")
def test_a_slider_over_decades_is_even_in_the_logarithm(session):
    knob = session.knobs["controller.gain.0"]  # from -1e5 to -300
    middle = -np.sqrt(knob.low * knob.high)
    assert knob.value_at(SLIDER_STEPS / 2) == pytest.approx(middle, rel=1e-4)


@killed_by(
    "output.explore.knobs",
    "return read_number_in_range(value, self.spec, self.name) / self.scale",
    "return float(value) / self.scale",
    case="plant.mass--3-plant.mass = -3 is outside 0, inf kg",
)
@killed_by("output.explore.session", "    if lines := objections(scenario):\n", "    if (lines := []):\n")
@pytest.mark.parametrize(
    ("key", "given", "said"),
    [
        ("plant.mass", "abc", 'plant.mass = "abc" is text; a number in (0, inf) kg is needed'),
        ("plant.mass", "", 'plant.mass = "" is text; a number in (0, inf) kg is needed'),
        ("plant.mass", "-3", "plant.mass = -3 is outside (0, inf) kg"),
        ("plant.mass", "nan", "plant.mass = nan is outside (0, inf) kg"),
        ("plant.mass", "1e999", "plant.mass = inf is outside (0, inf) kg"),
        ("plant.mass", None, "plant.mass = null is nothing; a number in (0, inf) kg is needed"),
        ("plant.mass", True, "plant.mass = true is a boolean; a number in (0, inf) kg is needed"),
        ("initial.speed", "900", "initial.speed_kmh = 900 is outside (0, 720] km/h"),
        ("initial.speed", "5", "initial.speed_kmh = 5 km/h: initial.speed = 1.38889 m/s is not above stop.speed"),
        ("controller.gain.1", "x", 'controller.gain.1 = "x" is text; a number in (-inf, inf) N m is needed'),
        ("plant.colour", "3", "'plant.colour' is no number of this loop"),
    ],
)
def test_nonsense_is_refused_with_the_field_named(session, key, given, said):
    before = dump(session.scenario())
    with pytest.raises(ScenarioError) as error:
        turn(session, key, given)
    assert str(error.value).startswith(said.replace("null", "None"))
    assert dump(session.scenario()) == before


@pytest.mark.parametrize("given", ["much", "-1", "91", "nan", None])
def test_a_spread_that_is_none_is_refused(session, given):

    with pytest.raises(ScenarioError, match=r"fan\.mass = .*\[0, 90\] %"):
        session.widen("mass", given)
    assert session.spread == Spread()


@killed_by(
    "output.explore.session", "return lines or list(find_unstable_step(scenario.loop, scenario.solver))", "return lines"
)
@killed_by("output.explore.knobs", 'return "" if unit == "1" else unit', "return unit")
def test_a_step_that_is_not_stable_is_refused(file, monkeypatch):

    found = Session(str(file(SHORT)))
    replace_seam(monkeypatch, "stable_step", lambda loop: 5.75e-3 / loop.plant.mass * (1 - loop.initial.slip))
    turn(found, "plant.mass", "5.5")
    with pytest.raises(ScenarioError, match=r"^plant.mass = 6 kg: solver.step = 0.001 s is not stable"):
        turn(found, "plant.mass", "6")
    with pytest.raises(ScenarioError, match=r"^initial.slip = 0.5: solver.step = 0.001 s is not stable"):
        turn(found, "initial.slip", "0.5")  # without the unit "1"
    assert (found.value("plant.mass"), found.value("initial.slip")) == (5.5, 0)


@killed_by("output.explore.session", "new[() if knob.place is None else knob.place] = value", "new[...] = value")
def test_what_is_turned_is_in_the_scenario_and_nowhere_else(file):
    one, other = (Session(str(file(SHORT))) for _ in range(2))
    turn(one, "plant.mass", "5.5")
    turn(one, "initial.speed", "25")
    turn(one, "controller.gain.1", "-60")
    loop = one.scenario().loop
    assert (loop.plant.mass, loop.initial.speed) == (5.5, pytest.approx(25 / 3.6))
    np.testing.assert_array_equal(loop.controller.gain, [-11753.0, -60.0])
    np.testing.assert_array_equal(other.scenario().loop.controller.gain, [-11753.0, -48.0])
    assert dump(other.scenario()) == dump(Session(str(file(SHORT))).scenario())
    one.reset()
    assert dump(one.scenario()) == dump(other.scenario())


@killed_by("output.explore.session", "                self._values[path] = changed[path]", "                pass")
def test_another_road_leaves_what_was_turned(session):
    turn(session, "plant.mass", "5.5")
    turn(session, "plant.road.scale", "0.5")
    session.switch(session.load_part("road", "snow"))
    loop = session.scenario().loop
    assert loop.plant.mass == 5.5
    assert loop.plant.road.scale == 1.0
    assert "c1" in dataclasses.asdict(loop.plant.road.road)
    session.switch(session.load_part("road", AS_GIVEN))
    assert session.scenario().loop.plant.mass == 5.5
    assert "w4" in dataclasses.asdict(session.scenario().loop.plant.road.road)


@killed_by("output.explore.session", "if basis.source == self.source else {}", "")
def test_edits_during_the_load_of_a_road_are_kept(session, file):
    turn(session, "plant.mass", "5.5")
    snow, other = session.load_part("road", "snow"), load_basis(str(file(SHORT, "other.toml")))
    turn(session, "plant.mass", "5.7")
    turn(session, "controller.gain.1", "-60")
    session.switch(snow)
    assert (session.value("plant.mass"), session.value("controller.gain.1")) == (5.7, -60)
    session.switch(other)
    assert (session.value("plant.mass"), session.value("controller.gain.1")) == (5.3, -48)


@killed_by("output.explore.session", "if knob.path in self._values), None)", "if False), None)")
def test_a_new_road_is_checked_with_the_kept_edits(session, monkeypatch):
    turn(session, "plant.mass", "6.1")
    session.switch(session.load_part("road", "snow"))
    replace_seam(monkeypatch, "stable_step", lambda loop: 1e-4 if loop.plant.mass > 6 else 1.0)
    with pytest.raises(ScenarioError, match=r"plant.mass = 6.1 kg: solver.step = 0.001 s is not stable"):
        check_edit(session.edited, session.scenario())
    assert session.withdraw() == ["plant.mass"]
    assert session.value("plant.mass") == 5.3
    assert session.edited is None


def test_a_part_that_does_not_fit_changes_nothing(session):
    before = dump(session.scenario())
    with pytest.raises(ScenarioError, match="balance-feedback"):
        session.load_part("controller", "balance-feedback")
    assert dump(session.scenario()) == before
    assert session.parts["controller"] == AS_GIVEN


@killed_by("output.explore.friction", "had or float(road.scale) != 1.0", "True", case="slip-lmi")
@killed_by(
    "output.explore.friction",
    "sweep=dataclasses.replace(sweep, over=keys(sweep.over), correlation=correlation)",
    "sweep=sweep",
    case="slip-lmi",
)
@pytest.mark.parametrize("name", ["slip-lmi", "slip-cured", "arm-hanging"])
def test_a_friction_factor_comes_and_goes_without_a_trace(name):
    given = load(name)
    with_one = friction.with_factor(given)
    assert dump(friction.without_factor(with_one, given)) == dump(given)
    if hasattr(given.loop.plant, "road"):
        slippery = dataclasses.replace(with_one, loop=replace(with_one.loop, {friction.FACTOR_PATH: 0.5}))
        again = friction.without_factor(slippery, given)
        assert float(get(again.loop, friction.FACTOR_PATH)) == 0.5
        assert {path.replace("plant.road.road.", "plant.road.") for path in again.sweep.over} == {*given.sweep.over}
        there = {path for path, _, _ in parameters(again.loop)}
        assert {*again.sweep.over, *again.design.over, *again.tune.free, *again.tune.over} <= there
        assert get(again.loop, "plant.road.road.w4") == get(given.loop, "plant.road.w4")


@pytest.mark.slow
@killed_by("output.explore.session", "        now = self.scenario()\n", "        now = self._base\n", case="turned0")
@pytest.mark.parametrize(
    "turned",
    [
        {"plant.mass": 5.61},
        {"plant.mass": 5.61, "plant.road.scale": 0.77},
        {},
    ],
)
def test_the_command_line_reproduces_the_saved_scenario(session, tmp_path, turned):
    for key, value in turned.items():
        turn(session, key, value)
    shown = curves.run_curves(session.scenario())
    path = saving.save_scenario(session.to_save(), tmp_path, "explored.toml")
    metrics = json.loads(run("simulate", path, "--json").stdout)["metrics"]
    assert metrics == pytest.approx(shown.metrics, rel=1e-12, abs=1e-14)
    assert ("scaled" in path.read_text()) == ("plant.road.scale" in turned)


@killed_by("output.explore.saving", "if name != pathlib.PurePath(name).name or", "if")
@pytest.mark.parametrize(
    "name",
    ["mine", "../mine.toml", "{outside}/other.toml", ".mine.toml", ".toml", "", "a/b.toml", "a\\b.toml", "a\nb.toml"],
)
def test_a_name_that_leads_elsewhere_is_refused(session, tmp_path, name):
    (tmp_path / "in").mkdir()
    with pytest.raises(ScenarioError, match="file = "):
        saving.save_scenario(session.to_save(), tmp_path / "in", name.format(outside=tmp_path))
    assert left_in(tmp_path / "in") == set()
    assert left_in(tmp_path) <= {"in", "mine.toml"}  # the scenario itself


@killed_by("output.explore.saving", "if replacing and path.is_file():", "if path.is_file():")
def test_a_file_is_only_replaced_when_that_is_said(session, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "mine.toml").write_text("mine")
    with pytest.raises(ScenarioError, match=r'file = "mine.toml" exists'):
        saving.save_scenario(session.to_save(), folder, "mine.toml")
    assert (folder / "mine.toml").read_text() == "mine"
    assert saving.free_name(folder, "mine") == "mine-2.toml"
    saving.save_scenario(session.to_save(), folder, "mine.toml", replacing=True)
    assert load(folder / "mine.toml").loop.plant.mass == session.original.loop.plant.mass
    assert left_in(folder) == {"mine.toml"}


@pytest.mark.slow
@killed_by("output.explore.curves", "int(lost.sum()) - refused", "int(lost.sum())")
@killed_by("output.explore.curves", "here * (1 + sign * part)", "here * (1 + sign * part / 2)")
@killed_by(
    "output.explore.curves",
    "np.nanquantile(values, QUANTILES, axis=0)",
    "np.nanquantile(values, QUANTILES, axis=0, method='lower')",
)
def test_a_fan_has_the_quantiles_of_its_runs(session, monkeypatch):
    replace_seam(monkeypatch, "members", 5)
    chosen, spread = session.scenario(), Spread(mass=0.1, road=0.3)
    found = curves.run_fan(chosen, spread)
    values, words = curves.fan_members(chosen, spread)
    assert words == "mass ± 10 %, friction ± 30 %"
    by = curves.drawing_solver(chosen, curves.DRAFT_INSTANTS)
    each = [replace(chosen.loop, {path: column[i] for path, column in values.items()}) for i in range(5)]
    slips = np.array([rollout(loop, by).trajectory.sample.output.slip for loop in each])
    early = slice(0, 50)  # all of them still run

    def places(found):
        return np.round(found.t[early] / (by.step * by.every)).astype(int)

    expected = np.quantile(slips[:, places(found)], curves.QUANTILES, axis=0)
    np.testing.assert_allclose(found.bands[0][0][:, early], expected, rtol=1e-9, atol=1e-12)
    for path, part in ((friction.FACTOR_PATH, 0.3), ("plant.mass", 0.1)):
        here = float(get(chosen.loop, path))
        assert np.all(np.abs(values[path] / here - 1) <= part)
        assert np.ptp(values[path]) > part * here
    heavy = values["plant.mass"] > chosen.loop.plant.mass
    replace_seam(monkeypatch, "is_step_stable", lambda loop, values, step: heavy)
    found = curves.run_fan(chosen, spread)
    assert (found.members, found.refused, found.diverged) == (5, np.sum(~heavy), 0)
    expected = np.quantile(slips[heavy][:, places(found)], curves.QUANTILES, axis=0)
    np.testing.assert_allclose(found.bands[0][0][:, early], expected, rtol=1e-9, atol=1e-12)


@killed_by("output.explore.curves", "KMH * line.values", "line.values")
@pytest.mark.slow
def test_a_draft_is_the_run_to_what_can_be_seen(session):
    exact, draft = (curves.run_curves(session.scenario(), by) for by in (None, curves.Adaptive(rtol=1e-3, step=2.5e-3)))
    assert (exact.draft, draft.draft) == (False, True)
    ends = np.interp(draft.t[:-1], exact.t, exact.panels[0].lines[0].values)
    assert np.max(np.abs(ends - draft.panels[0].lines[0].values[:-1])) < 2e-3
    assert [panel.unit for panel in exact.panels] == ["1", "km/h", "N m"]
    assert exact.panels[1].lines[0].values[0] == pytest.approx(30.0)
    assert exact.end.startswith("ends after 0.")


@killed_by(
    "linear.stability_margins",
    "return np.linalg.eigvals(system.A - system.B @ system.C / (1 + system.D[0, 0]))\n\n\ndef frequency_grid",
    "return np.linalg.eigvals(system.A)\n\n\ndef frequency_grid",
)
def test_poles_of_a_closed_loop_are_those_of_its_polynomial():
    def of(a, b, c, **more):
        return Transfer(*(np.array(x, float) for x in (a, b, c, [[0.0]])))._replace(**more)

    motor = of([[0, 1], [0, -1]], [[0], [1]], [[7.0, 0]])  # 7/(s (s + 1))
    np.testing.assert_allclose(
        np.sort_complex(closed_loop_poles(motor)), np.sort_complex(np.roots([1, 1, 7])), rtol=1e-12
    )
    late = of([[1]], [[1]], [[0.3]], period=0.1, delay=0.1)  # 0.3/(z (z - 1))
    np.testing.assert_allclose(
        np.sort_complex(closed_loop_poles(late)), np.sort_complex(np.roots([1, -1, 0.3])), rtol=1e-12
    )


@pytest.mark.slow
@killed_by("scenario.section_design", 'self._with_speed(loop) if self.over and hasattr(loop.plant, "frozen") else', "")
def test_margins_are_those_of_the_library(session):
    chosen = session.scenario()
    found, oracle = (
        stability.linear_stability(chosen, stability.linearise_box(chosen)),
        margins(open_loop(chosen.loop)),
    )
    assert found.stable
    assert found.margins["phase"] == oracle.phase
    assert found.margins["gain_up"] == oracle.gain[1]
    assert found.box.systems == 8  # corners of mass, and speed between start and stop; four points inside
    assert found.box.worst["phase"] <= found.margins["phase"]
    assert np.all(found.poles.real < 0)
    w, opened, here, goal, peak = found.curves
    np.testing.assert_allclose(np.abs(1 / (1 + opened)), here, rtol=1e-12)
    assert peak == math.inf
    assert np.max(here) == pytest.approx(1 / oracle.modulus, rel=1e-2)
    assert np.all(goal == math.inf)
    np.testing.assert_allclose(stability.loop_curves(chosen, w).gain, here, rtol=1e-12)
    w, around, least, greatest = found.box.curves
    assert around.shape == (8, len(w))
    inside = stability.loop_curves(chosen, w).gain  # this loop is a corner
    assert np.all((least <= inside * (1 + 1e-9)) & (inside <= greatest * (1 + 1e-9)))
    assert np.max(greatest / least) > 1.5
    lost = dataclasses.replace(chosen, loop=replace(chosen.loop, {"controller.gain": (11753.0, 48.0)}))
    lost_curves = stability.loop_curves(lost, w)
    assert np.all(np.isnan(lost_curves.gain))
    np.testing.assert_allclose(lost_curves.opened, -stability.loop_curves(chosen, w).opened, rtol=1e-9)


@pytest.mark.slow
@killed_by("output.explore.stability", "if earlier and earlier.of == of:", "if earlier:")
@killed_by("output.explore.stability", "if earlier and earlier.of == of:", "if False:")
def test_the_box_is_looked_at_again_only_where_it_moves(session):
    first = stability.linearise_box(session.scenario())
    turn(session, "plant.mass", "5.5")  # has a range in [design.over]
    assert stability.linearise_box(session.scenario(), first) is first
    turn(session, "controller.gain.1", "-60")
    moved = stability.linearise_box(session.scenario(), first)
    assert moved is not first
    fresh = stability.linearise_box(session.scenario())
    np.testing.assert_array_equal(moved.poles, fresh.poles)
    assert (moved.worst, moved.unstable, moved.systems) == (fresh.worst, fresh.unstable, fresh.systems)
    for name in moved.curves._fields:
        np.testing.assert_array_equal(getattr(moved.curves, name), getattr(fresh.curves, name))
    turn(session, "plant.mass", "6")
    found = stability.linearise_box(session.scenario(), moved)
    whole = stability.linearise_box(session.scenario())
    np.testing.assert_array_equal(found.poles, whole.poles)
    assert found.worst == whole.worst


@killed_by(
    "output.explore.session",
    "        self.adopt(self._accepted)\n",
    "        self._values = dict(list(self._values.items())[:-1])\n",
)
@killed_by(
    "output.explore.session",
    "self._values, self.edited = {**self._values, knob.path: new}, knob",
    "self._values[knob.path] = new",
)
def test_a_refused_edit_is_withdrawn_with_later_edits(session, tmp_path):
    turn(session, "plant.mass", "5.5")
    session.put("initial.speed", "5")  # below the stop's
    session.put("controller.gain.1", "-60")
    now = session.scenario()
    with pytest.raises(ScenarioError, match=r"controller.gain.1 = -60 N m: initial.speed"):
        check_edit(session.edited, now)
    with pytest.raises(ScenarioError, match=r"initial.speed = 1.38889 m/s is not above"):
        saving.save_scenario(session.to_save(), tmp_path, "refused.toml")
    assert sorted(session.withdraw()) == ["controller.gain.1", "initial.speed"]
    assert session.value("plant.mass") == 5.5
    assert session.value("controller.gain.1") == -48
    assert session.value("initial.speed") == pytest.approx(30 / 3.6)


@killed_by("output.explore.stability", "    _refuse_several_controls(scenario)\n    here", "    here")
@killed_by("output.explore.stability", "    _refuse_several_controls(scenario)\n    loop", "    loop")
def test_a_loop_with_several_controls_says_why_it_has_no_curves():
    tank = load("quadruple-tank")
    for compute in (lambda: stability.linear_stability(tank, None), lambda: stability.loop_curves(tank, np.ones(1))):
        with pytest.raises(ValueError, match="2 controls: its linear model compiles for too long"):
            compute()


@pytest.mark.slow
def test_a_loop_without_a_linear_model_says_so():
    with pytest.raises(ValueError, match="no linear loop"):
        stability.linear_stability(friction.with_factor(load("lab-rig")), None)


def test_a_tuning_begins_from_what_is_shown(file):
    session = Session(str(file(SHORT.replace("[-100.0, -15.0]", "[-100.0, -45.0]"))))
    assert session.knobs["controller.gain.1"].high > -45  # a slider goes further than the scenario tunes
    turn(session, "controller.gain.1", "-46")
    chosen = tuning.scenario_with_goal(session.scenario(), *tuning.default_tuning(session.scenario()), session.knobs)
    assert chosen.tune.free == {"controller.gain": ((-1e5, -300.0), (-100.0, -45.0))}
    assert chosen.tune.objective == {"iae": 1.0}
    assert get(chosen.loop, "controller.gain.1") == -46
    assert tuning.default_tuning(session.scenario())[1] == tuning.OWN_OBJECTIVE
    other = tuning.scenario_with_goal(session.scenario(), ["reference.slip"], "stop_distance", session.knobs)
    ends = other.tune.free["reference.slip"]
    assert ends
    low, high = ends
    assert 0 < low < 0.2 < high <= 1
    assert other.tune.objective == {"stop_distance": 1.0}
    with pytest.raises(ScenarioError, match=r"tune\.free is empty"):
        tuning.scenario_with_goal(session.scenario(), [], "iae", session.knobs)
    with pytest.raises(ScenarioError, match="is not measured"):
        tuning.scenario_with_goal(session.scenario(), ["reference.slip"], "beauty", session.knobs)


def test_the_objective_is_the_scenarios_with_all_weights_or_one_metric(file):
    now = Session(str(file(SHORT.replace("iae = 1.0", "iae = 1.0\novershoot = 0.01")))).scenario()
    known = Session(str(file(SHORT))).knobs
    goals = [
        tuning.scenario_with_goal(now, ["controller.gain"], metric, known).tune.objective
        for metric in (tuning.OWN_OBJECTIVE, "iae")
    ]
    assert goals == [{"iae": 1.0, "overshoot": 0.01}, {"iae": 1.0}]
    assert tuning.describe_own_objective(now) == "iae + 0.01 overshoot"
    none = dataclasses.replace(now, tune=dataclasses.replace(now.tune, objective={}))
    assert tuning.default_tuning(none)[1] == next(iter(now.objectives))
    with pytest.raises(ScenarioError, match="is not measured"):
        tuning.scenario_with_goal(none, ["controller.gain"], tuning.OWN_OBJECTIVE, known)


@killed_by("core.bijectors", "value - low < high - value", "True")
@killed_by("core.bijectors", "scale = bijection(low, high, value)", "scale = Interval(low, high)")
def test_a_tuning_names_the_bounds_at_which_it_ended(file):
    session = Session(str(file(SHORT)))
    now = session.scenario()

    def sentences(*gain, path="controller.gain"):
        after = dataclasses.replace(now, loop=replace(now.loop, {path: gain}))
        return tuning.at_bounds(now, after, session.knobs)

    # bounds [-1e5, -100] and [-300, -15], logarithmic: a hundredth of 3 and 1.3 decades
    assert sentences(-11753.0, -48.0) == ()
    assert sentences(-106.0, -48.0) == ("gain 1 is at its upper bound, -100 N m/s",)
    assert sentences(-95_000.0, -292.0) == (
        "gain 1 is at its lower bound, -100000 N m/s", "gain 2 is at its lower bound, -300 N m",
    )  # fmt: skip
    assert sentences(-11753.0, -15.0) == ("gain 2 is at its upper bound, -15 N m",)
    assert sentences(-110.0, -16.0) == ()


@killed_by("output.explore.tuning", "if loop.box.unstable:", "if False:")
@pytest.mark.slow
def test_unstable_points_are_named(file):
    """By the poles of the closed loops; a positive gain drives the slip away."""
    now = Session(str(file(SHORT))).scenario()
    lost = dataclasses.replace(now, loop=replace(now.loop, {"controller.gain": (11753.0, 48.0)}))
    assert tuning.describe_instability(lost) == (
        "the loop is not stable; 8 of 8 points of [design.over] are not stable"
    )
    assert all(np.any(closed_loop_poles(open_loop(loop).transfer()).real > 0) for loop in (lost.loop,))


@pytest.mark.slow
def test_nothing_is_said_of_stable_points(file):
    assert tuning.describe_instability(Session(str(file(SHORT))).scenario()) == ""


@killed_by("output.explore.tuning", "{knob.words(high)}", "{knob.text(high)} {knob.spec.unit}")
@killed_by("output.explore.tuning", "free_range = scenario.tune.free.get(path)", "free_range = None")
def test_a_tuning_stays_between_the_bounds_that_are_typed(file):
    session = Session(str(file(SHORT)))
    now, known = session.scenario(), session.knobs
    assert tuning.bounds_on_page(now, "controller.gain", known)["controller.gain.1"] == (-300.0, -15.0)
    typed = {"controller.gain.1": ("-60", "-20.5")}
    chosen = tuning.scenario_with_goal(now, ["controller.gain", "reference.slip"], "iae", known, typed)
    assert chosen.tune.free["controller.gain"] == ((-1e5, -60.0), (-100.0, -20.5))
    assert chosen.tune.free["reference.slip"] == tuple(
        tuning.bounds_on_page(now, "reference.slip", known)["reference.slip"]
    )
    with pytest.raises(ScenarioError, match=r"^tune\.free\.reference\.slip: 0\.5 is not below 0\.2$"):
        tuning.scenario_with_goal(now, ["reference.slip"], "iae", known, {"reference.slip": ("0.5", "0.2")})
    for pair, words in (
        (("-20", "-60"), r"tune\.free\.controller\.gain\.1: -20 is not below -60 N m"),
        (("low", "-60"), 'controller.gain.1 = "low" is text'),
        (("nan", "-60"), "controller.gain.1 = nan"),
    ):
        with pytest.raises(ScenarioError, match=words):
            tuning.scenario_with_goal(now, ["controller.gain"], "iae", known, {"controller.gain.1": pair})


@killed_by("output.explore.session", "parameters(loop)}", "parameters(loop) if np.ndim(value) < 2}")
@killed_by("output.explore.tuning", "and np.ndim(value) < 2", "and True")
@killed_by(
    "output.explore.tuning",
    "    if path in scenario.tune.free and read == defaults:\n        return scenario.tune.free[path]\n",
    "",
)
@killed_by("output.explore.session", "if not np.array_equal(", "if np.ndim(value) < 2 and not np.array_equal(")
def test_a_matrix_is_tuned_in_its_own_bounds_only(file):
    session = Session("arm-balance")
    session.switch(session.load_part("controller", "observer-feedback"))
    now, path = session.scenario(), "controller.transition"
    tuned = 0.9 * np.asarray(get(now.loop, path))
    session.adopt(replace(now.loop, {path: tuned}))
    np.testing.assert_array_equal(get(session.scenario().loop, path), tuned)
    again = Session(str(file(dump(now))))
    again.adopt(replace(again.scenario().loop, {path: tuned}))
    assert again.to_save().title != now.title
    again.switch(again.load_part("road", AS_GIVEN))
    np.testing.assert_array_equal(get(again.scenario().loop, path), tuned)
    assert "controller.gain" in tuning.tunable_parameters(now)
    assert path not in tuning.tunable_parameters(now)
    metric = next(iter(now.objectives))
    with pytest.raises(ScenarioError, match=r"tune\.free\.controller\.transition has no range"):
        tuning.scenario_with_goal(now, [path], metric, session.knobs)
    ends = (np.eye(6) - 1, np.eye(6) + 1)
    given = dataclasses.replace(now, tune=dataclasses.replace(now.tune, free={path: ends}))
    assert tuning.tunable_parameters(given)[0] == path
    assert tuning.scenario_with_goal(given, [path], metric, session.knobs).tune.free == {path: ends}


@killed_by(
    "output.explore.tuning",
    "if path in scenario.tune.free and read == defaults:",
    "if scenario.tune.free.get(path) and read == defaults:",
)
@killed_by("output.explore.tuning", "end if text == knob.text(end) else knob.read(text)", "knob.read(text)")
@killed_by(
    "output.explore.tuning",
    "if path in scenario.tune.free else (knob.low, knob.high)",
    "if False else (knob.low, knob.high)",
)
def test_a_declared_range_is_that_of_the_command(file):
    text = SHORT.replace("[tune.free]\n", '[tune.free]\n"reference.slip" = "declared"\n"initial.speed" = "declared"\n')
    session = Session(str(file(text.replace("[[-1e5, -300.0], [-100.0, -15.0]]", '"declared"'))))
    now, path, known = session.scenario(), "reference.slip", session.knobs
    assert tuning.bounds_on_page(now, path, known) == {path: (0.0, 1.0)}
    for key, typed, wanted in (
        (path, ("0", "1"), None),
        (path, ("0.1", "0.3"), (0.1, 0.3)),
        (path, ("0", "0.2"), (0.0, 0.2)),
        (path, ("0.2", "1"), (0.2, 1.0)),
        ("initial.speed", ("0", "36"), (0.0, 10.0)),
        ("controller.gain.1", ("-inf", "inf"), None),
        ("controller.gain.1", ("-60", "inf"), ((-math.inf, -60.0), (math.inf, math.inf))),
        ("controller.gain.1", ("-60", "-20"), ((-math.inf, -60.0), (math.inf, -20.0))),
    ):
        changed = known[key].path
        found = tuning.scenario_with_goal(now, [changed], "iae", known, {key: typed})
        assert found.tune.free == {changed: wanted}


@killed_by("output.explore.stability", 'name == "delay" and stable', "False")
@pytest.mark.parametrize(
    ("name", "value", "stable", "words"),
    [
        ("delay", math.nan, True, "undecided"),  # the search ended first
        ("delay", math.nan, False, "none"),
        ("phase", math.nan, True, "none"),
        ("delay", math.inf, True, "no limit"),
        ("delay", 0.0123, True, "12.3 ms"),
    ],
)
def test_a_delay_margin_may_be_undecided(name, value, stable, words):
    assert stability.format_margin(name, value, stable) == words


def test_each_gain_of_a_balance_has_the_unit_of_its_state():
    known = Session("arm-hanging").knobs
    units = [known[f"controller.gain.{i}"].spec.unit for i in range(6)]
    assert units == ["V/rad"] * 3 + ["V s/rad"] * 3


def test_speeds_of_a_plant_without_a_wheel_stay_in_si(session):
    class Cart:
        class shows:
            units = MappingProxyType({"position": "m", "speed": "m/s"})

    assert not is_vehicle(Cart())
    assert is_vehicle(session.original.loop.plant)
    assert session.knobs["initial.speed"].spec.unit == "km/h"


@killed_by("output.explore.curves", "(multiple * instants))", "instants)")
@pytest.mark.slow
@pytest.mark.parametrize("draft", [False, True])
def test_a_run_that_stops_early_is_drawn_whole(file, draft):
    """A hundredth of the duration has as many instants as a run needs, and its last one is where it stops."""
    chosen = Session(str(file(SHORT.replace("duration = 1.0", "duration = 40.0")))).scenario()
    assert curves.drawing_solver(chosen).steps == 40_000
    found = curves.run_curves(chosen, curves.draft_solver(chosen) if draft else None)
    assert 60 < len(found.t) <= 2 * curves.INSTANTS
    assert 0.3 < found.t[-1] == pytest.approx(found.metrics["stop_time"], rel=1e-3)


@killed_by("output.explore.curves", "min(count, instants + 1)", "instants + 1")
def test_curves_are_thinned_to_few_instants_and_the_last_one():
    assert [len(curves.thin(count, 400)) for count in (0, 1, 2, 400, 401, 402, 6401)] == [0, 1, 2, 400, 401, 401, 401]
    assert curves.thin(403, 400)[-1] == 402


def test_a_transient_ends_when_the_signal_has_settled():
    t = np.linspace(0.0, 10.0, 1001)
    decay = np.exp(-t) * np.cos(3 * t)  # inside 5 % of its start from t = 2.98 s on (where exp(-t) < 0.05 and cos is 0)
    lines = (Curve("slip", 0.2 + decay), Curve("target", np.full_like(t, 0.2)))
    found = Curves(t, (Panel("1", lines),), {}, "", draft=False)
    last = t[np.flatnonzero(np.abs(decay) > 0.05)[-1]]
    assert curves.transient_end(found) == pytest.approx(1.5 * last, abs=0.02)
    never = found._replace(panels=(Panel("1", (Curve("slip", np.cos(t)), lines[1])),))
    assert curves.transient_end(never) == 10.0
    still = found._replace(panels=(Panel("1", (Curve("slip", lines[1].values), lines[1])),))
    assert curves.transient_end(still) == 10.0
    assert charts.change_time_axis(1.23456789) == {"dataZoom": [{"startValue": 0, "endValue": 1.234568}]}


@killed_by("output.explore.curves", '_last_word(name) if name in channels else ""', '""')
@pytest.mark.slow
def test_each_channel_has_panels_of_its_own():
    chosen = load("quadruple-tank")
    found = curves.run_curves(chosen)
    aims, control = ["target", "setpoint"], ["command"]
    lines = [["level 1", *aims], ["level 2", *aims], ["level 3", "level 4"], ["pump 1", *control], ["pump 2", *control]]
    assert [[line.name for line in panel.lines] for panel in found.panels] == lines
    assert [float(panel.lines[1].values[0]) for panel in found.panels[:2]] == [0.134, 0.127]
    assert 20.0 < curves.transient_end(found) < 100.0
    axes = charts.run_chart(found)["yAxis"]
    assert [axis["name"] for axis in axes[2:4]] == ["level 3, level 4 [m]", "pump 1 [V]"]


@killed_by("output.explore.charts", "poles[np.isfinite(poles)]", "poles")
def test_a_loop_that_is_not_well_posed_shows_no_poles():
    empty = stability.LoopCurves(*np.empty((4, 0)), math.inf)
    loop = stability.Stability(None, 0.0, np.array([np.nan, -1.0]), {}, False, empty, stability.NO_BOX)
    change = json.loads(json.dumps(charts.change_poles(loop), allow_nan=False))
    assert [series["data"] for series in change["series"]] == [[], [[-1.0, 0.0]]]


def _integrator_with_lag(gain: float) -> System:
    """Return L = gain/(s (s + 1)), opened."""
    a, b, c = np.array([[0.0, 1.0], [0.0, -1.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    plant = Transfer(a, b, c, np.zeros((1, 1)))
    controller = Transfer(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[-gain]])
    )  # negative feedback
    opened = OpenLoop(plant, controller, 0.0)
    return System({}, opened, margins(opened))


@killed_by("output.explore.stability", "gains.min(axis=0), gains.max(axis=0)", "gains.max(axis=0), gains.max(axis=0)")
@killed_by("output.explore.stability", "if not all(system.margins.stable for system in systems):", "if False:")
@killed_by("linear.robustness", "in (sensitivity, identity - sensitivity)", "in (identity - sensitivity, sensitivity)")
def test_the_range_of_sensitivities_is_that_of_closed_forms():
    gains = (0.5, 2.0, 7.0)
    w, opened, least, greatest = stability.find_box_curves([_integrator_with_lag(gain) for gain in gains])
    s = 1j * w
    np.testing.assert_allclose(opened, [gain / (s * (s + 1)) for gain in gains], rtol=1e-9)
    exact = np.abs([s * (s + 1) / (s**2 + s + gain) for gain in gains])
    np.testing.assert_allclose(least, exact.min(axis=0), rtol=1e-9)
    np.testing.assert_allclose(greatest, exact.max(axis=0), rtol=1e-9)
    crossover = math.sqrt((math.sqrt(1 + 4 * 7.0**2) - 1) / 2)  # |L| = 1: w^4 + w^2 = k^2
    assert w[-1] == pytest.approx(crossover * 10**1.5)
    unstable = stability.find_box_curves([_integrator_with_lag(gain) for gain in (2.0, -1.0)])
    assert np.isnan([unstable.low, unstable.high]).all()
    assert np.isfinite(unstable.opened).all()


@killed_by("output.explore.frequency_charts", '"low": low, "step": high - low}}', '"low": low, "step": high}}')
@killed_by("output.explore.frequency_charts", "max(lower_end, bottom)", "bottom")
def test_the_chart_of_sensitivities_is_in_decibels():
    curve = stability.LoopCurves(
        np.array([0.2, 2.0, 20.0]), np.ones(3), np.array([0.0, 10.0, np.nan]), np.array([np.inf, 1.0, 2.0]), math.inf
    )
    over = stability.BoxCurves(np.array([0.3, 30.0]), np.ones((1, 2)), np.array([0.001, 1.0]), np.array([0.1, 100.0]))
    change = json.loads(json.dumps(frequency_charts.change_sensitivity(curve, over, moved=True), allow_nan=False))
    assert len(frequency_charts.change_sensitivity(curve, over, moved=False)["dataset"]) == 1
    here, box = (dataset["source"] for dataset in change["dataset"])
    assert here == {"w": [0.2, 2.0, 20.0], "s": [None, 20.0, None], "goal": [None, 0.0, 6.0206]}
    assert box == {"w": [0.3, 30.0], "low": [-60.0, 0.0], "step": [40.0, 40.0]}  # on top of the least
    assert change["xAxis"] == [{"min": 0.1, "max": 100.0}]
    assert change["yAxis"] == [{"min": -40.0, "max": 40, "interval": 10}]


def _late_integrator(gain: float, delay: float, w: np.ndarray) -> np.ndarray:
    """Return L = gain e^(-s delay)/(s (s + 1)) at frequencies w [rad/s]."""
    return gain * np.exp(-1j * w * delay) / (1j * w * (1j * w + 1))


def _sources(change) -> dict:
    return {part["id"]: part["source"] for part in json.loads(json.dumps(change, allow_nan=False))["dataset"]}


@killed_by("output.explore.frequency_charts", "np.exp(1j * angles) / here.peak", "np.exp(1j * angles) * here.peak")
@killed_by("output.explore.frequency_charts", '"mirrored": -im', '"mirrored": im')
@killed_by("output.explore.frequency_charts", "((0, 0), (0, 1))", "((0, 0), (0, 0))")
def test_the_nyquist_chart_has_the_circle_of_the_goal_and_a_line_for_each_point_of_the_box():
    w = np.geomspace(0.1, 10.0, 5)
    opened, around = _late_integrator(2.0, 0.0, w), np.array([_late_integrator(k, 0.0, w) for k in (1.0, 3.0)])
    loop = stability.LoopCurves(w, opened, np.ones(5), np.full(5, 2.0), 2.0)
    box = stability.BoxCurves(w, around, np.ones(5), np.ones(5))
    sources = _sources(frequency_charts.change_nyquist(loop, box, moved=True))
    points = np.array(sources["goal"]["re"]) + 1j * np.array(sources["goal"]["im"])
    np.testing.assert_allclose(np.abs(1 + points), 0.5, rtol=1e-6)
    assert points[0] == pytest.approx(points[-1])
    np.testing.assert_allclose(sources["here"]["re"], -2 / (1 + w**2), rtol=1e-6)  # of 2/(jw (1 + jw))
    np.testing.assert_allclose(sources["here"]["im"], -2 / (w * (1 + w**2)), rtol=1e-6)
    np.testing.assert_allclose(sources["here"]["mirrored"], np.negative(sources["here"]["im"]))
    assert [i for i, x in enumerate(sources["box"]["re"]) if x is None] == [5, 11]
    assert sources["box"]["im"][6] == pytest.approx(3 * sources["box"]["im"][0], rel=1e-6)
    without = _sources(frequency_charts.change_nyquist(loop._replace(peak=math.inf), box, moved=False))
    assert (without["goal"]["re"], "box" in without) == ([], False)
    ratio = [high - low for low, high in frequency_charts.NYQUIST_WINDOW.values()]
    assert ratio[0] / ratio[1] == frequency_charts.NYQUIST_SIZE["width"] / frequency_charts.NYQUIST_SIZE["height"]


@killed_by(
    "output.explore.frequency_charts",
    "np.degrees(np.unwrap(np.angle(here.opened)))",
    "np.degrees(np.angle(here.opened))",
)
@killed_by("output.explore.frequency_charts", "- 360 * np.round((angles[:, place", "- 0 * np.round((angles[:, place")
@killed_by("output.explore.frequency_charts", "- 360 * np.round((angles[place] - beside) / 360)", "")
def test_the_phase_is_continuous_and_beside_that_of_the_box():
    w = np.geomspace(0.1, 30.0, 400)
    lag = -90 - np.degrees(np.arctan(w))
    loop = stability.LoopCurves(w, _late_integrator(2.0, 1.0, w), np.full(400, np.nan), np.full(400, np.inf), math.inf)
    bode = frequency_charts.change_bode(loop, stability.NO_CURVES, moved=True)
    here = _sources(bode)["here"]
    np.testing.assert_allclose(here["phase"], lag - np.degrees(w), rtol=1e-5)  # to -1900 degrees
    np.testing.assert_allclose(here["db"], 20 * np.log10(2 / (w * np.sqrt(1 + w**2))), atol=1e-5)
    assert bode["yAxis"][1] == {"min": -720.0, "max": -90, "interval": 180}
    # With gains of both signs the phases near the crossover are apart by half a turn, not by more.
    around = np.array([_late_integrator(gain, 0.0, w) for gain in (-2.0, 2.0)])
    box = stability.BoxCurves(w, around, *np.full((2, 400), np.nan))
    sources = _sources(frequency_charts.change_bode(loop._replace(opened=around[1]), box, moved=True))
    np.testing.assert_allclose(np.abs(sources["box"]["turn"]), 180.0)
    offset = np.subtract(sources["here"]["phase"], sources["box"]["lag"])
    assert np.all(np.isclose(offset, 0) | np.isclose(offset, 180))


@killed_by("linear.robustness", "np.exp(np.interp(np.log(w), at, limits))", "np.interp(w, *np.array(shape).T)")
def test_the_goal_of_sensitivity_is_the_lower_bound(file):
    constraints = "[tune.constraints]\nsensitivity = 2.0\nshape = [[1.0, 0.1], [100.0, 4.0]]\n"
    now = Session(str(file(SHORT + constraints))).scenario()
    w = np.array([0.1, 1.0, 10.0, 100.0])
    curve = stability.find_sensitivity_goal(now, w)
    np.testing.assert_allclose(curve, [0.1, 0.1, math.sqrt(0.4), 2.0])


@killed_by("output.explore.panels", "if self.quantity else self.lines[:1]", "if False else self.lines[:1]")
@killed_by("output.explore.charts", "colour if several else GREY", "GREY")
@killed_by("output.explore.charts", "colour, light=several", "BLUE, light=several")
def test_each_wheel_has_its_fan_and_pinned_run():
    """In the colour of its own curve; of signals that only share a unit, the first has them."""
    names, slip, t = ("left", "right", "target", "target"), np.array([0.1, 0.2]), np.array([0.0, 1.0])
    wheels = Panel("1", tuple(Curve(name, i * slip) for i, name in enumerate(names)), "slip")
    speeds = Panel("km/h", (Curve("wheel speed", slip), Curve("speed", slip)))
    found = Curves(t, (wheels, speeds), {}, "", draft=False)
    before = charts.change_curves(found, "before")["dataset"][0]["source"]
    assert before == {"t": [0.0, 1.0], "0.0": [0.0, 0.0], "0.1": [0.1, 0.2], "1.0": [0.1, 0.2]}
    band = np.arange(5.0)[:, None] + slip
    fan = charts.change_fan(Fan(t, ((band, 2 * band), (band,)), 200, 0, 0, ""))["dataset"][0]["source"]
    assert fan["0.1.1"] == [2.0, 2.0]
    drawn = charts.run_chart(found)["series"]
    columns = {(line["datasetId"], line["encode"]["y"]): line for line in drawn}
    assert {column for name, column in columns if name == "fan"} == {*fan} - {"t"}
    assert {column for name, column in columns if name == "before"} == {*before} - {"t"}
    for wheel in ("0.0", "0.1"):
        colour = columns["now", wheel]["lineStyle"]["color"]
        assert (
            colour
            == columns["before", wheel]["lineStyle"]["color"]
            == columns["fan", f"{wheel}.1"]["areaStyle"]["color"]
        )
    assert columns["before", "1.0"]["lineStyle"]["color"] == charts.GREY
    assert len({line["stack"] for line in drawn if "stack" in line}) == 3


@pytest.fixture
def large(monkeypatch, users_engine, session):
    """A scenario whose loop counts as a large one."""
    replace_seam(monkeypatch, "many_states", 3)
    replace_seam(monkeypatch, "in_kernel", {})
    return session.scenario()


@killed_by("output.explore.members", "> MANY_STATES and _has_compiler()", "> MANY_STATES")
@killed_by("output.explore.members", 'if default_engine() == "xla" or', "if")
@killed_by("output.explore.curves", "multiple = KERNEL_MULTIPLE if takes_kernel(scenario) else", "multiple =")
def test_a_large_loop_runs_in_a_kernel(large, monkeypatch):
    """By the scenario's own solver, also during a drag, unless the machine or the user forbids it."""
    long = dataclasses.replace(large, solver=FixedStep(1e-4, 4.0))
    assert members.takes_kernel(long)
    assert curves.draft_solver(long) is None
    assert curves.drawing_solver(long).every == 25
    monkeypatch.setenv("DIFFABS_ENGINE", "xla")
    assert not members.takes_kernel(long)
    assert curves.draft_solver(long) is not None
    monkeypatch.delenv("DIFFABS_ENGINE")
    monkeypatch.setenv("DIFFABS_KERNEL_COMPILER", "")
    replace_seam(monkeypatch, "in_kernel", {})
    assert not members.takes_kernel(long)


def test_cars_are_large_and_single_wheels_small(users_engine, monkeypatch):
    replace_seam(monkeypatch, "in_kernel", {})
    assert {name: members.takes_kernel(load(name)) for name in ("car-jump", "slip-real", "half-car")} == {
        "car-jump": True,
        "slip-real": False,
        "half-car": False,
    }


@killed_by("output.explore.members", "_in_kernel[jax.tree.structure(scenario.loop)] = False", "pass")
def test_what_a_kernel_cannot_make_is_made_by_xla(large, monkeypatch):
    asked = []

    def refuse(*given, **more):
        asked.append(more["engine"])
        raise EngineError("no rule")

    monkeypatch.setattr(members, "run_batch", refuse)
    monkeypatch.setattr(members, "rollout", lambda *given, **more: "by XLA")
    assert [members.run_alone(large, large.solver) for _ in range(2)] == ["by XLA"] * 2
    assert asked == ["kernel"]


@pytest.mark.slow
@pytest.mark.slow
@killed_by("output.explore.members", "Batch(shared | values, keys=np.arange(count) + scenario.seed)", "Batch(values)")
@killed_by("output.explore.members", "float(get(scenario.loop, path))", "1.0")
def test_runs_in_a_kernel_are_those_of_xla(large, monkeypatch):
    noisy = dataclasses.replace(large, loop=dataclasses.replace(large.loop, sensor=sensors.Noise(slip=0.01)))
    solver, values, accepted = FixedStep(1e-3, 0.2, every=7), {"plant.mass": np.array([5.3, 6.0])}, np.ones(2, bool)

    def runs():
        return members.run_alone(noisy, solver), members.run_members(noisy, values, solver, accepted)

    kernel = runs()
    monkeypatch.setenv("DIFFABS_ENGINE", "xla")
    for made, expected in zip(kernel, runs(), strict=True):
        for name in noisy.objectives if expected.metrics else ():
            np.testing.assert_allclose(made.metrics[name], expected.metrics[name], rtol=1e-9)
        jax.tree.map(
            lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9), made.trajectory, expected.trajectory
        )


@killed_by("output.explore.charts", "third - quarter, high - third", "third - quarter, high - low")
@killed_by("output.explore.charts", "greatest < DISPLAY_ROUNDING", "not greatest")
def test_charts_are_plain_json_whatever_a_run_was():
    lines = (Curve("slip", np.array([0.1, np.nan, np.inf])), Curve("target", np.array([0.0, 1e-30, 123456.789])))
    torque = Panel(
        "N m", (Curve("control", np.array([0.0, 9.03, np.nan])), Curve("command", np.array([0.0, 1e9, 5.0])))
    )
    found = Curves(np.array([0.0, 0.1, 0.2]), (Panel("1", lines), torque), {}, "", draft=False)
    change = charts.change_curves(found)
    source = change["dataset"][0]["source"]
    assert source["0.0"] == [0.1, None, None]
    assert source["0.1"] == [0.0, 1e-30, 123456.8]
    assert change["yAxis"] == [{}, {"min": 0, "max": 15.0, "interval": 5.0}]  # the command is beyond what can be given
    still = Panel("rad", (Curve("steer angle", np.array([0.0, 1e-16, np.nan])), Curve("command", np.zeros(3))))
    assert charts.change_curves(found._replace(panels=(still,)))["yAxis"] == [{"min": -1, "max": 1}]
    bands = tuple((np.array([[0.0], [1.0], [2.0], [4.0], [8.0]]),) for _ in range(2))
    steps = charts.change_fan(Fan(np.array([0.0]), bands, 200, 0, 0, ""))["dataset"][0]["source"]
    assert [steps[f"0.0.{i}"] for i in range(4)] == [[0.0], [1.0], [3.0], [4.0]]  # each on top of the one before
    empty = [charts.pole_chart(), charts.change_poles(None)]
    empty += [frequency_charts.sensitivity_chart(), frequency_charts.nyquist_chart(), frequency_charts.bode_chart()]
    json.dumps([charts.run_chart(found), change, *empty], allow_nan=False)


@killed_by("output.explore.guard", "len(host) == 1 and host[0] in self.hosts", "len(host) == 1")
@killed_by("output.explore.guard", "return here and same_origin and", "return here and")
@killed_by("output.explore.guard", "_loopback(request.client)", "True")
@killed_by("output.explore.guard", "if port == HTTP_PORT else", "if False else")
@pytest.mark.parametrize(
    ("allowed", "host", "origin", "client"),
    [
        (True, "127.0.0.1", "http://127.0.0.1", "127.0.0.1"),  # of port 80
        (True, "127.0.0.1:8342", None, "127.0.0.1"),
        (True, "localhost:8342", "http://localhost:8342", "127.0.0.1"),
        (False, "127.0.0.1:8342", "http://evil.example", "127.0.0.1"),  # another page in the same browser
        (False, "127.0.0.1:8342", "http://127.0.0.1:9000", "127.0.0.1"),  # and one served on this machine
        (False, "127.0.0.1:8342", "null", "127.0.0.1"),
        (False, "127.0.0.1:8342", "http://localhost:8342", "127.0.0.1"),
        (False, "evil.example:8342", "http://evil.example:8342", "127.0.0.1"),  # a name that leads to 127.0.0.1
        (False, "127.0.0.1", None, "127.0.0.1"),
        (False, None, None, "127.0.0.1"),
        (False, "127.0.0.1:8342", None, "192.168.0.7"),
        (False, "127.0.0.1:8342", None, None),
    ],
)
def test_only_the_own_page_on_this_machine_is_answered(allowed, host, origin, client):
    given = {b"host": host, b"origin": origin}
    headers = [(name, value.encode()) for name, value in given.items() if value is not None]
    scope = {"type": "http", "headers": headers, "client": (client, 5) if client else None}
    starlette = pytest.importorskip("starlette.requests")
    from diffabs.output.explore.guard import Guard

    port = 80 if origin == "http://127.0.0.1" else 8342
    assert Guard(None, port, TOKEN).is_allowed(starlette.HTTPConnection(scope)) == allowed


@killed_by("output.explore.guard", 'allowed and self._same([request.cookies.get(self.cookie, "")])', "allowed")
@killed_by(
    "output.explore.guard",
    'request.cookies.get(self.cookie, "")',
    'request.headers.get("cookie", "").removeprefix(f"{self.cookie}=")',
)
@killed_by(
    "output.explore.guard",
    "len(tokens) == 1 and secrets.compare_digest(tokens[0].encode(), self.token.encode())",
    "len(tokens) == 1",
)
@killed_by("output.explore.guard", "Path=/; HttpOnly;", "Path=/;")
@pytest.mark.parametrize(
    ("path", "query", "cookie", "status"),
    [
        ("/", "", "", 403),
        ("/", "token=guessed", "", 403),
        ("/", "token=", "diffabs-explore-8342=", 403),
        ("/", f"token={TOKEN}", "", 303),
        ("//elsewhere.example/", f"token={TOKEN}", "", 303),
        ("/\r\nset-cookie: a=b", f"token={TOKEN}", "", 303),
        ("/", "", f"diffabs-explore-8342={TOKEN}", 200),
        (
            "/",
            "",
            f'flag; x[0]={{"a":1}}; name=M\u00fcller; a="b c; diffabs-explore-8342={TOKEN}',
            200,
        ),  # of other tools
        ("/", "", f"diffabs-explore-8343={TOKEN}", 403),
        ("/_nicegui/1.js", "", "", 403),
        ("/_nicegui/1.js", "", f"diffabs-explore-8342={TOKEN}", 200),
    ],
)
def test_a_request_needs_the_token_once_and_then_its_cookie(path, query, cookie, status):
    pytest.importorskip("starlette")
    from diffabs.output.explore.guard import STRANGER

    sent = asyncio.run(answered("http", path, query, cookie))
    assert sent[0]["status"] == status
    headers = dict(sent[0].get("headers", []))
    if status == 303:
        assert headers[b"location"] == b"/"
        assert headers[b"set-cookie"].decode() == f"diffabs-explore-8342={TOKEN}; Path=/; HttpOnly; SameSite=Lax"
    if status == 403:
        assert sent[1]["body"].decode() == f"{STRANGER}\n"
        assert b"set-cookie" not in headers
    opened = asyncio.run(answered("websocket", path, query, cookie))
    assert (opened[0]["type"] == "reached") == (status == 200)  # no token opens a socket


async def answered(kind, path, query, cookie):
    """What a guard sends that knows TOKEN, or its application."""
    from diffabs.output.explore.guard import Guard

    sent = []

    async def send(message):
        sent.append(message)

    async def app(scope, receive, send):
        await send({"type": "reached", "status": 200})

    async def receive():
        return {}

    headers = [(b"host", b"127.0.0.1:8342"), *([(b"cookie", cookie.encode())] if cookie else [])]
    scope = {"type": kind, "path": path, "query_string": query.encode(), "headers": headers, "client": ("127.0.0.1", 5)}
    await Guard(app, 8342, TOKEN)(scope, receive, send)
    return sent


@killed_by("output.explore.server", "path.touch(mode=0o600,", "path.touch(mode=0o644,")
def test_a_browser_is_led_to_the_token_by_a_file_of_its_user(tmp_path):
    pytest.importorskip("nicegui")
    from diffabs.output.explore.server import write_redirect_file

    path = write_redirect_file(f"http://127.0.0.1:8342/?token={TOKEN}", tmp_path)
    assert path.stat().st_mode & 0o077 == 0
    assert f'url=http://127.0.0.1:8342/?token={TOKEN}"' in path.read_text()


@killed_by(
    "output.explore.work",
    "            self._job = job\n",
    "            self._job = (lambda a, b: lambda: (a(), b()))(self._job, job) if self._job else job\n",
)
def test_a_worker_does_the_newest_and_drops_what_waited():
    gate, done, ended = threading.Event(), [], threading.Event()
    worker = NewestJobThread("test of a worker")
    began = threading.Event()
    worker.ask(lambda: (began.set(), gate.wait(10), done.append(0)))
    assert began.wait(10)
    for i in range(1, 5):
        worker.ask(lambda i=i: (done.append(i), ended.set()))
    gate.set()
    assert ended.wait(10)
    assert done == [0, 4]
    worker.end()


@killed_by("output.explore.work", "contextlib.suppress(Exception)", "contextlib.suppress(OSError)")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_worker_goes_on_after_a_failed_job():
    failing, done = threading.Event(), threading.Event()
    worker = NewestJobThread("test of a worker")
    worker.ask(lambda: (failing.set(), 1 / 0))
    assert failing.wait(10)
    worker.ask(done.set)
    assert done.wait(10)
    worker.end()


@pytest.mark.slow
@killed_by("cli.explore", "PORT = 8342\n", "PORT = 8342\nfrom diffabs.tune import Method as Method\n")
def test_the_framework_is_only_loaded_by_the_command():
    code = "import sys, diffabs.output.explore, diffabs.cli.main, diffabs.output.explore.session as s;"
    code += " s.Session('slip-cured');"
    code += " print(sorted({'nicegui', 'fastapi', 'uvicorn', 'optax', 'cvxpy', 'matplotlib'} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_without_the_extra_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(console.EXTRAS, "explore", ("no_such_framework",))
    found = run("explore", "slip-cured", status=2)
    assert found.stderr == 'error: no_such_framework needed: pip install ".[explore]" in a clone\n'


@killed_by(
    "output.explore.server", "    except OSError:\n        if port is", "    except TimeoutError:\n        if port is"
)
def test_a_refused_usual_port_is_replaced(monkeypatch, file):
    pytest.importorskip("nicegui")
    from diffabs.output.explore import server

    create, ports = socket.create_server, []

    def refuse(address):
        if address[1] == 8342:
            raise PermissionError(errno.EACCES, "Permission denied")
        return create(address)

    def serve(source, tools, folder, there, **more):
        with there:
            ports.append(there.getsockname()[1])

    monkeypatch.setattr(socket, "create_server", refuse)
    monkeypatch.setattr(server, "serve", serve)
    run("explore", file(SHORT), status=130)
    assert ports[0] not in (0, 8342)
    assert run("explore", file(SHORT), "--port", 8342, status=2).stderr == "error: --port 8342: Permission denied\n"


def test_a_wrong_scenario_is_refused_before_listening(monkeypatch, file):
    monkeypatch.setitem(console.EXTRAS, "explore", ())
    found = run("explore", file("[plant]\ntype = 'quarter-car'\nmass = -1.0"), status=2)
    assert re.fullmatch(r"error: plant\.mass = -1 is outside \(0, inf\) kg\n", found.stderr)


@pytest.mark.slow
def test_precision_is_that_of_the_command_line(session):
    assert jax.config.jax_enable_x64
    assert curves.run_curves(session.scenario()).t.dtype == np.float64
