"""Slides: runs that stay on a switching surface, because the flows of both sides push onto it (Filippov).

Such a run lands on the surface, and the flow beyond brings it back at once, for ever. Its steps would chatter along the
surface, and the times of these landings have no meaning for a derivative. So it follows the surface.

    landing    a run that lands on a surface is watched until it makes a calm step
    slide      a landing on a surface that it has met since then is a return. The run slides along it after two returns
               at once, or after three later ones. A touched surface brings one return. Margins that are zero to
               rounding bring none: they do not fall along a line
    end        the run leaves where its share reaches 0 or 1, a landing, too; at once if the share jumps beyond, because
               another answer changes
    lost       a slide that ends as soon as it begins, again and again, as where a run spirals into the intersection of
               two surfaces, or one along more surfaces than `MAX_SURFACES`. Such a run has no derivative

The flow along a surface onto which the flows of both sides push:

    one surface    dz/dt = f + s (g - f)               f, g: the flow with the one and with the other answer
    several        dz/dt = f + sum_i s_i (g_i - f)     each answer acts by itself, as switched forces do

The shares s keep the margins of these comparisons at zero. A slide ends where its share reaches 0 or 1, so s (1 - s) is
its margin: an event like any other. Signals are mixed by the same shares: objectives see the equivalent control.

Source: Filippov, Differential Equations with Discontinuous Righthand Sides, section 4; for several surfaces the rule
of the equivalent control, Utkin, Sliding Modes in Control and Optimization, chapter 2.
"""

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core import shapes
from diffabs.core.lanes import select
from diffabs.core.numerics import clamp, larger, ratio
from diffabs.core.types import AnyArray, Array, Bool, Int, PyTree, Scalar
from diffabs.engine.step.event_location import EventSearch
from diffabs.engine.step.modes import (
    ComparisonAnswers,
    Mode,
    ModeBits,
    SlidingSurface,
    pick_number,
    read_bits,
    single_bit,
)

# A return within the shortest time that a search resolves counts `RETURN_AT_ONCE`, a later one 1.
MAX_RETURNS, RETURN_AT_ONCE = 3, 2
LOST_RETURNS = 12  # returns since the last calm step with which a slide is lost
# Fraction of the fall: a margin at the beginning of a step that is farther from a line through zero is rounding.
MAX_LINE_ERROR = 0.5
MAX_SURFACES = 2  # along which a run can slide at the same time
# Of both margins, by which they differ if nothing jumps; of both rates, with which a margin leaves zero.
MAX_MARGIN_JUMP, MAX_STRAY = 1e-9, 1e-6
MAX_SHARE = 2.0  # of the other side, where the run leaves a surface to it

Look = Callable[[Scalar, PyTree, Mode], tuple[PyTree, ComparisonAnswers]]  # of time, flow, mode; begins with the rates


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


def no_surface() -> SlidingSurface:
    """Return what stands for a surface in a run that follows none."""
    return SlidingSurface(jnp.asarray(-1), ())


def ended_slide(carry: Any) -> SlidingSurface:
    """Return the surface along which the last landing has ended a slide; without answers if the run follows none."""
    if not along_of(carry):
        return no_surface()
    return SlidingSurface(carry.slides.followed.ended, carry.slides.followed.decided)


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


class SlidingDynamics(NamedTuple):
    """The dynamics of a run that slides.

    Attributes:
        dynamics: Outputs of the program, mixed by the shares.
        answers: Answers of the mode. The margin of a comparison along whose surface the run slides is s (1 - s).
        shares: Share s of the other answer of each such comparison; 0 without one.
    """

    dynamics: PyTree
    answers: ComparisonAnswers
    shares: tuple[Scalar, ...]


