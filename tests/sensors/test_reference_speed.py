"""Vehicle speeds from several wheels against NumPy, and their cost to the control of a car with two axles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs import controllers, plants, references, roads, stops
from diffabs.core.blocks import Direct, Series
from diffabs.core.protocols import BrakeOutput, Clock
from diffabs.parts.objectives import StopDistance
from diffabs.parts.plants.car import CarOutput
from diffabs.parts.plants.half_car import CHANNELS, HalfCarOutput
from diffabs.parts.sensors import OutputError, OutputNoise, PerOutput, SelectHigh, SpeedEstimator, SpeedScale

PERIOD, COUNT = 1e-3, 600
FIXED = d.FixedStep(5e-4, 10.0)


def braking_axles(deceleration=8.0):
    """Return 600 outputs of two axles that slip by turns, and together from 0.3 to 0.45 s."""
    t = PERIOD * np.arange(COUNT)
    v = 20.0 - deceleration * t
    front = 0.3 * np.clip(np.sin(2 * np.pi * t / 0.2), 0.0, None) + np.where((t > 0.3) & (t < 0.45), 0.2, 0.0)
    rear = 0.01 + np.where(t > 0.3, 0.15, 0.0) * (t < 0.45)
    still = 0.0 * t
    columns = (front, rear, v, (1 - front) * v, (1 - rear) * v, deceleration + 0.1 + still, still, still, still)
    return HalfCarOutput(*map(jnp.asarray, columns))


def feed(sensor, outputs, key=None):
    """Return what a sensor shows after each instant of a grid of 1 ms."""

    def step(memory, at):
        k, signal = at
        memory = sensor.tick(Clock(PERIOD * k, PERIOD, k, key), memory, signal)
        return memory, sensor.output(PERIOD * k, memory, signal)

    first = jax.tree.map(lambda x: x[0], outputs)
    return jax.lax.scan(step, sensor.start(first), (jnp.arange(len(outputs[0])), outputs))[1]


@killed_by("parts.sensors.reference_speed", "larger(larger(fastest_rim(signal), fallen)", "larger(larger(0.0, fallen)")
@killed_by("parts.sensors.reference_speed", "slip = (speed - wheel.wheel_speed) / speed", "slip = wheel.slip")
@killed_by("parts.sensors.reference_speed", "if slips is None else", "if slips is None or True else")
@pytest.mark.parametrize("slope", [5.0, 9.0])
def test_the_fastest_rim_or_the_slope(slope):
    """A loop in Python over samples of 2 ms, held in between, with a slope below and above the deceleration."""
    outputs = braking_axles()
    shown = feed(SelectHigh(slope=slope, period=2e-3), outputs)
    rims = np.stack([outputs.front_wheel_speed, outputs.rear_wheel_speed])
    reference, expected = rims[:, 0].max(), []
    for k in range(COUNT):
        if k % 2 == 0 and k > 0:
            reference = max(*rims[:, k], reference - slope * 2e-3)
        expected.append(reference)
    np.testing.assert_allclose(shown.speed, expected, rtol=1e-12)
    np.testing.assert_allclose(shown.front_slip, 1 - rims[0] / np.array(expected), rtol=0, atol=1e-12)
    np.testing.assert_allclose(shown.rear_slip, 1 - rims[1] / np.array(expected), rtol=0, atol=1e-12)
    assert (np.asarray(shown.deceleration) == np.asarray(outputs.deceleration)).all()
    drift = np.asarray(shown.speed - outputs.speed)[449]
    assert drift > 0.3 if slope == 5.0 else drift < -0.1  # too slow a fall shows slip, too fast a fall hides it


@killed_by("parts.sensors.speed_estimator", "v + gain * (w - v)", "predicted + gain * (w - predicted)")
def test_a_filter_gates_each_wheel():
    """The equations of the module in Python, one wheel after the other; 0.15 s without a wheel to trust."""
    outputs = braking_axles()
    shown = feed(SpeedEstimator(gate=0.03, growth=0.05, noise=0.005), outputs)
    rims = np.stack([outputs.front_wheel_speed, outputs.rear_wheel_speed])
    v, variance, expected = rims[:, 0].max(), (0.005 * rims[:, 0].max()) ** 2, [rims[:, 0].max()]
    for k in range(1, COUNT):
        before, variance = v - PERIOD * float(outputs.deceleration[k]), variance + PERIOD * 0.05**2
        v = before
        for w in rims[:, k]:
            trust = min(max(1 - (before - w) / before / 0.03, 0.0), 1.0)
            gain = trust * variance / (variance + (0.005 * before) ** 2)
            v, variance = v + gain * (w - v), (1 - gain) * variance
        expected.append(v)
    np.testing.assert_allclose(shown.speed, expected, rtol=1e-12)
    assert np.abs(np.asarray(shown.speed - outputs.speed)).max() < 0.25


@killed_by("parts.sensors.speed_estimator", "slip = (predicted - fastest_rim(signal))", "slip = (predicted - w)")
def test_a_slow_wheel_alone_does_not_restart_the_filter():
    """Without a deceleration a wheel beyond the gate would; but the other one rolls, and the filter averages it."""
    still = jnp.zeros(COUNT)
    rim = 10.0 + 0.04 * (-1.0) ** jnp.arange(COUNT)
    outputs = HalfCarOutput(still, still, still + 10.0, rim, still + 6.0, still, still, still, still)
    assert np.abs(np.asarray(feed(SpeedEstimator(growth=0.01), outputs).speed)[200:] - 10.0).max() < 0.01


@pytest.mark.parametrize("sensor", [SelectHigh(), SpeedEstimator()], ids=["select", "filter"])
@pytest.mark.parametrize("wheels", ["one", "two", "four"])
def test_it_is_exact_while_the_wheels_roll(sensor, wheels):
    """Of a wheel, an axle or a car; every slip is that of the shown speed, and the truth."""
    still = jnp.zeros(5)
    fields = {"one": BrakeOutput, "two": HalfCarOutput, "four": CarOutput}[wheels]
    outputs = fields(*(still + 15.0 if "speed" in name else still for name in fields._fields))
    shown = feed(sensor, outputs)
    for name in fields._fields:
        np.testing.assert_allclose(getattr(shown, name), getattr(outputs, name), rtol=1e-12, atol=1e-14)


@killed_by("parts.sensors.per_output", "self.factor * signal", "signal")
@killed_by("parts.sensors.per_output", "and name in type(signal).tracked", "")
def test_errors_of_single_outputs_enter_the_reference():
    """A front radius 1 % too great, an accelerometer's zero and noise, and a scaled channel."""
    outputs = braking_axles()
    errors = {
        "front_wheel_speed": OutputError(factor=1.01),
        "deceleration": Series(blocks=(OutputError(offset=0.3), OutputNoise(deviation=0.1))),
        "rear_slip": SpeedScale(factor=0.5),
    }
    shown = feed(PerOutput(sensor=errors), outputs, key=jax.random.key(1))
    np.testing.assert_allclose(shown.front_wheel_speed, 1.01 * outputs.front_wheel_speed, rtol=1e-12)
    error = np.asarray(shown.deceleration - outputs.deceleration)
    assert abs(error.mean() - 0.3) < 0.03
    assert abs(error.std() - 0.1) < 0.02
    np.testing.assert_allclose(shown.rear_slip, 1 - outputs.rear_wheel_speed / (0.5 * outputs.speed), rtol=1e-12)
    chain = Series(blocks=(PerOutput(sensor={"front_wheel_speed": errors["front_wheel_speed"]}), SelectHigh()))
    np.testing.assert_allclose(feed(chain, outputs).speed[0], 1.01 * 20.0, rtol=1e-12)


