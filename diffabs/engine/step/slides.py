"""Slides: runs that stay on a switching surface, because the flows of both sides push onto it (Filippov).

Such a run lands on the surface, and the flow beyond brings it back at once, for ever. Its steps would chatter along the
surface, and the times of these landings have no meaning for a derivative. So it follows the surface (`sliding_flow`).

    landing    a run that lands on a surface is watched until it makes a calm step
    slide      a landing on a surface that it has met since then is a return. The run slides along it after two returns
               at once, or after three later ones. A touched surface brings one return. Margins that are zero to
               rounding bring none: they do not fall along a line
    end        the run leaves where its share reaches 0 or 1, a landing, too
    lost       a slide that ends as soon as it begins, again and again, as where a run spirals into the intersection of
               two surfaces, or one along more surfaces than `MAX_SURFACES`. Such a run has no derivative

Source: Filippov, Differential Equations with Discontinuous Righthand Sides, section 4.
"""

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core import shapes
from diffabs.core.lanes import select
from diffabs.core.types import AnyArray, Array, Bool, Int, Scalar
from diffabs.engine.step.event_location import EventSearch
from diffabs.engine.step.modes import ModeBits, SlidingSurface, single_bit

# A return within the shortest time that a search resolves counts `RETURN_AT_ONCE`, a later one 1.
MAX_RETURNS, RETURN_AT_ONCE = 3, 2
LOST_RETURNS = 12  # returns since the last calm step with which a slide is lost
# Fraction of the fall: a margin at the beginning of a step that is farther from a line through zero is rounding.
MAX_LINE_ERROR = 0.5


class Slide(NamedTuple):
    """The first slide of a run that is lost.

    Attributes:
        comparison: Number of the comparison along whose surface the run slides; -1 without a lost slide.
        t: Time at which it begins [s]; NaN without a lost slide.
    """

    comparison: shapes.Int[AnyArray, "*runs"]
    t: Scalar


class Followed(NamedTuple):
    """What a run remembers that follows the surfaces along which it slides.

    Attributes:
        along: Surfaces along which it slides.
        words: Mode of the last step that has landed.
        answers: Bits in which it differs from that of the landing before.
        decided: Bits whose answers the last landing has decided: at the zero of a margin rounding could turn them back.
        last: Number of the comparison on whose surface the run has landed last; -1 after a calm step.
        ended: That number if the landing has ended a slide along the surface; else -1.
    """

    along: tuple[SlidingSurface, ...]
    words: ModeBits
    answers: ModeBits
    decided: ModeBits
    last: Array
    ended: Array


class SlideWatch(NamedTuple):
    """What a run remembers to notice a slide.

    Attributes:
        met: Comparisons on whose surfaces the run has landed since its last calm step.
        returns: Landings since then on surfaces that it has left, each with its weight.
        followed: Slides that the run follows; () if it follows none.
        lost: First slide that the run does not follow.
    """

    met: ModeBits
    returns: Int
    followed: Followed | tuple[()]
    lost: Slide


class Landing(NamedTuple):
    """An attempt as the watch sees it.

    Attributes:
        search: The search whose result it is.
        words: Its mode.
        landed: True if it was accepted and ends on a switching surface.
        calm: True if it was accepted and so long that what has landed before is over.
        reset: True if the state changes at its end.
        t: Time at its end [s].
    """

    search: EventSearch
    words: ModeBits
    landed: Bool
    calm: Bool
    reset: Bool
    t: Scalar


def init_watch(words: int, surfaces: int, t: Scalar) -> SlideWatch:
    """Return the watch at the start of a run that can follow this number of `surfaces` at the same time.

    The answers to its comparisons take this number of `words`.
    """
    zero = jnp.asarray(0)
    none, nothing = tuple(jnp.uint32(0) for _ in range(words)), zero - 1
    along = (SlidingSurface(nothing, none),) * surfaces
    followed = Followed(along, none, none, none, nothing, nothing) if surfaces else ()
    return SlideWatch(none, zero, followed, Slide(nothing, t + jnp.nan))


def watch_landing(watch: SlideWatch, landing: Landing) -> SlideWatch:
    """Return the watch after an attempt."""
    search, _, landed, calm, reset, t = landing
    bits = single_bit(jnp.where(landed, search.number, -1), len(watch.met))
    again = ~calm & jnp.any(jnp.stack([(met & bit) != 0 for met, bit in zip(watch.met, bits, strict=True)]))
    line = search.fall * search.place
    straight = jnp.abs(search.margin - line) <= -MAX_LINE_ERROR * line
    counts = jnp.where(search.at_once, jnp.where(straight, RETURN_AT_ONCE, 0), jnp.where(search.fall < 0, 1, 0))
    returns = jnp.where(calm, 0, watch.returns + jnp.where(again, counts, 0))
    met = tuple(jnp.where(calm, bit, met | bit) for met, bit in zip(watch.met, bits, strict=True))
    slides, followed = returns >= MAX_RETURNS, watch.followed
    if followed:
        followed, full = _follow(followed, landing, landed & again & ~reset & (counts > 0) & slides)
        slides = full | (returns >= LOST_RETURNS)
    return SlideWatch(met, returns, followed, begin_slide(watch.lost, slides, search.number, t))


