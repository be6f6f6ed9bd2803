"""The loop and its objectives as one function of time and state.

Values are computed as the parts have it. For derivatives it is a program whose comparisons are visible (`core.kinks`),
so that a step has one regime: a derivative through a step with a kink in it would be off by as much as one step in the
kink's moment, however exact the value is."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.kinks import Program
from diffabs.core.loop import Loop, LoopState, Margins, Signals
from diffabs.core.protocols import Memory, Objective, Sample
from diffabs.core.regime import Answers, Regime, Words
from diffabs.simulate.foresight import Margin

Objectives = dict[str, Objective]
Tally = dict[str, Memory]

FREE = Regime(None)  # as the numbers say
PROGRAMS = 256  # that are kept
_programs: dict[Any, Program] = {}


class Seen(NamedTuple):
    """At an instant: rate of the state, rates of the objectives' integrals, signals, margins of the events."""

    rate: Any
    tally_rates: Any
    signals: Signals
    margins: Margins


class Ahead(NamedTuple):
    """At an instant: what is seen, the rates of the sample, of what blocks record and of the margins of the events, the
    answers to the comparisons, those that the numbers contradict, and their margins with the rates of these."""

    seen: Seen
    moving: Sample
    recorded: dict[str, Any]
    falls: Margins
    words: Words
    crossed: Words
    comparisons: list[Margin]


class Dynamics(NamedTuple):
    """The program, None for values, and the parameters with which it is run."""

    program: Program | None
    loop: Loop
    objectives: Objectives

    @property
    def words(self) -> int:
        """How many words hold the answers to them."""
        return self.program.words if self.program else 0

    @property
    def kinks(self) -> int:
        """How many comparisons there are to be located."""
        return self.program.answers if self.program else 0

    def rates(self, t: Any, z: Any, held: Any, regime: Regime) -> Any:
        """dz/dt within a regime, z and what is `held` as `parted` has them."""
        return self._at(lambda seen: seen[:2], (t, *z), held, regime)

    def look(self, t: Any, state: LoopState, tally: Tally, regime: Regime) -> tuple[Seen, Answers]:
        """Everything at an instant, and the answers to its comparisons."""
        z, held = parted(state, tally)
        moving, fixed = (t, *z), (held, self.loop, self.objectives)
        if self.program is None:
            return _seen(moving, fixed), Answers((), (), [])
        return self.program.look(lambda seen: seen, moving, fixed, regime)

    def ahead(self, t: Any, state: LoopState, tally: Tally, regime: Regime = FREE) -> "Ahead":
        """Everything at an instant, within a regime or as the numbers say, and how it moves from there."""
        assert self.program is not None
        program, (z, held) = self.program, parted(state, tally)
        fixed = (held, self.loop, self.objectives)
        now = program.look(lambda seen: seen, (t, *z), fixed, regime)[0]

        def moves(t: Any, z: Any) -> Any:
            one, answers = program.look(lambda seen: seen, (t, *z), fixed, regime)
            values = [value for _, value in answers.margins]
            return (one.signals.sample, one.signals.recorded, one.margins, values), answers

        moving = (jnp.ones_like(t), now[:2])
        (*_, values), (sample, recorded, falls, rates), answers = jax.jvp(moves, (t, z), moving, has_aux=True)
        numbers = [number for number, _ in answers.margins]
        comparisons = [Margin(*one) for one in zip(numbers, values, rates, strict=True)]
        return Ahead(now, sample, recorded, falls, answers.words, answers.crossed, comparisons)

    def moving(self, of: Callable[[Sample], Any], end: tuple[Any, LoopState, Tally, Any], regime: Regime) -> Any:
        """d(of(sample))/dt within a regime, at a time, state and tally where d(state.flow())/dt is the last one."""
        t, state, tally, rate = end
        (flow, still), held = parted(state, tally)

        def seen(t: Any, flow: Any) -> Any:
            return self._at(lambda seen: of(seen.signals.sample), (t, flow, still), held, regime)

        return jax.jvp(seen, (t, flow), (jnp.ones_like(t), rate))[1]

    def _at(self, pick: Callable[[Seen], Any], moving: Any, held: Any, regime: Regime) -> Any:
        fixed = (held, self.loop, self.objectives)
        return self.program(pick, moving, fixed, regime) if self.program else pick(_seen(moving, fixed))


def dynamics(loop: Loop, objectives: Objectives, t: Any, state: LoopState, tally: Tally, *, kinks: bool) -> Dynamics:
    """Return the dynamics of a loop; the program is traced once for every structure, and for arguments of these
    shapes."""
    if not kinks:
        return Dynamics(None, loop, objectives)
    z, held = parted(state, tally)
    args = ((t, *z), (held, loop, objectives))
    leaves, tree = jax.tree.flatten(args)
    key = (tree, tuple(map(jax.typeof, leaves)), jnp.result_type(float))
    if key not in _programs:
        while len(_programs) >= PROGRAMS:
            _programs.pop(next(iter(_programs)))
        _programs[key] = Program(_seen, *args, counts=lambda seen: (seen[:2], seen.signals.recorded))
    return Dynamics(_programs[key], loop, objectives)


def tally_rates(objectives: Objectives, tally: Tally, sample: Sample) -> dict[str, Any]:
    """Return d/dt of the objectives' integrals."""
    return {name: one.flow(tally[name], sample) for name, one in objectives.items()}


def parted(state: LoopState, tally: Tally) -> tuple[Any, Any]:
    """Return what is integrated, of the loop and of the objectives, and what does not change between two instants."""
    flow = (state.flow(), {name: memory.flow for name, memory in tally.items()})
    return flow, ([memory.held for memory in state[1:]], {name: memory.held for name, memory in tally.items()})


def _seen(moving: Any, fixed: Any) -> Seen:
    (t, flow, tally_flow), ((held, tally_held), loop, objectives) = moving, fixed
    state = LoopState(flow[0], *(Memory(*both) for both in zip(flow[1:], held, strict=True)))
    tally = {name: Memory(tally_flow[name], tally_held[name]) for name in tally_flow}
    signals = loop.signals(t, state)
    rate = loop.flow(t, state, signals)
    margins = loop.margins(t, state, signals, lambda: rate)
    return Seen(rate, tally_rates(objectives, tally, signals.sample), signals, margins)
