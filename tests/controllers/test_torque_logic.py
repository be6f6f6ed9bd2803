"""The four-phase and the band logic against closed forms, and the limit cycle of a hybrid brake."""

import jax
import numpy as np
import pytest
from delays import loop
from mutants import killed_by
from signals import Mean, Script, seen

import diffabs as d
from diffabs.core.blocks import Direct
from diffabs.parts.actuators import Lag
from diffabs.parts.controllers import BandLogic, FourPhase, Sampled

RISING = Script(read=lambda t: seen(0.4 * t))  # slip 0.4 t
LENGTH = 0.5


def mean(controller, plant=RISING, length=LENGTH):
    with jax.enable_x64(True):
        run = d.rollout(loop(controller, Direct(), plant), d.FixedStep(1e-3, length), {"mean": Mean()})
    assert not run.diverged
    return float(run.metrics["mean"][1])


@killed_by("parts.controllers.torque_logic", "phase == 2, 1.0, 0.0", "phase == 2, 2.0, 0.0")
@killed_by("parts.controllers.torque_logic", "self.slip_high - slip, slip - self.slip_low", "1.0, slip - self.slip_low")
@killed_by("parts.controllers.torque_logic", "(phase == 2) & (slip <= self.slip_low)", "phase > 4", case="falls")
@killed_by("parts.controllers.torque_logic", "jnp.where(phase == 0, slip >= self.slip_high,", "(", case="high")
@pytest.mark.parametrize(
    ("plant", "slip_low", "slip_high", "area"),
    [
        # Raise for 0.1 s, hold until slip 0.1 at 0.25 s, lower for 0.05 s, and hold for good: the slip stays high.
        (RISING, 0.02, 0.1, 0.5 * 10 * 0.1 + 10 * 0.15 + 7.5 * 0.05 + 5 * 0.2),
        # The slip is 0.04 where the torque reaches 10: no hold before it is lowered.
        (RISING, 0.02, 0.03, 0.5 * 10 * 0.1 + 7.5 * 0.05 + 5 * 0.35),
        # 0.16 there, and 0.14 where it reaches 5: it rises again at once, and is held for good.
        pytest.param(
            *(Script(read=lambda t: seen(0.2 - 0.4 * t)), 0.145, 0.15, 0.5 * 10 * 0.1 + 2 * 7.5 * 0.05 + 10 * 0.3),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["inside", "high", "falls"],
)
def test_four_phases(plant, slip_low, slip_high, area):
    logic = FourPhase(torque_low=5.0, torque_high=10.0, slip_low=slip_low, slip_high=slip_high, rate=100.0)
    np.testing.assert_allclose(mean(logic, plant), area / LENGTH, rtol=1e-9)


@killed_by("parts.controllers.torque_logic", "slip > self.slip_high, -self.decay", "slip > self.slip_high, self.decay")
def test_a_band_logic_is_three_exponentials():
    logic = BandLogic(slip_low=0.08, slip_high=0.12, growth=3.0, decay=5.0, torque=10.0)
    top = 10 * np.exp(3.0 * 0.2)  # slip 0.08 at 0.2 s, 0.12 at 0.3 s
    area = (top - 10) / 3.0 + top * 0.1 + top * (1 - np.exp(-5.0 * 0.2)) / 5.0
    np.testing.assert_allclose(mean(logic), area / LENGTH, rtol=1e-8)


@killed_by("parts.controllers.torque_logic", "& (memory.flow < self.high)", "")
@killed_by("parts.controllers.torque_logic", "smaller(self.torque, self.high)", "self.torque", case="20.0")
@pytest.mark.parametrize("torque", [10.0, 20.0])
def test_a_band_logic_falls_from_its_limit_at_once(torque):
    """At 12 from the start or from 10 exp(3 t) on, to slip 0.12 at 0.3 s; then 12 exp(-5 (t - 0.3))."""
    logic = BandLogic(slip_low=0.08, slip_high=0.12, growth=3.0, decay=5.0, torque=torque, high=12.0)
    top, rise = 12.0, np.log(1.2) / 3.0 if torque == 10.0 else 0.0
    area = (top - min(torque, top)) / 3.0 + top * (0.3 - rise) + top * (1 - np.exp(-5.0 * 0.2)) / 5.0
    np.testing.assert_allclose(mean(logic), area / LENGTH, rtol=1e-8)


@pytest.mark.slow
def test_a_sampled_band_logic_multiplies():
    """10 (1 + 3/50)^k while the slip is below the band, sampled every 20 ms."""
    logic = Sampled(controller=BandLogic(slip_low=0.9, slip_high=0.95, growth=3.0, torque=10.0), period=0.02)
    expected = np.mean(10 * 1.06 ** np.arange(25))
    np.testing.assert_allclose(mean(logic), expected, rtol=1e-9)


@pytest.mark.slow
def test_a_lag_follows_the_torque():
    """The mean of a lag's output is that of its input, less the last value times the lag's time constant."""
    logic = FourPhase(torque_low=5.0, torque_high=10.0, slip_low=0.02, slip_high=0.9, rate=100.0)
    with jax.enable_x64(True):
        run = d.rollout(loop(logic, Lag(time_constant=5e-3), RISING), d.FixedStep(1e-3, LENGTH), {"mean": Mean()})
    np.testing.assert_allclose(run.metrics["mean"][1], (0.5 + 10 * 0.4 - 10 * 5e-3) / LENGTH, rtol=1e-6)
