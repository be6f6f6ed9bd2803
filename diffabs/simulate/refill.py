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
from diffabs.core.pytree import replace, strong
from diffabs.core.tracing import separated
from diffabs.simulate.condition import Condition
from diffabs.simulate.drivers import BLOCK, Carry
from diffabs.simulate.outcome import judge, prepare
from diffabs.simulate.run import arguments, without_derivatives
from diffabs.simulate.solution import Run, Solver

WIDTH = 1024  # lanes whose state stays in a processor's cache
ROUND = 64  # steps


class Enough(Protocol):
    """When a run may end before its stop and its time, because how it goes on is known; a pytree."""

    def own(self, number: Any) -> Any:
        """Return what it takes to say so of lane `number`, a pytree."""
        ...

    def reached(self, own: Any, output: Any) -> Any:
        """Whether a lane, of which this is its own and seen now, is taken off the belt."""
        ...


def run_refilled(
    loop: Loop,
    values: Mapping[str, Any],
    keys: Any,
    solver: Solver,
    objectives: Mapping[str, Objective],
    accepted: Any,
    enough: Enough | None = None,
) -> Run:
    """Return what `jax.vmap` of `measure` computes for lanes that differ in the values (lanes, ...) by path, and in
    their keys (lanes,) or None; `batch.run_batch` says what the arguments mean. Not for reverse mode.

    Raises ValueError for what `measure` objects to."""
    loop, objectives, method = arguments(loop, solver, objectives)
    values = strong(jax.tree.map(lambda x: jnp.asarray(x, method.h.dtype), dict(values)))
    values = {**values, **without_derivatives(loop, values)}
    return _run(loop, values, objectives, method, keys, accepted, enough, width=WIDTH)


def by_lane(
    loop: Loop, values: dict[str, Any], objectives: dict[str, Objective]
) -> tuple[Any, Callable[[Any], tuple[Any, Any]]]:
    """Return what is a lane's own of the loops with these values (lanes, ...), and a function from that of one lane to
    its loop, prepared, and what is measured."""
    leaves, whole = separated(lambda v: prepare(replace(loop, v)), values)

    def built(mine: Any) -> tuple[Loop, dict[str, Objective]]:
        one, audit = whole(mine)
        return one, objectives | audit

    return leaves, built


class _Belt(NamedTuple):
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
    enough: Enough | None,
    *,
    width: int,
) -> Run:
    count = len(accepted)
    leaves, built = by_lane(loop, values, objectives)
    step_all = jax.vmap(lambda mine, key, carry: method.step(*built(mine), key, carry))
    renew_all = jax.vmap(lambda mine, carry: method.renew(built(mine)[0], carry))
    start = jax.vmap(lambda mine, key: method.start(*built(mine), key))
    over = jax.vmap(lambda mine, carry: judge(*built(mine), carry)[0])

    def taken(number: Any) -> tuple[Any, Any, Carry]:
        """Lanes at their start; beyond the last one a copy of it that does not run."""
        mine, key, run = jax.tree.map(lambda x: x[jnp.minimum(number, count - 1)], (leaves, keys, accepted))
        carry = start(mine, key)
        condition = jnp.where(run & (number < count), carry.condition, Condition.DIVERGED)
        return mine, key, carry._replace(condition=condition.astype(carry.condition.dtype))

    def round_(belt: _Belt) -> _Belt:
        def some(carry: Carry, _: Any) -> tuple[Carry, None]:
            return step_all(belt.leaves, belt.keys, carry), None

        def rounds(carry: Any, _: Any) -> tuple[Any, None]:
            return jax.lax.scan(some, renew_all(belt.leaves, carry), length=BLOCK)[0], None

        belt = belt._replace(carry=jax.lax.scan(rounds, belt.carry, length=ROUND // BLOCK)[0])
        free = ~belt.carry.running | _seen_enough(enough, built, belt)
        return _exchanged(belt, free, over, taken, count)

    number = jnp.arange(min(width, count))
    first = taken(number)
    shapes = jax.eval_shape(over, first[0], first[2])
    ended = jax.tree.map(lambda x: jnp.zeros((count, *x.shape[1:]), x.dtype), shapes)
    belt = _Belt(*first, number, number[-1] + 1, ended)
    return jax.lax.while_loop(lambda belt: jnp.any(belt.number < count), round_, belt).ended


def _seen_enough(enough: Enough | None, built: Callable[[Any], Any], belt: _Belt) -> Any:
    """Lanes of which enough is seen; `built` makes the loop of one of what is its own."""
    if enough is None:
        return jnp.zeros_like(belt.carry.running)
    output = jax.vmap(lambda mine, at: built(mine)[0].plant.output(at.point.state.plant))(belt.leaves, belt.carry)
    return jax.vmap(lambda number, output: enough.reached(enough.own(number), output))(belt.number, output)


def _exchanged(
    belt: _Belt, free: Any, over: Callable[[Any, Carry], Run], taken: Callable[[Any], Any], count: int
) -> _Belt:
    """Put by the runs of lanes that are free (`over`), and take the next ones in their place (`taken`)."""
    place, runs = jnp.where(free, belt.number, count), over(belt.leaves, belt.carry)
    ended = jax.tree.map(lambda all, x: all.at[place].set(x, mode="drop"), belt.ended, runs)
    number = jnp.where(free, belt.next + jnp.cumsum(free) - 1, belt.number)
    old = (belt.leaves, belt.keys, belt.carry)
    mine, key, carry = jax.tree.map(partial(_by_lane, free), taken(number), old)
    return _Belt(mine, key, carry, jnp.minimum(number, count), belt.next + jnp.sum(free), ended)


def _by_lane(which: Any, a: Any, b: Any) -> Any:
    if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_by_lane(which, jax.random.key_data(a), jax.random.key_data(b)))
    return jnp.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b)
