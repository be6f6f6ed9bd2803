"""The two-wheeler against published numbers, a Lagrangian in Cartesian coordinates, SciPy, and its energy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from mutants import killed_by
from oracles import arm_rates
from scipy.integrate import solve_ivp

from diffabs.core.pytree import canonical_dtypes, replace
from diffabs.engine.solvers import FixedStep
from diffabs.engine.step.runge_kutta import rk4_step
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.recoverable import transmission_zeros
from diffabs.linear.regulator import lqr
from diffabs.linear.slip_model import Sampling
from diffabs.loop.run import measure
from diffabs.parts.objectives import PeakArmAngle, PeakVoltage
from diffabs.parts.plants import ACROBOT, ArmBalance, BalanceStart, PrintedArm
from diffabs.parts.plants.arm_balance import ArmState
from diffabs.scenario.defaults import balancing

ARM, HANGING = ArmBalance(), ArmBalance(arm_length=-0.5)
POINT = ArmState(0.5, 0.3, 0.2, 0.1, -0.4, 0.7)
FREE = ArmBalance(stiffness=0.0, damping=0.0, friction=0.0, back_emf=0.0)  # no torque without a voltage
GEARED = ArmBalance(torque_constant=0.3, back_emf=0.3, gear=100.0, rotor_inertia=2e-4)
COUNT = 1000


def states(seed, count=COUNT):
    """Anywhere around the circle, up to 5 rad/s."""
    spread = np.array([[np.pi]] * 3 + [[5.0]] * 3)
    return ArmState(*(spread * np.random.default_rng(seed).uniform(-1, 1, (6, count))))


def after(plant, start, step, count):
    """The state after RK4 steps under no voltage, and the energy's change, the largest on the way (2,)."""

    @jax.jit
    def run(plant, x):
        def body(carry, _):
            x, worst = carry
            x = rk4_step(lambda t, x: plant.derivative(t, x, 0.0), 0.0, x, step)
            return (x, jnp.maximum(worst, jnp.abs(plant.energy(x) - first))), None

        first = plant.energy(x)
        return jax.lax.scan(body, (x, 0.0 * first), length=count)[0]

    return run(*canonical_dtypes((plant, start)))


def model(plant):
    return (np.asarray(x) for x in BalanceModel(plant=plant).matrices())


# Numbers of an independent computation, to the digits that it gives


def test_lumps():
    np.testing.assert_allclose(ARM.lumps(), (48.7, 6.7, 24, 7, 21, 67, 10, 30), rtol=1e-15, atol=0)
    np.testing.assert_allclose(HANGING.lumps(), (48.7, 6.7, 24, -7, 21, 67, -10, 30), rtol=1e-15, atol=0)


def test_accelerations_at_a_point():
    found = ARM.derivative(0.0, POINT, 10.0)
    np.testing.assert_array_equal(found[:3], POINT[3:])
    np.testing.assert_allclose(found[3:], (6.0362858153, 31.2761257392, -14.5647715164), rtol=0, atol=6e-11)


def test_energy_is_kept_without_torque_and_damper():
    """4.1e-6 J of 880 J over 5 s at 1 ms: RK4's own error."""
    assert float(FREE.energy(POINT)) == pytest.approx(879.9195655465, abs=1e-10)
    _, worst = after(FREE, POINT, 1e-3, 5000)
    assert 1e-6 < float(worst) < 1e-5
    assert float(after(FREE, POINT, 5e-4, 10000)[1]) < float(worst) / 12  # 2^5 for an energy, of fourth order at least


