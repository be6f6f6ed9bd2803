"""Tyres with a relaxation length, against closed forms, SciPy, the unrelaxed tyre and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from mutants import killed_by
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs import controllers, roads, stops
from diffabs.core.protocols import Contact
from diffabs.core.validity import find_problems
from diffabs.parts.plants import BrakeStart, Car, HalfCar
from diffabs.parts.plants.car import WHEELS, CarControls, CarState, Wheels
from diffabs.parts.plants.half_car import CHANNELS, AxleBrakes, HalfCarState
from diffabs.parts.roads import RelaxedTyre
from diffabs.scenario import load

TYRE = RelaxedTyre(length=0.3, lateral_length=0.5)


def relaxed_car(tyre=TYRE, **numbers):
    return HalfCar(front_tyre=tyre, rear_tyre=tyre, **numbers)


@pytest.mark.parametrize("speed", [3.0, 20.0])
@killed_by("parts.roads.tyres", "speed * quotient(slip - contact.slip", "quotient(slip - contact.slip")
def test_a_relaxation_length_after_a_step_the_slip_has_63_percent_of_it(speed):
    """On a road without friction speeds stay; slips of 0.1 and -0.2 where the contacts had none."""
    smooth = roads.RoadTyre(road=roads.Burckhardt(c1=1e-14, c2=20.0, c3=0.0, c4=0.0))
    car = relaxed_car(RelaxedTyre(tyre=smooth, length=0.3))
    spins = [(1 - slip) * speed / car.radius for slip in (0.1, -0.25)]
    start = car.start(BrakeStart(speed=speed))._replace(front_spin=spins[0], rear_spin=spins[1])
    flat, unflatten = ravel_pytree(start)

    @jax.jit
    def rates(t, x):
        return ravel_pytree(car.derivative(t, unflatten(x), AxleBrakes(0.0, 0.0)))[0]

    end = unflatten(solve_ivp(rates, (0.0, 0.3 / speed), flat, rtol=1e-10, atol=1e-12).y[:, -1])
    slips = [contact.slip for contact in end.contacts]
    np.testing.assert_allclose(slips, np.array([0.1, -0.2]) * (1 - np.exp(-1)), rtol=1e-8)


def test_a_run_agrees_with_the_equations_written_out():
    m, a, b, h, r, j = 1093.2952334674046, 1.1561957064, 1.4227170936, 0.5748689544, 0.344, 1.7

    def equations(t, x):
        v, front, rear, _, front_slip, rear_slip = x
        mus = [(1.2801 * (1 - np.exp(-23.99 * s)) - 0.52 * s) * np.exp(-0.03 * s * v) for s in (front_slip, rear_slip)]
        transfer = np.array([[1, 0, -h / (a + b)], [0, 1, h / (a + b)], [-mus[0], -mus[1], 1]])
        weight = m * 9.81 / (a + b)
        first, second, force = np.linalg.solve(transfer, [weight * b, weight * a, 0.0])
        spins = [(r * mu * load - u) / j for mu, load, u in zip(mus, (first, second), (2000.0, 700.0), strict=True)]
        contacts = [((v - r * spin) - v * slip) / 0.3 for spin, slip in ((front, front_slip), (rear, rear_slip))]
        return [-force / m, *spins, v, *contacts]

    start = [30.0, 30.0 / r, 30.0 / r, 0.0, 0.0, 0.0]
    exact = solve_ivp(equations, (0.0, 2.0), start, method="LSODA", rtol=1e-11, atol=1e-11).y[:, -1]
    torques = {
        name: controllers.ConstantTorque(torque=torque) for name, torque in zip(CHANNELS, (2000.0, 700.0), strict=True)
    }
    car = relaxed_car()
    parts = car.usual_parts() | {
        "initial": BrakeStart(speed=30.0),
        "controller": controllers.PerChannel(torques, CHANNELS),
        "stop": stops.NoStop(),
    }
    y = d.rollout(d.Loop(plant=car, **parts), d.Adaptive(rtol=1e-9, duration=2.0), {}).ending.sample.output
    np.testing.assert_allclose(
        [y.speed, y.front_wheel_speed / r, y.rear_wheel_speed / r, y.distance], exact[:4], rtol=1e-7
    )


@pytest.mark.slow
def test_the_stopping_distance_goes_to_that_without_relaxation_and_has_its_derivative():
    """Linearly to the unrelaxed tyre's for lengths of 4 and 2 mm; differences at three widths at 0.3 m."""
    solver = d.Adaptive(rtol=1e-9, duration=5.0)
    relaxed = load("half-car", ["plant.front_tyre=relaxed-tyre", "plant.rear_tyre=relaxed-tyre"])

    def way(scenario, numbers):
        loop = d.replace(scenario.loop, numbers)
        return d.measure(loop, solver, {"way": scenario.objectives["stop_distance"]}).metrics["way"]

    @jax.jit
    def distance(length):
        return way(relaxed, {"plant.front_tyre.length": length, "plant.rear_tyre.length": length})

    np.testing.assert_allclose(2 * distance(2e-3) - distance(4e-3), way(load("half-car"), {}), rtol=1e-7)
    derivative = jax.jacfwd(distance)(0.3)
    np.testing.assert_allclose(jax.grad(distance)(0.3), derivative, rtol=1e-9)
    for width, tolerance in ((1e-1, 1e-3), (3e-2, 1e-4), (1e-2, 1e-5)):
        difference = (distance(0.3 + width) - distance(0.3 - width)) / (2 * width)
        np.testing.assert_allclose(derivative, difference, rtol=tolerance)


