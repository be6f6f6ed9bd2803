"""Status of a run, and event location: find the zero of a margin within a step, and the length of the step that ends
on it.

A margin of the stop, of a block, or of a comparison in the flow may fall through zero within a step. Then shorter steps
are attempted until one ends on the zero. So the run discretises the exact solution on both sides of the event, without
a later correction.

    RUNNING --a margin falls--> SEEKING --near its zero--> PROBING --> (REFINING) --> LANDING --> RUNNING, or STOPPED
       ^                          |  ^                        |                          |
       |                          |  +----missed the zero-----+                          | something has changed
       +--gave up: no mode--------+                                                      v
       +-------------------------------------------------------------------------- REFRESHING

    seek    attempts shrink a bracket, by secant, by Newton's step on a parabola, or by bisection, until one ends near
            the zero
    probe   an attempt beside it, on the same side of the zero, measures how the margin falls there
    land    the final step has the length place - margin(place)/slope, at least 0, and goes slightly beyond the surface
            of a comparison. Its derivative is that of the event's time by the implicit function theorem: the margin at
            the end of an attempt carries the derivative
    refine  for derivatives with fixed steps: one more attempt of the located length. The margin at its end gives one
            more Newton step, which doubles the order of the derivative
    refresh a step of length 0 evaluates the rates after an event, or within the mode beyond a switching surface. In a
            loop with a clock the rates are evaluated after every step, and no step of length 0 is needed

Every margin has a number. That of a comparison is the number of its bit. The stop and the blocks' events have the
numbers after the last bit. The margin of a comparison is known only at the end of an attempt.

Source: A. Griewank, A. Walther, Evaluating Derivatives, section 15.3 (order of the refinement).
"""

import enum
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.lanes import keep_decision, select
from diffabs.core.numerics import ratio
from diffabs.core.types import Any, AnyArray, Array, Bool, Int, PyTree, Scalar
from diffabs.engine.hybrid import HybridSystem
from diffabs.engine.step.modes import SurfaceCrossing

NEWTON_RADIUS_STEPS = 1e-4  # steps: a Newton step from here misses the zero by some 1e-8 steps
PROBE_EXPONENT = 0.2  # the probe is eps**PROBE_EXPONENT steps away
OVERSHOOT_EXPONENT = 0.5  # a step ends eps**OVERSHOOT_EXPONENT steps past a switching surface
MAX_LOCATION_ATTEMPTS = 24  # greatest number of attempts for an event, whose margin may have a corner or jump
BISECT = 4  # every fourth attempt halves the bracket
# Fraction of the margin's mean rate in the step. A margin with a slower fall at the beginning only touches zero there.
GRAZING_FRACTION = 1e-2
MAX_PROBE_BEND = 0.1  # greatest share of the slope by which it may change between the place and the probe
# Fraction of the slope: greatest correction by the cubic through both ends of a step. A larger correction is a kink.
MAX_CUBIC_CORRECTION = 1e-4
# Fraction of the fall: greatest change within a step in which the margin counts as smooth.
MAX_SLOPE_CHANGE = 0.5
# A landing on the stop may leave at most this fraction of the margin's change in the step.
MAX_MISSED_FRACTION = 0.1


class RunStatus(enum.IntEnum):
    """Status of a run; every value up to `REFRESHING` means that the run goes on.

    Attributes:
        RUNNING: The next attempt is an ordinary step.
        SEEKING: Attempts shrink a bracket around an event.
        PROBING: The attempt measures how the margin falls near the event.
        REFINING: The attempt refines the derivatives of the event's time, and provides second ones.
        LANDING: The attempt ends on the event.
        REFRESHING: A step of length 0 evaluates the rates after the event, or beyond the switching surface.
        STOPPED: The run is over and has reached its stop.
        TIMED_OUT: The run is over because its duration has passed.
        DIVERGED: The run is over because its numbers are invalid, or no step meets its tolerance.
        EXHAUSTED: The run is over because its attempts are too many.
        MISSED: The run is over because its landing misses the stop, or its start is beyond the stop.
        REFUSED: The run was not accepted, and over from the beginning.
        SLID: The run is over because it slides along a switching surface and does not follow it; only with adaptive
            steps or `WatchedModes`.
        GRAZED: The run is over because a margin only touches zero; only with `WatchedModes`.
    """

    RUNNING, SEEKING, PROBING, REFINING, LANDING, REFRESHING, STOPPED, TIMED_OUT = range(8)
    DIVERGED, EXHAUSTED, MISSED, REFUSED, SLID, GRAZED = range(8, 14)


