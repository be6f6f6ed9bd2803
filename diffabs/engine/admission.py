"""Admission of a field to `solve`: its arguments as a `FieldSystem`, or a ValueError that names what is wrong."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jax._src.source_info_util import summarize  # JAX has no public function that names the line of an operation
from jax.core import Tracer
from jax.sharding import AbstractMesh, Mesh
from jax.typing import DTypeLike

from diffabs.core import kinds
from diffabs.core.pytree import canonical_dtypes
from diffabs.core.types import AnyArray, Array, PyTree, Scalar
from diffabs.engine.drive.runs import build_stepping
from diffabs.engine.field import Event, Field, FieldCode, FieldSystem, Function, Saves
from diffabs.engine.solvers import Adaptive, FixedStep, find_solver_faults
from diffabs.engine.step.adaptive import AdaptiveStepping
from diffabs.engine.step.comparisons import SwitchedProgram
from diffabs.engine.step.fixed import FixedStepping
from diffabs.engine.step.inner_functions import HOST_CALLS
from diffabs.engine.step.switching import WatchedModes
from diffabs.engine.step.system import build_system

MAX_TIME_LOSS = 1e-4  # rounding of t0 and t1, as a fraction of the span
# By the function that hides a comparison: what to write instead.
REFUSAL_ADVICE = (
    (("scan",), "Write the loop as a loop of Python, or compare before it"),
    (("while",), "Write a fixed number of turns as a loop of Python, or compare before it"),
    (("custom_jvp_call", "custom_vjp_call"), "Compare outside of the function, or leave out its derivative rule"),
    (HOST_CALLS, "Write the function in JAX"),
    ((), "Compare outside of the function"),
)


def build_field(
    field: Field,
    y0: object,
    t0: Array,
    t1: Scalar,
    args: object,
    events: tuple[Event, ...],
    save: AnyArray | None,
    times_per_event: int,
) -> tuple[Any, Saves | None]:
    """Return the field as a `FieldSystem`, and the objective of the times `save`."""
    _read_times(t0, t1, save)
    _refuse_leaves("y0", y0)
    for path, leaf in jax.tree_util.tree_leaves_with_path(args):
        try:
            jax.typeof(leaf)
        except TypeError:
            place = jax.tree_util.keystr(path)
            raise ValueError(f"args{place} = {kinds.format_value(leaf)} is no number or array") from None
    save = jnp.asarray(save) if isinstance(save, list | tuple) else save
    y0, t0, t1, save = canonical_dtypes((y0, t0, t1, save))
    if not jax.tree.leaves(y0):
        raise ValueError("y0 has no number; a state of at least one is needed")
    if not has_tracer(t0, t1):
        start, end, eps = float(t0), float(t1), float(jnp.finfo(t0.dtype).eps)
        if eps * max(abs(start), abs(end)) > MAX_TIME_LOSS * abs(end - start):
            raise ValueError(
                f"t1 - t0 is lost in the rounding of t0 = {start:.10g} and t1 = {end:.10g} as {t0.dtype}: shift the"
                ' time, or call jax.config.update("jax_enable_x64", True)'
            )
    dynamics, event_functions, constants = _read_functions(field, events, t0, y0, args)
    inputs = {"y0": y0, "t0": t0, "t1": t1, "args": args, "constants": constants}
    system = FieldSystem(inputs=inputs, code=FieldCode(dynamics, event_functions), times_per_event=times_per_event)
    return system, None if save is None else _place_saves(save, t0, t1)


def _place_saves(save: AnyArray, t0: Scalar, t1: Scalar) -> Saves:
    """Return the objective of the times `save`; an empty span has only its end."""
    empty = t1 == t0
    at_end = jnp.where(save == t0, 1.0, jnp.nan)
    return Saves(places=jnp.where(empty, at_end, (save - t0) / jnp.where(empty, 1.0, t1 - t0)), times=jnp.asarray(save))


def trace_field(system: FieldSystem) -> SwitchedProgram:
    """Return the program of the field, or raise a ValueError for a switch that no step can end on."""
    program = build_system(system, {}, jnp.zeros_like(system.inputs["t0"]), system.start(), {}, switched=True).program
    assert program is not None
    for worst in program.hidden:
        advice = next((text for names, text in REFUSAL_ADVICE if worst.function in names), REFUSAL_ADVICE[-1][1])
        raise ValueError(
            f"field has the comparison '{worst.name}' within '{worst.function}' at {summarize(worst.source)}: no step"
            f" can end where its answer changes. {advice}"
        )
    for worst in program.jumps:
        raise ValueError(
            f"field has the operation '{worst.name}' at {summarize(worst.source)}: its result jumps or bends where no"
            " comparison changes, so that no step can end there. Write it as comparisons, or as a state that an event"
            " resets"
        )
    return program


def _read_times(t0: Scalar, t1: Scalar, save: AnyArray | None) -> None:
    """Raise a ValueError for an invalid time of a solution, as far as the times are concrete."""
    for name, x, rank in (("t0", t0, 0), ("t1", t1, 0), ("save", save, 1)):
        if x is None:
            continue
        if line := kinds.find_value_objection(x):
            raise ValueError(f"{name} = {kinds.format_value(x)} {line}; a time is needed")
        if len(kinds.value_shape(x)) != rank:
            needed = "a list of times" if rank else "one time"
            raise ValueError(f"{name} has shape {kinds.value_shape(x)}; {needed} is needed")
        if not has_tracer(x) and not np.all(np.isfinite(np.asarray(x, float))):
            raise ValueError(f"{name} = {kinds.format_value(x)} is not finite")
    if has_tracer(t0, t1):
        return
    if t0 == t1:
        raise ValueError(f"t1 = {t1} is equal to t0; another time is needed")
    if save is not None and not has_tracer(save):
        low, high = sorted((float(t0), float(t1)))
        outside = [x for x in np.asarray(save, float) if not low <= x <= high]
        if outside:
            raise ValueError(f"save has {outside[0]}; times in [{low:g}, {high:g}] are possible")


def _refuse_leaves(name: str, tree: object) -> None:
    """Raise a ValueError for a leaf that is no real number or array of numbers."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if line := kinds.find_value_objection(leaf):
            raise ValueError(
                f"{name}{jax.tree_util.keystr(path)} = {kinds.format_value(leaf)} {line}; a number is needed"
            )


