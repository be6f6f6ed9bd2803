"""The car of seven degrees of freedom against CommonRoad's single-track model, the half car, closed forms and SciPy."""

import dataclasses
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from project import ROOT
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs import controllers, roads, stops
from diffabs.core.pytree import get, replace
from diffabs.loop.contracts import find_misfits
from diffabs.parts.plants import GRAVITY, BrakeStart, Car, HalfCar
from diffabs.parts.plants.car import BRAKES, WHEELS, CarControls, CarState, Wheels
from diffabs.parts.plants.half_car import AxleBrakes, HalfCarState
from diffabs.scenario import load

SNOW = roads.RoadTyre(road=roads.SNOW)
SPLIT = Car(front_right_tyre=SNOW, rear_right_tyre=SNOW, drag=0.4, rolling=0.012)
rates = jax.jit(lambda car, state, control: car.derivative(0.0, state, control))
shown = jax.jit(lambda car, state: car.output(state))


def with_tyres(tyre):
    return {f"{wheel}_tyre": tyre for wheel in WHEELS}


def turning(car, speed, slips, lateral=0.0, yaw_velocity=0.0, steer=0.0):
    """A state with the slips of wheels that roll straight on."""
    spins = Wheels(*((1 - slip) * speed / car.radius for slip in slips))
    return CarState(3.0, -1.0, 0.1, speed, lateral, yaw_velocity, steer, spins)


# CommonRoad's single-track drift model: both wheels of an axle together, without lateral load transfer


@pytest.fixture(scope="module")
def oracle():
    """Vehicle 2, its parameters and the equations of motion."""
    from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
    from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std

    return parameters_vehicle2(), vehicle_dynamics_std


def single_track(vehicle):
    """The car without a track, whose tyres have the friction of an axle's load at half of it."""
    tyre = roads.PacejkaTyre(p_vx1=2 * vehicle.tire.p_vx1)
    tracks = {"front_track": 1e-13, "rear_track": 1e-13}
    return Car(height=vehicle.h_s, commanded=True, crawl_speed=0.1, **tracks, **with_tyres(tyre))


def wheel_torques(vehicle, acceleration):
    """The brake torques that CommonRoad makes of an acceleration."""
    torque = -0.5 * vehicle.m * vehicle.R_w * acceleration
    front, rear = vehicle.T_sb * torque, (1 - vehicle.T_sb) * torque
    return front, front, rear, rear


@killed_by("parts.roads.tyres", "+ by_slip", "")
@killed_by("parts.plants.car", "lateral - yaw_velocity * u", "lateral")
def test_rates_are_those_of_the_single_track_model(oracle):
    """At 1,000 random points with yaw, sideslip and steering, relative to the greatest rate of each state."""
    vehicle, equations = oracle
    car, rng = single_track(vehicle), np.random.default_rng(68)
    expected, found = [], []
    for _ in range(1000):
        speed, beta, turn, steer = (
            float(rng.uniform(*ends)) for ends in ((3, 50), (-0.2, 0.2), (-0.5, 0.5), (-0.2, 0.2))
        )
        front, rear, yaw, acceleration = (float(rng.uniform(*ends)) for ends in ((0, 1), (0, 1), (-1, 1), (-11, 0)))
        u, v = speed * math.cos(beta), speed * math.sin(beta)
        spins = [
            (1 - front) * (u * math.cos(steer) + (v + vehicle.a * turn) * math.sin(steer)) / vehicle.R_w,
            (1 - rear) * u / vehicle.R_w,
        ]
        single = equations([0, 0, steer, speed, yaw, turn, beta, *spins], [0, acceleration], vehicle)
        state = CarState(0.0, 0.0, yaw, u, v, turn, steer, Wheels(spins[0], spins[0], spins[1], spins[1]))
        rate = rates(car, state, CarControls(*wheel_torques(vehicle, acceleration), steer))
        along = single[3] * math.cos(beta) - v * single[6]
        across = single[3] * math.sin(beta) + u * single[6]
        expected.append([single[0], single[1], single[4], along, across, single[5], *np.repeat(single[7:], 2)])
        found.append([*rate[:6], *rate.spins])
    expected, found = np.array(expected), np.array(found)
    assert np.max(np.abs(found - expected) / np.max(np.abs(expected), axis=0)) < 1e-12