def is_running(carry: PyTree) -> Array:
    """Return True if the run needs another attempt."""
    return carry.status <= RunStatus.REFRESHING


def end_unfinished(carry: PyTree) -> PyTree:
    """Return the carry after the last attempt for which there is capacity: a run that still goes on is exhausted."""
    status = jnp.where(is_running(carry), RunStatus.EXHAUSTED, carry.status)
    return carry._replace(status=status.astype(carry.status.dtype))


def status_after_step(hybrid: HybridSystem, carry: PyTree, attempt: PyTree, decision: PyTree) -> Scalar:
    """Return the status after an accepted attempt.

    A landing whose margin is too far from zero (`MAX_MISSED_FRACTION`) misses the stop.
    """
    before, after, stops = (x["stop"] for x in (carry.point.margins, attempt.point.margins, decision.triggered))
    at_full = jnp.abs(carry.search.at_full)
    misses = [
        stop & ~(jnp.abs(b) <= MAX_MISSED_FRACTION * (a + at_full))
        for a, b, stop in zip(before, after, stops, strict=True)
    ]
    landed = jnp.where(reduce(jnp.logical_or, misses), RunStatus.MISSED, RunStatus.STOPPED)
    further = jnp.asarray(RunStatus.RUNNING)
    if not hybrid.ticks:
        changed = jnp.any(jnp.stack([decision.crosses_surface, *jax.tree.leaves(decision.triggered)]))
        further = jnp.where(changed, RunStatus.REFRESHING, RunStatus.RUNNING)
    return jnp.where(reduce(jnp.logical_or, stops), landed, jnp.where(decision.over, RunStatus.TIMED_OUT, further))


class EventSearch(NamedTuple):
    """State of an event search. All lengths start at the last point of the run. A margin is infinite where it is not
    known.

    Attributes:
        number: Number of the sought margin.
        full: Length of the first attempt [s].
        at_full: Margin there.
        near: Shorter length of the bracket [s].
        at_near: Margin there.
        far: Longer length of the bracket [s].
        at_far: Margin there.
        tries: Number of attempts.
        place: Length of the attempt that ended near the zero [s].
        margin: Margin there; 0 if the search found no zero.
        located: True if the search found a zero.
        at_once: True if the zero lies at the beginning of the step.
        fall: Slope of the margin at the end of the final step [1/s]; 0 if the event's time has no derivative.
    """

    number: Array
    full: Scalar
    at_full: Scalar
    near: Scalar
    at_near: Scalar
    far: Scalar
    at_far: Scalar
    tries: Int
    place: Scalar
    margin: Scalar
    located: Bool
    at_once: Bool
    fall: Scalar


class EventCrossing(NamedTuple):
    """A margin at both ends of an attempt.

    Attributes:
        number: Number of the margin.
        end: Margin at the end of the attempt.
        start: Margin at its beginning.
    """

    number: Int
    end: PyTree
    start: PyTree


class AttemptCrossings(NamedTuple):
    """Crossings within an attempt.

    Attributes:
        sought: Margin that the search looks for.
        falls: True if the sought margin falls through zero within the attempt.
        unsought: Another margin that falls through zero; of several events the earliest, by linear interpolation.
        another: True if such another margin exists.
    """

    sought: EventCrossing
    falls: Any
    unsought: EventCrossing
    another: Array


class SearchPlan(NamedTuple):
    """A search, and the next attempt that it asks for.

    Attributes:
        search: The search.
        length: Length of the next attempt [s].
        status: Status of the run, a `RunStatus`.
    """

    search: EventSearch
    length: Scalar
    status: Array


