"""Repeat a step many times with little memory for reverse mode."""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.custom_batching
import jax.numpy as jnp

X = TypeVar("X")
SCAN_GROUP_STEPS = 32  # steps that are skipped together, where no more than SLOTS are made
MAX_SAVED_CARRIES = 1800  # carries that reverse mode keeps in one scan: some 0.2 MB for each lane of a batch


def repeat_step(step: Callable[[X], X], carry: X, capacity: int, on: Callable[[X], Any]) -> X:
    """Return step(step(... carry)), in nested scans that have room for `room` steps.

    Groups of steps where `on(carry)` is False are skipped; for a batch under `jax.vmap` only if that is one number for
    all lanes. `step` must do nothing there. Reverse mode keeps the carries of the steps, or, of more than SLOTS, those
    of groups, whose steps it then runs once more.
    """
    outer, inner = nested_scan_lengths(capacity)

    def group(carry: X) -> X:
        return jax.lax.scan(rematerialise(lambda carry, _: (step(carry), None)), carry, length=inner)[0]

    def body(carry: X, _: Any) -> tuple[X, None]:
        return jax.lax.cond(on(carry), group, lambda carry: carry, carry), None

    return jax.lax.scan(rematerialise(body) if capacity > MAX_SAVED_CARRIES else body, carry, length=outer)[0]


def nested_scan_lengths(count: int) -> tuple[int, int]:
    """Return how many groups of how many steps make `count`: of GROUP, or of so many that groups and steps in a group
    are at most 3/2 SLOTS together, whatever the number of steps up to SLOTS^2/2."""
    inner = math.ceil(count / MAX_SAVED_CARRIES) if count > MAX_SAVED_CARRIES else min(SCAN_GROUP_STEPS, count)
    return math.ceil(count / inner), inner


@jax.custom_batching.custom_vmap
def any_lane(running: Any) -> Any:
    """Return whether any lane of a batch under `jax.vmap` still runs, the same for all of them: a step does nothing in
    a lane that is over. A condition of each lane's own would become a selection between all carries, in every step."""
    return running


@any_lane.def_vmap
def _(size: int, batched: Any, running: Any) -> tuple[Any, bool]:
    del size
    return (any_lane(jnp.any(running, axis=0)), False) if batched[0] else (any_lane(running), False)


def jit_barrier(active: Any, work: Callable[[], X]) -> X:
    """Return work(), compiled by itself and not once more into everything that is made of it; zeros where no lane is
    active."""
    work = jax.jit(work)  # traced once for its shape and for its program
    shape = jax.eval_shape(work)
    return jax.lax.cond(any_lane(active), work, lambda: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape))


def rematerialise(body: Any) -> Any:
    """Reverse mode keeps the arguments of `body` and works everything else out again."""
    return jax.checkpoint(body, policy=jax.checkpoint_policies.nothing_saveable, prevent_cse=False)
