"""Means with intervals, over the lanes of a study that count."""

import math

import numpy as np
from scipy.stats import t


def interval(x: np.ndarray, confidence: float) -> tuple[float, float]:
    """Return the mean and half of its t interval; NaN for fewer than two values."""
    if len(x) < 2:
        return math.nan, math.nan
    half = t.ppf((1 + confidence) / 2, len(x) - 1) * np.std(x, ddof=1) / math.sqrt(len(x))
    return float(np.mean(x)), float(half)


def kept(x: np.ndarray, lanes: np.ndarray) -> np.ndarray:
    """Return the values of these lanes; one NaN if there are none."""
    return x[lanes] if lanes.any() else np.full(1, np.nan)
