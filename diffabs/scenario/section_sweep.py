"""The section [sweep] of a scenario: distributions, number of runs, and bounds of a failure.

    samples, seed            runs (0: as many as the design has, or 1,000)
    chunk                    runs that are computed and stored together
    check                    runs, drawn from all, that are repeated with a half step to see how accurate they are
    dtype                    "float64" or "float32"
    design                   "random", "sobol", "latin-hypercube", "corners", "saltelli", or a table such as
                             { type = "grid", levels = 3 }, or levels = { "road.w4" = 5, "plant.mass" = 3 }
    [sweep.over]
    "plant.mass" = { low = 5.3, high = 6.2 }                  # an interval: uniform between its ends
    "road.scale" = { type = "normal", mean = 1.0, deviation = 0.1, low = 0.5, high = 1.5 }
    "initial.speed_kmh" = { low = 20.0, high = 60.0 }
    "controller.gain.0" = { type = "triangular", low = -13e3, mode = -12e3, high = -11e3 }
    "road.w4" = { type = "empirical", file = "roads.csv", column = "w4" }    # or .parquet; beside the scenario
    road = ["dry-asphalt", "snow"]                            # parts: one of them, or a table with weights
    [sweep.correlation]
    paths = ["plant.mass", "road.scale"]                      # of the normal copula
    matrix = [[1.0, 0.3], [0.3, 1.0]]
    [sweep.failures]
    overshoot = 0.5                                           # more is a failure; so is not to stop, or to lock

The distributions are those of `diffabs.uncertainty.sweep.distributions`. Reading the section needs no extra, except
for files. Running the sweep needs the extra `sweep`.
"""

import dataclasses
import math
import pathlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from diffabs.core.protocols import Objective
from diffabs.core.pytree import ParameterSpec, elements, get, parameters
from diffabs.core.types import JsonObject, Params, PyTree, Table
from diffabs.host.values import (
    ScenarioError,
    as_plain,
    choice_reader,
    format_given,
    plain_fields,
    read_as_given,
    read_number,
    read_text,
    table_field,
    table_reader,
    unknown_name_error,
    whole_reader,
    wrong_kind_error,
)
from diffabs.host.values import read_table as read_table
from diffabs.loop.closed_loop import Loop
from diffabs.scenario.parameter_paths import (
    ParameterEntry,
    flatten_table,
    interval_ends,
    interval_table,
    metric_reader,
    read_entries,
)
from diffabs.scenario.registry import build_part, describe_missing_inner_parts, family_of, unit_of
from diffabs.scenario.toml import parse_value
from diffabs.uncertainty.sweep import distributions, sampling
from diffabs.uncertainty.sweep.variables import Correlation, Space, read_correlation

if TYPE_CHECKING:
    from diffabs.scenario.scenario import Scenario
    from diffabs.uncertainty.sweep import Study

DEFAULT_SAMPLES = 1000  # for a sampling design without a number of points of its own
PARTS = {field.name for field in dataclasses.fields(Loop)} | {"road"}


@dataclasses.dataclass(frozen=True)
class Choice:
    """A categorical distribution over parts.

    Attributes:
        toml_value: Values as read from TOML.
        names: Distribution of the names of the parts.
        parts: The part of each name.
    """

    toml_value: PyTree
    names: distributions.Categorical
    parts: Table


@dataclasses.dataclass(frozen=True)
class SweepSection:
    """The section as read, in SI.

    Attributes:
        samples: Number of runs; 0 for as many as the design has, or 1,000.
        seed: Seed of the samples.
        chunk: Number of runs that are computed and stored together.
        check: Number of runs that are repeated with a half step, to estimate their accuracy.
        dtype: "float64" or "float32".
        design: Sampling design.
        over: Distributions, and choices of parts, by path of the loop.
        correlation: Correlation of the varied parameters by a normal copula; None for independent ones.
        failures: Bounds by metric: a run with a greater value fails.
    """

    samples: int = table_field(whole_reader(0, sampling.MAX_UINT32), 0)
    seed: int = table_field(whole_reader(0, sampling.MAX_UINT32), 0)
    chunk: int = table_field(whole_reader(1, 2**20), 4096)
    check: int = table_field(whole_reader(0, 4096), 16)
    dtype: str = table_field(choice_reader("float64", "float32"), "float64")
    design: sampling.SamplingDesign = table_field(sampling.read_sampling_design, sampling.Random)
    over: Params = dataclasses.field(default_factory=dict)
    correlation: Correlation | None = None
    failures: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def table(self) -> JsonObject:
        """Return the section as TOML values, with short forms for common values."""
        design = as_plain(self.design, brief=True)
        short = {"design": design["type"] if len(design) == 1 else design}
        short["over"] = {path: _format_item(item) for path, item in self.over.items()}
        short["correlation"] = plain_fields(self.correlation) if self.correlation else {}
        return plain_fields(dataclasses.replace(self, over={}, correlation=None)) | short


