"""Scenarios: packaged ones, the round trip, overrides, defaults, the catalogue."""

import dataclasses
import sys

import jax
import numpy as np
import pytest
from mutants import killed_by
from seams import replace_seam

from diffabs import controllers, roads
from diffabs.engine.solvers import Adaptive, FixedStep
from diffabs.parts.objectives import BRAKING
from diffabs.scenario import outside, registry, scenario
from diffabs.scenario.defaults import braking
from diffabs.scenario.scenario import dump, load, names
from diffabs.scenario.section_design import DesignTask
from diffabs.scenario.section_sweep import build_study
from diffabs.scenario.section_tune import Goal
from diffabs.tune import risk
from diffabs.uncertainty.sweep.distributions import Uniform

pytestmark = pytest.mark.usefixtures("any_step_is_stable")


def assert_same(a: scenario.Scenario, b: scenario.Scenario):
    assert jax.tree.structure((a.loop, dict(a.objectives))) == jax.tree.structure((b.loop, dict(b.objectives)))
    for x, y in zip(jax.tree.leaves((a.loop, a.objectives)), jax.tree.leaves((b.loop, b.objectives)), strict=True):
        np.testing.assert_array_equal(np.asarray(x, float), np.asarray(y, float))
    assert (a.name, a.title, a.description, a.solver, a.seed) == (b.name, b.title, b.description, b.solver, b.seed)
    assert a.design == b.design
    assert a.tune == b.tune


# What is packaged


def test_packaged_names():
    assert {"slip-lmi", "slip-estimator", "slip-cured", "lab-rig"} <= set(names())


@killed_by(
    "scenario.parameter_paths", "return tuple(scale_to_si(end, self.scale) for end in ends)", "return tuple(ends)"
)
def test_slip_lmi_is_the_papers_example():
    s = load("slip-lmi")
    assert type(s.loop.plant).__name__ == "MirroredRig"
    assert s.loop.plant.mass == 5.3
    assert s.loop.plant.road.q == 2.10
    np.testing.assert_array_equal(s.loop.controller.gain, [-11753, -48])
    assert (s.loop.controller.low, s.loop.controller.high) == (-np.inf, np.inf)
    assert isinstance(s.loop.feedforward, controllers.HoldingInput)
    assert s.loop.initial.speed == pytest.approx(50 / 3.6, rel=1e-15)
    assert s.loop.stop.speed == pytest.approx(5 / 3.6, rel=1e-15)
    assert s.loop.reference.slip == 0.2
    assert s.title
    assert s.description
    speeds = (s.loop.stop.speed, s.loop.initial.speed)
    over = {"plant.mass": (5.3, 6.2), "initial.speed": speeds}
    assert s.design == DesignTask(Q=(11753.0**2, 1.0), R=1.0, over=over)
    assert s.design.box(s.loop) == {"plant.mass": (5.3, 6.2), "speed": speeds}


def test_slip_estimator_is_the_papers_example():
    s = load("slip-estimator")
    c = s.loop.controller
    assert (c.kp, c.ki, c.kd, c.cutoff, c.low, c.high) == (3893, 5000, 5.67, 55, 0, 90)
    assert type(s.loop.reference).__name__ == "PeakLatch"
    assert (s.loop.plant.mass, s.loop.plant.radius, s.loop.plant.inertia) == (15, 0.2, 1.04456)
    np.testing.assert_array_equal(s.loop.plant.road.mu, roads.SPLINE_B.mu)
    assert s.loop.initial.speed == pytest.approx(100 / 3.6, rel=1e-15)


@killed_by("scenario.scenario", 'for name in ("design", "tune", "sweep")}', 'for name in ("tune", "sweep")}')
@killed_by("scenario.scenario", 'for name in ("design", "tune", "sweep")}', 'for name in ("design", "sweep")}')
@pytest.mark.parametrize("name", names())
def test_packaged_scenario_survives_dump_and_load(name, file):
    first = load(name)
    assert_same(first, load(file(dump(first), f"{name}.toml")))


