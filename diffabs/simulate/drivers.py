"""What repeats the step of a run: until it ends, with a look at every so many instants, or so that it can be reversed.

    values          a while loop: it ends when the run does, and one program serves every duration
    derivatives     checkpointed scans, whose length is known when they are compiled: reverse mode keeps the carries

The second have a number of slots, few different ones (`slots`), and do nothing in what is left over of them. So a new
duration compiles no new program for values, and for derivatives only beyond the slots that there are."""

from collections.abc import Callable
from typing import Any

import jax
import jax.custom_batching
import jax.numpy as jnp

from diffabs.simulate.checkpoint import forgetful, repeated
from diffabs.simulate.hybrid_step import Carry

Step = Callable[[Carry], Carry]
BLOCK = 32  # steps between two questions whether anything still runs


def slots(count: int) -> int:
    """Return the least number of at most four significant bits that is not less than `count`: up to an eighth more."""
    unit = 1 << max((count - 1).bit_length() - 4, 0)
    return -(-count // unit) * unit


@jax.custom_batching.custom_vmap
def anyone(running: Any) -> Any:
    """Return whether any lane of a batch under `jax.vmap` still runs, the same for all of them: a step does nothing in
    a lane that is over. A condition of each lane's own would become a selection between all carries, in every step."""
    return running


@anyone.def_vmap
def _(size: int, batched: Any, running: Any) -> tuple[Any, bool]:
    del size
    return (anyone(jnp.any(running, axis=0)), False) if batched[0] else (anyone(running), False)


def until(step: Step, carry: Carry) -> Carry:
    """Return the carry (one run, or a batch under `jax.vmap`) of a run that is over. Not for reverse mode."""

    def block(carry: Carry) -> Carry:
        return jax.lax.scan(lambda carry, _: (step(carry), None), carry, length=BLOCK)[0]

    return jax.lax.while_loop(lambda carry: anyone(carry.running), block, carry)


def watch(
    step: Step, look: Callable[[Carry], Any], carry: Carry, every: Any, count: Any, room: int
) -> tuple[Carry, Any]:
    """Return the carry after `count` times `every` steps, and what was seen after each `every`-th, with a leading axis
    of `room`, at least `count`: what is beyond is zero. Not for reverse mode."""
    seen = jax.tree.map(lambda x: jnp.zeros((room, *x.shape), x.dtype), jax.eval_shape(look, carry))

    def some(carry: Carry) -> Carry:
        return jax.lax.fori_loop(0, every, lambda _, carry: step(carry), carry)

    def segment(i: Any, at: tuple[Carry, Any]) -> tuple[Carry, Any]:
        carry = jax.lax.cond(_on(at[0]), some, lambda carry: carry, at[0])
        return carry, jax.tree.map(lambda all, x: all.at[i].set(x), at[1], look(carry))

    return jax.lax.fori_loop(0, count, segment, (carry, seen))


def scan(step: Step, carry: Carry, count: Any, room: int) -> Carry:
    """Return the carry after `count` steps, at most `room`; for derivatives."""
    return repeated(step, carry, room, _on, count)


def scan_and_watch(
    step: Step, look: Callable[[Carry], Any], carry: Carry, every: int, count: Any, room: int
) -> tuple[Carry, Any]:
    """Return what `watch` does; for derivatives."""

    def segment(carry: Carry, i: Any) -> tuple[Carry, Any]:
        def some(carry: Carry) -> Carry:
            return repeated(step, carry, every, _on, every)

        carry = jax.lax.cond(i < count, some, lambda carry: carry, carry)
        return carry, look(carry)

    return jax.lax.scan(forgetful(segment), carry, jnp.arange(room))


def _on(carry: Carry) -> Any:
    return anyone(jax.lax.stop_gradient(carry.running))