def test_the_lateral_force_of_a_car_follows_the_slip_angle():
    """After a step of the lateral velocity the force is 0 at first; at settled contacts it is that of the tyre."""
    tyres = {f"{wheel}_tyre": TYRE for wheel in WHEELS}
    car, plain = Car(**tyres), Car()
    start, none = BrakeStart(speed=20.0), CarControls(0.0, 0.0, 0.0, 0.0, 0.0)
    rate, at_once = (c.derivative(0.0, c.start(start)._replace(lateral_velocity=0.4), none) for c in (car, plain))
    assert float(rate.lateral_velocity) == 0.0
    assert float(at_once.lateral_velocity) < -1.0
    speed, angle = np.hypot(20.0, 0.4), np.arctan(0.4 / 20.0)
    np.testing.assert_allclose([contact.slip_angle for contact in rate.contacts], speed * angle / 0.5, rtol=1e-12)


def test_settled_contacts_have_the_forces_of_the_tyre():
    tyres = {f"{wheel}_tyre": RelaxedTyre(tyre=roads.PacejkaTyre()) for wheel in WHEELS}
    plain = Car(**{f"{wheel}_tyre": roads.PacejkaTyre() for wheel in WHEELS})
    spins = Wheels(*(np.array([0.9, 0.95, 0.8, 0.98]) * 20.0 / 0.344))
    state = CarState(3.0, -1.0, 0.1, 20.0, 0.7, 0.3, 0.05, spins)
    contacts = plain._contacts(state).each()
    control = CarControls(600.0, 100.0, 200.0, 50.0, 0.1)
    both = Car(**tyres).derivative(0.0, state._replace(contacts=tuple(contacts)), control)
    expected = jax.tree.leaves(plain.derivative(0.0, state, control))
    np.testing.assert_allclose(jax.tree.leaves(both)[:11], expected, rtol=1e-12)
    np.testing.assert_allclose(jax.tree.leaves(both)[11:], 0.0, atol=1e-12)


def test_in_straight_motion_a_relaxed_car_is_the_relaxed_half_car():
    car = Car(**{f"{wheel}_tyre": TYRE for wheel in WHEELS})
    front, rear = Contact(0.05, 0.0), Contact(0.02, 0.0)
    state = HalfCarState(20.0, 50.0, 55.0, 3.0, (front, rear))
    axles = relaxed_car().derivative(0.0, state, AxleBrakes(1200.0, 400.0))
    start = car.start(BrakeStart(speed=20.0))._replace(x=3.0, spins=Wheels(50.0, 50.0, 55.0, 55.0))
    wheels = start._replace(contacts=(front, front, rear, rear))
    rate = car.derivative(0.0, wheels, CarControls(600.0, 600.0, 200.0, 200.0, 0.0))
    np.testing.assert_allclose(rate.longitudinal_velocity, axles.speed, rtol=1e-12)
    np.testing.assert_allclose(rate.spins, np.repeat(axles[1:3], 2), rtol=1e-12)
    np.testing.assert_allclose(jnp.array(rate.contacts)[::2, 0], jnp.array(axles.contacts)[:, 0], rtol=1e-12)


def test_a_relaxed_tyre_in_a_relaxed_tyre_is_refused():
    problems = list(find_problems(relaxed_car(RelaxedTyre(tyre=RelaxedTyre()))))
    assert "front_tyre.tyre has a relaxation length of its own; a tyre without one is needed" in " ".join(
        map(str, problems)
    )