NESTED = """
title = 'quotes " and \\ and ü'
description = "two\\nlines, \\u00df"
[plant]
mass = 0.1
[road]
type = "patches"
roads = ["snow", {type = "scaled", scale = 0.7, road = "ice"}, {type = "magic-formula", B = 9.0}]
edges = [5.0, 7.123456789012345]
[controller]
type = "sampled"
period = 0.002
[controller.controller]
kp = 0.1
high = inf
antiwindup = {type = "back-calculation", tracking_time = 0.3}
[sensor]
type = "series"
blocks = [{type = "noise", slip = 0.01}, "wheel-speed", {type = "bias", slip = 1e-300}]
[actuator]
type = "series"
blocks = ["lag", {type = "delay", time = 0.02, capacity = 99}]
[solver]
step = 1e-3
duration = 1.25
every = 7
seed = 42
[objective]
effort = "effort"
"odd name" = {type = "quadratic-cost", q = [2.0, 3.0]}
settling_time = {band = 0.02}
"""


def test_everything_nested_survives_dump_and_load(file):
    first = load(file(NESTED))
    assert first.description == "two\nlines, \xdf"
    assert_same(first, load(file(dump(first))))
    assert first.loop.plant.road.roads[1].road is roads.ICE
    assert first.loop.controller.controller.antiwindup.tracking_time == 0.3
    assert first.loop.actuator.blocks[1].capacity == 99
    assert first.objectives["settling_time"].band == 0.02
    assert list(first.objectives) == [*BRAKING, "effort", "odd name"]
    assert first.solver == FixedStep(step=1e-3, duration=1.25, every=7)
    assert jax.numpy.array_equal(jax.random.key_data(first.key()), jax.random.key_data(jax.random.key(42)))


@killed_by("scenario.registry", "_numbers(item, depth - 1, spec,", "_numbers(item, 0, spec,")
def test_a_matrix_survives_dump_and_load(file):
    first = load("arm-balance", ["controller=observer-feedback"], integrated=False)
    assert first.loop.controller.transition.shape == (6, 6)
    assert_same(first, load(file(dump(first), "arm-balance.toml"), integrated=False))


CHOOSER = """from diffabs.core.protocols import no_flow, no_memory
from diffabs.core.pytree import pytree, static

@pytree
class Chooser:
    order: int = static(default=0)
    taps: int = static(default=4)
    scale: float = static(default=3.0)
    soft: bool = static(default=False)
    mode: str = static(default="mild")
    start = no_memory
    flow = no_flow

    def output(self, t, memory, signal):
        return self.scale * signal.target
"""


@killed_by("scenario.registry", "1 if default >= 1 else -MAX_STATIC", "1")
@killed_by("scenario.registry", "value if field.default is dataclasses.MISSING else field.default", "value")
@killed_by("scenario.registry", "type(value) is not int", "not isinstance(value, int)")
@pytest.mark.parametrize("changes", [[], ["order=-2", "taps=9", "scale=4", "soft=true", "mode=firm"]], ids=["0", "5"])
def test_choices_of_a_part_of_ones_own_are_read_again(changes, tmp_path, file):
    (tmp_path / "choosers.py").write_text(CHOOSER)
    with outside.lend_modules(tmp_path, ["choosers"]):
        first = load("slip-lmi", ["controller=chooser", *(f"controller.{change}" for change in changes)])
        assert_same(first, load(file(dump(first), "slip-lmi.toml")))
        chooser = registry.family_types("controller")["chooser"]
        usual = dataclasses.replace(chooser, order=5)  # where a plant names it
        assert registry.fill_part(usual, {"order": -2}, "controller", "controller").order == -2
        about = registry.describe_part("controller", chooser)
        ranges = {name: row["range"] for name, row in about.items() if row["range"]}
        assert ranges == {"order": "[-10000000, 10000000]", "taps": "[1, 10000000]"}
        with pytest.raises(scenario.ScenarioError, match=r"controller\.taps = 0 is outside \[1, 10000000\]"):
            load("slip-lmi", ["controller=chooser", "controller.taps=0"])
    sys.modules.pop("choosers")


@killed_by("scenario.registry", "    if isinstance(part, tuple | list):", "    if isinstance(part, tuple):")
@killed_by("scenario.registry", "if isinstance(items, tuple | list) else", "if isinstance(items, tuple) else")
def test_parts_in_a_list_are_described_like_those_in_a_tuple():
    listed, tupled = (roads.Patches(roads=kind([roads.SNOW, roads.SPLINE_B]), edges=[5.0]) for kind in (list, tuple))
    assert [path for path, _ in registry.part_choices(listed, "road")] == ["road", "road.roads.0", "road.roads.1"]
    assert registry.describe_part("road", listed) == registry.describe_part("road", tupled)


