"""Locate the zero of a margin in a step: the lengths of the tries, and the length of the step that ends on the zero.

seek    tries shrink a bracket, by secant, Newton's step on a parabola, or halving, until a try ends near the zero
probe   a try beside it, on the same side, shows how the margin falls there
land    the final step has the length place - margin(place)/fall. Its derivative is that of the event's moment, by the
        implicit function theorem: the margin at the end of a try carries it
refine  for derivatives: one more try of this length. A Newton step from it is right to the second derivative, as the
        one before was to the first: each doubles the order (A. Griewank, A. Walther, Evaluating Derivatives, 15.3)

The margins of comparisons have the first numbers; those of the stop and of the blocks' events follow. A comparison's
margin is known only at the end of a try."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import ratio

NEWTON_RADIUS_STEPS = 1e-4  # steps: a Newton step from here misses the zero by some 1e-8 steps
PROBE_EXPONENT = 0.2  # exponent: the probe is eps**APART steps away
OVERSHOOT_EXPONENT = 0.5  # exponent: a step ends eps**BEYOND steps past the zero of a comparison
MAX_LOCATION_ATTEMPTS = 24  # the most for an event, whose margin may have a corner or jump
BISECT = 4  # every so many tries halve the bracket
GRAZING_FRACTION = (
    1e-2  # of the margin's mean rate in the step: a margin that falls more slowly at the beginning only touches
)
MAX_CUBIC_CORRECTION = (
    1e-4  # of the slope: the greatest correction by a cubic through both ends of a step; a larger one is a kink
)
MAX_SLOPE_CHANGE = 0.5  # of the fall: the greatest change of it within a step in which the margin is taken to be smooth


class EventSearch(NamedTuple):
    """Where an event is looked for. A margin is infinite where it is not known."""

    which: Any  # the number of its margin
    full: Any  # the length that was tried first [s]
    at_full: Any  # the margin there
    near: Any  # the bracket's shorter length [s]
    at_near: Any
    far: Any  # the bracket's longer length [s]
    at_far: Any
    tries: Any  # how many there were
    place: Any  # the length of the try that ended near the zero [s]
    margin: Any  # the margin there; 0 if no zero was found
    found: Any  # whether there is a zero
    at_once: Any  # whether the zero is where the step begins
    fall: Any  # the margin's slope at the end of the final step [1/s]; 0 where the moment has no derivative


class EventCrossing(NamedTuple):
    """A margin that a try is about: its number, what it is at the end of the try, and at the beginning."""

    which: Any
    end: Any
    start: Any


class AttemptCrossings(NamedTuple):
    """What a try tells: the margin that is looked for, and whether it falls through zero within; another one that does,
    and whether there is one."""

    sought: EventCrossing
    falls: Any
    other: EventCrossing
    another: Any


def init_search(h: Any) -> EventSearch:
    """Return a search for nothing."""
    none, zero, no = 0.0 * h, jnp.asarray(0), jnp.asarray(False)
    return EventSearch(zero, h, none, none, none, h, none, zero, h, none, no, no, none)


def falls_through(before: list[Any], after: list[Any]) -> list[Any]:
    """Return whether each margin falls through zero, from the beginning of a step to its end."""
    return [(a >= 0) & (b < 0) for a, b in zip(before, after, strict=True)]


def find_event_crossings(which: Any, first: int, before: list[Any], after: list[Any]) -> AttemptCrossings:
    """Return what a try tells of these margins, whose numbers begin with `first`."""
    crossed = falls_through(before, after)
    others = [one & (which != first + i) for i, one in enumerate(crossed)]
    triples = zip(others, before, after, strict=True)
    places = jnp.stack([jnp.where(one, a / jnp.where(one, a - b, 1.0), jnp.inf) for one, a, b in triples])
    other = first + jnp.argmin(places).astype(which.dtype)
    picked = [EventCrossing(i, _pick(i - first, after), _pick(i - first, before)) for i in (which, other)]
    falls = _pick(which - first, crossed) & (which >= first)
    return AttemptCrossings(picked[0], falls, picked[1], jnp.any(jnp.stack(others)))


def bracket_event(
    search: EventSearch, x: Any, new: Any, tells: AttemptCrossings, h: Any
) -> tuple[EventSearch, Any, Any]:
    """Return the search for the earliest event after the try of length x, the length to try next, and whether that is
    the probe. It is the probe once x is near enough to the zero.

    new: whether nothing was looked for until now"""
    x = jax.lax.stop_gradient(x)
    changes = tells.another & ~tells.falls
    fresh, sought = new | changes, select(changes, tells.other, tells.sought)
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
    least = jnp.minimum(
        NEWTON_RADIUS_STEPS * h, 0.5 * width
    )  # the first guess is no shorter: there the margin has begun to fall
    first = jnp.where(jnp.isfinite(search.at_near), jnp.maximum(search.near + share * width, least), least)
    inside = falls & (newton > search.near) & (newton < search.far) & (search.tries % BISECT != 0)
    guess = jnp.where(inside, newton, jnp.where(fresh, first, search.near + 0.5 * width))
    apart = h * jnp.finfo(h.dtype).eps ** PROBE_EXPONENT
    # Before the beginning of the step its regime does not hold, and the margin says nothing.
    probe = jnp.where(sought.end < 0, x + apart, jnp.where(x > apart, x - apart, 0.5 * x))
    found = near | at_once
    search = search._replace(place=x, margin=jnp.where(found, sought.end, 0.0), found=found, at_once=at_once)
    # Beyond the zero another margin that falls does so before it.
    earlier = enough & ~at_once & tells.another & ~changes & tells.falls & (search.tries < MAX_LOCATION_ATTEMPTS)
    search = select(earlier, _bracket(search, x, tells.other), search)
    before = jnp.where(
        x > 4 * NEWTON_RADIUS_STEPS * h, x - 2 * NEWTON_RADIUS_STEPS * h, 0.5 * x
    )  # often both fall at once
    return search, jnp.where(earlier, before, jnp.where(enough, probe, guess)), enough & ~earlier


def locate_event(search: EventSearch, x: Any, tells: AttemptCrossings, beyond: Any) -> tuple[EventSearch, Any]:
    """Return the search with its fall, and the length that ends on the zero, after the probe of length x. `beyond` is
    added to the length, so that the margin has surely changed its sign. The fall is that of the parabola through the
    place, the probe, and an end of the first try. This is the end on the same side; the other one where the first says
    nothing and the margin is smooth up to there."""
    x = jax.lax.stop_gradient(x)
    place, margin = jax.lax.stop_gradient((search.place, search.margin))
    told = jnp.isfinite(tells.sought.end)  # not if another comparison changes at the probe, and this one does not
    probe = tells.sought._replace(end=jnp.where(told, tells.sought.end, margin))
    g, start = jax.lax.stop_gradient(probe[1:])
    ends = (search.full, search.at_full), (0.0 * x, start)
    side, other = select(margin < 0, ends, ends[::-1])
    near = _shows_curvature(side, place, x)
    end, at_end = third = select(near, side, other)
    fall = (g - margin) / (x - place)
    changes = ratio(at_end - g, end - x) - fall
    far = near | (_shows_curvature(third, place, x) & (jnp.abs(changes) <= MAX_SLOPE_CHANGE * jnp.abs(fall)))
    bend = jnp.where(far, ratio(changes, end - place), 0.0)
    at_place = jnp.where(told, fall + (place - x) * bend, 0.0)
    length = place - margin / jnp.where(at_place < 0, at_place, -jnp.inf)
    slope = at_place + 2.0 * (length - place) * bend
    last, at_last = select(near & _shows_curvature(other, place, x), other, third)
    more = ratio(ratio(ratio(at_last - g, last - x) - fall, last - place) - bend, last - end)
    more *= (length - place) * (length - x) + (length - place + length - x) * (length - end)
    slope += jnp.where(jnp.abs(more) <= MAX_CUBIC_CORRECTION * jnp.abs(slope), more, 0.0)
    far = jnp.abs(length - place) > jnp.abs(x - place)
    length = jnp.where(far, jnp.maximum(jnp.minimum(length, search.far), search.near), length)
    known = search.found & (slope < 0) & ~far
    moved = length + jnp.where(far, 0.0, _length_tangent(search, x, probe.end, length, slope))
    steep = _falls_from_start(search, at_place, start)
    known &= ~search.at_once | steep
    at_once = jnp.where(steep, moved - jax.lax.stop_gradient(jnp.minimum(moved, 0.0)), 0.0)
    return search._replace(fall=jnp.where(known, slope, 0.0)), jnp.where(search.at_once, at_once, moved) + beyond


def refine(search: EventSearch, x: Any, tells: AttemptCrossings) -> Any:
    """Return x. Its value stays; a Newton step from the margin at the end of a try of length x makes its second
    derivatives those of the event's moment."""
    left = jnp.where((search.fall < 0) & jnp.isfinite(tells.sought.end), tells.sought.end, 0.0)
    return x - (left - jax.lax.stop_gradient(left)) / jnp.where(search.fall < 0, search.fall, -1.0)


