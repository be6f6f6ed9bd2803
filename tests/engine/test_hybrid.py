"""Hybrid systems that are neither loop nor field: the engine needs nothing else of a system than its protocol."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs.core.pytree import param, pytree, static
from diffabs.engine.drive.runs import run_system
from diffabs.engine.step.event_location import RunStatus

A = np.array([[0.9, 0.2], [-0.3, 0.8]])


class Numbers(NamedTuple):
    """A state, and its only signal."""

    x: Any = ()
    steps: Any = ()

    def flow(self):
        return self.x

    def memories(self):
        return self.steps

    def with_flow(self, flow):
        return self._replace(x=flow)

    def show(self):
        return self

    def error_controlled_signals(self):
        return ()

    signal_scales = error_controlled_signals


class Signals(NamedTuple):
    sample: Any
    recorded: Any


class System:
    """What both systems below have in common: no events, no clock, nothing to prepare or to project."""

    changes = ticks = eventful = jumps = False
    recorders = ()

    def prepare_run(self):
        return self, {}

    def join_state(self, flow, held):
        return Numbers(flow, held)

    def signals(self, t, state):
        return Signals(state, {})

    def flow(self, t, state, signals):
        return ()

    def margins(self, t, state, signals, flow):
        return {"stop": (jnp.ones_like(t),)}

    def project(self, state):
        return state

    def error_controlled_signals(self, state):
        return ()

    def least_scales(self, state):
        return None


@pytree
class Decay(System):
    """x' = -r x, beside a number that only rounds."""

    decay: Any = param(default=1.0, unit="1/s", free=True)
    sizes: Any = static(default=None)

    def start(self):
        return Numbers((jnp.asarray(1.0), jnp.asarray(0.0)))

    def flow(self, t, state, signals):
        return (-self.decay * state.x[0], 1e-30 * jnp.cos(1e8 * t))

    def least_scales(self, state):
        return self.sizes


@pytree
class Difference(System):
    """x(k + 1) = A x(k), by a clock, without a flow."""

    matrix: Any = param(default=A, unit="1", free=True)

    changes = ticks = True

    def start(self):
        return Numbers((), jnp.array([1.0, 0.0]))

    def change(self, clock, state, before, margins, fired, passed=None):
        return state._replace(steps=jnp.where(clock.k > 0, self.matrix @ state.steps, state.steps))

    def next_tick(self, k, h):
        return k + 1


@pytree
class Ball(System):
    """y'' = -g; at y = 0 the speed turns to -e y'. It stops at a time of its own."""

    gravity: Any = param(default=9.81, unit="m/s^2")
    bounce: Any = param(default=0.8, unit="1")

    changes = eventful = True

    def start(self):
        return Numbers((jnp.asarray(1.0), jnp.asarray(0.0)), jnp.asarray(0.0))

    def flow(self, t, state, signals):
        return (state.x[1], -self.gravity)

    def margins(self, t, state, signals, flow):
        return {"stop": (1.0 - t,), "ground": (jnp.where(state.x[1] < 0, state.x[0], 1.0),)}

    def change(self, clock, state, before, margins, fired, passed=None):
        (height, speed), hits = state.x, fired["ground"][0]
        return Numbers((height, jnp.where(hits, -self.bounce * speed, speed)), state.steps + hits)


INFLOW, OUTFLOW, END = 1.5, 0.8, 3.0  # m/s, m^(1/2)/s, s


@pytree
class Tanks(System):
    """Two tanks in a row. A valve closes where the first level rises through `high`, and opens at `low`."""

    high: Any = param(default=1.0, unit="m", free=True)
    low: Any = param(default=0.7, unit="m")

    changes = eventful = True

    def start(self):
        return Numbers((jnp.asarray(0.8), jnp.asarray(0.4)), jnp.asarray(1.0))

    def flow(self, t, state, signals):
        first, second = (OUTFLOW * jnp.sqrt(level) for level in state.x)
        return (INFLOW * state.steps - first, first - second)

    def margins(self, t, state, signals, flow):
        level = state.x[0]
        return {"stop": (1.0 + 0.0 * t,), "closes": (self.high - level,), "opens": (level - self.low,)}

    def change(self, clock, state, before, margins, fired, passed=None):
        return state._replace(steps=jnp.where(fired["closes"][0], 0.0, jnp.where(fired["opens"][0], 1.0, state.steps)))


def levels(high, low, step):
    """Return both levels at the end, shape (2,)."""
    return jnp.array(run_system(Tanks(high=high, low=jnp.asarray(low)), d.FixedStep(step, END), last_state).x)


def levels_by_scipy(high, low):
    t, x, is_open = 0.0, np.array([0.8, 0.4]), 1.0
    while t < END:

        def flow(t, x, is_open=is_open):
            first, second = OUTFLOW * np.sqrt(x)
            return is_open * INFLOW - first, first - second

        def margin(t, x, is_open=is_open):
            return high - x[0] if is_open else x[0] - low

        margin.terminal, margin.direction = True, -1
        part = solve_ivp(flow, (t, END), x, method="DOP853", rtol=1e-13, atol=1e-14, events=margin)
        t, x, is_open = part.t[-1], part.y[:, -1], 1.0 - is_open
    return x