def test_what_is_left_out_has_its_default(file):
    s = load(file(""))
    assert_same(s, scenario.Scenario(name="mine", loop=braking(), solver=Adaptive()))


@pytest.mark.parametrize(
    ("section", "solver"),
    [
        ("duration = 3.0", Adaptive(duration=3.0)),
        ("rtol = 1e-6\nstep = 1e-2", Adaptive(rtol=1e-6, step=1e-2)),
        ("step = 1e-4", FixedStep(step=1e-4)),
        ("kinks = true", FixedStep(kinks=True)),
        ('type = "fixed"', FixedStep()),
        ('type = "adaptive"\nstep = 1e-2', Adaptive(step=1e-2)),
    ],
)
def test_steps_are_adaptive_unless_their_length_is_given(file, section, solver):
    assert load(file(f"[solver]\n{section}\n")).solver == solver


# The catalogue


def test_members_are_told_by_shape():
    assert set(registry.family_types("plant")) == {
        "quarter-car",
        "mirrored-rig",
        "road-vehicle",
        "lab-rig",
        "arm-balance",
        "acrobot",
        "printed-arm",
        "quadruple-tank",
        "half-car",
        "car",
    }
    assert set(registry.family_types("initial")) == {"brake-start", "balance-start", "tank-start"}
    assert {"burckhardt", "snow", "rig-unrounded", "spline-b"} <= set(registry.family_types("road"))
    assert not {"peak", "piecewise-cubic"} & set(registry.family_types("road"))
    assert set(registry.family_types("tyre")) == {"road-tyre", "pacejka-tyre", "relaxed-tyre"}
    assert "pid" in registry.family_types("controller")
    assert set(registry.family_types("antiwindup")) == {"no-anti-windup", "clamping", "back-calculation"}
    assert set(registry.family_types("feedforward")) == {"no-feedforward", "constant-input", "holding-input"}
    assert not set(registry.family_types("controller")) & {
        *registry.family_types("antiwindup"),
        *registry.family_types("feedforward"),
    }
    assert {"direct", "series", "lag"} <= set(registry.family_types("actuator"))
    assert {"direct", "series", "noise"} <= set(registry.family_types("sensor"))
    assert set(registry.family_types("stop")) == {"standstill", "speed-reached", "fallen", "no-stop"}
    assert registry.family_types("road")["snow"] is roads.SNOW


@pytest.mark.parametrize("family", registry.FAMILIES)
def test_every_exported_part_is_in_one_family_or_another(family):
    """An exported part class that no family recognises could not be used in a scenario."""
    modules, _ = registry.FAMILIES[family]
    known = {type(part) for name in registry.FAMILIES for part in registry.family_types(name).values()}
    helpers = {"Peak"}
    for module in modules:
        classes = {x for x in vars(module).values() if isinstance(x, type) and dataclasses.is_dataclass(x)}
        assert {c.__name__ for c in classes - known} <= helpers


def test_every_objective_says_its_unit():
    units = {name: registry.unit_of(part) for name, part in BRAKING.items()}
    assert units == {
        "stop_time": "s",
        "stop_distance": "m",
        "max_slip": "1",
        "overshoot": "1",
        "settling_time": "s",
        "iae": "s",
        "final_slip_error": "1",
        "locked_time": "s",
    }


# Overrides