def accept_location(search: EventSearch, x: Any, length: Any) -> tuple[Any, Any]:
    """Return the length to try after the probe of length x, and whether to search again, in the middle of the bracket.
    The search goes on if the final step would end farther from `place` than the probe did, or if the margin does not
    fall there: a margin may hardly fall, and then all at once."""
    probe, off = jnp.abs(x - search.place), jnp.abs(length - search.place)
    missed = ((off > probe) | ((off == 0) & (search.margin != 0))) & (search.far - search.near > probe)
    again = jax.lax.stop_gradient(missed & ~search.at_once & (search.tries < MAX_LOCATION_ATTEMPTS))
    return jnp.where(again, 0.5 * (search.near + search.far), length), again


def _length_tangent(search: EventSearch, x: Any, g: Any, zero: Any, fall: Any) -> Any:
    """A number with value 0 and the derivatives of the event's length. They follow from those of the margin at the
    place and at the probe x, continued to the zero: they, too, change in the ten-thousandth of a step between."""
    known = search.found & (fall < 0)
    share = ratio(zero - search.place, x - search.place)
    ends = (jnp.where(known, end, 0.0) for end in (search.margin, g))
    rises = sum(part * (end - jax.lax.stop_gradient(end)) for part, end in zip((1.0 - share, share), ends, strict=True))
    return -rises / jnp.where(known, fall, -1.0)