@pytest.mark.slow
def test_a_run_is_that_of_the_single_track_model(oracle):
    """One second of braking; the tyres push to the side a little, so the car turns. SciPy integrates CommonRoad."""
    vehicle, equations = oracle
    start = [0, 0, 0, 30.0, 0, 0, 0, 30.0 / vehicle.R_w, 30.0 / vehicle.R_w]
    exact = solve_ivp(
        lambda t, x: equations(list(x), [0, -6.0], vehicle), (0, 1), start, method="LSODA", rtol=1e-11, atol=1e-12
    ).y[:, -1]
    car, torques = single_track(vehicle), wheel_torques(vehicle, -6.0)
    constant = {brake: controllers.ConstantTorque(torque=torque) for brake, torque in zip(BRAKES, torques, strict=True)}
    parts = car.usual_parts() | {
        "initial": BrakeStart(speed=30.0),
        "controller": controllers.PerChannel(constant, BRAKES),
        "stop": stops.NoStop(),
    }
    y = d.rollout(d.Loop(plant=car, **parts), d.Adaptive(rtol=1e-6, duration=1.0), {}).ending.sample.output
    x, across, _, speed, yaw, turn, beta, front, rear = exact
    assert abs(across) > 1e-3
    found = [y.distance, y.speed, y.front_left_wheel_speed, y.rear_right_wheel_speed]
    np.testing.assert_allclose(found, [x, speed, vehicle.R_w * front, vehicle.R_w * rear], rtol=1e-8)
    found = [y.lateral_position, y.yaw, y.yaw_velocity, y.sideslip_angle]
    np.testing.assert_allclose(found, [across, yaw, turn, beta], rtol=1e-5)


# Other cars


@pytest.mark.parametrize("tyre", [roads.RoadTyre(), roads.RoadTyre(road=roads.WET_ASPHALT)], ids=["dry", "wet"])
def test_in_straight_motion_it_is_the_half_car(tyre):
    car = Car(drag=0.4, rolling=0.012, **with_tyres(tyre))
    half = HalfCar(drag=0.4, rolling=0.012, front_tyre=tyre, rear_tyre=tyre)
    for speed, front, rear in ((30.0, 0.1, 0.05), (3.0, 0.9, 0.02), (12.0, 0.0, 0.3)):
        state = car.start(BrakeStart(speed=speed))
        spins = Wheels(*((1 - slip) * speed / car.radius for slip in (front, front, rear, rear)))
        rate = rates(car, state._replace(spins=spins), CarControls(600.0, 600.0, 200.0, 200.0, 0.0))
        axles = half.derivative(0.0, HalfCarState(speed, spins[0], spins[2], 0.0), AxleBrakes(1200.0, 400.0))
        np.testing.assert_allclose(rate.longitudinal_velocity, axles.speed, rtol=1e-12)
        np.testing.assert_allclose(rate.spins, np.repeat(axles[1:3], 2), rtol=1e-12)
        np.testing.assert_allclose((rate.lateral_velocity, rate.yaw_velocity, rate.y), 0.0, atol=1e-12)


