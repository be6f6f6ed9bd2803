"""The section [tune] of a scenario: which parameters are free, what is made small, and over which runs.

    starts, seed     descents: the first from the scenario's own values, the others drawn from the ranges
    iterations       of each descent
    samples          0: every combination of the values of [tune.over] is a run, a lane; N: a Latin hypercube of N lanes
                     between the smallest and the greatest of each
    decay            1/s that shall be certified over [design.over]; 0 for none
    damping          of the poles of the linear systems there, in [0, 1); 0 for none
    [tune.free]
    "controller.gain" = [[-1e5, -300.0], [-100.0, -15.0]]    # low and high, lists where the parameter is one, in SI
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

Paths are those of `ranges`. Only reading is done without the extra `diffabs[tune]`."""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from diffabs.core.loop import Loop
from diffabs.core.protocols import Objective
from diffabs.core.pytree import Spec, get, parameters
from diffabs.scenario.parameter_paths import Entry, canonical, entries
from diffabs.scenario.registry import ScenarioError, joined, number, shown, unit_of, unknown, whole, wrong

if TYPE_CHECKING:
    from diffabs.tune import AtMost, Batch
    from diffabs.tune.risk import Aggregate

# Fields that are whole numbers, with their defaults and ranges.
WHOLE = {"starts": (1, 1, 1000), "seed": (0, 0, 2**32 - 1), "iterations": (60, 1, 100_000), "samples": (0, 0, 100_000)}
DECLARED = "declared"
REAL = {"decay": Spec("1/s", low=0.0), "damping": Spec("1", low=0.0, high=1.0, open_high=True)}  # default 0
FIELDS = (*WHOLE, *REAL, "free", "objective", "over", "aggregate", "limits")
MOST_LANES = 100_000
# As in `diffabs.tune.aggregate`, which is not there without the extra; a test compares the two.
AGGREGATES: dict[str, dict[str, tuple[float, Spec]]] = {
    "mean": {},
    "smooth-worst": {"softness": (0.02, Spec("1", low=0.0, open_low=True))},
    "cvar": {"level": (0.9, Spec("1", low=0.0, high=1.0, open_high=True))},
    "quantile": {"level": (0.9, Spec("1", low=0.0, high=1.0))},
}

Ends = tuple[Any, Any] | None  # low and high, tuples where the parameter is a list; None is declared


def _mean() -> dict[str, Any]:
    return {"type": "mean"}