def test_overrides_reach_every_kind_of_field(file):
    path = file(
        '[road]\ntype="patches"\nroads=["snow","ice"]\n[controller]\ntype="sampled"\n[initial]\nspeed_kmh=50.0\n'
        "[solver]\nstep=1e-3"
    )
    changes = (
        "title=two words",
        "controller.controller.kp=12",
        "controller.controller.antiwindup=clamping",
        "road.roads.0.c1=0.5",
        "road.edges=[3]",
        "initial.speed=10",
        "stop.speed_kmh=3.6",
        "solver.seed=3",
        "plant.road.width = 0.5",
        "objective.settling_time.band=0.05",
        "actuator={type='lag', time_constant=0.1}",
        "feedforward=holding-input",
    )
    s = load(path, changes)
    assert s.title == "two words"
    assert s.loop.controller.controller.kp == 12.0
    assert isinstance(s.loop.controller.controller.kp, float)
    assert isinstance(s.loop.controller.controller.antiwindup, controllers.Clamping)
    assert s.loop.plant.road.roads[0].c1 == 0.5
    assert s.loop.plant.road.roads[0].c2 == roads.SNOW.c2
    assert s.loop.plant.road.roads[1] is roads.ICE
    np.testing.assert_array_equal(s.loop.plant.road.edges, [3.0])
    assert s.loop.plant.road.width == 0.5
    assert s.loop.initial.speed == 10.0
    assert s.loop.stop.speed == pytest.approx(1.0, rel=1e-15)
    assert s.seed == 3
    assert s.objectives["settling_time"].band == 0.05
    assert s.loop.actuator.time_constant == 0.1
    assert isinstance(s.loop.feedforward, controllers.HoldingInput)


def test_a_list_needs_no_brackets():
    np.testing.assert_array_equal(load("slip-lmi", ["controller.gain=-1000,-50"]).loop.controller.gain, [-1000, -50])


def test_a_bare_type_replaces_the_part():
    s = load("slip-estimator", ["controller=relay", "controller.band=0.03"])
    assert type(s.loop.controller).__name__ == "Relay"
    assert s.loop.controller.band == 0.03


def test_default_members_of_a_tuple_can_be_changed(file):
    s = load(file(""), ["road=patches", "road.roads.1.c1=0.3"])
    assert s.loop.plant.road.roads[0] is roads.DRY_ASPHALT
    assert s.loop.plant.road.roads[1].c1 == 0.3


@killed_by("scenario.scenario", "if not removed:", "if True:")
def test_a_note_names_what_a_replaced_part_takes_along():
    s = load("slip-lmi", ["road=snow", "plant.mass=6"])
    assert s.notes == ("road=snow removes sweep.over.road.w4, sweep.over.road.a of the replaced part",)
    assert not {"plant.road.w4", "plant.road.a"} & s.sweep.over.keys()
    assert load("slip-lmi", ["sensor=noise"]).notes == ()


def test_a_file_may_begin_with_a_byte_order_mark(file):
    assert load(file("\ufefftitle = 'mine'")).title == "mine"


# What a design is for

RANGES = """
[design]
Q = [[4, 1], [1, 3.0]]
R = [2]
decay = 1
damping = 0.25
"""


@killed_by(
    "scenario.parameter_paths",
    '            pending += [(f"{path}.{key}", item) for key, item in list(value.items())[::-1]]\n            continue',
    "            flat[path] = value\n            continue",
)
def test_ranges_are_the_same_however_they_are_written(file):
    dotted = load(
        file(
            RANGES
            + """[design.over]
            "plant.mass" = [5, 6.5]
            "road.scale" = [0.5, 1.0]
            "initial.speed_kmh" = [3.6, 36.0]
            [road]
            type = "scaled"
            """
        )
    )
    nested = load(
        file(
            RANGES
            + """[design.over]
            initial = {speed = [1.0, 10.0]}
            [design.over.plant]
            mass = [5.0, 6.5]
            [design.over.plant.road]
            scale = [0.5, 1]
            [road]
            type = "scaled"
            """
        )
    )
    over = {"plant.mass": (5.0, 6.5), "plant.road.scale": (0.5, 1.0), "initial.speed": (1.0, 10.0)}
    assert dotted.design == DesignTask(Q=((4.0, 1.0), (1.0, 3.0)), R=(2.0,), decay=1.0, damping=0.25, over=over)
    assert nested.design == dotted.design
    assert nested.design.box(nested.loop) == {"plant.mass": (5.0, 6.5), "plant.road.scale": (0.5, 1), "speed": (1, 10)}
    assert_same(dotted, load(file(dump(dotted))))


@pytest.mark.parametrize(
    "change",
    ["design.over.plant.road.w4=0.38,0.42", "design.over.road.w4=0.38,0.42", 'design.over."road.w4"=0.38,0.42'],
)
def test_overrides_reach_ranges(change):
    first = "design.over.plant.road.w4=0,1"
    s = load("slip-lmi", [first, change, "design.Q=1,2", "design.over.initial.speed=2,3", "design.over.plant.mass=5,6"])
    assert s.design.Q == (1.0, 2.0)
    assert s.design.over == {"plant.mass": (5, 6), "initial.speed": (2, 3), "plant.road.w4": (0.38, 0.42)}


