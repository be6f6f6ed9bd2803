"""Adaptive steps: what they measure against fixed steps small enough, on kinks, events and clocks; trajectories;
derivatives against differences; lanes that diverge."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import random_loops
from mutants import killed_by
from scipy.optimize import brentq

import diffabs as d
from diffabs import actuators, controllers, plants, references, roads, stops
from diffabs.core.cubic import Cubic, HermiteStep
from diffabs.core.protocols import Memory
from diffabs.core.pytree import arrays, get, prepare_parts, refine_parts
from diffabs.engine.admission import build_field
from diffabs.engine.drive.runs import build_stepping
from diffabs.engine.step import modes, step_size
from diffabs.engine.step.adaptive import StateSpan
from diffabs.engine.step.replay import BASE_LOG_CAPACITY, log_capacity, states_between
from diffabs.loop.arguments import prepare_arguments
from diffabs.loop.closed_loop import LoopState
from diffabs.parts.objectives import BRAKING, IAE, MaxSlip, StopDistance
from diffabs.robust.design.attraction import Cells, region_of_attraction
from diffabs.scenario.scenario import load
from diffabs.tune import worst_case

LIMITS = ("controller.low=0.0", "controller.high=9.03")
SAMPLED = "controller={type='sampled',controller={type='pid',low=0.0,high=9.03},period=0.005}"
FINE = 4  # times shorter than a scenario's are the fixed steps that are compared with
MEASURED = {"iae": IAE(), "max_slip": MaxSlip(), "stop_distance": StopDistance()}


def rig(*changes: str):
    return load("slip-lmi", list(LIMITS + changes))


def close(run, reference, tolerance, least=1e-6):
    for name in set(reference.metrics) - {"final_slip_error"}:  # it is 0, to rounding
        value, found = np.asarray(reference.metrics[name]), np.asarray(run.metrics[name])
        never = np.isinf(value)  # what is measured is never reached
        np.testing.assert_array_equal(found[never], value[never], name)
        value, found = value[~never], found[~never]
        off = np.abs(found - value)
        scale = 0.1 if name == "overshoot" else least  # it is the small difference of a peak and the set point
        some = 2 if name == "peak_torque" else 1  # fixed steps see it at their ends, others by a parabola
        assert np.all(off <= some * tolerance * np.maximum(np.abs(value), scale)), (name, found, value)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["lab-rig", *(pytest.param(n, marks=pytest.mark.slow) for n in ("slip-estimator", "arm-hanging"))]
)
def test_a_packaged_scenario_agrees_with_fixed_steps(name):
    chosen = load(name)
    run = d.measure(chosen.loop, d.Adaptive(1e-5, chosen.solver.duration, chosen.solver.step), chosen.objectives)
    reference = d.measure(chosen.loop, chosen.solver, chosen.objectives)
    assert (run.stopped, run.diverged, run.timed_out) == (reference.stopped, reference.diverged, reference.timed_out)
    close(run, reference, 1e-4)


@pytest.mark.slow
def test_every_run_of_a_box_is_right_on_undeclared_limits():
    chosen = rig()
    mass, speed = (x.ravel() for x in np.meshgrid(np.linspace(5.3, 6.2, 6), np.linspace(8.5, 16.5, 6)))
    lanes = d.Batch({"plant.mass": mass, "initial.speed": speed})
    run = d.run_batch(chosen.loop, lanes, d.Adaptive(1e-5, 2.5), MEASURED)
    close(run, d.run_batch(chosen.loop, lanes, d.FixedStep(1e-4, 2.5), MEASURED), 1e-4)


@pytest.mark.slow
def test_a_smaller_step_error_makes_a_smaller_run_error():
    chosen = rig()
    exact = d.measure(chosen.loop, d.FixedStep(1e-5, 2.5), {"iae": IAE()}).metrics["iae"]
    errors = [
        abs(d.measure(chosen.loop, d.Adaptive(rtol, 2.5), {"iae": IAE()}).metrics["iae"] / exact - 1)
        for rtol in (1e-4, 1e-6, 1e-8)
    ]
    assert errors[0] < 5e-3
    assert errors[1] < errors[0] / 20
    assert errors[2] < 2e-7


@pytest.mark.slow
@pytest.mark.parametrize("name", random_loops.STRUCTURES)
def test_random_loops_of_any_parts_are_right_to_1e_4(name):
    structure, key = random_loops.STRUCTURES[name], jax.random.key(1)
    measured = {n: one for n, one in structure.objectives.items() if n != "torque_rate"}  # a jump counts by the grid
    loop = random_loops.drawn(name, 0, 0)
    run = d.measure(loop, d.Adaptive(1e-5, structure.duration, structure.step), measured, key=key)
    fixed = d.FixedStep(structure.step / FINE, structure.duration, kinks=True)
    close(run, d.measure(refine_parts(loop, FINE), fixed, measured, key=key), 1e-4, 1e-3)


@killed_by("engine.step.adaptive", "SHORT_OF_SURFACE_FRACTION = 0.995", "SHORT_OF_SURFACE_FRACTION = 1.0")
@pytest.mark.slow
def test_a_rate_that_jumps_at_a_limit_is_passed():
    """A valve stops at its limit. Steps that end there once went away from it, and became ever shorter."""
    structure = random_loops.STRUCTURES["valve"]
    loops = [random_loops.drawn("valve", 0, number) for number in range(40)]
    batch = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(one) for one in x]), *loops)
    wanted = {name: structure.objectives[name] for name in ("stop_time", "effort")}

    def measured(rtol):
        solver = d.Adaptive(rtol, structure.duration, structure.step)
        return jax.jit(jax.vmap(lambda loop: d.measure(loop, solver, wanted).metrics))(batch)

    finest = measured(1e-7)
    assert np.all(np.isfinite(finest["stop_time"]))
    for rtol in (1e-3, 1e-5, 1e-6):
        for name, value in measured(rtol).items():
            np.testing.assert_allclose(value, finest[name], rtol=10 * rtol, err_msg=f"{name} at rtol {rtol}")


@killed_by(
    "engine.step.adaptive", "jnp.minimum(hybrid.next_tick(k, self.h), self.steps)", "jnp.minimum(k + 1, self.steps)"
)
@pytest.mark.slow
def test_a_computer_ticks_on_its_own_clock():
    chosen = load("slip-cured", ["sensor=noise", "sensor.slip=0.002"])
    key = jax.random.key(4)
    coarse, fine = (
        d.measure(chosen.loop, d.Adaptive(1e-6, 3.0, step), chosen.objectives, key=key) for step in (1e-3, 1e-4)
    )
    for name in chosen.objectives:
        np.testing.assert_allclose(coarse.metrics[name], fine.metrics[name], rtol=1e-9, atol=1e-12)
    close(fine, d.measure(chosen.loop, d.FixedStep(1e-4, 3.0), chosen.objectives, key=key), 1e-4, 1e-3)


@killed_by(
    "engine.step.adaptive",
    "inside = (t < now.t) & (last.flow.end > last.flow.start)",
    "inside = (t < now.t) & (last.flow.end < last.flow.start)",
)
@pytest.mark.slow
def test_a_trajectory_is_kept_on_the_grid_and_changes_nothing():
    chosen = rig()
    solver = d.Adaptive(1e-6, 2.5, 1e-3, every=7)
    seen = d.rollout(chosen.loop, solver, BRAKING)
    reference = d.rollout(chosen.loop, d.FixedStep(1e-4, 2.5, every=70), BRAKING)
    alone = d.measure(chosen.loop, solver, BRAKING)
    for name, value in alone.metrics.items():  # by another program, whose last digits lead to other steps
        np.testing.assert_allclose(seen.metrics[name], value, rtol=1e-7, atol=1e-8)
    trajectory, like = seen.trajectory.sample, reference.trajectory.sample
    np.testing.assert_allclose(trajectory.t, like.t, atol=1e-6)
    np.testing.assert_allclose(trajectory.output.slip, like.output.slip, atol=2e-5)
    np.testing.assert_allclose(trajectory.control, like.control, atol=0.05)  # it has kinks between two points
    np.testing.assert_array_equal(seen.trajectory.running, reference.trajectory.running)


@pytest.mark.slow
def test_the_other_runs_of_a_batch_change_no_number():
    """As many lanes each time, and as above, so that one program runs them. Those without a speed, or that begin beyond
    their stop, have diverged."""
    speed = np.linspace(8.0, 16.0, 36)

    def run(speeds, together=False):
        lanes = d.Batch({"plant.mass": np.full(36, 5.7), "initial.speed": speeds})
        return d.run_batch(rig().loop, lanes, d.Adaptive(1e-5, 2.5), MEASURED, together=together, accepted=True)

    whole = run(speed).metrics["iae"]
    np.testing.assert_allclose(run(speed[::-1]).metrics["iae"][::-1], whole, rtol=1e-9)
    np.testing.assert_allclose(run(speed, True).metrics["iae"], whole, rtol=1e-9)
    others = run(np.concatenate([[np.nan, 0.5], np.tile(speed[3:20], 2)]))
    np.testing.assert_allclose(others.metrics["iae"][2:], np.tile(whole[3:20], 2), rtol=1e-9)
    np.testing.assert_array_equal(others.diverged, np.arange(36) < 2)
    np.testing.assert_array_equal(np.isnan(others.metrics["iae"]), np.arange(36) < 2)


@pytest.mark.slow
@killed_by("engine.step.adaptive", "return jnp.where(due, new, control.limit)", "return new")
def test_the_stability_limit_of_a_run_does_not_depend_on_its_neighbours():
    """Runs that wait for an instant of a trajectory have made different numbers of attempts."""

    def run(masses):
        lanes, solver = d.Batch({"plant.mass": masses}), d.Adaptive(1e-5, 3.0, 1e-2, every=50)
        return d.run_batch(d.braking(), lanes, solver, {"iae": IAE()}, trajectories=True).metrics["iae"][0]

    np.testing.assert_allclose(run([12.0, 18.0]), run([12.0, 12.0]), rtol=1e-12)


@pytest.mark.slow
def test_a_computer_in_single_precision_keeps_its_time():
    """Between two instants of a clock, times are known to a ten-thousandth of a period."""
    chosen = load("slip-cured")
    measured = {"iae": IAE(), "max_slip": MaxSlip()}
    solver = d.Adaptive(4e-6, 1.6, 1e-3)
    exact = d.measure(chosen.loop, solver, measured)
    with jax.enable_x64(False):
        run = d.measure(jax.tree.map(lambda x: np.asarray(x, np.float32), chosen.loop), solver, measured)
    close(run, exact, 2e-4)


@killed_by("engine.step.adaptive", "MIN_RTOL_EPS = 32 ", "MIN_RTOL_EPS = 0 ")
@pytest.mark.slow
def test_single_precision_asks_for_no_smaller_error_than_it_has():
    chosen = rig()
    exact = d.measure(chosen.loop, d.Adaptive(1e-9, 2.5), {"iae": IAE()})
    with jax.enable_x64(False):
        loop = jax.tree.map(lambda x: np.asarray(x, np.float32), chosen.loop)
        assert prepare_arguments(loop, d.Adaptive(1e-9, 2.5), {})[2].rtol == np.float32(32 * np.finfo(np.float32).eps)
        run = d.measure(loop, d.Adaptive(1e-9, 2.5), {"iae": IAE()})
    np.testing.assert_allclose(run.metrics["iae"], exact.metrics["iae"], rtol=1e-4)


def on_limits(solver):
    """Metrics as functions of two changes of the gain, relative."""
    chosen = rig()
    gain = jnp.asarray(chosen.loop.controller.gain)

    def metrics(scale):
        run = d.measure(d.replace(chosen.loop, {"controller.gain": gain * (1 + scale)}), solver, MEASURED)
        return jnp.stack([run.metrics[name] for name in MEASURED])

    return metrics


@killed_by(
    "engine.step.adaptive",
    "KEPT_MODES if self.switches == FREE_MODES else self.switches",
    "self.switches",
)
@pytest.mark.slow
def test_derivatives_on_limits_agree_with_differences():
    slopes = jax.jit(jax.jacfwd(on_limits(d.Adaptive(1e-5, 2.5))))(jnp.zeros(2))
    exact = jax.jit(jax.vmap(on_limits(d.Adaptive(1e-9, 2.5))))
    widths = np.array([1e-2, 3e-3, 1e-3])
    moved = exact(np.concatenate([sign * width * np.eye(2) for width in widths for sign in (1, -1)]))
    right, left = np.moveaxis(np.asarray(moved).reshape(3, 2, 2, 3), 1, 0)
    for width, difference in zip(widths, (right - left) / (2 * widths[:, None, None]), strict=True):
        np.testing.assert_allclose(slopes, difference.T, rtol=2e-3 if width > 5e-3 else 5e-4)


def clamped_rig():
    """Conditional integration: a rate jumps a dozen times within 20 ms, each time after a tick of the reference."""
    return d.Loop(
        plant=plants.MirroredRig(),
        initial=d.BrakeStart(speed=11.0, slip=0.03),
        stop=stops.SpeedReached(speed=8.0),
        reference=references.LimitedSlip(slip=0.15, rate=2.0, time_constant=0.02, period=2e-3),
        feedforward=controllers.HoldingInput(),
        controller=controllers.StateFeedback(
            gain=np.array([-3000.0, -90.0]), low=0.3, high=5.0, antiwindup=controllers.Clamping()
        ),
    )


def relay_at_its_rate():
    """A limit cycle at the greatest rate of the actuator: each of its corners moves the ends of two steps."""
    return d.Loop(
        plant=plants.QuarterCar(road=roads.DRY_COBBLESTONE, inertia=0.6),
        initial=d.BrakeStart(speed=6.0, slip=0.03),
        stop=stops.SpeedReached(speed=3.5),
        reference=references.FixedSlip(slip=0.3),
        controller=controllers.Relay(band=0.05, low=6.0, high=130.0),
        actuator=actuators.RateLimit(rate=3000.0, time_constant=0.004),
    )


@pytest.mark.slow
@pytest.mark.parametrize("make", [clamped_rig, relay_at_its_rate])
def test_derivatives_through_many_comparisons(make):
    """Two widths of differences of runs at a far smaller error. The scale is the derivative, or a thousandth of the
    value where that is more: 1 % of it is 10 rtol of the value."""
    loop = make()
    paths = ["plant.mass", "initial.speed", "controller.high"]
    start = np.array([float(get(loop, path)) for path in paths])
    lanes = np.random.default_rng(3).uniform(-0.12, 0.12, (6, len(paths)))

    def metrics(solver):
        def of(z):
            run = d.measure(d.replace(loop, dict(zip(paths, start * jnp.exp(z), strict=True))), solver, MEASURED)
            return jnp.stack([run.metrics[name] for name in MEASURED])

        return of

    slopes = np.asarray(jax.jit(jax.vmap(jax.jacfwd(metrics(d.Adaptive(1e-6, 2.0, 2e-4)))))(lanes))
    exact = jax.jit(jax.vmap(metrics(d.Adaptive(1e-10, 2.0, 2e-4))))
    widths = (1e-3, 3e-4)
    moved = [[np.asarray(exact(lanes + sign * w * row)) for row in np.eye(3) for sign in (1, -1)] for w in widths]
    differences = [
        np.stack([a - b for a, b in zip(m[::2], m[1::2], strict=True)], -1) / (2 * w)
        for m, w in zip(moved, widths, strict=True)
    ]
    scale = np.maximum(np.abs(differences[1]), 1e-3 * np.abs(np.asarray(exact(lanes)))[..., None])
    agree = np.abs(differences[0] - differences[1]) <= 3e-3 * scale
    assert agree.mean() > 0.6
    assert np.max(np.where(agree, np.abs(slopes - differences[1]) / scale, 0.0)) <= 1e-2


def test_the_root_of_a_bent_cubic_and_its_derivative_are_exact():
    """(x + 1)^3 = level over a step of length 1: far from a line, as the error of a long step is."""
    for level in (1.2, 2.0, 5.0, 7.5):
        root, slope = jax.value_and_grad(lambda level: Cubic(1.0, 8.0, 3.0, 12.0).minus(level).root())(level)
        assert root == pytest.approx(level ** (1 / 3) - 1, abs=1e-12)
        assert slope == pytest.approx(level ** (-2 / 3) / 3, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["slip-lmi", pytest.param("slip-cured", marks=pytest.mark.slow)])
def test_reverse_mode_is_forward_mode(name):
    chosen = load(name)

    def distance(mass):
        loop = d.replace(chosen.loop, {"plant.mass": mass})
        return d.measure(loop, d.Adaptive(1e-5, 0.3, 1e-3), {"iae": IAE()}).metrics["iae"]

    forward, reverse = (jax.jit(derivative(distance)) for derivative in (jax.jacfwd, jax.grad))
    np.testing.assert_allclose(reverse(5.7), forward(5.7), rtol=1e-6)


@killed_by(
    "engine.step.attempt",
    "        shift = request.shift_end(dynamics)",
    "        shift = 0.0 * request.shift_end(dynamics)",
)
@pytest.mark.slow
def test_a_derivative_through_relay_and_latch_is_that_of_rk4():
    structure, loop = random_loops.STRUCTURES["relay, latch, lag"], random_loops.drawn("relay, latch, lag", 3, 0)

    def slope(solver):
        def measured(mass):
            run = d.measure(d.replace(loop, {"plant.mass": mass}), solver, {"d": StopDistance(), "iae": IAE()})
            return jnp.stack([run.metrics["d"], run.metrics["iae"]])

        return jax.jacfwd(measured)(jnp.asarray(float(loop.plant.mass)))

    fixed = slope(d.FixedStep(structure.step, structure.duration))
    np.testing.assert_allclose(slope(d.Adaptive(1e-6, structure.duration)), fixed, rtol=2e-3)


@killed_by(
    "engine.step.adaptive",
    "rates = start.rates[0], end.rates[0]",
    "rates = start.rates[0], jax.tree.map(lambda x: 0.0 * x, end.rates[0])",
)
@pytest.mark.slow
def test_a_trajectory_between_ticks_is_that_of_fixed_steps():
    chosen = load("slip-lmi", [SAMPLED])
    solvers = d.Adaptive(1e-6, 0.03), d.FixedStep(1e-4, 0.03, every=10)
    seen, reference = (d.rollout(chosen.loop, one, {}).trajectory.sample.output.slip for one in solvers)
    np.testing.assert_allclose(seen, reference, atol=1e-6)


@killed_by(
    "engine.step.adaptive",
    "rates = start.rates[0], end.rates[0]",
    "rates = start.rates[0], start.rates[0]",
    case="limits",
)
@pytest.mark.slow
@pytest.mark.parametrize(
    "more",
    [
        pytest.param(LIMITS, id="limits"),
        pytest.param([SAMPLED], id="sampled", marks=pytest.mark.slow),
    ],
)
def test_the_derivative_of_a_trajectory_is_that_of_fixed_steps(more):
    chosen = load("slip-lmi", more)

    def slip(solver):
        return lambda mass: (
            d.rollout(d.replace(chosen.loop, {"plant.mass": mass}), solver, {}).trajectory.sample.output.slip
        )

    mass, solver = jnp.asarray(5.7), d.Adaptive(1e-5, 0.1, 5e-4)
    slope = jax.jacfwd(slip(solver))(mass)
    fixed = jax.jacfwd(slip(d.FixedStep(1e-4, 0.1, every=5)))(mass)
    np.testing.assert_allclose(slope, fixed, atol=5e-4 * np.abs(fixed).max())  # not what a step's length goes by
    weights = jnp.arange(float(len(slope)))
    reverse = jax.grad(lambda mass: weights @ slip(solver)(mass))(mass)
    np.testing.assert_allclose(reverse, weights @ slope, rtol=1e-7)


@pytest.mark.slow
def test_the_worst_case_is_that_of_fixed_steps():
    box = {"plant.mass": (5.3, 6.2), "initial.speed": (8.0, 16.0)}
    found, fixed = (
        worst_case(rig().loop, over=box, metric="max_slip", solver=solver, iterations=10)
        for solver in (d.Adaptive(1e-5, 2.5), d.FixedStep(5e-4, 2.5))
    )
    np.testing.assert_allclose(found.value, fixed.value, rtol=1e-5)
    for path, value in fixed.values.items():
        np.testing.assert_allclose(found.values[path], value, rtol=1e-4)  # on which the worst hardly depends there


@pytest.mark.slow
def test_the_region_of_attraction_is_that_of_fixed_steps():
    chosen, cells = load("arm-hanging"), Cells(-0.1, 0.1, 12)
    solvers = d.Adaptive(1e-5, 60.0), d.FixedStep(1e-3, 60.0)
    found, fixed = (region_of_attraction(chosen.loop, cells, cells, solver) for solver in solvers)
    for name in ("recovered", "fell", "unstable", "diverged"):
        np.testing.assert_array_equal(getattr(found.outcomes, name), getattr(fixed.outcomes, name))
    assert 0.2 < found.share < 0.8


@killed_by("engine.step.replay", "clip_rtol(np.asarray(solver.rtol, float))", "solver.rtol")
def test_there_is_room_for_smaller_steps():
    loop, sampled = rig().loop, load("slip-cured", integrated=False).loop
    assert log_capacity(loop, d.Adaptive(1e-5, 2.5)) == BASE_LOG_CAPACITY
    assert log_capacity(loop, d.Adaptive(1e-9, 2.5)) == 10 * BASE_LOG_CAPACITY
    assert log_capacity(sampled, d.Adaptive(1e-5, 2.0, 1e-3)) == BASE_LOG_CAPACITY + 3 * 2000
    # A run has no smaller error than 32 roundings.
    assert log_capacity(loop, d.Adaptive(1e-20, 2.5)) == log_capacity(loop, d.Adaptive(32 * np.finfo(float).eps, 2.5))


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"rtol": 0.0}, "solver.rtol = 0.0 is not positive and finite"),
        ({"rtol": "1e-5"}, "solver.rtol = '1e-5'"),
        ({"duration": -1.0}, "solver.duration = -1.0 is not positive and finite"),
        ({"step": 20.0}, "solver.step = 20 s is outside (0, 10] s: longer than solver.duration = 10 s"),
    ],
)
def test_a_solver_that_no_run_can_have_is_refused(change, line):
    with pytest.raises(ValueError, match=re.escape(line)):
        d.measure(rig().loop, dataclasses.replace(d.Adaptive(), **change), {})


@killed_by("engine.step.adaptive", "jnp.where(limit > 0, limit, self.h * self.steps)", "limit")
@pytest.mark.slow
def test_a_field_of_infinite_slope_at_its_start_is_solved():
    """A tank that fills, y' = q - sqrt(y): with s = sqrt(y), the time from a to b is the integral of 2 s/(q - s)."""

    def field(t, y, args):
        return jnp.where(t < 0.5, args, 0.3) - jnp.sqrt(jnp.maximum(y, 0.0))

    def time(a, b, q):
        return 2 * (a - b + q * np.log((q - a) / (q - b)))

    full = brentq(lambda s: time(0.0, s, 1.0) - 0.5, 0.0, 0.99)
    found = d.solve(field, 0.0, 0.0, 2.0, 1.0, solver=d.Adaptive(1e-6))
    assert time(full, np.sqrt(found.y), 0.3) == pytest.approx(1.5, rel=1e-6)


