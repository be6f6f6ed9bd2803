"""The last step of the co-design, without gradients: random designs around the best one, judged by recovered starts.

The number of recovered starts has no gradient, and a surrogate has its optimum elsewhere. So designs are drawn from a
normal law around the best one. Coordinates go from 0 to 1 over each range, in logarithms where a range is positive. The
best design is the next centre, and the law narrows from round to round.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from diffabs import FixedStep, Loop
from diffabs.robust.design.attraction import classify_starts

Values = dict[str, np.ndarray]  # by name, with a leading axis of designs


@dataclasses.dataclass(frozen=True)
class Draws:
    """How many designs, in how many rounds, and how far from the best in the first round."""

    rounds: int = 6
    designs: int = 200
    spread: float = 0.1
    reach: float = 1.2  # the greatest multiple that is tried, over the best so far
    multiples: int = 9
    seed: int = 0


def improved(
    draws: Draws,
    centre: dict[str, Any],
    ranges: dict[str, tuple[float, float]],
    judge: Callable[[Values, np.ndarray], np.ndarray],
    multiple: float,
) -> tuple[dict[str, Any], float]:
    """The best design found and its multiple, from a design that recovers `multiple`.

    judge: designs and multiples -> whether each is recovered (designs, multiples)
    """
    rng, best = np.random.default_rng(draws.seed), multiple
    for turn in range(draws.rounds):
        spread = draws.spread / (1 + turn)
        drawn = {name: _around(rng, draws.designs, spread, centre[name], *ends) for name, ends in ranges.items()}
        multiples = best * np.linspace(1.0, draws.reach, draws.multiples)
        counts = np.cumprod(judge(drawn, multiples), axis=1).sum(axis=1)
        first = int(np.argmax(counts))
        if counts[first] > 1:
            best, centre = float(multiples[counts[first] - 1]), {name: column[first] for name, column in drawn.items()}
    return centre, best


def _around(rng: np.random.Generator, count: int, spread: float, at: Any, low: float, high: float) -> np.ndarray:
    forward, back = (np.log, np.exp) if low > 0 else (np.asarray, np.asarray)
    a, b = forward(low), forward(high)
    place = (forward(np.asarray(at, float)) - a) / (b - a)
    place = np.clip(place + spread * rng.standard_normal((count, *np.shape(place))), 0.0, 1.0)
    return back(a + (b - a) * place)


def runs(
    closed: Callable[[Any], Loop], rider: float, start: np.ndarray, solver: FixedStep
) -> Callable[[Values, np.ndarray], np.ndarray]:
    """A judge: the nonlinear loops `closed(design)` with this rider, from multiples of a start of frame and rider."""
    many = jax.jit(jax.vmap(closed))

    def judge(designs: Values, multiples: np.ndarray) -> np.ndarray:
        loops = many(designs)
        columns = {f"plant.{field.name}": getattr(loops.plant, field.name) for field in dataclasses.fields(loops.plant)}
        columns["controller.gain"] = loops.controller.gain
        columns["plant.rider_mass"] = np.full(loops.controller.gain.shape[0], rider)
        lanes = {path: np.repeat(np.asarray(column), len(multiples), axis=0) for path, column in columns.items()}
        each = np.tile(multiples, len(columns["plant.rider_mass"]))
        lanes |= {"initial.theta": start[0] * each, "initial.phi": start[2] * each}
        template = jax.tree.map(lambda x: x[0], loops)
        return classify_starts(template, lanes, solver).recovered.reshape(-1, len(multiples))

    return judge
