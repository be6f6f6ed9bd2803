"""Estimates of a run's errors against SciPy's solution of the same loop, and against each other."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import cases
from mutants import killed_by
from oracles import brake

import diffabs as d
from diffabs import actuators, controllers, plants, references, sensors, stops
from diffabs.core import blocks
from diffabs.loop import accuracy as acc
from diffabs.loop.checking import describe_loose_metrics
from diffabs.parts.objectives import IAE, MaxSlip, StopDistance, StopTime
from diffabs.scenario.defaults import braking

OBJECTIVES = {"stop_time": StopTime(), "stop_distance": StopDistance(), "max_slip": MaxSlip(), "iae": IAE()}
RIG = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=10.0, slip=0.15),
    stop=stops.SpeedReached(speed=4.0),
    controller=controllers.StateFeedback(gain=np.array([-900.0, -60.0])),
    feedforward=controllers.ConstantInput(value=7.0),
)


def feedback(low=-np.inf, high=np.inf):
    return (lambda t, s, m: np.clip(7.0 - 900.0 * m[0] - 60.0 * (s - 0.2), low, high)), (lambda t, s, m: [s - 0.2])


def truth(low=-np.inf, high=np.inf):
    torque, rates = feedback(low, high)
    return brake(RIG.plant, torque, speed=10.0, stop=4.0, slip=0.15, memory=1, rates=rates)


@pytest.mark.slow
@killed_by(
    "loop.accuracy",
    "error = jnp.abs(d1) + jnp.abs(d2) / (1 - jnp.minimum(q, MAX_DIFFERENCE_RATIO))",
    "error = jnp.abs(d1)",
)
def test_the_error_of_a_smooth_loop_is_that_of_fourth_order():
    """Sixteen fifteenths of what the half step changes; and the half step's own error is a fifteenth."""
    found, exact = acc.estimate_accuracy(RIG, d.FixedStep(4e-3, 2.0), OBJECTIVES), truth()
    assert found.comparable
    assert found.alike
    for name in ("stop_time", "stop_distance"):
        one = found.estimates[name]
        error = abs(float(one.value) - exact[name])
        assert error > 1e-9, (name, error)
        assert float(one.order) == pytest.approx(4.0, abs=0.1)
        assert float(one.error) == pytest.approx(error, rel=0.01)
        assert float(one.error) == pytest.approx(16 / 15 * abs(float(one.difference)), rel=0.01)
        assert abs(float(one.value + one.difference) - exact[name]) == pytest.approx(error / 16, rel=0.1)
        assert one.converges


@pytest.mark.slow
def test_the_estimate_shows_the_order_lost_to_a_torque_limit():
    loop = d.replace(RIG, {"controller.low": 0.0, "controller.high": 8.0})
    exact = truth(0.0, 8.0)
    found = acc.estimate_accuracy(loop, d.FixedStep(2e-3, 2.0), OBJECTIVES)
    for name, one in found.estimates.items():
        error = abs(float(one.value) - exact[name])
        assert error <= 4 * float(one.error) + 1e-9, (name, error, one)
        assert float(one.error) <= 300 * error + 1e-7, (name, error, one)


def relay():
    return dataclasses.replace(RIG, controller=controllers.Relay(high=12.0, band=0.05))


def delayed(time=0.0061):
    controller = controllers.StateFeedback(gain=np.array([-100.0, -10.0]))
    return dataclasses.replace(RIG, actuator=actuators.Delay(time=time, capacity=16), controller=controller)


@pytest.mark.slow
@pytest.mark.parametrize(("make", "step"), [(relay, 1e-3), (delayed, 1e-3)])
def test_events_and_delays_are_estimated_to_their_size(make, step):
    """Against the same loop with steps 32 times shorter; within a factor of ten."""
    found = acc.estimate_accuracy(make(), d.FixedStep(step, 2.0), OBJECTIVES)
    exact = acc.measure_finer(make(), d.FixedStep(step, 2.0), OBJECTIVES, 32).metrics
    for name, one in found.estimates.items():
        error = abs(float(one.value - exact[name]))
        assert error <= 10 * float(one.error) + 1e-9, (name, error, one)
        assert float(one.error) <= 30 * error + 1e-5 * abs(float(one.value)), (name, error, one)


@killed_by("parts.actuators.delay", "capacity=times * self.capacity", "capacity=self.capacity")
@pytest.mark.slow
def test_a_delay_keeps_its_time_at_a_shorter_step():
    """A ring of 16 steps of 1 ms holds 13.1 ms, one of 16 steps of 0.25 ms does not."""
    finer = acc.measure_finer(delayed(0.0131), d.FixedStep(1e-3, 2.0), OBJECTIVES, 4).metrics
    longer = dataclasses.replace(delayed(), actuator=actuators.Delay(time=0.0131, capacity=256))
    expected = d.measure(longer, d.FixedStep(2.5e-4, 2.0), OBJECTIVES).metrics
    for name, value in expected.items():
        assert finer[name] == pytest.approx(float(value), rel=1e-12), name


