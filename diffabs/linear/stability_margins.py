"""Gain, phase and delay margins of a loop, its modulus margin, and the peaks of its sensitivities.

    L  the open loop, of one input and one output, with feedback u = -L v;   S = 1/(1 + L),   T = L/(1 + L)

The poles decide whether the closed loop is stable. With a pure delay in continuous time, the poles that cross the
imaginary axis are counted while the delay grows from zero. They cross only where |L| = 1 (Cooke and van den Driessche,
On zeroes of some transcendental equations, 1986). Crossings are bracketed on a grid, which is refined until neighbours
are close, and bisected to rounding.

In continuous time and without a delay, the direct path D is the limit of L at infinite frequency. It counts as a value
of L. A delay turns it through all angles. With |D| > 1 every delay makes infinitely many unstable poles. With |D| = 1
they come arbitrarily close to the imaginary axis, which counts as unstable too.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from diffabs.core.types import Matrix, Scalar
from diffabs.linear.opened_loop import OpenLoop
from diffabs.linear.transfer import Transfer, check_delay

GRID_DECADES, PER_DECADE = 4, 60  # beyond the slowest and the fastest pole; points of the grid before it is refined
NEIGHBOUR_DISTANCE, MAX_GRID_REFINEMENTS = 0.05, 14  # relative distance of neighbours; how often the grid is refined
# |L| below which the turns of a delay are not resolved; angle by which a delay turns L between points [rad].
SMALL_LOOP_GAIN, DELAY_TURN_ANGLE = 1e-3, 0.2
MAX_GRID_FREQUENCIES = 200_000  # points of a grid
ROOT_BISECTIONS, GOLDEN = 70, (math.sqrt(5) - 1) / 2
REAL_TOLERANCE = 1e-9  # relative: |L(0)| and L at half the sampling rate are real but for rounding
# Search for the delay margin of a sampled loop: steps up to the first guess, and its largest multiple to try.
DELAY_SEARCH_STEPS, MAX_DELAY_MULTIPLE = 40, 4.0


class Margins(NamedTuple):
    """Margins of a loop; all but `stable` and `crossover` are NaN for an unstable closed loop.

    In continuous time a frequency may be infinite: the limit of L counts.

    Attributes:
        stable: Whether the closed loop is stable.
        gain: Factors (low, high), low < 1 < high: the loop is stable for its gain times any factor between them. They
            are 0 and infinity without a limit.
        gain_at: Frequencies (low, high) at which the factors bring L to -1 [rad/s]; NaN without a limit.
        phase: Phase margin [rad]: the smallest angle, lag or lead, that reaches -1; infinity without a crossover.
        phase_at: Its frequency [rad/s].
        delay: Delay margin [s]; infinity without a limit, 0 if every delay makes the loop unstable.
        sensitivity: Ms, the largest |S|; 1/Ms is the modulus margin.
        sensitivity_at: Its frequency [rad/s].
        complementary: Mt, the largest |T|.
        complementary_at: Its frequency [rad/s].
        crossover: Highest frequency at which |L| = 1 [rad/s]; NaN if there is none.
    """

    stable: bool
    gain: tuple[float, float]
    gain_at: tuple[float, float]
    phase: float
    phase_at: float
    delay: float
    sensitivity: float
    sensitivity_at: float
    complementary: float
    complementary_at: float
    crossover: float

    @property
    def modulus(self) -> float:
        """Modulus margin 1/Ms: the smallest distance of L from -1."""
        return 1 / self.sensitivity


class Crossovers(NamedTuple):
    """Frequencies at which |L| = 1, and frequencies at which L is real and negative.

    Attributes:
        gain_at: Frequencies with |L| = 1 [rad/s]; infinity is one of them if |D| = 1 in continuous time.
        phases: Angle of -L at these frequencies, the phase of L plus pi, in (-pi, pi] [rad].
        phase_at: Frequencies at which L is real and negative [rad/s]. Infinity is one of them in continuous time if
            D < 0, or if there is a delay and D is not zero.
        factors: 1/|L| at the frequencies `phase_at`.
    """

    gain_at: np.ndarray
    phases: np.ndarray
    phase_at: np.ndarray
    factors: np.ndarray


def margins(loop: OpenLoop | Transfer) -> Margins:
    """Return the margins of an open loop.

    The delay margin is the smallest (phase lag to -1)/frequency over all crossovers. For a sampled `Transfer` only
    whole periods have a meaning: it is at most one period if one more period makes the loop unstable. An `OpenLoop`
    with a sampled controller is sampled again with each added delay instead.

    Args:
        loop: Open loop with one input and one output.

    Raises:
        ValueError: The system has several inputs or outputs, or a negative delay.
    """
    system = loop.transfer() if isinstance(loop, OpenLoop) else loop
    if np.shape(system.D) != (1, 1):
        raise ValueError(f"margins are of one input and one output; the system has {np.shape(system.D)[::-1]}")
    check_delay(system)
    w = frequency_grid(system)
    found = find_crossovers(system, w)
    crossover = float(found.gain_at.max()) if len(found.gain_at) else math.nan
    if not is_stable(system):
        none = (math.nan, math.nan)
        return Margins(False, none, none, *none, math.nan, *none, *none, crossover)
    i = int(np.argmin(np.abs(found.phases))) if len(found.phases) else None
    phase, phase_at = (math.inf, math.nan) if i is None else (abs(found.phases[i]), found.gain_at[i])
    gain, gain_at = _gain_margins(found)
    ms, mt = _sensitivities(system, w)
    angle = (float(phase), float(phase_at))
    return Margins(True, gain, gain_at, *angle, _delay_margin(loop, system, found), *ms, *mt, crossover)


def find_crossovers(system: Transfer, w: np.ndarray | None = None) -> Crossovers:
    """Return the frequencies at which |L| = 1, and at which L is real and negative.

    Args:
        system: Open loop with one input and one output.
        w: Grid of frequencies [rad/s]; by default `frequency_grid(system)`.
    """
    w = frequency_grid(system) if w is None else w
    gain_at = _roots(lambda w: np.log(np.abs(_response(system, w))), w)
    phases = np.angle(-_response(system, gain_at))
    phase_at = _roots(lambda w: _response(system, w).imag, w)
    ends = [0.0, *([math.pi / system.period] if system.period else [])]
    phase_at = np.union1d(phase_at, [end for end in ends if _is_real(system, end)])
    values = _response(system, phase_at).real
    real = (values < 0) & np.isfinite(values)
    real &= np.abs(_response(system, phase_at).imag) <= 1e-6 * np.abs(values)  # a sign change at a pole is no crossing
    phase_at, factors = phase_at[real], -1 / values[real]
    if system.period is None:
        far = _limit_at_infinity(system)
        if abs(far) == 1:
            gain_at, phases = np.append(gain_at, math.inf), np.append(phases, np.angle(-far))
        if far < 0:
            phase_at, factors = np.append(phase_at, math.inf), np.append(factors, -1 / far)
    return Crossovers(gain_at, phases, phase_at, factors)


def is_stable(system: Transfer) -> bool:
    """Return whether the closed loop is stable: all poles in the left half-plane, or in the unit circle if sampled.

    The pure delay is included, without an approximation.

    Args:
        system: Open loop with one input and one output.

    Raises:
        ValueError: The delay is negative, or no whole number of periods if sampled.
    """
    check_delay(system)
    if system.period is not None or not system.delay:
        return unstable_poles(system.without_delay()) == 0
    if _is_unstable_with_any_delay(system):
        return False
    # The poles of the delay-free loop, and the crossings of |L| = 1. A pair crosses to the right where |L| falls and to
    # the left where |L| rises, again and again with each further turn of the delay, 2 pi/w.
    count = unstable_poles(system._replace(delay=0.0))
    turning = find_crossovers(system._replace(delay=0.0))
    for w, phase in zip(turning.gain_at, turning.phases, strict=True):
        first = (phase % (2 * math.pi)) / w  # the delay at which a pair of poles is at +-jw
        if system.delay > first:
            times = 1 + math.floor((system.delay - first) * w / (2 * math.pi))
            falling = abs(_rational_response(system, w * 1.0001)) < abs(_rational_response(system, w * 0.9999))
            count += 2 * times if falling else -2 * times
    return count == 0


def unstable_poles(system: Transfer) -> int:
    """Return the number of unstable poles of the closed loop, those on the stability boundary included.

    If 1 + D = 0 the closed loop is not well-posed. The result is then the number of states plus 1.

    Args:
        system: Open loop with one input, one output and no delay.
    """
    if not 1 + system.D[0, 0]:
        return len(system.A) + 1
    poles = closed_loop_poles(system)
    return int(np.sum(np.real(poles) >= 0 if system.period is None else np.abs(poles) >= 1))


def closed_loop_poles(system: Transfer) -> np.ndarray:
    """Return the poles (order,) of the closed loop: in z if it is sampled, else in s.

    A delay in continuous time is left out, because it makes infinitely many poles.

    Args:
        system: Open loop with one input and one output.
    """
    system = system._replace(delay=0.0) if system.period is None else system.without_delay()
    return np.linalg.eigvals(system.A - system.B @ system.C / ((1 + system.D[0, 0]) or 1.0))


def frequency_grid(system: Transfer) -> np.ndarray:
    """Return frequencies (k,) [rad/s] between which L changes little.

    They begin well below the slowest pole, and end well above the fastest or at half the sampling rate.

    Args:
        system: Open loop with one input and one output.
    """
    poles, closed = system.poles, closed_loop_poles(system._replace(delay=0.0))
    if system.period is not None:
        poles, closed = (np.log(z[np.abs(z) > 1e-12].astype(complex)) / system.period for z in (poles, closed))
    sizes = np.abs(np.concatenate([poles, closed]))
    sizes = sizes[sizes > 1e-9]
    half = math.pi / system.period if system.period else math.inf
    low, high = (sizes.min(), sizes.max()) if len(sizes) else (1.0, 1.0)
    low, high = min(low, half) * 10.0**-GRID_DECADES, min(high * 10.0**GRID_DECADES, half)
    w = np.geomspace(low, high, int(PER_DECADE * math.log10(high / low)) + 2)
    # Extra points around each lightly damped pole, where L changes fast.
    around = [abs(p.imag) + abs(p.real) * np.linspace(-5, 5, 41) for p in poles if p.imag > 0]
    w = np.unique(np.concatenate([w, *around]))
    w = w[(w >= low) & (w <= high)]
    # Extra points between which a delay turns L by a small angle, up to where L is small.
    large = w[np.abs(_response(system, w)) > SMALL_LOOP_GAIN] if system.delay else w[:0]
    if len(large):
        count = min(MAX_GRID_FREQUENCIES, int(large[-1] * system.delay / DELAY_TURN_ANGLE) + 2)
        w = np.union1d(w, np.linspace(w[0], large[-1], count))
    return _refine_grid(system, w)


def _refine_grid(system: Transfer, w: np.ndarray) -> np.ndarray:
    """Return the grid with points added between neighbours with different L, relative to its distance from 0 and -1."""
    values = _response(system, w)
    for _ in range(MAX_GRID_REFINEMENTS):
        change = np.abs(np.diff(values))
        near = np.minimum(np.abs(values), np.abs(1 + values))
        wide = change > NEIGHBOUR_DISTANCE * np.maximum(np.minimum(near[1:], near[:-1]), 1e-6)
        wide &= np.maximum(np.abs(values[1:]), np.abs(values[:-1])) > SMALL_LOOP_GAIN
        wide &= np.diff(w) > 1e-9 * w[1:]
        if not wide.any() or len(w) > MAX_GRID_FREQUENCIES:
            break
        middle = np.sqrt(w[:-1][wide] * w[1:][wide])
        places = np.flatnonzero(wide) + 1
        w, values = np.insert(w, places, middle), np.insert(values, places, _response(system, middle))
    return w


def _response(system: Transfer, w: Scalar) -> Matrix:
    return system.response(w)[:, 0, 0]


def _rational_response(system: Transfer, w: float) -> complex:
    return complex(system.rational_response(w)[0, 0, 0])


def _complementary_sensitivity(values: np.ndarray) -> np.ndarray:
    """Return T; 1 where L is infinite."""
    with np.errstate(all="ignore"):
        return np.where(np.isfinite(values), values / (1 + values), 1.0)


def _roots(function: Callable[[np.ndarray], np.ndarray], w: np.ndarray) -> np.ndarray:
    """Return the places where a function changes its sign between neighbours of a grid, bisected to rounding."""
    with np.errstate(all="ignore"):
        sign = np.sign(function(w))
        here = np.flatnonzero((sign[1:] * sign[:-1] < 0) | (sign[1:] == 0))
        low, high, before = w[here], w[here + 1], sign[here]
        for _ in range(ROOT_BISECTIONS if len(here) else 0):
            middle = 0.5 * (low + high)
            left = np.sign(function(middle)) == before
            low, high = np.where(left, middle, low), np.where(left, high, middle)
    return 0.5 * (low + high)


def _peak(function: Callable[[np.ndarray], np.ndarray], w: np.ndarray) -> tuple[float, float]:
    """Return the maximum of a function and its place, by golden-section search around the maximum on a grid."""
    with np.errstate(all="ignore"):
        i = int(np.nanargmax(function(w)))
        low, high = w[max(i - 1, 0)], w[min(i + 1, len(w) - 1)]
        while high - low > 1e-9 * high:
            a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
            values = function(np.array([a, b]))
            low, high = (low, b) if values[0] > values[1] else (a, high)
        places = np.array([w[i], 0.5 * (low + high)])
        values = function(places)
    best = int(np.nanargmax(values))
    return float(values[best]), float(places[best])


def _sensitivities(system: Transfer, w: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the peaks of |S| and |T| with their frequencies; 0 and, in continuous time, infinity count too."""
    w = np.concatenate([[0.0], w])
    sensitivities = (
        lambda w: 1 / np.abs(1 + _response(system, w)),
        lambda w: np.abs(_complementary_sensitivity(_response(system, w))),
    )
    peaks = [_peak(function, w) for function in sensitivities]
    if system.period is None:
        far = _limit_at_infinity(system)
        ends = (1 / abs(1 + far), abs(far / (1 + far)))
        peaks = [max(peak, (end, math.inf)) for peak, end in zip(peaks, ends, strict=True)]
    return peaks[0], peaks[1]


