"""What must not be run: a loop that its parts, the integration grid or its step do not allow, alone or in a batch.

    check(loop, solver)                         raises for one loop, with its numbers
    batch_admissibility(loop, values, solver)   a code for every lane of a batch, 0 where it is accepted

Both ask the same things in the same order: ranges of fields and rules between them (`rules`), the start against the
stop, the parts against the step, and last whether the step is stable, which is the dearest question."""

import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.arrays import as_array
from diffabs.core.compiling import QUICK_COMPILE_OPTIONS, compile_once, is_traced
from diffabs.core.loop import Loop
from diffabs.core.pytree import canonical_dtypes, replace
from diffabs.core.rules import Rule
from diffabs.core.validity import check_part as check_parts
from diffabs.core.validity import find_broken, grid_rules, part_rules
from diffabs.simulate.solution import Adaptive, Solver
from diffabs.simulate.stable_step import is_step_stable, stable_step

MAX_SOLVER_STEPS = 1e8
T = TypeVar("T")


class Admissibility(NamedTuple):
    """Which lanes must not run: a code for each (lanes,), and what the codes mean; code 0 is accepted."""

    codes: np.ndarray
    reasons: tuple[str, ...]

    @property
    def accepted(self) -> np.ndarray:
        """Which lanes may run (lanes,)."""
        return self.codes == 0

    @property
    def texts(self) -> np.ndarray:
        """The reason of each lane (lanes,), empty where it is accepted."""
        return np.array(self.reasons)[self.codes]

    @property
    def number(self) -> int:
        """How many lanes are refused."""
        return int(np.count_nonzero(self.codes))


def check(part: T, solver: Solver | None = None) -> T:
    """The part itself if its parameters are in their ranges; with a solver, if this loop may be run with it, too.

    Raises:
        ValueError: names every offending field with its value, range and unit; a start beyond the stop; a period off
            the grid; a step that is not stable.
    """
    check_parts(part)
    if isinstance(part, Loop) and solver is not None:
        for lines in (find_mismatches(part, solver), find_unstable_step(part, solver)):
            if found := list(lines):
                raise ValueError("; ".join(found))
    return part


def find_impossible_values(loop: Loop, step: float) -> list[str]:
    """A line for each value of a loop that no run may have, alone or on a grid of this step [s]."""
    begun = _start_rule(loop)
    return (
        list(find_broken(part_rules(loop)))
        or ([] if begun.holds else [begun.says()])
        or list(find_broken(grid_rules(loop, step)))
    )


def find_mismatches(loop: Loop, solver: Solver) -> Iterator[str]:
    """What does not go together: start and stop, parts and step; a line each."""
    begun = _start_rule(loop)
    if not begun.holds:
        yield begun.says()
        return
    yield from find_solver_faults(solver) or find_broken(grid_rules(loop, solver.step))


def find_solver_faults(solver: Solver) -> list[str]:
    """What is wrong with the solver itself, whatever it integrates."""
    step, duration = solver.step, solver.duration
    if step > duration:
        return [f"solver.step = {step:g} s is outside (0, {duration:g}] s: longer than solver.duration"]
    if duration / step > MAX_SOLVER_STEPS:
        least = duration / MAX_SOLVER_STEPS
        return [f"solver.step = {step:g} s is outside [{least:g}, {duration:g}] s: too many steps"]
    return []


def find_unstable_step(loop: Loop, solver: Solver) -> Iterator[str]:
    """A line for a step that is too long for the loop; `Adaptive` finds its steps by itself."""
    if isinstance(solver, Adaptive):
        return
    largest, end = stable_step(loop), getattr(loop.stop, "speed", None)
    where = "" if end is None else f", between the initial speed and {end:g} m/s,"
    if solver.step > largest:
        digit = 10.0 ** (math.floor(math.log10(largest)) - 2)
        largest = math.floor(largest / digit) * digit  # what is printed must be stable too
        yield (
            f"solver.step = {solver.step:g} s is not stable: RK4 follows the fastest mode of this loop"
            f"{where} only with steps in (0, {largest:.3g}] s"
        )


