"""One contract for many lanes, however they are run: `run_batch` against `measure` of one lane after the other."""

import contextlib
import os
import subprocess
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from decaying import decay_loop
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from marks import cases
from mutants import killed_by
from project import ROOT
from seams import replace_seam

import diffabs as d
from diffabs import controllers, plants
from diffabs.core.pytree import replace
from diffabs.engine.drive import batches
from diffabs.engine.drive.batches import STEPS_PER_EXCHANGE, run_on_auto_mesh
from diffabs.loop.batch import Batch, grid, group_by_structure, latin, stack_loops
from diffabs.parts.objectives import BRAKING, IAE
from diffabs.parts.sensors import Noise
from diffabs.parts.stops import SpeedReached, Standstill
from diffabs.scenario.defaults import braking

LOOP = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=30 / 3.6),
    controller=controllers.StateFeedback(gain=np.array([-4000.0, -40.0])),
    feedforward=controllers.HoldingInput(),
    stop=SpeedReached(speed=25 / 3.6),
    sensor=Noise(slip=0.01, period=4e-3),
)
MEASURED = {name: BRAKING[name] for name in ("stop_distance", "settling_time", "iae")}
SOLVER = d.FixedStep(2e-3, 0.5)
SPEEDS = np.array([30.0, 25.1, 90.0, 31.0, 24.0, 28.0, 25.1, 27.0, 33.0, 29.5, 26.0]) / 3.6
SHORT, NEVER, AT_ONCE, DIVERGING = 1, 2, 4, 7
GAINS = np.where(np.arange(len(SPEEDS)) == DIVERGING, 1e308, -40.0)
VALUES = {"initial.speed": SPEEDS, "controller.gain.1": GAINS}
SOME = 4  # lanes on the belt where it does not matter how many
WIDTHS = [1, SOME, len(SPEEDS) + 5]

QUIET = replace(LOOP, {"sensor": braking(plant=LOOP.plant).sensor})


@pytest.fixture(scope="module")
def keys():
    return jax.vmap(lambda i: jax.random.fold_in(jax.random.key(5), i))(np.arange(len(SPEEDS)))


@pytest.fixture(scope="module")
def expected(keys):
    def one(values, key):
        return d.measure(replace(LOOP, values), SOLVER, MEASURED, key=key)

    return jax.device_get(jax.jit(jax.vmap(one))(VALUES, keys))


