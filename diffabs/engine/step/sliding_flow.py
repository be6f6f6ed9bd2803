"""The flow of a run that slides: on a switching surface onto which the flows of both sides push (Filippov).

    one surface    dz/dt = f + s (g - f)               f, g: the flow with the one and with the other answer
    several        dz/dt = f + sum_i s_i (g_i - f)     each answer acts by itself, as switched forces do

The shares s keep the margins of these comparisons at zero. A slide ends where its share reaches 0 or 1, so s (1 - s) is
its margin: an event like any other. Signals are mixed by the same shares: objectives see the equivalent control.

Source: Filippov, Differential Equations with Discontinuous Righthand Sides, section 4; for several surfaces the rule
of the equivalent control, Utkin, Sliding Modes in Control and Optimization, chapter 2.
"""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import clamp, larger, ratio
from diffabs.core.types import AnyArray, Array, PyTree, Scalar
from diffabs.engine.step.modes import ComparisonAnswers, Mode, ModeBits, SlidingSurface, pick_number, single_bit
from diffabs.engine.step.surfaces import read_bits

MAX_SURFACES = 2  # along which a run can slide at the same time
MAX_SHARE = 2.0  # of the other side, where the run leaves a surface to it

Look = Callable[[Scalar, PyTree, Mode], tuple[PyTree, ComparisonAnswers]]  # of time, flow, mode; begins with the rates


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
    """

    dynamics: PyTree
    answers: ComparisonAnswers
    margins: list[Scalar]
    pushes: list[Array]


def slide(look: Look, t: Scalar, z: PyTree, mode: Mode) -> SlidingDynamics:
    """Return the dynamics at (t, z) along the surfaces `mode.along`."""
    sides = _look_at_sides(look, t, z, mode)
    shares = _balance(sides.pushes, mode.along, [rates[0] for rates in sides.pushes])

    def mix(x: Array) -> AnyArray:
        return sum((share * (x[i] - x[0]) for i, share in enumerate(shares, 1)), x[0]) if _is_real(x) else x[0]

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

    def side(reversed: ModeBits) -> PyTree:
        return look(t, z, Mode(tuple(a ^ b for a, b in zip(answers.words, reversed, strict=True))))[0]

    others = jax.vmap(side)(stack_surfaces(mode.along).answers)
    dynamics = jax.tree.map(lambda x, more: jnp.concatenate([jnp.asarray(x)[None], more]), base, others)

    def list_margins(t: Scalar, z: PyTree) -> list[Scalar]:
        at = look(t, z, Mode(answers.words))[1]
        return [pick_number(at.numbers, surface.number, at.margins) for surface in mode.along]

    margins, move = jax.linearize(list_margins, t, z)
    pushes = jax.vmap(lambda rates: move(jnp.ones_like(t), rates))(dynamics[:2])
    return _Sides(dynamics, answers, margins, pushes)


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