def test_ranges_by_the_names_of_the_linear_model(file):
    text = """
    reference = "peak-latch"
    [controller]
    type = "sampled"
    [actuator]
    type = "series"
    blocks = ["limits", "lag"]
    [design.over]
    "reference.slip" = [0.1, 0.2]
    "controller.delay" = [0.0, 1e-3]
    "actuator.blocks.1.time_constant" = [0.01, 0.02]
    """
    s = load(file(text))
    default = (s.loop.stop.speed, s.loop.initial.speed)
    ranges = {"slip": (0.1, 0.2), "sampling.delay": (0, 1e-3), "actuator.time_constant": (0.01, 0.02)}
    assert s.design.box(s.loop) == {**ranges, "speed": default}
    lag = load(file('actuator = "lag"\n[design.over]\nactuator.time_constant = [0.01, 0.02]'))
    assert lag.design.box(lag.loop) == {"actuator.time_constant": (0.01, 0.02), "speed": default}


def test_no_stable_step_is_needed_for_what_is_not_integrated(monkeypatch):
    replace_seam(monkeypatch, "stable_step", lambda loop: pytest.fail("asked"))
    load("slip-lmi", integrated=False)


# What tuning is for

TUNED = """
reference = "filtered-slip"
[controller]
type = "state-feedback"
[road]
type = "scaled"
road = "snow"
[objective]
effort = "effort"
[tune]
starts = 3
seed = 11
iterations = 7
samples = 20
decay = 12
damping = 0.5
aggregate = "quantile"
[tune.objective]
effort = 1e-4
stop_time = 2
[tune.limits]
locked_time = 0
"""
WHAT = Goal(
    starts=3,
    seed=11,
    iterations=7,
    samples=20,
    decay=12.0,
    damping=0.5,
    free={
        "controller.gain": ((-2e4, -300.0), (-100.0, -15.0)),
        "reference.time_constant": None,
        "plant.road.scale": (0.5, 1.5),
        "initial.speed": (5.0, 30.0),
    },
    objective={"effort": 1e-4, "stop_time": 2.0},
    over={"plant.mass": (12.0, 15.5), "stop.speed": (0.5, 1.0), "plant.road.road.c1": (1.0,)},
    aggregate={"type": "quantile", "level": 0.9},
    limits={"locked_time": 0.0},
)


@killed_by(
    "scenario.parameter_paths", "return tuple(scale_to_si(end, self.scale) for end in ends)", "return tuple(ends)"
)
def test_what_is_tuned_is_the_same_however_it_is_written(file):
    dotted = load(
        file(
            TUNED
            + """[tune.free]
            "controller.gain" = [[-2e4, -300], [-100, -15.0]]
            "reference.time_constant" = "declared"
            "plant.road.scale" = [0.5, 1.5]
            "initial.speed_kmh" = [18, 108]
            [tune.over]
            "plant.mass" = [12, 15.5]
            "stop.speed" = [0.5, 1.0]
            "road.road.c1" = 1
            """
        )
    )
    nested = load(
        file(
            TUNED
            + """[tune.free.controller]
            gain = [[-2e4, -300], [-100.0, -15]]
            [tune.free]
            reference = {time_constant = "declared"}
            road.scale = [0.5, 1.5]
            initial.speed = [5, 30]
            [tune.over]
            plant = {mass = [12.0, 15.5], road = {road = {c1 = [1.0]}}}
            stop.speed_kmh = [1.8, 3.6]
            """
        )
    )
    assert dotted.tune == WHAT
    assert nested.tune == WHAT
    assert_same(dotted, load(file(dump(dotted))))


