"""Admissibility of runs: the checks of a loop, its parts, its grid and its step before one run or a batch.

    check(loop, solver)                         raises for one loop, with its numbers
    batch_admissibility(loop, values, solver)   returns a code for each run of a batch, 0 for an accepted run

Both make the same checks in the same order. First come the ranges of fields and the rules between them (`rules`), then
the start against the stop, then the parts against the step. The stability of the step comes last, because it costs
most. Before all these, `check` looks at the shapes of fields; of a batch, `run_batch` looks at those of the first run.
"""

import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.arrays import as_array
from diffabs.core.compiling import QUICK_COMPILE_OPTIONS, compile_once, is_traced
from diffabs.core.jax_flags import default_flags
from diffabs.core.pytree import canonical_dtypes, replace
from diffabs.core.rules import Rule
from diffabs.core.types import Array, Params, Part, PyTree, Scalar
from diffabs.core.validity import check_part as check_parts
from diffabs.core.validity import find_broken, find_misshapen, grid_rules, part_rules
from diffabs.engine.solvers import Adaptive, Solver, find_solver_faults
from diffabs.loop.closed_loop import Loop
from diffabs.loop.contracts import refuse_misfits
from diffabs.loop.stability import is_step_stable, stable_step

T = TypeVar("T")


class Admissibility(NamedTuple):
    """Result of the checks of a batch: for each run the reason for its refusal, if any.

    Attributes:
        codes: Code of each run, shape (runs,). Code 0 is an accepted run.
        reasons: Reason for each code, by index; empty for code 0.
    """

    codes: np.ndarray
    reasons: tuple[str, ...]

    @property
    def accepted(self) -> np.ndarray:
        """True for each accepted run, shape (runs,)."""
        return self.codes == 0

    @property
    def texts(self) -> np.ndarray:
        """Reason for the refusal of each run, shape (runs,); empty for an accepted run."""
        return np.array(self.reasons)[self.codes]

    @property
    def number(self) -> int:
        """Number of refused runs."""
        return int(np.count_nonzero(self.codes))


@default_flags()
def check(part: T, solver: Solver | None = None) -> T:
    """Return the part itself if its parameters are in their ranges and, with a solver, if the loop may be run.

    Args:
        part: Part or loop, with concrete parameters.
        solver: Solver. If it is given and the part is a loop, the function also checks start, duration, periods and
            step. Otherwise it has no effect.

    Raises:
        ValueError: A field has a wrong shape, is out of range, or breaks a rule between fields. For a loop with a
            solver also: a part does not fit its contract, or the start is beyond the stop. An invalid solver
            (`find_solver_faults`), a period off the grid and an unstable step raise it, too. The message gives each
            value with its range and unit. A later check runs only if the earlier ones have passed.
    """
    if lines := list(find_misshapen(part)):
        raise ValueError("; ".join(lines))
    check_parts(part)
    if isinstance(part, Loop) and solver is not None:
        refuse_misfits(part, {})
        if lines := list(find_mismatches(part, solver)) or list(find_unstable_step(part, solver)):
            raise ValueError("; ".join(lines))
    return part


def find_impossible_values(loop: Loop, step: float) -> list[str]:
    """Return one line for each value of a loop that no run may have; an empty list if all are allowed.

    Three groups are checked in order: ranges and rules of the parts, the start against the stop, the parts against the
    step of the grid [s]. The lines are those of the first group with a fault.
    """
    groups = part_rules(loop), [_start_rule(loop)], grid_rules(loop, step)
    return next(filter(None, map(list, map(find_broken, groups))), [])


def find_mismatches(loop: Loop, solver: Solver) -> Iterator[str]:
    """Yield one line for each mismatch between start and stop, or between the parts and the step.

    Three groups are checked in order: the start against the stop, the solver itself, the parts against the step. The
    lines are those of the first group with a fault.
    """
    lines = list(find_broken([_start_rule(loop)]))
    yield from lines or find_solver_faults(solver) or find_broken(grid_rules(loop, solver.step))


def find_unstable_step(loop: Loop, solver: Solver) -> Iterator[str]:
    """Yield one line if the step is too long for the loop. An `Adaptive` solver finds its own steps: nothing."""
    if isinstance(solver, Adaptive):
        return
    largest, end = stable_step(loop), getattr(loop.stop, "speed", None)
    where = "" if end is None else f", between the initial speed and {end:g} m/s,"
    if solver.step > largest:
        digit = 10.0 ** (math.floor(math.log10(largest)) - 2)
        largest = math.floor(largest / digit) * digit  # rounded down: the printed step must be stable, too
        yield (
            f"solver.step = {solver.step:g} s is not stable: RK4 follows the fastest mode of this loop"
            f"{where} only with steps in (0, {largest:.3g}] s"
        )
    else:
        _stable_steps.add((jax.tree.structure(loop), float(solver.step)))


_stable_steps: set[tuple[PyTree, float]] = set()  # structures of loops, with steps that were stable for such a loop


