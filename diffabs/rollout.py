"""Run a loop: a scan over Runge-Kutta steps that returns a trajectory, or only what is measured.

    each step:   jump at t_k;  z += elapsed (f_after - f_before) for each localised event;  RK4 over [t_k, t_k + h];
                 the plant's projection;  the objectives' update

A run that crosses its stop is frozen at the instant before; after the scan, one last step lands on the crossing.
Stopping time, distance and every objective are thus exact to the order of the method and differentiable, wherever the
crossing falls."""

import dataclasses
import math
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.integrate import axpy, rk4_step
from diffabs.loop import Loop, LoopState
from diffabs.numerics import clamp
from diffabs.protocols import BrakeOutput, Clock, Ending, Memory, Objective, Sample
from diffabs.pytree import prepared, strong

LANDINGS = 5  # Newton iterations for the last step; quadratic from an error below one step


@dataclasses.dataclass(frozen=True)
class FixedStep:
    """Steps of equal length [s], up to `duration` [s]; a trajectory keeps every `every`-th instant."""

    step: float = 1e-3
    duration: float = 10.0
    every: int = 1

    @property
    def steps(self) -> int:
        """How many steps the duration takes."""
        return math.ceil(self.duration / self.step * (1 - 1e-12))


class Trajectory(NamedTuple):
    """What was seen, with a leading time axis. After the end of a run its last sample is repeated."""

    sample: Sample
    measured: BrakeOutput
    state: Any  # of the plant
    running: Any  # bool: False once the run has ended

    def finite(self) -> Any:
        """Whether every number of the run is finite."""
        return jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(self.sample)]))


class Run(NamedTuple):
    """The result: metrics by name (NaN for a run that diverged), how it ended, and the trajectory if asked for."""

    metrics: dict[str, Any]
    stopped: Any  # bool: the stop was reached in time
    diverged: Any  # bool: a number became infinite or NaN
    ending: Ending
    trajectory: Trajectory | None


def rollout(
    loop: Loop, solver: FixedStep, objectives: Mapping[str, Objective] | None = None, *, key: Any = None
) -> Run:
    """Run a loop and keep its trajectory.

    Pure and jit-compiled; batch it with `jax.vmap`, differentiate it in any leaf of `loop`. It is compiled once per
    structure of the loop and number of steps: new values do not compile again. `key` seeds noisy sensors.
    Raises ValueError for a step, duration or stride that is not positive.
    """
    return _call(loop, solver, objectives or {}, key, solver.every)


def measure(loop: Loop, solver: FixedStep, objectives: Mapping[str, Objective], *, key: Any = None) -> Run:
    """Run a loop and keep only the objectives: memory does not grow with the number of steps."""
    return _call(loop, solver, objectives, key, 0)


def _call(loop: Loop, solver: FixedStep, objectives: Mapping[str, Objective], key: Any, every: int) -> Run:
    for name in ("step", "duration", "every"):
        if not 0 < getattr(solver, name) < math.inf:
            raise ValueError(f"solver.{name} = {getattr(solver, name)} is not positive and finite")
    loop, objectives = strong((loop, dict(objectives)))
    dtype = jax.tree.leaves(loop)[0].dtype
    return _run(loop, objectives, jnp.asarray(solver.step, dtype), key, steps=solver.steps, every=every)


class _Carry(NamedTuple):
    state: LoopState
    tally: dict[str, Memory]  # accumulators of the objectives
    k: Any  # number of the last instant
    running: Any
    stopped: Any
    diverged: Any


@partial(jax.jit, static_argnames=("steps", "every"))
def _run(loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, *, steps: int, every: int) -> Run:
    keep = every > 0
    segment = every if keep else max(1, math.isqrt(steps))
    loop = prepared(loop)
    start = loop.start()
    first = loop.signals(0.0 * h, start)
    tally = {name: objective.start(first.sample) for name, objective in objectives.items()}
    no = jnp.asarray(False)
    carry = _Carry(start, tally, jnp.asarray(0), loop.stop.margin(first.sample.output) > 0, no, no)
    carry = _typed(carry, h.dtype)

    step = partial(_step, loop, objectives, h, key, steps)
    body = jax.checkpoint(step, policy=jax.checkpoint_policies.nothing_saveable, prevent_cse=False)

    def advance(carry: _Carry) -> _Carry:
        return jax.lax.scan(lambda c, _: (body(c), None), carry, length=segment)[0]

    def block(carry: _Carry, _: Any) -> tuple[_Carry, Any]:
        carry = jax.lax.cond(carry.running, advance, lambda c: c, carry)
        return carry, _seen(loop, carry.k * h, carry.state, carry.running) if keep else None

    block = jax.checkpoint(block, policy=jax.checkpoint_policies.nothing_saveable, prevent_cse=False)
    carry, seen = jax.lax.scan(block, carry, length=-(-steps // segment))
    final, tally, t = _land(loop, objectives, h, key, carry)
    ending = _ending(loop, t, final, carry.stopped)
    trajectory = None
    if keep:
        last = _seen(loop, t, final, no)
        trajectory = _assembled(_seen(loop, 0.0 * h, start, first.sample.t >= 0), seen, last)
    metrics = {name: o.value(tally[name], ending) for name, o in objectives.items()}
    metrics = {name: jnp.where(carry.diverged, jnp.nan, value) for name, value in metrics.items()}
    return Run(metrics, carry.stopped, carry.diverged, ending, trajectory)


def _step(loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, steps: int, carry: _Carry) -> _Carry:
    """One step, or nothing if the run has ended."""
    state, tally = _advance(loop, objectives, h, key, carry, h)
    y = loop.plant.output(state.plant)
    finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(state.flow())]))
    crossed = finite & (loop.stop.margin(y) <= 0)
    on = carry.running & finite & ~crossed
    new = _Carry(state, tally, carry.k + 1, carry.running, carry.stopped, carry.diverged)
    new = jax.tree.map(lambda a, b: jnp.where(on, a, b), new, carry)
    return new._replace(
        running=on & (new.k < steps),
        stopped=carry.stopped | (carry.running & crossed),
        diverged=carry.diverged | (carry.running & ~finite),
    )