def test_a_mirrored_car_makes_the_mirrored_motion():
    """Left and right exchanged; the tyres of the axles differ in friction, and loads in all four wheels."""
    car = SPLIT
    left = turning(car, 20.0, (0.1, 0.05, 0.2, 0.02), 0.7, 0.3, 0.05)
    mirrored = Car(front_left_tyre=SNOW, rear_left_tyre=SNOW, drag=0.4, rolling=0.012)
    spins = Wheels(left.spins[1], left.spins[0], left.spins[3], left.spins[2])
    right = CarState(3.0, 1.0, -0.1, 20.0, -0.7, -0.3, -0.05, spins)
    a = rates(car, left, CarControls(600.0, 100.0, 200.0, 50.0, 0.1))
    b = rates(mirrored, right, CarControls(100.0, 600.0, 50.0, 200.0, -0.1))
    signs = np.array([1, -1, -1, 1, -1, -1, -1])
    np.testing.assert_allclose(b[:7], signs * np.array(a[:7]), rtol=1e-12)
    np.testing.assert_allclose(b.spins, np.array(a.spins)[[1, 0, 3, 2]], rtol=1e-12)


# Closed forms


@killed_by("parts.plants.car", "(rear, -pitch, rear_roll)", "(rear, -pitch, -rear_roll)")
@pytest.mark.parametrize("tyre", [roads.RoadTyre(), roads.PacejkaTyre()], ids=["road", "pacejka"])
def test_loads_are_those_of_the_accelerations(tyre):
    """h m a/(a + b) moves to the front, k h m ay/Tf and (1 - k) h m ay/Tr to the right in a turn to the left."""
    car = Car(**with_tyres(tyre))
    y = shown(car, turning(car, 20.0, (0.05, 0.06, 0.02, 0.03), -0.5, 0.2, 0.03))
    loads = np.array([y.front_left_load, y.front_right_load, y.rear_left_load, y.rear_right_load])
    wheelbase, force = car.to_front + car.to_rear, car.mass * y.deceleration
    assert y.lateral_acceleration > 1.0
    np.testing.assert_allclose(sum(loads), car.mass * GRAVITY, rtol=1e-12)
    np.testing.assert_allclose(
        sum(loads[:2]), (car.mass * GRAVITY * car.to_rear + car.height * force) / wheelbase, rtol=1e-12
    )
    roll = car.height * car.mass * y.lateral_acceleration
    np.testing.assert_allclose(loads[1] - loads[0], 2 * car.roll_share * roll / car.front_track, rtol=1e-11)
    np.testing.assert_allclose(loads[3] - loads[2], 2 * (1 - car.roll_share) * roll / car.rear_track, rtol=1e-11)


@killed_by("parts.plants.car", "0.5 * self.front_track * (", "0.0 * self.front_track * (")
def test_a_split_road_turns_the_car_to_its_better_side():
    """Jz r' is the difference of both sides' braking forces times half of the track."""
    tracks = {"front_track": 1.4, "rear_track": 1.4}
    car = Car(front_right_tyre=SNOW, rear_right_tyre=SNOW, height=0.0, **tracks)
    state = turning(car, 20.0, (0.1,) * 4)._replace(yaw=0.0)
    rate = rates(car, state, CarControls(*[0.0] * 5))
    half = 0.5 * car.mass * GRAVITY
    grip = half * (roads.DRY_ASPHALT.friction(0.1, 20.0) - roads.SNOW.friction(0.1, 20.0))
    np.testing.assert_allclose(rate.yaw_velocity, 0.7 * grip / car.yaw_inertia, rtol=1e-12)


def test_a_slow_turn_has_the_yaw_velocity_of_a_neutral_car():
    """Cornering stiffness in proportion to the load: r = u d/(a + b) at every speed, for a small steer angle d."""
    car, steer = Car(), 1e-4
    start = car.start(BrakeStart(speed=15.0))
    flat, unravel = jax.flatten_util.ravel_pytree(jax.tree.map(float, start))
    moves = jax.jit(
        lambda t, x: jax.flatten_util.ravel_pytree(rates(car, unravel(x), CarControls(0.0, 0.0, 0.0, 0.0, steer)))[0]
    )
    end = unravel(solve_ivp(moves, (0, 4), flat, method="LSODA", rtol=1e-9, atol=1e-12).y[:, -1])
    expected = end.longitudinal_velocity * steer / (car.to_front + car.to_rear)
    np.testing.assert_allclose(end.yaw_velocity, expected, rtol=1e-3)


