"""The judgement of a controller: at its weak spots, in the corners of the box, and on many points of it."""

import dataclasses
from typing import Any

import jax
import numpy as np

from diffabs import Batch, FixedStep, Loop, run_batch
from diffabs.parts.objectives import IAE, LockedTime, Overshoot, SettlingTime, StopDistance
from diffabs.parts.roads import RIG
from diffabs.uncertainty.sweep.statistics.estimates import Count
from experiments.real_rig.box import ESTIMATED, KMH, KNOWN, NOMINAL, Box, Fixed, batch, columns, corners, drawn
from experiments.real_rig.floor import GRAVITY, HELD, MIRRORED, Deviation, floor

BAND = 0.04  # of the slip: a fifth of the target, since the floor alone is 0.024
MEASURED = {
    "overshoot": Overshoot(),
    "settling": SettlingTime(band=BAND),
    "locked": LockedTime(),
    "distance": StopDistance(),
    "iae": IAE(),
    "deviation": Deviation(),
}
LONGEST = 5.0  # s, of a run
LOST = 100.0  # overshoot of a run that diverged
ENOUGH = 1.5  # times the floor is what was asked for
# Required of a controller: no wheel locks, every run stops, and in REQUIRED of the points the deviation to both sides
# exceeds that of the speed's error by at most NEAR, which is twice the noise of the measured slip (0.005 of 0.2).
NEAR, REQUIRED = 0.05, 0.95
PEAK = float(np.max(np.asarray(RIG.friction(np.linspace(0.1, 0.3, 2001)))))  # before the rise towards a locked wheel

SPOTS: dict[str, dict[str, float]] = {
    "nominal": {},
    "55 km/h": {"speed": 55.0},
    "70 km/h": {"speed": 70.0},
    "friction +10 %": {"height": 1.1},
    "friction -10 %": {"height": 0.9},
    "peak 10 % later": {"place": 1.1},
    "inertia +10 %": {"inertia": 1.1},
    "lag 2 ms": {"lag": 2e-3},
    "computing 1 ms": {"delay": 1e-3},
    "speed 1 % low": {"first": -0.01, "last": -0.01},
    "speed 3 % low": {"first": -0.03, "last": -0.03},
    "bias 0.1 m/s^2": {"bias": 0.1},
}
MASSES, SPEEDS, SEEDS = (5.3, 5.75, 6.2), (20.0, 35.0, 50.0), 4  # on which a weak spot is looked at


@dataclasses.dataclass(frozen=True)
class Judging:
    """Every number of the judging."""

    samples: int = 100_000  # of the tuned ones
    fewer: int = 20_000  # of the others
    block: int = 1024  # lanes of a call: one program for any number of points
    corner_seeds: int = 4
    seed: int = 2026  # of the points and their noise: not those that were tuned on
    step: float = 1e-3  # s
    confidence: float = 0.95
    engine: str = "auto"