def _follow(followed: Followed, landing: Landing, returned: Bool) -> tuple[Followed, Bool]:
    """Return what is followed after an attempt, and whether a slide has no room.

    A reset of the state ends all slides: they begin again if the state is still on their surfaces.
    """
    number, landed, along = landing.search.number, landing.landed, []
    # The modes of the last two steps that have landed are those of both sides, once they differ as before.
    answers = tuple(a ^ b for a, b in zip(landing.words, followed.words, strict=True))
    same = jnp.all(jnp.stack([a == b for a, b in zip(answers, followed.answers, strict=True)]))
    leaves = reduce(jnp.logical_or, [landed & (surface.number == number) for surface in followed.along])
    waits, decided = returned & same & ~leaves, single_bit(number, len(answers))
    none = SlidingSurface(jnp.full_like(number, -1), tuple(jnp.zeros_like(word) for word in answers))
    for surface in followed.along:
        ends, begins = landed & (surface.number == number), waits & ~surface.exists
        decided = select(ends, surface.answers, decided)
        along.append(select(begins, SlidingSurface(number, answers), select(ends | landing.reset, none, surface)))
        waits &= ~begins
    full = reduce(jnp.logical_and, [surface.exists for surface in followed.along])
    old = followed.words, followed.answers, followed.decided
    modes = select(landed, (landing.words, answers, decided), old)
    last = jnp.where(landed, number, jnp.where(landing.calm, -1, followed.last)).astype(number.dtype)
    ended = jnp.where(landed, jnp.where(leaves, number, -1), followed.ended).astype(number.dtype)
    return Followed(tuple(along), *modes, last, ended), returned & ~leaves & full


def begins_along(before: SlideWatch, after: SlideWatch) -> Bool:
    """Return True if a slide along a surface begins between two watches."""
    pairs = zip(_surfaces(before), _surfaces(after), strict=True)
    return reduce(jnp.logical_or, [~old.exists & new.exists for old, new in pairs], jnp.asarray(False))


def _surfaces(watch: SlideWatch | tuple[()]) -> tuple[SlidingSurface, ...]:
    return watch.followed.along if watch and watch.followed else ()


def begin_slide(slide: Slide, begins: Bool, number: Int, t: Scalar) -> Slide:
    """Return the lost slide, or a new one along the comparison `number` if it begins and is the first."""
    first = begins & (slide.comparison < 0)
    return Slide(jnp.where(first, number, slide.comparison), jnp.where(first, jax.lax.stop_gradient(t), slide.t))


def lose_mode(watch: SlideWatch, unrestricted: Bool, gives_up: Bool, number: Array, t: Scalar) -> SlideWatch:
    """Return the watch; the slide is lost of a run whose steps are `unrestricted`, for without a mode it would chatter.

    That holds during a slide, and where a search `gives_up`: it may have been for the landing that begins one.
    """
    slides = reduce(jnp.logical_or, [surface.exists for surface in _surfaces(watch)])
    return watch._replace(lost=begin_slide(watch.lost, unrestricted & (slides | gives_up), number, t))


def along_of(carry: Any) -> tuple[SlidingSurface, ...]:
    """Return the surfaces along which a run slides, as `Mode.along`."""
    return _surfaces(carry.slides)


def decided_answers(carry: Any, words: int) -> ModeBits:
    """Return the bits whose answers the last landing of a run has decided, in this number of words."""
    if along_of(carry):
        return carry.slides.followed.decided
    return single_bit(carry.search.number, words)


def ended_slide(carry: Any) -> Int:
    """Return the number of the comparison whose slide the last landing has ended; -1 for none."""
    return carry.slides.followed.ended if along_of(carry) else jnp.asarray(-1)


def is_return(carry: Any, number: Int) -> Bool:
    """Return True if the last landing was on the surface of the same comparison, in a run that follows surfaces."""
    return (carry.slides.followed.last == number) & (number >= 0) if along_of(carry) else jnp.asarray(False)


def slide_of(carry: Any) -> Slide:
    """Return the first lost slide of a run, without derivatives."""
    watch = carry.slides
    if watch == ():
        none = jnp.asarray(-1)
        return Slide(none, jnp.nan * jax.lax.stop_gradient(carry.point.t))
    return jax.tree.map(jax.lax.stop_gradient, watch.lost)


def has_slid(slide: Slide) -> Array:
    """Return True for a run with a lost slide."""
    return jnp.asarray(slide.comparison) >= 0
