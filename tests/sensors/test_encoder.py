"""The encoders' slip against closed forms, for a wheel and a vehicle that slow down at given rates."""

import jax
import jax.numpy as jnp
import numpy as np
from mutants import killed_by

from diffabs.core.protocols import BrakeOutput, Clock, Memory
from diffabs.parts.sensors import EncoderSlip

PERIOD = 0.01


def output_at(t):
    """A vehicle from 10 m/s at -2 m/s^2, and a rim from 8 m/s at -5 m/s^2."""
    v, w = 10.0 - 2.0 * t, 8.0 - 5.0 * t
    return BrakeOutput((v - w) / v, v, w, 2.0 + 0.0 * t, 10.0 * t - t**2)


def samples(sensor, count):
    """The outputs of the sensor after each of its samples; the rim's path is exact."""
    memory, seen = sensor.start(output_at(jnp.zeros(()))), []
    for k in range(count):
        t = k * PERIOD
        memory = Memory(jnp.asarray(8.0 * t - 2.5 * t**2), memory.held)
        memory = sensor.tick(Clock(jnp.asarray(t), PERIOD, k, None), memory, output_at(t))
        seen.append(sensor.output(t, memory, output_at(t)))
    return seen


@killed_by("parts.sensors.encoder", "(v - w) / (v + self.floor)", "(v - w) / v")
@killed_by("parts.sensors.encoder", "(signal.distance - m.vehicle) / self.period", "signal.speed")
def test_speeds_are_means_over_the_last_period():
    with jax.enable_x64(True):
        seen = samples(EncoderSlip(period=PERIOD), 5)
    for k, one in enumerate(seen):
        middle = max(k - 0.5, 0.0) * PERIOD
        v, w = 10.0 - 2.0 * middle, 8.0 - 5.0 * middle
        np.testing.assert_allclose([one.speed, one.wheel_speed], [v, w], rtol=1e-12)
        np.testing.assert_allclose(one.slip, (v - w) / (v + 0.01), rtol=1e-12)


@killed_by("parts.sensors.encoder", "jnp.where(x < self.dead_zone, 0.0, x)", "x")
def test_below_the_dead_zone_a_speed_is_zero():
    with jax.enable_x64(True):
        slow, slower = samples(EncoderSlip(period=PERIOD, dead_zone=9.0), 2)
    assert slow.wheel_speed == 0
    assert slow.speed == 10.0
    np.testing.assert_allclose(slower.slip, 1 / (1 + 0.01 / 9.99), rtol=1e-12)


def test_between_two_samples_it_holds():
    sensor = EncoderSlip(period=PERIOD)
    memory = sensor.start(output_at(jnp.zeros(())))
    later = sensor.tick(Clock(jnp.asarray(1e-3), 1e-3, 1, None), memory, output_at(jnp.asarray(1e-3)))
    assert jax.tree.all(jax.tree.map(lambda a, b: a == b, later.held, memory.held))
