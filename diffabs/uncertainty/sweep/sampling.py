"""Sampling designs: points of the unit cube for the samples of a sweep.

Sample i is a function of (seed, i), or of (seed, i, samples) for a finite design. So a chunk [start, stop) can be drawn
alone.

Points of a random design are odd multiples of 2^-53, and points of Sobol' sequences odd multiples of 2^-33. They are
never 0 or 1, and 1 - u is exact. SciPy's sequences have up to 64 bits, but in SciPy 1.17 `fast_forward` raises for more
than 32.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.shapes import Float, UInt
from diffabs.core.types import Int, PyTree, Table
from diffabs.host.values import (
    check_sound,
    find_field_faults,
    format_table,
    kebab_case,
    list_reader,
    read_any_number,
    read_one,
    read_whole,
    table_field,
    table_reader,
    whole_reader,
)
from diffabs.uncertainty.sweep.distributions import Distribution, support_interval

# Largest number of samples, whose numbers have 32 bits in JAX's keys and in the sequences; and largest seed.
MAX_UINT32 = 2**32 - 1
MAX_HYPERCUBE_SAMPLES = 1_000_000  # a Latin hypercube is drawn and kept as a whole
SOBOL_BITS = 32
Points: TypeAlias = Float[np.ndarray, "runs variables"]  # in the unit cube


class SamplingDesign(Protocol):
    """A rule by which samples fill the unit cube."""

    def unit(self, seed: int, start: int, stop: int, dimension: int, samples: int) -> Points:
        """Return samples start, ..., stop - 1, shape (stop - start, dimension).

        They lie in (0, 1), those of grids and corners in [0, 1]. `seed` selects the points of a random design;
        `samples` is the number of all samples.
        """
        ...

    def count(self, variables: Table, samples: int | None) -> int:
        """Return the number of samples for these `variables`; `samples` is the wanted number, or None.

        Raises:
            ValueError: The design cannot have the wanted number.
        """
        del variables
        return _check_samples(samples)

    def problems(self, name: str, variables: Table | None = None) -> Iterator[str]:
        """Yield an error for each field that is wrong, alone or with these variables."""
        del variables
        yield from find_field_faults(self, name)


@dataclasses.dataclass(frozen=True)
class Random(SamplingDesign):
    """Independent samples: bits of JAX's `fold_in(key(seed), i)` (Threefry), 52 to a number."""

    def unit(self, seed: int, start: int, stop: int, dimension: int, samples: int) -> Points:
        del samples
        high, low = np.moveaxis(
            np.asarray(_random_words(_check_seed(seed), np.uint32(start), stop - start, dimension)), -1, 0
        )
        # 32 + 20 bits and half of the last one: never 0 or 1, and exact in float64.
        return (high * 2.0**20 + (low >> 12) + 0.5) * 2.0**-52


@functools.partial(jax.jit, static_argnums=(2, 3))
def _random_words(seed: Int, start: Int, count: int, dimension: int) -> UInt[jax.Array, "{count} variables 2"]:
    key = jax.random.key(seed, impl="threefry2x32")
    numbers = start + jax.lax.iota(jnp.uint32, count)
    return jax.vmap(lambda i: jax.random.bits(jax.random.fold_in(key, i), (dimension, 2), jnp.uint32))(numbers)


