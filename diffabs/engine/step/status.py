"""Status of a run: running, searching for an event, or over, and the reason."""

import enum
from functools import reduce

import jax
import jax.numpy as jnp

from diffabs.core.types import Array, PyTree, Scalar
from diffabs.engine.hybrid import HybridSystem

# A landing on the stop may leave at most this fraction of the margin's change in the step.
MAX_MISSED_FRACTION = 0.1


class RunStatus(enum.IntEnum):
    """Status of a run; every value up to `REFRESHING` means that the run goes on.

    Attributes:
        RUNNING: The next attempt is an ordinary step.
        SEEKING: Attempts shrink a bracket around an event.
        PROBING: The attempt measures how the margin falls near the event.
        REFINING: The attempt provides second derivatives of the event's time.
        LANDING: The attempt ends on the event.
        REFRESHING: A step of length 0 evaluates the rates after the event, or beyond the switching surface.
        STOPPED: The run is over and has reached its stop.
        TIMED_OUT: The run is over because its duration has passed.
        DIVERGED: The run is over because its numbers are invalid, or no step meets its tolerance.
        EXHAUSTED: The run is over because its attempts are too many.
        MISSED: The run is over because its landing misses the stop, or its start is beyond the stop.
        REFUSED: The run was not accepted, and over from the beginning.
        SLID: The run is over because it slides along a switching surface; only with `WatchedModes`.
        GRAZED: The run is over because a margin only touches zero; only with `WatchedModes`.
    """

    RUNNING, SEEKING, PROBING, REFINING, LANDING, REFRESHING, STOPPED, TIMED_OUT = range(8)
    DIVERGED, EXHAUSTED, MISSED, REFUSED, SLID, GRAZED = range(8, 14)


def is_running(carry: PyTree) -> Array:
    """Return True if the run needs another attempt."""
    return carry.status <= RunStatus.REFRESHING


def end_unfinished(carry: PyTree) -> PyTree:
    """Return the carry after the last attempt for which there is capacity: a run that still goes on is exhausted."""
    status = jnp.where(is_running(carry), RunStatus.EXHAUSTED, carry.status)
    return carry._replace(status=status.astype(carry.status.dtype))


def status_after_step(hybrid: HybridSystem, carry: PyTree, attempt: PyTree, decision: PyTree) -> Scalar:
    """Return the status after an accepted attempt.

    A landing whose margin is too far from zero (`MAX_MISSED_FRACTION`) misses the stop.
    """
    before, after, stops = (x["stop"] for x in (carry.point.margins, attempt.point.margins, decision.triggered))
    at_full = jnp.abs(carry.search.at_full)
    misses = [
        stop & ~(jnp.abs(b) <= MAX_MISSED_FRACTION * (a + at_full))
        for a, b, stop in zip(before, after, stops, strict=True)
    ]
    landed = jnp.where(reduce(jnp.logical_or, misses), RunStatus.MISSED, RunStatus.STOPPED)
    further = jnp.asarray(RunStatus.RUNNING)
    if not hybrid.ticks:
        changed = jnp.any(jnp.stack([decision.crosses_surface, *jax.tree.leaves(decision.triggered)]))
        further = jnp.where(changed, RunStatus.REFRESHING, RunStatus.RUNNING)
    return jnp.where(reduce(jnp.logical_or, stops), landed, jnp.where(decision.over, RunStatus.TIMED_OUT, further))
