"""How near does a search with exact derivatives come to the static gains of least H-infinity norm of published plants?

The plants are of COMPleib (`problems.py`). From four starts each, the norm from the disturbance to the output of the
closed loop is minimised over the static gain (`search.py`, `bundle.py`). NumPy measures the norms of the results, and
they are compared with those of HIFOO and `hinfstruct`.

    python experiments/hinf_published/run.py
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from diffabs.papers import record
from experiments._shared.numbers import store_numbers
from experiments.hinf_published import problems, search
from experiments.hinf_published.problems import Plant

SMALL = 5  # states of a plant in the first of the two groups that are searched together
SAME = 1e-3  # relative distance of norms below which two searches agree
FREQUENCIES, TOPS, REFINEMENTS = 2000, 5, 5  # of the scan: places, maxima that are refined, and how often


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    names: tuple[str, ...] = ()  # of plants; all if empty
    starts: int = 4
    rounds: int = 150  # evaluations of the norm from one start, at most
    tolerance: float = 1e-7  # predicted decrease of the norm's logarithm that ends a search
    seed: int = 0
    out: str = "out/experiments/hinf_published"


def measure_norm(plant: Plant, gain: np.ndarray) -> float:
    """Return the H-infinity norm of the loop by a scan of frequencies in NumPy, refined; infinite if it is unstable."""
    a, b, c, d = plant.close(gain)
    poles = np.linalg.eigvals(a)
    if np.max(poles.real) >= 0:
        return np.inf

    def respond(w: np.ndarray) -> np.ndarray:
        inner = np.linalg.solve(1j * w[:, None, None] * np.eye(len(a)) - a, np.broadcast_to(b, (len(w), *b.shape)))
        return np.linalg.norm(c @ inner + d, 2, axis=(1, 2))

    sizes = np.abs(poles)
    around = np.abs(poles.imag)[:, None] + np.abs(poles.real)[:, None] * np.linspace(-3.0, 3.0, 61)
    even = np.geomspace(1e-3 * sizes.min(), 1e3 * sizes.max(), FREQUENCIES)
    w = np.unique(np.concatenate([[0.0], even, around[around > 0]]))
    values = respond(w)
    bordered = np.concatenate([[-np.inf], values, [-np.inf]])
    maxima = np.flatnonzero((values >= bordered[:-2]) & (values >= bordered[2:]))
    for top in maxima[np.argsort(values[maxima])[-TOPS:]]:
        low, high = w[max(top - 1, 0)], w[min(top + 1, len(w) - 1)]
        for _ in range(REFINEMENTS):
            between = np.linspace(low, high, 21)
            heights = respond(between)
            place = int(np.argmax(heights))
            low, high = between[max(place - 1, 0)], between[min(place + 1, 20)]
            values[top] = max(values[top], heights[place])
    return float(max(values.max(), np.linalg.norm(d, 2)))


def compare_plant(
    name: str, plant: Plant, gains: Sequence[np.ndarray], norms: Sequence[float], evaluations: np.ndarray
) -> dict[str, Any]:
    """Return the row of one plant from the gains of its starts, their norms and evaluations."""
    best = int(np.argmin(norms))
    reached = problems.REACHED[name]
    return {
        "plant": name,
        "states": len(plant.A),
        "controls": plant.B.shape[1],
        "measurements": len(plant.C),
        "norm": norms[best],
        "HIFOO": reached.norm,
        "norm / HIFOO": norms[best] / reached.norm,
        "evaluations": int(evaluations.sum()),
        "evaluations of HIFOO": reached.evaluations,
        "starts that agree": sum(norm <= (1 + SAME) * norms[best] for norm in norms),
        "starts that stabilise": int(np.sum(np.isfinite(norms))),
        "greatest gain": float(np.max(np.abs(gains[best]))),
        "gain": gains[best].tolist(),
    }


def summarise(rows: Sequence[dict[str, Any]], differences: Sequence[float]) -> dict[str, Any]:
    """Return the results from the rows, and from relative differences of the norms from the scan."""
    ratios = np.array([row["norm / HIFOO"] for row in rows])
    return {
        "rows": list(rows),
        "work": {
            "plants": len(rows),
            "below HIFOO by more than a thousandth": int(np.sum(ratios < 1 - SAME)),
            "above HIFOO by more than a thousandth": int(np.sum(ratios > 1 + SAME)),
            "median evaluations": float(np.median([row["evaluations"] for row in rows])),
            "median evaluations of HIFOO": float(np.median([row["evaluations of HIFOO"] for row in rows])),
            "greatest difference from the scan": float(np.max(differences)),
        },
    }


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    plants = problems.load_plants()
    plants = {name: plants[name] for name in config.names or plants}
    rows, differences = {}, []
    small = [name for name, plant in plants.items() if len(plant.A) <= SMALL]
    for group in filter(None, (small, [name for name in plants if name not in small])):
        members = [plants[name] for name in group]
        result = search.search_gains(members, config.starts, config.rounds, config.tolerance, config.seed)
        for i, name in enumerate(group):
            norms = [measure_norm(plants[name], gain) for gain in result.gains[i]]
            rows[name] = compare_plant(name, plants[name], result.gains[i], norms, result.evaluations[i])
            differences += [abs(a / b - 1) for a, b in zip(norms, result.norms[i], strict=True) if np.isfinite(b)]
    results = summarise([rows[name] for name in plants], differences)
    table = [{key: value for key, value in row.items() if key != "gain"} for row in results["rows"]]
    record.print_rows("Least H-infinity norms with a static gain", table)
    print(results["work"])
    return record.experiment(config, results, {})


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    store_numbers(__file__, main(), tolerance=1e-3)
