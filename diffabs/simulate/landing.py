"""Where in a step a margin falls through zero: the lengths that are tried, and the one that ends on the zero.

seek    tries shrink a bracket, by secant, Newton's step on a parabola, or halving, until one ends near the zero
probe   one more, on the same side: how the margin falls there; on the other side a road may have another curvature
land    place - margin(place)/fall: the last try's length. Its derivative is that of the event's moment, by the
        implicit function theorem: the margin at the end of a try carries it"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import ratio

NEAR = 1e-4  # steps: a Newton step from here misses the zero by some 1e-8 steps
APART = 0.2  # power of the precision: the probe's distance, in steps
TRIES = 24  # the most for an event, whose margin may have a corner or jump
BISECT = 4  # every so many tries halve the bracket


class Search(NamedTuple):
    """Where an event is looked for: the number of its margin; the length that was tried first [s]; the bracket; the
    margin at these; how many times it was tried. Near the zero: the length, and the margin there."""

    which: Any
    full: Any
    at_full: Any
    near: Any
    at_near: Any
    far: Any
    at_far: Any
    tries: Any
    place: Any
    margin: Any


def init_search(h: Any) -> Search:
    """Return a search for nothing."""
    none, zero = 0.0 * h, jnp.asarray(0)
    return Search(zero, h, none, none, none, h, none, zero, h, none)


def falls_through(before: list[Any], after: list[Any]) -> list[Any]:
    """Return whether each margin falls through zero, from the beginning of a step to its end."""
    return [(a >= 0) & (b < 0) for a, b in zip(before, after, strict=True)]


def seek(search: Search, x: Any, new: Any, before: list[Any], after: list[Any], h: Any) -> tuple[Search, Any, Any]:
    """Return the search for the earliest event after the try of length x, what to try next, and whether x is near
    enough, so that this is the probe.

    new: whether nothing was looked for until now. before, after: all margins, at the beginning and at the end"""
    x = jax.lax.stop_gradient(x)
    search, margin, slope = _narrowed(search, x, new, before, after)
    falls = slope < 0
    correction = jax.lax.stop_gradient(margin) / jnp.where(falls, slope, -1.0)
    near = falls & (jnp.abs(correction) <= NEAR * h)
    enough = near | (search.tries >= TRIES)

    width, newton = search.far - search.near, x - correction
    secant = search.near + ratio(search.at_near, search.at_near - search.at_far, 0.5) * width
    inside = falls & (newton > search.near) & (newton < search.far) & (search.tries % BISECT != 0)
    guess = jnp.where(inside, newton, jnp.where(search.tries == 1, secant, search.near + 0.5 * width))
    apart = jnp.where(margin < 0, 1.0, -1.0) * h * jnp.finfo(h.dtype).eps ** APART
    search = search._replace(place=x, margin=jnp.where(near, margin, 0.0))
    return search, jnp.where(enough, x + apart, guess), enough


def land(search: Search, x: Any, before: list[Any], after: list[Any]) -> Any:
    """Return the length that ends on the zero, after the probe of length x. The fall is that of the parabola through
    the place, the probe, and the end of the first try that is on the same side."""
    x = jax.lax.stop_gradient(x)
    start, g = (jax.lax.stop_gradient(_pick(search.which, margins)) for margins in (before, after))
    place, margin = jax.lax.stop_gradient((search.place, search.margin))
    end, at_end = select(margin < 0, (search.full, search.at_full), (0.0 * x, start))
    fall = (g - margin) / (x - place)
    bend = ratio(ratio(at_end - g, end - x) - fall, end - place)
    fall += jnp.where(jnp.abs(end - place) > 4 * jnp.abs(place - x), (place - x) * bend, 0.0)
    fall = jax.lax.stop_gradient(fall)
    return search.place - search.margin / jnp.where(fall < 0, fall, -jnp.inf)


def _narrowed(old: Search, x: Any, new: Any, before: list[Any], after: list[Any]) -> tuple[Search, Any, Any]:
    """The search for the earliest event, whose bracket ends at the try x; the margin there; and its slope in the
    length, of the parabola through the bracket's ends and this point, 0 for a new bracket."""
    crossed = falls_through(before, after)
    triples = zip(crossed, before, after, strict=True)
    places = jnp.stack([jnp.where(one, a / jnp.where(one, a - b, 1.0), jnp.inf) for one, a, b in triples])
    which = jnp.where(jnp.any(jnp.stack(crossed)), jnp.argmin(places), old.which).astype(old.which.dtype)
    first = new | (which != old.which)
    margin = _pick(which, after)
    g, start = jax.lax.stop_gradient((margin, _pick(which, before)))
    slope = jnp.where(first, 0.0, _slope(old, x, g))
    near, at_near = select(first, (0.0 * x, start), (old.near, old.at_near))
    near, at_near, far, at_far = select(first | (g < 0), (near, at_near, x, g), (x, g, old.far, old.at_far))
    full, at_full = select(first, (x, g), (old.full, old.at_full))
    tries = jnp.where(first, 0, old.tries) + 1
    return Search(which, full, at_full, near, at_near, far, at_far, tries, old.place, old.margin), margin, slope


def _slope(search: Search, x: Any, g: Any) -> Any:
    """d(margin)/d(length) at x, of the parabola through the bracket's ends and (x, g)."""
    left = ratio(g - search.at_near, x - search.near)
    right = ratio(search.at_far - g, search.far - x)
    return left + right - ratio(search.at_far - search.at_near, search.far - search.near)


def _pick(which: Any, values: list[Any]) -> Any:
    found = values[0]
    for i, value in enumerate(values[1:], 1):
        found = jnp.where(which == i, value, found)
    return found


def select(which: Any, a: Any, b: Any) -> Any:
    """Return a where `which`, else b; of pytrees."""
    return jax.tree.map(lambda x, y: jnp.where(which, x, y), a, b)