@dataclasses.dataclass(frozen=True)
class Goal:
    """What is tuned, in SI. `free`: ranges by path, None the declared one; `objective`: weights by metric; `over`:
    values by path; `aggregate`: its type and fields; `limits`: greatest values by metric."""

    starts: int = 1
    seed: int = 0
    iterations: int = 60
    samples: int = 0
    decay: float = 0.0
    damping: float = 0.0
    free: Mapping[str, Ends] = dataclasses.field(default_factory=dict)
    objective: Mapping[str, float] = dataclasses.field(default_factory=dict)
    over: Mapping[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    aggregate: Mapping[str, Any] = dataclasses.field(default_factory=_mean)
    limits: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def table(self) -> dict[str, Any]:
        """As values of TOML."""
        free = {path: DECLARED if ends is None else _listed(ends) for path, ends in self.free.items()}
        over = {path: list(values) for path, values in self.over.items()}
        others = {name: dict(getattr(self, name)) for name in ("objective", "aggregate", "limits")}
        return {name: getattr(self, name) for name in (*WHOLE, *REAL)} | {"free": free, "over": over, **others}

    def check(self, loop: Loop) -> "Goal":
        """What only matters once a loop is tuned. Raises ScenarioError: nothing free, no objective, a start at an end
        of its range or outside, a lane that would end before it starts."""
        for name, example in (("free", '"controller.gain" = [-20000.0, -80.0]'), ("objective", "iae = 1.0")):
            if not getattr(self, name):
                raise ScenarioError(f"tune.{name} is empty: say what, as in [tune.{name}] {example}")
        check_starts(loop, self.free, "tune.free")
        end, slowest = getattr(loop.stop, "speed", 0.0), min(self.over.get("initial.speed", (math.inf,)))
        if not slowest > end:
            raise ScenarioError(
                f"tune.over.initial.speed = {slowest:g} m/s is not above stop.speed = {end:g} m/s: the run would end"
                " before it starts"
            )
        return self

    def batch(self, seed: int) -> "Batch":
        """The lanes, each with the same noise."""
        from diffabs.tune import grid, latin

        if not self.over:
            lanes = grid({})
        elif self.samples:
            lanes = latin({path: (min(v), max(v)) for path, v in self.over.items()}, self.samples, self.seed)
        else:
            lanes = grid(self.over)
        return dataclasses.replace(lanes, seeds=(seed,) * max(lanes.size, 1))

    def aggregated(self) -> "Aggregate":
        """From a number per lane to one."""
        from diffabs import tune

        kinds = {"mean": tune.Mean, "smooth-worst": tune.SmoothWorst, "cvar": tune.CVaR, "quantile": tune.Quantile}
        return kinds[self.aggregate["type"]](**{k: v for k, v in self.aggregate.items() if k != "type"})

    def constraints(self) -> list["AtMost"]:
        """One for each limit, in their order."""
        from diffabs.tune import AtMost

        return [AtMost(metric=name, bound=bound) for name, bound in self.limits.items()]


def read(table: Any, loop: Loop, objectives: Mapping[str, Objective]) -> Goal:
    """The goal of a section. Raises ScenarioError, one line, for whatever is wrong with it."""
    if not isinstance(table, dict):
        raise wrong("tune", table, f"a table of {', '.join(FIELDS)}")
    for key in table:
        if key not in FIELDS:
            raise unknown(f"{joined('tune', key)} is not a field of tune", key, FIELDS)
    numbers: dict[str, Any] = {
        name: whole(table.get(name, default), low, high, f"tune.{name}") for name, (default, low, high) in WHOLE.items()
    }
    numbers |= {name: _within(table.get(name, 0.0), spec, f"tune.{name}") for name, spec in REAL.items()}
    over = _over(_table(table, "over", "values"), loop)
    lanes = math.prod(map(len, over.values()))
    units = {name: unit_of(one, loop.plant) for name, one in objectives.items()}
    if lanes > MOST_LANES and not numbers["samples"]:
        raise ScenarioError(f"tune.over has {lanes} combinations, outside [1, {MOST_LANES}]; set tune.samples")
    return Goal(
        **numbers,
        free=free_ranges(_table(table, "free", "ranges"), loop, "tune.free"),
        objective=_metrics(_table(table, "objective", "weights of metrics"), "tune.objective", objectives, {}),
        over=over,
        aggregate=_aggregate(table.get("aggregate", "mean")),
        limits=_metrics(_table(table, "limits", "greatest values of metrics"), "tune.limits", objectives, units),
    )


def _table(table: dict[str, Any], name: str, what: str) -> dict[str, Any]:
    inside = table.get(name, {})
    if not isinstance(inside, dict):
        raise wrong(f"tune.{name}", inside, f"a table of {what}")
    return inside


def _within(given: Any, spec: Spec, path: str) -> float:
    value = number(given, spec, path)
    if not spec.holds(value):
        raise ScenarioError(f"{path} = {shown(value)} is outside {spec.interval()}")
    return value


def _tunable(loop: Loop) -> dict[str, tuple[Spec, Any]]:
    return {path: (spec, value) for path, spec, value in parameters(loop)}


def _entries(table: dict[str, Any], section: str, loop: Loop) -> Iterable[Entry]:
    specs = {path: spec for path, (spec, _) in _tunable(loop).items()}
    return entries(table, section, specs, "not a parameter of this loop")


def free_ranges(table: dict[str, Any], loop: Loop, section: str) -> dict[str, Ends]:
    """Ranges by path of the loop, in SI. Raises ScenarioError."""
    found: dict[str, Ends] = {}
    for entry in _entries(table, section, loop):
        if not entry.spec.tunable:
            raise ScenarioError(f"{entry.where} cannot be tuned: a run does not depend smoothly on it")
        found[entry.path] = _ends(entry, np.shape(get(loop, entry.path)))
    return found


def check_starts(loop: Loop, free: Mapping[str, Ends], section: str) -> None:
    """Raises ScenarioError for a value of the loop at an end of its range or outside: it could not be moved."""
    lines = [line for path, ends in free.items() for line in _stuck(loop, path, ends, section)]
    if lines:
        raise ScenarioError("; ".join(lines))


def _stuck(loop: Loop, path: str, ends: Ends, section: str) -> Iterator[str]:
    spec, value = _tunable(loop)[path]
    low, high = ends or (spec.low, spec.high)
    low, high, value = np.broadcast_arrays(low, high, np.asarray(value, float))
    for at in np.ndindex(value.shape):
        inside = dataclasses.replace(spec, low=low[at], high=high[at], open_low=True, open_high=True)
        if not inside.holds(value[at]):
            name = ".".join([canonical(path), *map(str, at)])
            yield f"{name} = {value[at]:g} is outside {inside.interval()}, its range in {section}"


def _ends(entry: Entry, shape: tuple[int, ...]) -> Ends:
    """In SI, checked in the unit in which they were given."""
    path, given, spec = entry.where, entry.given, entry.spec
    needed = f'a range [low, high] in {spec.interval()}, or "{DECLARED}",'
    if given == DECLARED:
        return None
    if not isinstance(given, list):
        raise wrong(path, given, needed)
    if len(given) != 2:
        raise ScenarioError(f"{path} = {shown(given)} is no range [low, high] in {spec.interval()}")
    low, high = (_end(item, shape, spec, f"{path}.{i}") for i, item in enumerate(given))
    if not (np.all(np.asarray(low) >= spec.low) and np.all(np.asarray(high) <= spec.high)):
        raise ScenarioError(f"{path} = {shown([low, high])} is outside {spec.interval()}")
    if not np.all(np.asarray(low) < np.asarray(high)):
        raise ScenarioError(f"{path} = {shown([low, high])} is empty: a range [low, high] in {spec.interval()}")
    return _divided(low, entry.scale), _divided(high, entry.scale)


def _end(given: Any, shape: tuple[int, ...], spec: Spec, path: str) -> Any:
    """A number, or a tuple of as many as the parameter has."""
    if not shape or not isinstance(given, list):
        return number(given, spec, path)
    if len(given) != shape[0]:
        raise ScenarioError(f"{path} = {shown(given)} has {len(given)} numbers; the parameter has {shape[0]}")
    return tuple(number(item, spec, f"{path}.{i}") for i, item in enumerate(given))


def _divided(end: Any, scale: float) -> Any:
    return tuple(x / scale for x in end) if isinstance(end, tuple) else end / scale


def _over(table: dict[str, Any], loop: Loop) -> dict[str, tuple[float, ...]]:
    found = {}
    for entry in _entries(table, "tune.over", loop):
        path, spec, shape = entry.where, entry.spec, np.shape(get(loop, entry.path))
        if shape:
            raise ScenarioError(f"{path} is a list of {shape[0]} numbers; only single numbers can differ between lanes")
        given = entry.given if isinstance(entry.given, list) else [entry.given]
        if not given:
            raise ScenarioError(f"{path} = [] is empty; numbers in {spec.interval()} are needed")
        found[entry.path] = tuple(_within(x, spec, f"{path}.{i}") / entry.scale for i, x in enumerate(given))
    return found


def _metrics(
    table: dict[str, Any], section: str, objectives: Mapping[str, Objective], units: Mapping[str, str]
) -> dict[str, float]:
    found = {}
    for name, given in table.items():
        if name not in objectives:
            raise unknown(f"{joined(section, name)} is not measured", name, objectives)
        spec = Spec(units.get(name, "1"))
        found[name] = _within(given, spec, joined(section, name))
    return found


def _aggregate(given: Any) -> dict[str, Any]:
    table = {"type": given} if isinstance(given, str) else given
    path = "tune.aggregate"
    if not isinstance(table, dict):
        raise wrong(path, given, f"a table, or the name of a type ({', '.join(AGGREGATES)}),")
    kind = table.get("type", "mean")
    if not isinstance(kind, str):
        raise wrong(f"{path}.type", kind, f"one of {', '.join(AGGREGATES)}")
    if kind not in AGGREGATES:
        raise unknown(f"{path}.type = {shown(kind)} is unknown", kind, AGGREGATES)
    fields = AGGREGATES[kind]
    for key in table:
        if key != "type" and key not in fields:
            raise unknown(f"{joined(path, key)} is not a field of {kind}", key, fields)
    values = {
        name: _within(table.get(name, default), spec, f"{path}.{name}") for name, (default, spec) in fields.items()
    }
    return {"type": kind, **values}


def _listed(value: Any) -> Any:
    return [_listed(item) for item in value] if isinstance(value, tuple) else value