def init_search(h: Scalar) -> EventSearch:
    """Return an empty search, from the length of a step [s]."""
    none, zero, no = 0.0 * h, jnp.asarray(0), jnp.asarray(False)
    return EventSearch(zero, h, none, none, none, h, none, zero, h, none, no, no, none)


def falls_through(before: list[PyTree], after: list[PyTree]) -> list[PyTree]:
    """Return True for each margin that falls through zero between the beginning and the end of a step."""
    return [(a >= 0) & (b < 0) for a, b in zip(before, after, strict=True)]


def _find_event_crossings(number: Array, first: int, before: list[PyTree], after: list[PyTree]) -> AttemptCrossings:
    crossed = falls_through(before, after)
    unsought_falls = [crosses & (number != first + i) for i, crosses in enumerate(crossed)]
    triples = zip(unsought_falls, before, after, strict=True)
    places = jnp.stack([jnp.where(crosses, a / jnp.where(crosses, a - b, 1.0), jnp.inf) for crosses, a, b in triples])
    unsought = first + jnp.argmin(places).astype(number.dtype)
    picked = [EventCrossing(i, _pick(i - first, after), _pick(i - first, before)) for i in (number, unsought)]
    falls = _pick(number - first, crossed) & (number >= first)
    return AttemptCrossings(picked[0], falls, picked[1], jnp.any(jnp.stack(unsought_falls)))


def find_crossings(
    number: Array, bit_count: int, surface: SurfaceCrossing | None, before: list[PyTree], after: list[PyTree]
) -> AttemptCrossings:
    """Return the crossings of switching surfaces and events within an attempt.

    `surface` is None if switching surfaces are not located. `before` and `after` are the events' margins at both ends.
    """
    events = _find_event_crossings(number, bit_count, before, after)
    if surface is None:
        return events
    unknown, bends = jnp.full_like(surface.margin, jnp.inf), surface.unsought >= 0
    at = [jnp.where(surface.target == bit, surface.margin, jnp.inf) for bit in (number, surface.unsought)]
    sought = select(number < bit_count, EventCrossing(number, at[0], unknown), events.sought)
    unsought = select(bends, EventCrossing(surface.unsought, at[1], unknown), events.unsought)
    return AttemptCrossings(sought, surface.contradicted | events.falls, unsought, bends | events.another)


def continue_search(
    plan: SearchPlan, crossings: AttemptCrossings, base: Array, bit_count: int, *, refines: bool
) -> SearchPlan:
    """Return the search after an attempt that contains an event or a switching surface.

    `base` is the length of a regular step [s], the scale of the tolerances. If the search `refines`, the event's time
    has second derivatives.
    """
    old, length, status = plan
    search, next, near = _bracket_event(old, length, status == RunStatus.RUNNING, crossings, base)
    seeking = SearchPlan(search, next, jnp.where(near, RunStatus.PROBING, RunStatus.SEEKING))
    # A step ends sqrt(eps) steps beyond a switching surface, so that the comparison has surely changed there.
    overshoot = base * jnp.finfo(base.dtype).eps ** OVERSHOOT_EXPONENT
    is_surface = old.number < bit_count
    # A comparison may bend the margin of an event at its very zero. So the refining attempt ends as far aside, on the
    # side of the place, whose slope the search has.
    aside = jnp.where(is_surface | (not refines), 0.0, jnp.where(old.margin > 0, -overshoot, overshoot))
    beyond = jnp.where(is_surface, overshoot, aside)
    search, landing = _locate_event(old, length, crossings)
    next, missed = _accept_location(search, length, landing, beyond)
    located = jnp.where(missed, RunStatus.SEEKING, RunStatus.REFINING if refines else RunStatus.LANDING)
    next_plan = select(status == RunStatus.PROBING, SearchPlan(search, next, located), seeking)
    if refines:
        refined = SearchPlan(old, refine(old, length, aside, crossings), status * 0 + RunStatus.LANDING)
        next_plan = select(status == RunStatus.REFINING, refined, next_plan)
    return next_plan._replace(status=next_plan.status.astype(status.dtype))


