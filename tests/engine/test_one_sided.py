"""Derivatives by delays and clocks: right, from the side that there is, or an error that names the parameter."""

import types
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import cases

import diffabs as d
from diffabs import actuators, controllers, objectives, plants, references, stops
from diffabs.core.pytree import get, param, parameters, pytree
from diffabs.tune import one_sided

STEP, PERIOD, WIDTH = 5e-4, 2e-3, 2e-7
SOLVER = d.FixedStep(STEP, 0.01)
MEASURED = {
    "distance": objectives.StopDistance(),
    "peak": objectives.MaxSlip(),
    "iae": objectives.IAE(),
    "variation": objectives.Variation(),
}
PID = controllers.PID(kp=20.0, ki=200.0, low=0.2, high=6.0)


def braking(slip=0.03, **parts):
    return d.Loop(
        plant=plants.MirroredRig(),
        initial=d.BrakeStart(speed=11.0, slip=slip),
        stop=stops.SpeedReached(speed=10.0),
        **{"reference": references.FixedSlip(slip=0.15), "feedforward": controllers.HoldingInput(), **parts},
    )


def run(loop, path, solver):
    def measured(x):
        metrics = d.measure(d.replace(loop, {path: x}), solver, MEASURED).metrics
        return jnp.stack([metrics[name] for name in MEASURED])

    return jax.jit(measured), jax.jit(jax.jacfwd(measured))


def beside(measured, slope, x, sides):
    """The derivative, and the difference from these sides, of second order."""
    x, h = jnp.asarray(x), WIDTH
    if len(sides) == 2:
        return slope(x), (measured(x + h) - measured(x - h)) / (2 * h)
    (side,) = sides
    difference = -3 * measured(x) + 4 * measured(x + side * h) - measured(x + 2 * side * h)
    return slope(x), difference / (2 * side * h)


DELAYS = [
    pytest.param(
        braking(controller=controllers.Sampled(controller=PID, period=PERIOD)),
        "controller.delay",
        [(0.0, (1,)), (3e-4, (-1, 1)), (2 * STEP, (-1, 1)), (PERIOD, (-1,))],
        id="computer",
    ),
    pytest.param(
        braking(controller=controllers.SampledOnGrid(controller=PID, sampling_period=PERIOD)),
        "controller.delay",
        [(0.0, (1,)), (3e-4, (-1, 1)), (2 * STEP, (1,)), (PERIOD, (-1,))],
        id="computer on the grid",
    ),
    pytest.param(
        braking(
            controller=controllers.Sampled(controller=PID, period=PERIOD),
            actuator=actuators.Delay(time=1e-3, capacity=64),
        ),
        "actuator.time",
        [(STEP, (1,)), (7e-4, (-1, 1)), (2 * STEP, (-1, 1))],
        id="pure delay",
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize("solver", [d.FixedStep(STEP, 0.1)])
@pytest.mark.parametrize(("loop", "path", "places"), DELAYS)
def test_a_delay_has_the_derivative_of_differences(loop, path, places, solver):
    measured, slope = run(loop, path, solver)
    for x, sides in places:
        found, differences = beside(measured, slope, x, sides)
        np.testing.assert_allclose(found, differences, rtol=1e-4, atol=1e-6, err_msg=f"{path} = {x}")


@pytest.mark.slow
def test_without_delay_the_derivative_is_from_the_right():
    loop, path, places = DELAYS[0].values
    found, differences = beside(*run(loop, path, d.FixedStep(STEP, 0.02)), *places[0])
    assert (np.abs(differences) > 1e-2).any()
    np.testing.assert_allclose(found, differences, rtol=1e-4, atol=1e-6)


CLOCKS = [
    (braking(controller=controllers.Sampled(controller=PID, period=PERIOD)), "controller.period", PERIOD),
    (braking(controller=controllers.SampledOnGrid(controller=PID)), "controller.sampling_period", 1e-3),
    (braking(controller=PID, reference=references.LimitedSlip(period=PERIOD)), "reference.period", PERIOD),
]


@pytest.mark.slow
@pytest.mark.parametrize(("loop", "path", "period"), CLOCKS)
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.grad])
@pytest.mark.parametrize("solver", [d.FixedStep(PERIOD, 0.01), d.Adaptive(1e-4, 0.01, PERIOD)])
def test_a_period_has_no_derivative(loop, path, period, derivative, solver):
    def distance(x):
        return d.measure(d.replace(loop, {path: x}), solver, MEASURED).metrics["distance"]

    for function in (distance, jax.jit(distance)):
        with pytest.raises(ValueError, match=f"{path} has no derivative: a run does not depend smoothly on it"):
            derivative(function)(period)


