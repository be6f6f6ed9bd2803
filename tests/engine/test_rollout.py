"""The rollout: order of accuracy, stops, frozen runs, batches, compilation, precision."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs import controllers, plants, references, roads
from diffabs.engine.drive.runs import _run
from diffabs.loop.arguments import prepare_arguments
from diffabs.loop.result import finish_run
from diffabs.loop.stability import stable_step
from diffabs.parts.actuators import Lag
from diffabs.parts.objectives import BRAKING, Effort, MaxSlip, TorqueRate, Variation
from diffabs.parts.stops import SpeedReached, Standstill
from diffabs.scenario.defaults import braking

RIG = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=50 / 3.6),
    controller=controllers.StateFeedback(),
    feedforward=controllers.HoldingInput(),
    stop=SpeedReached(speed=5 / 3.6),
)
SLIDING = braking(  # a locked wheel decelerates at mu(1) g: everything about it is known in closed form
    plant=plants.QuarterCar(),
    initial=d.BrakeStart(speed=10.0, slip=1.0),
    controller=controllers.ConstantTorque(torque=500.0),
)
DECELERATION = 0.75761 * 9.81  # last knot of the spline, times g


@pytest.mark.slow
def test_order_four_on_the_smooth_loop():
    fine = d.measure(RIG, d.FixedStep(1e-4, 2.0), BRAKING).metrics
    steps = np.array([1e-3, 5e-4])
    errors = [
        abs(d.measure(RIG, d.FixedStep(h, 2.0), BRAKING).metrics["stop_distance"] - fine["stop_distance"])
        for h in steps
    ]
    order = np.log(errors[0] / errors[1]) / np.log(2)
    assert 3.8 < order < 4.3  # two steps only, so the next term of the error shows


@pytest.mark.parametrize("step", [1e-3, 0.7e-3])
@pytest.mark.slow
def test_standstill_of_a_locked_wheel_in_closed_form(step):
    run = d.measure(SLIDING, d.FixedStep(step, 2.0), BRAKING)
    assert run.stopped
    np.testing.assert_allclose(run.metrics["stop_time"], 10 / DECELERATION, rtol=1e-12)
    np.testing.assert_allclose(run.metrics["stop_distance"], 50 / DECELERATION, rtol=1e-12)
    np.testing.assert_allclose(run.metrics["locked_time"], (10 - 0.05) / DECELERATION, rtol=1e-12)


@pytest.mark.slow
@killed_by("engine.step.switching", "(running & exact & ~crosses))", "(running & exact))")
def test_speed_reached_lands_between_samples():
    loop = dataclasses.replace(SLIDING, stop=SpeedReached(speed=3.0))
    run = d.rollout(loop, d.FixedStep(0.01, 2.0), {"effort": Effort(), "variation": Variation()})
    np.testing.assert_allclose(run.ending.sample.t, 7 / DECELERATION, rtol=1e-12)
    np.testing.assert_allclose(run.ending.sample.output.speed, 3.0, rtol=1e-12)
    np.testing.assert_allclose(run.ending.sample.output.distance, (100 - 9) / (2 * DECELERATION), rtol=1e-12)
    np.testing.assert_allclose(run.metrics["effort"], 500.0**2 * 7 / DECELERATION, rtol=1e-12)
    assert run.metrics["variation"] == 0


@pytest.mark.slow
@killed_by(
    "parts.objectives.braking",
    "rates = (jnp.abs(rate.control) for rate in segment.sample_rates())",
    "rates = (segment.step * jnp.abs(rate.control) for rate in segment.sample_rates())",
)
def test_the_torque_rate_of_a_lag_is_that_of_its_exponential():
    """u = U (1 - exp(-t/T)) from rest: U/T at once, and less from then on."""
    lag, h = 0.05, 1e-3
    loop = dataclasses.replace(SLIDING, stop=SpeedReached(speed=3.0), actuator=Lag(time_constant=lag))
    run = d.measure(loop, d.FixedStep(h, 2.0), {"rate": TorqueRate()})
    np.testing.assert_allclose(run.metrics["rate"], 500.0 / lag, rtol=1e-12)


@pytest.mark.slow
def test_the_peak_of_a_falling_slip_is_its_first_value():
    loop = dataclasses.replace(RIG, initial=d.BrakeStart(speed=10.0, slip=0.6))
    run = d.rollout(loop, d.FixedStep(1e-3, 0.01), {"max_slip": MaxSlip()})
    assert np.all(np.diff(run.trajectory.sample.output.slip) < 0)
    assert run.metrics["max_slip"] == 0.6


@killed_by(
    "loop.result",
    "(carry.status == RunStatus.TIMED_OUT) & ~diverged",
    "(carry.status == RunStatus.LANDING) & ~diverged",
)
@killed_by("engine.step.fixed", "request.strikes & (request.strike >= self.steps)", "request.strikes & False")
def test_a_run_that_does_not_stop_is_charged_the_rest():
    run = d.measure(SLIDING, d.FixedStep(1e-3, 0.5), BRAKING)
    assert run.timed_out
    assert not run.stopped
    assert not run.diverged
    assert not d.measure(SLIDING, d.FixedStep(1e-3, 3.0), BRAKING).timed_out
    np.testing.assert_allclose(run.ending.sample.t, 0.5, rtol=1e-12)
    np.testing.assert_allclose(run.metrics["stop_distance"], 50 / DECELERATION, rtol=1e-12)
    coasting = dataclasses.replace(
        SLIDING, controller=controllers.ConstantTorque(torque=0.0), initial=d.BrakeStart(speed=10.0)
    )
    assert d.measure(coasting, d.FixedStep(1e-3, 0.5), BRAKING).metrics["stop_distance"] > 1e4


@pytest.mark.slow
def test_literal_estimator_does_not_brake():
    loop = dataclasses.replace(braking(), reference=references.PeakLiteral())
    run = d.measure(loop, d.FixedStep(1e-3, 10.0), BRAKING)
    assert not run.stopped
    assert run.ending.sample.output.distance > 270


@pytest.mark.slow
def test_a_trajectory_is_frozen_after_its_end_and_thinned():
    run = d.rollout(SLIDING, d.FixedStep(1e-3, 3.0, every=10), BRAKING)
    trajectory = run.trajectory
    assert trajectory.sample.t.shape == (301,)
    assert trajectory.finite()
    on = np.asarray(trajectory.running)
    np.testing.assert_allclose(trajectory.sample.t[on], np.arange(on.sum()) * 0.01, rtol=0, atol=1e-12)
    np.testing.assert_allclose(trajectory.sample.t[~on], run.ending.sample.t, rtol=0, atol=0)
    np.testing.assert_allclose(
        trajectory.sample.output.speed[on], 10 - DECELERATION * trajectory.sample.t[on], rtol=1e-12
    )


@pytest.mark.slow
def test_streamed_and_stored_runs_agree():
    solver = d.FixedStep(1e-3, 2.0, every=7)
    streamed, stored = d.measure(RIG, solver, BRAKING), d.rollout(RIG, solver, BRAKING)
    for name in BRAKING:
        np.testing.assert_allclose(streamed.metrics[name], stored.metrics[name], rtol=1e-13, atol=1e-15, err_msg=name)


@pytest.mark.slow
def test_vmap_over_masses_and_roads_equals_single_runs():
    solver = d.FixedStep(1e-3, 2.0)

    def run(mass, w4):
        return d.measure(d.replace(RIG, {"plant.mass": mass, "plant.road.w4": w4}), solver, BRAKING)

    masses, peaks = jnp.array([5.3, 5.7, 6.2]), jnp.array([0.3, 0.407, 0.6])
    many = jax.vmap(run)(masses, peaks)
    for i in range(3):
        one = run(masses[i], peaks[i])
        for name in BRAKING:
            np.testing.assert_allclose(many.metrics[name][i], one.metrics[name], rtol=1e-12, atol=1e-14)


def test_new_values_do_not_compile_again():
    solver = d.FixedStep(1e-3, 0.02)
    d.measure(RIG, solver, BRAKING)
    before = _run._cache_size()
    d.measure(d.replace(RIG, {"plant.mass": 6.0}), solver, BRAKING)
    d.measure(d.replace(RIG, {"plant.mass": jnp.asarray(6.1), "initial.speed": np.float64(12.0)}), solver, BRAKING)
    d.measure(RIG, d.FixedStep(0.9e-3, 0.018), BRAKING)  # same number of steps
    d.measure(RIG, d.FixedStep(1e-3, 0.03), BRAKING)
    assert _run._cache_size() == before


@jax.jit
def plainly(loop, objectives, method, tries):
    loop, audit = loop.prepare_run()
    objectives = objectives | audit
    carry = method.start(loop, objectives, None)
    over = jax.lax.fori_loop(
        0, tries, lambda _, carry: method.step(loop, objectives, None, method.renew(loop, carry)), carry
    )
    return finish_run(loop, objectives, over)[0]


@pytest.mark.slow
@pytest.mark.parametrize("duration", [3.0, 0.3, 0.02])
@pytest.mark.parametrize("like", [d.FixedStep(1e-3), d.Adaptive()], ids=["fixed", "adaptive"])
def test_another_duration_compiles_nothing_new(duration, like):
    """Against the steps one after the other, without any driver but what renews the longest stable step."""
    solver = dataclasses.replace(like, duration=duration)
    d.measure(RIG, dataclasses.replace(like, duration=0.5), BRAKING)
    before = _run._cache_size()
    run = d.measure(RIG, solver, BRAKING)
    assert _run._cache_size() == before
    loop, objectives, method = prepare_arguments(RIG, solver, BRAKING)
    alone = plainly(loop, objectives, method, 2 * solver.steps + 200)
    assert bool(run.stopped) == (duration == 3.0)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-13), run, alone)


@pytest.mark.slow
def test_trajectories_of_all_durations_share_a_program():
    d.rollout(RIG, d.FixedStep(1e-3, 0.5, every=5), BRAKING)
    before = _run._cache_size()
    all_of_it = d.rollout(RIG, d.FixedStep(1e-3, 3.0), BRAKING).trajectory
    for duration, every in ((0.494, 5), (0.306, 3)):
        seen = d.rollout(RIG, d.FixedStep(1e-3, duration, every=every), BRAKING).trajectory
        assert len(seen.sample.t) == -(-round(duration * 1000) // every) + 1
        whole = round(duration * 1000) // every * every  # the last instant of a stride that does not fit is another
        np.testing.assert_array_equal(
            seen.sample.output.slip[: whole // every + 1], all_of_it.sample.output.slip[: whole + 1 : every]
        )
    assert _run._cache_size() == before + 1  # of the whole trajectory's length


@killed_by(
    "engine.drive.loops",
    "jax.lax.while_loop(lambda carry: any_lane(carry.running), block",
    "jax.lax.while_loop(lambda carry: ~any_lane(~carry.running), block",
)
@killed_by("core.lanes", "jnp.any(running, axis=0)", "jnp.all(running, axis=0)")
@pytest.mark.slow
def test_a_batch_ends_with_its_last_lane():
    """Behind `vmap` the condition of the loop is one for all lanes; each lane ends as it would alone, also if another
    has no time to stop."""
    speeds = jnp.array([3.0, 12.0, 7.0])

    def run(speed, duration):
        return d.measure(d.replace(RIG, {"initial.speed": speed}), d.FixedStep(1e-3, duration), BRAKING)

    for duration, stopped in ((1e5, [True, True, True]), (1.0, [True, False, True])):
        many = jax.vmap(jax.vmap(partial(run, duration=duration)))(speeds[None])
        np.testing.assert_array_equal(many.stopped[0], stopped)
        for i, speed in enumerate(speeds):
            np.testing.assert_allclose(many.ending.sample.t[0, i], run(speed, duration).ending.sample.t, rtol=1e-12)


@killed_by(
    "loop.result",
    "invalidate(metrics, diverged, (loop, objectives))",
    "metrics",
)
@pytest.mark.slow
def test_a_diverging_run_changes_no_other_run():
    solver = d.FixedStep(1e-3, 0.5)

    def run(gain):
        return d.measure(d.replace(RIG, {"controller.gain": gain}), solver, BRAKING)

    gains = jnp.array([[-11753.0, -48.0], [jnp.inf, 0.0], [-1000.0, -100.0]])
    many = jax.vmap(run)(gains)
    np.testing.assert_array_equal(many.diverged, [False, True, False])
    assert np.isnan(many.metrics["iae"][1])
    alone = jax.vmap(run)(gains.at[1].set(gains[0]))
    np.testing.assert_array_equal(many.metrics["iae"][0], alone.metrics["iae"][0])


@pytest.mark.slow
def test_float32_follows_the_inputs():
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), RIG)
    run = d.measure(single, d.FixedStep(1e-3, 2.0), BRAKING)
    double = d.measure(RIG, d.FixedStep(1e-3, 2.0), BRAKING)
    assert run.metrics["stop_time"].dtype == jnp.float32
    for name in ("stop_time", "stop_distance", "max_slip"):
        # 1,600 additions with rounding errors of 6e-8 that mostly cancel
        np.testing.assert_allclose(run.metrics[name], double.metrics[name], rtol=5e-5, err_msg=name)


@pytest.mark.parametrize(
    ("field", "value"),
    [("step", 0.0), ("step", -1e-3), ("duration", float("nan")), ("every", 0), ("step", float("inf"))],
)
def test_bad_solver_is_named(field, value):
    with pytest.raises(ValueError, match=rf"solver\.{field} = .* is not positive"):
        d.rollout(RIG, dataclasses.replace(d.FixedStep(), **{field: value}))


def test_stable_step_is_where_the_scalar_test_equation_says():
    # the P loop's slip rate is r kp/(J v), and RK4 leaves |R(-x)| <= 1 at x = 2.785293563405282
    slippery = plants.QuarterCar(road=roads.Scaled(road=roads.SPLINE_B, scale=1e-3))  # so that the road adds nothing
    loop, r, kp, J, v = braking(plant=slippery), 0.2, 3893.0, 1.04456, 0.05
    np.testing.assert_allclose(stable_step(loop), 2.785293563405282 * J * v / (r * kp), rtol=0.02)
    slower = dataclasses.replace(loop, stop=Standstill(speed=0.5))
    assert stable_step(slower) > 8 * stable_step(loop)


ROADS = {
    "rig": roads.RIG,
    "asphalt": roads.DRY_ASPHALT,
    "snow": roads.SNOW,
    "ice": roads.ICE,
    "spline": roads.SPLINE_B,
    "magic": roads.MagicFormula(),
    "patches": roads.Patches(
        roads=(roads.DRY_ASPHALT, roads.ICE, roads.WET_ASPHALT), edges=np.array([2.0, 4.0]), width=0.0
    ),
}
PASSIVE = {
    "car": (plants.QuarterCar(), 60.0),
    "rig": (plants.MirroredRig(), 5.0),
    "lab": (plants.LabRig(), 0.8),
    "road vehicle": (plants.RoadVehicle(), 2500.0),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "plant", ["car", *(pytest.param(name, marks=pytest.mark.slow) for name in ("rig", "lab", "road vehicle"))]
)
def test_energy_never_increases_down_to_standstill(plant):
    """Brakes and friction only take energy, on every road, while the wheel rolls, locks, sticks and stands."""
    part, torque = PASSIVE[plant]
    solver = d.FixedStep(1e-4, 14.0, every=20)
    for name, road in ROADS.items():
        loop = braking(
            plant=dataclasses.replace(part, road=road),
            initial=d.BrakeStart(speed=6.0),
            controller=controllers.ConstantTorque(torque=torque),
            stop=SpeedReached(speed=1e-9),  # never: the run goes on at standstill
        )
        trajectory = d.rollout(loop, solver).trajectory
        energy = np.asarray(jax.vmap(loop.plant.energy)(trajectory.state))
        assert np.all(np.diff(energy) <= 1e-8 * energy[0]), (name, np.max(np.diff(energy)))
        assert np.all(np.asarray(trajectory.sample.output.speed) >= 0)
        # at rest but for what the last steps did: below the crawl speed the wheel's rate is too fast for any step
        assert trajectory.sample.output.speed[-1] < 4 * 9.81 * solver.step, name
