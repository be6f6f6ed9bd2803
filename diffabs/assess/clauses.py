"""The clauses of the regulation: the figure of each in the runs, its limit, and the verdict.

    z = 0.849/t        braking rate of the car from 45 to 15 km/h in t seconds (30/3.6/9.81 = 0.849)
    epsilon = z/k      utilised adhesion; the surfaces give k exactly, or k is measured with one axle (`adhesion`)

Three figures of the split road stand in no text that was read, and are marked: z >= 0.75 (4 kL + kH)/5, z >= kL, and
the lateral position. Its limit is ours: half of the room that a lane of 3.5 m leaves a car of 1.75 m. Without it a car
that nobody steers would meet 5.3.7.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from diffabs.assess.adhesion import AxleAdhesion, measure_adhesion
from diffabs.assess.program import StopProgram
from diffabs.assess.runs import ONE_KMH, Population, RuleStop, plan_stops, run_stops, tyre_fields
from diffabs.core.types import Array, JsonObject, Scalar
from diffabs.core.validity import check_part
from diffabs.engine.solvers import Solver
from diffabs.loop.closed_loop import Loop
from diffabs.loop.result import Run
from diffabs.parts.plants import GRAVITY
from diffabs.uncertainty.sweep.statistics.estimates import Count, IntervalEstimate

RATE = 30 * ONE_KMH / GRAVITY  # s, braking rate times the time from 45 to 15 km/h
LANE_ROOM = (3.5 - 1.75) / 2  # m
GREATEST_USE = 1.0  # utilised adhesion to two decimals, above which k is to be measured again (App. 2, 1.3)
SLOWEST = 2.0  # times the shortest time of the longest stop: a slower run does not stop


class Figures(NamedTuple):
    """The figures of a clause in its stops.

    Attributes:
        number: Number of the clause in the regulation.
        rule: What it asks for.
        values: Figure of each car in each stop, shape (cars, stops).
        limit: Limit of the figures.
        unit: Unit of both.
        at_least: Whether a figure must be at least, or at most the limit.
        stop_indices: Which stops of a car they are.
        confirmed: Whether the rule stands in a text that was read.
        repeat_above: Figure above which the regulation asks to repeat the measurement; the verdict stays.
    """

    number: str
    rule: str
    values: Array
    limit: Scalar
    unit: str
    at_least: bool
    stop_indices: tuple[int, ...]
    confirmed: bool = True
    repeat_above: float = np.inf


class Clause(NamedTuple):
    """A clause with its figure in the worst stop of all cars.

    Attributes:
        number: Number of the clause in the regulation.
        rule: What it asks for.
        figure: Figure of the worst stop.
        limit: Limit of the figure.
        unit: Unit of both.
        at_least: Whether the figure must be at least, or at most the limit.
        stop: The worst stop.
        confirmed: Whether the rule stands in a text that was read.
        met: Whether each car meets the clause, shape (cars,); False where a run of the car diverged.
        diverged: Number of runs that diverged, or did not reach 15 km/h.
        note: What the regulation asks for besides, such as to repeat a measurement; empty for nothing.
    """

    number: str
    rule: str
    figure: float
    limit: float
    unit: str
    at_least: bool
    stop: str
    confirmed: bool
    met: np.ndarray
    diverged: int
    note: str = ""

    @property
    def verdict(self) -> str:
        """Return "met" or "not met" by all cars; "undecided" if a run diverged and no other one decides."""
        if np.all(self.met):
            return "met"
        within = self.figure >= self.limit if self.at_least else self.figure <= self.limit
        return "undecided" if within or np.isnan(self.figure) else "not met"


class Assessment(NamedTuple):
    """The verdicts of all clauses.

    Attributes:
        clauses: The clauses.
        cars: Number of cars.
        stops: Number of stops of each.
        passed: Number of cars that meet all confirmed clauses.
        unfinished: Number of runs that diverged, or did not reach 15 km/h. Their cars do not pass.
    """

    clauses: tuple[Clause, ...]
    cars: int
    stops: int
    passed: int
    unfinished: int

    def probability(self) -> IntervalEstimate:
        """Return the probability that a car of the distribution meets all confirmed clauses (Clopper and Pearson)."""
        return Count(self.passed, self.cars).probability()

    def record(self) -> JsonObject:
        """Return the clauses as JSON values."""
        rows = [
            clause._asdict() | {"verdict": clause.verdict, "met": int(np.sum(clause.met))} for clause in self.clauses
        ]
        share = self.probability()
        interval = {"probability": share.value, "interval": [share.low, share.high]} if self.cars > 1 else {}
        counts = {name: getattr(self, name) for name in ("cars", "stops", "passed", "unfinished")}
        return {**counts, **interval, "clauses": rows}


def assess(
    loop: Loop, solver: Solver, program: StopProgram | None = None, population: Population | None = None
) -> Assessment:
    """Assess a car, or each car of a population, by the clauses.

    Args:
        loop: Loop of a `plants.HalfCar` or `plants.Car`. Tyres, stop and initial speed are those of the test.
        solver: Solver; a duration is extended to twice that of a stop from the high speed at the slippery road's k.
        program: What the regulation leaves open.
        population: Parameters of several cars by path, shape (cars,); without one there is one car.

    Raises:
        ValueError: The plant has no tyres, the population changes them or the speed, or the program is impossible.

    Examples:
        >>> import diffabs as d
        >>> from diffabs.assess import assess
        >>> from diffabs.scenario import load
        >>> assess(load("slip-lmi").loop, d.Adaptive(1e-5, 20.0))
        Traceback (most recent call last):
        ValueError: MirroredRig has no tyres with roads; the plants half-car and car have them
    """
    program, population = check_part(program or StopProgram()), population or {}
    prescribed = (*(f"plant.{name}" for name in tyre_fields(loop.plant)), "initial.")
    if fixed := [path for path in population if path.startswith(prescribed)]:
        raise ValueError(f"{', '.join(fixed)}: the test prescribes tyres, roads and speeds; draw other parameters")
    stops = plan_stops(loop.plant, program)
    rows, failed = evaluate_clauses(loop, solver, stops, program, population)
    failed = np.asarray(failed)
    clauses = tuple(judge_clause(figures, stops, failed) for figures in rows)
    passed = np.all([clause.met for clause in clauses if clause.confirmed], axis=0)
    return Assessment(clauses, len(failed), len(stops), int(np.sum(passed)), int(np.sum(failed)))


def evaluate_clauses(
    loop: Loop,
    solver: Solver,
    stops: list[RuleStop],
    program: StopProgram,
    population: Population | None = None,
    engine: str = "auto",
) -> tuple[list[Figures], Array]:
    """Return the figures of all clauses, and which runs diverged or did not end, shape (cars, stops).

    The arguments are those of `run_stops`, for a traced loop, too. A run that did not end has meaningless figures.
    """
    slowest = SLOWEST * program.fast * ONE_KMH / (GRAVITY * program.low)
    solver = dataclasses.replace(solver, duration=max(float(solver.duration), float(slowest)))
    runs = run_stops(loop, solver, stops, program, population, engine=engine)
    failed = jnp.reshape(jnp.asarray(runs.diverged) | ~jnp.asarray(runs.stopped), (-1, len(stops)))
    measured = measure_adhesion(loop, solver, program, population, engine) if program.adhesion == "axles" else None
    return clause_figures(runs, stops, program, measured), failed


def clause_figures(
    runs: Run, stops: list[RuleStop], program: StopProgram, measured: AxleAdhesion | None = None
) -> list[Figures]:
    """Return the figures of all clauses, differentiable by whatever the `runs` of `run_stops` depend on.

    Args:
        runs: Runs of all stops.
        stops: Stops of each car.
        program: Roads, load, speed and limits.
        measured: Coefficients of adhesion of each axle (`measure_adhesion`), in place of those of the roads.
    """
    metrics = {name: jnp.reshape(value, (-1, len(stops))) for name, value in runs.metrics.items()}
    locked = jnp.max(jnp.stack([value for name, value in metrics.items() if name.startswith("locked_")]), axis=0)
    rate = RATE / metrics["time"]
    adhesion = jnp.stack([jnp.asarray(program.low if stop.left_side[0] else program.high, float) for stop in stops])
    used, origin = rate / adhesion, ""
    if measured:
        used, origin = rate / measured.mean_adhesion(rate, stops), ", k by one axle"

    def row(
        number: str, rule: str, kind: str, values: Array, limit: Scalar, unit: str, at_least: bool = False
    ) -> Figures:
        indices = tuple(index for index, stop in enumerate(stops) if stop.kind == kind)
        return Figures(number, rule, values[:, jnp.asarray(indices)], limit, unit, at_least, indices)

    rows = [
        row("5.2.1", f"utilised adhesion from 55 km/h{origin}", "adhesion", used, 0.75, "1", at_least=True)._replace(
            repeat_above=GREATEST_USE
        ),
        row("5.3.1", "time locked under full braking", "lock", locked, program.brief, "s"),
        row("5.3.2", "time locked, good to slippery road", "down", locked, program.brief, "s"),
        row("5.3.3", "time until the deceleration rises", "up", metrics["rise_time"], 1.0, "s"),
    ]
    if "steer" not in metrics:
        return rows
    early, whole = (jnp.degrees(program.steering_ratio * metrics[name]) for name in ("early_steer", "steer"))
    fair = 0.75 * (4 * program.low + program.high) / 5
    return [
        *rows,
        row("5.3.4", "time locked on a split road", "split", locked, program.brief, "s"),
        row("5.3.7", "steering wheel, first 2 s", "split", early, 120.0, "deg"),
        row("5.3.7", "steering wheel, in all", "split", whole, 240.0, "deg"),
        row("", "split: rate, 0.75 (4 kL + kH)/5", "split", rate, fair, "1", at_least=True)._replace(confirmed=False),
        row("", "split: rate, kL", "split", rate, program.low, "1", at_least=True)._replace(confirmed=False),
        row("", "split: lateral position", "split", metrics["lateral"], LANE_ROOM, "m")._replace(confirmed=False),
    ]


def judge_clause(figures: Figures, stops: list[RuleStop], failed: np.ndarray) -> Clause:
    """Return a clause with its worst stop, and whether each car meets it.

    Args:
        figures: Figures of the clause.
        stops: Stops of each car.
        failed: Runs that diverged or did not end, shape (cars, stops); they count neither as met nor as not met.
    """
    values = np.asarray(figures.values)
    missed = failed[:, list(figures.stop_indices)] | np.isnan(values)  # NaN: a run that measures k failed
    finished = np.where(missed, np.nan, values)
    worst = np.full_like(finished, np.inf if figures.at_least else -np.inf)
    worst = np.where(np.isnan(finished), worst, finished)
    _, column = np.unravel_index(np.argmin(worst) if figures.at_least else np.argmax(worst), worst.shape)
    figure = float(np.min(worst) if figures.at_least else np.max(worst))
    within = finished >= figures.limit if figures.at_least else finished <= figures.limit  # False for NaN
    return Clause(
        figures.number,
        figures.rule,
        np.nan if np.all(np.isnan(finished)) else figure,
        float(figures.limit),
        figures.unit,
        figures.at_least,
        stops[figures.stop_indices[column]].describe(),
        figures.confirmed,
        np.all(within, axis=1),
        int(np.sum(missed)),
        _note_repeat(figures, stops, finished),
    )


def _note_repeat(figures: Figures, stops: list[RuleStop], finished: np.ndarray) -> str:
    """Return the note that a figure, to two decimals, is so great that k is to be measured again, or nothing.

    The regulation calls a tolerance of 10 % acceptable, without saying of what: the note states the figure.
    """
    if np.all(np.isnan(finished)):
        return ""
    highest, column = np.nanmax(finished), np.unravel_index(np.nanargmax(finished), finished.shape)[1]
    if np.round(highest, 2) <= figures.repeat_above:
        return ""
    where = stops[figures.stop_indices[column]].describe()
    return f"{highest:.2f} in {where} is above {figures.repeat_above:.2f}: measure k again (App. 2, 1.3)"
