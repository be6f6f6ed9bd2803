"""The friction curve and the wheel's inertia from Tables 1 and 2 of Aoki and Nakamura, which print neither.

Least squares on stopping times and distances, with gradients through the runs and the estimator's latch:

  (a) Magic Formula and inertia, five parameters, from several priors. A prior holds the fit at first: the tables'
      deviations are ten and three times too large. Then it lets go, so only the basin depends on it. The deviations,
      0.01 s and 0.06 m, are errors of the formula, not of rounding.
  (b) A spline (16 heights), the slip of its peak and the inertia: as many unknowns as different numbers. A smoothness
      prior about a blend of (a) with each stated curve decides the rest.

    python experiments/identification/run.py
"""

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from diffabs import FixedStep, Loop
from diffabs.core.pytree import canonical_dtypes, param, pytree
from diffabs.core.types import Scalar, Vector
from diffabs.papers import record, slip_estimator
from diffabs.parts.controllers import PID, ConstantTorque
from diffabs.parts.plants import QuarterCar
from diffabs.parts.references import FixedSlip, PeakLatch
from diffabs.parts.roads import MagicFormula, Tabulated
from diffabs.parts.roads.tabulated import PiecewiseCubic
from diffabs.parts.stops import Standstill
from diffabs.scenario.defaults import braking
from diffabs.tune.identify.fit import Identified, Tolerances
from diffabs.tune.identify.identification import identify
from diffabs.tune.identify.residuals import gaussian
from diffabs.tune.identify.table import Table
from experiments._shared.numbers import SEARCH_TOLERANCE, store_numbers
from experiments.identification.figures import UNITS, draw_curves, draw_residuals

