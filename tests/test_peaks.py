"""Peaks of what a control does, between the ends of a step."""

import jax
import jax.numpy as jnp
import numpy as np
import parts
import pytest

from diffabs.core.messages import Segment
from diffabs.core.protocols import Shown
from diffabs.objectives import PeakVoltage


def step(voltage, h, smooth):
    """A step of length h of a balance under voltage(t)."""

    def at(t):
        return parts.balancing_at(t)._replace(control=voltage(t))

    (a, da), (b, db) = (jax.jvp(at, (t,), (jnp.ones_like(t),)) for t in jnp.array([0.0, h]))
    return Segment(a, b, h, h, lambda: (Shown.of(da), Shown.of(db)), lambda: (da, db), smooth)


@pytest.mark.parametrize(("smooth", "peak"), [(True, 24.0), (False, 19.2)])
def test_a_voltage_rises_and_falls_within_a_long_step(smooth, peak):
    """u = 24 - 30 (t - 0.4)^2 over a step of 1 s. If the step would not end on a limit, only its ends are seen."""
    segment = step(lambda t: 24.0 - 30.0 * (t - 0.4) ** 2, 1.0, smooth)
    objective = PeakVoltage()
    np.testing.assert_allclose(objective.update(objective.start(segment.start), segment), peak, rtol=1e-12)


def test_a_voltage_that_rises_to_a_limit_does_not_leave_it():
    """u = 20 + 8 t to 24, where the step ends and the voltage falls: its slope there says nothing about the step."""
    objective, segment = PeakVoltage(), step(lambda t: jnp.where(t < 0.5, 20.0 + 8.0 * t, 26.0 - 4.0 * t), 0.5, True)
    np.testing.assert_allclose(objective.update(objective.start(segment.start), segment), 24.0, rtol=1e-12)
