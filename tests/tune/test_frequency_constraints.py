"""[tune.constraints]: values with units, what no loop can meet, and the poles of known loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

from diffabs.host.values import ScenarioError
from diffabs.linear.responses.response import TracedSystem
from diffabs.scenario import tuning
from diffabs.scenario.scenario import load
from diffabs.tune.frequency_bounds import least_of_poles

W0, RATIO, PERIOD = 30.0, 0.4, 2e-3  # rad/s, 1, s


def load_with(constraint, scenario="slip-cured"):
    return load(scenario, [f"tune.constraints.{constraint}"], integrated=False)


@pytest.mark.parametrize(
    ("constraint", "value"),
    [
        ('delay_margin="4.5 ms"', 4.5e-3),
        ('delay_margin="450 us"', 450e-6),
        ("delay_margin=4.5e-3", 4.5e-3),
        ('phase_margin="40 deg"', np.deg2rad(40.0)),
        ('phase_margin="0.7"', 0.7),
    ],
)
def test_a_margin_has_a_unit(constraint, value):
    bounds = load_with(constraint).tune.constraints.bounds()
    assert bounds == {constraint.partition("=")[0]: pytest.approx(value, rel=1e-15)}


@killed_by("scenario.section_tune", "max(bound for _, bound in rows) < 1", "max(bound for _, bound in rows) < 0")
@pytest.mark.parametrize(
    ("constraint", "message"),
    [
        ('delay_margin="5 hours"', 'delay_margin = "5 hours": a time is needed, as in "5 ms"'),
        ('delay_margin="-5 ms"', r"delay_margin = -0.005 is outside \(0, inf\) s"),
        ('phase_margin="200 deg"', r"phase_margin = 3.49.* is outside \(0, 3.14159\] rad"),
        ('phase_margin="wide"', 'phase_margin = "wide": an angle is needed, as in "40 deg"'),
        ("shape=[[10.0, 0.5], [100.0, 0.9]]", "no loop keeps .S. below 1 at all frequencies"),
        ("shape=[[10.0, 0.0], [100.0, 1.9]]", r"0 is outside \(0, inf\)"),
        ("sensitivity=1.0", r"1 is outside \(1, inf\)"),
        ("control_noise=0.0", r"0 is outside \(0, inf\)"),
        ("pole_damping=1.5", r"1.5 is outside \(0, 1\]"),
    ],
)
def test_a_bound_that_cannot_be_is_refused(constraint, message):
    with pytest.raises(ScenarioError, match=message):
        load_with(constraint)


@killed_by(
    "scenario.tuning", "        check_one_control(scenario.tune.constraints.bounds(), scenario.loop)", "        pass"
)
def test_a_bound_of_one_control_is_refused_first():
    """Before the sections that are missing too."""
    with pytest.raises(ScenarioError, match="phase_margin: of one control; the plant has pump_1, pump_2"):
        tuning.build_work(load_with("phase_margin=0.7", "quadruple-tank"))


def closed_by(gain_scale=1.0):
    """Return an open loop whose closed loop is s^2 + 2 d w0 s + w0^2."""
    a = jnp.array([[-2 * RATIO * W0, 0.0], [1.0, 0.0]])
    b, c = jnp.eye(2, 1), jnp.array([[0.0, 1.0]]) * W0**2 * gain_scale
    return TracedSystem(a, b, c, jnp.zeros((1, 1)), None, jnp.zeros(()))


@killed_by("tune.frequency_bounds", "-poles.real / jnp.abs(poles)", "-poles.real")
def test_poles_of_a_second_order_loop():
    """With the gain times f the damping ratio is d/sqrt(f), and the decay rate stays."""

    def damping(factor):
        return least_of_poles(closed_by(factor), "pole_damping")[0]

    value, slope = map(float, jax.value_and_grad(damping)(1.0))
    assert (value, slope) == pytest.approx((RATIO, -RATIO / 2), rel=1e-9)
    for width in (1e-3, 1e-4, 1e-5):
        difference = float(damping(1 + width) - damping(1 - width)) / (2 * width)
        assert slope == pytest.approx(difference, rel=1e-5)
    np.testing.assert_allclose(least_of_poles(closed_by(), "pole_decay"), RATIO * W0, rtol=1e-9)


@killed_by("tune.frequency_bounds", "jnp.where(opened.delay > 0, jnp.nan, ", "jnp.where(False, jnp.nan, ")
def test_poles_of_a_sampled_loop_and_of_a_delayed_one():
    """A feedback that moves z1 = e^(s1 T) and the mode at z = 0, which decays at once, is known in closed form."""
    s = W0 * (-RATIO + 1j * np.sqrt(1 - RATIO**2))
    z = np.exp(s * PERIOD)
    a = jnp.array([[2 * z.real, -(abs(z) ** 2), 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    loop = TracedSystem(a, jnp.zeros((3, 1)), jnp.zeros((1, 3)), jnp.zeros((1, 1)), PERIOD, jnp.zeros(()))
    np.testing.assert_allclose(least_of_poles(loop, "pole_decay")[:2], RATIO * W0, rtol=1e-9)
    np.testing.assert_allclose(least_of_poles(loop, "pole_damping")[:2], RATIO, rtol=1e-9)
    late = loop._replace(delay=jnp.asarray(PERIOD))
    assert np.isnan(least_of_poles(late, "pole_decay")).all()