@pytest.mark.parametrize(("engine", "together"), [("xla", True), ("xla", False), ("kernel", False)])
def test_a_period_of_a_batch_has_no_derivative(engine, together):
    loop, path, period = CLOCKS[0]

    def distances(x):
        batch = d.Batch({path: x * jnp.ones(2)})
        return d.run_batch(loop, batch, d.FixedStep(PERIOD, 0.01), MEASURED, engine=engine, together=together).metrics

    with pytest.raises(ValueError, match=f"{path} has no derivative"):
        jax.eval_shape(lambda x: jax.jvp(distances, (x,), (1.0,)), period)


@pytest.mark.slow
def test_a_clock_leaves_the_derivatives_of_other_parameters():
    loop = CLOCKS[0][0]

    def distance(controller):
        held = jax.lax.stop_gradient(controller.period)
        both = d.replace(loop, {"controller": controller, "controller.period": held})
        return d.measure(both, d.FixedStep(PERIOD, 0.01), MEASURED).metrics["distance"]

    slopes = jax.grad(distance)(jax.tree.map(jnp.asarray, loop.controller))
    assert slopes.period == 0
    assert slopes.controller.kp != 0


def both_sides(function, x):
    return [float((function(x + h) - function(x)) / h) for h in (-1e-6, 1e-6)]


@pytest.mark.parametrize(("name", "side"), [("gain", 0), ("high", 1)])
def test_a_gain_at_the_limit_has_one_side(name, side):
    def control(x):
        mode = d.replace(controllers.SlidingMode(gain=90.0, high=90.0), {name: x})
        signal = types.SimpleNamespace(target=0.2, measured=(0.0,), feedforward=0.0)
        return mode.output(0.0, None, signal)

    slopes = both_sides(control, 90.0)
    assert abs(slopes[0] - slopes[1]) > 0.9
    np.testing.assert_allclose(jax.grad(control)(90.0), slopes[side], rtol=1e-6)


@pytest.mark.parametrize(("which", "side"), [(0, 0), (1, 1)])
def test_a_torque_at_the_limit_of_the_actuator_has_one_side(which, side):
    def control(x):
        both = [90.0, 90.0]
        both[which] = x
        return actuators.Limits(high=both[1]).output(0.0, None, jnp.asarray(both[0]))

    slopes = both_sides(control, 90.0)
    assert abs(slopes[0] - slopes[1]) > 0.9
    np.testing.assert_allclose(jax.grad(control)(90.0), slopes[side], rtol=1e-6)


def test_a_relay_on_its_target_is_released():
    def applied(slip):
        signal = types.SimpleNamespace(target=0.2, measured=(slip,), feedforward=0.0)
        return float(controllers.Relay().start(signal).held)

    assert [applied(0.2 + one) for one in (-1e-9, 0.0, 1e-9)] == [1.0, 0.0, 0.0]


