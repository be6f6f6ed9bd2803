"""Mass, speed and friction unknown together: does what was proved hold?

A gain is designed over a box of three parameters of Maeda and Sugiura's rig, with a least decay rate, and proved for
the polytope that covers the box. Then closed loops are drawn from the box, frozen, and their slowest pole compared with
the rate that was proved. One that is slower would refute the proof, or the hull that it is about.

    python experiments/three_uncertainties.py
"""

import dataclasses
from typing import Any

import jax
import numpy as np

from diffabs import plot, replace
from diffabs.design import Spec, certify, design
from diffabs.design.parameter_box import polytope
from diffabs.linear.slip_model import SlipModel
from diffabs.papers import record
from diffabs.plants import MirroredRig


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment. w4 is the height of the friction curve (13)."""

    mass: tuple[float, float] = (5.3, 6.2)  # kg
    speed: tuple[float, float] = (5 / 3.6, 50 / 3.6)  # m/s
    peak: tuple[float, float] = (0.9 * 0.407, 1.1 * 0.407)  # w4
    weights: tuple[float, float] = (1e6, 1e4)
    decay: float = 6.0  # 1/s
    samples: int = 10_000
    seed: int = 0
    out: str = "out/experiments/three_uncertainties"

    def box(self) -> dict[str, tuple[float, float]]:
        """By path of the model."""
        return {"plant.mass": self.mass, "speed": self.speed, "plant.road.w4": self.peak}


def drawn(config: Config, model: SlipModel) -> tuple[np.ndarray, np.ndarray]:
    """A and B at random points of the box."""
    random = np.random.default_rng(config.seed)
    points = {path: random.uniform(*ends, config.samples) for path, ends in config.box().items()}
    a, b = jax.jit(jax.vmap(lambda values: replace(model, values).matrices()))(points)
    return np.asarray(a), np.asarray(b)


def study(config: Config) -> dict[str, Any]:
    """The gain, its proof, and the slowest poles [1/s] of the loops that were drawn."""
    model = SlipModel(plant=MirroredRig())
    system = polytope(model, config.box())
    found = design(system, Spec(Q=config.weights, R=1.0, decay=config.decay))
    proof = certify(found.gain, system, Spec(Q=config.weights, R=1.0, decay=config.decay), fastest=True)
    a, b = drawn(config, model)
    rates = -np.linalg.eigvals(a + b @ found.gain).real.max(axis=1)
    return {"system": system, "design": found, "proof": proof, "rates": rates}


def table(seen: dict[str, Any]) -> list[dict[str, Any]]:
    """What was proved and what was seen."""
    system, found, proof, rates = (seen[key] for key in ("system", "design", "proof", "rates"))
    slower = int((rates < proof.decay_rate).sum())
    values = {
        "vertices": system.vertices,
        "systems of the box checked to lie in their hull": system.coverage.checked,
        "factor by which corners were spread": system.coverage.spread,
        "k1 [N m/s]": float(found.gain[0, 0]),
        "k2 [N m]": float(found.gain[0, 1]),
        "guaranteed cost": proof.guaranteed_cost,
        "decay rate proved [1/s]": proof.decay_rate,
        "proved exactly": proof.verified_exactly,
        "loops drawn": len(rates),
        "slowest of them [1/s]": float(rates.min()),
        "slower than proved": slower,
    }
    return [{"quantity": name, "value": value} for name, value in values.items()]


def figure(seen: dict[str, Any]) -> Any:
    """How fast the loops decay, and what was proved."""
    sheet, (ax,) = plot.sheet(title="Frozen loops of the box, and the rate that was proved", size=(6.4, 3.8))
    ax.hist(seen["rates"], bins=60, color=plot.COLOURS[0])
    ax.axvline(seen["proof"].decay_rate, color=plot.COLOURS[1], linestyle="--", label="proved, also while it varies")
    plot.label_axes(ax, "slowest pole's decay rate [1/s]", "loops")
    ax.set_xlim(0, None)
    return sheet


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    seen = study(config)
    rows = table(seen)
    record.print_rows("Mass, speed and friction unknown", rows)
    return record.experiment(config, {"table": rows, "certificate": seen["proof"].summary()}, {"rates": figure(seen)})


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