def _bracket_event(
    search: EventSearch, x: Scalar, new: PyTree, crossings: AttemptCrossings, h: Array
) -> tuple[EventSearch, PyTree, PyTree]:
    """Return three values after an attempt: the search for the earliest event, the next length [s], and a flag.

    The flag is True if the next length is the probe: `x` is then near enough to the zero.
    """
    # The search works on values only: the derivative of the event's time comes from the final Newton step.
    x = jax.lax.stop_gradient(x)
    changes = crossings.another & ~crossings.falls
    fresh, sought = new | changes, select(changes, crossings.unsought, crossings.sought)
    search, slope = _narrow_bracket(search, x, fresh, sought)
    search = search._replace(tries=jnp.where(new, 0, search.tries) + 1)
    falls = slope < 0
    correction = jax.lax.stop_gradient(sought.end) / jnp.where(falls, slope, -1.0)
    near = falls & (jnp.abs(correction) <= NEWTON_RADIUS_STEPS * h)
    near |= jnp.isfinite(sought.end) & ~fresh & (search.far - search.near <= 4 * NEWTON_RADIUS_STEPS * h)
    at_once = (sought.end < 0) & (x <= 1.5 * NEWTON_RADIUS_STEPS * h)
    enough = near | at_once | (search.tries >= MAX_LOCATION_ATTEMPTS)

    width, newton = search.far - search.near, x - correction
    share = ratio(search.at_near, search.at_near - search.at_far, 0.5)
    # The first guess is no shorter, because the margin need not fall yet at the very beginning of the step.
    shortest = jnp.minimum(NEWTON_RADIUS_STEPS * h, 0.5 * width)
    first = jnp.where(jnp.isfinite(search.at_near), jnp.maximum(search.near + share * width, shortest), shortest)
    inside = falls & (newton > search.near) & (newton < search.far) & (search.tries % BISECT != 0)
    guess = jnp.where(inside, newton, jnp.where(fresh, first, search.near + 0.5 * width))
    apart = h * jnp.finfo(h.dtype).eps ** PROBE_EXPONENT
    # The probe stays within the step: before its beginning the mode does not hold, and the margin has no meaning.
    probe = jnp.where(sought.end < 0, x + apart, jnp.where(x > apart, x - apart, 0.5 * x))
    located = near | at_once
    search = search._replace(place=x, margin=jnp.where(located, sought.end, 0.0), located=located, at_once=at_once)
    # The attempt ends just beyond the sought zero. If another margin falls through zero in it, its zero is earlier.
    earlier = (
        enough & ~at_once & crossings.another & ~changes & crossings.falls & (search.tries < MAX_LOCATION_ATTEMPTS)
    )
    search = select(earlier, _bracket(search, x, crossings.unsought), search)
    # The next attempt is just before this zero, because two margins often fall at the same time.
    before = jnp.where(x > 4 * NEWTON_RADIUS_STEPS * h, x - 2 * NEWTON_RADIUS_STEPS * h, 0.5 * x)
    return search, jnp.where(earlier, before, jnp.where(enough, probe, guess)), enough & ~earlier


