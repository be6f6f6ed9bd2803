"""Peaks of what a control does, between the ends of a step."""

import jax
import jax.numpy as jnp
import numpy as np
import parts
import pytest
from mutants import killed_by

import diffabs as d
from diffabs import actuators, controllers, objectives, plants, references, sensors, stops
from diffabs.core.blocks import Series
from diffabs.core.cubic import Cubic
from diffabs.core.messages import Segment
from diffabs.core.numerics import later_of_larger
from diffabs.parts.objectives import PeakVoltage


def step(h, smooth, within=(True, True), **signals):
    """A step of length h of a balance with these signals of time."""

    def at(t):
        return parts.balancing_at(t)._replace(**{name: signal(t) for name, signal in signals.items()})

    (a, da), (b, db) = (jax.jvp(at, (t,), (jnp.ones_like(t),)) for t in jnp.array([0.0, h]))
    return Segment(a, b, h, h, lambda: (da.show(), db.show()), lambda: (da, db), smooth, within)


@killed_by("parts.objectives.balance", "if segment.smooth is not False:", "if False:", case="True-24.0")
@pytest.mark.parametrize(("smooth", "peak"), [(True, 24.0), (False, 19.2)])
def test_a_voltage_rises_and_falls_within_a_long_step(smooth, peak):
    """u = 24 - 30 (t - 0.4)^2 over a step of 1 s. If the step would not end on a limit, only its ends are seen."""
    segment = step(1.0, smooth, control=lambda t: 24.0 - 30.0 * (t - 0.4) ** 2)
    objective = PeakVoltage()
    np.testing.assert_allclose(objective.update(objective.start(segment.start), segment), peak, rtol=1e-12)


@killed_by("core.messages", "jnp.where(end, last, jnp.where(start, 2.0 * rise - first, rise))", "last")
@pytest.mark.parametrize(("objective", "value"), [(PeakVoltage(), 24.0), (objectives.Variation(), 4.0)])
def test_a_voltage_that_rises_to_a_limit_does_not_leave_it(objective, value):
    """u = 20 + 8 t to 24, where the step ends and the voltage falls: its slope there says nothing about the step."""

    def voltage(t):
        return jnp.where(t < 0.5, 20.0 + 8.0 * t, 44.0 - 40.0 * t)

    segment = step(0.5, True, (True, False), control=voltage)
    found = objective.update(objective.start(segment.start), segment)
    np.testing.assert_allclose(getattr(found, "total", found), value, rtol=1e-12)


@pytest.mark.parametrize("corner", [0.0, 0.5])
def test_a_corner_at_the_end_of_a_step_leaves_the_error(corner):
    """The setpoint rises by 2 t within the step, and falls before or after it. Integral of |theta - setpoint|."""
    within = corner == 0.0

    def setpoint(t):
        return jnp.where((t > 0.0) if within else (t < 0.5), 2.0 * t, -6.0 * (t - corner) + 2.0 * corner)

    def theta(t):
        return 3.0 * t - 0.2

    def output(t):
        return parts.balancing_at(t).output._replace(theta=theta(t))

    segment = step(0.5, True, (not within, within), output=output, setpoint=setpoint)
    objective = objectives.IAE()
    found = objective.update(objective.start(segment.start), segment)
    np.testing.assert_allclose(found, 0.2**2 / 2 + 0.3**2 / 2, rtol=1e-12)


@pytest.mark.slow
def test_the_variation_with_a_corner_is_that_of_short_steps():
    """A limit and the nodes of a gain schedule are corners of the control, at which adaptive steps begin and end. The
    rate beyond a corner makes no extremum before it. Against the sum of |du| over short steps."""
    loop = d.Loop(
        plant=plants.MirroredRig(),
        initial=d.BrakeStart(speed=11.0, slip=0.03),
        stop=stops.SpeedReached(speed=5.0),
        sensor=sensors.SpeedScale(factor=0.85),
        reference=references.FilteredSlip(slip=0.15, time_constant=0.03),
        feedforward=controllers.HoldingInput(),
        controller=controllers.ScheduledFeedback(
            speeds=np.array([3.0, 7.0, 13.0]),
            integral_gains=np.array([-900.0, -1100.0, -1300.0]),
            gains=np.array([-40.0, -60.0, -80.0]),
            low=0.3,
            high=4.0,
            antiwindup=controllers.BackCalculation(tracking_time=0.03),
        ),
    )
    control = d.rollout(loop, d.FixedStep(2e-4, 2.0, kinks=True)).trajectory.sample.control
    found = d.measure(loop, d.Adaptive(1e-6, 2.0), {"variation": objectives.Variation()})
    np.testing.assert_allclose(found.metrics["variation"], np.sum(np.abs(np.diff(control))), rtol=1e-6)