@pytest.mark.parametrize("slip", [0.02, 0.3, 1.0])
def test_the_force_of_a_road_tyre_opposes_the_sliding(slip):
    tyre = roads.RoadTyre()
    for angle in (0.0, 0.05, -0.4):
        force = tyre.forces(slip, angle, 3000.0, 12.0, 0.0)
        along, across = slip * np.cos(angle), np.sin(angle)
        size = 3000.0 * float(roads.DRY_ASPHALT.friction(np.hypot(along, across), 12.0))
        np.testing.assert_allclose(np.hypot(*force), size, rtol=1e-13)
        np.testing.assert_allclose(force.braking * across, -force.lateral * along, atol=1e-10)
    np.testing.assert_allclose(
        tyre.forces(slip, 0.0, 3000.0, 12.0, 0.0).braking, tyre.braking_force(slip, 3000.0, 12.0, 0.0), rtol=1e-13
    )


def test_the_energy_of_a_run_is_the_work_of_brakes_slip_and_drag():
    """Braking on a split road with the wheels steered; contact forces do work on the sliding only."""
    control = CarControls(900.0, 100.0, 300.0, 50.0, -0.02)
    start = SPLIT.start(BrakeStart(speed=30.0))
    flat, unravel = jax.flatten_util.ravel_pytree(jax.tree.map(float, start))

    @jax.jit
    def powers(_, x):
        state = unravel(x[: flat.size])
        contacts = SPLIT._contacts(state)
        loads = SPLIT._solve_loads(SPLIT._forces_of_loads(contacts, state), state)
        slides = 0.0
        positions = ((SPLIT.to_front, SPLIT.front_track), (SPLIT.to_front, -SPLIT.front_track))
        positions += ((-SPLIT.to_rear, SPLIT.rear_track), (-SPLIT.to_rear, -SPLIT.rear_track))
        speed = jnp.hypot(state.longitudinal_velocity, state.lateral_velocity)
        for i, wheel in enumerate(WHEELS):
            force = getattr(SPLIT, f"{wheel}_tyre").forces(
                contacts.slips[i], contacts.slip_angles[i], loads[i], speed, contacts.places[i]
            )
            u = state.longitudinal_velocity - state.yaw_velocity * positions[i][1] / 2
            v = state.lateral_velocity + state.yaw_velocity * positions[i][0]
            steer = state.steer if i < 2 else 0.0
            along, across = u * jnp.cos(steer) + v * jnp.sin(steer), v * jnp.cos(steer) - u * jnp.sin(steer)
            slides += force.braking * (along - SPLIT.radius * state.spins[i]) - force.lateral * across
        brakes = sum(torque * spin for torque, spin in zip(control[:4], state.spins, strict=True))
        drag = SPLIT.drag * state.longitudinal_velocity**3
        drag += SPLIT.rolling * SPLIT.mass * GRAVITY * state.longitudinal_velocity
        rate = jax.flatten_util.ravel_pytree(SPLIT.derivative(0.0, state, control))[0]
        return jnp.concatenate([rate, jnp.stack([brakes, slides, drag])])

    run = solve_ivp(powers, (0, 1.0), [*flat, 0.0, 0.0, 0.0], method="LSODA", rtol=1e-11, atol=1e-9)
    end = unravel(run.y[: flat.size, -1])
    assert abs(end.yaw) > 0.01
    assert min(end.spins) > 1.0
    np.testing.assert_allclose(sum(run.y[flat.size :, -1]), SPLIT.energy(start) - SPLIT.energy(end), rtol=1e-8)


def test_holding_torques_hold_all_slips():
    state = SPLIT.start(BrakeStart(speed=15.0))._replace(spins=Wheels(40.0, 42.0, 41.0, 39.0))
    y = shown(SPLIT, state)
    rate = rates(SPLIT, state, SPLIT.holding(y, y))
    straight = rate._replace(lateral_velocity=0.0, yaw_velocity=0.0)  # the slips of a car that goes straight on
    np.testing.assert_allclose(jax.jvp(lambda x: SPLIT.output(x)[:4], (state,), (straight,))[1], 0.0, atol=1e-12)