def _format_item(item: object) -> JsonObject:
    """Return a distribution, or a choice of parts, as a TOML value."""
    if isinstance(item, distributions.Uniform):
        return interval_table(item.low, item.high)
    return item.toml_value if isinstance(item, Choice) else as_plain(item, brief=True)


def read_sweep_section(
    table: object, loop: Loop, objectives: Mapping[str, Objective], folder: pathlib.Path
) -> SweepSection:
    """Return the sweep that a section describes.

    Files of numbers are read now, so later changes of the files have no effect.
    """
    plan: SweepSection = read_table(
        SweepSection,
        table,
        "sweep",
        over=lambda value, path: _over(flatten_table(table_reader(read_as_given)(value, path), path), loop, folder),
        correlation=lambda value, path: read_correlation(value, path) if value != {} else None,
        failures=metric_reader(objectives, "bounds by metric", lambda objective: unit_of(objective, loop.plant)),
    )
    if plan.correlation:
        paths = dict.fromkeys(plan.correlation.paths)
        paths = tuple(_by_varied_path(paths, "sweep.correlation.paths", plan.over, loop))
        plan = dataclasses.replace(plan, correlation=dataclasses.replace(plan.correlation, paths=paths))
    if isinstance(plan.design, sampling.Grid) and isinstance(levels := plan.design.levels, Mapping):
        levels = _by_varied_path(levels, "sweep.design.levels", plan.over, loop)
        plan = dataclasses.replace(plan, design=dataclasses.replace(plan.design, levels=levels))
    return plan


def _by_varied_path(table: Table, where: str, over: Params, loop: Loop) -> JsonObject:
    """Return the values given for varied parameters by path of the loop; the keys may have any allowed form."""
    specs = elements(loop)
    allowed = {path: (specs.get(path, ParameterSpec("1")), ()) for path in over}
    return {item.path: item.value for item in read_entries(table, where, allowed, "not varied in sweep.over")}


def _over(table: Table, loop: Loop, folder: pathlib.Path) -> JsonObject:
    """Return distributions and choices by path of the loop, in the order given."""
    allowed = {path: (spec, ()) for path, spec in elements(loop).items()}
    numbers = {path: item for path, item in table.items() if path not in PARTS}
    entries = read_entries(numbers, "sweep.over", allowed, "not a parameter of this loop")
    varied = {}
    for key, value in table.items():
        if key in PARTS:
            path = "plant.road" if key == "road" else key
            varied[path] = _choice(key, value, get(loop, path))
        else:
            item = next(entries)
            varied[item.path] = _distribution(item, folder)
    return varied


def _distribution(item: ParameterEntry, folder: pathlib.Path) -> PyTree:
    """Return the distribution of one parameter, in SI; an interval is uniform."""
    value = item.value
    if isinstance(value, list):
        low, high = (value[0], value[-1]) if value else (0, 1)
        raise ScenarioError(
            f"{item.where} = {format_given(value)} is a list; an interval is {{ low = {format_given(low)}, high ="
            f' {format_given(high)} }}, a choice of values {{ type = "categorical", choices = {format_given(value)} }}'
        )
    if (ends := interval_ends(value, item.where)) is not None:
        value = {"type": "uniform", **interval_table(*ends)}
    if not isinstance(value, dict):
        raise wrong_kind_error(item.where, value, "an interval { low, high } or a table with a type")
    distribution = distributions.read_distribution(_with_numbers(value, item.where, folder), item.where)
    if line := distributions.describe_out_of_range(distribution, item.spec, item.where):
        raise ScenarioError(line)
    return distributions.convert_distribution_to_si(distribution, item.scale)


