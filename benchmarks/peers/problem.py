"""The problem that every peer solves, and how wrong an answer is. Nothing but NumPy: a peer may live in an environment
of its own, without diffabs.

The mirrored rig of [lmi] under its published gain, its torque limited: with y = (omega2, omega1, x1, distance, IAE),

    omega2' = -2 g mu/r2,  omega1' = (m g r1 mu - u)/J1,  x1' = s - S,  distance' = r2 omega2,  IAE' = |s - S|
    s = 1 - r1 omega1/(r2 omega2),  u = clamp(tau* + K1 x1 + K2 (s - S), 0, U),
    mu = w4 s^p/(a + s^p) + w3 s^3 + w2 s^2 + w1 s,  tau* = m g r1 mu(S) + 2 (1 - S) J1 g mu(S)/r1

from a speed, with slip 0, to 5 km/h. Lanes differ in mass m and initial speed. Four numbers are asked for: stopping
time and distance, the greatest slip, and the IAE.
"""

import math

import numpy as np

R1, R2, J1, G = 0.0995, 0.099, 7.53e-3, 9.81  # radii of wheel and body [m], the wheel's inertia [kg m^2], [m/s^2]
A, P, W1, W2, W3, W4 = 2.57e-4, 2.10, -4.24e-2, 2.94e-10, 3.51e-2, 0.407
K1, K2, SLIP, U = -11753.0, -48.0, 0.2, 9.03
STOP = 5 / 3.6  # [m/s]
DURATION = 2.1  # [s], in which every lane stops
MASSES, SPEEDS = (5.3, 6.2), (30 / 3.6, 60 / 3.6)
METRICS = ("stop_time", "stop_distance", "max_slip", "iae")


def friction(s: float) -> float:
    """mu [1] of a slip between 0 and 1."""
    power = s**P
    return W4 * power / (A + power) + ((W3 * s + W2) * s + W1) * s


HELD = friction(SLIP)


def holding(mass):
    """tau* [N m] of masses [kg]."""
    return mass * G * R1 * HELD + 2 * (1 - SLIP) * J1 * G * HELD / R1


def lanes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """(masses [kg], speeds [m/s]), each (count,): a grid, nearly square, in which neighbours last similarly long."""
    across = math.isqrt(count)
    while count % across:
        across -= 1
    masses, speeds = np.meshgrid(np.linspace(*MASSES, across), np.linspace(*SPEEDS, count // across))
    return masses.ravel(), speeds.ravel()


def errors(found, reference) -> np.ndarray:
    """The worst relative error of each metric over ALL lanes (4,): infinite where an answer is no number."""
    relative = np.abs(np.asarray(found, float) / np.asarray(reference, float) - 1)
    return np.where(np.isfinite(relative), relative, np.inf).max(axis=1)