class _Sides(NamedTuple):
    """The dynamics with the answers of the mode, and with each of those along a surface reversed, leaves (sides, ...).

    Attributes:
        dynamics: Outputs of the program.
        answers: Answers of the mode.
        margins: Margins of the comparisons along whose surfaces the run slides.
        pushes: Rates of each of these margins, shape (sides,).
        all_margins: Margins of all comparisons with the answers of each side, shape (sides, comparisons).
        all_pushes: Rates of all margins with the answers of the mode, shape (sides, comparisons).
    """

    dynamics: PyTree
    answers: ComparisonAnswers
    margins: list[Scalar]
    pushes: list[Array]
    all_margins: Array
    all_pushes: Array


def slide(look: Look, t: Scalar, z: PyTree, mode: Mode) -> SlidingDynamics:
    """Return the dynamics at (t, z) along the surfaces `mode.along`."""
    sides = _look_at_sides(look, t, z, mode)
    shares = _balance(sides.pushes, mode.along, [rates[0] for rates in sides.pushes])

    strayed = _strays(sides, mode, shares)

    def mix(x: Array) -> AnyArray:
        if not _is_real(x):
            return x[0]
        # A step with NaN is not accepted, and the run is reported as one that slides.
        return jnp.where(strayed, jnp.nan, sum((share * (x[i] - x[0]) for i, share in enumerate(shares, 1)), x[0]))

    judged = _turn_outward(shares, sides.pushes)
    return SlidingDynamics(jax.tree.map(mix, sides.dynamics), _answer_by_shares(sides.answers, mode, judged), judged)


def return_to_surfaces(look: Look, t: Scalar, z: PyTree, mode: Mode) -> PyTree:
    """Return the flow `z` moved onto the surfaces `mode.along`, from which a step has strayed by its error.

    It moves along the difference of the rates of both sides, as a run that chatters does.
    """
    sides = _look_at_sides(look, t, z, mode)
    times = _balance(sides.pushes, mode.along, sides.margins)

    def move(x: Array, rates: Array) -> AnyArray:
        return sum((time * (rates[i] - rates[0]) for i, time in enumerate(times, 1)), x)

    return jax.tree.map(move, z, sides.dynamics[:2])


def _look_at_sides(look: Look, t: Scalar, z: PyTree, mode: Mode) -> _Sides:
    assert mode.words is not None
    loose = mode.released and tuple(
        word & ~bits for word, bits in zip(mode.released, sliding_answers(mode.along), strict=True)
    )
    base, answers = look(t, z, Mode(mode.words, released=loose))

    def side(reversed: ModeBits) -> tuple[PyTree, Array]:
        rates, others = look(t, z, Mode(tuple(a ^ b for a, b in zip(answers.words, reversed, strict=True))))
        return rates, others.margins

    def join(x: Array, more: Array) -> Array:
        return jnp.concatenate([jnp.asarray(x)[None], more])

    others, other_margins = jax.vmap(side)(stack_surfaces(mode.along).answers)
    dynamics = jax.tree.map(join, base, others)
    margins, move = jax.linearize(lambda t, z: look(t, z, Mode(answers.words))[1].margins, t, z)
    pushes = jax.vmap(lambda rates: move(jnp.ones_like(t), rates))(dynamics[:2])

    def pick(values: Array) -> list[Any]:
        return [pick_number(answers.numbers, surface.number, values) for surface in mode.along]

    return _Sides(
        dynamics, answers, pick(margins), jax.vmap(pick)(pushes), join(answers.margins, other_margins), pushes
    )


def _strays(sides: _Sides, mode: Mode, shares: tuple[Scalar, ...]) -> Bool:
    """Return True if the flow along the surfaces leaves the zero of a comparison whose answer changes with theirs.

    Such a comparison has a surface of its own, which the run met at the same instant. A comparison that reads what
    jumps at the surface has no such zero: its margins with the answers of both sides differ by more than the sign.
    """
    numbers, pushes, strays = sides.answers.numbers, sides.all_pushes, jnp.asarray(False)
    flow = sum((share * (pushes[i] - pushes[0]) for i, share in enumerate(shares, 1)), pushes[0])
    followed = reduce(jnp.logical_or, [numbers == surface.number for surface in mode.along])
    for i, surface in enumerate(mode.along, 1):
        near, beyond = sides.all_margins[0], sides.all_margins[i]
        steady = jnp.abs(near + beyond) <= MAX_MARGIN_JUMP * (jnp.abs(near) + jnp.abs(beyond))
        leaves = jnp.abs(flow) > MAX_STRAY * larger(jnp.abs(pushes[0]), jnp.abs(pushes[i]))
        strays |= jnp.any(read_bits(surface.answers, numbers) & ~followed & steady & leaves & surface.exists)
    return strays