PATHS = ("plant.inertia", "plant.road.B", "plant.road.C", "plant.road.D", "plant.road.E")
METRICS = ("stop_time", "stop_distance")
# Knots as parts of the peak's slip, and of the way from there to slip 1: dense where the latch and the two targets lie.
BELOW = (0.15, 0.3, 0.45, 0.6, 0.75, 0.88)
ABOVE = (0.02, 0.05, 0.08, 0.105, 0.13, 0.2, 0.35, 0.6, 1.0)


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment.

    priors: J [kg m^2], B, C, D, E. The paper says of J only that the brake, 90 N m, locks the wheel: it must pass the
        peak of friction D at slip s, so J < (r/g)(90/D - m g r)/(1 - s), 1.37 for D = 1 and s = .1. The curves are
        those of textbooks, from a soft tyre on a wet road to a stiff one on a dry road
    impossible: a prior beyond that on purpose. Its estimator finds no peak, and no gradient tells it that there is one
    spread: standard deviations of a prior, relative for J and B, absolute for C, D, E
    softness: of the tables in each stage, times `weights`; 0 is the last stage, without the prior
    """

    priors: tuple[tuple[str, tuple[float, ...]], ...] = (
        ("textbook asphalt", (0.6, 10.0, 1.65, 1.0, 0.3)),
        ("soft tyre", (0.5, 5.0, 1.2, 0.6, 0.8)),
        ("stiff tyre", (1.0, 25.0, 1.9, 1.2, -2.0)),
        ("flat curve", (0.5, 20.0, 1.3, 0.8, -2.0)),
        ("linear tail", (1.0, 15.0, 1.4, 0.9, 0.0)),
        ("heavy wheel", (1.3, 12.0, 1.5, 0.8, -1.0)),
    )
    impossible: tuple[tuple[str, tuple[float, ...]], ...] = (("too heavy", (2.0, 6.0, 1.8, 1.1, 0.5)),)
    spread: tuple[float, ...] = (0.5, 0.4, 0.2, 0.2, 2.0)
    weights: tuple[float, float] = (0.01, 0.06)  # s, m
    rounding: tuple[float, float] = (0.005, 0.005)  # s, m: half a unit of the last digit
    softness: tuple[float, ...] = (10.0, 3.0, 0.0)
    norm: float = 8.0
    step: float = 5e-4  # s; with the stop at .5 m/s it changes no time by more than 1e-6 s from 2e-4
    stop: float = 0.5  # m/s
    duration: float = 4.5  # s
    spline_weights: tuple[float, float] = (0.002, 0.002)  # s, m
    height: float = 0.05  # deviation of a knot from the prior's curve
    roughness: float = 0.01  # of its second difference along the knots
    others: tuple[float, float] = (0.2, 0.03)  # kg m^2, slip of the peak
    blend: float = 0.25  # how far the spline's prior is moved from the Magic Formula found towards the stated one
    out: str = "out/experiments/identification"


@pytree
class Spline:
    """A monotone cubic (`Tabulated`) whose knots move with the slip of its peak."""

    peak: Scalar = param(default=0.1, unit="1", above=0.02, below=0.5)
    mu: Vector = param(unit="1", above=0.0)

    def slips(self) -> Any:
        """Of the knots but the first, (16,)."""
        below, above = self.peak * jnp.array(BELOW), self.peak + (1 - self.peak) * jnp.array(ABOVE)
        return jnp.concatenate([below, jnp.atleast_1d(self.peak), above])

    def table(self) -> Tabulated:
        """With the knot (0, 0)."""
        slip, mu = (jnp.concatenate([jnp.zeros(1), x]) for x in (self.slips(), jnp.asarray(self.mu)))
        return Tabulated(slip=slip, mu=mu)

    def prepared(self) -> PiecewiseCubic:
        """Coefficients."""
        return self.table().prepared()

    def friction(self, slip: Scalar, speed: Scalar = 0.0, distance: Scalar = 0.0) -> Scalar:
        """mu [1]."""
        return self.prepared().friction(slip, speed, distance)


def loops(car: QuarterCar, config: Config) -> dict[str, Loop]:
    """The nine runs of the tables."""
    stop = Standstill(speed=config.stop)
    cases = {"no ABS": braking(plant=car, reference=FixedSlip(), controller=ConstantTorque(torque=90.0), stop=stop)}
    for method, reference in (("conventional", FixedSlip()), ("proposed", PeakLatch())):
        for name, (ki, kd) in slip_estimator.PID_GAINS.items():
            controller = PID(kp=3893.0, ki=ki, kd=kd, low=0.0, high=90.0)
            cases[f"{method} {name}"] = braking(plant=car, reference=reference, controller=controller, stop=stop)
    return cases


def tables(car: QuarterCar, config: Config, weights: tuple[float, float]) -> tuple[Loop, Table]:
    """A loop that holds the free parameters, and the published numbers."""
    rows = loops(car, config)
    values = {
        name: dict(zip(METRICS, numbers, strict=True)) for name, numbers in slip_estimator.PUBLISHED_STOPS.items()
    }
    return rows["no ABS"], Table(loops=rows, values=values, sigma=dict(zip(METRICS, weights, strict=True)))


def magic(config: Config, start: dict[str, Any], weights: tuple[float, float], **more: Any) -> Identified:
    """Five parameters from the tables."""
    car = QuarterCar(inertia=1.0, road=MagicFormula(B=10.0, C=1.65, D=1.0, E=0.3))  # only the scale of a step
    loop, table = tables(car, config, weights)
    solver = FixedStep(step=config.step, duration=config.duration)
    return identify(loop, table, PATHS, solver=solver, starts=[start], **more)


def from_prior(config: Config, means: tuple[float, ...]) -> list[Identified]:
    """The stages: the tables weigh more and more, and in the end alone."""
    start: dict[str, Any] = dict(zip(PATHS, means, strict=True))
    relative = np.array(means) * np.array([1, 1, 0, 0, 0]) + np.array([0, 0, 1, 1, 1])
    prior = gaussian(dict(zip(PATHS, zip(means, relative * np.array(config.spread), strict=True), strict=True)))
    stages = []
    for soft in config.softness:
        rough = Tolerances(cost=1e-3, evaluations=12) if soft else Tolerances(cost=1e-8, step=1e-8, evaluations=40)
        weights = tuple(float(w * (soft or 1.0)) for w in config.weights)
        more = {"prior": prior} if soft else {"absolute": False}
        stages.append(magic(config, start, weights, tolerances=rough, **more))
        start = stages[-1].values
    return stages


@dataclasses.dataclass(frozen=True)
class Smoothness:
    """The spline's prior, in standard deviations: heights above a curve, their second differences along the knots,
    inertia and slip of the peak. The curve lies between the Magic Formula found, `near`, and a stated one, `far`."""

    config: Config

    def curve(self, near: MagicFormula, far: MagicFormula, slip: Any) -> Any:
        """mu."""
        return (1 - self.config.blend) * near.friction(slip) + self.config.blend * far.friction(slip)

    def __call__(self, near: MagicFormula, far: MagicFormula, means: Any, loop: Any) -> Any:
        """(16 + 15 + 2,); means: inertia and peak."""
        plant = loop.plant
        away = plant.road.mu - jax.vmap(lambda s: self.curve(near, far, s))(plant.road.slips())
        bends = jnp.diff(jnp.concatenate([jnp.zeros(1), away]), n=2)
        others = jnp.stack([plant.inertia - means[0], plant.road.peak - means[1]]) / jnp.array(self.config.others)
        return jnp.concatenate([away / self.config.height, bends / self.config.roughness, others])


def highest(curve: Any) -> float:
    """Slip of the greatest friction."""
    slips = np.linspace(0.0, 1.0, 20001)
    return float(slips[np.argmax(np.asarray(jax.vmap(curve)(slips)))])


def spline(config: Config, fit: Identified, means: tuple[float, ...]) -> Identified:
    """The spline from the Magic Formula found, with a prior about its blend with a stated one."""
    near, far = fit.part.plant.road, MagicFormula(**dict(zip("BCDE", means[1:], strict=True)))
    smooth, inertia, peak = Smoothness(config), float(fit.values["plant.inertia"]), highest(near.friction)
    expected = jnp.array([inertia, highest(lambda s: smooth.curve(near, far, s))])
    prior = Partial(smooth, canonical_dtypes(near), canonical_dtypes(far), expected)
    road = Spline(peak=peak, mu=np.ones(len(BELOW) + 1 + len(ABOVE)))
    road = dataclasses.replace(road, mu=np.asarray(jax.vmap(near.friction)(road.slips())))
    loop, table = tables(QuarterCar(inertia=inertia, road=road), config, config.spline_weights)
    solver = FixedStep(step=config.step, duration=config.duration)
    free, ends = ("plant.inertia", "plant.road.peak", "plant.road.mu"), Tolerances(cost=1e-4, step=1e-6, evaluations=30)
    return identify(loop, table, free, solver=solver, prior=prior, tolerances=ends)


def summary(name: str, fit: Identified, start: dict[str, Any] | None = None) -> dict[str, Any]:
    """A row for each fit: worst residuals, parameters."""
    worst = np.abs(fit.residuals.reshape(-1, 2)).max(axis=0)
    line = {"fit": name, "start J": float((start or fit.start)[PATHS[0]]), "J": float(fit.values[PATHS[0]])}
    for path in PATHS[1:]:
        if path in fit.values:
            line[path.rpartition(".")[2]] = float(fit.values[path])
    return {**line, "worst [s]": worst[0], "worst [m]": worst[1], "runs": fit.evaluations, "ended": fit.reason.name}


def directions(fit: Identified, count: int = 6) -> list[dict[str, Any]]:
    """Return the directions of the parameters, first the least determined one. An infinite spread becomes None."""
    loosest = fit.uncertainty.directions[::-1][:count]
    short = [direction.describe(0.15).replace("plant.", "").replace("road.", "") for direction in loosest]
    spreads = [direction.spread if np.isfinite(direction.spread) else None for direction in loosest]
    return [{"relative spread": spread, "direction": text} for spread, text in zip(spreads, short, strict=True)]


def known(fit: Identified) -> list[dict[str, Any]]:
    """Parameters with their standard deviations."""
    values = np.concatenate([np.ravel(x) for x in fit.values.values()])
    rows = zip(fit.uncertainty.deviations.items(), values, strict=True)
    return [{"parameter": name, "value": float(value), "deviation": sd} for (name, sd), value in rows]


def from_tables(config: Config) -> tuple[list[dict[str, Any]], dict[str, Identified]]:
    """The Magic Formula from every prior, then from the best with other norms."""
    rows, fits = [], {}
    for name, means in config.priors + config.impossible:
        stages = from_prior(config, means)
        fits[name] = stages[-1]
        rows.append(summary(name, stages[-1], stages[0].start))
        rows[-1]["runs"] = sum(stage.evaluations for stage in stages)
    best = min(fits.values(), key=lambda fit: fit.cost)
    ends = Tolerances(cost=1e-6, step=1e-6, evaluations=40)
    fits["rounding"] = magic(config, best.values, config.rounding, tolerances=ends, absolute=False)
    fits["minimax"] = magic(config, best.values, config.weights, tolerances=ends, absolute=False, norm=config.norm)
    rows.append(summary("weights .005 s, .005 m", fits["rounding"]))
    rows.append(summary(f"norm {config.norm:g}", fits["minimax"]))
    return rows, {"best": best, **fits}


def residual_rows(fits: dict[str, Identified]) -> list[dict[str, Any]]:
    """Differences by row of the tables."""
    table = {name: fit.residuals.reshape(-1, 2) for name, fit in fits.items()}
    return [
        {"run": row, **{f"{name} [{u}]": float(x[i, j]) for name, x in table.items() for j, u in enumerate(UNITS)}}
        for i, row in enumerate(slip_estimator.PUBLISHED_STOPS)
    ]


def from_splines(config: Config, best: Identified) -> tuple[list[dict[str, Any]], dict[str, Identified], list[Any]]:
    """A spline for every prior, checked at the fine step."""
    rows, fits, tables = [], {}, []
    for name, means in config.priors:
        fits[name] = spline(config, best, means)
        plant = fits[name].part.plant
        car = QuarterCar(inertia=plant.inertia, road=jax.tree.map(np.asarray, plant.road.table()))
        tables.append(slip_estimator.table(slip_estimator.run(car)))  # at its own, fine step
        line = summary(name, fits[name])
        peak = float(fits[name].values["plant.road.peak"])
        rows.append({**line, "peak slip": peak, "digits": sum(row["matches"] for row in tables[-1]), "of": 20})
    return rows, fits, tables


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config, begun = config or Config(), time.perf_counter()
    rows, fits = from_tables(config)
    best, minutes = fits.pop("best"), {}
    record.print_rows("Magic Formula from Tables 1 and 2", rows)
    shown = {"least squares": best, "rounding": fits["rounding"], "minimax": fits["minimax"]}
    leaves = residual_rows(shown)
    record.print_rows("What it leaves", leaves)
    record.print_rows("Covariance scaled by what is left", known(best))
    record.print_rows("What the tables say least about", directions(best))
    minutes["formula"] = (time.perf_counter() - begun) / 60
    lines, splines, tables = from_splines(config, best)
    record.print_rows("Splines, checked at 5e-5 s", lines)
    first = next(iter(splines.values()))
    record.print_rows("What the tables say least about a spline, without its prior", directions(first))
    minutes["splines"] = (time.perf_counter() - begun) / 60
    record.print_rows("Minutes until", [minutes])
    results = {
        "formula": rows,
        "residuals": leaves,
        "parameters": known(best),
        "covariance": best.uncertainty.covariance.tolist(),
        "directions": directions(best),
        "splines": lines,
        "spline parameters": known(first),
        "spline directions": directions(first, 18),
        "spline tables": dict(zip(splines, tables, strict=True)),
        "minutes": minutes,
    }
    drawn = {
        "curves": draw_curves(config, best, splines),
        "residuals": draw_residuals(config, {**shown, "spline, textbook asphalt": first}),
    }
    return record.experiment(config, results, drawn)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    store_numbers(__file__, main(), SEARCH_TOLERANCE)
