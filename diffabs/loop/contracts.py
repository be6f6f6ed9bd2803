"""Contracts of a loop's parts: whether each method returns what `core.protocols` asks for.

`find_misfits` traces the methods that a run calls, once each, so no values are computed. A part of the user's own may
have a mistake, or may read a signal that the plant lacks. Either gives one line with the part, the method and what is
needed. Without this check JAX would report the mistake later, in terms of compiled loops and derivatives. Of the
optional methods, only those of ticks and events are traced.
"""

import dataclasses
import operator
import pathlib
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core import kinds
from diffabs.core.blocks import Parallel, offers
from diffabs.core.channels import has_channels
from diffabs.core.protocols import Clock, Ending, Memory, Objective, Sample, Tracking, resting_segment
from diffabs.core.pytree import canonical_dtypes, children, stack_lists
from diffabs.host.values import kebab_case
from diffabs.loop.closed_loop import Loop

# The part that holds parts for one number each, of a loop with several inputs.
FOR_CHANNELS = {"controller": "per-channel", "actuator": "per-control", "sensor": "per-output"}
STEP = 1e-3  # [s] arbitrary: only its type matters
# folders whose code is not the user's: this package, Python's library, and installed packages such as JAX
NOT_USERS = (pathlib.Path(__file__).parents[1], pathlib.Path(jax.__file__).parents[1], *map(pathlib.Path, {
    sysconfig.get_path("stdlib"), sysconfig.get_path("purelib")
}))  # fmt: skip
WITHOUT_VALUE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
MAX_FITTING = 4096  # structures to remember
_fitting: dict[Any, None] = {}  # structures and shapes that were checked without a misfit, the oldest first


class Misfit(Exception):
    """A method or an attribute of a part breaks its contract; the text is the line for the user."""


def refuse_misfits(loop: Loop, objectives: Mapping[str, Objective]) -> None:
    """Raise a ValueError for the misfits of a loop with parameters of correct types and shapes (`find_misshapen`)."""
    if lines := list(find_misfits(loop, {f"objectives.{name}": objective for name, objective in objectives.items()})):
        raise ValueError("; ".join(lines))


def find_misfits(loop: Loop, objectives: Mapping[str, Objective]) -> Iterator[str]:
    """Yield one line for each misfit: a method that fails, or that returns something else than its contract asks for.

    The first misfit of a part of the loop ends the check. If the loop fits, each objective gives at most one line. A
    structure that fits is not traced again for other values of its parameters, of the same shapes. `objectives` have
    the paths that messages show.
    """
    leaves, structure = jax.tree.flatten((loop, list(objectives.values())))
    structure = structure, *map(np.shape, leaves)
    if structure in _fitting:
        return
    lines: list[str] = []

    def trace(loop: Loop, objectives: Mapping[str, Objective]) -> None:
        try:
            sample, ending = _follow_loop(loop)
        except (Misfit, ValueError) as error:  # a ValueError is the message of a packaged part
            lines.append(str(error))
            return
        for path, objective in objectives.items():
            try:
                _follow_objective(path, objective, sample, ending)
            except (Misfit, ValueError) as error:
                lines.append(str(error))

    jax.eval_shape(trace, *canonical_dtypes((stack_lists(loop), dict(objectives))))
    yield from lines
    if not lines:
        while len(_fitting) >= MAX_FITTING:
            _fitting.pop(next(iter(_fitting)), None)
        _fitting[structure] = None


