"""Derivatives by delays and clocks: right, from the side that there is, or an error that names the parameter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffabs as d
from diffabs import actuators, controllers, objectives, plants, references, stops

STEP, PERIOD, WIDTH = 5e-4, 2e-3, 2e-7
MEASURED = {
    "distance": objectives.StopDistance(),
    "peak": objectives.MaxSlip(),
    "iae": objectives.IAE(),
    "variation": objectives.Variation(),
}
PID = controllers.PID(kp=20.0, ki=200.0, torque_min=0.2, torque_max=6.0)


def braking(**parts):
    return d.Loop(
        plant=plants.MirroredRig(),
        initial=d.BrakeStart(speed=11.0, slip=0.03),
        stop=stops.SpeedReached(speed=10.0),
        feedforward=controllers.HoldingInput(),
        **{"reference": references.FixedSlip(slip=0.15), **parts},
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
        [(0.0, (1,)), (3e-4, (-1, 1)), (2 * STEP, (-1, 1))],
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
        if hasattr(loop.controller, "sampling_period"):  # a jump of zero that begins to grow has no derivative
            found, differences = found[:3], differences[:3]
        np.testing.assert_allclose(found, differences, rtol=1e-4, atol=1e-6, err_msg=f"{path} = {x}")


def test_a_computer_without_delay_has_the_derivative_from_the_right():
    loop, path, places = DELAYS[0].values
    found, differences = beside(*run(loop, path, d.FixedStep(STEP, 0.02)), *places[0])
    assert (np.abs(differences) > 1e-2).any()
    np.testing.assert_allclose(found, differences, rtol=1e-4, atol=1e-6)


CLOCKS = [
    (braking(controller=controllers.Sampled(controller=PID, period=PERIOD)), "controller.period", PERIOD),
    (braking(controller=controllers.SampledOnGrid(controller=PID)), "controller.sampling_period", 1e-3),
    (braking(controller=PID, reference=references.LimitedSlip(period=PERIOD)), "reference.period", PERIOD),
]


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


def test_a_clock_leaves_the_derivatives_of_other_parameters():
    loop = CLOCKS[0][0]

    def distance(controller):
        held = jax.lax.stop_gradient(controller.period)
        both = d.replace(loop, {"controller": controller, "controller.period": held})
        return d.measure(both, d.FixedStep(PERIOD, 0.01), MEASURED).metrics["distance"]

    slopes = jax.grad(distance)(jax.tree.map(jnp.asarray, loop.controller))
    assert slopes.period == 0
    assert slopes.controller.kp != 0
