"""Check of whether the parts of a loop fit together: each part finds the signals that it reads."""

import dataclasses
import traceback
from collections.abc import Iterator, Mapping
from typing import Any

import jax

from diffabs.config.values import kebab_case
from diffabs.core.loop import Loop
from diffabs.core.protocols import Clock, Memory, Objective, Sample, resting_segment
from diffabs.core.pytree import canonical_dtypes
from diffabs.core.types import PyTree
from diffabs.scenario.registry import join_path
from diffabs.simulate.step.attempt import start_state


def find_misfits(loop: Loop, objectives: Mapping[str, Objective]) -> Iterator[str]:
    """Yield one line for each misfit: a part that reads a signal which the loop lacks.

    A misfit within the loop gives a single line, and objectives are then not checked. Otherwise each objective with a
    misfit gives a line. The loop is only traced: no number is computed.

    Args:
        loop: Loop to trace once around, and through one instant.
        objectives: Objectives of its runs by name, traced on one sample and one segment.
    """
    arrays, measured = canonical_dtypes((loop, dict(objectives)))
    if not isinstance(_trial("", lambda: jax.eval_shape(_trials, arrays, measured)), str):
        return  # the usual case: one trace shows that all parts fit
    around = _trial("", lambda: jax.eval_shape(_trace_loop, arrays))
    if isinstance(around, str):
        yield around
        return
    for name, objective in measured.items():
        found = _trial(join_path("objective", name), lambda o=objective: jax.eval_shape(_trace_objective, arrays, o))
        if isinstance(found, str):
            yield found


def _trials(loop: Loop, objectives: Mapping[str, Objective]) -> Any:
    sample = _sample(loop)  # shared: tracing the signals around the loop takes most of the time
    return _trace_loop(loop), [_read(objective, sample) for objective in objectives.values()]


def _trace_loop(loop: Loop) -> PyTree:
    """Trace the loop once around, and through an instant."""
    clock = Clock(0.0, 1e-3, 0, jax.random.key(0))
    state, _ = start_state(loop, {}, clock)
    signals = loop.signals(clock.t, state)
    rate = loop.flow(clock.t, state, signals)
    return rate, loop.margins(clock.t, state, signals, lambda: rate)


def _trace_objective(loop: Loop, objective: Objective) -> Any:
    return _read(objective, _sample(loop))


def _sample(loop: Loop) -> Sample:
    return loop.signals(0.0, loop.start()).sample


def _read(objective: Objective, sample: Sample) -> Any:
    memory: Memory = objective.start(sample)
    return objective.flow(memory, sample), objective.update(memory, resting_segment(sample, 1e-3))


def _trial(path: str, trace: Any) -> PyTree:
    """Return the result of `trace`, or one line if a part reads an attribute that its input lacks."""
    try:
        return trace()
    except AttributeError as error:
        frames = [frame.f_locals.get("self") for frame, _ in traceback.walk_tb(error.__traceback__)]
        parts = [part for part in frames if dataclasses.is_dataclass(part) and not isinstance(part, Loop)]
        there = getattr(error.obj, "_fields", None) or [f.name for f in dataclasses.fields(error.obj)]  # pyright: ignore[reportArgumentType]
        names = f"{kebab_case(type(parts[-1]).__name__)} needs {error.name}"
        return f"{path or 'loop'}: {names}; there is only {', '.join(there)}: these parts do not fit together"
