"""Many runs at once, none of which waits for another: for values, not for gradients.

A batch under `jax.vmap` runs until its slowest lane ends. Here `width` lanes run at a time, like boxes on a belt: every
ROUND steps what has ended is taken off and the next lanes are put in its place."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from diffabs.core.loop import Loop
from diffabs.core.protocols import Objective
from diffabs.core.pytree import canonical_dtypes, replace
from diffabs.core.tracing import split_batched
from diffabs.simulate.condition import RunStatus
from diffabs.simulate.drivers import STEPS_PER_BLOCK, Carry
from diffabs.simulate.result import finish_run, prepare
from diffabs.simulate.run import forbid_derivatives, prepare_arguments
from diffabs.simulate.solution import Run, Solver

LANES_AT_ONCE = 1024  # lanes whose state stays in a processor's cache
STEPS_PER_EXCHANGE = 64  # steps


class EarlyEnd(Protocol):
    """When a run may end before its stop and its time, because how it goes on is known; a pytree."""

    def own(self, number: Any) -> Any:
        """Return what it takes to say so of lane `number`, a pytree."""
        ...

    def reached(self, own: Any, output: Any) -> Any:
        """Whether a lane, of which this is its own and seen now, is taken off the belt."""
        ...


def run_packed(
    loop: Loop,
    values: Mapping[str, Any],
    keys: Any,
    solver: Solver,
    objectives: Mapping[str, Objective],
    accepted: Any,
    enough: EarlyEnd | None = None,
) -> Run:
    """Return what `jax.vmap` of `measure` computes for lanes that differ in the values (lanes, ...) by path, and in
    their keys (lanes,) or None; `batch.run_batch` says what the arguments mean. Not for reverse mode.

    Raises ValueError for what `measure` objects to."""
    loop, objectives, method = prepare_arguments(loop, solver, objectives)
    values = canonical_dtypes(jax.tree.map(lambda x: jnp.asarray(x, method.h.dtype), dict(values)))
    values = {**values, **forbid_derivatives(loop, values)}
    return _run(loop, values, objectives, method, keys, accepted, enough, width=LANES_AT_ONCE)


def split_by_lane(
    loop: Loop, values: dict[str, Any], objectives: dict[str, Objective]
) -> tuple[Any, Callable[[Any], tuple[Any, Any]]]:
    """Return what is a lane's own of the loops with these values (lanes, ...), and a function from that of one lane to
    its loop, prepared, and what is measured."""
    leaves, whole = split_batched(lambda v: prepare(replace(loop, v)), values)

    def built(mine: Any) -> tuple[Loop, dict[str, Objective]]:
        one, audit = whole(mine)
        return one, objectives | audit

    return leaves, built


class _LaneSlots(NamedTuple):
    """Lanes on their way: what is their own of their loops, key and carry of each; its number (how many lanes there are
    if it has none), the next number; and what has ended, by number."""

    leaves: Any
    keys: Any
    carry: Carry
    number: Any
    next: Any
    ended: Run


@partial(jax.jit, static_argnames="width")
def _run(
    loop: Loop,
    values: dict[str, Any],
    objectives: dict[str, Objective],
    method: Any,
    keys: Any,
    accepted: Any,
    enough: EarlyEnd | None,
    *,
    width: int,
) -> Run:
    count = len(accepted)
    leaves, built = split_by_lane(loop, values, objectives)
    step_all = jax.vmap(lambda mine, key, carry: method.step(*built(mine), key, carry))
    renew_all = jax.vmap(lambda mine, carry: method.renew(built(mine)[0], carry))
    start = jax.vmap(lambda mine, key: method.start(*built(mine), key))
    over = jax.vmap(lambda mine, carry: finish_run(*built(mine), carry)[0])

    def taken(number: Any) -> tuple[Any, Any, Carry]:
        """Lanes at their start; beyond the last one a copy of it that does not run."""
        mine, key, run = jax.tree.map(lambda x: x[jnp.minimum(number, count - 1)], (leaves, keys, accepted))
        carry = start(mine, key)
        status = jnp.where(run & (number < count), carry.status, RunStatus.DIVERGED)
        return mine, key, carry._replace(status=status.astype(carry.status.dtype))

    def round_(slots: _LaneSlots) -> _LaneSlots:
        def some(carry: Carry, _: Any) -> tuple[Carry, None]:
            return step_all(slots.leaves, slots.keys, carry), None

        def rounds(carry: Any, _: Any) -> tuple[Any, None]:
            return jax.lax.scan(some, renew_all(slots.leaves, carry), length=STEPS_PER_BLOCK)[0], None

        slots = slots._replace(carry=jax.lax.scan(rounds, slots.carry, length=STEPS_PER_EXCHANGE // STEPS_PER_BLOCK)[0])
        free = ~slots.carry.running | _lanes_ended_early(enough, built, slots)
        return _exchange_lanes(slots, free, over, taken, count)

    number = jnp.arange(min(width, count))
    first = taken(number)
    shapes = jax.eval_shape(over, first[0], first[2])
    ended = jax.tree.map(lambda x: jnp.zeros((count, *x.shape[1:]), x.dtype), shapes)
    slots = _LaneSlots(*first, number, number[-1] + 1, ended)
    return jax.lax.while_loop(lambda slots: jnp.any(slots.number < count), round_, slots).ended


def _lanes_ended_early(enough: EarlyEnd | None, built: Callable[[Any], Any], slots: _LaneSlots) -> Any:
    """Lanes of which enough is seen; `built` makes the loop of one of what is its own."""
    if enough is None:
        return jnp.zeros_like(slots.carry.running)
    output = jax.vmap(lambda mine, at: built(mine)[0].plant.output(at.point.state.plant))(slots.leaves, slots.carry)
    return jax.vmap(lambda number, output: enough.reached(enough.own(number), output))(slots.number, output)


def _exchange_lanes(
    slots: _LaneSlots, free: Any, over: Callable[[Any, Carry], Run], taken: Callable[[Any], Any], count: int
) -> _LaneSlots:
    """Put by the runs of lanes that are free (`over`), and take the next ones in their place (`taken`)."""
    place, runs = jnp.where(free, slots.number, count), over(slots.leaves, slots.carry)
    ended = jax.tree.map(lambda all, x: all.at[place].set(x, mode="drop"), slots.ended, runs)
    number = jnp.where(free, slots.next + jnp.cumsum(free) - 1, slots.number)
    old = (slots.leaves, slots.keys, slots.carry)
    mine, key, carry = jax.tree.map(partial(_select_lanes, free), taken(number), old)
    return _LaneSlots(mine, key, carry, jnp.minimum(number, count), slots.next + jnp.sum(free), ended)


def _select_lanes(which: Any, a: Any, b: Any) -> Any:
    if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_select_lanes(which, jax.random.key_data(a), jax.random.key_data(b)))
    return jnp.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b)
