"""Modes: frozen answers to the comparisons of a program (`comparisons`), packed in words, one bit for each. Switching
surfaces: where the margin of a comparison is zero, and when a run crosses it.

Near a point of the run the margin x - y of a comparison moves along a line. It is zero at a time |x - y|/|d(x - y)/dt|
ahead or in the past. A step that ends there has its kink at its end, where the kink costs no accuracy.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.types import AnyArray, Array, Bool, Int, PyTree, Scalar, Vector

WORD_BITS, WORD_SHIFT = 32, 5  # answers in a word, and the logarithm of base 2 of this number
NO_BIT = -2  # number of no comparison; -1 is the number of a comparison that was not found
ROUNDING_POWER = 0.75  # eps to this power is a relative difference that may come from rounding alone
NEVER_S = 1e9  # s; time to the next crossing if no crossing is predicted
# A crossing nearer than this fraction of the length that the error allows counts as past.
IMMEDIATE_FRACTION = 2e-4
# A crossing outside of these fractions of a step lies at one end of the step.
STEP_START_FRACTION, STEP_END_FRACTION = 0.02, 0.95

ModeBits = tuple[Any, ...]
BitRange = tuple[int, tuple[int, ...]]  # first bit and shape of a comparison


class SlidingSurface(NamedTuple):
    """A surface along which a run slides.

    Attributes:
        number: Number of the comparison whose margin is zero there; -1 for none.
        answers: Bits of all comparisons that answer otherwise on the other side: of this one, and of those that depend
            on it. Their numbers say nothing on the surface itself.
    """

    number: Array
    answers: ModeBits

    @property
    def exists(self) -> Bool:
        """True if the run slides along it."""
        return self.number >= 0


class Mode(NamedTuple):
    """Frozen answers to the comparisons of a program.

    Attributes:
        words: The answers; None takes the answers of the numbers.
        free: True overrides the frozen answers by the answers of the numbers. An evaluation with `look` ignores it,
            except for a search in knots.
        released: Answers that give way where the numbers contradict them. Only an evaluation with `look` reads them.
        along: Surfaces along which the run slides (`slides`); () if it cannot slide.
    """

    words: ModeBits | None
    free: PyTree = None
    released: ModeBits | None = None
    along: tuple[SlidingSurface, ...] = ()

    @property
    def slides(self) -> Bool:
        """True if the run slides along a surface."""
        return reduce(jnp.logical_or, [surface.exists for surface in self.along], jnp.asarray(False))


class ComparisonAnswers(NamedTuple):
    """The answers of an evaluation with `look`.

    Attributes:
        words: Answers that were used.
        contradicted: Answers that the numbers contradict by more than rounding, and that did not give way.
        numbers: Numbers of the bits to which the margins belong, shape (n,): one for each comparison, two for a search
            in knots.
        margins: Margins, shape (n,). A margin is negative where the numbers contradict the answer. Without frozen
            answers it is x - y, with either sign.
    """

    words: ModeBits
    contradicted: ModeBits
    numbers: AnyArray
    margins: Array


def split_number(number: Array) -> tuple[Array, Array]:
    """Return the word and the place in it of the bit with this number; a word that does not exist for -1 and -2."""
    # Shift and mask are two operations; // and % of numbers with a sign are twenty each.
    bits = number.astype(jnp.uint32)
    return bits >> WORD_SHIFT, bits & (WORD_BITS - 1)


def single_bit(number: Array, words: int) -> ModeBits:
    """Return packed words with one bit set, or without a set bit if its `number` is negative."""
    word, place = split_number(number)
    return tuple(jnp.where(word == i, jnp.uint32(1) << place, jnp.uint32(0)) for i in range(words))


class SurfaceCrossing(NamedTuple):
    """Contradicted comparisons at the end of a step: the numbers there give other answers than the mode of the step.

    Attributes:
        unsought: A contradicted comparison other than the sought one, or -1.
        contradicted: True if the sought comparison is contradicted.
        target: Number of the comparison to search for: `unsought` if it alone is contradicted, else the sought one.
        margin: Margin of that comparison.
    """

    unsought: Array
    contradicted: Bool
    target: Array
    margin: Scalar


def find_contradicted(answers: ComparisonAnswers, number: Array, like: PyTree) -> SurfaceCrossing:
    """Return the contradicted comparisons, by the number of the sought one; `like` has the type of the margin."""
    unsought, crossed = jnp.asarray(-1, number.dtype), jnp.asarray(False)
    for i, (word, bit) in enumerate(
        zip(answers.contradicted, single_bit(number, len(answers.contradicted)), strict=True)
    ):
        remaining = word & ~bit
        # x & -x keeps the lowest set bit; one less has as many bits set as there are places below it.
        lowest = jax.lax.population_count((remaining & (~remaining + 1)) - 1)
        unsought = jnp.where(remaining != 0, i * WORD_BITS + lowest.astype(number.dtype), unsought)
        crossed |= (word & bit) != 0
    target = jnp.where(crossed | (unsought < 0), number, unsought)
    margin = pick_number(answers.numbers, target, answers.margins).astype(like.dtype)
    return SurfaceCrossing(unsought, crossed, target, margin)


def pick_number(numbers: AnyArray, number: Int, values: Array) -> Array:
    """Return the value with this number, of `values` (n,) with the `numbers` (n,); 0 without one."""
    return jnp.sum(jnp.where(numbers == number, values, 0.0))


class ComparisonTrace:
    """The comparisons of one evaluation of a program."""

    def __init__(self, places: Sequence[BitRange], words: int, mode: Mode, look: bool):
        """Begin an evaluation in `mode`; `look` records contradictions and margins.

        `places` holds the bits of each comparison, by its number, and `words` is the number of words.
        """
        self.places, self.mode, self.look = places, mode, look
        self.by_number: dict[int, PyTree] = {}
        self.against: list[PyTree] = [jnp.uint32(0)] * words
        self.said: list[PyTree] = [jnp.uint32(0)] * words
        self.margins: list[tuple[PyTree, PyTree]] = []

    def __call__(self, ask: tuple[int, bool], x: Scalar, y: Scalar, strict: bool) -> Scalar:
        """Return the answer to x > y if strict, else to x >= y.

        `ask` holds the number of the comparison, and True if that number denotes the negation.
        """
        number, turned = ask
        if number not in self.by_number:
            self.by_number[number] = self._compare(number, *((y, x, not strict) if turned else (x, y, strict)))
        answer = self.by_number[number]
        return ~answer if turned else answer

    def _compare(self, number: int, x: Scalar, y: Scalar, strict: bool) -> Scalar:
        """Return the frozen answer, or the answer of the numbers, and record the contradiction and the margin."""
        first, shape = self.places[number]

        def says() -> Array:
            return jnp.greater(x, y) if strict else jnp.greater_equal(x, y)

        if self.mode.words is None:
            self._pack(self.said, first, says())
            self._add(first, shape, x - y)
            return says()
        answer = _unpack_answers(self.mode.words, first, shape)
        if not self.look:
            return answer if self.mode.free is None else jnp.where(self.mode.free, says(), answer)
        margin = jnp.where(answer, x - y, y - x)
        against = margin < -_rounding_error(x)
        if self.mode.released is not None:
            # A margin of exactly 0 (a product that has become 0) is no contradiction; without this line a released
            # answer would stay frozen for ever.
            gives = _unpack_answers(self.mode.released, first, shape)
            against |= gives & (margin == 0) & (says() != answer)
            answer ^= against & gives
        self._pack(self.against, first, against)
        self._add(first, shape, margin)
        return answer

    def search(self, ask: tuple[int, bool], says: Callable[[], PyTree], knots: Vector, x: Scalar) -> Array:
        """Return the number of knots that are not above `x`, as an integer; each knot has one bit.

        `ask` holds the number of the search and is otherwise not used. `says()` is the search by the numbers. The
        `knots` have the shape (n,).
        """
        number, count = ask[0], len(knots)
        first = self.places[number][0]
        word, shift, all = first // WORD_BITS, np.uint32(first % WORD_BITS), np.uint32((1 << count) - 1)
        if self.mode.words is None:
            below = says()
            self.said[word] |= _ones(below) << shift
            self._between(first, below, knots, x)
            return below
        field = (self.mode.words[word] >> shift) & all
        below = jax.lax.population_count(field).astype(np.int32)
        if not self.look:
            return below if self.mode.free is None else jnp.where(self.mode.free, says(), below)
        low, high = self._between(first, below, knots, x)
        # The neighbouring interval if x has left the frozen one by more than rounding.
        next = below + jnp.where(high < -_rounding_error(x), 1, 0) - jnp.where(low < -_rounding_error(x), 1, 0)
        if self.mode.free is not None:
            next = jnp.where(self.mode.free, says(), next)
        against = _ones(next) ^ field
        self.against[word] |= against << shift
        loose = np.uint32(0) if self.mode.released is None else self.mode.released[word] >> shift
        return jax.lax.population_count(field ^ (against & loose)).astype(np.int32)

    def _add(self, first: int, shape: tuple[int, ...], margin: Scalar) -> None:
        self.margins.append((first + np.arange(np.prod(shape)).reshape(shape) if shape else first, margin))

    def _between(self, first: int, below: Scalar, knots: Vector, x: Scalar) -> tuple[PyTree, PyTree]:
        """Return the distances of x from the knots below and above it, and record them as margins.

        `below` is the number of knots that count as not above x, and `first` the bit of the first knot.
        """
        count = len(knots)
        low = jnp.where(below > 0, x - knots[jnp.maximum(below - 1, 0)], jnp.inf)
        high = jnp.where(below < count, knots[jnp.minimum(below, count - 1)] - x, jnp.inf)
        # A side without a knot has no bit: `first - 1` and `first + count` belong to other comparisons.
        self.margins += [
            (jnp.where(below > 0, first + below - 1, NO_BIT), low),
            (jnp.where(below < count, first + below, NO_BIT), high),
        ]
        return low, high

    def _pack(self, words: list[PyTree], first: int, answer: Scalar) -> None:
        """Set the bits of an answer in these words."""
        if not jnp.ndim(answer):
            words[first // WORD_BITS] |= jnp.where(answer, np.uint32(1 << first % WORD_BITS), np.uint32(0))
            return
        for start, word, places in _locate_bits(first, jnp.shape(answer)):
            bits = jnp.ravel(answer)[start : start + len(places)]
            words[word] |= jnp.sum(jnp.where(bits, np.uint32(1) << places, np.uint32(0)), dtype=jnp.uint32)

    def answers(self) -> ComparisonAnswers:
        """Return the answers, the contradicted bits and the margins."""
        against = self.against
        if self.mode.words is None:
            return ComparisonAnswers(tuple(self.said), tuple(against), *self._stack_margins())
        loose = self.mode.released or (np.uint32(0),) * len(against)
        words = (was ^ (now & give) for was, now, give in zip(self.mode.words, against, loose, strict=True))
        return ComparisonAnswers(
            tuple(words), tuple(now & ~give for now, give in zip(against, loose, strict=True)), *self._stack_margins()
        )

    def _stack_margins(self) -> tuple[AnyArray, Array]:
        """Return the numbers and the margins of all comparisons."""
        numbers = [number for number, _ in self.margins]
        constant = all(isinstance(number, int | np.ndarray) for number in numbers)
        if not numbers:
            return np.zeros(0, int), jnp.zeros(0)
        stacked = np.concatenate([np.ravel(x) for x in numbers]) if constant else stack_flat(numbers)
        return stacked, stack_flat([margin for _, margin in self.margins])


def stack_flat(arrays: Sequence[object]) -> Array:
    """Return all numbers of the arrays in one vector."""
    vectors = [jnp.ravel(jnp.asarray(x)) for x in arrays]
    # An empty vector would only decide the type: that of a loop in float32 is not the default type.
    return jnp.concatenate([vector for vector in vectors if vector.size] or vectors)


def _ones(count: Array) -> Array:
    """Return a word with the lowest `count` bits set."""
    return (jnp.uint32(1) << count.astype(jnp.uint32)) - 1


def _rounding_error(x: Scalar) -> Scalar:
    """Return the difference from x below which a comparison is undecided by rounding."""
    limits = jnp.finfo(jnp.result_type(x))
    return limits.eps**ROUNDING_POWER * jnp.minimum(jnp.abs(x), limits.max)


def _unpack_answers(words: ModeBits, first: int, shape: tuple[int, ...]) -> Scalar:
    """Return the answers of one comparison as booleans of the comparison's shape."""
    if not shape:
        return (words[first // WORD_BITS] & np.uint32(1 << first % WORD_BITS)) != 0
    parts = [(words[word] & (np.uint32(1) << places)) != 0 for _, word, places in _locate_bits(first, shape)]
    return jnp.concatenate(parts).reshape(shape)


def _locate_bits(first: int, shape: tuple[int, ...]) -> list[tuple[int, int, np.ndarray]]:
    """Return the bits of a comparison word by word, as a list of (first element, word, bits).

    An entry holds the flat index of the first element in the word, the word's index, and the bits' places in it.
    """
    size, ranges, start = int(np.prod(shape)), [], 0
    while start < size:
        at = (first + start) % WORD_BITS
        many = min(size - start, WORD_BITS - at)
        ranges.append((start, (first + start) // WORD_BITS, np.arange(at, at + many, dtype=np.uint32)))
        start += many
    return ranges


def mode_in_step(words: ModeBits, free: Bool) -> Mode:
    """Return the mode of a step in which the comparisons keep the answers `words`.

    Where it is `free`, each stage evaluates its comparisons, across switching surfaces.
    """
    all, none = jnp.uint32(0xFFFFFFFF), jnp.uint32(0)
    return Mode(words, free, tuple(jnp.where(free, all, none) for _ in words))


def mode_after_changes(words: ModeBits, decided: ModeBits, lands: Bool) -> Mode:
    """Return the mode in which the dynamics are evaluated after the changes at the end of a step.

    If it `lands` on a switching surface, the bits `decided` keep their answers in `words`: at the zero of a margin,
    rounding could turn them back. All others are evaluated.
    """
    return Mode(words, ~lands, tuple(~jnp.where(lands, bits, jnp.uint32(0)) for bits in decided))


def flip_answers(words: ModeBits, bits: ModeBits, lands: Bool) -> ModeBits:
    """Return the answers with these bits reversed where a step `lands` on the switching surface between them."""
    return tuple(word ^ jnp.where(lands, bit, jnp.uint32(0)) for word, bit in zip(words, bits, strict=True))


class SwitchingFunctions(NamedTuple):
    """Margins of comparisons, and their rates.

    Attributes:
        numbers: Numbers of the comparisons' bits, shape (n,).
        values: Margins x - y, shape (n,); within a mode, negative where the numbers contradict the answer.
        rates: Rates of the margins [1/s], shape (n,); None if they were not evaluated.
    """

    numbers: AnyArray
    values: Array
    rates: Array | None = None

    def times_since_crossing(self) -> Array:
        """Return the times since the margins were zero, shape (n,) [s]; negative for a crossing ahead.

        A rate of 0 gives an infinite time or NaN, which cuts no step.
        """
        assert self.rates is not None
        return self.values / self.rates

    def take_none(self) -> "SwitchingFunctions":
        """Return no functions, of the same types."""
        return SwitchingFunctions(self.numbers[:0], self.values[:0], None if self.rates is None else self.rates[:0])


def forecast_crossing(surfaces: SwitchingFunctions, natural: Scalar, shortest: Scalar) -> Scalar:
    """Return the time [s] to the first predicted crossing of a switching surface; `NEVER_S` without one.

    A crossing nearer than `shortest`, the shortest step [s], or than `IMMEDIATE_FRACTION` of `natural`, the length that
    the error allows [s], counts as past.
    """
    nearest, since = jnp.maximum(IMMEDIATE_FRACTION * natural, shortest), surfaces.times_since_crossing()
    return jnp.min(jnp.where(since < -nearest, -since, NEVER_S), initial=NEVER_S).astype(jnp.result_type(natural))


def time_since_crossing(surfaces: SwitchingFunctions, changed: ModeBits, length: Scalar) -> Scalar:
    """Return the time [s] between the first crossing inside a step and the end of the step; 0 without one.

    A crossing counts as inside between `STEP_START_FRACTION` and `STEP_END_FRACTION` of the step. `surfaces` are those
    at its end, and `changed` the bits of the comparisons whose answers differ from those at its beginning.
    """
    _, later, since = _find_changes(surfaces, changed, length)
    # Crossings outside of these fractions of the step lie at its ends.
    inside = later & (since > (1 - STEP_END_FRACTION) * length)
    return jnp.max(jnp.where(inside, since, 0.0), initial=0.0)


class Imminent(NamedTuple):
    """The comparison that a run is about to change.

    Attributes:
        number: Number of the comparison; -1 without one.
        time: Predicted time to the change [s].
    """

    number: Int
    time: Scalar


def find_imminent(surfaces: SwitchingFunctions, natural: Scalar) -> Imminent:
    """Return the comparison with the first predicted change, however near; later than `NEVER_S` counts as none."""
    ahead = -surfaces.times_since_crossing()
    ahead = jnp.where(ahead >= 0, ahead, NEVER_S)
    time = jnp.min(ahead, initial=NEVER_S).astype(jnp.result_type(natural))
    number = jnp.max(jnp.where((ahead == time) & (time < NEVER_S), jnp.asarray(surfaces.numbers), -1), initial=-1)
    return Imminent(number, time)


def find_return(imminent: Imminent, surfaces: SwitchingFunctions, changed: ModeBits, length: Scalar) -> Array:
    """Return the number of a comparison that a step crosses and that moves back in it or at its end; -1 without one."""
    assert surfaces.rates is not None
    numbers = jnp.asarray(surfaces.numbers)
    back = read_bits(changed, numbers) & (surfaces.values * surfaces.rates < 0)
    early = (imminent.time < STEP_START_FRACTION * length) & ~read_bits(changed, imminent.number)
    number = jnp.where(early, imminent.number, -1)
    return jnp.maximum(number, jnp.max(jnp.where(back, numbers, -1), initial=-1))


def valid_end_rates(surfaces: SwitchingFunctions, changed: ModeBits, length: Scalar) -> tuple[Bool, Bool]:
    """Return two flags, for the start and the end of a step: True if the rate there is also the rate inside the step.

    The start's flag is False if a comparison changes at the start. The end's flag is False if one changes later.
    """
    at_start, later, _ = _find_changes(surfaces, changed, length)
    return ~jnp.any(at_start), ~jnp.any(later)


def _find_changes(surfaces: SwitchingFunctions, changed: ModeBits, length: Scalar) -> tuple[AnyArray, AnyArray, Array]:
    """Return for each comparison: whether it changed at the start of a step, whether later, and the time since then.

    A change without a time, at a rate of 0, counts as later.
    """
    on, since = read_bits(changed, surfaces.numbers), surfaces.times_since_crossing()
    early = since >= (1 - STEP_START_FRACTION) * length
    return on & early, on & ~early, since


def is_surface_moving(surfaces: SwitchingFunctions, changed: ModeBits) -> Bool:
    """Return True if the margin of a comparison that changes in a step is not at rest at its end."""
    return jnp.any(read_bits(changed, surfaces.numbers) & (surfaces.rates != 0))  # pyright: ignore[reportOptionalOperand]


def read_bits(words: ModeBits, numbers: object) -> Bool:
    """Return the bits with these numbers, bool."""
    index, place = split_number(jnp.asarray(numbers))
    word = sum(jnp.where(index == i, bits, jnp.uint32(0)) for i, bits in enumerate(words))
    return word & (jnp.uint32(1) << place) != 0