def same(found, expected):
    """The same operations, compiled apart: rounding only, of runs of up to 250 steps."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


class Slow(NamedTuple):
    """A lane is over below its own speed [m/s]."""

    speeds: Any

    def data_of(self, number):
        return number

    def has_reached(self, number, sample):
        return sample.output.speed < self.speeds[jnp.minimum(number, len(self.speeds) - 1)]


@pytest.fixture(params=cases(["refilled", "together"], "together"))
def driven(request, monkeypatch):
    """`run_batch` by each of its drivers, results as NumPy arrays."""
    replace_seam(monkeypatch, "lanes_at_once", SOME)
    together = request.param == "together"
    return lambda *args, **more: jax.device_get(d.run_batch(*args, together=together, **more))


class TestLanes:
    @pytest.mark.slow
    def test_are_what_they_are_meant_to_be(self, expected):
        taken = expected.ending.sample.t / SOLVER.step
        assert np.flatnonzero(expected.diverged).tolist() == [AT_ONCE, DIVERGING]  # one begins below its stop
        assert sorted(np.flatnonzero(~expected.stopped)) == [NEVER, AT_ONCE, DIVERGING]
        assert taken[NEVER] == SOLVER.steps > 3 * STEPS_PER_EXCHANGE
        assert taken[AT_ONCE] == 0
        assert 0 < taken[SHORT] < STEPS_PER_EXCHANGE
        assert np.isnan(expected.metrics["iae"]).tolist() == expected.diverged.tolist()
        assert len(np.unique(expected.metrics["iae"][[SHORT, 6]])) == 2  # noise of their own, everything else is equal

    @pytest.mark.slow
    @pytest.mark.parametrize("width", WIDTHS)
    def test_are_those_of_single_runs(self, width, keys, expected, monkeypatch):
        """Of whom enough is never seen: no car is slower than 0."""
        replace_seam(monkeypatch, "lanes_at_once", width)
        never = Slow(jnp.zeros(len(SPEEDS)))
        run = d.run_batch(LOOP, Batch(VALUES, keys), SOLVER, MEASURED, accepted=True, enough=never)
        same(jax.device_get(run), expected)

    @killed_by("engine.drive.batches", "reshape(cores, each).T.ravel()[:count]", "ravel()[:count]")
    @pytest.mark.slow
    @killed_by(
        "engine.drive.batches",
        "lane_numbers = numbers[jnp.minimum(slots",
        "lane_numbers = slots.number + 0 * numbers[jnp.minimum(slots",
    )
    def test_are_those_of_single_runs_on_two_cores(self, keys, expected, monkeypatch):
        """Shares of different runs, the last ones filled by copies; each run knows its own speed at which it ends."""
        replace_seam(monkeypatch, "core_count", lambda: 2)
        replace_seam(monkeypatch, "min_runs_per_core", 3)
        assert len(SPEEDS) % 2
        lanes, ends = Batch(VALUES, keys), Slow(jnp.where(jnp.arange(len(SPEEDS)) % 2 == 0, 1e3, 0.0))
        found = jax.device_get(d.run_batch(LOOP, lanes, SOLVER, MEASURED, accepted=True, enough=ends))
        odd = slice(1, None, 2)
        same(*(jax.tree.map(lambda x: x[odd], run) for run in (found, expected)))
        assert expected.stopped[[0, 8]].all()
        assert not found.stopped[[0, 8]].any()

    @killed_by("core.compiling", "_is_tracing() or any(", "any(")
    @pytest.mark.slow
    def test_are_those_of_single_runs_together(self, keys, expected):
        lanes = Batch(VALUES, keys)
        once = jax.jit(lambda: d.run_batch(LOOP, lanes, SOLVER, MEASURED))()  # a trace is under way, of no argument
        same(jax.device_get(once), expected)
        at_once = d.run_batch(LOOP, lanes, SOLVER, MEASURED, together=True, accepted=True)
        same(jax.device_get(at_once), expected)

    @pytest.mark.slow
    def test_without_keys_and_of_lists(self, driven):
        gains = np.where(np.arange(len(SPEEDS))[:, None] < 9, [-4000.0, -40.0], [-5000.0, -50.0])
        lanes = Batch({"initial.speed": SPEEDS, "controller.gain": gains})
        found = driven(QUIET, lanes, SOLVER, MEASURED, accepted=True)
        for i in (3, 10):
            one = jax.device_get(d.measure(lanes.lane(QUIET, i), SOLVER, MEASURED))
            same(jax.tree.map(lambda x, i=i: x[i], found), one)
        assert found.metrics["iae"][SHORT] == found.metrics["iae"][6]

    @killed_by(
        "loop.batch",
        "return jax.vmap(jax.random.key)(jnp.asarray(self.keys))",
        "return jax.vmap(jax.random.key)(0 * jnp.asarray(self.keys))",
        case="refilled",
    )
    @pytest.mark.slow
    def test_may_differ_in_their_noise_alone(self, driven):
        """Keys, or the numbers that they are made of."""
        seeds = np.array([7, 3])
        found = driven(LOOP, Batch(keys=seeds), SOLVER, MEASURED)
        same(driven(LOOP, Batch(keys=jax.vmap(jax.random.key)(seeds)), SOLVER, MEASURED), found)
        one = jax.device_get(d.measure(LOOP, SOLVER, MEASURED, key=jax.random.key(3)))
        same(jax.tree.map(lambda x: x[1], found), one)

    @pytest.mark.slow
    def test_none_is_one_lane(self, driven):
        found = driven(QUIET, Batch(), SOLVER, MEASURED)
        same(found, jax.tree.map(lambda x: x[None], jax.device_get(d.measure(QUIET, SOLVER, MEASURED))))

    @pytest.mark.slow
    @killed_by("loop.ensemble", "    if accepted is True:\n        return run", "    return run", case="together")
    @killed_by(
        "engine.drive.batches",
        "jnp.where(run & (number < count), carry.status",
        "jnp.where(number < count, carry.status",
        case="refilled",
    )
    def test_that_are_not_accepted(self, driven, keys, expected):
        """They are flagged, the others are what they were."""
        out = np.isin(np.arange(len(SPEEDS)), [0, NEVER, 9])
        found = driven(LOOP, Batch(VALUES, keys), SOLVER, MEASURED, accepted=~out)
        same(*(jax.tree.map(lambda x: x[~out], run) for run in (found, expected)))
        assert found.diverged[out].all()
        assert not (found.stopped | found.timed_out)[out].any()
        assert all(np.isnan(column[out]).all() for column in found.metrics.values())

    @pytest.mark.slow
    def test_are_refused_before_they_run(self, driven, keys):
        slow = Batch({**VALUES, "controller.gain.1": np.full(len(SPEEDS), -40.0)}, keys)
        found = driven(LOOP, slow, SOLVER, MEASURED)
        assert np.flatnonzero(found.diverged).tolist() == [AT_ONCE]
        with pytest.raises(ValueError, match=r"lane 4: initial.speed = 6.66667 m/s is not above stop.speed"):
            Batch({"initial.speed": SPEEDS}).check(LOOP, SOLVER)
        assert d.run_batch(QUIET, Batch(), d.FixedStep(0.3, 0.6), MEASURED).diverged.tolist() == [True]

    @killed_by("loop.ensemble", "jnp.concatenate(x)[order]", "jnp.concatenate(x)")
    @pytest.mark.slow
    def test_in_order_when_those_of_similar_length_run_together(self, keys, expected):
        times = np.maximum(expected.ending.sample.t + 0.02, 0.13)
        times[NEVER] = SOLVER.duration
        lanes = Batch(VALUES, keys, durations=times)
        first, second = (members for members, _ in lanes.groups(SOLVER.duration))
        assert first.max() > second.min()
        same(jax.device_get(d.run_batch(LOOP, lanes, SOLVER, MEASURED, together=True, accepted=True)), expected)

    @pytest.mark.slow
    def test_are_compiled_once(self, keys, monkeypatch):
        replace_seam(monkeypatch, "lanes_at_once", SOME)
        lanes = Batch(VALUES, keys)
        d.run_batch(LOOP, lanes, SOLVER, MEASURED, accepted=True)
        before = batches._run._cache_size()
        faster = Batch({**VALUES, "initial.speed": 1.01 * SPEEDS}, keys)
        d.run_batch(LOOP, faster, d.FixedStep(2e-3, 0.4), MEASURED, accepted=True)
        assert batches._run._cache_size() == before


class Far(NamedTuple):
    """A lane is over beyond its own place [m]."""

    places: Any

    def data_of(self, number):
        return number

    def has_reached(self, number, sample):
        return sample.output.x > self.places[jnp.minimum(number, len(self.places) - 1)]


@killed_by(
    "engine.drive.batches",
    "free = ~slots.carry.running | _lanes_ended_early(enough, build_lane, slots, numbers)",
    "free = ~slots.carry.running",
)
@pytest.mark.slow
def test_lanes_make_room_for_others(monkeypatch):
    """The integral of x = (1 - exp(-rate t))/rate; the second lane is over beyond 0.2 m, at the next look."""
    replace_seam(monkeypatch, "lanes_at_once", 2)
    end, rates, places = 0.03 * STEPS_PER_EXCHANGE, np.linspace(0.5, 2.0, 5), np.array([9.0, 0.2, 9.0, 9.0, 9.0])
    batch, solver = Batch({"plant.rate": rates}), d.FixedStep(0.01, end)
    run = d.run_batch(decay_loop(), batch, solver, {"iae": IAE()}, accepted=True, enough=Far(jnp.asarray(places)))
    over = places < 9.0
    np.testing.assert_allclose(
        run.metrics["iae"][~over], ((end - (1 - np.exp(-rates * end)) / rates) / rates)[~over], rtol=1e-9
    )
    np.testing.assert_array_equal(run.timed_out, ~over)
    taken = run.ending.sample.t[over] / end * 3
    np.testing.assert_allclose(taken, np.ceil(-np.log(1 - 0.2 * rates[over]) / rates[over] / end * 3), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
def test_a_lane_of_which_enough_is_seen_is_taken_off(keys, expected, width, monkeypatch):
    """At the next look; it has not stopped, and the others are what they were."""
    replace_seam(monkeypatch, "lanes_at_once", width)
    limits = np.zeros(len(SPEEDS))
    limits[NEVER], limits[8], limits[SHORT] = 24.5, 7.5, 6.9
    slow = Slow(jnp.asarray(limits))
    found = jax.device_get(d.run_batch(LOOP, Batch(VALUES, keys), SOLVER, MEASURED, accepted=True, enough=slow))
    early = np.isin(np.arange(len(SPEEDS)), [NEVER, 8])  # the other ends before it is that slow
    assert not (found.stopped | found.diverged | found.timed_out)[early].any()
    assert np.all(found.ending.sample.output.speed[early] < limits[early])
    taken = found.ending.sample.t[early] / SOLVER.step
    np.testing.assert_allclose(taken, STEPS_PER_EXCHANGE * np.round(taken / STEPS_PER_EXCHANGE), rtol=1e-12)
    assert np.all(taken < 0.9 * expected.ending.sample.t[early] / SOLVER.step)
    same(*(jax.tree.map(lambda x: x[~early], run) for run in (found, expected)))


@pytest.mark.slow
def test_trajectories():
    lanes = Batch({"initial.speed": SPEEDS[:2]})
    found = jax.device_get(d.run_batch(QUIET, lanes, SOLVER, MEASURED, trajectories=True))
    assert found.trajectory.sample.t.shape == (2, SOLVER.steps + 1)
    for i in range(2):
        one = jax.device_get(d.rollout(lanes.lane(QUIET, i), SOLVER, MEASURED))
        same(jax.tree.map(lambda x: x[i], found), one)  # noqa: B023


def iae_of_one(gain, speed):
    loop = replace(QUIET, {"controller.gain.1": gain, "initial.speed": speed})
    return d.measure(loop, SOLVER, {"iae": MEASURED["iae"]}).metrics["iae"]


@killed_by(
    "loop.batch",
    "columns = {path: jnp.asarray(column, dtype) for",
    "columns = {path: jax.lax.stop_gradient(jnp.asarray(column, dtype)) for",
    case="jacfwd",
)
@pytest.mark.parametrize(
    ("mode", "single"),
    [
        pytest.param(jax.jacfwd, jax.jacfwd, id="jacfwd"),  # compiles in half the time of what goes backwards
        pytest.param(jax.jacfwd, jax.grad, id="jacfwd-grad", marks=pytest.mark.slow),
        pytest.param(jax.jacrev, jax.grad, id="jacrev", marks=pytest.mark.slow),
    ],
)
@pytest.mark.slow
def test_derivatives_are_those_of_single_runs(mode, single):
    """In the loop, which lanes share, and in their values."""
    slopes_of_one = jax.jit(single(iae_of_one, (0, 1)))
    speeds = jnp.asarray(SPEEDS[[0, 3]])

    def many(gain, speeds):
        loop = replace(QUIET, {"controller.gain.1": gain})
        return d.run_batch(loop, Batch({"initial.speed": speeds}), SOLVER, {"iae": MEASURED["iae"]}).metrics["iae"]

    by_gain, by_speed = jax.jit(mode(many, (0, 1)))(-40.0, speeds)
    for i, speed in enumerate(speeds):
        shared, own = slopes_of_one(-40.0, speed)
        np.testing.assert_allclose(by_gain[i], shared, rtol=1e-9)
        np.testing.assert_allclose(by_speed[i], np.where(np.arange(2) == i, own, 0.0), rtol=1e-9)


@pytest.mark.parametrize(
    ("error", "message", "lanes", "more"),
    [
        (ValueError, "plant.mass has 2 values, keys has 3 values", Batch({"plant.mass": [5.0, 6.0]}, [1, 2, 3]), {}),
        (
            ValueError,
            "columns of the same length, with one value for each run: plant.mass is one number",
            Batch({"plant.mass": 5.0}),
            {},
        ),
        (KeyError, "no 'mas' in plant.mas", Batch({"plant.mas": [5.0, 6.0]}), {"accepted": True}),
        (ValueError, r"has shape \(\); it needs \(2,\)", Batch({"controller.gain": [1.0, 2.0]}), {"accepted": True}),
        (
            ValueError,
            r"accepted has shape \(2,\); \(3,\) is needed",
            Batch(keys=[1, 2, 3]),
            {"accepted": [True, False]},
        ),
        pytest.param(
            *(ValueError, "enough: lanes that run together", Batch(VALUES)),
            {"enough": Slow(SPEEDS), "trajectories": True},
            marks=pytest.mark.slow,
        ),
        (
            ValueError,
            "plant.road is of type RationalCurve; the path of a number",
            Batch({"plant.road": [12.0, 13.0]}),
            {},
        ),
        (
            ValueError,
            "durations = nan s is not positive",
            Batch({"plant.mass": [5.0, 6.0]}, durations=[np.nan, 1.0]),
            {"together": True, "accepted": True},
        ),
    ],
)
def test_says_what_cannot_be_run(error, message, lanes, more):
    with pytest.raises(error, match=message):
        d.run_batch(QUIET, lanes, SOLVER, MEASURED, **more)


@killed_by("loop.batch", "            if line:\n", "            if False:\n")
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"values": [12.0]}, r"values = \[12.0\] is no mapping by path"),
        ({"values": {"plant.mass": ["12", "13"]}}, "plant.mass = .* is text; one value for each run is needed"),
        ({"values": {"plant.mass": [None, 1.0]}}, "plant.mass = .* is of type NoneType"),
        ({"values": {"controller.gain": [[1.0], [1.0, 2.0]]}}, "controller.gain = .* has rows of different shapes"),
        ({"weights": ["a", "b"]}, "weights = .* is text"),
        ({"keys": [0.5, 1.0]}, "keys = .* is neither keys of jax.random.key nor whole numbers"),
        ({"keys": np.zeros((2, 2), np.uint32)}, "keys = .* is neither keys"),
    ],
)
def test_a_column_without_numbers_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        Batch(**given)


@killed_by("engine.drive.batches", "first_order((hybrid, values, objectives), VALUES_ONLY)", "loop, values, objectives")
@pytest.mark.parametrize("solver", [SOLVER, d.Adaptive(1e-4, 0.5)])
def test_lanes_that_make_room_have_no_derivative_by_xla(solver):
    """Of fixed steps it was 1.4 % off: the switches were not located."""

    def iae(gain):
        lanes = Batch({"controller.gain.1": gain * jnp.ones(2)})
        return d.run_batch(QUIET, lanes, solver, MEASURED, together=False, engine="xla").metrics["iae"]

    with pytest.raises(ValueError, match="together=False has no derivatives by XLA"):
        jax.eval_shape(lambda gain: jax.jvp(iae, (gain,), (1.0,)), -40.0)


@killed_by("loop.ensemble", "if lines := find_impossible_values(loop, solver.step):", "if lines := []:")
@pytest.mark.parametrize("batch", [Batch(), Batch(keys=[1, 2])], ids=["empty", "keys"])
def test_a_loop_that_no_run_may_have_is_named_without_values(batch):
    with pytest.raises(ValueError, match=r"plant.mass = -1 is outside \(0, inf\) kg"):
        d.run_batch(replace(QUIET, {"plant.mass": -1.0}), batch, SOLVER, MEASURED)


@killed_by("loop.batch", "jnp.asarray(column, dtype)", "jnp.asarray(column, float)")
@pytest.mark.parametrize("together", cases([True, False], False))
def test_results_have_the_precision_of_the_loop(together):
    loop, batch = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), decay_loop()), Batch({"plant.rate": [1.0, 2.0]})
    run = d.run_batch(loop, batch, d.FixedStep(0.1, 1.0), {"iae": IAE()}, together=together, engine="xla")
    assert {column.dtype for column in run.metrics.values()} == {np.dtype(np.float32)}


@killed_by("loop.batch", "(count, *jnp.shape(x))", "(1, *jnp.shape(x))")
@pytest.mark.parametrize("column", cases(["weights", "durations"], "durations"))
def test_a_batch_without_values_has_one_result_for_each_run(column):
    batch = Batch(**{column: [0.5, 0.5, 0.1]})
    run = d.run_batch(decay_loop(), batch, d.FixedStep(0.1, 1.0), {"iae": IAE()})
    assert batch.size == 3
    assert {np.shape(x) for x in jax.tree.leaves((run.metrics, run.stopped, run.diverged, run.timed_out))} == {(3,)}


class TestStacked:
    def test_loops_become_lanes(self):
        """Each parameter of its own, by path; whatever is done to them is done to each."""
        loops = [replace(QUIET, {"plant.mass": m, "controller.gain.0": k}) for m, k in ((5.0, -4e3), (6.0, -5e3))]
        first, lanes = stack_loops(loops)
        assert lanes.size == 2
        for i, loop in enumerate(loops):
            same(lanes.lane(first, i), loop)
        weights = lanes.each(first, lambda loop, key: loop.plant.mass * loop.controller.gain[0])
        np.testing.assert_array_equal(weights, [-2e4, -3e4])

    @killed_by("loop.batch", "(jax.tree.structure(loop), *map", "(0, *map")
    def test_of_one_structure(self):
        other = replace(QUIET, {"stop": Standstill(speed=5.0)})  # of equal shapes
        assert group_by_structure([QUIET, other, replace(QUIET, {"plant.mass": 6.0})]) == [[0, 2], [1]]
        with pytest.raises(ValueError, match="loops of 2 structures are no lanes of one batch"):
            stack_loops([QUIET, other])


class TestBatch:
    def test_a_grid_has_every_combination(self):
        batch = grid({"plant.mass": [5.0, 6.0], "initial.speed": [10.0, 12.0, 14.0]}).check(QUIET)
        assert batch.size == 6
        pairs = set(zip(batch.values["plant.mass"].tolist(), batch.values["initial.speed"].tolist(), strict=True))
        assert pairs == {(m, v) for m in (5.0, 6.0) for v in (10.0, 12.0, 14.0)}
        assert float(batch.lane(QUIET, 5).plant.mass) == 6.0

    def test_a_latin_hypercube_has_one_lane_in_each_strip(self):
        batch = latin({"plant.mass": (5.0, 6.0), "initial.speed": (10.0, 20.0)}, 50, seed=4)
        for path, (low, width) in {"plant.mass": (5.0, 1.0), "initial.speed": (10.0, 10.0)}.items():
            strips = np.floor((batch.values[path] - low) / width * 50).astype(int)
            assert sorted(strips) == list(range(50))

    def test_lanes_of_similar_length_run_together(self):
        times = np.array([1.0, 9.0, 3.0, 10.0, 1.2])
        batch = Batch({"plant.mass": np.full(5, 5.0)}, durations=times)
        groups = batch.groups(8.0)
        assert sorted(np.concatenate([lanes for lanes, _ in groups])) == [0, 1, 2, 3, 4]
        for lanes, duration in groups:
            wanted = np.minimum(times[lanes], 8.0)
            assert duration == wanted.max() < 2 * wanted.min() * (1 + 1e-9)

    @pytest.mark.parametrize(
        ("batch", "message"),
        [
            (Batch({"plant.mas": [5.0]}), "plant.mas is not a parameter of the loop"),
            (
                Batch({"plant.mass": [5.0], "initial.speed": [9.0, 8.0]}),
                "same length, with one value for each run: plant.mass has 1 values, initial.speed has 2",
            ),
            (Batch({"plant.mass": []}), "plant.mass has 0 values"),
            (Batch({"plant.mass": [5.0, -1.0]}), r"plant.mass = -1 ... 5 leaves \(0, inf\) kg"),
            (Batch({"controller.gain": [1.0, 2.0]}), r"a lane has shape \(\), not \(2,\)"),
            (Batch({"plant.mass": [5.0]}, weights=[0.0]), "weights = 0 ... 0 are not all positive"),
            (Batch({"plant.mass": [5.0]}, durations=[np.nan]), "durations = nan"),
        ],
    )
    def test_says_what_does_not_fit(self, batch, message):
        with pytest.raises(ValueError, match=message):
            batch.check(QUIET)


def placed(values, keys, kind):
    """Lanes on all devices, along a mesh with an axis of this type."""
    place = NamedSharding(jax.make_mesh((jax.device_count(),), ("lanes",), axis_types=(kind,)), PartitionSpec("lanes"))
    return {path: jax.device_put(x, place) for path, x in values.items()}, jax.device_put(keys, place)


@killed_by("engine.drive.batches", "    if not meshes:", "    if True:")
def test_lanes_on_an_explicit_mesh_are_run_on_an_auto_one():
    """Gathers say nothing of where they lie there; results come back."""
    (speeds,), numbers = (given := placed({"speed": SPEEDS[:4]}, np.arange(4), AxisType.Explicit))[0].values(), given[1]
    with pytest.raises(Exception, match="out_sharding"):
        speeds[numbers]
    for around in (contextlib.nullcontext, jax.set_mesh):
        with around(speeds.sharding.mesh):
            found = run_on_auto_mesh(lambda x, which, one: {"x": x[which], "one": one}, (speeds, numbers, 3.0))
        np.testing.assert_array_equal(found["x"], SPEEDS[:4])
        assert found["x"].sharding.mesh == speeds.sharding.mesh
        assert found["one"] == 3.0


@pytest.mark.slow
def test_lanes_may_lie_on_a_mesh_of_either_type():
    """With and without the mesh around; the results lie there, too, and can be worked with."""
    values, numbers = {"initial.speed": SPEEDS[:4]}, np.arange(4)
    known = d.run_batch(LOOP, Batch(values, numbers), SOLVER, MEASURED)
    for kind in (AxisType.Auto, AxisType.Explicit):
        lanes = Batch(*placed(values, numbers, kind))
        run = d.run_batch(LOOP, lanes, SOLVER, MEASURED)
        with jax.set_mesh(run.metrics["iae"].sharding.mesh):
            again = d.run_batch(LOOP, lanes, SOLVER, MEASURED)
        for found in (run, again):
            same(jax.device_get(found), jax.device_get(known))
            assert found.metrics["iae"].sharding.mesh.axis_types == (kind,)
            np.testing.assert_array_equal(lanes.values["initial.speed"] + found.metrics["iae"] > 0, True)


def test_lanes_on_an_explicit_mesh_are_refused_within_jit():
    lanes = placed({"initial.speed": SPEEDS[:4]}, np.arange(4), AxisType.Explicit)
    with pytest.raises(
        ValueError, match="axes of type Explicit, within jit or a derivative; there they need Auto ones"
    ):
        jax.jit(lambda values, keys: d.run_batch(LOOP, Batch(values, keys), SOLVER, MEASURED))(*lanes)


@pytest.mark.slow
def test_lanes_lie_on_two_devices_of_a_mesh_of_either_type():
    """By either engine."""
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT / "tests" / "support"), *sys.path])
    done = subprocess.run([sys.executable, "-c", ON_TWO], env=environment, capture_output=True, text=True)
    assert done.stdout == "on two devices\n", done.stderr[-2000:]


ON_TWO = """
import jax, numpy as np
from jax.sharding import AxisType

import diffabs as d
from test_batch import LOOP, MEASURED, SOLVER, SPEEDS, placed, same

jax.config.update("jax_enable_x64", True)
values, numbers = {"initial.speed": SPEEDS[:4]}, np.arange(4)
known = d.run_batch(LOOP, d.Batch(values, numbers), SOLVER, MEASURED)
for kind in (AxisType.Auto, AxisType.Explicit):
    lanes = d.Batch(*placed(values, numbers, kind))
    assert len(lanes.values["initial.speed"].sharding.device_set) == 2
    for how in ({"together": True}, {"together": False}, {"engine": "kernel"}):
        same(jax.device_get(d.run_batch(LOOP, lanes, SOLVER, MEASURED, **how)), jax.device_get(known))
print("on two devices")
"""