def test_the_fall_of_the_papers_start():
    """Fourth order: 1 ms leaves 1e-9 of rates of 2.6 rad/s."""
    start = ArmState(0.5, 0.0, 0.2, 0.0, 0.0, 0.0)
    state, _ = after(ARM, start, 1e-3, 500)
    known = (1.1721997098, -0.0099741155, -0.0613621720, 2.5748449443, -0.0083005846, 0.0840182452)
    np.testing.assert_allclose(state, known, rtol=0, atol=2e-9)
    torque = lambda t, x: -(ARM.torque_constant * ARM.back_emf / ARM.resistance + ARM.friction) * x[4]  # noqa: E731
    run = solve_ivp(arm_rates(ARM, torque), (0, 0.5), start, "DOP853", rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(state, run.y[:, -1], rtol=0, atol=2e-9)


@pytest.mark.slow
def test_published_gain_of_the_acrobot():
    """Spong's, with Q = I and R = 1, of frame and arm; the rider without mass is a state of its own."""
    a, b = model(ACROBOT)
    part = [0, 1, 3, 4]
    assert np.all(a[np.ix_(part, [2, 5])] == 0)
    gain = lqr(a[np.ix_(part, part)], b[part], np.eye(4), np.eye(1)).gain[0]
    np.testing.assert_allclose(-gain, (-246.48129, -98.690342, -106.464047, -50.138071), rtol=1e-8, atol=0)


# Mechanics


def lagrangian(p, q, rates):
    """From where the three bodies are: centres of mass in the plane, angles from the vertical. Nothing of the lumps."""

    def bodies(q):
        def along(angle, length):
            return length * jnp.stack([jnp.sin(angle), jnp.cos(angle)])

        frame, arm, rider = q[0], q[0] + q[1], q[0] + q[2]
        mount = along(frame, p.mount_height)
        places = (along(frame, p.body_height), mount + along(arm, p.arm_length), mount + along(rider, p.rider_height))
        return jnp.stack(places), jnp.stack([frame, arm, rider])

    (places, _), (speeds, spins) = jax.jvp(bodies, (q,), (rates,))
    masses = jnp.stack([p.body_mass, p.arm_mass, p.rider_mass])
    inertias = jnp.stack([p.body_inertia, p.arm_inertia, p.rider_inertia])
    rotor = 0.5 * p.gear**2 * p.rotor_inertia * rates[1] ** 2
    kinetic = 0.5 * (masses @ jnp.sum(speeds**2, axis=1) + inertias @ spins**2) + rotor
    return kinetic - masses @ places[:, 1] * p.gravity - 0.5 * p.stiffness * q[2] ** 2


@killed_by(
    "parts.plants.arm_balance",
    "r2 = torque - c2 * sin2 * v1**2 + arm",
    "r2 = torque - c2 * sin2 * v1**2 - arm",
    case="upright",
)
@pytest.mark.parametrize(
    "plant",
    [
        pytest.param(ARM, id="upright"),
        *(
            pytest.param(plant, id=name, marks=pytest.mark.slow)
            for name, plant in (("hanging", HANGING), ("geared", GEARED))
        ),
    ],
)
def test_the_closed_form_is_lagranges_equation(plant):
    """M q'' = force + dL/dq - (d2L/dq'dq) q', M = d2L/dq'2. Both round at 1e-16 times the condition of M, about 20."""
    x, torque = states(1), np.random.default_rng(2).uniform(-500, 500, COUNT)

    @jax.jit
    def euler_lagrange(p, q, rates, torque):
        mass = jax.hessian(lagrangian, 2)(p, q, rates)
        by_both = jax.jacfwd(jax.grad(lagrangian, 2), 1)(p, q, rates)
        force = jnp.stack([0.0, torque, -p.damping * rates[2]])
        return jnp.linalg.solve(mass, force + jax.grad(lagrangian, 1)(p, q, rates) - by_both @ rates)

    plant = canonical_dtypes(plant)
    q, rates = np.stack(x[:3], axis=1), np.stack(x[3:], axis=1)
    expected = jax.vmap(euler_lagrange, (None, 0, 0, 0))(plant, q, rates, torque).T
    found = jax.jit(lambda p, x, torque: p.accelerations(x, torque))(plant, x, torque)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * float(np.max(np.abs(expected))))


@killed_by("parts.plants.arm_balance", "c2 * sin2 * v2 * (2 * v1 + v2)", "c2 * sin2 * v2 * (v1 + v2)", case="hanging")
@pytest.mark.parametrize("plant", [ARM, HANGING, GEARED], ids=["upright", "hanging", "geared"])
def test_motor_and_damper_power_is_the_change_of_energy(plant):
    """Here as tau psi' - d phi'^2, with the torque of eq. (11) by hand, relative to the largest term."""
    x, volts = states(3), np.random.default_rng(4).uniform(-50, 50, COUNT)

    @jax.jit
    def change(p, x, u):
        return jax.vmap(lambda x, u: jax.jvp(p.energy, (x,), (p.derivative(0.0, x, u),))[1])(x, u)

    p = plant
    tau = (
        p.gear * p.torque_constant * (volts - p.gear * p.back_emf * x.psi_rate) / p.resistance - p.friction * x.psi_rate
    )
    terms = tau * x.psi_rate, p.damping * x.phi_rate**2
    found = change(*canonical_dtypes((plant, x, volts)))
    gravity = np.max(np.abs(x.theta_rate)) * p.gravity * 107  # the largest rate of an energy that is only exchanged
    np.testing.assert_allclose(found, terms[0] - terms[1], rtol=0, atol=1e-12 * max(gravity, np.max(np.abs(terms))))


