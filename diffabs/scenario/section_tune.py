"""The section [tune] of a scenario: free parameters, objective, and the runs it is taken over.

    starts, seed     descents: the first from the scenario's own values, the others drawn from the ranges
    iterations       of each descent
    samples          0: every combination of the values of [tune.over] is a run, a lane; N: a Latin hypercube of N lanes
                     between the smallest and the greatest of each, or in an interval { low, high }
    decay            1/s that shall be certified over [design.over]; 0 for none
    damping          of the poles of the linear systems there, in [0, 1); 0 for none
    clauses          numbers of the clauses about anti-lock brakes that the car meets, or "all": see `section_assess`
    [tune.free]
    "controller.gain" = { low = [-1e5, -300.0], high = [-100.0, -15.0] }     # lists where the parameter is one, in SI
    "reference.time_constant" = "declared"                   # the declared range
    [tune.objective]
    iae = 1.0                                                # weights of metrics; their sum is that of a lane
    [tune.over]
    "plant.mass" = [5.3, 5.75, 6.2]
    "initial.speed_kmh" = [20.0, 35.0, 50.0]
    [tune.aggregate]
    type = "cvar"                                            # of the lanes: mean, smooth-worst, cvar, quantile
    level = 0.9
    [tune.limits]
    overshoot = 0.008                                        # at most, on every lane
    [tune.constraints]                                       # of the linear loop, over [design.over]
    sensitivity = 1.7                                        # greatest |S| at most; also complementary, control_noise
    delay_margin = "5 ms"                                    # at least, or 5e-3 [s]; also phase_margin = "40 deg" [rad]
    pole_decay = 20.0                                        # 1/s at least; also pole_damping, a ratio
    shape = [[10.0, 0.5], [100.0, 1.7]]                      # |S| at most: rows of frequency [rad/s] and value
    samples = 8                                              # points inside the ranges, besides the corners

Paths are those of `parameter_paths`. Reading the section needs no extra; tuning needs the extra `tune`.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterable, Mapping

import numpy as np

from diffabs.core.protocols import Objective
from diffabs.core.pytree import ParameterSpec, parameters
from diffabs.core.types import JsonObject, Table
from diffabs.host.values import (
    Reader,
    ScenarioError,
    list_reader,
    plain_fields,
    range_reader,
    read_angle,
    read_as_given,
    read_one,
    read_time,
    table_field,
    table_reader,
    text_or_number_reader,
    whole_reader,
)
from diffabs.host.values import read_table as read_table
from diffabs.loop.batch import Batch, grid, latin
from diffabs.loop.closed_loop import Loop
from diffabs.scenario.parameter_paths import (
    Ends,
    ParameterEntry,
    canonical_path,
    interval_ends,
    interval_table,
    metric_reader,
    parameters_of,
    read_entries,
)
from diffabs.scenario.registry import unit_of
from diffabs.scenario.section_assess import read_clauses
from diffabs.tune import risk

DECLARED_RANGE = "declared"
MOST_LANES = 100_000
DELAY_SPEC = ParameterSpec("s", low=0.0, open_low=True)
PHASE_SPEC = ParameterSpec("rad", 0.0, math.pi, open_low=True)


def _aggregate(value: object, path: str) -> JsonObject:
    """Return type and fields of an aggregate."""
    part = read_one(risk.AGGREGATE_TYPES, value, path)
    return {
        "type": next(name for name, kind in risk.AGGREGATE_TYPES.items() if type(part) is kind),
        **plain_fields(part),
    }


def _positive_reader(unit: str) -> Reader:
    return range_reader(ParameterSpec(unit, low=0.0, open_low=True))


def _read_shape(value: object, path: str) -> tuple[tuple[float, float], ...]:
    """Return rows of frequency and bound; the frequencies increase."""
    read = list_reader(list_reader(_positive_reader("1")))
    rows = read(value, path)
    if any(len(row) != 2 for row in rows):
        raise ScenarioError(f"{path}: each row is [frequency in rad/s, greatest |S|]")
    if rows and max(bound for _, bound in rows) < 1:
        raise ScenarioError(f"{path}: no loop keeps |S| below 1 at all frequencies; a bound of a row is at least 1")
    if any(after[0] <= before[0] for before, after in itertools.pairwise(rows)):
        raise ScenarioError(f"{path}: the frequencies of the rows increase")
    return rows


@dataclasses.dataclass(frozen=True)
class FrequencyConstraints:
    """Bounds of the linear loop at the corners of [design.over] and at points inside; None for no bound.

    Attributes:
        sensitivity: Greatest |S|, at least 1.
        complementary: Greatest |T|.
        delay_margin: Least delay margin [s].
        phase_margin: Least phase margin [rad].
        pole_decay: Least decay rate of the closed loop's poles [1/s].
        pole_damping: Least damping ratio of the closed loop's poles, at most 1.
        control_noise: Greatest gain from noise on the tracked signals to the command.
        shape: Rows (frequency [rad/s], greatest |S|).
        samples: Number of points inside the ranges.
    """

    sensitivity: float | None = table_field(range_reader(ParameterSpec("1", low=1.0, open_low=True)), None)
    complementary: float | None = table_field(_positive_reader("1"), None)
    delay_margin: float | None = table_field(text_or_number_reader(read_time, DELAY_SPEC), None)
    phase_margin: float | None = table_field(text_or_number_reader(read_angle, PHASE_SPEC), None)
    pole_decay: float | None = table_field(_positive_reader("1/s"), None)
    pole_damping: float | None = table_field(range_reader(ParameterSpec("1", 0.0, 1.0, open_low=True)), None)
    control_noise: float | None = table_field(_positive_reader("1"), None)
    shape: tuple[tuple[float, float], ...] = table_field(_read_shape, ())
    samples: int = table_field(whole_reader(0, 1000), 8)

    def bounds(self) -> JsonObject:
        """Return the bounds by name, without those that are not set."""
        return {
            name: value for name, value in plain_fields(self).items() if name != "samples" and value not in (None, [])
        }


@dataclasses.dataclass(frozen=True)
class Goal:
    """The goal of a tuning, in SI.

    Attributes:
        starts: Number of descents.
        seed: Seed of the starts, and of the Latin hypercube.
        iterations: Greatest number of iterations of each descent.
        samples: Number of runs of the Latin hypercube; 0 for every combination.
        decay: Required certified decay rate [1/s]; 0 for none.
        damping: Required damping of the poles, in [0, 1); 0 for none.
        clauses: Numbers of the clauses of [assess] that the loop shall meet.
        free: Ranges by path; None for the declared range.
        objective: Weights by metric.
        over: Values by path.
        aggregate: Type and fields of the aggregate over the runs.
        limits: Greatest allowed values by metric.
        constraints: Bounds of the linear loop's margins.
    """

    starts: int = table_field(whole_reader(1, 1000), 1)
    seed: int = table_field(whole_reader(0, 2**32 - 1), 0)
    iterations: int = table_field(whole_reader(1, 100_000), 60)
    samples: int = table_field(whole_reader(0, MOST_LANES), 0)
    decay: float = table_field(range_reader(ParameterSpec("1/s", low=0.0)), 0.0)
    damping: float = table_field(range_reader(ParameterSpec("1", low=0.0, high=1.0, open_high=True)), 0.0)
    clauses: tuple[str, ...] = ()
    free: Mapping[str, Ends | None] = dataclasses.field(default_factory=dict)
    objective: Mapping[str, float] = dataclasses.field(default_factory=dict)
    over: Mapping[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    aggregate: Table = table_field(_aggregate, lambda: {"type": "mean"})
    limits: Mapping[str, float] = dataclasses.field(default_factory=dict)
    constraints: FrequencyConstraints = dataclasses.field(default_factory=FrequencyConstraints)

    def table(self) -> JsonObject:
        """Return the section as TOML values."""
        free = {path: DECLARED_RANGE if ends is None else interval_table(*ends) for path, ends in self.free.items()}
        bounds = self.constraints.bounds()
        constraints = bounds | {"samples": self.constraints.samples} if bounds else {}
        return plain_fields(self) | {"free": free, "constraints": constraints}

    def check(self, loop: Loop) -> "Goal":
        """Return this goal unchanged if `loop` can be tuned with it."""
        interval = '"controller.gain" = { low = -20000.0, high = -80.0 }'
        for name, example in (("free", interval), ("objective", "iae = 1.0")):
            if not getattr(self, name):
                raise ScenarioError(f"tune.{name} is empty; for example [tune.{name}] {example}")
        if self.samples and not self.over:
            raise ScenarioError(f"tune.samples = {self.samples} needs ranges to draw from: tune.over is empty")
        if both := set(self.free) & set(self.over):
            named = ", ".join(sorted(map(canonical_path, both)))
            raise ScenarioError(f"{named}: both in tune.free and in tune.over; leave it out of one of them")
        check_starts(loop, self.free, "tune.free")
        end, slowest = getattr(loop.stop, "speed", 0.0), min(self.over.get("initial.speed", (math.inf,)))
        if not slowest > end:
            raise ScenarioError(
                f"tune.over.initial.speed = {slowest:g} m/s is not above stop.speed = {end:g} m/s: the run would end"
                " before it starts"
            )
        return self

    def batch(self, seed: int) -> Batch:
        """Return the runs as a batch: all combinations of [tune.over], or its Latin hypercube.

        It has one run without [tune.over]. All runs have the same noise, from `seed`.
        """
        if not self.over:
            lanes = grid({})
        elif self.samples:
            lanes = latin({path: (min(v), max(v)) for path, v in self.over.items()}, self.samples, self.seed)
        else:
            lanes = grid(self.over)
        return dataclasses.replace(lanes, keys=(seed,) * max(lanes.size, 1))

    def read_aggregate(self) -> risk.Aggregate:
        """Return the aggregate: it maps the objective of each run to a single number."""
        return read_one(risk.AGGREGATE_TYPES, self.aggregate, "tune.aggregate")


def read_tune_section(table: object, loop: Loop, objectives: Mapping[str, Objective]) -> Goal:
    """Return the goal that a section describes, of at most `MOST_LANES` combinations."""
    samples = table.get("samples") if isinstance(table, Mapping) else 0
    goal: Goal = read_table(
        Goal,
        table,
        "tune",
        free=lambda value, path: free_ranges(table_reader(read_as_given, "ranges")(value, path), loop, path),
        over=lambda value, path: _over(table_reader(read_as_given, "values")(value, path), loop, bool(samples)),
        objective=metric_reader(objectives, "weights of metrics"),
        clauses=lambda value, path: read_clauses(value, path, loop) if value != [] else (),
        constraints=functools.partial(read_table, FrequencyConstraints),
        limits=metric_reader(
            objectives, "greatest values of metrics", lambda objective: unit_of(objective, loop.plant)
        ),
    )
    lanes = math.prod(map(len, goal.over.values()))
    if lanes > MOST_LANES and not goal.samples:
        raise ScenarioError(f"tune.over has {lanes} combinations, outside [1, {MOST_LANES}]; set tune.samples")
    return goal


def _entries(table: JsonObject, section: str, loop: Loop) -> Iterable[ParameterEntry]:
    return read_entries(table, section, parameters_of(loop), "not a parameter of this loop")


def free_ranges(table: JsonObject, loop: Loop, section: str) -> dict[str, Ends | None]:
    """Return the ranges (low, high) of the free parameters by path of the loop, in SI; None for a declared range.

    Each end is a number, or a tuple where a list was given for a parameter that is a list.
    """
    ranges: dict[str, Ends | None] = {}
    for item in _entries(table, section, loop):
        if not item.spec.tunable:
            raise ScenarioError(f"{item.where} cannot be tuned: a run does not depend smoothly on it")
        ranges[item.path] = None if item.value == DECLARED_RANGE else item.range(f', or "{DECLARED_RANGE}",')
    return ranges


def _over(table: JsonObject, loop: Loop, drawn: bool) -> dict[str, tuple[float, ...]]:
    """Return values by path; the ends of an interval if the runs are drawn from it."""
    values = {}
    for item in _entries(table, "tune.over", loop):
        entry = item.single("differ between lanes")
        values[item.path] = entry.range() if drawn and interval_ends(entry.value, entry.where) else entry.values()
    return values


def check_starts(loop: Loop, free: Mapping[str, Ends | None], section: str) -> None:
    """Check that each free parameter starts strictly inside its range.

    A parameter that starts at an end of its range could not move: its coordinate in the tuning is infinite there.
    """
    lines = []
    for path, ends in free.items():
        spec, value = next((spec, value) for name, spec, value in parameters(loop) if name == path)
        low, high = ends or (spec.low, spec.high)
        low, high, value = np.broadcast_arrays(low, high, np.asarray(value, float))
        for at in np.ndindex(value.shape):
            inside = dataclasses.replace(spec, low=low[at], high=high[at], open_low=True, open_high=True)
            if not inside.holds(value[at]):
                name = ".".join([canonical_path(path), *map(str, at)])
                lines.append(f"{name} = {value[at]:g} is outside {inside.interval()}, its range in {section}")
    if lines:
        raise ScenarioError("; ".join(lines))