def read_solver(
    solver: object, t0: Scalar, t1: Scalar, dtype: DTypeLike
) -> tuple[FixedStepping | AdaptiveStepping, int]:
    """Return the stepping method in units of the span, and the number of its steps."""
    count = 1
    if isinstance(solver, Adaptive):
        solver = dataclasses.replace(solver, step=1.0, duration=1.0, every=1)
    elif not isinstance(solver, FixedStep):
        raise ValueError(f"solver = {kinds.format_value(solver)} is no solver; d.FixedStep or d.Adaptive is needed")
    elif has_tracer(t0, t1):
        raise ValueError("t0 or t1 is traced: d.FixedStep must know the number of its steps; d.Adaptive need not")
    elif solver.kinks is False:
        raise ValueError("solver.kinks = False: d.solve locates all switches; leave it out")
    else:
        solver = dataclasses.replace(solver, duration=abs(float(t1) - float(t0)), every=1)
    if lines := find_solver_faults(solver):
        raise ValueError("; ".join(lines).replace("solver.duration =", "t1 - t0 ="))
    if isinstance(solver, FixedStep):
        count = solver.steps
        solver = FixedStep(1.0 / count, 1.0, kinks=True, follow_slides=solver.follow_slides)
    return dataclasses.replace(build_stepping(solver, dtype), switches=WatchedModes(solver.follow_slides)), count