@pytest.mark.parametrize("tyre", [roads.RoadTyre(), roads.PacejkaTyre()], ids=["road", "pacejka"])
def test_rates_are_finite_in_every_corner(tyre):
    car = Car(**with_tyres(tyre))
    for u, v, turn, spin in ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 9.0), (5.0, 3.0, 2.0, 0.0), (1e-9, 0.0, 0.0, 1e-9)):
        state = CarState(0.0, 0.0, 0.0, u, v, turn, 0.1, Wheels(spin, 0.0, spin, 0.0))
        rate = rates(car, state, CarControls(50.0, 0.0, 0.0, 0.0, 0.0))
        slopes = jax.jacfwd(car.output)(state)
        assert np.all(np.isfinite([*jax.tree.leaves(rate)]))
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slopes))


PATHS = ("height", "front_track", "roll_share", "yaw_inertia", "front_left_tyre.road.c1", "rear_right_tyre.road.c2")
STATE = turning(SPLIT, 20.0, (0.1, 0.05, 0.2, 0.02), 0.7, 0.3, 0.05)
CONTROL = CarControls(600.0, 100.0, 200.0, 50.0, 0.1)


@jax.jit
def moves(values):
    car = replace(SPLIT, dict(zip(PATHS, values, strict=True)))
    return jnp.stack(jax.tree.leaves((car.derivative(0.0, STATE, CONTROL), car.output(STATE))))


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
def test_derivatives_are_those_of_differences(mode):
    """Of all rates and outputs by parameters of the car and its tyres, at three widths."""
    x = jnp.array([float(get(SPLIT, path)) for path in PATHS])
    derivative = mode(moves)(x)
    for i, value in enumerate(np.asarray(x)):
        assert np.any(derivative[:, i])
        for width in (1e-2, 3e-3, 1e-3):
            h = width * value
            far, near, close, distant = (moves(x.at[i].add(step * h)) for step in (-2, -1, 1, 2))
            difference = (8 * (close - near) - (distant - far)) / (12 * h)
            scale = np.max(np.abs(derivative[:, i]))
            np.testing.assert_allclose(derivative[:, i], difference, rtol=1e-6, atol=1e-7 * scale)


# The scenarios


@pytest.mark.slow
def test_in_a_run_on_a_straight_road_it_is_the_half_car():
    """Also at a small error: y, yaw and steer angle stay zero, or near rounding."""
    for rtol in ("1e-6", "1e-8"):
        car, half = (load(name, [f"solver.rtol={rtol}"]) for name in ("car-straight", "half-car"))
        run = d.measure(car.loop, car.solver, car.objectives)
        distance = d.measure(half.loop, half.solver, {"distance": half.objectives["stop_distance"]}).metrics["distance"]
        assert not run.diverged
        np.testing.assert_allclose(run.metrics["stop_distance"], distance, rtol=1e-8)
        assert run.metrics["max_yaw"] < 1e-6
        assert run.metrics["max_steer"] < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("groups", ["", "[]"], ids=["select-low", "each wheel"])
def test_the_page_tells_how_far_a_car_turns_on_a_split_road(groups):
    text = (ROOT / "docs" / "car.md").read_text(encoding="utf-8")
    row = [line for line in text.splitlines() if " m | " in line and " rad" in line][bool(groups)]
    told = [float(number) for number in re.findall(r"([\d.]+) (?:m|rad)\b", row)]
    scenario = load("car-split", [f"controller.controller.groups={groups}"] if groups else [])
    metrics = d.measure(scenario.loop, scenario.solver, scenario.objectives).metrics
    found = [metrics[name] for name in ("stop_distance", "max_yaw", "max_lateral_position", "max_steer")]
    np.testing.assert_allclose(found, told, rtol=1e-2)


