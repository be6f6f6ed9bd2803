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

LANDINGS = 4  # Newton iterations for the length of the last step; quadratic from an error below one step


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
    t: Any  # its time; after a stop, the time of the crossing
    length: Any  # of the step to try: h, or shorter when landing
    landing: Any  # how many times the last step was tried
    running: Any
    stopped: Any
    diverged: Any


@partial(jax.jit, static_argnames=("steps", "every"))
def _run(loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, *, steps: int, every: int) -> Run:
    loop = prepared(loop)
    start = loop.start()
    first = loop.signals(0.0 * h, start).sample
    tally = {name: objective.start(first) for name, objective in objectives.items()}
    no, zero = jnp.asarray(False), jnp.asarray(0)
    carry = _Carry(start, tally, zero, 0.0 * h, h, zero, loop.stop.margin(first.output) > 0, no, no)
    carry = _typed(carry, h.dtype)
    segment = every or max(1, math.isqrt(steps))

    def advance(carry: _Carry) -> _Carry:
        return jax.lax.scan(lambda c, _: (_step(loop, objectives, h, key, steps, c), None), carry, length=segment)[0]

    def block(carry: _Carry, _: Any) -> tuple[_Carry, Any]:
        carry = jax.lax.cond(carry.running, advance, lambda c: c, carry)
        return carry, _seen(loop, carry) if every else None

    first = _seen(loop, carry)
    block = jax.checkpoint(block, policy=jax.checkpoint_policies.nothing_saveable, prevent_cse=False)
    carry, seen = jax.lax.scan(block, carry, length=-(-(steps + LANDINGS) // segment))
    last = _seen(loop, carry)
    trajectory = _assembled(first, seen, last, -(-steps // segment)) if every else None
    ending = Ending(last.sample, carry.stopped, *loop.stop.remainder(last.sample, carry.stopped))
    metrics = {name: o.value(carry.tally[name], ending) for name, o in objectives.items()}
    metrics = {name: jnp.where(carry.diverged, jnp.nan, value) for name, value in metrics.items()}
    return Run(metrics, carry.stopped, carry.diverged, ending, trajectory)


def _step(loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, steps: int, carry: _Carry) -> _Carry:
    """One step; or one try of the last step; or nothing if the run has ended."""
    state, tally, late = _advance(loop, objectives, h, key, carry)
    finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(state.flow())]))
    trying = carry.landing > 0
    crossed = finite & (loop.stop.margin(loop.plant.output(state.plant)) <= 0)
    landed = carry.running & trying & (carry.landing == LANDINGS)
    ahead = carry.running & finite & ~trying & ~crossed
    search = carry.running & finite & ~landed & ~ahead
    state, tally = jax.tree.map(
        lambda a, b: jnp.where(ahead | landed, a, b), (state, tally), (carry.state, carry.tally)
    )
    k = carry.k + jnp.where(ahead, 1, 0)
    shorter = clamp(jax.lax.stop_gradient(carry.length + late), 0.0, h)
    return _Carry(
        state=state,
        tally=tally,
        k=k,
        t=jnp.where(landed, carry.t + carry.length + late, jnp.where(ahead, k * h, carry.t)),
        length=jnp.where(search, shorter, carry.length),
        landing=carry.landing + jnp.where(search, 1, 0),
        running=(ahead & (k < steps)) | search,
        stopped=carry.stopped | landed,
        diverged=carry.diverged | (carry.running & ~finite),
    )


def _advance(
    loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, carry: _Carry
) -> tuple[LoopState, dict[str, Memory], Any]:
    """Jump at the present instant and integrate over carry.length; how much later [s] the margin crosses zero.

    On the last try of the last step that time is zero to rounding, but not its derivative, which is the implicit
    function theorem's: the state is moved by it, and so carries the derivative of the moment of the crossing.
    """
    state, events = loop.jump(Clock(carry.t, h, carry.k, key), carry.state)
    held = {name: memory.held for name, memory in carry.tally.items()}

    def flow(t: Any, z: Any, state: LoopState = state) -> Any:
        state = state.with_flow(z[0])
        signals = loop.signals(t, state)
        rates = {name: o.flow(Memory(z[1][name], held[name]), signals.sample) for name, o in objectives.items()}
        return loop.flow(t, state, signals), rates

    tally_flow = {name: memory.flow for name, memory in carry.tally.items()}
    z = (state.flow(), tally_flow)
    for event in events:
        old = flow(carry.t, (event.before.flow(), tally_flow), event.before)
        new = flow(carry.t, (event.after.flow(), tally_flow), event.after)
        z = axpy(event.elapsed, axpy(-1.0, old, new), z)
    before = loop.signals(carry.t, state.with_flow(z[0])).sample
    z = rk4_step(flow, carry.t, z, carry.length)

    t = carry.t + carry.length
    y = loop.plant.output(z[0][0])
    slope = jax.lax.stop_gradient(loop.stop.rate(y))
    late = -loop.stop.margin(y) / jnp.where(slope < 0, slope, -jnp.inf)
    moved = jnp.where(carry.landing == LANDINGS, late, 0.0)
    loop_flow, tally_flow = axpy(moved, flow(t, z), z)
    state = state.with_flow(loop_flow)
    state = state._replace(plant=loop.plant.project(state.plant))
    sample = loop.signals(t + moved, state).sample
    memories = {name: Memory(tally_flow[name], held[name]) for name in objectives}
    tally = {
        name: memories[name]._replace(held=o.update(memories[name], before, sample, carry.length + moved))
        for name, o in objectives.items()
    }
    return state, tally, late


def _seen(loop: Loop, carry: _Carry) -> Trajectory:
    signals = loop.signals(carry.t, carry.state)
    return Trajectory(signals.sample, signals.measured, carry.state.plant, carry.running & (carry.landing == 0))


def _assembled(first: Trajectory, seen: Trajectory, last: Trajectory, count: int) -> Trajectory:
    """First instant, `count` instants of the scan, and the last one in place of everything after the end."""

    def join(a: Any, b: Any, c: Any) -> Any:
        b = jnp.where(jnp.expand_dims(seen.running, range(1, b.ndim)), b, c)
        return jnp.concatenate([jnp.asarray(a)[None], b[:count]])

    return jax.tree.map(join, first, seen, last)


def _typed(tree: Any, dtype: Any) -> Any:
    """Strong types throughout: a scan refuses a carry whose type weakens or strengthens."""

    def typed(x: Any) -> Any:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(x.dtype)

    return jax.tree.map(typed, tree)
