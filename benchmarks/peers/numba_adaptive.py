"""The method of lanes.c in Numba: a scalar loop per lane, `prange` over lanes, fastmath."""

import math

import numba
import numpy as np

from peers.ladder import TOLERANCES
from peers.problem import J1, K1, K2, R1, R2, SLIP, STOP, W1, W2, W3, W4, A, G, P, U, holding

TITLE, PACKAGES, MANY = "Numba, adaptive RK4 (prange)", ("numba", "llvmlite", "numpy"), None
LADDER = TOLERANCES
FIRST, LONGEST, LEAST = 1e-4, 7e-3, 2e-5  # s
LOW = 1e-6  # slip, below which friction is taken as there; and s


def model(real):
    """Return rates(omega2, omega1, x1, mass, hold): d2, d1, the slip's error, slip, torque and the slip's rate;
    compiled for numbers of the type `real`, as all that follows."""
    r1, r2, slip, most, one, zero, low = (real(x) for x in (R1, R2, SLIP, U, 1, 0, LOW))
    a, p, w1, w2, w3, w4, k1, k2 = (real(x) for x in (A, P, W1, W2, W3, W4, K1, K2))
    body, push, per_inertia = real(-2 * G / R2), real(G * R1 / J1), real(1 / J1)

    @numba.njit(fastmath=True, inline="always")
    def rates(y2, y1, y3, m, hold):
        inverse = one / (r2 * y2)
        s = one - r1 * y1 * inverse
        error = s - slip
        torque = hold + k1 * y3 + k2 * error
        x = min(max(s, low), one)
        power = math.exp(p * math.log(x))
        mu = w4 * power / (a + power) + ((w3 * x + w2) * x + w1) * x
        d2, d1 = body * mu, m * push * mu - min(max(torque, zero), most) * per_inertia
        return d2, d1, error, s, torque, (-r1 * d1 + (one - s) * r2 * d2) * inverse

    return rates


def between(real):
    """Return gained(z, whole, start, end): what a cubic with this gain over a step, and these gains at the rates of its
    ends, has gained up to the part z of it."""
    one, two, three = (real(x) for x in (1, 2, 3))

    @numba.njit(fastmath=True, inline="always")
    def gained(z, whole, start, end):
        return z * z * ((three - two * z) * whole - (one - z) * end) + z * (one - z) * (one - z) * start

    return gained


def limits(real):
    """Return to_limit(step, torque, rate): the step, or one that ends where the torque comes to a limit."""
    most, zero = real(U), real(0)
    low, tiny, part, near, least = (real(x) for x in (LOW, 1e-20, 0.6, 1.2, LEAST))

    @numba.njit(fastmath=True, inline="always")
    def to_limit(h, torque, rate):
        if rate > zero:
            gap = -torque if torque < zero else most - torque
        else:
            gap = torque - most if torque > most else torque
        ahead = gap / (abs(rate) + tiny)
        if low < ahead < h:
            return max(ahead, least)
        return part * h if h <= ahead < near * h else h

    return to_limit


def functions(real):
    """Return run(masses, holds, speeds, tolerance, out)."""
    rates, gained, to_limit = model(real), between(real), limits(real)
    r1, r2, stop, k1, k2 = (real(x) for x in (R1, R2, STOP, K1, K2))
    zero, one, two, half = (real(x) for x in (0, 1, 2, 0.5))
    sixth, twelfth, first, longest, least = (real(x) for x in (1 / 6, 1 / 12, FIRST, LONGEST, LEAST))
    safe, floor, shrink, grow = (real(x) for x in (0.85, 1e-4, 0.25, 2.5))
    share = real(R2 * 0.72)

    @numba.njit(fastmath=True)
    def lane(m, hold, speed, tolerance):
        y2, y1, y3, t, distance, iae, peak = speed / r2, speed / r1, zero, zero, zero, zero, zero
        a2, a1, a3, s0, torque, rate0 = rates(y2, y1, y3, m, hold)
        base = first
        while True:
            h = to_limit(base, torque, k1 * a3 + k2 * rate0)
            b2, b1, b3, _, _, _ = rates(y2 + half * h * a2, y1 + half * h * a1, y3 + half * h * a3, m, hold)
            c2, c1, c3, _, _, _ = rates(y2 + half * h * b2, y1 + half * h * b1, y3 + half * h * b3, m, hold)
            d2, d1, d3, _, _, _ = rates(y2 + h * c2, y1 + h * c1, y3 + h * c3, m, hold)
            n2 = y2 + h * sixth * (a2 + two * (b2 + c2) + d2)
            n1 = y1 + h * sixth * (a1 + two * (b1 + c1) + d1)
            n3 = y3 + h * sixth * (a3 + two * (b3 + c3) + d3)
            e2, e1, e3, s1, new_torque, rate1 = rates(n2, n1, n3, m, hold)
            excess = abs(e3 - d3) * half / tolerance
            factor = min(max(safe / math.sqrt(math.sqrt(excess + floor)), shrink), grow)
            accepted = excess <= one or h <= least
            base = max(h * factor, base) if accepted and h < base else h * factor
            base = max(min(base, longest * math.sqrt(n2 * share)), least)
            if not accepted:
                continue
            v0, v1, f0, f1, whole = r2 * y2, r2 * n2, r2 * a2, r2 * e2, n3 - y3
            z, end, gain = one, v1, whole
            if v1 <= stop:
                z = (v0 - stop) / (v0 - v1)
                z -= (f1 - f0) * h * half * z * (one - z) / (v0 - v1)
                end, gain = stop, gained(z, whole, h * a3, h * e3)
            distance += h * z * half * (v0 + end) + h * z * h * z * twelfth * z * (f0 - f1)
            if a3 * (a3 + z * (e3 - a3)) < zero:
                turn = gained(a3 / (a3 - e3), whole, h * a3, h * e3)
                iae += abs(turn) + abs(gain - turn)
            else:
                iae += abs(gain)
            peak = max(peak, s1)
            if rate0 > zero >= rate1:
                peak = max(peak, s0 + gained(rate0 / (rate0 - rate1), s1 - s0, h * rate0, h * rate1))
            if v1 <= stop:
                return t + h * z, distance, peak, iae
            t, y2, y1, y3, a2, a1, a3, s0, torque, rate0 = t + h, n2, n1, n3, e2, e1, e3, s1, new_torque, rate1

    @numba.njit(parallel=True, fastmath=True)
    def run(masses, holds, speeds, tolerance, out):
        for i in numba.prange(masses.size):
            out[0, i], out[1, i], out[2, i], out[3, i] = lane(masses[i], holds[i], speeds[i], tolerance)

    return run


def prepared(masses, speeds, tolerance, dtype, threads):
    """Threads are set by NUMBA_NUM_THREADS."""
    del threads
    real = np.float32 if dtype == "float32" else np.float64
    columns = [np.ascontiguousarray(x, real) for x in (masses, holding(masses), speeds)]
    run, out = functions(real), np.empty((4, len(masses)), real)

    def solve():
        run(*columns, real(tolerance), out)
        return out.copy()

    return solve
