"""Repetition of a step with little memory in reverse mode, and JAX helpers for conditions of a batch."""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.custom_batching
import jax.numpy as jnp

from diffabs.core.types import Bool, PyTree

X = TypeVar("X")
SCAN_GROUP_STEPS = 32  # steps that are skipped together, in scans of at most MAX_SAVED_CARRIES steps
MAX_SAVED_CARRIES = 1800  # carries that reverse mode keeps in one scan: some 0.2 MB for each run of a batch


def repeat_step(step: Callable[[X], X], carry: X, capacity: int, on: Callable[[X], PyTree]) -> X:
    """Return the carry after `capacity` applications of `step`, in nested scans.

    Groups of steps are skipped while `on(carry)` is False; there, `step` must return its argument. In a batch under
    `jax.vmap` groups are skipped only if `on` returns one value for all runs (`any_lane`). Reverse mode keeps the carry
    of each step. Beyond `MAX_SAVED_CARRIES` steps it keeps the carry of each group and computes the steps of a group
    again.

    Args:
        step: Function from carry to carry.
        carry: Carry before the first step.
        capacity: Number of steps for which there is room.
        on: Function of the carry: True if the run goes on.
    """
    outer, inner = nested_scan_lengths(capacity)

    def group(carry: X) -> X:
        return jax.lax.scan(rematerialise(lambda carry, _: (step(carry), None)), carry, length=inner)[0]

    def body(carry: X, _: Any) -> tuple[X, None]:
        return jax.lax.cond(on(carry), group, lambda carry: carry, carry), None

    # Checkpoints on both levels: memory for the carries of the groups plus those of one group at a time.
    return jax.lax.scan(rematerialise(body) if capacity > MAX_SAVED_CARRIES else body, carry, length=outer)[0]


def nested_scan_lengths(count: int) -> tuple[int, int]:
    """Return the number of groups and the number of steps in a group for at least `count` steps.

    Up to `MAX_SAVED_CARRIES` steps a group has `SCAN_GROUP_STEPS` steps. Beyond, both numbers together are at most 3/2
    `MAX_SAVED_CARRIES`, up to a count of MAX_SAVED_CARRIES^2/2.

    Args:
        count: Number of steps.
    """
    inner = math.ceil(count / MAX_SAVED_CARRIES) if count > MAX_SAVED_CARRIES else min(SCAN_GROUP_STEPS, count)
    return math.ceil(count / inner), inner


@jax.custom_batching.custom_vmap
def any_lane(running: Bool) -> Bool:
    """Return True if any run of a batch under `jax.vmap` is still running, the same value for all runs.

    With one condition for all runs `jax.lax.cond` skips the work. With one condition for each run JAX would execute
    both branches and select between all carries in every step. A step must therefore do nothing in a run that is over.

    Args:
        running: True if this run goes on.
    """
    return running


@any_lane.def_vmap
def _(size: int, batched: Any, running: Bool) -> tuple[PyTree, bool]:
    del size
    # The result is unbatched, and `any_lane` again covers a further `vmap` around this one.
    return (any_lane(jnp.any(running, axis=0)), False) if batched[0] else (any_lane(running), False)


def jit_barrier(active: Bool, work: Callable[[], X]) -> X:
    """Return work(), compiled as one unit; zeros if no run of a batch is active.

    XLA would otherwise compile a copy of `work` into each expression that uses the result.

    Args:
        active: True if this run is active.
        work: Function without arguments that returns a pytree of arrays.
    """
    work = jax.jit(work)  # traced once for its shape and for its program
    shape = jax.eval_shape(work)
    return jax.lax.cond(any_lane(active), work, lambda: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape))


def rematerialise(body: Any) -> PyTree:
    """Return `body` with checkpointing: reverse mode keeps only its arguments and computes everything else again.

    Args:
        body: Function to wrap, usually the body of a scan.
    """
    return jax.checkpoint(body, policy=jax.checkpoint_policies.nothing_saveable, prevent_cse=False)
