"""The distillation column of Wood and Berry with decentralised PI controllers, against SciPy's method of steps.

    y1 = 12.8 e^-s/(16.7 s + 1) u1 - 18.9 e^-3s/(21 s + 1) u2         time in minutes
    y2 = 6.6 e^-7s/(10.9 s + 1) u1 - 19.4 e^-3s/(14.4 s + 1) u2

The reflux u1 has two delays, so it is two controls with the same command.

Source: W. L. Luyben, Simple method for tuning SISO controllers in multivariable systems, Industrial and Engineering
Chemistry Process Design and Development 25 (1986), pp. 654-660: transfer functions and gains.
"""

from types import MappingProxyType
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs.core.blocks import ChangedCommand
from diffabs.core.protocols import Block
from diffabs.core.pytree import param, part, pytree
from diffabs.core.types import Scalar, Vector
from diffabs.parts.actuators import Delay, PerControl
from diffabs.parts.controllers import PID, PerChannel
from diffabs.parts.references import PerTarget, Setpoint
from diffabs.parts.stops import NoStop

GAINS, LAGS = (12.8, -18.9, 6.6, -19.4), (16.7, 21.0, 10.9, 14.4)  # of the entries 11, 12, 21, 22
DELAYS = {"reflux_top": 1.0, "reflux_bottom": 7.0, "steam": 3.0}
LUYBEN = ((0.375, 8.29), (-0.075, 23.6))  # gain and integral time of both controllers
TARGET, DURATION = 0.75, 60.0


class Products(NamedTuple):
    top: Scalar
    bottom: Scalar

    units = MappingProxyType({"top": "1", "bottom": "1"})
    tracked = ("top", "bottom")


class Flows(NamedTuple):
    reflux_top: Scalar
    reflux_bottom: Scalar
    steam: Scalar

    units = MappingProxyType(dict.fromkeys(DELAYS, "1"))


class Entries(NamedTuple):
    x: Vector


@pytree
class Rest:
    pass


@pytree
class Column:
    gains: Vector = param(default=np.array(GAINS), unit="1", free=True)
    lags: Vector = param(default=np.array(LAGS), unit="s", above=0.0)

    shows, controls = Products, Flows

    def start(self, initial):
        return Entries(jnp.zeros(4))

    def derivative(self, t, state, control):
        inputs = jnp.stack([control.reflux_top, control.steam, control.reflux_bottom, control.steam])
        return Entries((jnp.asarray(self.gains) * inputs - state.x) / jnp.asarray(self.lags))

    def project(self, state):
        return state

    def output(self, state):
        return Products(state.x[0] + state.x[1], state.x[2] + state.x[3])

    def holding(self, output, target):
        reflux, steam = jnp.linalg.solve(jnp.reshape(self.gains, (2, 2)), jnp.stack(target))
        return Flows(reflux, reflux, steam)


@pytree
class NoFeedforward:
    def input(self, plant, output, target):
        return Flows(0.0, 0.0, 0.0)


@pytree
class OneReflux(ChangedCommand):
    """Both refluxes are the one that the top product commands."""

    controller: Block = part(default=PerChannel)

    def change(self, t, command, signal):
        return command._replace(reflux_bottom=command.reflux_top)


def column():
    top, bottom = (PID(kp=kp, ki=kp / time, cutoff=1.0, low=-10.0, high=10.0) for kp, time in LUYBEN)
    each = PerChannel(
        {"reflux_top": top, "reflux_bottom": PID(kp=0.0, cutoff=1.0), "steam": bottom},
        {"reflux_top": "top", "reflux_bottom": "top", "steam": "bottom"},
    )
    return d.Loop(
        plant=Column(),
        initial=Rest(),
        reference=PerTarget(reference={"top": Setpoint(value=TARGET), "bottom": Setpoint(value=0.0)}),
        feedforward=NoFeedforward(),
        controller=OneReflux(controller=each),
        actuator=PerControl(actuator={name: Delay(time=time, capacity=80) for name, time in DELAYS.items()}),
        stop=NoStop(),
    )


def method_of_steps():
    """Return a function of time for the four entries and the integrals of both errors, minute after minute."""
    minutes, state = [], np.zeros(6)
    targets, (kp, ki) = np.array([TARGET, 0.0]), np.array([(kp, kp / time) for kp, time in LUYBEN]).T

    def errors(x):
        return targets - np.array([x[0] + x[1], x[2] + x[3]])

    def solution(t):
        return minutes[min(int(t), len(minutes) - 1)](t)

    def rates(t, x, minute):
        u = []
        for delay, i in zip(DELAYS.values(), (0, 0, 1), strict=True):
            then = solution(t - delay) if minute >= delay else None
            u.append(0.0 if then is None else kp[i] * errors(then)[i] + ki[i] * then[4 + i])
        return np.concatenate([(np.array(GAINS) * (u[0], u[2], u[1], u[2]) - x[:4]) / LAGS, errors(x)])

    for minute in range(round(DURATION)):
        span, accuracy = (minute, minute + 1), {"rtol": 1e-10, "atol": 1e-12}
        piece = solve_ivp(rates, span, state, "DOP853", args=(minute,), dense_output=True, **accuracy)
        minutes.append(piece.sol)
        state = piece.y[:, -1]
    return solution


@pytest.mark.slow
@killed_by("parts.actuators.per_control", "return signal._replace(**outputs)", "return signal")
def test_the_column_agrees_with_the_method_of_steps():
    run = d.rollout(column(), d.FixedStep(0.1, DURATION))
    sample, solution = run.trajectory.sample, method_of_steps()
    x = np.array([solution(float(t)) for t in sample.t])
    np.testing.assert_allclose(sample.output.top, x[:, 0] + x[:, 1], atol=1e-8)
    np.testing.assert_allclose(sample.output.bottom, x[:, 2] + x[:, 3], atol=1e-8)
    assert sample.t[-1] > DURATION - 0.2
