"""Gain, phase and delay margins of a loop, its modulus margin, and the peaks of its sensitivities.

    L  the open loop, from one input to one output, closed by negative feedback;   S = 1/(1 + L),   T = L/(1 + L)

The poles decide whether the closed loop is stable. With a pure delay, the poles that cross the stability boundary are
counted while the delay grows from zero. They cross only where |L| = 1 (Cooke and van den Driessche, On zeroes of some
transcendental equations, 1986). Crossings are bracketed on a grid, which is refined until neighbours are close, and
bisected to rounding. The frequencies with |L| = 1 are eigenvalues of a Hamiltonian matrix, and the grid has a point
between each two of them (Boyd, Balakrishnan and Kabamba, A bisection method for computing the H-infinity norm, 1989).

In continuous time and without a delay, the direct path D is the limit of L at infinite frequency. It counts as a value
of L. A delay turns it through all angles. With |D| > 1 every delay makes infinitely many unstable poles. With |D| = 1
they come arbitrarily close to the imaginary axis, which counts as unstable too.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike

from diffabs.core.jax_flags import default_flags
from diffabs.core.shapes import Bool, Float
from diffabs.core.types import Any, JsonObject
from diffabs.linear.channel_loop import ChannelLoop, select_loop
from diffabs.linear.delay_steps import LEAST_DISTANCE, REACHING, DelayedLoop
from diffabs.linear.opened_loop import OpenLoop
from diffabs.linear.transfer import Transfer, check_transfer

# Decades of the grid beyond the slowest and the fastest pole, and its points per decade before it is refined.
GRID_DECADES, PER_DECADE = 4, 60
# Distance of |L| from 1 that counts as a touch of the unit circle, and distance on the grid of a place to examine.
UNIT_TOLERANCE, NEAR_UNIT = 1e-12, 0.1
NEIGHBOUR_DISTANCE, MAX_GRID_REFINEMENTS = 0.05, 14  # relative distance of neighbours; how often the grid is refined
# |L| below which the turns of a delay are not resolved; angle by which a delay turns L between points [rad].
SMALL_LOOP_GAIN, DELAY_TURN_ANGLE = 1e-3, 0.2
MAX_GRID_FREQUENCIES = 200_000  # points of a grid
MIN_FREQUENCY, MAX_RANGE_STEPS = 1e-60, 4  # lowest frequency of a grid [rad/s]; steps to crossovers far from the poles
NEAR_GREATEST = 0.05  # relative distance from the greatest value of a grid, within which a local maximum is refined
ROOT_BISECTIONS, GOLDEN = 70, (math.sqrt(5) - 1) / 2
REAL_TOLERANCE = 1e-9  # relative: L(0) and L at half the sampling rate are real but for rounding
# Longest delay to try with a sampled loop: in periods, and in multiples of the margin without a new sampling. The most
# steps of the delay, each as long as is safe, before the search gives up.
MAX_DELAY_PERIODS, MAX_DELAY_MULTIPLE = 1000, 4.0
MAX_DELAY_STEPS = 3000
WATCHED_DISTANCE = 10 * LEAST_DISTANCE  # distance of L from -1 below which the poles are computed after each step
MAX_SHIFTS = 30  # periods of delay that become states; with more, poles are counted by their crossings

MARGIN_UNITS = {
    "gain_up": "1",
    "gain_down": "1",
    "phase": "rad",
    "delay": "s",
    "modulus": "1",
    "sensitivity": "1",
    "complementary": "1",
    "crossover": "rad/s",
}


class Margins(NamedTuple):
    """Margins of a loop; all but `stable` and `crossover` are NaN for an unstable closed loop.

    In continuous time a frequency may be infinite: the limit of L counts.

    Attributes:
        stable: Whether the closed loop is stable.
        gain: Factors (low, high), low < 1 < high: the loop is stable for its gain times any factor between them. They
            are 0 and infinity without a limit.
        gain_at: Frequencies (low, high) at which the factors bring L to -1, the phase crossovers [rad/s]; NaN without a
            limit.
        phase: Phase margin [rad]: the smallest angle, lag or lead, that reaches -1; infinity without a crossover.
        phase_at: Its frequency [rad/s].
        delay: Delay margin [s], the smallest added delay that makes the loop unstable; 0 if every delay does. Infinity
            says that no delay does. NaN: the closed loop is unstable, or the search ended first (see `margins`).
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

    def numbers(self) -> dict[str, float]:
        """Return each margin and the crossover by name, with both gain margins, in the units of `MARGIN_UNITS`."""
        low, high = self.gain
        values = {"gain_up": high, "gain_down": low}
        return values | {name: getattr(self, name) for name in MARGIN_UNITS if name not in values}

    def record(self) -> JsonObject:
        """Return `stable` and the `numbers` as JSON values; infinity (no limit) is the text "inf", and NaN is None."""
        return {"stable": self.stable, **{name: json_number(value) for name, value in self.numbers().items()}}


