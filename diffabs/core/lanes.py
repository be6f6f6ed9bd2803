"""JAX helpers for the body of a step: conditions of a whole batch, units of compilation, and checkpoints."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.custom_batching
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from diffabs.core.types import Bool, PyTree

X = TypeVar("X")
DECISION = "decision"  # name of what checkpoints keep (`keep_decision`)


@jax.custom_batching.custom_vmap
def any_lane(running: Bool) -> Bool:
    """Return True if any run of a batch under `jax.vmap` is still running, the same value for all runs.

    With one condition for all runs `jax.lax.cond` skips the work. With one condition for each run JAX would execute
    both branches and select between all carries in every step. A step must therefore do nothing in a run that is over.
    """
    return running


@any_lane.def_vmap
def _(size: int, batched: Sequence[bool], running: Bool) -> tuple[PyTree, bool]:
    del size
    # The result is unbatched, and `any_lane` again covers a further `vmap` around this one.
    return (any_lane(jnp.any(running, axis=0)), False) if batched[0] else (any_lane(running), False)


def jit_barrier(active: Bool, work: Callable[[], X]) -> X:
    """Return work(), compiled as one unit; zeros if no run of a batch is active.

    XLA would otherwise compile a copy of `work` into each expression that uses the result.
    """
    work = jax.jit(work)  # traced once for its shape and for its program
    shape = jax.eval_shape(work)
    return jax.lax.cond(any_lane(active), work, lambda: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape))


def rematerialise(body: Callable[..., PyTree], keeps_decisions: bool = False) -> Callable[..., PyTree]:
    """Return `body` with checkpointing: reverse mode keeps its arguments, and its decisions if `keeps_decisions`.

    It computes everything else again.
    """
    names = (DECISION,) if keeps_decisions else ()
    return jax.checkpoint(body, policy=jax.checkpoint_policies.save_only_these_names(*names), prevent_cse=False)


def keep_decision(decision: X) -> X:
    """Return the `decision`, a pytree, for `rematerialise` to keep.

    What XLA computes again it may round in another way. A decision that depends on the last digits would then be
    another one, and the derivative that of no run.
    """
    return jax.tree.map(lambda x: checkpoint_name(x, DECISION), decision)


def select(condition: Bool, a: X, b: X) -> X:
    """Return a where the condition holds, else b, a pytree of the same structure."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