def _follow_loop(loop: Loop) -> tuple[Sample, Ending]:
    """Call each method of the loop's parts once, and return a sample at t = 0 and an ending made of it."""
    plant, t = loop.plant, jnp.asarray(0.0)
    state = _call("plant", plant, "start", loop.initial)
    _expect_reals("plant.start", state)
    _expect_like("plant.project", _call("plant", plant, "project", state), state, "the state")
    output = _call("plant", plant, "output", state)
    _check_shown(plant, output)
    measured = _follow_block("sensor", loop.sensor, output)
    target = _follow_block("reference", loop.reference, measured)
    _expect_target("reference.output", target, output)
    setpoint = _call("reference", loop.reference, "setpoint", loop.reference.start(measured))
    _expect_like("reference.setpoint", setpoint, target, "the target")
    feedforward = _call("feedforward", loop.feedforward, "input", plant, measured, setpoint)
    _expect_control("feedforward.input", feedforward, plant)
    tracking = Tracking(target, measured, feedforward)
    command = _follow_block("controller", loop.controller, tracking)
    _expect_control("controller.output", command, plant)
    control = _follow_block("actuator", loop.actuator, command)
    _expect_control("actuator.output", control, plant)
    _expect_like("plant.derivative", _call("plant", plant, "derivative", t, state, control), state, "the state")
    _expect_real("stop.margin", _call("stop", loop.stop, "margin", output))
    sample = Sample(t, output, target, setpoint, feedforward, command, control)
    stopped = jnp.asarray(True)
    remainder = _call("stop", loop.stop, "remainder", sample, stopped)
    if not isinstance(remainder, tuple) or len(remainder) != 2:
        raise Misfit(f"stop.remainder returns {_describe(remainder)}; (time left [s], distance left [m]) is needed")
    return sample, Ending(sample, stopped, *remainder)


def _follow_block(name: str, block: object, signal: object) -> Any:
    """Call each method of a block once, and return its output."""
    try:
        return _call_block(name, block, signal)
    except Misfit as error:
        channels: Any = signal.feedforward if isinstance(signal, Tracking) else signal
        if name not in FOR_CHANNELS or not has_channels(channels) or isinstance(block, Parallel):
            raise
        if name == "sensor" and not hasattr(type(channels), "tracked"):
            raise
        named = ", ".join(type(channels)._fields)
        raise Misfit(f"{error}; {FOR_CHANNELS[name]} has one for each of {named}") from error


def _call_block(name: str, block: object, signal: object) -> Any:
    t = jnp.asarray(0.0)
    memory = _call(name, block, "start", signal)
    _expect_memory(f"{name}.start", memory)
    _expect_like(f"{name}.flow", _call(name, block, "flow", t, memory, signal), memory.flow, "memory.flow")
    if offers(block, "tick"):
        clock = Clock(t, jnp.asarray(STEP), jnp.asarray(0), jax.random.key(0), before=signal)
        _expect_like(f"{name}.tick", _call(name, block, "tick", clock, memory, signal), memory, "memory")
    if offers(block, "margins"):
        margins = _call(name, block, "margins", t, memory, signal, lambda: jax.tree.map(jnp.zeros_like, signal))
        if not isinstance(margins, tuple):
            raise Misfit(f"{name}.margins returns {_describe(margins)}; a tuple of real numbers is needed")
        for margin in margins:
            _expect_real(f"{name}.margins", margin)
        fired = tuple(jnp.asarray(False) for _ in margins)
        _expect_like(f"{name}.event", _call(name, block, "event", t, memory, signal, fired), memory, "memory")
    return _call(name, block, "output", t, memory, signal)


def _follow_objective(path: str, objective: Objective, sample: Sample, ending: Ending) -> None:
    memory = _call(path, objective, "start", sample)
    _expect_memory(f"{path}.start", memory)
    _expect_like(f"{path}.flow", _call(path, objective, "flow", memory, sample), memory.flow, "memory.flow")
    segment = resting_segment(sample, jnp.asarray(STEP))
    _expect_like(f"{path}.update", _call(path, objective, "update", memory, segment), memory.held, "memory.held")
    _expect_reals(f"{path}.value", _call(path, objective, "value", memory, ending))


