"""Linear slip models against the paper's formulas, SciPy, finite differences, and the real loops."""

from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from mutants import killed_by
from scipy.signal import cont2discrete

import diffabs as d
from diffabs.core.blocks import Direct, Series
from diffabs.core.protocols import BrakeOutput, Clock, no_flow, no_memory
from diffabs.core.pytree import canonical_dtypes, param, pytree, replace
from diffabs.core.validity import check_part
from diffabs.engine.step.runge_kutta import rk4_step
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.linearization import linearize, tracking_dynamics
from diffabs.linear.opened_loop import open_loop
from diffabs.linear.operating_point import loop_gain, operating_point
from diffabs.linear.slip_model import LowPass, Sampling, SlipModel
from diffabs.loop.closed_loop import Loop
from diffabs.parts.actuators import AsymmetricLag, Delay, Lag, Limits, RateLimit
from diffabs.parts.controllers import (
    PID,
    BackCalculation,
    ConstantTorque,
    HoldingInput,
    ProportionalFeedback,
    Relay,
    Sampled,
    SlidingMode,
    StateFeedback,
)
from diffabs.parts.plants import BrakeStart, LabRig, MirroredRig, QuarterCar
from diffabs.parts.references import FilteredSlip, FixedSlip, Setpoint
from diffabs.parts.roads import WET_ASPHALT, Burckhardt, PiecewiseLinear
from diffabs.parts.sensors import Bias, WheelSpeed
from diffabs.parts.stops import NoStop
from diffabs.robust.design.state_feedback import reduce_loop
from diffabs.scenario.defaults import braking

K = 1 / 3.6
R1, R2, J1, G = 0.0995, 0.099, 7.53e-3, 9.81
BETA = 133.472842636189
ALPHA = {5.3: 83.8796606703, 6.2: 84.6321445666}


def alpha_beta(mass, slip, road):
    """Eq. (17), with mu' of eq. (13) by hand."""
    a, q, w = road.a, road.q, (road.w1, road.w2, road.w3, road.w4)
    mu = w[3] * slip**q / (a + slip**q) + w[2] * slip**3 + w[1] * slip**2 + w[0] * slip
    steep = w[3] * a * q * slip ** (q - 1) / (a + slip**q) ** 2 + 3 * w[2] * slip**2 + 2 * w[1] * slip + w[0]
    load, j2 = mass * G, 0.5 * mass * R2**2
    return (
        -(R1**2 / (J1 * R2) * load * steep + ((1 - slip) * steep - mu) * load * R2 / j2),
        R1 / (J1 * R2),
    )


quick = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})  # compiles twice as fast


