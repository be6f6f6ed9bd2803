"""Status of a run: running, searching for an event, or over, and the reason."""

import enum

import jax
import jax.numpy as jnp

from diffabs.core.loop import Loop, Margins
from diffabs.core.types import Bool, PyTree, Scalar

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
        REFRESHING: A step of length 0 evaluates the rates after the event.
        STOPPED: The run is over and has reached its stop.
        TIMED_OUT: The run is over because its duration has passed.
        DIVERGED: The run is over because its numbers are invalid.
    """

    RUNNING, SEEKING, PROBING, REFINING, LANDING, REFRESHING, STOPPED, TIMED_OUT, DIVERGED = range(9)


def is_running(carry: PyTree) -> Bool:
    """Return True if the run needs another attempt.

    Args:
        carry: Carry of the run, with a `status`.
    """
    return carry.status <= RunStatus.REFRESHING


def status_after_step(loop: Loop, carry: PyTree, margins: Margins, verdict: PyTree) -> Scalar:
    """Return the status after an accepted step.

    A landing whose margin is too far from zero (`MAX_MISSED_FRACTION`) makes the run diverge.

    Args:
        loop: Closed loop.
        carry: Carry before the step.
        margins: Margins at the end of the step.
        verdict: Decision on the attempt: the triggered events, and True in `over` if the run ends there.
    """
    left, scale = jnp.abs(margins["stop"][0]), carry.point.margins["stop"][0] + jnp.abs(carry.search.at_full)
    landed = jnp.where(left <= MAX_MISSED_FRACTION * scale, RunStatus.STOPPED, RunStatus.DIVERGED)
    further = jnp.asarray(RunStatus.RUNNING)
    if loop.eventful and not loop.ticks:
        happened = jnp.any(jnp.stack(jax.tree.leaves(verdict.triggered)))
        further = jnp.where(happened, RunStatus.REFRESHING, RunStatus.RUNNING)
    return jnp.where(verdict.triggered["stop"][0], landed, jnp.where(verdict.over, RunStatus.TIMED_OUT, further))
