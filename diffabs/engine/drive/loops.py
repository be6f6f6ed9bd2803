"""Loops that repeat the step of a run: to its end, or with a sample at every so many instants; for values or
derivatives.

    values          a while loop, which ends with the run: one program serves every duration
    derivatives     checkpointed scans, whose length is fixed at compilation: reverse mode keeps the carries

Scans have a capacity of attempts, rounded up to one of few values (`round_up_capacity`). Steps beyond the end of the
run do nothing. So a new duration compiles no new program for values, and a new program for derivatives only beyond the
capacity.
"""

import math
from collections.abc import Callable
from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp

from diffabs.core.lanes import any_lane, rematerialise
from diffabs.core.types import Array, Bool, Int, PyTree

X = TypeVar("X")


class _Running(Protocol):
    @property
    def running(self) -> Array: ...


MethodCarry = TypeVar("MethodCarry", bound=_Running)  # pytree of the stepping method
# Function of a carry and, for trajectories, of `until`, the number of the grid instant at which to pause.
Step = Callable[..., MethodCarry]
SCAN_GROUP_STEPS = 32  # attempts that are skipped together
SEGMENT_STEPS = 128  # least number of grid steps that reverse mode computes again together
MAX_SAVED_CARRIES = 1800  # carries that reverse mode keeps in one scan: some 0.2 MB for each run of a batch
BLOCKS_PER_GROUP = 32  # blocks of a logged run that are skipped together
STEPS_PER_BLOCK = 16  # steps between two checks of `running`, which is a reduction over the whole batch