def test_steps_that_find_themselves_are_never_unstable():
    """The same step of a grid is refused for fixed steps, and is no step of the integration for the others."""
    loop = load("slip-estimator", integrated=False).loop
    with pytest.raises(ValueError, match="not stable"):
        d.check(loop, d.FixedStep(1e-2, 4.0))
    d.check(loop, d.Adaptive(1e-5, 4.0, 1e-2))


@killed_by("engine.step.adaptive", "(control.tries == 0) & (carry.length > limit)", "(carry.length < 0)")
def test_the_first_step_is_stable():
    """A run at rest has no error, and a step that is too long would only spoil its derivative."""
    decay = 1e6
    system, _ = build_field(lambda t, y, args: -decay * y, 0.0, 0.0, 1.0, None, (), None, 1)
    method = build_stepping(d.Adaptive(1e-6, 1.0, 1.0), jnp.dtype(float))
    carry = jax.jit(lambda: method.renew(system, method.start(system, {}, None)))()
    assert 0 < carry.length <= 3.0 * (1 + 1e-9) / decay
    assert carry.base == carry.length


@killed_by("engine.step.modes", "jnp.where(since < -nearest, -since, NEVER_S)", "jnp.where(since < 0, -since, NEVER_S)")
@killed_by("engine.step.modes", "inside = later & (since >", "inside = (since >")
def test_lines_say_when_comparisons_change_and_when_they_did():
    numbers = np.array([0, 1, 33, 2, 3])
    values, rates = jnp.array([3.0, -2.0, 1.0, 0.5, 4.0]), jnp.array([-1.0, 1.0, 4.0, 1.0, -40.0])
    margins = modes.SwitchingFunctions(numbers, values, rates)
    words = (jnp.uint32(0b1100), jnp.uint32(0b10))
    np.testing.assert_array_equal(modes.read_bits(words, np.array([2, 3, 33, 1])), [True, True, True, False])
    length = jnp.asarray(1.0)
    assert modes.forecast_crossing(margins, length, 0.0) == pytest.approx(0.1)  # 3 falls by 40/s
    # 0.1 s counts as past, and the number 1 rises by 1/s.
    assert modes.forecast_crossing(margins, length, 0.2) == pytest.approx(2.0)
    assert modes.find_imminent(margins, length).number == 3
    # Bits 2 and 33 changed 0.5 s and 0.25 s ago.
    assert modes.time_since_crossing(margins, words, length) == pytest.approx(0.5)
    assert modes.time_since_crossing(margins, (jnp.uint32(0),) * 2, length) == 0


