"""Pads that fade, against closed forms, the work of the brakes, constant pads and differences."""

import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from mutants import killed_by
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs.parts.plants import BrakeStart, Car, FadingPads, HalfCar
from diffabs.parts.plants.car import CarControls, Wheels
from diffabs.parts.plants.half_car import AxleBrakes
from diffabs.scenario import load


@killed_by("parts.plants.pads", "power - self.cooling * (temperature - self.air)", "power - self.cooling * temperature")
def test_a_disc_under_constant_power_warms_up_exponentially():
    """T - T_a = (P/h)(1 - exp(-h t/C)), by SciPy's integration of the rates of a front and a rear disc."""
    pads, powers = FadingPads(cooling=25.0), (9000.0, 4000.0)
    exact = solve_ivp(lambda t, x: np.array(pads.heat_rates(x, powers)), (0.0, 90.0), pads.start(2), rtol=1e-10).y[
        :, -1
    ]
    warmed = [9000 / 25 * (1 - np.exp(-25 * 90 / 3500)), 4000 / 25 * (1 - np.exp(-25 * 90 / 2500))]
    np.testing.assert_allclose(exact - 293.15, warmed, rtol=1e-7)


def test_without_cooling_the_discs_keep_the_work_of_the_brakes():
    """Of a car with four wheels that brakes from 30 to about 10 m/s."""
    car = Car(pads=FadingPads(cooling=0.0))
    start, control = car.start(BrakeStart(speed=30.0)), CarControls(900.0, 900.0, 300.0, 300.0, 0.0)
    flat, unflatten = ravel_pytree((start, 0.0))

    @jax.jit
    def rates(_, x):
        state, _ = unflatten(x)
        y, rate = car.output(state), car.derivative(0.0, state, control)
        work = sum(
            torque * getattr(y, f"{name}_wheel_speed") / car.radius
            for torque, name in zip(car.pads.torques(state.temperatures, control[:4]), Wheels._fields, strict=True)
        )
        return ravel_pytree((rate, work))[0]

    run = solve_ivp(rates, (0.0, 2.5), flat, rtol=1e-10, atol=1e-9)
    end, work = unflatten(run.y[:, -1])
    heat = sum(np.array([3500.0, 3500.0, 2500.0, 2500.0]) * (np.array(end.temperatures) - 293.15))
    assert 5.0 < float(end.longitudinal_velocity) < 15.0
    np.testing.assert_allclose(heat, work, rtol=1e-8)
    assert car.output(end).rear_left_brake_temperature == end.temperatures[2]


def test_half_of_the_loss_is_gone_at_the_middle_temperature():
    pads = FadingPads(loss=0.4, middle=700.0, spread=50.0)
    torques = pads.torques((700.0, 750.0, 0.0), (1000.0, 1000.0, 1000.0))
    np.testing.assert_allclose(torques, [800.0, 1000 * (1 - 0.4 / (1 + np.exp(-1))), 1000.0], rtol=1e-5)
    np.testing.assert_allclose(pads.commands((700.0, 750.0, 0.0), torques), 1000.0, rtol=1e-12)


def test_hot_pads_make_less_torque_and_the_feed_forward_knows_it():
    hot, cold = HalfCar(pads=FadingPads(initial=800.0)), HalfCar()
    rates = [car.derivative(0.0, car.start(BrakeStart(speed=20.0)), AxleBrakes(1000.0, 500.0)) for car in (hot, cold)]
    share = float(hot.pads.torques((800.0,), (1.0,))[0])
    np.testing.assert_allclose(rates[0].front_spin / rates[1].front_spin, share, rtol=1e-12)
    y = hot.output(hot.start(BrakeStart(speed=20.0, slip=0.1)))
    np.testing.assert_allclose(np.array(hot.holding(y, y)) * share, np.array(cold.holding(y, y)), rtol=1e-12)


def test_the_discs_of_half_car_and_car_have_the_same_temperatures():
    half, car = HalfCar(pads=FadingPads()), Car(pads=FadingPads())
    axles = half.derivative(0.0, half.start(BrakeStart(speed=20.0)), AxleBrakes(1200.0, 400.0)).temperatures
    control = CarControls(600.0, 600.0, 200.0, 200.0, 0.0)
    wheels = car.derivative(0.0, car.start(BrakeStart(speed=20.0)), control).temperatures
    np.testing.assert_allclose(wheels, np.repeat(axles, 2), rtol=1e-12)


@pytest.mark.slow
def test_a_stop_with_hot_pads_has_the_derivative_of_its_temperature():
    """The brakes are at their limit; differences at three widths."""
    scenario = load("half-car", ["plant.pads=fading-pads"])

    @jax.jit
    def distance(initial):
        loop = d.replace(scenario.loop, {"plant.pads.initial": initial})
        solver = d.Adaptive(rtol=1e-9, duration=6.0)
        return d.measure(loop, solver, {"way": scenario.objectives["stop_distance"]}).metrics["way"]

    derivative = jax.jacfwd(distance)(750.0)
    np.testing.assert_allclose(jax.grad(distance)(750.0), derivative, rtol=1e-8)
    assert float(derivative) > 0.01
    for width, tolerance in ((10.0, 3e-2), (3.0, 3e-3), (1.0, 3e-4)):
        difference = (distance(750.0 + width) - distance(750.0 - width)) / (2 * width)
        np.testing.assert_allclose(derivative, difference, rtol=tolerance)
