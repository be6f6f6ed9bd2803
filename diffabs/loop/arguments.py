"""Arguments of a run: refusals, and the preparation for a compiled program."""

import functools
import logging
from collections.abc import Mapping

import jax

from diffabs.core import kinds
from diffabs.core.compiling import is_traced
from diffabs.core.first_order import without_derivative
from diffabs.core.protocols import Objective
from diffabs.core.pytree import canonical_dtypes, parameters, replace, stack_lists
from diffabs.core.types import Params, PyTree
from diffabs.core.validity import find_broken, find_misshapen, part_rules
from diffabs.engine.drive.runs import build_stepping
from diffabs.engine.solvers import Solver, find_solver_faults
from diffabs.loop.admissible import find_impossible_values, find_unstable_step, was_step_checked
from diffabs.loop.closed_loop import Loop
from diffabs.loop.contracts import refuse_misfits

log = logging.getLogger("diffabs")
OBJECTIVE_METHODS = ("start", "flow", "update", "value")  # methods of an objective
RESERVED_METRICS = ("", "stopped", "diverged", "timed_out")  # the plant's audit, and the end flags of a run


def prepare_arguments(loop: Loop, solver: Solver, objectives: Mapping[str, Objective]) -> tuple[Loop, PyTree, PyTree]:
    """Return loop, objectives and stepping method of one data type; invalid arguments are a ValueError (`refuse`).

    In a traced loop the derivative by a parameter that is not tunable raises an error (`forbid_derivatives`).
    """
    refuse(loop, solver, objectives)
    loop, objectives = canonical_dtypes(
        (stack_lists(loop), {name: stack_lists(part) for name, part in objectives.items()})
    )
    if is_traced(loop):
        # Only traced values can be differentiated.
        loop = replace(loop, forbid_derivatives(loop, {path: value for path, _, value in parameters(loop)}))
    return loop, objectives, build_stepping(solver, jax.tree.leaves(loop)[0].dtype)


def forbid_derivatives(loop: Loop, values: Params) -> dict[str, PyTree]:
    """Return the values of all parameters that are not tunable, wrapped so that their derivative raises a ValueError.

    A run does not depend smoothly on these parameters. Other values are left out.
    """
    coarse = {path for path, spec, _ in parameters(loop) if not spec.tunable}
    return {path: without_derivative(path, value) for path, value in values.items() if path in coarse}


def refuse(loop: Loop, solver: Solver, objectives: Mapping[str, Objective]) -> None:
    """Raise a ValueError for faults of solver, shapes, objectives and contracts, whatever the parameters' values."""
    if not isinstance(loop, Loop):
        raise ValueError(f"loop = {kinds.format_value(loop)} is no Loop; d.Loop(...) or d.braking() is needed")
    refuse_unnamed(objectives)
    lines = [*find_solver_faults(solver), *find_misshapen(loop)]
    for name, part in objectives.items():
        if isinstance(part, type):
            lines.append(f"objectives.{name} = {part.__name__} is a class; {part.__name__}(...) is needed")
        elif all(callable(getattr(part, method, None)) for method in OBJECTIVE_METHODS):
            lines += find_misshapen(part, f"objectives.{name}.")
        else:
            needed = ", ".join(OBJECTIVE_METHODS)
            lines.append(f"objectives.{name} = {kinds.format_value(part)} is no objective: it needs {needed}")
    if lines:
        raise ValueError("; ".join(lines))
    refuse_misfits(loop, objectives)


def refuse_unnamed(objectives: Mapping[str, Objective] | None) -> None:
    """Raise a ValueError for objectives that are no mapping by name, or with a name that a run uses itself."""
    named = isinstance(objectives, Mapping) and all(isinstance(name, str) for name in objectives)
    if objectives is not None and not named:
        text = kinds.format_value(objectives)
        raise ValueError(f'objectives = {text} is no mapping by name, such as {{"overshoot": Overshoot()}}')
    if reserved := [repr(name) for name in objectives or () if name in RESERVED_METRICS]:
        raise ValueError(f"objectives: no metric can be called {', '.join(reserved)}, like another value of a run")


def refuse_values(loop: Loop, solver: Solver, objectives: Mapping[str, Objective]) -> None:
    """Raise a ValueError as `refuse` does and, if all parameters are concrete, for impossible values or an unstable
    step.

    For traced parameters a warning says once that the step is not checked, unless it was for such a loop.
    """
    refuse(loop, solver, objectives)
    if is_traced(loop, dict(objectives)):
        if not was_step_checked(loop, solver):
            _warn_unchecked_step(f"{solver.step:g}")
        return
    lines = find_impossible_values(loop, solver.step)
    lines += [
        line for name, part in objectives.items() for line in find_broken(part_rules(part, f"objectives.{name}."))
    ]
    if lines := lines or list(find_unstable_step(loop, solver)):
        raise ValueError("; ".join(lines))


_warn_unchecked_step = functools.cache(
    functools.partial(
        log.warning,
        "solver.step = %s s is not checked for stability, because the loop is traced; d.check(loop, solver) checks it",
    )
)