def _with_numbers(table: Table, where: str, folder: pathlib.Path) -> Table:
    """Return the table of a distribution, with the numbers of a file in the place of its name."""
    if table.get("type") != "empirical" or "file" not in table:
        return table
    if "values" in table:
        raise ScenarioError(f"{where} has values and a file; one of them is needed")
    if "column" not in table:
        raise ScenarioError(f"{where}.column is missing: name a column of {format_given(table['file'])}")
    file, column = (read_text(table[key], f"{where}.{key}") for key in ("file", "column"))
    try:
        from diffabs.uncertainty.sweep import sample_files
    except ImportError:
        raise ScenarioError(f'{where}: reading a file needs pip install ".[sweep]" in a clone') from None
    try:
        values = sample_files.read_column(folder / file, column)
    except ValueError as error:
        raise ScenarioError(f"{where}: {error}") from None
    return {key: value for key, value in table.items() if key not in ("file", "column")} | {"values": values.tolist()}


def _choice(key: str, value: PyTree, default: Any) -> Choice:
    """Return a choice of parts; a part given as a table has its number as its name."""
    where = f"sweep.over.{key}"
    table = {"choices": value} if isinstance(value, list) else value
    if not isinstance(table, dict) or not isinstance(table.get("choices"), list) or not table["choices"]:
        raise wrong_kind_error(where, value, "a list of parts, or a table of choices and weights,")
    names = [item if isinstance(item, str) else f"{i}" for i, item in enumerate(table["choices"])]
    drawn: Any = distributions.read_distribution({**table, "type": "categorical", "choices": names}, where)
    family, parts = family_of(key, key), {}
    for i, (name, item) in enumerate(zip(names, table["choices"], strict=True)):
        if lines := describe_missing_inner_parts(family, item, f"{where}.{i}"):
            raise ScenarioError("; ".join(lines))
        parts[name] = build_part(family, item, default, f"{where}.{i}")
    return Choice(value, drawn, parts)


def read_failure(text: str, scenario: Any) -> tuple[str, float]:
    """Return metric and bound, in SI, of a text `METRIC=BOUND`; without a bound, that of [sweep.failures]."""
    metric, equals, bound = text.partition("=")
    if metric not in scenario.objectives:
        raise unknown_name_error(f"{metric} is not a metric of this scenario", metric, scenario.objectives)
    if equals:
        spec = ParameterSpec(unit_of(scenario.objectives[metric], scenario.loop.plant))
        value = read_number(parse_value(bound.strip()), spec, metric)
        if not math.isfinite(value):
            raise ScenarioError(f"{metric} = {value:g} is outside {spec.interval()}")
        return metric, value
    if metric not in scenario.sweep.failures:
        raise ScenarioError(f"{metric} has no bound in [sweep.failures]: say {metric}=BOUND")
    return metric, scenario.sweep.failures[metric]


def _example_range(loop: Loop) -> str:
    """Return an entry of [sweep.over] for the plant: 10 % around the first of its positive numbers."""
    numbers = ((path, value) for path, _, value in parameters(loop.plant, "plant."))
    path, value = next((path, float(value)) for path, value in numbers if np.ndim(value) == 0 and value > 0)
    return f'"{path}" = {{ low = {0.9 * value:.4g}, high = {1.1 * value:.4g} }}'


def build_study(scenario: "Scenario") -> "Study":
    """Return the sweep of a scenario."""
    from diffabs.uncertainty.sweep import Study

    plan: SweepSection = scenario.sweep
    if not plan.over:
        raise ScenarioError(f"sweep.over is empty; for example [sweep.over] {_example_range(scenario.loop)}")
    choices = {path: item for path, item in plan.over.items() if isinstance(item, Choice)}
    variables = {path: item.names if path in choices else item for path, item in plan.over.items()}
    space = Space(variables, plan.correlation, plan.design)
    try:
        return Study(
            loop=scenario.loop,
            space=space,
            samples=plan.samples or _natural_count(space),
            solver=scenario.solver,
            objectives=scenario.objectives,
            seed=plan.seed,
            chunk=plan.chunk,
            dtype=plan.dtype,
            parts={path: item.parts for path, item in choices.items()},
            failures=plan.failures,
        ).check()
    except ValueError as error:
        raise ScenarioError(str(error)) from None


def _natural_count(space: Space) -> int:
    """Return the number of points of a grid or of corners, else `DEFAULT_SAMPLES`."""
    return space.check() if isinstance(space.design, sampling.Corners | sampling.Grid) else DEFAULT_SAMPLES
