"""PID with set-point weights and reverse action, and PIDs in cascade, on the servo of the example.

The oracle is SciPy's Radau with rtol 1e-9 on equations written here. Steps of 1e-4 s end on kinks: their error is
below 1e-8 of the signals, so rtol is 1e-6.
"""

import dataclasses
import importlib
import sys

import numpy as np
import pytest
import scipy.integrate
from marks import cases
from mutants import killed_by
from project import ROOT

import diffabs as d
from diffabs.core.pytree import parameters
from diffabs.core.validity import check_part, find_cautions
from diffabs.parts.controllers import PID, BackCalculation, Cascade, Relay, Sampled
from diffabs.parts.objectives import IAE
from diffabs.parts.references import Setpoint
from diffabs.parts.stops import NoStop

SOLVER = d.FixedStep(1e-4, 0.12, every=1200, kinks=True)
RTOL = 1e-6
SHORT = d.FixedStep(1e-3, 0.05)


@pytest.fixture
def servo(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples" / "dc-servo")
    yield importlib.import_module("dc_servo")
    sys.modules.pop("dc_servo")


def closed_loop(servo, controller, plant=None, **plant_values):
    plant = plant or servo.DCMotor(coulomb=0.0, **plant_values)
    initial, reference = servo.ServoStart(angle=0.1), Setpoint(value=1.0)
    return d.Loop(plant=plant, initial=initial, reference=reference, controller=controller, stop=NoStop())


def last(loop):
    out = d.rollout(loop, SOLVER).trajectory.sample
    return np.array([float(x[-1]) for x in out.output]), float(out.command[-1])


def motor(x, u):
    """Of the example's equations without friction at rest: J = 2e-3, b = 1e-3, K = 0.1, R = 1, L = 2e-3."""
    _, speed, current = x
    return [speed, (0.1 * current - 1e-3 * speed) / 2e-3, (u - current - 0.1 * speed) / 2e-3]


def solved(rates, states):
    start = np.zeros(3 + states)
    start[0] = 0.1
    return scipy.integrate.solve_ivp(rates, (0, 0.12), start, method="Radau", rtol=1e-9, atol=1e-11, max_step=5e-4).y[
        :, -1
    ]


FURTHER = [((1.0, 1.0), 1.0), ((1.0, 1.0), -1.0), ((0.3, 0.0), -1.0), ((0.0, 0.6), 1.0)]


@killed_by("parts.controllers.pid", "self.kp * (self.b * signal.target", "self.kp * (signal.target")
@killed_by("parts.controllers.pid", "self.cutoff * (self.c * signal.target", "self.cutoff * (signal.target")
@pytest.mark.parametrize(
    ("b", "c", "sign"),
    [
        pytest.param(0.3, 0.0, 1.0, marks=pytest.mark.slow),
        (0.0, 0.6, -1.0),
        *[pytest.param(*weights, sign, marks=pytest.mark.slow) for weights, sign in FURTHER],
    ],
)
def test_weights_and_reverse_action(servo, sign, b, c):
    """Of a motor whose amplifier has this sign, and gains with the same sign."""

    class Amplified(servo.DCMotor):
        def derivative(self, t, state, control):
            return super().derivative(t, state, sign * control)

    kp, ki, kd, wc = 6.0, 20.0, 0.1, 200.0
    controller = PID(kp=sign * kp, ki=sign * ki, kd=sign * kd, cutoff=wc, b=b, c=c)
    plant = d.core.pytree.pytree(Amplified)(coulomb=0.0)
    found, command = last(closed_loop(servo, controller, plant))

    def control(x):
        return kp * (b - x[0]) + ki * x[3] + kd * wc * (c - x[0] - x[4])

    wanted = solved(lambda t, x: [*motor(x[:3], control(x)), 1 - x[0], wc * (c - x[0] - x[4])], 2)
    np.testing.assert_allclose(found, wanted[:3], rtol=RTOL)
    np.testing.assert_allclose(command, sign * control(wanted), rtol=RTOL)


OUTER = {"kp": 25.0, "ki": 40.0, "low": -6.0, "high": 6.0}
INNER = {"kp": 0.6, "ki": 20.0, "kd": 1e-3, "low": -3.0, "high": 3.0}


def cascade(**options):
    outer = PID(**OUTER, antiwindup=BackCalculation(tracking_time=0.05))
    inner = PID(**INNER, antiwindup=BackCalculation(tracking_time=0.02))
    return Cascade(outer=outer, inner=inner, **options)


@killed_by("parts.controllers.cascade", "put_first(signal.measured, name)", "signal.measured")
@killed_by(
    "parts.controllers.cascade",
    "zip(memory.flow, memory.held, strict=True)",
    "zip(memory.flow[::-1], memory.held, strict=True)",
)
@pytest.mark.parametrize("name", cases(["speed", ""], ""))
def test_a_cascade_with_limits_and_anti_windup_of_each(servo, name):
    found, command = last(closed_loop(servo, cascade(inner_signal=name)))
    hit = {"outer": False, "inner": False}

    def rates(t, x):
        angle, speed = x[:2]
        error = 1 - angle
        raw = 25 * error + 40 * x[3]
        target = np.clip(raw, -6, 6)
        slope = 55 * (target - speed - x[5])
        inner_raw = 0.6 * (target - speed) + 20 * x[4] + 1e-3 * slope
        u = np.clip(inner_raw, -3, 3)
        hit["outer"] |= raw != target
        hit["inner"] |= inner_raw != u
        outer_rate = error + (target - raw) / (40 * 0.05)
        return [*motor(x[:3], u), outer_rate, target - speed + (u - inner_raw) / (20 * 0.02), slope]

    wanted = solved(rates, 3)
    assert hit == {"outer": True, "inner": True}
    np.testing.assert_allclose(found, wanted[:3], rtol=RTOL)
    assert command <= 3.0


def test_units_of_a_cascade_are_those_of_its_signals(servo):
    units = {path: spec.unit for path, spec, _ in parameters(closed_loop(servo, cascade()))}
    wanted = {"outer.kp": "1/s", "outer.high": "rad/s", "inner.kp": "V s/rad", "inner.ki": "V/rad", "inner.high": "V"}
    assert {name: units[f"controller.{name}"] for name in wanted} == wanted
    units = {path: spec.unit for path, spec, _ in parameters(closed_loop(servo, cascade(inner_signal="current")))}
    assert (units["controller.outer.kp"], units["controller.inner.kp"]) == ("A/rad", "V/A")
    with pytest.raises(ValueError, match=r"controller\.outer\.high = nan is outside \(-inf, inf\) rad/s"):
        check_part(d.replace(closed_loop(servo, cascade()), {"controller.outer.high": np.nan}))


@pytest.mark.slow
def test_a_cascade_by_a_kernel_and_by_xla(servo):
    loop, masses = closed_loop(servo, cascade()), d.Batch({"controller.outer.kp": [20.0, 30.0]})
    kernel, xla = (d.run_batch(loop, masses, SHORT, {"iae": IAE()}, engine=name) for name in ("kernel", "xla"))
    np.testing.assert_allclose(kernel.metrics["iae"], xla.metrics["iae"], rtol=1e-9)  # to rounding


def message(function, *args):
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        function(*args)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_a_cascade_refuses(servo):
    inside = dataclasses.replace(cascade(), inner=Sampled())
    line = message(d.rollout, closed_loop(servo, inside), SHORT)
    assert "controller: inner = Sampled computes at instants" in line or "inner = Sampled computes at instants" in line
    assert "wrap the cascade in Sampled" in line
    assert "outer = Relay computes" in message(d.rollout, closed_loop(servo, Cascade(outer=Relay())), SHORT)
    line = message(d.rollout, closed_loop(servo, cascade(inner_signal="sped")), SHORT)
    assert "controller.inner_signal = sped is no output of the plant; there is angle, speed, current" in line


@pytest.mark.slow
def test_a_sampled_cascade(servo):
    """It follows the continuous one the closer the shorter the period; its rules name the inner parts."""
    command = [last(closed_loop(servo, Sampled(controller=cascade(), period=T)))[0][0] for T in (2e-3, 5e-4, 1e-4)]
    exact = last(closed_loop(servo, cascade()))[0][0]
    errors = np.abs(np.array(command) / exact - 1)
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 5e-3
    fast = dataclasses.replace(cascade(), inner=PID(cutoff=3000.0))
    line = message(check_part, Sampled(controller=fast, period=1e-3))
    assert line.startswith("controller.inner.cutoff = 3000 rad/s is outside (0, 2000) rad/s")


def test_gains_of_different_signs_are_hardly_intended():
    assert list(find_cautions(PID(kp=-1.0, ki=-2.0))) == []
    assert next(find_cautions(PID(kp=1.0, ki=-2.0))).startswith("kp = 1, ki = -2, kd = 0 have different signs")
