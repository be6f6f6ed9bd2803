"""Derivatives of a run with adaptive steps in one pass: each step is made for its values, and then repeated.

What `replay` makes of the notes of a whole run is made of each as soon as it is there. Nothing is kept of a run but
where it is, so the memory of many runs does not grow with their steps. Forward mode only: reverse mode needs the steps
in the other order."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax

from diffabs.core.loop import Loop
from diffabs.simulate.checkpoint import any_lane
from diffabs.simulate.dynamics import Objectives
from diffabs.simulate.methods import AdaptiveStepping
from diffabs.simulate.replay import ReplayState, log_attempt, replay_attempt, start_replay
from diffabs.simulate.tries import AdaptiveCarry


class LaggedReplay(NamedTuple):
    """A run on its way, ahead, and where its repetition is."""

    ahead: AdaptiveCarry
    point: ReplayState

    @property
    def running(self) -> Any:
        """Whether another step is to be tried."""
        return self.ahead.running

    @property
    def status(self) -> Any:
        """That of the run ahead."""
        return self.ahead.status


@partial(jax.tree_util.register_dataclass, data_fields=["pace"], meta_fields=[])
@dataclasses.dataclass(frozen=True)
class LaggedReplayStepping:
    """The steps of `Adaptive` as they are differentiated, forward; `pace` is that of a run that is noted."""

    pace: AdaptiveStepping

    def start(self, loop: Loop, objectives: Objectives, key: Any) -> LaggedReplay:
        """Return the carry at t = 0."""
        ahead = self.pace.start(_stop_gradients(loop), _stop_gradients(objectives), key)
        return LaggedReplay(ahead, start_replay(loop, objectives, self.pace, key))

    def step(self, loop: Loop, objectives: Objectives, key: Any, carry: LaggedReplay) -> LaggedReplay:
        """Return the carry after one try of the run ahead, which is repeated if it led on."""
        old = _stop_gradients(carry.ahead)
        new = _stop_gradients(self.pace.step(_stop_gradients(loop), _stop_gradients(objectives), key, old))
        note = log_attempt(old, new)

        def repeated() -> ReplayState:
            return replay_attempt(loop, objectives, self.pace, key, carry.point, note)[0]

        return LaggedReplay(new, jax.lax.cond(any_lane(note.moved), repeated, lambda: carry.point))

    def renew(self, loop: Loop, carry: LaggedReplay) -> LaggedReplay:
        """Return the carry with the longest stable step, if that was not looked at for a while."""
        return carry._replace(
            ahead=_stop_gradients(self.pace.renew(_stop_gradients(loop), _stop_gradients(carry.ahead)))
        )


def _stop_gradients(tree: Any) -> Any:
    """Without derivatives."""
    return jax.tree.map(jax.lax.stop_gradient, tree)