def _call(path: str, part: object, method: str, *args: object) -> Any:
    """Return the result of a method, or raise a Misfit with the reason why it fails.

    A ValueError of a packaged part is its message to the user, and is raised again with the path of that part.
    """
    function: Callable[..., Any] | None = getattr(part, method, None)
    if not callable(function):
        raise Misfit(
            f"{path}: {type(part).__name__} has no method {method}; diffabs.core.protocols lists what it needs"
        )
    try:
        return function(*args)
    except Exception as error:
        place = _place(error)
        if isinstance(error, ValueError) and not place:
            raise ValueError(_prefix_field(path, part, error)) from error
        if isinstance(error, WITHOUT_VALUE):
            why = (
                " needs a number's value, which JAX traces without; use jnp.where for if, jax.numpy for math and numpy"
            )
        elif isinstance(error, AttributeError):
            raise Misfit(_explain_missing(path, part, method, error) + place) from error
        else:
            why = f" fails: {type(error).__name__}: {next(iter(str(error).splitlines()), '')}"
        raise Misfit(f"{path}.{method}{why}{place}") from error


def _explain_missing(path: str, part: object, method: str, error: AttributeError) -> str:
    """Return a line about a missing attribute: which part reads it, and which fields exist."""
    reader = next(_active_parts(error), part)
    fields = getattr(error.obj, "_fields", None)
    if fields is None and dataclasses.is_dataclass(error.obj):
        fields = [field.name for field in dataclasses.fields(error.obj)]
    if fields is None or error.obj is reader:
        return f"{path}.{method} fails: {next(iter(str(error).splitlines()), '')}"
    needs = f"{path}: {kebab_case(type(reader).__name__)} needs {error.name}"
    return f"{needs}; there is only {', '.join(fields)}: these parts do not fit together"


def _prefix_field(path: str, part: object, error: ValueError) -> str:
    """Return the message of a packaged part, which may begin with one of its fields, after the part's path."""
    message, root = str(error), path.partition(".")[0]
    if message.startswith(root):
        return message
    places = ((_find_path(active, part, path), active) for active in _active_parts(error))
    where, reader = next(filter(operator.itemgetter(0), places), (path, part))
    fields = [field.name for field in dataclasses.fields(reader)] if dataclasses.is_dataclass(reader) else []
    begins_with_field = message.partition(":")[0].partition(" ")[0] in fields
    return f"{where}.{message}" if begins_with_field else f"{where}: {message}"


def _active_parts(error: Exception) -> Iterator[Any]:
    """Yield the parts whose methods the error passed, the innermost first."""
    frames = [frame.f_locals.get("self") for frame, _ in traceback.walk_tb(error.__traceback__)]
    return (part for part in reversed(frames) if dataclasses.is_dataclass(part))


def _find_path(inner: object, part: object, path: str) -> str:
    """Return the path of a part that is `part` or inside it; empty if it is not."""
    if inner is part:
        return path
    inside = (_find_path(inner, value, name) for name, _, value in children(part, f"{path}."))
    return next(filter(None, inside), "")


def _place(error: Exception) -> str:
    """Return the innermost line of the user's code that the error passed, as ` (file.py, line 7)`; empty if none."""
    frames = traceback.extract_tb(error.__traceback__)
    user_frames = [frame for frame in frames if not set(NOT_USERS) & set(pathlib.Path(frame.filename).parents)]
    # Dataclasses generate methods in "files" whose names begin so.
    user_frames = [frame for frame in user_frames if not frame.filename.startswith("<string")]
    return f" ({pathlib.Path(user_frames[-1].filename).name}, line {user_frames[-1].lineno})" if user_frames else ""


def _check_shown(plant: object, output: object) -> None:
    """Check a plant's output, its declared types `shows` and `controls` with their units, and `control_unit`."""
    _expect_reals("plant.output", output)
    unit, shows, controls = (
        getattr(plant, "control_unit", ""),
        *(getattr(plant, n, None) for n in ("shows", "controls")),
    )
    if not isinstance(unit, str):
        raise Misfit(f"plant.control_unit = {kinds.format_value(unit)} is no text, such as 'N m'")
    if controls is not None:
        _check_named("controls", controls)
    if shows is None:
        return  # a run does not need it; figures and tables do
    _check_named("shows", shows)
    if unknown := [name for name in getattr(shows, "tracked", ()) if name not in shows._fields]:
        raise Misfit(f"plant.shows: {shows.__name__}.tracked has {', '.join(unknown)}, which is no output")
    if not isinstance(output, shows):
        raise Misfit(f"plant.output returns {_describe(output)}; {shows.__name__}(...) is needed, as plant.shows says")


