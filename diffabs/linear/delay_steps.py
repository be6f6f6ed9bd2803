"""How much delay a sampled loop bears: steps of the delay that do not reach the stability boundary, on a fine grid.

A held input that arrives late by d = n T + f gives the open loop, with z = e^(j w T),

    L(w, d) = -K(z) C (z I - e^(A T))^-1 z^-n [ (1 - 1/z) G(T - f) + G(T)/z ]
    G(s) = integral of e^(A r) B over r in [0, s]

L is continuous in d, also where n changes. A closed-loop pole is on the unit circle only where L = -1. At each
frequency, s seconds of extra delay move L by at most R s. R is the largest rate |dL/dd| over all fractions f. If n does
not change, the movement is also at most |dL/dd| s + M s^2/2, where M is the largest second derivative. As long as one
of these is below |1 + L| at all frequencies, no pole changes its side. The maxima are those of a grid, with a reserve.

Whole periods only turn L. So where |L| < 1 for all fractions, no delay at all reaches -1.
"""

from typing import NamedTuple

import numpy as np

from diffabs.linear.channel_loop import ChannelLoop
from diffabs.linear.opened_loop import OpenLoop, sample_plant
from diffabs.linear.zero_order_hold import hold_input

# Fractions of a period for the largest |L| and its rates: at least, per turn of the fastest pole, at most.
FRACTIONS, FRACTIONS_PER_TURN, MAX_FRACTIONS = 16, 32, 512
NEIGHBOUR_DISTANCE, MAX_REFINEMENTS = 0.05, 12  # distance of neighbours relative to max(1, |L|); how often halved
# Largest |L| over all fractions from which L may reach -1. It is below 1, because the peak may be between the points.
REACHING = 0.99
RATE_RESERVE = 1.1  # for rates between the points of the grids
TURN_BETWEEN = 0.1  # angle by which the delay turns L between neighbours [rad]
NEAR, PIECES = 0.05, 16  # distance from -1 below which a chord is divided; into how many pieces
HUGE = 1e3  # |1 + L| of neighbours between which L has a pole, or nearly
LEAST_DISTANCE = 1e-5  # smallest distance used for a step, also if L is nearer to -1: otherwise the search would stall


class DelayStep(NamedTuple):
    """A step of the delay.

    Attributes:
        size: Delay that may be added [s].
        distance: Smallest distance of L from -1 where L may reach -1 with a delay.
    """

    size: float
    distance: float


class _Curve(NamedTuple):
    """The response on a grid.

    Attributes:
        w: Frequencies (k,) [rad/s].
        row: Response (k, n) from a change of the plant's state to minus the command.
        rate: Largest |dL/dd| over all fractions, (k,) [1/s].
        bend: Largest second derivative, (k,) [1/s2].
    """

    w: np.ndarray
    row: np.ndarray
    rate: np.ndarray
    bend: np.ndarray


