"""Nothing that one run would refuse is run in a batch, and a run whose numbers cannot be says so."""

import dataclasses
import json
import re

import commands
import jax
import jax.numpy as jnp
import lorenz
import numpy as np
import pytest
from mutants import killed_by
from seams import replace_seam
from sweeping import described

import diffabs as d
from diffabs import actuators, controllers, objectives, plants, references, roads, sensors
from diffabs.core.protocols import BrakeOutput, Ending, Sample, resting_segment
from diffabs.core.pytree import canonical_dtypes, replace
from diffabs.core.validity import find_problems
from diffabs.loop import admissible
from diffabs.loop import stability as stable_step
from diffabs.loop.result import _is_impossible
from diffabs.parts.objectives import BALANCE, BRAKING
from diffabs.parts.plants.audit import BrakeAudit
from diffabs.parts.stops import Fallen, SpeedReached
from diffabs.robust.design.attraction import classify_starts
from diffabs.scenario.defaults import braking
from diffabs.tune import Method, StartError, build_problem, tune, worst_case
from diffabs.tune.identify import Traces, identify
from diffabs.uncertainty.reliability.failure import failure_probability
from diffabs.uncertainty.sweep import Results, sweep
from diffabs.uncertainty.sweep.statistics.summary import summarise_sweep

RIG = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=50 / 3.6),
    sensor=sensors.WheelSpeed(),
    feedforward=controllers.HoldingInput(),
    controller=controllers.StateFeedback(),
    stop=SpeedReached(),
)  # `sensor=wheel-speed` of slip-lmi
SOLVER = d.FixedStep(1e-3, 0.25)
FEEDBACK = controllers.ScheduledFeedback(speeds=np.array([2.0, 9.0]))
ROAD = roads.Patches(roads=(roads.RIG, roads.SNOW, roads.RIG), edges=np.array([3.0, 5.0]))
BAD = {  # a loop, values by lane of which the first is fine, and what is said of the others
    "limits": (
        replace(RIG, {"controller.low": 0.0, "controller.high": 9.0}),
        {"controller.low": [0.0, 9.5, np.nan], "controller.high": [9.0, 9.0, 9.0]},
        ["controller.low exceeds high", "controller.low is outside (-inf, inf) N m"],
    ),
    "period": (
        dataclasses.replace(RIG, sensor=sensors.Noise()),
        {"sensor.period": [2e-3, 1.5e-3, 4e-4]},
        ["sensor.period is not a multiple of solver.step = 0.001 s"],
    ),
    "computing": (
        dataclasses.replace(RIG, controller=controllers.Sampled(controller=controllers.StateFeedback())),
        {"controller.delay": [1e-3, 1.2e-3, 0.0], "controller.period": [2e-3, 1e-3, 2.5e-3]},
        ["controller.delay exceeds the period", "controller.period is not a multiple of solver.step = 0.001 s"],
    ),
    "filter": (
        dataclasses.replace(
            RIG, controller=controllers.Sampled(controller=controllers.PID(kd=1.0, low=0.0, high=90.0))
        ),
        {"controller.controller.cutoff": [1999.0, 2001.0, 1e5]},
        ["controller.controller.cutoff is too fast for the period"],
    ),
    "ring": (
        dataclasses.replace(RIG, actuator=actuators.Delay(capacity=16)),
        {"actuator.time": [14e-3, 15e-3, 9e-4]},
        ["actuator.time is outside [0.001, 0.014] s, one step to capacity - 2 steps"],
    ),
    "edges": (
        replace(RIG, {"plant.road": ROAD}),
        {"plant.road.edges.0": [3.0, 5.5, 5.0]},
        ["plant.road.edges is not increasing"],
    ),
    "schedule": (
        dataclasses.replace(RIG, controller=FEEDBACK),
        {"controller.speeds.1": [9.0, 1.0, 2.0]},
        ["controller.speeds do not increase"],
    ),
    "start": (
        RIG,
        {"initial.speed": [9.0, 1.3, 1.388]},
        ["initial.speed is not above stop.speed: the run would end before it starts"],
    ),
    "fallen": (
        dataclasses.replace(d.balancing(), stop=Fallen(angle=0.5)),
        {"initial.theta": [0.1, 0.6, -0.5]},
        ["initial is at the stop or beyond: the run would end before it starts"],
    ),
}