@pytest.mark.slow
def test_derivatives_of_a_run_are_those_of_differences():
    """On a split road, at three widths: of distance, yaw and place by the driver, the car, a road and a target."""
    scenario = load("car-split", ["solver.rtol=1e-8", "stop=speed-reached", "stop.speed=3.0"])
    paths = ("controller.gain", "plant.height", "plant.front_left_tyre.road.c1", "reference.rear_right_slip.slip")
    names = ("stop_distance", "max_yaw", "max_lateral_position", "max_steer")
    objectives = {name: scenario.objectives[name] for name in names}

    def run(values):
        loop = replace(scenario.loop, dict(zip(paths, values, strict=True)))
        metrics = d.measure(loop, scenario.solver, objectives).metrics
        return jnp.stack([metrics[name] for name in names])

    x = jnp.array([float(get(scenario.loop, path)) for path in paths])
    derivative = np.asarray(jax.jit(jax.jacfwd(run))(x))
    moved = jax.jit(jax.vmap(run))
    for width, tolerance in ((1e-2, 1e-4), (3e-3, 1e-4), (1e-3, 1e-4)):
        steps = np.array([-2, -1, 1, 2])[:, None, None] * width * np.diag(x)
        far, near, close, distant = np.asarray(moved(jnp.asarray((np.asarray(x) + steps).reshape(-1, 4)))).reshape(
            4, 4, 4
        )
        difference = (8 * (close - near) - (distant - far)).T / (12 * width * np.asarray(x))
        np.testing.assert_allclose(derivative, difference, rtol=tolerance, atol=1e-5 * np.abs(difference).max())


@killed_by("parts.plants.car", "+ downhill * jnp.sin(state.yaw)", "- downhill * jnp.sin(state.yaw)")
@killed_by("parts.plants.half_car", "+ GRAVITY * jnp.sin(self.incline)", "- GRAVITY * jnp.sin(self.incline)")
def test_a_torque_and_an_angle_have_no_least_one():
    """The driver encloses the group: the message names the field at its place in the loop."""
    loop = load("car-split").loop
    mixed = (("rear_left_brake", "steer_angle"),)
    loop = replace(loop, {"controller.controller": dataclasses.replace(loop.controller.controller, groups=mixed)})
    line = "controller.controller.groups: rear_left_brake [N m], steer_angle [rad] have different units"
    assert [message.partition(";")[0] for message in find_misfits(loop, {})] == [line]


def test_gravity_acts_downhill_on_a_slope():
    """Without tyre forces and drag: g sin(slope) against the x axis of the road, and loads of m g cos(slope)."""
    slope, yaw, speed = 0.12, 0.3, 15.0
    smooth = with_tyres(roads.RoadTyre(road=roads.Scaled(road=roads.SNOW, scale=1e-9)))
    car = Car(incline=slope, **smooth)
    state = car.start(BrakeStart(speed=speed))._replace(yaw=yaw)
    rate, y = rates(car, state, CarControls(*[0.0] * 5)), shown(car, state)
    acceleration = np.array([rate.longitudinal_velocity, rate.lateral_velocity])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    np.testing.assert_allclose(turn @ acceleration, [-GRAVITY * np.sin(slope), 0.0], atol=1e-6)
    loads = [y.front_left_load, y.front_right_load, y.rear_left_load, y.rear_right_load]
    np.testing.assert_allclose(sum(loads), car.mass * GRAVITY * np.cos(slope), rtol=1e-12)

    half = HalfCar(
        incline=slope, rolling=0.01, front_tyre=smooth["front_left_tyre"], rear_tyre=smooth["rear_left_tyre"]
    )
    rolling = half.derivative(0.0, HalfCarState(speed, speed / 0.344, speed / 0.344, 0.0), AxleBrakes(0.0, 0.0))
    expected = -GRAVITY * (np.sin(slope) + 0.01 * np.cos(slope))
    np.testing.assert_allclose(rolling.speed, expected, rtol=1e-6)
