"""Loops that repeat the step of a run: to its end, or with a sample at every so many instants; for values or
derivatives.

    values          a while loop, which ends with the run: one program serves every duration
    derivatives     checkpointed scans, whose length is fixed at compilation: reverse mode keeps the carries

Scans have a capacity of attempts, rounded up to one of few values (`round_up_capacity`). Steps beyond the end of the
run do nothing. So a new duration compiles no new program for values, and a new program for derivatives only beyond the
capacity.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from diffabs.core.types import Bool, Int, PyTree
from diffabs.simulate.drive.checkpoint import any_lane, rematerialise, repeat_step

Carry = Any  # pytree of the stepping method, with an attribute `running`
Step = Callable[..., Carry]  # function of a carry and, for trajectories, of `until`, the instant at which to pause
STEPS_PER_BLOCK = 16  # steps between two checks of `running`, which is a reduction over the whole batch


def round_up_capacity(count: int) -> int:
    """Return the least number of at most four significant bits that is not less than `count`: up to an eighth more.

    Args:
        count: Number of attempts or instants.
    """
    unit = 1 << max((count - 1).bit_length() - 4, 0)
    return -(-count // unit) * unit


def run_to_end(step: Step, renew: Step, carry: Carry) -> Carry:
    """Return the carry at the end of a run, or of a batch under `jax.vmap`. Not for reverse mode.

    Args:
        step: Function from carry to carry: one attempt of a step.
        renew: Function from carry to carry, called once before each block of `STEPS_PER_BLOCK` steps.
        carry: Carry at t = 0.
    """

    def block(carry: Carry) -> Carry:
        return jax.lax.scan(lambda carry, _: (step(carry), None), renew(carry), length=STEPS_PER_BLOCK)[0]

    return jax.lax.while_loop(lambda carry: any_lane(carry.running), block, carry)


def run_with_trajectory(
    step: Step,
    renew: Step,
    before: Callable[[Carry, PyTree], PyTree],
    look: Callable[[Carry, PyTree], PyTree],
    carry: Carry,
    every: Any,
    count: Int,
    room: int,
) -> tuple[Carry, PyTree]:
    """Return the carry after `count` times `every` steps of the grid, and a sample after each `every`-th step.

    The samples have a leading axis of `room`; those beyond `count` are zero. Not for reverse mode.

    Args:
        step: Function of the carry and of `until`, the instant at which it pauses: one attempt of a step.
        renew: Function from carry to carry, called once before each attempt.
        before: Function of carry and instant: True if the run goes on and has not reached that instant.
        look: Function of carry and instant that returns the sample.
        carry: Carry at t = 0.
        every: Number of grid steps between two samples.
        count: Number of samples.
        room: Capacity for samples, at least `count`.
    """
    seen = jax.tree.map(lambda x: jnp.zeros((room, *x.shape), x.dtype), jax.eval_shape(look, carry, count))

    def segment(i: Int, at: tuple[Carry, PyTree]) -> tuple[Carry, PyTree]:
        until = (i + 1) * every

        def some(carry: Carry) -> Carry:
            return step(renew(carry), until=until)

        carry = jax.lax.while_loop(lambda carry: any_lane(before(carry, until)), some, at[0])
        return carry, jax.tree.map(lambda all, x: all.at[i].set(x), at[1], look(carry, until))

    return jax.lax.fori_loop(0, count, segment, (carry, seen))


def scan_to_end(step: Step, carry: Carry, room: int) -> Carry:
    """Return the carry at the end of a run after at most `room` attempts; for derivatives.

    Args:
        step: Function from carry to carry: one attempt of a step.
        carry: Carry at t = 0.
        room: Capacity for attempts.
    """
    return repeat_step(step, carry, room, lambda carry: _any_running(carry.running))


def scan_with_trajectory(
    step: Step,
    before: Callable[[Carry, PyTree], PyTree],
    look: Callable[[Carry, PyTree], PyTree],
    carry: Carry,
    every: int,
    count: Int,
    instants: int,
    room: int,
) -> tuple[Carry, PyTree]:
    """Return the result of `run_with_trajectory` with room for `instants` samples; for derivatives.

    Args:
        step: Function of the carry and of `until`, the instant at which it pauses: one attempt of a step.
        before: Function of carry and instant: True if the run goes on and has not reached that instant.
        look: Function of carry and instant that returns the sample.
        carry: Carry at t = 0.
        every: Number of grid steps between two samples.
        count: Number of samples.
        instants: Capacity for samples, at least `count`.
        room: Capacity for attempts between two samples.
    """

    def segment(carry: Carry, i: Int) -> tuple[Carry, PyTree]:
        until = (i + 1) * every

        def on(carry: Carry) -> Any:
            return _any_running(before(carry, until))

        def some(carry: Carry) -> Carry:
            return repeat_step(lambda carry: step(carry, until=until), carry, room, on)

        # The scan has `instants` rounds, the run only `count`: the rest is skipped, not computed and discarded.
        carry = jax.lax.cond(i < count, some, lambda carry: carry, carry)
        return carry, look(carry, until)

    return jax.lax.scan(rematerialise(segment), carry, jnp.arange(instants))


def _any_running(running: Bool) -> Bool:
    """Return `any_lane(running)` without a derivative."""
    return any_lane(jax.lax.stop_gradient(running))
