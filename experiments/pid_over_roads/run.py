"""Which PID gains of Aoki and Nakamura are best on hundreds of roads?

Gradients tune the gains over a family of roads and cars. Peak friction is 0.1 to 1.1 at slips of 0.05 to 0.2, curves
have many shapes, and two thirds of the roads have a patch of another surface. Cars have 12 to 20 kg and 40 to 120
km/h. A run counts with its distance over the shortest that friction allows. The paper's own car and road (the Magic
Formula identified from its tables) have a fifth of the weight.

Conventional control tunes one target slip for all roads. Proposed control finds it from the deceleration, by the
estimator for noisy sensors. The latch of the estimator makes the objective kinked. So its descent starts from the best
of a screening: thousands of gains on the paper's own road, then the best of them on a few roads of the family.

The gains are judged on other roads, with and without sensor noise, and on the paper's own road (a spline) to
standstill.

    python experiments/pid_over_roads/run.py
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from scipy.stats import qmc

from diffabs import Batch, FixedStep, Loop, measure, replace, run_batch
from diffabs.output import plot
from diffabs.papers import record, slip_estimator
from diffabs.parts.controllers import PID, BackCalculation
from diffabs.parts.objectives import BRAKING, Effort
from diffabs.parts.plants import QuarterCar
from diffabs.parts.references import FixedSlip, PeakRobust
from diffabs.parts.roads import MagicFormula, Patches
from diffabs.parts.sensors import Noise
from diffabs.parts.stops import Standstill
from diffabs.scenario.defaults import braking
from diffabs.tune import Method, Stopping, Tuned, build_problem, tune
from experiments._shared.numbers import SEARCH_TOLERANCE, store_numbers
from experiments._shared.roads import Family, Roads, family
from experiments._shared.statistics import interval, kept

MEASURED = {**BRAKING, "effort": Effort()}


@dataclasses.dataclass(frozen=True)
class Config(Roads):
    """Every number of the experiment."""

    candidates: int = 4096  # gains screened on the paper's own road,
    near: float = 0.0028  # those this close to its bound
    nearest: int = 64  # (the nearest of them) also on
    few: int = 64  # roads of the family
    arming: float = 0.5  # m/s^2; at the estimator's 3 m/s^2 nothing would be found on roads below 0.3
    own_share: float = 0.2  # of the objective: the paper's own car and road
    ki: float = 5e4  # N m/s, start of the tuning: ten times the paper's, with an anti-windup
    tracking: float = 0.05  # s, start of its tracking time
    noise: float = 0.1  # m/s^2, of the accelerometer at 1 kHz, in the last comparison
    ranges: tuple[tuple[str, float, float], ...] = (
        ("controller.kp", 500.0, 12000.0),
        ("controller.ki", 10.0, 1e5),
        ("controller.antiwindup.tracking_time", 0.005, 1.0),
        ("reference.slip", 0.03, 0.9),
    )
    estimator: tuple[tuple[str, float, float], ...] = (
        ("reference.time_constant", 0.005, 0.05),  # noise forbids less
        ("reference.threshold", 0.005, 0.1),
    )
    screening: float = 5e-4  # s, step on the paper's own road
    step: float = 2e-3  # s
    judged_step: float = 1e-3  # s, for judging
    stop: float = 2.0  # m/s; from there at the last deceleration. Slower, these steps are not stable for large kp
    longest: float = 40.0  # s
    own_step: float = 5e-5  # s, on the paper's own road, to 0.05 m/s
    iterations: int = 10
    confidence: float = 0.95
    out: str = "out/experiments/pid_over_roads"


def loops(config: Config) -> dict[str, Loop]:
    """The paper's gains on the car of the family, conventional and proposed."""
    road = Patches(roads=(MagicFormula(), MagicFormula()), edges=np.array([10.0]), width=config.width)
    car, pi = QuarterCar(inertia=1.0539, road=road), PID(ki=5000.0, low=0.0, high=90.0)
    stop = Standstill(speed=config.stop)
    references = {"conventional": FixedSlip(), "proposed": PeakRobust(arming=config.arming)}
    return {name: braking(plant=car, reference=r, controller=pi, stop=stop) for name, r in references.items()}


