"""Random piecewise fields whose solutions slide, and their exact solutions in smooth pieces by SciPy.

    dy/dt = A y + b(t) + sum_i s_i (C_i y + d_i),   s_i = sign(h_i),   h_i = n_i.y + m_i (y.y) + k_i sin(t)

A switch is up, down, or at rest (the run slides along h_i = 0). At rest its s_i between -1 and 1 keeps h_i at zero.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

EXACT = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
UP, DOWN, REST = 1, -1, 0
MAX_PIECES = 60


class Field(NamedTuple):
    """Numbers of a field with n states and m switches."""

    A: Any  # (n, n)
    b: Any  # (2, n): constant, and of sin(t)
    C: Any  # (m, n, n)
    d: Any  # (m, n)
    n: Any  # (m, n)
    m: Any  # (m,)
    k: Any  # (m,)
    y0: Any  # (n,)


class Solution(NamedTuple):
    """An exact solution: the end, how often it slides, and the least rate with which anything happens."""

    y: Any
    slides: int
    both: int
    slowest: float


def draw_field(rng, states=3, switches=1):
    """Return a random field, most of which slide for a while."""
    n, m = states, switches
    A = rng.normal(size=(n, n)) - 1.0 * np.eye(n)
    normals = rng.normal(size=(m, n))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    d = rng.normal(size=(m, n)) * 0.5 - normals * rng.uniform(0.5, 2.5, size=(m, 1))
    return Field(
        A, rng.normal(size=(2, n)), 0.2 * rng.normal(size=(m, n, n)), d, normals, 0.2 * rng.normal(size=m),
        0.3 * rng.normal(size=m), rng.normal(size=n),
    )  # fmt: skip


def rate(p, t, y, s):
    return p.A @ y + p.b[0] + p.b[1] * np.sin(t) + sum(x * (C @ y + d) for x, C, d in zip(s, p.C, p.d, strict=True))


def margins(p, t, y):
    return p.n @ y + p.m * (y @ y) + p.k * np.sin(t)


def margin_rates(p, t, y, s):
    return (p.n + 2.0 * np.outer(p.m, y)) @ rate(p, t, y, s) + p.k * np.cos(t)


def equivalent(p, t, y, modes):
    """Return the s of all switches: those at rest keep their margins at rest."""
    s = np.array(modes, float)
    rest = [i for i, mode in enumerate(modes) if mode == REST]
    if not rest:
        return s
    zero = margin_rates(p, t, y, s)[rest]
    columns = [margin_rates(p, t, y, s + np.eye(len(s))[i])[rest] - zero for i in rest]
    s[rest] = np.linalg.solve(np.stack(columns, axis=1), -zero)
    return s


def flow_of(p, modes):
    """Return the rates as a function of (t, y) with these switches."""
    return lambda t, y: rate(p, t, y, equivalent(p, t, y, modes))


def condition_of(p, modes, i):
    """Return the function of (t, y) whose fall through zero ends the present mode of switch i."""

    def condition(t, y):
        return 1.0 - abs(equivalent(p, t, y, modes)[i]) if modes[i] == REST else modes[i] * margins(p, t, y)[i]

    condition.terminal, condition.direction = True, -1
    return condition


def solve_exactly(p, end):
    """Return the `Solution`, or None where it meets a degenerate point or too many pieces."""
    t, y, count = 0.0, np.asarray(p.y0, float), len(p.m)
    modes = [UP if h > 0 else DOWN for h in margins(p, t, y)]
    slides = both = 0
    slowest = float(np.min(np.abs(margins(p, t, y))))
    for _ in range(MAX_PIECES):
        flow, conditions = flow_of(p, tuple(modes)), [condition_of(p, tuple(modes), i) for i in range(count)]
        run = solve_ivp(flow, (t, end), y, events=conditions, **EXACT)
        t, y = run.t[-1], run.y[:, -1]
        fired = [i for i, times in enumerate(run.t_events) if len(times)]
        if not fired:
            return Solution(y, slides, both, slowest)
        if len(fired) > 1:
            return None
        (i,), h = fired, 1e-7
        slope = (conditions[i](t + h, y + h * flow(t, y)) - conditions[i](t - h, y - h * flow(t, y))) / (2 * h)
        slowest = min(slowest, abs(slope))
        if modes[i] == REST:
            modes[i] = UP if equivalent(p, t, y, modes)[i] > 0 else DOWN
            continue
        rest = [j for j in range(count) if modes[j] == REST]
        old, modes[i] = modes[i], REST
        s = equivalent(p, t, y, modes)
        if abs(s[i]) < 1:
            slides += 1
            both += modes.count(REST) > 1
            slowest = min(slowest, 1 - abs(s[i]))
        else:
            modes[i] = -old
            slowest = min(slowest, abs(s[i]) - 1)
        # The share of another slide may jump beyond 1: then that slide ends here, too.
        s = equivalent(p, t, y, modes)
        others = [1 - abs(s[j]) for j in range(count) if modes[j] == REST and j != i]
        if others and min(others) < 0:
            j = next(j for j in range(count) if modes[j] == REST and j != i and abs(s[j]) > 1)
            modes[j] = UP if s[j] > 0 else DOWN
            slowest = min(slowest, abs(abs(s[j]) - 1))
        # In a corner of two surfaces this choice may contradict itself.
        s = equivalent(p, t, y, modes)
        moves = modes * margin_rates(p, t, y, s)
        if any(abs(s[k]) > 1 if modes[k] == REST else moves[k] < 0 for k in {i, *rest}):
            return None
    return None