def was_step_checked(loop: Loop, solver: Solver) -> bool:
    """Return True if the step was found stable for a loop of this structure, or the solver finds its own steps."""
    return isinstance(solver, Adaptive) or (jax.tree.structure(loop), float(solver.step)) in _stable_steps


def batch_admissibility(loop: Loop | None, values: object, solver: Solver) -> Admissibility:
    """Make the checks of `check` for each run of a batch, and return a code for each run instead of an error.

    One compiled program checks all runs. A code stands for the first check that a run fails. Without a common loop,
    `values` is a batch of loops whose leaves have a leading axis (runs,).
    """
    if lines := find_solver_faults(solver):
        raise ValueError(lines[0])
    step = float(solver.step)  # an array could be no static argument
    values = {path: np.asarray(x, float) for path, x in values.items()} if isinstance(values, Mapping) else values
    loop, values = jax.tree.map(lambda x: np.asarray(x, float), (loop, values))
    with jax.enable_x64(True):
        arguments = jax.tree.map(lambda x: x if np.ndim(x) else as_array(float(x), x.dtype), (loop, values))
        # Double precision: single precision could round a value across the end of its range.
        codes = np.array(_codes(*arguments, step=step))
    # Only accepted runs need the costly stability check. `np.resize` repeats them up to the batch's size, so that
    # the compiled program keeps its shapes.
    if not codes.all() and not isinstance(solver, Adaptive):
        good = np.flatnonzero(codes == 0)
        lanes = values if len(good) == len(codes) else jax.tree.map(lambda x: x[np.resize(good, len(codes))], values)
        codes[good[~is_step_stable(loop, lanes, step)[: len(good)]]] = -1
    return _name_reasons(loop, values, step, codes)


def _name_reasons(loop: Loop | None, values: object, step: float, codes: np.ndarray) -> Admissibility:
    """Return the codes renumbered to the reasons that occur; code -1 is an unstable step."""
    present = [code for code in np.unique(codes).tolist() if code] if codes.any() else []
    named = {-1: f"solver.step = {step:g} s is not stable"}
    if any(code > 0 for code in present):
        with jax.enable_x64(True):
            first = _lane(loop, jax.tree.map(lambda x: x[0], values))
            named |= {i: rule.broken for i, rule in enumerate(_rules(first, step), 1)}
    numbers = np.select([codes == code for code in present], range(1, len(present) + 1), 0) if present else codes
    return Admissibility(numbers, ("", *(named[code] for code in present)))


def first_refusal(loop: Loop, values: Params, solver: Solver) -> str | None:
    """Return a text about the first refused run and its reasons, with their numbers; None if all runs are accepted.

    A semicolon separates two reasons. Without values the loop is the only run.
    """
    where, lane, why = "", loop, ""
    if values:
        checks = batch_admissibility(loop, values, solver)
        if not checks.number:
            return None
        i = int(np.flatnonzero(checks.codes)[0])
        lane = replace(loop, {path: np.asarray(column)[i] for path, column in values.items()})
        where, why = f"lane {i}: ", checks.texts[i]
    try:
        check(lane, solver)
    except ValueError as error:
        why = str(error)
    return f"{where}{why}" if why else None


def _lane(loop: Loop | None, values: PyTree) -> Loop:
    """Return the loop of one run: the common loop with the run's values or, without a common loop, `values` itself."""
    return values if loop is None else replace(loop, values)


def _rules(loop: Loop, step: float) -> Iterator[Rule]:
    """Yield every rule but the stability of the step, in the order of `check`."""
    yield from part_rules(loop)
    yield _start_rule(loop)
    yield from grid_rules(loop, step)


@partial(jax.jit, static_argnames="step")
def _codes(loop: Loop | None, values: object, *, step: float) -> Scalar:
    """Return the number of the first broken rule of each run, from 1, shape (runs,); 0 if no rule is broken."""

    def code(values: object) -> Array:
        holds = jnp.stack([jnp.asarray(rule.holds) for rule in _rules(canonical_dtypes(_lane(loop, values)), step)])
        return jnp.where(jnp.all(holds), 0, 1 + jnp.argmin(holds))  # argmin finds the first False

    return jax.vmap(code)(values)


# One compiled program: the operations one by one would each cost as much as the whole function.
@compile_once(options=QUICK_COMPILE_OPTIONS)
def _margin(plant: Part, initial: Part, stop: Part) -> jax.Array:
    """Return the margin of the stop at the start."""
    return stop.margin(plant.output(plant.start(initial)))


def _start_rule(loop: Loop) -> Rule:
    """Return the rule that a run starts before its stop: the stop's margin is positive there.

    If start and stop both have a `speed`, that of the start must also be the greater one.
    """
    after = ": the run would end before it starts"
    # Arrays instead of Python numbers: a Python number overflows with an OverflowError, an array becomes infinite.
    margin = _margin(*canonical_dtypes((loop.plant, loop.initial, loop.stop)))
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
