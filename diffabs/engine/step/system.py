"""The dynamics of a system and its objectives, as one function of time and state.

Fixed steps evaluate the parts directly, unless switching surfaces are located. All other runs trace a program whose
comparisons are visible (`comparisons`). On this program steps freeze a mode if their rule `keeps_mode`, or if they are
replayed. Without a mode, the derivative of a step places a kink up to one step too early or too late.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.lanes import any_lane
from diffabs.core.protocols import Memory, Segment
from diffabs.core.types import PyTree, Scalar
from diffabs.engine.hybrid import HybridSignals, HybridState, HybridSystem, Margins, Objectives
from diffabs.engine.step.comparisons import SwitchedProgram
from diffabs.engine.step.modes import ComparisonAnswers, Mode, ModeBits, SwitchingFunctions
from diffabs.engine.step.slides import SlidingDynamics, return_to_surfaces, slide

Accumulators = dict[str, Memory]

UNCONSTRAINED = Mode(None)  # no frozen answers: every comparison is evaluated
MAX_CACHED_SYSTEMS = 256  # greatest number of traced programs that are kept
_traced: dict[PyTree, tuple[SwitchedProgram | None, str]] = {}


class Instant(NamedTuple):
    """The dynamics at an instant.

    Attributes:
        rate: Rates of the system's flow.
        accumulator_rates: Rates of the objectives' integrals.
        signals: Signals of the system.
        margins: Margins of the stop and of the events.
    """

    rate: PyTree
    accumulator_rates: dict[str, PyTree]
    signals: HybridSignals
    margins: Margins


class Evaluation(NamedTuple):
    """The dynamics at an instant within a mode, with the time derivatives that a step needs.

    Attributes:
        rates: Rates of the system's flow and of the objectives' integrals.
        signals: Signals of the system.
        margins: Margins of the stop and of the events.
        words: Answers to the comparisons.
        contradicted: Answers of the mode that the numbers contradict.
        surfaces: Margins of the comparisons, and their rates.
        signal_rates: Rates of the sample, or of its shown part, or (), as the objectives need them.
        recorded_rates: Rates of the recorded signals, by name.
        margin_rates: Rates of the margins of stop and events; () if they were not evaluated.
        shares: Shares of the other answer of each comparison along whose surface the run slides; () if it cannot slide.
    """

    rates: tuple[PyTree, PyTree]
    signals: HybridSignals
    margins: Margins
    words: ModeBits
    contradicted: ModeBits
    surfaces: SwitchingFunctions
    signal_rates: PyTree
    recorded_rates: dict[str, PyTree]
    margin_rates: PyTree
    shares: tuple[Scalar, ...] = ()


class ObservedSystem(NamedTuple):
    """A hybrid system and its objectives, with the program of their dynamics.

    Attributes:
        program: The program with visible comparisons; None if the parts are evaluated directly.
        hybrid: The system, with the parameters of the run.
        objectives: Objectives by name.
        signal_rates: Signals whose rates an evaluation has: "sample", "shown" (a part of them), or "".
        has_margin_rates: True if an evaluation has the rates of all margins.
    """

    program: SwitchedProgram | None
    hybrid: HybridSystem
    objectives: Objectives
    signal_rates: str
    has_margin_rates: bool

    @property
    def word_count(self) -> int:
        """Number of words that hold the answers to the comparisons."""
        return self.program.word_count if self.program else 0

    @property
    def bit_count(self) -> int:
        """Number of bits that hold the answers to the comparisons; margins of events have the numbers after them."""
        return self.program.bit_count if self.program else 0

    def rates(self, t: Scalar, z: PyTree, held: PyTree, mode: Mode) -> PyTree:
        """Return dz/dt at time `t` within a `mode`, with z and `held` as `split_flow_and_held` returns them."""
        moving, fixed = (t, *z), (held, self.hybrid, self.objectives)
        if self.program is None:
            return _evaluate_rates(moving, fixed)
        return self.program(lambda dynamics: dynamics[:2], moving, fixed, mode)

    def sliding_rates(self, t: Scalar, z: PyTree, held: PyTree, mode: Mode) -> PyTree:
        """Return the rates of `rates` along the surfaces of a `mode`."""
        return slide(partial(self._look_at_rates, held), t, z, mode).dynamics

    def return_to_surfaces(self, t: Scalar, z: PyTree, held: PyTree, mode: Mode) -> PyTree:
        """Return the flow `z` moved onto the surfaces along which a run in this `mode` slides."""
        return return_to_surfaces(partial(self._look_at_rates, held), t, z, mode)

    def _look_at_rates(self, held: PyTree, t: Scalar, z: PyTree, mode: Mode) -> tuple[PyTree, ComparisonAnswers]:
        assert self.program is not None
        return self.program.look(lambda dynamics: dynamics[:2], (t, *z), (held, self.hybrid, self.objectives), mode)

    def list_margins(self, t: Scalar, state: HybridState, accumulators: Accumulators, mode: Mode) -> list[Scalar]:
        """Return the margins of comparisons and then of events at time `t`, `state` and `accumulators` in a `mode`."""
        z, held = split_flow_and_held(state, accumulators)
        moving, fixed = (t, *z), (held, self.hybrid, self.objectives)
        if self.program is None:
            return jax.tree.leaves(_evaluate(moving, fixed).margins)
        # The rates are asked for, because they depend on all comparisons.
        (margins, _), answers = self.program.look(
            lambda dynamics: (dynamics.margins, dynamics[:2]), moving, fixed, mode
        )
        return [answers.margins, *jax.tree.leaves(margins)]

    def evaluate(self, t: Scalar, state: HybridState, accumulators: Accumulators, mode: Mode) -> Evaluation:
        """Return the dynamics at time `t`, `state` and `accumulators` within a `mode`."""
        z, held = split_flow_and_held(state, accumulators)
        fixed = (held, self.hybrid, self.objectives)

        def look(t: Scalar, z: PyTree, mode: Mode) -> tuple[Instant, ComparisonAnswers]:
            if self.program is None:
                none = ComparisonAnswers((), (), np.zeros(0, int), jnp.zeros_like(t, shape=(0,)))
                return _evaluate((t, *z), fixed), none
            return self.program.look(lambda dynamics: dynamics, (t, *z), fixed, mode)

        def look_aside(t: Scalar, z: PyTree) -> SlidingDynamics:
            return SlidingDynamics(*look(t, z, mode), tuple(jnp.zeros_like(t) for _ in mode.along))

        if not mode.along:
            return self._differentiate(look_aside, t, z)
        return jax.lax.cond(
            any_lane(mode.slides),
            lambda: self._differentiate(lambda t, z: slide(look, t, z, mode), t, z),
            lambda: self._differentiate(look_aside, t, z),
        )

    def _differentiate(self, look: Callable[[Scalar, PyTree], SlidingDynamics], t: Scalar, z: PyTree) -> Evaluation:
        """Return what `look` sees at (t, z), with the time derivatives that a step needs."""

        def moving_signals(t: Scalar, z: object) -> tuple[PyTree, ComparisonAnswers]:
            dynamics, answers, _ = look(t, z)
            sample = dynamics.signals.sample
            shown = {"sample": sample, "shown": sample.show(), "": ()}[self.signal_rates]
            margins = (dynamics.margins, answers.margins) if self.has_margin_rates else ((), ())
            return (shown, dynamics.signals.recorded, *margins), answers

        dynamics, answers, shares = look(t, z)
        surfaces = SwitchingFunctions(answers.numbers, answers.margins)
        signal_rates, recorded_rates, margin_rates = (), dynamics.signals.recorded, ()
        if self.signal_rates or self.has_margin_rates or self.hybrid.recorders:
            # The derivative along (1, dz/dt) is the total time derivative on the trajectory.
            along = (jnp.ones_like(t), dynamics[:2])
            (_, _, _, values), moves, answers = jax.jvp(moving_signals, (t, z), along, has_aux=True)
            signal_rates, recorded_rates, margin_rates, rates = moves
            if self.has_margin_rates:
                surfaces = SwitchingFunctions(answers.numbers, values, rates)
        return Evaluation(
            *(dynamics[:2], dynamics.signals, dynamics.margins, answers.words, answers.contradicted, surfaces),
            *(signal_rates, recorded_rates, margin_rates, shares),
        )


def build_system(
    hybrid: HybridSystem,
    objectives: Objectives,
    t: Scalar,
    state: HybridState,
    accumulators: Accumulators,
    *,
    switched: bool,
    has_margin_rates: bool = False,
) -> ObservedSystem:
    """Return a system with its objectives. Its program is traced once for each structure and for these shapes.

    Of time, state and accumulators only shapes and types matter. A `switched` program has visible comparisons; without
    it the parts are evaluated directly.
    """
    z, held = split_flow_and_held(state, accumulators)
    args = ((t, *z), (held, hybrid, objectives))
    leaves, tree = jax.tree.flatten(args)
    # `result_type(float)` is part of the key: with another precision the same shapes give another program.
    key = (tree, tuple(map(jax.typeof, leaves)), jnp.result_type(float), switched)
    traced = _traced.get(key)
    if traced is None:
        while len(_traced) >= MAX_CACHED_SYSTEMS:
            _traced.pop(next(iter(_traced)), None)  # a dict keeps the order of insertion: the oldest goes first
        program = trace_program(*args) if switched else None
        traced = _traced[key] = program, _find_asked_rates(hybrid, objectives, t, state, accumulators, smooth=switched)
    return ObservedSystem(traced[0], hybrid, objectives, traced[1], has_margin_rates)


def trace_program(moving: object, fixed: object) -> SwitchedProgram:
    """Return the program of the dynamics with visible comparisons, for the arguments of `_evaluate`."""
    # `counts`: only comparisons that influence rates or recorded signals produce a kink in the run.
    return SwitchedProgram(_evaluate, moving, fixed, counts=lambda dynamics: (dynamics[:2], dynamics.signals.recorded))


def _find_asked_rates(
    hybrid: HybridSystem,
    objectives: Objectives,
    t: Scalar,
    state: HybridState,
    accumulators: Accumulators,
    *,
    smooth: bool,
) -> str:
    """Return the signals of a segment whose rates the objectives ask for, as `ObservedSystem.signal_rates`."""
    needed = set()

    def note(kind: str, rates: object) -> tuple[PyTree, PyTree]:
        needed.add(kind)
        return rates, rates

    def update(
        hybrid: HybridSystem, objectives: Objectives, state: HybridState, accumulators: Accumulators, t: Scalar
    ) -> dict[str, PyTree]:
        sample = hybrid.signals(t, state).sample
        segment = Segment(
            *(sample, sample, t, t),
            lambda: note("shown", sample.show()),
            lambda: note("sample", sample),
            smooth=t > 0 if smooth else False,
        )
        return {name: objective.update(accumulators[name], segment) for name, objective in objectives.items()}

    jax.eval_shape(update, hybrid, objectives, state, accumulators, t)
    return "sample" if "sample" in needed else "shown" if needed else ""


def split_flow_and_held(state: HybridState, accumulators: Accumulators) -> tuple[PyTree, PyTree]:
    """Return the integrated part of system and objectives, and the part that is constant between two instants."""
    flow = (state.flow(), {name: memory.flow for name, memory in accumulators.items()})
    return flow, (state.memories(), {name: memory.held for name, memory in accumulators.items()})


def with_flow(state: HybridState, accumulators: Accumulators, flow: PyTree) -> tuple[HybridState, Accumulators]:
    """Return state and accumulators with another integrated part, as `split_flow_and_held` returns it."""
    return state.with_flow(flow[0]), {
        name: memory._replace(flow=flow[1][name]) for name, memory in accumulators.items()
    }


def _evaluate(moving: PyTree, fixed: PyTree) -> Instant:
    """Return the dynamics for (time, flow, accumulator flow) and ((held, accumulator held), system, objectives)."""
    (t, flow, tally_flow), ((held, tally_held), hybrid, objectives) = moving, fixed
    state = hybrid.join_state(flow, held)
    accumulators = {name: Memory(tally_flow[name], tally_held[name]) for name in tally_flow}
    signals = hybrid.signals(t, state)
    rate = hybrid.flow(t, state, signals)
    margins = hybrid.margins(t, state, signals, lambda: rate)
    accumulator_rates = {
        name: objective.flow(accumulators[name], signals.sample) for name, objective in objectives.items()
    }
    return Instant(rate, accumulator_rates, signals, margins)


@jax.jit  # traced and differentiated once for all stages of a step
def _evaluate_rates(moving: object, fixed: object) -> tuple[PyTree, dict[str, PyTree]]:
    """Return the rates of `_evaluate`."""
    return _evaluate(moving, fixed)[:2]