def test_overrides_reach_what_is_tuned():
    changes = (
        "tune.free.controller.gain=[[-2e4,-200],-20]",
        'tune.free."reference.slip"=0.1,0.3',
        "tune.over.plant.mass=5.3,6.2",
        "tune.over.initial.speed_kmh=36",
        "tune.over.plant.road.w4=0.3,0.4",
        "tune.aggregate=smooth-worst",
        "tune.aggregate.softness=0.1",
        "tune.limits.overshoot=0.2",
        "tune.objective={stop_time=1}",
        "tune.starts=4",
    )
    goal = load("slip-lmi", changes).tune
    assert goal.free == {"controller.gain": ((-2e4, -200.0), -20.0), "reference.slip": (0.1, 0.3)}
    assert goal.over == {"plant.mass": (5.3, 6.2), "initial.speed": (10.0,), "plant.road.w4": (0.3, 0.4)}
    assert goal.aggregate == {"type": "smooth-worst", "softness": 0.1}
    assert (goal.limits, goal.objective, goal.starts) == ({"overshoot": 0.2}, {"stop_time": 1.0}, 4)


def test_lanes_in_the_other_unit_replace_those_in_one():
    goal = load("slip-cured", ["tune.over.initial.speed=9,10"]).tune
    assert goal.over == {"plant.mass": (5.3, 5.75, 6.2), "initial.speed": (9.0, 10.0)}


def test_lanes_are_every_combination_with_one_noise():
    batch = load("slip-cured", ["solver.seed=4"]).tune.batch(4)
    pairs = {(m, round(3.6 * v)) for m, v in zip(*(batch.values[path].tolist() for path in batch.values), strict=True)}
    assert pairs == {(m, v) for m in (5.3, 5.75, 6.2) for v in (20, 35, 50)}
    assert tuple(batch.keys) == (4,) * 9


@pytest.mark.parametrize("kind", risk.AGGREGATE_TYPES)
def test_aggregates_are_those_of_the_library(kind):
    part = load("slip-lmi", [f"tune.aggregate={kind}"]).tune.read_aggregate()
    assert type(part) is risk.AGGREGATE_TYPES[kind]
    assert vars(part) == vars(risk.AGGREGATE_TYPES[kind]())


def test_slip_cured_is_the_rig_with_what_the_paper_leaves_out():
    s = load("slip-cured")
    assert type(s.loop.controller.controller) is controllers.ProportionalFeedback
    assert (s.loop.controller.controller.low, s.loop.controller.controller.high) == (0.0, 9.03)
    assert (s.loop.controller.period, s.loop.actuator.time_constant) == (1e-3, 1e-3)
    here = s.loop.plant.output(s.loop.plant.start(s.loop.initial))
    assert s.loop.plant.mass == 5.75
    assert s.loop.feedforward.value == pytest.approx(float(s.loop.plant.holding(here, 0.2)), rel=1e-12)


@pytest.mark.usefixtures("any_step_is_stable")
def test_a_replaced_part_takes_its_ranges_with_it():
    assert set(load("slip-lmi").design.over) == {"plant.mass", "initial.speed"}
    assert set(load("slip-lmi", ["plant=lab-rig"]).design.over) == {"initial.speed"}
    again = load("slip-lmi", ["plant=quarter-car", "design.over.plant.mass=12,20"])
    assert again.design.over["plant.mass"] == (12.0, 20.0)


@pytest.mark.parametrize("change", ["controller=pid", "controller={type='pid'}"])
def test_another_part_takes_what_is_tuned_with_it(change):
    first = ("tune.over.controller.low=0,1", "tune.free.reference.slip=0.1,0.3")
    goal = load("slip-lmi", [*first, change]).tune
    assert set(goal.free) == {"reference.slip"}
    assert set(goal.over) == {"plant.mass"}
    assert set(load("slip-cured", ["controller.controller=pid"]).tune.free) == {"reference.time_constant"}
    again = load("slip-lmi", [change, "tune.free.controller.kp=1000,5000"]).tune
    assert again.free == {"controller.kp": (1000.0, 5000.0)}


@killed_by("scenario.scenario", "[0, self.seed]", "[self.seed, 0]", case="7")
@killed_by("scenario.scenario", "and 0 <= self.seed < 2**31:", ":", case="1099511627776")
@pytest.mark.parametrize("seed", [0, 7, 2**31 - 1, 2**40])
def test_the_key_of_a_run_is_that_of_jax(seed):
    found, wanted = scenario.Scenario("mine", seed=seed).key(), jax.random.key(seed)
    assert found.dtype == wanted.dtype
    np.testing.assert_array_equal(jax.random.key_data(found), jax.random.key_data(wanted))


