"""What a run under `Adaptive` has in hand: where it is, where a try has led, what is made of that."""

from typing import Any, NamedTuple

from diffabs.core.loop import LoopState, Margins, Signals
from diffabs.core.modes import ModeBits
from diffabs.core.protocols import Sample
from diffabs.simulate.condition import is_running
from diffabs.simulate.dynamics import Accumulators
from diffabs.simulate.landing import EventSearch


class AdaptivePoint(NamedTuple):
    """A run at an instant, after what changes there: the loop's state and the objectives' accumulators; what is seen,
    and its rates; what blocks record, and its rates; the rates of what is integrated; the margins of the stop and of
    the blocks' events; the answers to the comparisons, and in how many seconds the first of them will change."""

    t: Any
    state: LoopState
    accumulators: Accumulators
    sample: Sample
    moving: Sample
    recorded: tuple[dict[str, Any], dict[str, Any]]
    rate: tuple[Any, Any]
    margins: Margins
    words: ModeBits
    ahead: Any


class AdaptiveAttempt(NamedTuple):
    """The end of a try, before what changes there: the point, its signals, the error as a multiple of what is allowed,
    the largest values of the states so far, for how many seconds a comparison has been another one, and, where steps
    keep to a regime, the comparisons that say something else at the end."""

    point: AdaptivePoint
    signals: Signals
    error: Any
    scale: Any
    late: Any
    kink: Any


class AdaptiveCarry(NamedTuple):
    """A run on its way."""

    point: AdaptivePoint
    k: Any  # number of the last instant of the grid at which a clock struck
    since: Any  # for how long [s]: differences of times would lose digits
    error_limited: Any  # the length that the error allows [s]
    length: Any  # of the step to try [s]
    ends: Any  # whether that ends where a clock strikes, or with the run
    limit: Any  # the longest stable step [s]
    scale: Any  # the largest values of the states so far
    base: Any  # length of the try that an event was first seen in [s]
    search: EventSearch
    tries: Any
    tries_at_renewal: Any  # how many of these there were when the longest stable step was last looked at
    last_step: Any  # the last step, as a `Span`; () where nobody asks
    turns: Any  # steps in a row that ended where a comparison changes
    stability_fraction: Any  # the part of the longest stable step that a step may have, after an event
    unrestricted: (
        Any  # whether the comparisons in a step say at each stage what the numbers say, where steps keep to a regime
    )
    triggered: Any  # a bit for each event at the end of the last try
    status: Any

    running = property(is_running)


class AdaptiveDecision(NamedTuple):
    """What is made of a try: whether its numbers are finite; whether it is taken; whether an event was seen in it, and
    is to be looked for; which events happen at its end, and whether the run is over there."""

    fine: Any
    taken: Any
    searches_event: Any
    triggered: Margins
    over: Any