@pytest.fixture
def any_step(monkeypatch):
    """Without the seconds that the stability takes to compile."""
    replace_seam(
        monkeypatch, "is_step_stable", lambda loop, values, step: np.ones(len(jax.tree.leaves(values)[0]), bool)
    )
    replace_seam(monkeypatch, "stable_step", lambda loop: np.inf)


class TestBeforeARun:
    @killed_by(
        "loop.admissible",
        "    yield _start_rule(loop)\n    yield from grid_rules(loop, step)",
        "    yield _start_rule(loop)",
        case="ring",
    )
    @killed_by(
        "core.validity",
        '    yield from _below(part, prefix, units_of(getattr(part, "plant", None)), "rules")',
        "    yield from ()",
        case="limits",
    )
    @pytest.mark.parametrize("name", BAD)
    def test_a_lane_is_refused_where_its_loop_alone_would_be(self, any_step, name):
        """In single precision as well: the check is in double, like that of one loop."""
        loop, values, reasons = BAD[name]
        values = {path: np.array(column) for path, column in values.items()}
        for given in (loop, jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), loop)):
            found = admissible.batch_admissibility(given, values, SOLVER)
            assert found.accepted.tolist() == [True, False, False]
            assert set(found.texts[1:]) == set(reasons)
            assert found.number == 2
        for i, fine in enumerate(found.accepted):
            lane = replace(loop, {path: column[i] for path, column in values.items()})
            if fine:
                assert d.check(lane, SOLVER) is lane
            else:
                with pytest.raises(ValueError, match=next(iter(values)).split(".")[0]) as checked:
                    d.check(lane, SOLVER)
                for run in (d.measure, d.rollout):
                    with pytest.raises(ValueError, match=re.escape(str(checked.value))):
                        run(lane, SOLVER, {})

    def test_numbers_of_a_tuple_are_asked_like_those_of_an_array(self, any_step):
        """Inside the compiled call a gain given as a tuple is a tuple of traced numbers."""
        for gain in ((-11753.0, -48.0), np.array([-11753.0, -48.0])):
            loop = d.braking(plant=plants.MirroredRig(), controller=controllers.StateFeedback(gain=gain))
            found = admissible.batch_admissibility(loop, {"plant.mass": np.array([5.3, -1.0])}, SOLVER)
            assert found.accepted.tolist() == [True, False], found.texts

    @killed_by("engine.solvers", "if not (kinks is None or isinstance(kinks, bool)):", "if False:")
    def test_a_solver_that_fits_nothing_is_named(self, any_step):
        for solver, message in (
            (d.FixedStep(0.3, 0.25), "longer than solver.duration"),
            (d.FixedStep(1e-9, 1.0), "too many steps"),
            (d.FixedStep(1e-3, 1.0, kinks="false"), "solver.kinks = 'false' is not a Python bool"),
            (d.FixedStep(1e-3, 1.0, kinks=np.False_), "solver.kinks = .* is not a Python bool"),
        ):
            with pytest.raises(ValueError, match=message):
                admissible.batch_admissibility(RIG, {"plant.mass": np.array([5.0])}, solver)
            with pytest.raises(ValueError, match=message):
                d.check(RIG, solver)

    @killed_by("loop.admissible", "    step = float(solver.step)", "    step = solver.step")
    @pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
    def test_the_step_may_be_an_array_without_axes(self, any_step, array):
        solver = dataclasses.replace(SOLVER, step=array(SOLVER.step))
        found = admissible.batch_admissibility(RIG, {"plant.mass": np.array([5.0, -1.0])}, solver)
        assert found.accepted.tolist() == [True, False]

    @killed_by("loop.admissible", "if lines := list(find_misshapen(part)):", "if lines := []:")
    @pytest.mark.parametrize(
        ("run", "message"),
        [
            (d.check, r"plant.mass = \[1.0, 2.0\] has shape \(2,\); it needs \(\)"),
            (lambda loop: d.check(loop, SOLVER), r"plant.mass = \[1.0, 2.0\] has shape \(2,\)"),
            (lambda loop: d.measure(loop, SOLVER, {}), r"plant.mass = \[1.0, 2.0\] has shape \(2,\)"),
            (lambda loop: d.measure(RIG, SOLVER, {}, key=0), "key = 0 is no random key"),
        ],
    )
    def test_a_loop_or_key_of_a_wrong_shape_is_refused(self, run, message):
        with pytest.raises(ValueError, match=message):
            run(replace(RIG, {"plant.mass": [1.0, 2.0]}))

    @pytest.mark.slow
    @killed_by("loop.stability", "bound = jnp.max(jnp.exp(log)", "bound = 0.5 * jnp.max(jnp.exp(log)")
    def test_the_step_is_judged_as_by_the_eigenvalues(self):
        """Whatever a lane is decided by: the first bound, the squared one, or its eigenvalues; the last are NumPy's."""
        rng = np.random.default_rng(0)
        n = 200
        values = {
            "sensor.time_constant": 10 ** rng.uniform(-4.5, -2, n),
            "plant.mass": rng.uniform(4, 8, n),
            "controller.gain.1": -(10 ** rng.uniform(1, 4, n)),
        }
        lanes = jax.vmap(lambda v: replace(canonical_dtypes(RIG), v))(
            {path: jnp.asarray(x) for path, x in values.items()}
        )
        steps = stable_step.stable_steps(lanes)
        for h in (1e-4, float(steps[7]), float(steps[8]) * (1 + 1e-6)):
            np.testing.assert_array_equal(stable_step.is_step_stable(RIG, values, h), steps >= h)
        quick = 1e-4 * np.asarray(stable_step._bounds(RIG, values, squarings=0)) <= stable_step.MIN_BOUNDARY_RADIUS
        assert np.mean(quick) > 0.7 * np.mean(steps >= 1e-4)  # few are left to the eigenvalues
        alike = {"initial.slip": np.linspace(0.0, 0.5, 5)}  # moves no matrix
        assert stable_step.is_step_stable(RIG, alike, 1e-4).all()
        assert not stable_step.is_step_stable(RIG, alike, 2e-2).any()

    def test_a_plant_without_a_start_has_a_stable_step(self):
        """RK4 on the Lorenz system from (1, 0, 0) with rho = 0: its stiffest mode is -10, stable up to 2.785/10."""
        values = {"plant.rho": np.zeros(2)}
        assert stable_step.is_step_stable(lorenz.LOOP, values, 0.278).all()
        assert not stable_step.is_step_stable(lorenz.LOOP, values, 0.279).any()

    @pytest.mark.slow
    @killed_by(
        "loop.stability",
        "bound = jnp.max(jnp.minimum(rows, columns))",
        "bound = 0.5 * jnp.max(jnp.minimum(rows, columns))",
    )
    def test_the_bound_of_many_lanes_is_that_of_few(self, monkeypatch):
        """Of many it is worked out in chunks, and number by number; and no mode is faster."""
        values = {"sensor.time_constant": np.array([1e-4, 3e-4, 1e-3]), "plant.mass": np.array([4.0, 5.0, 8.0])}

        def bounds():
            """Traced anew."""
            bound = stable_step._bounds.__wrapped__
            return np.asarray(jax.jit(lambda values: bound(RIG, values, squarings=0))(values))

        few = bounds()
        with monkeypatch.context() as chunks_of_one_run:
            replace_seam(chunks_of_one_run, "entries_per_chunk", 1)
            np.testing.assert_allclose(bounds(), few, rtol=1e-6)
        replace_seam(monkeypatch, "min_entrywise_matrices", 0)
        many = bounds()
        np.testing.assert_allclose(many, few, rtol=1e-6)
        loops = jax.vmap(lambda v: replace(canonical_dtypes(RIG), v))(
            {path: jnp.asarray(x) for path, x in values.items()}
        )
        modes = np.abs(np.linalg.eigvals(stable_step._jacobians(loops))).max((1, 2))
        assert (modes <= many).all()
        assert (many < 3 * modes).all()

    @killed_by("loop.stability", "states <= MAX_ENTRYWISE_STATES and ", "")
    def test_the_program_of_many_cars_is_that_of_few(self):
        """Entry by entry, the matrices of a car have a program that compiles for minutes."""
        loop = d.Loop(plant=plants.Car(), **plants.Car().usual_parts())

        def length(runs):
            values = {"plant.mass": jax.ShapeDtypeStruct((runs,), jnp.float64)}
            return len(stable_step._bounds.lower(loop, values, squarings=0).as_text().splitlines())

        assert length(10_000) < 1.01 * length(2)

    def test_an_impossible_objective_is_refused(self):
        late = {"settled": objectives.SettlingTime(share=-0.1)}
        with pytest.raises(ValueError, match=r"objectives\.settled\.share = -0\.1 is outside"):
            d.measure(RIG, SOLVER, late)