@dataclasses.dataclass(frozen=True)
class Sobol(SamplingDesign):
    """Scrambled Sobol' sequences, one after another (SciPy's: linear matrix scramble and digital shift, Matousek 1998).

    Attributes:
        replicates: Number of sequences, scrambled independently; the spread of their means gives the error. Each is
            balanced only with a power of two of samples (Owen 2020, arXiv:2008.08051).
    """

    replicates: int = table_field(whole_reader(1, MAX_UINT32), 1)

    def unit(self, seed: int, start: int, stop: int, dimension: int, samples: int) -> Points:
        block = samples // self.replicates
        points = [np.empty((0, dimension))]
        for r in range(start // block, math.ceil(stop / block)):
            first, last = max(start - r * block, 0), min(stop - r * block, block)
            points.append(_sobol_points(seed, r, first, last, dimension))
        return np.concatenate(points)

    def count(self, variables: Table, samples: int | None) -> int:
        """Return `samples`, a multiple of the replicates, for any `variables`."""
        return _check_multiple(super().count(variables, samples), self.replicates, "the number of replicates")


def _sobol_points(seed: int, replicate: int, start: int, stop: int, dimension: int) -> Points:
    """Return points of one scrambled sequence, moved by half of their last bit. Skipping 10^7 points takes 0.1 s."""
    from scipy.stats import qmc

    engine = qmc.Sobol(dimension, bits=SOBOL_BITS, rng=_generator(seed, replicate))
    if start == 0 < stop:
        # Draw the first point alone: SciPy warns if the first draw is not a power of two, and chunks have any length.
        points = np.concatenate([engine.random(1), engine.random(stop - 1)])
    else:
        points = engine.fast_forward(start).random(stop - start)
    return points + 0.5 ** (SOBOL_BITS + 1)


@dataclasses.dataclass(frozen=True)
class LatinHypercube(SamplingDesign):
    """SciPy's Latin hypercube: each variable has one sample in each of its N strata.

    All samples are drawn and kept together.
    """

    def unit(self, seed: int, start: int, stop: int, dimension: int, samples: int) -> Points:
        return _hypercube_points(seed, samples, dimension)[start:stop]

    def count(self, variables: Table, samples: int | None) -> int:
        """Return `samples`, at most MAX_HYPERCUBE_SAMPLES, for any `variables`."""
        if (count := super().count(variables, samples)) > MAX_HYPERCUBE_SAMPLES:
            raise ValueError(
                f"samples = {count} are more than a latin-hypercube can have, {MAX_HYPERCUBE_SAMPLES}; use sobol"
            )
        return count


@functools.lru_cache(1)
def _hypercube_points(seed: int, samples: int, dimension: int) -> Float[np.ndarray, "{samples} {dimension}"]:
    from scipy.stats import qmc

    points = qmc.LatinHypercube(dimension, rng=_generator(seed, 0)).random(samples)
    points = np.clip(points, 0.5**53, 1 - 0.5**53)
    points.flags.writeable = False
    return points


def _read_level(entry: PyTree, where: str) -> Any:
    return (
        list_reader(read_any_number)(entry, where)
        if isinstance(entry, list | tuple)
        else read_whole(entry, 2, MAX_UINT32, where)
    )


def _read_levels(entry: PyTree, where: str) -> Any:
    return (
        table_reader(_read_level)(entry, where)
        if isinstance(entry, Mapping)
        else read_whole(entry, 2, MAX_UINT32, where)
    )


@dataclasses.dataclass(frozen=True)
class Grid(SamplingDesign):
    """Every combination of levels; the last variable changes fastest.

    Attributes:
        levels: Number of levels of every variable, or an entry for each variable by name. A number gives levels equally
            spaced in u from 0 to 1; a tuple gives the u. `Categorical` and `Rows` have a level for each item, unless u
            are given.
    """

    levels: int | Mapping[str, int | tuple[float, ...]] = table_field(_read_levels)

    def over(self, variables: Table) -> "Grid":
        """Return the grid with the levels of each of these `variables`, in their order."""
        return Grid({name: self._levels(name, item) for name, item in variables.items()})

    def _levels(self, name: str, variable: Any) -> int | tuple[float, ...]:
        levels = self.levels.get(name, 0) if isinstance(self.levels, Mapping) else self.levels
        return tuple(variable.middles()) if hasattr(variable, "middles") and np.ndim(levels) == 0 else levels

    def unit(self, seed: int, start: int, stop: int, dimension: int, samples: int) -> Points:
        """Return samples of a grid made by `over`, or of a grid with one number of levels for all variables."""
        del seed, samples
        all_levels = list(self.levels.values()) if isinstance(self.levels, Mapping) else [self.levels] * dimension
        if len(all_levels) != dimension:
            raise ValueError(f"levels are given for {len(all_levels)} variables, not {dimension}")
        places = np.unravel_index(np.arange(start, stop), list(map(_level_count, all_levels)))
        return np.stack([_levels_at(place, levels) for place, levels in zip(places, all_levels, strict=True)], 1)

    def count(self, variables: Table, samples: int | None) -> int:
        """Return the number of points of the grid over `variables`.

        Raises:
            ValueError: `samples` is given, and is another number.
        """
        sizes = [_level_count(self._levels(name, item)) for name, item in variables.items()]
        return _check_exact_count(math.prod(sizes), samples, f"the grid {' x '.join(map(str, sizes))}")

    def problems(self, name: str, variables: Table | None = None) -> Iterator[str]:
        faults = list(super().problems(name))
        yield from faults
        if faults:
            return
        for path, levels in self.levels.items() if isinstance(self.levels, Mapping) else ():
            fractions = np.asarray(levels, float)
            if fractions.ndim and not (fractions.size and np.all((fractions >= 0) & (fractions <= 1))):
                yield f"{name}: {path} = {fractions.tolist()} are not quantile levels in [0, 1]"
        if variables is None:
            return
        if isinstance(self.levels, Mapping):
            missing = [p for p, v in variables.items() if p not in self.levels and not hasattr(v, "middles")]
            yield from (f"{name}: levels of {path} are missing" for path in missing)
            yield from (f"{name}: {path} is not a variable" for path in self.levels if path not in variables)
        for path, variable in variables.items():
            levels = self._levels(path, variable)
            has_end = not isinstance(levels, tuple | list) or {0.0, 1.0} & set(levels)
            if has_end and not hasattr(variable, "middles"):
                yield from _support_problems(name, path, variable, "grid")


def _level_count(levels: int | Sequence[float]) -> int:
    return len(levels) if isinstance(levels, Sequence) else int(levels)


def _levels_at(places: np.ndarray, levels: int | Sequence[float]) -> np.ndarray:
    """Return the levels u at these places: given ones, or those of `numpy.linspace` without computing the others."""
    if isinstance(levels, Sequence):
        return np.array(levels)[places]
    return np.where(places == levels - 1, 1.0, places * (1 / (levels - 1)))


@dataclasses.dataclass(frozen=True)
class Corners(SamplingDesign):
    """The 2^d corners of the box of supports; the last variable changes fastest."""

    def unit(self, seed: int, start: int, stop: int, dimension: int, samples: int) -> Points:
        return Grid(2).unit(seed, start, stop, dimension, samples)

    def count(self, variables: Table, samples: int | None) -> int:
        """Return the number of corners, 2^d for d `variables`.

        Raises:
            ValueError: `samples` is given, and is another number.
        """
        return _check_exact_count(2 ** len(variables), samples, "the corners")

    def problems(self, name: str, variables: Table | None = None) -> Iterator[str]:
        for path, variable in (variables or {}).items():
            if not hasattr(variable, "middles"):
                yield from _support_problems(name, path, variable, "corners")
            elif len(variable.middles()) != 2:
                yield f"{name}: {path} is one of {len(variable.middles())}; corners need two ends; use grid"


@dataclasses.dataclass(frozen=True)
class Saltelli(SamplingDesign):
    """Rows of d + 2 samples for Sobol' sensitivity indices.

    The samples of a row are A, B, and A with column j from B for j = 0, ..., d - 1. Row r of A and B is point r of one
    scrambled Sobol' sequence of dimension 2 d.

    Source: Saltelli et al. 2010, Computer Physics Communications 181, 259.
    """

    def unit(self, seed: int, start: int, stop: int, dimension: int, samples: int) -> Points:
        del samples
        row, member = np.divmod(np.arange(start, stop), dimension + 2)
        first, last = start // (dimension + 2), math.ceil(stop / (dimension + 2))
        a, b = np.split(_sobol_points(seed, 0, first, last, 2 * dimension)[row - first], 2, axis=1)
        from_b = (member[:, None] - 2 == np.arange(dimension)) | (member[:, None] == 1)
        return np.where(from_b, b, a)

    def count(self, variables: Table, samples: int | None) -> int:
        """Return `samples`, the number of all runs.

        Raises:
            ValueError: `samples` is None, or no multiple of the number of `variables` plus 2.
        """
        return _check_multiple(_check_samples(samples), len(variables) + 2, "the number of variables plus 2")


DESIGN_TYPES = {kebab_case(cls.__name__): cls for cls in (Random, Sobol, LatinHypercube, Grid, Corners, Saltelli)}


def read_sampling_design(entry: object, where: str) -> SamplingDesign:
    """Return the design of a table, or of the bare name of a type."""
    return check_sound(read_one(DESIGN_TYPES, entry, where), where)


def _check_seed(seed: int) -> np.uint32:
    if not 0 <= seed <= MAX_UINT32:
        raise ValueError(f"seed = {seed} is outside [0, {MAX_UINT32}]")
    return np.uint32(seed)


def _generator(seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(int(_check_seed(seed)), spawn_key=(stream,)))


def _check_samples(samples: int | None) -> int:
    if samples is None:
        raise ValueError("samples is missing: how many there shall be")
    if not 1 <= samples <= MAX_UINT32:
        raise ValueError(f"samples = {samples} is outside [1, {MAX_UINT32}]")
    return samples


def _check_multiple(samples: int, of: int, meaning: str) -> int:
    below = samples // of * of
    if below != samples:
        near = f"{below} or {below + of}" if below else str(of)
        raise ValueError(f"samples = {samples} is not a multiple of {of}, {meaning}; {near} would be")
    return samples


def _check_exact_count(count: int, samples: int | None, meaning: str) -> int:
    if samples not in (None, count):
        raise ValueError(f"samples = {samples} is not {count}, the number of points of {meaning}")
    return _check_samples(count)


def _support_problems(name: str, path: str, variable: Distribution, design: str) -> Iterator[str]:
    support = support_interval(variable)
    if support.open_low or support.open_high:
        reached = f"{name}: {path} = {format_table(variable)} reaches {support.interval()}"
        yield f"{reached}; {design} needs a finite, closed support"