@killed_by(
    "parts.plants.arm_balance",
    "current = clamp(current, -self.current_max, self.current_max)",
    "current = clamp(current, -np.inf, np.inf)",
)
def test_torque_ends_at_the_current_limit():
    motor = dataclasses.replace(GEARED, current_max=7.0)
    most, rate = 100 * 0.3 * 7.0, 0.5
    for volts, torque in ((1e4, most), (-1e4, -most), (33.0, 30 * (33.0 - 15.0) / 3)):
        np.testing.assert_allclose(motor.torque(rate, volts), torque - 0.02 * rate, rtol=1e-14, atol=0)
    assert float(jax.grad(motor.torque, 1)(rate, 1e4)) == 0.0


def test_float32_is_as_good_as_its_digits():
    """24 bits; the Schur complement loses less than a factor of 100."""
    x = states(5)
    exact = np.array(jax.jit(ARM.derivative)(0.0, x, 10.0))
    single, y, volts = jax.tree.map(jnp.float32, (ARM, x, 10.0))
    rounded = jax.jit(single.derivative)(0.0, y, volts)
    assert {part.dtype for part in rounded} == {jnp.dtype("float32")}
    scale = np.max(np.abs(exact), axis=1, keepdims=True)
    np.testing.assert_allclose(np.array(rounded) / scale, exact / scale, rtol=0, atol=100 * 2.0**-24)


@killed_by("parts.plants.arm_balance", "self.rider_mass > 0 and not", "not")
def test_a_rider_without_mass_needs_no_spring():
    assert list(ACROBOT.cautions()) == []


# The paper's printed equations


def gravity_matrix(plant):
    """M times the accelerations' slope in the angles, without spring: d(forces)/dq, which is symmetric in mechanics."""
    a, _ = model(plant)
    m11 = 48.7 + 6.7 + 24 + 2 * 7 + 2 * 21
    mass = np.array([[m11, 13.7, 45.0], [13.7, 6.7, 0.0], [45.0, 0.0, 24.0]])
    return mass @ a[3:, :3]


@killed_by(
    "parts.plants.printed_arm",
    "m.gravity * b2 * (theta - psi), m.gravity * b3 * (theta - phi)",
    "m.gravity * b2 * (theta + psi), m.gravity * b3 * (theta + phi)",
)
def test_printed_gravity_is_no_machines():
    right, printed = gravity_matrix(FREE), gravity_matrix(PrintedArm(machine=FREE))
    np.testing.assert_allclose(right, right.T, rtol=0, atol=1e-11 * np.max(right))
    np.testing.assert_allclose(right, 9.81 * np.array([[107, 10, 30], [10, 10, 0], [30, 0, 30]]), rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        printed, 9.81 * np.array([[107, -10, -30], [10, -10, 0], [30, 0, -30]]), rtol=0, atol=1e-9
    )


@pytest.mark.slow
def test_fig_3_is_that_of_the_printed_equations():
    """Every angle returns, after 4.37 rad of the arm and 479 V; 1 ms and less than 3 s find both peaks."""
    plant = PrintedArm()
    gain = lqr(*model(plant), np.eye(6), np.eye(1)).gain[0]
    loop = dataclasses.replace(
        replace(balancing(), {"actuator.high": 1e6, "controller.gain": np.asarray(gain)}),
        plant=plant,
        initial=BalanceStart(theta=0.5, phi=0.2),
    )
    seen = measure(loop, FixedStep(step=1e-3, duration=3.0), {"arm": PeakArmAngle(), "volts": PeakVoltage()})
    assert not seen.stopped
    assert float(seen.metrics["arm"]) == pytest.approx(4.37, abs=0.005)
    assert float(seen.metrics["volts"]) == pytest.approx(479, abs=0.5)


# About upright


ROWS = [
    (12.9180668385, -4.45395728949, 70.2901931216, 0, 26.6593633961, 8.14807608114),
    (-11.7727635355, 23.7491365472, -143.727708323, 0, -99.2915341084, -16.6609913898),
    (-11.9588753223, 8.35116991779, -161.19827877, 0, -49.9863063677, -19.4443093188),
]