@pytest.mark.parametrize(("lag", "end"), [(1e-3, 10.5), (0.0, 5.0)])
@pytest.mark.slow
def test_a_peak_on_an_event_of_the_grid_moves_with_the_event(lag, end):
    """The slip rises until the brake is released, on an instant of the grid. The step to that event has no length, but
    its end moves with the delay, and so do the peak and the torque's variation. Against differences from both sides."""
    inner = controllers.PID(kp=20.0, ki=200.0, low=0.2, high=6.0)
    loop = d.Loop(
        plant=plants.MirroredRig(),
        initial=d.BrakeStart(speed=11.0, slip=0.03),
        stop=stops.SpeedReached(speed=end),
        reference=references.FixedSlip(slip=0.15),
        feedforward=controllers.HoldingInput(),
        controller=controllers.Sampled(controller=inner, period=2e-3, delay=1e-3),
        **({"actuator": actuators.Lag(time_constant=lag)} if lag else {}),
    )
    measured = {"slip": objectives.MaxSlip(), "variation": objectives.Variation()}

    @jax.jit
    def values(delay):
        late = d.replace(loop, {"controller.delay": delay})
        found = d.measure(late, d.FixedStep(2e-4, 2.0), measured).metrics
        return jnp.stack([found[name] for name in measured])

    slopes, here = np.asarray(jax.jit(jax.jacfwd(values))(1e-3)), np.asarray(values(1e-3))
    left, right = ((np.asarray(values(1e-3 + width)) - here) / width for width in (-2e-6, 2e-6))
    np.testing.assert_allclose(left, right, rtol=2e-2)  # there is a derivative
    np.testing.assert_allclose(slopes, (left + right) / 2, rtol=2e-3)


@pytest.mark.slow
def test_a_torque_peak_has_the_derivative_of_accurate_runs():
    """Between the ends of fixed steps, behind a lag. Against differences of adaptive runs at three widths."""
    loop = d.Loop(
        plant=plants.ArmBalance(gear=1.1, rotor_inertia=0.3, current_max=40.0),
        initial=plants.BalanceStart(theta=0.02, psi=0.015, phi=0.01, theta_rate=0.02, psi_rate=0.03, phi_rate=0.01),
        reference=references.Upright(),
        controller=controllers.BalanceFeedback(),
        actuator=Series(blocks=(actuators.VoltageLimit(high=90.0), actuators.Lag(time_constant=0.002))),
        stop=stops.Fallen(),
    )
    paths = {"plant.arm_mass": 20.0, "plant.gear": 1.1}

    def peak(z, solver):
        values = {path: value * jnp.exp(z[i]) for i, (path, value) in enumerate(paths.items())}
        return d.measure(d.replace(loop, values), solver, {"x": objectives.PeakTorque()}).metrics["x"]

    slope = np.asarray(jax.jit(jax.jacfwd(lambda z: peak(z, d.FixedStep(5e-4, 0.3))))(jnp.zeros(2)))
    accurate = jax.jit(jax.vmap(lambda z: peak(z, d.Adaptive(1e-9, 0.3, 5e-4))))
    for width in (3e-3, 1e-3, 3e-4):
        up, down = np.asarray(accurate(width * jnp.concatenate([jnp.eye(2), -jnp.eye(2)]))).reshape(2, 2)
        np.testing.assert_allclose(slope, (up - down) / (2 * width), rtol=1e-3)


def test_a_cubic_without_a_root_returns_its_end():
    """A signal outside its band at both ends enters it no earlier than at the end, where its set point may jump."""

    def place(start):
        return Cubic(start, 0.5, -0.3, -0.1).root()

    assert jax.jvp(place, (1.0,), (1.0,)) == (1.0, 0.0)
    assert jax.jvp(place, (-1.0,), (1.0,))[0] < 1.0


@killed_by("core.cubic", " & (self.end_slope < 0)", "")
@killed_by("core.cubic", "(self.start_slope > 0) &", "")
def test_the_greatest_value_of_any_cubic():
    """Against NumPy's roots; some values and slopes at the ends are zero. It is the greater end if the cubic does not
    rise at the start and fall at the end: a control that leaves its limit at a step's end has no peak before it."""
    random = np.random.default_rng(5)
    ends = random.normal(size=(200, 4)) * (random.random((200, 4)) > 0.2)
    found = jax.vmap(lambda one: Cubic(*one).greatest())(jnp.asarray(ends))
    for (a, b, da, db), greatest in zip(ends, found, strict=True):
        curve = np.polynomial.Polynomial([a, da, 3 * (b - a) - 2 * da - db, 2 * (a - b) + da + db])
        inside = [x.real for x in curve.deriv().roots() if abs(x.imag) < 1e-6 and 0 < x.real < 1]
        inside = inside if da > 0 > db else []
        np.testing.assert_allclose(greatest, max(a, b, *curve(np.array(inside))), rtol=1e-9, atol=1e-12)


@killed_by("core.numerics", "jnp.where(jnp.greater(short, 0), short, 0.0)", "0.0")
def test_a_maximum_does_not_follow_a_slow_decline():
    """In single precision 0.9999 is equal to 1 within the rounding that decides about derivatives."""

    def follow(held, k):
        return later_of_larger(held, jnp.float32(0.9999) ** k), None

    assert jax.lax.scan(follow, jnp.float32(1.0), jnp.arange(5000.0, dtype=jnp.float32))[0] == 1.0
