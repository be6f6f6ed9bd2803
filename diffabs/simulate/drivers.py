"""What repeats the step of a run: until it ends, with a look at every so many instants, or so that it can be reversed.

    values          a while loop: it ends when the run does, and one program serves every duration
    derivatives     checkpointed scans, whose length is known when they are compiled: reverse mode keeps the carries

The second have a number of slots, few different ones (`slots`), and do nothing in what is left over of them. So a new
duration compiles no new program for values, and for derivatives only beyond the slots that there are."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from diffabs.simulate.checkpoint import any_lane, rematerialise, repeat_step

Carry = Any  # of whatever chooses the steps; it says whether it is `running`
Step = Callable[..., Carry]  # of a carry, and of the instant to which it goes, `until`, where it is not the end
STEPS_PER_BLOCK = 16  # steps between two questions whether anything still runs


def round_up_capacity(count: int) -> int:
    """Return the least number of at most four significant bits that is not less than `count`: up to an eighth more."""
    unit = 1 << max((count - 1).bit_length() - 4, 0)
    return -(-count // unit) * unit


def run_to_end(step: Step, renew: Step, carry: Carry) -> Carry:
    """Return the carry (one run, or a batch under `jax.vmap`) of a run that is over; `renew` is called once for a block
    of steps. Not for reverse mode."""

    def block(carry: Carry) -> Carry:
        return jax.lax.scan(lambda carry, _: (step(carry), None), renew(carry), length=STEPS_PER_BLOCK)[0]

    return jax.lax.while_loop(lambda carry: any_lane(carry.running), block, carry)


def run_with_trajectory(
    step: Step,
    renew: Step,
    before: Callable[[Carry, Any], Any],
    look: Callable[[Carry, Any], Any],
    carry: Carry,
    every: Any,
    count: Any,
    room: int,
) -> tuple[Carry, Any]:
    """Return the carry after `count` times `every` steps of the grid, and what was seen after each `every`-th, with a
    leading axis of `room`, at least `count`: what is beyond is zero. `before` says whether a run goes on, and has not
    come to an instant. Not for reverse mode."""
    seen = jax.tree.map(lambda x: jnp.zeros((room, *x.shape), x.dtype), jax.eval_shape(look, carry, count))

    def segment(i: Any, at: tuple[Carry, Any]) -> tuple[Carry, Any]:
        until = (i + 1) * every

        def some(carry: Carry) -> Carry:
            return step(renew(carry), until=until)

        carry = jax.lax.while_loop(lambda carry: any_lane(before(carry, until)), some, at[0])
        return carry, jax.tree.map(lambda all, x: all.at[i].set(x), at[1], look(carry, until))

    return jax.lax.fori_loop(0, count, segment, (carry, seen))


def scan_to_end(step: Step, carry: Carry, room: int) -> Carry:
    """Return the carry of a run that is over, after at most `room` tries; for derivatives."""
    return repeat_step(step, carry, room, lambda carry: _any_running(carry.running))


def scan_with_trajectory(
    step: Step,
    before: Callable[[Carry, Any], Any],
    look: Callable[[Carry, Any], Any],
    carry: Carry,
    every: int,
    count: Any,
    instants: int,
    room: int,
) -> tuple[Carry, Any]:
    """Return what `watch` does, `instants` for its room; each segment has room for so many tries. For derivatives."""

    def segment(carry: Carry, i: Any) -> tuple[Carry, Any]:
        until = (i + 1) * every

        def on(carry: Carry) -> Any:
            return _any_running(before(carry, until))

        def some(carry: Carry) -> Carry:
            return repeat_step(lambda carry: step(carry, until=until), carry, room, on)

        carry = jax.lax.cond(i < count, some, lambda carry: carry, carry)
        return carry, look(carry, until)

    return jax.lax.scan(rematerialise(segment), carry, jnp.arange(instants))


def _any_running(running: Any) -> Any:
    return any_lane(jax.lax.stop_gradient(running))
