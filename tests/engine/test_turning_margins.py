"""Margins that turn near zero: a mass that swings just beyond its stop; a mass and a wheel that leave their rest."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from shown_state import ShownState

import diffabs as d
from diffabs.core.protocols import Memory, no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.engine.step.outlook import Outlook, find_turns
from diffabs.parts.actuators import Lag
from diffabs.parts.controllers import ConstantTorque, Relay
from diffabs.parts.objectives import BRAKING
from diffabs.parts.plants import LabRig
from diffabs.parts.references import FixedSlip, Setpoint
from diffabs.parts.stops import NoStop, SpeedReached
from diffabs.scenario.defaults import braking


class Motion(NamedTuple):
    """Speed [m/s] and place [m]."""

    v: float
    x: float


@pytree
class Start:
    """Speed at the start, at the place zero."""

    v: float = param(default=4.0, unit="m/s")


@pytree
class Swing(ShownState):
    """A mass of 1 kg on a spring: v = 4 cos(sqrt(k) t)."""

    stiffness: float = param(default=1.0, unit="N/m")
    control_unit = "N"

    def start(self, initial):
        return Motion(initial.v, 0.0 * initial.v)

    def derivative(self, t, state, control):
        return Motion(control - self.stiffness * state.x, state.v)


@pytree
class Friction(Swing):
    """A mass under dry friction: it comes to rest, and slides again when the control exceeds the friction."""

    friction: float = param(default=2.0, unit="N")

    def derivative(self, t, state, control):
        push = control - self.friction
        return Motion(jnp.where(state.v > 0, push, jnp.maximum(push, 0.0)), state.v)

    def project(self, state):
        return Motion(jnp.where(state.v > 0, state.v, 0.0), state.x)


@pytree
class Ramp:
    """The control t."""

    start, flow = no_memory, no_flow

    def output(self, t, memory, signal):
        return t


@pytree
class Backwards(NoStop):
    """The mass has this speed."""

    v: float = param(default=-3.98, unit="m/s")

    def margin(self, output):
        return output.v - self.v


@pytree
class Rest:
    """Time at rest."""

    unit = "s"
    physical = (0.0, jnp.inf)

    def start(self, sample):
        return Memory(flow=0.0 * sample.t)

    def flow(self, memory, sample):
        return jnp.where(sample.output.v > 0, 0.0, 1.0)

    def update(self, memory, segment):
        return memory.held

    def value(self, memory, ending):
        return memory.flow


@pytree
class End(Rest):
    """Time at the end."""

    def start(self, sample):
        return Memory()

    def flow(self, memory, sample):
        return ()

    def value(self, memory, ending):
        return ending.sample.t


def swing(depth=5e-3):
    """A mass that is faster than its stop by this share of its greatest speed, for a short time."""
    parts = {"reference": Setpoint(value=0.0), "controller": ConstantTorque(torque=0.0)}
    return d.Loop(plant=Swing(), initial=Start(), stop=Backwards(v=-4.0 * (1 - depth)), **parts)


DIPS = {  # cubics that are positive at both ends of a step from 0 to 1
    "falls from the start": np.poly1d([-7.2, 14.4, -7.2, 1.0]),  # as far as its slope there can make it
    "rises first": np.poly1d([-0.1, 0.5, 0.9], r=True),
    "falls at the end": -np.poly1d([0.2, 0.5, 1.4], r=True),
}


@killed_by("engine.step.outlook", "(bend != 0, bend, jnp.inf)", "(bend > 0, bend, jnp.inf)", case="rises first")
@killed_by("engine.step.outlook", "_EFFECT = 4 / 27", "_EFFECT = 3 / 27", case="falls from the start")
@pytest.mark.parametrize("name", DIPS)
def test_a_dip_of_a_cubic_is_found(name):
    """Its minimum by NumPy; beside it a margin that is infinite, and one that stays positive."""
    cubic = DIPS[name]
    ends = [Outlook(jnp.array([np.inf, cubic(x), 1.0]), jnp.array([0.0, cubic.deriv()(x), 0.1])) for x in (0.0, 1.0)]
    lowest = min((x for x in np.roots(cubic.deriv()).real if 0 < x < 1), key=cubic)
    assert cubic(0.0) > 0 > cubic(lowest)
    assert cubic(1.0) > 0
    turns = find_turns(*ends, jnp.asarray(1.0), jnp.zeros(3, bool))
    np.testing.assert_allclose(turns.time_since, 1 - lowest, rtol=1e-12)
    assert not turns.grazes


STIFFNESSES = np.linspace(0.3, 2.5, 12)


@killed_by(
    "engine.step.switching",
    "dynamics.surfaces, changed, h), turns.time_since)",
    "dynamics.surfaces, changed, h), 0.0)",
)
@pytest.mark.slow
@pytest.mark.parametrize("rtol", [1e-3, 1e-4])
def test_a_stop_that_is_passed_for_a_moment(rtol):
    """Its time in closed form. The margin is positive at both ends of a step with the rtol of 1e-4."""
    for depth in (1e-2, 1e-3):
        values = {"plant.stiffness": STIFFNESSES}
        runs = d.run_batch(swing(depth), d.Batch(values), d.Adaptive(rtol, 20.0), {"end": End()}, engine="xla")
        assert runs.stopped.all()
        np.testing.assert_allclose(runs.metrics["end"], np.arccos(depth - 1) / np.sqrt(STIFFNESSES), rtol=10 * rtol)


@pytest.mark.slow
def test_its_derivative_is_that_of_the_run():
    def end(stiffness):
        loop = d.replace(swing(), {"plant.stiffness": stiffness})
        return d.measure(loop, d.Adaptive(1e-4, 20.0), {"end": End()}).metrics["end"]

    time, slope = jax.jvp(end, (1.0,), (1.0,))
    np.testing.assert_allclose([time, slope], np.arccos(-0.995) * np.array([1.0, -0.5]), rtol=1e-4)


def rest(friction, solver):
    """The time at rest under the control t: from friction - sqrt(friction^2 - 2) to friction."""
    parts = {"reference": Setpoint(value=0.5), "controller": Ramp()}
    loop = d.Loop(plant=Friction(friction=friction), initial=Start(v=1.0), stop=Backwards(), **parts)
    return d.measure(loop, solver, {"rest": Rest()}).metrics["rest"]


FIXED = d.FixedStep(1e-2, 3.0)


@killed_by(
    "engine.step.replay",
    "(old.search.fall == 0) | is_return(old, lands)",
    "is_return(old, lands)",
    case="adaptive",
)
@killed_by(
    "engine.step.replay",
    "jnp.where(with_start, carry.control.delay,",
    "jnp.where(with_start, 0.0,",
    case="adaptive",
)
@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", [pytest.param(d.Adaptive(1e-8, 3.0), id="adaptive"), pytest.param(FIXED, id="fixed")]
)
def test_the_time_at_rest_has_a_derivative(solver):
    """The speed leaves zero with the slope zero, so the friction decides when it does."""
    frictions = np.linspace(2.003, 2.0293, 12)  # not on the grid of fixed steps
    times, slopes = jax.jit(jax.vmap(lambda f: jax.jvp(lambda f: rest(f, solver), (f,), (1.0,))))(frictions)
    np.testing.assert_allclose(times, np.sqrt(frictions**2 - 2), rtol=1e-7)
    np.testing.assert_allclose(slopes, frictions / np.sqrt(frictions**2 - 2), rtol=1e-7)


@pytest.mark.slow
def test_on_the_grid_a_part_of_it_is_missing():
    """A limit of fixed steps, which docs/gradients.md names: the derivative 1 of the end of the rest."""
    slope = jax.jacfwd(lambda friction: rest(friction, FIXED))(2.01)
    np.testing.assert_allclose(slope, 2.01 / np.sqrt(2.01**2 - 2) - 1, rtol=1e-7)


@pytest.mark.slow
@killed_by("engine.step.replay", "landing & old.search.at_once", "old.search.at_once")
def test_a_wheel_that_turns_again_has_a_derivative():
    """The relay of a laggard brake locks the wheel and lets it go; against central differences of three widths."""
    loop = braking(
        plant=LabRig(),
        initial=d.BrakeStart(speed=60 / 3.6),
        controller=Relay(band=0.1, high=25.0),
        actuator=Lag(time_constant=0.05),
        reference=FixedSlip(slip=0.6),
        stop=SpeedReached(speed=5 / 3.6),
    )

    def locked(torque):
        solver, measured = d.Adaptive(1e-8, 1.5, 1e-3), {"locked_time": BRAKING["locked_time"]}
        return d.measure(d.replace(loop, {"controller.high": torque}), solver, measured).metrics["locked_time"]

    widths = np.array([3e-2, 3e-3, 3e-4])
    torques = 25.0 + np.concatenate([[0.0], widths, -widths])
    times, slopes = jax.jit(jax.vmap(lambda torque: jax.jvp(locked, (torque,), (1.0,))))(torques)
    np.testing.assert_allclose((times[1:4] - times[4:]) / (2 * widths), slopes[0], rtol=1e-4)


def grows(stiffness):
    """The end of a loop whose state grows beyond all numbers: it depends on nothing."""
    loop = d.replace(swing(), {"plant.stiffness": -stiffness})
    return d.measure(loop, d.FixedStep(0.5, 2000.0), {"end": End()}).metrics["end"]


def touches(level):
    """The end of a solution whose field touches a switching surface: until there, the level plays no part."""
    return d.solve(lambda t, y, a: jnp.minimum(a, jnp.sin(t)), 0.0, 0.0, 3.0, level, solver=d.Adaptive(1e-8)).y


@killed_by("core.numerics", "jnp.where(void, jnp.nan, jnp.zeros((), real))", "jnp.zeros((), real)", case="touches")
@pytest.mark.slow  # test_invalid_numbers.py has the derivative of a diverged run for every change
@pytest.mark.parametrize("result", [grows, touches])
def test_an_invalid_result_has_no_derivative(result):
    assert all(np.isnan(x) for x in (result(1.0), jax.jacfwd(result)(1.0), jax.grad(result)(1.0)))
