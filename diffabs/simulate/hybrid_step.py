"""One step of a run, and its two ends: what happens in an interval is said here, and nowhere else."""

import enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.loop import Event, Loop, LoopState
from diffabs.core.numerics import axpy, clamp
from diffabs.core.protocols import Clock, Memory, Objective, Sample
from diffabs.simulate.rk4 import rk4_step_and_rate
from diffabs.simulate.solution import Trajectory

LANDINGS = 4  # Newton iterations for the length of the last step; quadratic from an error below one step


class Condition(enum.IntEnum):
    """How a run is: it goes on, or looks for the length of its last step, or it is over, in one of three ways."""

    RUNNING, LANDING, STOPPED, TIMED_OUT, DIVERGED = range(5)


class Carry(NamedTuple):
    """A run on its way."""

    state: LoopState
    tally: dict[str, Memory]  # accumulators of the objectives; `held` is still without the last interval
    before: Sample  # at the beginning of that interval
    k: Any  # number of steps taken
    t: Any  # the present instant; after a stop, that of the crossing
    length: Any  # of the step to try: h, or shorter when landing
    tries: Any  # how many times the last step was tried
    condition: Any  # a Condition

    @property
    def running(self) -> Any:
        """Whether another step is to be made or tried."""
        return self.condition <= Condition.LANDING

    @property
    def stopped(self) -> Any:
        """Whether the stop was reached."""
        return self.condition == Condition.STOPPED


def init_carry(loop: Loop, objectives: dict[str, Objective], h: Any) -> Carry:
    """Return the carry at t = 0."""
    state = loop.start()
    sample = loop.signals(0.0 * h, state).sample
    tally = {name: objective.start(sample) for name, objective in objectives.items()}
    zero = jnp.asarray(0)
    condition = jnp.where(loop.stop.margin(sample.output) > 0, zero + Condition.RUNNING, zero + Condition.DIVERGED)
    return _typed(Carry(state, tally, sample, zero, 0.0 * h, h, zero, condition), h.dtype)


def step(loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, steps: Any, carry: Carry) -> Carry:
    """Return the carry after one step; or one try of the last step; or the same if the run has ended."""
    state, tally, before, late = _advance(loop, objectives, h, key, carry)
    finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(state.flow())]))
    trying = carry.condition == Condition.LANDING
    crossed = finite & (loop.stop.margin(loop.plant.output(state.plant)) <= 0)
    landed = trying & (carry.tries == LANDINGS)
    ahead = (carry.condition == Condition.RUNNING) & finite & ~crossed
    search = carry.running & finite & ~landed & ~ahead
    taken = ahead | landed
    state, tally, before = jax.tree.map(
        lambda a, b: jnp.where(taken, a, b), (state, tally, before), (carry.state, carry.tally, carry.before)
    )
    k = carry.k + jnp.where(taken, 1, 0)
    after = jnp.where(landed, Condition.STOPPED, Condition.LANDING)
    after = jnp.where(ahead, jnp.where(k < steps, Condition.RUNNING, Condition.TIMED_OUT), after)
    after = jnp.where(finite, after, Condition.DIVERGED)
    return Carry(
        state=state,
        tally=tally,
        before=before,
        k=k,
        t=jnp.where(landed, carry.t + carry.length, jnp.where(ahead, k * h, carry.t)),
        length=jnp.where(search, clamp(carry.length + late, 0.0, h), carry.length),
        tries=carry.tries + jnp.where(search, 1, 0),
        condition=jnp.where(carry.running, after, carry.condition).astype(carry.condition.dtype),
    )


def _advance(
    loop: Loop, objectives: dict[str, Objective], h: Any, key: Any, carry: Carry
) -> tuple[LoopState, dict[str, Memory], Sample, Any]:
    """Update, jump, integrate over carry.length: state, accumulators, the sample after the jump, and how much later [s]
    the margin crosses zero. That time only chooses the next length, so it has no derivative."""
    signals = loop.signals(carry.t, carry.state)
    held = _update_objectives(objectives, carry, signals.sample, h)
    state, events = loop.jump(Clock(carry.t, h, carry.k, key), carry.state, signals)
    tally_flow = {name: memory.flow for name, memory in carry.tally.items()}

    def flow(t: Any, z: Any, state: LoopState = state) -> Any:
        return _rates(loop, objectives, held, t, state.with_flow(z[0]), z[1])

    z = (state.flow(), tally_flow)
    for event in events:
        z = _saltation(flow, carry.t, z, event)
    before = loop.signals(carry.t, state.with_flow(z[0])).sample
    z, rate = rk4_step_and_rate(flow, carry.t, z, carry.length)
    state = state.with_flow(z[0])
    state = state._replace(plant=loop.plant.project(state.plant))
    tally = {name: Memory(z[1][name], held[name]) for name in objectives}
    return state, tally, before, _landing_correction(loop, state.plant, rate[0][0])


def _saltation(flow: Any, t: Any, z: Any, event: Event) -> Any:
    """z at t, if the event happened `elapsed` ago and not now: back by that with the rates from before it, and forth
    again with those from after it, both by the midpoint rule."""

    def moved(t: Any, z: Any, e: Any, state: LoopState) -> Any:
        return axpy(e, flow(t + e / 2, axpy(e / 2, flow(t, z, state), z), state), z)

    e = event.elapsed
    return moved(t - e, moved(t, z, -e, event.before), e, event.after)


def _landing_correction(loop: Loop, plant: Any, rate: Any) -> Any:
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


def _update_objectives(objectives: dict[str, Objective], carry: Carry, sample: Sample, h: Any) -> dict[str, Any]:
    """`held` of the accumulators after the last interval, of length h, that ends on `sample`; there is none before the
    first step."""

    def updated(memory: Memory, objective: Objective) -> Any:
        held = objective.update(memory, carry.before, sample, h)
        return jax.tree.map(lambda a, b: jnp.where(carry.k > 0, a, b), held, memory.held)

    return {name: updated(carry.tally[name], o) for name, o in objectives.items()}


def finish(loop: Loop, objectives: dict[str, Objective], h: Any, carry: Carry) -> Carry:
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
    length = jnp.where(carry.stopped, carry.length + moved, h)
    held = _update_objectives(objectives, carry, loop.signals(carry.t, state).sample, length)
    return carry._replace(tally={name: Memory(tally[name], held[name]) for name in objectives})


def observe(loop: Loop, carry: Carry) -> Trajectory:
    """Return what is seen of the loop at the present instant."""
    signals = loop.signals(carry.t, carry.state)
    return Trajectory(signals.sample, signals.measured, carry.state.plant, carry.condition == Condition.RUNNING)


def _typed(tree: Any, dtype: Any) -> Any:
    """Strong types throughout: a scan refuses a carry whose type weakens or strengthens."""

    def typed(x: Any) -> Any:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(x.dtype)

    return jax.tree.map(typed, tree)
