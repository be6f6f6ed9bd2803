"""Run a loop: a scan over Runge-Kutta steps that returns a trajectory, or only what is measured.

    each step:   the objectives' update over [t_k - h, t_k];  jump at t_k;  z += elapsed (f_after - f_before) for each
                 localised event;  RK4 over [t_k, t_k + h];  the plant's projection
    at the end:  the objectives' last update, after the state was moved onto the crossing

A step that crosses the stop is tried again, shorter, until it ends on the crossing. Stopping time, distance and every
objective are thus exact to the order of the method and differentiable, wherever the crossing falls."""

import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from diffabs.core import kinds
from diffabs.core.compiling import SAME, compile_once
from diffabs.core.loop import Loop
from diffabs.core.protocols import Objective
from diffabs.core.pytree import arrayed, misshapen, strong
from diffabs.simulate.checkpoint import forgetful, repeated
from diffabs.simulate.hybrid_step import LANDINGS, Carry, init_carry, observe, step
from diffabs.simulate.outcome import judge, prepare
from diffabs.simulate.solution import FixedStep, Run, Trajectory

MOST_STEPS = 2**31 - 8  # that a counter in 32 bits holds, landing included


def rollout(
    loop: Loop, solver: FixedStep, objectives: Mapping[str, Objective] | None = None, *, key: Any = None
) -> Run:
    """Run a loop and keep its trajectory.

    Pure and jit-compiled; batch it with `jax.vmap`, differentiate it in any leaf of `loop`. It is compiled once per
    structure of the loop and number of steps: new values do not compile again. `key` seeds noisy sensors.
    Raises ValueError for a step, duration or stride that is not positive, a step longer than the duration, and
    parameters that are no real numbers of 32 bits or more, or have another shape than they need.
    """
    return _call(loop, solver, objectives or {}, key, solver.every)


def measure(loop: Loop, solver: FixedStep, objectives: Mapping[str, Objective], *, key: Any = None) -> Run:
    """Run a loop and keep only the objectives: memory does not grow with the number of steps."""
    return _call(loop, solver, objectives, key, 0)


def _call(loop: Loop, solver: FixedStep, objectives: Mapping[str, Objective], key: Any, every: int) -> Run:
    loop, objectives, h = arguments(loop, solver, objectives)
    return _run(loop, objectives, h, key, steps=solver.steps, every=every)


def arguments(loop: Loop, solver: FixedStep, objectives: Mapping[str, Objective]) -> tuple[Loop, Any, Any]:
    """Loop, objectives and step, of one data type. Raises ValueError."""
    lines = [*_wrong_solver(solver), *misshapen(loop)]
    lines += [line for name, part in objectives.items() for line in misshapen(part, f"objectives.{name}.")]
    if lines:
        raise ValueError("; ".join(lines))
    loop, objectives = strong((arrayed(loop), {name: arrayed(part) for name, part in objectives.items()}))
    return loop, objectives, jnp.asarray(solver.step, jax.tree.leaves(loop)[0].dtype)


def _wrong_solver(solver: FixedStep) -> Iterator[str]:
    """One line for each field that no run can have."""
    lines = [f"solver.{name} {line}" for name in ("step", "duration", "every") if (line := _wrong_number(solver, name))]
    if lines:
        yield from lines
    elif solver.step > solver.duration:
        yield f"solver.step = {solver.step} s is longer than solver.duration = {solver.duration} s"
    elif solver.duration / solver.step > MOST_STEPS:
        yield f"solver.step = {solver.step} s takes more than {MOST_STEPS} steps of {solver.duration} s"


def _wrong_number(solver: FixedStep, name: str) -> str:
    value = getattr(solver, name)
    if line := kinds.objection(value) or (kinds.shape(value) and f"has shape {kinds.shape(value)}"):
        return f"= {kinds.shown(value)} {line}; a number is needed"
    if not 0 < value < math.inf:
        return f"= {value} is not positive and finite"
    return f"= {value} is no whole number" if name == "every" and value != int(value) else ""


@compile_once(static=("steps", "every"), options=SAME)
def _run(loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, *, steps: int, every: int) -> Run:
    loop, audit = prepare(loop)
    objectives = objectives | audit
    carry = init_carry(loop, objectives, h)
    stepped = partial(step, loop, objectives, h, key, steps)
    first = observe(loop, carry)
    if every:
        carry, seen = _segments(stepped, partial(observe, loop), carry, every, steps + LANDINGS)
    else:
        carry, seen = repeated(stepped, carry, steps + LANDINGS, _running), None
    done, last = judge(loop, objectives, h, carry)
    return done._replace(trajectory=_assembled(first, seen, last, -(-steps // every))) if every else done


def _segments(step: Any, seen: Any, carry: Carry, every: int, steps: int) -> tuple[Carry, Any]:
    """At least `steps` steps, and what was seen after every `every`-th."""

    def segment(carry: Carry, _: Any) -> tuple[Carry, Any]:
        carry = repeated(step, carry, every, _running)
        return carry, seen(carry)

    return jax.lax.scan(forgetful(segment), carry, length=-(-steps // every))


def _running(carry: Carry) -> Any:
    return carry.running


def _assembled(first: Trajectory, seen: Any, last: Trajectory, count: int) -> Trajectory:
    """First instant, `count` instants of the scan, and the last one in place of everything after the end."""

    def join(a: Any, b: Any, c: Any) -> Any:
        b = jnp.where(jnp.expand_dims(seen.running, range(1, b.ndim)), b, c)
        return jnp.concatenate([jnp.asarray(a)[None], b[:count]])

    return jax.tree.map(join, first, seen, last)