@killed_by(
    "engine.step.step_size",
    "jax.tree.leaves((signal_errors, state_errors))",
    "jax.tree.leaves((signal_errors, jax.tree.map(lambda x: 0.0 * x, state_errors)))",
)
@killed_by(
    "engine.step.step_size",
    "moved = state.with_flow(jax.tree.map(lambda x, d: x - d, state.flow(), state_errors))",
    "moved = state",
)
def test_the_error_of_a_step_is_that_of_the_worst_state():
    loop = prepare_parts(
        arrays(load("slip-lmi", ["actuator=lag", "actuator.time_constant=0.01"], integrated=False).loop)
    )
    state = loop.start()
    state = state.with_flow(jax.tree.map(lambda x: x + 2.0, state.flow()))
    sample = loop.signals(0.0, state).sample
    scale = step_size.error_scales(state, sample)
    none = jax.tree.map(lambda x: 0.0 * x, state)
    assert step_size.error_norm(loop, state, none.flow(), scale, sample) == 0
    off = none._replace(actuator=none.actuator._replace(flow=0.01 * state.actuator.flow))
    assert step_size.error_norm(loop, state, off.flow(), scale, sample) == pytest.approx(0.01)
    slower = none._replace(plant=none.plant._replace(wheel=0.01 * state.plant.wheel))
    slip = abs(
        float(
            loop.plant.output(state._replace(plant=state.plant._replace(wheel=0.99 * state.plant.wheel)).plant)[0]
            - sample.output[0]
        )
    )
    first = step_size.error_norm(loop, state, slower.flow(), scale, sample)
    assert first == pytest.approx(max(0.01, slip / float(scale[0])), rel=1e-9)
    assert slip > 0.01 * float(scale[0])


