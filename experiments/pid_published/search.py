"""The greatest integral gain of all models at once, by an interior-point method with exact derivatives.

    maximise ln ki + mu * sum of ln(1 - peak/M) over the local maxima of |S| and |T|,   mu -> 0

Peaks and their first and second derivatives are those of `diffabs.linear.responses`. One compiled function has the
models as its batch. An unstable loop has no value, so a step never leaves the stable loops.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once
from diffabs.linear.responses.grid import place_frequencies
from diffabs.linear.responses.loop_margins import find_sensitivity_peaks
from diffabs.linear.responses.response import TracedSystem
from experiments.pid_published.models import Gains, Process

ORDER = 8  # greatest of a model
BARRIERS = (1.0, 1e-5)  # mu of the first and of the last centre
CENTRED = 0.01  # of mu: expected decrease of the function below which mu falls
MAX_ROUNDS = 400
MIN_CURVATURE = 1e-9
MIN_SHARE = 1e-6  # of a Newton step, below which rounding ends the search for a centre
STARTS = tuple(0.8**power for power in range(40))  # of the guessed gains


class Models(NamedTuple):
    """Models as arrays with a leading axis, in units of their own time scale.

    Attributes:
        A: Matrix (count, 8, 8); a model of less order has stable states more that influence nothing.
        B: Matrix (count, 8, 1).
        C: Matrix (count, 1, 8).
        delay: Delays (count,).
        filter_time: Time constants of the derivative's filter (count,).
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    delay: np.ndarray
    filter_time: np.ndarray


def stack_models(processes: Sequence[Process], filter_times: Sequence[float]) -> Models:
    """Return processes as arrays; time is in units of `Process.duration`."""
    count = len(processes)
    a, b, c = np.tile(-np.eye(ORDER), (count, 1, 1)), np.zeros((count, ORDER, 1)), np.zeros((count, 1, ORDER))
    for i, process in enumerate(processes):
        matrix, entry, row = process.state_space()
        n = len(matrix)
        a[i, :n, :n], b[i, :n], c[i, :, :n] = matrix * process.duration, entry * process.duration, row
    scales = np.array([process.duration for process in processes])
    delays = np.array([process.delay for process in processes])
    return Models(a, b, c, delays / scales, np.array(filter_times) / scales)


def open_pid(model: Models, k: jax.Array, ki: jax.Array, kd: jax.Array) -> TracedSystem:
    """Return L = P C of one model with C = k + ki/s + kd s/(1 + s filter_time)."""
    n, rate = ORDER, 1 / model.filter_time
    a = jnp.zeros((n + 2, n + 2)).at[:n, :n].set(model.A)
    # The last two states are the integral of the output, and the filtered output.
    a = a.at[n, :n].set(model.C[0]).at[n + 1, :n].set(rate * model.C[0]).at[n + 1, n + 1].set(-rate)
    b = jnp.zeros((n + 2, 1)).at[:n].set(model.B)
    c = jnp.concatenate([(k + kd * rate) * model.C[0], jnp.stack([ki, -kd * rate])])[None]
    return TracedSystem(a, b, c, jnp.zeros((1, 1)), None, jnp.asarray(model.delay))


def measure_rooms(x: jax.Array, model: Models, units: jax.Array, peak: float) -> jax.Array:
    """Return minus the sum of ln(1 - peak/M) of one model; NaN for an unstable loop or a peak beyond the bound.

    Args:
        x: ln ki, k and, of a PID controller, kd (2,) or (3,).
        model: Model.
        units: Units of k and kd (2,).
        peak: Bound M of |S| and |T|.
    """
    derivative = x[2] * units[1] if len(x) > 2 else jnp.zeros(())
    loop = open_pid(model, x[1] * units[0], jnp.exp(x[0]), derivative)
    grid = place_frequencies(loop)
    tops = [find_sensitivity_peaks(loop, grid, change)[0] for change in (lambda s, w: s, lambda s, w: 1 - s)]
    rooms = 1 - jnp.concatenate(tops) / peak
    rooms = jnp.where(jnp.isfinite(rooms), rooms, 1.0)
    inside = grid.decided & jnp.all(rooms > 0)
    return jnp.where(inside, -jnp.sum(jnp.log(jnp.where(rooms > 0, rooms, 1.0))), jnp.nan)