@killed_by("engine.step.adaptive", "jnp.where(after.since > 0, score, 0)", "score")
def test_a_clock_that_moves_the_slip_across_its_target_is_no_slide():
    """The reference falls at each tick and the wheel follows: the error of the PID changes its sign every millisecond,
    where its anti-windup has a bend. Adaptive and fixed steps agree."""
    loop = d.braking(
        plant=plants.QuarterCar(mass=300.0, radius=0.3, inertia=1.0, road=roads.DRY_ASPHALT),
        initial=d.BrakeStart(speed=27.0),
        reference=references.FilteredSlip(slip=0.1),
        controller=controllers.PID(kp=1e4, ki=1.5e5, low=0.0, high=2000.0, antiwindup=controllers.Clamping()),
        sensor=SelectHigh(slope=10.0),
        stop=stops.SpeedReached(speed=5.0),
    )
    runs = [d.measure(loop, solver, {"distance": StopDistance()}) for solver in (d.Adaptive(1e-6, 10.0), FIXED)]
    assert not any(run.diverged for run in runs)
    np.testing.assert_allclose(runs[0].metrics["distance"], runs[1].metrics["distance"], rtol=1e-5)


def of_half_car(sensor, gains=None):
    """Return the loop of the page's table: a PID for each axle, to 4 m/s."""
    car = plants.HalfCar()
    usual = car.usual_parts()
    pid = controllers.PID(kp=2e4, ki=3e5, low=0.0, high=4000.0, antiwindup=controllers.BackCalculation())
    pids = {brake: d.replace(pid, gains or {}) for brake in CHANNELS}
    parts = {"sensor": sensor, "controller": controllers.PerChannel(pids, CHANNELS)}
    return d.Loop(plant=car, **usual | parts | {"stop": stops.SpeedReached(speed=4.0)})