def noisy(period):
    return dataclasses.replace(RIG, sensor=sensors.Noise(slip=0.01, period=period))


@pytest.mark.slow
def test_noise_with_its_own_clock_is_the_same_at_every_step():
    key, solver = jax.random.key(4), d.FixedStep(1e-3, 2.0)
    found = acc.estimate_accuracy(noisy(2e-3), solver, OBJECTIVES, key=key)
    assert found.comparable
    assert acc.incomparability_reasons(noisy(2e-3), solver, key) == []
    for name, one in found.estimates.items():
        assert float(one.error) < 1e-3 * abs(float(one.value)), name
    other = d.measure(noisy(2e-3), solver, OBJECTIVES, key=jax.random.key(5)).metrics
    assert abs(other["iae"] / found.estimates["iae"].value - 1) > 1e-2  # what another realisation would do


@killed_by("loop.accuracy", "    if key is None:", "    if True:", case="0.00025")
@pytest.mark.slow
@pytest.mark.parametrize("period", cases([2.5e-4, 1.5e-3], 2.5e-4))
def test_other_noise_is_not_compared(period):
    key, solver = jax.random.key(4), d.FixedStep(1e-3, 2.0)
    with pytest.raises(ValueError, match="period"):  # a clock off the grid
        acc.estimate_accuracy(noisy(period), solver, OBJECTIVES, key=key)
    found = jax.jit(lambda period: acc.estimate_accuracy(noisy(period), solver, OBJECTIVES, key=key))(period)
    assert not found.comparable
    assert all(np.isnan(float(one.error)) and not one.converges for one in found.estimates.values())
    assert "other noise" in acc.incomparability_reasons(noisy(period), solver, key)[0]


def test_what_computes_in_every_step_is_not_compared():
    solver = d.FixedStep(1e-3, 2.0)
    for reference, paced in ((references.PeakLiteral(), True), (references.PeakLatch(), False)):
        loop = dataclasses.replace(RIG, reference=reference)
        assert bool(acc.incomparability_reasons(loop, solver)) == paced
        assert bool(acc.is_comparable(loop, solver)) != paced
    observer = controllers.ObserverFeedback()
    assert list(acc.per_step_blocks(dataclasses.replace(RIG, controller=observer))) == ["controller"]
    assert (
        list(acc.per_step_blocks(dataclasses.replace(RIG, controller=controllers.Sampled(controller=observer)))) == []
    )
    series = blocks.Series(blocks=(sensors.Bias(), sensors.Noise()))
    assert list(acc.per_step_blocks(dataclasses.replace(RIG, sensor=series))) == []
    assert acc.needs_key(dataclasses.replace(RIG, sensor=series))
    assert not acc.needs_key(RIG)


@pytest.mark.slow
def test_lanes_are_estimated_together():
    def one(mass):
        return acc.estimate_accuracy(d.replace(RIG, {"plant.mass": mass}), d.FixedStep(4e-3, 2.0), OBJECTIVES)

    masses = jnp.array([5.3, 6.2])
    both = jax.vmap(one)(masses)
    for i, mass in enumerate(masses):
        alone = one(mass)
        for name in OBJECTIVES:
            np.testing.assert_allclose(
                both.estimates[name].error[i], alone.estimates[name].error, rtol=1e-3, atol=1e-12
            )


def test_a_run_that_diverges_at_a_shorter_step_is_not_alike():
    runs = [
        d.Run({}, jnp.asarray(stopped), jnp.asarray(diverged), jnp.asarray(False), None, None)  # pyright: ignore[reportArgumentType]
        for stopped, diverged in ((True, False), (False, False), (False, True))
    ]
    assert acc.runs_end_alike(runs[0], runs[0])
    assert acc.runs_end_alike(runs[1], runs[1])
    assert not acc.runs_end_alike(runs[0], runs[1])
    assert not acc.runs_end_alike(runs[1], runs[2])


def test_share_of_nothing():
    np.testing.assert_array_equal(
        acc.relative_difference(np.array([0.0, 1.0, -1.0]), np.array([0.0, 0.0, 4.0])), [0, np.inf, 0.25]
    )


def test_a_run_says_what_its_solver_does_not_hold():
    """A metric that a smaller `rtol` moves by more than 100 rtol is told; one that is about 0, or infinite, is not."""
    solver, asked, never = d.Adaptive(1e-5), [], float("inf")

    def again(other):
        asked.append(other)
        return d.Run({"a": 2.0, "b": 2.0, "c": 1e-9, "t": never}, True, False, False, None, None)  # pyright: ignore[reportArgumentType]

    (line,) = describe_loose_metrics({"a": 2.0 + 2.1e-3, "b": 2.0 + 1.9e-3, "c": 2e-9, "t": never}, solver, again)
    assert line.startswith("solver.rtol = 6.3e-07 changes a by 0.1 %: the run chatters")
    assert asked == [dataclasses.replace(solver, rtol=1e-5 / 16)]
    assert not describe_loose_metrics({"a": 2.0, "b": 2.0, "c": 1e-9, "t": never}, solver, again)
