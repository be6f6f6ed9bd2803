"""Data of a run under `Adaptive`: its present point, the end of an attempt, and the decision on it."""

from typing import Any, NamedTuple

from diffabs.core.loop import LoopState, Margins, Signals
from diffabs.core.protocols import Sample
from diffabs.core.types import Bool, Int, PyTree, Scalar
from diffabs.simulate.step.event_location import EventSearch
from diffabs.simulate.step.modes import ModeBits
from diffabs.simulate.step.status import is_running
from diffabs.simulate.step.system import Accumulators


class AdaptivePoint(NamedTuple):
    """A run at an instant, after the changes there.

    Attributes:
        t: Time [s].
        state: State of the loop.
        accumulators: Accumulators of the objectives.
        sample: Sample of the signals.
        moving: Rates of the sample.
        recorded: Signals that blocks record, and their rates.
        rate: Rates of the loop's flow and of the objectives' integrals.
        margins: Margins of the stop and of the blocks' events.
        words: Answers to the comparisons.
        ahead: Predicted time to the first change of an answer [s].
    """

    t: Scalar
    state: LoopState
    accumulators: Accumulators
    sample: Sample
    moving: Sample
    recorded: tuple[dict[str, PyTree], dict[str, PyTree]]
    rate: tuple[PyTree, PyTree]
    margins: Margins
    words: ModeBits
    ahead: Scalar


class AdaptiveAttempt(NamedTuple):
    """The end of an attempt, before the changes there.

    Attributes:
        point: Point at the end.
        signals: Signals of the loop.
        error: Error as a multiple of the allowed error.
        scale: Largest values of the states so far.
        late: Time from the first change of a comparison inside the step to its end [s], or 0.
        kink: Contradicted comparisons, if steps keep to a mode; else ().
    """

    point: AdaptivePoint
    signals: Signals
    error: Scalar
    scale: Scalar
    late: Scalar
    kink: Any


class AdaptiveCarry(NamedTuple):
    """State of a run between two attempts.

    Attributes:
        point: Point of the run that the last accepted attempt reached.
        k: Number of the last instant of the grid at which a clock struck.
        since: Time since that instant [s]. A difference of two times would lose digits.
        error_limited: Length that the error allows [s].
        length: Length of the next attempt [s].
        ends: True if the attempt ends where a clock strikes, or with the run.
        limit: Longest stable step [s].
        scale: Largest values of the states so far.
        base: Length of the attempt that first contained the sought event [s].
        search: Search for an event.
        tries: Number of attempts so far.
        tries_at_renewal: Number of attempts at the last update of the stability limit.
        last_step: Last step, a `HermiteStep`; () without a trajectory.
        turns: Number of consecutive steps that ended on switching surfaces.
        stability_fraction: Fraction of the longest stable step that a step may have after an event.
        unrestricted: True if each stage evaluates its comparisons, in a run whose steps otherwise keep to a mode.
        triggered: Bit mask of the events at the end of the last attempt.
        status: Status of the run, a `RunStatus`.
    """

    point: AdaptivePoint
    k: Int  # number of the last instant of the grid at which a clock struck
    since: Scalar  # time since that instant [s]: a difference of times would lose digits
    error_limited: Scalar  # length that the error allows [s]
    length: Scalar  # length of the next attempt [s]
    ends: PyTree  # True if the attempt ends where a clock strikes, or with the run
    limit: Scalar  # longest stable step [s]
    scale: Scalar  # largest values of the states so far
    base: Scalar  # length of the attempt that first contained the sought event [s]
    search: EventSearch
    tries: Int  # number of attempts so far
    tries_at_renewal: Any  # number of attempts at the last update of the stability limit
    last_step: Any  # last step, a `HermiteStep`; () without a trajectory
    turns: Int  # number of consecutive steps that ended on switching surfaces
    stability_fraction: Any  # fraction of the longest stable step that a step may have after an event
    unrestricted: Bool  # True if each stage evaluates its comparisons, in a run whose steps otherwise keep to a mode
    triggered: PyTree  # bit mask of the events at the end of the last attempt
    status: Scalar

    running = property(is_running)


class AdaptiveDecision(NamedTuple):
    """Decision on an attempt.

    Attributes:
        fine: True if its numbers are finite.
        taken: True if the attempt is accepted.
        searches_event: True if an event or a switching surface lies inside and is to be located.
        triggered: True for each event at its end.
        over: True if the run ends there.
    """

    fine: Bool
    taken: PyTree
    searches_event: Bool
    triggered: Margins
    over: Any