class TestAfterARun:
    @pytest.mark.slow
    @killed_by("loop.closed_loop", 'audit = getattr(loop.plant, "audit", None)', "audit = None")
    @pytest.mark.parametrize("step", [1e-4, 1e-3])
    def test_an_unstable_step_with_finite_numbers_is_refused(self, step):
        """At 1e-6 s the run ends after three steps at -1e13 m: it has not stopped, and there is no mean to enter."""

        def one(T):
            return d.measure(replace(RIG, {"sensor.time_constant": T}), d.FixedStep(step, 2500 * step), BRAKING)

        many = jax.vmap(one)(jnp.array([1e-6, 3e-6, 1e-5, 2e-5, 3e-5]))
        assert np.asarray(many.diverged).all()
        assert not np.asarray(many.stopped).any()
        assert all(np.isnan(x).all() for x in many.metrics.values())

    @killed_by(
        "engine.step.advance",
        "zero + RunStatus.RUNNING, zero + RunStatus.MISSED",
        "zero + RunStatus.RUNNING, zero + RunStatus.STOPPED",
    )
    @pytest.mark.slow
    def test_a_traced_start_beyond_the_stop_is_no_run(self):
        braked = jax.jit(lambda start: d.measure(replace(RIG, {"initial.speed": start}), SOLVER, BRAKING))
        for start in (1.0, 5 / 3.6):
            found = braked(start)
            assert found.diverged
            assert np.isnan(found.metrics["stop_time"])
        balanced = jax.jit(lambda start: d.measure(replace(d.balancing(), {"initial.theta": start}), SOLVER, BALANCE))
        assert balanced(2.0).diverged

    @killed_by("loop.result", "(value >= low - PHYSICAL_RANGE_TOLERANCE)", "(value >= -jnp.inf)")
    def test_a_metric_outside_its_range_is_a_run_that_diverged(self):
        for part in (*BRAKING.values(), *BALANCE.values()):
            assert type(part).physical[0] <= 0
        for name, part, value, bad in (
            ("time", objectives.StopTime(), -1e-6, True),
            ("time", objectives.StopTime(), 0.0, False),
            ("time", objectives.StopTime(), np.nan, True),
            ("slip", objectives.MaxSlip(), 1.1, True),
            ("slip", objectives.MaxSlip(), -1.0, False),
            ("", objectives.StopTime(), 1.5, True),
            ("", objectives.StopTime(), 0.5, False),
            ("own", object(), -5.0, False),
        ):
            assert bool(_is_impossible(name, part, jnp.asarray(value))) is bad, (name, value)

    @pytest.mark.slow
    def test_a_torque_that_drives_the_wheel_is_no_alarm(self):
        """The car speeds up, its energy grows with the torque's work: physical, if hardly a brake."""
        for plant in (plants.MirroredRig(), plants.QuarterCar()):
            loop = braking(
                plant=plant, initial=d.BrakeStart(speed=8.0), controller=controllers.ConstantTorque(torque=-3.0),
                reference=references.FixedSlip(), stop=SpeedReached(speed=1.0),
            )  # fmt: skip
            found = d.measure(loop, SOLVER, BRAKING)
            assert found.ending.sample.output.speed > 8.02
            assert not found.diverged


