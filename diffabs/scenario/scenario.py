"""Scenarios: a TOML file, or the name of a packaged one, describes a loop and the tasks on it.

    title, description    one printable line; printable lines
    [plant] [road] [initial] [sensor] [reference] [feedforward] [controller] [actuator] [stop]    a part each: `type`
    [solver]       type (fixed, adaptive), step [s], duration [s], every (trajectories keep every so many steps), rtol
                   (of adaptive steps), kinks (of fixed ones), follow_slides, seed (of noisy sensors)
    [objective]    name = a part; adds to, or changes, those of every report on such a plant
    [design]       requirements on a robust gain, and the ranges of parameters: see `section_design`
    [tune]         free parameters, objective, and the runs it is taken over: see `section_tune`
    [sweep]        distributions of a Monte-Carlo sweep, and bounds of a failure: see `section_sweep`
    [assess]       roads, load and speed of the clauses about anti-lock brakes: see `section_assess`

A section that is left out gets the plant's usual part; it is required if the plant has none. Speeds may be given in
km/h: `speed_kmh`. A value is never evaluated as code.
"""

import dataclasses
import importlib.resources
import pathlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from diffabs.core.jax_flags import default_flags
from diffabs.core.protocols import Objective
from diffabs.core.pytree import get
from diffabs.core.types import JsonObject, Table
from diffabs.core.units import units_of
from diffabs.core.validity import find_cautions, find_problems
from diffabs.engine.solvers import Adaptive, Solver
from diffabs.host import files
from diffabs.host.values import ScenarioError as ScenarioError
from diffabs.host.values import (
    as_plain,
    format_given,
    make_printable,
    read_printable_line,
    read_printable_lines,
    unknown_name_error,
    wrong_kind_error,
)
from diffabs.loop.admissible import find_mismatches, find_unstable_step
from diffabs.loop.closed_loop import Loop
from diffabs.loop.contracts import find_misfits
from diffabs.parts.objectives import BRAKING, default_objectives
from diffabs.scenario import (
    parameter_paths,
    section_assess,
    section_design,
    section_solver,
    section_sweep,
    section_tune,
    toml,
)
from diffabs.scenario.defaults import braking
from diffabs.scenario.registry import (
    FAMILIES,
    OTHER_SECTIONS,
    build_loop,
    build_part,
    describe_missing_inner_parts,
    family_of,
    join_path,
    name_of,
    type_name,
)

if TYPE_CHECKING:
    from diffabs.assess import StopProgram

