"""Event location: find the zero of a margin within a step, and the length of the step that ends on it.

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
    land    the final step has the length place - margin(place)/fall. Its derivative is that of the event's time by the
            implicit function theorem: the margin at the end of an attempt carries the derivative
    refine  for second derivatives: one more attempt of the located length. The margin at its end gives one more Newton
            step, which doubles the order of the derivative
    refresh a step of length 0 evaluates the rates after an event, or within the mode beyond a switching surface. In a
            loop with a clock the rates are evaluated after every step, and no step of length 0 is needed

Every margin has a number. That of a comparison is the number of its bit. The stop and the blocks' events have the
numbers after the last bit. The margin of a comparison is known only at the end of an attempt.

Source: A. Griewank, A. Walther, Evaluating Derivatives, section 15.3 (order of the refinement).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.lanes import select
from diffabs.core.numerics import ratio
from diffabs.core.types import AnyArray, Bool, Int, PyTree, Scalar
from diffabs.simulate.step.modes import ComparisonAnswers, SurfaceCrossing, find_contradicted
from diffabs.simulate.step.status import RunStatus
from diffabs.simulate.step.system import Evaluation

NEWTON_RADIUS_STEPS = 1e-4  # steps: a Newton step from here misses the zero by some 1e-8 steps
PROBE_EXPONENT = 0.2  # the probe is eps**PROBE_EXPONENT steps away
OVERSHOOT_EXPONENT = 0.5  # a step ends eps**OVERSHOOT_EXPONENT steps past a switching surface
MAX_LOCATION_ATTEMPTS = 24  # greatest number of attempts for an event, whose margin may have a corner or jump
BISECT = 4  # every fourth attempt halves the bracket
# Fraction of the margin's mean rate in the step. A margin with a slower fall at the beginning only touches zero there.
GRAZING_FRACTION = 1e-2
# Fraction of the slope: greatest correction by the cubic through both ends of a step. A larger correction is a kink.
MAX_CUBIC_CORRECTION = 1e-4
# Fraction of the fall: greatest change within a step in which the margin counts as smooth.
MAX_SLOPE_CHANGE = 0.5


class EventSearch(NamedTuple):
    """State of an event search. All lengths start at the last point of the run. A margin is infinite where it is not
    known.

    Attributes:
        which: Number of the sought margin.
        full: Length of the first attempt [s].
        at_full: Margin there.
        near: Shorter length of the bracket [s].
        at_near: Margin there.
        far: Longer length of the bracket [s].
        at_far: Margin there.
        tries: Number of attempts.
        place: Length of the attempt that ended near the zero [s].
        margin: Margin there; 0 if the search found no zero.
        found: True if the search found a zero.
        at_once: True if the zero lies at the beginning of the step.
        fall: Slope of the margin at the end of the final step [1/s]; 0 if the event's time has no derivative.
    """

    which: Int
    full: Scalar
    at_full: Scalar
    near: Scalar
    at_near: Scalar
    far: Scalar
    at_far: Scalar
    tries: Int
    place: Scalar
    margin: Scalar
    found: Bool
    at_once: Bool
    fall: Scalar


class EventCrossing(NamedTuple):
    """A margin at both ends of an attempt.

    Attributes:
        which: Number of the margin.
        end: Margin at the end of the attempt.
        start: Margin at its beginning.
    """

    which: Int
    end: PyTree
    start: PyTree


class AttemptCrossings(NamedTuple):
    """Crossings within an attempt.

    Attributes:
        sought: Margin that the search looks for.
        falls: True if the sought margin falls through zero within the attempt.
        other: Another margin that falls through zero; of several events the earliest, by linear interpolation.
        another: True if such another margin exists.
    """

    sought: EventCrossing
    falls: Scalar
    other: EventCrossing
    another: Bool


class SearchPlan(NamedTuple):
    """A search, and the next attempt that it asks for.

    Attributes:
        search: The search.
        length: Length of the next attempt [s].
        status: Status of the run, a `RunStatus`.
    """

    search: EventSearch
    length: Scalar
    status: Scalar


def init_search(h: Scalar) -> EventSearch:
    """Return an empty search.

    Args:
        h: Length of a step [s].
    """
    none, zero, no = 0.0 * h, jnp.asarray(0), jnp.asarray(False)
    return EventSearch(zero, h, none, none, none, h, none, zero, h, none, no, no, none)


def falls_through(before: list[PyTree], after: list[PyTree]) -> list[PyTree]:
    """Return True for each margin that falls through zero between the beginning and the end of a step.

    Args:
        before: Margins at the beginning.
        after: Margins at the end.
    """
    return [(a >= 0) & (b < 0) for a, b in zip(before, after, strict=True)]


def _find_event_crossings(which: Scalar, first: int, before: list[PyTree], after: list[PyTree]) -> AttemptCrossings:
    """Return the crossings of events within an attempt."""
    crossed = falls_through(before, after)
    others = [one & (which != first + i) for i, one in enumerate(crossed)]
    triples = zip(others, before, after, strict=True)
    places = jnp.stack([jnp.where(one, a / jnp.where(one, a - b, 1.0), jnp.inf) for one, a, b in triples])
    other = first + jnp.argmin(places).astype(which.dtype)
    picked = [EventCrossing(i, _pick(i - first, after), _pick(i - first, before)) for i in (which, other)]
    falls = _pick(which - first, crossed) & (which >= first)
    return AttemptCrossings(picked[0], falls, picked[1], jnp.any(jnp.stack(others)))


def find_surface_crossing(seen: Evaluation, which: Scalar, like: Scalar) -> SurfaceCrossing:
    """Return the comparisons whose answers at the end of a step contradict the mode of the step.

    Args:
        seen: Dynamics at the end of the step, within its mode.
        which: Number of the sought comparison.
        like: A number with the type of the margin.
    """
    margins = [(one.numbers, one.value) for one in seen.surfaces]
    return find_contradicted(ComparisonAnswers(seen.words, seen.contradicted, margins), which, like)


def find_crossings(
    which: Scalar, bit_count: int, surface: SurfaceCrossing | None, before: list[PyTree], after: list[PyTree]
) -> AttemptCrossings:
    """Return the crossings of switching surfaces and events within an attempt.

    Args:
        which: Number of the sought margin.
        bit_count: Number of bits of the comparisons. Events have the numbers after them.
        surface: Contradicted comparisons at the end of the attempt; None if switching surfaces are not located.
        before: Margins of events at the beginning.
        after: Margins of events at the end.
    """
    events = _find_event_crossings(which, bit_count, before, after)
    if surface is None:
        return events
    unknown, bends = jnp.full_like(surface.margin, jnp.inf), surface.other >= 0
    at = [jnp.where(surface.chosen == one, surface.margin, jnp.inf) for one in (which, surface.other)]
    sought = select(which < bit_count, EventCrossing(which, at[0], unknown), events.sought)
    other = select(bends, EventCrossing(surface.other, at[1], unknown), events.other)
    return AttemptCrossings(sought, surface.contradicted | events.falls, other, bends | events.another)


def continue_search(
    plan: SearchPlan, crossings: AttemptCrossings, base: Scalar, bit_count: int, *, refines: bool
) -> SearchPlan:
    """Return the search after an attempt that contains an event or a switching surface.

    Args:
        plan: The search before the attempt, the length of the attempt, and the status of the run.
        crossings: Crossings within the attempt.
        base: Length of a regular step [s], the scale of the tolerances.
        bit_count: Number of bits of the comparisons; 0 if switching surfaces are not located.
        refines: True if the event's time has second derivatives.
    """
    old, length, status = plan
    search, next, near = _bracket_event(old, length, status == RunStatus.RUNNING, crossings, base)
    seeking = SearchPlan(search, next, jnp.where(near, RunStatus.PROBING, RunStatus.SEEKING))
    # A step ends sqrt(eps) steps beyond a switching surface, so that the comparison has surely changed there.
    beyond = jnp.where(old.which < bit_count, base * jnp.finfo(base.dtype).eps ** OVERSHOOT_EXPONENT, 0.0)
    search, next = _locate_event(old, length, crossings, beyond)
    next, missed = _accept_location(search, length, next)
    located = jnp.where(missed, RunStatus.SEEKING, RunStatus.REFINING if refines else RunStatus.LANDING)
    found = select(status == RunStatus.PROBING, SearchPlan(search, next, located), seeking)
    if refines:
        refined = SearchPlan(old, refine(old, length, crossings), status * 0 + RunStatus.LANDING)
        found = select(status == RunStatus.REFINING, refined, found)
    return found._replace(status=found.status.astype(status.dtype))


def _bracket_event(
    search: EventSearch, x: Scalar, new: PyTree, crossings: AttemptCrossings, h: Scalar
) -> tuple[EventSearch, PyTree, PyTree]:
    """Return three values after an attempt: the search for the earliest event, the next length [s], and a flag.

    The flag is True if the next length is the probe: `x` is then near enough to the zero.
    """
    # The search works on values only: the derivative of the event's time comes from the final Newton step.
    x = jax.lax.stop_gradient(x)
    changes = crossings.another & ~crossings.falls
    fresh, sought = new | changes, select(changes, crossings.other, crossings.sought)
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
    least = jnp.minimum(NEWTON_RADIUS_STEPS * h, 0.5 * width)
    first = jnp.where(jnp.isfinite(search.at_near), jnp.maximum(search.near + share * width, least), least)
    inside = falls & (newton > search.near) & (newton < search.far) & (search.tries % BISECT != 0)
    guess = jnp.where(inside, newton, jnp.where(fresh, first, search.near + 0.5 * width))
    apart = h * jnp.finfo(h.dtype).eps ** PROBE_EXPONENT
    # The probe stays within the step: before its beginning the mode does not hold, and the margin has no meaning.
    probe = jnp.where(sought.end < 0, x + apart, jnp.where(x > apart, x - apart, 0.5 * x))
    found = near | at_once
    search = search._replace(place=x, margin=jnp.where(found, sought.end, 0.0), found=found, at_once=at_once)
    # The attempt ends just beyond the sought zero. If another margin falls through zero in it, its zero is earlier.
    earlier = (
        enough & ~at_once & crossings.another & ~changes & crossings.falls & (search.tries < MAX_LOCATION_ATTEMPTS)
    )
    search = select(earlier, _bracket(search, x, crossings.other), search)
    # The next attempt is just before this zero, because two margins often fall at the same time.
    before = jnp.where(x > 4 * NEWTON_RADIUS_STEPS * h, x - 2 * NEWTON_RADIUS_STEPS * h, 0.5 * x)
    return search, jnp.where(earlier, before, jnp.where(enough, probe, guess)), enough & ~earlier


def _locate_event(
    search: EventSearch, x: Scalar, crossings: AttemptCrossings, beyond: Scalar
) -> tuple[EventSearch, PyTree]:
    """Return the search with the margin's slope, and the length of the step that ends on the zero, after the probe.

    The slope is that of the parabola through the place, the probe, and one end of the first attempt. This is the end on
    the same side. It is the other end if that one is uninformative and the margin is smooth up to there.
    """
    x = jax.lax.stop_gradient(x)
    place, margin = jax.lax.stop_gradient((search.place, search.margin))
    # The margin is unknown if another comparison changes at the probe and the sought one does not.
    told = jnp.isfinite(crossings.sought.end)
    probe = crossings.sought._replace(end=jnp.where(told, crossings.sought.end, margin))
    g, start = jax.lax.stop_gradient(probe[1:])
    ends = (search.full, search.at_full), (0.0 * x, start)
    side, other = select(margin < 0, ends, ends[::-1])
    same_side = _shows_curvature(side, place, x)
    end, at_end = third = select(same_side, side, other)
    fall = (g - margin) / (x - place)
    changes = ratio(at_end - g, end - x) - fall
    curved = same_side | (_shows_curvature(third, place, x) & (jnp.abs(changes) <= MAX_SLOPE_CHANGE * jnp.abs(fall)))
    # Newton's divided differences: `fall` is the first, `bend` the second.
    bend = jnp.where(curved, ratio(changes, end - place), 0.0)
    at_place = jnp.where(told, fall + (place - x) * bend, 0.0)
    # Division by -inf instead of a slope that is not negative: the length stays at the place.
    length = place - margin / jnp.where(at_place < 0, at_place, -jnp.inf)
    slope = at_place + 2.0 * (length - place) * bend
    last, at_last = select(same_side & _shows_curvature(other, place, x), other, third)
    # The third divided difference improves the slope unless it is large: then a kink lies between the points.
    more = ratio(ratio(ratio(at_last - g, last - x) - fall, last - place) - bend, last - end)
    more *= (length - place) * (length - x) + (length - place + length - x) * (length - end)
    slope += jnp.where(jnp.abs(more) <= MAX_CUBIC_CORRECTION * jnp.abs(slope), more, 0.0)
    beyond_probe = jnp.abs(length - place) > jnp.abs(x - place)
    length = jnp.where(beyond_probe, jnp.maximum(jnp.minimum(length, search.far), search.near), length)
    known = search.found & (slope < 0) & ~beyond_probe
    moved = length + jnp.where(beyond_probe, 0.0, _length_tangent(search, x, probe.end, length, slope))
    steep = _falls_from_start(search, at_place, start)
    known &= ~search.at_once | steep
    # For an event at the beginning of the step the length is clipped at 0 in value, but not in its derivative.
    at_once = jnp.where(steep, moved - jax.lax.stop_gradient(jnp.minimum(moved, 0.0)), 0.0)
    return search._replace(fall=jnp.where(known, slope, 0.0)), jnp.where(search.at_once, at_once, moved) + beyond


def refine(search: EventSearch, x: Scalar, crossings: AttemptCrossings) -> Scalar:
    """Return x with the second derivatives of the event's time.

    The value is unchanged. The derivatives come from a Newton step on the margin at the end of an attempt of length x.

    Args:
        search: Search with the slope of the margin.
        x: Length of the step that ends on the event [s].
        crossings: Crossings within an attempt of this length.
    """
    left = jnp.where((search.fall < 0) & jnp.isfinite(crossings.sought.end), crossings.sought.end, 0.0)
    return x - (left - jax.lax.stop_gradient(left)) / jnp.where(search.fall < 0, search.fall, -1.0)


def _accept_location(search: EventSearch, x: Scalar, length: Scalar) -> tuple[PyTree, PyTree]:
    """Return the length to try after the probe, and True if the search continues from the middle of the bracket.

    It continues if the final step would end farther from `place` than the probe, or if the margin does not fall there.
    A margin can be almost flat and then fall suddenly.
    """
    probe, off = jnp.abs(x - search.place), jnp.abs(length - search.place)
    missed = ((off > probe) | ((off == 0) & (search.margin != 0))) & (search.far - search.near > probe)
    again = jax.lax.stop_gradient(missed & ~search.at_once & (search.tries < MAX_LOCATION_ATTEMPTS))
    return jnp.where(again, 0.5 * (search.near + search.far), length), again


def _length_tangent(search: EventSearch, x: Scalar, g: AnyArray, zero: Scalar, fall: Scalar) -> Scalar:
    """Return a number with value 0 and the derivatives of the event's length.

    They come from the derivatives of the margin at the place and at the probe x. Linear extrapolation continues them to
    the zero, because they change over the ten-thousandth of a step between.
    """
    known = search.found & (fall < 0)
    share = ratio(zero - search.place, x - search.place)
    ends = (jnp.where(known, end, 0.0) for end in (search.margin, g))
    rises = sum(part * (end - jax.lax.stop_gradient(end)) for part, end in zip((1.0 - share, share), ends, strict=True))
    return -rises / jnp.where(known, fall, -1.0)


def _shows_curvature(end: tuple[PyTree, PyTree], place: Scalar, probe: Scalar) -> Scalar:
    """Return True if the margin at an end of an attempt determines the curvature between the place and the probe."""
    length, margin = end
    return (jnp.abs(length - place) > 4 * jnp.abs(place - probe)) & jnp.isfinite(margin)


def _falls_from_start(search: EventSearch, fall: Scalar, start: PyTree) -> Scalar:
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
    return old._replace(which=sought.which, full=x, at_full=g, near=0.0 * x, at_near=start, far=x, at_far=g)


def _slope(search: EventSearch, x: Scalar, g: AnyArray) -> Scalar:
    """Return d(margin)/d(length) at x, from the parabola through the ends of the bracket and (x, g)."""
    right = jnp.where(jnp.isfinite(search.at_far), ratio(search.at_far - g, search.far - x), 0.0)
    left = ratio(g - search.at_near, x - search.near)
    bent = left + right - ratio(search.at_far - search.at_near, search.far - search.near)
    return jnp.where(jnp.isfinite(search.at_near) & jnp.isfinite(search.at_far), bent, right)


def _pick(which: Int, values: list[PyTree]) -> PyTree:
    found = values[0]
    for i, value in enumerate(values[1:], 1):
        found = jnp.where(which == i, value, found)
    return found