@pytest.mark.parametrize(("mass", "slip", "speed"), [(5.3, 0.2, 50 * K), (6.2, 0.2, 5 * K), (6.0, 0.35, 3.0)])
def test_rig_is_equation_21(mass, slip, speed):
    model = SlipModel(plant=MirroredRig(mass=mass), slip=slip, speed=speed)
    alpha, beta = alpha_beta(mass, slip, model.plant.road)
    omega = speed / R2
    a, b = model.matrices()
    np.testing.assert_allclose(a, [[0, 1], [0, alpha / omega]], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(b, [[0], [beta / omega]], rtol=1e-12, atol=0)
    if slip == 0.2:
        np.testing.assert_allclose([alpha, beta], [ALPHA[mass], BETA], rtol=1e-11)
    assert model.states == ("integral of slip error", "slip error")
    assert model.period is None
    assert a.dtype == b.dtype == jnp.float64


@killed_by("linear.linearization", "jax.jvp(chart, (x,), (flow(x, u),))[1]", "by_x @ flow(x, u)")
def test_quarter_car_by_hand():
    """slip' = ((1 - s) v' - r omega')/v at a frozen v, and mu' of Burckhardt's curve, by hand."""
    r, m, j, s, v, road = 0.2, 15.0, 1.04456, 0.1, 12.0, WET_ASPHALT
    fade, low = np.exp(-road.c4 * s * v), np.exp(-road.c2 * s)
    mu = (road.c1 * (1 - low) - road.c3 * s) * fade
    steep = (road.c1 * road.c2 * low - road.c3) * fade - road.c4 * v * mu
    expected = (-r * r * steep * m * G / j - (1 - s) * steep * G + mu * G) / v
    car = QuarterCar(mass=m, radius=r, inertia=j, road=road)
    a, b = SlipModel(plant=car, slip=s, speed=v, integral=False).matrices()
    np.testing.assert_allclose(a, [[expected]], rtol=1e-12)
    np.testing.assert_allclose(b, [[r / j / v]], rtol=1e-12)


def differences(function, z, h):
    return np.stack([(function(z + d) - function(z - d)) / (2 * h) for d in h * np.eye(len(z))], axis=1)


@pytest.mark.parametrize(
    "plant",
    [
        pytest.param(QuarterCar(road=WET_ASPHALT), id="car"),
        pytest.param(LabRig(), id="lab rig", marks=pytest.mark.slow),
    ],
)
def test_linearize_against_differences(plant):
    state = plant.start(BrakeStart(speed=11.0, slip=0.15))
    x, unravel = ravel_pytree(jax.tree.map(float, state))
    control = {QuarterCar: 20.0, LabRig: 0.7}[type(plant)]
    flow = quick(lambda x, u: ravel_pytree(plant.derivative(0.0, unravel(x), u[0]))[0])
    a, b = quick(linearize)(plant, state, control)
    u = jnp.array([control])
    np.testing.assert_allclose(a, differences(lambda x: flow(x, u), x, 1e-5), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(b, differences(lambda u: flow(x, u), u, 1e-5), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("brake", [1.0, 4.0])
@pytest.mark.slow
def test_tracking_away_from_equilibrium(brake):
    """The lab rig, its brake anywhere: rates of slip and brake by finite differences in those coordinates, at a fixed
    drum speed, from the derivative of slip = 1 - r1 w1/(r2 w2) by the quotient rule."""
    rig, drum, control = LabRig(), 100.0, 0.7

    @jax.jit
    def rates(z, u):
        s, m = z
        wheel = (1 - s) * rig.drum_radius * drum / rig.wheel_radius
        state = type(rig.start(BrakeStart()))(wheel, drum, m, 0.0)
        rate = rig.derivative(0.0, state, u[0])
        ratio = rig.wheel_radius / rig.drum_radius
        return jnp.stack([-ratio * (rate.wheel * drum - wheel * rate.drum) / drum**2, rate.brake])

    z, u = jnp.array([0.15, brake]), jnp.array([control])
    state = rig.start(BrakeStart(speed=rig.drum_radius * drum, slip=0.15))._replace(brake=brake)
    a, b = quick(tracking_dynamics)(rig, state, control)
    np.testing.assert_allclose(a, differences(lambda z: rates(z, u), z, 1e-6), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(b, differences(lambda u: rates(z, u), u, 1e-6), rtol=1e-6, atol=1e-8)


@killed_by("linear.linearization", "(narrow * NARROWER**KINK_POWER > wide) & ", "(wide < 0.0) & ")
@killed_by("linear.linearization", "jnp.where(kinked, jnp.nan, x)", "jnp.where(kinked, x, x)")
@pytest.mark.slow
def test_no_slip_model_at_a_knot_of_the_friction():
    """Where the slope is 0.6 below and -0.4 above, at slip 0.2; close to the knot each side has its own model."""
    rig = MirroredRig(road=PiecewiseLinear())
    speeds = np.array([3.0, 5.0, 7.0, 13.9])

    @quick
    def rates(slip):
        return jax.vmap(lambda v: SlipModel(plant=rig, slip=slip, speed=v, integral=False).matrices().A[0, 0] * v)(
            speeds
        )

    load, j2 = rig.mass * G, 0.5 * rig.mass * R2**2
    for slip, steep in ((0.2 - 1e-4, 0.6), (0.2 + 1e-4, -0.4)):
        mu = 1.0 + steep * (slip - 0.2)
        alpha = -(R1**2 / (J1 * R2) * load * steep + ((1 - slip) * steep - mu) * load * R2 / j2)
        np.testing.assert_allclose(rates(slip), alpha * R2, rtol=1e-9)
    assert np.isnan(rates(0.2)).all()
    with pytest.raises(ValueError, match=r"^MirroredRig at slip 0\.2: a slope jumps here, at a kink: no linear model$"):
        SlipModel(plant=rig, integral=False).matrices()


@killed_by(
    "linear.slip_model",
    "nan_at_kink(model.with_memory(system), kinked), kinked",
    "model.with_memory(system), jnp.isnan(system.B).any()",
)
def test_a_speed_that_is_no_number_is_no_kink():
    assert np.isnan(SlipModel(speed=np.nan, integral=False).matrices().B).all()


FORCES = (  # of x, with the slope at 0; the last three are constant but for rounding
    (jnp.sin, 1.0),
    (lambda x: jnp.tanh(1e3 * x), 1e3),
    (lambda x: x**3, 0.0),
    (lambda x: 1e5 * jnp.maximum(x, 0.0) ** 1.5, 0.0),
    (lambda x: -0.1 * jnp.sign(x), np.nan),
    (lambda x: 1e-4 * jnp.sign(x) - x, np.nan),
    (jnp.abs, np.nan),
    (lambda x: jnp.maximum(x, 0.0), np.nan),
    *((lambda x, at=at: 1e9 * (jnp.cos(x + at) ** 2 + jnp.sin(x + at) ** 2), 0.0) for at in (0.5, 1.2, 1.5)),
)


@pytree
class Sled:
    """x' = u + the weighted forces."""

    weights: Any = param(default=0.0, unit="1")

    def derivative(self, t, state, control):
        del t
        return control + self.weights @ jnp.stack([force(state) for force, _ in FORCES])


@killed_by("linear.linearization", "bent | (", "bent | False & (")
@killed_by("linear.linearization", "MAX_SLOPE_GROWTH = 1.5", "MAX_SLOPE_GROWTH = 0.9")
@killed_by("linear.linearization", "KINK_POWER = 1.1", "KINK_POWER = 1.6")
@killed_by("linear.linearization", "+ MAX_ROUNDINGS * rounding", "")
def test_a_jump_is_a_kink_and_a_power_of_1_5_is_none():
    """Dry friction at rest and a stop are kinks; Hertz contact, which has a slope everywhere, is none."""
    weights = np.eye(len(FORCES))
    found = quick(jax.vmap(lambda one: linearize(Sled(weights=one), 0.0, 0.0).A))(weights)
    np.testing.assert_allclose(found.ravel(), [slope for _, slope in FORCES], rtol=1e-12, atol=1e-6)


@killed_by("linear.linearization", "narrow * NARROWER / offset > counts", "narrow > 0.0")
@killed_by("linear.linearization", "NARROWER**KINK_POWER > wide", "NARROWER**3 > wide")
@pytest.mark.slow
def test_a_steep_curve_has_no_kink():
    """Friction that bends within a slip of 0.0001, or hardly at all."""
    slips = np.geomspace(1e-4, 0.5, 40)
    rig = MirroredRig(road=Burckhardt(c1=0.05, c2=1e4, c3=0.0))
    found = quick(jax.vmap(lambda slip: SlipModel(plant=rig, slip=slip, integral=False).matrices().A))(slips)
    assert np.isfinite(found).all()


class Temperature(NamedTuple):
    above: Any
    units = MappingProxyType({"above": "K"})


@pytree
class Oven:
    """x' = u - x, but u - 3 x above x = 1."""

    shows, control_unit = Temperature, "W"

    def start(self, initial):
        del initial
        return Temperature(jnp.asarray(0.5))

    def project(self, state):
        return state

    output = project

    def derivative(self, t, state, control):
        del t
        loss = jnp.where(state.above > 1.0, 3 * state.above - 2, state.above)
        return Temperature(control - loss)

    def holding(self, output, target):
        del output
        return jnp.where(target > 1.0, 3 * target - 2, target)


@pytree
class Hasty:
    """A command of 2 per unit of error, or 4 where the target is exceeded."""

    start, flow = no_memory, no_flow

    def output(self, t, memory, signal):
        del t, memory
        error = signal.target - signal.measured.above
        return signal.feedforward + jnp.where(error > 0, 2.0, 4.0) * error


@pytest.mark.slow
@killed_by("linear.operating_point", 'check_kink("the loop at its setpoint", linear.kinked)\n    if', "if")
@killed_by("linear.opened_loop", "plant and linear.kinked[0]", "False")
@killed_by(
    "linear.operating_point",
    "linear = _linearize_at_rest(model)\n    check",
    "return _linearize_at_rest(model)\n    check",
)
@killed_by("linear.opened_loop", "is_kinked(compute, moves, signal, inside)", "jnp.array(False)")
def test_no_linear_loop_at_a_kink():
    """Of the plant, the actuator, or the controller; nor where a lag rises and falls differently."""

    def loop(target, controller, **more):
        reference = Setpoint(value=target)
        return Loop(plant=Oven(), initial=(), reference=reference, controller=controller, stop=NoStop(), **more)

    kink = "at (the|its) setpoint: a slope jumps here, at a kink: no linear model$"
    pid = PID(kp=2.0, ki=1.0, low=-9.0, high=9.0)
    for target, pole in ((0.8, -1.0), (1.2, -3.0)):
        assert operating_point(loop(target, pid)).matrices().A[0, 0] == pytest.approx(pole)
        assert open_loop(loop(target, pid)).plant.A[0, 0] == pytest.approx(pole)
    with pytest.raises(ValueError, match=rf"^the loop {kink}"):
        operating_point(loop(1.0, pid))
    moved = replace(operating_point(loop(0.8, pid)), {"reference.value": 1.0})
    for ask in (moved.matrices, moved.gain, lambda: loop_gain(loop(1.0, pid), moved.states)):
        with pytest.raises(ValueError, match=rf"^the loop {kink}"):
            ask()
    lags = AsymmetricLag(rise=0.049, fall=0.001), AsymmetricLag(rise=0.01, fall=0.01)
    for one, names in (
        (loop(1.0, pid), "sensor Direct, plant Oven, actuator Direct"),
        (loop(0.8, pid, actuator=lags[0]), "sensor Direct, plant Oven, actuator AsymmetricLag"),
        (loop(0.8, Hasty(), feedforward=HoldingInput()), "controller Hasty"),
    ):
        with pytest.raises(ValueError, match=f"^{names} {kink}"):
            open_loop(one)
    assert np.sort(np.linalg.eigvals(open_loop(loop(0.8, pid, actuator=lags[1])).plant.A)) == pytest.approx([-100, -1])


@killed_by("linear.linearization", "check_kink(type(plant).__name__, kinked)", "pass")
def test_a_plant_at_a_kink_has_no_linear_model():
    with pytest.raises(ValueError, match=r"^Oven: a slope jumps here, at a kink: no linear model$"):
        linearize(Oven(), Temperature(1.0), 1.0)


@pytest.mark.slow
def test_tracking_needs_coordinates():
    car = QuarterCar()
    state = car.start(BrakeStart(speed=10.0, slip=0.1))
    for outputs, count in ((("speed", "wheel_speed", "distance"), 4), ((), 2)):
        with pytest.raises(ValueError, match=f"do not depend on are {count} coordinates of 3 states"):
            jax.eval_shape(lambda x, outputs=outputs: tracking_dynamics(car, x, 20.0, ("slip",), outputs), state)
    with pytest.raises(ValueError, match="slip, deceleration, distance are no coordinates here: they depend on each"):
        tracking_dynamics(QuarterCar(road=SlipOnly()), state, 20.0, ("slip",), ("deceleration", "distance"))


class SlipOnly:
    """A road whose friction the slip alone decides: then so is the deceleration."""

    def friction(self, slip, speed, distance):
        return 3.0 * slip


jax.tree_util.register_pytree_node(SlipOnly, lambda r: ((), ()), lambda s, c: SlipOnly())


@pytest.mark.slow
def test_lab_rig_rests_where_it_is_held():
    """The remaining state, the brake, where its own rate is zero; then the slip's is, too."""
    model = SlipModel(plant=LabRig(), speed=8.0)
    state, control = quick(SlipModel.point)(canonical_dtypes(model))
    rate = model.plant.derivative(0.0, state, control)
    assert abs(rate.brake) < 1e-12
    slip_rate = jax.jvp(lambda x: model.plant.output(x).slip, (state,), (rate,))[1]
    assert abs(slip_rate) < 1e-12
    assert rate.drum < -1
    assert model.states == ("integral of slip error", "slip error", "brake")
    a, b = model.matrices()
    assert a[0].tolist() == [0, 1, 0]
    np.testing.assert_allclose(a[2], [0, 0, -20.37], atol=1e-12)
    np.testing.assert_allclose(b[:, 0], [0, 0, 20.37 * 15.24], atol=1e-11)


def test_lag_is_a_state():
    a, b = SlipModel(actuator=Lag(time_constant=0.02)).matrices()
    plain = SlipModel().matrices()
    np.testing.assert_allclose(a[:2, :2], plain.A, rtol=1e-14)
    np.testing.assert_allclose(a[:, 2], [0, plain.B[1, 0], -50.0], rtol=1e-13)
    assert b[:, 0].tolist() == [0, 0, 50.0]


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 1.3e-3, 4e-3])
def test_sampling_against_scipy(delay):
    """SciPy's zero-order hold over the two parts of a period."""
    period, lag = 4e-3, 0.01
    model = SlipModel(speed=2.0, actuator=Lag(time_constant=lag), sampling=Sampling(period=period, delay=delay))
    a, b = model.matrices()
    c = SlipModel(speed=2.0, actuator=Lag(time_constant=lag), integral=False).matrices()
    c = [np.asarray(x) for x in c]
    (first, old), (second, new) = (
        cont2discrete((*c, np.eye(2), np.zeros((2, 1))), s)[:2] if s else (np.eye(2), np.zeros((2, 1)))
        for s in (delay, period - delay)
    )
    expected = np.zeros((4, 4))
    expected[0, :2] = 1, period
    expected[1:3, 1:3], expected[1:3, 3:] = second @ first, second @ old
    np.testing.assert_allclose(a, expected, rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(b[:, 0], [0, *new[:, 0], 1], rtol=1e-11, atol=1e-16)
    assert model.period == period
    assert model.states[2:] == ("actuator torque", "torque of the last sample")


class FrozenRig:
    """Eq. (14) for the default rig at a frozen omega2; the state is the slip."""

    def __init__(self, speed):
        self.speed = speed

    def start(self, initial):
        return jnp.asarray(initial.slip)

    def derivative(self, t, state, control):
        road, load, omega = MirroredRig().road, 5.3 * G, self.speed / R2
        mu = road.friction(state, self.speed, 0.0)
        j2 = 0.5 * 5.3 * R2**2
        friction = R1**2 / (J1 * R2) * load * mu + (1 - state) * load * R2 * mu / j2
        return -friction / omega + R1 / (J1 * R2 * omega) * control

    def output(self, state):
        return BrakeOutput(state, self.speed, (1 - state) * self.speed, 0.0, 0.0)

    def holding(self, output, target):
        return MirroredRig().holding(output._replace(deceleration=0.0), target)


jax.tree_util.register_pytree_node(FrozenRig, lambda r: ((), r.speed), lambda s, c: FrozenRig(s))
STEPS = 40


def one_period(loop, z, period):
    """(integral, slip, lag's torque, last sample's torque, [PID's filter]) a period later, in the real loop."""
    h = period / STEPS
    state = loop.start()
    flow = state.controller.held.inner.flow
    flow = flow._replace(integral=z[0], filtered=z[4]) if len(z) == 5 else z[0]
    held = state.controller.held
    held = held._replace(inner=held.inner._replace(flow=flow), applied=z[3], next=z[3])
    state = state._replace(
        plant=z[1],
        controller=state.controller._replace(held=held),
        actuator=state.actuator._replace(flow=z[2]),
    )

    def step(state, k):
        t, signals = k * h, loop.signals(k * h, state)
        margins = loop.margins(t, state, signals, lambda: loop.flow(t, state, signals))
        fired = jax.tree.map(lambda margin: margin < 1e-9, margins)  # the delay is a whole number of steps
        state = loop.change(Clock(t, h, k, None), state, signals, margins, fired)

        def rate(t, flow):
            at = state.with_flow(flow)
            return loop.flow(t, at, loop.signals(t, at))

        return state.with_flow(rk4_step(rate, k * h, state.flow(), h)), None

    state, _ = jax.lax.scan(step, canonical_dtypes(state), jnp.arange(STEPS))
    held = state.controller.held
    inner = held.inner.flow
    own = [inner.integral, inner.filtered] if len(z) == 5 else [inner]
    return jnp.stack([own[0], state.plant, state.actuator.flow, held.next, *own[1:]])


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 0.002])
@pytest.mark.parametrize(
    "controller",
    [
        pytest.param(StateFeedback(gain=np.array([-400.0, -30.0])), id="state feedback"),
        pytest.param(PID(kp=30.0, ki=400.0, kd=0.3, low=-np.inf, high=np.inf), id="pid"),
    ],
)
def test_sampled_loop_is_the_model(controller, delay):
    """The Jacobian of a period of the real sampled loop, eq. (14) at a frozen speed behind a lag, is A + B K."""
    period, speed = 0.004, 2.0
    sampled = Sampled(controller=controller, period=period, delay=delay)
    parts = {
        "feedforward": HoldingInput(),
        "controller": sampled,
        "actuator": Lag(),
        "initial": BrakeStart(speed=speed, slip=0.2),
    }
    reduced = reduce_loop(braking(plant=MirroredRig(), reference=FixedSlip(slip=0.2), **parts))
    loop = braking(plant=FrozenRig(speed), reference=FixedSlip(slip=0.2), **parts)
    tau = float(MirroredRig().holding(BrakeOutput(0.2, speed, 0.0, 0.0, 0.0), 0.2))
    pid = isinstance(controller, PID)
    z = jnp.array([0.0, 0.2, tau, tau] + [0.0] * pid)
    true = quick(jax.jacfwd(lambda z: one_period(loop, z, period)))(z)
    a, b = reduced.model.matrices()
    sign = np.diag([-1.0, 1, 1, 1, -1]) if pid else np.eye(4)  # a PID's integral and filter are of target - slip
    np.testing.assert_allclose(a + b @ reduced.gain[None], sign @ true @ sign, rtol=1e-8, atol=1e-12)
    assert reduced.exact


def modes(matrix):
    return np.linalg.eigvals(np.asarray(matrix))


CONTROLLERS = {
    "state feedback": (StateFeedback(), ["integral of slip error", "slip error"]),
    "proportional": (  # to the speed, here 9 m/s
        ProportionalFeedback(gain=np.array([-8000.0, -200.0])),
        ["integral of slip error", "slip error"],
    ),
    "p": (PID(kp=300.0, high=np.inf, low=0.0), ["slip error"]),
    "pi": (PID(kp=300.0, ki=900.0, low=0.0, high=90.0), ["integral of slip error", "slip error"]),
    "pd": (PID(kp=300.0, kd=4.0, low=0.0, high=90.0), ["slip error", "filtered slip error"]),
    "pid": (
        PID(kp=300.0, ki=900.0, kd=4.0, low=0.0, high=90.0),
        ["integral of slip error", "slip error", "filtered slip error"],
    ),
}


CASES = [
    *[("rig", "proportional", Direct()), ("car", "pid", Lag())],
    pytest.param("rig", "pid", RateLimit(), marks=pytest.mark.slow),
    *[pytest.param("rig", x, Direct(), marks=pytest.mark.slow) for x in CONTROLLERS if x != "proportional"],
]


@killed_by(
    "robust.design.state_feedback",
    "gain = gain * (model.speed / float(controller.reference_speed))",
    "gain = 1.0 * gain",
)
@pytest.mark.parametrize(("plant", "name", "actuator"), CASES)
def test_reduction_has_the_modes_of_the_loop(plant, name, actuator):
    """The real loop's flow in the coordinates (slip, speed, distance): held exactly, the slip's rate is zero at any
    speed, the Jacobian is block triangular, and the modes of A + B K are among its own."""
    controller, states = CONTROLLERS[name]
    plant = {"rig": MirroredRig(), "car": QuarterCar(road=Burckhardt(c4=0.0))}[plant]
    if isinstance(plant, QuarterCar):
        controller = replace(controller, {"high": np.inf})
    parts = {"reference": FixedSlip(slip=0.2), "feedforward": HoldingInput(), "controller": controller}
    loop = braking(plant=plant, initial=BrakeStart(speed=9.0, slip=0.2), actuator=actuator, **parts)
    reduced = reduce_loop(loop)
    a, b = reduced.model.matrices()
    state = loop.start()
    if not isinstance(actuator, Direct):
        tau = plant.holding(plant.output(state.plant), 0.2)
        state = state._replace(actuator=state.actuator._replace(flow=tau))
    z, unravel = ravel_pytree(state.flow())

    def chart(z):
        y = plant.output(unravel(z)[0])
        return jnp.concatenate([jnp.stack([y.slip, y.speed, y.distance]), z[3:]])

    def rate(z):
        at = state.with_flow(unravel(z))
        return jax.jvp(chart, (z,), (ravel_pytree(loop.flow(0.0, at, loop.signals(0.0, at)))[0],))[1]

    by_chart, by_state = quick(lambda z: (jax.jacfwd(chart)(z), jax.jacfwd(rate)(z)))(z)
    true = modes(by_state @ np.linalg.inv(by_chart))
    assert [s for s in reduced.model.states if "torque" not in s] == states
    assert reduced.exact
    for mode in modes(a + b @ reduced.gain[None]):
        assert np.min(np.abs(true - mode)) < 1e-9 * max(1, abs(mode))


@killed_by(
    "robust.design.state_feedback", "insert_unit(line, units) for line", "line.replace('{control}', 'N m') for line"
)
def test_what_is_neglected():
    lag = Lag(time_constant=0.02)
    loop = braking(
        plant=MirroredRig(),
        controller=PID(kp=30.0, ki=9.0, antiwindup=BackCalculation(), low=0.0, high=90.0),
        actuator=Series(blocks=(Delay(time=0.004), lag, Limits(low=0.0, high=90.0), Direct())),
        sensor=WheelSpeed(),
        reference=FilteredSlip(),
    )
    reduced = reduce_loop(loop)
    assert not reduced.exact
    assert reduced.neglected == (
        "The controller's torque limits of 0 and 90 N m.",
        "Anti-windup, which acts at the torque limits only.",
        "The actuator's delay of 0.004 s, which can destabilise.",
        "The actuator's limits of 0 and 90 N m.",
        "The fall of the speed: it is frozen.",
        "The sensor, wheel speed: its dynamics, rounding or error.",
        "The motion of the target (filtered slip), a disturbance; the model is taken at its setpoint.",
        "The error of the feed-forward (no feedforward), a disturbance.",
    )
    np.testing.assert_array_equal(reduced.gain, [-9.0, -30.0, 0.0])
    assert reduced.model.actuator.time_constant == 0.02
    assert reduced.model.speed == loop.initial.speed
    plain = reduce_loop(replace(loop, {"actuator": RateLimit(rate=70.0), "sensor": Bias(slip=0.01)}))
    assert plain.exact
    assert "The actuator's rate limit of 70 N m/s." in plain.neglected
    assert "The sensor's bias, a disturbance." in plain.neglected
    assert reduce_loop(braking(controller=StateFeedback(), feedforward=HoldingInput())).neglected == (
        "The fall of the speed: it is frozen.",
    )
    commanded = braking(plant=LabRig(), controller=StateFeedback(low=0.0, high=1.0))
    assert reduce_loop(commanded).neglected[0] == "The controller's torque limits of 0 and 1."  # of no unit


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"controller": Relay()}, "controller relay is not linear: it cannot be brought to state feedback"),
        ({"controller": SlidingMode(low=0.0, high=90.0)}, "controller sliding mode is not linear"),
        ({"controller": Sampled(controller=ConstantTorque())}, "controller constant torque is not linear"),
        ({"controller": Sampled(controller=Sampled())}, "controller sampled is not linear"),
        ({"actuator": Series(blocks=(Lag(), Lag()))}, "room for one lag, not for several"),
        ({"actuator": Sampled()}, "actuator sampled is not known to be linear"),
        ({"plant.mass": np.nan}, r"plant.mass = nan is outside \(0, inf\) kg"),
        ({"reference.slip": 1.0}, r"slip = 1 is outside \(0, 1\)"),
    ],
)
def test_what_cannot_be_reduced(change, message):
    with pytest.raises(ValueError, match=message):
        reduce_loop(replace(braking(), change))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"actuator": Delay()}, "actuator: a linear slip model knows Direct and Lag, not Delay"),
        ({"sampling": Lag()}, "sampling: a linear slip model knows Continuous and Sampling, not Lag"),
        ({"filter": Lag()}, "filter: a linear slip model knows Direct and LowPass, not Lag"),
    ],
)
def test_unknown_parts(parts, message):
    model = SlipModel(**parts)
    with pytest.raises(ValueError, match=message):
        model.matrices()
    with pytest.raises(ValueError, match=message):
        _ = model.states


