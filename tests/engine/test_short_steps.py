"""Steps far shorter than the span. A step that cannot meet its tolerance ends the run."""

from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from shown_state import ShownState

import diffabs as d
from diffabs import controllers, objectives, references, stops
from diffabs.core.pytree import param, pytree
from diffabs.engine.field import SolutionStatus

ACCURACY = 1e-6  # for an rtol of 1e-8


@killed_by("engine.step.step_size", "number.tiny / number.eps", "1e-9")
def test_a_layer_is_resolved_however_thin_it_is():
    """dy/dt = exp(-t/width)/width from 0: 1 - exp(-1/width) at t = 1, which is 1 here."""
    widths = jnp.array([1e-6, 1e-9, 1e-10, 1e-11, 1e-12, 1e-14, 1e-17])
    found = jax.vmap(
        lambda width: d.solve(lambda t, y, w: jnp.exp(-t / w) / w, 0.0, 0.0, 1.0, width, solver=d.Adaptive(1e-8))
    )(widths)
    np.testing.assert_allclose(found.y, np.ones(7), rtol=ACCURACY)
    assert set(found.status.tolist()) == {SolutionStatus.FINISHED}


def coast(t, y, args):
    """Speed, and the integral of 1/speed, which is infinite at standstill."""
    return jnp.array([-9.81, 1 / y[0]])


SINGULAR = {  # fields without a solution at t = 4, with their starts
    "standstill": (coast, [20.0, 0.0]),
    "time": (lambda t, y, args: 1 / (1.0 - t) + 0.0 * y, [0.0]),
    "time, squared": (lambda t, y, args: 1 / (1.0 - t) ** 2 + 0.0 * y, [0.0]),
    "beside a switch": (lambda t, y, args: jnp.where(t < 0.5, 1.0, 1 / (1.0 - t)) + 0.0 * y, [0.0]),
}


@pytest.mark.slow
@killed_by(
    "engine.step.adaptive",
    "exact = (error <= 1) & (past_crossing <= 0)",
    "exact = (error <= 1) | (carry.length <= self.closest)",
)
@pytest.mark.parametrize("name", SINGULAR)
def test_no_step_passes_over_a_singularity(name):
    """SciPy's RK45 and DOP853 stop there: "Required step size is less than spacing between numbers"."""
    field, start = SINGULAR[name]

    def end(scale, engine="xla", rtol=1e-8):
        start_ = scale * jnp.array(start)
        found = d.solve(field, start_, 0.0, 4.0, solver=d.Adaptive(rtol), engine=engine)
        return found.y[-1], found.status

    value, status = end(1.0, rtol=1e-5)
    assert np.isnan(value)
    assert status == SolutionStatus.DIVERGED
    assert np.all(np.isnan(jax.grad(end, has_aux=True)(1.0)[0]))
    value, status = jax.vmap(lambda scale: end(scale, "kernel"))(jnp.array([1.0, 1.1]))
    assert np.all(np.isnan(value))
    assert set(status.tolist()) == {SolutionStatus.DIVERGED}


@pytest.mark.slow
def test_a_singularity_beyond_the_end_is_no_fault():
    """The integral of 1/speed is log(20/v)/9.81, up to a thousandth of a second before standstill."""
    for dtype, accuracy in ((jnp.float64, 1e-6), (jnp.float32, 1e-3)):
        end = 20 / 9.81 - 1e-3
        found = d.solve(coast, jnp.array([20.0, 0.0], dtype), dtype(0.0), dtype(end), solver=d.Adaptive(1e-5))
        assert found.status == SolutionStatus.FINISHED
        assert found.y[1] == pytest.approx(np.log(20 / (20 - 9.81 * end)) / 9.81, rel=accuracy)


class CoastOutput(NamedTuple):
    pace: Any
    speed: Any
    units = MappingProxyType({"pace": "s^2/m", "speed": "m/s"})


@pytree
class CoastStart:
    speed: Any = param(default=20.0, unit="m/s", above=0.0)


