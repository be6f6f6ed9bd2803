"""The section [sweep] of a scenario: what varies, how often it is drawn, and what counts as a failure.

    samples, seed            runs (0: as many as the design has, or 1,000)
    chunk                    runs that are computed and stored together
    check                    runs, drawn from all, that are repeated with a half step to see how accurate they are
    dtype                    "float64" or "float32"
    design                   "random", "sobol", "latin-hypercube", "grid", "corners", "saltelli", or a table of one
    [sweep.over]
    "plant.mass" = [5.3, 6.2]                                 # uniform between them
    "road.scale" = { type = "normal", mean = 1.0, deviation = 0.1, low = 0.5, high = 1.5 }
    "initial.speed_kmh" = [20.0, 60.0]
    "controller.gain.0" = { type = "triangular", low = -13e3, mode = -12e3, high = -11e3 }
    "road.w4" = { type = "empirical", file = "roads.csv", column = "w4" }    # or .parquet; beside the scenario
    road = ["dry-asphalt", "snow"]                            # parts: one of them, or a table with weights
    [sweep.correlation]
    paths = ["plant.mass", "road.scale"]                      # of the normal copula
    matrix = [[1.0, 0.3], [0.3, 1.0]]
    [sweep.failures]
    overshoot = 0.5                                           # more is a failure; so is not to stop, or to lock

The distributions are those of `diffabs.sweep.distributions`. Reading needs no extra, running `diffabs[sweep]`."""

import dataclasses
import pathlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from diffabs.core.loop import Loop
from diffabs.core.protocols import Objective
from diffabs.core.pytree import Spec, elements, get
from diffabs.scenario.parameter_paths import Entry, canonical, entries, flat
from diffabs.scenario.registry import (
    FAMILIES,
    ScenarioError,
    build,
    family_of,
    joined,
    number,
    shown,
    unit_of,
    unknown,
    whole,
    wrong,
)

if TYPE_CHECKING:
    from diffabs.sweep import Study

WHOLE = {"samples": (0, 0, 2**32 - 1), "seed": (0, 0, 2**32 - 1), "chunk": (4096, 1, 2**20), "check": (16, 0, 4096)}
SAMPLES = 1000  # where the design does not say how many there are
DTYPES = ("float64", "float32")
FIELDS = (*WHOLE, "dtype", "design", "over", "correlation", "failures")
UNSCALED = ("weights", "type", "levels", "interpolated")  # fields of a distribution that have no unit
PARTS = {field.name for field in dataclasses.fields(Loop)} | {"road"}


@dataclasses.dataclass(frozen=True)
class Variation:
    """What was said, checked for its form: `over` by path of the scenario, as it was given."""

    samples: int = 0
    seed: int = 0
    chunk: int = 4096
    check: int = 16
    dtype: str = "float64"
    design: Any = "random"
    over: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    correlation: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    failures: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def table(self) -> dict[str, Any]:
        """As values of TOML."""
        return {f.name: _plain(getattr(self, f.name)) for f in dataclasses.fields(self)}


def read(table: Any, loop: Loop, objectives: Mapping[str, Objective]) -> Variation:
    """The section, without its distributions. Raises ScenarioError, one line, for whatever is wrong with it."""
    if not isinstance(table, dict):
        raise wrong("sweep", table, f"a table of {', '.join(FIELDS)}")
    for key in table:
        if key not in FIELDS:
            raise unknown(f"{joined('sweep', key)} is not a field of sweep", key, FIELDS)
    for name in ("over", "correlation", "failures"):
        if not isinstance(table.get(name, {}), dict):
            raise wrong(f"sweep.{name}", table[name], "a table")
    numbers = {
        name: whole(table.get(name, default), low, high, f"sweep.{name}")
        for name, (default, low, high) in WHOLE.items()
    }
    dtype = table.get("dtype", DTYPES[0])
    if dtype not in DTYPES:
        raise unknown(f"sweep.dtype = {shown(dtype)} is unknown", str(dtype), DTYPES)
    over = flat(table.get("over", {}), "sweep.over")
    list(_entries(over, loop))
    failures = {}
    for name, given in table.get("failures", {}).items():
        if name not in objectives:
            raise unknown(f"{joined('sweep.failures', name)} is not measured", name, objectives)
        failures[name] = number(given, Spec(unit_of(objectives[name], loop.plant)), joined("sweep.failures", name))
    return Variation(
        **numbers,
        dtype=dtype,
        design=table.get("design", "random"),
        over=over,
        correlation=table.get("correlation", {}),
        failures=failures,
    )


def with_samples(table: Any, folder: pathlib.Path) -> Any:
    """The section with the numbers of files in the place of their names, which are relative to `folder`: a scenario
    that was read no longer depends on them. Raises ScenarioError."""
    over = table.get("over") if isinstance(table, dict) else None
    if not isinstance(over, dict):
        return table
    return {**table, "over": {path: _sample(given, f"sweep.over.{path}", folder) for path, given in over.items()}}


