"""The integrating valve against its closed form."""

import jax
import numpy as np
import pytest
from delays import loop
from mutants import killed_by
from signals import Mean

import diffabs as d
from diffabs.parts.actuators import IntegratingValve
from diffabs.parts.controllers import PlayedCommand

LENGTH = 0.2


@pytest.mark.slow
@killed_by("parts.actuators.valve", "smaller(rate, 0.0)", "rate")
@killed_by("parts.actuators.valve", "self.gain * signal", "signal")
def test_a_valve_waits_at_its_limits():
    """Up at 200/s to the limit 2 within 10 ms, where it stays; down from 60 ms on to the limit 0, and up again."""
    commands = [1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0, -1.0, 1.0, 0.0]
    controller = PlayedCommand(commands=np.array(commands), period=0.02)
    with jax.enable_x64(True):
        run = d.rollout(
            loop(controller, IntegratingValve(gain=200.0, low=0.0, high=2.0)),
            d.FixedStep(1e-3, LENGTH),
            {"mean": Mean()},
        )
    ramp = 2.0 * 0.01 / 2
    area = (ramp + 2.0 * 0.05) + ramp + (ramp + 2.0 * 0.03)
    np.testing.assert_allclose(run.metrics["mean"][1], area / LENGTH, rtol=1e-9)