def batch_admissibility(loop: Loop | None, values: Any, solver: Solver) -> Admissibility:
    """The lanes of a loop that differ in the values (lanes,) at these paths: what `check` says of each, in one compiled
    call for all. Without a loop (None) `values` is a batch of loops, whose leaves have a leading axis.

    Raises ValueError for a solver that is wrong whatever it integrates."""
    if lines := find_solver_faults(solver):
        raise ValueError(lines[0])
    values = {path: np.asarray(x, float) for path, x in values.items()} if isinstance(values, Mapping) else values
    loop, values = jax.tree.map(lambda x: np.asarray(x, float), (loop, values))
    with jax.enable_x64(True):
        known = jax.tree.map(lambda x: x if np.ndim(x) else as_array(float(x), x.dtype), (loop, values))
        codes = np.array(_codes(*known, step=solver.step))
    if not codes.all() and not isinstance(solver, Adaptive):
        fine = np.flatnonzero(codes == 0)
        asked = values if len(fine) == len(codes) else jax.tree.map(lambda x: x[np.resize(fine, len(codes))], values)
        codes[fine[~is_step_stable(loop, asked, solver.step)[: len(fine)]]] = -1
    return _name_reasons(loop, values, solver.step, codes)


def _name_reasons(loop: Loop | None, values: Any, step: float, codes: np.ndarray) -> Admissibility:
    """Only those reasons that occur; -1 is the step's."""
    there = [code for code in np.unique(codes).tolist() if code] if codes.any() else []
    named = {-1: f"solver.step = {step:g} s is not stable"}
    if any(code > 0 for code in there):
        with jax.enable_x64(True):
            first = _lane(loop, jax.tree.map(lambda x: x[0], values))
            named |= {i: rule.broken for i, rule in enumerate(_rules(first, step), 1)}
    numbers = np.select([codes == code for code in there], range(1, len(there) + 1), 0) if there else codes
    return Admissibility(numbers, ("", *(named[code] for code in there)))


def first_refusal(loop: Loop, values: Mapping[str, Any], solver: Solver) -> str | None:
    """The first refused lane and why, in a line with its numbers; None if all lanes are accepted. Without values the
    loop is the lane."""
    if not values:
        lines = [*find_broken(part_rules(loop)), *find_mismatches(loop, solver)] or list(
            find_unstable_step(loop, solver)
        )
        return "; ".join(lines) or None
    found = batch_admissibility(loop, values, solver)
    if not found.number:
        return None
    i = int(np.flatnonzero(found.codes)[0])
    lane = replace(loop, {path: np.asarray(column)[i] for path, column in values.items()})
    try:
        check(lane, solver)
        why = found.texts[i]
    except ValueError as error:
        why = str(error)
    return f"lane {i}: {why}"


def _lane(loop: Loop | None, values: Any) -> Loop:
    return values if loop is None else replace(loop, values)


def _rules(loop: Loop, step: float) -> Iterator[Rule]:
    """Everything but the stability, in the order of `check`."""
    yield from part_rules(loop)
    yield _start_rule(loop)
    yield from grid_rules(loop, step)


@partial(jax.jit, static_argnames="step")
def _codes(loop: Loop | None, values: Any, *, step: float) -> Any:
    """The number of the first broken rule of each lane, from 1; 0 for none (lanes,)."""

    def code(values: Any) -> Any:
        holds = jnp.stack([jnp.asarray(rule.holds) for rule in _rules(canonical_dtypes(_lane(loop, values)), step)])
        return jnp.where(jnp.all(holds), 0, 1 + jnp.argmin(holds))

    return jax.vmap(code)(values)


@compile_once(options=QUICK_COMPILE_OPTIONS)
def _margin(plant: Any, initial: Any, stop: Any) -> jax.Array:
    """The margin of the stop at the start. Compiled as one: each operation by itself costs as much as all of them."""
    return stop.margin(plant.output(plant.start(initial)))


def _start_rule(loop: Loop) -> Rule:
    """A run starts on this side of its stop."""
    after = ": the run would end before it starts"
    margin = _margin(
        *canonical_dtypes((loop.plant, loop.initial, loop.stop))
    )  # a number of Python raises OverflowError
    margin = margin if is_traced(margin) else np.asarray(margin)
    start, end = (getattr(part, "speed", None) for part in (loop.initial, loop.stop))
    if start is None or end is None:
        line = f"initial is at the stop or beyond{after}"
        return Rule(margin > 0, line, lambda: line)
    return Rule(
        (margin > 0) & (start > end),
        f"initial.speed is not above stop.speed{after}",
        lambda: f"initial.speed = {start:g} m/s is not above stop.speed = {end:g} m/s{after}",
    )
