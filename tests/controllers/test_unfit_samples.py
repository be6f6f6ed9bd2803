"""Samples that are not numbers: a sampled controller holds its memory and its command, in runs and on a computer."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs.core.protocols import no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.core.validity import find_problems
from diffabs.parts.controllers import (
    PID,
    BackCalculation,
    BandLogic,
    ConstantInput,
    PlayedCommand,
    Sampled,
    SampledOnGrid,
)
from diffabs.parts.plants import BrakeStart, MirroredRig
from diffabs.parts.references import FixedSlip
from diffabs.scenario.defaults import braking

PERIOD, STEP, SAMPLES = 1e-3, 5e-4, 60
LOST = slice(20, 26)  # samples


@pytree
class Loses:
    """A sensor that shows a NaN for a while: the slip or, which no controller here reads, the wheel's speed."""

    first: Any = param(default=19.5 * PERIOD, unit="s")
    last: Any = param(default=25.5 * PERIOD, unit="s")
    other: Any = param(default=0.0, unit="1")

    start, flow = no_memory, no_flow

    def output(self, t, memory, signal):
        lost = jnp.where((t > self.first) & (t < self.last), jnp.nan, 0.0)
        slip = signal.slip + jnp.where(self.other > 0, 0.0, lost)
        return signal._replace(slip=slip, wheel_speed=signal.wheel_speed + jnp.where(self.other > 0, lost, 0.0))


def rig(controller, **sensor):
    return braking(
        plant=MirroredRig(),
        reference=FixedSlip(slip=0.2),
        feedforward=ConstantInput(value=2.7),
        sensor=Loses(**sensor),
        controller=controller,
        initial=BrakeStart(speed=10.0, slip=0.19),
    )


def computers(inner):
    return (
        Sampled(controller=inner, period=PERIOD),
        SampledOnGrid(controller=inner, sampling_period=PERIOD),
    )


def trajectory(loop):
    """Slip and command at the samples."""
    run = d.rollout(loop, d.FixedStep(STEP, SAMPLES * PERIOD, every=round(PERIOD / STEP), kinks=False), {})
    kept = run.trajectory.sample
    return np.asarray(kept.output.slip)[:SAMPLES], np.asarray(kept.command)[:SAMPLES]


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1], ids=["sampled", "sampled on the grid"])
def test_a_lost_sample_holds_memory_and_command(which):
    """Against the difference equations of the PID, which skip the samples that are lost."""
    slips, commands = trajectory(rig(computers(PID(kp=60.0, ki=400.0, kd=0.3, high=9.03, low=0.0))[which]))
    integral, filtered, wanted = 0.0, 0.0, []
    for k, slip in enumerate(slips):
        if k in range(LOST.start, LOST.stop):
            wanted.append(wanted[-1])
            continue
        error = 0.2 - slip
        rate = 55.0 * (error - filtered)
        wanted.append(min(max(2.7 + 60.0 * error + 400.0 * integral + 0.3 * rate, 0.0), 9.03))
        integral, filtered = integral + PERIOD * error, filtered + PERIOD * rate
    np.testing.assert_allclose(commands, wanted, rtol=1e-9)
    assert np.ptp(commands[LOST]) == 0.0
    assert np.ptp(commands[LOST.stop :]) > 1e-3


@pytest.mark.slow
def test_what_the_controller_does_not_read_is_not_missed():
    inner = PID(kp=60.0, ki=400.0, high=9.03, low=0.0)
    _, whole = trajectory(rig(computers(inner)[0], first=1.0, last=2.0))
    _, other = trajectory(rig(computers(inner)[0], other=1.0))
    np.testing.assert_array_equal(other, whole)
    assert np.ptp(other[LOST]) > 0


@pytree
class Switch:
    """3 N m below the target, else 1 N m: a comparison with a NaN is false, so a lost sample would command 1 N m."""

    start, flow = no_memory, no_flow

    def output(self, t, memory, signal):
        return jnp.where(signal.measured.slip < signal.target, 3.0, 1.0)