def _locate_event(search: EventSearch, x: Scalar, crossings: AttemptCrossings) -> tuple[EventSearch, PyTree]:
    """Return the search with the margin's slope, and the length of the step that ends on the zero, after the probe.

    The slope is that of the parabola through the place, the probe, and one end of the first attempt. This is the end on
    the same side. It is the other end if that one is uninformative and the margin is smooth up to there.
    """
    x = jax.lax.stop_gradient(x)
    place, margin = jax.lax.stop_gradient((search.place, search.margin))
    # The margin is unknown if another comparison changes at the probe and the sought one does not.
    is_known = jnp.isfinite(crossings.sought.end)
    probe = crossings.sought._replace(end=jnp.where(is_known, crossings.sought.end, margin))
    g, start = jax.lax.stop_gradient(probe[1:])
    ends = (search.full, search.at_full), (0.0 * x, start)
    side, opposite = select(margin < 0, ends, ends[::-1])
    same_side = _shows_curvature(side, place, x)
    third = select(same_side, side, opposite)
    fall = (g - margin) / (x - place)
    # Over a long attempt the margin may be no parabola. Then the bracket's end beyond the place is a nearer point.
    bends = jnp.abs(ratio(third[1] - g, third[0] - x) - fall) * jnp.abs(ratio(place - x, third[0] - place))
    nearer = select(margin < 0, (search.near, search.at_near), (search.far, search.at_far))
    takes_nearer = (bends > MAX_PROBE_BEND * jnp.abs(fall)) & jnp.isfinite(nearer[1]) & (nearer[0] != place)
    end, at_end = third = select(takes_nearer, nearer, third)
    changes = ratio(at_end - g, end - x) - fall
    curved = same_side | (_shows_curvature(third, place, x) & (jnp.abs(changes) <= MAX_SLOPE_CHANGE * jnp.abs(fall)))
    # Newton's divided differences: `fall` is the first, `bend` the second.
    bend = jnp.where(curved, ratio(changes, end - place), 0.0)
    at_place = jnp.where(is_known, fall + (place - x) * bend, 0.0)
    # Division by -inf instead of a slope that is not negative: the length stays at the place.
    length = place - margin / jnp.where(at_place < 0, at_place, -jnp.inf)
    slope = at_place + 2.0 * (length - place) * bend
    last, at_last = select(same_side & _shows_curvature(opposite, place, x), opposite, third)
    # The third divided difference improves the slope unless it is large: then a kink lies between the points.
    more = ratio(ratio(ratio(at_last - g, last - x) - fall, last - place) - bend, last - end)
    more *= (length - place) * (length - x) + (length - place + length - x) * (length - end)
    slope += jnp.where(jnp.abs(more) <= MAX_CUBIC_CORRECTION * jnp.abs(slope), more, 0.0)
    beyond_probe = keep_decision(jnp.abs(length - place) > jnp.abs(x - place))
    length = jnp.where(beyond_probe, jnp.maximum(jnp.minimum(length, search.far), search.near), length)
    has_tangent = keep_decision(search.located & (slope < 0) & ~beyond_probe)
    moved = length + jnp.where(beyond_probe, 0.0, _length_tangent(search, x, probe.end, length, slope))
    steep = keep_decision(_falls_from_start(search, at_place, start))
    has_tangent &= ~search.at_once | steep
    # For an event at the beginning of the step the length is clipped at 0 in value, but not in its derivative.
    at_once = jnp.where(steep, moved - jax.lax.stop_gradient(jnp.minimum(moved, 0.0)), 0.0)
    # The slope has the derivatives of that between place and probe, and of the length.
    moves = jnp.where(has_tangent, ratio(probe.end - search.margin, x - place) + 2.0 * bend * moved, 0.0)
    slope += moves - jax.lax.stop_gradient(moves)
    return search._replace(fall=jnp.where(has_tangent, slope, 0.0)), jnp.where(search.at_once, at_once, moved)


def refine(search: EventSearch, x: Scalar, aside: Scalar, crossings: AttemptCrossings) -> Scalar:
    """Return the length of the step that ends on the event [s], with the second derivatives of the event's time.

    The value is x less `aside`, the lengths [s] of an attempt and of its end beyond the event. The derivatives come
    from a Newton step on the margin there.
    """
    has_tangent = (search.fall < 0) & jnp.isfinite(crossings.sought.end)
    remaining = jnp.where(has_tangent, crossings.sought.end - aside * search.fall, 0.0)
    fall = jnp.where(search.fall < 0, jax.lax.stop_gradient(search.fall), -1.0)
    return x - aside - (remaining - jax.lax.stop_gradient(remaining)) / fall


def _accept_location(search: EventSearch, x: Scalar, length: Scalar, beyond: Scalar) -> tuple[PyTree, PyTree]:
    """Return the length to try after the probe, and True if the search continues from the middle of the bracket.

    Without a further search it is the `length` to the zero, and the time [s] by which the step ends `beyond` it. The
    search continues if the final step would end farther from `place` than the probe, or if the margin does not fall
    there. A margin can be almost flat, or rise, and then fall suddenly.
    """
    probe, distance = jnp.abs(x - search.place), jnp.abs(length - search.place)
    missed = ((distance > probe) | ((distance == 0) & (search.margin != 0))) & (search.far - search.near > probe)
    again = jax.lax.stop_gradient(missed & ~search.at_once & (search.tries < MAX_LOCATION_ATTEMPTS))
    return jnp.where(again, 0.5 * (search.near + search.far), length + beyond), again