def _read_functions(
    field: Field, events: Sequence[Event], t: Scalar, y: PyTree, args: PyTree
) -> tuple[Function, tuple[Event, ...], list[PyTree]]:
    """Return the field, the events, and the traced constants of their functions."""
    constants: list[PyTree] = []

    def read(function: Any, name: str, like: PyTree) -> Function:
        if not callable(function):
            raise ValueError(f"{name} = {kinds.format_value(function)} is no function of (t, y, args)")
        # What a function closes over may have changed. A new wrapper makes JAX trace it again.
        program, shapes = jax.make_jaxpr(lambda *inputs: function(*inputs), return_shape=True)(t, y, args)
        _check_result(name, shapes, like)
        traced = any(map(has_tracer, program.consts))
        hidden: list[Any] = []
        key = _describe_program(program, [jax.typeof(x) if traced else x for x in program.consts], hidden)
        if hidden:  # a derivative rule, which shows neither its operations nor its tracers
            key = key, object() if traced else _hashable(function)
        if not traced:
            return Function(key, function)

        # The compiled programs of the engine know no tracer from outside: the closure becomes an argument.
        def call(t: Scalar, y: PyTree, args: PyTree, closure: PyTree) -> PyTree:
            run = jex.jaxpr_as_fun(jex.ClosedJaxpr(program.jaxpr, closure))
            return jax.tree.unflatten(jax.tree.structure(shapes), run(*jax.tree.leaves((t, y, args))))

        constants.append(list(program.consts))
        return Function(key, call, len(constants) - 1)

    dynamics, event_functions = read(field, "field", y), []
    for i, event in enumerate(events):
        if not isinstance(event, Event):
            raise ValueError(f"events.{i} = {kinds.format_value(event)} is no d.Event")
        if event.terminal and event.reset is not None:
            raise ValueError(f"events.{i} is terminal and has a reset; a terminal event has none")
        condition = read(event.condition, f"events.{i}.condition", t)
        reset = None if event.reset is None else read(event.reset, f"events.{i}.reset", y)
        event_functions.append(Event(condition, reset, event.terminal))
    return dynamics, tuple(event_functions), constants


def _check_result(name: str, shapes: object, like: object) -> None:
    """Check that a function returns real numbers with structure and shapes of `like`."""
    if jax.tree.structure(shapes) != jax.tree.structure(like):
        structure, needed = jax.tree.structure(shapes), jax.tree.structure(like)
        raise ValueError(f"{name} returns the structure {structure}; {needed} is needed")
    paths = jax.tree_util.tree_leaves_with_path(shapes)
    for (path, a), b in zip(paths, jax.tree.leaves(like), strict=True):
        place = jax.tree_util.keystr(path)
        if a.shape != b.shape:
            raise ValueError(f"{name} returns shape {a.shape}{place and f' at {place}'}; {b.shape} is needed")
        if line := kinds.find_value_objection(a):
            raise ValueError(f"{name} returns a number that {line}{place and f' at {place}'}; a real one is needed")


def _describe_program(program: jex.ClosedJaxpr | jex.Jaxpr, constants: Sequence[Any], hidden: list[Any]) -> Any:
    """Return a description that is equal for programs of equal operations and constants; see `_describe`."""
    x, numbers = getattr(program, "jaxpr", program), dict[Any, int]()

    def read(atoms: Sequence[Any]) -> tuple:
        return tuple(
            (atom.aval, _describe(atom.val, hidden))
            if isinstance(atom, jex.Literal)
            else numbers.setdefault(atom, len(numbers))
            for atom in atoms
        )

    begins = [(variable.aval, *read([variable])) for variable in (*x.constvars, *x.invars)]
    rows = [(eqn.primitive, _describe(eqn.params, hidden), read(eqn.invars), read(eqn.outvars)) for eqn in x.eqns]
    return tuple(begins), tuple(rows), read(x.outvars), _describe(list(constants), hidden)


def _describe(x: object, hidden: list[Any]) -> Any:
    """Return a description that is equal for equal programs or parameters; `hidden` gets the parameters not read."""
    if isinstance(x, jex.ClosedJaxpr | jex.Jaxpr):
        return _describe_program(x, getattr(x, "consts", ()), hidden)
    if isinstance(x, dict):
        return tuple((name, _describe(entry, hidden)) for name, entry in sorted(x.items()))
    if isinstance(x, list | tuple):
        return type(x), tuple(_describe(element, hidden) for element in x)
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        x = jax.random.key_data(x)
    if isinstance(x, jax.Array | np.ndarray | np.generic | float):
        x = np.asarray(x)
        return x.dtype, x.shape, x.tobytes()
    unread = callable(x) or hasattr(x, "call_wrapped")  # JAX wraps a derivative rule anew each time
    if _hashable(x) is x and (not unread or isinstance(x, type | np.dtype | Mesh | AbstractMesh)):
        return x
    hidden.append(x)
    return type(x), str(getattr(x, "debug_info", None))


def _hashable(function: object) -> Any:
    try:
        hash(function)
    except TypeError:  # a callable with arrays in it: equal to itself only
        return id(function)
    return function


def has_tracer(*values: PyTree) -> bool:
    """Return whether a leaf of the values is traced."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(values))
