"""SciPy's solve_ivp, one lane at a time, ended by a terminal event; the peak from its dense output."""

from math import exp, log

import numpy as np
from scipy.integrate import solve_ivp

from peers.ladder import TOLERANCES
from peers.problem import J1, K1, K2, R1, R2, SLIP, STOP, W1, W2, W3, W4, A, G, P, U, holding

TITLE, PACKAGES, MANY = "SciPy solve_ivp RK45 in a loop", ("scipy", "numpy"), 16
LADDER = TOLERANCES
WINDOW = np.linspace(0.0, 0.12, 481)  # [s], in which every lane has its greatest slip


def one(mass, speed, tolerance):
    """The four numbers of one lane."""
    hold, push = float(holding(mass)), mass * G * R1 / J1

    def rates(t, y):
        speed = R2 * y[0]
        error = 1 - R1 * y[1] / speed - SLIP
        s = min(max(error + SLIP, 1e-6), 1.0)
        power = exp(P * log(s))
        mu = W4 * power / (A + power) + ((W3 * s + W2) * s + W1) * s
        torque = min(max(hold + K1 * y[2] + K2 * error, 0.0), U)
        return -2 * G / R2 * mu, push * mu - torque / J1, error, speed, abs(error)

    def stop(t, y):
        return R2 * y[0] - STOP

    stop.terminal = True
    absolute = tolerance * np.array([1.0, 1.0, 1e-4, 1e-2, 1e-4])  # to the sizes of the states
    start = (speed / R2, speed / R1, 0.0, 0.0, 0.0)
    run = solve_ivp(rates, (0, 5), start, "RK45", rtol=tolerance, atol=absolute, events=stop, dense_output=True)
    seen = run.sol(WINDOW)
    return run.t[-1], run.y[3, -1], highest(1 - R1 * seen[1] / (R2 * seen[0])), run.y[4, -1]


def highest(values):
    """The top of the parabola through the greatest of equally spaced values and its neighbours."""
    i = min(max(int(np.argmax(values)), 1), len(values) - 2)
    a, b, c = values[i - 1 : i + 2]
    return b + (a - c) ** 2 / (8 * (2 * b - a - c))


def prepared(masses, speeds, tolerance, dtype, threads):
    """In float64 by one thread, whatever is asked for: it has no other."""
    del dtype, threads
    return lambda: np.array([one(*lane, tolerance) for lane in zip(masses.tolist(), speeds.tolist(), strict=True)]).T
