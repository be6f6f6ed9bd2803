"""How a run is: on its way, or over, and why."""

import enum
from typing import Any

import jax
import jax.numpy as jnp

from diffabs.core.loop import Loop, Margins

MAX_MISSED_FRACTION = 0.1  # of the change of the stop's margin in the step: the most that may be left of it


class RunStatus(enum.IntEnum):
    """A run goes on; or looks for an event, for how its margin falls, or for second derivatives of its moment; or is to
    land on it, or to look around after it; or it is over."""

    RUNNING, SEEKING, PROBING, REFINING, LANDING, REFRESHING, STOPPED, TIMED_OUT, DIVERGED = range(9)


def is_running(carry: Any) -> Any:
    """Return whether another step of the run that has this carry is to be made or tried."""
    return carry.status <= RunStatus.REFRESHING


def status_after_step(loop: Loop, carry: Any, margins: Margins, verdict: Any) -> Any:
    """Return the condition after a step that is taken, with these margins at its end; `verdict` says which events
    happen there, and whether the run is over. A landing that does not come to rest on the stop is none."""
    left, scale = jnp.abs(margins["stop"][0]), carry.point.margins["stop"][0] + jnp.abs(carry.search.at_full)
    landed = jnp.where(left <= MAX_MISSED_FRACTION * scale, RunStatus.STOPPED, RunStatus.DIVERGED)
    further = jnp.asarray(RunStatus.RUNNING)
    if loop.eventful and not loop.ticks:
        happened = jnp.any(jnp.stack(jax.tree.leaves(verdict.triggered)))
        further = jnp.where(happened, RunStatus.REFRESHING, RunStatus.RUNNING)
    return jnp.where(verdict.triggered["stop"][0], landed, jnp.where(verdict.over, RunStatus.TIMED_OUT, further))