def json_number(value: float) -> float | str | None:
    """Return a margin as a JSON value: infinity is the text "inf", and NaN is None."""
    return "inf" if value == math.inf else None if math.isnan(value) else float(value)


class Crossovers(NamedTuple):
    """The gain crossovers, at which |L| = 1, and the phase crossovers, at which L is real and negative.

    Attributes:
        unit_at: Frequencies with |L| = 1 [rad/s]; infinity is one of them if |D| = 1 in continuous time.
        falls: Whether |L| falls there, with growing frequency.
        phases: Angle of -L at these frequencies, the phase of L plus pi, in (-pi, pi] [rad].
        negative_at: Frequencies at which L is real and negative [rad/s]. Infinity is one of them in continuous time if
            D < 0, or if there is a delay and D is not zero.
        factors: 1/|L| at the frequencies `negative_at`.
    """

    unit_at: Float[np.ndarray, " units"]
    falls: Bool[np.ndarray, " units"]
    phases: Float[np.ndarray, " units"]
    negative_at: Float[np.ndarray, " negatives"]
    factors: Float[np.ndarray, " negatives"]


@default_flags()
def margins(loop: OpenLoop | Transfer, channel: str | None = None) -> Margins:
    """Return the margins of an open loop, or of one channel of a loop with several, with the others closed.

    In continuous time the delay margin is the smallest (phase lag to -1)/frequency over all crossovers. For a sampled
    `Transfer` only whole periods have a meaning: it is the fewest periods that make the loop unstable. An `OpenLoop`
    with a sampled controller is sampled again with each added delay. An unstable range of delays in which L passes -1
    by less than 1e-5 may be missed there.

    For a sampled loop the search ends at 1000 periods, or at 4 times (phase lag to -1)/frequency if that is more. For
    an `OpenLoop` it also ends after 3000 steps of the delay. The delay margin is NaN if it ends without a delay that
    makes the loop unstable. It is infinite only if no delay at all does. Then |L| < 1 at all frequencies with all
    delays (|L| < 0.99 for an `OpenLoop`, as a peak may be between points).

    Args:
        loop: Open loop with one input and one output, or the `OpenLoop` of a plant with several controls.
        channel: Name of the control whose channel is open.

    Raises:
        ValueError: The loop is no open loop, or has a field that `check_transfer` refuses. It has several inputs or
            outputs and no channel is named, or no channel has this name. Or it has several channels and a delay in
            continuous time.

    See also:
        `linear.multivariable_margins`: Margins of all channels together.
        `linear.Transfer`: A linear system with a delay, as an argument.
        `linear.open_loop`: The loop of a plant and a controller, opened at the control.
        `linear.linearize`: Its linear model.

    Notes:
        With the open loop L, negative feedback, S = 1/(1 + L) and T = L/(1 + L)

            gain      the factors k nearest to 1 with k L(jw) = -1
            phase     the least |angle| to -1 over all w with |L(jw)| = 1
            delay     the least lag/w to -1 over these w
            modulus   1/Ms, Ms = max |S(jw)|

        A loop with the modulus margin 1/Ms has a gain margin of at least Ms/(Ms - 1), and a phase margin of at least 2
        asin(1/(2 Ms)). Frequencies with |L| = 1 are eigenvalues of a Hamiltonian matrix (S. Boyd, V. Balakrishnan and
        P. Kabamba, A bisection method for computing the H-infinity norm, Math. Control Signals Syst. 2 (1989)). Only
        there can poles cross the imaginary axis while a delay grows (K. L. Cooke and P. van den Driessche, On zeroes of
        some transcendental equations, Funkcial. Ekvac. 29 (1986)).

    Examples:
        L = 1/(s (s + 1)) crosses 1 at w = 0.786 rad/s, with a phase margin of 51.8 degrees:

        >>> import math
        >>> import numpy as np
        >>> from diffabs.linear import Transfer, margins
        >>> A, B = np.array([[0.0, 1.0], [0.0, -1.0]]), np.array([[0.0], [1.0]])
        >>> result = margins(Transfer(A, B, C=np.array([[1.0, 0.0]]), D=np.zeros((1, 1))))
        >>> print(f"{math.degrees(result.phase):.1f} degrees at {result.phase_at:.3f} rad/s, {result.delay:.3f} s")
        51.8 degrees at 0.786 rad/s, 1.151 s
    """
    if not isinstance(loop, OpenLoop | Transfer):
        raise ValueError(
            f"loop = {type(loop).__name__} is no OpenLoop or Transfer: open_loop(loop) makes one of a Loop"
        )
    if channel is not None:
        return _find_margins(select_loop(loop, channel))
    return _find_margins(check_transfer(loop) if isinstance(loop, Transfer) else loop)