def with_offset(offset, **numbers):
    """Return the filter behind an accelerometer with an offset [m/s^2]."""
    return Series(
        blocks=(PerOutput(sensor={"deceleration": OutputError(offset=offset)}), SpeedEstimator(**numbers)),
    )


TUNED = {"gate": 0.001, "growth": 0.017, "noise": 0.0078}
ON_PAGE = {
    "true": (Direct(), {}, [38.3, 0.0, 52.4, 0.0]),
    "select high": (SelectHigh(), {}, [38.0, 0.14, 68.6, 8.96]),
    "filter": (with_offset(0.0, gate=0.01), {}, [37.8, 0.26, 52.2, 0.26]),
    "tuned": (with_offset(0.0, **TUNED), {"kp": 4e4, "ki": 6e5}, [37.6, 0.01, 52.0, 0.01]),
    "offset": (with_offset(0.2, **TUNED), {"kp": 4e4, "ki": 6e5}, [37.2, 1.04]),
    "offset, negative": (with_offset(-0.2, **TUNED), {"kp": 4e4, "ki": 6e5}, [39.9, 0.0]),
}


@pytest.mark.slow
@pytest.mark.parametrize("row", ON_PAGE)
def test_the_table_of_the_page(row):
    """Distance and overshoot of the front axle on dry and on wet asphalt, as docs/car.md has them."""
    sensor, gains, expected = ON_PAGE[row]
    loop, solver = of_half_car(sensor, gains), d.Adaptive(rtol=1e-6, duration=10.0)
    wet = {f"plant.{axle}_tyre.road.{name}": getattr(roads.WET_ASPHALT, name)
           for axle in ("front", "rear") for name in ("c1", "c2", "c3")}  # fmt: skip
    usual = loop.plant.usual_objectives()
    measured = {name: usual[name] for name in ("stop_distance", "overshoot_front")}
    for values, numbers in (({}, expected[:2]), (wet, expected[2:])):
        if numbers:
            metrics = d.measure(d.replace(loop, values), solver, measured).metrics
            np.testing.assert_allclose([float(metrics[name]) for name in measured], numbers, rtol=0, atol=0.06)
            assert abs(float(metrics["overshoot_front"]) - numbers[1]) < 0.006
