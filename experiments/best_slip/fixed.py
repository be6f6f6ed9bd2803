"""Roads, errors of the sensors and criterion of `best_slip`, fixed before the first run.

Roads and cars are those of `pid_over_roads`, with its 2,048 held-out roads. Each lane has its bound (`bound.py`).
Either sensors are exact, or the vehicle's speed is the integral of an accelerometer and gives the slip. The
accelerometer has noise of 0.1 m/s^2 at 1 kHz and a bias within 0.05 m/s^2. The speed in the slip's denominator is at
least 4 m/s. These three numbers come from `slip_estimator/noise.py`.

- A lane fails if it does not stop in time, diverges, or locks (slip above 0.99, however shortly). Failures are counted,
  no mean includes them.
- The figure of a rule is the mean of distance/bound - 1 over the lanes that it stops.
- Its gain on another rule is the mean of (the other's distance - its own)/bound, over the lanes that both stop, with a
  t interval.
- Rules that fail on more than 1 % of the lanes cannot be best. The best of the others has the least mean over the lanes
  that all of these stop.

Each kind of sensor has its own best rule, tuned and judged with that sensor.
"""

import dataclasses
from typing import Any

import numpy as np

from diffabs import Batch
from experiments._shared.roads import Family, Roads, family
from experiments._shared.statistics import interval, kept
from experiments.best_slip.bound import Bound, bound

EXACT, ERRORS = "exact sensors", "noise and bias"


@dataclasses.dataclass(frozen=True)
class Fixed:
    """The numbers that do not change with the search."""

    roads: Roads = dataclasses.field(default_factory=Roads)  # its ranges, counts and seed; held out: the next seed
    torque: float = 90.0  # N m, the most that the brake has
    noise: float = 0.1  # m/s^2, standard deviation, at each sample
    period: float = 1e-3  # s, of the samples
    bias: float = 0.05  # m/s^2, either way, even
    floor: float = 4.0  # m/s, in the denominator of the slip that is computed
    stop: float = 2.0  # m/s, where a run ends; the rest is braked at the last deceleration
    longest: float = 40.0  # s
    step: float = 1e-3  # s, for judging
    most_failures: float = 0.01  # of the lanes, of a rule that may be the best
    confidence: float = 0.95


@dataclasses.dataclass(frozen=True)
class Lanes:
    """Roads and cars with bias, noise and bound of each; values by path."""

    family: Family
    bias: np.ndarray
    keys: np.ndarray
    bound: Bound

    def batch(self, sensors: str, **more: Any) -> Batch:
        """Return the lanes as a batch, with bias and noise if the sensors have errors."""
        errors = sensors == ERRORS
        values = self.family.values | ({"sensor.blocks.1.bias": self.bias} if errors else {})
        return Batch(values, self.keys if errors else None, **more)


def lanes(fixed: Fixed, count: int, seed: int) -> Lanes:
    """Return this number of lanes. Another seed gives other roads, biases and noises."""
    roads = family(fixed.roads, count, seed)
    bias = np.random.default_rng((seed, 7)).uniform(-fixed.bias, fixed.bias, count)
    keys = np.arange(count) + (1 << 20) * seed
    return Lanes(roads, bias, keys, bound(roads.values, fixed.torque, fixed.roads.width))


def good(result: dict[str, Any]) -> np.ndarray:
    """Lanes that stop, do not diverge and never lock (lanes,)."""
    return result["stopped"] & ~result["diverged"] & ~(result["locked_time"] > 0)


def line(fixed: Fixed, result: dict[str, Any], paper: dict[str, Any], shortest: np.ndarray) -> dict[str, Any]:
    """Return a rule's row beside the paper's rule, in per cent of the bound (lanes,)."""
    stops, both = good(result), good(result) & good(paper)
    ratio = result["stop_distance"] / shortest
    gain = (paper["stop_distance"] - result["stop_distance"])[both] / shortest[both]
    above, above_half = interval(ratio[stops] - 1, fixed.confidence)
    each = 100 * (kept(ratio, stops) - 1)
    shorter, half = interval(gain, fixed.confidence)
    return {
        "above the bound [%]": 100 * above,
        "+- [%]": 100 * above_half,
        "median [%]": float(np.median(each)),
        "95 % of them [%]": float(np.quantile(each, 0.95)),
        "shorter than the paper's [%]": 100 * shorter,
        "+- of that [%]": 100 * half,
        "both stop": int(both.sum()),
        "locked": int(np.sum(result["locked_time"] > 0)),
        "not stopped": int(np.sum(~result["stopped"] & ~result["diverged"])),
        "diverged": int(np.sum(result["diverged"])),
    }


def best(fixed: Fixed, results: dict[str, dict[str, Any]], shortest: np.ndarray) -> dict[str, Any]:
    """Return the best of these rules by the criterion above: its name, and the mean of each over the common lanes
    [%]."""
    count = len(shortest)
    allowed = [name for name, result in results.items() if np.sum(~good(result)) <= fixed.most_failures * count]
    if not allowed:
        return {"best": None, "common lanes": 0, "above the bound [%]": {}}
    common = np.all([good(results[name]) for name in allowed], axis=0)
    means = {name: 100 * float(np.mean((results[name]["stop_distance"] / shortest)[common] - 1)) for name in allowed}
    return {"best": min(means, key=lambda n: means[n]), "common lanes": int(common.sum()), "above the bound [%]": means}