@compile_once(options=SAME_RESULT_OPTIONS)
def expand_rooms(x: Any, models: Models, units: Any, peaks: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return `measure_rooms` of all models, its gradients and its Hessians."""

    def expand(*arguments: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
        def value_and_gradient(x: jax.Array) -> tuple[jax.Array, jax.Array]:
            value, pull = jax.linearize(lambda x: measure_rooms(x, *arguments[1:]), x)
            return value, jax.vmap(pull)(jnp.eye(len(x)))

        (value, gradient), push = jax.linearize(value_and_gradient, arguments[0])
        return value, gradient, jax.vmap(push)(jnp.eye(len(arguments[0])))[1]

    return jax.vmap(expand)(x, models, units, peaks)


class Search(NamedTuple):
    """Result of a search.

    Attributes:
        gains: Gains in the models' own units of time.
        evaluations: Evaluations of each model, with derivatives.
    """

    gains: list[Gains]
    evaluations: np.ndarray


def start_inside(
    models: Models, guesses: Sequence[Gains], peaks: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates inside the bounds, (count, size), and their units: guesses with lower gains where needed.

    Raises:
        ValueError: A model has no such start.
    """
    guess = np.array(guesses)
    units = np.stack([guess[:, 0], np.where(guess[:, 2] > 0, guess[:, 2], 1.0)], axis=1)
    start = np.full((len(guess), size), np.nan)
    for factor in STARTS:
        x = np.stack([np.log(guess[:, 1] * factor**2), *([np.full(len(guess), factor)] * (size - 1))], axis=1)
        value = np.asarray(expand_rooms(x, models, units, peaks)[0])
        take = np.isnan(start[:, 0]) & np.isfinite(value)
        start[take] = x[take]
        if np.isfinite(start).all():
            return start, units
    raise ValueError(f"no start inside the bounds for models {np.flatnonzero(np.isnan(start[:, 0])).tolist()}")


def maximise_integral(models: Models, start: np.ndarray, units: np.ndarray, peaks: np.ndarray) -> Search:
    """Return the gains with the greatest ki, from a start inside the bounds.

    All models advance together; each has its own steps and barrier.
    """
    count, size = start.shape
    x, barrier, share = start, np.full(count, BARRIERS[0]), np.ones(count)
    rooms = [np.asarray(part) for part in expand_rooms(x, models, units, peaks)]
    evaluations, active = np.ones(count, int), np.ones(count, bool)
    target = np.eye(size)[0]
    for _ in range(MAX_ROUNDS):
        gradient = barrier[:, None] * rooms[1] - target
        curvatures, axes = np.linalg.eigh(barrier[:, None, None] * rooms[2])
        # Absolute curvatures keep the step one of descent.
        along = np.einsum("nij,ni->nj", axes, gradient)
        move = -np.einsum("nij,nj->ni", axes, along / np.maximum(np.abs(curvatures), MIN_CURVATURE))
        decrease = -np.sum(gradient * move, axis=1)
        centred = (decrease < CENTRED * barrier) | (share < MIN_SHARE)
        active &= ~(centred & (barrier <= BARRIERS[1]))
        if not active.any():
            break
        barrier = np.where(centred & active, np.maximum(0.1 * barrier, BARRIERS[1]), barrier)
        share = np.where(centred, 1.0, share)
        length = np.maximum(np.linalg.norm(move, axis=1), 1.0)
        step = np.where((active & ~centred)[:, None], (share / length)[:, None] * move, 0.0)
        trial = [np.asarray(part) for part in expand_rooms(x + step, models, units, peaks)]
        evaluations += active & ~centred
        change = barrier * (trial[0] - rooms[0]) - step[:, 0]
        better = change < 0
        x = np.where(better[:, None], x + step, x)
        for i, part in enumerate(trial):
            rooms[i] = np.where(better.reshape(-1, *[1] * (part.ndim - 1)), part, rooms[i])
        share = np.where(better, np.minimum(2 * share, 1.0), 0.25 * share)
    kd = x[:, 2] * units[:, 1] if size > 2 else np.zeros(count)
    rows = zip(x[:, 1] * units[:, 0], np.exp(x[:, 0]), kd, strict=True)
    return Search([Gains(*map(float, row)) for row in rows], evaluations)