MAX_SCENARIO_BYTES = 1_000_000  # bytes of a file
MAX_WRITTEN_BYTES = 10 * MAX_SCENARIO_BYTES  # bytes of a text in a document, which `dump` writes with all digits
MAX_OBJECTIVES = 200  # of a scenario; each is traced once to check it
MAX_PATH_LENGTH = 4096  # characters of a path in a message
TEXTS = {"title": read_printable_line, "description": read_printable_lines}


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A loop with its solver and objectives, and the tasks on it: a design, a tuning, a sweep.

    Attributes:
        name: Name of the packaged scenario, or of the file without its suffix.
        title: One line for reports.
        description: Lines for reports.
        loop: Loop to run.
        solver: Step [s], duration [s] and method of the integration.
        objectives: Objectives of a run by name.
        seed: Seed of the noise of the sensors.
        design: Section `[design]`.
        tune: Section `[tune]`.
        sweep: Section `[sweep]`.
        assess: Section `[assess]`; None without one.
        notes: One line for each override that replaces a part and so removes entries of the sections.
    """

    name: str
    title: str = ""
    description: str = ""
    loop: Loop = dataclasses.field(default_factory=braking)
    solver: Solver = dataclasses.field(default_factory=Adaptive)
    objectives: Mapping[str, Objective] = dataclasses.field(default_factory=lambda: dict(BRAKING))
    seed: int = 0
    design: section_design.DesignTask = dataclasses.field(default_factory=section_design.DesignTask)
    tune: section_tune.Goal = dataclasses.field(default_factory=section_tune.Goal)
    sweep: section_sweep.SweepSection = dataclasses.field(default_factory=section_sweep.SweepSection)
    assess: "StopProgram | None" = None
    notes: tuple[str, ...] = ()

    def key(self) -> jax.Array:
        """Return the random key of a run, `jax.random.key(seed)`."""
        if jax.config.jax_default_prng_impl == "threefry2x32" and 0 <= self.seed < 2**31:  # pyright: ignore
            # The same key as below. `jax.random.key` would compile a program for it.
            words: Any = np.array([0, self.seed], np.uint32)
            return jax.random.wrap_key_data(words)
        return jax.random.key(self.seed)

    def with_loop(self, loop: Loop, how: str) -> "Scenario":
        """Return this scenario with another `loop`, and the title "NAME, HOW", where `how` tells how the loop was
        found.

        The description is dropped, because it may be wrong for the new loop.
        """
        return dataclasses.replace(self, loop=loop, title=f"{self.name}, {how}", description="")

    def cautions(self) -> list[str]:
        """Return one line for each value of the loop that is allowed but probably a mistake."""
        return list(find_cautions(self.loop))


def names() -> list[str]:
    """Return the names of the packaged scenarios."""
    folder = importlib.resources.files("diffabs.scenario") / "scenarios"
    return sorted(file.name.removesuffix(".toml") for file in folder.iterdir() if file.name.endswith(".toml"))


def read_header(name_or_path: str | pathlib.Path) -> dict[str, str]:
    """Return title and description of a scenario, without building it."""
    table = _parse(_read(name_or_path)[1], str(name_or_path))
    return {key: read(table.get(key, ""), key) for key, read in TEXTS.items()}


@default_flags()
def load(name_or_path: str | pathlib.Path, overrides: Sequence[str] = (), *, integrated: bool = True) -> Scenario:
    """Return the scenario in a TOML file, or a packaged scenario, with overrides such as `controller.kp=4000`.

    Args:
        name_or_path: Name of a packaged scenario, such as `slip-lmi`, or path of a file, such as `mine.toml`.
        overrides: Texts `path=value`. A value is a TOML value; a bare word is a text, and `1,2` a list.
            `controller=relay` replaces the part.
        integrated: Also check that the step is stable for the loop.

    Raises:
        ScenarioError: The file cannot be read, a name is unknown, a value has the wrong type or is out of range, or the
            step is unstable. The message is one line.
    """
    name, raw = _read(name_or_path)
    folder = pathlib.Path() if str(name_or_path) in names() else pathlib.Path(name_or_path).parent
    return loads(raw, name, str(name_or_path), overrides, folder=folder, integrated=integrated)


@default_flags()
def loads(
    raw: bytes,
    name: str,
    origin: str,
    overrides: Sequence[str] = (),
    *,
    folder: pathlib.Path = pathlib.Path(),
    integrated: bool = True,
) -> Scenario:
    """Return the scenario in a TOML text.

    Args:
        raw: Text in UTF-8.
        name: Name of the scenario.
        origin: Name of the text, for messages.
        overrides: As in `load`.
        folder: Folder of the files that the text names.
        integrated: As in `load`.

    Raises:
        ScenarioError: As in `load`.
    """
    table = _parse(raw, origin)
    before = {family: type_name(table.get(family)) for family in FAMILIES}
    notes = [note for override in overrides if (note := _override(table, override))]
    _refuse(_without_inner(before, table))
    if overrides:
        # The texts of the file may be wrong for other values; a text that an override sets itself stays.
        overridden = {override.partition("=")[0].strip() for override in overrides}
        texts = {"title": make_printable(f"{name} with {', '.join(overrides)}"), "description": ""}
        table |= {key: text for key, text in texts.items() if key not in overridden}
    scenario = _assemble(name, table, folder, notes)
    loop_and_solver = (scenario.loop, scenario.solver)
    _refuse(find_mismatches(*loop_and_solver), find_unstable_step(*loop_and_solver) if integrated else ())
    return scenario


def _without_inner(before: Table, table: Table) -> Iterator[str]:
    """Yield a line for each section whose new part encloses another part that the override does not name."""
    for family, old in before.items():
        if type_name(table.get(family)) != old:
            yield from describe_missing_inner_parts(family, table.get(family), family)


def _refuse(*objections: Iterable[str]) -> None:
    """Raise ScenarioError with all lines of the first check that yields any; the checks after it do not run."""
    for lines in objections:
        errors = [re.sub(r"^plant\.road\b", "road", line) for line in lines]
        if errors:
            raise ScenarioError("; ".join(errors))


def _read(name_or_path: str | pathlib.Path) -> tuple[str, bytes]:
    if not str(name_or_path):
        raise ScenarioError("the name of the scenario is empty")
    path, quoted = pathlib.Path(name_or_path), format_given(str(name_or_path), MAX_PATH_LENGTH)
    if str(name_or_path) in names():
        file = importlib.resources.files("diffabs.scenario") / "scenarios" / f"{name_or_path}.toml"
        return str(name_or_path), file.read_bytes()
    try:
        if len(path.parts) == 1 and not path.suffix and not path.exists():
            raise unknown_name_error(f"no scenario and no file is called {quoted}", str(path), names())
        raw = files.read_content(path, MAX_SCENARIO_BYTES + 1)
    except (OSError, ValueError) as error:
        if isinstance(error, ScenarioError):
            raise
        why = getattr(error, "strerror", None) or str(error)
        raise ScenarioError(f"cannot read scenario {quoted}: {why}") from None
    if len(raw) > MAX_SCENARIO_BYTES:
        raise ScenarioError(f"{quoted} is larger than {MAX_SCENARIO_BYTES} bytes; it is no scenario")
    return make_printable(path.stem), raw


def _parse(raw: bytes, origin: str) -> JsonObject:
    quoted = format_given(origin, MAX_PATH_LENGTH)
    if len(raw) > MAX_WRITTEN_BYTES:
        raise ScenarioError(f"{quoted} is larger than {MAX_WRITTEN_BYTES} bytes; it is no scenario")
    try:
        return parameter_paths.to_canonical_form(toml.parse_toml(raw.decode("utf-8-sig")))
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise ScenarioError(f"{quoted} is not UTF-8 text (at line {line})") from None
    except ScenarioError as error:
        raise ScenarioError(f"{quoted} is not a scenario: {error}") from None
    except ValueError as error:
        raise ScenarioError(f"{quoted} is not TOML: {error}") from None


def _override(table: JsonObject, override: str) -> str:
    """Change the table by an override, and return a note on the entries that it removes; empty for none."""
    path, equals, text = override.partition("=")
    keys = path.strip().split(".")
    if not equals or not all(keys):
        raise ScenarioError(f"override {format_given(override)} is not of the form section.field=value")
    if len(keys) > toml.MOST_LEVELS:
        raise ScenarioError(f"override {format_given(override)} is nested more than {toml.MOST_LEVELS} deep")
    if any("\ud800" <= letter <= "\udfff" for letter in override):
        raise ScenarioError(f"override {format_given(override)} is not UTF-8 text")
    if keys[:2] == ["plant", "road"]:
        keys = keys[1:]
    keys = parameter_paths.join_path_keys(keys)
    node: Any = table
    for i, key in enumerate(keys[:-1]):
        place = _place(node, key, ".".join(keys[:i]))
        child = node[place] if isinstance(node, list) else node.get(place, {})
        child = {"type": child} if isinstance(child, str) else child
        if not isinstance(child, dict | list):
            raise ScenarioError(
                f"{'.'.join(keys[: i + 1])} = {format_given(child)} has no field {format_given(keys[i + 1])}"
            )
        node[place] = child
        node = child
    place = _place(node, keys[-1], ".".join(keys[:-1]))
    replaced = keys[:-1] if place == "type" else keys
    old_type = node.get("type", _usual_type(table, replaced)) if place == "type" else None
    if isinstance(place, str):
        # An override in m/s replaces a value in km/h and the reverse; both together would be given twice.
        alternative = place.removesuffix("_kmh") if place.endswith("_kmh") else f"{place}_kmh"
        node.pop(alternative, None)
    try:
        node[place] = toml.parse_value(text.strip())
    except ScenarioError as error:
        raise ScenarioError(f"override {format_given(override)}: {error}") from None
    parameter_paths.to_canonical_form(table)
    new = node[place]
    part = new.get("type") if isinstance(new, dict) else new
    is_replaced = isinstance(part, str) and part != old_type
    removed = parameter_paths.forget_replaced_part(table, ".".join(replaced)) if is_replaced else []
    if not removed:
        return ""
    return f"{'.'.join(keys)}={part} removes {', '.join(removed)} of the replaced part"


def _usual_type(table: JsonObject, keys: Sequence[str]) -> str | None:
    """Return the name of the part at a path of the loop before an override; None if there is none yet."""
    path = ".".join(["plant", *keys] if keys[:1] == ["road"] else keys)
    try:
        return name_of(family_of(keys[-1], keys[0]), get(_build_loop(table), path))
    except (ScenarioError, LookupError):
        return None


def _place(node: Any, key: str, path: str) -> Any:
    if isinstance(node, dict):
        return key
    numbers = [str(i) for i in range(len(node))]
    if key not in numbers:
        raise unknown_name_error(f"{path}.{key} is not there", key, numbers)
    return int(key)


def _assemble(name: str, table: JsonObject, folder: pathlib.Path, notes: Iterable[str]) -> Scenario:
    texts = {key: read(table.get(key, ""), key) for key, read in TEXTS.items()}
    solver, seed = section_solver.read_solver_section(table.get("solver", {}))
    section = table.get("objective", {})
    if not isinstance(section, dict):
        raise wrong_kind_error("objective", section, "a table of objectives")
    if len(section) > MAX_OBJECTIVES:
        raise ScenarioError(f"objective has {len(section)} entries, outside [0, {MAX_OBJECTIVES}]")
    loop = _build_loop(table)
    report = default_objectives(loop.plant)
    measured = {}
    for key, value in section.items():
        place = join_path("objective", read_printable_line(key, "a name in objective"))
        measured[key] = build_part("objective", value, report.get(key), place, units_of(loop.plant))
    objectives = {**report, **measured}
    # First: the sections below need valid parameters.
    named = {join_path("objective", key): objective for key, objective in objectives.items()}
    _refuse(_wrong_values(loop, objectives), find_misfits(loop, named))
    return Scenario(
        name=name,
        **texts,
        loop=loop,
        solver=solver,
        objectives=objectives,
        seed=seed,
        design=section_design.read_design_section(table.get("design", {}), loop),
        tune=section_tune.read_tune_section(table.get("tune", {}), loop, objectives),
        sweep=section_sweep.read_sweep_section(table.get("sweep", {}), loop, objectives, folder),
        assess=section_assess.read_assess_section(table.get("assess"), loop),
        notes=tuple(notes),
    )


def _build_loop(table: JsonObject) -> Loop:
    """Return the loop of a scenario, whose road has a section of its own."""
    sections = {key: value for key, value in table.items() if key not in OTHER_SECTIONS}
    if "road" in table:
        plant = sections.get("plant", {})
        plant = {"type": plant} if isinstance(plant, str) else plant
        sections["plant"] = {**plant, "road": table["road"]} if isinstance(plant, dict) else plant
    return build_loop(sections)


def _wrong_values(loop: Loop, objectives: Mapping[str, Objective]) -> Iterator[str]:
    """Yield the objections of the parts to their values."""
    yield from find_problems(loop)
    for name, objective in objectives.items():
        yield from find_problems(objective, f"{join_path('objective', name)}.", units_of(loop.plant))


def dump(scenario: Scenario) -> str:
    """Return TOML that loads back to the same scenario, with every field, and numbers at full precision.

    Args:
        scenario: Scenario to write.
    """
    parts = {field.name: as_plain(getattr(scenario.loop, field.name)) for field in dataclasses.fields(Loop)}
    sections = {name: part for name, part in parts.items() if isinstance(part, dict)}
    # A plant's usual part may be a tuple of parts. TOML has no form of an empty one, which `load` takes from the plant.
    lists = {name: part for name, part in parts.items() if name not in sections and part}
    if "road" in sections["plant"]:
        sections["road"] = sections["plant"].pop("road")
    sections["solver"] = section_solver.write_solver_section(scenario.solver, scenario.seed)
    sections["objective"] = as_plain(scenario.objectives)
    sections |= {name: getattr(scenario, name).table() for name in ("design", "tune", "sweep")}
    sections |= section_assess.write_assess_section(scenario.assess)
    return toml.write_toml({key: getattr(scenario, key) for key in TEXTS} | lists, sections)


def field_paths(scenario: Scenario) -> list[str]:
    """Return the paths of all fields of a scenario, as overrides name them, in the order of `dump`."""
    pending, paths = list(toml.parse_toml(dump(scenario)).items())[::-1], []
    while pending:
        path, value = pending.pop()
        if isinstance(value, dict):
            pending += [(f"{path}.{key}", item) for key, item in value.items()][::-1]
        else:
            paths.append(path)
    return paths