def _find_margins(loop: OpenLoop | ChannelLoop | Transfer) -> Margins:
    system = loop if isinstance(loop, Transfer) else check_transfer(loop.transfer())
    if np.shape(system.D) != (1, 1):
        (outputs, inputs), names = np.shape(system.D), " or ".join(getattr(loop, "channels", ()))
        hint = f"; name a channel: {names}" if names else ""
        raise ValueError(f"margins are of one input and one output; the system has {inputs} and {outputs}{hint}")
    w = frequency_grid(system)
    crossovers = find_crossovers(system, w)
    crossover = float(crossovers.unit_at.max()) if len(crossovers.unit_at) else math.nan
    if not is_stable(system):
        none = (math.nan, math.nan)
        return Margins(False, none, none, *none, math.nan, *none, *none, crossover)
    crossovers = _add_touches(system, w, crossovers)
    crossover = float(crossovers.unit_at.max()) if len(crossovers.unit_at) else math.nan
    i = int(np.argmin(np.abs(crossovers.phases))) if len(crossovers.phases) else None
    phase, phase_at = (math.inf, math.nan) if i is None else (abs(crossovers.phases[i]), crossovers.unit_at[i])
    gain, gain_at = _gain_margins(crossovers)
    ms, mt = _sensitivities(system, w)
    angle = (float(phase), float(phase_at))
    return Margins(True, gain, gain_at, *angle, _delay_margin(loop, system, w, crossovers), *ms, *mt, crossover)


