"""The section [solver]: how a run is integrated, and the seed of its noise.

Where no type is given, a step or `kinks` make it fixed; otherwise, and with an rtol, steps are adaptive."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from diffabs.core.pytree import Spec
from diffabs.core.values import entry, members, ranged, read_one, switch, within
from diffabs.simulate.admissible import MAX_SOLVER_STEPS
from diffabs.simulate.solution import SOLVER_TYPES, Adaptive, FixedStep, Solver

TIME = Spec("s", low=0.0, open_low=True)
TOLERANCE = Spec("1", low=1e-12, high=0.01)


@dataclasses.dataclass(frozen=True)
class _Any:
    """What every solver has."""

    step: float = entry(ranged(TIME), FixedStep.step)
    duration: float = entry(ranged(TIME), FixedStep.duration)
    every: int = entry(within(1, int(MAX_SOLVER_STEPS)), FixedStep.every)
    seed: int = entry(within(0, 2**32 - 1), 0)


@dataclasses.dataclass(frozen=True)
class _Fixed(_Any):
    """Fixed steps."""

    kinks: bool | None = entry(switch, FixedStep.kinks)


@dataclasses.dataclass(frozen=True)
class _Adaptive(_Any):
    """Adaptive ones."""

    rtol: float = entry(ranged(TOLERANCE), Adaptive.rtol)


SECTIONS = {"fixed": _Fixed, "adaptive": _Adaptive}


def read(given: Any) -> tuple[Solver, int]:
    """Return solver and seed of a section. Raises ScenarioError."""
    table = {"type": _usual(given), **given} if isinstance(given, Mapping) else given
    found = read_one(SECTIONS, table, "solver")
    said = members(found)
    seed = said.pop("seed")
    kind = next(name for name, section in SECTIONS.items() if type(found) is section)
    return SOLVER_TYPES[kind](**said), seed


def _usual(given: Mapping[str, Any]) -> str:
    """The type that is meant where none is given."""
    return "fixed" if {"step", "kinks"} & given.keys() and "rtol" not in given else "adaptive"


def table(solver: Solver, seed: int) -> dict[str, Any]:
    """Return the section that is read so."""
    kind = next(name for name, one in SOLVER_TYPES.items() if type(solver) is one)
    said = {name: value for name, value in members(solver).items() if value is not None}
    return {"type": kind, **said, "seed": seed}