def sample(speed, wheel, distance, control=0.0, deceleration=0.0):
    y = BrakeOutput(0.0, *(jnp.asarray(x, float) for x in (speed, wheel, deceleration, distance)))
    return Sample(0.0, y, 0.2, 0.2, 0.0, control, control)


@killed_by("parts.plants.audit", "_driving_power(-before.control, -sample.control)", "0.0")
@pytest.mark.parametrize(
    ("before", "after", "fine"),
    [
        ((10, 10, 0), (9.99, 9.98, 0.01), True),
        ((10, 10, 0), (9.99, 9.98, -0.01), False),  # backwards
        ((10, 10, 0), (9.99, 9.98, 0.05), False),  # five times as far as its speed
        ((10, 10, 0), (3.0, 9.98, 0.01), False),  # 7,000 m/s^2 without friction
        ((10, 10, 0), (9.99, 12.0, 0.01), False),  # a wheel that nothing drives
        ((10, 10, 0, -500.0), (9.99, 12.0, 0.01, -500.0), True),  # a torque drives it
        ((10, 2, 0, 500.0, 8.0), (9.99, 4.0, 0.01, 500.0, 8.0), True),  # the road does
    ],
)
def test_what_no_braked_car_does(before, after, fine):
    audit = BrakeAudit(car=jnp.asarray(10.0), wheel=jnp.asarray(1.0), radius=jnp.asarray(0.2), scale=550.0)
    a, b = sample(*before), sample(*after)
    memory = audit.start(a)
    value = audit.value(
        memory._replace(held=audit.update(memory, resting_segment(a, 1e-3)._replace(end=b))),
        Ending(b, False, 0.0, 0.0),
    )
    assert bool(value <= 1) is fine


