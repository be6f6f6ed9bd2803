"""Objectives that are relative to the step of a run: from the first value to the final setpoint, up or down.

    y'' = wn^2 (u - y) - 2 zeta wn y',  u = r,  from rest at y0:
    (y - r)/(y0 - r) = exp(-a t) (cos(b t) + a/b sin(b t)),  a = zeta wn,  b = wn sqrt(1 - zeta^2)

So the overshoot is exp(-pi zeta/sqrt(1 - zeta^2)) of every step, in any unit, and its settling time is the same.
"""

import json
import math
from types import MappingProxyType
from typing import Any, NamedTuple

import commands
import jax
import numpy as np
import pytest
import scipy.optimize
from mutants import killed_by

import diffabs as d
from diffabs import objectives, references, stops
from diffabs.core.protocols import Memory, no_flow, no_memory
from diffabs.core.pytree import param, pytree

ZETA, WN = 0.3, 2.0
# (y0, r): a cart in m, a servo in mV, steps down, to zero and across it, a step far from zero
STEPS = np.array([
    (0.0, 0.5), (0.0, 0.005), (1.0, 0.0), (0.5, 0.2), (-1.0, 1.0), (1.0, -1.0),
    (0.0, 300.0), (2500.0, 1200.0), (0.0, -0.02), (1000.0, 1000.01), (1.0, 1.0), (1.0, 1.0 + 1e-15),
])  # fmt: skip
SOLVER = d.FixedStep(2e-3, 12.0)
MEASURED = {"overshoot": objectives.Overshoot(), "settling": objectives.SettlingTime(), "iae": objectives.IAE()}


class Signal(NamedTuple):
    """Signal and rate."""

    y: Any
    rate: Any

    units = MappingProxyType({"y": "mV", "rate": "mV/s"})


@pytree
class Second:
    """The oscillator of this file's head, from rest at `first`."""

    first: Any = param(default=0.0, unit="mV")
    zeta: Any = param(default=ZETA, unit="1", above=0.0)
    shows, control_unit = Signal, "mV"

    def start(self, initial: Any) -> Signal:
        return Signal(self.first + 0.0 * self.zeta, 0.0 * self.zeta)

    def derivative(self, t: Any, state: Signal, control: Any) -> Signal:
        return Signal(state.rate, WN**2 * (control - state.y) - 2 * self.zeta * WN * state.rate)

    def project(self, state: Signal) -> Signal:
        return state

    output = project

    def holding(self, output: Any, target: Any) -> Any:
        return target


@pytree
class Ramp:
    """A target that a filter moves to `value`: the step is the one to `value`."""

    value: Any = param(default=1.0, unit="signal")

    def start(self, signal: Any) -> Memory:
        return Memory(flow=signal.y)

    def flow(self, t: Any, memory: Memory, signal: Any) -> Any:
        return 5.0 * (self.value - memory.flow)

    def output(self, t: Any, memory: Memory, signal: Any) -> Any:
        return memory.flow

    def setpoint(self, memory: Memory) -> Any:
        return self.value


@pytree
class Follower:
    """u = target."""

    start = no_memory
    flow = no_flow

    def output(self, t: Any, memory: Memory, signal: Any) -> Any:
        return signal.target


def stepping(first, value, zeta=ZETA, **more):
    more = {"reference": references.Setpoint(value=value), "controller": Follower(), **more}
    return d.Loop(plant=Second(first=first, zeta=zeta), initial=(), stop=stops.NoStop(), **more)


ROOT = math.sqrt(1 - ZETA**2)
FRACTION = math.exp(-math.pi * ZETA / ROOT)


@killed_by("parts.objectives.tracking", "setpoint - lowest)", "highest - setpoint)")
@killed_by("parts.objectives.tracking", "jnp.nan, jnp.abs(step))", "jnp.nan, jnp.abs(setpoint))")
@killed_by("parts.objectives.tracking", "jnp.abs(step) <= rounding", "step != step")
def test_overshoot_and_settling_time_are_relative_to_the_step():
    """Against the closed form; RK4 and the cubics leave 1e-9, and 1 part in 1e5 of the step from 1000 loses 1e-9."""
    first, value = STEPS.T
    batch = d.Batch({"plant.first": first, "reference.value": value})
    runs = jax.device_get(d.run_batch(stepping(0.0, 1.0), batch, SOLVER, MEASURED))
    assert not runs.diverged.any()
    np.testing.assert_allclose(runs.metrics["overshoot"][:-2], FRACTION, rtol=1e-7)
    assert np.isnan(runs.metrics["overshoot"][-2:]).all()  # they have no step

    def beyond_band(t):
        a, b = ZETA * WN, WN * ROOT
        return abs(math.exp(-a * t) * (math.cos(b * t) + a / b * math.sin(b * t))) - 0.02

    times = np.linspace(0.0, 12.0, 5000)
    last = max(t for t in times if beyond_band(t) > 0)
    settled = scipy.optimize.brentq(beyond_band, last, last + times[1])
    np.testing.assert_allclose(runs.metrics["settling"][:-2], settled, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("first", "value"), [(0.0, 1.0), (2.0, 0.5), (1.0, 1.0)])
def test_the_derivative_of_an_overshoot(first, value):
    """Of the closed form. Without a step the derivative is no number; that of another metric of the run is one."""

    def measure(zeta):
        return d.measure(stepping(first, value, zeta), SOLVER, MEASURED).metrics

    expected = math.nan if first == value else -math.pi / ROOT**3 * FRACTION
    forward = jax.jit(jax.jacfwd(measure))(ZETA)
    reverse = {
        name: jax.jit(jax.grad(lambda zeta, name=name: measure(zeta)[name]))(ZETA) for name in ("overshoot", "iae")
    }
    for slopes in (forward, reverse):
        np.testing.assert_allclose(slopes["overshoot"], expected, rtol=1e-6)
        assert np.isfinite(slopes["iae"])


@pytest.mark.slow
def test_the_step_of_a_filtered_target_is_the_one_to_its_end():
    """Target r + (y0 - r) exp(-5 t) from y0: the linear response is computed here by a matrix exponential."""
    first, value = 3.0, 1.0
    matrix = np.array([[0.0, 1.0, 0.0], [-(WN**2), -2 * ZETA * WN, WN**2], [0.0, 0.0, -5.0]])
    eigenvalues, vectors = np.linalg.eig(matrix)  # of y - r, y', target - r
    weights = np.linalg.solve(vectors, np.array([1.0, 0.0, 1.0]))
    times = np.linspace(0.0, 6.0, 60_001)
    shares = np.real(np.exp(np.outer(times, eigenvalues)) @ (weights * vectors[0]))
    loop = stepping(first, value, reference=Ramp(value=value), controller=Follower())
    run = d.measure(loop, SOLVER, {"overshoot": objectives.Overshoot()})
    np.testing.assert_allclose(run.metrics["overshoot"], max(-shares), rtol=1e-6)  # samples 1e-4 s apart: 1e-8
    assert run.metrics["overshoot"] < 0.35  # less than the step's own


@pytest.mark.slow
def test_the_command_says_that_a_run_has_no_step():
    changes = ("initial.slip=0.2", "solver.step=1e-3")
    result = commands.run("simulate", "slip-lmi", "--json", *(word for change in changes for word in ("--set", change)))
    document = json.loads(result.stdout)
    assert document["metrics"]["overshoot"] is None
    line = "overshoot is not a number: the run lacks what it measures, as an overshoot needs a step"
    assert line in document["warnings"]