@killed_by("engine.step.step_size", "(moves) / size", "(moves * 0.0 + size[0]) / size", case="arm-hanging")
@pytest.mark.parametrize("name", ["slip-lmi", "arm-hanging"])
def test_the_longest_stable_step_is_that_of_the_eigenvalues(name):
    loop = prepare_parts(arrays(load(name, integrated=False).loop))
    state = loop.start()
    z, tree = jax.flatten_util.ravel_pytree(state.flow())

    @jax.jit
    def both():
        def flow(z):
            at = state.with_flow(tree(z))
            return jax.flatten_util.ravel_pytree(loop.flow(0.0, at, loop.signals(0.0, at)))[0]

        sizes = step_size.error_scales(state, loop.signals(0.0, state).sample)
        return jax.jacfwd(flow)(z), step_size.spectral_step_limit(loop, jnp.asarray(0.0), state, sizes)

    jacobian, longest = both()
    radius = np.max(np.abs(np.linalg.eigvals(jacobian)))
    assert 0.7 < float(longest) * radius / step_size.STABILITY_RADIUS < 1.4


@killed_by("engine.step.replay", "order = jnp.argsort(begins)", "order = jnp.arange(len(begins))")
def test_a_trajectory_passes_over_rejected_attempts():
    """Six steps of 0.1 s in blocks of two, of which the second block has none; the state is t, its rate 1."""
    starts = jnp.array([[0.0, 0.1], [0.0, 0.0], [0.2, 0.3]])
    taken = jnp.array([[True, True], [False, False], [True, True]])
    ends, one = starts + 0.1, jnp.ones_like(starts)
    flows = [(x, (), (), (), ()) for x in (starts, ends, one, one)]
    state = LoopState(starts, *4 * [Memory()])
    spans = StateSpan(state, HermiteStep(starts, ends, (flows[0], flows[1]), (flows[2], flows[3])))
    instants = jnp.array([0.05, 0.15, 0.25, 0.35])
    np.testing.assert_allclose(states_between(spans, taken, instants).plant, instants, rtol=1e-12)
