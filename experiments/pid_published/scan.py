"""The greatest integral gain of a PI controller by a scan of the plane of its gains, in NumPy alone.

    |S| <= M keeps L out of the disc around -1 of radius 1/M
    |T| <= M keeps L out of the disc around -M^2/(M^2 - 1) of radius M/(M^2 - 1)

At a proportional gain k and a frequency, L = P (k - j ki/w) moves along a line as ki grows, and is in a disc between
the two roots of a quadratic equation. The smallest of these roots over all frequencies is the limit of ki. It is the
envelope of K. J. Astrom, H. Panagopoulos, T. Hagglund, "Design of PI controllers based on non-convex optimization",
Automatica 34 (1998) 585-601.
"""

import math

import numpy as np

from experiments.pid_published.models import Gains, Process

COARSE, FINE = 4_000, 20_000  # frequencies
ROUNDS, FIRST_PLACES, PLACES = 5, 401, 41  # of the scan over k; a round spans four places of the one before
LEAST_LOOP = -0.2  # static gain of P k at the lowest k
DECADES = (-5.0, 4.0)  # of the frequencies, around that of the sum of delay and lags
FACTORS, HALVINGS = np.geomspace(300.0, 0.05, 89), 30  # of gains that are scaled to a peak
POINTS, HORIZON, SLOW, SETTLED = 2**17, 30.0, 10.0, 1e-3  # of an error over time; the horizon in two time scales
FAR = 400.0  # rad: delay times the highest frequency that is scanned


def frequencies(process: Process, count: int) -> np.ndarray:
    """Return frequencies [rad/s], half of them even on the logarithmic axis, half along the turns of the delay."""
    low, high = (10.0**decade / process.duration for decade in DECADES)
    w = np.geomspace(low, max(high, FAR / process.delay if process.delay else 0.0), count // 2)
    if not process.delay:
        return np.union1d(w, np.geomspace(low * 100, w[-1] / 10, count // 2))
    return np.union1d(w, np.linspace(low, FAR / process.delay, count // 2))


def discs(peak: float) -> tuple[tuple[float, float], ...]:
    """Return centre and radius of the discs that L avoids for |S| and |T| of at most `peak`."""
    return (-1.0, 1 / peak), (-(peak**2) / (peak**2 - 1), peak / (peak**2 - 1))


def greatest_integral(process: Process, k: np.ndarray, w: np.ndarray, peak: float) -> np.ndarray:
    """Return the limit of ki at each k; NaN where L is in a disc without integral action."""
    response = process.respond(w)
    limit = np.full(len(k), np.inf)
    for centre, radius in discs(peak):
        # |P k - centre - j P ki/w|^2 = radius^2:  a ki^2 - 2 b ki + c = 0
        offset = response * k[:, None] - centre
        a = np.abs(response) ** 2 / w**2
        b = np.real(np.conj(offset) * 1j * response / w)
        c = np.abs(offset) ** 2 - radius**2
        crosses = (b > 0) & (b**2 >= a * c)
        root = np.sqrt(np.where(crosses, b**2 - a * c, 1.0))
        limit = np.minimum(limit, np.min(np.where(crosses, c / np.where(crosses, b + root, 1.0), np.inf), axis=1))
        limit = np.where(np.min(c, axis=1) < 0, np.nan, limit)
    return limit


def scan_pi(process: Process, peak: float, greatest_k: float) -> Gains:
    """Return the PI gains with the greatest ki for |S| and |T| of at most `peak`."""
    lowest_k = 0.0 if process.integrates else LEAST_LOOP * process.denominator[-1] / process.numerator[-1]
    w, places = frequencies(process, COARSE), np.linspace(lowest_k, greatest_k, FIRST_PLACES)
    best = Gains(math.nan, math.nan)
    for _ in range(ROUNDS):
        limits = greatest_integral(process, places, w, peak)
        top = int(np.nanargmax(limits))
        width = 2 * (places[1] - places[0])
        best = Gains(float(places[top]), float(limits[top]))
        w, places = frequencies(process, FINE), np.linspace(best.k - width, best.k + width, PLACES)
    return best


def is_stable(process: Process, gains: Gains, filter_time: float) -> bool:
    """Return whether the closed loop is stable: Mikhailov's criterion for s^q (1 + L) with q poles of L at zero."""
    w, order = frequencies(process, COARSE), 2 if process.integrates else 1
    values = (1j * w) ** order * (1 + respond_loop(process, gains, filter_time, w))
    quarters = (np.angle(values[0]) + np.sum(np.angle(values[1:] / values[:-1]))) / (np.pi / 2)
    return round(float(quarters)) == order


def respond_loop(process: Process, gains: Gains, filter_time: float, w: np.ndarray) -> np.ndarray:
    """Return L(jw) with a derivative that is filter_time by a lag [s]."""
    s = 1j * w
    return process.respond(w) * (gains.k + gains.ki / s + gains.kd * s / (1 + filter_time * s))


def measure_peaks(process: Process, gains: Gains, filter_time: float, count: int = COARSE) -> float:
    """Return the greatest of |S| and |T|; infinity for an unstable loop."""
    if not is_stable(process, gains, filter_time):
        return np.inf
    loop = respond_loop(process, gains, filter_time, frequencies(process, count))
    return float(np.max(np.maximum(1.0, np.abs(loop)) / np.abs(1 + loop)))


def scale_to_peak(process: Process, gains: Gains, filter_time: float, peak: float) -> Gains | None:
    """Return the gains times the greatest factor that keeps |S| and |T| at most `peak`; None without one."""

    def scale(factor: float) -> Gains:
        return Gains(*(factor * gain for gain in gains))

    def is_inside(factor: float) -> bool:
        return measure_peaks(process, scale(factor), filter_time) <= peak

    low = next((factor for factor in FACTORS if is_inside(factor)), None)
    if low is None or low == FACTORS[0]:
        return None
    high = low * FACTORS[0] / FACTORS[1]
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_inside(middle) else (low, middle)
    return scale(low)


def integrate_error(process: Process, gains: Gains, filter_time: float) -> float:
    """Return the integral of the absolute error after a unit step of the load; NaN if the error does not settle.

    The error has the spectrum P S/(jw), with its exact delay, and 1/ki at w = 0. It is transformed over a horizon in
    which it settles.
    """
    gain = 1.0 if process.integrates else process.numerator[-1] / process.denominator[-1]
    horizon = HORIZON * (process.delay + abs(gains.k) / gains.ki + 1 / (gains.ki * gain)) + SLOW * process.duration
    w = 2 * np.pi / horizon * np.arange(1, POINTS // 2 + 1)
    spectrum = process.respond(w) / (1j * w * (1 + respond_loop(process, gains, filter_time, w)))
    error = np.abs(np.fft.irfft(np.append(1 / gains.ki, spectrum)) * POINTS / horizon)
    settled = np.max(error[-POINTS // 20 : -POINTS // 100]) < SETTLED * np.max(error)
    return float(np.mean(error) * horizon) if settled else np.nan