@killed_by("scenario.scenario", 'keys[:-1] if place == "type" else keys', "keys")
@killed_by("scenario.scenario", "isinstance(part, str) and part != old_type", "isinstance(part, str)")
def test_a_type_alone_replaces_a_part_too():
    assert "reference.time_constant" in load("slip-cured").tune.free
    found = load("slip-cured", ["reference.type=limited-slip"])
    assert "reference.time_constant" not in found.tune.free
    removes = "removes tune.free.reference.time_constant of the replaced part"
    assert found.notes == (f"reference.type=limited-slip {removes}",)
    assert load("slip-cured", ["reference=limited-slip"]).notes == (f"reference=limited-slip {removes}",)
    same = load("slip-cured", ["reference.type=filtered-slip"])
    assert "reference.time_constant" in same.tune.free
    assert same.notes == ()


@killed_by("scenario.scenario", 'node.get("type", _usual_type(table, replaced))', 'node.get("type")')
def test_the_type_of_the_usual_part_replaces_nothing():
    """`slip-lmi` gives its start no type, and a rig has a brake's start."""
    found = load("slip-lmi", ["initial.type=brake-start"])
    assert (found.notes, found.loop.initial.speed) == ((), pytest.approx(50 / 3.6, rel=1e-15))
    assert "initial.speed" in found.design.over
    assert "initial.speed" in found.sweep.over
    other = load("slip-lmi", ["road.type=scaled", "road.road=rig"])
    assert other.notes == ("road.type=scaled removes sweep.over.road.w4, sweep.over.road.a of the replaced part",)


# Intervals

INTERVALS = (
    "plant.mass={low=5,high=6}",
    '"plant.mass"={low=5,high=6}',
    "plant={mass={low=5,high=6}}",
    '"plant.mass"="5:6"',
)


@killed_by("scenario.parameter_paths", "is_interval = isinstance(value, dict) and", "is_interval = False and")
@pytest.mark.parametrize("form", INTERVALS)
def test_an_interval_has_one_notation(file, form):
    """In files and on the command line, for a design, a tuning, its drawn runs and a sweep."""
    given = ["tune.samples=4", "tune.objective={iae=1.0}", f"tune.over={{{form}}}"]
    given += [f"tune.free={{{form}}}".replace("plant", "initial").replace("mass", "speed")]
    given += [f"design.over={{{form}}}", f"sweep.over={{{form}}}"]
    found = load("slip-lmi", given)
    assert found.design.over["plant.mass"] == (5.0, 6.0)
    assert found.tune.over["plant.mass"] == (5.0, 6.0)
    assert found.tune.free["initial.speed"] == (5.0, 6.0)
    assert found.sweep.over["plant.mass"] == Uniform(5.0, 6.0)
    written = dump(found)
    assert written.count("{low = 5.0, high = 6.0}") == 3
    assert dump(dataclasses.replace(load(file(written)), name=found.name)) == written


def test_an_interval_on_the_command_line_and_of_a_list():
    ends = "{low=[-2e4,-300],high=[-100,-15]}"
    found = load(
        "slip-lmi", ["design.over.plant.mass=5:6", "sweep.over.plant.mass=5:6", f"tune.free.controller.gain={ends}"]
    )
    assert (found.design.over["plant.mass"], found.sweep.over["plant.mass"]) == ((5.0, 6.0), Uniform(5.0, 6.0))
    assert found.tune.free["controller.gain"] == ((-2e4, -300.0), (-100.0, -15.0))
    pair = load("slip-lmi", ["design.over.plant.mass=[5,6]"])  # two ends are no list of values here
    assert pair.design.over["plant.mass"] == (5.0, 6.0)
    nested = load(
        "slip-lmi", ["controller=pid", "tune.free={controller={low=[-9,-1],high=[1,9]}}", "tune.objective={iae=1}"]
    )
    assert nested.tune.free == {"controller.low": (-9.0, -1.0), "controller.high": (1.0, 9.0)}


# What varies in a sweep