def find_crossovers(system: Transfer, w: np.ndarray | None = None) -> Crossovers:
    """Return the frequencies [rad/s] at which |L| = 1, and at which L is real and negative, from a grid `w`."""
    w = frequency_grid(system) if w is None else w
    unit_at, falls = _roots(lambda w: np.log(np.abs(_response(system, w))), w)
    phases = np.angle(-_response(system, unit_at))
    negative_at, _ = _roots(lambda w: _response(system, w).imag, w)
    ends = [0.0, *([math.pi / system.period] if system.period else [])]
    negative_at = np.union1d(negative_at, [end for end in ends if _is_real(system, end)])
    values = _response(system, negative_at).real
    real = (values < 0) & np.isfinite(values)
    # A sign change at a pole is no crossing.
    real &= np.abs(_response(system, negative_at).imag) <= 1e-6 * np.abs(values)
    negative_at, factors = negative_at[real], -1 / values[real]
    if system.period is None:
        far = _limit_at_infinity(system)
        if abs(far) == 1:
            unit_at, phases = np.append(unit_at, math.inf), np.append(phases, np.angle(-far))
            falls = np.append(falls, True)
        if far < 0:
            negative_at, factors = np.append(negative_at, math.inf), np.append(factors, -1 / far)
    return Crossovers(unit_at, falls, phases, negative_at, factors)


def _add_touches(system: Transfer, w: np.ndarray, crossovers: Crossovers) -> Crossovers:
    """Return the crossovers with the frequencies at which |L| reaches 1 and does not cross it."""

    def distance(w: np.ndarray) -> np.ndarray:
        gap = np.abs(np.log(np.abs(_response(system, w))))
        return np.where(gap <= UNIT_TOLERANCE, 0.0, gap)

    with np.errstate(all="ignore"):
        values, signs = distance(w), np.sign(np.log(np.abs(_response(system, w))))
    # The end of the grid is the end of the axis only if the loop is sampled. A plateau counts where it ends.
    after = np.append(values[1:], math.inf if system.period else -math.inf)
    before = np.insert(values[:-1], 0, -math.inf)
    lowest = np.flatnonzero((values <= before) & (values < after) & (values < NEAR_UNIT))
    touches = []
    for i in lowest:
        around = slice(max(i - 1, 0), i + 2)
        gap, at = (0.0, w[i]) if values[i] == 0 else find_peak(lambda w: -distance(w), w[around])
        if gap == 0 and len(set(signs[around] > 0)) == 1:
            touches.append(at)
    unit_at = np.array(touches)
    return crossovers._replace(
        unit_at=np.append(crossovers.unit_at, unit_at),
        falls=np.append(crossovers.falls, np.ones(len(unit_at), bool)),
        phases=np.append(crossovers.phases, np.angle(-_response(system, unit_at))),
    )


def is_stable(system: Transfer) -> bool:
    """Return whether the closed loop is stable; its pure delay is included, without an approximation."""
    system = check_transfer(system)
    whole = 0 if system.period is None else system.count_periods()
    if not system.delay or 0 < whole <= MAX_SHIFTS:
        return unstable_poles(system.without_delay()) == 0
    if _is_unstable_with_any_delay(system):
        return False
    return unstable_poles(system._replace(delay=0.0)) + int(_poles_gained(system, np.array([system.delay]))[0]) == 0


def _poles_gained(system: Transfer, delays: np.ndarray) -> np.ndarray:
    """Return how many more unstable poles the closed loop has with each delay (k,) [s] than without a delay."""
    system = system._replace(delay=0.0)
    crossovers = find_crossovers(system)
    gained = np.zeros(len(delays))
    # A pair crosses outwards where |L| falls and inwards where |L| rises, again and again with each further turn of the
    # delay, 2 pi/w. `first` is the delay at which a pair of poles is at +-jw, or at the angle +-wT.
    for w, falls, phase in zip(crossovers.unit_at, crossovers.falls, crossovers.phases, strict=True):
        first = (phase % (2 * math.pi)) / w
        times = np.where(delays > first, 1 + np.floor((delays - first) * w / (2 * math.pi)), 0)
        gained += 2 * times if falls else -2 * times
    if system.period is not None and abs(_response(system, math.pi / system.period)[0]) >= 1:
        # |L| > 1 at z = -1: there each period of delay brings one more pole outside the circle, without |L| = 1.
        gained += np.round(delays / system.period)
    return gained


