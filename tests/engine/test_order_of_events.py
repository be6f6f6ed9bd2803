"""Delay, relay and rate limit against SciPy, which knows nothing of our steps: it integrates the parts' equations with
events, restarts at each, and looks up a delayed command in its own dense output."""

import dataclasses
from functools import cache

import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from marks import cases
from mutants import killed_by
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs import actuators, controllers, plants
from diffabs.core.blocks import Direct
from diffabs.core.protocols import Memory
from diffabs.parts.stops import SpeedReached
from diffabs.scenario.defaults import braking

END, BAND, DELAY = 0.25, 0.05, 0.00613
RIG = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=50 / 3.6),
    controller=controllers.StateFeedback(gain=np.array([-100.0, -10.0])),
    feedforward=controllers.HoldingInput(),
    stop=SpeedReached(speed=1.0),
)
LOOPS = {
    "relay": dataclasses.replace(RIG, controller=controllers.Relay(high=12.0, band=BAND)),
    "delay": dataclasses.replace(RIG, actuator=actuators.Delay(time=DELAY, capacity=512)),
    "rate limit": dataclasses.replace(RIG, actuator=actuators.RateLimit(rate=300.0, time_constant=0.004)),
}


def ours(loop, h):
    """Slip, speed, distance after END."""
    run = d.measure(loop, d.FixedStep(h, END), {})
    return np.array([run.ending.sample.output[i] for i in (0, 1, 4)])


@cache
def theirs(name):
    """The same of SciPy."""
    return {"relay": relay, "delay": delay, "rate limit": rate_limit}[name](LOOPS[name])


def _shown(loop, x, unravel):
    y = loop.plant.output(unravel(x))
    return np.array([y[i] for i in (0, 1, 4)], float)


TIGHT = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-13}


def relay(loop):
    start, unravel = ravel_pytree(loop.plant.start(loop.initial))
    rate = jax.jit(lambda x, u: ravel_pytree(loop.plant.derivative(0.0, unravel(x), u))[0])
    excess = jax.jit(lambda x: loop.plant.output(unravel(x)).slip - loop.reference.slip)
    t, x, applied = 0.0, np.asarray(start), True
    while t < END:
        level, u = (BAND, 12.0) if applied else (-BAND, 0.0)

        def crossing(t, x, level=level):
            return float(excess(x)) - level

        crossing.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
        crossing.direction = 1.0 if applied else -1.0  # pyright: ignore[reportFunctionMemberAccess]
        part = solve_ivp(lambda t, x, u=u: np.asarray(rate(x, u)), (t, END), x, events=crossing, **TIGHT)
        t, x, applied = part.t[-1], part.y[:, -1], not applied
    return _shown(loop, x, unravel)


def _controlled(loop):
    """State of plant and controller, its rates under a control, its command."""
    state = loop.start()
    start, unravel = ravel_pytree((state.plant, state.controller.flow))

    def full(x):
        plant, flow = unravel(x)
        return state._replace(plant=plant, controller=Memory(flow))

    def command(x):
        return loop.signals(0.0, full(x)).sample.command

    def rates(x, u):
        at = full(x)
        rest = loop.flow(0.0, at, loop.signals(0.0, at))
        return ravel_pytree((loop.plant.derivative(0.0, at.plant, u), rest[3]))[0]

    return np.asarray(start), lambda x: unravel(x)[0], jax.jit(rates), jax.jit(command)


def delay(loop):
    """The method of steps: over each delay the command is that of the piece before."""
    x, plant, rates, command = _controlled(dataclasses.replace(loop, actuator=Direct()))
    t, past = 0.0, lambda t: 0.0
    while t < END - 1e-12:
        until = min(t + DELAY, END)
        part = solve_ivp(
            lambda t, x, past=past: np.asarray(rates(x, past(t - DELAY))), (t, until), x, dense_output=True, **TIGHT
        )
        t, x, past = until, part.y[:, -1], lambda t, sol=part.sol: float(command(sol(t)))
    return _shown(loop, x, lambda x: plant(x))


def rate_limit(loop):
    """Pieces between the instants at which the limit begins or ends to act."""
    start, plant, rates, command = _controlled(dataclasses.replace(loop, actuator=Direct()))
    limit, lag = loop.actuator.rate, loop.actuator.time_constant

    def wanted(x):
        return (float(command(x[:-1])) - x[-1]) / lag

    def flow(t, x):
        return np.append(np.asarray(rates(x[:-1], x[-1])), np.clip(wanted(x), -limit, limit))

    def upper(t, x):
        return wanted(x) - limit

    def lower(t, x):
        return wanted(x) + limit

    x = np.append(start, 0.0)
    return _shown(loop, solve_ivp(flow, (0.0, END), x, max_step=1e-4, **TIGHT).y[:-1, -1], lambda x: plant(x))


STEPS = (1e-3, 5e-4, 2.5e-4)


BOUNDS = {"relay": (1e-6, 2.0), "delay": (2e-9, 1.5), "rate limit": (1e-5, 1.4)}  # error at 1 ms, order


@killed_by(
    "parts.actuators.delay", "(h * rate for rate in step.rates)", "(0.0 * rate for rate in step.rates)", case="delay"
)
@pytest.mark.slow
@pytest.mark.parametrize("name", cases(BOUNDS, "rate limit"))
def test_converges_to_scipy(name):
    """Largest relative error of slip, speed and distance at a step of 1 ms, and the order down to a quarter of it."""
    exact, (error, order) = theirs(name), BOUNDS[name]
    errors = [np.max(np.abs(ours(LOOPS[name], h) / exact - 1)) for h in STEPS]
    assert errors[0] < error, errors
    assert np.log2(errors[0] / errors[2]) / 2 > order, errors