SMALL = """
plant = "mirrored-rig"
initial = { speed_kmh = 30.0 }
stop = { type = "speed-reached", speed_kmh = 25.0 }
controller = { type = "pid", kp = 40.0, high = 9.0 }
solver = { step = 1e-3, duration = 0.25 }
[sweep]
samples = 48
chunk = 16
[sweep.over]
"initial.speed_kmh" = { low = 20.0, high = 34.0 }
[sweep.failures]
iae = 1.0
"""


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    return sweep(described(SMALL), tmp_path_factory.mktemp("refused") / "s")


class TestWhoeverRuns:
    @killed_by("uncertainty.sweep.statistics.summary", "eligible = view.rows & view.accepted", "eligible = view.rows")
    @pytest.mark.slow
    def test_a_refused_lane_is_a_row_with_a_reason_and_in_no_number(self, swept):
        below = swept.column("initial.speed") <= 25 / 3.6
        assert 8 < below.sum() < 40
        np.testing.assert_array_equal(swept.accepted, ~below)
        assert set(swept.column("refused")[below]) == {
            "initial.speed is not above stop.speed: the run would end before it starts"
        }
        np.testing.assert_array_equal(swept.column("diverged"), below)  # lest somebody's mean over the table take them
        assert swept.diverged_rows().num_rows == 0
        assert not swept.column("stopped")[below].any()
        found = summarise_sweep(Results(swept.folder))
        for name in swept.metrics:
            x = swept.column(name)
            assert np.isnan(x[below]).all()
            reached = x[~below][np.isfinite(x[~below])]
            assert found["never"].get(name, {"count": 0})["count"] == (~below).sum() - len(reached)
            if len(reached):
                np.testing.assert_allclose(found["metrics"][name]["mean"]["value"], reached.mean(), rtol=1e-12)
        assert found["refused"]["count"] == below.sum()
        assert found["refused"]["samples"][0] == np.flatnonzero(below)[0]
        assert sum(found["refused"]["reasons"].values()) == below.sum()
        assert found["failures"]["diverged"]["count"] == 0
        none = 1 - 0.025 ** (1 / np.sum(~below))  # Clopper-Pearson's end for no failure among the runs that were made
        assert found["failures"]["diverged"]["high"] == pytest.approx(none, rel=1e-9)
        assert found["failures"]["not stopped"]["value"] < 0.5
        assert found["failures"]["any"]["high"] < 1 / 2

    @killed_by("engine.drive.batches", "carry.status, RunStatus.REFUSED)", "carry.status, RunStatus.TIMED_OUT)")
    @pytest.mark.slow
    def test_a_batch_does_not_run_them(self, any_step):
        values = {"initial.speed": np.array([8.0, 1.0, 9.0])}
        done = d.run_batch(RIG, d.Batch(values), SOLVER, {"stop_time": BRAKING["stop_time"]})
        np.testing.assert_array_equal(done.diverged, [False, True, False])
        assert np.isnan(done.metrics["stop_time"]).tolist() == [False, True, False]
        with pytest.raises(ValueError, match=r"lane 1: initial.speed = 1 m/s is not above stop.speed"):
            d.Batch(values).check(RIG, SOLVER)
        arm = dataclasses.replace(d.balancing(), stop=Fallen(angle=0.5))
        starts = {"initial.theta": np.array([0.0, 0.6])}
        found = classify_starts(arm, starts, d.FixedStep(1e-3, 0.05), band=0.1)
        assert (found.recovered.tolist(), found.diverged.tolist()) == ([True, False], [False, True])

    @killed_by("uncertainty.reliability.failure", "    if len(bad):", "    if False:")
    def test_a_probability_is_of_the_whole_space_or_none(self, any_step):
        study = described(SMALL)
        with pytest.raises(ValueError, match=r"\d+ of 40 points cannot be run: initial.speed is not above"):
            failure_probability(study, "iae", 1.0, samples=40)

    @pytest.mark.slow
    def test_worst_case_tune_and_identify_refuse_at_the_start(self, any_step):
        ask = {"solver": SOLVER, "measured": BRAKING}
        with pytest.raises(ValueError, match=r"the box has points that cannot be run; lane 0: initial.speed = 1 m/s"):
            worst_case(RIG, over={"initial.speed": (1.0, 9.0)}, metric="iae", **ask)
        over = d.Batch({"initial.speed": [9.0, 1.0]})
        with pytest.raises(StartError, match=r"lane 1: initial.speed = 1 m/s is not above stop.speed"):
            tune(
                build_problem(
                    RIG,
                    free={"controller.gain": ((-2e4, -60.0), (-9e3, -30.0))},
                    objective={"iae": 1.0},
                    over=over,
                    **ask,
                )
            )
        t = np.array([0.0, 0.1])
        data = Traces(t=t, columns={"speed": np.ones((2, 2))}, over={"initial.speed": np.array([9.0, 1.0])})
        with pytest.raises(ValueError, match=r"initial.speed is not above stop.speed"):
            identify(RIG, data, {"plant.mass": (4.0, 8.0)}, solver=SOLVER)

    def test_a_trial_that_breaks_a_rule_is_a_failed_evaluation(self, any_step):
        """Limits may cross on the way: such a point is too far, whatever its loss."""
        limited = replace(RIG, {"controller.low": 0.0, "controller.high": 9.0})
        free = {"controller.low": (-5.0, 20.0), "controller.high": (5.0, 15.0)}
        problem = build_problem(limited, free=free, objective={"iae": 1.0}, solver=SOLVER)
        crossed = replace(limited, {"controller.low": 12.0, "controller.high": 8.0})
        z = np.stack([problem.space.place(part) for part in (limited, crossed)])
        assert problem.steady()(z).tolist() == [True, False]
        assert Method().starts == 1


