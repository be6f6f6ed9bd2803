"""Dead times against closed forms: the mean of the control of a relay that toggles, its derivatives, and the limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from delays import H, loop
from mutants import killed_by
from signals import Mean

import diffabs as d
from diffabs.core.blocks import Series
from diffabs.core.protocols import Memory
from diffabs.parts.actuators import AsymmetricLag, DeadTime, Lag
from diffabs.parts.controllers import PlayedCommand

PERIOD, LENGTH = 0.01, 0.2
PULSE = np.array([0.0, 3.0, 3.0, 0.0, 0.0, 0.0])  # 3 from 10 to 30 ms


def run_of(actuator, commands=PULSE, step=H, **solver):
    controller = PlayedCommand(commands=np.asarray(commands), period=PERIOD)
    return d.rollout(loop(controller, actuator), d.FixedStep(step, LENGTH, **solver), {"mean": Mean()})


@pytest.mark.parametrize(("rise", "fall"), [(0.013, 0.0042), (0.0042, 0.013), (0.01, 0.01), (0.045, 0.052)])
@killed_by("parts.actuators.dead_time", "jnp.where(rises, self.rise, self.fall)", "self.rise")
def test_a_pulse_is_longer_or_shorter_by_the_difference(rise, fall):
    run = run_of(DeadTime(rise=rise, fall=fall))
    assert not run.diverged
    np.testing.assert_allclose(run.metrics["mean"][1], 3.0 * (0.02 + fall - rise) / LENGTH, rtol=1e-5)


@killed_by("parts.actuators.dead_time", "jnp.where(before, m.due, jnp.inf)", "m.due")
@pytest.mark.slow
def test_a_fall_that_would_come_first_cancels_the_pulse():
    assert run_of(DeadTime(rise=0.035, fall=0.01)).metrics["mean"][1] == 0
    two = run_of(DeadTime(rise=0.035, fall=0.01), [0.0, 1.0, 2.0, 0.0, 0.0, 0.0])  # the fall cancels both rises
    assert two.metrics["mean"][1] == 0
    run = run_of(DeadTime(rise=0.035, fall=0.01), [0.0, 3.0, 3.0, 0.0, 0.0, 5.0, 5.0, 5.0, 5.0, 0.0])
    np.testing.assert_allclose(run.metrics["mean"][1], 5.0 * (0.04 - 0.025) / LENGTH, rtol=1e-5)


@killed_by("parts.actuators.dead_time", "jnp.concatenate([m.due[1:]", "jnp.concatenate([m.due[:-1]")
def test_several_switches_are_on_their_way():
    commands = [0.0, 1.0, 0.0, 4.0, 2.0, 0.0]
    run = run_of(DeadTime(rise=0.061, fall=0.064), commands)
    expected = 1.0 * (0.01 + 0.003) + 4.0 * (0.01 + 0.003) + 2.0 * 0.01  # the last of them falls from 2 like from 4
    np.testing.assert_allclose(run.metrics["mean"][1], (expected - 0.0) / LENGTH, rtol=1e-5)


@killed_by("core.validity", 'part, "plant", None)), "problems")', 'part, "plant", None)), "none")')
@pytest.mark.parametrize(
    ("capacity", "message"),
    [
        (0, r"capacity = 0 is outside \[1, inf\) switches"),
        (2.5, r"capacity = 2.5 is no integer; one in \[1, inf\) switches is needed"),
    ],
)
def test_no_place_for_a_switch_is_refused_by_its_name(capacity, message):
    given = loop(PlayedCommand(), DeadTime(capacity=capacity))
    for use in (d.check, lambda given: d.measure(given, d.FixedStep(H, 10 * H), {})):
        with pytest.raises(ValueError, match=f"^actuator.{message}$"):
            use(given)


@pytest.mark.slow
def test_more_switches_than_its_capacity_are_a_run_that_diverged():
    commands = [0.0, 1.0] * 9
    assert run_of(DeadTime(rise=0.095, fall=0.095, capacity=4), commands).diverged
    assert not run_of(DeadTime(rise=0.095, fall=0.095, capacity=10), commands).diverged


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rise", "fall"])
def test_derivatives_are_those_of_the_closed_form(name):
    with jax.enable_x64(True):

        def mean(x):
            return run_of(d.replace(DeadTime(rise=0.0131, fall=0.0137), {name: x})).metrics["mean"][1]

        expected = -3.0 / LENGTH if name == "rise" else 3.0 / LENGTH
        np.testing.assert_allclose(jax.jacfwd(mean)(jnp.asarray(0.0142)), expected, rtol=1e-9)
        np.testing.assert_allclose(jax.grad(mean)(jnp.asarray(0.0142)), expected, rtol=1e-9)


@pytest.mark.slow
def test_adaptive_steps_and_a_lag_behind_it():
    """The mean of a lag's output over a long time is the mean of its input."""
    actuator = Series(blocks=(DeadTime(rise=0.0123, fall=0.0042), Lag(time_constant=2e-3)))
    controller = PlayedCommand(commands=PULSE, period=PERIOD)
    solver = d.Adaptive(rtol=1e-7, step=5e-3, duration=LENGTH)
    with jax.enable_x64(True):
        run = d.rollout(loop(controller, actuator), solver, {"mean": Mean()})
    np.testing.assert_allclose(run.metrics["mean"][1], 3.0 * (0.02 + 0.0042 - 0.0123) / LENGTH, rtol=1e-6)


@killed_by("parts.actuators.lag", "jnp.where(excess > 0, self.rise, self.fall)", "self.rise")
def test_an_asymmetric_lag_is_two_exponentials():
    lag = AsymmetricLag(rise=0.02, fall=0.005)
    with jax.enable_x64(True):
        run = run_of(lag, [1.0, 1.0, 1.0, 0.0], step=5e-4)
        top = 1 - np.exp(-0.03 / 0.02)
        rising = 0.03 - 0.02 * top
        np.testing.assert_allclose(run.metrics["mean"][1], (rising + 0.005 * top) / LENGTH, rtol=1e-6)
    assert lag.flow(0.0, Memory(flow=1.0), 1.0) == 0