class DelayedLoop:
    """The response of a sampled open loop as a function of its delay."""

    def __init__(self, loop: OpenLoop | ChannelLoop, w: np.ndarray):
        """Prepare the loop for all delays, from a grid of frequencies `w` (k,) [rad/s] that is refined.

        `largest` is then the largest |L| over all frequencies and delays.
        """
        self.loop = loop
        self.period: float = float(loop.period or 0.0)
        self._plant = sample_plant(loop.plant, self.period, 0.0)
        powers, held = hold_input(loop.plant.A, loop.plant.B, self._rests())
        self._inputs, self._slopes = held[:, :, 0].T, (powers @ loop.plant.B)[:, :, 0].T
        self._longest = 0.0
        self.largest: float
        self._curve, self._reaching, self.largest = self._trace(self._refine(w))

    def step(self, delay: float) -> DelayStep:
        """Return a step from a whole delay [s] that keeps the number of unstable poles.

        It is no such step if L is within `LEAST_DISTANCE` of -1.
        """
        if delay > self._longest:
            self._longest = 2 * delay
            self._curve, self._reaching, _ = self._trace(self._divide_for(self._longest))
        steps, distances = self._bound(self._curve, delay)
        near = np.flatnonzero(self._reaching & (distances < NEAR))
        far = self._reaching & (distances >= NEAR)
        steps, distances = steps[far], distances[far]
        if len(near):
            # The curve may be nearer to -1 than its chord, so chords near -1 are divided.
            w = self._curve.w
            pieces = (w[near, None] + (w[near + 1] - w[near])[:, None] * np.linspace(0, 1, PIECES + 1)).ravel()
            divided = self._bound(self._trace(pieces)[0], delay)
            inner = np.arange(1, len(pieces)) % (PIECES + 1) != 0
            steps, distances = np.append(steps, divided[0][inner]), np.append(distances, divided[1][inner])
        return DelayStep(float(np.nanmin(steps)), float(np.nanmin(distances)))

    def _rests(self) -> np.ndarray:
        """Return remaining times T - f of a period; they are dense near 0, where fast poles still act."""
        poles = self.loop.plant.poles
        turns = float(np.max(np.abs(np.imag(poles)), initial=0.0)) * self.period / (2 * np.pi)
        count = min(MAX_FRACTIONS, FRACTIONS + int(FRACTIONS_PER_TURN * turns))
        return self.period * np.union1d(np.linspace(0, 1, count + 1), np.geomspace(1e-4, 1, FRACTIONS))

    def _respond(self, w: np.ndarray, row: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Return L (k, m) with less than a period of delay f, for `inputs` G(T - f) of shape (n, m)."""
        back = np.exp(-1j * w * self.period)[:, None]
        return (1 - back) * (row @ inputs) + back * (row @ self._plant.B)

    def _trace(self, w: np.ndarray) -> tuple[_Curve, np.ndarray, float]:
        """Return the curve on a grid, which of its chords may reach -1 with a delay (k - 1,), and the largest |L|."""
        row = self.loop.respond_to_state(w)
        with np.errstate(all="ignore"):
            size = np.max(np.abs(self._respond(w, row, self._inputs)), axis=1)
            turn = RATE_RESERVE * np.abs(1 - np.exp(-1j * w * self.period))
            rate = turn * np.max(np.abs(row @ self._slopes), axis=1)
            bend = turn * np.max(np.abs(row @ (self.loop.plant.A @ self._slopes)), axis=1)
        reaching = size >= REACHING
        return _Curve(w, row, rate, bend), reaching[1:] | reaching[:-1], float(np.nanmax(size, initial=0.0))

    def _refine(self, w: np.ndarray) -> np.ndarray:
        """Return the grid with points added where L changes much between neighbours, for any fraction."""
        columns = self._inputs[:, :: max(1, self._inputs.shape[1] // FRACTIONS)]
        for _ in range(MAX_REFINEMENTS):
            with np.errstate(all="ignore"):
                values = self._respond(w, self.loop.respond_to_state(w), columns)
                size = np.maximum(np.abs(values[1:]), np.abs(values[:-1]))
                change = np.abs(np.diff(values, axis=0)) / np.maximum(1, size)
                wide = ((change > NEIGHBOUR_DISTANCE) & (size > 0.5)).any(axis=1)
            if not wide.any():
                break
            w = np.insert(w, np.flatnonzero(wide) + 1, 0.5 * (w[1:] + w[:-1])[wide])
        return w

    def _divide_for(self, delay: float) -> np.ndarray:
        """Return the grid divided where L may reach -1, so that this delay turns L little between neighbours."""
        w = self._curve.w
        pieces = np.where(self._reaching, np.ceil(np.diff(w) * delay / TURN_BETWEEN), 1.0).clip(1).astype(int)
        starts = np.repeat(np.arange(len(pieces)), pieces)
        within = np.arange(len(starts)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        return np.append(w[starts] + np.diff(w)[starts] * within / pieces[starts], w[-1])

    def _bound(self, curve: _Curve, delay: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest safe step, and the distance from -1, for each chord of the Nyquist curve."""
        w, row, rate, bend = curve
        whole = np.floor(delay / self.period)
        remainder = self.period - min(max(delay - whole * self.period, 0.0), self.period)
        plant = self.loop.plant
        (power,), (held,) = hold_input(plant.A, plant.B, np.array([remainder]))
        with np.errstate(all="ignore"):
            values = 1 + self._respond(w, row, held)[:, 0] * np.exp(-1j * w * (self.period * whole))
            now = RATE_RESERVE * np.abs((1 - np.exp(-1j * w * self.period)) * (row @ (power @ plant.B))[:, 0])
            start, along = values[:-1], np.diff(values)
            at = np.clip(np.nan_to_num(-(start * along.conj()).real / np.abs(along) ** 2), 0, 1)
            distances = np.abs(start + at * along)
            fastest, sharpest, fast = (np.maximum(x[1:], x[:-1]) for x in (rate, bend, now))
            steps = _safe_step(np.maximum(distances, LEAST_DISTANCE), fastest, sharpest, fast, remainder)
            # Between two huge values the curve passes a pole at infinity, and its chord may pass 0. The values count.
            sizes = np.abs(values)
            alone = _safe_step(sizes, rate, bend, now, remainder)
            huge = ~((sizes[1:] < HUGE) | (sizes[:-1] < HUGE))
            steps = np.where(huge, np.fmin(alone[1:], alone[:-1]), steps)
            return steps, np.where(huge, np.fmin(sizes[1:], sizes[:-1]), distances)


def _safe_step(room: np.ndarray, rate: np.ndarray, bend: np.ndarray, now: np.ndarray, remainder: float) -> np.ndarray:
    """Return the largest delay that moves L by at most `room`, with the rates of `_Curve` and the rate now.

    `remainder` is the rest of the period [s]; up to there the second derivative bounds the change of the rate.
    """
    within = 2 * room / (now + np.sqrt(now**2 + 2 * bend * room))  # now s + bend s^2/2 = room
    return np.maximum(room / rate, np.minimum(within, remainder))
