"""Arguments of a run: refusals, and the preparation for a compiled program."""

import functools
import logging
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from diffabs.core import kinds
from diffabs.core.arrays import as_array
from diffabs.core.compiling import is_traced
from diffabs.core.first_order import without_derivative
from diffabs.core.loop import Loop
from diffabs.core.protocols import Objective
from diffabs.core.pytree import canonical_dtypes, parameters, replace, stack_lists
from diffabs.core.types import Params, PyTree
from diffabs.core.validity import find_broken, find_misshapen, part_rules
from diffabs.objectives import Variation
from diffabs.simulate.admissible import (
    find_impossible_values,
    find_solver_faults,
    find_unstable_step,
    was_step_checked,
)
from diffabs.simulate.contracts import refuse_misfits
from diffabs.simulate.step.adaptive import AdaptiveStepping, clip_rtol
from diffabs.simulate.step.fixed import FixedStepping
from diffabs.simulate.types import Adaptive, Solver

log = logging.getLogger("diffabs")
OBJECTIVE_METHODS = ("start", "flow", "update", "value")  # methods of an objective
RESERVED_METRICS = ("", "stopped", "diverged", "timed_out")  # the plant's audit, and the end flags of a run


def prepare_arguments(loop: Loop, solver: Solver, objectives: Mapping[str, Objective]) -> tuple[Loop, PyTree, PyTree]:
    """Return loop, objectives and stepping method of one data type.

    In a traced loop the derivative by a parameter that is not tunable raises an error (`forbid_derivatives`).

    Args:
        loop: Closed loop with every part and parameter.
        solver: Solver of the run.
        objectives: Objectives by the names of their metrics.

    Raises:
        ValueError: An argument is invalid, apart from the values of parameters.
    """
    refuse(loop, solver, objectives)
    loop, objectives = canonical_dtypes(
        (stack_lists(loop), {name: stack_lists(part) for name, part in objectives.items()})
    )
    if is_traced(loop):
        # Only traced values can be differentiated.
        loop = replace(loop, forbid_derivatives(loop, {path: value for path, _, value in parameters(loop)}))
    return loop, objectives, build_stepping(solver, jax.tree.leaves(loop)[0].dtype)


def build_stepping(solver: Solver, dtype: DTypeLike) -> FixedStepping | AdaptiveStepping:
    """Return the stepping method of a solver, with numbers of one data type: a pytree, for compiled programs.

    Args:
        solver: Solver of the run.
        dtype: Floating-point type.
    """
    number = jnp.asarray if is_traced() else as_array
    # `device_put` instead of `jnp.asarray`, which would compile a program.
    h, steps = number(float(solver.step), dtype), jax.device_put(solver.steps)
    if isinstance(solver, Adaptive):
        return AdaptiveStepping(h, steps, number(float(clip_rtol(np.asarray(solver.rtol, dtype))), dtype))
    return FixedStepping(h, steps, solver.kinks)


def forbid_derivatives(loop: Loop, values: Params) -> dict[str, PyTree]:
    """Return the values of all parameters that are not tunable, wrapped so that their derivative raises a ValueError.

    A run does not depend smoothly on these parameters. Other values are left out.

    Args:
        loop: Closed loop that specifies the parameters.
        values: Values by dotted path.
    """
    coarse = {path for path, spec, _ in parameters(loop) if not spec.tunable}
    return {path: without_derivative(path, value) for path, value in values.items() if path in coarse}


def refuse(loop: Loop, solver: Solver, objectives: Mapping[str, Objective]) -> None:
    """Check solver, shapes, objectives and contracts of a run, independent of the parameters' values.

    Args:
        loop: Closed loop.
        solver: Solver of the run.
        objectives: Objectives by the names of their metrics.

    Raises:
        ValueError: An argument has a wrong type, a field of the solver is invalid, or a parameter has a wrong shape.
            Also if a part is not an objective, or does not fit its contract (`find_misfits`).
    """
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
    """Check that objectives have names.

    Args:
        objectives: Objectives by the names of their metrics, or None.

    Raises:
        ValueError: The objectives are no mapping, or a name is no text, empty, or that of an end flag of a run.
    """
    named = isinstance(objectives, Mapping) and all(isinstance(name, str) for name in objectives)
    if objectives is not None and not named:
        given = kinds.format_value(objectives)
        raise ValueError(f'objectives = {given} is no mapping by name, such as {{"overshoot": Overshoot()}}')
    if taken := [repr(name) for name in objectives or () if name in RESERVED_METRICS]:
        raise ValueError(f"objectives: no metric can be called {', '.join(taken)}, like another value of a run")


def refuse_values(loop: Loop, solver: Solver, objectives: Mapping[str, Objective]) -> None:
    """Check a run as `refuse` does and, if all parameters are concrete, their values.

    For traced parameters a warning says once that the step is not checked, unless it was for such a loop.

    Args:
        loop: Closed loop.
        solver: Solver of the run.
        objectives: Objectives by the names of their metrics.

    Raises:
        ValueError: An argument is invalid, or a concrete parameter has a value that no run may have. Also if the
            step is not stable.
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


def refuse_derivative(loop: Loop, objectives: Mapping[str, Objective], method: PyTree) -> None:
    """Check that the objectives of a run have right derivatives.

    Wrong is only the derivative of a `Variation` behind a pure delay with adaptive steps.

    Args:
        loop: Closed loop.
        objectives: Objectives by the names of their metrics.
        method: Stepping method.

    Raises:
        ValueError: The derivative of an objective would be wrong.
    """
    if isinstance(method, AdaptiveStepping) and loop.recorders:
        # Rounding moves the kinks of the delayed command between the logged run and its replay.
        names = [name for name, one in objectives.items() if isinstance(one, Variation)]
        if names:
            raise ValueError(
                f"{', '.join(names)}: Variation has no derivative behind a pure delay with adaptive steps. Leave it"
                " out, or use d.FixedStep"
            )