@killed_by("scenario.parameter_paths", 'f"{path}.".startswith("plant.road.")', 'path.startswith("plant.road.")')
def test_a_choice_of_roads_is_written_and_read(file):
    there = load("slip-lmi", ['sweep.over={road=["rig", "snow"], plant={mass={low=5.3,high=6.2}}}'])
    again = load(file(dump(there)))
    assert dump(dataclasses.replace(again, name=there.name)) == dump(there)
    assert list(again.sweep.over) == ["plant.road", "plant.mass"]
    assert again.sweep.over["plant.road"].parts["snow"] is roads.SNOW


@killed_by("scenario.parameter_paths", ', ("sweep", "design", "levels"))', ")", case="nested")
@killed_by("scenario.section_sweep", "levels = _by_varied_path(levels,", "levels = levels or _by_varied_path(levels,")
@pytest.mark.parametrize(
    "levels",
    [
        '{"plant.road.w4"=3, "initial.speed"=2}',
        '{"road.w4"=3, "initial.speed_kmh"=2}',
        "{road={w4=3}, initial.speed=2}",
    ],
    ids=["loop", "short", "nested"],
)
def test_levels_of_a_grid_have_the_paths_of_what_varies(file, levels):
    over = '"road.w4" = {low = 0.3, high = 0.4}\n"initial.speed_kmh" = "20:40"'
    chosen = load(file(f'plant = "mirrored-rig"\n[sweep]\ndesign = {{type = "grid", levels = {levels}}}\n'
                       f"[sweep.over]\n{over}"))  # fmt: skip
    assert chosen.sweep.design.levels == {"plant.road.w4": 3, "initial.speed": 2}
    assert build_study(chosen).samples == 6
    assert load(file(dump(chosen))).sweep.design == chosen.sweep.design


@killed_by("scenario.parameter_paths", "return [*table, canonical_path", "return [*table] or [*table, canonical_path")
def test_a_level_of_a_grid_is_changed(file):
    """The file has the paths with dots."""
    path = file("""plant = "mirrored-rig"
    controller = {type = "pid", high = 9.0}
    [sweep.over]
    "controller.high" = { low = 5, high = 9 }
    "initial.speed_kmh" = { low = 20, high = 40 }
    [sweep.design]
    type = "grid"
    levels = {"controller.high" = 3, "initial.speed_kmh" = 2}""")
    assert build_study(load(path)).samples == 6
    changes = ["sweep.design.levels.controller.high=4", "sweep.design.levels.initial.speed=5"]
    assert build_study(load(path, changes)).samples == 20


@killed_by("scenario.registry", "is_class and inner_family == family", "inner_family == family")
def test_a_constant_has_its_own_inner_part(tmp_path):
    text = "from diffabs import roads\nWORN = roads.Scaled(road=roads.ICE, scale=0.8)\n"
    (tmp_path / "worn_roads.py").write_text(text)
    with outside.lend_modules(tmp_path, ["worn_roads"]):
        assert load("slip-lmi", ["sweep.over={}", "road=worn"]).loop.plant.road.road is roads.ICE
        varied = load("slip-lmi", ["sweep.over={road=['rig', 'worn']}"]).sweep.over["plant.road"]
        assert varied.parts["worn"].road is roads.ICE
    sys.modules.pop("worn_roads")


@killed_by("scenario/scenarios/literature-mathworks.toml", "0.249960856269", "0.249958735168", case="dry")
@pytest.mark.parametrize(
    ("name", "share"), [("literature-mathworks", 1.0), ("literature-vipulsree", 0.8)], ids=["dry", "case 1"]
)
def test_the_load_of_a_quarter_car_in_feet(name, share):
    """32.18 ft/s2 of 0.3048 m, for a road whose weight is m times 9.81 m/s2."""
    scale = load(name, integrated=False).loop.plant.road.scale
    assert scale == pytest.approx(share * 32.18 * 0.3048 / 9.81 / 4, rel=1e-11)


@killed_by("scenario.section_design", "if ends[0] < ends[1]}\n        paths", "}\n        paths")
def test_a_single_value_of_the_model_is_no_range():
    changes = ["reference=setpoint", "reference.value=0.2", "design.over.reference.slip=0.2,0.2"]
    chosen = load("slip-lmi", changes, integrated=False)
    assert chosen.design.over["reference.slip"] == (0.2, 0.2)
    assert list(chosen.design.ranges(chosen.loop)) == ["plant.mass", "initial.speed"]
