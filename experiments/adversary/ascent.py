"""Ascent by gradients within the adversary's set: projected gradients, and steps of Frank and Wolfe.

Each start moves as follows. A gradient g gives two kinds of points: feasible(z + step d), where d is g normalised in
each block, and z + share (p - z), where p is the point of the set that is farthest along g (`farthest`). A linear
function has its maximum at p. The best of all these points is the next start.
"""

import numpy as np

from experiments.adversary.bounds import Bounds, feasible

HALVINGS = 40
ALL = 1e9  # a factor that makes signs of numbers


def farthest(bounds: Bounds, slopes: np.ndarray) -> np.ndarray:
    """Return the points z of the set (n, size) with the greatest slopes . z."""
    road, noise, start = (slopes[:, block] for block in bounds.blocks)
    return np.concatenate([_road(bounds, road), _noise(bounds, noise), np.sign(start)], axis=1)


def _road(bounds: Bounds, slopes: np.ndarray) -> np.ndarray:
    """Return the best roads, backwards by dynamic programming.

    The best road goes from corner to corner of |z_i| <= 1 and |z_(i+1) - z_i| <= steepest. So each of its values is a
    bound plus or minus a whole multiple of the steepest.
    """
    steepest = bounds.slope * bounds.spacing / bounds.height
    rungs = steepest * np.arange(int(2 / steepest + 1e-9) + 1) - 1
    levels = np.unique(np.round(np.concatenate([rungs, -rungs]), 12))
    apart = np.abs(np.subtract.outer(levels, levels)) > steepest * (1 + 1e-9)
    count, n = slopes.shape
    gain, after = slopes[:, -1:] * levels, np.zeros((n, count, len(levels)), int)
    for i in range(n - 2, -1, -1):
        reached = np.where(apart, -np.inf, gain[:, None, :])
        after[i] = reached.argmax(axis=2)
        gain = slopes[:, i : i + 1] * levels + reached.max(axis=2)
    at, z = gain.argmax(axis=1), np.zeros((count, n))
    for i in range(n):
        z[:, i] = levels[at]
        at = after[i][np.arange(count), at]
    return z


def _noise(bounds: Bounds, slopes: np.ndarray) -> np.ndarray:
    """Return the best noise, clip(factor (g - level), +-peak). Halving finds the level for mean 0 and the factor
    for root mean square 1."""
    g = slopes / np.maximum(np.abs(slopes).max(axis=1, keepdims=True), np.finfo(float).tiny)

    def noise(factor: np.ndarray) -> np.ndarray:
        low, high = g.min(axis=1, keepdims=True), g.max(axis=1, keepdims=True)
        for _ in range(HALVINGS):
            level = 0.5 * (low + high)
            above = np.clip(factor * (g - level), -bounds.peak, bounds.peak).mean(axis=1, keepdims=True) > 0
            low, high = np.where(above, level, low), np.where(above, high, level)
        return np.clip(factor * (g - 0.5 * (low + high)), -bounds.peak, bounds.peak)

    small, great = np.full((len(g), 1), 1e-3), np.full((len(g), 1), ALL)
    for _ in range(HALVINGS):
        factor = np.sqrt(small * great)
        much = np.sqrt(np.mean(noise(factor) ** 2, axis=1, keepdims=True)) > 1
        small, great = np.where(much, small, factor), np.where(much, factor, great)
    return noise(small)


def along(bounds: Bounds, slopes: np.ndarray) -> np.ndarray:
    """Return gradients whose root mean square is one in each block, or 0 (n, size)."""
    units = np.zeros_like(slopes)
    for block in bounds.blocks:
        norm = np.sqrt(np.mean(slopes[:, block] ** 2, axis=1, keepdims=True))
        units[:, block] = np.divide(slopes[:, block], norm, out=np.zeros_like(slopes[:, block]), where=norm > 0)
    return units


def tries(
    bounds: Bounds, z: np.ndarray, slopes: np.ndarray, steps: np.ndarray, shares: tuple[float, ...]
) -> np.ndarray:
    """Return the points that follow a gradient (n, tries, size): steps (n, k) along it, and shares of the way to
    the farthest point."""
    far, here = farthest(bounds, slopes), z[:, None]
    moved = here + steps[:, :, None] * along(bounds, slopes)[:, None]
    towards = here + np.array(shares)[:, None] * (far - z)[:, None]
    points = np.concatenate([moved, towards], axis=1)
    return feasible(bounds, points.reshape(-1, z.shape[1])).reshape(points.shape)
