"""Run a loop: a scan over Runge-Kutta steps that returns a trajectory, or only what is measured.

    each step:   the objectives' update over [t_k - h, t_k];  jump at t_k;  z += elapsed (f_after - f_before) for each
                 localised event;  RK4 over [t_k, t_k + h];  the plant's projection
    at the end:  the objectives' last update, after the state was moved onto the crossing

A step that crosses the stop is tried again, shorter, until it ends on the crossing. Stopping time, distance and every
objective are thus exact to the order of the method and differentiable, wherever the crossing falls.

An unstable step may leave every number finite. So a run has `diverged`, too, if its landing did not come to rest on the
crossing, if a metric is outside of its physical range, or if the plant's own audit says that it cannot have been."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs import kinds
from diffabs.integrate import axpy, forgetful, repeated, rk4_step_and_rate
from diffabs.loop import Loop, LoopState
from diffabs.numerics import clamp
from diffabs.protocols import Clock, Ending, Memory, Objective, Sample
from diffabs.pytree import arrayed, misshapen, prepared, strong

MOST_STEPS = 2**31 - 8  # that a counter in 32 bits holds, landing included
LANDINGS = 4  # Newton iterations for the length of the last step; quadratic from an error below one step
MISSED = 0.1  # of the last step, by which a landing may miss the crossing: the state is still moved onto it
ROUNDING = 1e-9  # of a metric beyond its physical range
AUDIT = ""  # the name of a plant's audit among the objectives; no metric is called so


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
    measured: Any  # output of the sensor
    state: Any  # of the plant
    running: Any  # bool: False once the run has ended

    def finite(self) -> Any:
        """Whether every number of the run is finite."""
        return jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(self.sample)]))


class Run(NamedTuple):
    """The result: metrics by name (NaN for a run that diverged), how it ended, and the trajectory if asked for."""

    metrics: dict[str, Any]
    stopped: Any  # bool: the stop was reached in time
    diverged: Any  # bool: its numbers mean nothing: one became infinite, NaN or impossible, or it began beyond its stop
    ending: Ending
    trajectory: Trajectory | None


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


class Carry(NamedTuple):
    """A run on its way."""

    state: LoopState
    tally: dict[str, Memory]  # accumulators of the objectives; `held` is still without the last interval
    before: Sample  # at the beginning of that interval
    k: Any  # number of steps taken
    t: Any  # the present instant; after a stop, that of the crossing
    length: Any  # of the step to try: h, or shorter when landing
    landing: Any  # how many times the last step was tried
    running: Any
    stopped: Any
    diverged: Any


@partial(jax.jit, static_argnames=("steps", "every"))
def _run(loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, *, steps: int, every: int) -> Run:
    loop, audit = ready(loop)
    objectives = objectives | audit
    carry = started(loop, objectives, h)
    stepped = partial(step, loop, objectives, h, key, steps)
    first = _seen(loop, carry)
    if every:
        carry, seen = _segments(stepped, partial(_seen, loop), carry, every, steps + LANDINGS)
    else:
        carry, seen = repeated(stepped, carry, steps + LANDINGS, _running), None
    done, last = judged(loop, objectives, h, carry)
    return done._replace(trajectory=_assembled(first, seen, last, -(-steps // every))) if every else done


def ready(loop: Loop) -> tuple[Loop, dict[str, Objective]]:
    """The loop with everything worked out that does not change during a run, and what its plant watches it by."""
    loop = prepared(loop)
    audit = getattr(loop.plant, "audit", None)
    return loop, {AUDIT: audit(loop.initial)} if audit else {}


def judged(loop: Loop, objectives: dict[str, Objective], h: Any, carry: Carry) -> tuple[Run, Trajectory]:
    """The result of a run that is over, and its last instant. `objectives` with the plant's audit."""
    missed = carry.stopped & ~_landed(loop, h, carry)
    carry = _ended(loop, objectives, h, carry)
    last = _seen(loop, carry)
    ending = Ending(last.sample, carry.stopped, *loop.stop.remainder(last.sample, carry.stopped))
    metrics = {name: o.value(carry.tally[name], ending) for name, o in objectives.items()}
    wrong = [_impossible(name, objectives[name], value) for name, value in metrics.items()]
    diverged = jnp.any(jnp.stack([carry.diverged, missed, *wrong]))
    metrics = {n: jnp.where(diverged, jnp.nan, value) for n, value in metrics.items() if n != AUDIT}
    return Run(metrics, carry.stopped & ~diverged, diverged, ending, None), last