@pytree
class Coast(ShownState):
    """`coast` as a plant: no control moves it."""

    brake: Any = param(default=9.81, unit="m/s^2", above=0.0)
    shows, control_unit = CoastOutput, "N"

    def start(self, initial):
        return CoastOutput(0.0 * initial.speed, initial.speed)

    def derivative(self, t, state, control):
        return CoastOutput(1 / state.speed + 0.0 * control, -self.brake)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["xla", "kernel"])
def test_no_step_of_a_loop_passes_over_a_singularity(engine):
    """The IAE of a setpoint of 0 is the integral of log(20/v)/brake: v - v log(v/20) from the end to the start."""
    parts = {"reference": references.Setpoint(value=0.0), "controller": controllers.PID(), "stop": stops.NoStop()}
    loop = d.Loop(plant=Coast(), initial=CoastStart(), **parts)
    end, measured = 1.9, {"iae": objectives.IAE()}

    def iae(brakes):
        batch = d.Batch({"plant.brake": brakes})
        run = d.run_batch(loop, batch, d.Adaptive(1e-7, end, 0.1), measured, engine=engine)
        return run.metrics["iae"], run.diverged

    brakes = jnp.array([9.81, 10.0, 11.0, 12.0])  # standstill after 2.04, 2, 1.82, 1.67 s
    run, slopes, diverged = jax.jvp(iae, (brakes,), (jnp.ones(4),), has_aux=True)
    last = 20.0 - brakes * end
    truth = (20.0 - last + last * jnp.log(last / 20.0)) / brakes**2
    np.testing.assert_allclose(run, jnp.where(last > 0, truth, jnp.nan), rtol=1e-5)
    assert np.isnan(slopes).tolist() == [False, False, True, True]
    assert diverged.tolist() == [False, False, True, True]


class WakingOutput(NamedTuple):
    heat: Any
    speed: Any
    units = MappingProxyType({"heat": "J", "speed": "m/s"})


@pytree
class Waking(ShownState):
    """A speed 1 - t, and heat that is exactly zero until the speed is below `wakes`, with a kink or a jump."""

    wakes: Any = param(default=0.5, unit="m/s", above=0.0)
    slope: Any = param(default=1.0, unit="W/(m/s)", above=0.0)
    jump: Any = param(default=0.0, unit="W", low=0.0)
    shows, control_unit = WakingOutput, "N"

    def start(self, initial):
        return WakingOutput(0.0 * initial.speed, initial.speed)

    def derivative(self, t, state, control):
        below = self.wakes - state.speed
        return WakingOutput(jnp.where(below > 0, self.slope * below + self.jump, 0.0) + 0.0 * control, -1.0)


@killed_by("engine.step.adaptive", "jnp.where(starts & (before == 0), jnp.inf, now)", "now")
@pytest.mark.slow
@pytest.mark.parametrize("rtol", [1e-5, 1e-8, 1e-11])
def test_a_state_that_is_zero_until_a_comparison_changes(rtol):
    """Heat is jump s + slope s^2/2 a time s after the change; its integral up to the end is the IAE of a setpoint 0."""
    parts = {
        "reference": references.Setpoint(value=0.0),
        "controller": controllers.ConstantTorque(torque=0.0),
        "stop": stops.NoStop(),
    }
    loop = d.Loop(plant=Waking(), initial=CoastStart(speed=1.0), **parts)
    wakes, slope, jump = (x.ravel() for x in np.meshgrid([0.3, 0.5, 1 / 1.3], [1e-3, 1.0, 1e6], [0.0, 1e-3, 1e3]))
    batch = d.Batch({"plant.wakes": wakes, "plant.slope": slope, "plant.jump": jump})
    run = d.run_batch(loop, batch, d.Adaptive(rtol, 1.0, 0.1), {"iae": objectives.IAE()})
    assert not np.any(run.diverged)
    np.testing.assert_allclose(
        run.metrics["iae"], jump * wakes**2 / 2 + slope * wakes**3 / 6, rtol=max(30 * rtol, 1e-9)
    )
