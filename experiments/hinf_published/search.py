"""Static gains of least H-infinity norm, for all plants and starts of a group at once.

First the greatest real part of the closed loop's poles is minimised until it is negative, then the logarithm of the
norm. The peaks of the response and their gradients are those of `diffabs.linear.responses`. One compiled function has
the plants and starts as its batch: the matrices are padded with zeros, and with stable states that influence nothing.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once
from diffabs.linear.responses.norms import find_norm_peaks
from diffabs.linear.responses.response import TracedSystem
from experiments.hinf_published.bundle import Functions, minimise_greatest
from experiments.hinf_published.problems import Plant

STABLE = -1e-6  # greatest real part of a pole, relative to the norm of A, that ends the search for a stable loop
STABLE_ROUNDS = 200
CHUNK = 8  # loops of a call


def stack_plants(plants: Sequence[Plant]) -> Plant:
    """Return plants as arrays with a leading axis."""
    n, nw, nu, nz, ny = (max(sizes) for sizes in zip(*map(_sizes, plants), strict=True))
    shapes = ((n, n), (n, nw), (n, nu), (nz, n), (ny, n), (nz, nw), (nz, nu), (ny, nw))
    stacked = [np.zeros((len(plants), *shape)) for shape in shapes]
    for i, plant in enumerate(plants):
        stacked[0][i] = -np.linalg.norm(plant.A, 2) * np.eye(n)
        for matrices, matrix in zip(stacked, plant, strict=True):
            matrices[i, : matrix.shape[0], : matrix.shape[1]] = matrix
    return Plant(*stacked)


def _sizes(plant: Plant) -> tuple[int, int, int, int, int]:
    return len(plant.A), plant.B1.shape[1], plant.B.shape[1], len(plant.C1), len(plant.C)


def _close(plant: Plant, gain: jax.Array) -> TracedSystem:
    gain = gain.reshape(plant.B.shape[1], plant.C.shape[0])
    a, b, c, d = plant.close(gain)  # pyright: ignore[reportArgumentType]
    return TracedSystem(a, b, c, d, None, jnp.zeros(()))  # pyright: ignore[reportArgumentType]


@compile_once(options=SAME_RESULT_OPTIONS)
def expand_poles(gains: Any, plants: Plant) -> Functions:
    """Return the real parts of the poles over the norm of A, with gradients; the Hessians are zero."""

    def expand(gain: jax.Array, plant: Plant) -> Functions:
        def measure(gain: jax.Array) -> jax.Array:
            return jnp.linalg.eigvals(_close(plant, gain).A).real / jnp.linalg.norm(jnp.asarray(plant.A))

        value, pull = jax.linearize(measure, gain)
        slopes = jax.vmap(pull, out_axes=-1)(jnp.eye(len(gain)))
        return Functions(value, slopes, jnp.zeros((*slopes.shape, len(gain))))  # pyright: ignore

    return jax.vmap(expand)(gains, plants)


@compile_once(options=SAME_RESULT_OPTIONS)
def expand_peaks(gains: Any, plants: Plant) -> Functions:
    """Return the logarithms of the peaks of the response with derivatives; +inf for an unstable loop."""

    def expand(gain: jax.Array, plant: Plant) -> Functions:
        def measure(gain: jax.Array) -> jax.Array:
            tops, _ = find_norm_peaks(_close(plant, gain))
            some = tops > 0
            return jnp.where(some, jnp.log(jnp.where(some, tops, 1.0)), -jnp.inf)

        def value_and_slopes(gain: jax.Array) -> tuple[jax.Array, jax.Array]:
            value, pull = jax.linearize(measure, gain)
            return value, jax.vmap(pull, out_axes=-1)(jnp.eye(len(gain)))

        (value, slopes), push = jax.linearize(value_and_slopes, gain)
        bends = jax.vmap(lambda move: push(move)[1], out_axes=-1)(jnp.eye(len(gain)))
        stable = jnp.all(jnp.linalg.eigvals(_close(plant, gain).A).real < 0)
        return Functions(jnp.where(stable, value, jnp.inf), slopes, bends)  # pyright: ignore

    return jax.vmap(expand)(gains, plants)


class GainSearch(NamedTuple):
    """Results of the searches of a group.

    Attributes:
        gains: Gain of each plant and start, in the order of the plants, then of the starts.
        norms: Norms that the search sees (plants, starts); infinite where no stable loop was found.
        evaluations: Evaluations of the poles and of the norm (plants, starts).
    """

    gains: list[list[np.ndarray]]
    norms: np.ndarray
    evaluations: np.ndarray


def search_gains(plants: Sequence[Plant], starts: int, rounds: int, tolerance: float, seed: int) -> GainSearch:
    """Return gains of least norm from some starts: the zero gain, and gains of independent normal numbers."""
    stacked = stack_plants(plants)
    nu, ny = stacked.B.shape[2], stacked.C.shape[1]
    start = np.zeros((len(plants), starts, nu, ny))
    for i, plant in enumerate(plants):
        draw = np.random.default_rng(seed)
        drawn = draw.normal(size=(starts - 1, plant.B.shape[1], len(plant.C)))
        start[i, 1:, : drawn.shape[1], : drawn.shape[2]] = drawn
    everything = Plant(*(np.repeat(matrices, starts, axis=0) for matrices in stacked))

    def expand(function: Any) -> Any:
        def call(gains: np.ndarray, at: np.ndarray) -> Functions:
            parts = []
            for low in range(0, len(at), CHUNK):
                # A batch of one size is compiled once.
                places = np.minimum(np.arange(low, low + CHUNK), len(at) - 1)
                some = Plant(*(matrices[at[places]] for matrices in everything))
                parts.append([np.asarray(part)[: len(at) - low] for part in function(gains[places], some)])
            values, *derivatives = (np.concatenate(part) for part in zip(*parts, strict=True))
            return Functions(values, *map(np.nan_to_num, derivatives))

        return call

    first = minimise_greatest(expand(expand_poles), start.reshape(-1, nu * ny), STABLE_ROUNDS, goal=STABLE)
    last = minimise_greatest(expand(expand_peaks), first.x, rounds, tolerance)
    gains = last.x.reshape(len(plants), starts, nu, ny)
    cut = [[gain[: p.B.shape[1], : len(p.C)] for gain in row] for p, row in zip(plants, gains, strict=True)]
    shape = (len(plants), starts)
    evaluations = (first.evaluations + last.evaluations).reshape(shape)
    return GainSearch(cut, np.exp(last.values).reshape(shape), evaluations)
