"""Check the worst runs of the searches: with shorter steps, by differences, and by another program.

`elsewhere` integrates the same run by SciPy (Dormand and Prince of order 8, tolerance 1e-10, SciPy's own B-spline), one
sample of the controller after the other. It writes out the plant of Maeda and Sugiura, a gain in proportion to the
speed with back-calculation, and the rate limit of the target. From diffabs it takes parameters only.
"""

import math
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import BSpline

from diffabs import Loop, replace
from experiments.adversary.attack import Attack
from experiments.adversary.bounds import NOISE, ROAD, nominal, parameters

WIDTHS = (1e-3, 1e-4, 1e-5)  # of differences, in units of the bounds
GRAVITY = 9.81
DENSE = 40  # points of a period at which the slip is looked at


def by_block(attack: Attack, z: np.ndarray) -> dict[str, float]:
    """Return the excess [%] of each block of a point (1, size) alone, the others nominal, and of all together."""
    rest = nominal(attack.bounds)
    points = np.repeat(rest, 5, axis=0)
    for i, block in enumerate(attack.bounds.blocks):
        points[1 + i, block] = z[0, block]
    points[4] = z[0]
    overshoots = 100 * attack.overshoots(points)
    names = ("road alone", "noise alone", "start alone", "together")
    return {name: float(value - overshoots[0]) for name, value in zip(names, overshoots[1:], strict=True)}


def with_shorter_steps(attack: Attack, z: np.ndarray) -> dict[str, float]:
    """Return the overshoot [%] at a point (1, size), and its change if the step is halved, and halved again."""
    overshoot, halved, quartered = (float(attack.runs(z, finer).metrics["overshoot"][0]) for finer in (1, 2, 4))
    changes = {"step halved": 100 * (halved - overshoot), "quartered": 100 * (quartered - overshoot)}
    return {"overshoot [%]": 100 * overshoot, **changes}


def against_differences(attack: Attack, z: np.ndarray, entries: np.ndarray) -> list[dict[str, float]]:
    """The gradient at a point (1, size) and central differences of three widths, of some of its numbers. The point need
    not be in the set."""
    slope, rows = attack.gradients(z)[0], []
    moved = np.concatenate([z + w * s * np.eye(z.shape[1])[entries] for w in WIDTHS for s in (1, -1)])
    overshoots = attack.overshoots(moved).reshape(len(WIDTHS), 2, -1)
    for i, entry in enumerate(entries):
        row = {"number": float(entry), "gradient": float(slope[entry])}
        for k, width in enumerate(WIDTHS):
            row[f"width {width:g}"] = float((overshoots[k, 0, i] - overshoots[k, 1, i]) / (2 * width))
        rows.append(row)
    return rows


def elsewhere(loop: Loop, attack: Attack, z: np.ndarray) -> float:
    """Overshoot [1] at a point (1, size), by SciPy. The controller is a ProportionalFeedback with back-calculation, its
    target a LimitedSlip."""
    values = {path: np.asarray(value)[0] for path, value in parameters(attack.bounds, z).items()}
    case: Any = replace(loop, values)
    rates, slip_of = _plant(case, values[ROAD])
    computer, noise = _Computer(case), values[NOISE]
    h, radius, stop = float(case.controller.sampling_period), float(case.plant.body_radius), float(case.stop.speed)
    speed = float(values["initial.speed"])
    x, greatest = np.array([speed / float(case.plant.wheel_radius), speed / radius, 0.0, 0.0]), 0.0

    def ended(t: float, x: np.ndarray, u: float) -> float:
        del t, u
        return x[1] * radius - stop

    ended.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    for k in range(10_000):
        u = computer.step(slip_of(x) + float(noise[k % len(noise)]), x[1] * radius)
        part = solve_ivp(
            rates, (k * h, (k + 1) * h), x, "DOP853", args=(u,), events=ended, rtol=1e-10, atol=1e-12, dense_output=True
        )
        states = part.sol(np.linspace(part.t[0], part.t[-1], DENSE + 1))
        greatest, x = max(greatest, max(slip_of(at) for at in states.T)), part.y[:, -1]
        if part.status == 1:
            return greatest / float(case.reference.slip) - 1
    raise RuntimeError("the run did not end")


def _plant(loop: Any, factors: np.ndarray) -> tuple[Any, Any]:
    """Rates of (wheel, body, torque, distance) under a command, and the slip."""
    p, road, spacing = loop.plant, loop.plant.road.road, float(loop.plant.road.spacing)
    w1, w2, w3, w4, a, q = (float(getattr(road, name)) for name in ("w1", "w2", "w3", "w4", "a", "q"))
    mass, inertia, share = float(p.mass), float(p.wheel_inertia), float(p.inertia_factor)
    r1, r2, lag = float(p.wheel_radius), float(p.body_radius), float(loop.actuator.time_constant)
    padded = np.concatenate([3 * [factors[0]], factors, 3 * [factors[-1]]])
    spline = BSpline(spacing * np.arange(-5, len(factors) + 5.0), padded, 3)

    def slip_of(x: np.ndarray) -> float:
        return 1 - r1 * x[0] / (r2 * x[1])

    def rates(t: float, x: np.ndarray, u: float) -> np.ndarray:
        del t
        s = abs(slip_of(x))
        mu = w4 * s**q / (a + s**q) + s * (w1 + s * (w2 + s * w3))
        mu *= math.copysign(float(spline(x[3])), slip_of(x))
        wheel = (mass * GRAVITY * r1 * mu - x[2]) / inertia
        return np.array([wheel, -mu * GRAVITY / (share * r2), (u - x[2]) / lag, r2 * x[1]])

    return rates, slip_of


class _Computer:
    """Target, controller and anti-windup of one period."""

    def __init__(self, loop: Any):
        """From their parameters."""
        self.loop, self.control, self.target, self.integral = loop, loop.controller.controller, 0.0, 0.0

    def step(self, slip: float, speed: float) -> float:
        """Return the commanded torque for the measured slip and speed."""
        loop, c = self.loop, self.control
        h = float(loop.reference.period)
        scaled = h * float(loop.reference.reference_speed) / speed
        gap = float(loop.reference.slip) - self.target
        self.target += min(
            -math.expm1(-scaled / float(loop.reference.time_constant)) * gap, scaled * float(loop.reference.rate)
        )
        k1, k2 = (speed / float(c.reference_speed) * float(k) for k in c.gain)
        raw = float(loop.feedforward.value) + k1 * self.integral + k2 * (slip - self.target)
        u = min(max(raw, float(c.low)), float(c.high))
        self.integral += h * (slip - self.target + (u - raw) / (k1 * float(c.antiwindup.tracking_time)))
        return u