@pytest.mark.slow
def test_a_comparison_does_not_hide_that_a_sample_is_lost():
    slips, commands = trajectory(rig(computers(Switch())[0]))
    kept = np.r_[: LOST.start, LOST.stop : SAMPLES]
    np.testing.assert_array_equal(commands[kept], np.where(slips[kept] < 0.2, 3.0, 1.0))
    np.testing.assert_array_equal(commands[LOST], commands[LOST.start - 1])
    assert set(commands) == {1.0, 3.0}
    assert commands[LOST.start] == 3.0


@pytree
class Filter:
    """A filter of its own, which is no Euler step and has no clock; its margin asks for a rate."""

    cutoff: Any = param(default=500.0, unit="Hz")
    period: Any = param(default=0.015, unit="s")

    start, flow = no_memory, no_flow

    def output(self, t, memory, signal):
        return signal.target * jnp.exp(-self.cutoff * PERIOD)

    def margins(self, t, memory, signal, rate):
        return (rate().target,)

    def event(self, t, memory, signal, fired):
        return memory


@killed_by("parts.controllers.sampled", "(decay) * as_rule_array(period) < 1", "(decay) < 1e9")
@killed_by("parts.controllers.sampled", 'hasattr(controller, "period")', "False")
@killed_by("parts.controllers.sampled", 'if offers(controller, "tick") and', "if")
@killed_by("parts.controllers.sampled", "isinstance(controller, PID)", 'hasattr(controller, "cutoff")')
@pytest.mark.parametrize(
    ("controller", "line"),
    [
        (BandLogic(decay=99.0), ""),  # a sample multiplies its torque by 0.01
        (
            BandLogic(decay=101.0),
            "controller.decay = 101 1/s is outside (0, 100) 1/s: sampled every 0.01 s",
        ),  # by -0.01
        (PlayedCommand(period=0.02), ""),
        (PlayedCommand(period=0.015), "controller.period = 0.015 s is not a multiple of the sampling period"),
        (PlayedCommand(period=1e-3), "controller.period = 0.001 s is not a multiple of the sampling period"),
        (Filter(), ""),
    ],
)
def test_a_controller_that_does_not_fit_its_period(controller, line):
    for computer in (
        Sampled(controller=controller, period=0.01),
        SampledOnGrid(controller=controller, sampling_period=0.01),
    ):
        problems = list(find_problems(computer))
        assert len(problems) == bool(line)
        assert all(one.startswith(line) for one in problems)


@killed_by("parts.controllers.sampled", "memory, signal, _refuse_rate))", "memory, signal, None))")
def test_a_sampled_controller_has_no_rate():
    with pytest.raises(ValueError, match="the signal of a sampled controller has no rate"):
        d.check(rig(Sampled(controller=Filter())), d.FixedStep(STEP, 1.0))


@killed_by(
    "parts.controllers.sampled",
    "as_rule_array(period) < 2 * as_rule_array(tracking_time)",
    "as_rule_array(period) < 200 * as_rule_array(tracking_time)",
)
@pytest.mark.parametrize(("tracking", "holds"), [(5.1e-3, True), (4.9e-3, False)])
def test_a_back_calculation_too_fast_for_its_samples(tracking, holds):
    """The oracle is the computer's own recursion at a constant error, written out: does it stay at its limit of 20?"""
    period, kp, ki, error, integral, said = 0.01, 500.0, 5000.0, 0.2, 0.0, []
    for _ in range(3000):
        raw = kp * error + ki * integral
        said.append(min(max(raw, 0.0), 20.0))
        integral += period * (error + (said[-1] - raw) / (ki * tracking))
    assert (min(said[-100:]) == 20.0) == holds
    pid = PID(kp=kp, ki=ki, low=0.0, high=20.0, antiwindup=BackCalculation(tracking_time=tracking))
    for computer in (Sampled(controller=pid, period=period), SampledOnGrid(controller=pid, sampling_period=period)):
        line = f"controller.antiwindup.tracking_time = {tracking:g} s is outside (0.005, inf) s: sampled every 0.01 s"
        problems = list(find_problems(computer))
        assert len(problems) == (not holds)
        assert all(one.startswith(line) for one in problems)