def _check_named(attribute: str, signals: Any) -> None:
    """Check a plant's declared type of outputs or controls, and its units."""
    if not (isinstance(signals, type) and hasattr(signals, "_fields")):
        raise Misfit(f"plant.{attribute} = {kinds.format_value(signals)} is no class of NamedTuple")
    units, names = getattr(signals, "units", {}), getattr(signals, "_fields", ())
    if missing := [name for name in names if not isinstance(units, Mapping) or name not in units]:
        raise Misfit(f"plant.{attribute}: {signals.__name__}.units lacks a unit of {', '.join(missing)}")


def _expect_control(path: str, value: object, plant: object) -> None:
    """Check a feed-forward, a command or a control: one number, or a number for each of the plant's `controls`."""
    controls = getattr(plant, "controls", None)
    if controls is None:
        _expect_real(path, value)
    elif not isinstance(value, controls):
        raise Misfit(f"{path} returns {_describe(value)}; {controls.__name__}(...) is needed, as plant.controls says")
    _expect_each_real(path, value)


def _expect_target(path: str, target: object, output: object) -> None:
    """Check a target: one number, or a number for each output in `tracked` of the plant's output type."""
    tracked = getattr(type(output), "tracked", None)
    if tracked is None:
        _expect_real(path, target)
    elif {*getattr(target, "_fields", ())} != {*tracked}:
        raise Misfit(f"{path} returns {_describe(target)}; a NamedTuple of {', '.join(tracked)} is needed")
    _expect_each_real(path, target)


def _expect_each_real(path: str, signal: object) -> None:
    for number in jax.tree.leaves(signal):
        if _describe(number) != "float":
            raise Misfit(f"{path} returns {_describe(signal)}; real numbers without axes are needed")


def _expect_memory(path: str, memory: object) -> None:
    if not isinstance(memory, Memory):
        raise Misfit(f"{path} returns {_describe(memory)}; Memory(flow, held) is needed")
    _expect_reals(f"{path}, in flow,", memory.flow)
    if not all(map(_is_array, jax.tree.leaves(memory.held))):
        raise Misfit(f"{path}, in held, returns {_describe(memory.held)}; numbers or arrays are needed")


def _expect_real(path: str, value: object) -> None:
    if _describe(value) != "float":
        raise Misfit(f"{path} returns {_describe(value)}; one real number is needed, a float without axes")


def _expect_reals(path: str, tree: object) -> None:
    if tree is None or any(not _describe_leaf(leaf).startswith("float") for leaf in jax.tree.leaves(tree)):
        raise Misfit(f"{path} returns {_describe(tree)}; real numbers are needed, of type float")


def _expect_like(path: str, tree: object, like: object, name: str) -> None:
    """Check that a result has structure, shapes and kinds of numbers of `like`; `name` stands for it in the message."""
    fits = jax.tree.structure(tree) == jax.tree.structure(like)
    if not fits or list(map(_describe_leaf, jax.tree.leaves(tree))) != list(map(_describe_leaf, jax.tree.leaves(like))):
        raise Misfit(f"{path} returns {_describe(tree)}; {_describe(like)} is needed, like {name}")


class _Word(str):
    """A text that is shown without quotes."""

    __repr__ = str.__str__


def _describe(tree: object) -> str:
    """Return the text of a result, with kind and shape in place of each number."""
    return repr(jax.tree.map(lambda leaf: _Word(_describe_leaf(leaf)), tree))


def _describe_leaf(leaf: object) -> str:
    """Return kind and shape of a number, such as `float` or `int[3]`; the type's name of anything else."""
    if not _is_array(leaf):
        return type(leaf).__name__
    aval = jax.typeof(leaf)
    kind = next((word for word in ("float", "int", "bool", "complex") if word in str(aval.dtype)), str(aval.dtype))
    return kind + (str(list(aval.shape)) if aval.shape else "")


def _is_array(leaf: object) -> bool:
    try:
        jax.typeof(leaf)
    except TypeError:
        return False
    return True