def runs(loop: Loop, points: dict[str, np.ndarray], config: Judging, seed: int) -> dict[str, np.ndarray]:
    """Metrics at points of a box, each with a noise of its own, and whether the run stopped. One that diverges counts
    as locked."""
    lanes = batch(columns(points), seed)
    places = np.arange(config.block * -(-lanes.size // config.block)).clip(max=lanes.size - 1)
    blocks = [_block(loop, lanes, at, config) for at in places.reshape(-1, config.block)]
    results: Any = jax.tree.map(lambda *parts: np.concatenate(parts)[: lanes.size], *blocks)
    worst = {"overshoot": LOST, "deviation": LOST, "locked": LONGEST, "settling": LONGEST}
    metrics = {name: np.where(results.diverged, worst.get(name, np.nan), results.metrics[name]) for name in MEASURED}
    never = np.isinf(metrics["settling"])  # a run that never settles counts with its length: quantiles stay finite
    metrics["settling"] = np.where(never, results.ending.sample.t, metrics["settling"])
    return metrics | {"stopped": results.stopped & ~results.diverged}


def _block(loop: Loop, lanes: Batch, at: np.ndarray, config: Judging) -> Any:
    assert lanes.keys is not None
    some = Batch({path: column[at] for path, column in lanes.values.items()}, lanes.keys[at])
    solver = FixedStep(step=config.step, duration=LONGEST, kinks=False)
    return jax.device_get(run_batch(loop, some, solver, MEASURED, engine=config.engine))


def spots(speed: str) -> dict[str, dict[str, np.ndarray]]:
    """Return the points of each weak spot by its name: all masses and speeds, with one deviation."""
    deviations = {name: at for name, at in SPOTS.items() if _fits(at, speed)}
    axes = np.meshgrid(MASSES, SPEEDS, range(SEEDS), indexing="ij")
    mass, start, _ = (axis.ravel() for axis in axes)
    names = [name for name in NOMINAL if _fits({name: 0.0}, speed)]
    plain = {name: np.full(len(mass), NOMINAL[name]) for name in names} | {"mass": mass, "speed": start}
    return {spot: plain | {name: np.full(len(mass), x) for name, x in at.items()} for spot, at in deviations.items()}


def _fits(at: dict[str, float], speed: str) -> bool:
    other = ("bias",) if speed == KNOWN else ("first", "last")
    return not set(at) & set(other)


def weak_spots(loop: Loop, speed: str, config: Judging) -> dict[str, float]:
    """Return the worst overshoot [%] under one deviation."""
    spot_points = spots(speed)
    together = {
        name: np.concatenate([at[name] for at in spot_points.values()]) for name in next(iter(spot_points.values()))
    }
    overshoot = runs(loop, together, config, config.seed + 1)["overshoot"].reshape(len(spot_points), -1)
    return dict(zip(spot_points, (100 * overshoot.max(axis=1)).tolist(), strict=True))


def shortest(points: dict[str, np.ndarray], fixed: Fixed) -> np.ndarray:
    """The distance at the greatest friction before the wheel locks, from the first instant on [m] (n,)."""
    squares = (points["speed"] / KMH) ** 2 - (fixed.end / KMH) ** 2
    return squares / (2 * MIRRORED * GRAVITY * points["height"] * PEAK)


def chance(happens: np.ndarray, confidence: float) -> dict[str, Any]:
    """Probability in per cent with the interval of Clopper and Pearson."""
    estimate = Count(int(happens.sum()), happens.size).probability(confidence=confidence)
    return {
        "percent": 100 * estimate.value,
        "low": 100 * estimate.low,
        "high": 100 * estimate.high,
        "count": int(happens.sum()),
    }


def on_samples(loop: Loop, box: Box, fixed: Fixed, speed: str, config: Judging, samples: int) -> dict[str, Any]:
    """Probabilities and quantiles on so many points of the box."""
    points = drawn(box, speed, samples, config.seed)
    metrics, floors = runs(loop, points, config, config.seed), floor(points, speed, fixed)
    widest = 4 * max(map(abs, (*box.first, *box.last)))  # the floor of the box, of a known speed
    overshoot, lost = metrics["overshoot"], metrics["distance"] / shortest(points, fixed) - 1
    deviation = metrics["deviation"] - floor(points, speed, fixed, two_sided=True)
    sound = (metrics["locked"] == 0) & metrics["stopped"]
    low = floors > 0.01
    row = {
        "overshoot > 1 %": chance(overshoot > 0.01, config.confidence),
        "overshoot > 5 %": chance(overshoot > 0.05, config.confidence),
        "locks": chance(metrics["locked"] > 0, config.confidence),
        "does not stop": chance(~metrics["stopped"], config.confidence),
        "within 1.5 floors of the box": chance(overshoot <= ENOUGH * widest, config.confidence),
        "within 1.5 floors of its own, where that exceeds 1 %": chance(
            overshoot[low] <= ENOUGH * floors[low], config.confidence
        ),
        "overshoot [%]": quantiles(100 * overshoot),
        "above the floor [%]": quantiles(100 * (overshoot - floors)),
        "deviation above the floor [%]": quantiles(100 * deviation),
        "deviation near the floor": chance(deviation <= NEAR, config.confidence),
        "meets the requirement": bool(sound.all() and np.mean(deviation <= NEAR) >= REQUIRED),
        "settling [s]": quantiles(metrics["settling"]),
        "settled within 0.25 s": chance(metrics["settling"] <= HELD, config.confidence),
        "distance lost [%]": quantiles(100 * lost),
        "samples": samples,
    }
    return row | (
        {"against the true speed": against_truth(loop, points, metrics, config)} if speed == ESTIMATED else {}
    )


def quantiles(values: np.ndarray) -> dict[str, float]:
    """Median, 95 and 99 %, greatest."""
    finite = np.nan_to_num(values, nan=1e9, posinf=1e9)
    named = {"median": 0.5, "95 %": 0.95, "99 %": 0.99, "greatest": 1.0}
    return {name: float(np.quantile(finite, level)) for name, level in named.items()}


def seconds(time: float) -> str:
    """Return a settling time as text; times beyond a run are of runs that never settle."""
    return f"{time:.3f}" if time <= LONGEST else "never"


def against_truth(loop: Loop, points: Any, metrics: Any, config: Judging) -> dict[str, float]:
    """Stopping distance, in per cent longer than under the same controller that sees the true speed with the same noise
    of the wheel."""
    from experiments.real_rig.loops import with_truth

    unbiased = {name: value for name, value in points.items() if name != "bias"}
    truth = runs(
        with_truth(loop), unbiased | {name: 0 * points["mass"] for name in ("first", "last")}, config, config.seed
    )
    return quantiles(100 * (metrics["distance"] / truth["distance"] - 1))


def in_corners(loop: Loop, box: Box, fixed: Fixed, speed: str, config: Judging) -> dict[str, Any]:
    """The worst of all corners, with a few noises each, and which it is."""
    points = corners(box, speed, config.corner_seeds)
    metrics, floors = runs(loop, points, config, config.seed + 2), floor(points, speed, fixed)
    worst = int(np.argmax(metrics["overshoot"]))
    return {
        "overshoot [%]": float(100 * metrics["overshoot"][worst]),
        "floor there [%]": float(100 * floors[worst]),
        "above the floor, most [%]": float(100 * np.max(metrics["overshoot"] - floors)),
        "at": {name: float(value[worst]) for name, value in points.items()},
        "locks": int((metrics["locked"] > 0).sum()),
        "do not stop": int((~metrics["stopped"]).sum()),
        "corners": len(points["mass"]) // config.corner_seeds,
    }