def _advance(
    loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, carry: _Carry, length: Any
) -> tuple[LoopState, dict[str, Memory]]:
    """Jump at the present instant, then integrate over `length` <= h."""
    t = carry.k * h
    state, events = loop.jump(Clock(t, h, carry.k, key), carry.state)
    held = {name: memory.held for name, memory in carry.tally.items()}

    def flow(t: Any, z: Any, state: LoopState = state) -> Any:
        loop_flow, tally_flow = z
        state = state.with_flow(loop_flow)
        signals = loop.signals(t, state)
        rates = {name: o.flow(Memory(tally_flow[name], held[name]), signals.sample) for name, o in objectives.items()}
        return loop.flow(t, state, signals), rates

    tally_flow = {name: memory.flow for name, memory in carry.tally.items()}
    z = (state.flow(), tally_flow)
    for event in events:
        before = flow(t, (event.before.flow(), tally_flow), event.before)
        after = flow(t, (event.after.flow(), tally_flow), event.after)
        z = axpy(event.elapsed, axpy(-1.0, before, after), z)
    loop_flow, tally_flow = rk4_step(flow, t, z, length)
    state = state.with_flow(loop_flow)
    state = state._replace(plant=loop.plant.project(state.plant))
    sample = loop.signals(t + length, state).sample
    tally = {
        name: Memory(tally_flow[name], o.update(Memory(tally_flow[name], held[name]), sample, length))
        for name, o in objectives.items()
    }
    return state, tally


def _land(
    loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, carry: _Carry
) -> tuple[LoopState, dict[str, Memory], Any]:
    """For a run that stopped, the partial step that ends on the crossing; the time of the end."""
    stop = loop.stop

    def newton(length: Any, _: Any) -> tuple[Any, None]:
        """One iteration. Only the last one is differentiated: its slope is the implicit function theorem's."""
        length = jax.lax.stop_gradient(length)
        state, _ = _advance(loop, {}, h, key, carry._replace(tally={}), length)
        y = loop.plant.output(state.plant)
        slope = jax.lax.stop_gradient(stop.rate(y))
        slope = jnp.where(slope < 0, slope, -jnp.inf)
        return clamp(length - stop.margin(y) / slope, 0.0, h), None

    length, _ = jax.lax.scan(newton, 0.0 * h, length=LANDINGS)
    length = jnp.where(carry.stopped, length, 0.5 * h)  # not used, but a point where all derivatives exist
    state, tally = _advance(loop, objectives, h, key, carry, length)
    chosen = jax.tree.map(lambda a, b: jnp.where(carry.stopped, a, b), (state, tally), (carry.state, carry.tally))
    return *chosen, carry.k * h + jnp.where(carry.stopped, length, 0.0)


def _ending(loop: Loop, t: Any, state: LoopState, stopped: Any) -> Ending:
    sample = loop.signals(t, state).sample
    return Ending(sample, stopped, *loop.stop.remainder(sample.output, stopped))


def _seen(loop: Loop, t: Any, state: LoopState, running: Any) -> Trajectory:
    signals = loop.signals(t, state)
    return Trajectory(signals.sample, signals.measured, state.plant, running)


def _assembled(first: Trajectory, seen: Trajectory, last: Trajectory) -> Trajectory:
    """First instant, the instants of the scan, and the last one in place of everything after the end."""

    def join(a: Any, b: Any, c: Any) -> Any:
        b = jnp.where(jnp.expand_dims(seen.running, range(1, b.ndim)), b, c)
        return jnp.concatenate([jnp.asarray(a)[None], b])

    return jax.tree.map(join, first, seen, last)


def _typed(tree: Any, dtype: Any) -> Any:
    """Strong types throughout: a scan refuses a carry whose type weakens or strengthens."""

    def typed(x: Any) -> Any:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(x.dtype)

    return jax.tree.map(typed, tree)