def test_linear_model():
    a, b = model(ARM)
    np.testing.assert_array_equal(a[:3], np.hstack([np.zeros((3, 3)), np.eye(3)]))
    np.testing.assert_allclose(a[3:], ROWS, rtol=6e-12, atol=1e-11)
    np.testing.assert_allclose(b[:, 0], (0, 0, 0, -0.888586207456, 3.30949717047, 1.66609913898), rtol=6e-12, atol=0)


@pytest.mark.parametrize(
    ("plant", "known", "digits"),
    [
        (ARM, (-108.06522648, -5.48266737 + 7.0849418j, -2.79102448, 0.29783666, 2.78790563), 6e-8),
        (HANGING, (-44.476, -9.722 + 7.845j, -2.8068, -0.3632, 2.84055), 5.1e-4),
    ],
    ids=["upright", "hanging"],
)
def test_poles(plant, known, digits):
    poles = np.sort_complex(np.linalg.eigvals(next(model(plant))))
    np.testing.assert_allclose(poles[poles.imag >= 0], known, rtol=0, atol=digits)


@pytest.mark.parametrize(
    ("plant", "q", "r", "known"),
    [
        (ARM, (1, 1, 1, 1, 1, 1), 1.0, (24208.064, 2293.1921, 7667.1, 8683.2995, 889.36867, 2860.7285)),
        (HANGING, (1, 100, 1, 1, 1, 1), 0.01, (3518.9528, -300.78828, 1397.0168, 1242.2936, -10.830832, 516.96042)),
    ],
    ids=["upright", "hanging"],
)
def test_gains(plant, q, r, known):
    """Eight digits are printed."""
    gain = lqr(*model(plant), np.diag(q).astype(float), r * np.eye(1)).gain[0]
    np.testing.assert_allclose(gain, known, rtol=5e-8, atol=0)


def test_the_zero_that_nearly_cancels_the_unstable_pole():
    """Where [[A - s I, B], [c', 0]] loses rank, by SciPy; its infinite eigenvalues are not zeros."""
    a, b = model(ARM)
    c = np.eye(6)[:1]
    pencil = np.block([[a, b], [c, np.zeros((1, 1))]])
    values = scipy.linalg.eigvals(pencil, np.diag([1.0] * 6 + [0.0]))
    finite, found = (
        np.sort_complex(x[(np.abs(x) < 1e4) & (x.imag >= 0)]) for x in (values, transmission_zeros(a, b, c[0]))
    )
    np.testing.assert_allclose(found, finite, rtol=1e-9, atol=0)
    assert np.max(found.real) == pytest.approx(np.sqrt(98.1 / 13.7), rel=1e-10)


@killed_by("linear.recoverable", "a @ complement - np.outer", "a @ complement + np.outer")
@killed_by("linear.recoverable", "> ROUNDING * size * np.linalg.norm(b)", "> 0.0 * size")
def test_a_slow_zero_is_found_in_any_basis():
    """(s + 1e-6)/((s + 1)(s + 2)(s + 3)(s + 4)) in random coordinates of the state: the relative degree is 3."""
    a, b, c = np.eye(4, k=1), np.eye(4)[:, 3:], np.array([1e-6, 1.0, 0.0, 0.0])
    a[3] = -np.poly([-1.0, -2.0, -3.0, -4.0])[:0:-1]
    random = np.random.default_rng(0)
    for basis in random.normal(size=(100, 4, 4)):
        inverse = np.linalg.inv(basis)
        found = transmission_zeros(basis @ a @ inverse, basis @ b, c @ inverse)
        assert found == pytest.approx([-1e-6], abs=1e-12 * np.linalg.cond(basis) ** 2)
    for factor, output in ((1, 0 * c), (0, c)):  # without influence
        assert transmission_zeros(a, factor * b, output).shape == (0,)


@pytest.mark.parametrize("period", [1e-3, 0.02])
def test_a_sampled_model_is_the_exact_one(period):
    """e^(A T) and the input held over T, by SciPy's exponential of both together."""
    a, b = model(HANGING)
    whole = scipy.linalg.expm(period * np.block([[a, b], [np.zeros((1, 7))]]))
    sampled = BalanceModel(plant=HANGING, sampling=Sampling(period=period)).matrices()
    np.testing.assert_allclose(sampled.A, whole[:6, :6], rtol=0, atol=1e-13)
    np.testing.assert_allclose(sampled.B, whole[:6, 6:], rtol=0, atol=1e-14)
