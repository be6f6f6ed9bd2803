"""Derivatives of a run with adaptive steps in one pass: each step is made for its values and then replayed.

`replay` uses the log of a whole run. Here each log entry is used as soon as it exists. Only the present state is kept,
so the memory of many runs does not grow with their steps. Forward mode only: reverse mode needs the steps in the
opposite order.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax

from diffabs.core.loop import Loop
from diffabs.core.types import Key, PyTree, Scalar
from diffabs.simulate.drive.checkpoint import any_lane
from diffabs.simulate.step.methods import AdaptiveStepping
from diffabs.simulate.step.replay import ReplayState, log_attempt, replay_attempt, start_replay
from diffabs.simulate.step.system import Objectives
from diffabs.simulate.step.tries import AdaptiveCarry


class LaggedReplay(NamedTuple):
    """A run for values, with a replay that follows it step by step.

    Attributes:
        ahead: Carry of the run for values.
        point: State of the replay.
    """

    ahead: AdaptiveCarry
    point: ReplayState

    @property
    def running(self) -> Scalar:
        """True if the run for values needs another attempt."""
        return self.ahead.running

    @property
    def status(self) -> Scalar:
        """Status of the run for values."""
        return self.ahead.status


@partial(jax.tree_util.register_dataclass, data_fields=["pace"], meta_fields=[])
@dataclasses.dataclass(frozen=True)
class LaggedReplayStepping:
    """Steps of `Adaptive` with forward derivatives.

    Attributes:
        pace: Stepping method of the logged run.
    """

    pace: AdaptiveStepping

    def start(self, loop: Loop, objectives: Objectives, key: Key) -> LaggedReplay:
        """Return the carry of a run at t = 0, from `loop`, `objectives` and random `key`."""
        ahead = self.pace.start(_stop_gradients(loop), _stop_gradients(objectives), key)
        return LaggedReplay(ahead, start_replay(loop, objectives, self.pace, key))

    def step(self, loop: Loop, objectives: Objectives, key: Key, carry: LaggedReplay) -> LaggedReplay:
        """Return the `carry` after one attempt of the run for values, and its replay if the attempt was accepted.

        `loop`, `objectives` and `key` are those of `start`.
        """
        # The run ahead only chooses the steps. All derivatives pass through the replay.
        old = _stop_gradients(carry.ahead)
        new = _stop_gradients(self.pace.step(_stop_gradients(loop), _stop_gradients(objectives), key, old))
        note = log_attempt(old, new)

        def repeat() -> ReplayState:
            return replay_attempt(loop, objectives, self.pace, key, carry.point, note)[0]

        return LaggedReplay(new, jax.lax.cond(any_lane(note.moved), repeat, lambda: carry.point))

    def renew(self, loop: Loop, carry: LaggedReplay) -> LaggedReplay:
        """Return the `carry` with a new stability limit of the `loop` if the last one is too old."""
        return carry._replace(
            ahead=_stop_gradients(self.pace.renew(_stop_gradients(loop), _stop_gradients(carry.ahead)))
        )


def _stop_gradients(tree: PyTree) -> PyTree:
    """Return the tree without derivatives."""
    return jax.tree.map(jax.lax.stop_gradient, tree)
