"""The loops of the study: the rig of the box around any controller, its speed known or estimated."""

import dataclasses
from typing import Any

from diffabs import BrakeStart, Loop
from diffabs.core.blocks import Series
from diffabs.parts.actuators import Lag
from diffabs.parts.controllers import ConstantInput, Sampled, SampledOnGrid
from diffabs.parts.plants import MirroredRig
from diffabs.parts.references import FixedSlip
from diffabs.parts.sensors import Bias, DriftingSpeed, Noise, Quantisation, SpeedEstimator, WheelNoise
from diffabs.parts.stops import SpeedReached
from diffabs.scenario.defaults import braking
from experiments.real_rig.box import KMH, KNOWN, NOMINAL, Fixed


def holding(fixed: Fixed) -> float:
    """Return tau* of the known mass [N m]."""
    rig = MirroredRig(mass=fixed.known_mass)
    output = rig.output(rig.start(BrakeStart(speed=NOMINAL["speed"] / KMH, slip=fixed.slip)))
    return float(rig.holding(output, fixed.slip))


def sensor(fixed: Fixed, speed: str, estimator: Any = None, *, smooth: bool = False) -> Series:
    """Return the sensor.

    `smooth`: noise of the same size replaces the quantisation of the wheel's speed, which has no useful derivative.
    """
    period = fixed.period
    steps = Quantisation(wheel_speed=fixed.quantum)
    if smooth:
        steps = Noise(wheel_speed=fixed.quantum / 12**0.5, period=period)
    wheel = (WheelNoise(slip=fixed.slip_noise, period=period), steps)
    if speed == KNOWN:
        return Series(blocks=(*wheel, DriftingSpeed(time_constant=fixed.drift)))
    accelerometer = (Noise(deceleration=fixed.acceleration_noise, period=period), Bias())
    return Series(blocks=(*wheel, *accelerometer, estimator or SpeedEstimator(period=period)))


def loop(
    fixed: Fixed, controller: Any, speed: str, reference: Any = None, estimator: Any = None, *, smooth: bool = False
) -> Loop:
    """The rig around a controller that a computer runs; its delay is not located by an event (`SampledOnGrid`)."""
    low, high = fixed.torque
    limited = dataclasses.replace(controller, low=low, high=high)
    return braking(
        plant=MirroredRig(mass=NOMINAL["mass"]),
        initial=BrakeStart(speed=NOMINAL["speed"] / KMH),
        sensor=sensor(fixed, speed, estimator, smooth=smooth),
        reference=reference or FixedSlip(slip=fixed.slip),
        feedforward=ConstantInput(value=holding(fixed)),
        controller=SampledOnGrid(controller=limited, sampling_period=fixed.period),
        actuator=Lag(time_constant=NOMINAL["lag"]),
        stop=SpeedReached(speed=fixed.end / KMH),
    )


def located(loop: Loop) -> Loop:
    """The same loop with the computing delay located by events: the reference that `loop` is checked against."""
    grid: Any = loop.controller
    sampled = Sampled(controller=grid.controller, period=grid.sampling_period, delay=grid.delay)
    return dataclasses.replace(loop, controller=sampled)


def with_truth(loop: Loop) -> Loop:
    """Return the same loop with the true speed of the vehicle, and the same noise of the wheel's speed."""
    wheel = loop.sensor.blocks[:2]  # pyright: ignore[reportAttributeAccessIssue]
    return dataclasses.replace(loop, sensor=Series(blocks=(*wheel, DriftingSpeed())))


def quantised(loop: Loop, fixed: Fixed) -> Loop:
    """The same loop with the quantisation of the wheel's speed in place of the noise that it was tuned with."""
    first, _, *others = loop.sensor.blocks  # pyright: ignore[reportAttributeAccessIssue]
    steps = Quantisation(wheel_speed=fixed.quantum)
    return dataclasses.replace(loop, sensor=Series(blocks=(first, steps, *others)))
