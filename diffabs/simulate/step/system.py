"""The dynamics of the loop and its objectives, as one function of time and state.

For values, the parts are evaluated directly. For derivatives, the function is a program whose comparisons are visible
(`comparisons`), so that a step has one mode. Without a mode, the derivative of a step with a kink inside is wrong by up
to one step in the kink's time. The value may still be exact.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.loop import Loop, LoopState, Margins, Signals
from diffabs.core.protocols import Memory, Objective, Sample
from diffabs.core.types import AnyArray, PyTree, Scalar
from diffabs.simulate.step.comparisons import SwitchedProgram
from diffabs.simulate.step.foresight import SwitchingFunction
from diffabs.simulate.step.modes import ComparisonAnswers, Mode, ModeBits

Objectives = dict[str, Objective]
Accumulators = dict[str, Memory]

UNCONSTRAINED = Mode(None)  # no frozen answers: every comparison is evaluated
MAX_CACHED_PROGRAMS = 256  # greatest number of programs that are kept
_programs: dict[PyTree, SwitchedProgram] = {}


class LoopEvaluation(NamedTuple):
    """The dynamics at an instant.

    Attributes:
        rate: Rates of the loop's flow.
        accumulator_rates: Rates of the objectives' integrals.
        signals: Signals of the loop.
        margins: Margins of the stop and of the blocks' events.
    """

    rate: PyTree
    accumulator_rates: Any
    signals: Signals
    margins: Margins


class LoopEvaluationWithRates(NamedTuple):
    """The dynamics at an instant, with the time derivatives of the signals and margins.

    Attributes:
        seen: The dynamics.
        moving: Rates of the sample.
        recorded: Rates of the signals that blocks record, by block.
        falls: Rates of the margins of events.
        words: Answers to the comparisons.
        contradicted: Answers of the mode that the numbers contradict.
        comparisons: Margins of the comparisons and their rates.
    """

    seen: LoopEvaluation
    moving: Sample
    recorded: dict[str, PyTree]
    falls: Margins
    words: ModeBits
    contradicted: ModeBits
    comparisons: list[SwitchingFunction]


class Dynamics(NamedTuple):
    """A loop and its objectives, with the program of their dynamics.

    Attributes:
        program: The program with visible comparisons; None if the parts are evaluated directly.
        loop: Loop with the parameters of the run.
        objectives: Objectives by name.
    """

    program: SwitchedProgram | None
    loop: Loop
    objectives: Objectives

    @property
    def words(self) -> int:
        """Number of words that hold the answers to the comparisons."""
        return self.program.words if self.program else 0

    @property
    def kinks(self) -> int:
        """Number of comparisons whose switching surfaces are located."""
        return self.program.answers if self.program else 0

    def rates(self, t: Scalar, z: AnyArray, held: PyTree, mode: Mode) -> Scalar:
        """Return dz/dt at time `t` within a `mode`, with z and `held` as `split_flow_and_held` returns them."""
        return self._at(lambda seen: seen[:2], (t, *z), held, mode)

    def look(
        self, t: Scalar, state: LoopState, accumulators: Accumulators, mode: Mode
    ) -> tuple[LoopEvaluation, ComparisonAnswers]:
        """Return the dynamics at time `t`, `state` and `accumulators` within a `mode`, and the answers to the
        comparisons.
        """
        z, held = split_flow_and_held(state, accumulators)
        moving, fixed = (t, *z), (held, self.loop, self.objectives)
        if self.program is None:
            return _evaluate_loop(moving, fixed), ComparisonAnswers((), (), [])
        return self.program.look(lambda seen: seen, moving, fixed, mode)

    def ahead(
        self, t: Scalar, state: LoopState, accumulators: Accumulators, mode: Mode = UNCONSTRAINED
    ) -> "LoopEvaluationWithRates":
        """Return the dynamics at time `t`, `state` and `accumulators` within a `mode`, with the rates along the flow.

        By default the comparisons are evaluated.
        """
        assert self.program is not None
        program, (z, held) = self.program, split_flow_and_held(state, accumulators)
        fixed = (held, self.loop, self.objectives)
        now = program.look(lambda seen: seen, (t, *z), fixed, mode)[0]

        def moves(t: Scalar, z: AnyArray) -> Any:
            one, answers = program.look(lambda seen: seen, (t, *z), fixed, mode)
            values = [value for _, value in answers.margins]
            return (one.signals.sample, one.signals.recorded, one.margins, values), answers

        # The derivative along (1, dz/dt) is the total time derivative on the trajectory.
        moving = (jnp.ones_like(t), now[:2])
        (*_, values), (sample, recorded, falls, rates), answers = jax.jvp(moves, (t, z), moving, has_aux=True)
        numbers = [number for number, _ in answers.margins]
        comparisons = [SwitchingFunction(*one) for one in zip(numbers, values, rates, strict=True)]
        return LoopEvaluationWithRates(now, sample, recorded, falls, answers.words, answers.contradicted, comparisons)

    def rate_of(
        self, of: Callable[[Sample], PyTree], end: tuple[PyTree, LoopState, Accumulators, PyTree], mode: Mode
    ) -> PyTree:
        """Return d(of(sample))/dt within a `mode`.

        `end` holds time, state, accumulators and d(state.flow())/dt; `of` is a function of the sample.
        """
        t, state, accumulators, rate = end
        (flow, still), held = split_flow_and_held(state, accumulators)

        def evaluate(t: Scalar, flow: PyTree) -> Any:
            return self._at(lambda evaluate: of(evaluate.signals.sample), (t, flow, still), held, mode)

        return jax.jvp(evaluate, (t, flow), (jnp.ones_like(t), rate))[1]

    def _at(self, pick: Callable[[LoopEvaluation], PyTree], moving: PyTree, held: PyTree, mode: Mode) -> Any:
        fixed = (held, self.loop, self.objectives)
        return self.program(pick, moving, fixed, mode) if self.program else pick(_evaluate_loop(moving, fixed))


def build_dynamics(
    loop: Loop, objectives: Objectives, t: Scalar, state: LoopState, accumulators: Accumulators, *, kinks: bool
) -> Dynamics:
    """Return the dynamics of a loop. A program is traced once for each structure and for arguments of these shapes.

    Args:
        loop: Closed loop, prepared.
        objectives: Objectives by name.
        t: Time [s].
        state: State of the loop.
        accumulators: Accumulators of the objectives.
        kinks: True for a program with visible comparisons; False for direct evaluation.
    """
    if not kinks:
        return Dynamics(None, loop, objectives)
    z, held = split_flow_and_held(state, accumulators)
    args = ((t, *z), (held, loop, objectives))
    leaves, tree = jax.tree.flatten(args)
    # `result_type(float)` is part of the key: with another precision the same shapes give another program.
    key = (tree, tuple(map(jax.typeof, leaves)), jnp.result_type(float))
    if key not in _programs:
        while len(_programs) >= MAX_CACHED_PROGRAMS:
            _programs.pop(next(iter(_programs)))  # a dict keeps the order of insertion: the oldest program goes first
        # `counts`: only comparisons that influence rates or recorded signals produce a kink in the run.
        _programs[key] = SwitchedProgram(_evaluate_loop, *args, counts=lambda seen: (seen[:2], seen.signals.recorded))
    return Dynamics(_programs[key], loop, objectives)


def accumulator_rates(objectives: Objectives, accumulators: Accumulators, sample: Sample) -> dict[str, PyTree]:
    """Return the rates of the objectives' integrals, by name.

    Args:
        objectives: Objectives by name.
        accumulators: Accumulators of the objectives.
        sample: Sample of the signals.
    """
    return {name: one.flow(accumulators[name], sample) for name, one in objectives.items()}


def split_flow_and_held(state: LoopState, accumulators: Accumulators) -> tuple[PyTree, PyTree]:
    """Return the integrated part of loop and objectives, and the part that is constant between two instants.

    Args:
        state: State of the loop.
        accumulators: Accumulators of the objectives.
    """
    flow = (state.flow(), {name: memory.flow for name, memory in accumulators.items()})
    return flow, ([memory.held for memory in state[1:]], {name: memory.held for name, memory in accumulators.items()})


def _evaluate_loop(moving: PyTree, fixed: PyTree) -> LoopEvaluation:
    """Return the dynamics for (time, flow, accumulator flow) and ((held, accumulator held), loop, objectives)."""
    (t, flow, tally_flow), ((held, tally_held), loop, objectives) = moving, fixed
    state = LoopState(flow[0], *(Memory(*both) for both in zip(flow[1:], held, strict=True)))
    accumulators = {name: Memory(tally_flow[name], tally_held[name]) for name in tally_flow}
    signals = loop.signals(t, state)
    rate = loop.flow(t, state, signals)
    margins = loop.margins(t, state, signals, lambda: rate)
    return LoopEvaluation(rate, accumulator_rates(objectives, accumulators, signals.sample), signals, margins)