def tuned(config: Config, tuning_roads: Family, loop: Loop, progress: Any = None) -> Tuned:
    """kp, ki, the tracking time of an anti-windup and the (first) target slip; of the estimator its filter, too."""
    return tune(
        build_problem(
            screened(config, loop) if isinstance(loop.reference, PeakRobust) else wound(config, loop),
            free=free(config, loop),
            objective={"stop_distance": 1.0},
            over=tuning_roads.with_paper(config.own_share),
            solver=FixedStep(step=config.step, duration=config.longest),
        ),
        method=Method(stopping=Stopping(iterations=config.iterations, change=1e-5)),
        progress=progress,
    )


def free(config: Config, loop: Loop) -> dict[str, tuple[float, float]]:
    """Ranges by path."""
    ranges = config.ranges + (config.estimator if isinstance(loop.reference, PeakRobust) else ())
    return {path: (low, high) for path, low, high in ranges}


def wound(config: Config, loop: Loop) -> Loop:
    """A fast integral with an anti-windup, where tuning starts."""
    antiwindup = BackCalculation(tracking_time=config.tracking)
    return dataclasses.replace(
        loop, controller=dataclasses.replace(loop.controller, ki=config.ki, antiwindup=antiwindup)
    )


def screened(config: Config, loop: Loop) -> Loop:
    """The best start among many for a loop with an estimator: a Sobol sequence in logarithms over the ranges."""
    loop, ranges = wound(config, loop), free(config, loop)
    low, high = np.log(np.array(list(ranges.values()))).T
    points = qmc.Sobol(len(ranges), rng=np.random.default_rng(config.seed)).random(config.candidates)
    gains = dict(zip(ranges, np.exp(low + (high - low) * points).T, strict=True))
    own_loop = dataclasses.replace(loop, plant=QuarterCar(), stop=Standstill(speed=1.0))
    far = (
        distances(own_loop, gains, FixedStep(step=config.screening, duration=4.0)) / slip_estimator.BOUNDS["90 N m"] - 1
    )
    near = np.argsort(far)[: min(config.nearest, int(np.sum(far < config.near)))]
    few = family(config, config.few, config.seed)
    lanes = {path: np.repeat(column[near], config.few) for path, column in gains.items()}
    lanes |= {path: np.concatenate([column] * len(near)) for path, column in few.values.items()}
    stops = distances(loop, lanes, FixedStep(step=config.step, duration=config.longest))
    mean = (stops.reshape(len(near), config.few) / few.distance).mean(axis=1)
    best = near[np.argmin(mean)]
    return replace(loop, {path: float(column[best]) for path, column in gains.items()})


def distances(loop: Loop, lanes: dict[str, Any], solver: FixedStep) -> np.ndarray:
    """Of lanes that differ in these values; infinite for one that diverges."""
    runs = run_batch(loop, Batch(lanes), solver, {"stop_distance": BRAKING["stop_distance"]})
    return np.nan_to_num(np.asarray(runs.metrics["stop_distance"]), nan=np.inf)


def judged(config: Config, loop: Loop, unseen: Family, noise: float = 0.0) -> dict[str, np.ndarray]:
    """Metrics of every lane of a family."""
    keys = None
    if noise:
        loop = dataclasses.replace(loop, sensor=Noise(deceleration=noise, period=1e-3))
        keys = np.arange(len(unseen.time))
    solver = FixedStep(step=config.judged_step, duration=config.longest)
    runs = jax.device_get(run_batch(loop, Batch(unseen.values, keys), solver, MEASURED))
    return {**runs.metrics, "stopped": runs.stopped, "diverged": runs.diverged}


