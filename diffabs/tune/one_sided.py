"""Warnings for points with a one-sided derivative by a parameter (listed in `docs/gradients.md`)."""

import warnings
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.pytree import replace, stack_lists
from diffabs.core.types import Array, Params, Part, PyTree
from diffabs.engine.solvers import FixedStep, Solver
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.parts.actuators import Delay
from diffabs.parts.controllers import ConstantInput, NoFeedforward, Relay, SampledOnGrid, SlidingMode
from diffabs.tune.result import build_subject_loop

EQUAL_ROUNDING_STEPS = 64.0  # tolerance of equality, in units of the relative precision
ADVICE = "a search may end there without a minimum: start it from other values, or hold one of these parameters"


def one_sided_candidates(loop: Loop, solver: Solver) -> Iterator[tuple[str, PyTree, PyTree]]:
    """Yield (name, number, number) for each condition under which a derivative of `loop` may be one-sided.

    The derivative is one-sided where the two numbers are equal. The name depends on the parts of the loop alone, so
    both numbers may be traced.
    """
    sampled: Any = loop.controller
    inner: Part = getattr(sampled, "controller", sampled)
    prefix = "controller." if inner is sampled else "controller.controller."
    if inner is not sampled and hasattr(sampled, "delay"):
        period = next(name for name in ("period", "sampling_period") if hasattr(sampled, name))
        yield "controller.delay is zero", sampled.delay, 0.0
        yield f"controller.delay and controller.{period} are equal", sampled.delay, getattr(sampled, period)
    if isinstance(sampled, SampledOnGrid):
        steps = jnp.round(sampled.delay / solver.step)
        yield "controller.delay is a whole number of steps", sampled.delay, steps * solver.step
    for path, actuator in _actuators(loop.actuator):
        if isinstance(actuator, Delay) and isinstance(solver, FixedStep):
            yield f"{path}.time and the step are equal", actuator.time, solver.step
    for sign, name in ((1, "high"), (-1, "low")):
        if isinstance(inner, SlidingMode) and isinstance(loop.feedforward, NoFeedforward | ConstantInput):
            constant = getattr(loop.feedforward, "value", 0.0)
            text = f"{prefix}gain reaches {prefix}{name} and no further"
            yield text, sign * inner.gain + constant, getattr(inner, name)
        for path, actuator in _actuators(loop.actuator):
            if hasattr(inner, name) and hasattr(actuator, name):
                text = f"{prefix}{name} and {path}.{name} are equal"
                yield text, getattr(inner, name), getattr(actuator, name)
    if isinstance(inner, Relay):
        signals = loop.signals(0.0, loop.start())
        yield "the relay starts on its target, where its first state jumps", signals.measured[0], signals.sample.target


def warn(subject: object, values: Params, batch: Batch, solver: Solver, where: str) -> None:
    """Issue a UserWarning that begins with `where` for each condition under which a derivative is one-sided in some
    run.
    """

    def compare(values: Params) -> Array:
        """Return both numbers of each pair in each run, shape (2, runs, pairs)."""
        loop = stack_lists(build_subject_loop(replace(subject, values)))
        both = batch.each(loop, lambda loop, _: [jnp.stack(two) for _, *two in one_sided_candidates(loop, solver)])
        return jnp.moveaxis(jnp.stack(both, axis=1), 2, 0)

    names = [name for name, *_ in one_sided_candidates(build_subject_loop(subject), solver)]
    if not names:
        return
    values = {path: jnp.asarray(value, float) for path, value in values.items()}
    x, y = np.asarray(compare(values))
    small = EQUAL_ROUNDING_STEPS * np.finfo(x.dtype).eps
    equal = np.isfinite(x) & np.isclose(x, y, rtol=small, atol=0.0)
    if not equal.any():
        return
    slopes = jax.jacfwd(lambda values: jnp.subtract(*compare(values)))(values)
    moves = {path: abs(np.asarray(slope)) > small for path, slope in slopes.items()}  # above rounding
    for i, name in enumerate(names):
        moving = [path for path, ones in moves.items() if ones[:, i][equal[:, i]].any()]
        if moving:
            runs = f" (in {equal[:, i].sum()} of {len(equal)} runs)" if len(equal) > 1 else ""
            side = f"the derivative by {' and '.join(moving)} is that of one side"
            warnings.warn(f"{where}: {name}{runs}, so {side}; {ADVICE}", stacklevel=3)


def _actuators(actuator: object) -> Iterator[tuple[str, PyTree]]:
    """Yield the path and the part of an actuator, or of each actuator in a series."""
    series = getattr(actuator, "blocks", None)
    if isinstance(series, tuple):
        yield from ((f"actuator.blocks.{i}", block) for i, block in enumerate(series))
    else:
        yield "actuator", actuator