RELAY, SLIDING = controllers.Relay(high=9.0), controllers.SlidingMode(gain=9.0, high=9.0)
POINTS = {  # loop; which free parameters are named; a part of what is said
    "torque": (
        braking(controller=RELAY, actuator=actuators.Limits(high=9.0)),
        {"controller.high", "actuator.high"},
        "controller.high and actuator.high are equal",
    ),
    "gain": (
        braking(controller=SLIDING, feedforward=controllers.NoFeedforward()),
        {"controller.gain", "controller.high"},
        "controller.gain reaches controller.high and no further",
    ),
    "gain, constant": (
        braking(
            controller=controllers.SlidingMode(gain=9.0, low=-6.5), feedforward=controllers.ConstantInput(value=2.5)
        ),
        {"controller.gain", "controller.low", "feedforward.value"},
        "controller.gain reaches controller.low and no further",
    ),
    "relay": (
        braking(slip=0.15, controller=controllers.Relay()),
        {"initial.slip", "reference.slip"},
        "the relay starts on its target, where its first state jumps",
    ),
    "sampled relay": (
        braking(slip=0.15, controller=controllers.Sampled(controller=controllers.Relay(), delay=3e-4)),
        {"initial.slip", "reference.slip"},
        "the relay starts on its target, where its first state jumps",
    ),
    "delay": (DELAYS[0].values[0], {"controller.delay"}, "controller.delay is zero"),
    "delay, period": (
        braking(controller=controllers.Sampled(controller=PID, period=PERIOD, delay=PERIOD)),
        {"controller.delay"},
        "controller.delay and controller.period are equal",
    ),
    "delay, steps": (
        braking(controller=controllers.SampledOnGrid(controller=PID, delay=STEP)),
        {"controller.delay"},
        "controller.delay is a whole number of steps",
    ),
    "pure delay": (
        braking(controller=PID, actuator=actuators.Delay(time=STEP)),
        {"actuator.time"},
        "actuator.time and the step are equal",
    ),
    "PID": (braking(controller=PID, actuator=actuators.Limits()), set(), ""),
    "relay, off its target": (braking(controller=controllers.Relay(), actuator=actuators.Limits()), set(), ""),
    "usual sliding mode": (braking(controller=controllers.SlidingMode(), actuator=actuators.Limits()), set(), ""),
    "usual PID": (braking(controller=controllers.PID(), actuator=actuators.Limits()), set(), ""),
    "held gain": (braking(controller=SLIDING), set(), ""),  # what holds the wheel is added: always at the limit
}


def warned(subject, free, batch=None):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        one_sided.warn(subject, {path: get(subject, path) for path in free}, batch or d.Batch(), SOLVER, "start")
    return [str(warning.message) for warning in told]


@pytest.mark.parametrize(
    "name",
    cases(
        POINTS, "relay", "sampled relay", "torque", "delay", "delay, steps", "gain", "gain, constant", "delay, period"
    ),
)
def test_points_with_one_side_are_named(name):
    loop, paths, said = POINTS[name]
    free = [path for path, spec, value in parameters(loop) if spec.tunable and np.isfinite(value).all()]
    told = warned(loop, free)
    assert len(told) == bool(paths)
    for line in told:
        assert line.startswith(f"start: {said}, so the derivative by ")
        assert set(line.partition(" by ")[2].partition(" is that of one side; ")[0].split(" and ")) == paths
        assert "a search may end there without a minimum: start it from other values" in line
    assert warned(loop, [path for path in free if path not in paths]) == []


@pytest.mark.slow
def test_points_with_one_side_are_named_in_any_run_and_subject():
    """One run of a batch may stand on the point, and what is free need not be a parameter of the loop."""
    loop = braking(controller=controllers.Relay())
    batch = d.Batch({"initial.slip": np.array([0.1, 0.15, 0.2])})
    (told,) = warned(loop, ["reference.slip", "controller.band"], batch)
    assert told.startswith("start: the relay starts on its target, where its first state jumps (in 1 of 3 runs), so ")
    assert "by reference.slip is that" in told

    @pytree
    class Twice:
        half: float = param(default=4.5, unit="N m")

        def closed_loop(self):
            controller = controllers.SlidingMode(gain=2 * self.half, high=9.0)
            return braking(controller=controller, feedforward=controllers.NoFeedforward())

    (told,) = warned(Twice(), ["half"])
    assert "by half is that" in told


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.grad])
def test_an_adaptive_variation_behind_a_delay_is_refused(derivative):
    loop = DELAYS[2].values[0]

    def measured(time):
        return d.measure(d.replace(loop, {"actuator.time": time}), d.Adaptive(1e-4, 0.01, STEP), MEASURED).metrics

    with pytest.raises(ValueError, match="variation: Variation has no derivative behind a pure delay with adaptive"):
        derivative(lambda time: measured(time)["variation"])(1e-3)


@pytest.mark.slow
def test_an_adaptive_pure_delay_agrees_with_differences():
    loop = DELAYS[2].values[0]
    measured = {name: one for name, one in MEASURED.items() if name != "variation"}

    @jax.jit
    def run(time):
        metrics = d.measure(d.replace(loop, {"actuator.time": time}), d.Adaptive(1e-7, 0.1, STEP), measured).metrics
        return jnp.stack(list(metrics.values()))

    slope = jax.jit(jax.jacfwd(run))
    for x in (7e-4, 1e-3):
        found, differences = beside(run, slope, x, (-1, 1))
        np.testing.assert_allclose(found, differences, rtol=1e-3, atol=1e-5, err_msg=f"{x}")
