"""Plants against published numbers, the papers' linearisation, and mechanics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import cases
from mutants import killed_by
from parts import PLANTS

from diffabs import FixedStep, braking, check, rollout
from diffabs.core.protocols import BrakeOutput
from diffabs.core.validity import check_part
from diffabs.parts.controllers import ConstantTorque
from diffabs.parts.objectives import BRAKING
from diffabs.parts.plants import GRAVITY, BrakeStart, LabRig, MirroredRig, QuarterCar, RoadVehicle
from diffabs.parts.plants.lab_rig import LabRigState
from diffabs.parts.roads import (
    DRY_ASPHALT,
    RIG,
    SNOW,
    SPLINE_B,
    Burckhardt,
    Patches,
    PiecewiseLinear,
    RationalCurve,
    Tabulated,
)
from diffabs.parts.stops import NoStop, SpeedReached

NO_FRICTION = Burckhardt(c1=0.0, c3=0.0)
MU = 0.39575220833898  # of the rig's curve at slip 0.2
K = 1 / 3.6


def output(slip, speed, distance=0.0):
    return BrakeOutput(slip, speed, (1 - slip) * speed, 0.0, distance)


@jax.jit
def slip_rate(plant, speed, slip, control):
    """d(slip)/dt along the plant's derivative."""
    state = plant.start(BrakeStart(speed=speed, slip=slip))
    rate = plant.derivative(0.0, state, control)
    return jax.jvp(lambda x: plant.output(x).slip, (state,), (rate,))[1]


# Maeda and Sugiura's rig


@pytest.mark.parametrize(("mass", "torque"), [(5.3, 2.51743976961), (6.2, 2.86510234623)])
def test_holding_torque(mass, torque):
    np.testing.assert_allclose(MirroredRig(mass=mass).holding(output(0.2, 10.0), 0.2), torque, rtol=1e-11, atol=0)


@pytest.mark.parametrize(("mass", "alpha"), [(5.3, 83.8796606703), (6.2, 84.6321445666)])
@pytest.mark.parametrize("speed", [50 * K, 5 * K])
def test_linearisation(mass, alpha, speed):
    """Eqs. (16), (17): slip' = (alpha (slip - 0.2) + beta (tau - tau*))/omega_2, at any speed."""
    rig = MirroredRig(mass=mass)
    omega = rig.start(BrakeStart(speed=speed, slip=0.2)).body
    np.testing.assert_allclose(omega, {50: 140.291806958, 5: 14.0291806958}[round(speed / K)], rtol=1e-11, atol=0)
    tau = rig.holding(output(0.2, speed), 0.2)
    by_slip, by_torque = jax.jit(jax.grad(slip_rate, (2, 3)))(rig, speed, 0.2, tau)
    np.testing.assert_allclose(by_slip * omega, alpha, rtol=1e-10, atol=0)  # mu'(0.2) is the sensitive factor
    np.testing.assert_allclose(by_torque * omega, 133.472842636189, rtol=1e-12, atol=0)