@pytest.mark.slow
def test_the_sweep_of_the_report(tmp_path):
    """0 diverged, 0 not stopped, a mean stopping time of 0.002 s and a mean distance of -2.6e11 m, once."""
    over = 'sweep.over={"sensor.time_constant"={low=1e-6,high=1e-5}}'
    words = ("sweep", "slip-lmi", "--set", "sensor=wheel-speed", "--set", over, "--samples", 8, "--json")
    result = commands.run(*words, "--out", tmp_path / "s", status=1)
    document = json.loads(result.stdout)
    assert document["refused"]["reasons"] == {"solver.step = 0.0001 s is not stable": 8}
    assert document["metrics"] == {name: {} for name in document["metrics"]}
    assert document["failures"] == {}
    assert "no sample could be run: solver.step = 0.0001 s is not stable" in result.stderr
    assert not (set(document["metrics"]) - set(BRAKING))


@killed_by(
    "parts.controllers.sampled",
    "as_rule_array(cutoff) * as_rule_array(period) < 2",
    "as_rule_array(cutoff) * as_rule_array(period) < 200",
)
@killed_by("parts.controllers.sampled_on_grid", "sampling_rules(self.controller,", "sampling_rules(None,")
@pytest.mark.parametrize(("cutoff", "grows"), [(1990.0, False), (2010.0, True)])
def test_a_filter_too_fast_for_its_samples_is_refused(cutoff, grows):
    """The oracle is the computer's own recursion, d + T wc (e - d), written out for e = 0."""
    period, d = 1e-3, 1.0
    for _ in range(2000):
        d += period * cutoff * (0.0 - d)
    assert (abs(d) > 1) == grows
    line = f"controller.controller.cutoff = {cutoff:g} rad/s is outside (0, 2000) rad/s: sampled every 0.001 s"
    for computer in (controllers.Sampled, controllers.SampledOnGrid):
        said = list(
            find_problems(
                dataclasses.replace(
                    RIG, controller=computer(controller=controllers.PID(cutoff=cutoff, low=0.0, high=90.0))
                )
            )
        )
        assert len(said) == grows
        assert all(one.startswith(line) for one in said)