def _limit_at_infinity(system: Transfer) -> float:
    """Return the limit of L at infinite frequency, in continuous time.

    With a delay there is no limit: L circles around 0 with the radius |D|. The value nearest to -1 is returned.
    """
    direct = float(system.D[0, 0])
    return -abs(direct) if system.delay else direct


def _is_unstable_with_any_delay(system: Transfer) -> bool:
    """Return whether the closed loop is unstable with every positive delay: |D| >= 1 in continuous time."""
    return system.period is None and abs(system.D[0, 0]) >= 1


def _is_real(system: Transfer, w: float) -> bool:
    """Return whether L is finite and real at an end of the frequency axis."""
    value = _response(system, w)[0]
    return (
        bool(np.isfinite(value)) and abs(value.imag) <= REAL_TOLERANCE * abs(value) and abs(value) < 1 / REAL_TOLERANCE
    )


def _gain_margins(found: Crossovers) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the factors nearest to 1, below and above, and their frequencies."""
    low, high, low_at, high_at = 0.0, math.inf, math.nan, math.nan
    for factor, w in zip(found.factors.tolist(), found.phase_at.tolist(), strict=True):
        if low < factor < 1:
            low, low_at = factor, w
        if 1 < factor < high:
            high, high_at = factor, w
    return (low, high), (low_at, high_at)


def _delay_margin(loop: OpenLoop | Transfer, system: Transfer, found: Crossovers) -> float:
    """Return the delay margin of a stable loop [s]; `system` is its transfer function."""
    if _is_unstable_with_any_delay(system):
        return 0.0
    delays = (found.phases % (2 * math.pi)) / found.gain_at
    guess = float(delays.min()) if len(delays) else math.inf
    if isinstance(loop, Transfer) and loop.period is not None:
        # Only whole periods have a meaning here. The crossovers do not show whether one more period is too much where
        # |L| >= 1 at half the sampling rate, so it is tried.
        late = loop._replace(delay=loop.delay + loop.period)
        return guess if is_stable(late) else min(guess, loop.period)
    if not isinstance(loop, OpenLoop) or loop.period is None or not math.isfinite(guess):
        return guess
    step, low = max(guess, loop.period) / DELAY_SEARCH_STEPS, 0.0
    while is_stable(loop.transfer(low + step)):
        low += step
        if low > MAX_DELAY_MULTIPLE * max(guess, loop.period):
            return math.inf
    high = low + step
    while high - low > 1e-12 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(loop.transfer(middle)) else (low, middle)
    return 0.5 * (low + high)
