"""The half car against CommonRoad's single-track model, closed forms, SciPy, the quarter car, and differences."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pages
import pytest
from mutants import killed_by
from project import ROOT
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs import controllers, references, roads, stops
from diffabs.core.pytree import get
from diffabs.parts.objectives import BRAKING
from diffabs.parts.plants import GRAVITY, BrakeStart, HalfCar, QuarterCar
from diffabs.parts.plants.half_car import CHANNELS, AxleBrakes, HalfCarState
from diffabs.scenario import load

CAR = HalfCar(drag=0.4, rolling=0.012)
TYRES = {"front_tyre": roads.PacejkaTyre(), "rear_tyre": roads.PacejkaTyre()}
rates = jax.jit(lambda car, state, control: car.derivative(0.0, state, control))
shown = jax.jit(lambda car, state: car.output(state))


def state_at(car, speed, front, rear, distance=0.0):
    return HalfCarState(speed, (1 - front) * speed / car.radius, (1 - rear) * speed / car.radius, distance)


# CommonRoad's single-track drift model


@pytest.fixture(scope="module")
def oracle():
    """Vehicle 2, its parameters and the equations of motion."""
    from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
    from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std

    return parameters_vehicle2(), vehicle_dynamics_std


def both_rates(oracle, speed, front, rear, acceleration):
    """Rates of speed and spins by CommonRoad and by the half car, with loads by the commanded acceleration."""
    vehicle, equations = oracle
    car = HalfCar(height=vehicle.h_s, crawl_speed=0.1, commanded=True, **TYRES)
    state = state_at(car, speed, front, rear)
    spins = [float(state.front_spin), float(state.rear_spin)]
    expected = np.array(equations([0, 0, 0, speed, 0, 0, 0, *spins], [0, acceleration], vehicle))[[3, 7, 8]]
    torque = -vehicle.m * vehicle.R_w * acceleration
    rate = rates(car, state, AxleBrakes(vehicle.T_sb * torque, (1 - vehicle.T_sb) * torque))
    return expected, np.array(rate[:3])


PRINTED = {
    (30.0, 0.1, 0.05, -6.0): (-10.456589340629117, 861.5152717220273, 124.42270002457322),
    (20.0, 0.2, 0.1, -8.0): (-11.189431465365761, 679.8945205837525, 25.70820599450579),
    (10.0, 0.05, 0.02, -3.0): (-7.131374063636825, 781.0052385377198, 132.98486768409222),
}


@pytest.mark.parametrize("point", PRINTED)
def test_rates_are_those_of_the_single_track_model_as_printed(oracle, point):
    for rate in both_rates(oracle, *point):
        np.testing.assert_allclose(rate, PRINTED[point], rtol=1e-12, atol=0)


@killed_by("parts.roads.tyres", "_bend(x, self.p_ex1) + load * self.p_vx1)", "_bend(x, self.p_ex1))")
@killed_by("parts.plants.half_car", "+ shift) / wheelbase", "- shift) / wheelbase")
def test_rates_are_those_of_the_single_track_model(oracle):
    """At 1,000 random points; above 2 m/s that model has no share of its kinematic one. Spins change by up to 4,500."""
    rng = np.random.default_rng(68)
    draws = (rng.uniform(low, high, 1000) for low, high in ((2, 50), (0, 1), (0, 1), (-11.5, 0)))
    expected, found = np.swapaxes([both_rates(oracle, *map(float, point)) for point in zip(*draws, strict=True)], 0, 1)
    scale = np.max(np.abs(expected), axis=0)
    assert np.max(np.abs(found - expected) / scale) < 1e-12


# Closed forms


def test_static_loads_of_vehicle_2():
    np.testing.assert_allclose(HalfCar().loads(0.0), (5916.82, 4808.41), rtol=0, atol=5e-3)


@pytest.mark.parametrize("tyres", [{}, TYRES], ids=["road", "pacejka"])
def test_loads_are_those_of_the_deceleration(tyres):
    """m a h/(a + b) moves to the front, and the deceleration is that of the tyres under these very loads."""
    car = HalfCar(**tyres)
    for speed, front, rear in ((30.0, 0.1, 0.05), (3.0, 0.9, 0.02), (12.0, 0.01, 0.3)):
        y = shown(car, state_at(car, speed, front, rear))
        weight, wheelbase = car.mass * GRAVITY, car.to_front + car.to_rear
        moved = car.mass * y.deceleration * car.height / wheelbase
        np.testing.assert_allclose(y.front_load, weight * car.to_rear / wheelbase + moved, rtol=1e-13)
        np.testing.assert_allclose(y.rear_load, weight * car.to_front / wheelbase - moved, rtol=1e-13)
        forces = [
            car.front_tyre.braking_force(front, y.front_load, speed, 0.0),
            car.rear_tyre.braking_force(rear, y.rear_load, speed, 0.0),
        ]
        np.testing.assert_allclose(sum(forces), car.mass * y.deceleration, rtol=1e-12)


@killed_by("parts.plants.half_car", "1 if proportional else LOAD_STEPS", "1")
def test_a_friction_of_the_load_needs_more_steps():
    """With a friction that falls by half for 60 kN, the loop is far from linear; three steps still close it."""
    tyre = roads.PacejkaTyre(p_vx1=-5e-5)
    car = HalfCar(front_tyre=tyre, rear_tyre=tyre)
    y = shown(car, state_at(car, 20.0, 0.3, 0.03))
    forces = tyre.braking_force(0.3, y.front_load) + tyre.braking_force(0.03, y.rear_load)
    np.testing.assert_allclose(forces, car.mass * y.deceleration, rtol=1e-12)


@pytest.mark.parametrize("slip", [0.02, 0.08, 0.5])
def test_the_ideal_distribution_uses_both_axles_alike(slip):
    """F1/F2 = (b + mu h)/(a - mu h) at one friction mu, and the deceleration is mu g."""
    car = HalfCar(front_inertia=1e-12, rear_inertia=1e-12)
    y = shown(car, state_at(car, 20.0, slip, slip))
    mu = roads.DRY_ASPHALT.friction(slip, 20.0)
    np.testing.assert_allclose(y.deceleration, mu * GRAVITY, rtol=1e-13)
    torques = car.holding(y, Target(slip, slip))
    ratio = (car.to_rear + mu * car.height) / (car.to_front - mu * car.height)
    np.testing.assert_allclose(torques.front_brake / torques.rear_brake, ratio, rtol=1e-11)


class Target:
    def __init__(self, front, rear):
        self.front_slip, self.rear_slip = front, rear


@killed_by("parts.plants.half_car", "(1 - slip) * inertia * deceleration", "inertia * deceleration")
def test_holding_torques_hold_both_slips():
    state = state_at(CAR, 15.0, 0.12, 0.05)
    torques = CAR.holding(shown(CAR, state), Target(0.12, 0.05))
    rate = rates(CAR, state, torques)
    slip_rates = jax.jvp(lambda x: CAR.output(x)[:2], (state,), (rate,))[1]
    np.testing.assert_allclose(slip_rates, 0.0, atol=1e-12)


# Runs


def test_without_height_it_is_a_quarter_car():
    """Two equal axles at height 0 brake as one wheel with half of the mass: rates, and a controlled run to its end."""
    half = {"to_front": 1.3, "to_rear": 1.3, "height": 0.0, "front_inertia": 1.1, "rear_inertia": 1.1, "radius": 0.3}
    tyre = roads.RoadTyre(road=roads.WET_ASPHALT)
    car = HalfCar(mass=900.0, front_tyre=tyre, rear_tyre=tyre, **half)
    quarter = QuarterCar(mass=450.0, inertia=1.1, radius=0.3, road=roads.WET_ASPHALT)
    for speed, slip in ((30.0, 0.0), (20.0, 0.07), (2.0, 0.8)):
        wheel = quarter.derivative(0.0, quarter.start(BrakeStart(speed=speed, slip=slip)), 500.0)
        both = rates(car, car.start(BrakeStart(speed=speed, slip=slip)), AxleBrakes(500.0, 500.0))
        np.testing.assert_allclose(both[:4], (wheel.speed, wheel.spin, wheel.spin, wheel.distance), rtol=1e-13)
    pid = controllers.PID(kp=8e3, ki=6e4, low=0.0, high=3e3)
    parts = {"initial": BrakeStart(speed=20.0), "stop": stops.SpeedReached(speed=5.0)}
    target = references.FilteredSlip(slip=0.08)
    one = d.Loop(plant=quarter, reference=target, controller=pid, feedforward=controllers.NoFeedforward(), **parts)
    two = d.Loop(plant=car, **(car.usual_parts() | parts | {
        "reference": references.PerTarget(reference=dict.fromkeys(CHANNELS.values(), target)),
        "controller": controllers.PerChannel(pid, CHANNELS),
    }))  # fmt: skip
    solver = d.FixedStep(5e-4, 5.0)
    a, b = d.measure(one, solver, BRAKING).metrics, d.measure(two, solver, car.usual_objectives()).metrics
    for name, value in a.items():
        for other in [name] if name in b else [f"{name}_front", f"{name}_rear"]:
            np.testing.assert_allclose(b[other], value, rtol=1e-9, atol=1e-12)


def test_the_energy_of_a_run_is_the_work_of_brakes_slip_and_drag():
    """From 30 m/s to nearly locked wheels, by SciPy's integration of the plant's rates and of each power."""
    torques = AxleBrakes(2300.0, 900.0)
    wheelbase = CAR.to_front + CAR.to_rear

    @jax.jit
    def powers(_, x):
        state = HalfCarState(*x[:4])
        y, rate = CAR.output(state), CAR.derivative(0.0, state, torques)
        brakes = torques.front_brake * state.front_spin + torques.rear_brake * state.rear_spin
        front = CAR.front_tyre.braking_force(y.front_slip, y.front_load, y.speed, y.distance)
        rear = CAR.rear_tyre.braking_force(y.rear_slip, y.rear_load, y.speed, y.distance - wheelbase)
        slip = front * (y.speed - y.front_wheel_speed) + rear * (y.speed - y.rear_wheel_speed)
        drag = CAR.drag * y.speed**3 + CAR.rolling * CAR.mass * GRAVITY * y.speed
        return jnp.stack([*rate[:4], brakes, slip, drag])

    start = CAR.start(BrakeStart(speed=30.0))
    run = solve_ivp(powers, (0.0, 2.5), [*map(float, start[:4]), 0.0, 0.0, 0.0], method="LSODA", rtol=1e-11, atol=1e-9)
    end = run.y[:, -1]
    lost = CAR.energy(start) - CAR.energy(HalfCarState(*end[:4]))
    assert min(end[1:7]) > 1.0
    np.testing.assert_allclose(sum(end[4:]), lost, rtol=1e-8)


def test_a_run_agrees_with_scipy():
    """Open loop, with the equations written out and the load loop solved as a linear system."""
    m, a, b, h, r, j = CAR.mass, CAR.to_front, CAR.to_rear, CAR.height, CAR.radius, CAR.front_inertia
    torques = (2000.0, 700.0)

    def equations(t, x):
        v, front, rear, _ = x
        slips = [(v - r * front) / v, (v - r * rear) / v]
        mus = [(1.2801 * (1 - np.exp(-23.99 * s)) - 0.52 * s) * np.exp(-0.03 * s * v) for s in slips]
        transfer = np.array([[1, 0, -h / (a + b)], [0, 1, h / (a + b)], [-mus[0], -mus[1], 1]])
        weight = m * 9.81 / (a + b)
        first, second, force = np.linalg.solve(transfer, [weight * b, weight * a, 0.012 * m * 9.81])
        spins = [(r * mu * load - u) / j for mu, load, u in zip(mus, (first, second), torques, strict=True)]
        return [-(force + 0.4 * v * v) / m, *spins, v]

    start = [30.0, 30.0 / r, 30.0 / r, 0.0]
    exact = solve_ivp(equations, (0.0, 2.0), start, method="LSODA", rtol=1e-11, atol=1e-11).y[:, -1]
    constant = {
        "front_brake": controllers.ConstantTorque(torque=2000.0),
        "rear_brake": controllers.ConstantTorque(torque=700.0),
    }
    parts = CAR.usual_parts() | {
        "initial": BrakeStart(speed=30.0),
        "controller": controllers.PerChannel(constant, CHANNELS),
        "stop": stops.NoStop(),
    }
    y = d.rollout(d.Loop(plant=CAR, **parts), d.Adaptive(rtol=1e-9, duration=2.0), {}).ending.sample.output
    found = [y.speed, y.front_wheel_speed / r, y.rear_wheel_speed / r, y.distance]
    np.testing.assert_allclose(found, exact, rtol=1e-7)


def test_the_rear_axle_reaches_a_patch_one_wheelbase_later():
    ice = roads.RoadTyre(road=roads.Patches(roads=(roads.DRY_ASPHALT, roads.ICE), edges=(10.0,), width=0.0))
    car = HalfCar(front_tyre=ice, rear_tyre=ice, height=0.0)
    wheelbase = car.to_front + car.to_rear
    grips = []
    for place in (9.99, 10.01, 9.99 + wheelbase, 10.01 + wheelbase):
        rate = rates(car, state_at(car, 20.0, 0.1, 0.1, place), AxleBrakes(0.0, 0.0))
        grips.append([float(rate.front_spin) > 500.0, float(rate.rear_spin) > 500.0])
    assert grips == [[True, True], [False, True], [False, True], [False, False]]


@pytest.mark.parametrize("tyres", [{}, TYRES], ids=["road", "pacejka"])
def test_rates_are_finite_in_every_corner(tyres):
    car = HalfCar(**tyres)
    for v, front, rear in ((0.0, 0.0, 0.0), (0.0, 5.0, 0.0), (5.0, 0.0, 80.0), (1e-9, 1e-9, 0.0)):
        state = HalfCarState(v, front, rear, 0.0)
        rate, slopes = rates(car, state, AxleBrakes(50.0, 0.0)), jax.jacfwd(car.output)(state)
        assert np.all(np.isfinite([*rate[:4], *jax.tree.leaves(slopes)]))
        assert car.project(car.project(state)) == car.project(state)


# The scenario

PATHS = (
    *("plant.height", "plant.to_front", "plant.front_inertia", "plant.rear_tyre.road.c1"),
    *("controller.front_brake.kp", "controller.rear_brake.ki", "reference.front_slip.slip"),
)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.grad], ids=["forward", "reverse"])
def test_derivatives_are_those_of_differences(mode):
    """At three widths, whose errors are the fourth power of the width, and the rounding and step errors over it."""
    scenario = load("half-car")
    solver = d.Adaptive(rtol=1e-9, duration=5.0)

    @jax.jit
    def distance(x):
        loop = d.replace(scenario.loop, dict(zip(PATHS, x, strict=True)))
        return d.measure(loop, solver, {"way": scenario.objectives["stop_distance"]}).metrics["way"]

    x = jnp.array([float(get(scenario.loop, path)) for path in PATHS])
    derivative = mode(distance)(x)
    for i, value in enumerate(np.asarray(x)):
        for width, tolerance in ((1e-2, 1e-5), (3e-3, 1e-6), (1e-3, 1e-6)):
            h = width * value
            far, near, close, distant = (distance(x.at[i].add(step * h)) for step in (-2, -1, 1, 2))
            difference = (8 * (close - near) - (distant - far)) / (12 * h)
            np.testing.assert_allclose(derivative[i], difference, rtol=tolerance, atol=1e-9)


def test_the_scenario_stops_without_a_locked_wheel():
    """Within 5 % of the distance that the tyres allow: v^2/(2 g) times the mean of 1/mu at the targets."""
    scenario = load("half-car")
    metrics = d.measure(scenario.loop, scenario.solver, scenario.objectives).metrics
    assert metrics["locked_time_front"] == metrics["locked_time_rear"] == 0.0
    speeds = np.linspace(0.0, 100 / 3.6, 1001)
    least = np.trapezoid(speeds / (GRAVITY * np.asarray(roads.DRY_ASPHALT.friction(0.1, speeds))), speeds)
    assert least < metrics["stop_distance"] < 1.06 * least


FIXED = ("solver=fixed", "solver.duration=5", "stop=speed-reached", "stop.speed=5")


@killed_by("parts.plants.half_car", "class HalfCar(SlipProbes)", "class HalfCar")
def test_fixed_steps_may_be_as_long_as_the_stiffest_wheel_allows():
    """At the stop's speed, not at rest: the rate of a free wheel there is r^2 Fz c1 c2/(J v), and RK4 bears 2.785."""
    load("half-car", [*FIXED, "solver.step=8e-4"])
    stiffest = CAR.radius**2 * 5916.82 * (1.2801 * 23.99 - 0.52) / (1.7 * 5.0)
    with pytest.raises(ValueError, match=r"only with steps in \(0, ([\d.e-]+)\] s") as refusal:
        load("half-car", [*FIXED, "solver.step=2e-3"])
    limit = float(re.search(r"\(0, ([\d.e-]+)\]", str(refusal.value))[1])
    assert 0.6 < limit / (2.785 / stiffest) < 1.2


@pytest.mark.slow
def test_fixed_and_adaptive_steps_agree():
    distances = []
    for changes in (FIXED, FIXED[1:]):
        scenario = load("half-car", [*changes, *(["solver.step=8e-4"] if changes is FIXED else [])])
        distances.append(d.measure(scenario.loop, scenario.solver, scenario.objectives).metrics["stop_distance"])
    np.testing.assert_allclose(*distances, rtol=1e-6)


def test_the_page_prints_what_it_says():
    text = (ROOT / "docs" / "car.md").read_text(encoding="utf-8")
    assert pages.written(text, pages.printed(text, "docs/car.md")) == text


def test_sensors_and_metrics_see_an_axle_as_a_wheel():
    y = shown(CAR, state_at(CAR, 20.0, 0.1, 0.05, 3.0))
    rear = y.channel("rear_slip")
    assert (rear.slip, rear.wheel_speed, rear.distance) == (y.rear_slip, y.rear_wheel_speed, y.distance)
    assert y.channel("deceleration")[0] == y.deceleration
    changed = y.with_channel("rear_slip", rear._replace(slip=0.3, speed=1.0))
    assert changed == y._replace(rear_slip=0.3)
    assert y.with_channel("speed", (7.0,)).speed == 7.0