def unstable_poles(system: Transfer) -> int:
    """Return how many of the `closed_loop_poles` are unstable, those on the stability boundary included.

    If 1 + D = 0 the closed loop is not well-posed. The result is then the number of states plus 1.
    """
    if not 1 + system.D[0, 0]:
        return len(system.A) + 1
    poles = closed_loop_poles(system)
    return int(np.sum(np.real(poles) >= 0 if system.period is None else np.abs(poles) >= 1))


def closed_loop_poles(system: Transfer) -> np.ndarray:
    """Return the poles (order,) of the closed loop: in z if it is sampled, else in s.

    A delay in continuous time is left out, because it makes infinitely many poles. If 1 + D = 0 the closed loop is not
    well-posed, and the poles are NaN. With several channels D is a matrix, and I + D is singular.
    """
    system = system._replace(delay=0.0) if system.period is None else system.without_delay()
    if len(system.D) > 1:
        direct = np.eye(len(system.D)) + system.D
        if np.linalg.matrix_rank(direct) < len(direct):
            return np.full(len(system.A), math.nan)
        return np.linalg.eigvals(system.A - system.B @ np.linalg.solve(direct, system.C))
    if not 1 + system.D[0, 0]:
        return np.full(len(system.A), math.nan)
    return np.linalg.eigvals(system.A - system.B @ system.C / (1 + system.D[0, 0]))


def frequency_grid(system: Transfer) -> np.ndarray:
    """Return frequencies (k,) [rad/s] between which L changes little.

    They begin well below the slowest pole and the lowest crossover. They end well above the fastest pole and the
    highest crossover, or at half the sampling rate.
    """
    poles, closed = system.poles, closed_loop_poles(system._replace(delay=0.0))
    if system.period is not None:
        poles, closed = (np.log(z[np.abs(z) > 1e-12].astype(complex)) / system.period for z in (poles, closed))
    half = math.pi / system.period if system.period else math.inf
    low, high = _frequency_range(system, np.abs(np.concatenate([poles, closed])), half)
    low, high = low * 10.0**-GRID_DECADES, min(high * 10.0**GRID_DECADES, half)
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
    w = _refine_grid(system, w)
    between = _between_crossovers(system)
    return np.union1d(w, between[between < half])


def _frequency_range(system: Transfer, sizes: np.ndarray, half: float) -> tuple[float, float]:
    """Return the lowest and the highest frequency of poles and crossovers, up to `half` the sampling rate [rad/s].

    Poles do not show a crossover that is far from all of them: one of them may be rounding. Beyond the poles L is
    g w^k, so |L| = 1 at w |L(w)|^(-1/k).
    """
    sizes = sizes[sizes > MIN_FREQUENCY]
    low, high = (min(sizes.min(), half), min(sizes.max(), half)) if len(sizes) else (min(1.0, half),) * 2
    for way in (-1, 1):
        for _ in range(MAX_RANGE_STEPS):
            w = low if way < 0 else high
            w = w * 10.0 ** (way * GRID_DECADES)
            if not MIN_FREQUENCY < w < min(half, 1 / MIN_FREQUENCY):
                break
            with np.errstate(divide="ignore"):  # L may be 0
                near, far = np.log(np.abs(_response(system._replace(delay=0.0), np.array([w, w * 10.0**way]))))
            if not (np.isfinite(near) and np.isfinite(far)):
                break
            slope = round((far - near) / math.log(10.0))  # of log |L| in the direction away from the poles
            if not slope or near * slope >= 0:  # constant, or already away from |L| = 1
                break
            crossing = w * math.exp(min(-near / slope, 600.0) * way)
            low, high = (max(crossing, MIN_FREQUENCY), high) if way < 0 else (low, min(crossing, half))
    return low, high


