"""Lanes that are refilled against `jax.vmap` of `measure`, whatever its width."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffabs as d
from diffabs import controllers, plants
from diffabs.core.pytree import replace
from diffabs.objectives import BRAKING
from diffabs.scenario.defaults import braking
from diffabs.sensors import Noise
from diffabs.simulate.refill import ROUND, _run, measure_lanes
from diffabs.stops import SpeedReached

pytestmark = pytest.mark.xdist_group("conveyor")  # one worker compiles what these share

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
WIDTHS = [1, 4, len(SPEEDS) + 5]


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

    def reached(self, number, output):
        return output.speed < self.speeds[jnp.minimum(number, len(self.speeds) - 1)]


@pytest.mark.parametrize("width", WIDTHS)
def test_a_lane_of_which_enough_is_seen_is_taken_off(keys, expected, width):
    """At the next look; it has not stopped, and the others are what they were."""
    limits = np.zeros(len(SPEEDS))
    limits[NEVER], limits[8], limits[SHORT] = 24.5, 7.5, 6.9
    found = jax.device_get(
        measure_lanes(LOOP, VALUES, SOLVER, MEASURED, keys=keys, width=width, enough=Slow(jnp.asarray(limits)))
    )
    early = np.isin(np.arange(len(SPEEDS)), [NEVER, 8])  # the other ends before it is that slow
    assert not found.stopped[early].any()
    assert np.all(found.ending.sample.output.speed[early] < limits[early])
    taken = found.ending.sample.t[early] / SOLVER.step
    np.testing.assert_allclose(taken, ROUND * np.round(taken / ROUND), rtol=1e-12)
    assert np.all(taken < 0.9 * expected.ending.sample.t[early] / SOLVER.step)
    same(*(jax.tree.map(lambda x: x[~early], run) for run in (found, expected)))


def test_the_lanes_are_what_they_are_meant_to_be(expected):
    taken = expected.ending.sample.t / SOLVER.step
    assert np.flatnonzero(expected.diverged).tolist() == [AT_ONCE, DIVERGING]  # one begins below its stop
    assert sorted(np.flatnonzero(~expected.stopped)) == [NEVER, AT_ONCE, DIVERGING]
    assert taken[NEVER] == SOLVER.steps > 3 * ROUND
    assert taken[AT_ONCE] == 0
    assert 0 < taken[SHORT] < ROUND
    assert np.isnan(expected.metrics["iae"]).tolist() == expected.diverged.tolist()
    assert len(np.unique(expected.metrics["iae"][[SHORT, 6]])) == 2  # noise of their own, everything else is equal


@pytest.mark.parametrize("width", WIDTHS)
def test_lanes_are_those_of_a_batch(keys, expected, width):
    same(jax.device_get(measure_lanes(LOOP, VALUES, SOLVER, MEASURED, keys=keys, width=width)), expected)


def test_without_keys(keys, expected):
    quiet = replace(LOOP, {"sensor": braking(plant=LOOP.plant).sensor})
    found = jax.device_get(measure_lanes(quiet, VALUES, SOLVER, MEASURED, width=4))
    one = jax.device_get(d.measure(replace(quiet, {"initial.speed": SPEEDS[3]}), SOLVER, MEASURED))
    same(jax.tree.map(lambda x: x[3], found), one)
    assert found.metrics["iae"][SHORT] == found.metrics["iae"][6]


def test_one_compilation_for_new_values(keys):
    measure_lanes(LOOP, VALUES, SOLVER, MEASURED, keys=keys, width=4)
    before = _run._cache_size()
    measure_lanes(LOOP, {**VALUES, "initial.speed": 1.01 * SPEEDS}, SOLVER, MEASURED, keys=keys, width=4)
    assert _run._cache_size() == before


def test_nothing_that_differs_is_an_error():
    with pytest.raises(ValueError, match="no value differs between the lanes"):
        measure_lanes(LOOP, {}, SOLVER, MEASURED)
