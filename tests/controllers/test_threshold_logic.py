"""The threshold logic with a hydraulic brake, against the whole sampled loop written out in NumPy."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from signals import seen

import diffabs as d
from diffabs import plants, roads
from diffabs.core.protocols import Clock, Tracking
from diffabs.parts.actuators import HydraulicBrake, PerControl
from diffabs.parts.controllers import FivePhase, PerChannel
from diffabs.parts.controllers.threshold_logic import BrakePhase
from diffabs.parts.objectives import LockedTime, StopDistance
from diffabs.parts.plants.half_car import CHANNELS
from diffabs.parts.stops import SpeedReached
from diffabs.scenario.defaults import braking

SPEED, END, PERIOD = 20.0, 4.0, 5e-3
BURCKHARDT = {"DRY_ASPHALT": (1.2801, 23.99, 0.52), "SNOW": (0.1946, 94.129, 0.0646)}


def friction(road, slip, speed):
    c1, c2, c3 = BURCKHARDT[road]
    size = abs(slip)
    return math.copysign((c1 * (1 - math.exp(-c2 * size)) - c3 * size) * math.exp(-0.03 * size * speed), slip)


def wheel_loop(road):
    """Return the loop of a wheel under 300 kg."""
    return braking(
        plant=plants.QuarterCar(mass=300.0, radius=0.3, inertia=1.0, road=getattr(roads, road)),
        initial=d.BrakeStart(speed=SPEED),
        controller=FivePhase(),
        actuator=HydraulicBrake(),
        stop=SpeedReached(speed=END),
    )


def follow(phase, acceleration, slip):
    """Return the next phase and its command, by the table of the docstring with the default thresholds."""
    brakes, recovers = acceleration < -25.0, acceleration > 5.0
    if phase == "BUILD":
        return "HOLD" if brakes else phase
    if phase == "HOLD":
        if slip > 0.1:
            return "DUMP"
        return phase if brakes else "SLOW_BUILD"
    if phase == "DUMP":
        if recovers:
            return "RECOVER"
        return phase if brakes or slip > 0.25 else "WAIT"
    if phase == "WAIT":
        if brakes or slip > 0.25:
            return "DUMP"
        if recovers:
            return "RECOVER"
        return "SLOW_BUILD" if slip < 0.1 else phase
    if phase == "RECOVER":
        return phase if recovers else "SLOW_BUILD"
    return "DUMP" if brakes else phase


def simulate(road, substeps):
    """Return the commands and phases of all ticks, and speed, rim speed and distance at the last one before 4 m/s."""

    def rates(x, command):
        speed, spin, _, filling = x
        rim = 0.3 * spin
        mu = friction(road, (speed - rim) / max(speed, rim, 0.01), speed)
        pressed = max(filling - 0.15, 0.0) / 0.85
        pressure = 1e7 * (0.4 * pressed + 0.6 * pressed**2)
        flows = [gap / (gap**2 + 1e8) ** 0.25 / 1e7**0.5 for gap in (1.5e7 - pressure, pressure)]
        torque = 2 * 0.38 * 2.55e-3 * 0.11 * max(pressure - 5e4, 0.0)
        rate = 0.3 * mu * 300.0 * 9.81 - torque
        inflow = max(command, 0.0) * flows[0] / 0.2 - max(-command, 0.0) * flows[1] / 0.07
        return np.array([-mu * 9.81, rate if spin > 0 else max(rate, 0.0), speed, inflow])

    x, h = np.array([SPEED, SPEED / 0.3, 0.0, 0.0]), PERIOD / substeps
    phase, last, acceleration = "BUILD", SPEED, 0.0
    commands, phases, states = [], [], []
    while x[0] > END:
        rim = 0.3 * x[1]
        acceleration += PERIOD / (PERIOD + 0.01) * ((rim - last) / PERIOD - acceleration)
        last, phase = rim, follow(phase, acceleration, (x[0] - rim) / max(x[0], rim))
        strong = 1.0 if acceleration > 20.0 else 0.0
        levels = {"BUILD": 1.0, "DUMP": -1.0, "RECOVER": strong, "SLOW_BUILD": 0.15}
        command = levels.get(phase, 0.0)
        commands.append(command)
        phases.append(phase)
        states.append([x[0], rim, x[2]])
        for _ in range(substeps):
            a = rates(x, command)
            b = rates(x + h / 2 * a, command)
            c = rates(x + h / 2 * b, command)
            x = x + h / 6 * (a + 2 * b + 2 * c + rates(x + h * c, command))
            x[1] = max(x[1], 0.0)
    return np.array(commands), phases, np.array(states)


def shortest(road, start, end):
    """Return the distance [m] that the greatest friction at each speed allows."""
    speeds, slips = np.linspace(end, start, 200), np.linspace(0.005, 1.0, 400)
    greatest = [max(friction(road, slip, speed) for slip in slips) for speed in speeds]
    return np.trapezoid(speeds / (9.81 * np.array(greatest)), speeds)


@killed_by("parts.controllers.threshold_logic", "jnp.logical_not(brakes | locks)", "jnp.logical_not(brakes)")
@killed_by("parts.controllers.threshold_logic", "(BrakePhase.SLOW_BUILD, slip < self.slip_low),", "")
@killed_by("parts.controllers.threshold_logic", "acceleration > self.strong_threshold", "acceleration > 1e9")
@pytest.mark.parametrize(("road", "excess"), [("DRY_ASPHALT", 0.14), ("SNOW", 0.12)])
def test_a_run_agrees_with_the_loop_in_numpy(road, excess):
    """Every command, the states at every tick, no locked wheel, and a distance near the least one."""
    loop = wheel_loop(road)
    run = d.rollout(loop, d.FixedStep(2.5e-4, 20.0, every=20), {"distance": StopDistance(), "locked": LockedTime()})
    commands, phases, states = simulate(road, 30)
    sample = run.trajectory.sample
    count = len(commands)
    np.testing.assert_allclose(np.asarray(sample.command)[:count], commands, rtol=0, atol=1e-12)
    y = sample.output
    found = np.stack([y.speed, y.wheel_speed, y.distance], axis=1)[:count]
    np.testing.assert_allclose(found, states, rtol=0, atol=5e-6)
    assert {*phases} == {phase.name for phase in BrakePhase}
    assert float(run.metrics["locked"]) == 0.0
    assert 1.0 < float(y.distance[count - 1]) / shortest(road, SPEED, float(y.speed[count - 1])) < 1.0 + excess


def after(phase, acceleration, slip, speed=20.0):
    """Return the phase that follows, and its command."""
    logic = FivePhase(time_constant=0.0)
    rim = (1 - slip) * speed
    signal = Tracking(0.1, seen(slip, speed), 0.0)
    memory = logic.start(signal)
    held = memory.held._replace(phase=1.0 * phase, wheel_speed=rim - acceleration * PERIOD)
    memory = logic.tick(Clock(jnp.asarray(0.0), PERIOD, 0, None), memory._replace(held=held), signal)
    return BrakePhase(int(memory.held.phase)), float(logic.output(0.0, memory, signal))


@pytest.mark.parametrize("phase", BrakePhase)
def test_every_way_out_of_every_phase(phase):
    """On a grid of accelerations between all thresholds, and of slips."""
    with jax.enable_x64(True):
        for acceleration in (-60.0, -24.0, 0.0, 6.0, 30.0):
            for slip in (0.02, 0.15, 0.4, 1.0):
                expected = BrakePhase[follow(phase.name, acceleration, slip)]
                strong = 1.0 if acceleration > 20.0 else 0.0
                levels = (1.0, 0.0, -1.0, 0.0, strong, 0.15)
                assert after(phase, acceleration, slip) == (expected, levels[expected])
        assert after(phase, -60.0, 1.0, speed=1.9) == (BrakePhase.BUILD, 1.0)


def test_both_axles_of_a_car_stop_without_locking():
    """With load transfer and a logic and a valve for each axle; within 15 % of the least distance."""
    car = plants.HalfCar()
    brakes = {
        "front_brake": HydraulicBrake(piston_area=5.1e-3),
        "rear_brake": HydraulicBrake(piston_area=5.1e-3, pad_radius=0.08),
    }
    loop = d.Loop(plant=car, **car.usual_parts() | {
        "controller": PerChannel(FivePhase(), CHANNELS),
        "actuator": PerControl(actuator=brakes),
        "stop": SpeedReached(speed=END),
    })  # fmt: skip
    metrics = d.measure(loop, d.Adaptive(rtol=1e-6, duration=20.0), car.usual_objectives()).metrics
    assert metrics["locked_time_front"] == metrics["locked_time_rear"] == 0.0
    assert metrics["stop_distance"] < 1.15 * shortest("DRY_ASPHALT", 100 / 3.6, 0.0)


def test_thresholds_in_the_wrong_order_are_refused():
    with pytest.raises(ValueError, match=r"slip_low = 0.3 is not below slip_high = 0.25"):
        d.measure(d.replace(wheel_loop("SNOW"), {"controller.slip_low": 0.3}), d.FixedStep(2.5e-4, 20.0), {})