def _between_crossovers(system: Transfer) -> np.ndarray:
    """Return a frequency between each two neighbours with |L| = 1 [rad/s], and some others.

    The frequencies with |L| = 1 are eigenvalues jw of the Hamiltonian matrix. All eigenvalues above the real axis are
    used, so that no tolerance has to say which are imaginary. The result is empty if |L| = 1 at the end of the axis.
    """
    a, b, c, d = (np.asarray(x, float) for x in system[:4])
    try:
        if system.period is not None:  # s = (z - 1)/(z + 1) maps the unit circle to the imaginary axis
            inverse = np.linalg.inv(a + np.eye(len(a)))
            a, b, c, d = inverse @ (a - np.eye(len(a))), 2 * inverse @ b, c @ inverse, d - c @ inverse @ b
        if not (short := 1 - d[0, 0] ** 2):
            return np.zeros(0)
        f = a + b @ c * d[0, 0] / short
        s = np.linalg.eigvals(np.block([[f, b @ b.T / short], [-c.T @ c / short, -f.T]]))
    except np.linalg.LinAlgError:
        return np.zeros(0)
    w = np.sort(s.imag[s.imag > 0])
    w = np.sqrt(w[1:] * w[:-1])
    return w if system.period is None else 2 * np.arctan(w) / system.period


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


def _response(system: Transfer, w: ArrayLike) -> Any:
    return system.response(w)[:, 0, 0]


def _rational_response(system: Transfer, w: float) -> complex:
    return complex(system.rational_response(w)[0, 0, 0])


def _complementary_sensitivity(values: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):
        return np.where(np.isfinite(values), values / (1 + values), 1.0)