def test_slip_rate_is_equation_14():
    rig, speed, slip, tau = MirroredRig(mass=6.0), 8.0, 0.35, 1.7
    r1, r2, j1, load, omega = 0.0995, 0.099, 7.53e-3, 6.0 * 9.81, 8.0 / 0.099
    mu = float(RIG.friction(slip))
    j2 = 0.5 * 6.0 * r2**2
    friction = r1**2 / (j1 * r2) * load * mu + (1 - slip) * load * r2 * mu / j2
    expected = -friction / omega + r1 / (j1 * r2 * omega) * tau
    np.testing.assert_allclose(slip_rate(rig, speed, slip, tau), expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize(("factor", "deceleration"), [(1.0, MU * 9.81), (0.5, 2 * MU * 9.81)])
def test_inertia_factor(factor, deceleration):
    """As a body, eq. (8): mu g. As the disk of eq. (3), eq. (9): twice that."""
    rig = MirroredRig(inertia_factor=factor)
    state = rig.start(BrakeStart(speed=10.0, slip=0.2))
    rate = rig.derivative(0.0, state, 1.0)
    np.testing.assert_allclose(rig.output(state).deceleration, deceleration, rtol=1e-12, atol=0)
    np.testing.assert_allclose(-rig.body_radius * rate.body, deceleration, rtol=1e-12, atol=0)


@pytest.mark.parametrize(("slip", "speed"), [(0.05, 20.0), (0.4, 3.0), (1.0, 10.0)])
def test_rig_as_a_body_is_a_quarter_car(slip, speed):
    car = QuarterCar(mass=6.0, radius=0.1, inertia=0.01, road=RIG)
    rig = MirroredRig(mass=6.0, wheel_radius=0.1, body_radius=0.1, wheel_inertia=0.01, inertia_factor=1.0, road=RIG)
    a, b = (p.output(p.start(BrakeStart(speed=speed, slip=slip))) for p in (car, rig))
    np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15)
    rates = [slip_rate(p, speed, slip, 1.5) for p in (car, rig)]
    np.testing.assert_allclose(*rates, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(*(p.holding(a, slip) for p in (car, rig)), rtol=1e-13, atol=0)


# Aoki and Nakamura's quarter car


def test_quarter_car_by_hand():
    """At a knot of the road: mu = 0.95733 at slip 0.14539; m = 15, r = 0.2, J = 1.04456."""
    car = QuarterCar(road=SPLINE_B)
    state = car.start(BrakeStart(speed=20.0, slip=0.14539))
    np.testing.assert_allclose(state, (20.0, 0.85461 * 100.0, 0.0), rtol=1e-14, atol=0)
    rate = jax.jit(car.derivative)(0.0, state, 30.0)
    expected = (-0.95733 * 9.81, (0.2 * 0.95733 * 15.0 * 9.81 - 30.0) / 1.04456, 20.0)
    np.testing.assert_allclose(rate, expected, rtol=1e-11, atol=0)


def test_slip_in_driving_and_at_standstill():
    """Relative to the faster of both; below the crawl speed it fades with the difference instead of jumping."""
    car = QuarterCar(crawl_speed=0.01)
    for v, w, slip in (
        (10, 8, 0.2),
        (8, 10, -0.2),
        (10, 0, 1),
        (0, 10, -1),
        (0.001, 0, 0.1),
        (0, 0.002, -0.2),
        (0, 0, 0),
    ):
        state = car.start(BrakeStart(speed=0.0))._replace(speed=float(v), spin=w / 0.2)
        np.testing.assert_allclose(car.output(state).slip, slip, rtol=1e-13, atol=1e-15)


CRAWLED = PiecewiseLinear(slip=(0.0, 0.1, 1.0), mu=(0.0, 0.8, 0.7))


@killed_by("parts.plants.wheel", "else self.crawl_speed", "else 10.0")
def test_without_a_stop_the_crawl_speed_limits_the_step():
    """A run may last to standstill, and below the crawl speed c the slip fades as exp(-(g k/c) (1 + m r^2/J) t). RK4 is
    stable to 2.785 of this rate, k is the friction's first slope."""
    car = QuarterCar(mass=15.0, radius=0.2, inertia=1.0, crawl_speed=0.05, road=CRAWLED)
    loop = braking(plant=car, initial=BrakeStart(speed=0.2), controller=ConstantTorque(torque=20.0), stop=NoStop())
    limit = 2.785293563405282 / (GRAVITY * 8.0 / 0.05 * (1 + 15.0 * 0.2**2))
    check(loop, FixedStep(0.97 * limit, 0.2))
    with pytest.raises(ValueError, match="is not stable"):
        check(loop, FixedStep(1.03 * limit, 0.2))


@pytest.mark.slow
def test_without_a_stop_a_car_stands_to_the_end():
    car = QuarterCar(mass=15.0, radius=0.2, inertia=1.0, crawl_speed=0.05, road=CRAWLED)
    loop = braking(plant=car, initial=BrakeStart(speed=0.2), controller=ConstantTorque(torque=20.0), stop=NoStop())
    run = jax.jit(rollout, static_argnums=1)(loop, FixedStep(1e-4, 0.2))
    last = jax.tree.map(lambda x: float(x[-1]), run.trajectory.sample)
    np.testing.assert_allclose(last.t, 0.2, rtol=1e-12)  # the whole duration, though the car stands from 0.05 s on
    assert last.output.speed == 0.0
    assert not run.stopped
    assert not run.diverged


# The laboratory rig


def test_lab_rig_static_load():
    """All at rest and no friction: the weight on its lever, Mg/(L sin phi)."""
    rig = LabRig(road=NO_FRICTION, wheel_stiction=0.0, drum_stiction=0.0, wheel_friction=0.0, drum_friction=0.0)
    mu, normal, torque = rig.contact(LabRigState(0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(normal, 58.217466, rtol=1e-8, atol=0)
    assert mu == 0
    assert torque == 0


@killed_by(
    "parts.plants.lab_rig",
    "normal = jnp.where(free, quotient(self.weight_torque + torque, jnp",
    "normal = jnp.where(free, quotient(self.weight_torque, jnp",
)
def test_lab_rig_derivative():
    rate = LabRig().derivative(0.0, LabRigState(100.0, 140.0, 3.0, 0.0), 0.6)
    expected = (25.7927789186, -129.512606509, -1.34442, 0.099 * 140.0)
    np.testing.assert_allclose(rate, expected, rtol=1e-11, atol=0)


@pytest.mark.parametrize(
    ("command", "torque"), [(0.41, 0.0), (0.415, 0.1146), (0.6, 2.934), (1.0, 9.03), (7.0, 9.03), (-1.0, 0.0)]
)
def test_lab_rig_brake_characteristic(command, torque):
    """b(u) = 15.24 u - 6.21 from u0 = 0.415 up to u = 1, and its lag of 1/20.37 s."""
    rate = LabRig().derivative(0.0, LabRigState(100.0, 140.0, 0.5, 0.0), command)
    np.testing.assert_allclose(rate.brake, 20.37 * (torque - 0.5), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("command", [0.5, 0.9, 1.0])
def test_the_brake_of_the_lab_rig_does_not_drive(command):
    """With an offset of -14 N m, b1 u + b2 is negative up to u = 0.92: the brake is then released."""
    rate = LabRig(brake_offset=-14.0).derivative(0.0, LabRigState(100.0, 140.0, 0.5, 0.0), command)
    np.testing.assert_allclose(rate.brake, 20.37 * (max(15.24 * command - 14.0, 0.0) - 0.5), rtol=1e-12)


@killed_by("parts.plants.lab_rig", "yield stays_below(friction, limit,", "yield stays_below(friction, 1e9 * limit,")
def test_a_lever_that_locks_itself_is_refused():
    """tan 65.61 deg = 2.205: at that friction no finite normal force balances the lever."""
    assert check(LabRig(road=Burckhardt(c1=2.2, c3=0.0))).road.c1 == 2.2
    assert check(LabRig(road=SPLINE_B)).road is SPLINE_B
    with pytest.raises(ValueError, match=r"road.friction = 2.4\d at slip 1 is not below tan\(lever_angle\) = 2.2"):
        check(LabRig(road=Burckhardt(c1=2.41, c3=0.0)))
    with pytest.raises(ValueError, match=r"road\.friction = .* the lever locks itself"):
        check(LabRig(road=Burckhardt(c1=1e300)))


@killed_by("core.validity", "has_fault |= bool(within)", "has_fault |= False")
def test_a_lever_on_a_broken_road_is_not_asked_for():
    """Rules between parts are for parts that are sound: a spline has too few frictions, a c1 is infinite."""
    broken = Tabulated(slip=np.array([0.0, 0.1, 0.2, 1.0]), mu=np.array([0.0, 0.5, 0.6]))
    with pytest.raises(ValueError, match=r"^road\.slip and mu have shapes \(4,\) and \(3,\)"):
        check_part(LabRig(road=broken))
    with pytest.raises(ValueError, match=r"^road\.c1 = inf is outside \[0, inf\)$"):
        check_part(LabRig(road=Burckhardt(c1=np.inf)))


@killed_by(
    "parts.plants.lab_rig",
    "jnp.where(free, arm, 1.0)), jnp.inf)",
    "jnp.where(free, arm, 1.0)), quotient(self.weight_torque + torque, arm))",
)
def test_a_lever_that_locks_itself_further_on_is_no_run():
    """A patch that `check` does not see. The normal force is infinite there: no number is left to be averaged."""
    road = Patches(roads=(RIG, Burckhardt(c1=5.0, c3=0.0)), edges=(2.0,))
    rig = LabRig(road=road)
    ahead = LabRigState(100.0, 140.0, 9.0, 3.0)
    assert not np.isfinite(rig.derivative(0.0, ahead, 0.9).drum)
    assert np.isfinite(rig.derivative(0.0, ahead._replace(distance=1.0), 0.9).drum)


@killed_by("parts.plants.lab_rig", "larger(arm - grip, 0.0)", "arm - grip")
@pytest.mark.parametrize("mu", [0.4, 1.0, 1.4])
def test_no_command_holds_a_lab_wheel_that_no_torque_holds(mu):
    """Both wheels' torque balances are linear in torque and normal force; slip is kept if omega1' = ratio omega2'."""
    rig, slip, speed = LabRig(road=Burckhardt(c1=mu, c2=1e9, c3=0.0, c4=0.0)), 0.2, 10.0
    r1, r2, j1, j2 = rig.wheel_radius, rig.drum_radius, rig.wheel_inertia, rig.drum_inertia
    ratio, spin, drum = (1 - slip) * r2 / r1, (1 - slip) * speed / r1, speed / r2
    arm = rig.lever * (np.sin(rig.lever_angle) - mu * np.cos(rig.lever_angle))
    bearing, drag = rig.wheel_friction * spin + rig.wheel_stiction, rig.drum_friction * drum + rig.drum_stiction
    # T - arm Fn = -Mg - bearing;  -T/J1 + (r1/J1 + ratio r2/J2) mu Fn = bearing/J1 - ratio drag/J2
    matrix = [[1.0, -arm], [-1 / j1, (r1 / j1 + ratio * r2 / j2) * mu]]
    torque, normal = np.linalg.solve(matrix, [-rig.weight_torque - bearing, bearing / j1 - ratio * drag / j2])
    command = (torque - rig.brake_offset) / rig.brake_gain
    assert (normal > 0) == (mu < 1.1)
    np.testing.assert_allclose(rig.holding(output(slip, speed), slip), command if normal > 0 else np.inf, rtol=1e-9)


@killed_by("parts.plants.lab_rig", "target = jnp.where(u < self.brake_threshold, 0.0, brake)", "target = brake")
@killed_by("parts.plants.lab_rig", "larger(0.0, self.brake_gain", "larger(-1e9, self.brake_gain")
def test_the_lab_brake_by_hand():
    """Below its threshold and its offset it releases; a command of NaN brakes with NaN, and the run has diverged."""
    state = LabRigState(100.0, 140.0, 2.0, 0.0)
    for threshold, command, target in (
        *((0.5, 0.45, 0.0), (0.3, 0.35, 0.0), (0.5, 0.6, 0.6 * 15.24 - 6.21), (0.5, 1.5, 9.03)),
        (0.5, np.nan, np.nan),
    ):
        rate = LabRig(brake_threshold=threshold).derivative(0.0, state, command).brake
        np.testing.assert_allclose(rate, 20.37 * (target - 2.0), rtol=1e-12)


@killed_by("parts.plants.lab_rig", "held = arm > self.wheel_radius * mu", "held = arm > -jnp.inf")
def test_a_lab_wheel_that_no_torque_holds_turns_again():
    """Friction between 1.34 and tan phi: the road's torque grows faster than the brake's, whatever the brake does."""
    rig = LabRig(road=Burckhardt(c1=1.6, c3=0.0, c4=0.0))
    _, normal, carried = rig.contact(LabRigState(0.0, 100.0, 9.0, 0.0))
    np.testing.assert_allclose(carried, 9.0 + rig.wheel_stiction, rtol=1e-12)
    assert normal > 0
    assert rig.derivative(0.0, LabRigState(0.0, 100.0, 9.0, 0.0), 0.9).wheel > 0


def test_stuck_lab_wheel_carries_what_the_road_asks():
    """While stuck, the force on the lever includes the brake's reaction: T = r1 mu Fn, Fn = (Mg + T)/arm, iterated
    here to its fixed point."""
    rig = LabRig()
    mu = float(RIG.friction(1.0))
    arm = 0.37 * (np.sin(np.radians(65.61)) - mu * np.cos(np.radians(65.61)))
    torque = 0.0
    for _ in range(200):
        torque = 0.0995 * mu * (19.6181 + torque) / arm
    _, normal, carried = rig.contact(LabRigState(0.0, 100.0, 9.0, 0.0))
    np.testing.assert_allclose(carried, torque, rtol=1e-12, atol=0)
    np.testing.assert_allclose(normal, (19.6181 + torque) / arm, rtol=1e-12, atol=0)


@killed_by("parts.plants.lab_rig", "wheel = jnp.where(rests, 0.0, wheel)", "wheel = jnp.where(rests, wheel, wheel)")
@pytest.mark.slow
def test_a_stuck_lab_wheel_stays_at_rest():
    """Exactly, on a thousand roads: a rate of 1e-16, the rounding of a torque that balances another, would turn it,
    and a wheel that turns feels all of the brake."""
    grip = jnp.linspace(0.1, 0.6, 1000)
    rates = jax.vmap(
        lambda w4: LabRig(road=RationalCurve(w4=w4)).derivative(0.0, LabRigState(0.0, 100.0, 9.0, 0.0), 0.9)
    )
    assert np.all(np.asarray(rates(grip).wheel) == 0)
    assert LabRig().derivative(0.0, LabRigState(0.0, 100.0, 0.0, 0.0), 0.0).wheel > 0  # without a brake it turns


# Mechanics of every plant


def states(plant, count=60):
    """Seeded states of sliding wheels, braked and driven; their speeds, rim speeds and slips."""
    speed, rim, place = np.random.default_rng(5).uniform([[0.5], [0.5], [9.9]], [[40.0], [40.0], [10.1]], (3, count))
    start = jax.vmap(plant.start)(BrakeStart(speed=speed, slip=1 - rim / speed))
    return start._replace(distance=place), speed, rim, (speed - rim) / np.maximum(speed, rim)


@killed_by(
    "parts.plants.wheel",
    "return quotient(speed - wheel_speed,",
    "return quotient(wheel_speed - speed,",
    case="quarter car",
)
@pytest.mark.parametrize("name", cases(PLANTS, *set(PLANTS) - {"quarter car", "lab rig", "mirrored rig"}))
def test_energy_only_goes_into_friction(name):
    """With the brake released, dE/dt = -Fn mu (v - w) - bearing friction <= 0."""
    plant = PLANTS[name]
    x, speed, rim, slip = states(plant)

    @jax.jit
    @jax.vmap
    def power(state):
        return jax.jvp(plant.energy, (state,), (plant.derivative(0.0, state, 0.0),))[1]

    mu = np.asarray(jax.jit(jax.vmap(plant.road.friction))(slip, speed, x.distance))
    bearing = 0.0
    if isinstance(plant, LabRig):
        torque = plant.wheel_stiction + plant.wheel_friction * x.wheel
        arm = plant.lever * (np.sin(plant.lever_angle) - mu * np.cos(plant.lever_angle))
        load = (plant.weight_torque + torque) / arm
        bearing = torque * x.wheel + (plant.drum_stiction + plant.drum_friction * x.drum) * x.drum
    elif isinstance(plant, RoadVehicle):
        load = plant.wheel_load
        bearing = plant.bearing * x.spin**2 + plant.drag * speed**3 + plant.rolling * plant.mass * GRAVITY * speed
    else:
        load = plant.mass * GRAVITY
    expected = -load * mu * (speed - rim) - bearing
    np.testing.assert_allclose(power(x), expected, rtol=1e-10, atol=1e-10 * np.max(np.abs(expected)))
    assert np.all(expected <= 0)


@jax.jit
def held_slip_rate(plant, speed, target):
    """d(slip)/dt under the input that `holding` gives; the lab rig's brake then has its steady torque."""
    state = plant.start(BrakeStart(speed=speed, slip=target))
    control = plant.holding(plant.output(state), target)
    if isinstance(plant, LabRig):
        state = state._replace(brake=plant.brake_gain * control + plant.brake_offset)
    return jax.jvp(lambda x: plant.output(x).slip, (state,), (plant.derivative(0.0, state, control),))[1]


@killed_by(
    "parts.plants.quarter_car",
    "self.mass * self.radius + (1 - target) * self.inertia / self.radius",
    "self.mass * self.radius",
    case="25.0-0.2-quarter car",
)
@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize(("speed", "target"), [(25.0, 0.2), (3.0, 0.08), (12.0, 0.9)])
def test_holding_holds_the_slip(name, speed, target):
    scale = abs(float(slip_rate(PLANTS[name], speed, target, 0.0)))  # with the brake released
    assert scale > 0.01
    np.testing.assert_allclose(held_slip_rate(PLANTS[name], speed, target), 0.0, rtol=0, atol=1e-12 * scale)


@killed_by(
    "parts.plants.wheel",
    "return jnp.where(jnp.greater(speed, 0), rate, larger(rate, 0.0))",
    "return rate",
    case="mirrored rig",
)
@pytest.mark.parametrize("name", PLANTS)
def test_a_stopped_wheel_stays_stopped_until_released(name):
    """It sticks while the brake can carry the road's torque, here up to a hair, and turns again below."""
    plant = PLANTS[name]
    state = plant.start(BrakeStart(speed=10.0, slip=1.0))
    mu = float(plant.road.friction(1.0, 10.0, 0.0))
    spin = "spin" if isinstance(plant, QuarterCar | RoadVehicle) else "wheel"

    def wheel_rate(brake):
        if isinstance(plant, LabRig):  # its control is a command, its torque a state
            return getattr(plant.derivative(0.0, state._replace(brake=brake), 0.0), spin)
        return getattr(plant.derivative(0.0, state, brake), spin)

    if isinstance(plant, LabRig):
        arm = plant.lever * (np.sin(plant.lever_angle) - mu * np.cos(plant.lever_angle))
        asked = plant.wheel_radius * mu * plant.weight_torque / (arm - plant.wheel_radius * mu) - plant.wheel_stiction
    else:
        load = plant.wheel_load if isinstance(plant, RoadVehicle) else plant.mass * GRAVITY
        asked = mu * load * (plant.wheel_radius if isinstance(plant, MirroredRig) else plant.radius)
    for brake in (1.001 * asked, 5 * asked):
        np.testing.assert_allclose(wheel_rate(brake), 0.0, rtol=0, atol=1e-11)
    inertia = plant.inertia if isinstance(plant, QuarterCar | RoadVehicle) else plant.wheel_inertia
    released = wheel_rate(0.0)
    # the brake of the lab rig also loads the contact, so its released wheel is slower than this
    low, high = (0.5, 1.0) if isinstance(plant, LabRig) else (1 - 1e-12, 1 + 1e-12)
    assert low * asked / inertia <= released <= high * asked / inertia
    assert 0 < wheel_rate(0.999 * asked) < 0.01 * released


@killed_by("parts.plants.wheel", "jnp.where(jnp.greater(speed, STANDSTILL_SPEED), speed, 0.0)", "speed", case="plant0")
@killed_by("parts.plants.wheel", "jnp.greater(speed, STANDSTILL_SPEED)", "jnp.greater(speed, 0)", case="plant0")
@pytest.mark.parametrize("plant", [QuarterCar(road=SNOW), MirroredRig(road=DRY_ASPHALT), LabRig()])
def test_projection(plant):
    """Speeds below zero, and those that rounding leaves at standstill, become zero, the rest stays."""
    state = plant.start(BrakeStart(speed=10.0, slip=0.3))
    assert plant.project(state) == state
    rounded = plant.project(type(state)(*(1e-17 for _ in state)))
    assert [name for name, x in rounded._asdict().items() if x != 0] == [
        name for name in state._fields if name in ("distance", "brake")
    ]
    backwards = type(state)(*(-1.0 - jnp.arange(float(len(state)))))
    expected = [x if name in ("distance", "brake") else 0.0 for name, x in backwards._asdict().items()]
    np.testing.assert_allclose(plant.project(backwards), expected, rtol=0, atol=0)


def test_load_does_not_change_a_cars_deceleration():
    """mu g: what the papers' eq. (8) says of any mass."""
    heavy = dataclasses.replace(QuarterCar(), mass=1500.0)
    decelerations = [c.output(c.start(BrakeStart(slip=0.2))).deceleration for c in (QuarterCar(), heavy)]
    np.testing.assert_allclose(decelerations[0], decelerations[1], rtol=1e-15, atol=0)


@pytest.mark.slow
@killed_by("parts.plants.road_vehicle", "self.drag * v * v + self.rolling", "self.drag * v + self.rolling")
@killed_by("parts.plants.road_vehicle", "self.wheel_load * mu", "self.mass * GRAVITY * mu")
def test_a_locked_road_vehicle_stops_in_closed_form():
    """v' = -(a + c v^2/m) with a = (Fz mu + f m g)/m: time and distance from 30 to 3 m/s."""
    ice = Tabulated(slip=(0.0, 0.1, 0.5, 1.0), mu=(0.0, 0.3, 0.3, 0.3))
    car = RoadVehicle(road=ice, wheel_load=6000.0, drag=2.0, rolling=0.02)
    with jax.enable_x64(True):
        loop = braking(
            plant=car,
            initial=BrakeStart(speed=30.0, slip=1.0),
            controller=ConstantTorque(torque=5000.0),
            stop=SpeedReached(speed=3.0),
        )
        run = rollout(loop, FixedStep(1e-2, 20.0), BRAKING)
    a, c = (6000.0 * 0.3 + 0.02 * 440.0 * GRAVITY) / 440.0, 2.0 / 440.0
    k = np.sqrt(c / a)
    time, way = (np.arctan(30 * k) - np.arctan(3 * k)) / np.sqrt(a * c), np.log((a + 900 * c) / (a + 9 * c)) / (2 * c)
    np.testing.assert_allclose([run.metrics["stop_time"], run.metrics["stop_distance"]], [time, way], rtol=1e-7)
