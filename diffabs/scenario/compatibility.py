"""Parts that do not fit together: one reads what another does not show."""

import dataclasses
import traceback
from collections.abc import Iterator, Mapping
from typing import Any

import jax

from diffabs.core.loop import Loop
from diffabs.core.protocols import Clock, Memory, Objective, Sample, still
from diffabs.core.pytree import strong
from diffabs.core.values import kebab
from diffabs.scenario.registry import joined
from diffabs.simulate.advance import initial_point


def misfits(loop: Loop, objectives: Mapping[str, Objective]) -> Iterator[str]:
    """One line for the first part of a loop, and for each objective, that reads what the plant does not show. Nothing
    is computed: the loop is only traced."""
    arrays, measured = strong((loop, dict(objectives)))
    if not isinstance(_trial("", lambda: jax.eval_shape(_everything, arrays, measured)), str):
        return  # one trace is enough where all fit
    around = _trial("", lambda: jax.eval_shape(_once, arrays))
    if isinstance(around, str):
        yield around
        return
    for name, objective in measured.items():
        found = _trial(joined("objective", name), lambda o=objective: jax.eval_shape(_measured, arrays, o))
        if isinstance(found, str):
            yield found


def _everything(loop: Loop, objectives: Mapping[str, Objective]) -> Any:
    sample = _sample(loop)  # once: following the signal around the loop is most of the time
    return _once(loop), [_read(objective, sample) for objective in objectives.values()]


def _once(loop: Loop) -> Any:
    """Once around the loop, and through an instant."""
    return initial_point(loop, {}, Clock(0.0, 1e-3, 0, jax.random.key(0)))


def _measured(loop: Loop, objective: Objective) -> Any:
    return _read(objective, _sample(loop))


def _sample(loop: Loop) -> Sample:
    return loop.signals(0.0, loop.start()).sample


def _read(objective: Objective, sample: Sample) -> Any:
    memory: Memory = objective.start(sample)
    return objective.flow(memory, sample), objective.update(memory, still(sample, 1e-3))


def _trial(path: str, trace: Any) -> Any:
    """What `trace` returns, or a line if a part read something that is not there."""
    try:
        return trace()
    except AttributeError as error:
        frames = [frame.f_locals.get("self") for frame, _ in traceback.walk_tb(error.__traceback__)]
        parts = [part for part in frames if dataclasses.is_dataclass(part) and not isinstance(part, Loop)]
        there = getattr(error.obj, "_fields", None) or [f.name for f in dataclasses.fields(error.obj)]  # pyright: ignore[reportArgumentType]
        names = f"{kebab(type(parts[-1]).__name__)} needs {error.name}"
        return f"{path or 'loop'}: {names}, and here is only {', '.join(there)}: these parts do not fit together"
