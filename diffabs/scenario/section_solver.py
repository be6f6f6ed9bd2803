"""The section [solver] of a scenario: the integration of a run, and the seed of its noise.

Without a type, `step` or `kinks` select fixed steps. Otherwise, and always with `rtol`, steps are adaptive.
"""

import dataclasses
from collections.abc import Mapping

from diffabs.core.pytree import ParameterSpec
from diffabs.core.types import JsonObject
from diffabs.engine.solvers import MAX_SOLVER_STEPS, SOLVER_TYPES, Adaptive, FixedStep, Solver
from diffabs.host.values import plain_fields, range_reader, read_one, read_switch, table_field, whole_reader

TIME_SPEC = ParameterSpec("s", low=0.0, open_low=True)
TOLERANCE_SPEC = ParameterSpec("1", low=1e-12, high=0.01)


@dataclasses.dataclass(frozen=True)
class _Any:
    """Fields of every solver."""

    step: float = table_field(range_reader(TIME_SPEC), FixedStep.step)
    duration: float = table_field(range_reader(TIME_SPEC), FixedStep.duration)
    every: int = table_field(whole_reader(1, int(MAX_SOLVER_STEPS)), FixedStep.every)
    follow_slides: bool = table_field(read_switch, False)
    seed: int = table_field(whole_reader(0, 2**32 - 1), 0)


@dataclasses.dataclass(frozen=True)
class _Fixed(_Any):
    """Fields of fixed steps."""

    kinks: bool | None = table_field(read_switch, FixedStep.kinks)


@dataclasses.dataclass(frozen=True)
class _Adaptive(_Any):
    """Fields of adaptive steps."""

    rtol: float = table_field(range_reader(TOLERANCE_SPEC), Adaptive.rtol)


SECTIONS = {"fixed": _Fixed, "adaptive": _Adaptive}


def read_solver_section(table: object) -> tuple[Solver, int]:
    """Return solver and seed of a section."""
    if isinstance(table, Mapping):
        fixed = {"step", "kinks"} & table.keys() and "rtol" not in table
        table = {"type": "fixed" if fixed else "adaptive", **table}
    settings = read_one(SECTIONS, table, "solver")
    fields = plain_fields(settings)
    seed = fields.pop("seed")
    kind = next(name for name, section in SECTIONS.items() if type(settings) is section)
    return SOLVER_TYPES[kind](**fields), seed


def write_solver_section(solver: Solver, seed: int) -> JsonObject:
    """Return the section that `read_solver_section` reads back to the same solver and seed."""
    kind = next(name for name, cls in SOLVER_TYPES.items() if type(solver) is cls)
    fields = {name: value for name, value in plain_fields(solver).items() if value is not None}
    if not solver.follow_slides:
        del fields["follow_slides"]
    return {"type": kind, **fields, "seed": seed}
