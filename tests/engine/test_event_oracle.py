"""Runs with events against SciPy, which finds them by itself: values, and d/d ln J of every metric."""

import dataclasses

import event_oracle
import numpy as np
import oracles
import pytest
from marks import cases

import diffabs as d
from diffabs import controllers, objectives

STEP = 1e-4
SLOW = ("robust, PI", "spline, latch, PI", "spline, latch, P", "fixed slip, P")
LOOPS = [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in event_oracle.LOOPS]
FLOOR = 0.01  # of what a metric is large: a speed of 0.01 m/s or a slip of 1e-4 matters to nobody


@pytest.fixture(scope="module")
def ours():
    found = {}

    def run(name, step=STEP):
        if (name, step) not in found:
            found[name, step] = event_oracle.ours(name, step)
        return found[name, step]

    return run


def misses(found, expected, tolerance, least=0.0):
    """One line for each metric that is off by more than `tolerance` of the larger of its size and `least`."""
    scale = np.maximum(np.abs(expected), least)
    return [
        f"{metric}: {a:.9g}, SciPy {b:.9g}"
        for metric, a, b, s in zip(event_oracle.METRICS, found, expected, scale, strict=True)
        if not abs(a - b) <= tolerance * s + 1e-12
    ]


@pytest.mark.parametrize("name", cases(LOOPS, "fixed slip, PI, clamping", "relay", "latch, P"))
def test_derivative_through_events(name, ours):
    least = np.maximum(0.1 * np.abs(event_oracle.values(name)), FLOOR)
    assert misses(ours(name)[1], event_oracle.sensitivities(name), 1e-3, least) == []


@pytest.mark.parametrize("name", cases(LOOPS, "fixed slip, PI, clamping", "relay", "latch, P"))
def test_value_across_events(name, ours):
    assert misses(ours(name)[0], event_oracle.values(name), 1e-8, FLOOR) == []


@pytest.mark.slow
def test_values_are_as_right_where_a_rate_jumps():
    """Without being asked: conditional integration begins and ends within a step."""
    name = "fixed slip, PI, clamping"
    metrics = d.measure(event_oracle.LOOPS[name], d.FixedStep(STEP, 4.0), objectives.BRAKING).metrics
    assert misses([metrics[one] for one in event_oracle.METRICS], event_oracle.values(name), 1e-8, FLOOR) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", event_oracle.LOOPS)
def test_values_converge(name, ours):
    assert misses(ours(name, STEP / 4)[0], event_oracle.values(name), 1e-9, FLOOR) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", event_oracle.LOOPS)
def test_derivatives_converge_with_the_second_order_at_least(name, ours):
    """From 4e-4 to 1e-4 the error falls by 16, or to what limits of the torque within a step leave."""
    exact = event_oracle.sensitivities(name)
    scale = np.maximum(np.abs(exact), np.maximum(0.1 * np.abs(event_oracle.values(name)), FLOOR))
    coarse, fine = (np.abs(ours(name, h)[1] - exact) / scale for h in (4 * STEP, STEP))
    bad = fine > np.maximum(coarse / 12, 4e-5)
    assert not bad.any(), list(zip(np.array(event_oracle.METRICS)[bad], coarse[bad], fine[bad], strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", event_oracle.LOOPS)
def test_the_oracle_does_not_depend_on_its_tolerance(name, monkeypatch):
    usual = event_oracle.values(name)
    monkeypatch.setattr(event_oracle, "TOLERANCE", event_oracle.TOLERANCE | {"rtol": 1e-13, "max_step": 1e-3})
    np.testing.assert_allclose(event_oracle.values(name), usual, rtol=1e-10, atol=1e-12)


# A relay whose band no slip leaves stands on the brake: the wheel locks.
STUCK = dataclasses.replace(event_oracle.LOOPS["relay"], controller=controllers.Relay(high=600.0, band=0.9))


@pytest.mark.parametrize("name", ["fixed slip, P", "locked"])
def test_the_oracle_is_the_other_one_where_nothing_jumps(name):
    """oracles.py integrates across the limit of the torque, which costs it a few digits."""
    loop = event_oracle.LOOPS.get(name, STUCK)
    c = loop.controller

    def torque(t, slip, memory):
        return 600.0 if loop is STUCK else np.clip(c.kp * (0.12 - slip), c.low, c.high)

    other = oracles.brake(loop.plant, torque, speed=22.0, stop=loop.stop.speed)
    mine, record = event_oracle.Brake(loop, loop.plant.inertia).run()
    for metric in ("stop_distance", "stop_time", "max_slip"):
        np.testing.assert_allclose(mine[metric], other[metric], rtol=1e-9, err_msg=metric)
    assert ("lock" in [what for _, what in record.events]) == (loop is STUCK)


def test_the_oracle_latches_at_the_peak_of_the_road():
    """Where friction does not depend on the speed, the deceleration is greatest at the knot with the most friction."""
    loop = event_oracle.LOOPS["spline, latch, P"]
    road = loop.plant.road
    _, record = event_oracle.Brake(loop, loop.plant.inertia).run()
    jumps = [what for _, what in record.events if what.startswith("target")]
    assert jumps == [f"target {road.slip[np.argmax(road.mu)]:.9g}"]