def _length_tangent(search: EventSearch, x: Scalar, g: AnyArray, zero: Scalar, fall: Scalar) -> Scalar:
    """Return a number with value 0 and the derivatives of the event's length.

    They come from the derivatives of the margin at the place and at the probe x. Linear extrapolation continues them to
    the zero, because they change over the ten-thousandth of a step between.
    """
    has_tangent = search.located & (fall < 0)
    share = ratio(zero - search.place, x - search.place)
    ends = (jnp.where(has_tangent, end, 0.0) for end in (search.margin, g))
    rises = sum(part * (end - jax.lax.stop_gradient(end)) for part, end in zip((1.0 - share, share), ends, strict=True))
    return -rises / jnp.where(has_tangent, fall, -1.0)


def _shows_curvature(end: tuple[PyTree, PyTree], place: Scalar, probe: Scalar) -> Bool:
    """Return True if the margin at an end of an attempt determines the curvature between the place and the probe."""
    length, margin = end
    return (jnp.abs(length - place) > 4 * jnp.abs(place - probe)) & jnp.isfinite(margin)


def _falls_from_start(search: EventSearch, fall: Scalar, start: Array) -> Bool:
    """Return True if the margin is smooth and falls at the beginning of the step at `GRAZING_FRACTION` of its mean rate
    or faster.

    Only then does the time of an event there have a derivative. It has none if the margin jumps or has its maximum
    there.
    """
    place, margin = jax.lax.stop_gradient((search.place, search.margin))
    smooth = jnp.where(
        jnp.isfinite(start), jnp.abs(margin - fall * place - start) <= -MAX_SLOPE_CHANGE * fall * place, True
    )
    mean = jnp.where(jnp.isfinite(search.at_full), search.at_full / search.full, 0.0)
    return smooth & (fall < 0) & (fall <= GRAZING_FRACTION * jax.lax.stop_gradient(mean))


def _narrow_bracket(old: EventSearch, x: Scalar, first: PyTree, sought: EventCrossing) -> tuple[EventSearch, PyTree]:
    """Return the search whose bracket ends at the attempt x, and the margin's slope in the length there.

    The slope is that of the parabola through the ends of the bracket and this point; 0 for a new bracket.
    """
    g = jax.lax.stop_gradient(sought.end)
    slope = jnp.where(first, 0.0, _slope(old, x, g))
    new = _bracket(old, x, sought)
    closer = select(g < 0, old._replace(far=x, at_far=g), old._replace(near=x, at_near=g))
    return select(first, new, closer), slope


def _bracket(old: EventSearch, x: Scalar, sought: EventCrossing) -> EventSearch:
    """Return a search with the bracket from the beginning of the step to the attempt of length x."""
    g, start = jax.lax.stop_gradient(sought[1:])
    return old._replace(number=sought.number, full=x, at_full=g, near=0.0 * x, at_near=start, far=x, at_far=g)


def _slope(search: EventSearch, x: Scalar, g: AnyArray) -> Scalar:
    """Return d(margin)/d(length) at x, from the parabola through the ends of the bracket and (x, g)."""
    far_slope = jnp.where(jnp.isfinite(search.at_far), ratio(search.at_far - g, search.far - x), 0.0)
    near_slope = ratio(g - search.at_near, x - search.near)
    bent = near_slope + far_slope - ratio(search.at_far - search.at_near, search.far - search.near)
    return jnp.where(jnp.isfinite(search.at_near) & jnp.isfinite(search.at_far), bent, far_slope)


def _pick(number: Int, values: list[PyTree]) -> Array:
    picked = values[0]
    for i, value in enumerate(values[1:], 1):
        picked = jnp.where(number == i, value, picked)
    return picked