def _roots(function: Callable[[np.ndarray], np.ndarray], w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where a function changes its sign between neighbours of a grid, and whether it falls there.

    The places are bisected to rounding. Zero counts as negative.
    """

    def sign(w: np.ndarray) -> np.ndarray:
        values = function(w)
        return np.where(values == 0, -1.0, np.sign(values))

    with np.errstate(all="ignore"):
        signs = sign(w)
        crossings = np.flatnonzero(signs[1:] * signs[:-1] < 0)
        low, high, before = w[crossings], w[crossings + 1], signs[crossings]
        for _ in range(ROOT_BISECTIONS if len(crossings) else 0):
            middle = 0.5 * (low + high)
            before_root = sign(middle) == before
            low, high = np.where(before_root, middle, low), np.where(before_root, high, middle)
    return 0.5 * (low + high), before > 0


def find_peak(function: Callable[[np.ndarray], np.ndarray], w: np.ndarray) -> tuple[float, float]:
    """Return the maximum of a function and its place, by golden-section search around maxima on a grid.

    Of nearly equal peaks, as a long delay makes, the highest need not have the highest point of the grid.
    """
    with np.errstate(all="ignore"):
        values = function(w)
        values = np.where(np.isnan(values), -math.inf, values)
        before, after = np.append(-math.inf, values[:-1]), np.append(values[1:], -math.inf)
        greatest = values.max()
        high_enough = (
            values >= greatest - NEAR_GREATEST * abs(greatest) if math.isfinite(greatest) else values == greatest
        )
        i = np.flatnonzero((values >= before) & (values >= after) & high_enough)
        low, high = w[np.maximum(i - 1, 0)], w[np.minimum(i + 1, len(w) - 1)]
        while np.any(high - low > 1e-9 * high):
            a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
            rises = np.less_equal(*np.split(function(np.concatenate([a, b])), 2))
            low, high = np.where(rises, a, low), np.where(rises, high, b)
        places = np.append(w[i], 0.5 * (low + high))
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
    peaks = [find_peak(function, w) for function in sensitivities]
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
    """Return whether L is real at an end `w` of the frequency axis, and below `1/REAL_TOLERANCE`."""
    value = _response(system, w)[0]
    return (
        bool(np.isfinite(value)) and abs(value.imag) <= REAL_TOLERANCE * abs(value) and abs(value) < 1 / REAL_TOLERANCE
    )


def _gain_margins(crossovers: Crossovers) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the factors nearest to 1, below and above, and their frequencies."""
    low, high, low_at, high_at = 0.0, math.inf, math.nan, math.nan
    for factor, w in zip(crossovers.factors.tolist(), crossovers.negative_at.tolist(), strict=True):
        if low < factor < 1:
            low, low_at = factor, w
        if 1 < factor < high:
            high, high_at = factor, w
    return (low, high), (low_at, high_at)


def _delay_margin(
    loop: OpenLoop | ChannelLoop | Transfer, system: Transfer, w: np.ndarray, crossovers: Crossovers
) -> float:
    """Return the delay margin of a stable loop [s]; `system` is its transfer function on the grid `w`."""
    if _is_unstable_with_any_delay(system):
        return 0.0
    delays = (crossovers.phases % (2 * math.pi)) / crossovers.unit_at
    guess = float(delays.min()) if len(delays) else math.inf
    if loop.period is None:
        return guess
    end = max(MAX_DELAY_PERIODS * loop.period, MAX_DELAY_MULTIPLE * guess if len(delays) else 0.0)
    return _count_margin(loop, len(delays) > 0, end) if isinstance(loop, Transfer) else _find_margin(loop, w, end)


def _count_margin(loop: Transfer, crosses: bool, end: float) -> float:
    """Return the fewest whole periods that make a stable sampled loop unstable [s].

    It is infinity if |L| < 1 everywhere, and NaN if no delay up to `end` suffices. `crosses`: whether |L| = 1 anywhere.
    """
    period = float(loop.period or math.nan)
    if not crosses and abs(_response(loop, math.pi / period)[0]) < 1:
        return math.inf
    # A pair of poles crosses at the delays first + 2 pi k/w. Only the first whole periods after each are examined.
    crossovers = find_crossovers(loop._replace(delay=0.0))
    delays = [loop.delay + period]
    for w, phase in zip(crossovers.unit_at, crossovers.phases, strict=True):
        turn = 2 * math.pi / w
        first = phase % (2 * math.pi) / w
        start = math.floor(max(loop.delay - first, 0.0) / turn)
        delays += [first + turn * k for k in range(start, start + math.ceil(end / turn) + 2)]
    periods = np.unique(np.ceil((np.array(delays) - loop.delay) / period))
    periods = np.union1d(periods, periods + 1)  # a pair that is on the circle has not crossed yet
    added = periods[(periods >= 1) & (periods <= math.ceil(end / period))] * period
    present, *gained = _poles_gained(loop, np.append(0.0, added) + loop.delay)
    unstable = np.flatnonzero(np.array(gained) > present)
    return float(added[unstable[0]]) if len(unstable) else math.nan


def _find_margin(loop: OpenLoop | ChannelLoop, w: np.ndarray, end: float) -> float:
    """Return the smallest added delay that makes a stable loop with a sampled controller unstable [s].

    It is infinity if |L| < 0.99 with every delay. It is NaN if no delay up to `end` suffices, or the steps run out.
    """
    delayed = DelayedLoop(loop, w)
    if delayed.largest < REACHING:
        return math.inf
    low = 0.0
    for _ in range(MAX_DELAY_STEPS):
        if low >= end:
            break
        step = delayed.step(loop.delay + low)
        high = low + step.size
        if step.distance < WATCHED_DISTANCE and not is_stable(loop.transfer(high)):
            return _bisect_delay(loop, low, high)
        low = high
    return math.nan


def _bisect_delay(loop: OpenLoop | ChannelLoop, low: float, high: float) -> float:
    """Return the added delay between a stable and an unstable one at which the loop turns unstable [s]."""
    while high - low > 1e-12 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(loop.transfer(middle)) else (low, middle)
    return 0.5 * (low + high)