def _impossible(name: str, objective: Objective, value: Any) -> Any:
    """Whether no real run has this value: of an audit more than 1, of a metric one outside its range, or no number."""
    if name == AUDIT:
        return ~(value <= 1)
    low, high = getattr(objective, "physical", (-math.inf, math.inf))
    if math.isinf(low) and math.isinf(high):
        return jnp.asarray(False)
    return ~((value >= low - ROUNDING) & (value <= high + ROUNDING) & jnp.isfinite(value))


def _landed(loop: Loop, h: Any, carry: Carry) -> Any:
    """Whether the last step ended near the crossing, in units of the margin at its beginning and of its change in h."""
    y = loop.plant.output(carry.state.plant)
    left, ahead = loop.stop.margin(y), loop.stop.margin(carry.before.output)
    first = loop.stop.margin(loop.plant.output(loop.plant.start(loop.initial)))
    rounding = 16 * jnp.finfo(h.dtype).eps * jnp.abs(first)
    return jnp.abs(left) <= MISSED * (jnp.abs(ahead) + h * jnp.abs(loop.stop.rate(y))) + rounding


def started(loop: Loop, objectives: dict[str, Objective], h: Any) -> Carry:
    """The carry at t = 0."""
    state = loop.start()
    sample = loop.signals(0.0 * h, state).sample
    tally = {name: objective.start(sample) for name, objective in objectives.items()}
    no, zero = jnp.asarray(False), jnp.asarray(0)
    running = loop.stop.margin(sample.output) > 0
    return _typed(Carry(state, tally, sample, zero, 0.0 * h, h, zero, running, no, ~running), h.dtype)


def _segments(step: Any, seen: Any, carry: Carry, every: int, steps: int) -> tuple[Carry, Any]:
    """At least `steps` steps, and what was seen after every `every`-th."""

    def segment(carry: Carry, _: Any) -> tuple[Carry, Any]:
        carry = repeated(step, carry, every, _running)
        return carry, seen(carry)

    return jax.lax.scan(forgetful(segment), carry, length=-(-steps // every))


def _running(carry: Carry) -> Any:
    return carry.running


def step(loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, steps: int, carry: Carry) -> Carry:
    """One step; or one try of the last step; or nothing if the run has ended."""
    state, tally, before, late = _advance(loop, objectives, h, key, carry)
    finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(state.flow())]))
    trying = carry.landing > 0
    crossed = finite & (loop.stop.margin(loop.plant.output(state.plant)) <= 0)
    landed = carry.running & trying & (carry.landing == LANDINGS)
    ahead = carry.running & finite & ~trying & ~crossed
    search = carry.running & finite & ~landed & ~ahead
    taken = ahead | landed
    state, tally, before = jax.tree.map(
        lambda a, b: jnp.where(taken, a, b), (state, tally, before), (carry.state, carry.tally, carry.before)
    )
    k = carry.k + jnp.where(taken, 1, 0)
    return Carry(
        state=state,
        tally=tally,
        before=before,
        k=k,
        t=jnp.where(landed, carry.t + carry.length, jnp.where(ahead, k * h, carry.t)),
        length=jnp.where(search, clamp(carry.length + late, 0.0, h), carry.length),
        landing=carry.landing + jnp.where(search, 1, 0),
        running=(ahead & (k < steps)) | search,
        stopped=carry.stopped | landed,
        diverged=carry.diverged | (carry.running & ~finite),
    )