def _is_real(x: Array) -> bool:
    return jnp.issubdtype(x.dtype, jnp.floating)


def sliding_answers(along: tuple[SlidingSurface, ...]) -> ModeBits:
    """Return the bits of all comparisons that answer otherwise on the other side of a surface."""
    return tuple(reduce(jnp.bitwise_or, words) for words in zip(*(surface.answers for surface in along), strict=True))


def stack_surfaces(along: tuple[SlidingSurface, ...]) -> SlidingSurface:
    """Return all surfaces as one, leaves (surfaces, ...)."""
    return jax.tree.map(lambda *x: jnp.stack(x), *along)


def _balance(pushes: list[Array], along: tuple[SlidingSurface, ...], excesses: list[Scalar]) -> tuple[Scalar, ...]:
    """Return x_i with excess_k + sum_i x_i (push_k of side i - push_k) = 0 for each margin k; 0 without a surface."""
    rows = [
        [jnp.where(surface.exists, rates[i] - rates[0], 1.0 * (i == place)) for i in range(1, 1 + len(along))]
        for place, (surface, rates) in enumerate(zip(along, pushes, strict=True), 1)
    ]
    rests = [jnp.where(surface.exists, -excess, 0.0) for surface, excess in zip(along, excesses, strict=True)]
    if len(along) == 1:
        return (ratio(rests[0], rows[0][0]),)
    (a, b), (c, d) = rows
    determinant = a * d - b * c
    return ratio(rests[0] * d - b * rests[1], determinant), ratio(a * rests[1] - rests[0] * c, determinant)


def _turn_outward(shares: tuple[Scalar, ...], pushes: list[Array]) -> tuple[Scalar, ...]:
    """Return the shares; where both sides of a surface push the same way, beyond 0 or 1 on the side they push to.

    There -p/(q - p), with the pushes p < q < 0 or q < p < 0, is beyond 1 or below 0. The run crosses in both cases.
    """
    outward = []
    for place, (rates, share) in enumerate(zip(pushes, shares, strict=True)):
        more = [other * (rates[i] - rates[0]) for i, other in enumerate(shares, 1) if i != place + 1]
        near = sum(more, rates[0])
        beyond = near + rates[place + 1] - rates[0]
        far = jnp.where(near == beyond, MAX_SHARE, clamp(larger(share, 1.0 - share), 1.0, MAX_SHARE))
        share = jnp.where((near < 0) & (beyond < 0), far, jnp.where((near > 0) & (beyond > 0), 1.0 - far, share))
        outward.append(share)
    return tuple(outward)


def _answer_by_shares(answers: ComparisonAnswers, mode: Mode, shares: tuple[Scalar, ...]) -> ComparisonAnswers:
    """Return the answers whose margins along the surfaces are those of the shares."""
    undecided = sliding_answers(mode.along)
    contradicted = tuple(word & ~bits for word, bits in zip(answers.contradicted, undecided, strict=True))
    margins = jnp.where(read_bits(undecided, answers.numbers), jnp.inf, answers.margins)
    for surface, share in zip(mode.along, shares, strict=True):
        ahead, bits = share * (1.0 - share), single_bit(surface.number, len(contradicted))
        margins = jnp.where(answers.numbers == surface.number, ahead, margins)
        contradicted = tuple(
            jnp.where(ahead < 0, word | bit, word & ~bit) for word, bit in zip(contradicted, bits, strict=True)
        )
    return ComparisonAnswers(answers.words, contradicted, answers.numbers, margins)