def _sample(given: Any, where: str, folder: pathlib.Path) -> Any:
    if not isinstance(given, dict) or given.get("type") != "empirical" or "file" not in given:
        return given
    if "values" in given:
        raise ScenarioError(f"{where} has values and a file; one of them is needed")
    if "column" not in given:
        raise ScenarioError(f"{where}.column is missing: which one of {shown(given['file'])}?")
    for key in ("file", "column"):
        if not isinstance(given[key], str):
            raise wrong(f"{where}.{key}", given[key], "text")
    try:
        from diffabs.sweep import sample_files
    except ImportError:
        raise ScenarioError(f'{where}: reading a file needs pip install "diffabs[sweep]"') from None
    try:
        values = sample_files.read(folder / given["file"], given["column"])
    except ValueError as error:
        raise ScenarioError(f"{where}: {' '.join(str(error).split())}") from None
    rest = {key: value for key, value in given.items() if key not in ("file", "column")}
    return {**rest, "values": values.tolist()}


def _entries(over: Mapping[str, Any], loop: Loop) -> Iterable[Entry]:
    """Single numbers of the loop that vary; parts are left out."""
    numbers = {path: given for path, given in over.items() if path not in PARTS}
    return entries(numbers, "sweep.over", elements(loop), "not a parameter of this loop")


def study(chosen: Any) -> "Study":
    """The sweep of a scenario. Raises ScenarioError."""
    from diffabs.sweep import Study
    from diffabs.sweep import sampling as all_designs
    from diffabs.sweep.variables import Space

    plan: Variation = chosen.sweep
    if not plan.over:
        raise ScenarioError('sweep.over is empty: say what varies, as in [sweep.over] "plant.mass" = [5.3, 6.2]')
    try:
        variables, parts = _variables(plan.over, chosen.loop)
        design = {"type": plan.design} if isinstance(plan.design, str) else plan.design
        drawn = all_designs.read(design, "sweep.design")
        space = Space(variables, _correlation(plan.correlation, variables), drawn)
        return Study(
            loop=chosen.loop,
            space=space,
            samples=plan.samples or _counted(space),
            solver=chosen.solver,
            objectives=chosen.objectives,
            seed=plan.seed,
            chunk=plan.chunk,
            dtype=plan.dtype,
            parts=parts,
            failures=plan.failures,
        ).check()
    except ScenarioError:
        raise
    except ValueError as error:
        raise ScenarioError(str(error)) from None


def _counted(space: Any) -> int:
    """As many samples as the design has by itself."""
    from diffabs.sweep.sampling import Corners, Grid

    return space.check() if isinstance(space.design, Corners | Grid) else SAMPLES


def _variables(over: Mapping[str, Any], loop: Loop) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Distributions by path of the loop, in SI and in the order given; and the parts by path and name."""
    numbers = {entry.where.removeprefix("sweep.over."): entry for entry in _entries(over, loop)}
    variables, parts = {}, {}
    for key, given in over.items():
        if key in PARTS:
            path = "plant.road" if key == "road" else key
            variables[path], parts[path] = _choice(key, given, get(loop, path))
        else:
            entry = numbers[key]
            variables[entry.path] = _distribution(entry)
    return variables, parts


def _distribution(entry: Entry) -> Any:
    """In SI; a pair of numbers is uniform."""
    from diffabs.sweep import distributions

    given = entry.given
    if isinstance(given, list):
        if len(given) != 2:
            raise ScenarioError(f"{entry.where} = {shown(given)} is no pair [low, high], and no table with a type")
        given = {"type": "uniform", "low": given[0], "high": given[1]}
    if not isinstance(given, dict):
        raise wrong(entry.where, given, "a pair [low, high] or a table with a type")
    found = distributions.read(given, entry.where)
    if line := distributions.leaving(found, entry.spec, entry.where):
        raise ScenarioError(line)
    unscaled = (*UNSCALED, *(("deviation",) if given.get("type") == "log-normal" else ()))
    table = {name: value if name in unscaled else _scaled(value, entry.scale) for name, value in found.table().items()}
    return distributions.read(table, entry.where)


def _scaled(value: Any, scale: float) -> Any:
    return [_scaled(item, scale) for item in value] if isinstance(value, list | tuple) else value / scale


def _choice(key: str, given: Any, default: Any) -> tuple[Any, dict[str, Any]]:
    """A categorical distribution of names, and the part of each."""
    from diffabs.sweep.distributions import read as read_distribution

    where = f"sweep.over.{key}"
    table = {"choices": given} if isinstance(given, list) else given
    if not isinstance(table, dict) or not isinstance(table.get("choices"), list) or not table["choices"]:
        raise wrong(where, given, "a list of parts, or a table of choices and weights,")
    for name in table:
        if name not in ("choices", "weights", "type"):
            raise unknown(f"{where}.{name} is not a field of a choice", name, ("choices", "weights"))
    family = key if key in FAMILIES else family_of(key, key)
    names = [item if isinstance(item, str) else f"{i}" for i, item in enumerate(table["choices"])]
    parts = {
        name: build(family, item, default, f"{where}.{i}")
        for i, (name, item) in enumerate(zip(names, table["choices"], strict=True))
    }
    weights = {"weights": table["weights"]} if "weights" in table else {}
    return read_distribution({"type": "categorical", "choices": names, **weights}, where), parts


def _correlation(table: Mapping[str, Any], variables: Mapping[str, Any]) -> Any:
    from diffabs.sweep.variables import Correlation

    if not table:
        return None
    paths = [str(path) for path in table.get("paths", ())]
    known = {canonical(path).removesuffix("_kmh"): path for path in variables}
    for path in paths:
        if canonical(path).removesuffix("_kmh") not in known:
            raise unknown(f"sweep.correlation.paths: {shown(path)} does not vary", path, known)
    return Correlation(tuple(known[canonical(path).removesuffix("_kmh")] for path in paths), table.get("matrix", []))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
