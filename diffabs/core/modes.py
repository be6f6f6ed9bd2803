"""Answers to the comparisons of a program (`core.comparisons`), given from outside: packed in words, a bit for each."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

WORD_BITS = 32  # answers in a word
ROUNDING_POWER = 0.75  # power of the precision: of two numbers, a relative difference that says nothing

ModeBits = tuple[Any, ...]
BitRange = tuple[int, tuple[int, ...]]  # of a comparison: its first bit, and its shape


class Mode(NamedTuple):
    """Answers (None: as the numbers say); whether they do not count, after all; and, where one looks, those of them
    that give way where the numbers say otherwise."""

    words: ModeBits | None
    free: Any = None
    released: ModeBits | None = None


class ComparisonAnswers(NamedTuple):
    """The answers that were taken; those that the numbers contradict, by more than rounding, and that did not give way;
    the margins until they do, negative then, each with the numbers of its bits. Of answers as the numbers say it, the
    margins are x - y, with either sign."""

    words: ModeBits
    contradicted: ModeBits
    margins: list[tuple[Any, Any]]


def single_bit(which: Any, words: int) -> ModeBits:
    """Return the words of one bit."""
    word, place = which // WORD_BITS, (which % WORD_BITS).astype(jnp.uint32)
    return tuple(jnp.where(word == i, jnp.uint32(1) << place, jnp.uint32(0)) for i in range(words))


def find_contradicted(answers: ComparisonAnswers, which: Any, like: Any) -> tuple[Any, Any, Any, Any]:
    """Return a comparison other than `which` that is contradicted, -1 if none is; whether `which` is; which of both
    this is about, `which` if it is contradicted or no other is; and its margin, of the type of `like`. Numbers are
    those of bits."""
    other, crossed = jnp.asarray(-1, which.dtype), jnp.asarray(False)
    for i, (word, bit) in enumerate(
        zip(answers.contradicted, single_bit(which, len(answers.contradicted)), strict=True)
    ):
        rest = word & ~bit
        lowest = jax.lax.population_count((rest & (~rest + 1)) - 1)
        other = jnp.where(rest != 0, i * WORD_BITS + lowest.astype(which.dtype), other)
        crossed |= (word & bit) != 0
    chosen, margin = jnp.where(crossed | (other < 0), which, other), jnp.zeros_like(like)
    for numbers, one in answers.margins:
        inside = chosen == numbers
        if jnp.ndim(one):
            inside, one = jnp.any(inside), jnp.sum(jnp.where(inside, one, 0.0))
        margin = jnp.where(inside, one, margin)
    return other, crossed, chosen, margin


class ComparisonTrace:
    """The comparisons of one run of a program."""

    def __init__(self, places: Sequence[BitRange], words: int, mode: Mode, look: bool):
        """Comparisons at these places, of which a caller may want to `look` at the margins."""
        self.places, self.mode, self.look = places, mode, look
        self.taken: dict[int, Any] = {}
        self.against: list[Any] = [jnp.uint32(0)] * words
        self.said: list[Any] = [jnp.uint32(0)] * words
        self.margins: list[tuple[Any, Any]] = []

    def __call__(self, ask: tuple[int, bool], x: Any, y: Any, strict: bool) -> Any:
        """Whether x > y, or x >= y."""
        number, turned = ask
        if number not in self.taken:
            self.taken[number] = self._compare(number, *((y, x, not strict) if turned else (x, y, strict)))
        taken = self.taken[number]
        return ~taken if turned else taken

    def _compare(self, number: int, x: Any, y: Any, strict: bool) -> Any:
        first, shape = self.places[number]

        def says() -> Any:
            return jnp.greater(x, y) if strict else jnp.greater_equal(x, y)

        if self.mode.words is None:
            self._pack(self.said, first, says())
            self._add(first, shape, x - y)
            return says()
        taken = unpack_answers(self.mode.words, first, shape)
        if not self.look:
            return taken if self.mode.free is None else jnp.where(self.mode.free, says(), taken)
        margin = jnp.where(taken, x - y, y - x)
        against = margin < -_rounding(x)
        if self.mode.released is not None:  # a product that has become 0 contradicts nobody, and would be held for ever
            gives = unpack_answers(self.mode.released, first, shape)
            against |= gives & (margin == 0) & (says() != taken)
            taken ^= against & gives
        self._pack(self.against, first, against)
        self._add(first, shape, margin)
        return taken

    def search(self, ask: tuple[int, bool], says: Callable[[], Any], knots: Any, x: Any) -> Any:
        """How many of the knots lie below x: a bit for each of them."""
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
        next = below + jnp.where(high < -_rounding(x), 1, 0) - jnp.where(low < -_rounding(x), 1, 0)
        if self.mode.free is not None:
            next = jnp.where(self.mode.free, says(), next)
        against = _ones(next) ^ field
        self.against[word] |= against << shift
        loose = np.uint32(0) if self.mode.released is None else self.mode.released[word] >> shift
        return jax.lax.population_count(field ^ (against & loose)).astype(np.int32)

    def _add(self, first: int, shape: tuple[int, ...], margin: Any) -> None:
        self.margins.append((first + np.arange(np.prod(shape)).reshape(shape) if shape else first, margin))

    def _between(self, first: int, below: Any, knots: Any, x: Any) -> tuple[Any, Any]:
        """How far x is from the knots on either side of it."""
        count = len(knots)
        low = jnp.where(below > 0, x - knots[jnp.maximum(below - 1, 0)], jnp.inf)
        high = jnp.where(below < count, knots[jnp.minimum(below, count - 1)] - x, jnp.inf)
        self.margins += [(first + below - 1, low), (first + below, high)]
        return low, high

    def _pack(self, words: list[Any], first: int, answer: Any) -> None:
        if not jnp.ndim(answer):
            words[first // WORD_BITS] |= jnp.where(answer, np.uint32(1 << first % WORD_BITS), np.uint32(0))
            return
        for start, word, places in locate_bits(first, jnp.shape(answer)):
            here = jnp.ravel(answer)[start : start + len(places)]
            words[word] |= jnp.sum(jnp.where(here, np.uint32(1) << places, np.uint32(0)), dtype=jnp.uint32)

    def answers(self) -> ComparisonAnswers:
        """What was found."""
        against = self.against
        if self.mode.words is None:
            return ComparisonAnswers(tuple(self.said), tuple(against), self.margins)
        loose = self.mode.released or (np.uint32(0),) * len(against)
        taken = (was ^ (now & give) for was, now, give in zip(self.mode.words, against, loose, strict=True))
        return ComparisonAnswers(
            tuple(taken), tuple(now & ~give for now, give in zip(against, loose, strict=True)), self.margins
        )


def _ones(count: Any) -> Any:
    """So many bits, from the lowest."""
    return (jnp.uint32(1) << count.astype(jnp.uint32)) - 1


def _rounding(x: Any) -> Any:
    most = jnp.finfo(jnp.result_type(x))
    return most.eps**ROUNDING_POWER * jnp.minimum(jnp.abs(x), most.max)


def unpack_answers(words: ModeBits, first: int, shape: tuple[int, ...]) -> Any:
    """Return the answers of a comparison, bool of this shape."""
    if not shape:
        return (words[first // WORD_BITS] & np.uint32(1 << first % WORD_BITS)) != 0
    parts = [(words[word] & (np.uint32(1) << places)) != 0 for _, word, places in locate_bits(first, shape)]
    return jnp.concatenate(parts).reshape(shape)


def locate_bits(first: int, shape: tuple[int, ...]) -> list[tuple[int, int, np.ndarray]]:
    """Where the bits of a comparison lie: the first of them in a word, the word, and places in it."""
    size, found, start = int(np.prod(shape)), [], 0
    while start < size:
        at = (first + start) % WORD_BITS
        many = min(size - start, WORD_BITS - at)
        found.append((start, (first + start) // WORD_BITS, np.arange(at, at + many, dtype=np.uint32)))
        start += many
    return found