def _shows_curvature(end: tuple[Any, Any], place: Any, probe: Any) -> Any:
    """Whether the margin at an end of a try says how it bends between the place and the probe."""
    length, margin = end
    return (jnp.abs(length - place) > 4 * jnp.abs(place - probe)) & jnp.isfinite(margin)


def _falls_from_start(search: EventSearch, fall: Any, start: Any) -> Any:
    """Whether a margin falls at the beginning of a step as steeply as it does on the whole. Then the moment of an event
    there has a derivative; not if the margin jumps, or has its maximum there."""
    place, margin = jax.lax.stop_gradient((search.place, search.margin))
    smooth = jnp.where(
        jnp.isfinite(start), jnp.abs(margin - fall * place - start) <= -MAX_SLOPE_CHANGE * fall * place, True
    )
    mean = jnp.where(jnp.isfinite(search.at_full), search.at_full / search.full, 0.0)
    return smooth & (fall < 0) & (fall <= GRAZING_FRACTION * jax.lax.stop_gradient(mean))


def _narrow_bracket(old: EventSearch, x: Any, first: Any, sought: EventCrossing) -> tuple[EventSearch, Any]:
    """The search whose bracket ends at the try x, and the margin's slope in the length there: of the parabola through
    the bracket's ends and this point, 0 for a new bracket."""
    g = jax.lax.stop_gradient(sought.end)
    slope = jnp.where(first, 0.0, _slope(old, x, g))
    new = _bracket(old, x, sought)
    closer = select(g < 0, old._replace(far=x, at_far=g), old._replace(near=x, at_near=g))
    return select(first, new, closer), slope


def _bracket(old: EventSearch, x: Any, sought: EventCrossing) -> EventSearch:
    """A bracket from the beginning of the step to the try of length x."""
    g, start = jax.lax.stop_gradient(sought[1:])
    return old._replace(which=sought.which, full=x, at_full=g, near=0.0 * x, at_near=start, far=x, at_far=g)


def _slope(search: EventSearch, x: Any, g: Any) -> Any:
    """d(margin)/d(length) at x, of the parabola through the bracket's ends and (x, g)."""
    right = jnp.where(jnp.isfinite(search.at_far), ratio(search.at_far - g, search.far - x), 0.0)
    left = ratio(g - search.at_near, x - search.near)
    bent = left + right - ratio(search.at_far - search.at_near, search.far - search.near)
    return jnp.where(jnp.isfinite(search.at_near) & jnp.isfinite(search.at_far), bent, right)


def _pick(which: Any, values: list[Any]) -> Any:
    found = values[0]
    for i, value in enumerate(values[1:], 1):
        found = jnp.where(which == i, value, found)
    return found


def select(which: Any, a: Any, b: Any) -> Any:
    """Return a where `which`, else b; of pytrees."""
    return jax.tree.map(lambda x, y: jnp.where(which, x, y), a, b)
