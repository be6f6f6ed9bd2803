"""The loop and its objectives as one function of time and state.

Values are computed as the parts have it. For derivatives the function is a program whose comparisons are visible
(`core.comparisons`), so that a step has one mode. A derivative through a step with a kink inside is off by up
to one step in the kink's moment, however exact the value is."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.comparisons import SwitchedProgram
from diffabs.core.loop import Loop, LoopState, Margins, Signals
from diffabs.core.modes import ComparisonAnswers, Mode, ModeBits
from diffabs.core.protocols import Memory, Objective, Sample
from diffabs.simulate.foresight import SwitchingFunction

Objectives = dict[str, Objective]
Accumulators = dict[str, Memory]

UNCONSTRAINED = Mode(None)  # as the numbers say
MAX_CACHED_PROGRAMS = 256  # that are kept
_programs: dict[Any, SwitchedProgram] = {}


class LoopEvaluation(NamedTuple):
    """At an instant: rate of the state, rates of the objectives' integrals, signals, margins of the events."""

    rate: Any
    accumulator_rates: Any
    signals: Signals
    margins: Margins


class LoopEvaluationWithRates(NamedTuple):
    """At an instant: what is seen, the rates of the sample, of what blocks record and of the margins of the events, the
    answers to the comparisons, those that the numbers contradict, and their margins with the rates of these."""

    seen: LoopEvaluation
    moving: Sample
    recorded: dict[str, Any]
    falls: Margins
    words: ModeBits
    contradicted: ModeBits
    comparisons: list[SwitchingFunction]


class Dynamics(NamedTuple):
    """The program, None for values, and the parameters with which it is run."""

    program: SwitchedProgram | None
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

    def rates(self, t: Any, z: Any, held: Any, mode: Mode) -> Any:
        """dz/dt within a regime, z and what is `held` as `parted` has them."""
        return self._at(lambda seen: seen[:2], (t, *z), held, mode)

    def look(
        self, t: Any, state: LoopState, accumulators: Accumulators, mode: Mode
    ) -> tuple[LoopEvaluation, ComparisonAnswers]:
        """Everything at an instant, and the answers to its comparisons."""
        z, held = split_flow_and_held(state, accumulators)
        moving, fixed = (t, *z), (held, self.loop, self.objectives)
        if self.program is None:
            return _evaluate_loop(moving, fixed), ComparisonAnswers((), (), [])
        return self.program.look(lambda seen: seen, moving, fixed, mode)

    def ahead(
        self, t: Any, state: LoopState, accumulators: Accumulators, mode: Mode = UNCONSTRAINED
    ) -> "LoopEvaluationWithRates":
        """Everything at an instant, within a regime or as the numbers say, and how it moves from there."""
        assert self.program is not None
        program, (z, held) = self.program, split_flow_and_held(state, accumulators)
        fixed = (held, self.loop, self.objectives)
        now = program.look(lambda seen: seen, (t, *z), fixed, mode)[0]

        def moves(t: Any, z: Any) -> Any:
            one, answers = program.look(lambda seen: seen, (t, *z), fixed, mode)
            values = [value for _, value in answers.margins]
            return (one.signals.sample, one.signals.recorded, one.margins, values), answers

        moving = (jnp.ones_like(t), now[:2])
        (*_, values), (sample, recorded, falls, rates), answers = jax.jvp(moves, (t, z), moving, has_aux=True)
        numbers = [number for number, _ in answers.margins]
        comparisons = [SwitchingFunction(*one) for one in zip(numbers, values, rates, strict=True)]
        return LoopEvaluationWithRates(now, sample, recorded, falls, answers.words, answers.contradicted, comparisons)

    def moving(self, of: Callable[[Sample], Any], end: tuple[Any, LoopState, Accumulators, Any], mode: Mode) -> Any:
        """d(of(sample))/dt within a regime, at a time, state and tally where d(state.flow())/dt is the last one."""
        t, state, accumulators, rate = end
        (flow, still), held = split_flow_and_held(state, accumulators)

        def seen(t: Any, flow: Any) -> Any:
            return self._at(lambda seen: of(seen.signals.sample), (t, flow, still), held, mode)

        return jax.jvp(seen, (t, flow), (jnp.ones_like(t), rate))[1]

    def _at(self, pick: Callable[[LoopEvaluation], Any], moving: Any, held: Any, mode: Mode) -> Any:
        fixed = (held, self.loop, self.objectives)
        return self.program(pick, moving, fixed, mode) if self.program else pick(_evaluate_loop(moving, fixed))


def build_dynamics(
    loop: Loop, objectives: Objectives, t: Any, state: LoopState, accumulators: Accumulators, *, kinks: bool
) -> Dynamics:
    """Return the dynamics of a loop; the program is traced once for every structure, and for arguments of these
    shapes."""
    if not kinks:
        return Dynamics(None, loop, objectives)
    z, held = split_flow_and_held(state, accumulators)
    args = ((t, *z), (held, loop, objectives))
    leaves, tree = jax.tree.flatten(args)
    key = (tree, tuple(map(jax.typeof, leaves)), jnp.result_type(float))
    if key not in _programs:
        while len(_programs) >= MAX_CACHED_PROGRAMS:
            _programs.pop(next(iter(_programs)))
        _programs[key] = SwitchedProgram(_evaluate_loop, *args, counts=lambda seen: (seen[:2], seen.signals.recorded))
    return Dynamics(_programs[key], loop, objectives)


def accumulator_rates(objectives: Objectives, accumulators: Accumulators, sample: Sample) -> dict[str, Any]:
    """Return d/dt of the objectives' integrals."""
    return {name: one.flow(accumulators[name], sample) for name, one in objectives.items()}


def split_flow_and_held(state: LoopState, accumulators: Accumulators) -> tuple[Any, Any]:
    """Return what is integrated, of the loop and of the objectives, and what does not change between two instants."""
    flow = (state.flow(), {name: memory.flow for name, memory in accumulators.items()})
    return flow, ([memory.held for memory in state[1:]], {name: memory.held for name, memory in accumulators.items()})


def _evaluate_loop(moving: Any, fixed: Any) -> LoopEvaluation:
    (t, flow, tally_flow), ((held, tally_held), loop, objectives) = moving, fixed
    state = LoopState(flow[0], *(Memory(*both) for both in zip(flow[1:], held, strict=True)))
    accumulators = {name: Memory(tally_flow[name], tally_held[name]) for name in tally_flow}
    signals = loop.signals(t, state)
    rate = loop.flow(t, state, signals)
    margins = loop.margins(t, state, signals, lambda: rate)
    return LoopEvaluation(rate, accumulator_rates(objectives, accumulators, signals.sample), signals, margins)