def round_up_capacity(count: int) -> int:
    """Return the least number of at most four significant bits that is not less than `count`: up to an eighth more."""
    unit = 1 << max((count - 1).bit_length() - 4, 0)
    return -(-count // unit) * unit


def run_to_end(step: Step[MethodCarry], renew: Step[MethodCarry], carry: MethodCarry) -> MethodCarry:
    """Return the carry at the end of a run, or of a batch under `jax.vmap`. Not for reverse mode.

    `renew` is called once before each block of `STEPS_PER_BLOCK` steps.
    """

    def block(carry: MethodCarry) -> MethodCarry:
        return jax.lax.scan(lambda carry, _: (step(carry), None), renew(carry), length=STEPS_PER_BLOCK)[0]

    return jax.lax.while_loop(lambda carry: any_lane(carry.running), block, carry)


def run_with_trajectory(
    advance_to: Callable[[MethodCarry, Int], MethodCarry],
    look: Callable[[MethodCarry, PyTree], PyTree],
    carry: MethodCarry,
    every: Int,
    count: Int,
    room: int,
) -> tuple[MethodCarry, PyTree]:
    """Return the carry after `count` times `every` steps of the grid, and a sample after each `every`-th step.

    `advance_to(carry, i)` goes to the grid instant i or to the end of the run, such as `step_until`, and
    `look(carry, i)` is the sample there, with an attribute `running`. The samples have a leading axis of `room`. Those
    beyond `count`, and those after the first in which no run goes on, are zero. Not for reverse mode.
    """
    samples = jax.tree.map(lambda x: jnp.zeros((room, *x.shape), x.dtype), jax.eval_shape(look, carry, count))

    def segment(at: tuple[Int, PyTree, MethodCarry, PyTree]) -> tuple[Int, PyTree, MethodCarry, PyTree]:
        i, _, carry, samples = at
        until = (i + 1) * every
        carry = advance_to(carry, until)
        sample = look(carry, until)
        samples = jax.tree.map(lambda all, x: all.at[i].set(x), samples, sample)
        return i + 1, any_lane(jnp.any(sample.running)), carry, samples

    start = jnp.zeros_like(count), jnp.asarray(True), carry, samples
    return jax.lax.while_loop(lambda at: at[1] & (at[0] < count), segment, start)[2:]


def step_until(
    step: Step[MethodCarry],
    renew: Step[MethodCarry],
    before: Callable[[MethodCarry, PyTree], PyTree],
    carry: MethodCarry,
    until: Int,
) -> MethodCarry:
    """Return the carry at the grid instant `until`, or of a batch where every run is there. Not for reverse mode.

    `before(carry, i)` is True if the run goes on and has not reached the instant i.
    """

    def attempt(carry: MethodCarry) -> MethodCarry:
        return step(renew(carry), until=until)

    return jax.lax.while_loop(lambda carry: any_lane(before(carry, until)), attempt, carry)


def scan_with_trajectory(
    step: Step[MethodCarry],
    before: Callable[[MethodCarry, PyTree], PyTree],
    look: Callable[[MethodCarry, PyTree], PyTree],
    carry: MethodCarry,
    every: int,
    count: Int,
    instants: int,
    capacity: Callable[[int], int],
) -> tuple[MethodCarry, PyTree]:
    """Return what `run_with_trajectory` does, for derivatives. Between two samples there is room as in `scan_steps`.

    The samples have a leading axis of `instants`; those beyond `count` come from the final carry. Reverse mode keeps
    the carry at each sample, and computes the steps between two samples again.
    """

    def segment(carry: MethodCarry, i: Int) -> tuple[MethodCarry, PyTree]:
        until = (i + 1) * every

        def go_to_sample(carry: MethodCarry) -> MethodCarry:
            return scan_steps(step, before, carry, i * every, until, every, capacity)

        # The scan has `instants` rounds, the run only `count`: the rest is skipped, not computed and discarded.
        carry = jax.lax.cond(i < count, go_to_sample, lambda carry: carry, carry)
        return carry, look(carry, until)

    return jax.lax.scan(rematerialise(segment), carry, jnp.arange(instants))


def scan_steps(
    step: Step[MethodCarry],
    on: Callable[[MethodCarry, PyTree], PyTree],
    carry: MethodCarry,
    first: Int,
    last: Int | None,
    steps: int,
    capacity: Callable[[int], int],
) -> MethodCarry:
    """Return the carry at the grid instant `last`, or at the end of the run, from that at `first`. For derivatives.

    There is room for `steps` steps of the grid, and `capacity(n)` is the room for attempts in n of them. `on(carry, i)`
    is True if the run goes on and has not reached the instant i. Reverse mode keeps the carry of each attempt. If these
    are more than `MAX_SAVED_CARRIES`, it keeps the carry of each segment, and computes a segment again.

    Segments end at instants of the grid. Rounding may change the number of attempts in what is computed again, but not
    the instant.
    """

    def go(carry: MethodCarry, until: Int | None, steps: int) -> MethodCarry:
        return repeat_step(
            lambda carry: step(carry, until=until), carry, capacity(steps), lambda carry: on(carry, until)
        )

    if capacity(steps) <= MAX_SAVED_CARRIES:
        return go(carry, last, steps)
    length = max(SEGMENT_STEPS, math.ceil(steps / MAX_SAVED_CARRIES))

    def segment(carry: MethodCarry, i: Int) -> tuple[MethodCarry, None]:
        end = first + (i + 1) * length
        until = end if last is None else jnp.minimum(end, last)
        running = any_lane(jax.lax.stop_gradient(on(carry, until)))
        return jax.lax.cond(running, lambda carry: go(carry, until, length), lambda carry: carry, carry), None

    return jax.lax.scan(rematerialise(segment), carry, jnp.arange(math.ceil(steps / length)))[0]


def repeat_step(step: Callable[[X], X], carry: X, capacity: int, on: Callable[[X], PyTree]) -> X:
    """Return the carry after whole groups of steps, with room for at least `capacity` steps.

    A group is skipped where `on(carry)` is False for all runs of the batch. Within a group `on` is not asked: `step`
    must leave a run that is over as it is. Reverse mode keeps the carry and the decisions of each step.
    """
    length = min(SCAN_GROUP_STEPS, capacity)

    def group(carry: X) -> X:
        body = rematerialise(lambda carry, _: (step(carry), None), keeps_decisions=True)
        return jax.lax.scan(body, carry, length=length)[0]

    def body(carry: X, _: object) -> tuple[X, None]:
        running = any_lane(jax.lax.stop_gradient(on(carry)))
        return jax.lax.cond(running, group, lambda carry: carry, carry), None

    return jax.lax.scan(body, carry, length=math.ceil(capacity / length))[0]


def log_run(
    step: Step[MethodCarry],
    renew: Step[MethodCarry],
    log: Callable[[MethodCarry, MethodCarry], PyTree],
    carry: MethodCarry,
    room: int,
) -> tuple[MethodCarry, PyTree]:
    """Return the carry at the end of a run, and the entry log(before, after) of each attempt, at least `room` of them.

    The log is in blocks of shape (blocks, `STEPS_PER_BLOCK`, ...). Blocks after the end of the run are zero. `renew` is
    called once before each block.
    """

    def attempt(carry: MethodCarry, _: None) -> tuple[MethodCarry, PyTree]:
        new = step(carry)
        return new, log(carry, new)

    def block(carry: MethodCarry, _: None) -> tuple[MethodCarry, PyTree]:
        return jax.lax.scan(attempt, renew(carry), length=STEPS_PER_BLOCK)

    return _scan_active(
        block,
        lambda carry, _: carry.running,
        carry,
        None,
        BLOCKS_PER_GROUP * math.ceil(room / (BLOCKS_PER_GROUP * STEPS_PER_BLOCK)),
    )


def replay_log(
    step: Callable[[MethodCarry, PyTree], MethodCarry],
    keep: Callable[[MethodCarry], PyTree],
    accepted: Callable[[PyTree], Array],
    carry: MethodCarry,
    log: object,
) -> tuple[MethodCarry, PyTree]:
    """Return the carry after all logged attempts, and keep(carry) after each, in the blocks of the log.

    A block in which no attempt is `accepted` is skipped: zeros. Reverse mode keeps the carry before each block, and
    computes the attempts of a block again.
    """

    def attempt(carry: MethodCarry, entry: object) -> tuple[MethodCarry, PyTree]:
        carry = step(carry, entry)
        return carry, keep(carry)

    # Checkpoints on both levels: memory for the states of the blocks plus those of one block.
    @rematerialise
    def block(carry: MethodCarry, entries: PyTree) -> tuple[MethodCarry, PyTree]:
        return jax.lax.scan(rematerialise(attempt, keeps_decisions=True), carry, entries)

    blocks = len(accepted(log))
    return _scan_active(block, lambda _, entries: jnp.any(accepted(entries)), carry, log, blocks)


def _scan_active(
    work: Callable[[MethodCarry, PyTree], tuple[MethodCarry, PyTree]],
    on: Callable[[MethodCarry, PyTree], Bool],
    carry: MethodCarry,
    xs: object,
    length: int,
) -> tuple[MethodCarry, PyTree]:
    """Return the result of a scan of `work` over blocks. Where no run of the batch is `on`, a block is skipped: zeros.

    Most of the capacity is not needed. To skip a block costs almost as much as a short step. So whole groups of
    `BLOCKS_PER_GROUP` blocks are skipped as well; `length` is a multiple of it.
    """

    def skip_unless_on(work: Callable) -> Callable:
        def body(carry: MethodCarry, x: object) -> tuple[MethodCarry, PyTree]:
            def skip() -> tuple[MethodCarry, PyTree]:
                return carry, jax.tree.map(lambda y: jnp.zeros(y.shape, y.dtype), jax.eval_shape(work, carry, x)[1])

            return jax.lax.cond(any_lane(on(carry, x)), lambda: work(carry, x), skip)

        return body

    def group(carry: MethodCarry, xs: object) -> tuple[MethodCarry, PyTree]:
        return jax.lax.scan(skip_unless_on(work), carry, xs, length=BLOCKS_PER_GROUP)

    groups = length // BLOCKS_PER_GROUP
    split = jax.tree.map(lambda x: jnp.reshape(x, (groups, BLOCKS_PER_GROUP, *x.shape[1:])), xs)
    carry, ys = jax.lax.scan(skip_unless_on(group), carry, split, length=groups)
    return carry, jax.tree.map(lambda y: jnp.reshape(y, (length, *y.shape[2:])), ys)
