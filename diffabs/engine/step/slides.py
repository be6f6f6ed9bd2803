"""Slides: runs that stay on a switching surface, because the flows of both sides push onto it (Filippov).

Such a run lands on the surface, and the flow beyond brings it back at once, for ever. Its values are nearly right: the
steps chatter along the surface. Its derivatives are wrong, because the times of these landings mean nothing.

    landing    a run that lands on a surface is watched until it makes a calm step
    slide      a landing on a surface that it has met since then is a return. The run slides after two returns at once,
               or after three later ones, as where it spirals into the intersection of two surfaces. A touched surface
               brings one return. Margins that are zero to rounding bring none: they do not fall along a line

Source: Filippov, Differential Equations with Discontinuous Righthand Sides, section 4.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core import shapes
from diffabs.core.types import AnyArray, Array, Bool, Int, Scalar
from diffabs.engine.step.event_location import EventSearch
from diffabs.engine.step.modes import ModeBits, single_bit

# A return within the shortest time that a search resolves counts `RETURN_AT_ONCE`, a later one 1.
MAX_RETURNS, RETURN_AT_ONCE = 3, 2
# Fraction of the fall: a margin at the beginning of a step that is farther from a line through zero is rounding.
MAX_LINE_ERROR = 0.5


class Slide(NamedTuple):
    """The first slide of a run.

    Attributes:
        comparison: Number of the comparison along whose surface the run slides; -1 without a slide.
        t: Time at which it begins [s]; NaN without a slide.
    """

    comparison: shapes.Int[AnyArray, "*runs"]
    t: Scalar


class SlideWatch(NamedTuple):
    """What a run remembers to notice a slide.

    Attributes:
        met: Comparisons on whose surfaces the run has landed since its last calm step.
        returns: Landings since then on surfaces that it has left, each with its weight.
        slide: First slide of the run.
    """

    met: ModeBits
    returns: Int
    slide: Slide


def init_watch(words: int, t: Scalar) -> SlideWatch:
    """Return the watch at the start of a run; the answers to its comparisons take this number of words."""
    zero = jnp.asarray(0)
    none = tuple(jnp.uint32(0) for _ in range(words))
    return SlideWatch(none, zero, Slide(zero - 1, t + jnp.nan))


def watch_landing(watch: SlideWatch, search: EventSearch, landed: Bool, calm: Bool, t: Scalar) -> SlideWatch:
    """Return the watch after an attempt, the result of a `search`, that ends at `t` [s].

    It has `landed` if it was accepted and ends on a switching surface. It is `calm` if it was an accepted step without
    a landing.
    """
    bits = single_bit(jnp.where(landed, search.number, -1), len(watch.met))
    again = jnp.any(jnp.stack([(met & bit) != 0 for met, bit in zip(watch.met, bits, strict=True)]))
    line = search.fall * search.place
    straight = jnp.abs(search.margin - line) <= -MAX_LINE_ERROR * line
    counts = jnp.where(search.at_once, jnp.where(straight, RETURN_AT_ONCE, 0), jnp.where(search.fall < 0, 1, 0))
    returns = jnp.where(calm, 0, watch.returns + jnp.where(again, counts, 0))
    met = tuple(jnp.where(calm, jnp.uint32(0), met | bit) for met, bit in zip(watch.met, bits, strict=True))
    return SlideWatch(met, returns, begin_slide(watch.slide, returns >= MAX_RETURNS, search.number, t))


def begin_slide(slide: Slide, begins: Bool, number: Int, t: Scalar) -> Slide:
    """Return the slide, or a new one along the comparison `number` if it begins and is the first."""
    first = begins & (slide.comparison < 0)
    return Slide(jnp.where(first, number, slide.comparison), jnp.where(first, jax.lax.stop_gradient(t), slide.t))


def slide_of(carry: Any) -> Slide:
    """Return the first slide of a run, without derivatives."""
    watch = carry.slides
    if watch == ():
        none = jnp.asarray(-1)
        return Slide(none, jnp.nan * jax.lax.stop_gradient(carry.point.t))
    return jax.tree.map(jax.lax.stop_gradient, watch.slide)


def has_slid(slide: Slide) -> Array:
    """Return True for a run that slides."""
    return jnp.asarray(slide.comparison) >= 0
