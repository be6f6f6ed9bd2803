"""Loops that slide along a switching surface, or would with the textbook's anti-windup, beside exact solutions."""

from types import MappingProxyType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from shown_state import ShownState

import diffabs as d
from diffabs.core.pytree import param, pytree
from diffabs.parts.controllers import PID
from diffabs.parts.references import Setpoint
from diffabs.parts.stops import NoStop

PIECES = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-14}


class Shown(NamedTuple):
    y: Any
    units = MappingProxyType({"y": "1"})


class Scalar(ShownState):
    """A plant with one state, which is its output."""

    shows, control_unit = Shown, "1"


@pytree
class Lagging(Scalar):
    """T y' = k u - y, from rest."""

    T: Any = param(default=2.0, unit="s", above=0.0)
    k: Any = param(default=0.5, unit="1")

    def start(self, initial):
        return Shown(0.0 * self.k)

    def derivative(self, t, x, u):
        return Shown((self.k * u - x.y) / self.T)

    def holding(self, output, target):
        return target / self.k


def limited_pi(antiwindup):
    """A PI controller that reaches its upper limit and stays on it from 0.19 s to 1.05 s."""
    pid = PID(kp=2.0, ki=5.0, low=-1.0, high=3.0, antiwindup=antiwindup)
    return d.Loop(plant=Lagging(), initial=(), reference=Setpoint(value=1.0), controller=pid, stop=NoStop())


def limited_pi_iae(ki=5.0, kp=2.0, high=3.0, T=2.0, k=0.5, end=10.0):
    """IAE of `limited_pi` with conditional integration in Filippov's sense, in three smooth pieces."""

    def free(t, x):
        return [(k * (kp * (1 - x[0]) + ki * x[1]) - x[0]) / T, 1 - x[0], abs(1 - x[0])]

    def hit(t, x):
        return kp * (1 - x[0]) + ki * x[1] - high

    def slide(t, x):
        return [(k * high - x[0]) / T, abs(1 - x[0])]

    def leave(t, x):  # the equivalent rate of the integral reaches the error
        return (1 - x[0]) - kp * (k * high - x[0]) / T / ki

    hit.terminal = leave.terminal = True
    hit.direction, leave.direction = 1, -1
    run = solve_ivp(free, (0, end), [0, 0, 0], events=hit, **PIECES)
    (y, _, iae), begins = run.y[:, -1], run.t[-1]
    run = solve_ivp(slide, (begins, end), [y, iae], events=leave, **PIECES)
    (y, iae), ends = run.y[:, -1], run.t[-1]
    return solve_ivp(free, (ends, end), [y, (high - kp * (1 - y)) / ki, iae], **PIECES).y[2, -1]


def differences(function, at, h=1e-4):
    """Central differences of a function by each of its arguments."""
    return [(function(**at | {n: x + h}) - function(**at | {n: x - h})) / (2 * h) for n, x in at.items()]


@pytree
class Block(Scalar):
    """v' = u - Fc sign(v), from v = 1: dry friction."""

    Fc: Any = param(default=0.7, unit="N", above=0.0)

    def start(self, initial):
        return Shown(1.0 + 0.0 * self.Fc)

    def derivative(self, t, x, u):
        return Shown(u - self.Fc * jnp.where(x.y > 0, 1.0, jnp.where(x.y < 0, -1.0, 0.0)))


class Pair(NamedTuple):
    y: Any
    w: Any
    units = MappingProxyType({"y": "1", "w": "1"})


MOST_CROSSINGS = 60  # beyond, a run spirals into the intersection of two surfaces
DRIFT = np.array([[0.0, 1.0], [-4.0, -0.4]])


@pytree
class Switched(ShownState):
    """z' = A z + b + d1 sign(n1 z - c1) + d2 sign(n2 z - c2): an oscillator with two switches."""

    b: Any = param(default=np.zeros(2), unit="1")
    d: Any = param(default=np.zeros((2, 2)), unit="1")
    n: Any = param(default=np.eye(2), unit="1")
    c: Any = param(default=np.zeros(2), unit="1")

    shows, control_unit = Pair, "1"

    def start(self, initial):
        return Pair(1.0 + 0.0 * self.c[0], 0.3 + 0.0 * self.c[0])

    def derivative(self, t, x, u):
        z = jnp.stack([x.y, x.w])
        sides = [jnp.where(self.n[i] @ z > self.c[i], 1.0, -1.0) for i in range(2)]
        rate = DRIFT @ z + self.b + self.d[0] * sides[0] + self.d[1] * sides[1]
        return Pair(rate[0] + 0.0 * u, rate[1])


def draw_switched(rng):
    """Random numbers of `Switched`, by field."""
    return {
        "b": rng.normal(0, 0.3, 2),
        "d": rng.normal(0, 0.7, (2, 2)),
        "n": rng.normal(0, 1, (2, 2)),
        "c": rng.normal(0, 0.3, 2),
    }


class Piecewise(NamedTuple):
    """What SciPy finds: integral of y^2, whether the run slides, and the least speed of a crossing."""

    cost: float
    slides: bool
    slowest: float


def solve_switched(p, end):
    """`Switched` in smooth pieces by SciPy, up to its first slide."""
    z, t, cost, slowest, crossings = np.array([1.0, 0.3]), 0.0, 0.0, np.inf, 0
    sides = np.where(p["n"] @ z > p["c"], 1.0, -1.0)

    def flow(sides):
        return lambda t, x: [*(DRIFT @ x[:2] + p["b"] + sides @ p["d"]), x[0] ** 2]

    while t < end:
        events = [lambda t, x, i=i, side=sides[i]: side * (p["n"][i] @ x[:2] - p["c"][i]) for i in range(2)]
        for one in events:
            one.terminal, one.direction = True, -1
        run = solve_ivp(flow(sides), (t, end), [*z, cost], events=events, **PIECES)
        t, z, cost = run.t[-1], run.y[:2, -1], run.y[2, -1]
        if run.status == 0:
            break
        i = int(np.argmax([len(times) for times in run.t_events]))
        before = sides[i] * p["n"][i] @ flow(sides)(t, z)[:2]
        sides = np.where(np.arange(2) == i, -sides, sides)
        after = sides[i] * p["n"][i] @ flow(sides)(t, z)[:2]
        slowest = min(slowest, abs(before), abs(after))
        crossings += 1
        if after < 0 or crossings > MOST_CROSSINGS:
            return Piecewise(cost, True, slowest)
    return Piecewise(cost, False, slowest)