@killed_by("core.validity", "shapes = shapes or list(", "shapes = list(")
@killed_by("linear.balance_model", "as_rule_array(delay) == 0", "True")
@pytest.mark.parametrize(
    ("model", "message"),
    [
        (SlipModel(slip=0.0, speed=0.0), r"^slip = 0 is outside \(0, 1\); speed = 0 is outside \(0, 200\] m/s$"),
        (SlipModel(sampling=Sampling(delay=0.002)), "^sampling.delay = 0.002 s exceeds the period of 0.001 s$"),
        (SlipModel(sampling=Sampling(period=-1.0)), r"^sampling.period = -1 is outside \(0, inf\) s$"),
        (SlipModel(sampling=Sampling(period=np.ones(2))), r"^sampling.period .*has shape \(2,\); it needs \(\)$"),
        (BalanceModel(sampling=Sampling(delay=1e-4)), r"^sampling.delay = 0.0001 s is outside \[0, 0\] s"),
    ],
)
def test_ranges(model, message):
    for use in (check_part, d.check):
        with pytest.raises(ValueError, match=message):
            use(model)


@pytest.mark.slow
def test_batches_and_derivatives():
    """A full model, batched; and its derivatives in every parameter that is varied, by differences."""
    model = SlipModel(actuator=Lag(), sampling=Sampling(period=2e-3, delay=5e-4), filter=LowPass())
    paths = ("plant.mass", "speed", "actuator.time_constant", "sampling.delay", "filter.cutoff", "slip")

    @jax.vmap
    def entries(values):
        return ravel_pytree(replace(model, dict(zip(paths, values, strict=True))).matrices())[0]

    at = jnp.array([5.5, 6.0, 0.012, 7e-4, 50.0, 0.25])
    h = 1e-5 * at
    left, right = (quick(entries)(at + sign * jnp.diag(h)) for sign in (-1, 1))
    for jacobian in (jax.jacfwd, jax.jacrev):
        slopes = quick(jacobian(lambda v: entries(v[None])[0]))(at).T
        np.testing.assert_allclose(slopes, (right - left) / (2 * h[:, None]), rtol=1e-5, atol=1e-6)
    one = replace(model, dict(zip(paths, at.tolist(), strict=True)))
    np.testing.assert_allclose(quick(entries)(at[None])[0], ravel_pytree(one.matrices())[0], rtol=1e-13, atol=1e-16)
