"""Derivatives of a run with adaptive steps in one pass: it is made for its values, and one step behind it is repeated.

What `replay` makes of the notes of a whole run is made of each as soon as it is known in which regime the next step is.
Nothing is kept of a run but where it is, so the memory of many runs does not grow with their steps. Forward mode only:
reverse mode needs the steps in the other order."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.loop import Loop
from diffabs.simulate.checkpoint import anyone
from diffabs.simulate.dynamics import Objectives
from diffabs.simulate.landing import select
from diffabs.simulate.methods import AtPace
from diffabs.simulate.replay import Notes, Place, noted, place_at_start, repeat_try
from diffabs.simulate.tries import Carry


class Pursuit(NamedTuple):
    """A run on its way, ahead, and its repetition: the note of the last step that led on, whether that is still to be
    repeated, and where the repetition is."""

    ahead: Carry
    note: Notes
    waits: Any
    point: Place

    @property
    def running(self) -> Any:
        """Whether another step is to be made, tried or repeated."""
        return self.ahead.running | self.waits

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
        none = jnp.asarray(False)
        note = noted(ahead, ahead)._replace(moved=none)
        return Pursuit(ahead, note, none, place_at_start(loop, objectives, self.pace, key))

    def step(self, loop: Loop, objectives: Objectives, key: Any, carry: Pursuit) -> Pursuit:
        """Return the carry after one try of the run ahead, and after the step before that, if the next one is known."""
        old, before = _still(carry.ahead), _still(carry.note)
        new = _still(self.pace.step(_still(loop), _still(objectives), key, old))
        last = noted(old, new)
        due = carry.waits & (last.moved | ~old.running)
        one = before._replace(next=select(last.moved, last.words, new.point.words))

        def repeated() -> Place:
            return repeat_try(loop, objectives, self.pace, key, carry.point, one)[0]

        point = select(due, jax.lax.cond(anyone(due), repeated, lambda: carry.point), carry.point)
        return Pursuit(new, select(last.moved, last, before), last.moved | (carry.waits & ~due), point)

    def renew(self, loop: Loop, carry: Pursuit) -> Pursuit:
        """Return the carry with the longest stable step, if that was not looked at for a while."""
        return carry._replace(ahead=_still(self.pace.renew(_still(loop), _still(carry.ahead))))


def _still(tree: Any) -> Any:
    """Without derivatives."""
    return jax.tree.map(jax.lax.stop_gradient, tree)
