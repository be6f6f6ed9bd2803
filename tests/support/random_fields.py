"""Random piecewise fields with resets, and their solutions by SciPy in pieces that know every switch.

margins    s_j = w_j.y + b_j + c_j sin(o_j t + f_j)
field      dy/dt = A tanh(y) - 0.3 y + u sin t + sum_j (on_j or off_j by the sign of s_j) + k |s_0| + l clip(s_last)
events     c_i = v_i.y + d_i falls through zero: y <- y + g_i (1 + 0.2 tanh(y)),  |v_i.g_i| >= 0.1

A reset that moves the state less across its zero would happen thousands of times, one after the other.
"""

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import diffabs as d

END = 3.0
# Dimensions, switches and events. Together they cover dimensions from 1 to 6, and 1 to 4 switches.
SHAPES = [(1, 1, 1), (2, 2, 1), (3, 3, 2), (4, 4, 1), (5, 1, 2), (6, 2, 1)]
MAX_PIECES = 5000  # one field has 1,298 events


def _unit(x):
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def draw(rng, n, switches, events):
    """Return the parameters of a random field, and its start as `y`."""
    normal = rng.standard_normal
    given = {
        "y": normal(n),
        "A": 1.5 * normal((n, n)) / np.sqrt(n),
        "u": normal(n),
        "w": _unit(normal((switches, n))),
        "b": 0.5 * normal(switches),
        "c": 0.7 * normal(switches),
        "o": rng.uniform(0.5, 6.0, switches),
        "f": rng.uniform(0.0, 6.3, switches),
        "on": normal((switches, n)),
        "off": normal((switches, n)),
        "k": 0.5 * normal(n),
        "l": 0.5 * normal(n),
        "v": _unit(normal((events, n))),
        "d": 0.5 * normal(events),
        "g": normal((events, n)),
    }
    across = np.sum(given["v"] * given["g"], axis=1, keepdims=True)
    given["g"] += (np.copysign(np.maximum(np.abs(across), 0.1), across) - across) * given["v"]
    return given


def find_margins(t, y, p, np=jnp):
    """Return the margins of the switches."""
    return p["w"] @ y + p["b"] + p["c"] * np.sin(p["o"] * t + p["f"])


def field(t, y, p):
    """Return dy/dt, with undeclared switches."""
    s = find_margins(t, y, p)
    sides = jnp.where((s > 0)[:, None], p["on"], p["off"])
    smooth = p["A"] @ jnp.tanh(y) - 0.3 * y + p["u"] * jnp.sin(t)
    return smooth + sides.sum(0) + p["k"] * jnp.abs(s[0]) + p["l"] * jnp.clip(s[-1], -0.5, 0.5)


def build_events(count):
    """Return the events of a field."""
    return [
        d.Event(
            lambda t, y, p, i=i: p["v"][i] @ y + p["d"][i],
            lambda t, y, p, i=i: y + p["g"][i] * (1 + 0.2 * jnp.tanh(y)),
        )
        for i in range(count)
    ]


def rate(t, y, p, mode):
    """Return dy/dt for given answers: those of s > 0, and of s_last < -0.5 and s_last > 0.5."""
    s, k = find_margins(t, y, p, np), len(p["b"])
    sides = np.where(mode[:k, None], p["on"], p["off"]).sum(0)
    clipped = -0.5 if mode[k] else 0.5 if mode[k + 1] else s[-1]
    smooth = p["A"] @ np.tanh(y) - 0.3 * y + p["u"] * np.sin(t)
    return smooth + sides + p["k"] * (s[0] if mode[0] else -s[0]) + p["l"] * clipped


def surfaces(t, y, p):
    """Return numbers whose signs are the mode."""
    s = find_margins(t, y, p, np)
    return np.array([*s, -0.5 - s[-1], s[-1] - 0.5])


def solve_in_pieces(p):
    """Return (state at the end, numbers of events), or a word that says why there is none."""
    t, y, counts = 0.0, p["y"].copy(), np.zeros(len(p["d"]), int)
    mode = surfaces(t, y, p) > 0
    armed = p["v"] @ y + p["d"] >= 0
    last = -1.0, 0
    for _ in range(MAX_PIECES):
        size = len(mode)
        marks = [lambda t, y, j=j: surfaces(t, y, p)[j] for j in range(size)]
        marks += [lambda t, y, i=i: p["v"][i] @ y + p["d"][i] for i in range(len(armed))]
        for j, mark in enumerate(marks):
            mark.terminal = True
            mark.direction = (-1 if mode[j] else 1) if j < size else (-1 if armed[j - size] else 1)
        found = solve_ivp(
            lambda t, y, mode=mode: rate(t, y, p, mode),
            (t, END),
            y,
            "DOP853",
            rtol=1e-11,
            atol=1e-12,
            events=marks,
            max_step=0.02,
        )
        if found.status != 1:
            return (found.y[:, -1], counts) if found.success else "fails"
        hits = [j for j, times in enumerate(found.t_events) if len(times)]
        before, (t, y) = t, (found.t[-1], found.y[:, -1])
        last = (t, last[1] + 1 if t - before < 1e-7 else 0)
        if last[1] > 12:
            return "has no end"
        j = hits[0]
        if j < size:
            mode = mode.copy()
            mode[j] = ~mode[j]
            moved = [surfaces(t + h, y + h * rate(t, y, p, mode), p)[j] for h in (-1e-6, 1e-6)]
            if (moved[1] > moved[0]) != mode[j]:
                return "slides"
            continue
        i = j - size
        if not armed[i]:
            armed[i] = True
            continue
        counts[i] += 1
        was = p["v"] @ y + p["d"]
        y = y + p["g"][i] * (1 + 0.2 * np.tanh(y))
        now = p["v"] @ y + p["d"]
        mode = surfaces(t, y, p) > 0
        moves = p["v"] @ rate(t, y, p, mode)
        armed = np.where(np.abs(now) < 1e-9, moves > 0, now >= 0)
        # An event that another one's reset makes happen: it happens at this instant.
        again = (was >= 0) & (now < -1e-9)
        again[i] = False
        for other in np.flatnonzero(again):
            if other < i:
                return "has no order"
            counts[other] += 1
            y = y + p["g"][other] * (1 + 0.2 * np.tanh(y))
            mode = surfaces(t, y, p) > 0
            now = p["v"] @ y + p["d"]
            armed = now >= 0
    return "has no end"