def compared(config: Config, name: str, before: Any, after: Any, unseen: Family) -> dict[str, Any]:
    """Paired over the lanes that both stop: by how much shorter, with a t interval, and the locked wheels."""
    both = before["stopped"] & ~before["diverged"] & after["stopped"] & ~after["diverged"]
    gain, half = interval((1 - after["stop_distance"] / before["stop_distance"])[both], config.confidence)
    pair = (("before", before), ("after", after))
    relative = {key: kept(result["stop_distance"] / unseen.distance, both) for key, result in pair}
    return {
        "control": name,
        "paper's gains: distance/shortest": float(relative["before"].mean()),
        "tuned": float(relative["after"].mean()),
        "shorter [%]": 100 * gain,
        "+- [%]": 100 * half,
        "worst lane, paper's": float(relative["before"].max()),
        "worst lane, tuned": float(relative["after"].max()),
        "both stop": int(np.sum(both)),
        "lanes locked longer": int(np.sum(after["locked_time"] > before["locked_time"] + 1e-9)),
        "not stopped": int(np.sum(~after["stopped"])),
        "diverged": int(np.sum(after["diverged"])),
    }


def own_road(config: Config, name: str, loop: Loop) -> dict[str, Any]:
    """On the paper's own road, to standstill."""
    bound = slip_estimator.BOUNDS["90 N m"]
    loop = dataclasses.replace(loop, plant=QuarterCar(), stop=Standstill())
    distance = float(measure(loop, FixedStep(step=config.own_step, duration=3.6), BRAKING).metrics["stop_distance"])
    return {"control": name, "distance [m]": distance, "above the bound of 90 N m [%]": 100 * (distance / bound - 1)}


def figures(results: dict[str, Any], tunings: dict[str, Tuned]) -> dict[str, Any]:
    """How the relative distances are distributed, before and after, and how the tuning went."""
    figure, axes = plot.sheet(1, 2, title="Braking distance over roads not tuned for", size=(5.6, 3.6), sharey=True)
    for i, (ax, (name, pair)) in enumerate(zip(axes, results.items(), strict=True)):
        for j, (label, values) in enumerate(pair.items()):
            x = np.sort(values)
            ax.plot(x, np.arange(1, len(x) + 1) / len(x), plot.DASHES[j], color=plot.COLOURS[j], label=label)
        ax.set_xlim(1.0, 1.5)
        plot.label_axes(ax, "distance/shortest possible [1]", "" if i else "share of the roads", name)
    history, (ax,) = plot.sheet(title="How the tuning went", size=(6.0, 3.6))
    for i, (name, tuning) in enumerate(tunings.items()):
        points = [(p.evaluations, p.objective) for p in tuning.history]
        ax.plot(*zip(*points, strict=True), "o-", markersize=3, color=plot.COLOURS[i], label=name)
    plot.label_axes(ax, "gradients computed", "mean distance/shortest possible [1]")
    return {"distances": figure, "tuning": history}


def main(config: Config | None = None, progress: Any = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    tuning_roads, unseen = family(config, config.roads, config.seed), family(config, config.held_out, config.seed + 1)
    rows, own_rows, gains, curves, tunings = [], [], [], {}, {}
    for name, loop in loops(config).items():
        tunings[name] = tuned(config, tuning_roads, loop, progress)
        tuned_loop = tunings[name].loop
        for label, noise in (("", 0.0), (f", noise {config.noise:g} m/s2", config.noise)):
            before, after = (judged(config, x, unseen, noise) for x in (loop, tuned_loop))
            rows.append(compared(config, name + label, before, after, unseen))
            if not noise:
                curves[name] = {
                    "paper's gains": before["stop_distance"] / unseen.distance,
                    "tuned": after["stop_distance"] / unseen.distance,
                }
        own_rows += [own_road(config, f"{name}, paper's gains", loop), own_road(config, f"{name}, tuned", tuned_loop)]
        gains.append({"control": name, **{k: float(v) for k, v in tunings[name].values.items()}})
    record.print_rows(f"{config.held_out} roads that the tuning has not seen, {config.confidence:.0%} interval", rows)
    record.print_rows("The paper's own road (spline B)", own_rows)
    for line in gains:
        record.print_rows("Tuned", [line])
    how = {
        k: {"reason": f.reason.value, "evaluations": f.evaluations, "objective": f.objective}
        for k, f in tunings.items()
    }
    return record.experiment(
        config, {"table": rows, "own": own_rows, "gains": gains, "tuning": how}, figures(curves, tunings)
    )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    results = main(progress=lambda p: print(f"{p.point.evaluations} gradients: objective {p.point.objective:.6f}"))
    store_numbers(__file__, results, SEARCH_TOLERANCE)