def slope_by_differences(function, at, width):
    """Return df/dx by the central difference of fourth order."""
    near, far = (function(at + n * width) - function(at - n * width) for n in (1, 2))
    return np.asarray(8.0 * near - far) / (12.0 * width)


def last_state(system, objectives, carry):
    return carry.point.state, None


def last_state_at_the_end(system, objectives, carry):
    """NaN for a run that was given up."""
    over = carry.status == RunStatus.EXHAUSTED
    return jax.tree.map(lambda x: jnp.where(over, jnp.nan, x), carry.point.state), None


@pytest.mark.parametrize(
    "solver", [d.FixedStep(0.5, 10.0), pytest.param(d.Adaptive(1e-6, 10.0, step=0.5), marks=pytest.mark.slow)]
)
def test_a_difference_equation_has_a_clock_and_no_flow(solver):
    """Of 20 instants after t = 0 the last one ends the run, and changes nothing."""

    def end(matrix):
        return run_system(Difference(matrix=matrix), solver, last_state).steps

    np.testing.assert_allclose(end(jnp.asarray(A)), np.linalg.matrix_power(A, 19) @ [1.0, 0.0], rtol=1e-12)
    slope = jax.jvp(end, (jnp.asarray(A),), (jnp.eye(2),))[1]
    exact = 19 * np.linalg.matrix_power(A, 18) @ [1.0, 0.0]  # d (A + s I)^19/ds
    np.testing.assert_allclose(slope, exact, rtol=1e-12)


@killed_by("engine.step.step_size", "jax.tree.map(jnp.maximum, states, least_scales)", "states")
@pytest.mark.parametrize(("sizes", "end"), [(None, np.nan), ((0.0, 1.0), np.exp(-1.0))], ids=["relative", "absolute"])
def test_rounding_near_zero_does_not_shorten_the_steps(sizes, end):
    """Without a least size the error is relative to the rounding, and the run needs too many steps."""
    solver = d.Adaptive(1e-6, 1.0, step=0.5)
    state = run_system(Decay(decay=jnp.asarray(1.0), sizes=sizes), solver, last_state_at_the_end)
    np.testing.assert_allclose(state.x[0], end, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [d.FixedStep(0.01, 2.0), d.Adaptive(1e-8, 2.0)])
def test_a_ball_bounces_and_has_derivatives(solver):
    """In closed form: it lands at sqrt(2/g) with sqrt(2 g), and rises with e sqrt(2 g) up to t = 1."""

    def height(gravity):
        return run_system(Ball(gravity=gravity, bounce=jnp.asarray(0.8)), solver, last_state).x[0]

    def exact(g):
        after = 1.0 - np.sqrt(2 / g)
        return 0.8 * np.sqrt(2 * g) * after - 0.5 * g * after**2

    g = jnp.asarray(9.81)
    np.testing.assert_allclose(height(g), exact(9.81), rtol=1e-7)
    slope = (exact(9.81 + 1e-6) - exact(9.81 - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.grad(height)(g), slope, rtol=1e-5)
    np.testing.assert_allclose(jax.jvp(height, (g,), (1.0,))[1], slope, rtol=1e-5)


@pytest.mark.slow
@killed_by("engine.step.advance", "carry.since + request.h", "carry.since + jax.lax.stop_gradient(request.h)")
def test_a_derivative_by_the_place_of_events_has_the_order_of_the_method():
    """Over eight switching levels, because the error depends on where in its step an event lies."""
    highs, low = jnp.linspace(0.92, 1.06, 8), 0.7
    values = np.array([levels_by_scipy(high, low) for high in highs])
    slopes = np.array([slope_by_differences(lambda x: levels_by_scipy(x, low), high, 1e-4) for high in highs])

    def errors(step):
        run = jax.vmap(lambda high: jax.jvp(lambda x: levels(x, low, step), (high,), (1.0,)))
        return [np.sqrt(np.mean((ours - exact) ** 2)) for ours, exact in zip(run(highs), (values, slopes), strict=True)]

    coarse, middle, fine = (np.array(errors(step)) for step in (0.04, 0.02, 0.01))
    orders = np.log2([coarse / middle, middle / fine])
    assert np.all(orders > 3.3), orders


@pytest.mark.slow
def test_a_coarse_step_has_the_derivative_of_its_own_run():
    """Few steps pass the low level, where the outflow changes fast. Their place decides on the error of the run."""
    low, step = 1e-3, 0.01
    value, slope = jax.jvp(lambda high: levels(high, low, step), (jnp.asarray(1.0),), (1.0,))
    own = slope_by_differences(lambda high: levels(jnp.asarray(high), low, step), 1.0, 2e-6)
    exact = slope_by_differences(lambda high: levels_by_scipy(high, low), 1.0, 1e-5)
    np.testing.assert_allclose(value, levels_by_scipy(1.0, low), rtol=3e-5)
    np.testing.assert_allclose(slope, own, rtol=1e-7)
    assert np.all(np.abs(slope - exact) > 1e-4)