def _advance(
    loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, carry: Carry
) -> tuple[LoopState, dict[str, Memory], Sample, Any]:
    """Update, jump, integrate over carry.length: state, accumulators, the sample after the jump, and how much later [s]
    the margin crosses zero. That time only chooses the next length, so it has no derivative."""
    held = _updated(loop, objectives, carry, carry.state, carry.t, h)
    state, events = loop.jump(Clock(carry.t, h, carry.k, key), carry.state)
    tally_flow = {name: memory.flow for name, memory in carry.tally.items()}

    def flow(t: Any, z: Any, state: LoopState = state) -> Any:
        return _rates(loop, objectives, held, t, state.with_flow(z[0]), z[1])

    z = (state.flow(), tally_flow)
    for event in events:
        old = flow(carry.t, (event.before.flow(), tally_flow), event.before)
        new = flow(carry.t, (event.after.flow(), tally_flow), event.after)
        z = axpy(event.elapsed, axpy(-1.0, old, new), z)
    before = loop.signals(carry.t, state.with_flow(z[0])).sample
    z, rate = rk4_step_and_rate(flow, carry.t, z, carry.length)
    state = state.with_flow(z[0])
    state = state._replace(plant=loop.plant.project(state.plant))
    tally = {name: Memory(z[1][name], held[name]) for name in objectives}
    return state, tally, before, _late(loop, state.plant, rate[0][0])


def _late(loop: Loop, plant: Any, rate: Any) -> Any:
    """How much later [s] the margin crosses zero if the plant's state goes on at this rate."""

    def margin(x: Any) -> Any:
        return loop.stop.margin(loop.plant.output(x))

    left, slope = jax.jvp(margin, (plant,), (rate,))
    return jax.lax.stop_gradient(-left / jnp.where(slope < 0, slope, -jnp.inf))


def _rates(
    loop: Loop, objectives: dict[str, Objective], held: dict[str, Any], t: Any, state: LoopState, tally: dict[str, Any]
) -> tuple[Any, Any]:
    """d/dt of the loop's state and of the objectives' integrals `tally`."""
    signals = loop.signals(t, state)
    rates = {name: o.flow(Memory(tally[name], held[name]), signals.sample) for name, o in objectives.items()}
    return loop.flow(t, state, signals), rates


def _updated(
    loop: Loop, objectives: dict[str, Objective], carry: Carry, state: LoopState, t: Any, h: Any
) -> dict[str, Any]:
    """`held` of the accumulators after the last interval, of length h; there is none before the first step."""
    sample = loop.signals(t, state).sample

    def updated(memory: Memory, objective: Objective) -> Any:
        held = objective.update(memory, carry.before, sample, h)
        return jax.tree.map(lambda a, b: jnp.where(carry.k > 0, a, b), held, memory.held)

    return {name: updated(carry.tally[name], o) for name, o in objectives.items()}


def _ended(loop: Loop, objectives: dict[str, Objective], h: Any, carry: Carry) -> Carry:
    """Move a stopped run onto its crossing, and update the objectives over the last interval.

    The time to move is zero to rounding, but not its derivative, which is the implicit function theorem's: the state is
    moved by it, and so carries the derivative of the moment of the crossing.
    """
    y = loop.plant.output(carry.state.plant)
    slope = jax.lax.stop_gradient(loop.stop.rate(y))
    moved = jnp.where(carry.stopped, -loop.stop.margin(y) / jnp.where(slope < 0, slope, -jnp.inf), 0.0)
    tally = {name: memory.flow for name, memory in carry.tally.items()}
    held = {name: memory.held for name, memory in carry.tally.items()}
    rates = _rates(loop, objectives, held, carry.t, carry.state, tally)
    flow, tally = axpy(moved, rates, (carry.state.flow(), tally))
    state = carry.state.with_flow(flow)
    state = state._replace(plant=loop.plant.project(state.plant))
    carry = carry._replace(t=carry.t + moved, state=state)
    carry = carry._replace(tally={name: Memory(tally[name], held[name]) for name in objectives})
    held = _updated(loop, objectives, carry, state, carry.t, jnp.where(carry.stopped, carry.length + moved, h))
    return carry._replace(tally={name: Memory(tally[name], held[name]) for name in objectives})


def _seen(loop: Loop, carry: Carry) -> Trajectory:
    signals = loop.signals(carry.t, carry.state)
    return Trajectory(signals.sample, signals.measured, carry.state.plant, carry.running & (carry.landing == 0))


def _assembled(first: Trajectory, seen: Any, last: Trajectory, count: int) -> Trajectory:
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
