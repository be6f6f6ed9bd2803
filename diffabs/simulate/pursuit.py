"""Derivatives of a run with adaptive steps in one pass: each step is made for its values, and then repeated.

What `replay` makes of the notes of a whole run is made of each as soon as it is there. Nothing is kept of a run but
where it is, so the memory of many runs does not grow with their steps. Forward mode only: reverse mode needs the steps
in the other order."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax

from diffabs.core.loop import Loop
from diffabs.simulate.checkpoint import anyone
from diffabs.simulate.dynamics import Objectives
from diffabs.simulate.methods import AtPace
from diffabs.simulate.replay import Place, noted, place_at_start, repeat_try
from diffabs.simulate.tries import Carry


class Pursuit(NamedTuple):
    """A run on its way, ahead, and where its repetition is."""

    ahead: Carry
    point: Place

    @property
    def running(self) -> Any:
        """Whether another step is to be tried."""
        return self.ahead.running

    @property
    def condition(self) -> Any:
        """That of the run ahead."""
        return self.ahead.condition


@partial(jax.tree_util.register_dataclass, data_fields=["pace"], meta_fields=[])
@dataclasses.dataclass(frozen=True)
class Pursuing:
    """The steps of `Adaptive` as they are differentiated, forward; `pace` is that of a run that is noted."""

    pace: AtPace

    def start(self, loop: Loop, objectives: Objectives, key: Any) -> Pursuit:
        """Return the carry at t = 0."""
        ahead = self.pace.start(_still(loop), _still(objectives), key)
        return Pursuit(ahead, place_at_start(loop, objectives, self.pace, key))

    def step(self, loop: Loop, objectives: Objectives, key: Any, carry: Pursuit) -> Pursuit:
        """Return the carry after one try of the run ahead, which is repeated if it led on."""
        old = _still(carry.ahead)
        new = _still(self.pace.step(_still(loop), _still(objectives), key, old))
        note = noted(old, new)

        def repeated() -> Place:
            return repeat_try(loop, objectives, self.pace, key, carry.point, note)[0]

        return Pursuit(new, jax.lax.cond(anyone(note.moved), repeated, lambda: carry.point))

    def renew(self, loop: Loop, carry: Pursuit) -> Pursuit:
        """Return the carry with the longest stable step, if that was not looked at for a while."""
        return carry._replace(ahead=_still(self.pace.renew(_still(loop), _still(carry.ahead))))


def _still(tree: Any) -> Any:
    """Without derivatives."""
    return jax.tree.map(jax.lax.stop_gradient, tree)
